"""The constrained fit: its covariance is valid, outliers have little effect, the surface may cut through a tag."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.core.optics import Camera, Interface
from finssim.core.rotations import matrix_to_quat, wrap_angle
from finssim.localization.detection.detections import Detection
from finssim.localization.poses import Constraints, tilt_matrix
from finssim.localization.poses.planar import corner_points, planar_fit, rigid_fit
from localization.poses.seen_vehicle import POOLS, TAGS, known, moved, pose, rotation, seen

POOL = POOLS["level water"]


def errors(found, position, angles):
    """Return (x, y, yaw), estimated minus true."""
    return np.array([*(found.position - position)[:2], wrap_angle(found.yaw - angles[2])])


def nees(pool, position, angles, truth, runs, rng, up=(0.0, 0.0, 1.0), tags=TAGS):
    """Return the mean normalised squared error over runs with noise of `truth` on corners, height and tilt."""
    exact = seen(pool, position, angles, tags, up)
    port = np.array(truth.port)
    height = float(np.array(up) @ position) + (tilt_matrix(*angles[:2]) @ port)[2]
    total = []
    for _ in range(runs):
        roll, pitch = angles[:2] + truth.tilt_std * rng.normal(size=2)
        z_b = height + truth.z_std * rng.normal() - (tilt_matrix(roll, pitch) @ port)[2]
        noise = 0.3 * rng.normal(size=(len(exact), 4, 2)) + truth.shared_pixel_std * rng.normal(size=2)
        given = replace(truth, z_b=z_b, roll=roll, pitch=pitch)
        found = planar_fit(moved(exact, noise), pool, tags, given, 0.3)
        e = errors(found, position, angles)
        total.append(e @ np.linalg.solve(found.covariance, e))
    return np.mean(total)


CASES = {
    "pixels alone": Constraints(0.0, z_std=0.0, tilt_std=0.0),
    "height": Constraints(0.0, z_std=0.01, tilt_std=0.0),
    "tilt": Constraints(0.0, z_std=0.0, tilt_std=np.radians(1.0)),
    "tilt about a distant port": Constraints(0.0, z_std=0.0, tilt_std=np.radians(1.0), port=(0.3, 0.2, -0.2)),
    "shared pixels": Constraints(0.0, z_std=0.0, tilt_std=0.0, shared_pixel_std=1.0),
    "all": Constraints(
        0.0, z_std=0.01, tilt_std=np.radians(0.5), port=(0.0, 0.0, -0.115), shared_pixel_std=0.5
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_the_covariance_is_that_of_the_errors(case):
    """NEES over 400 noisy measurements averages 3, the number of unknowns, within its 99.9 % band."""
    value = nees(
        POOL,
        np.array([0.8, -0.4, 0.3]),
        np.array([0.1, -0.15, 2.0]),
        CASES[case],
        400,
        np.random.default_rng(1),
    )
    # Chi² with 1200 degrees of freedom divided by 400; Huber's rho adds 3 %.
    assert 3.0 - 0.42 < value < 3.0 + 0.55


@pytest.mark.slow
@pytest.mark.parametrize("name", POOLS)
def test_the_covariance_holds_everywhere(name):
    """The covariance is valid at other positions, behind windows and with other lenses."""
    position, angles = pose(name, 7)
    value = nees(POOLS[name], position, angles, CASES["all"], 300, np.random.default_rng(2))
    assert 3.0 - 0.49 < value < 3.0 + 0.64


def test_one_tag_alone_has_an_honest_covariance():
    """Four corners leave five degrees of freedom, and the covariance is still valid."""
    one = {15: TAGS[15]}
    value = nees(
        POOL,
        np.array([0.8, -0.4, 0.3]),
        np.array([0.1, -0.15, 2.0]),
        CASES["all"],
        400,
        np.random.default_rng(3),
        tags=one,
    )
    assert 3.0 - 0.42 < value < 3.0 + 0.6


def test_height_and_tilt_follow_the_water_where_the_survey_is_not_level():
    """Depth, roll and pitch about the water's vertical give the pose in the survey's frame, with z up or down."""
    for up in (np.array([0.02, -0.03, 1.0]), np.array([0.01, 0.02, -1.0])):
        up = up / np.linalg.norm(up)
        camera = POOL.camera
        pool = replace(POOL, interface=Interface.through([0, 0, 0.96], up))
        if up[2] < 0.0:  # a survey with z down: the same pool, turned upside down
            turn = np.diag([1.0, -1.0, -1.0])
            camera = Camera(camera.lens, turn @ camera.position, matrix_to_quat(turn @ camera.R_pc))
            pool = replace(pool, camera=camera, interface=Interface.through([0, 0, -0.96], up))
        position, angles = np.array([0.6, -0.3, 0.4 * np.sign(up[2])]), np.array([0.05, -0.1, 0.5])
        detections = seen(pool, position, angles, up=tuple(up))
        given = Constraints(float(up @ position), 0.01, angles[0], angles[1], np.radians(0.5), up=tuple(up))
        found = planar_fit(detections, pool, TAGS, given, 0.3)
        np.testing.assert_allclose(found.position, position, atol=1e-6)
        np.testing.assert_allclose(found.rotation, rotation(angles, tuple(up)), atol=1e-6)
        assert found.yaw == pytest.approx(np.arctan2(found.rotation[1, 0], found.rotation[0, 0]))


def test_a_corner_far_off_is_left_out_and_counted():
    """A corner 15 px off moves the result by less than 2 mm and 1 degree, and is counted."""
    position, angles = np.array([0.5, 0.3, 0.4]), np.array([0.0, 0.1, -2.0])
    exact = seen(POOL, position, angles)
    for tag, corner in ((0, 0), (0, 2), (1, 3)):
        change = np.zeros((2, 4, 2))
        change[tag, corner] = [9.0, -12.0]
        found = planar_fit(moved(exact, change), POOL, TAGS, known(position, angles), 0.3)
        assert found.ok
        assert found.rejected == {"outlier": 1}
        assert found.corners == 7
        assert np.abs(errors(found, position, angles)).max() < 1e-6


def test_a_corner_a_little_off_does_little():
    """A corner 3 px off, too little to be excluded, moves the result by a third of the shift without weights."""
    position, angles = np.array([0.5, 0.3, 0.4]), np.array([0.0, 0.1, -2.0])
    change = np.zeros((2, 4, 2))
    change[0, 0] = [3.0, 0.0]
    detections = moved(seen(POOL, position, angles), change)
    robust = planar_fit(detections, POOL, TAGS, known(position, angles), 0.3)
    trusting = planar_fit(detections, POOL, TAGS, known(position, angles), 3.0)
    assert robust.corners == trusting.corners == 8
    assert (
        np.hypot(*errors(robust, position, angles)[:2])
        < np.hypot(*errors(trusting, position, angles)[:2]) / 3.0
    )


def test_tags_that_contradict_each_other_are_refused():
    """Two tags half a metre apart that should be 14 cm apart are both refused; a third one decides."""
    position, angles = np.array([0.4, 0.1, 0.4]), np.array([0.0, 0.0, 1.0])
    elsewhere = seen(POOL, position + [-0.5, 0.1, 0.0], angles)
    here = seen(POOL, position, angles)
    found = planar_fit([here[0], elsewhere[1]], POOL, TAGS, known(position, angles), 0.3)
    assert not found.ok
    assert "residual too large" in found.reason
    tags = {**TAGS, 17: TAGS[15] + [0.0, 0.2, 0.0]}
    three = seen(POOL, position, angles, tags)
    found = planar_fit([three[0], elsewhere[1], three[2]], POOL, tags, known(position, angles), 0.3)
    assert found.ok
    assert found.tags == (15, 17)
    np.testing.assert_allclose(found.position, position, atol=1e-6)


def test_a_tag_of_another_size_is_refused():
    """A printed edge half as long as in the vehicle file does not pass as the tag."""
    position, angles = np.array([0.4, 0.1, 0.6]), np.array([0.0, 0.0, 1.0])
    small = {15: TAGS[15].mean(axis=0) + 0.5 * (TAGS[15] - TAGS[15].mean(axis=0))}
    found = planar_fit(seen(POOL, position, angles, small), POOL, TAGS, known(position, angles), 0.3)
    assert not found.ok
    assert "residual" in found.reason


@pytest.mark.parametrize(
    ("z", "roll", "medium"), [(-0.06, 0.0, "air"), (-0.16, 0.0, "water"), (-0.1, 0.3, "both")]
)
def test_the_surface_may_lie_below_across_or_above_the_tags(z, roll, medium):
    """By their heights, corners in the air are seen along straight rays, corners in the water along refracted ones."""
    for name in ("level water", "tilted water"):
        height = float(POOLS[name].interface.height(0.5, -0.3))
        position, angles = np.array([0.5, -0.3, height + z]), np.array([roll, 0.02, 0.3])
        found = planar_fit(
            seen(POOLS[name], position, angles), POOLS[name], TAGS, known(position, angles), 0.3
        )
        np.testing.assert_allclose(found.position, position, atol=1e-6)
        assert abs(found.yaw - 0.3) < 1e-5
        assert found.medium == medium


def test_nothing_happens_while_the_vehicle_surfaces():
    """From 3 cm below to 3 cm above, a step of 1 mm in depth never moves the result by more than 1 mm and 0.2 degrees
    beyond the motion itself, although the given height is wrong by 1 cm."""
    steps = []
    for z in np.arange(0.83, 0.89, 0.001):
        position, angles = np.array([0.5, -0.3, z]), np.array([0.05, 0.02, 0.3])
        wrong = replace(known(position, angles), z_b=z + 0.01)
        steps.append(
            errors(planar_fit(seen(POOL, position, angles), POOL, TAGS, wrong, 0.3), position, angles)
        )
    assert np.abs(np.diff(steps, axis=0)).max(axis=0) == pytest.approx(0.0, abs=1e-3 * 3.5)


def test_weights_in_pixels_are_as_good_as_metres_and_a_little_better():
    """Near the rim, where a pixel spans more metres along the ray than across, weights in pixels are nowhere worse.

    The corners of one vehicle are close together, so that all weights are nearly the same ellipse: the gain is 1 %.
    """
    position, angles = np.array([1.15, -0.6, 0.15]), np.array([0.3, 0.3, 0.0])
    rng, exact = np.random.default_rng(4), seen(POOL, position, angles)
    given, ours, metres = known(position, angles), [], []
    level = np.concatenate(list(TAGS.values())) @ tilt_matrix(*angles[:2]).T
    for _ in range(300):
        noisy = moved(exact, 0.3 * rng.normal(size=(2, 4, 2)))
        ours.append(errors(planar_fit(noisy, POOL, TAGS, given, 0.3), position, angles))
        pixels = np.concatenate([d.corners for d in noisy])
        Q = corner_points(POOL, np.eye(3), pixels, position[2] + level[:, 2], straight=False).Q
        xi = rigid_fit(Q, level[:, :2], np.broadcast_to(np.eye(2), (8, 2, 2)), 1e9).xi
        metres.append([xi[0] - position[0], xi[1] - position[1], wrap_angle(xi[2] - angles[2])])
    ratio = np.sqrt(np.mean(np.square(ours), axis=0) / np.mean(np.square(metres), axis=0))
    assert (ratio < 1.01).all()
    assert ratio.prod() < 1.0


def test_rays_that_miss_are_counted():
    """A corner beyond the lens's range, or a height above the camera, gives no point."""
    position, angles = np.array([0.2, 0.1, 0.4]), np.zeros(3)
    detections = seen(POOL, position, angles)
    above = planar_fit(detections, POOL, TAGS, replace(known(position, angles), z_b=5.0), 0.3)
    assert not above.ok
    assert above.rejected == {"away": 8}
    assert "8 away" in above.reason
    lost = [Detection(15, np.array([[-6e3, 5e3], [6e3, 5e3], [6e3, 1.5e4], [-6e3, 1.5e4]]))]
    found = planar_fit(lost, POOLS["fisheye"], TAGS, known(position, angles), 0.3)
    assert not found.ok
    assert found.rejected == {"no ray": 4}
