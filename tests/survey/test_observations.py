"""Pixels are matched to their surveyed points, and unmatched ones are named."""

import numpy as np
import pytest

from finssim.localization.detection.detections import Detection, Frame, write_detections
from finssim.survey.points import observe, observe_combined, read_survey
from finssim.trials.findings import CalibrationError

SQUARE = np.array([[10.0, 10.0], [20.0, 10.0], [20.0, 20.0], [10.0, 20.0]])


def written(folder, name, text):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_pixels_meet_points_by_id(tmp_path):
    survey = read_survey(written(tmp_path, "s.csv", "id,x,y,z\n1,0,0,0\n2,1,0,0\nrim,0,1,0\n"))
    pixels = written(tmp_path, "p.csv", "ID,px,py\n2.0,5,6\nrim,7,8\n9,1,1\n1,,\n")
    seen = observe([pixels], survey)
    np.testing.assert_allclose(seen.points, [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    np.testing.assert_allclose(seen.pixels, [[5.0, 6.0], [7.0, 8.0]])
    assert ("9",) in [one.values.get("names") for one in seen.findings]
    assert 5 in [one.values.get("line") for one in seen.findings]


def test_a_point_seen_in_two_pictures_is_one_location(tmp_path):
    """The survey error of a point is shared by all of its pictures."""
    survey = read_survey(written(tmp_path, "s.csv", "id,x,y,z\na,0,0,0\nb,1,0,0\n"))
    pixels = written(
        tmp_path, "p.csv", "image,id,u,v\n1.png,a,5,6\n2.png,a,5.1,6\n2.png,a,5.1,6\n1.png,b,9,9\n"
    )
    seen = observe([pixels], survey)
    assert seen.location.tolist() == [0, 0, 1]
    assert seen.names == ("1.png: a", "2.png: a", "1.png: b")
    assert "counted_twice" in {one.code for one in seen.findings}


def test_detected_tags_meet_fixed_tags(tmp_path):
    survey = read_survey(written(tmp_path, "s.csv", "tag,x,y,z,edge\n3,0,0,0,0.2\n4,1,0,0,0.2\n"))
    frame = Frame(
        0.0, "a.png", (Detection(3, SQUARE, 50.0, 0, "tag25h9"), Detection(8, SQUARE, 50.0, 0, "tag25h9"))
    )
    write_detections([frame], tmp_path / "d.csv")
    seen = observe([tmp_path / "d.csv"], survey)
    np.testing.assert_allclose(seen.pixels, SQUARE)
    np.testing.assert_allclose(seen.points[0], [-0.1, 0.1, 0.0])
    assert seen.location.tolist() == [0, 0, 0, 0]
    assert np.all(np.abs(seen.arm).max(axis=1) > 0.0)
    assert ("tag 8",) in [one.values.get("names") for one in seen.findings]


def test_a_moved_tag_is_found_by_its_picture(tmp_path):
    text = "image,x,y,z,yaw_deg,edge\na.png,0,0,0,0,0.2\nb.png,1,0,0,0,0.2\n"
    survey = read_survey(written(tmp_path, "s.csv", text))
    frames = [Frame(0.0, f"run/{n}.png", (Detection(1, SQUARE, 50.0, 0, "tag25h9"),)) for n in "abc"]
    write_detections(frames, tmp_path / "d.csv")
    seen = observe([tmp_path / "d.csv"], survey)
    assert seen.locations == ("a.png", "b.png")
    np.testing.assert_allclose(seen.points[4:].mean(axis=0), [1.0, 0.0, 0.0], atol=1e-12)
    assert ("run/c.png",) in [one.values.get("names") for one in seen.findings]


@pytest.mark.parametrize(
    "text",
    [
        "u,v,x,y,z\n5,6,1,2,3\n",
        "# units: mm\npx;py;X;Y;Z\n5;6;1000;2000;3000\n",
        "X [mm],Y [mm],Z [mm],x_px,y_px\n1000,2000,3000,5,6\n",
        "pixel_x pixel_y floor_x floor_y floor_z\n5 6 1 2 3\n",
    ],
)
def test_pixel_and_point_in_one_row(tmp_path, text):
    seen = observe_combined([written(tmp_path, "c.csv", text)])
    np.testing.assert_allclose(seen.pixels, [[5.0, 6.0]])
    np.testing.assert_allclose(seen.points, [[1.0, 2.0, 3.0]])


def test_a_floor_needs_no_column_of_heights(tmp_path):
    path = written(tmp_path, "c.csv", "u,v,x,y\n5,6,1,2\n")
    with pytest.raises(CalibrationError, match="no column 'z'.*survey file gives it"):
        observe_combined([path])
    assert observe_combined([path], z=0.0).points[0].tolist() == [1.0, 2.0, 0.0]


def test_numbers_that_cannot_be_metres_are_refused(tmp_path):
    path = written(tmp_path, "c.csv", "u,v,x,y,z\n5,6,1500,200,0\n")
    with pytest.raises(CalibrationError, match="spread over 1500 m.*unit: mm into the survey file"):
        observe_combined([path])
    assert observe_combined([path], unit="mm").points[0, 0] == pytest.approx(1.5)


def test_nothing_in_common_is_refused(tmp_path):
    survey = read_survey(written(tmp_path, "s.csv", "id,x,y,z\na,0,0,0\n"))
    with pytest.raises(CalibrationError, match="no observation belongs.*surveyed: a.*observed: b"):
        observe([written(tmp_path, "p.csv", "id,u,v\nb,1,2\n")], survey)


def test_one_bad_pixel_refuses_the_file_and_an_empty_one_its_row(tmp_path):
    survey = read_survey(written(tmp_path, "s.csv", "id,x,y,z\na,0,0,0\nb,1,0,0\n"))
    with pytest.raises(CalibrationError, match="p.csv: line 3: v is 'abc'.*file is refused"):
        observe([written(tmp_path, "p.csv", "id,u,v\na,1,2\nb,1,abc\n")], survey)
    seen = observe([written(tmp_path, "q.csv", "id,u,v\na,1,2\nb,1,\n")], survey)
    assert len(seen) == 1 and [
        one.values["line"] for one in seen.findings if one.code == "pixel_missing"
    ] == [3]


def test_an_empty_file_is_called_so(tmp_path):
    survey = read_survey(written(tmp_path, "s.csv", "id,x,y,z\na,0,0,0\n"))
    with pytest.raises(CalibrationError, match="p.csv: the file is empty"):
        observe([written(tmp_path, "p.csv", "")], survey)
