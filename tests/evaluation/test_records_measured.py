"""Measures from records: equal for the same motion, from the robot's estimate or from a truth, on any clock."""

import json
from pathlib import Path

import numpy as np
import pytest

from finssim.agents.catalogue import baselines_of
from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.control import ControlError
from finssim.control.guidance import Station
from finssim.control.trajectories import load_trajectory
from finssim.core.rotations import quat_from_yaw, quat_yaw
from finssim.evaluation.evaluate import evaluate
from finssim.evaluation.metrics import T1_SETPOINTS, measure_trial
from finssim.evaluation.records import DriveError, read_record
from finssim.pool import draw_plant
from finssim.pool.camera import PoolCamera, camera_of
from finssim.pool.task_site import Referee
from finssim.pool.virtual_pool import VirtualPool, read_truth
from finssim.robot.lockstep import run_lockstep
from finssim.robot.perception import Perception
from finssim.robot.pilots import make_pilot
from finssim.robot.recorder import Recorder
from finssim.robot.runtime import Runtime
from finssim.tasks import task_named
from finssim.vehicles import load_vehicle
from reference.policies import linear, written
from studies.stack import site_of

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("brief_t1")]

FINSROV = load_vehicle("finsrov")
EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
X, Y, Z, YAW = T1_SETPOINTS["P03"]


def driven(folder, guide, seconds, task="t1", start=(0.0, 0.0, -0.5), vehicle=FINSROV):
    """Return a recorded run of the tuned PID on the pool's clock and its truth, of the length in `brief_t1`."""
    true_site, known_site, settings = camera_of(vehicle, 1, "realistic")
    truth, record = folder / "truth", folder / "run.mcap"
    camera = PoolCamera(vehicle, true_site, mode="corners", settings=settings, seed=1)
    pool = VirtualPool(
        vehicle,
        draw_plant(vehicle, 1, "realistic"),
        camera=camera,
        start=(start, quat_from_yaw(0.0)),
        seed=1,
        truth=truth,
    )
    pilot = make_pilot("pid", vehicle, task=task)
    about = {"command": "finssim run", "pilot": pilot.describe()}
    end = 16.5 if isinstance(guide, Station) else guide.duration + 0.5
    with Recorder(record, vehicle, about, pictures="none", epoch=1e9) as recorder:
        runtime = Runtime(vehicle, Perception(vehicle, known_site), pilot, guide, arm=True, recorder=recorder)
        run_lockstep(runtime, pool, seconds, until=lambda r: r.t >= end)
    pool.close()
    return record, truth, runtime.started


@pytest.fixture(scope="module")
def held(brief_t1, tmp_path_factory):
    """A record of P03, started nearby and held for 16 s."""
    guide = Station((X, Y, Z), YAW, name="P03")
    return driven(tmp_path_factory.mktemp("held"), guide, 30.0, start=(X + 0.3, Y + 0.1, Z))


def captured(path, truth, late):
    """Write a motion-capture table on its own clock, at 50 Hz, with a gap."""
    found = read_truth(truth)
    rows = np.arange(0, len(found.time), 2)
    rows = rows[(rows < 400) | (rows > 410)]
    table = np.column_stack([found.time + late, found.position, quat_yaw(found.quaternion)])[rows]
    path.write_text("t,x,y,z,yaw\n" + "\n".join(",".join(map(repr, row)) for row in table.tolist()) + "\n")
    return path


def test_the_truth_gives_the_measures_of_the_true_motion(held):
    """Measures equal those with the known clock; the estimated offset is within a step of the search."""
    record, truth, started = held
    trial = read_record(record, "t1", FINSROV, truth=truth)
    measures, found = trial.scores("t1", FINSROV), read_truth(truth)
    exact = measure_trial(
        found.time - started, found.position, quat_yaw(found.quaternion), T1_SETPOINTS["P03"]
    )
    assert abs(trial.offset) < 0.06 and measures["success"] is exact["success"] is True
    for name in ("e_p_m", "e_y_m", "e_psi_deg"):
        assert measures[name] == pytest.approx(exact[name], rel=0.02)
    assert abs(measures["t_s_s"] - exact["t_s_s"]) <= 0.2
    assert 0.001 < measures["localization"]["position_m"] < 0.05


def test_the_estimate_is_off_by_what_localization_is(held):
    """Measures of estimate and truth differ by no more than the error of the estimate."""
    record, truth, _ = held
    known = read_record(record, "t1", FINSROV).scores("t1", FINSROV)
    true = read_record(record, "t1", FINSROV, truth=truth).scores("t1", FINSROV)
    assert known["success"] and known["localization"] is None and known["fault"] == ""
    assert abs(known["e_p_m"] - true["e_p_m"]) < true["localization"]["position_m"] + 1e-3


