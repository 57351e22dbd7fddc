"""Logs that need no map (Water Linked, QGroundControl, acoustic positions, NumPy, PX4), written as
documented."""

import json
import struct
from itertools import pairwise

import numpy as np
import pytest
import yaml

from finssim.core.importer import importers
from finssim.core.rotations import quat_from_euler, quat_multiply, quat_rotate, wrap_angle
from finssim.trials.findings import CalibrationError
from finssim.trials.importers.dispatch import read_trials
from finssim.trials.importers.log import importer_of
from finssim.vehicles import load_vehicle
from trials.importers.tables import csv

N = 200
T = np.arange(N) * 0.1
PERIOD = np.array([60.0, 110.0, 240.0, 150.0] * (N // 4))
CLOCK = np.cumsum(PERIOD) * 1e-3
U, V, W = 0.2 * np.sin(CLOCK), 0.1 + 0.0 * CLOCK, 0.05 * np.cos(CLOCK)
GOOD = np.arange(N) % 8 != 5


def one(path, **options):
    (trial,) = read_trials([path], **options)
    return trial


def note(trial, code):
    (item,) = [item for item in trial.findings if item.code == code]
    return item


def report(i, version):
    """Return a velocity report of the log's protocol: forward-right-down axes, stale where bottom lock was
    lost."""
    v = (U[i], -V[i], -W[i]) if GOOD[i] else (0.56, -0.02, 0.0)
    out = {"time": PERIOD[i], **dict(zip(("vx", "vy", "vz"), v, strict=True)), "fom": 0.002, "altitude": 1.4}
    out |= {
        "transducers": [{"id": 0, "beam_valid": bool(GOOD[i])}],
        "velocity_valid": bool(GOOD[i]),
        "status": 0,
    }
    out["format"] = f"json_v{version}"
    if version != "1":
        out["type"] = "velocity"
    if version.startswith("3"):
        stamp = 1_700_000_000_000_000 + round(1e6 * CLOCK[i])
        out |= {"time_of_validity": stamp, "time_of_transmission": stamp + 90_000}
    return out


def dead_reckoning(i):
    return {
        "ts": 1.7e9 + CLOCK[i], "x": 0.1 * CLOCK[i], "y": 0.2, "z": 0.3, "std": 0.01, "roll": 0.6, "pitch": 359.0,
        "yaw": 350.0, "type": "position_local", "status": int(i % 10 == 0), "format": "json_v3.1",
    }  # fmt: skip


@pytest.mark.parametrize("version", ["1", "2", "3", "3.1"])
def test_water_linked_reports_of_all_versions(tmp_path, version):
    """v1 and v2 have no clock: their periods are summed. Reports without bottom lock are dropped and counted."""
    lines = [json.dumps(report(i, version)) for i in range(N)]
    (tmp_path / "dvl.jsonl").write_text("\n".join(lines) + "\n")
    trial = one(tmp_path / "dvl.jsonl")
    assert note(trial, "invalid_left_out").values["samples"] == N - GOOD.sum()
    times = CLOCK[GOOD] - CLOCK[GOOD][0]
    for name, expected in (("u", U), ("v", V), ("w", W)):
        t, values = trial.series(name)
        np.testing.assert_allclose(values, expected[GOOD], atol=1e-12)
        np.testing.assert_allclose(t, times, atol=2e-6)
    assert ("periods_summed" in {item.code for item in trial.findings}) == (version in "12")
    assert "altitude, transducers" in str(trial.findings[-1])


def test_dead_reckoning_is_read_on_the_same_clock_only(tmp_path):
    """position_local of version 3 has a Unix time, as velocities have; that of version 2 does not."""
    lines = [json.dumps(line) for i in range(N) for line in (report(i, "3.1"), dead_reckoning(i))]
    lines += [
        '{"type": "response", "success": true}',
        '{"type": "velocity", "tracking_mode": "water"}',
        "garbage",
    ]
    (tmp_path / "dvl.json").write_text("\n".join(lines))
    trial = one(tmp_path / "dvl.json")
    t, x = trial.series("x")
    assert len(x) == N * 9 // 10 and "z" not in trial.channels
    np.testing.assert_allclose(x, 0.1 * CLOCK[np.arange(N) % 10 != 0])
    np.testing.assert_allclose(trial.series("yaw")[1], np.radians(10.0))
    np.testing.assert_allclose(trial.series("pitch")[1], np.radians(1.0))
    unread = str(trial.findings[-1])
    for item in (
        "response (1 lines)",
        "velocity_water (1 lines)",
        "lines that are no JSON object (1 lines)",
        " z",
    ):
        assert item in unread
    old = [json.dumps(line) for i in range(N) for line in (report(i, "2"), dead_reckoning(i))]
    (tmp_path / "old.json").write_text("\n".join(old))
    assert f"position_local, which has another clock ({N} lines)" in str(
        one(tmp_path / "old.json").findings[-1]
    )
    boot = [
        json.dumps(line)
        for i in range(N)
        for line in (report(i, "3.3"), dead_reckoning(i) | {"ts": CLOCK[i]})
    ]
    (tmp_path / "boot.json").write_text("\n".join(boot))
    trial = one(tmp_path / "boot.json")
    assert "x" not in trial.channels and "position_local, which has another clock" in str(trial.findings[-1])


@pytest.mark.parametrize("name", ["time", "time_of_validity"])
def test_tables_of_a_doppler_log_need_no_map(tmp_path, name):
    """Both forms of the manufacturer's parser are read: with periods, and with Unix times."""
    times = PERIOD if name == "time" else np.round(1e6 * (1.7e9 + CLOCK)).astype(np.int64)
    trial = one(csv(tmp_path / "dvl.csv", **{name: times}, **VELOCITIES, status=0 * GOOD))
    for column, expected in (("u", U), ("v", V), ("w", W)):
        np.testing.assert_allclose(trial.series(column)[1], expected[GOOD], atol=1e-12)
    np.testing.assert_allclose(trial.t, CLOCK[GOOD] - CLOCK[GOOD][0], atol=2e-6)
    assert note(trial, "invalid_left_out").values["samples"] == N - GOOD.sum()


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        (
            {"velocity_valid": False, "format": "json_v3", "type": "response"},
            "no velocity of a Water Linked log",
        ),
        ({**report(5, "3.1")}, "no sample is valid"),
        ({k: v for k, v in report(0, "1").items() if k != "time"}, "have no 'time' with numbers"),
        ({k: v for k, v in report(0, "1").items() if k != "vy"}, "no column 'vy'"),
    ],
)
def test_reports_that_say_nothing_are_refused(tmp_path, line, sentence):
    (tmp_path / "dvl.jsonl").write_text("\n".join([json.dumps(line)] * 5))
    with pytest.raises(CalibrationError, match=sentence):
        read_trials([tmp_path / "dvl.jsonl"])


