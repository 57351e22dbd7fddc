"""Tables from the field: flags of invalid samples, kinds of time, angles, units of pressure, constant and
empty columns."""

from pathlib import Path

import numpy as np
import pytest

from finssim.core.rotations import wrap_angle
from finssim.trials.conversion import pressure_unit, spread
from finssim.trials.findings import CalibrationError
from finssim.trials.importers.dispatch import read_trials
from finssim.trials.trial import Trial
from finssim.trials.trial_files import load_trial
from trials.importers.tables import codes, read

N = 200
T = np.arange(N) * 0.1


# Flags of invalid samples.

STALE = np.where(np.arange(N) % 10 == 3, 0.56, np.sin(T))
FLAG = np.arange(N) % 10 != 3


@pytest.mark.parametrize(
    ("flag", "how"),
    [
        (FLAG, "valid: ok_flag"),
        (FLAG.astype(int), "valid: {column: ok_flag, value: 1}"),
        (np.where(FLAG, "A", "V"), "valid: {column: ok_flag, value: A}"),
        (np.where(FLAG, 4, 0), "valid: {column: ok_flag, value: [3, 4]}"),
        (np.where(FLAG, 0.01, 2.66), "valid: {column: ok_flag, below: 0.5}"),
        (np.where(FLAG, 0.01, -1.0), "valid: {column: ok_flag, above: 0}"),
    ],
)
def test_invalid_samples_are_left_out_and_counted(tmp_path, flag, how):
    """Samples are dropped by a flag, a value or a limit; the others are unchanged."""
    trial = read(tmp_path, {"t": T, "u": STALE, "ok_flag": flag}, f"time: t\ncolumns: [u]\n{how}")
    np.testing.assert_array_equal(trial.series("u")[1], STALE[FLAG])
    (note,) = [item for item in trial.findings if item.code == "invalid_left_out"]
    assert (note.values["samples"], note.values["total"], note.values["column"]) == (20, 200, "ok_flag")


def test_a_column_may_have_a_flag_of_its_own(tmp_path):
    """In a table of two sensors only the columns of the flagged one become empty."""
    columns = {"t": T, "u": STALE, "depth": T, "dvl": FLAG}
    trial = read(tmp_path, columns, "time: t\ncolumns: {u: {column: u, valid: dvl}, depth: depth}")
    assert len(trial.series("u")[1]) == 180 and len(trial.series("depth")[1]) == 200


@pytest.mark.parametrize(
    ("name", "bad", "column"),
    [
        ("velocity_valid", False, "u"),
        ("fom", 2.66, "u"),
        ("position_valid", 0, "x"),
        ("fix_type", 1, "x"),
        ("valid", 0, "u"),
    ],
)
def test_evident_flags_need_no_map(tmp_path, name, bad, column):
    """The usual names of flags in tables, and figures of merit, are recognised; other columns are unchanged."""
    good = {"fom": 0.002, "fix_type": 3}.get(name, 1 if bad is not False else True)
    columns = {"t": T, column: STALE, "depth": T, name: [good if f else bad for f in FLAG]}
    trial = read(tmp_path, columns)
    assert len(trial.series(column)[1]) == 180
    assert len(trial.series("depth")[1]) == (180 if name == "valid" else 200)
    assert "invalid_left_out" in codes(trial)
    kept = read(tmp_path, columns, f"time: t\ncolumns: [{column}, depth]\nvalid: false")
    assert len(kept.series(column)[1]) == 200
    assert any(name in str(item) for item in kept.findings if item.code == "not_read")


@pytest.mark.parametrize(
    ("flag", "how", "sentence"),
    [
        (["maybe"] * N, "valid: f", "contains 'maybe', expected 1 and 0 or true and false"),
        ([5] * N, "valid: f", "contains '5'"),
        (["A"] * N, "valid: {column: f, below: 3}", "contains words, which have no limits"),
        ([0] * N, "valid: f", "no sample is valid: 200 of 200"),
        ([1] * N, "valid: g", "no column 'g'"),
        ([1] * N, "valid: {column: f, belov: 3}", "unknown key 'belov', did you mean 'below'?"),
        ([1] * N, "valid: 3", "is 3, expected a column"),
    ],
)
def test_a_flag_that_says_nothing_is_refused(tmp_path, flag, how, sentence):
    with pytest.raises(CalibrationError) as refused:
        read(tmp_path, {"t": T, "u": STALE, "f": flag}, f"time: t\ncolumns: [u]\n{how}")
    assert sentence in str(refused.value) and "\n" not in str(refused.value)


