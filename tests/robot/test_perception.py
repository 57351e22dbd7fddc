"""Perception turns sensor messages into the controller's reading, in the right frames and at the right times."""

import math
from dataclasses import replace

import numpy as np
import pytest

from finssim.core.rotations import quat_from_yaw, quat_yaw
from finssim.localization import LocalizationError
from finssim.robot.messages import POSE, NavigationAid, Picture, TagCorners
from finssim.robot.perception import Perception
from finssim.vehicles import load_vehicle
from reference.rounds import Rounds, overhead, without_latency, yaw_between

VEHICLE = without_latency(load_vehicle("finsrov"))
BAD = (math.nan, -math.inf, 3e38)


def run(world, perception, duration, *, telemetry=lambda t, x: x, picture=lambda t, x: x, depart=0.0):
    """Return readings at 60 Hz from telemetry at 100 Hz and pictures at 30 Hz, altered or dropped (None) in
    transit."""
    events = [(depart + 0.01 * k, 0, k) for k in range(round(100 * duration))]
    events += [(depart + k / 30 + world.pool.latency, 1, k) for k in range(round(30 * duration))]
    events += [(depart + k / 60 + 1e-6, 2, k) for k in range(round(60 * duration))]
    readings = []
    for t, kind, k in sorted(events):
        if kind == 0 and (x := telemetry(t, world.telemetry(t, k))) is not None:
            perception.telemetry(t, x, t)
        elif kind == 1 and (x := picture(t, world.picture(depart + k / 30, k))) is not None:
            perception.picture(t, x)
        elif kind == 2:
            readings.append(perception.reading(t))
    return readings


def errors(world, readings):
    """Return rms errors of distance [m], turn [rad], velocity [m/s] and rate [rad/s] against the truth."""
    found = [
        (
            np.linalg.norm(r.position - world.position(r.time)),
            yaw_between(world.quaternion(r.time), r.quaternion),
            np.linalg.norm((r.nu - world.nu(r.time))[:3]),
            np.linalg.norm((r.nu - world.nu(r.time))[3:]),
        )
        for r in readings
    ]
    return np.sqrt(np.mean(np.square(found), axis=0))


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["constant-velocity", "error-state"])
def test_the_state_is_the_vehicles(mode):
    """The state of a moving, rocking vehicle seen 50 ms late is right to 1 cm and 0.5 degrees, its speed to 3
    cm/s."""
    world = Rounds(overhead(latency=0.05), VEHICLE)
    readings = run(world, Perception(VEHICLE, world.pool, mode=mode), 4.0)[90:]
    assert all(r.ready and r.mode == "fresh" and r.reason == "" for r in readings)
    assert np.all(errors(world, readings) < (0.01, math.radians(0.5), 0.03, 0.01))


def test_the_world_frame_of_the_pool_file_is_that_of_the_reading():
    """In a pool surveyed in axes rotated by 40° and shifted, position, heading and velocity are in world
    axes."""
    turned = overhead(world_position=(0.1, -0.2, 0.0), world_orientation=tuple(quat_from_yaw(0.7).tolist()))
    world = Rounds(turned, VEHICLE)
    readings = run(world, Perception(VEHICLE, turned), 3.0)[90:]
    assert all(r.ready for r in readings)
    assert np.all(errors(world, readings) < (0.01, math.radians(0.5), 0.03, 0.01))


def test_fixes_of_another_instrument_are_of_the_world_too():
    """In the same rotated pool, motion capture instead of pictures gives a reading in world axes as well."""
    turned = overhead(world_position=(0.1, -0.2, 0.0), world_orientation=tuple(quat_from_yaw(0.7).tolist()))
    world = Rounds(turned, VEHICLE)
    perception = Perception(VEHICLE, turned)

    def fix(t, picture):
        x, y, _ = world.position(picture.time)
        yaw = float(quat_yaw(np.asarray(world.quaternion(picture.time))))
        aid = NavigationAid(0, POSE, t - picture.time, (float(x), float(y), yaw), (0.003, 0.005))
        perception.aid(t, aid)

    readings = run(world, perception, 3.0, picture=fix)[90:]
    assert all(r.ready for r in readings)
    assert np.all(errors(world, readings) < (0.01, math.radians(0.5), 0.03, 0.01))


