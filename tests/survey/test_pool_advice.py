"""Poor geometry, wrong rows, tapes and camera files are detected and reported."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.core.optics import Interface, Lens
from finssim.survey.pool_findings import numbers
from finssim.survey.pool_fit import calibrate_pool, with_critical_findings
from finssim.survey.pool_model import PoolFitSettings
from finssim.trials.findings import CalibrationError

from .surveyed_pools import (
    FLOOR,
    GLASS,
    PLUMB_BOB,
    SOLID,
    TANK,
    TANK_LENS,
    before_tank,
    looking,
    observations,
    overhead,
    survey,
    window,
)

WATER = Interface.water(1.0)
FIT = ("pose", "height", "tilt", "index")


def codes(fit):
    """Return the codes of the findings, the most severe first."""
    return [one.code for one in fit.findings]


def tilt_error(fit, plane):
    return float(np.degrees(np.arccos(min(1.0, fit.model.interface.normal @ plane.normal))))


@pytest.mark.slow
@pytest.mark.parametrize("box", [FLOOR, SOLID], ids=["floor", "solid"])
def test_wrong_rows_are_named_and_left_out(box):
    """With two pairs exchanged and one point 20 cm off, exactly these five are named."""
    seen = survey(overhead(), WATER, box, 40)
    points = seen.points.copy()
    points[[3, 11, 20, 30]] = points[[11, 3, 30, 20]]
    points[7, 0] += 0.2
    fit = calibrate_pool(replace(seen, points=points), PLUMB_BOB, PoolFitSettings(fit=FIT, water_height=1.0))
    assert set(fit.outliers) == {"p3", "p7", "p11", "p20", "p30"}
    assert fit.model.camera.position[2] == pytest.approx(2.2, abs=0.01)


@pytest.mark.slow
def test_a_rough_camera_file_is_found_out():
    """With a focal length 3 % off and no distortion, the lens is fitted, and this is reported."""
    rough = Lens(1280, 720, 557.0, 557.0, 640.0, 360.0, "plumb_bob", ())
    seen = survey(overhead(), WATER, SOLID, 80)
    fit = calibrate_pool(seen, rough, PoolFitSettings(water_height=1.0))
    assert "focal" in fit.lens_fitted
    assert "lens_refitted" in codes(fit)
    assert fit.held_out.as_json()["rms_cm"] < 0.6
    held = calibrate_pool(seen, rough, PoolFitSettings(fit=FIT, water_height=1.0))
    assert held.held_out.as_json()["rms_cm"] > 2.0 * fit.held_out.as_json()["rms_cm"]


def test_a_good_camera_file_is_left_alone():
    seen = survey(overhead(), WATER, FLOOR, 60)
    assert calibrate_pool(seen, PLUMB_BOB, PoolFitSettings(water_height=1.0)).lens_fitted == ()


def test_points_near_the_axis_tell_no_height():
    """Seen from above, water only brings the floor nearer: the height is reported as unknown, and the map is
    right."""
    seen = survey(overhead(), WATER, ((-0.2, -0.4, 0.0), (0.2, 0.0, 1e-12)), 40)
    fit = calibrate_pool(seen, PLUMB_BOB, PoolFitSettings(fit=FIT))
    assert not fit.estimates["camera_height"].identifiable
    assert any(
        one.code == "points_narrow" and "surface: height" in one.values["remedy"] for one in fit.findings
    )
    assert fit.held_out.as_json()["rms_cm"] < 0.5
    low, high = fit.estimates["camera_height"].ci95
    assert low < 1.2 < high


@pytest.mark.slow
def test_a_sloping_floor_taken_for_level_is_noticed():
    """With the water 1.2 degrees from the survey's level, the level constraint is dropped, which is reported."""
    water = Interface.water(1.0, tilt_x=0.02)
    camera = looking((-2.5, 0.0, 2.5), (0.0, 0.0, 0.0), PLUMB_BOB, (0.0, 0.0, 1.0))
    seen = survey(camera, water, ((-2.0, -1.5, 0.0), (2.0, 1.5, 0.5)), 80, error=0.001)
    told = PoolFitSettings(fit=FIT, water_height=1.0, place_sigma=0.02, survey_sigma=0.001)
    fit = calibrate_pool(seen, PLUMB_BOB, told)
    assert "plane_tilted" in codes(fit)
    assert tilt_error(fit, water) < 0.5


