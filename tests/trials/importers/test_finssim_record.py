"""A FinsSim record becomes trials without a map: each channel at its own times, phases, arming, the vehicle."""

import json

import numpy as np
import pytest

pytest.importorskip("mcap")
pytest.importorskip("rosbags")

from finssim.core.rotations import quat_from_euler
from finssim.robot.messages import Telemetry
from finssim.robot.reading import Reading
from finssim.robot.recorder import Recorder
from finssim.trials.findings import CalibrationError
from finssim.trials.importers import import_trials
from finssim.trials.importers.dispatch import read_trials
from finssim.trials.inputs import drive
from finssim.vehicles import load_vehicle
from reference.finned import torpedo

VEHICLE = load_vehicle("finsrov")
RAD_PER_S = 2.0 * np.pi / 60.0


def true_rpm(t):
    """Return shaft speeds by thruster, signed by positive thrust [rpm], (8,)."""
    return 500.0 * np.sin(t + np.arange(8.0))


def telemetry(i, t, *, rpm=True):
    """Return telemetry of the motor controller: IMU turned by half a turn about z, outputs in their own
    order."""
    thrusters = list(VEHICLE.thrusters.values())
    motor = np.zeros(VEHICLE.mcu.outputs)
    for value, thruster in zip(true_rpm(t), thrusters, strict=True):
        motor[thruster.motor_index] = thruster.motor_sign * value
    gyro, accel = (-np.sin(t), -0.5 * np.sin(t), 0.3), (-0.1 * t, -0.2, 9.81)
    q = (0.0, 0.0, 1.0, 0.0)
    return Telemetry(i, 10 * i, q, gyro, accel, 0.3 + 0.1 * t, 2e5, 0, tuple(motor) if rpm else None)


def reading(t):
    nu = np.array([0.1 * t, 0.2, -0.1, 9.0, 9.0, 9.0])
    return Reading(t, np.array([0.05 * t**2, 0.1, -0.5]), quat_from_euler(0.0, 0.1, 0.2 * t), nu, True)


def record(path, *, rpm=True, meta=None, states=True, vehicle=VEHICLE):
    """Record four seconds of a run, armed from 1 s to 3 s; telemetry arrives 5 ms late."""
    with Recorder(path, vehicle, meta, epoch=1.7e9) as recorder:
        for i in range(400):
            t = 0.01 * i
            if i in (100, 300):
                recorder.event(t, "armed" if i == 100 else "fault", "by the test")
            if i in (120, 200):
                recorder.event(t, "phase", "excitation" if i == 120 else "coast")
            recorder.telemetry(t + 0.005, telemetry(i, t, rpm=rpm), time=t)
            if i % 2 == 0:
                recorder.reading(t, reading(t))
            if i % 10 == 0:
                recorder.command(t, np.full(8, 99.0), "pid", np.full(6, 99.0))
                recorder.goal(t, (7.0, 7.0, 7.0), 0.0)
                if states:
                    recorder.thrusters(t, "armed", force=np.arange(8.0) * t)


def sampled(trial, name):
    """Return times and values of a channel where it has samples."""
    known = np.isfinite(trial.channels[name])
    return trial.t[known], trial.channels[name][known]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("record") / "run.mcap"
    record(path, meta={"trial": {"axis": ["surge"], "role": "held-out"}})
    return path


def test_channels_come_back_at_their_times(run):
    """Pose, velocity, rates, force, depth and shaft speeds equal the recorded ones, in body axes and thruster
    order."""
    (trial,) = read_trials([run])
    t, rates = sampled(trial, "p")
    assert t == pytest.approx(0.01 * np.arange(400), abs=1e-6), "stamps are those of the measurement"
    assert rates == pytest.approx(np.sin(t), abs=1e-9)
    assert sampled(trial, "ax")[1] == pytest.approx(0.1 * t, abs=1e-9)
    assert sampled(trial, "depth")[1] == pytest.approx(0.3 + 0.1 * t, abs=1e-9)
    for i, name in enumerate(VEHICLE.thruster_names):
        times, rpm = sampled(trial, f"rpm_{name}")
        assert rpm == pytest.approx(500.0 * np.sin(times + i), abs=1e-6)
    t, u = sampled(trial, "u")
    assert t == pytest.approx(0.02 * np.arange(200), abs=1e-6)
    assert u == pytest.approx(0.1 * t, abs=1e-9)
    assert sampled(trial, "x")[1] == pytest.approx(0.05 * t**2, abs=1e-9)
    assert sampled(trial, "qy")[1][0] == pytest.approx(np.sin(0.05))
    times, force = sampled(trial, "command_H_RF")
    assert force == pytest.approx(7.0 * times, abs=1e-9), "of the bridge, not of the pilot"


def test_the_trial_is_of_the_recorded_vehicle_and_driven_by_its_shafts(run):
    """Without map or option the header is the record's, and measured shaft speeds drive the replay."""
    (trial,) = read_trials([run])
    assert (trial.header.vehicle, trial.header.axis, trial.header.role) == ("finsrov", ("surge",), "held-out")
    driven = drive(trial, VEHICLE)
    assert driven.source == "rpm" and not driven.commanded and driven.names == VEHICLE.thruster_names
    at = np.searchsorted(driven.t, 1.0 - 1e-9)
    expected = [
        th.thrust(w * RAD_PER_S) for th, w in zip(VEHICLE.thrusters.values(), true_rpm(1.0), strict=True)
    ]
    assert driven.force[at] == pytest.approx(expected, abs=1e-6)


