"""Camera and plane are found without a guess, with valid intervals, or refused with the reason."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.core.optics import Camera, Interface, Layer, project
from finssim.survey.pool_fit import calibrate_pool
from finssim.survey.pool_model import PoolFitSettings
from finssim.trials.findings import CalibrationError

from .surveyed_pools import (
    FISHEYE,
    FLOOR,
    GLASS,
    PLUMB_BOB,
    RATIONAL,
    SOLID,
    observations,
    overhead,
    survey,
)

WATER = Interface.water(1.0)
FIT = ("pose", "height", "tilt", "index")


def clearance(camera, plane):
    return float(plane.normal @ camera.position + plane.offset)


def tilt_error(fit, plane):
    return float(np.degrees(np.arccos(min(1.0, fit.model.interface.normal @ plane.normal))))


@pytest.mark.slow
@pytest.mark.parametrize("lens", [PLUMB_BOB, FISHEYE, RATIONAL], ids=lambda lens: lens.model)
@pytest.mark.parametrize("box", [FLOOR, SOLID], ids=["floor", "solid"])
def test_noise_free_surveys_give_the_truth(lens, box):
    """Without errors the residuals vanish for every lens, and no guess is needed."""
    camera = overhead(lens)
    seen = survey(camera, WATER, box, 40, pixel=0.0, error=0.0)
    fit = calibrate_pool(seen, lens, PoolFitSettings(fit=FIT, index_sigma=0.0, survey_sigma=1e-6))
    np.testing.assert_allclose(fit.model.camera.position, camera.position, atol=1e-4)
    assert fit.model.clearance == pytest.approx(clearance(camera, WATER), abs=1e-4)
    assert np.linalg.norm(fit.residual, axis=1).max() < 1e-2


@pytest.mark.slow
def test_published_geometry_with_a_tape():
    """The geometry is 1.2 m above 1 m of water, 85 points, 2 mm of survey, 0.25 px, a tape of 2 mm (paper,
    table II)."""
    camera, errors = overhead(), []
    for seed in range(6):
        seen = survey(camera, WATER, FLOOR, 160, seed, pixel=0.25, error=0.002)
        tape = 1.0 + 0.002 * np.random.default_rng(seed).standard_normal()
        told = PoolFitSettings(fit=FIT, water_height=tape, place_sigma=0.002)
        fit = calibrate_pool(seen, PLUMB_BOB, told)
        normal = fit.model.interface.normal
        errors.append([fit.model.camera.position[2] - camera.position[2], *np.degrees(normal[:2])])
        assert fit.held_out.as_json()["rms_cm"] < 0.45
        assert fit.held_out.as_json()["rms_cm"] < 0.25 * fit.pinhole_held_out.as_json()["rms_cm"]
    height, *tilts = np.sqrt(np.mean(np.square(errors), axis=0))
    assert height < 0.002
    assert max(tilts) < 0.12


@pytest.mark.slow
def test_intervals_hold_the_truth():
    """95 % intervals: of 6 surveys x 4 numbers, 20 or more contain the truth (binomial, 1 in 170 has fewer)."""
    inside = 0
    for seed in range(6):
        rng = np.random.default_rng([5, seed])
        index, tilts = 1.333 + 0.003 * rng.standard_normal(), np.radians(0.2) * rng.standard_normal(2)
        camera = overhead()
        water = Interface.water(1.0, tilt_x=tilts[0], tilt_y=tilts[1], n_water=index)
        seen = survey(camera, water, SOLID, 30, seed)
        table = calibrate_pool(seen, PLUMB_BOB, PoolFitSettings(fit=FIT, seed=seed)).estimates
        truth = {"camera_x": 0.03, "camera_z": 2.2, "index": index, "camera_height": clearance(camera, water)}
        inside += sum(table[n].ci95[0] < value < table[n].ci95[1] for n, value in truth.items())
    assert inside >= 20


def test_z_down_is_a_frame_like_any_other():
    """With x forward, y right, z down, the water lies at negative z."""
    camera, seen = overhead(), survey(overhead(), WATER, FLOOR, 60)
    down = replace(seen, points=seen.points * np.array([1.0, -1.0, -1.0]))
    fit = calibrate_pool(down, camera.lens, PoolFitSettings(fit=FIT, water_height=-1.0))
    assert fit.model.interface.normal[2] < -0.999
    np.testing.assert_allclose(fit.model.camera.position, camera.position * [1.0, -1.0, -1.0], atol=0.01)


@pytest.mark.slow
def test_a_left_handed_solid_is_refused():
    seen = survey(overhead(), WATER, SOLID, 40)
    mirrored = replace(seen, points=seen.points * np.array([1.0, -1.0, 1.0]))
    with pytest.raises(CalibrationError, match="left-handed.*negate one axis"):
        calibrate_pool(mirrored, PLUMB_BOB, PoolFitSettings(fit=FIT))


def test_a_left_handed_floor_contradicts_its_tape():
    """A plane fits its mirror image, but then the camera is below it and the water is not."""
    seen = survey(overhead(), WATER, FLOOR, 40)
    mirrored = replace(seen, points=seen.points * np.array([1.0, -1.0, 1.0]))
    with pytest.raises(CalibrationError, match="other side.*negate y"):
        calibrate_pool(mirrored, PLUMB_BOB, PoolFitSettings(fit=FIT, water_height=1.0))
    depth = calibrate_pool(mirrored, PLUMB_BOB, PoolFitSettings(fit=FIT, water_depth=1.0))
    assert depth.held_out.as_json()["rms_cm"] < 0.5


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


@pytest.mark.slow
def test_equal_seeds_give_equal_fits():
    seen = survey(overhead(), WATER, FLOOR, 30)
    a, b = (calibrate_pool(seen, PLUMB_BOB, PoolFitSettings(water_height=1.0, seed=4)) for _ in range(2))
    assert a.estimates == b.estimates
    assert a.held_out.as_json() == b.held_out.as_json()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"fit": ("pose", "colour")}, "unknown 'colour' to fit"),
        ({"fit": ("pose", "tilt")}, "leaves the height out"),
        ({"water_height": 1.0, "water_depth": 1.0}, "given twice"),
        ({"plane": (0.0, 1.0, 0.0, 0.0)}, "a plane without a window"),
        ({"window": GLASS, "water_height": 1.0}, "the height or depth of a window"),
        ({"window": GLASS, "plane": (0.0, 0.0, 0.0, 1.0)}, "expected a direction"),
        ({"window": Layer(10.0, 1.52)}, "window is 10 m thick.*metres"),
        ({"folds": 1}, "at least 2"),
        ({"index": 0.7}, "index is 0.7"),
    ],
)
def test_senseless_options_are_refused(options, words):
    with pytest.raises(CalibrationError, match=words):
        PoolFitSettings(**options)


@pytest.mark.slow
def test_intervals_allow_for_a_lens_that_is_not_sure():
    """Intervals of the camera position allow for stated lens errors of 0.3 % in focal length and 4 px in centre.

    The mean square of normalised errors is below 1.9; it exceeds 3 if the lens is taken as exact.
    """
    camera, random = overhead(), np.random.default_rng(3)
    squares = {"told": [], "not told": []}
    for seed in range(12):
        seen = survey(camera, WATER, FLOOR, 60, seed, pixel=0.25, error=0.002)
        focal, x, y = random.normal(0.0, [0.003, 4.0, 4.0])
        given = replace(
            PLUMB_BOB,
            fx=PLUMB_BOB.fx * (1.0 + focal),
            fy=PLUMB_BOB.fy * (1.0 + focal),
            cx=PLUMB_BOB.cx + x,
            cy=PLUMB_BOB.cy + y,
        )
        for name, sigma in (("told", (0.003, 4.0)), ("not told", (0.0, 0.0))):
            told = PoolFitSettings(
                fit=FIT,
                water_height=1.0,
                place_sigma=0.002,
                focal_sigma=sigma[0],
                center_sigma=sigma[1],
            )
            fit = calibrate_pool(seen, given, told)
            for axis, name_ in enumerate(("camera_x", "camera_y", "camera_z")):
                estimate = fit.estimates[name_]
                std = (estimate.ci95[1] - estimate.ci95[0]) / 3.92
                squares[name].append(((estimate.estimate - camera.position[axis]) / std) ** 2)
    assert np.mean(squares["told"]) < 1.9  # 99.9 % quantile of chi² with 36 degrees of freedom, over 36
    assert np.mean(squares["not told"]) > 3.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_a_flat_floor_with_two_dry_marks_is_not_taken_for_left_handed(seed):
    """Straight rays may fit the mirror image of such a survey better than the survey; refracted ones fit the
    survey."""
    random = np.random.default_rng(seed)
    camera = Camera(PLUMB_BOB, [1.0, -1.6, 5.3], [1.0, 0.0, 0.0, 0.0])
    floor = np.column_stack([random.uniform(-1.7, 3.2, 10), random.uniform(-3.1, 0.2, 10), np.zeros(10)])
    marks = np.array([[0.7, -3.1, 2.46], [2.0, -2.5, 2.46]])
    straight = camera.lens.project((marks - camera.position) @ camera.R_pc)[0]
    pixels = np.concatenate([project(camera, Interface.water(2.29), floor).pixels, straight])
    seen = observations(np.concatenate([floor, marks]), pixels + random.normal(0.0, 1.0, (12, 2)))
    seen = replace(seen, dry=np.arange(12) >= 10)
    fit = calibrate_pool(seen, PLUMB_BOB, PoolFitSettings(fit=FIT, water_height=2.29, survey_sigma=0.01))
    assert np.linalg.norm(fit.model.camera.position - camera.position) < 0.2
