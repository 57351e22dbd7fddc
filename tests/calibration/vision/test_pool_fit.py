"""Camera and plane are found from no guess, with intervals that hold the truth, or the refusal says why not."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.calibration.errors import CalibrationError
from finssim.calibration.vision.pool_fit import calibrate_pool
from finssim.calibration.vision.pool_settings import Settings
from finssim.geometry.optics import Interface, Lens, project

from .surveyed_pools import (
    FISHEYE,
    FLOOR,
    GLASS,
    PLUMB_BOB,
    RATIONAL,
    SOLID,
    TANK,
    before_tank,
    carried,
    looking,
    observations,
    overhead,
    survey,
    wall,
)

WATER = Interface.water(1.0)
FIT = ("pose", "height", "tilt", "index")


def clearance(camera, plane):
    return float(plane.normal @ camera.position + plane.offset)


def tilt_error(fit, plane):
    return float(np.degrees(np.arccos(min(1.0, fit.model.interface.normal @ plane.normal))))


@pytest.mark.parametrize("lens", [PLUMB_BOB, FISHEYE, RATIONAL], ids=lambda lens: lens.model)
@pytest.mark.parametrize("box", [FLOOR, SOLID], ids=["floor", "solid"])
def test_noise_free_surveys_give_the_truth(lens, box):
    """Without errors nothing is left over, whatever the lens, and no guess is needed."""
    camera = overhead(lens)
    seen = survey(camera, WATER, box, 40, pixel=0.0, error=0.0)
    fit = calibrate_pool(seen, lens, Settings(fit=FIT, index_sigma=0.0, survey_sigma=1e-6))
    np.testing.assert_allclose(fit.model.camera.position, camera.position, atol=1e-4)
    assert fit.model.clearance == pytest.approx(clearance(camera, WATER), abs=1e-4)
    assert np.linalg.norm(fit.residual, axis=1).max() < 1e-2


def test_published_geometry_with_a_tape():
    """1.2 m above 1 m of water, 85 places, 2 mm of survey, 0.25 px, a tape of 2 mm (paper, table II)."""
    camera, errors = overhead(), []
    for seed in range(6):
        seen = survey(camera, WATER, FLOOR, 160, seed, pixel=0.25, error=0.002)
        tape = 1.0 + 0.002 * np.random.default_rng(seed).standard_normal()
        told = Settings(fit=FIT, water_height=tape, water_height_sigma=0.002, interface="surface")
        fit = calibrate_pool(seen, PLUMB_BOB, told)
        normal = fit.model.interface.normal
        errors.append([fit.model.camera.position[2] - camera.position[2], *np.degrees(normal[:2])])
        assert fit.held_out.as_json()["rms_cm"] < 0.45
        assert fit.held_out.as_json()["rms_cm"] < 0.25 * fit.pinhole_held_out.as_json()["rms_cm"]
    height, *tilts = np.sqrt(np.mean(np.square(errors), axis=0))
    assert height < 0.002
    assert max(tilts) < 0.12


def test_intervals_hold_the_truth():
    """19 of 20 intervals hold it: of 12 surveys x 4 numbers, 40 or more do (binomial, 1 in 200 has fewer than 41)."""
    inside = 0
    for seed in range(12):
        rng = np.random.default_rng([5, seed])
        index, tilts = 1.333 + 0.003 * rng.standard_normal(), np.radians(0.2) * rng.standard_normal(2)
        camera = overhead()
        water = Interface.water(1.0, tilt_x=tilts[0], tilt_y=tilts[1], n_water=index)
        seen = survey(camera, water, SOLID, 30, seed)
        table = calibrate_pool(seen, PLUMB_BOB, Settings(fit=FIT, interface="surface", seed=seed)).estimates
        truth = {"camera_x": 0.03, "camera_z": 2.2, "index": index, "camera_height": clearance(camera, water)}
        inside += sum(table[n].ci95[0] < value < table[n].ci95[1] for n, value in truth.items())
    assert inside >= 40


@pytest.mark.parametrize("window", [(), GLASS], ids=["bare", "glass"])
@pytest.mark.parametrize("degrees", [0.0, 20.0, 40.0])
def test_points_behind_a_wall(degrees, window):
    """A vertical wall at any angle to the camera, its plane unknown: held-out points to about a millimetre."""
    camera, plane = before_tank(degrees), wall(window=window)
    seen = survey(camera, plane, TANK, 60, pixel=0.25, error=0.0005)
    fit = calibrate_pool(seen, camera.lens, Settings(fit=FIT, window=window, survey_sigma=0.0005))
    table = fit.estimates
    assert not fit.surface
    assert table["camera_distance"].ci95[0] < clearance(camera, plane) < table["camera_distance"].ci95[1]
    assert tilt_error(fit, plane) < 2.5
    assert fit.held_out.as_json()["rms_cm"] < 0.12
    assert fit.held_out.as_json()["rms_cm"] < 0.5 * fit.pinhole_held_out.as_json()["rms_cm"]


def test_a_wall_in_the_frame_of_a_target():
    """Any frame will do: that of a target that lies askew in the water."""
    camera, plane = before_tank(30.0), wall(window=GLASS)
    camera, plane, seen = carried(camera, plane, survey(camera, plane, TANK, 60, pixel=0.25, error=0.0005))
    told = Settings(fit=FIT, window=GLASS, survey_sigma=0.0005, interface="wall")
    fit = calibrate_pool(seen, camera.lens, told)
    assert tilt_error(fit, plane) < 2.5
    assert np.linalg.norm(fit.model.camera.position - camera.position) < 0.03


def test_a_surveyed_plane_makes_a_wall_exact():
    camera, plane = before_tank(20.0), wall(window=GLASS)
    seen = survey(camera, plane, TANK, 60, pixel=0.25, error=0.0005)
    told = Settings(
        fit=FIT, window=GLASS, survey_sigma=0.0005, plane=(0.0, 1.0, 0.0, 0.0), water_height_sigma=0.001
    )
    fit = calibrate_pool(seen, camera.lens, told)
    assert np.linalg.norm(fit.model.camera.position - camera.position) < 0.004
    assert tilt_error(fit, plane) < 0.5


def test_z_down_is_a_frame_like_any_other():
    """x forward, y right, z down: the water lies at negative z."""
    camera, seen = overhead(), survey(overhead(), WATER, FLOOR, 60)
    down = replace(seen, points=seen.points * np.array([1.0, -1.0, -1.0]))
    fit = calibrate_pool(down, camera.lens, Settings(fit=FIT, water_height=-1.0))
    assert fit.model.interface.normal[2] < -0.999
    np.testing.assert_allclose(fit.model.camera.position, camera.position * [1.0, -1.0, -1.0], atol=0.01)


def test_a_left_handed_solid_is_refused():
    seen = survey(overhead(), WATER, SOLID, 40)
    mirrored = replace(seen, points=seen.points * np.array([1.0, -1.0, 1.0]))
    with pytest.raises(CalibrationError, match="left-handed.*negate one axis"):
        calibrate_pool(mirrored, PLUMB_BOB, Settings(fit=FIT))


def test_a_left_handed_floor_contradicts_its_tape():
    """A plane fits its mirror image, but then the camera is under it and the water is not."""
    seen = survey(overhead(), WATER, FLOOR, 40)
    mirrored = replace(seen, points=seen.points * np.array([1.0, -1.0, 1.0]))
    with pytest.raises(CalibrationError, match="other side.*negate y"):
        calibrate_pool(mirrored, PLUMB_BOB, Settings(fit=FIT, water_height=1.0))
    depth = calibrate_pool(mirrored, PLUMB_BOB, Settings(fit=FIT, water_depth=1.0))
    assert depth.held_out.as_json()["rms_cm"] < 0.5


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


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (np.column_stack([np.linspace(0.0, 1.0, 9), np.zeros(9), np.zeros(9)]), "on one line"),
        (np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.7, 0.0]]), "3 usable points"),
    ],
    ids=["line", "three"],
)
def test_too_little_is_refused(points, words):
    pixels = project(overhead(), WATER, points).pixels
    with pytest.raises(CalibrationError, match=words):
        calibrate_pool(observations(points, pixels), PLUMB_BOB)


def test_equal_seeds_give_equal_fits():
    seen = survey(overhead(), WATER, FLOOR, 30)
    a, b = (calibrate_pool(seen, PLUMB_BOB, Settings(water_height=1.0, seed=4)) for _ in range(2))
    assert a.estimates == b.estimates
    assert a.held_out.as_json() == b.held_out.as_json()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"interface": "ceiling"}, "unknown interface 'ceiling'"),
        ({"fit": ("pose", "colour")}, "unknown 'colour' to fit"),
        ({"fit": ("pose", "tilt")}, "leaves the height out"),
        ({"water_height": 1.0, "water_depth": 1.0}, "given twice"),
        ({"folds": 1}, "at least 2"),
        ({"index": 0.7}, "index is 0.7"),
    ],
)
def test_senseless_options_are_refused(options, words):
    with pytest.raises(CalibrationError, match=words):
        Settings(**options)
