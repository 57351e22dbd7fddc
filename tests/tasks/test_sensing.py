"""Observations from the vehicle's own sensors and position fixes: errors, times, losses, and the filter."""

import math

import numpy as np
import pytest
import warp as wp

import finssim
from finssim.localization.fusion import attitude, position_filter
from finssim.sim.randomize import Randomization
from finssim.sim.ranges_file import Ranges
from finssim.tasks import Environment, EnvironmentSetupError, MeasurementNoise, StationKeeping
from finssim.tasks.check import check_task
from finssim.tasks.sensing import (
    Sensing,
    covariance_after_rate,
    covariance_after_value,
    propagated_covariance,
    value_gain,
)
from finssim.vehicles import load_vehicle
from finssim.vehicles.equipment import DepthSensor, Dvl, Imu

ORIGIN = np.zeros(3)
PERFECT_IMU = Imu(
    rate=100.0, position=ORIGIN, gyro_noise_density=0.0, gyro_bias_walk=0.0, gyro_bias_initial=0.0,
    accel_noise_density=0.0, accel_bias_walk=0.0, accel_bias_initial=0.0,
)  # fmt: skip
EXACT = 1e-4
"""Deviation of a fix that the filter adopts exactly [m, rad]."""


def carrying(**sensors):
    """Return FinsROV with a perfect IMU and other sensors; None removes one."""
    vehicle = load_vehicle("finsrov")
    given = {"imu": PERFECT_IMU, "depth": None, "dvl": None, **sensors}
    return vehicle.model_copy(update={"sensors": vehicle.sensors.model_copy(update=given)})


def made(sensing=None, worlds=200, vehicle="finsrov", **options):
    return Environment(
        StationKeeping(), vehicle, worlds=worlds, noise=sensing or Sensing(), seed=5, **options
    )


def fixes(rate=10.0, **noise):
    return Sensing(rate=rate, fixes=MeasurementNoise(**{"position_std": EXACT, "yaw_std": EXACT, **noise}))


def run(env, steps, push=0.4):
    """Return estimates and truth after each step, by name, (steps, worlds, numbers); actions last half a
    second."""
    rng, rows = np.random.default_rng(0), []
    for k in range(steps):
        if k % 5 == 0:
            action = rng.uniform(-push, push, (1, 6)).astype(np.float32).repeat(env.worlds, axis=0)
        env.step(action)
        state, a = env.simulator.state, env.arrays
        places = {"position": (a, state), "velocity": (a, state), "quaternion": (a, state)}
        rows.append([getattr(x, name).numpy()[:, 0].copy() for name, both in places.items() for x in both])
    names = [f"{name}{which}" for name in ("position", "velocity", "quaternion") for which in ("", "_true")]
    return {name: np.array([row[i] for row in rows]) for i, name in enumerate(names)}


def yaw_between(q, p):
    """Return the yaw of attitude q relative to p [rad], (...)."""
    d = finssim.core.rotations.quat_multiply(q, p * np.array([-1.0, -1.0, -1.0, 1.0]))
    return 2.0 * np.arctan2(d[..., 2] * np.sign(d[..., 3]), np.abs(d[..., 3]))


# -- the filter's equations are those of the robot's ------------------------------------------------------------------


def test_doubts_grow_and_shrink_as_in_the_filters_of_the_robot():
    """Position and velocity of `position_filter`, yaw and bias of `attitude` (whose bias has the opposite
    sign)."""
    P, q, dt, R = np.array([0.03, 0.01, 0.2]), 0.05, 0.1, 0.004
    square = np.zeros((6, 6))
    square[:3, :3], square[3:, 3:] = np.eye(3) * P[0], np.eye(3) * P[2]
    square[:3, 3:] = square[3:, :3] = np.eye(3) * P[1]
    there = position_filter.PositionState(np.zeros(6), square)
    motion = position_filter.MotionModel(density=(q, q, q))
    later = position_filter.predict(there, dt, motion)
    np.testing.assert_allclose(
        propagated_covariance(wp.vec3(*P), q, dt), later.P[[0, 0, 3], [0, 3, 3]], rtol=1e-5
    )
    for column, known in ((0, covariance_after_value), (3, covariance_after_rate)):
        H, noise = np.eye(6)[[column]], np.array([[R]])
        after = there.corrected(there.innovation(np.ones(1), H, noise))
        np.testing.assert_allclose(known(wp.vec3(*P), R), after.P[[0, 0, 3], [0, 3, 3]], rtol=1e-4)
    yaw = attitude.YawState(0.0, 0.0, P[0], -P[1], P[2])
    after = yaw.corrected(yaw.innovation(np.ones(1), np.array([[1.0, 0.0]]), np.array([[R]])))
    np.testing.assert_allclose(value_gain(wp.vec3(*P), R), [after.yaw, -after.bias], rtol=1e-5)
    after = attitude.predict(yaw, 0.0, dt, attitude.YawNoise(rate=0.0, bias_walk=math.sqrt(q)))
    expected = [after.variance, -after.cross, after.bias_variance]
    np.testing.assert_allclose(propagated_covariance(wp.vec3(*P), q, dt), expected, rtol=1e-5)


