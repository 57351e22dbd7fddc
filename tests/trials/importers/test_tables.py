"""Tables with a map become trials: units, frames, time, several files, splitting and refusals."""

import re
from pathlib import Path

import numpy as np
import pytest

from finssim.core.files import OutputError
from finssim.trials.findings import CalibrationError
from finssim.trials.importers import import_trials
from finssim.trials.importers.column_map import read_map
from finssim.trials.importers.dispatch import read_trials
from finssim.trials.trial_files import load_trial

HINSDALE = Path(__file__).parents[2] / "data" / "hinsdale"
DOCS = Path(__file__).parents[3] / "docs"


def shipped_map(name):
    """Return the map file that one of the two pages on trials prints under this name."""
    pages = [(DOCS / page).read_text(encoding="utf-8") for page in ("trials.md", "reference/trial_format.md")]
    block = "\n".join(pages).split(f"# {name}\n", 1)[1]
    return block.split("```", 1)[0]


@pytest.fixture
def folder(tmp_path):
    """Function that writes files by name and text into one folder, and returns their paths."""

    def write(**files):
        paths = []
        for name, text in files.items():
            path = tmp_path / name.replace("__", ".")
            path.write_text(text, encoding="utf-8")
            paths.append(path)
        return paths

    return write


def table(columns, n=50, rate=10.0, time="t", start=0.0):
    """Return CSV text of columns given as functions of time."""
    t = start + np.arange(n) / rate
    rows = [",".join([time, *columns])]
    rows += [",".join(f"{f(x):.15g}" for f in [lambda x: x, *columns.values()]) for x in t]
    return "\n".join(rows) + "\n"


def one(paths, map_text, tmp_path, **options):
    """Return the only trial of some files under a map."""
    map_file = tmp_path / "map.yaml"
    map_file.write_text(map_text, encoding="utf-8")
    trials = read_trials(paths, column_map=map_file, **options)
    assert len(trials) == 1
    return trials[0]


def test_the_shipped_map_reads_the_recordings_of_a_drifting_vehicle(tmp_path):
    """Motion capture and IMU of the Hinsdale wave laboratory give one trial per pair of files, with gravity
    up in both."""
    map_file = tmp_path / "hinsdale.yaml"
    map_file.write_text(shipped_map("hinsdale.yaml"), encoding="utf-8")
    folders = import_trials(sorted(HINSDALE.glob("*.csv")), out=tmp_path / "trials", column_map=map_file)
    assert [folder.name for folder in folders] == ["baseline2", "traj005-1", "traj026-0", "traj_alt_009-0"]
    for folder in folders:
        trial = load_trial(folder)
        assert trial.header.passive and trial.header.vehicle == "bluerov2_heavy"
        assert trial.has("x", "y", "z", "qx", "qy", "qz", "qw", "p", "q", "r", "ax", "ay", "az")
        # A stationary accelerometer measures 9.81 upwards; its rates are those of a hanging body.
        assert np.median(trial.series("az")[1]) == pytest.approx(9.75, abs=0.1)
        assert np.abs(trial.series("p")[1]).max() < 0.6
    # Rows of the mocap and of the IMU remain separate: 20 Hz among about 100 Hz.
    assert len(trial.series("p")[0]) == 543 and len(trial.series("x")[0]) == 2764


def test_what_is_written_reads_back_with_the_same_numbers(folder, tmp_path):
    """The folder contains the trial that was read."""
    paths = folder(log__csv=table({"u": np.sin, "tau_x": np.cos}, rate=7.0))
    (trial,) = read_trials(paths)
    (written,) = import_trials(paths, out=tmp_path / "out", vehicle="finsrov")
    assert load_trial(written).sha256 == trial.sha256
    assert load_trial(written).header.vehicle == "finsrov"


def test_scale_offset_sign_and_unit_go_together_in_that_order(folder, tmp_path):
    """sign (scale x + offset) in the unit: 3 becomes -(2 * 3 + 4) degrees."""
    paths = folder(log__csv=table({"a": lambda x: 3.0}))
    trial = one(
        paths,
        "time: t\ncolumns: {roll: {column: a, scale: 2, offset: 4, sign: -1, unit: deg}, voltage: 15.5}",
        tmp_path,
    )
    np.testing.assert_allclose(trial.channels["roll"], np.radians(-10.0))
    np.testing.assert_allclose(trial.channels["voltage"], 15.5)