def test_a_table_on_another_clock_is_laid_over_the_record(held, tmp_path):
    """For a table 3 minutes behind, with yaw, the offset is found and the measures are the same."""
    record, truth, _ = held
    known = read_record(record, "t1", FINSROV, truth=truth)
    trial = read_record(record, "t1", FINSROV, truth=captured(tmp_path / "m.csv", truth, -180.0))
    assert trial.offset == pytest.approx(known.offset + 180.0, abs=0.021)
    first, second = (x.scores("t1", FINSROV) for x in (known, trial))
    assert second["e_p_m"] == pytest.approx(first["e_p_m"], rel=0.02)


def test_evaluate_takes_a_record_and_prints_what_it_prints_of_a_simulation(held, tmp_path, capsys):
    """`evaluate` prints the setpoint by its published name, the paper's row beneath, one JSON object, and the
    figure."""
    record, truth, _ = held
    words = ["evaluate", str(record), "--task", "t1", "--truth", str(truth)]
    assert boundary.run(app, [*words, "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert "P03" in said and "1/1" in said and "paper" in said
    assert "run.mcap: the robot's estimate was 0.0" in said and "ended early" not in said
    assert (tmp_path / "out" / "error_envelope.png").stat().st_size > 10_000
    assert boundary.run(app, [*words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["controller"]["name"] == "pid" and told["truth"] == "truth" and told["success"] == 1
    assert len(told["records"][0]["sha256"]) == 64


def test_a_run_that_ended_early_is_named_and_has_no_late_errors(tmp_path, capsys):
    """Three seconds contain no success of 10 s; t2 needs a trajectory, and the command says how to give it."""
    record, _, _ = driven(tmp_path, Station((X, Y, Z), YAW), 5.0)
    (trial,) = evaluate([record], task="t1")["per_trial"]
    assert not trial["success"] and trial["e_p_m"] is None and trial["fault"] == "ended early"
    assert boundary.run(app, ["evaluate", str(record)]) == 0
    assert "run.mcap: ended early" in capsys.readouterr().out
    assert boundary.run(app, ["evaluate", str(record), "--task", "t2"]) == 2
    assert "(evaluate --trajectory" in capsys.readouterr().err


def test_a_record_of_a_vehicle_of_ones_own_is_measured_by_the_file_that_it_keeps(
    tmp_path, capsys, monkeypatch
):
    """A record is measured without --vehicle, from another directory, without the file; another vehicle is
    refused."""
    own = tmp_path / "minnow.yaml"
    own.write_text("extends: finsrov\norigin: measured\nsource: test\nbody: {mass: 13.0}\n")
    minnow = load_vehicle(own)
    record, _, _ = driven(tmp_path, Station((X, Y, Z), YAW), 5.0, vehicle=minnow)
    own.unlink()
    monkeypatch.chdir(tmp_path.parent)
    assert boundary.run(app, ["evaluate", str(record), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["vehicle"] == {"name": "minnow", "sha256": minnow.sha256} and told["records"]
    assert boundary.run(app, ["evaluate", str(record), "--vehicle", "finsrov"]) == 2
    assert "give the file of the recorded vehicle with --vehicle" in capsys.readouterr().err


def test_a_trajectory_is_measured_by_the_name_in_the_record(brief_straight, tmp_path, capsys):
    """The path is complete with a PID's errors; a truth of another run, t1 and a multi-agent task are refused."""
    guide = load_trajectory("straight")
    first = tuple(guide.at(0.0).position.tolist())
    record, truth, _ = driven(tmp_path, guide, guide.duration + 5.0, "t2", first)
    assert boundary.run(app, ["evaluate", str(record), "--task", "t2", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["complete"] == 1 and told["horizontal_rmse_m"] < 0.05 and told["energy"] > 0.0
    (trial,) = evaluate([record], task="t2", truth=truth)["per_trial"]
    assert trial["p95_m"] < 0.08 and trial["success"]
    with pytest.raises(DriveError, match="the recorded goal moves"):
        read_record(record, "t1", FINSROV)
    with pytest.raises(DriveError, match="'pursuit' has 2 vehicles but .* contains one"):
        read_record(record, "pursuit", FINSROV)
    with pytest.raises(DriveError, match="the recorded goal moves, but 'docking' expects a fixed goal"):
        read_record(record, "docking", FINSROV)
    short = tmp_path / "short.csv"
    short.write_text("t,x,y,z,yaw\n0,0,0,0,0\n1,0,0,0,0\n")
    with pytest.raises(DriveError, match="less than half of the record"):
        read_record(record, "t2", FINSROV, truth=short)
    short.write_text("time,x,y\n0,0,0\n")
    with pytest.raises(DriveError, match="columns time, x, y, expected t"):
        read_record(record, "t2", FINSROV, truth=short)


@pytest.mark.parametrize("task", ["t3", "own/task/keep_depth"])
def test_a_record_is_scored_as_the_episode_was(task, tmp_path, capsys, monkeypatch):
    """The same referee on the site's truth gives the live score, except for the clock, which is estimated again.

    The truth's clock is found to 10 ms, which is 5 mm at 0.5 m/s; the return is a mean over hundreds of steps.
    """
    if task.startswith("own"):
        task, brief = f"{EXAMPLES / task}.py:KeepDepth", {"hold": 2.0, "time_limit": 10.0}
        gain = np.zeros((6, 2), np.float32)
        gain[2] = 5.0, -2.0
        who = str(written(linear(gain), tmp_path / "depth", task_named(task), 6))
    else:
        who, brief = next(iter(baselines_of(task))), {"time_limit": 15.0}
    for name, value in brief.items():
        monkeypatch.setitem(type(task_named(task)).__init__.__kwdefaults__, name, value)
    live = site_of(task, who, [FINSROV], seed=3, record=tmp_path / "episode").run()
    record, truth = (tmp_path / "episode" / f"vehicle.{kind}" for kind in ("mcap", "truth"))
    capsys.readouterr()  # Warp's banner, if it starts here
    assert boundary.run(app, ["evaluate", str(record), "--task", task, "--truth", str(truth), "--json"]) == 0
    (scored,) = json.loads(capsys.readouterr().out)["per_trial"]
    assert scored["fault"] == "" and scored["success"] == live["success"] == 1.0
    assert scored["length"] == live["length"] and abs(scored["held"] - live["held"]) < 0.35
    assert scored["return"] == pytest.approx(live["return"], rel=0.02)
    assert 0.0005 < scored["localization"]["position_m"] < 0.05
    known = read_record(record, task, FINSROV).scores(task, FINSROV)
    assert known["success"] == 1.0 and known["return"] == pytest.approx(live["return"], rel=0.05)


def test_an_episode_that_was_cut_short_counts_without_success(tmp_path, capsys):
    """For 5 of 40 s of docking, a note beneath the table says so, and no return is printed."""
    site_of("docking", "align-insert", [FINSROV], seed=3, record=tmp_path).run(duration=5.0)
    assert boundary.run(app, ["evaluate", str(tmp_path / "vehicle.mcap"), "--task", "docking"]) == 0
    assert "vehicle.mcap: ended early" in capsys.readouterr().out
    done = evaluate([tmp_path / "vehicle.mcap"], task="docking")
    (trial,) = done["per_trial"]
    assert trial["success"] == 0.0 and trial["return"] is None and done["valid"] == 0


def test_a_memory_that_was_drawn_is_not_in_a_record(held, tmp_path):
    """A torch task that remembers its start is refused by name."""
    text = (EXAMPLES / "own/task/keep_depth.py").read_text().split("if __name__")[0]
    text = text.replace("class KeepDepth(TorchTask):", "class Go(TorchTask):\n    memory = {'last': 3}\n")
    start = "memory={'last': w.uniform(low, high)}, position="
    (tmp_path / "go.py").write_text(text.replace("Start(position=", f"Start({start}"))
    task = f"{tmp_path / 'go.py'}:Go"
    with pytest.raises(ControlError, match="begins with a memory that its reset draws"):
        read_record(held[0], task, FINSROV).scores(task, FINSROV)
    assert Referee(task, [FINSROV], seed=1).metrics()["success"] == 0.0  # a live episode is scored


def test_a_record_moves_the_pipeline_as_a_whole_and_a_drawn_net_is_refused(held):
    """The pipe keeps its bends at the goal's pose; the corners drawn for a net's world are in no record."""
    record = read_record(held[0], "pipeline", FINSROV)
    referee = Referee("pipeline", [FINSROV], guide=record.guide, start=record.motion.at(0.0))
    pipe = referee.arrays.reference.position.numpy()[0]
    drawn = Referee("pipeline", [FINSROV], seed=1).arrays.reference.position.numpy()[0]
    np.testing.assert_array_equal(pipe, drawn)
    with pytest.raises(ControlError, match="needs the places of rope_0, .* drawn with its world"):
        read_record(held[0], "net", FINSROV).scores("net", FINSROV)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["a.mcap", "pid"], "expected one controller"),
        (
            ["a.mcap", "--trials", "3", "--hydrodynamics", "mesh"],
            "--trials, --hydrodynamics: no effect on a record: omit them",
        ),
        (["pid", "--truth", "m.csv"], "--truth is for records"),
    ],
)
def test_what_does_not_go_together_is_refused(words, sentence, capsys):
    """Each combination is refused in one sentence."""
    assert boundary.run(app, ["evaluate", *words]) == 2
    assert sentence in capsys.readouterr().err