def test_a_late_fix_moves_the_path_since_its_own_time():
    """With fixes 0.3 s late, the estimate for 0.3 s ago equals that of a filter without delay at that time."""
    at_once, late = (made(fixes(position_std=0.02, delay=delay), worlds=40) for delay in (0.0, 0.3))
    known = run(at_once, 60)["position"]
    run(late, 60)
    ring = late.sensing.estimates.position.numpy()[:, 0]
    assert ring.shape[1] == 4
    np.testing.assert_allclose(ring[:, 57 % 4, :2], known[56, :, :2], atol=2e-4)


def test_what_is_known_is_as_good_as_the_filter_says():
    """For motion as the filter assumes, errors over worlds and axes have the variance that it states."""
    env = made(fixes(position_std=0.02, yaw_std=0.05), vehicle=carrying(), worlds=400)
    told = env.sensing.estimates.plane.numpy()[0, 0]
    state, rng, dt = env.simulator.state, np.random.default_rng(1), 0.1
    x, v = state.position.numpy()[:, 0].astype(float), np.zeros((400, 3))
    for _ in range(60):
        kick = rng.standard_normal((2, 400, 3)) * math.sqrt(0.05 * dt)
        x += v * dt + dt * (0.5 * kick[0] + kick[1] / math.sqrt(12.0))
        v += kick[0]
        env.simulator.state.steps.assign(state.steps.numpy() + 1)
        state.position.assign(x[:, None].astype(np.float32))
        pipeline = env.simulator.pipeline()
        env.sensing.add(pipeline, env.seed)
        pipeline.run()
    off = (env.arrays.position.numpy()[:, 0] - x)[:, :2]
    speed = (env.sensing.estimates.velocity.numpy()[:, 0, 0] - v)[:, :2]
    assert off.std() == pytest.approx(math.sqrt(told[0]), rel=0.1)
    assert speed.std() == pytest.approx(math.sqrt(told[2]), rel=0.1)
    assert (off * speed).mean() == pytest.approx(told[1], rel=0.25)


# -- fixes ------------------------------------------------------------------------------------------------------------


def test_fixes_come_at_their_rate_and_are_lost_as_often_as_their_chance():
    """At 2.5 Hz every fourth control step may bring a fix, which is the vehicle's position."""
    env = made(fixes(rate=2.5, dropout=0.3), worlds=400, vehicle=carrying())
    seen = run(env, 40)
    off = np.linalg.norm((seen["position"] - seen["position_true"])[..., :2], axis=2)
    came = off < 5.0 * EXACT
    assert came[[k for k in range(40) if (k + 1) % 4]].mean() < 0.2  # those that stand still
    assert came[3::4].mean() == pytest.approx(0.7, abs=0.02)


def test_a_fix_is_as_old_as_it_takes_to_come():
    env = made(fixes(delay=0.24), worlds=20, vehicle=carrying())
    seen = run(env, 15)
    ring = env.sensing.estimates.position.numpy()[:, 0]  # of 0.2 s ago: the nearest control step
    assert ring.shape[1] == 3
    np.testing.assert_allclose(ring[:, 13 % 3], seen["position_true"][12], atol=6.0 * EXACT)
    assert np.abs(seen["position"][14] - seen["position_true"][14]).max() > 10.0 * EXACT