def test_a_latency_that_the_pool_file_does_not_tell_shows():
    """Uncompensated pictures 0.1 s late put a vehicle at 0.09 m/s a centimetre behind; with compensation they
    do not."""
    late = overhead(latency=0.1)
    world = Rounds(late, VEHICLE)
    told = errors(world, run(world, Perception(VEHICLE, late), 4.0)[90:])[0]
    untold = errors(world, run(world, Perception(VEHICLE, overhead(latency=0.0)), 4.0)[90:])[0]
    assert told < 0.004 < 0.006 < untold


def test_the_mcus_own_heading_does_not_enter():
    """The mcu's heading is offset and drifts by 10°/s; the estimate uses the camera and the gyro."""
    pool = overhead()
    steady, drifting = (Rounds(pool, VEHICLE, mcu_yaw=y, drift=d) for y, d in ((0.0, 0.0), (2.0, 0.17)))
    a, b = (run(world, Perception(VEHICLE, pool), 2.0)[-1] for world in (steady, drifting))
    np.testing.assert_allclose(a.quaternion, b.quaternion, atol=1e-6)


def test_before_the_first_fix_the_position_is_unknown_and_says_so():
    """Before the first fix the position is NaN and the reading is not ready, with a reason."""
    world = Rounds(overhead(), VEHICLE)
    perception = Perception(VEHICLE, world.pool)
    assert perception.reading(0.0).reason == "no inertial data"
    readings = run(world, perception, 0.5, picture=lambda t, x: None)
    assert not readings[-1].ready and readings[-1].mode == "uninitialized"
    assert readings[-1].reason == "not seen by the camera yet"
    assert np.isnan(readings[-1].position[:2]).all()


def test_without_a_camera_a_fix_is_what_is_missing():
    """Without a camera the reason for not being ready names a missing fix, not a camera."""
    perception = Perception(VEHICLE, None)
    readings = run(Rounds(overhead(), VEHICLE), perception, 0.5, picture=lambda t, x: None)
    assert readings[-1].reason == "no position fix yet, and where it was let in is not given"


def test_three_seconds_without_vision_end_readiness_and_it_comes_back():
    """The states are coast, hold and lost in turn; the reading is ready again once pictures return."""
    world = Rounds(overhead(), VEHICLE)
    readings = run(
        world, Perception(VEHICLE, world.pool), 7.0, picture=lambda t, x: None if 2.0 < t < 5.5 else x
    )
    modes = {r.mode for r in readings if 2.3 < r.time < 5.4}
    assert modes == {"coast", "hold", "lost"}
    assert not any(r.ready for r in readings if 2.9 < r.time < 5.4)
    assert all(r.ready for r in readings if r.time > 6.5)
    assert "not seen by the camera for" in next(r.reason for r in readings if r.time > 4.0)


def test_a_clock_that_is_set_back_costs_a_moment():
    """A clock set back by a minute is first rejected; two seconds later the reading is ready, with current
    rates."""
    world = Rounds(overhead(), VEHICLE)
    perception = Perception(VEHICLE, world.pool)
    assert run(world, perception, 1.0, depart=100.0)[-1].ready
    last = run(world, perception, 2.5, depart=40.0)[-1]
    assert last.ready and np.linalg.norm(last.position - world.position(last.time)) < 0.02
    np.testing.assert_allclose(last.nu[3:], world.nu(last.time)[3:], atol=0.05)


FIELDS = ["quaternion", "gyro", "accel", "depth", "pressure"]


@pytest.mark.slow
@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("bad", BAD)
def test_a_bad_number_in_telemetry_never_raises_and_never_gets_through(field, bad):
    """While it lasts the reading is either not ready or right; afterwards it is ready and right."""
    world = Rounds(overhead(), VEHICLE)

    def broken(t, telemetry):
        if not 0.6 < t < 1.0:
            return telemetry
        value = getattr(telemetry, field)
        return replace(telemetry, **{field: (bad, *value[1:]) if isinstance(value, tuple) else bad})

    readings = run(world, Perception(VEHICLE, world.pool), 1.7, telemetry=broken)
    used = [r for r in readings if r.ready and r.time > 0.4]
    assert np.linalg.norm([r.position - world.position(r.time) for r in used], axis=1).max() < 0.05
    assert readings[-1].ready


@pytest.mark.parametrize("bad", BAD)
def test_bad_corners_never_raise_and_never_get_through(bad):
    """A corner that is not a number gives no fix from that tag; the other tag still does."""
    world = Rounds(overhead(), VEHICLE)

    def broken(t, picture):
        first = picture.tags[0]
        corners = first.corners.copy()
        corners[0, 0] = bad
        return replace(picture, tags=(TagCorners(first.tag_id, corners), *picture.tags[1:]))

    readings = run(world, Perception(VEHICLE, world.pool), 1.0, picture=broken)
    used = [r for r in readings if r.ready]
    assert all(np.linalg.norm(r.position - world.position(r.time)) < 0.05 for r in used)


