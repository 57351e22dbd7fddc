"""Pictures come in order, with their times, and unreadable ones are named."""

import math

import cv2
import numpy as np
import pytest

from finssim.localization import LocalizationError
from finssim.localization.detection.pictures import pictures, read_picture, write_picture

RNG = np.random.default_rng(0)


def scene(level):
    """Return a smooth gray picture identified by its mean."""
    return np.clip(np.linspace(0, 40, 64)[None, :] + np.full((48, 1), float(level)), 0, 255).astype(np.uint8)


def listed(source, **options):
    """Return the contents of the stream as a list."""
    return list(pictures(source, **options))


def test_a_folder_comes_in_natural_order_without_other_files(tmp_path):
    """2 comes before 10; text files, hidden files and folders are skipped."""
    for number in (10, 2, 1):
        write_picture(scene(10 * number), tmp_path / f"view{number}.png")
    (tmp_path / "notes.txt").write_text("x")
    (tmp_path / ".view3.png").write_bytes(b"x")
    (tmp_path / "more").mkdir()
    got = listed(tmp_path)
    assert [name for _, name, _ in got] == ["view1.png", "view2.png", "view10.png"]
    assert all(math.isnan(time) for time, _, _ in got)
    for (_, _, image), number in zip(got, (1, 2, 10), strict=True):
        assert image.dtype == np.uint8 and np.array_equal(image, scene(10 * number))


@pytest.mark.parametrize(
    ("name", "time"),
    [
        ("12.5.png", 12.5),
        ("cam0_1700000000.250000.png", 1700000000.25),
        ("1403636579763555584.png", 1403636579.7635555),
        ("frame_1700000000123.png", 1700000000.123),
        ("1700000000.png", 1700000000.0),
        ("view_0007.png", math.nan),
        ("20261120_192200.png", math.nan),
        ("33369213973_9d9bb4cc96_c.png", math.nan),
    ],
)
def test_times_are_read_from_names_that_carry_one(tmp_path, name, time):
    """Seconds with a decimal point and counts since 1970 are times; running numbers and dates are not."""
    write_picture(scene(50), tmp_path / name)
    [(got, shown, _)] = listed(tmp_path / name)
    assert shown == name
    assert got == pytest.approx(time, abs=1e-6, rel=0.0, nan_ok=True)


def test_times_may_come_from_a_table(tmp_path):
    """Times are looked up by name; a picture missing from the table and an invalid time are refused before reading."""
    for number in (1, 2):
        write_picture(scene(50), tmp_path / f"{number}.png")
    table = tmp_path / "times.csv"
    table.write_text("image,time\n2.png,0.5\n1.png,0.25\n")
    assert [time for time, _, _ in listed(tmp_path, times=table)] == [0.25, 0.5]
    table.write_text("image,time\n2.png,0.5\n")
    with pytest.raises(LocalizationError, match=r"no time of 1\.png"):
        pictures(tmp_path, times=table)
    table.write_text("image,time\n2.png,nan\n")
    with pytest.raises(LocalizationError, match="line 2"):
        pictures(tmp_path, times=table)
    table.write_text("2.png,0.5\n")
    with pytest.raises(LocalizationError, match="expected a first line"):
        pictures(tmp_path, times=table)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.95])
def test_a_picture_cut_short_is_named_and_left_out(tmp_path, suffix, share):
    """A cut picture is named, skipped and counted, even where the decoder would fill the rest with gray."""
    busy = RNG.integers(0, 255, (48, 64)).astype(np.uint8)
    for number in (1, 2, 3):
        write_picture(busy, tmp_path / f"{number}{suffix}")
    whole = (tmp_path / f"2{suffix}").read_bytes()
    (tmp_path / f"2{suffix}").write_bytes(whole[: int(share * len(whole))])
    told = []
    assert [name for _, name, _ in listed(tmp_path, notify=told.append)] == [f"1{suffix}", f"3{suffix}"]
    assert len(told) == 2 and f"2{suffix}" in told[0] and told[1] == "1 of 3 files were left out"