@pytest.mark.parametrize("rate", [10.0, 30.0])
def test_noise_and_offset_of_a_fix_are_those_that_were_given(rate):
    """They are recovered from the filter's estimates; of three fixes in a control step the mean counts."""
    env = made(
        fixes(rate=rate, position_std=0.05, position_bias=0.2, yaw_bias=0.1), worlds=300, vehicle=carrying()
    )
    offsets, e = [], env.sensing.estimates
    R = 0.05**2 / (rate / 10.0)
    for _ in range(6):
        before = env.arrays.position.numpy()[:, 0] + 0.1 * e.velocity.numpy()[:, 0, 0]
        env.step(np.zeros((300, 6)))
        gain = e.plane.numpy()[0, 0, 0] / R  # K = P / R after the fix
        fix = before + (env.arrays.position.numpy()[:, 0] - before) / gain
        offsets.append((fix - env.simulator.state.position.numpy()[:, 0])[:, :2])
    noise = np.array(offsets)
    lasting = noise.mean(axis=0)
    assert (noise - lasting).std(ddof=0) * math.sqrt(6 / 5) == pytest.approx(math.sqrt(R), rel=0.05)
    assert lasting.std() == pytest.approx(math.sqrt(0.2**2 + R / 6), rel=0.08)
    turned = yaw_between(env.arrays.quaternion.numpy()[:, 0], env.simulator.state.quaternion.numpy()[:, 0])
    assert turned.std() == pytest.approx(0.1, rel=0.12) and abs(turned.mean()) < 0.02


def test_ranges_draw_the_noise_of_fixes_by_world():
    ranges = Ranges.model_validate(
        {"name": "test", "sensors": {"delay": [0.0, 0.44], "position_bias": [0.0, 0.4]}}
    )
    env = made(fixes(), vehicle=carrying(), randomization=Randomization(ranges))
    seen = run(env, 12)
    drawn = env.draws.numpy(["sensors.delay", "sensors.position_bias"])[:, 0]
    steps = np.rint(drawn[:, 0].astype(float) / 0.1).astype(int)
    ring = env.sensing.estimates.position.numpy()[:, 0]
    was = [
        ring[w, (12 - steps[w]) % ring.shape[1]] - seen["position_true"][11 - steps[w], w] for w in range(200)
    ]
    spread = np.array(was) / drawn[:, 1:]
    assert set(steps) == {0, 1, 2, 3, 4} and spread.std() == pytest.approx(1.0, abs=0.1)


# -- instruments ------------------------------------------------------------------------------------------------------


def test_depth_comes_from_the_pressure_gauge():
    """The error of z is the gauge's turn-on error, whatever fixes report; x and y are not affected."""
    gauge = DepthSensor(rate=20.0, position=np.array([0.1, 0.0, -0.2]), noise_std=0.0, bias_initial=0.05)
    env = made(fixes(position_bias=1.0), vehicle=carrying(depth=gauge), worlds=400)
    seen = run(env, 20)
    off = (seen["position"] - seen["position_true"])[..., 2]
    assert off[-1].std() == pytest.approx(0.05, rel=0.1)
    left = np.abs(off[-1] + env.sensing.suite.depth.bias.numpy()[:, 0])
    assert np.quantile(left, 0.95) < 2e-3  # except those that just hit a wall


def test_rates_come_from_the_gyro_and_its_bias_is_known_but_for_what_the_filter_doubts():
    env = made(worlds=300)
    seen = run(env, 30)
    off = (seen["velocity"] - seen["velocity_true"])[..., 3:]
    noise = math.hypot(2.5e-4 * math.sqrt(100.0), 1.07e-3 / math.sqrt(12.0))
    np.testing.assert_allclose(off.std(axis=(0, 1)), noise, rtol=0.1)
    bias = env.sensing.suite.imu.gyro_bias.numpy()[:, 0] * [-1.0, -1.0, 1.0]  # the IMU is turned by half
    learned = bias - env.sensing.estimates.bias.numpy()[:, 0]
    assert env.sensing.suite.imu.gyro_bias.numpy().std() == pytest.approx(5e-3, rel=0.1)
    assert learned.std() < 1e-3  # of 5e-3 at power-on


def test_velocity_comes_from_a_dvl_where_there_is_one():
    """Without fixes its noise is filtered, while its bias remains and makes the position drift."""
    quiet = Dvl(rate=10.0, position=np.array([0.0, 0.1, -0.1]), noise_std=0.0)
    seen = run(made(Sensing(rate=0.0), vehicle=carrying(dvl=quiet), worlds=20), 50)
    assert np.abs(seen["position"] - seen["position_true"]).max() < 0.02
    assert np.abs(seen["velocity"] - seen["velocity_true"])[..., :3].max() < 0.02
    biased = Dvl(rate=10.0, position=ORIGIN, noise_std=0.005, bias_initial=0.02)
    env = made(Sensing(rate=0.0), vehicle=carrying(dvl=biased), worlds=400)
    seen = run(env, 100, push=0.0)  # a vehicle that turns would turn its DVL's bias with it
    drift = (seen["position"] - seen["position_true"])[-1]
    assert drift.std() == pytest.approx(0.02 * 10.0, rel=0.15)