@pytest.mark.slow
def test_a_wrong_tape_is_contradicted():
    seen = survey(overhead(), WATER, SOLID, 80)
    fit = calibrate_pool(seen, PLUMB_BOB, PoolFitSettings(fit=FIT, water_height=1.3, place_sigma=0.005))
    assert "plane_contradicted" in codes(fit)


@pytest.mark.slow
def test_dry_points_help():
    """Markers above the water fix the camera: the interval of the water's height shrinks by at least a third."""
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
    told = PoolFitSettings(fit=FIT)
    half = [np.ptp(calibrate_pool(s, PLUMB_BOB, told).estimates["water_height"].ci95) for s in (wet, both)]
    assert half[1] < half[0] / 1.5


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.7, 1.4])
def test_a_guessed_focal_length_is_enough(factor):
    """Points at many depths recover the focal length within 2 % from a guess 30 or 40 % off."""
    guess = Lens(1280, 720, 541.0 * factor, 541.0 * factor, 640.0, 360.0, "plumb_bob", ())
    seen = survey(overhead(), WATER, SOLID, 80)
    fit = calibrate_pool(seen, guess, PoolFitSettings(water_height=1.0, focal_sigma=0.3))
    assert fit.model.camera.lens.fx == pytest.approx(540.93, rel=0.02)
    assert np.linalg.norm(fit.model.camera.position - overhead().position) < 0.03
    assert fit.held_out.as_json()["rms_cm"] < 0.5
    unsaid = calibrate_pool(seen, guess, PoolFitSettings(water_height=1.0))
    assert "focal_pulled" in codes(unsaid)


def rim(camera, count=8):
    """Return markers above the water, seen in straight lines, in the form of `survey`."""
    rng = np.random.default_rng(2)
    points = rng.uniform((-0.8, -0.4, 1.02), (0.8, 0.3, 1.3), (count, 3))
    pixels, ok = camera.lens.project((points - camera.position) @ camera.R_pc)
    assert ok.all()
    return points, pixels + 0.25 * rng.standard_normal((count, 2))


@pytest.mark.slow
def test_marks_above_the_water_are_told_from_wrong_rows():
    """Eight rim marks lack their flag, and one mark under water is 20 cm off."""
    wet = survey(overhead(), WATER, FLOOR, 40)
    points, pixels = rim(overhead())
    wrong = wet.points.copy()
    wrong[7, 0] += 0.2
    seen = observations(np.concatenate([wrong, points]), np.concatenate([wet.pixels, pixels]))
    fit = calibrate_pool(seen, PLUMB_BOB, PoolFitSettings(fit=FIT, water_height=1.0))
    of = {one.code: one.values for one in fit.findings}
    assert of["marks_dry"]["marks"] == tuple(f"p{i}" for i in range(40, 48))
    assert of["rows_wrong"] == {"rows": 1}


def test_points_without_water_are_noticed():
    """For pixels of points in air, calibrated as a tank, straight lines predict better; this finding comes
    first."""
    camera = before_tank(30.0)
    points = survey(camera, window(), TANK, 60, error=0.0).points
    pixels, _ = camera.lens.project((points - camera.position) @ camera.R_pc)
    pixels = pixels + 0.25 * np.random.default_rng(1).standard_normal(pixels.shape)
    told = PoolFitSettings(
        fit=FIT, window=GLASS, plane=(0.0, 1.0, 0.0, 0.0), index_sigma=0.0, survey_sigma=0.0005
    )
    fit = with_critical_findings(calibrate_pool(observations(points, pixels), TANK_LENS, told))
    assert codes(fit)[0] == "straight_better"


@pytest.mark.slow
@pytest.mark.parametrize("box", [FLOOR, SOLID], ids=["floor", "solid"])
def test_points_in_water_raise_no_doubt(box):
    fit = calibrate_pool(
        survey(overhead(), WATER, box, 60), PLUMB_BOB, PoolFitSettings(fit=FIT, water_height=1.0)
    )
    assert with_critical_findings(fit).findings == fit.findings


@pytest.mark.slow
@pytest.mark.parametrize(("option", "value"), [("water_height", 100.0), ("water_depth", 100.0)])
def test_centimetres_for_metres_are_refused(option, value):
    seen = survey(overhead(), WATER, FLOOR, 40)
    fit = calibrate_pool(seen, PLUMB_BOB, PoolFitSettings(fit=FIT, **{option: value}))
    with pytest.raises(
        CalibrationError, match=f"surface: {option.removeprefix('water_')} 100 puts the plane 100 m.*unit"
    ):
        with_critical_findings(fit)