def test_a_whole_jpeg_with_something_behind_it_is_read(tmp_path):
    """Phones append data to pictures; a thumbnail inside the header does not end the large picture."""
    write_picture(scene(90), tmp_path / "a.jpg")
    raw = (tmp_path / "a.jpg").read_bytes()
    small = b"\xff\xe1" + (2 + len(raw)).to_bytes(2, "big") + raw
    (tmp_path / "a.jpg").write_bytes(raw[:2] + small + raw[2:] + b"more")
    assert abs(float(read_picture(tmp_path / "a.jpg").mean()) - float(scene(90).mean())) < 1.0
    (tmp_path / "a.jpg").write_bytes(raw[:2] + small + raw[2:-2])
    with pytest.raises(LocalizationError, match="cut short"):
        read_picture(tmp_path / "a.jpg")


def test_a_run_of_which_nothing_can_be_read_is_refused(tmp_path):
    """A folder without a readable picture is refused with the first reason."""
    for number in (1, 2):
        (tmp_path / f"{number}.png").write_bytes(b"no picture")
    told = []
    with pytest.raises(LocalizationError, match=r"none of 2 files can be read; the first: .*1\.png"):
        listed(tmp_path, notify=told.append)
    assert len(told) == 2


def test_what_is_not_there_is_refused_at_once(tmp_path):
    """A missing source is refused before the first picture is requested."""
    (tmp_path / "a.txt").write_text("x")
    for source, sentence in [
        (tmp_path / "none", "no such file or folder"),
        (tmp_path / "a.txt", "expected a picture"),
        (tmp_path, "holds no pictures"),
    ]:
        with pytest.raises(LocalizationError, match=sentence):
            pictures(source)
    with pytest.raises(LocalizationError, match="ends in"):
        write_picture(scene(1), tmp_path / "a.xyz")


def test_two_pictures_of_one_name_are_told_apart(tmp_path):
    """Pictures with equal names are named with their folders."""
    for folder in ("a", "b"):
        write_picture(scene(50), tmp_path / folder / "1.png")
    names = [name for _, name, _ in listed([tmp_path / "a", tmp_path / "b"])]
    assert len(set(names)) == 2 and all(name.endswith("/1.png") for name in names)


@pytest.mark.parametrize(("suffix", "code"), [(".avi", "MJPG"), (".mp4", "mp4v")])
def test_a_video_gives_its_pictures_with_their_times(tmp_path, suffix, code):
    """Eight pictures come at 10 Hz, 0.1 s apart; half a video gives its remaining pictures or is skipped."""
    path = tmp_path / f"run{suffix}"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), 10.0, (64, 48))
    for number in range(8):
        writer.write(cv2.cvtColor(scene(20 * number), cv2.COLOR_GRAY2BGR))
    writer.release()
    notes = []
    got = listed(path, notify=notes.append)
    assert notes == []
    assert [name for _, name, _ in got] == [f"run{suffix}#{i}" for i in range(8)]
    assert np.allclose([time for time, _, _ in got], 0.1 * np.arange(8), atol=1e-3)
    means = [float(image.mean()) for _, _, image in got]
    assert np.allclose(means, [scene(20 * i).mean() for i in range(8)], atol=4.0)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(LocalizationError, match="none of 1 files"):
        listed(path, notify=lambda sentence: None)


def test_notes_on_turning_the_picture_are_not_followed(tmp_path):
    """A phone held upright writes the same pixel frame as one held flat."""
    write_picture(scene(60), tmp_path / "a.jpg")
    raw = (tmp_path / "a.jpg").read_bytes()
    # Orientation 6: rotate by 90°.
    entry = b"\x01\x12" + b"\x00\x03" + b"\x00\x00\x00\x01" + b"\x00\x06\x00\x00"
    exif = b"Exif\0\0MM\x00\x2a\x00\x00\x00\x08\x00\x01" + entry + b"\x00\x00\x00\x00"
    (tmp_path / "a.jpg").write_bytes(
        raw[:2] + b"\xff\xe1" + (2 + len(exif)).to_bytes(2, "big") + exif + raw[2:]
    )
    assert cv2.imread(str(tmp_path / "a.jpg"), cv2.IMREAD_GRAYSCALE).shape == (64, 48)
    assert read_picture(tmp_path / "a.jpg").shape == (48, 64)