def ground_station(**more):
    columns = {
        "Timestamp": [f"2026-05-04 10:{i // 60:02d}:{i % 60:02d}.250" for i in range(N)],
        "roll": 10.0 * np.sin(T), "pitch": -5.0 + T, "heading": (350.0 + np.arange(N)) % 360.0,
        "rollRate": np.cos(T), "pitchRate": 1.0 + 0.0 * T, "yawRate": 2.0 + np.sin(T),
        "altitudeRelative": -1.5 - 0.1 * T,
        "battery0.voltage": ["--.--"] * N, "throttlePct": T, "localPosition.x": 0.1 * T, "localPosition.y": 0.2 * T,
        "localPosition.z": 0.3 * T, **more,
    }  # fmt: skip
    cells = [[str(value) for value in values] for values in columns.values()]
    return "\n".join([",".join(columns), *(",".join(row) for row in zip(*cells, strict=True))]) + "\n"


def test_qgroundcontrol_needs_no_map(tmp_path):
    """Degrees in north-east-down axes, altitude upwards, `--.--` for data that the vehicle does not send."""
    (tmp_path / "2026-05-04 10-00-00 vehicle1.csv").write_text(ground_station())
    trial = one(tmp_path / "2026-05-04 10-00-00 vehicle1.csv")
    expected = {
        "roll": np.radians(10.0 * np.sin(T)), "pitch": -np.radians(-5.0 + T), "p": np.radians(np.cos(T)),
        "yaw": wrap_angle(-np.radians((350.0 + np.arange(N)) % 360.0)), "r": -np.radians(2.0 + np.sin(T)),
        "depth": 1.5 + 0.1 * T, "x": 0.1 * T, "y": -0.2 * T, "z": -0.3 * T,
    }  # fmt: skip
    for name, values in expected.items():
        np.testing.assert_allclose(trial.channels[name], values, atol=1e-12)
    np.testing.assert_allclose(trial.t, np.arange(N))
    assert "voltage" not in trial.channels and str(trial.findings[-1]).endswith(
        "not read: columns throttlePct"
    )


