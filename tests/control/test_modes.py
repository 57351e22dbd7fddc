"""An action is a fraction of a limit, is refused if invalid, and its definition is plain data."""

import json
from dataclasses import dataclass

import numpy as np
import pytest
import warp as wp

from finssim.control import ControlError
from finssim.control.course import FARTHEST, STEEPEST, WIDEST, course_speeds
from finssim.control.modes import (
    MODES,
    ModeData,
    ModeKind,
    action_mode,
    mode_data,
    mode_from_dict,
    thrusts_of,
)
from finssim.physics.types import vec8
from finssim.vehicles import catalogue, load_vehicle
from reference.tails import tailed


@dataclass(frozen=True)
class Craft:
    """The parts of a vehicle that an action mode reads."""

    control_matrix: np.ndarray
    force_limits: tuple[np.ndarray, np.ndarray]
    wrench_limits: np.ndarray
    wrench_reference: tuple[float, float, float] = (0.0, 0.0, -0.08)
    name: str = "craft"

    @property
    def thruster_names(self):
        return tuple(f"T{i}" for i in range(self.control_matrix.shape[1]))

    @property
    def channel_names(self):
        return self.thruster_names

    @property
    def channel_limits(self):
        return self.force_limits


@pytest.fixture
def craft(layout):
    return Craft(layout.B, (layout.lower, layout.upper), layout.wrench_limits)


OWN = [name for name in MODES if not MODES[name].pilot and not MODES[name].course]
"""Modes of every vehicle; ArduSub's is tested in test_ardusub.py, the course autopilot in sim/test_course.py."""


@pytest.mark.parametrize("name", OWN)
def test_zero_action_is_zero_thrust(craft, name):
    mode = action_mode(name, craft)
    np.testing.assert_array_equal(
        mode.to_thrusters(np.zeros(mode.size)), np.zeros(craft.control_matrix.shape[1])
    )


def test_thruster_actions_reach_each_limit(craft):
    lower, upper = craft.force_limits
    mode = action_mode("thruster8", craft)
    np.testing.assert_array_equal(mode.to_thrusters(np.ones(mode.size)), np.float32(upper))
    np.testing.assert_array_equal(mode.to_thrusters(-np.ones(mode.size)), np.float32(lower))
    np.testing.assert_allclose(mode.to_thrusters(np.full(mode.size, -0.5)), 0.5 * lower, rtol=1e-6)


def test_actions_beyond_one_saturate(craft):
    for name in OWN:
        mode = action_mode(name, craft)
        np.testing.assert_array_equal(
            mode.to_thrusters(np.full(mode.size, 3.0)), mode.to_thrusters(np.ones(mode.size))
        )


def test_wrench_actions_produce_their_part_of_each_axis_limit(finsrov):
    craft = Craft(finsrov.B, (finsrov.lower, finsrov.upper), finsrov.wrench_limits)
    mode = action_mode("wrench6", craft, scale=(0.1, 0.2, 0.3, 0.4, 0.5, 0.6))
    for axis in range(6):
        wrench = finsrov.B @ mode.to_thrusters(np.eye(6)[axis]) / finsrov.wrench_limits
        np.testing.assert_allclose(wrench, np.eye(6)[axis] * mode.scale[axis], atol=3e-4)  # lambda


def test_wrench4_asks_for_no_roll_or_pitch(craft):
    mode = action_mode("wrench4", craft)
    assert mode.labels == ("surge", "sway", "heave", "yaw")
    np.testing.assert_array_equal(
        np.array([0.1, 0.2, 0.3, 0.4]) @ mode.columns,
        np.array([0.1, 0.2, 0.3, 0, 0, 0.4]) * craft.wrench_limits,
    )


@wp.kernel(enable_backward=False)
def thrusts_of_worlds(action: wp.array2d(dtype=vec8), data: ModeData, force: wp.array2d(dtype=vec8)):
    w, v = wp.tid()
    force[w, v] = thrusts_of(action[w, v], v, data)


@pytest.mark.parametrize("name", OWN)
def test_a_batch_of_vehicles_and_the_robot_give_the_same_bits(name):
    """Results are bit-identical in a batch of all vehicles with as many thrusters, each with its own scale."""
    vehicles = [one for one in map(load_vehicle, catalogue()) if len(one.thruster_names) == 8]
    assert len(vehicles) > 3
    scales = [1.0 / (1 + v) for v in range(len(vehicles))]
    action = np.random.default_rng(2).uniform(-1.2, 1.2, (300, len(vehicles), 8)).astype(np.float32)
    force = wp.zeros(action.shape[:2], dtype=vec8, device="cpu")
    inputs = [wp.array(action, dtype=vec8, device="cpu"), mode_data(name, vehicles, scales), force]
    wp.launch(thrusts_of_worlds, dim=action.shape[:2], inputs=inputs, device="cpu")
    for v, vehicle in enumerate(vehicles):
        mode = action_mode(name, vehicle, scales[v])
        np.testing.assert_array_equal(mode.to_thrusters(action[:, v, : mode.size]), force.numpy()[:, v])
        np.testing.assert_array_equal(mode.to_thrusters(action[7, v, : mode.size]), force.numpy()[7, v])


