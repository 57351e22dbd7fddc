"""Offsets between streams that see the same motion are found, with an honest error, or nothing is said."""

import numpy as np
import pytest

from calibration.moving_body import MovingBody
from finssim.calibration.importers.assemble import Stream, merge, moved_in_time
from finssim.calibration.motion import stream_offsets, up_in_body
from finssim.calibration.trials.trial import Header, Trial
from finssim.vehicles import load_vehicle

VEHICLE = load_vehicle("bluerov2")
T = np.arange(1500) * 0.02
NOISE = {
    "velocity": 0.01,
    "rates": 0.01,
    "acceleration": 0.05,
    "quaternion": 0.003,
    "position": 0.005,
    "depth": 0.005,
}


def moved(t, channels, offsets):
    """A trial whose groups of columns are moved in time."""
    streams = [
        Stream(source=name, t=t[np.isfinite(x)], channels={name: x[np.isfinite(x)]})
        for name, x in channels.items()
    ]
    table = merge(moved_in_time(streams, offsets))
    return Trial(name="made", t=table.t, channels=table.channels, header=Header(passive=True))


def log(late, noise=0.0, seed=0):
    """A trial in which every group of columns comes late by some seconds."""
    body = MovingBody(seed)
    rng = np.random.default_rng(seed)
    channels = {}
    for group, size in NOISE.items():
        for name, values in body.columns(T, group).items():
            channels[name] = values + noise * size * rng.normal(size=len(T))
    return moved(T, channels, late)


LATE = {"attitude": 0.12, "position": 0.31, "depth": -0.08, "acceleration": 0.055}


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_shifts_put_in_are_found(seed, noise):
    """Each group's shift, negated, is what brings it back, also of depth, which is told against the late position."""
    found = stream_offsets(log(LATE, noise, seed), VEHICLE)
    expected = {"attitude": -0.12, "position": -0.31, "depth": 0.08, "acceleration": -0.055}
    for group, seconds in expected.items():
        assert found[group].seconds == pytest.approx(seconds, abs=0.004 if noise else 0.001)
        assert abs(found[group].seconds - seconds) < 5.0 * found[group].std + 0.002
        assert found[group].correlation > 0.9
    assert found["attitude"].reference == "rates" and found["depth"].reference == "position"


@pytest.mark.slow
@pytest.mark.parametrize(
    "late", [LATE, {"velocity": 0.15}, {"velocity": 0.1, "attitude": 0.03, "depth": 0.05}]
)
def test_what_is_found_is_what_a_map_takes(late):
    """Applying the offsets found as `time_offsets`, all at once, leaves none."""
    made = log(late)
    found = stream_offsets(made, VEHICLE)
    offsets = {group: found[group].seconds for group in late}
    again = stream_offsets(moved(made.t, made.channels, offsets), VEHICLE)
    assert all(abs(offset.seconds) < 0.002 for offset in again.values())


@pytest.mark.parametrize("level", [False, True])
def test_a_late_velocity_is_told_by_an_imu_on_one_clock(level):
    """A DVL's: the depth sensor and the accelerometer are not blamed for it, and only the velocity is."""
    made = log({"velocity": 0.12}, noise=1.0, seed=2)
    if level:  # gravity already taken off
        up = up_in_body(np.stack([made.channels[name] for name in ("qx", "qy", "qz", "qw")], axis=-1))
        free = {name: made.channels[name] - 9.81 * up[:, i] for i, name in enumerate(("ax", "ay", "az"))}
        made = Trial(name="free", t=made.t, channels={**made.channels, **free}, header=made.header)
    found = stream_offsets(made, VEHICLE)
    assert found["velocity"].reference == "acceleration"
    assert found["velocity"].seconds == pytest.approx(-0.12, abs=0.01)
    assert all(abs(found[group].seconds) < 0.01 for group in ("attitude", "position", "depth"))


def test_streams_that_see_no_motion_say_nothing():
    """A vehicle at rest: only noise, and no offset is made of it."""
    rng = np.random.default_rng(0)
    names = ("u", "v", "w", "p", "q", "r", "roll", "pitch", "yaw", "x", "y", "z", "depth")
    channels = {name: 0.01 * rng.normal(size=len(T)) for name in names}
    still = Trial(name="still", t=T, channels=channels, header=Header(passive=True))
    assert stream_offsets(still, VEHICLE) == {}
    constant = Trial(
        name="still", t=T, channels=dict.fromkeys(names, np.zeros(len(T))), header=Header(passive=True)
    )
    assert stream_offsets(constant, VEHICLE) == {}


def test_streams_without_a_partner_are_left_out():
    """A gyro alone has nothing to be compared with."""
    channels = MovingBody(0).columns(T, "rates", "depth")
    assert (
        stream_offsets(Trial(name="alone", t=T, channels=channels, header=Header(passive=True)), VEHICLE)
        == {}
    )