def test_qgroundcontrol_velocities_of_the_world_become_those_of_the_body(tmp_path):
    """At heading north, velocity north is surge; small pitch and roll are taken into account."""
    level = {"roll": 0.0 * T, "pitch": 0.0 * T, "heading": 90.0 + 0.0 * T, "rollRate": np.cos(T)}
    moving = {
        "localPosition.vx": 0.5 + 0.0 * T,
        "localPosition.vy": 0.1 * T,
        "localPosition.vz": 0.2 + 0.0 * T,
    }
    (tmp_path / "a.csv").write_text(ground_station(**level, **moving, **{"battery0.voltage": 15.0 + 0.0 * T}))
    trial = one(tmp_path / "a.csv")
    np.testing.assert_allclose(trial.channels["u"], 0.1 * T, atol=1e-9)  # east is ahead
    np.testing.assert_allclose(trial.channels["v"], 0.5, atol=1e-9)  # north is to the left
    np.testing.assert_allclose(trial.channels["w"], -0.2, atol=1e-9)
    np.testing.assert_allclose(trial.channels["voltage"], 15.0)


def test_acoustic_positions_need_no_map(tmp_path):
    """Invalid fixes are dropped; z is down."""
    rows = [
        f"{1.7e9 + t:.3f},{good},{t:.3f},2.0,{1.0 + 0.01 * t:.4f},0.2"
        for t, good in zip(T, GOOD, strict=True)
    ]
    (tmp_path / "fix.csv").write_text("\n".join(["timestamp,position_valid,x,y,z,std", *rows]) + "\n")
    trial = one(tmp_path / "fix.csv")
    np.testing.assert_allclose(trial.channels["x"], np.round(T[GOOD], 3))
    np.testing.assert_allclose(trial.channels["y"], -2.0)
    np.testing.assert_allclose(trial.channels["z"], -np.round(1.0 + 0.01 * T[GOOD], 4))
    assert note(trial, "invalid_left_out").values["samples"] == N - GOOD.sum()
    assert str(trial.findings[-1]).endswith("not read: columns std")


def test_numpy_archives(tmp_path):
    """Arrays are columns, two-dimensional ones by index in a map; arrays of other lengths are named."""
    gyro = np.stack([np.sin(T), np.cos(T), T], axis=-1)
    np.savez(tmp_path / "run.npz", t=T, u=T**2, gyro=gyro, slow=np.arange(7), mass=11.2)
    trial = one(tmp_path / "run.npz")
    np.testing.assert_array_equal(trial.channels["u"], T**2)
    assert "slow (7,), mass ()" in str(trial.findings[-2]) and "gyro[0], gyro[1]" in str(trial.findings[-1])
    (tmp_path / "map.yaml").write_text(
        'time: t\ncolumns: {p: "gyro[0]", r: {column: "gyro[2]", unit: deg/s}}'
    )
    mapped = one(tmp_path / "run.npz", column_map=tmp_path / "map.yaml")
    np.testing.assert_allclose(mapped.channels["r"], np.radians(T))
    np.savez(
        tmp_path / "dates.npz",
        t=np.datetime64("2026-05-04T10:00:00") + np.arange(N) * np.timedelta64(100, "ms"),
        u=T,
    )
    np.testing.assert_allclose(one(tmp_path / "dates.npz").t, T, atol=1e-6)