@pytest.mark.parametrize("unit, per_second", [("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_time_units_and_unix_times_start_at_zero(folder, tmp_path, unit, per_second):
    """A clock in any unit since 1970 gives seconds from the first sample, to a microsecond."""
    rows = "\n".join(
        f"{int((1_700_000_000 + 0.02 * i) * per_second * 1000) / 1000:.0f},{i}" for i in range(0, 500, 50)
    )
    trial = one(
        folder(log__csv=f"stamp,v\n{rows}\n"),
        f"time: {{column: stamp, unit: {unit}}}\ncolumns: {{u: v}}",
        tmp_path,
    )
    np.testing.assert_allclose(trial.t, np.arange(10.0), atol=2e-6)
    assert any(one.code == "clock_origin" and one.values["start"] >= 1.7e9 for one in trial.findings)


def test_written_dates_are_times(folder, tmp_path):
    """ISO dates with fractions are read."""
    paths = folder(
        log__csv="when,v\n2026-05-31T12:00:00.250Z,1\n2026-05-31T12:00:00.500Z,2\n2026-05-31T12:00:01Z,3\n"
    )
    np.testing.assert_allclose(
        one(paths, "time: {column: when, unit: date}\ncolumns: {u: v}", tmp_path).t, [0, 0.25, 0.75]
    )


def test_semicolons_decimal_commas_blanks_and_missing_names(folder, tmp_path):
    """Spreadsheets, numerical programs and loggers without a heading write such tables."""
    semicolons, blanks, bare = folder(
        a__csv="t;v\n0,0;1,5\n0,1;2,5\n",
        b__txt="  t   v\n  0.0 1.5\n  0.1 2.5\n",
        c__csv="0.0,1.5\n0.1,2.5\n",
    )
    for path, extra in ((semicolons, ""), (blanks, "spaces: true\n"), (bare, "names: [t, v]\n")):
        trial = one([path], f"time: t\n{extra}columns: {{u: v}}", tmp_path)
        np.testing.assert_allclose(trial.channels["u"], [1.5, 2.5])


def test_nose_up_right_turn_and_dive_in_forward_right_down_axes(folder, tmp_path):
    """Pitching up, turning right, diving and moving right have the opposite sign in FinsSim's axes."""
    events = {"pitch": 0.1, "yawrate": 0.2, "down": 2.0, "sway": 0.3, "fz": 5.0, "accz": -9.81, "m": 0.4}
    paths = folder(log__csv=table({name: lambda x, v=value: v for name, value in events.items()}))
    trial = one(
        paths,
        "time: t\nframe: FRD\ncolumns: {pitch: pitch, r: yawrate, z: down, v: sway, tau_z: fz, az: accz, tau_m: m}",
        tmp_path,
    )
    expected = {"pitch": -0.1, "r": -0.2, "z": -2.0, "v": -0.3, "tau_z": -5.0, "az": 9.81, "tau_m": -0.4}
    assert {name: pytest.approx(values[0]) for name, values in trial.channels.items()} == expected


def test_world_velocity_becomes_body_velocity(folder, tmp_path):
    """Moving north while heading west is moving to the right: v < 0 in axes with y to the left."""
    paths = folder(
        pose__csv=table(
            {"yaw": lambda x: 90.0, "pitch": lambda x: 0.0, "roll": lambda x: 0.0}, rate=20.0, n=100
        ),
        speed__csv=table(
            {"east": lambda x: 0.5, "north": lambda x: 0.0, "up": lambda x: 0.1}, rate=3.0, n=14, start=0.1
        ),
    )
    trial = one(
        paths,
        """
files:
  pose.csv: {time: t, columns: {roll: roll, pitch: pitch, yaw: {column: yaw, unit: deg}}}
  speed.csv: {time: t, columns: {vx: east, vy: north, vz: up}}
""",
        tmp_path,
    )
    for column, expected in (("u", 0.0), ("v", -0.5), ("w", 0.1)):
        np.testing.assert_allclose(trial.series(column)[1], expected, atol=1e-9)


def test_pressure_becomes_depth(folder, tmp_path):
    """One metre of sea water of 1025 kg/m3 gives 1025 * 9.80665 Pa."""
    paths = folder(log__csv=table({"p": lambda x: 1013.25 + 1025 * 9.80665 / 100}))
    text = "time: t\ncolumns: {pressure: {column: p, unit: hPa}}\nsurface_pressure: 101325\nwater: {density: 1025}"
    np.testing.assert_allclose(one(paths, text, tmp_path).channels["depth"], 1.0, rtol=1e-6)


def test_streams_of_other_rates_stay_unsynchronised(folder, tmp_path):
    """Times are the union, with NaN where a stream has no sample, and one stream's clock is shifted."""
    fast, slow = table({"u": np.sin}, rate=50.0, n=200), table({"tau_x": np.cos}, rate=7.0, n=28)
    trial = one(
        folder(fast__csv=fast, slow__csv=slow),
        "files:\n  fast.csv: {time: t, columns: {u: u}}\n"
        "  slow.csv: {time: t, time_offset: 0.003, columns: {tau_x: tau_x}}",
        tmp_path,
    )
    assert len(trial.series("u")[0]) == 200 and len(trial.series("tau_x")[0]) == 28
    np.testing.assert_allclose(trial.series("tau_x")[0], np.arange(28) / 7.0 + 0.003, atol=1e-6)


def test_a_cut_table_opens_up_to_the_cut(folder, tmp_path):
    """The last line ends within a number, which is discarded."""
    whole = table({"u": lambda x: 10.0 + x})
    (trial,) = read_trials(folder(log__csv=whole[: len(whole) - 4]))
    values = trial.series("u")[1]
    assert 48 <= len(values) <= 49 and values.min() >= 10.0
    assert trial.findings


PHASES = ["baseline"] * 10 + ["hold"] * 20 + ["off"] * 10


def phased(repeats):
    rows = [f"{0.1 * i:.1f},{i},{word}" for i, word in enumerate(PHASES * repeats)]
    return "t,u,state\n" + "\n".join(rows) + "\n"


def test_splitting_by_phases_gives_one_trial_per_baseline(folder, tmp_path):
    """The log's words are translated, and every part starts at 0."""
    words = "{baseline: baseline, hold: excitation, off: coast}"
    text = f"time: t\nphase: {{column: state, words: {words}}}\ncolumns: {{u: u}}\nsplit: phase"
    map_file = tmp_path / "map.yaml"
    map_file.write_text(text)
    trials = read_trials(folder(log__csv=phased(3)), column_map=map_file)
    assert [trial.name for trial in trials] == ["log_1", "log_2", "log_3"]
    for trial in trials:
        assert trial.t[0] == 0.0 and len(trial.t) == 40
        assert list(trial.phase) == ["baseline"] * 10 + ["excitation"] * 20 + ["coast"] * 10


@pytest.mark.parametrize(
    "split, names, rows",
    [
        ("{gaps: 2.0}", ["log_1", "log_2"], [30, 20]),
        ("{windows: {first: [0.0, 1.0], last: [8.0, 9.0]}}", ["first", "last"], [11, 11]),
        ("column", ["log_1", "log_2"], [30, 20]),
    ],
)
def test_splitting_by_gaps_windows_and_a_column(folder, tmp_path, split, names, rows):
    """The splits are a pause of 5 s, two windows, and a column that numbers the runs."""
    times = np.concatenate([np.arange(30) * 0.1, 8.0 + np.arange(20) * 0.1])
    text = "t,u,run\n" + "\n".join(f"{t:.1f},1,{int(t > 5)}" for t in times) + "\n"
    map_file = tmp_path / "map.yaml"
    map_file.write_text(f"files: {{log.csv: {{time: t, columns: {{u: u}}, split: run}}}}\nsplit: {split}")
    trials = read_trials(folder(log__csv=text), column_map=map_file)
    assert [trial.name for trial in trials] == names and [len(trial.t) for trial in trials] == rows


def test_roles_of_single_trials(folder, tmp_path):
    """The map assigns some trials to the held-out role."""
    text = "files:\n  '{trial}.csv': {time: t, columns: {u: u}}\nrole: fit\ntrials: {b: {role: held-out}}"
    map_file = tmp_path / "map.yaml"
    map_file.write_text(text)
    trials = read_trials(
        folder(a__csv=table({"u": np.sin}), b__csv=table({"u": np.cos})), column_map=map_file
    )
    assert {trial.name: trial.header.role for trial in trials} == {"a": "fit", "b": "held-out"}


@pytest.mark.parametrize(
    "text, sentence",
    [
        (
            "time: t\ncolumns: {u: vel_y}",
            "no column 'vel_y', did you mean 'vel_x'? its columns are t, vel_x, name",
        ),
        ("time: t\ncolumns: {u: name}", "column 'name' contains no numbers, for instance 'x'"),
        ("time: when\ncolumns: {u: vel_x}", "no column 'when'"),
        ("columns: {u: vel_x}", "no time: give 'time: COLUMN'"),
        ("time: t\ncolums: {u: vel_x}", "unknown key 'colums', did you mean 'columns'?"),
        ("time: t\ncolumns: {surge: vel_x}", "names 'surge'"),
        (
            "time: t\ncolumns: {u: {column: vel_x, unit: rad}}",
            "unit of u is 'rad', an angle, expected one of m/s",
        ),
        ("time: t\ncolumns: {u: {column: vel_x, unit: knots}}", "unit of u is 'knots'"),
        ("time: {column: t, unit: sec}\ncolumns: {u: vel_x}", "unit"),
        ("time: t\ncolumns: {u: vel_x}\nrole: test", "role"),
        ("time: t\ncolumns: {u: vel_x}\nframe: ENU", "frame"),
        (
            "files: {other.csv: {time: t, columns: {u: vel_x}}}",
            "log.csv fits none of the files of the map: other.csv",
        ),
        ("time: t\ncolumns: {vx: vel_x, vy: vel_x, vz: vel_x}", "without an attitude"),
        (
            "time: t\ncolumns: {u: vel_x}\nvehicle: bluerov",
            "unknown vehicle 'bluerov', did you mean 'bluerov2'?",
        ),
        ("time: t\ncolumns: 3", "columns is 3, expected {CANONICAL: COLUMN}"),
        ("time: t\ncolumns: {u: vel_x}\nsplit: phase", "cannot be split by phase"),
        ("time: t\ncolumns: {u: vel_x}\nsplit: {windows: {a: [3, 2]}}", "window a"),
    ],
)
def test_one_sentence_says_what_is_wrong(folder, tmp_path, text, sentence):
    """Wrong columns, units and keys are named with their location and the valid ones."""
    paths = folder(log__csv="t,vel_x,name\n" + "".join(f"{0.1 * i},{i},x\n" for i in range(30)))
    with pytest.raises(ValueError) as refused:
        one(paths, text, tmp_path)
    assert sentence in str(refused.value) and "\n" not in str(refused.value)


def test_the_refusal_of_a_table_contains_a_draft_of_its_map(folder, tmp_path):
    """The draft takes time, units and quantities from the columns' names; with axes filled in, it reads the table."""
    rows = "".join(f"{20 * i},{0.01 * i},{i},0.5,9.8,{-i},a\n" for i in range(50))
    names = "time_ms,gyro_x,heading_deg,Depth [cm],accel z (m/s2),rate_s,note"
    paths = folder(log__csv=f"{names}\n{rows}")
    with pytest.raises(CalibrationError, match="no time; its columns are time_ms, gyro_x") as refused:
        read_trials(paths)
    draft = re.search("'(files: .*)', replace the words in capitals", str(refused.value))[1]
    with pytest.raises(CalibrationError, match="FLU_OR_FRD', expected FLU, FRD"):
        one(paths, draft, tmp_path)
    trial = one(paths, draft.replace("FLU_OR_FRD", "FLU"), tmp_path)
    i = np.arange(50.0)
    np.testing.assert_allclose(trial.t, 0.02 * i, atol=1e-12)
    assert set(trial.channels) == {"p", "yaw", "depth", "az"}
    for column, expected in {"p": 0.01 * i, "yaw": np.radians(i), "depth": 0.005, "az": 9.8}.items():
        np.testing.assert_allclose(trial.channels[column], expected, atol=1e-12)


@pytest.mark.parametrize(
    ("names", "draft"),
    [
        (
            "when,u,vel",
            'files: {"log.csv": {time: COLUMN, columns: {u: u}, frame: FLU_OR_FRD}}',
        ),
        (
            "Timestamp [us],rollRate,yaw_m,wz_dps,battery_voltage",
            'files: {"log.csv": {time: {column: "Timestamp [us]", unit: us}, columns: {p: rollRate, '
            "r: {column: wz_dps, unit: deg/s}, voltage: battery_voltage}, frame: FLU_OR_FRD}}",
        ),
        (
            "t_h,gx,p,heading_m",
            'files: {"log.csv": {time: {column: t_h, unit: h}, columns: {p: p}, frame: FLU_OR_FRD}}',
        ),
        ("t,a,b", 'files: {"log.csv": {time: t, columns: {u: COLUMN}, frame: FLU_OR_FRD}}'),
    ],
)
def test_a_draft_leaves_open_what_names_do_not_state(folder, names, draft):
    """Unknown names, and units of another dimension, are left to the user."""
    count = names.count(",") + 1
    paths = folder(log__csv=names + "\n" + "".join(",".join([f"{i}"] * count) + "\n" for i in range(9)))
    with pytest.raises(CalibrationError) as refused:
        read_trials(paths)
    assert f"'{draft}', replace" in str(refused.value)


def test_clocks_that_do_not_meet_are_refused(folder, tmp_path):
    """One file counts from 1970, the other from zero."""
    text = "files:\n  a.csv: {time: t, columns: {u: u}}\n  b.csv: {time: t, columns: {v: v}}"
    with pytest.raises(CalibrationError, match="do not overlap"):
        one(folder(a__csv=table({"u": np.sin}), b__csv=table({"v": np.sin}, start=1.7e9)), text, tmp_path)


def test_a_clock_that_was_set_back_leaves_a_gap_or_is_refused(folder, tmp_path):
    """In a single stream the rest follows after a gap; among several streams its place is ambiguous."""
    back = "t,u\n" + "".join(f"{0.1 * (i % 40):.1f},{i}\n" for i in range(80))
    (trial,) = read_trials(folder(a__csv=back))
    assert (
        len(trial.t) == 80
        and np.diff(trial.t).max() > 5.0
        and "clock_jump" in {one.code for one in trial.findings}
    )
    text = "files:\n  a.csv: {time: t, columns: {u: u}}\n  b.csv: {time: t, columns: {v: v}}"
    with pytest.raises(CalibrationError, match=r"a\.csv: the clock"):
        one(folder(a__csv=back, b__csv=table({"v": np.sin})), text, tmp_path)


def test_a_folder_with_other_files_is_not_overwritten(folder, tmp_path):
    """Files that a user keeps under the name of a trial are not touched."""
    paths = folder(log__csv=table({"u": np.sin}))
    (tmp_path / "out" / "log").mkdir(parents=True)
    (tmp_path / "out" / "log" / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="other files"):
        import_trials(paths, out=tmp_path / "out")
    assert (tmp_path / "out" / "log" / "notes.txt").read_text() == "mine"


def test_an_earlier_trial_of_the_same_name_is_replaced_with_a_notice(folder, tmp_path, capsys):
    """There is no notice if the data are equal: the same log may be imported again."""
    out = tmp_path / "out"
    for function, replaced in ((np.sin, False), (np.sin, False), (np.cos, True)):
        import_trials(folder(log__csv=table({"u": function})), out=out)
        assert ("log: replaced an earlier trial with other data" in capsys.readouterr().err) == replaced


@pytest.mark.parametrize(("factor", "reported"), [(1.0, False), (57.3, True)])
def test_angles_that_are_impossible_in_radians_are_reported_at_the_import(
    folder, tmp_path, capsys, factor, reported
):
    """A roll of 29 in a column without a unit can only be in degrees."""
    import_trials(folder(log__csv=table({"roll": lambda t: 0.5 * factor * np.sin(t)})), out=tmp_path / "out")
    assert ("log: roll reaches 28.6 rad: degrees?" in capsys.readouterr().err) == reported


def test_two_tables_of_one_name_are_refused(tmp_path):
    for place in ("a", "b"):
        (tmp_path / place).mkdir()
        (tmp_path / place / "dive.csv").write_text(table({"u": np.sin}))
    with pytest.raises(
        CalibrationError, match="b/dive.csv have the same name, 'dive', which names the trial"
    ):
        read_trials([tmp_path / "a" / "dive.csv", tmp_path / "b" / "dive.csv"])


@pytest.mark.parametrize("name", ["hinsdale.yaml", "full.yaml", "dive.yaml", "bag.yaml"])
def test_the_maps_of_the_page_are_maps(tmp_path, name):
    """Each printed map can be read."""
    (tmp_path / name).write_text(shipped_map(name), encoding="utf-8")
    read_map(tmp_path / name)


@pytest.mark.parametrize("name", ["../mine", "..", "/tmp/mine", "a\\\\b", "C:x", ""])
def test_a_window_of_a_map_names_a_folder_and_no_path(folder, tmp_path, name):
    """The trial would be written to that path."""
    map_file = tmp_path / "map.yaml"
    map_file.write_text(f'time: t\ncolumns: {{u: u}}\nsplit: {{windows: {{"{name}": [0, 3]}}}}')
    with pytest.raises(CalibrationError, match="^trial '.*expected the plain name of a file or folder"):
        import_trials(folder(log__csv=table({"u": np.sin})), column_map=map_file, out=tmp_path / "in" / "out")
    assert not (tmp_path / "in").exists() and not (tmp_path / "mine").exists()


def test_a_file_name_makes_no_trial_that_is_a_path(tmp_path):
    """By the pattern {trial}.csv, `...csv` would be the trial `..`."""
    (tmp_path / "...csv").write_text(table({"u": np.sin}))
    (tmp_path / "map.yaml").write_text("files: {'{trial}.csv': {time: t, columns: {u: u}}}")
    with pytest.raises(CalibrationError, match=r"^trial '\.\.' is a folder's link"):
        import_trials([tmp_path / "...csv"], column_map=tmp_path / "map.yaml", out=tmp_path / "in" / "out")
    assert not (tmp_path / "in").exists()