def test_a_table_in_memory_has_flags_too():
    trial = Trial.from_frame({"t": T, "u": STALE, "velocity_valid": FLAG, "other": T})
    assert len(trial.series("u")[1]) == 180
    assert str(trial.findings[-1]) == "trial: not read: columns other"


# Kinds of time.


def test_periods_are_summed_up_and_are_no_clock(tmp_path):
    """The time since the previous row, in ms, is refused as a clock, with the cause, and read as periods."""
    period = 60.0 + 30.0 * (np.arange(N) * 7 % 5)
    with pytest.raises(CalibrationError, match="probably the period since the last row.*kind: period"):
        read(tmp_path, {"time": period, "u": STALE}, "time: {column: time, unit: ms}\ncolumns: [u]")
    trial = read(
        tmp_path, {"time": period, "u": STALE}, "time: {column: time, unit: ms, kind: period}\ncolumns: [u]"
    )
    np.testing.assert_allclose(trial.t, 1e-3 * (np.cumsum(period) - period[0]), atol=1e-6)


@pytest.mark.parametrize(
    ("bits", "unit", "wrap"), [(16, "ms", ""), (32, "us", ""), (16, "ms", ", wrap: 65536"), (8, "s", "")]
)
def test_counters_go_on_where_they_begin_again(tmp_path, bits, unit, wrap):
    """A wrapping clock of this many bits continues; as a stamp it is refused with the cause."""
    step = {"ms": 700, "us": 40_000_000, "s": 1}[unit] if bits < 32 else 1_500_000
    count = (np.arange(N * 4) * step + 2**bits - 50 * step) % 2**bits
    columns = {"n": count, "u": np.arange(N * 4)}
    trial = read(tmp_path, columns, f"time: {{column: n, unit: {unit}, kind: counter{wrap}}}\ncolumns: [u]")
    scale = {"ms": 1e-3, "us": 1e-6, "s": 1.0}[unit]
    np.testing.assert_allclose(np.diff(trial.t), step * scale, atol=2e-6)
    if bits > 8:
        with pytest.raises(CalibrationError, match="probably a counter that overflows after"):
            read(tmp_path, columns, f"time: {{column: n, unit: {unit}}}\ncolumns: [u]")


def test_whole_seconds_are_spread_and_never_dropped(tmp_path):
    """A clock of whole seconds with 10 samples each is refused, or spread to within 0.1 s of the truth."""
    true = 17.37 + np.arange(N) * 0.1
    columns = {"t": np.floor(true).astype(int), "u": np.arange(N)}
    with pytest.raises(CalibrationError, match=r"clock counts steps of 1 s: .*kind: coarse"):
        read(tmp_path, columns)
    trial = read(tmp_path, columns, "time: {column: t, kind: coarse}\ncolumns: [u]")
    assert len(trial.series("u")[1]) == N
    np.testing.assert_allclose(trial.t, true - true[0], atol=0.1)
    (tmp_path / "data.csv").write_text("t,u\n" + "".join(f"{int(t)},{i}\n" for i, t in enumerate(true)))
    with pytest.raises(CalibrationError, match="kind: coarse"):
        load_trial(tmp_path / "data.csv")


def test_spreading_keeps_counts_that_vary():
    """With 9 or 11 samples in a second, each second is filled and the order is kept."""
    t = np.repeat([0.0, 1.0, 2.0, 3.0], [4, 9, 11, 6])
    out = spread(t)
    assert (np.diff(out) > 0.0).all() and (np.floor(out) == t).all()
    np.testing.assert_allclose(out[4:13], 1.0 + np.arange(9) / 9.0)
    np.testing.assert_allclose(out[0], 1.0 - 4 * 0.1, atol=0.02)


@pytest.mark.parametrize(
    "kind", ["{column: t, kind: clock}", "{column: t, wrap: 5}", "{column: t, unit: date, kind: period}"]
)
def test_a_time_of_no_kind_is_refused(tmp_path, kind):
    with pytest.raises(CalibrationError, match="time"):
        read(tmp_path, {"t": T, "u": STALE}, f"time: {kind}\ncolumns: [u]")


