"""Trials on disk: round trips, reported repairs, and refusals with their location."""

import math
import time
from pathlib import Path

import numpy as np
import pytest

from finssim.core.files import OutputError
from finssim.trials.findings import CalibrationError
from finssim.trials.trial import Header, Trial
from finssim.trials.trial_files import load_trial, load_trials, write_trial

COLUMNS = ("tau_x", "tau_n", "u", "v", "w", "p", "q", "r", "ax", "ay", "az", "x", "y", "z")


def a_trial(seed=0, n=50, **changes):
    """Return random numbers in many columns, one of them at a fifth of the rate, with unit quaternions."""
    rng = np.random.default_rng(seed)
    q = np.array([0.0, 0.0, 0.0, 1.0]) + 0.2 * rng.normal(size=(n, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    channels = {name: rng.normal(size=n) * 10.0 ** rng.integers(-9, 9) for name in COLUMNS}
    channels |= {f"q{c}": q[:, i] for i, c in enumerate("xyzw")}
    channels["depth"] = np.where(np.arange(n) % 5 == 0, rng.normal(size=n), np.nan)
    values = {
        "name": "made",
        "t": np.arange(n) * 0.02 + 0.3,
        "channels": channels,
        "phase": np.array(["baseline"] * 10 + ["excitation"] * (n - 15) + [""] * 5),
    }
    return Trial(**(values | changes))


def csv(folder: Path, text: str, header: str | None = None) -> Path:
    """Write a trial folder with this table and header."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "data.csv").write_bytes(text.encode())
    if header is not None:
        (folder / "trial.yaml").write_text(header)
    return folder


def rows(n=20, step=0.1, start=0.0):
    """Return lines of t and u = sin t."""
    t = start + step * np.arange(n)
    return "".join(f"{x!r},{math.sin(x)!r}\n" for x in t.tolist())


# -- round trip ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("format", ["csv", "parquet"])
@pytest.mark.parametrize("seed", range(3))
def test_a_written_trial_reads_back_bit_for_bit(tmp_path, format, seed):
    """Numbers, gaps, phases, header and hash are identical."""
    header = Header(
        vehicle="finsrov",
        velocity_at=(0.1, 0.0, 1e-5),
        voltage=15.5,
        water={"density": 1e3},
        description="a: b",
    )
    trial = a_trial(seed, header=header)
    write_trial(trial, tmp_path / "made", format=format)
    back = load_trial(tmp_path / "made")
    assert back.sha256 == trial.sha256
    assert back.header == trial.header and back.name == "made" and back.findings == ()
    np.testing.assert_array_equal(back.t, trial.t)
    np.testing.assert_array_equal(back.phase, trial.phase)
    for name, values in trial.channels.items():
        np.testing.assert_array_equal(back.channels[name], values)


def test_the_hash_is_of_the_meaning_not_of_the_place(tmp_path):
    """Name, folder, format and role do not affect the hash; a number, a phase or the meaning of a number do."""
    trial = a_trial()
    write_trial(trial, tmp_path / "a", format="csv")
    write_trial(a_trial(header=Header(role="held-out", description="x")), tmp_path / "b", format="parquet")
    assert load_trial(tmp_path / "a").sha256 == load_trial(tmp_path / "b").sha256
    other = dict(trial.channels) | {"u": np.nextafter(trial.channels["u"], np.inf)}
    assert a_trial(channels=other).sha256 != trial.sha256
    assert a_trial(header=Header(velocity_at=(0.1, 0.0, 0.0))).sha256 != trial.sha256
    assert a_trial(phase=None).sha256 != trial.sha256


def test_an_earlier_trial_is_replaced_and_other_files_are_not(tmp_path):
    """Writing again replaces our own output as a whole; a folder with other files in it is refused."""
    write_trial(a_trial(0), tmp_path / "made", format="parquet")
    write_trial(a_trial(1), tmp_path / "made")
    assert sorted(file.name for file in (tmp_path / "made").iterdir()) == ["data.csv", "trial.yaml"]
    (tmp_path / "made" / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"notes\.txt"):
        write_trial(a_trial(2), tmp_path / "made")
    assert load_trial(tmp_path / "made").sha256 == a_trial(1).sha256


@pytest.mark.slow
def test_thirty_two_trials_load_in_less_than_a_second(tmp_path):
    """Each has 15 s at 50 Hz and 20 columns, as in the calibration of a vehicle."""
    for seed in range(32):
        write_trial(a_trial(seed, n=750), tmp_path / f"trial{seed}")
    best = np.inf
    for _ in range(3):
        start = time.process_time()
        assert len(load_trials([tmp_path])) == 32
        best = min(best, time.process_time() - start)
    assert best < 1.0


# -- several ------------------------------------------------------------------------------------------------------


def test_a_folder_of_trials_is_read_in_natural_order(tmp_path):
    """Trial 2 comes before trial 10, tables without a folder count, and names are unique."""
    for i in (10, 2, 1):
        csv(tmp_path / f"run{i}", "t,u\n" + rows(20 + i))
    (tmp_path / "bare.csv").write_text("t,u\n" + rows(50))
    assert [trial.name for trial in load_trials([tmp_path])] == ["bare", "run1", "run2", "run10"]
    csv(tmp_path / "b" / "run1", "t,u\n" + rows(7))
    names = [t.name for t in load_trials([tmp_path / "run1", tmp_path / "b" / "run1"])]
    assert len(set(names)) == 2 and "b/run1" in names


def test_the_same_trial_twice_is_refused(tmp_path):
    """Otherwise equal numbers would count as two measurements."""
    csv(tmp_path / "a", "t,u\n" + rows())
    csv(tmp_path / "b", "t,u\n" + rows(), "description: a copy")
    with pytest.raises(CalibrationError, match=r"b: contains the same numbers as .*a: .* omit one of them"):
        load_trials([tmp_path])


# -- repairs ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cut", range(1, 40))
def test_a_cut_off_file_opens_up_to_the_cut(tmp_path, cut):
    """However many bytes are missing, only logged numbers appear."""
    text = "t,u,w\n" + "".join(f"{i / 10!r},{math.sin(i)!r},{math.cos(i) * 1e-5!r}\n" for i in range(20))
    trial = load_trial(csv(tmp_path / "cut", text[:-cut]))
    i = np.rint(trial.t * 10.0)
    assert 18 <= len(i) <= 20
    for name, truth in (("u", [math.sin(x) for x in i]), ("w", [math.cos(x) * 1e-5 for x in i])):
        good = np.isfinite(trial.channels[name])
        assert good.sum() >= 18
        np.testing.assert_array_equal(trial.channels[name][good], np.array(truth)[good])
    assert trial.findings or text[-cut - 1] == ","  # an empty last cell looks complete


def test_zero_bytes_after_a_crash_are_the_end(tmp_path):
    """A file system leaves zeros in preallocated space."""
    trial = load_trial(csv(tmp_path / "cut", "t,u\n" + rows() + "\0" * 300))
    assert len(trial.t) == 20 and trial.findings[0].code == "zero_bytes"


def test_late_rows_are_sorted_and_repeated_times_merged(tmp_path):
    """Slightly late rows are sorted; rows of one time complete each other."""
    text = "t,u,w\n0,1,\n0.1,2,\n0.3,4,\n0.2,3,\n0.3,,7\n0.4,5,8\n"
    trial = load_trial(csv(tmp_path / "late", text))
    np.testing.assert_array_equal(trial.t, [0.0, 0.1, 0.2, 0.3, 0.4])
    np.testing.assert_array_equal(trial.channels["u"], [1, 2, 3, 4, 5])
    np.testing.assert_array_equal(trial.channels["w"], [np.nan, np.nan, np.nan, 7, 8])
    assert len(trial.findings) == 2


def test_the_newest_row_may_be_first(tmp_path):
    """A log in reverse order is the same trial; a shuffled one is refused, because the cause is unknown."""
    lines = rows(60).splitlines()
    straight = load_trial(csv(tmp_path / "a", "\n".join(["t,u", *lines, ""])))
    again = load_trial(csv(tmp_path / "b", "\n".join(["t,u", *lines[::-1], ""])))
    assert again.sha256 == straight.sha256 and again.findings[0].code == "times_sorted"
    mixed = np.random.default_rng(0).permutation(lines)
    with pytest.raises(CalibrationError, match="the time steps back at 28 of 60 rows"):
        load_trial(csv(tmp_path / "c", "\n".join(["t,u", *mixed, ""])))


def test_a_clock_that_jumps_back_leaves_a_gap_between_two_pieces(tmp_path):
    """Rows after the jump are not sorted between earlier ones, which would mix two moments."""
    text = "t,u\n" + rows(50) + "".join(f"{2.0 + 0.1 * i!r},{100 + i}\n" for i in range(40))
    trial = load_trial(csv(tmp_path / "jump", text))
    np.testing.assert_array_equal(trial.channels["u"][50:], 100.0 + np.arange(40))
    assert trial.t[50] - trial.t[49] == pytest.approx(10.0)
    np.testing.assert_allclose(np.diff(trial.t[50:]), 0.1)
    jump = trial.findings[0]
    assert (jump.code, jump.severity, jump.values["row"]) == ("clock_jump", "care", 51)
    assert (jump.values["before"], jump.values["after"]) == pytest.approx((4.9, 2.0))


def test_blocks_of_different_columns_over_the_same_times_are_no_jump(tmp_path):
    """Streams written one after another into one table overlap in time, and fill different columns."""
    text = "t,u,w\n" + "".join(f"{0.1 * i},{i},\n" for i in range(30))
    text += "".join(f"{0.1 * i},,{-i}\n" for i in range(30))
    trial = load_trial(csv(tmp_path / "blocks", text))
    assert len(trial.t) == 30
    np.testing.assert_array_equal(trial.channels["u"], -trial.channels["w"])


def test_times_since_1970_begin_at_zero(tmp_path):
    """Seconds and dates give the same times."""
    t = 1.7e9 + np.arange(10) * 0.25
    stamps = {
        "seconds": "".join(f"{x!r},1\n" for x in t.tolist()),
        "dates": "".join(f"{np.datetime64(round(x * 1000), 'ms')}Z,1\n" for x in t),
    }
    for name, text in stamps.items():
        trial = load_trial(csv(tmp_path / name, "t,u\n" + text))
        np.testing.assert_allclose(trial.t, np.arange(10) * 0.25, atol=1e-6)
        assert {"epoch", "dates"} & {one.code for one in trial.findings}


def test_what_is_no_number_counts_as_empty_and_is_told(tmp_path):
    """Empty cells and words for missing values are silent; text and infinities are reported with their row."""
    text = "t,u,w\n0,1,2\n0.1,,nan\n0.2,NaN,null\n0.3,inf,ERR\n0.4,5,6\n"
    trial = load_trial(csv(tmp_path / "dirty", text))
    for name in "uw":
        assert np.isfinite(trial.channels[name]).tolist() == [True, False, False, False, True]
    assert any((one.values.get("cell"), one.values.get("row")) == ("ERR", 4) for one in trial.findings)
    assert "infinite_numbers" in {one.code for one in trial.findings}
    assert len(trial.findings) == 2


@pytest.mark.parametrize("separator", [";", "\t"])
def test_other_separators_and_decimal_commas_are_read(tmp_path, separator):
    """Spreadsheets in many European countries use them."""
    text = "\ufeff# exported\nt,u\n".replace(",", separator) + f"0,0{separator}1,5\n0,1{separator}2,5\n"
    trial = load_trial(csv(tmp_path / "comma", text))
    np.testing.assert_array_equal(trial.t, [0.0, 0.1])
    np.testing.assert_array_equal(trial.channels["u"], [1.5, 2.5])


def test_unknown_columns_and_phases_are_left_out_with_a_guess(tmp_path):
    """A foreign column is ignored; a misspelt one gets a hint."""
    trial = load_trial(csv(tmp_path / "x", "t,u,depht,phase\n0,1,2,excite\n1,2,3,Coast\n"))
    assert set(trial.channels) == {"u"} and trial.phase.tolist() == ["", "coast"]
    hints = {
        one.values.get("column", one.values.get("word")): one.values["hint"]
        for one in trial.findings
        if "hint" in one.values
    }
    assert hints.get("depht") == ", did you mean 'depth'?"
    assert hints.get("excite") == ", did you mean 'excitation'?"


def test_quaternions_get_unit_length_and_one_sign(tmp_path):
    """q and -q are the same attitude; zeros are not an attitude."""
    text = "t,qx,qy,qz,qw\n0,0,0,0.2,2\n1,0,0,-0.1,-1\n2,0,0,0,0\n3,0,0,-0.1,-1\n"
    trial = load_trial(csv(tmp_path / "q", text))
    q = np.stack([trial.channels[f"q{c}"] for c in "xyzw"], axis=-1)
    good = [0, 1, 3]
    np.testing.assert_allclose(np.linalg.norm(q[good], axis=1), 1.0)
    np.testing.assert_allclose(q[good], q[[0, 0, 0]])
    assert np.isnan(q[2]).all() and trial.findings[0].code == "quaternion_lengths"


# -- refusals -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("time_s,u\n0,1\n1,2\n", "no column 't' .*'time: time_s'"),
        ("t,u\n0,1\n", "1 rows with a time, expected at least 2"),
        ("t,u\n1,1\n1,2\n", "all rows have the time 1 s"),
        ("t,foo\n0,1\n1,2\n", "no usable column besides t"),
        ("t,u\n0,\n1,\n", "no usable column besides t"),
        ("0,1\n1,2\n", "begins with numbers"),
        ("t,u,u\n0,1,2\n1,2,3\n", "column 'u' occurs twice"),
        (
            "t,u\n0,1\n20,2\n40,3\n",
            "t has a row every 20 s, expected one every 2 s .* in ms, import it with a map",
        ),
        ("", "no line of column names"),
        ("t,u\n" + "1,2,3,4\n" * 10, "do not have 2 cells"),
    ],
)
def test_a_table_that_is_no_trial_is_refused_with_the_reason(tmp_path, text, said):
    """The refusal is one sentence that names the file and what was expected."""
    with pytest.raises(CalibrationError, match=said) as error:
        load_trial(csv(tmp_path / "bad", text))
    assert "data.csv" in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ("velocty_at: [0, 0, 0]", "unknown key 'velocty_at', did you mean 'velocity_at'"),
        ("velocity_at: [0, 0]", r"velocity_at is \[0, 0\], expected 3 numbers \[x, y, z\]"),
        ("wrench_at: centre", "wrench_at is 'centre', expected 3 numbers .* center_of_gravity or origin"),
        ("water: {density: -3}", "water: density is -3, expected > 0"),
        ("role: test", "role is 'test', expected 'fit' or 'held-out'"),
        ("axis: [surge, jaw]", "axis: 1 is 'jaw', expected 'surge', 'sway'"),
        ("voltage: .nan", "voltage is nan, expected"),
        ("- a list", "expected keys such as"),
    ],
)
def test_a_header_that_is_wrong_is_refused_with_the_reason(tmp_path, header, said):
    """The message names trial.yaml, the key, the value and what was expected."""
    with pytest.raises(CalibrationError, match=said) as error:
        load_trial(csv(tmp_path / "bad", "t,u,w\n0,1,1\n1,2,2\n", header))
    assert "trial.yaml" in str(error.value) and "\n" not in str(error.value)


def test_places_without_a_trial_are_refused(tmp_path):
    """A missing or empty folder, two tables, and files of other kinds are refused."""
    for path, said in [
        (tmp_path / "none", "no such file"),
        (tmp_path, "contains no trial|neither"),
    ]:
        with pytest.raises(CalibrationError, match=said):
            load_trials([path])
    write_trial(a_trial(), tmp_path / "two")
    (tmp_path / "two" / "data.parquet").write_bytes(b"PAR1")
    with pytest.raises(CalibrationError, match="both"):
        load_trial(tmp_path / "two")
    (tmp_path / "log.bin").write_bytes(b"x")
    with pytest.raises(CalibrationError, match="finssim trials import"):
        load_trial(tmp_path / "log.bin")
    (tmp_path / "cut.parquet").write_bytes(b"PAR1 and then nothing")
    with pytest.raises(CalibrationError, match="not a complete Parquet file"):
        load_trial(tmp_path / "cut.parquet")


def test_the_header_on_the_page_is_read(tmp_path):
    """The example on the page of the trial format is read with a matching log."""
    page = (Path(__file__).resolve().parents[2] / "docs" / "reference" / "trial_format.md").read_text("utf-8")
    example = page.split("```yaml\n")[1].split("```")[0]
    trial = load_trial(csv(tmp_path / "x", "t,u,v\n0,1,2\n1,1,2\n", example))
    assert trial.header.role == "fit" and trial.header.axis == ("surge",)
    assert trial.header.velocity_at == (0.12, 0.0, -0.08) and trial.header.water.density == 998.0


def test_any_damage_gives_a_trial_or_one_sentence(tmp_path):
    """With bytes flipped, cut and doubled at random, times increase and numbers are finite or empty."""
    rng = np.random.default_rng(0)
    names = [
        "t",
        *rng.permutation([*COLUMNS, "roll", "qx", "qy", "qz", "qw", "depth", "phase", "foo"])[:9].tolist(),
    ]
    lines = [",".join(names)]
    for i in range(60):
        cells = [repr(0.05 * i), *(repr(float(x)) for x in rng.normal(size=9))]
        lines.append(
            ",".join(cell if rng.random() > 0.1 else rng.choice(["", "nan", "inf", "x"]) for cell in cells)
        )
    whole = "\n".join(lines).encode() + b"\n"
    read = 0
    for k in range(150):
        damaged = np.frombuffer(whole, np.uint8).copy()
        damaged[rng.integers(0, len(whole), k % 8)] = rng.integers(0, 256, k % 8)
        a, b = sorted(rng.integers(0, len(whole), 2))
        text = damaged.tobytes()[: b if k % 3 else None] + (whole[a:b] if k % 5 == 0 else b"")
        folder = csv(tmp_path / "damaged", "")
        (folder / "data.csv").write_bytes(text)
        try:
            trial = load_trial(folder)
        except CalibrationError as error:
            assert str(error).startswith(str(folder)) and "\n" not in str(error)
        else:
            read += 1
            assert np.all(np.diff(trial.t) > 0.0)
            assert not any(np.isinf(values).any() for values in trial.channels.values())
    assert read > 75
