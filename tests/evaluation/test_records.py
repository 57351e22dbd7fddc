"""Selection of record segments for learning, and refusals, with records made decision by decision."""

import json

import numpy as np
import pytest

from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.control.allocation import Allocator
from finssim.control.modes import action_mode
from finssim.evaluation.records import (
    DriveError,
    actions_of,
    collect_records,
    episodes_of,
    indices_of,
    read_drive,
)
from finssim.learning.demonstrations import about, load
from finssim.tasks.observer import Observer
from finssim.vehicles import load_vehicle

pytest.importorskip("mcap")
pytest.importorskip("rosbags")
from finssim.robot.reading import Reading
from finssim.robot.recorder import Recorder

FINSROV = load_vehicle("finsrov")
STEP = 1.0 / 60.0
WRENCH6 = action_mode("wrench6", FINSROV)
ALLOCATOR = Allocator.from_vehicle(FINSROV)


def surge(newtons):
    """Return the thrusts of a pure surge."""
    return ALLOCATOR.allocate([newtons, 0.0, 0.0, 0.0, 0.0, 0.0])


def written(path, seconds=2.0, *, meta=None, period=1, vehicle=FINSROV, events=(), **at):
    """Write a record in which the vehicle moves along x at 0.1 m/s.

    `at` contains functions of time: state, ready, goal (position and yaw), force; `period` is in steps of the loop.
    """
    state, ready = at.get("state", lambda t: "armed"), at.get("ready", lambda t: True)
    goal, force = at.get("goal", lambda t: ((1.0, 0.0, -0.5), 0.3)), at.get("force", lambda t: surge(5.0))
    events = list(events)
    with Recorder(path, vehicle, {"command": "finssim teleop"} if meta is None else meta) as recorder:
        for k in range(round(seconds / STEP)):
            t = k * STEP
            if k % period == 0:
                recorder.goal(t, *goal(t))
                recorder.command(t, force(t), "mode-switch", vehicle.control_matrix @ force(t))
                recorder.policy(t, "mode-switch", period=period * STEP, force=force(t))
            nu = np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
            recorder.reading(
                t, Reading(t, np.array([0.1 * t, 0.0, -0.5]), np.array([0.0, 0.0, 0.0, 1.0]), nu, ready(t))
            )
            recorder.thrusters(t, state(t))
            while events and events[0][0] <= t:
                recorder.event(t, *events.pop(0)[1:])
    return path


def spans(path, split_goals=True):
    """Return first and last time of each segment, and its number of decisions."""
    drive = read_drive(path, FINSROV)
    return [
        (round(float(drive.time[i[0]]), 3), round(float(drive.time[i[-1]]), 3), len(i))
        for i in indices_of(drive, 0.1, split_goals=split_goals)
    ]


def test_a_drive_is_sampled_at_the_tasks_period(tmp_path):
    """Sixty decisions a second become ten, including the first; observation and action agree with hand calculations."""
    path = written(tmp_path / "a.mcap", force=lambda t: surge(5.0 + t))
    assert spans(path) == [(0.0, 1.9, 20)]
    (episode,) = episodes_of(read_drive(path, FINSROV), Observer("t1", FINSROV), WRENCH6, FINSROV)
    t = 0.1 * np.arange(20)
    assert episode.observation.shape == (20, 16) and episode.action.shape == (19, 6)
    np.testing.assert_allclose(episode.observation[:, 0], (1.0 - 0.1 * t) / 3.0, atol=1e-6)
    np.testing.assert_allclose(episode.observation[:, 3:5], [[np.cos(0.3), np.sin(0.3)]] * 20, atol=1e-6)
    np.testing.assert_allclose(episode.observation[:, 9], 0.1, atol=1e-6)
    np.testing.assert_allclose(episode.action[:, 0], (5.0 + t[:-1]) / FINSROV.wrench_limits[0], atol=2e-4)
    assert np.abs(episode.action[:, 1:]).max() < 1e-3 and not episode.terminated


def test_only_what_the_operator_did_with_an_armed_and_located_vehicle_counts(tmp_path):
    """Disarming, a missing estimate and a change to the controller each end a segment."""
    armed = written(tmp_path / "a.mcap", state=lambda t: "hold" if 0.95 < t < 1.2 else "armed")
    assert spans(armed) == [(0.0, 0.9, 10), (1.2, 1.9, 8)]
    located = written(tmp_path / "b.mcap", ready=lambda t: t > 0.52)
    assert spans(located) == [(0.533, 1.933, 15)]
    modes = ((0.5, "mode", "other"), (1.5, "mode", "person"))
    assert spans(written(tmp_path / "c.mcap", events=modes)) == [(0.0, 0.5, 6), (1.517, 1.917, 5)]


def test_a_blink_between_two_decisions_ends_a_stretch(tmp_path):
    """One step of the loop in hold, without a decision, ends a segment."""
    path = written(
        tmp_path / "a.mcap", period=6, state=lambda t: "hold" if abs(t - 0.95) < 0.5 * STEP else "armed"
    )
    assert spans(path) == [(0.0, 0.9, 10), (1.0, 1.9, 10)]


def test_another_goal_begins_another_episode_of_a_station_task(tmp_path):
    path = written(tmp_path / "a.mcap", goal=lambda t: ((0.5 if t < 0.99 else -0.5, 0.0, -0.5), 0.0))
    assert spans(path) == [(0.0, 0.9, 10), (1.0, 1.9, 10)]
    assert spans(path, split_goals=False) == [(0.0, 1.9, 20)]
    episodes = episodes_of(read_drive(path, FINSROV), Observer("t1", FINSROV), WRENCH6, FINSROV)
    assert [e.observation[0, 0] > 0.0 for e in episodes] == [True, False]