def test_an_archive_runs_no_code(tmp_path):
    """Python objects in an archive are refused, as are files that are not archives."""
    np.savez(tmp_path / "objects.npz", t=np.array([{}, {}], dtype=object))
    (tmp_path / "text.npz").write_text("t,u\n")
    (tmp_path / "cut.npz").write_bytes((tmp_path / "objects.npz").read_bytes()[:-30])
    np.savez(tmp_path / "empty.npz", u=T)
    for name, sentence in (
        ("objects", "archive of numbers"),
        ("text", "archive of numbers"),
        ("empty", "no array of times"),
    ):
        with pytest.raises(CalibrationError, match=sentence):
            read_trials([tmp_path / f"{name}.npz"])


# PX4, by the description of the ULog format: header, definitions, subscriptions, data.

FORMATS = {
    "vehicle_attitude": ("uint64_t timestamp;float[4] q;", "<Q4f"),
    "vehicle_angular_velocity": ("uint64_t timestamp;float[3] xyz;", "<Q3f"),
    "sensor_combined": ("uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;", "<Q6f"),
    "vehicle_local_position": (
        "uint64_t timestamp;float x;float y;float z;float vx;float vy;float vz;bool xy_valid;bool z_valid;"
        "bool v_xy_valid;bool v_z_valid;",
        "<Q6f4?",
    ),
    "actuator_outputs": ("uint64_t timestamp;uint32_t noutputs;float[16] output;", "<QI16f"),
    "battery_status": ("uint64_t timestamp;float voltage_v;", "<Qf"),
    "vehicle_status": ("uint64_t timestamp;uint8_t arming_state;", "<QB"),
    "cpuload": ("uint64_t timestamp;float load;", "<Qf"),
}
TILT = quat_from_euler(0.2, 0.1, 0.7)
"""Attitude in FinsSim's axes."""


def message(kind, content):
    return struct.pack("<HB", len(content), ord(kind)) + content


def ulog(path, topics=tuple(FORMATS), valid=None, parameters=None):
    """Write a log of 20 s: FinsSim's attitude and motion converted to forward-right-down and north-east-down."""
    half = np.array([1.0, 0.0, 0.0, 0.0])
    x, y, z, w = quat_multiply(quat_multiply(half, TILT), half)
    out = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + message("B", bytes(40))
    for name, value in (parameters or {}).items():
        kind, form = ("int32_t", "<i") if isinstance(value, int) else ("float", "<f")
        key = f"{kind} {name}".encode()
        out += message("P", bytes([len(key)]) + key + struct.pack(form, value))
    out += b"".join(message("F", f"{name}:{FORMATS[name][0]}".encode()) for name in topics)
    out += b"".join(message("A", struct.pack("<BH", 0, i) + name.encode()) for i, name in enumerate(topics))
    for k, t in enumerate(T):
        flags = valid or (k % 10 != 0, True, k % 5 != 0, True)
        outputs = [1500.0 + 10.0 * k % 300.0, 1500.0, *[0.0] * 14]
        values = {
            "vehicle_attitude": (w, x, y, z),
            "vehicle_angular_velocity": (0.01 * np.sin(t), -0.01 * np.cos(t), -3e-3 * t),
            "sensor_combined": (9.0, 9.0, 9.0, 0.1, -0.2, -9.8),
            "vehicle_local_position": (t, -2.0 * t, 3.0, 0.5, -0.25, 0.1 * t, *flags),
            "actuator_outputs": (2, *outputs),
            "battery_status": (15.5,),
            "vehicle_status": (2 if 50 <= k < 150 else 1,),
            "cpuload": (0.5,),
        }
        for i, name in enumerate(topics):
            body = struct.pack(FORMATS[name][1], 1_000_000 + round(1e6 * t), *values[name])
            out += message("D", struct.pack("<H", i) + body)
    path.write_bytes(out)
    return path


