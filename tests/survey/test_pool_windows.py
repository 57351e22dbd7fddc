"""Tanks seen through a window in any orientation."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.core.optics import Interface, Status, project
from finssim.core.rotations import quat_from_rotvec, quat_to_matrix
from finssim.survey.pool_findings import CAMERA
from finssim.survey.pool_fit import calibrate_pool
from finssim.survey.pool_model import PoolFitSettings

from .surveyed_pools import (
    GLASS,
    TANK,
    TANK_LENS,
    before_tank,
    carried,
    observations,
    survey,
    window,
)

FIT = ("pose", "height", "tilt", "index")
BOARD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]).T
"""Axes of boards that hang in the tank, z into the water: columns, in the tank's frame."""

TURNS = [(0, 0), (8, 0), (-8, 0), (0, 8), (0, -8), (12, -9), (-12, 9), (12, 9), (20, 0), (0, -20), (-14, -14)]
"""Turns of the window against the boards, about the boards' two axes [degrees]."""

PIXEL, SURVEY = 0.1, 0.0002


def clearance(camera, plane):
    return float(plane.normal @ camera.position + plane.offset)


def tilt_error(fit, plane):
    return float(np.degrees(np.arccos(min(1.0, fit.model.interface.normal @ plane.normal))))


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [0.0, 20.0, 40.0])
def test_points_behind_a_window(degrees):
    """With a vertical window at any angle to the camera, its plane unknown, held-out points agree to about a
    millimetre."""
    camera, plane = before_tank(degrees), window()
    seen = survey(camera, plane, TANK, 60, pixel=0.25, error=0.0005)
    fit = calibrate_pool(seen, camera.lens, PoolFitSettings(fit=FIT, window=GLASS, survey_sigma=0.0005))
    table = fit.estimates
    assert table["camera_distance"].ci95[0] < clearance(camera, plane) < table["camera_distance"].ci95[1]
    assert tilt_error(fit, plane) < 2.5
    assert fit.held_out.as_json()["rms_cm"] < 0.12
    assert fit.held_out.as_json()["rms_cm"] < 0.5 * fit.pinhole_held_out.as_json()["rms_cm"]


@pytest.mark.slow
def test_a_window_in_the_frame_of_a_target():
    """The frame may be that of a tilted target in the water."""
    camera, plane = before_tank(30.0), window()
    camera, plane, seen = carried(camera, plane, survey(camera, plane, TANK, 60, pixel=0.25, error=0.0005))
    told = PoolFitSettings(fit=FIT, window=GLASS, survey_sigma=0.0005)
    fit = calibrate_pool(seen, camera.lens, told)
    assert tilt_error(fit, plane) < 2.5
    assert np.linalg.norm(fit.model.camera.position - camera.position) < 0.03


@pytest.mark.slow
def test_a_surveyed_plane_makes_a_window_exact():
    camera, plane = before_tank(20.0), window()
    seen = survey(camera, plane, TANK, 60, pixel=0.25, error=0.0005)
    told = PoolFitSettings(
        fit=FIT, window=GLASS, survey_sigma=0.0005, plane=(0.0, 1.0, 0.0, 0.0), place_sigma=0.001
    )
    fit = calibrate_pool(seen, camera.lens, told)
    assert np.linalg.norm(fit.model.camera.position - camera.position) < 0.004
    assert tilt_error(fit, plane) < 0.5


def turned(turn):
    """Return a window turned from the boards about x and z [degrees], through the middle of their edge."""
    R = quat_to_matrix(quat_from_rotvec(np.radians([turn[0], 0.0, turn[1]])))
    normal = R @ np.array([0.0, -1.0, 0.0])
    plane = Interface(normal / np.linalg.norm(normal), 0.0, window=(GLASS,))
    return replace(plane, offset=-float(plane.normal @ np.array([0.0, 0.0, 0.2])))


def boards(camera, plane, seed=5, nearest=0.02):
    """Return five boards one behind the other, as far as they hang in the water, in their own frame."""
    rng = np.random.default_rng(seed)
    x, z = np.meshgrid(np.linspace(-0.12, 0.12, 6), np.linspace(0.1, 0.3, 5))
    layers = [np.column_stack([x.ravel(), np.full(x.size, y), z.ravel()]) for y in np.linspace(0.06, 0.4, 5)]
    points = np.concatenate(layers)
    points = points[-(points @ plane.normal) - plane.offset - plane.thickness > nearest]
    found = project(camera, plane, points + SURVEY * rng.standard_normal(points.shape))
    ok = found.status == Status.OK
    pixels = found.pixels[ok] + PIXEL * rng.standard_normal((ok.sum(), 2))
    return observations(points[ok] @ BOARD, pixels)


def told(**options):
    return PoolFitSettings(fit=FIT, survey_sigma=SURVEY, **options)


def tilt_sigma(fit):
    """Return the calibration's standard error of the normal's direction [degrees]."""
    names = [name for name in fit.estimates if name.startswith("normal")]
    return float(np.degrees(max((np.ptp(fit.estimates[name].ci95)) / 3.92 for name in names)))


def noise():
    """Return the residual due to pixels and survey alone at half a metre and more [px]."""
    return np.sqrt(2.0) * np.hypot(PIXEL, SURVEY * TANK_LENS.fx / 0.7)


@pytest.mark.slow
@pytest.mark.parametrize("turn", TURNS, ids=str)
def test_a_window_turned_against_the_boards(turn):
    """The fitted plane does not depend on how near the first candidate comes to the nearest point."""
    camera, plane = before_tank(10.0), turned(turn)
    seen = boards(camera, plane)
    fit = calibrate_pool(seen, camera.lens, told(window=GLASS))
    normal = plane.normal @ BOARD
    error = float(np.degrees(np.arccos(min(1.0, fit.model.interface.normal @ normal))))
    assert error < max(0.5, 3.0 * tilt_sigma(fit))
    assert error < 1.5
    assert fit.residual_json()["rms_px"] < 1.2 * noise()
    assert fit.used.all()
    assert "plane_touches" not in {one.code for one in fit.findings}


@pytest.mark.slow
@pytest.mark.parametrize("turn", [(8, -6), (-8, 6)], ids=str)
def test_rows_before_the_window_do_not_hold_it(turn):
    """Three points surveyed 15 cm before the window are named, and the plane passes them."""
    camera, plane = before_tank(10.0), turned(turn)
    seen = boards(camera, plane)
    points = seen.points.copy()
    wrong = [3, 40, 77]
    points[wrong] += 0.2 * plane.normal @ BOARD
    fit = calibrate_pool(replace(seen, points=points), camera.lens, told(window=GLASS))
    assert set(fit.outliers) == {f"p{i}" for i in wrong}
    assert fit.residual_json()["rms_px"] < 1.2 * noise()


@pytest.mark.slow
def test_a_plane_at_its_bound_is_told():
    """A window stated far too thick leaves no space for the plane before the nearest board."""
    camera, plane = before_tank(10.0), turned((12, -9))
    seen = boards(camera, plane, nearest=0.001)
    fit = calibrate_pool(seen, camera.lens, told(window=replace(GLASS, thickness=0.12)))
    (touched,) = (one for one in fit.findings if one.code == "plane_touches")
    assert touched.values["places"] and CAMERA not in touched.values["places"]