def test_a_drive_to_no_goal_needs_one(tmp_path):
    """The goal is a given position, or the end of each segment, where the last offset is zero."""
    path = written(tmp_path / "a.mcap", 0.5, goal=lambda t: ((0.0, 0.0, 0.0), 0.0))
    with pytest.raises(DriveError, match="was driven by hand without a goal: give --goal"):
        collect_records([path], "t1", out=tmp_path / "set")
    collect_records([path], "t1", out=tmp_path / "end", goal="end")
    assert np.allclose(load(tmp_path / "end").following[-1, :3], 0.0, atol=1e-6)
    collect_records([path], "t1", out=tmp_path / "there", goal="2,0,-0.5,0")
    assert load(tmp_path / "there").observation[0, 0] == pytest.approx(2.0 / 3.0)


def test_every_mode_says_what_was_commanded(tmp_path):
    """Random thrusts, converted to actions and back, give the same wrench; a mode that cannot do so is refused."""
    rng = np.random.default_rng(3)
    heavy = load_vehicle("bluerov2_heavy")
    for name in ("thruster8", "wrench6", "wrench4", "pilot6"):
        vehicle = heavy if name == "pilot6" else FINSROV
        mode = action_mode(name, vehicle)
        force = mode.to_thrusters(rng.uniform(-0.3, 0.3, (50, mode.size)))
        again = mode.to_thrusters(actions_of(force, mode, vehicle))
        np.testing.assert_allclose(
            (again - force) @ vehicle.control_matrix.T, 0.0, atol=0.05 if mode.pilot else 2e-3
        )
    rolled = WRENCH6.to_thrusters(np.tile([0.0, 0.0, 0.0, 0.5, 0.0, 0.0], (10, 1)))
    with pytest.raises(DriveError, match=r"wrench4 cannot express the commands in 100 % .* \(roll"):
        actions_of(rolled, action_mode("wrench4", FINSROV), FINSROV)


def test_records_that_do_not_fit_are_refused(tmp_path):
    """Refused: another vehicle, a driver slower than the task, no usable segment, no estimate, another task."""
    other = written(
        tmp_path / "other.mcap", 0.3, vehicle=load_vehicle("bluerov2_heavy"), force=lambda t: np.zeros(8)
    )
    slow = written(tmp_path / "slow.mcap", 0.5, period=12)
    never = written(tmp_path / "never.mcap", 0.3, state=lambda t: "disarmed")
    with Recorder(tmp_path / "blind.mcap", FINSROV, {}) as recorder:
        recorder.command(0.0, np.zeros(8), "teleop", np.zeros(6))
    for path, task, sentence in (
        (other, "t1", "is of the vehicle .*, expected finsrov .* --vehicle"),
        (slow, "t1", "decided every 0.2 s, expected at most 0.1 s, the period of t1"),
        (never, "t1", "the robot was never armed"),
        (tmp_path / "blind.mcap", "t1", "contains no estimate of the vehicle's position"),
        (slow, "t9", "unknown task 't9'; available: t1, t2"),
    ):
        with pytest.raises(ValueError, match=sentence):
            collect_records([path], task, out=tmp_path / "set")
    assert not (tmp_path / "set").exists()


def test_a_record_that_was_cut_is_taken_up_to_the_cut(tmp_path):
    """Half of the file gives fewer steps, with the same values."""
    path = written(tmp_path / "a.mcap", 2.5)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    (whole, half) = ((load_steps(p, tmp_path / p.stem)) for p in (path, cut))
    assert 0 < len(half) < len(whole) and np.array_equal(half, whole[: len(half)])


def load_steps(path, out):
    collect_records([path], "t1", out=out)
    return load(out).observation


def test_the_command_takes_several_records(tmp_path, capsys):
    """The command reports the yield of each record; options of an expert are refused."""
    paths = [str(written(tmp_path / f"{name}.mcap", 0.6)) for name in ("a", "b")]
    words = ["collect", *paths, "--task", "t1", "--out", str(tmp_path / "set")]
    assert boundary.run(app, [*words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["episodes"] == 2 and [row["driver"] for row in told["records"]] == ["teleop"] * 2
    kept = about(tmp_path / "set")
    assert (
        kept["expert"] == "teleop"
        and kept["action"]["mode"] == "wrench6"
        and len(kept["records"][0]["sha256"]) == 64
    )
    assert boundary.run(app, words) == 0 and "a.mcap: teleop, 1 episodes" in capsys.readouterr().out
    assert boundary.run(app, ["datasets", str(tmp_path)]) == 0
    assert boundary.run(app, [*words, "--episodes", "3"]) == 2
    assert boundary.run(app, ["collect", "pid", "--task", "t1", "--out", str(tmp_path / "x")]) == 2


@pytest.mark.parametrize("name", ["{}/theirs.csv", "theirs.csv", "theirs", "/theirs"])
def test_the_trajectory_that_a_record_names_is_no_file(tmp_path, monkeypatch, name):
    """A trajectory name in a record is never opened as a file; only the user names files, by --goal."""
    (tmp_path / "theirs.csv").write_text("t,x,y,z\n0,0,0,-0.5\n9,1,0,-0.5\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    told = name.format(tmp_path)
    path = written(
        tmp_path / "run.mcap", meta={"command": "finssim run"}, events=[(0.0, "trial_start", told)]
    )
    with pytest.raises(
        DriveError,
        match=f"followed '{told}', expected one of .*: give the name or the file of the trajectory",
    ):
        collect_records([path], "t2", out=tmp_path / "set")
    assert not (tmp_path / "set").exists()
