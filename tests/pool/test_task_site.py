"""Every task with the deployed software: stack, wire, motor controller and plant of each vehicle, in
lock-step."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from finssim.agents.catalogue import baselines_of
from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.control import ControlError
from finssim.control.guidance import Station, Track
from finssim.control.trajectories import TRAJECTORIES
from finssim.core.rotations import quat_from_euler
from finssim.pool.fleet import Medium
from finssim.pool.positioning import Exposure
from finssim.pool.task_site import Referee
from finssim.robot.pilots import AgentPilot, make_pilot
from finssim.tasks import TASKS, Environment, task_named
from finssim.tasks.communication import Communication
from finssim.tasks.docking import Docking
from finssim.vehicles import load_vehicle
from reference.policies import linear, written
from reference.programs import study
from studies import stack
from studies.stack import site_of

FINSROV = load_vehicle("finsrov")
EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SHORT = {
    "t1": 14.0,
    "t2": 14.0,
    "t3": 11.0,
    "docking": 19.0,
    "camera-docking": 25.0,
    "net": 32.0,
    "pipeline": 31.0,
}
"""Time limits long enough for the baseline to succeed [s]."""
SMALL = {"path": {"legs": 20}, "waypoints": {"legs": 1}, "terrain": {"line": 15.0}}
"""Settings that shorten these tasks to less than a third."""
SEEDS = {"camera-docking": 4, "pipeline": 2, "gate": 4, "pursuit": 11, "formation": 8}
"""Seeds of episodes in which the baseline succeeds soon; in tasks with vision it does not succeed in all."""


@pytest.mark.slow
# Commands exist in training alone.
@pytest.mark.parametrize("name", [name for name in TASKS if name != "velocity6"])
def test_the_baseline_of_every_task_succeeds_through_the_stack(name):
    """The task itself scores the true state; no vehicle is stopped, and all decide at the task's rate."""
    (who, *_), task = baselines_of(name), task_named(name)
    if task.pictures or task.ranges:
        pytest.importorskip("newton", reason="finssim[perception] is not installed")
    task = replace(task, time_limit=SHORT.get(name, task.time_limit), **SMALL.get(name, {}))
    guide = TRAJECTORIES["lemniscate"] if name == "t2" else None
    vehicle = load_vehicle("eca_a9") if name in ("path", "waypoints", "homing", "terrain") else FINSROV
    site = site_of(task, who, [vehicle] * len(task.vehicles), seed=SEEDS.get(name, 1), guide=guide)
    measured = site.run()
    assert measured["success"] == 1.0
    for runtime in site.runtimes.values():
        assert not runtime.bridge.reason and runtime.counters.missed == 0
        assert runtime.counters.decisions >= measured["length"] - 1


def test_a_task_whose_commands_are_drawn_is_refused():
    """The refusal comes before anything starts and names the source of commands on a robot."""
    with pytest.raises(ControlError, match="the velocity and the heading of a trajectory"):
        site_of("velocity6", "pid", [FINSROV])


@pytest.mark.slow
def test_a_policy_of_ones_own_task_runs_through_the_stack(tmp_path):
    """In Warp (evaluation/test_records_measured.py has one in torch), a linear policy directory holds the
    depth."""
    words = f"{EXAMPLES / 'own_task.py'}:KeepDepth"
    task = task_named(words)
    gain = np.zeros((6, 2), np.float32)
    gain[2] = 5.0, -2.0
    policy = written(linear(gain), tmp_path / "depth", task, 6)
    site = site_of(words, str(policy), [FINSROV], seed=3)
    assert site.run()["success"] == 1.0
    pilot = site.runtimes["vehicle"].pilot
    assert isinstance(pilot, AgentPilot) and pilot.describe()["task"] == "keep-depth"


@pytest.mark.slow
def test_what_a_task_sees_is_what_it_would_see_in_training():
    """Equal seeds give the same dock pose, funnel and picture; the first picture agrees with that of the batch except
    for noise and exposure."""
    pytest.importorskip("newton", reason="finssim[perception] is not installed")
    batch = Environment(task_named("camera-docking"), worlds=1, seed=9)
    site = site_of("camera-docking", "light-servo", [FINSROV], seed=9)
    (world,) = site.worlds.values()
    funnel = world.plant.simulator.funnel
    for there, here in (
        (batch.arrays.goal_position, funnel.position),
        (batch.arrays.goal_quaternion, funnel.quaternion),
    ):
        np.testing.assert_allclose(here.numpy(), there.numpy(), atol=1e-6)
    start = np.concatenate([batch.simulator.numpy(key)[0, 0] for key in ("position", "quaternion")])
    pose = start[:3].astype(float), start[3:].astype(float)
    picture = world.camera.develop(Exposure(0, 0.0, 0.0, pose, pose, "front_camera")).image
    seen = batch.sight.pictures["front_camera"].numpy()[0]
    assert picture.shape == seen.shape
    assert np.corrcoef(picture.ravel(), seen.ravel())[0, 1] > 0.98


