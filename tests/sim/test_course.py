"""The autopilot by course: its linear model against closed forms, and vehicles with fins in the simulator."""

import math

import numpy as np
import pytest

from finssim.control import ControlError
from finssim.control.course import STEEPEST, CoursePilot, course_speeds, tuned
from finssim.control.guidance import Known
from finssim.core.rotations import quat_from_euler
from finssim.sim import SeaState, SimulatorError, Water, Wave
from finssim.sim.free_motion import linear_model
from finssim.vehicles import load_vehicle
from reference.steered import PERIOD, sailed
from reference.tails import TAILS, tailed

CRUCIFORM = tailed("cruciform")
EVERY_TAIL = pytest.mark.parametrize("tail", TAILS)


@pytest.fixture(scope="module")
def models():
    return {tail: linear_model(tailed(tail)) for tail in TAILS}


def test_the_columns_of_fins_and_the_trim_in_closed_form(models):
    """Lift ½ ρ A C_L U² per radian at its lever, and a thrust c ω² that in the inflow is the drag of hull and fins."""
    model, U = models["cruciform"], course_speeds(CRUCIFORM)
    wrench = model.inertia @ model.B[:, :6]
    pressure = 0.5 * 1030.0 * 0.00665 * U**2
    lift = 3.12 * pressure
    names = list(CRUCIFORM.channel_names)
    rudder, plane = names.index("fin_1"), names.index("fin_0")  # their spans are z and y
    for column, axis, moment in ((rudder, 1, 5), (plane, 2, 4)):
        assert np.abs(wrench[:, axis, column]) == pytest.approx(lift, rel=0.01)
        assert np.abs(wrench[:, moment, column]) == pytest.approx(0.48 * 1.33 * lift, rel=0.01)
    assert (wrench[:, 5, rudder] < 0.0).all(), (
        "a positive deflection of a stern rudder turns the bow to starboard"
    )
    drag, propeller = 6.109 * U**2 + 4 * 0.01 * pressure, CRUCIFORM.thrusters["propeller"]
    loss = propeller.inflow.thrust_loss * (1.0 - propeller.inflow.wake_fraction) * U
    omega = (loss + np.sqrt(loss**2 + 4.0 * propeller.c_plus * drag)) / (2.0 * propeller.c_plus)
    assert model.trim[:, 0] == pytest.approx(propeller.c_plus * omega**2, rel=1e-3)
    assert model.lag.tolist() == [1.0, 0.1, 0.1, 0.1, 0.1]


@EVERY_TAIL
def test_the_closed_loop_is_stable_between_the_speeds_too(models, tail):
    """Eigenvalues of the linear model half way between two speeds, with the mean of their gains and of allocation."""
    model = models[tail]
    found = tuned(model, tail)
    n = len(model.speeds)
    for rows in (0, n):
        for i in range(n - 1):
            gains = 0.5 * (found.gains[rows + i] + found.gains[rows + i + 1])
            columns = 0.5 * (found.columns[i] + found.columns[i + 1])
            B = 0.5 * (model.B[i] + model.B[i + 1]) @ np.linalg.pinv(columns)
            A = np.zeros((17, 17))
            A[:8, :8] = 0.5 * (model.A[i] + model.A[i + 1])
            A[8, 5], A[9, 2], A[9, 7] = 1.0, 1.0, -0.5 * (model.speeds[i] + model.speeds[i + 1])
            A[[10, 11, 12], [0, 8, 7 if rows else 9]] = 1.0
            A[:8, 13:] = B
            A[13:] = -gains / found.lag[:, None]
            A[13:, 13:] -= np.diag(1.0 / found.lag)
            free = (
                np.delete(np.delete(A, 9, 0), 9, 1) if rows else A
            )  # where the pitch is held, the depth is free
            assert np.linalg.eigvals(free).real.max() < -0.02


@pytest.mark.slow
@EVERY_TAIL
def test_steps_of_course_and_depth(tail):
    """Reached, hardly overshot, with channels within their limits: 90° and 10 m, a fin's travel long."""
    vehicle = tailed(tail)
    orders = {
        "speed": 1.6,
        "course": np.array([0.0, 0.5 * math.pi, -0.3]),
        "depth": np.array([20.0, 10.0, 9.0]),
    }
    found = sailed(vehicle, orders, 90.0)
    lower, upper = vehicle.channel_limits
    assert (found.channels >= lower - 1e-5).all() and (found.channels <= upper + 1e-5).all()
    assert (np.abs(found.channels[:, :, 1:]).max(axis=(0, 2)) > 0.3)[:2].all(), "fins reach their limits"
    end = found.time > 60.0
    off = found.course - orders["course"]
    deep = -found.position[:, :, 2] - orders["depth"]
    assert np.abs(off[end]).max() < math.radians(0.2) and np.abs(deep[end]).max() < 0.02
    assert found.nu[end, :, 0] == pytest.approx(1.6, abs=0.02)
    assert off[:, 1].max() < math.radians(6.0) and -off[:, 2].min() < math.radians(6.0)
    assert deep[:, 0].max() < 0.4
    assert np.abs(found.euler[..., 1]).max() < STEEPEST + math.radians(5.0)
    assert np.abs(found.euler[..., 0]).max() < math.radians(10.0)


@pytest.mark.slow
def test_a_pitch_is_held():
    orders = {"speed": 1.6, "course": 0.0, "pitch": np.array([0.2, -0.15])}
    found = sailed(CRUCIFORM, orders, 40.0, depth=30.0)
    assert np.abs(found.euler[found.time > 25.0][..., 1] - orders["pitch"]).max() < 0.01


