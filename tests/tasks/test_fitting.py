"""Tasks adapted to a vehicle that is longer than the paper's."""

import io

import numpy as np
import pytest
from rich.console import Console

from finssim import make
from finssim.control.axis_model import axis_model
from finssim.control.modes import mode_from_dict
from finssim.control.policy import Policy
from finssim.evaluation.metrics import T1_SETPOINTS, in_room
from finssim.learning.train import TrainingSettings, train
from finssim.sim import RectangularPool
from finssim.tasks import TASKS, EnvironmentSetupError, numeric_tasks
from finssim.tasks.fitting import authority
from finssim.tasks.validation import vehicles_of_task
from finssim.vehicles import catalogue, load_vehicle
from finssim.vehicles.defaults import room

NUMERIC = numeric_tasks()

QUIET = Console(file=io.StringIO())

SIZE = 2.6 / 0.6
"""RexROV's length divided by that of the published pool's vehicles."""


@pytest.mark.parametrize("name", ["t1", "t2"])
def test_lengths_of_t1_and_t2_grow_with_the_vehicle_and_their_tolerance_stays(name):
    """FinsROV has the paper's pool; RexROV's starts fill a pool 4.3 times as large, under water."""
    small, large = make(name, worlds=200), make(name, worlds=200, vehicle="rexrov")
    assert small.simulator.surroundings[1] == RectangularPool()
    assert large.simulator.surroundings[1].depth == pytest.approx(SIZE)
    assert large.task.tolerance == small.task.tolerance
    starts = [e.simulator.state.position.numpy()[:, 0] for e in (small, large)]
    np.testing.assert_allclose(starts[1], SIZE * starts[0], rtol=1e-4, atol=1e-5)
    again = large.task.fitted([load_vehicle("rexrov")])
    assert again == large.task  # fitting what is fitted changes nothing


def test_setpoints_grow_with_the_pool():
    """Positions grow, headings do not."""
    goal = in_room(T1_SETPOINTS["P02"], load_vehicle("rexrov"))
    np.testing.assert_allclose(goal[:3], SIZE * T1_SETPOINTS["P02"][:3])
    assert goal[3] == T1_SETPOINTS["P02"][3]
    assert np.array_equal(in_room(T1_SETPOINTS["P02"], load_vehicle("finsrov")), T1_SETPOINTS["P02"])


@pytest.mark.parametrize("task", [name for name in sorted(NUMERIC) if TASKS[name].needs])
@pytest.mark.parametrize("name", catalogue())
def test_a_vehicle_has_the_axes_of_its_task_or_is_refused_by_name(task, name):
    """Missing axes are named before a world is made; a vehicle that has all is accepted.

    Tasks by course name no axes: their autopilot refuses vehicles that it cannot steer (test_every_task.py).
    """
    vehicle, needs = load_vehicle(name), TASKS[task].needs
    missing = [axis for axis in needs if axis not in vehicle.controlled_axes]
    assert set(needs) >= {"surge", "sway", "heave"}
    if missing:
        said = f"vehicle '{name}' does not control {', '.join(missing)}, which task '{task}' needs"
        with pytest.raises(EnvironmentSetupError, match=said):
            vehicles_of_task(name, TASKS[task](), TASKS[task].action)
    else:
        assert vehicles_of_task(name, TASKS[task](), TASKS[task].action)[0].name == name
    unable = {"eca_a9", "lauv", "remus100", "slocum", "torpedo"}
    if "pitch" in needs:  # an axis that six thrusters do not control
        unable |= {"bluerov2", "bluerov2_centralenantes", "bluerov2_einarsson"}
    assert bool(missing) == (name in unable)


def test_an_agent_may_use_all_of_finsrov_and_a_part_of_a_stronger_vehicle():
    """Wrench over inertia with added mass is at most 1 m/s² and 20 rad/s², times RexROV's size."""
    assert np.array_equal(authority(load_vehicle("finsrov")), np.ones(6))
    for name in ("bluerov2_heavy", "rexrov"):
        vehicle = load_vehicle(name)
        scale, size = authority(vehicle), room(vehicle.body.size)
        pull = scale * vehicle.wrench_limits / axis_model(vehicle).inertia
        assert np.all(pull <= np.array([size] * 3 + [20.0] * 3) * (1.0 + 1e-12))
        assert np.all((scale == 1.0) | (pull >= 0.999 * np.array([size] * 3 + [20.0] * 3)))


def test_a_policy_says_what_its_actions_stand_for(tmp_path):
    """The policy's description contains the share of the limits, and the action mode made from it uses this
    share."""
    path = train(
        "t1",
        TrainingSettings(vehicle="bluerov2_heavy", worlds=16, steps=512),
        out=tmp_path / "p",
        console=QUIET,
    )
    vehicle = load_vehicle("bluerov2_heavy")
    mode = mode_from_dict(Policy.load(path, vehicle=vehicle).description.action, vehicle)
    np.testing.assert_allclose(mode.scale, authority(vehicle))
    np.testing.assert_allclose(mode.ends[1], authority(vehicle) * vehicle.wrench_limits)


def test_an_underactuated_vehicle_trains_nothing(tmp_path):
    """There is no policy and no folder."""
    with pytest.raises(EnvironmentSetupError, match="does not control sway, heave, yaw"):
        train("t1", TrainingSettings(vehicle="remus100", steps=512), out=tmp_path / "p", console=QUIET)
    assert not any(tmp_path.iterdir())