def test_another_mode_is_one_entry(craft, monkeypatch):
    """Two components each drive half of the thrusters, the second one backwards; values beyond the limits are
    clipped."""
    n = len(craft.thruster_names)
    half = np.stack([np.arange(n) < n // 2, -1.0 * (np.arange(n) >= n // 2)])
    monkeypatch.setitem(
        MODES, "sides", ModeKind(False, lambda vehicle: ("left", "right"), lambda vehicle: 2.0 * half)
    )
    mode = action_mode("sides", craft)
    lower, upper = craft.force_limits
    expected = np.where(half[0] > 0.0, 0.5 * upper, lower)
    np.testing.assert_allclose(mode.to_thrusters([0.25, 1.0]), expected, rtol=1e-6)
    assert mode_from_dict(mode.describe(), craft) == mode


def test_batches_equal_single_actions(craft):
    for name in OWN:
        mode = action_mode(name, craft)
        actions = np.random.default_rng(0).uniform(-1, 1, (3, 4, mode.size))
        np.testing.assert_array_equal(mode.to_thrusters(actions)[2, 1], mode.to_thrusters(actions[2, 1]))


@pytest.mark.parametrize("name", OWN)
def test_definition_survives_a_file(craft, name):
    mode = action_mode(name, craft, scale=0.5)
    assert mode_from_dict(json.loads(json.dumps(mode.describe())), craft) == mode


@pytest.mark.parametrize("name", OWN)
def test_another_vehicles_limits_are_refused(finsrov, name):
    craft = Craft(finsrov.B, (finsrov.lower, finsrov.upper), finsrov.wrench_limits)
    weaker = Craft(finsrov.B, (finsrov.lower, 0.9 * finsrov.upper), 0.9 * finsrov.wrench_limits)
    with pytest.raises(ControlError, match="trained with"):
        mode_from_dict(action_mode(name, craft).describe(), weaker)


@pytest.mark.parametrize("name", OWN)
def test_wrong_length_and_nan_are_refused(craft, name):
    mode = action_mode(name, craft)
    with pytest.raises(ControlError, match="expected"):
        mode.to_thrusters(np.zeros(mode.size + 1))
    with pytest.raises(ControlError, match="NaN"):
        mode.to_thrusters(np.full(mode.size, np.nan))


def test_unknown_modes_and_impossible_scales_are_refused(craft):
    with pytest.raises(ControlError, match="available: thruster8, wrench6, wrench4"):
        action_mode("wrench7", craft)
    for scale in (1.5, -0.1, [1.0, 1.0, 1.0], float("nan")):
        with pytest.raises(ControlError, match="scale"):
            action_mode("wrench6", craft, scale)


def test_surfaces_are_all_channels_in_their_own_units():
    """The channels are a propeller in newtons and four fins in radians, as fractions of their limits in each
    direction."""
    vehicle = tailed("x")
    mode = action_mode("surfaces", vehicle)
    assert mode.labels == ("propeller", "fin_0", "fin_1", "fin_2", "fin_3")
    got = mode.to_thrusters([0.5, 1.0, -1.0, 0.2, 0.0])
    full = vehicle.force_limits[1][0]
    assert got == pytest.approx([0.5 * full, 0.35, -0.35, 0.07, 0.0], rel=1e-6)
    assert action_mode("thruster8", vehicle).to_thrusters([1.0]) == pytest.approx([full])


def test_modes_by_course_state_what_their_numbers_mean_and_need_the_state():
    vehicle = tailed("cruciform")
    deep, pitched = (action_mode(name, vehicle) for name in ("course", "course_pitch"))
    assert (deep.labels, pitched.labels) == (("speed", "course", "depth"), ("speed", "course", "pitch"))
    speeds = course_speeds(vehicle)
    assert deep.definition["lower"] == pytest.approx([speeds[0], -WIDEST, -FARTHEST])
    assert pitched.definition["upper"] == pytest.approx([speeds[-1], WIDEST, STEEPEST])
    assert mode_from_dict(json.loads(json.dumps(deep.describe())), vehicle).definition == deep.definition
    with pytest.raises(
        ControlError, match="course is carried out by an autopilot that needs the vehicle's state"
    ):
        deep.to_thrusters([0.0, 0.0, 0.0])
