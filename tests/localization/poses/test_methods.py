"""Every method finds the pose where its assumptions hold, and otherwise gives a reason."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.core.optics import Camera
from finssim.core.rotations import wrap_angle
from finssim.localization.detection.detections import Detection
from finssim.localization.poses.methods import METHODS, NEEDS_DEPTH
from localization.poses.seen_vehicle import LENS, POOLS, TAGS, known, moved, pose, rotation, seen

REFRACTIVE = ("refractive", "refractive-weighted", "refractive-6dof")
PINHOLE = tuple(name for name in METHODS if name not in REFRACTIVE)


def dry(pool):
    """Return the same pool filled with air."""
    interface = pool.interface
    return replace(pool, interface=replace(interface, index_far=interface.index_near, window=()))


@pytest.mark.parametrize("name", POOLS)
@pytest.mark.parametrize("method", REFRACTIVE)
def test_exact_corners_give_the_pose(method, name):
    """Without noise the pose is found to 0.01 cm, over the whole field of view, whatever the interface."""
    for seed in range(12 if method == "refractive" else 4):
        position, angles = pose(name, seed)
        found = METHODS[method](
            seen(POOLS[name], position, angles), POOLS[name], TAGS, known(position, angles), 0.3
        )
        assert found.ok, found.reason
        np.testing.assert_allclose(found.position, position, atol=1e-4)
        np.testing.assert_allclose(found.rotation, rotation(angles), atol=1e-4)
        assert abs(wrap_angle(found.yaw - angles[2])) < 1e-4
        assert found.residual_px < 1e-3
        assert found.corners == 8
        assert found.tags == (15, 16)


@pytest.mark.parametrize("method", METHODS)
def test_without_water_all_methods_agree(method):
    """Where both media are air, every method finds the pose."""
    for seed in range(3):
        position, angles = pose("level water", seed)
        pool = dry(POOLS["level water"])
        detections = seen(pool, position, angles)
        if detections is None:
            continue
        found = METHODS[method](detections, pool, TAGS, known(position, angles), 0.3)
        assert found.ok, found.reason
        np.testing.assert_allclose(found.position, position, atol=1e-4)


def test_equal_indices_make_refractive_and_pinhole_depth_the_same():
    """The same noisy corners give the same numbers to 1e-9, by two different computations of the rays."""
    rng = np.random.default_rng(5)
    for name in ("level water", "tilted water", "window wall", "fisheye"):
        pool = dry(POOLS[name])
        position, angles = pose(name, 3)
        detections = moved(seen(POOLS[name], position, angles), rng.normal(0.0, 0.3, (2, 4, 2)))
        a, b = (
            METHODS[m](detections, pool, TAGS, known(position, angles), 5.0)
            for m in ("refractive", "pinhole-depth")
        )
        assert a.ok and b.ok
        np.testing.assert_allclose(a.position, b.position, atol=1e-9)
        assert abs(a.yaw - b.yaw) < 1e-9
        np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-6)


@pytest.mark.parametrize("method", PINHOLE)
def test_water_leads_a_pinhole_astray(method):
    """Half a metre of water shifts the result of a pinhole camera by centimetres at the rim of the picture."""
    position, angles = np.array([1.0, -0.5, 0.4]), np.array([0.0, 0.0, 0.4])
    pool = POOLS["level water"]
    found = METHODS[method](seen(pool, position, angles), pool, TAGS, known(position, angles), 5.0)
    assert not found.ok or np.linalg.norm(found.position - position) > 0.02


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("detections", "word"),
    [
        ([], "no tag seen"),
        ([Detection(7, np.arange(8.0).reshape(4, 2))], "no tag of the vehicle"),
        ([Detection(15, np.full((4, 2), np.nan))], ""),
        ([Detection(15, np.full((4, 2), 300.0))], ""),
        ([Detection(15, np.full((4, 2), 1e7))], ""),
        ([Detection(15, np.arange(8.0).reshape(4, 2) * 50.0)], "clockwise"),
        ([Detection(15, np.array([[600.0, 300], [600, 340], [640, 340], [640, 300]]))], "clockwise"),
    ],
)
def test_a_bad_picture_is_refused_with_a_reason(method, detections, word):
    """For any detections, no exception is raised, and the measurement states the reason for its refusal."""
    position, angles = pose("level water", 0)
    found = METHODS[method](detections, POOLS["level water"], TAGS, known(position, angles), 0.3)
    assert not found.ok
    assert found.reason
    assert word in found.reason
    assert np.isnan(found.position).all()


@pytest.mark.parametrize("method", METHODS)
def test_what_is_not_used_is_counted(method):
    """An unknown tag and a second detection of a known one change nothing, and are counted."""
    position, angles = pose("level water", 1)
    pool = dry(POOLS["level water"])
    detections = seen(pool, position, angles)
    stranger = Detection(3, detections[0].corners + 40.0)
    double = replace(detections[0], corners=detections[0].corners + 100.0, hamming=1)
    alone = METHODS[method](detections, pool, TAGS, known(position, angles), 0.3)
    found = METHODS[method]([stranger, *detections, double], pool, TAGS, known(position, angles), 0.3)
    np.testing.assert_allclose(found.position, alone.position, atol=1e-9)
    assert found.rejected == {"unknown tag": 4, "tag seen twice": 4}


@pytest.mark.parametrize("method", METHODS)
def test_without_height_only_those_that_need_it_refuse(method):
    """Constraints are required only by the methods that use them."""
    position, angles = pose("level water", 2)
    detections = seen(POOLS["level water"], position, angles)
    found = METHODS[method](detections, POOLS["level water"], TAGS, None, 0.3)
    assert found.ok == (method not in NEEDS_DEPTH)
    assert ("depth" in found.reason) == (method in NEEDS_DEPTH)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("yaw", [np.pi - 1e-3, -np.pi + 1e-3, 0.0, np.pi / 2])
def test_yaw_wraps(method, yaw):
    """Headings on both sides of south are within [-pi, pi], and right to 1e-4 modulo a turn."""
    position, angles = np.array([0.2, -0.1, 0.4]), np.array([0.02, 0.03, yaw])
    pool = dry(POOLS["level water"])
    found = METHODS[method](seen(pool, position, angles), pool, TAGS, known(position, angles), 0.3)
    assert -np.pi <= found.yaw <= np.pi
    assert abs(wrap_angle(found.yaw - yaw)) < 1e-4


@pytest.mark.parametrize("method", METHODS)
def test_two_tags_are_surer_than_one(method):
    """Every standard deviation shrinks when a second tag is seen."""
    position, angles = np.array([0.5, -0.3, 0.4]), np.array([0.05, -0.08, 0.7])
    pool = dry(POOLS["level water"])
    detections = seen(pool, position, angles)
    exact = known(position, angles, z_std=0.0, tilt_std=0.0)
    one, two = (METHODS[method](some, pool, TAGS, exact, 0.3) for some in (detections[:1], detections))
    assert (two.std < one.std).all()
    assert (two.std[:2] < one.std[:2] / np.sqrt(1.9)).all()


@pytest.mark.parametrize("method", METHODS)
def test_a_lens_of_any_model_will_do(method):
    """Rational and fisheye lenses of the same view give the same pose."""
    position, angles = np.array([0.3, 0.2, 0.4]), np.array([0.0, 0.1, 0.7])
    for model, distortion in (("rational", (0.1, 0.02, 0.0, 0.001, 0.0, 0.12, 0.03, 0.0)), ("fisheye", ())):
        lens = replace(LENS, model=model, distortion=distortion)
        pool = dry(POOLS["level water"])
        pool = replace(pool, camera=Camera(lens, pool.camera.position, pool.camera.orientation))
        found = METHODS[method](seen(pool, position, angles), pool, TAGS, known(position, angles), 0.3)
        np.testing.assert_allclose(found.position, position, atol=1e-4)