def test_a_dvl_makes_velocity_better_than_fixes_alone():
    dvl = Dvl(rate=10.0, position=ORIGIN, noise_std=0.003)
    off = []
    for vehicle in (carrying(), carrying(dvl=dvl)):
        seen = run(made(vehicle=vehicle), 30)
        off.append((seen["velocity"] - seen["velocity_true"])[..., :3].std())
    assert off[1] < 0.5 * off[0]


# -- worlds, seeds, refusals ------------------------------------------------------------------------------------------


def test_a_world_is_the_same_in_every_batch_and_a_seed_repeats_it():
    few, many, again = made(worlds=3), made(worlds=130, threads=2), made(worlds=3)
    first, second = run(few, 12), run(many, 12)
    for name, values in run(again, 12).items():
        np.testing.assert_array_equal(first[name], values)
        np.testing.assert_array_equal(first[name], second[name][:, :3])
    again.reset(seed=6)
    assert not np.array_equal(again.arrays.position.numpy(), made(worlds=3).arrays.position.numpy())
    again.reset(seed=5)
    np.testing.assert_array_equal(again.arrays.position.numpy(), made(worlds=3).arrays.position.numpy())


def test_a_reset_elsewhere_does_not_change_what_is_seen():
    env = made(fixes(delay=0.2, dropout=0.5), worlds=8)
    run(env, 5)
    before = env.state()
    env.reset(mask=np.arange(8) < 3)
    for name, values in env.state().items():
        if name.startswith("estimates.") or name == "task.position":
            np.testing.assert_array_equal(values[3:], before[name][3:])
            assert not np.array_equal(values[:3], before[name][:3]) or "past" in name


def test_a_task_passes_its_check_under_sensors():
    check_task(StationKeeping(), noise=Sensing())


def test_nothing_is_made_where_sensors_are_not_asked_for():
    env = finssim.make("t1", worlds=2)
    assert env.sensing is None and env.arrays.position.ptr == env.simulator.state.position.ptr
    assert not any(name.startswith(("estimates", "readings")) for name in env.state())


def test_fixes_of_another_site_are_a_file(tmp_path):
    """Omitted values of a fix are 0; mistakes are reported with file and key."""
    file = tmp_path / "usbl.yaml"
    file.write_text("rate: 1\nfixes: {position_std: 0.2, yaw_std: 1, delay: 0.5}\n")
    env = finssim.make("t1", worlds=1, observe=str(file))
    assert env.noise == Sensing(rate=1.0, fixes=MeasurementNoise(position_std=0.2, yaw_std=1.0, delay=0.5))
    for text, sentence in (
        ("fixes: {}", "rate is missing: give the fixes a second"),
        ("rate: fast", "rate is 'fast', expected a number"),
        ("rate: 1\nfix: {}", "unknown key 'fix', expected rate, fixes"),
        ("rate: 1\nfixes: 3", "fixes is 3, expected keys such as position_std"),
        ("rate: 1\nfixes: {velocity_std: 0.1}", "unknown key 'velocity_std', expected position_std"),
        ("rate: 1\nfixes: {delay: 9}", "delay of the measurement is 9.0 s, expected at most 2 s"),
        ("rate: -1", "rate of the fixes is -1.0 Hz"),
    ):
        file.write_text(text)
        with pytest.raises(EnvironmentSetupError, match=f"usbl.yaml: {sentence}"):
            finssim.make("t1", observe=str(file))
    with pytest.raises(EnvironmentSetupError, match="nowhere.yaml"):
        finssim.make("t1", observe="nowhere.yaml")


def test_what_cannot_be_sensed_is_refused():
    with pytest.raises(EnvironmentSetupError, match=r"finsrov has no IMU.*give sensors\.imu"):
        made(vehicle=carrying(imu=None), worlds=1)
    with pytest.raises(
        ValueError, match=r"velocity_std of the fixes is given.*under sensors in the vehicle file"
    ):
        Sensing(fixes=MeasurementNoise(velocity_std=0.1))
    with pytest.raises(ValueError, match="rate of the fixes is -1.0 Hz"):
        Sensing(rate=-1.0)
    ranges = Randomization(Ranges.model_validate({"name": "test", "sensors": {"rate_std": [0.0, 0.1]}}))
    with pytest.raises(EnvironmentSetupError, match=r"sensors\.rate_.*out of the ranges"):
        made(worlds=1, randomization=ranges)
    with pytest.raises(
        EnvironmentSetupError, match="observe is 'eyes', expected truth, estimator, sensors, training"
    ):
        finssim.make("t1", observe="eyes")