def test_a_few_late_rows_are_sorted_and_many_are_refused(tmp_path):
    """Three late rows are repaired; for two sensors' clocks in one column the cause is reported."""
    late = T.copy()
    late[[50, 51]] = late[[51, 50]]
    trial = read(tmp_path, {"t": late, "u": late})
    np.testing.assert_allclose(trial.t, T, atol=1e-9)
    np.testing.assert_allclose(trial.channels["u"], late[np.argsort(late)], atol=1e-9)
    mixed = np.where(np.arange(N) % 2, T, T + 5.0)
    with pytest.raises(
        CalibrationError, match=r"steps back at 100 of 200 rows.*clocks or sensors are probably mixed"
    ):
        read(tmp_path, {"t": mixed, "u": T})


# Angles and pressures.


def test_angles_are_within_half_a_turn_when_they_are_read(tmp_path):
    """Tested with headings of 0 to 360 degrees in NED, and radians of 0 to 2 pi without a unit."""
    heading = (np.arange(N) * 7.0) % 360.0
    trial = read(
        tmp_path,
        {"t": T, "h": heading, "p": (heading / 50.0 - 3.0) % 360.0},
        "time: t\nframe: NED\ncolumns: {yaw: {column: h, unit: deg}, pitch: {column: p, unit: deg}}",
    )
    np.testing.assert_allclose(trial.channels["yaw"], wrap_angle(-np.radians(heading)), atol=1e-12)
    assert np.abs(trial.channels["pitch"]).max() < 0.1
    assert read(tmp_path, {"t": T, "yaw": np.radians(heading)}).channels["yaw"].min() < -3.0


def test_degrees_without_a_unit_stay_to_be_noticed(tmp_path):
    """If they were wrapped as radians they would look like valid angles."""
    trial = read(tmp_path, {"t": T, "yaw": (np.arange(N) * 7.0) % 360.0})
    assert trial.channels["yaw"].max() > 300.0


@pytest.mark.parametrize(("unit", "scale"), [("Pa", 1.0), ("hPa", 1e-2), ("kPa", 1e-3)])
def test_the_unit_of_a_pressure_is_told_from_its_size(tmp_path, unit, scale):
    """Absolute pressures from the surface to 5 m of sea water determine the unit."""
    depth = 2.5 - 2.5 * np.cos(0.2 * T)
    pressure = (101325.0 + 1025.0 * 9.80665 * depth) * scale
    assert pressure_unit(pressure) == unit
    text = "time: t\ncolumns: {pressure: p}\nsurface_pressure: 101325\nwater: {density: 1025}"
    trial = read(tmp_path, {"t": T, "p": pressure}, text)
    np.testing.assert_allclose(trial.channels["depth"], depth, atol=1e-6)
    assert ("pressure_unit" in codes(trial)) == (unit != "Pa")


def test_a_gauge_is_not_taken_for_an_absolute_pressure(tmp_path):
    gauge = 1000.0 * 9.80665 * (1.0 + np.sin(T))
    with pytest.raises(CalibrationError, match="not absolute pressures.*surface_pressure: 0"):
        read(tmp_path, {"t": T, "p": gauge}, "time: t\ncolumns: {pressure: p}")
    trial = read(tmp_path, {"t": T, "p": gauge}, "time: t\ncolumns: {pressure: p}\nsurface_pressure: 0")
    np.testing.assert_allclose(trial.channels["depth"], 1.0 + np.sin(T), rtol=1e-9)


# Constant and empty columns.

ROLL = 0.35 * np.exp(-0.2 * T) * np.cos(2.0 * T)


def test_rates_that_never_change_lose_to_an_attitude_that_moves(tmp_path):
    """In an import and in a table read as a trial, with one sentence; rates of a vehicle at rest are kept."""
    columns = {
        "t": T,
        "roll": ROLL,
        "pitch": 0.0 * T,
        "yaw": 0.05 * T,
        "p": 0.0 * T,
        "q": 0.0 * T,
        "r": 0.0 * T,
    }
    for trial in (read(tmp_path, columns), load_trial(tmp_path / "log.csv")):
        assert sorted(trial.channels) == ["pitch", "roll", "yaw"]
        (note,) = [item for item in trial.findings if item.code == "never_changes"]
        assert note.values["columns"] == ("p", "q", "r") and note.values["moving"] == ("roll", "yaw")
    still = columns | {"roll": 0.0 * T, "yaw": 0.0 * T}
    assert {"p", "q", "r"} <= set(read(tmp_path, still).channels)
    turning = columns | {"roll": 0.0 * T, "r": 0.05 + 0.0 * T}
    assert "r" in read(tmp_path, turning).channels


