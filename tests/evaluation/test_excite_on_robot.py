"""Programmes on a robot that keeps its position between trials: driven to each start, stopped and resumed."""

import json

import numpy as np
import pytest
import yaml
from rich.console import Console

from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.evaluation.excitation import PlanSettings, excite_on_robot
from finssim.evaluation.robot_trials import NEAR, TURNED, OnRobot, RobotError
from finssim.robot.record_reader import open_record
from finssim.trials.trial_files import load_trials
from finssim.vehicles import load_vehicle
from reference.pools import Person, lockstep_pool

pytestmark = pytest.mark.slow

FINSROV = load_vehicle("finsrov")
QUIET = Console(quiet=True)


@pytest.fixture
def robot(tmp_path):
    """A vehicle 0.7 m from its start, on a port, and the settings for trials on it."""

    def opened(wiring, **how):
        return OnRobot(wiring=wiring, pool_file=tmp_path / "pool.yaml", arm=True, **how)

    return opened


def excite(out, robot, axes="roll", level=1.0):
    plan = PlanSettings(levels=[str(level)])
    return excite_on_robot(axes, vehicle="finsrov", out=out, robot=robot, plan=plan, console=QUIET)


def test_trials_are_made_one_after_the_other_and_an_interrupted_session_goes_on(tmp_path, robot):
    """The PID drives the vehicle to each start; q ends after the first; the same command plays only the second."""
    out, file = tmp_path / "trials", tmp_path / "pool.yaml"
    with (
        lockstep_pool(FINSROV, file, position=(0.6, 0.3, -0.4), yaw=0.6) as wiring,
        pytest.raises(KeyboardInterrupt),
    ):
        person = Person(("enter:", "\r"), ("enter:", "q"))
        excite(out, robot(wiring, attendant=person))
    assert [p.stem for p in (out / "records").glob("*.mcap")] == ["roll_plus_1"]
    assert any("on the way to its start" in line for line in person.read)
    before = (out / "records" / "roll_plus_1.mcap").stat().st_mtime_ns
    with lockstep_pool(FINSROV, file, position=(-0.5, 0.0, -0.5)) as wiring:
        made = excite(out, robot(wiring, unattended=True))
    assert made == [out / f"roll_{word}_1" for word in ("plus", "minus")]
    assert (out / "records" / "roll_plus_1.mcap").stat().st_mtime_ns == before
    for trial in load_trials([out]):
        x, y, z, qz = (trial.channels[name] for name in ("x", "y", "z", "qz"))
        first = np.array([a[np.isfinite(a)][0] for a in (x, y, z)])
        assert np.abs(first - (0.0, 0.0, -0.515)).max() < NEAR + 0.05
        assert abs(2.0 * np.arcsin(qz[np.isfinite(qz)][0])) < TURNED
        assert tuple(trial.header.axis) == ("roll",) and trial.phase[0] == "baseline"
        assert (trial.phase == "excitation").sum() > 5
    with open_record(out / "records" / "roll_minus_1.mcap") as record:  # the drive to the start is not in it
        starts = [e.message.data for e in record.messages(("events",)) if "trial_start" in e.message.data]
    assert len(starts) == 1 and "roll_minus_1" in starts[0]
    assert yaml.safe_load((out / "programmes.yaml").read_text())["robot"] is True


def test_a_robot_trial_is_taken_by_the_calibration_as_it_is(tmp_path, robot):
    """Surge steps in both directions give the damping of the plant, 39.1 N s/m, within 5 %."""
    out, file = tmp_path / "trials", tmp_path / "pool.yaml"
    with lockstep_pool(FINSROV, file) as wiring:
        excite(out, robot(wiring, unattended=True), "surge", level=12.0)
    words = f"calibrate hydrodynamics {out} --axes surge --damping linear --vehicle finsrov".split()
    assert boundary.run(app, [*map(str, words), "--out", str(tmp_path / "new.yaml")]) == 0
    found = load_vehicle(tmp_path / "new.yaml").hydrodynamics["calibrated"].linear_damping
    assert found[0, 0] == pytest.approx(39.07, rel=0.05)


