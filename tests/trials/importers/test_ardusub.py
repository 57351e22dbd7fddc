"""ArduSub logs become trials: real DataFlash and telemetry logs, their axes, clocks and outputs, and cut
files."""

import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from finssim.core.frames import FROM_FOSSEN
from finssim.core.rotations import quat_from_euler, quat_inverse_rotate
from finssim.trials.findings import CalibrationError
from finssim.trials.importers import import_trials
from finssim.trials.importers.ardusub import ArduPilotLog, velocity_stream
from finssim.trials.importers.ardusub_outputs import outputs_of
from finssim.trials.importers.dispatch import read_trials
from finssim.trials.trial_files import load_trial
from finssim.vehicles import load_vehicle
from finssim.vehicles.autopilot import FRAMES

pytest.importorskip("pymavlink")

LOGS = Path(__file__).parents[2] / "data" / "ardusub"
BIN, TLOG = LOGS / "small.BIN", LOGS / "small_cut.tlog"


@pytest.fixture(scope="module")
def dataflash():
    return read_trials([BIN], vehicle="bluerov2")[0]


@pytest.fixture(scope="module")
def telemetry():
    return read_trials([TLOG], vehicle="bluerov2_heavy")[0]


@pytest.mark.parametrize("which", ["dataflash", "telemetry"])
def test_gravity_agrees_with_the_attitude(which, request):
    """At rest the specific force is upward gravity rotated by the attitude, so both are in FinsSim's axes."""
    trial = request.getfixturevalue(which)
    angles = [np.median(trial.series(c)[1]) for c in ("roll", "pitch", "yaw")]
    felt = [np.median(trial.series(c)[1]) for c in ("ax", "ay", "az")]
    expected = quat_inverse_rotate(quat_from_euler(*angles), [0.0, 0.0, 9.81])
    # Accelerometers of autopilots are off by a few hundredths of g.
    np.testing.assert_allclose(felt, expected, atol=0.3)
    assert felt[2] > 9.5


@pytest.mark.parametrize("which", ["dataflash", "telemetry"])
def test_rates_are_those_of_the_attitude(which, request):
    """Except for the gyroscope's bias, the mean rate over the log is the change of angle divided by time."""
    trial = request.getfixturevalue(which)
    for angle, rate in (("roll", "p"), ("pitch", "q"), ("yaw", "r")):
        t, values = trial.series(angle)
        mean = np.ptp(np.unwrap(values)[[0, -1]]) / (t[-1] - t[0])
        assert abs(np.median(trial.series(rate)[1])) < mean + 0.02


def test_pitching_back_and_forth_has_the_sign_of_its_rate(telemetry):
    """At small roll d(pitch)/dt has the sign of q: angle and rate were converted alike."""
    t, pitch = telemetry.series("pitch")
    q = np.interp(t, *telemetry.series("q"))
    moving = np.abs(q) > 0.03
    assert moving.sum() > 10
    assert np.corrcoef(np.gradient(pitch, t)[moving], q[moving])[0, 1] > 0.8


def test_depth_is_of_the_sensor_in_the_water(dataflash, telemetry):
    """Both vehicles float at the surface: depths are millimetres, while the sensor in the hull would give 9
    m."""
    for trial in (dataflash, telemetry):
        assert np.abs(trial.series("depth")[1]).max() < 0.05


def test_rates_and_battery(dataflash):
    """The IMU has 25 Hz, the rest 10 Hz, each at its own times; the battery has 4 cells."""
    assert len(dataflash.series("az")[0]) == 594 and len(dataflash.series("yaw")[0]) == 237
    assert 16.0 < np.median(dataflash.series("voltage")[1]) < 17.5


def test_an_estimate_without_a_position_sensor_is_no_velocity(dataflash):
    """The filter assumed that the vehicle was stationary; the trial says why it has no u v w."""
    assert not dataflash.has("u")
    assert "velocity_left_out" in {one.code for one in dataflash.findings}


