"""The virtual pool's camera: drawn pictures and computed corners give a robot the same data."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.core.rotations import quat_from_euler
from finssim.localization.detection.detector import detector
from finssim.pool.camera import CameraSettings, PoolCamera, camera_of
from finssim.pool.plant_spec import PlantSpecError
from finssim.vehicles import load_vehicle

FINSROV = load_vehicle("finsrov")
NOISE = CameraSettings().pixel_noise


def pose_at(t):
    """Return a pose on an ellipse through the pool, with slight rocking."""
    position = np.array([1.3 * np.cos(0.5 * t), 0.6 * np.sin(0.5 * t), -0.45 + 0.2 * np.sin(0.3 * t)])
    return position, quat_from_euler(0.05 * np.sin(3.0 * t), 0.04 * np.cos(2.0 * t), 0.7 * t)


def at(x, y, z, roll=0.0, yaw=0.0):
    """Return the pose function of a vehicle at rest."""
    return lambda t: (np.array([x, y, z]), quat_from_euler(roll, 0.0, yaw))


def camera(mode="corners", severity="nominal", seed=1, **changed):
    """Return the camera of a plant, with some settings changed."""
    true, _, settings = camera_of(FINSROV, 1, severity)
    return PoolCamera(FINSROV, true, mode=mode, settings=replace(settings, **changed), seed=seed)


def seen(eye, pose, duration=0.3):
    """Return the ids of the tags in each picture of a vehicle at rest."""
    return [tuple(tag.tag_id for tag in p.tags) for p in eye.advance(0.0, duration, pose)]


@pytest.mark.slow
@pytest.mark.parametrize(("severity", "most"), [("nominal", 0.05), ("realistic", 0.1), ("hard", 0.25)])
def test_computed_corners_are_those_found_in_drawn_pictures(severity, most):
    """For equal exposures the rms difference per axis [px] is bounded, without the noise of computed corners."""
    drawn = camera("pictures", severity)
    computed = {
        p.sequence: p for p in camera("corners", severity, pixel_noise=0.0).advance(0.0, 12.0, pose_at)
    }
    find = detector(FINSROV.tags.family)
    errors, found, expected = [], 0, 0
    for exposure in drawn.exposures(0.0, 12.0, pose_at)[::12]:
        picture = drawn.develop(exposure)
        here = {t.tag_id: t.corners for t in computed[picture.sequence].tags}
        around = np.concatenate(list(here.values())) if here else np.array([[0, 0], [1280, 720]])
        region = tuple(
            np.clip([*around.min(0) - 60, *around.max(0) + 60], 0, [1280, 720] * 2).astype(int).tolist()
        )
        there = {d.tag: d.corners for d in find.detect(picture.image, region) if d.tag in FINSROV.tags.mounts}
        assert picture.time == computed[picture.sequence].time
        found, expected = found + len(there), expected + len(here)
        errors += [there[tag] - here[tag] for tag in there.keys() & here.keys()]
    assert len(errors) > 45 and abs(found - expected) <= 0.05 * found
    assert np.std(errors) < most
    assert np.abs(np.mean(errors, axis=(0, 1))).max() < 4.0 * most / np.sqrt(len(errors))


def test_pixel_noise_is_that_given():
    """Corners of a tag at rest scatter over pictures by the given noise."""
    for noise in (0.05, 0.3):
        pictures = camera(pixel_noise=noise).advance(0.0, 10.0, at(0.3, 0.2, -0.5))
        scatter = np.std([p.tags[0].corners for p in pictures], axis=0)
        assert abs(scatter.mean() / noise - 1.0) < 0.1


def test_tags_out_of_sight_are_not_reported():
    """Both tags are seen in the middle; none outside the picture, above the water, upside down or far away."""
    assert set(seen(camera(), at(0.0, 0.0, -0.5))) == {(15, 16)}
    for pose in (at(3.5, 0.0, -0.5), at(0.0, 0.0, 0.3), at(0.0, 0.0, -0.5, roll=3.0), at(0.0, 0.0, -6.0)):
        assert set(seen(camera(), pose)) == {()}
    assert set(seen(camera(), at(0.0, 0.0, -0.5, roll=1.5))) == {()}
    at_the_edge = {seen(camera(), at(x, 0.0, -0.6))[0] for x in np.linspace(1.8, 2.4, 25)}
    assert at_the_edge == {(15, 16), (16,), ()}  # the front tag disappears first


def test_wild_water_hides_tags():
    """At a slope of 0.06 many tags are too distorted to be found, at 0.005 none."""
    counts = [
        np.mean([len(tags) for tags in seen(camera(ripples=slope), at(0.2, 0.1, -0.8), 20.0)])
        for slope in (0.005, 0.06)
    ]
    assert counts[0] == 2.0 and counts[1] < 1.6


def test_mounts_are_where_they_truly_are():
    """A tag mounted 10 mm further forward appears 10 mm further forward."""
    mount = FINSROV.tags.mounts[15]
    moved = {15: mount.model_copy(update={"position": mount.position + [0.01, 0.0, 0.0]})}
    a, b = (camera(pixel_noise=0.0, mounts=m).advance(0.0, 0.2, at(0.0, 0.0, -0.5))[0] for m in ({}, moved))
    shift = (b.tags[0].corners - a.tags[0].corners).mean(axis=0)
    assert shift[0] == pytest.approx(0.01 * 540.9 / (1.4 + 0.4 / 1.333), rel=0.02) and abs(shift[1]) < 0.05
    assert np.array_equal(a.tags[1].corners, b.tags[1].corners)


@pytest.mark.slow
def test_exposure_blurs_drawn_pictures():
    """At 1 m/s an exposure of 30 ms leaves less contrast than 1 ms; at rest the contrast is equal."""

    def contrast(exposure, speed):
        eye = camera("pictures", exposure=exposure)
        image = eye.advance(0.0, 0.15, lambda t: (np.array([speed * (t - 0.05), 0.0, -0.5]), np.eye(4)[3]))[
            0
        ].image
        return np.sort(np.abs(image[:, 2:].astype(float) - image[:, :-2]).ravel())[-200:].mean()

    assert contrast(0.030, 1.0) < 0.6 * contrast(0.001, 1.0)
    assert contrast(0.030, 0.0) == pytest.approx(contrast(0.001, 0.0), rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["corners", "pictures"])
def test_equal_seeds_give_equal_pictures_however_time_is_cut(mode):
    """Two cameras of one seed give the same pictures at different tick lengths; a camera of another seed does
    not."""

    def run(tick, seed):
        eye, found = camera(mode, "realistic", seed), []
        for k in range(round(0.4 / tick)):
            found += eye.advance(k * tick, (k + 1) * tick, pose_at)
        return found[:6]

    a, b, other = run(0.01, 1), run(0.1, 1), run(0.1, 2)

    def same(p, q):
        if mode == "pictures":
            return np.array_equal(p.image, q.image)
        return all(np.allclose(s.corners, t.corners, atol=1e-9) for s, t in zip(p.tags, q.tags, strict=True))

    assert all(p.time == q.time and same(p, q) for p, q in zip(a, b, strict=True))
    assert not all(same(p, q) for p, q in zip(a, other, strict=True))


def test_the_basin_is_in_the_picture():
    """A shallower pool changes the picture around the vehicle."""
    from finssim.pool.plant_spec import Basin

    true, _, settings = camera_of(FINSROV, 1, "nominal")
    images = [
        PoolCamera(FINSROV, true, settings=settings, basin=Basin(depth=depth))
        .advance(0.0, 0.1, at(0, 0, -0.3))[0]
        .image
        for depth in (1.0, 0.7)
    ]
    assert np.abs(images[0].astype(int) - images[1]).mean() > 5.0


def test_what_cannot_be_is_refused():
    """A vehicle without tags and an unknown mode are each refused in one sentence."""
    true, _, settings = camera_of(FINSROV, 1, "nominal")
    with pytest.raises(PlantSpecError, match="has no tags"):
        PoolCamera(FINSROV.model_copy(update={"tags": None}), true, settings=settings)
    with pytest.raises(PlantSpecError, match="pictures, corners"):
        PoolCamera(FINSROV, true, mode="film", settings=settings)
