"""Detections survive a round trip, foreign files are read, and broken ones are refused with the position."""

import math

import numpy as np
import pytest

from finssim.localization import LocalizationError
from finssim.localization.detection.detections import (
    COLUMNS,
    Detection,
    Frame,
    best_detections,
    read_detections,
    write_detections,
)

RING = np.array([[10.25, 20.5], [50.1, 21.0], [49.0, 61.0 / 3.0], [9.0, 60.0]])
NUMBERS = ",".join(str(x) for x in RING.ravel().tolist())


def same(a, b):
    """Return whether two detections have the same contents."""
    margins = a.margin == b.margin or (math.isnan(a.margin) and math.isnan(b.margin))
    return (
        margins
        and (a.tag, a.hamming, a.family) == (b.tag, b.hamming, b.family)
        and np.array_equal(a.corners, b.corners)
    )


def test_what_is_written_reads_back_bit_for_bit(tmp_path):
    """Times, names, corners, unknown margins, pictures without tags and pictures without a time read back exactly."""
    frames = [
        Frame(0.1, "a.png", (Detection(15, RING, 71.3, 1, "tag25h9"), Detection(16, RING + 1.0 / 3.0))),
        Frame(0.2, "b.png", ()),
        Frame(math.nan, "c, d.png", (Detection(3, RING * math.pi),)),
    ]
    write_detections(frames, tmp_path / "d.csv")
    again = read_detections(tmp_path / "d.csv")
    assert [f.image for f in again] == ["a.png", "b.png", "c, d.png"]
    assert [f.time for f in again[:2]] == [0.1, 0.2] and math.isnan(again[2].time)
    for before, after in zip(frames, again, strict=True):
        assert len(before.detections) == len(after.detections)
        assert all(map(same, before.detections, after.detections))


@pytest.mark.parametrize(
    "header",
    [
        "tag,u0,v0,u1,v1,u2,v2,u3,v3",
        "ID,X0,Y0,X1,Y1,X2,Y2,X3,Y3",
        "tag_id,corner0_u,corner0_v,corner1_u,corner1_v,corner2_u,corner2_v,corner3_u,corner3_v",
        "Tag ID,c1_x,c1_y,c2_x,c2_y,c3_x,c3_y,c4_x,c4_y",
        "marker,u1 [px],v1 [px],u2 [px],v2 [px],u3 [px],v3 [px],u4 [px],v4 [px]",
        "id,p0x,p0y,p1x,p1y,p2x,p2y,p3x,p3y",
    ],
)
@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_foreign_column_names_are_understood(tmp_path, header, delimiter):
    """Names may have any case and corners start at 0 or 1; image and time may be missing; other columns are ignored."""
    text = f"# made by hand\n{header},note\n7,{NUMBERS},x\n".replace(",", delimiter)
    (tmp_path / "d.csv").write_text(text, encoding="utf-8-sig")
    [frame] = read_detections(tmp_path / "d.csv")
    assert math.isnan(frame.time) and frame.image == ""
    assert same(frame.detections[0], Detection(7, RING))


def test_columns_may_stand_in_any_order(tmp_path):
    """The same cells in reverse give the same detections; pictures keep the order of the file."""
    row = ["0.5", "z.png", "7", *(str(x) for x in RING.ravel().tolist()), "50.0", "0", "tag36h11"]
    other = ["0.6", "a.png", *row[2:]]
    lines = [",".join(reversed(cells)) for cells in (COLUMNS, row, other)]
    (tmp_path / "d.csv").write_text("\n".join(lines) + "\n")
    first, second = read_detections(tmp_path / "d.csv")
    assert (first.time, first.image, second.image) == (0.5, "z.png", "a.png")
    assert same(first.detections[0], Detection(7, RING, 50.0, 0, "tag36h11"))


@pytest.mark.parametrize("cell", ["nan", "inf", "abc", "", "1e999", "12px"])
@pytest.mark.parametrize("place", [2, 3, 10])
def test_a_cell_that_is_no_number_is_refused_by_name(tmp_path, cell, place):
    """The message names the file, the line and the column."""
    good = ["0.5", "a.png", "7", *(str(x) for x in RING.ravel().tolist()), "50.0", "0", "tag36h11"]
    bad = good.copy()
    bad[place] = cell
    lines = [",".join(cells) for cells in (COLUMNS, good, bad)]
    (tmp_path / "d.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(LocalizationError, match=rf"d\.csv: line 3: {COLUMNS[place]} is"):
        read_detections(tmp_path / "d.csv")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "no line of column names"),
        ("tag,u0,v0\n1,2,3\n", "no column 'u1'"),
        (f"{','.join(COLUMNS[3:11])}\n{NUMBERS}\n", "no column 'tag'"),
        (f"id,tag,{','.join(COLUMNS[3:11])}\n1,1,{NUMBERS}\n", "second column of tag"),
        (f"tag,{','.join(COLUMNS[3:11])}\n1,{NUMBERS},9\n", "line 2: 10 cells"),
        (f"tag,{','.join(COLUMNS[3:11])}\n1,2\n1,{NUMBERS}\n", "line 2: 2 cells"),
        (f"tag,{','.join(COLUMNS[3:11])}\n-1,{NUMBERS}\n", "expected an integer from 0"),
    ],
)
def test_a_file_that_is_no_detections_file_is_refused(tmp_path, text, sentence):
    """One sentence states what is missing."""
    (tmp_path / "d.csv").write_text(text)
    with pytest.raises(LocalizationError, match=sentence):
        read_detections(tmp_path / "d.csv")


def test_a_file_that_is_not_there_is_refused(tmp_path):
    """A missing file is refused, and so is a directory."""
    for path in (tmp_path / "none.csv", tmp_path):
        with pytest.raises(LocalizationError, match="cannot be read"):
            read_detections(path)


def test_a_file_cut_anywhere_opens_up_to_the_cut(tmp_path):
    """A cut in the last row leaves the rows before it, and is reported; a cut number never passes for a
    complete one."""
    frames = [Frame(float(i), f"{i}.png", (Detection(i, RING, 55.25, 0, "tag25h9"),)) for i in range(3)]
    write_detections(frames, tmp_path / "d.csv")
    raw = (tmp_path / "d.csv").read_bytes()
    start = raw.index(b"2.0,2.png") + 1
    for tail in (b"", b"\0\0\0"):
        for end in range(start, len(raw)):
            (tmp_path / "cut.csv").write_bytes(raw[:end] + tail)
            notes = []
            again = read_detections(tmp_path / "cut.csv", notes)
            assert [f.image for f in again] == ["0.png", "1.png"]
            assert len(notes) == 1 and "cut short" in notes[0]


def test_the_most_certain_of_two_of_one_id_stays():
    """Fewer corrected bits come first, then the greater margin; a known margin comes before an unknown one."""
    weak, strong = Detection(4, RING, 20.0, 0), Detection(4, RING, 60.0, 0)
    corrected, unknown = Detection(4, RING, 90.0, 1), Detection(4, RING)
    other = Detection(5, RING, 10.0)
    for order in ([weak, strong, corrected, unknown, other], [other, unknown, corrected, strong, weak]):
        kept = {d.tag: d for d in best_detections(order)}
        assert kept == {4: strong, 5: other}
