"""The published protocol on a robot: from the published start, one trial after the other, labelled as hardware."""

import json

import numpy as np
import pytest

from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.control.guidance import Station
from finssim.evaluation.records import read_record
from finssim.evaluation.robot_trials import OnRobot, RobotError, RobotTrial, session
from finssim.pool import read_truth
from finssim.robot.pilots import make_pilot
from finssim.robot.record_reader import open_record
from finssim.studies.transfer import T1, T2, TransferSettings, transfer_experiment
from finssim.vehicles import load_vehicle
from reference.pools import Person, lockstep_pool

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("brief_t1")]

FINSROV = load_vehicle("finsrov")
SETPOINTS = ("P02", "P03")


def experiment(spec, out, wiring, targets, person=None):
    robot = OnRobot(
        wiring=wiring,
        pool_file=out.parent / "pool.yaml",
        arm=True,
        unattended=person is None,
        attendant=person,
    )
    settings = TransferSettings(rows=("pid",), seeds=1)
    return transfer_experiment(spec, out=out, robot=robot, targets=targets, settings=settings)


@pytest.fixture(scope="module")
def held(brief_t1, tmp_path_factory):
    """Two setpoints of T1, ended by the operator after the first and resumed: folder, result, truth."""
    folder = tmp_path_factory.mktemp("t1")
    out, truth = folder / "out", folder / "truth"
    with lockstep_pool(
        FINSROV, folder / "pool.yaml", position=(0.3, -0.1, -0.4), yaw=0.5, truth=truth
    ) as wiring:
        person = Person(("enter:", "\r"), ("enter:", "q"))
        with pytest.raises(KeyboardInterrupt):
            experiment(T1, out, wiring, SETPOINTS, person)
    first = {path: path.stat().st_mtime_ns for path in (out / "trials").glob("*.json")}
    with lockstep_pool(FINSROV, folder / "pool.yaml", position=(-0.3, 0.1, -0.4)) as wiring:
        result = experiment(T1, out, wiring, SETPOINTS)
    return out, result, truth, first


def test_rows_are_scored_as_virtual_ones_and_marked(held):
    """Both setpoints are held; the first is not played again; table, JSON and figure say hardware."""
    out, result, _, first = held
    row = result["rows"]["pid"]
    assert (row["success"], row["trials"], row["stopped"]) == (2, 2, 0) and row["e_p_m"]["value"] < 0.05
    assert len(first) == 1 and all(path.stat().st_mtime_ns == time for path, time in first.items())
    assert result["robot"].startswith("127.0.0.1:") and result["severity"] == "hardware"
    page = (out / "t1.html").read_text()
    assert "T1 on hardware, robot 127.0.0.1:" in page and "PID, tuned from the model, hardware" in page
    assert "paper" not in page.split("hardware")[0] and "whose error is not in it" in page
    assert (out / "t1_envelopes.png").stat().st_size > 10_000


def test_a_record_of_the_experiment_is_measured_again_by_evaluate_and_by_a_truth(held, capsys):
    """The record gives the same figures, and the true motion on the same clock similar ones."""
    out, result, truth, _ = held
    (trial,) = (t for t in result["trials"] if t["job"]["target"] == "P02")
    record = out / "trials" / trial["record"]
    assert boundary.run(app, ["evaluate", str(record), "--json"]) == 0
    (again,) = json.loads(capsys.readouterr().out)["per_trial"]
    assert {key: again[key] for key in ("setpoint", "e_p_m", "t_s_s")} == {
        "setpoint": "P02", "e_p_m": trial["e_p_m"], "t_s_s": trial["t_s_s"],
    }  # fmt: skip
    true = read_record(record, "t1", FINSROV, truth=truth)
    assert abs(true.offset) < 0.06
    measured = true.measures("t1", FINSROV)
    assert measured["success"] and abs(measured["e_p_m"] - trial["e_p_m"]) < 0.02


