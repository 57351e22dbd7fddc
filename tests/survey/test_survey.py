"""Surveys are read in common spellings, and missing or contradictory data are named."""

import numpy as np
import pytest

from finssim.survey.points import read_survey
from finssim.trials.findings import CalibrationError


def written(folder, text):
    path = folder / "survey.csv"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "text",
    [
        "id,x,y,z\na,1.5,-0.25,0.5\n",
        "ID;X [mm];Y [mm];Z [mm]\na;1500;-250;500\n",
        "Point\tx_cm\ty_cm\tz_cm\na\t150\t-25\t50\n",
        "id;x;y;z\na;1,5;-0,25;0,5\n",
        "# unit: mm\nname, World X, World Y, World Z\na, 1500, -250, 500\n",
        "\ufeffz(m),y(cm),x(mm),label\n0.5,-25,1500,a\n",
        "# id x y z\na 1.5 -0.25 0.5\n",
        "id,x,y,z,remark\n\na,1.5,-0.25,0.5,beside the ladder\n",
    ],
)
def test_one_point_in_many_spellings(tmp_path, text):
    """Case, order, separator, decimal comma and unit are free."""
    survey = read_survey(written(tmp_path, text))
    np.testing.assert_allclose(survey.points["a"].points, [[1.5, -0.25, 0.5]])


def test_a_unit_may_be_given_beside(tmp_path):
    path = written(tmp_path, "id,x,y,z\na,1500,0,0\nb,0,900,0\n")
    with pytest.raises(CalibrationError, match="spread over 1500 m.*unit: mm into the survey file"):
        read_survey(path)
    np.testing.assert_allclose(read_survey(path, unit="mm").points["b"].points, [[0.0, 0.9, 0.0]])


def test_one_height_may_be_given_beside(tmp_path):
    path = written(tmp_path, "id,x,y\na,1,2\n")
    with pytest.raises(CalibrationError, match="no column 'z'.*z in the survey file"):
        read_survey(path)
    assert read_survey(path, z=-1.0).points["a"].points[0, 2] == -1.0


def test_a_fixed_tag_gives_its_corners(tmp_path):
    """Turned by 90 degrees to the left, the printed top left corner (-h, +h) lies at (-h, -h)."""
    survey = read_survey(written(tmp_path, "tag,x,y,z,yaw_deg,edge\n7,1,2,0.5,90,0.2\n"))
    np.testing.assert_allclose(survey.tags[7].points[0], [0.9, 1.9, 0.5], atol=1e-12)


def test_a_moved_tag_belongs_to_its_picture(tmp_path):
    text = "image,x_mm,y_mm,z_mm,yaw_deg\na.png,100,0,0,0\nb.png,200,0,0,0\n"
    survey = read_survey(written(tmp_path, text), edge=0.1)
    ((tag, placed),) = survey.locations["b.png"]
    assert tag is None
    np.testing.assert_allclose(placed.points.mean(axis=0), [0.2, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("head", "cells", "radians"),
    [("yaw_deg", "90", np.pi / 2), ("yaw_rad", "1.0", 1.0), ("yaw", "1.0", 1.0), ("yaw", "90", np.pi / 2)],
)
def test_directions_in_degrees_or_radians(tmp_path, head, cells, radians):
    survey = read_survey(written(tmp_path, f"tag,x,y,z,{head},edge\n1,0,0,0,{cells},0.2\n"))
    along = survey.tags[1].points[1] - survey.tags[1].points[0]
    assert np.arctan2(along[1], along[0]) == pytest.approx(radians)


def test_own_errors_dry_points_and_targets(tmp_path):
    text = "id,x,y,z,sigma_mm,dry,group\na,0,0,0,5,,left\nb,1,0,1.2,,yes,\n"
    survey = read_survey(written(tmp_path, text))
    assert survey.points["a"].sigma == pytest.approx(0.005)
    assert survey.points["a"].group == "left"
    assert survey.points["b"].dry and np.isnan(survey.points["b"].sigma)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1,2,3\n4,5,6\n", "no header"),
        ("id,x,z\na,1,2\n", "no column 'y'"),
        ("x,y,z\n1,2,3\n", "names the points"),
        ("", "is empty"),
        ("\n# surveyed on Monday\n", "nothing but comments"),
        ("id,x,y,z\na,1,two,3\n", "line 2: y is 'two'.*file is refused.*empty it"),
        ("id,x,y,z\na,1,2,3\nb,0,0,0\na,1,2,4\n", "line 4: point 'a' has another position in line 2"),
        ("tag,x,y,z\n1,0,0,0\n", "without its edge"),
        ("tag,x,y,z,edge\none,0,0,0,0.1\n", "tag is 'one'"),
        ("id,x,x_mm,y,z\na,1,1,2,3\n", "two columns mean 'x'"),
        ("id,x,y,z\n", "no surveyed point"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, text, words):
    with pytest.raises(CalibrationError, match=words):
        read_survey(written(tmp_path, text))


def test_rows_without_a_number_are_left_out_and_said(tmp_path):
    survey = read_survey(written(tmp_path, "id,x,y,z\na,1,2,3\nb,,2,3\nc,nan,0,0\n"))
    assert list(survey.points) == ["a"]
    assert [one.values["line"] for one in survey.findings][0] == 3 and len(survey.findings) == 2


def test_a_repeated_row_is_no_contradiction(tmp_path):
    assert len(read_survey(written(tmp_path, "id,x,y,z\na,1,2,3\na,1,2,3\n")).points) == 1