def test_an_estimate_with_one_is(telemetry):
    """This vehicle had an acoustic position."""
    assert telemetry.has("u", "v", "w", "x", "y", "z")
    assert 0.05 < np.abs(telemetry.series("u")[1]).max() < 1.0


def test_the_stick_up_pushes_up_through_all_vertical_thrusters(telemetry):
    """In the pilot's one ascent, four vertical pulses of different directions combine to one upward push."""
    vertical = [telemetry.series(f"pwm_T{n}")[1] for n in (5, 6, 7, 8)]
    np.testing.assert_array_equal(vertical[0], vertical[3])
    np.testing.assert_array_equal(vertical[1], vertical[2])
    i = int(np.argmax(np.abs(vertical[0] - 1500.0)))
    assert all(pulses[i] == 1300.0 for pulses in vertical)


def test_arming_splits_the_log():
    """The log is armed for 16 s of the minute, by heartbeats once a second."""
    (trial,) = read_trials([TLOG], vehicle="bluerov2_heavy", split="arming")
    assert 15.0 < trial.duration < 17.0
    (trial,) = read_trials([BIN], vehicle="bluerov2", split="arming")
    assert trial.duration == pytest.approx(274.434 - 265.679, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "file, vehicle, part", [(BIN, "bluerov2", 0.95), (BIN, "bluerov2", 0.7), (TLOG, "bluerov2_heavy", 0.9)]
)
def test_a_log_cut_short_opens_up_to_the_cut(tmp_path, file, vehicle, part):
    """A flat battery cuts a message; everything before it is as in the whole log."""
    data = file.read_bytes()
    (tmp_path / file.name).write_bytes(data[: int(part * len(data))])
    (cut,) = read_trials([tmp_path / file.name], vehicle=vehicle)
    (whole,) = read_trials([file], vehicle=vehicle)
    n = len(cut.series("yaw")[0])
    assert 10 < n < len(whole.series("yaw")[0])
    np.testing.assert_array_equal(cut.series("yaw")[1], whole.series("yaw")[1][:n])


def test_the_folder_reads_back(tmp_path, dataflash):
    """`trials import` writes what was read."""
    (folder,) = import_trials([BIN], out=tmp_path, vehicle="bluerov2")
    assert load_trial(folder).sha256 == dataflash.sha256


@pytest.mark.parametrize("frame, name", [(1, "bluerov2"), (2, "bluerov2_heavy")])
def test_outputs_push_as_the_autopilot_means_them(frame, name):
    """A pulse above neutral on each output in turn gives, in FinsSim's axes, the wrench signs of the frame's
    table."""
    vehicle = load_vehicle(name)
    directions = [1.0, -1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0]
    parameters = {"FRAME_CONFIG": float(frame)} | {
        f"MOT_{i + 1}_DIRECTION": d for i, d in enumerate(directions)
    }
    outputs, _ = outputs_of(vehicle, parameters, {})
    B = dict(zip(vehicle.thrusters, vehicle.control_matrix.T, strict=True))
    for motor, (roll, pitch, yaw, up, forward, right) in enumerate(FRAMES[frame][1]):
        thruster, sign = outputs[motor + 1]
        # FinsSim's and Fossen's axes differ by half a turn.
        wrench = FROM_FOSSEN.twist(sign * directions[motor] * B[thruster])
        meant = np.array([forward, right, -up, roll, pitch, yaw])
        used = meant != 0.0
        np.testing.assert_array_equal(np.sign(wrench[used]), np.sign(meant[used]))


def test_pulses_of_a_thruster_wired_the_other_way_are_left_to_the_vehicle_file():
    """With motor_sign -1 the vehicle file itself makes short pulses push forward: the thrust must be the
    same."""
    vehicle = load_vehicle("bluerov2")
    turned = vehicle.replace({"thrusters.T1.motor_sign": -1, "autopilot.directions": [-1]})
    given = {f"C{i + 1}": name for i, name in enumerate(vehicle.thrusters)}
    for one in (vehicle, turned):
        outputs, _ = outputs_of(one, {}, given)
        name, sign = outputs[1]
        assert one.thrusters[name].shaft_speed(1500.0 + sign * 200.0) > 0.0