def test_when_all_is_played_the_robot_is_not_opened(held):
    """With all trials played, the robot is not opened: none answers at that address."""
    from finssim.robot.wiring import Wiring

    out, result, _, _ = held
    again = experiment(T1, out, Wiring(robot="127.0.0.1:1", lockstep=True), SETPOINTS)
    assert again["rows"] == result["rows"]


def test_a_trajectory_is_followed_from_its_first_pose(brief_straight, tmp_path):
    """The tuned PID follows the whole straight path of T2 with an error of centimetres."""
    with lockstep_pool(FINSROV, tmp_path / "pool.yaml") as wiring:
        result = experiment(T2, tmp_path / "out", wiring, ("straight",))
    row = result["rows"]["pid"]
    assert row["success"] == 1 and row["horizontal_rmse_m"]["value"] < 0.03
    assert "T2 on hardware" in (tmp_path / "out" / "t2.html").read_text()


def test_dead_reckoning_is_carried_from_trial_to_trial(tmp_path):
    """Initialised once in open water, the vehicle begins the second trial a metre away by the estimate of the first.

    Its true position is within 0.15 m: the compass errs by 1°, the log by 1 %, the initial position by 5 cm.
    """
    heavy = load_vehicle("bluerov2_heavy")
    places = (0.4, -0.3, -0.6), (1.2, 0.1, -0.8)
    truth = tmp_path / "truth"
    with lockstep_pool(heavy, None, position=places[0], site="open-water", truth=truth) as wiring:
        robot = OnRobot(
            wiring=wiring, pool_file=None, site="open-water", arm=True, unattended=True, let_in=places[0][:2]
        )
        with session(robot, heavy) as opened:
            for k, place in enumerate(places):
                here = Station(place, 0.0)
                outcome = opened.trial(
                    lambda here=here: RobotTrial(
                        name="hold", pilot=make_pilot("pid", heavy), guide=here, duration=2.0,
                        over=lambda runtime: runtime.t >= 2.0,
                    ),
                    here, tmp_path / f"{k}.mcap", counts=True,
                )  # fmt: skip
                reading = outcome.runtime.reading
    true = read_truth(truth)
    position = [np.interp(reading.time, true.time, column) for column in true.position.T]
    assert reading.ready and np.linalg.norm(reading.position - places[1]) < 0.4
    assert np.linalg.norm(reading.position - position) < 0.15


def test_a_trial_that_the_bridge_stops_counts_and_ends_an_unattended_session(tmp_path):
    """When the link breaks after 12 s, there is a fault and a result without success, and nothing is armed
    afterwards."""
    with (
        lockstep_pool(FINSROV, tmp_path / "pool.yaml", silent_from=12.0) as wiring,
        pytest.raises(RobotError, match=r"pid, P02: stopped \(the trial counts\): no fresh telemetry"),
    ):
        experiment(T1, tmp_path / "out", wiring, SETPOINTS)
    (played,) = (tmp_path / "out" / "trials").glob("*.json")
    result = json.loads(played.read_text())
    assert not result["success"] and result["e_p_m"] is None
    with open_record(played.with_suffix(".mcap")) as record:
        events = [json.loads(e.message.data) for e in record.messages(("events",))]
    assert [e["kind"] for e in events].count("armed") == 1 and events[-1]["kind"] == "fault"


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--robot", "pool", "--pool-file", "p.yaml", "--plants", "2"], "omit --plants"),
        (["--robot", "pool", "--arm"], "give --pool-file"),
        (
            ["--robot", "pool", "--arm", "--pool-file", "p.yaml", "--let-in", "0,0"],
            "--let-in is for dead reckoning",
        ),
        (["--robot", "pool", "--arm", "--pool-file", "none", "--let-in", "here"], "expected two numbers x,y"),
        (["--let-in", "0,0"], "need a robot: give --robot"),
        (["--unattended"], "need a robot: give --robot"),
    ],
)
def test_options_that_do_not_go_together(tmp_path, words, sentence, capsys):
    """Each combination is refused in one sentence."""
    assert boundary.run(app, ["experiment", "t1", "--out", str(tmp_path / "o"), *words]) == 2
    assert sentence in " ".join(capsys.readouterr().err.split())