def test_px4_logs(tmp_path):
    """Attitude, rates, specific force, position and velocity in FinsSim's axes, the last two where valid."""
    pytest.importorskip("pyulog")
    trial = one(ulog(tmp_path / "dive.ulg"))
    q = np.stack([trial.series(f"q{c}")[1] for c in "xyzw"], axis=-1)
    for v in np.eye(3):
        np.testing.assert_allclose(
            quat_rotate(q, v), np.broadcast_to(quat_rotate(TILT, v), (N, 3)), atol=1e-6
        )
    for name, expected in {
        "p": 0.01 * np.sin(T), "q": 0.01 * np.cos(T), "r": 3e-3 * T, "ax": 0.1 + 0 * T, "ay": 0.2 + 0 * T,
        "az": 9.8 + 0 * T,
        "z": -3.0 + 0 * T, "voltage": 15.5 + 0 * T, "pwm_C1": 1500.0 + 10.0 * np.arange(N) % 300.0,
    }.items():  # fmt: skip
        np.testing.assert_allclose(trial.series(name)[1], expected, rtol=1e-6, atol=1e-6, err_msg=name)
    np.testing.assert_allclose(trial.series("x")[1], T[np.arange(N) % 10 != 0], atol=1e-5)
    world = np.stack([0.5 + 0 * T, 0.25 + 0 * T, -0.1 * T], axis=-1)[np.arange(N) % 5 != 0]
    body = np.stack([trial.series(name)[1] for name in "uvw"], axis=-1)
    np.testing.assert_allclose(quat_rotate(TILT, body), world, atol=1e-5)
    assert {item.values["column"] for item in trial.findings if item.code == "invalid_left_out"} == {
        "xy_valid",
        "v_xy_valid",
    }
    assert str(trial.findings[-1]) == "not read: topics cpuload (200)"


def test_px4_logs_split_by_arming_with_outputs_of_a_map(tmp_path):
    pytest.importorskip("pyulog")
    path = ulog(tmp_path / "dive.ulg")
    codes = {item.code for item in one(path, vehicle="bluerov2").findings}
    assert "outputs_unassigned" in codes and "pulses_unnamed" not in codes
    (tmp_path / "map.yaml").write_text("vehicle: bluerov2\nsplit: arming\nardusub: {outputs: {C1: -T1}}")
    trial = one(path, column_map=tmp_path / "map.yaml")
    assert len(trial.series("p")[1]) == 100
    np.testing.assert_allclose(
        trial.series("pwm_T1")[1], (1500.0 - 10.0 * np.arange(50, 150) % 300.0), rtol=1e-6
    )


ORDER = ("T8", "T1", "T3", "T2", "T5", "T7", "T6", "T4")
"""Thrusters of PX4's motors 1 to 8."""


def rotors(move=0.0):
    """Return PX4 parameters of a bluerov2_heavy, in forward-right-down; motor 2 is moved forward [m]."""
    vehicle, found = load_vehicle("bluerov2_heavy"), {"CA_ROTOR_COUNT": 8}
    for i, name in enumerate(ORDER):
        thruster = vehicle.thrusters[name]
        place = (thruster.position - vehicle.body.center_of_gravity) * [1, -1, -1] + [move * (i == 1), 0, 0]
        turned = -1.0 if i == 1 else 1.0  # motor 2 pushes against the axis of T1
        for letter, vector in (("P", place), ("A", turned * thruster.axis * [1, -1, -1])):
            found |= {f"CA_ROTOR{i}_{letter}{axis}": float(x) for axis, x in zip("XYZ", vector, strict=True)}
    return found


@pytest.mark.parametrize("functions", [{}, {"PWM_AUX_FUNC1": 102, "PWM_AUX_FUNC2": 101, "PWM_AUX_REV": 2}])
def test_rotors_of_px4_assign_the_outputs(tmp_path, functions):
    """Position and axis match rotors to thrusters, through the functions of the outputs; each reversal flips
    the pulses."""
    pytest.importorskip("pyulog")
    trial = one(ulog(tmp_path / "a.ulg", parameters=rotors() | functions), vehicle="bluerov2_heavy")
    first, still = 1500.0 + 10.0 * np.arange(N) % 300.0, 1500.0 + 0.0 * T
    expected = (
        {"pwm_T1": 3000.0 - first, "pwm_T8": still} if functions else {"pwm_T8": first, "pwm_T1": still}
    )
    assert {name for name in trial.channels if name.startswith("pwm_")} == set(expected)
    for name, pulses in expected.items():
        np.testing.assert_allclose(trial.series(name)[1], pulses, rtol=1e-6)
    found = {item.code: item for item in trial.findings}
    assert not set(found) & {"outputs_unassigned", "rotors_apart", "rotors_unlike"}
    assert ("C2 -T8" if functions else "C2 -T1") in str(found["outputs_mapped"])