@pytest.mark.parametrize(("pixels", "refused"), [(4.0, False), (30.0, True)])
def test_a_camera_on_the_plane_with_large_residuals_is_doubted(pixels, refused):
    """With a sound calibration moved onto its plane, 4 px are questioned and 30 px refused.

    0.3 px are accepted: a camera at a window.
    """
    fit = calibrate_pool(
        survey(overhead(), WATER, FLOOR, 40), PLUMB_BOB, PoolFitSettings(fit=FIT, water_height=1.0)
    )
    plane = replace(
        fit.model.interface, offset=-float(fit.model.interface.normal @ fit.model.camera.position)
    )
    touching = replace(fit, model=replace(fit.model, interface=plane))
    assert with_critical_findings(touching).findings == fit.findings
    poor = replace(touching, residual=np.full_like(fit.residual, pixels / np.sqrt(2.0)))
    if refused:
        with pytest.raises(CalibrationError, match="on the plane itself"):
            with_critical_findings(poor)
    else:
        assert codes(with_critical_findings(poor))[0] == "camera_on_plane"


@pytest.mark.slow
def test_a_flat_left_handed_survey_is_warned_of():
    """A floor with negated y could as well have z down; the water's height or a second depth decides."""
    turn = np.array([1.0, -1.0, 1.0])
    left = survey(overhead(), WATER, FLOOR, 40)
    left = replace(left, points=left.points * turn)
    told = PoolFitSettings(fit=FIT)
    assert codes(with_critical_findings(calibrate_pool(left, PLUMB_BOB, told)))[0] == "handedness_open"
    with pytest.raises(CalibrationError, match="other side"):
        calibrate_pool(left, PLUMB_BOB, replace(told, water_height=1.0))
    down = calibrate_pool(left, PLUMB_BOB, replace(told, water_height=-1.0))
    assert with_critical_findings(down).findings == down.findings
    solid = survey(overhead(), WATER, SOLID, 40)
    down = calibrate_pool(replace(solid, points=solid.points * turn * [1, 1, -1]), PLUMB_BOB, told)
    assert with_critical_findings(down).findings == down.findings


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.94, 0.96])
def test_a_lens_that_misfits_before_a_known_window_may_be_fitted(factor):
    """With window and index known and the lens not, index or window is fitted, and the advice says how to fit
    the lens."""
    rough = replace(TANK_LENS, fx=TANK_LENS.fx * factor, fy=TANK_LENS.fy * factor)
    seen = survey(before_tank(30.0), window(), TANK, 60, error=0.0005)
    told = PoolFitSettings(fit=FIT, window=GLASS, plane=(0.0, 1.0, 0.0, 0.0), survey_sigma=0.0005)
    fit = calibrate_pool(seen, rough, told)
    assert any(
        one.code in ("index_pulled", "tilt_pulled") and "index, focal, center" in one.values["remedy"]
        for one in fit.findings
    )


@pytest.mark.slow
@pytest.mark.parametrize("plane", [None, (0.0, 1.0, 0.0, 0.0)], ids=["surface", "window"])
def test_correlations_bear_the_names_of_the_table(plane):
    if plane is None:
        seen, lens = survey(overhead(), WATER, SOLID, 40), PLUMB_BOB
    else:
        seen, lens = survey(before_tank(30.0), window(), TANK, 40, error=0.0005), TANK_LENS
    fit = calibrate_pool(seen, lens, PoolFitSettings(fit=FIT, window=GLASS if plane else None, plane=plane))
    fitted = [name for name, estimate in fit.estimates.items() if estimate.note != "as given"]
    assert list(fit.correlation.names) == fitted
    np.testing.assert_allclose(np.diagonal(fit.correlation.matrix), 1.0)
    np.testing.assert_allclose(fit.correlation.matrix, fit.correlation.matrix.T, atol=1e-12)


@pytest.mark.slow
def test_a_survey_that_is_rougher_than_stated_is_noticed_with_its_error():
    """Errors of three times the assumed 2 mm are reported as 6 mm."""
    seen = survey(overhead(), WATER, SOLID, 40)
    fit = calibrate_pool(seen, PLUMB_BOB, PoolFitSettings(fit=FIT, water_height=1.0))
    assert "survey_rough" not in codes(fit)
    rough = replace(fit, noise=replace(fit.noise, survey=0.002, scale=3.0))
    (found,) = (one for one in numbers(rough, seen) if one.code == "survey_rough")
    assert found.values == {"times": 3.0, "error": pytest.approx(6.0)}