@pytest.mark.slow
@pytest.mark.parametrize("beam", ["ray", "ping"])
def test_altimeters_measure_the_seabed_of_training(tmp_path, beam):
    """In the described world rays agree to 3 cm wherever the vehicle is, as the seabed is straight within a metre.

    Beams of a Ping agree to 3 %: 61 rays represent one, and training assumes a plane where they meet the seabed.
    """
    pytest.importorskip("newton", reason="finssim[perception] is not installed")
    device = tmp_path / "narrow.yaml"
    device.write_text(
        "{kind: range, about: one ray, source: this test, minimum_range: 0.1, range: 100.0, rate: 10.0}"
    )
    body = load_vehicle("remus100")
    names = ("altimeter", "altimeter_ahead")
    down = quat_from_euler(0.0, 0.5 * np.pi, 0.0)
    sensors = {
        name: body.perception[name].model_copy(update={"device": str(device), "orientation": q})
        for name, q in zip(names, (down, body.perception[names[1]].orientation), strict=True)
    }
    vehicle = body if beam == "ping" else body.model_copy(update={"perception": sensors})
    batch = Environment(task_named("terrain"), vehicle=vehicle, worlds=1, seed=5, auto_reset=False)
    world = batch.task.site(batch.arrays, 5).sensors(vehicle, names, 5)
    for _ in range(4):
        pose = [batch.simulator.numpy(key)[0, 0].astype(float) for key in ("position", "quaternion")]
        measured = [
            world.develop(Exposure(0, 0.0, 0.0, tuple(pose), tuple(pose), name)).ranges[0] for name in names
        ]
        tolerance = {"rtol": 0.03} if beam == "ping" else {"rtol": 0.0, "atol": 0.03}
        np.testing.assert_allclose(measured, batch.arrays.ranges.numpy()[0], **tolerance)
        for _ in range(40):
            batch.step(np.array([[1.0, 0.2, 0.1]]))


def test_a_vehicle_without_altimeters_follows_no_seabed_as_a_robot():
    body = load_vehicle("remus100")
    blind = body.model_copy(update={"perception": {"altimeter": body.perception["altimeter"]}})
    with pytest.raises(ControlError, match="altimeter sees altimeter_ahead, which remus100 does not have"):
        make_pilot("altimeter", blind, task="terrain")


def test_an_episode_over_a_seabed_that_is_in_no_record_is_not_scored():
    here = Track(np.array([0.0, 0.0, -15.0]), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(6))
    guide = Station((50.0, 0.0, -15.0), 0.0)
    with pytest.raises(ControlError, match="'terrain' needs the places of the seabed, .* in no record"):
        Referee("terrain", [load_vehicle("remus100")], guide=guide, start=here)


@pytest.mark.slow
def test_the_command_keeps_its_episodes_and_goes_on(tmp_path, capsys, monkeypatch):
    """The second call plays only the second episode, and prints both beside the batch."""
    monkeypatch.setattr(stack, "BATCH", 32)
    monkeypatch.setitem(Docking.__init__.__kwdefaults__, "time_limit", 25.0)
    words = ["docking", "--policy", "align-insert", "--out", tmp_path, "--json", "--episodes"]
    assert study("stack", *words, 1) == 0
    capsys.readouterr()
    assert study("stack", *words, 2) == 0
    said = capsys.readouterr()
    told = json.loads(said.out)
    assert "episode 1 of" not in said.err and "episode 2 of 2" in said.err
    assert told["stack"]["trials"] == 2 and told["batch"]["trials"] == 32
    assert told["batch"]["metrics"]["success"]["value"] > 0.9


def test_a_site_without_what_its_task_needs_is_refused(capsys):
    with pytest.raises(ControlError, match="'t2' follows a reference that is known ahead: give a trajectory"):
        site_of("t2", "pid", [FINSROV])
    assert boundary.run(app, ["pool", "--task", "t2"]) == 2
    assert "give a trajectory, in a pool without --task" in capsys.readouterr().err


@pytest.mark.slow
def test_a_lost_vehicle_stops_alone():
    """The right netter falls silent after a second and is stopped; the others continue with its last message."""
    site = site_of("team-pursuit", "formation", [FINSROV] * 4, seed=2)
    lost = site.worlds["right_netter"]
    before = lost.exchange

    def silent(until, sent=()):
        lost.faults.drop = 1.0 if until > 1.0 else 0.0
        return before(until, sent)

    lost.exchange = silent
    site.run(duration=8.0)
    reasons = {name: runtime.bridge.reason for name, runtime in site.runtimes.items()}
    assert "telemetry" in reasons.pop("right_netter") and not any(reasons.values())
    assert site.runtimes["left_netter"].counters.decisions > 70
    assert site.runtimes["right_netter"].counters.decisions < 20


def test_messages_are_late_by_the_way_and_lost_as_often_as_told():
    """The delay is 15 m at 1500 m/s plus 0.1 s; one in four of 4000 datagrams is lost, to 3 standard
    deviations."""
    places = {"a": np.zeros(3), "b": np.array([15.0, 0.0, 0.0])}
    medium = Medium(lambda: places, Communication(loss=0.25), seed=1)
    heard = 0
    for k in range(4000):
        medium.send(float(k), "a", b"x")
        assert not medium.receive(k + 0.109, "b")
        heard += len(medium.receive(k + 0.111, "b"))
        assert not medium.receive(k + 0.2, "a")
    assert abs(heard / 4000 - 0.75) < 3.0 * np.sqrt(0.25 * 0.75 / 4000)