def test_rotors_of_px4_are_compared_with_the_vehicle_or_offered(tmp_path):
    pytest.importorskip("pyulog")
    path = ulog(tmp_path / "a.ulg", parameters=rotors(move=0.1))
    found = {item.code: str(item) for item in one(path, vehicle="bluerov2_heavy").findings}
    assert "place T1 0.1 m from its position in bluerov2_heavy" in found["rotors_apart"]
    stated = {item.code: str(item) for item in one(path, vehicle=None).findings}["rotors_stated"]
    lines = yaml.safe_load("{" + stated.partition("gravity: ")[2].partition("; these")[0] + "}")
    vehicle = load_vehicle("bluerov2_heavy")
    for i, name in enumerate(ORDER):
        place = vehicle.thrusters[name].position - vehicle.body.center_of_gravity + [0.1 * (i == 1), 0, 0]
        np.testing.assert_allclose(lines[f"M{i + 1}"]["position"], place, atol=1e-4)
    unlike = {item.code for item in one(path, vehicle="bluerov2").findings}
    assert {"rotors_unlike", "outputs_unassigned"} <= unlike


def test_px4_logs_without_a_horizontal_velocity(tmp_path):
    """Without positioning, a valid vertical velocity alone gives no body velocity, and this is noted."""
    pytest.importorskip("pyulog")
    trial = one(ulog(tmp_path / "dive.ulg", valid=(False, True, False, True)))
    assert "z" in trial.channels and not {"x", "u", "v", "w"} & set(trial.channels)
    assert "vz left out: a velocity in the world needs all of vx, vy and vz" in [
        str(i) for i in trial.findings
    ]


@pytest.mark.parametrize("part", [0.7, 0.3])
def test_a_px4_log_that_was_cut_is_read_up_to_the_cut(tmp_path, part):
    pytest.importorskip("pyulog")
    data = ulog(tmp_path / "dive.ulg").read_bytes()
    (tmp_path / "cut.ulg").write_bytes(data[: int(part * len(data))])
    trial = one(tmp_path / "cut.ulg")
    assert 0.8 * part < trial.duration / 20.0 <= part + 0.02


def test_a_px4_log_without_motion_is_refused(tmp_path):
    pytest.importorskip("pyulog")
    with pytest.raises(CalibrationError, match="contains none of vehicle_attitude"):
        read_trials([ulog(tmp_path / "dive.ulg", ("cpuload",))])
    (tmp_path / "broken.ulg").write_bytes(b"ULog\x01\x12\x35\x01" + bytes(3))
    with pytest.raises(CalibrationError, match="cannot be read as a PX4 log"):
        read_trials([tmp_path / "broken.ulg"])
    # On this file pyulog loops for ever.
    about = message("I", b"\x05char[2] aab" + bytes(20)) * 15
    (tmp_path / "endless.ulg").write_bytes(
        b"ULog\x01\x12\x35\x01" + bytes(8) + about + b"\x2c\x01\0" + bytes(97)
    )
    with pytest.raises(CalibrationError, match="is damaged and cannot be read"):
        read_trials([tmp_path / "endless.ulg"])


def test_formats_are_recognised_by_content(tmp_path):
    """Special formats are tried before general ones; an unknown one is refused with a list of all known."""
    assert list(importers("trial"))[-1] == "csv"
    ulog(tmp_path / "a.bin")
    assert importer_of(tmp_path / "a.bin") == "ulog"
    (tmp_path / "b.txt").write_text(json.dumps(report(0, "1")))
    assert importer_of(tmp_path / "b.txt") == "waterlinked"
    (tmp_path / "c.xyz").write_text("?")
    with pytest.raises(
        CalibrationError, match=r"unknown format of the log, expected one of .*PX4.*give --format"
    ):
        read_trials([tmp_path / "c.xyz"])
    with pytest.raises(CalibrationError, match="format is 'ulg', expected one of auto, "):
        read_trials([tmp_path / "c.xyz"], format="ulg")


