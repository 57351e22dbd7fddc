"""Tanks seen through a wall of any direction, with glass or without."""

import numpy as np
import pytest

from finssim.calibration.vision.pool_fit import calibrate_pool
from finssim.calibration.vision.pool_settings import Settings

from .surveyed_pools import (
    GLASS,
    TANK,
    before_tank,
    carried,
    survey,
    wall,
)

FIT = ("pose", "height", "tilt", "index")


def clearance(camera, plane):
    return float(plane.normal @ camera.position + plane.offset)


def tilt_error(fit, plane):
    return float(np.degrees(np.arccos(min(1.0, fit.model.interface.normal @ plane.normal))))


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
