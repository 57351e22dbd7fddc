"""Tables of points to pixels and back: output, kept columns, messages and refusals."""

import csv
import io
import sys
from pathlib import Path

import numpy as np
import pytest

from finssim.core.optics import Camera, Interface, Lens, back_project, project
from finssim.localization import LocalizationError
from finssim.localization.overhead_camera import Pool, write_pool
from finssim.localization.points import run_backproject, run_project

LENS = Lens(1280, 720, 540.9, 540.9, 652.2, 348.6, distortion=(0.029, -0.060, 0.0009, 0.0018, 0.0126))
CAMERA = Camera(LENS, (0.03, -0.17, 2.17), (1.0, 0.0, 0.0, 0.0))  # looks straight down
WATER = Interface.water(0.96, tilt_x=0.01)

POINTS = """id,x,y,z
near,0.1,0.2,0.3
above,0.1,0.2,1.3
far,9.0,0.2,0.3
"""


@pytest.fixture
def pool(tmp_path):
    """A pool file with a camera above water."""
    path = tmp_path / "pool.yaml"
    write_pool(Pool(CAMERA, WATER), path)
    return path


def given(tmp_path, text, name="points.csv"):
    """Return the path of a table written to a file."""
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def table(text):
    """Return the rows of a CSV as dicts."""
    return list(csv.DictReader(io.StringIO(text)))


def test_points_become_pixels(tmp_path, pool, capsys):
    """Visible points have pixels, others none; other columns are kept; reasons are printed and counted."""
    run_project(given(tmp_path, POINTS), pool=pool)
    shown = capsys.readouterr()
    rows = table(shown.out)
    assert list(rows[0]) == ["id", "x", "y", "z", "u", "v", "status"]
    assert [row["status"] for row in rows] == ["ok", "wrong_side", "outside_image"]
    assert (rows[1]["u"], rows[1]["v"]) == ("", "")
    expected = project(CAMERA, WATER, [[0.1, 0.2, 0.3], [9.0, 0.2, 0.3]]).pixels
    found = [[float(rows[i][c]) for c in "uv"] for i in (0, 2)]
    np.testing.assert_allclose(found, expected, atol=6e-7)  # six digits
    assert "1 of 3 points" in shown.err
    assert "1 wrong_side: not on the far side" in shown.err and "1 outside_image" in shown.err


@pytest.mark.parametrize(
    "text",
    [
        "x,y,z\n0.1,0.2,0.3\n",
        "0.1,0.2,0.3\n",
        "\ufeff# survey of today\n\nZ [m]; Y [m]; X [m]\n0,3; 0,2; 0,1\n",
        "Y_m\tX_m\tZ_m\r\n0.2\t0.1\t0.3\r\n",
        "x y z\n0.1  0.2  3e-1\n",
        '"x","y","z"\n"0.1","0.2","0.3"\n',
    ],
)
def test_tables_as_others_write_them(tmp_path, pool, capsys, text):
    """Any order, capitals, units, separators, decimal commas, comments, or no header give the same pixel."""
    run_project(given(tmp_path, text), pool=pool)
    (row,) = table(capsys.readouterr().out)
    expected = project(CAMERA, WATER, [0.1, 0.2, 0.3]).pixels
    np.testing.assert_allclose([float(row["u"]), float(row["v"])], expected, atol=6e-7)


def test_there_and_back_through_files(tmp_path, pool, monkeypatch, capsys):
    """`backproject` reads the output of `project`, from a file or a pipe, and recovers the points."""
    run_project(
        given(tmp_path, "id,x,y,z\na,0.1,0.2,0.3\nb,-0.4,0.1,-0.5\n"), pool=pool, out=tmp_path / "pixels.csv"
    )
    assert capsys.readouterr().out == ""
    text = (tmp_path / "pixels.csv").read_text(encoding="utf-8")
    run_backproject(tmp_path / "pixels.csv", pool=pool)  # the file contains the heights
    from_file = capsys.readouterr().out
    monkeypatch.setattr(sys, "stdin", io.StringIO(text))
    run_backproject(Path("-"), pool=pool)
    assert capsys.readouterr().out == from_file
    rows = table(from_file)
    assert [row["id"] for row in rows] == ["a", "b"]
    for axis, values in {"x": [0.1, -0.4], "y": [0.2, 0.1], "z": [0.3, -0.5]}.items():
        np.testing.assert_allclose(
            [float(row[axis]) for row in rows], values, atol=1e-8
        )  # pixels have six digits
        np.testing.assert_allclose([float(row[f"{axis}_given"]) for row in rows], values)


