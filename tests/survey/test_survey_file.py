"""Survey files give the settings of the fit and the surveyed points, and errors in them are named."""

import numpy as np
import pytest

from finssim.core.optics import Layer
from finssim.survey.pool_model import PoolFitSettings
from finssim.survey.survey_file import load_survey_file
from finssim.trials.findings import CalibrationError

GRID = "{first: 5, columns: 3, rows: 2, spacing: [0.2, 0.3], edge: 0.1, position: [1, 2, 0], yaw_deg: 90}"
WHOLE = """
points: points.csv
unit: mm
z: -0.1
sigma: 0.001
tags: {family: tag36h11, edge: 0.16, yaw_sigma_deg: 2}
surface: {height: 1.02, sigma: 0.004, tilt_sigma_deg: 0.4}
water: {index: 1.34, index_sigma: 0.002}
camera: {focal_sigma: 0.003, center_sigma_px: 4, pixel_sigma_px: 0.3, latency: 0.045}
fit: [pose, height, tilt]
folds: 4
"""
WINDOW = "window: {thickness: 0.010, index: 1.52, plane: [0, 1, 0, 0.3], sigma: 0.002, tilt_sigma_deg: 0.1}\n"


def written(folder, text):
    path = folder / "survey.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_every_key_is_a_setting_in_si(tmp_path):
    file = load_survey_file(written(tmp_path, WHOLE))
    assert file.fit_settings(seed=3) == PoolFitSettings(
        survey_sigma=0.001,
        survey_yaw_sigma=np.radians(2.0),
        water_height=1.02,
        place_sigma=0.004,
        tilt_sigma=np.radians(0.4),
        index=1.34,
        index_sigma=0.002,
        focal_sigma=0.003,
        center_sigma=4.0,
        pixel_sigma=0.3,
        fit=("pose", "height", "tilt"),
        folds=4,
        seed=3,
    )
    assert (file.points, file.unit, file.z) == (tmp_path / "points.csv", "mm", -0.1)
    assert (file.family, file.edge, file.latency) == ("tag36h11", 0.16, 0.045)


def test_a_window_and_its_plane(tmp_path):
    file = load_survey_file(written(tmp_path, WINDOW))
    assert file.fit_settings() == PoolFitSettings(
        window=Layer(0.010, 1.52),
        plane=(0.0, 1.0, 0.0, 0.3),
        place_sigma=0.002,
        tilt_sigma=np.radians(0.1),
    )


@pytest.mark.parametrize("text", ["surface: {}\n", "surface:\n"])
def test_the_shortest_file_keeps_every_default(tmp_path, text):
    """Omitted keys have the caller's values, or else those of `PoolFitSettings`."""
    file = load_survey_file(written(tmp_path, text))
    assert file.fit_settings() == PoolFitSettings()
    assert file.fit_settings(focal_sigma=0.01).focal_sigma == 0.01
    assert load_survey_file(written(tmp_path, WHOLE)).fit_settings(focal_sigma=0.01).focal_sigma == 0.003


def test_a_grid_of_tags(tmp_path):
    """With a turn of 90 degrees, the columns run along y; the second row lies at smaller x."""
    tags = load_survey_file(written(tmp_path, f"surface: {{}}\ngrid: {GRID}\n")).grid
    assert sorted(tags) == [5, 6, 7, 8, 9, 10]
    np.testing.assert_allclose(tags[7].points.mean(axis=0), [1.0, 2.4, 0.0], atol=1e-12)
    np.testing.assert_allclose(tags[8].points.mean(axis=0), [0.7, 2.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("sigma: 0.002\n", "neither surface nor window is given"),
        ("surface: {}\n" + WINDOW, "both surface and window are given"),
        ("wall: {plane: [0, 1, 0, 0]}\n", "neither surface nor window is given"),
        ("surface: {height: 1, depth: 1}\n", "given twice"),
        ("surface: {height: high}\n", "survey.yaml: surface: height holds 'high'"),
        ("surface: {height: .nan}\n", "height holds nan"),
        ("surface: {sigma: 0.01}\n", "is given without height or depth"),
        ("surface: {height: 1, sigma: -1}\n", "survey.yaml: sigma of the surface or window.* is -1"),
        ("surface: {tilt_sigma_deg: -1}\n", r"tilt sigma \[deg\] is -1"),
        ("surface: {plane: [0, 0, 1, -1]}\n", "surface: unknown key 'plane'"),
        ("window: {thickness: 0.01}\n", "window: index is missing"),
        ("window: {thickness: 10, index: 1.52}\n", "window is 10 m thick.*metres"),
        ("window: {thickness: -1, index: 1.52}\n", "survey.yaml: window: "),
        ("window: {thickness: 0.01, index: 1.52, plane: [0, 1]}\n", "plane is .0, 1., expected 4 numbers"),
        ("window: {thickness: 0.01, index: 1.52, plane: [0, 0, 0, 1]}\n", "expected a direction"),
        ("window: {thickness: 0.01, index: 1.52, sigma: 0.01}\n", "is given without plane"),
        ("window: {thickness: 0.01, index: 1.52, tilt_sigma_deg: 1}\n", "a standard deviation is given without plane"),
        ("window: [{thickness: 0.01, index: 1.52}]\n", "expected a section"),
        ("surface: {}\nwater: {index: 5}\n", "index is 5, expected a number from 1 to 2.5"),
        ("surface: {}\nwater: {index_sigma: -1}\n", "index sigma is -1"),
        ("surface: {}\nfit: [pose, colour]\n", "unknown 'colour' to fit; available: pose"),
        ("surface: {}\nfit: [height]\n", "fit leaves the pose out"),
        ("surface: {}\nfit: [pose]\n", "give the height of the surface or the plane"),
        ("surface: {}\nfit: pose\n", "fit is 'pose', expected a list"),
        ("surface: {}\ncamera: {pixel_sigma_px: 0}\n", "pixel sigma is 0"),
        ("surface: {}\ncamera: {focal_sigma: -1}\n", "focal sigma is -1"),
        ("surface: {}\ncamera: {center_sigma_px: -1}\n", "center sigma is -1"),
        ("surface: {}\ncamera: {latency: soon}\n", "latency holds 'soon'"),
        ("surface: {}\nsigma: -1\n", "survey sigma is -1"),
        ("surface: {}\ntags: {yaw_sigma_deg: -1}\n", r"survey yaw sigma \[deg\] is -1"),
        ("surface: {}\ntags: {family: 99h9}\n", "unknown tag family '99h9'"),
        ("surface: {}\nunit: mile\n", "unknown unit 'mile'; available: m"),
        ("surface: {}\nfolds: 1\n", "folds is 1, expected at least 2"),
        ("surface: {}\nfolds: 2.5\n", "folds is 2.5, expected an integer"),
        (f"surface: {{}}\npoints: points.csv\ngrid: {GRID}\n", "points and grid are given"),
        (f"surface: {{}}\ngrid: {GRID.replace('edge: 0.1', 'edge: 0.5')}\n", "spacing above the edge"),
        ("", "found nothing"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(tmp_path, text, words):
    with pytest.raises(CalibrationError, match=words):
        load_survey_file(written(tmp_path, text))