def test_known_formats_take_the_keys_of_a_map(tmp_path):
    """These are vehicle, role, offsets and windows, without descriptions of the columns."""
    (tmp_path / "dvl.jsonl").write_text("\n".join(json.dumps(report(i, "1")) for i in range(N)))
    (tmp_path / "map.yaml").write_text(
        "vehicle: bluerov2\npassive: true\nsplit: {windows: {a: [0, 5], b: [6, 9]}}"
    )
    first, second = read_trials([tmp_path / "dvl.jsonl"], column_map=tmp_path / "map.yaml")
    assert first.header.passive and all(low < high for low, high in pairwise(second.t))


# In every format, data of a log that a trial cannot represent are named, and so are invalid or constant data.


def npz(path, **columns):
    np.savez(path, **columns)
    return path


def with_type(path):
    lines = [json.dumps(report(i, "3.1") | {"turboness": 1.5}) for i in range(N)]
    path.write_text("\n".join([*lines, *['{"type": "turbo_model"}'] * 7]))
    return path


FIX = {"timestamp": T, "position_valid": GOOD, "x": T, "y": T, "z": T}
VELOCITIES = {
    "vx": U,
    "vy": -V,
    "vz": -W,
    "fom": 0.002 + 0 * T,
    "altitude": 1 + 0 * T,
    "velocity_valid": GOOD,
}
UNKNOWN = {
    "csv": ("a.csv", lambda path: csv(path, t=T, u=T, turboness=T)),
    "npz": ("a.npz", lambda path: npz(path, t=T, u=T, turboness=np.arange(3))),
    "qgroundcontrol": ("a.csv", lambda path: path.write_text(ground_station(turboness=T)) and path),
    "acoustic": ("a.csv", lambda path: csv(path, **FIX, turboness=T)),
    "waterlinked": ("a.json", with_type),
    "waterlinked_csv": (
        "a.csv",
        lambda path: csv(path, **VELOCITIES, time_of_validity=1e6 * (1.7e9 + T), turboness=T),
    ),
    "waterlinked_period_csv": ("a.csv", lambda path: csv(path, **VELOCITIES, time=PERIOD, turboness=T)),
    "ulog": ("a.ulg", lambda path: ulog(path, (*list(FORMATS)[:3], "cpuload"))),
}


@pytest.mark.parametrize("name", UNKNOWN)
def test_what_a_trial_has_not_is_named(tmp_path, name):
    """An unknown column, field, array or topic is named, and unknown kinds of messages are counted."""
    if name == "ulog":
        pytest.importorskip("pyulog")
    file, write = UNKNOWN[name]
    unread = " ".join(str(item) for item in one(write(tmp_path / file)).findings if item.code == "not_read")
    assert ("cpuload (200)" if name == "ulog" else "turboness") in unread
    assert name != "waterlinked" or "turbo_model (7 lines)" in unread


def test_every_importer_of_logs_has_such_a_test():
    """Bags are tested in `test_mavros.py`, ArduSub logs in `test_ardusub.py`; add a new format to the table
    above."""
    assert set(importers("trial")) == {*UNKNOWN, "rosbag", "ardupilot"} - {"npz"}


@pytest.mark.parametrize("name", ["csv", "npz"])
def test_a_dead_column_and_a_stale_flag_are_reported_in_tables(tmp_path, name):
    """Zero rates and stale last velocities do not silently become measurements."""
    flags = np.where(GOOD, 1.0, 0.0)
    columns = {"t": T, "yaw": np.sin(T), "r": 0.0 * T, "u": np.where(GOOD, T, 77.0), "velocity_valid": flags}
    trial = one((csv if name == "csv" else npz)(tmp_path / f"a.{name}", **columns))
    assert "r" not in trial.channels and trial.series("u")[1].max() < 77.0
    assert {"never_changes", "invalid_left_out"} <= {item.code for item in trial.findings}