def test_height_plane_and_column(tmp_path, pool, capsys):
    """A height and the plane at that height give the same points; a column z takes precedence over the height."""
    pixels = given(tmp_path, "u,v\n600,300\n700,420\n")
    run_backproject(pixels, pool=pool, z=0.2)
    by_height = table(capsys.readouterr().out)
    run_backproject(pixels, pool=pool, plane="0, 0, -2, 0.4")
    assert table(capsys.readouterr().out) == by_height
    run_backproject(given(tmp_path, "u,v,z\n600,300,0.2\n700,420,0.2\n", "z.csv"), pool=pool, z=-5.0)
    with_column = table(capsys.readouterr().out)
    assert [row["x"] for row in with_column] == [row["x"] for row in by_height]
    expected, _ = back_project(CAMERA, WATER, [[600.0, 300.0], [700.0, 420.0]]).at_z(0.2)
    found = [[float(row[c]) for c in "xyz"] for row in by_height]
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_a_plane_above_the_water_is_not_met(tmp_path, pool, capsys):
    """A plane above the water gives no point, and the reason is printed."""
    run_backproject(given(tmp_path, "u,v\n600,300\n"), pool=pool, z=1.5)
    shown = capsys.readouterr()
    (row,) = table(shown.out)
    assert (row["x"], row["status"]) == ("", "away")
    assert "0 of 1 pixels" in shown.err and "1 away" in shown.err


def test_the_error_of_a_pixel_becomes_one_of_the_point(tmp_path, pool, capsys):
    """sigma equals the scatter of points whose pixels have that error, within 5 % for 4000 draws."""
    run_backproject(given(tmp_path, "u,v\n900,200\n"), pool=pool, plane="0.3,0,1,0", pixel_std=0.5)
    (row,) = table(capsys.readouterr().out)
    pixels = np.array([900.0, 200.0]) + 0.5 * np.random.default_rng(0).standard_normal((4000, 2))
    scatter = back_project(CAMERA, WATER, pixels).at_plane((0.3, 0.0, 1.0), 0.0)[0].std(axis=0)
    found = [float(row[f"sigma_{axis}"]) for axis in "xyz"]
    np.testing.assert_allclose(found, scatter, rtol=0.05)  # standard error of a standard deviation: 1.1 %


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "x,y,z\n0.1,0.2,0.3\n0.1,deep,0.3\n\n1,2\n",
            "line 3: y is 'deep', expected a number; line 5 has 2 cells, expected 3",
        ),
        ("x,y,z\n0.1,,0.3\n", "line 2: y is '', expected a number"),
        ("x,y,z\n0.1,nan,0.3\n", "line 2: y is 'nan', expected a number"),
        ("x,y\n0.1,0.2\n", "column z is missing among x, y: name the columns x, y, z"),
        ("x,y,z,X\n1,2,3,4\n", "column x is repeated"),
        ("1,2,3,4\n", "has 4 columns without a header, expected x, y, z"),
        ("", "holds no rows"),
    ],
)
def test_wrong_tables_are_refused_by_line(tmp_path, pool, text, words):
    """The refusal names file, line and cell; nothing is written."""
    with pytest.raises(LocalizationError) as refused:
        run_project(given(tmp_path, text), pool=pool, out=tmp_path / "out.csv")
    assert words in str(refused.value) and "points.csv" in str(refused.value)
    assert not (tmp_path / "out.csv").exists()
