"""The virtual pool's camera: its field of view, and the errors of its calibration."""

from dataclasses import fields

import numpy as np
import pytest

from finssim.core.optics import Status, project
from finssim.localization.overhead_camera import load_pool, write_pool
from finssim.pool.camera import CameraSettings, camera_of, true_site
from finssim.pool.plant_spec import Basin, PlantSpecError
from finssim.vehicles import load_vehicle

FINSROV = load_vehicle("finsrov")
SEEDS = range(200)


def turn(a, b):
    """Return the angle between two orientations [rad]."""
    return 2.0 * np.arccos(np.clip(abs(np.dot(a, b)), 0.0, 1.0))


@pytest.mark.parametrize("scale", [1.0, 1.5])
def test_the_whole_pool_is_seen_from_half_a_metre_down(scale):
    """The tags of a vehicle half a metre down, 0.1 m above its middle, are in view as far as the walls of the
    pool."""
    basin = Basin(length=4.0 * scale, width=2.0 * scale)
    site = true_site(basin)
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 41) * basin.length, np.linspace(-0.5, 0.5, 21) * basin.width)
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, basin.depth - 0.4 * scale)], axis=1)
    assert (project(site.camera, site.interface, points).status == Status.OK).all()


def test_tags_off_the_walls_are_seen_from_little_depth():
    """Tags at least 0.23 m off the ends and 0.13 m off the sides are seen from 0.1 m under the surface."""
    site = true_site()
    x, y = np.meshgrid([-1.77, 1.77], [-0.87, 0.87])
    for depth in (0.1, 0.3, 0.7):
        points = np.stack([x.ravel(), y.ravel(), np.full(4, 1.0 - depth)], axis=1)
        assert (project(site.camera, site.interface, points).status == Status.OK).all()


def test_the_world_lies_on_the_water_above_the_middle():
    """The world's origin is in the middle of the pool on the still surface; the pool frame's is on the floor."""
    assert np.allclose(
        true_site(Basin(depth=1.3)).T_pw, np.array(np.eye(4) + 1.3 * np.eye(4, k=1) * [[0], [0], [1], [0]])
    )


def test_a_nominal_camera_is_known():
    """Severity nominal: the calibration is the truth, the tags are where the file says, the water is flat."""
    true, calibrated, settings = camera_of(FINSROV, 3, "nominal")
    assert true.sha256 == calibrated.sha256
    assert settings.ripples == settings.jitter == settings.dropout == 0.0
    for tag, mount in FINSROV.tags.mounts.items():
        assert np.allclose(settings.mounts[tag].position, mount.position)


@pytest.mark.parametrize(("severity", "factor"), [("realistic", 1.0), ("hard", 2.0)])
def test_calibration_errors_have_the_size_that_they_are_said_to_have(severity, factor):
    """Over 200 seeds: position 2 mm, tilt 0.1°, focal 0.1 %, water 2 mm, latency 3 ms, mounts 1 mm and 0.2°."""
    drawn = [camera_of(FINSROV, seed, severity) for seed in SEEDS]
    measured = {
        0.002: [c.camera.position - t.camera.position for t, c, _ in drawn],
        0.001: [c.camera.lens.fx / t.camera.lens.fx - 1.0 for t, c, _ in drawn],
        0.0020001: [c.T_pw[2, 3] - t.T_pw[2, 3] for t, c, _ in drawn],
        0.003: [c.latency - t.latency for t, c, _ in drawn],
        0.0010001: [s.mounts[15].position - FINSROV.tags.mounts[15].position for _, _, s in drawn],
    }
    for std, errors in measured.items():
        n = np.size(errors)
        assert abs(np.std(errors) / (factor * std) - 1.0) < 4.0 / np.sqrt(2 * n)
        assert abs(np.mean(errors)) < 4.0 * factor * std / np.sqrt(n)
    tilts = [turn(c.camera.orientation, t.camera.orientation) for t, c, _ in drawn]
    turns = [turn(s.mounts[16].orientation, FINSROV.tags.mounts[16].orientation) for _, _, s in drawn]
    for degrees, angles in ((0.1, tilts), (0.2, turns)):
        rms = np.sqrt(np.mean(np.square(angles)) / 3.0)
        assert abs(rms / (factor * np.radians(degrees)) - 1.0) < 4.0 / np.sqrt(6 * len(angles))


def test_equal_seeds_give_equal_cameras_and_other_seeds_others(tmp_path):
    """The same seed repeats and another differs; the calibrated pool survives its file."""
    (a, b, s), (c, d, r), (_, other, _) = (camera_of(FINSROV, seed) for seed in (5, 5, 6))
    assert a.sha256 == c.sha256 and b.sha256 == d.sha256 != other.sha256
    assert all(np.array_equal(s.mounts[k].position, r.mounts[k].position) for k in s.mounts)
    write_pool(b, tmp_path / "pool.yaml")
    assert load_pool(tmp_path / "pool.yaml").sha256 == b.sha256


def test_vehicles_without_tags_and_unknown_severities_are_refused():
    """Each in one sentence that says what to do."""
    bare = FINSROV.model_copy(update={"tags": None})
    with pytest.raises(PlantSpecError, match="has no tags"):
        camera_of(bare, 1, "nominal")
    with pytest.raises(PlantSpecError, match="nominal, realistic, hard"):
        camera_of(FINSROV, 1, "easy")
    assert {f.name for f in fields(CameraSettings)} >= {"rate", "exposure", "latency", "jitter", "dropout"}