def test_kinds_of_messages_that_are_not_read_are_named_with_their_numbers(dataflash, telemetry):
    """The counts agree with pymavlink's own iteration over both logs."""
    from pymavlink import mavutil

    for path, trial in ((BIN, dataflash), (TLOG, telemetry)):
        log, counts = mavutil.mavlink_connection(str(path)), Counter()
        while (message := log.recv_msg()) is not None:
            counts[message.get_type()] += 1
        unread = str(trial.findings[-1])
        assert trial.findings[-1].code == "not_read"
        kind, number = max(
            ((k, n) for k, n in counts.items() if f" {k} (" in unread), key=lambda item: item[1]
        )
        assert f"{kind} ({number})" in unread and "ATT" not in unread.replace("ATTITUDE_TARGET", "").split()


def test_an_explicit_map_of_outputs_comes_first(tmp_path):
    """Two outputs are exchanged and one is reversed."""
    text = "vehicle: bluerov2\nardusub: {outputs: {C1: T2, C2: T1, C3: -T3, C4: T4, C5: T5, C6: T6}}\n"
    (tmp_path / "map.yaml").write_text(text)
    (trial,) = read_trials([BIN], column_map=tmp_path / "map.yaml")
    (usual,) = read_trials([BIN], vehicle="bluerov2")
    np.testing.assert_array_equal(trial.channels["pwm_T2"], 3000.0 - usual.channels["pwm_T1"])
    np.testing.assert_array_equal(trial.channels["pwm_T3"], 3000.0 - usual.channels["pwm_T3"])
    (tmp_path / "map.yaml").write_text(text.replace("C1: T2", "C1: T9"))
    with pytest.raises(CalibrationError, match=r"ardusub.outputs.C1: bluerov2 has no thruster 'T9'"):
        read_trials([BIN], column_map=tmp_path / "map.yaml")


def test_a_frame_of_other_thrusters_is_refused():
    """Eight motors cannot drive six thrusters."""
    with pytest.raises(CalibrationError, match="VECTORED_6DOF of the log has 8 motors"):
        read_trials([TLOG], vehicle="bluerov2")


def test_a_passive_trial_needs_no_outputs(tmp_path):
    """When towed or hanging, outputs that fit no thruster of the vehicle do not matter."""
    (tmp_path / "map.yaml").write_text("vehicle: bluerov2\npassive: true\n")
    (trial,) = read_trials([TLOG], column_map=tmp_path / "map.yaml")
    assert trial.has("p", "depth") and not any(c.startswith("pwm") for c in trial.channels)


def test_position_deltas_become_body_velocity():
    """A DVL that reports 5 cm forward, 2 cm right and 1 cm down in 0.1 s gives u = 0.5, v = -0.2, w = -0.1
    m/s."""
    deltas = [{"dt": 0.1, "PosDX": 0.05, "PosDY": 0.02, "PosDZ": 0.01}] * 5
    log = ArduPilotLog("x.BIN", False, {"VISO": np.arange(5) * 0.1}, {"VISO": deltas})
    stream = velocity_stream(log, "auto")
    for column, expected in (("u", 0.5), ("v", -0.2), ("w", -0.1)):
        np.testing.assert_allclose(stream.channels[column], expected)


def test_what_is_no_log_is_refused(tmp_path):
    """A picture with the wrong suffix and an empty file are refused."""
    for content in (b"\x89PNG" + bytes(2000), b""):
        (tmp_path / "x.tlog").write_bytes(content)
        with pytest.raises(CalibrationError, match=r"x\.tlog"):
            read_trials([tmp_path / "x.tlog"])


def test_a_log_under_another_name_opens_when_told(tmp_path):
    """The content distinguishes DataFlash from telemetry."""
    shutil.copy(BIN, tmp_path / "00000042.log")
    (trial,) = read_trials([tmp_path / "00000042.log"], format="ardupilot", vehicle="bluerov2")
    assert trial.has("roll", "p", "az", "depth")