@pytest.mark.parametrize(
    ("dead", "moving"),
    [
        ({"qx": 0.0, "qy": 0.0, "qz": 0.0, "qw": 1.0}, {"roll": ROLL, "pitch": ROLL, "yaw": ROLL}),
        ({"u": 0.0, "v": 0.0}, {"x": T, "y": np.sin(T)}),
        ({"w": 0.0}, {"z": -1.0 - 0.5 * np.sin(T)}),
        ({"x": 0.0, "y": 0.0}, {"u": np.sin(T), "v": np.cos(T)}),
        ({"depth": 0.0}, {"z": -1.0 - 0.5 * np.sin(T)}),
        ({"z": 0.0}, {"depth": 1.0 + 0.5 * np.sin(T)}),
        ({"roll": 0.0, "pitch": 0.0}, {"p": 0.01 + 0.3 * np.cos(T), "q": 0.3 * np.sin(T)}),
        ({"qx": 0.0, "qy": 0.0, "qz": 0.0, "qw": 1.0}, {"r": 0.3 * np.cos(T)}),
    ],
)
def test_other_dead_columns_lose_as_well(tmp_path, dead, moving):
    trial = read(tmp_path, {"t": T} | {k: v + 0.0 * T for k, v in dead.items()} | moving)
    assert set(trial.channels) == set(moving)


def test_a_biased_gyroscope_does_not_kill_a_heading_that_rests(tmp_path):
    """A compass of whole degrees at rest, beside rates with a bias of 0.02 rad/s and noise, is kept."""
    rate = 0.02 + 0.005 * np.random.default_rng(0).normal(size=N)
    assert set(read(tmp_path, {"t": T, "yaw": 0.5 + 0.0 * T, "r": rate}).channels) == {"yaw", "r"}


def test_a_dead_pressure_loses_to_a_depth_that_moves(tmp_path):
    columns = {"t": T, "depth": 1.0 + 0.5 * np.sin(T), "p": 101325.0 + 0.0 * T}
    trial = read(tmp_path, columns, "time: t\ncolumns: {depth: depth, pressure: p}")
    np.testing.assert_allclose(trial.channels["depth"], columns["depth"])
    assert "never_changes" in codes(trial)


def test_an_empty_optional_column_is_left_out_with_a_note(tmp_path):
    """Ground stations write such columns for data that the vehicle does not send."""
    trial = read(tmp_path, {"t": T, "u": T, "V": ["--.--"] * N}, "time: t\ncolumns: {u: u, voltage: V}")
    assert set(trial.channels) == {"u"}
    assert "voltage contains no finite number and is left out" in [str(item) for item in trial.findings]


def test_an_import_ends_with_what_it_did_not_read(tmp_path):
    trial = read(tmp_path, {"t": T, "u": T, "lights": T, "mode": ["MANUAL"] * N})
    assert str(trial.findings[-1]) == "log.csv: not read: columns lights, mode"


@pytest.mark.parametrize(
    "content",
    [
        "t;u\r\n0,0;0,5\r\n0,1;0,25\r\n".encode("utf-16"),
        b"\xff\xfe" + "t\tu\n0\t0.5\n0.1\t0.25\n".encode("utf-16-le"),
        "t,u\n0,0.5\n0.1,0.25\n".encode("utf-16-le"),
        b"sep=;\r\nt;u\r\n0,0;0,5\r\n0,1;0,25\r\n",
        b"\xef\xbb\xbfsep=,\nt,u\n0,0.5\n0.1,0.25\n",
        b't,u\n0,"0,5"\n"0,1","0,25"\n',
        b"t\tu\n0\t0,5\n0,1\t0,25\n",
        b"t;u\n2026-05-04 10:00:00,5;0,5\n2026-05-04 10:00:00,6;0,25\n",
        "t;u;T [\u20ac\u00b0]\n0;0,5;1\n0,1;0,25;2\n".encode("cp1252"),
    ],
)
def test_texts_of_spreadsheets_are_read(tmp_path, content):
    """UTF-16 with and without a byte order mark, a separator line, code page 1252 and decimal commas are
    read."""
    (tmp_path / "log.csv").write_bytes(content)
    (trial,) = read_trials([Path(tmp_path / "log.csv")])
    np.testing.assert_array_equal(trial.channels["u"], [0.5, 0.25])
    np.testing.assert_allclose(trial.t, [0.0, 0.1], atol=1e-6)