def test_a_robot_that_no_camera_sees_is_excited_by_its_position_fixes(tmp_path):
    """In open water, with Doppler log and compass, rates are the IMU's, and the record contains no pool file."""
    heavy, out = load_vehicle("bluerov2_heavy"), tmp_path / "trials"
    how = {"site": "open-water", "positioning": "motion-capture", "position": (0.0, 0.0, -0.75)}
    with lockstep_pool(heavy, None, **how) as wiring:
        robot = OnRobot(wiring=wiring, pool_file=None, site="open-water", arm=True, unattended=True)
        assert robot.options.endswith("--pool-file none --site open-water --lockstep")
        plan = PlanSettings(levels=["15"], coast=5.0)
        made = excite_on_robot(
            "heave", vehicle="bluerov2_heavy", out=out, robot=robot, plan=plan, console=QUIET
        )
    for trial in load_trials(made):
        assert np.isfinite(trial.channels["p"]).any() and np.nanmax(np.abs(trial.channels["w"])) > 0.1
    with open_record(out / "records" / f"{made[0].name}.mcap") as record:
        assert record.metadata["site"] == "open-water" and "pool_sha256" not in record.metadata
        assert record.metadata["vehicle_sha256"] == heavy.sha256


def test_the_operator_stops_a_trial_which_is_put_away_and_played_again_or_skipped(tmp_path, robot):
    """x turns the thrusters off during the trial, whose record is kept separately; s skips the other."""
    out, file = tmp_path / "trials", tmp_path / "pool.yaml"
    with lockstep_pool(FINSROV, file) as wiring:
        person = Person(("enter:", "\r"), ("3 s of", "x"), ("enter:", "\r"), ("5 s of", ""), ("enter:", "s"))
        made = excite(out, robot(wiring, attendant=person))
    assert made == [out / "roll_plus_1"]
    assert [p.name for p in (out / "records" / "aborted").iterdir()] == ["roll_plus_1_1.mcap"]
    with open_record(out / "records" / "aborted" / "roll_plus_1_1.mcap") as record:
        events = [json.loads(e.message.data) for e in record.messages(("events",))]
    assert [e["text"] for e in events if e["kind"] == "fault"] == ["stopped by the operator"]


def test_by_hand_nothing_is_armed_before_the_vehicle_is_at_its_start(tmp_path, robot):
    """0.6 m away, Enter does nothing: only s continues."""
    out, file = tmp_path / "trials", tmp_path / "pool.yaml"
    with lockstep_pool(FINSROV, file, position=(0.6, 0.0, -0.5)) as wiring:
        person = Person(*[("bring it to its start", key) for key in ("\r", "s")] * 2)
        assert excite(out, robot(wiring, by_hand=True, attendant=person)) == []
    assert not list((out / "records").glob("*.mcap")) and not (out / "records" / "aborted").exists()
    assert not any("enter:" in line for line in person.read)


def test_what_cannot_be_is_refused_before_anything_is_opened(tmp_path, robot):
    """Refused: not armed, by hand without an operator, another plan's folder, no workspace, a start outside it."""
    from finssim.identification.vehicle_file import write_vehicle
    from finssim.robot.wiring import Wiring
    from finssim.trials.findings import CalibrationError

    where = OnRobot(wiring=Wiring(robot="127.0.0.1:1", lockstep=True), pool_file=tmp_path / "pool.yaml")
    with pytest.raises(RobotError, match="give --arm"):
        excite(tmp_path / "a", where)
    with pytest.raises(RobotError, match="--by-hand waits for enter"):
        excite(tmp_path / "b", robot(where.wiring, by_hand=True, unattended=True))
    with pytest.raises(RobotError, match="holds other files"):
        excite(tmp_path / "a", where, level=0.5)
    from finssim.evaluation.excitation import box_of

    small = FINSROV.replace(
        {"safety.workspace_lower": [-0.5, -1.0, -1.0], "safety.workspace_upper": [0.5, 1.0, 0.0]}
    )
    write_vehicle(small, tmp_path / "small.yaml")
    with pytest.raises(CalibrationError, match="m of room along surge"):
        box = box_of(small)
        from finssim.evaluation.excitation import start_of
        from finssim.identification.programme import programmes

        start_of(programmes("surge", small)[0], small, box)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--robot", "pool", "--pool-file", "pool.yaml", "--pool", "1"], "excludes --simulate, --pool"),
        (["--robot", "pool"], "give --pool-file"),
        (["--arm"], "need a robot: give --robot"),
    ],
)
def test_options_that_do_not_go_together(tmp_path, words, sentence, capsys):
    """Each combination is refused in one sentence."""
    command = ["excite", "roll", "--vehicle", "finsrov", "--out", str(tmp_path / "t"), *words]
    assert boundary.run(app, command) == 2
    assert sentence in capsys.readouterr().err