def test_goals_and_wanted_wrenches_are_not_taken_for_motion(run):
    (trial,) = read_trials([run])
    assert not any(name.startswith("tau") for name in trial.channels)
    assert np.nanmax(trial.channels["y"]) == pytest.approx(0.1)


def test_a_firmware_without_shaft_speeds_leaves_what_the_bridge_asked_for(tmp_path):
    record(tmp_path / "run.mcap", rpm=False)
    (trial,) = read_trials([tmp_path / "run.mcap"])
    driven = drive(trial, VEHICLE)
    assert driven.source == "command" and driven.commanded


def test_a_record_without_bridge_states_leaves_what_the_pilot_asked_for(tmp_path):
    record(tmp_path / "run.mcap", rpm=False, states=False)
    (trial,) = read_trials([tmp_path / "run.mcap"])
    assert np.nanmax(trial.channels["command_V_LF"]) == 99.0


def test_events_split_a_record(run):
    """Splits are the armed segment alone, and announced phases."""
    (armed,) = read_trials([run], split="arming")
    assert armed.t[-1] == pytest.approx(2.0, abs=0.011)
    (excited,) = read_trials([run], split="phase")
    assert set(excited.phase) == {"excitation", "coast"}
    assert (excited.phase == "coast").sum() > 100


def test_a_cut_record_is_imported_up_to_the_cut(run, tmp_path):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(run.read_bytes()[: int(0.7 * run.stat().st_size)])
    (trial,) = read_trials([cut])
    assert trial.header.vehicle == "finsrov" and 0.5 < trial.t[-1] < 3.99
    assert any("cut off" in str(one) for one in trial.findings)


def test_a_vehicle_that_is_not_in_the_catalogue_is_noted(tmp_path):
    """The trial then has no vehicle; a different state of a known vehicle's file is noted, too."""
    own = VEHICLE.model_copy(update={"name": "mine"})
    record(tmp_path / "mine.mcap", vehicle=own)
    (trial,) = read_trials([tmp_path / "mine.mcap"])
    assert trial.header.vehicle is None and "vehicle_unknown" in {one.code for one in trial.findings}
    (trial,) = read_trials([tmp_path / "mine.mcap"], vehicle="finsrov")
    assert trial.header.vehicle == "finsrov" and "vehicle_unknown" not in {one.code for one in trial.findings}
    heavy = VEHICLE.replace({"body.mass": 13.0})
    record(tmp_path / "heavy.mcap", vehicle=heavy)
    (trial,) = read_trials([tmp_path / "heavy.mcap"])
    assert "vehicle_changed" in {one.code for one in trial.findings}


def test_broken_words_for_the_header_are_refused(tmp_path):
    record(tmp_path / "run.mcap", meta={"trial": json.dumps([1])})
    with pytest.raises(CalibrationError, match="'trial' is '\\[1\\]', expected a mapping"):
        read_trials([tmp_path / "run.mcap"])


def test_trial_folders_are_written(run, tmp_path):
    (folder,) = import_trials([run], out=tmp_path / "trials", split="arming")
    assert (folder / "trial.yaml").is_file()


@pytest.mark.parametrize("meta", [{}, {"trial": {"vehicle": "../mine"}}], ids=["vehicle", "trial"])
def test_a_vehicle_that_a_record_names_is_no_path(tmp_path, meta):
    """Neither its own name nor the one for `trial.yaml` may be a path; nothing is written."""
    vehicle = VEHICLE if meta else VEHICLE.model_copy(update={"name": "../mine"})
    record(tmp_path / "run.mcap", meta=meta, vehicle=vehicle)
    with pytest.raises(CalibrationError, match=r"run.mcap: vehicle '../mine' has a separator of folders"):
        import_trials([tmp_path / "run.mcap"], out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_vehicle_that_a_record_names_is_of_the_catalogue(tmp_path, monkeypatch):
    """A local file of that name is not read: a note asks for --vehicle."""
    (tmp_path / "mine.yaml").write_text("nothing: 1", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    record(tmp_path / "run.mcap", meta={"trial": {"vehicle": "mine.yaml"}})
    (trial,) = read_trials([tmp_path / "run.mcap"])
    assert trial.header.vehicle is None
    assert any(one.values == {"vehicle": "mine.yaml"} for one in trial.findings)


def test_values_of_fins_are_channels(tmp_path):
    """Channels are the measured values of joints by actuator; requested values are not."""
    ours = torpedo()
    with Recorder(tmp_path / "run.mcap", ours) as recorder:
        for i in range(200):
            t = 0.01 * i
            values = (0.1 * np.sin(t), -0.2, 3e-4, 0.01)
            q, accel = (0.0, 0.0, 0.0, 1.0), (0.0, -0.1 * t, 9.81)
            snapshot = Telemetry(i, 10 * i, q, (0.1 * t, 0.0, 0.0), accel, 1.0, 2e5, 0, (600.0,), values)
            recorder.telemetry(t, snapshot, time=t)
            recorder.reading(t, reading(t))
            recorder.command(t, [5.0, 0.3, 0.3, 0.0, 0.0], "pilot")
    (trial,) = read_trials([tmp_path / "run.mcap"])
    assert [n for n in trial.channels if n.startswith("actuator_")] == [
        f"actuator_{n}" for n in ours.actuators
    ]
    t, rudder = sampled(trial, "actuator_rudder")
    np.testing.assert_allclose(rudder, 0.1 * np.sin(t), atol=2e-3)
    np.testing.assert_allclose(sampled(trial, "actuator_engine")[1], 3e-4)
