"""Poor geometry, wrong rows, tapes and camera files are noticed, and said."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.calibration.vision.pool_fit import calibrate_pool
from finssim.calibration.vision.pool_settings import Settings
from finssim.geometry.optics import Interface, Lens

from .surveyed_pools import (
    FLOOR,
    PLUMB_BOB,
    SOLID,
    looking,
    overhead,
    survey,
)

WATER = Interface.water(1.0)
FIT = ("pose", "height", "tilt", "index")


def tilt_error(fit, plane):
    return float(np.degrees(np.arccos(min(1.0, fit.model.interface.normal @ plane.normal))))


@pytest.mark.parametrize("box", [FLOOR, SOLID], ids=["floor", "solid"])
def test_wrong_rows_are_named_and_left_out(box):
    """Two pairs exchanged and one point 20 cm off: those five and no other."""
    seen = survey(overhead(), WATER, box, 40)
    points = seen.points.copy()
    points[[3, 11, 20, 30]] = points[[11, 3, 30, 20]]
    points[7, 0] += 0.2
    fit = calibrate_pool(replace(seen, points=points), PLUMB_BOB, Settings(fit=FIT, water_height=1.0))
    assert set(fit.outliers) == {"p3", "p7", "p11", "p20", "p30"}
    assert fit.model.camera.position[2] == pytest.approx(2.2, abs=0.01)


def test_a_rough_camera_file_is_found_out():
    """A focal length 3 % off and no distortion: the lens is fitted here, and said to be."""
    rough = Lens(1280, 720, 557.0, 557.0, 640.0, 360.0, "plumb_bob", ())
    seen = survey(overhead(), WATER, SOLID, 80)
    fit = calibrate_pool(seen, rough, Settings(water_height=1.0))
    assert "focal" in fit.lens_fitted
    assert any("camera file does not fit" in note for note in fit.notes)
    assert fit.held_out.as_json()["rms_cm"] < 0.6
    held = calibrate_pool(seen, rough, Settings(fit=FIT, water_height=1.0))
    assert held.held_out.as_json()["rms_cm"] > 2.0 * fit.held_out.as_json()["rms_cm"]


def test_a_good_camera_file_is_left_alone():
    seen = survey(overhead(), WATER, FLOOR, 60)
    assert calibrate_pool(seen, PLUMB_BOB, Settings(water_height=1.0)).lens_fitted == ()


def test_points_near_the_axis_tell_no_height():
    """Seen from above, water only brings the floor nearer: the height is said to be unknown, and the map is right."""
    seen = survey(overhead(), WATER, ((-0.2, -0.4, 0.0), (0.2, 0.0, 1e-12)), 40)
    fit = calibrate_pool(seen, PLUMB_BOB, Settings(fit=FIT, interface="surface"))
    assert not fit.estimates["camera_height"].identifiable
    assert any("not separable" in sentence and "--water-height" in sentence for sentence in fit.advice)
    assert fit.held_out.as_json()["rms_cm"] < 0.5
    low, high = fit.estimates["camera_height"].ci95
    assert low < 1.2 < high


def test_a_sloping_floor_taken_for_level_is_noticed():
    """The water 1.2 degrees from the survey's level: the level is given up, and that is said."""
    water = Interface.water(1.0, tilt_x=0.02)
    camera = looking((-2.5, 0.0, 2.5), (0.0, 0.0, 0.0), PLUMB_BOB, (0.0, 0.0, 1.0))
    seen = survey(camera, water, ((-2.0, -1.5, 0.0), (2.0, 1.5, 0.5)), 80, error=0.001)
    told = Settings(fit=FIT, water_height=1.0, water_height_sigma=0.02, survey_sigma=0.001)
    fit = calibrate_pool(seen, PLUMB_BOB, told)
    assert any("tilted" in note for note in fit.notes)
    assert tilt_error(fit, water) < 0.5


def test_a_wrong_tape_is_contradicted():
    seen = survey(overhead(), WATER, SOLID, 80)
    fit = calibrate_pool(seen, PLUMB_BOB, Settings(fit=FIT, water_height=1.3, water_height_sigma=0.005))
    assert any("than it was measured" in sentence for sentence in fit.advice)


def test_dry_points_help():
    """Markers above the water fix the camera: the water's height is told half as exactly again as without."""
    camera = overhead()
    wet = survey(camera, WATER, FLOOR, 40)
    points = np.random.default_rng(2).uniform((-0.8, -0.4, 1.02), (0.8, 0.3, 1.3), (12, 3))
    optical = (points - camera.position) @ camera.R_pc
    pixels, ok = camera.lens.project(optical)
    assert ok.all()
    both = replace(
        wet,
        pixels=np.concatenate([wet.pixels, pixels]),
        points=np.concatenate([wet.points, points]),
        location=np.arange(52),
        names=(*wet.names, *(f"d{i}" for i in range(12))),
        locations=(*wet.locations, *(f"d{i}" for i in range(12))),
        sigma=np.full(52, np.nan),
        arm=np.zeros((52, 3)),
        dry=np.arange(52) >= 40,
    )
    told = Settings(fit=FIT, interface="surface")
    half = [np.ptp(calibrate_pool(s, PLUMB_BOB, told).estimates["water_height"].ci95) for s in (wet, both)]
    assert half[1] < half[0] / 1.5


@pytest.mark.parametrize("factor", [0.7, 1.4])
def test_a_guessed_focal_length_is_enough(factor):
    """Points at many depths give the focal length back within 2 % from a guess 30 or 40 % off."""
    guess = Lens(1280, 720, 541.0 * factor, 541.0 * factor, 640.0, 360.0, "plumb_bob", ())
    seen = survey(overhead(), WATER, SOLID, 80)
    fit = calibrate_pool(seen, guess, Settings(water_height=1.0, focal_sigma=0.3))
    assert fit.model.camera.lens.fx == pytest.approx(540.93, rel=0.02)
    assert np.linalg.norm(fit.model.camera.position - overhead().position) < 0.03
    assert fit.held_out.as_json()["rms_cm"] < 0.5
    unsaid = calibrate_pool(seen, guess, Settings(water_height=1.0))
    assert any("--focal-sigma" in sentence for sentence in unsaid.advice)