@pytest.mark.slow
def test_course_over_ground_in_a_current():
    """With 0.4 m/s across, the bow points into the current and the course is kept."""
    orders = {"speed": 1.6, "course": np.array([0.0, 1.0]), "depth": 10.0}
    found = sailed(load_vehicle("remus100"), orders, 80.0, water=Water(current=(0.0, 0.4, 0.0), depth=50.0))
    end = found.time > 50.0
    assert np.abs(found.course[end] - orders["course"]).max() < math.radians(0.5)
    assert found.euler[end, 0, 2] == pytest.approx(-math.asin(0.4 / 1.6), abs=0.04)


def test_rows_of_a_batch_are_those_of_one_robot(models):
    pilot = CoursePilot(models["x"], "x", PERIOD)
    rng = np.random.default_rng(1)
    q = quat_from_euler(*rng.uniform(-0.4, 0.4, (3, 6)))
    seen = Known(
        None, rng.normal(size=(6, 3)) - [0, 0, 9], q, rng.normal(size=(6, 6)) * 0.2 + [1.5, 0, 0, 0, 0, 0]
    )
    memory = rng.normal(size=(6, 11)) * 0.1
    orders = {"speed": rng.uniform(1, 2, 6), "course": rng.uniform(-3, 3, 6), "depth": rng.uniform(5, 12, 6)}
    channels, after = pilot.command(memory, seen, **orders)
    assert np.ptp(channels, axis=0).min() > 0.01
    for i in range(6):
        alone = Known(None, seen.position[i], seen.quaternion[i], seen.nu[i])
        one = pilot.command(memory[i : i + 1], alone, **{name: x[i] for name, x in orders.items()})
        np.testing.assert_array_equal(one[0][0], channels[i])
        np.testing.assert_array_equal(one[1][0], after[i])


def test_integrals_rest_while_the_channels_cannot_follow(models):
    """With thrust at its limit the integral of the speed is frozen, that of a small course error is not."""
    pilot = CoursePilot(models["cruciform"], "cruciform", PERIOD)
    at = Known(None, np.array([0, 0, -9.0]), np.array([0, 0, 0, 1.0]), np.array([0.9, 0, 0, 0, 0, 0]))
    after = pilot.command(pilot.reset(), at, speed=2.4, course=0.01, depth=9.0)[1][0]
    assert after[0] == 0.0 and after[1] == pytest.approx(-0.01 * PERIOD, rel=1e-3)
    after = pilot.command(pilot.reset(), at, speed=0.95, course=2.0, depth=2.0)[1][0]
    assert after[0] == pytest.approx(-0.05 * PERIOD, rel=1e-3) and after[1] == after[2] == 0.0


def test_vehicles_that_cannot_be_steered_are_refused():
    rudders = {name: one for name, one in CRUCIFORM.actuators.items() if name in ("fin_1", "fin_3")}
    with pytest.raises(ControlError, match="remus100: its actuators do not control surge, pitch and yaw"):
        tuned(linear_model(CRUCIFORM.replace({"actuators": rudders})), "remus100")
    with pytest.raises(ControlError, match="period is 0"):
        CoursePilot(linear_model(CRUCIFORM), "remus100", 0.0)
    sideways = CRUCIFORM.replace({"thrusters.propeller.axis": [0.0, 1.0, 0.0], "controlled_axes": ["sway"]})
    with pytest.raises(SimulatorError, match="no thruster drives it ahead"):
        linear_model(sideways)


def test_any_vehicle_with_thrusters_for_surge_pitch_and_yaw_has_an_autopilot():
    vehicle = load_vehicle("finsrov")
    gains = tuned(linear_model(vehicle), "finsrov").gains
    assert np.isfinite(gains).all() and (np.abs(gains[:, [0, 2, 3], [0, 7, 8]]) > 0.0).all()


SEAS = {
    "still": (None, 1.0, 0.1),
    "swell": (
        Water(
            current=(0.1, 0.28, 0.0), depth=60.0, waves=(Wave(amplitude=0.2, wavelength=12.0, heading=0.7),)
        ),
        3.0,
        0.3,
    ),
    "sea": (
        Water(
            current=(0.0, 0.3, 0.0), depth=50.0, waves=SeaState(spectrum="jonswap", height=0.25, period=5.0)
        ),
        3.0,
        0.3,
    ),
}
"""Water, and the error of course [degrees] and of depth [m] in it: waves 0.4 m high, and a sea of 0.25 m."""


@pytest.mark.slow
@pytest.mark.parametrize("sea", SEAS)
@pytest.mark.parametrize("name", ["remus100", "lauv", "eca_a9", "torpedo"])
def test_course_and_depth_are_held(name, sea):
    """Every vehicle of the catalogue with fins holds both, a minute after steps of both, at half its speeds."""
    vehicle, (water, turn, deep) = load_vehicle(name), SEAS[sea]
    speed = float(course_speeds(vehicle)[[0, -1]].mean())
    orders = {"course": np.array([0.0, 1.0, -2.0, 0.5]), "depth": np.array([10.0, 12.0, 9.0, 10.0])}
    found = sailed(vehicle, {"speed": speed, **orders}, 90.0, speed=speed, water=water)
    end = found.time > 60.0
    off = (found.course[end] - orders["course"] + math.pi) % (2.0 * math.pi) - math.pi
    assert np.abs(off).max() < math.radians(turn)
    assert np.abs(found.position[end][:, :, 2] + orders["depth"]).max() < deep
