"""Motors with their speed loop: lag, delay, dead zone, limits, and control of speed at any battery voltage."""

import numpy as np
import pytest

from finssim.pool import draw_plant
from finssim.pool.plant import RPM, Plant
from finssim.vehicles import load_vehicle

FINSROV = load_vehicle("finsrov")
NOMINAL = draw_plant(FINSROV, 0, "nominal")


def speeds(spec, target_rpm, duration=2.0, motor=4, seed=0, **options):
    """Return the true shaft speed of one motor after a step of its target [rpm], by physics step."""
    plant = Plant(FINSROV, spec, seed=seed, **options)
    plant.target[motor] = target_rpm * RPM
    out = []
    for _ in range(round(duration / plant.step)):
        plant.advance()
        out.append(float(plant.shaft_speed[motor]) / RPM)
    return np.array(out)


@pytest.mark.parametrize("target", [1500.0, -900.0])
def test_the_loop_settles_on_its_target(target):
    """The error is within a quantum of the speed measurement, also on a hard plant with a sagging battery."""
    for spec in (NOMINAL, draw_plant(FINSROV, 3, "hard")):
        settled = speeds(spec, target, 4.0)[-200:]
        assert abs(settled.mean() - target) < spec.firmware.rpm_quantum
        assert settled.std() < 3.0 * spec.firmware.rpm_noise


def test_the_shaft_follows_after_the_delay_with_the_file_lag():
    """There is no motion during the delay; 63 % is reached slightly before delay plus time constant, owing to
    the loop."""
    thruster = FINSROV.thrusters["H_LF"]
    response = speeds(NOMINAL, 1000.0) / 1000.0
    step = 0.005
    assert np.all(response[: int(thruster.delay / step)] == 0.0)
    rise = step * (1 + np.argmax(response > 1.0 - np.exp(-1.0)))
    assert (
        thruster.delay + 0.6 * thruster.time_constant < rise < thruster.delay + 1.1 * thruster.time_constant
    )
    assert response.max() < 1.15


def test_without_the_loop_the_feed_forward_alone_is_wrong():
    """With zero gains the firmware's model error remains: full throttle does not give the speed of the file."""
    off = NOMINAL.firmware.model_copy(update={"gain": 0.0, "integral_gain": 0.0, "derivative_gain": 0.0})
    spec = NOMINAL.model_copy(update={"firmware": off})
    assert abs(speeds(spec, 1000.0)[-1] - 1000.0) > 30.0
    wrong = off.model_copy(update={"feed_forward": 0.8})
    assert speeds(NOMINAL.model_copy(update={"firmware": wrong}), 1000.0)[-1] == pytest.approx(
        0.8 * speeds(spec, 1000.0)[-1], rel=1e-3
    )


@pytest.mark.parametrize("target", [1500.0, -900.0])
def test_pulses_alone_turn_a_motor_as_fast_as_it_and_its_battery_can(target):
    """Without a speed loop a nominal motor at full voltage reaches the target; otherwise speed scales with
    both."""
    assert speeds(NOMINAL, target, speed_loop=False)[-1] == pytest.approx(target, rel=2e-3)
    built = NOMINAL.thrusters
    weak = {name: t.model_copy(update={"full_rpm": 0.9 * t.full_rpm}) for name, t in built.items()}
    spec = NOMINAL.model_copy(update={"thrusters": weak})
    assert speeds(spec, target, speed_loop=False)[-1] == pytest.approx(0.9 * target, rel=2e-3)
    tired = NOMINAL.battery.model_copy(update={"fade": 0.2, "fade_time": 0.1, "resistance": 0.0})
    spec = NOMINAL.model_copy(update={"battery": tired})
    assert speeds(spec, target, speed_loop=False)[-1] == pytest.approx(0.8 * target, rel=2e-3)


def test_the_derivative_gain_holds_the_rise_back():
    """A larger derivative gain gives less speed during the rise."""
    strong = NOMINAL.firmware.model_copy(update={"derivative_gain": 0.03})
    held = speeds(NOMINAL.model_copy(update={"firmware": strong}), 1500.0, 0.3)
    assert held[20:50].mean() < speeds(NOMINAL, 1500.0, 0.3)[20:50].mean() - 10.0


def test_no_shaft_turns_slower_than_its_slowest_speed():
    """A throttle for a lower speed does not turn it; one for a higher speed does."""
    off = NOMINAL.firmware.model_copy(update={"gain": 0.0, "integral_gain": 0.0})
    spec = NOMINAL.model_copy(update={"firmware": off})
    slowest = NOMINAL.thrusters["H_LF"].dead_rpm_plus
    assert np.all(speeds(spec, 0.9 * slowest) == 0.0)
    assert speeds(spec, 1.05 * slowest)[-1] > slowest


def test_no_shaft_turns_faster_than_the_battery_allows():
    """The file's firmware scale of 3000 rpm exceeds what any motor reaches."""
    assert speeds(NOMINAL, 3000.0)[-1] == pytest.approx(NOMINAL.thrusters["H_LF"].full_rpm, rel=1e-3)


def test_a_shaft_told_to_stop_stops():
    """The shaft stays stopped: noise does not make it creep."""
    plant = Plant(FINSROV, NOMINAL)
    plant.target[0] = 150.0
    plant.advance(200)
    plant.target[0] = 0.0
    plant.advance(400)
    assert np.all(plant.shaft_speed == 0.0) and np.all(plant.throttle == 0.0)


def test_speed_measurements_are_noisy_by_the_seed():
    """Equal seeds repeat, other seeds do not; the noise has the plant's size."""
    assert np.array_equal(speeds(NOMINAL, 800.0, seed=3), speeds(NOMINAL, 800.0, seed=3))
    assert not np.array_equal(speeds(NOMINAL, 800.0, seed=3), speeds(NOMINAL, 800.0, seed=4))
    plant = Plant(FINSROV, NOMINAL)
    plant.target[:] = 1000.0 * RPM
    plant.advance(400)
    errors = []
    for _ in range(300):
        plant.advance()
        errors.append((plant.measured_speed - plant.shaft_speed) / RPM)
    expected = np.hypot(NOMINAL.firmware.rpm_noise, NOMINAL.firmware.rpm_quantum / np.sqrt(12.0))
    assert np.std(errors) == pytest.approx(expected, rel=0.1)