def test_a_picture_that_is_none_is_counted():
    """Colours, floats, another camera's picture, nothing, or a stamp that is not a number count as invalid
    pictures."""
    world = Rounds(overhead(), VEHICLE)
    perception = Perception(VEHICLE, world.pool)
    run(world, perception, 1.0)
    size = (720, 1280)
    for k, image in enumerate(
        (
            np.zeros((*size, 3), np.uint8),
            np.zeros(size),
            np.zeros((480, 640), np.uint8),
            np.zeros(0, np.uint8),
        )
    ):
        assert perception.picture(2.0 + k, Picture(2.0 + k, k, image=image)) == "not a picture of this camera"
    assert perception.picture(6.0, Picture(6.0, 9)) == "no tag"
    assert perception.picture(7.0, replace(world.picture(6.9, 10), time=math.nan)) == "time not finite"
    assert perception.health().counts["vision"]["not a picture of this camera"] == 4


@pytest.mark.parametrize("what", ["gyro and accel", "depth", "picture"])
def test_a_frozen_sensor_ends_readiness(what):
    """A sensor that repeats its last value with new stamps is trusted only until the freeze can be detected."""
    world = Rounds(overhead(), VEHICLE)
    last = {}

    def stuck(t, telemetry):
        last.setdefault("telemetry", telemetry)
        if t < 1.0:
            last["telemetry"] = telemetry
        names = {"gyro and accel": ("gyro", "accel"), "depth": ("depth",), "picture": ()}[what]
        return replace(telemetry, **{name: getattr(last["telemetry"], name) for name in names})

    def still(t, picture):
        if t < 1.0 or what != "picture":
            last["picture"] = picture
            return picture
        return replace(last["picture"], time=picture.time, sequence=picture.sequence)

    readings = run(world, Perception(VEHICLE, world.pool), 4.0, telemetry=stuck, picture=still)
    assert readings[-1].time > 3.5 and not readings[-1].ready
    assert any(r.ready for r in readings)


def test_telemetry_that_repeats_a_depth_adds_it_once():
    """A 20 Hz depth sensor in 100 Hz telemetry contributes about twenty samples a second."""
    world = Rounds(overhead(), VEHICLE)
    perception, held = Perception(VEHICLE, world.pool), {}

    def repeated(t, telemetry):
        held[round(20.0 * t)] = held.get(round(20.0 * t), telemetry.depth)
        return replace(telemetry, depth=held[round(20.0 * t)])

    run(world, perception, 5.0, telemetry=repeated)
    assert 95 <= sum(perception.health().counts["depth"].values()) <= 105


def test_without_a_filter_the_state_is_the_latest_fix():
    """Ablation without filter: the position is right to centimetres, but the heading drifts like the motor
    controller's."""
    world = Rounds(overhead(), VEHICLE, drift=0.05)
    readings = run(world, Perception(VEHICLE, world.pool, fusion=False), 4.0)
    distance, turn, speed, _ = errors(world, readings[90:])
    assert distance < 0.03 and speed < 0.3 and turn > math.radians(3.0)
    assert all(r.ready for r in readings[90:])


def test_what_cannot_be_is_refused():
    """An invalid method, an invalid mode and a vehicle without tags are each refused in one sentence."""
    pool = overhead()
    with pytest.raises(LocalizationError, match="unknown method 'x'"):
        Perception(VEHICLE, pool, method="x")
    with pytest.raises(LocalizationError, match="unknown estimator 'x'"):
        Perception(VEHICLE, pool, mode="x")
    with pytest.raises(LocalizationError, match="no tags"):
        Perception(VEHICLE.model_copy(update={"tags": None}), pool)


def test_the_gyros_bias_is_taken_off_about_the_vertical():
    """A tilted vehicle turns at 0.3 rad/s about the vertical while its gyro reads 0.05 rad/s too much about
    that axis."""
    perception = Perception(VEHICLE, overhead())
    roll, pitch = 0.2, -0.3
    up = np.array([-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)])
    estimate = perception.estimator.estimate(0.0)
    level = replace(estimate, roll=roll, pitch=pitch, yaw_rate=0.3)
    perception._omega = 0.35 * up
    np.testing.assert_allclose(perception._turning(level), 0.3 * up, atol=1e-12)
