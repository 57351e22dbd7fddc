"""The estimator: order of delivery, silences, wrong camera data, clock faults, and its status messages."""

import json
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from finssim.core.rotations import quat_to_matrix, wrap_angle
from finssim.localization import LocalizationError
from finssim.localization.fusion import position_filter
from finssim.localization.fusion.attitude import up_of
from finssim.localization.fusion.estimator import MODELS, Estimator
from finssim.localization.fusion.fuse_settings import Settings
from finssim.localization.fusion.position_filter import PositionState
from finssim.localization.fusion.sensors import SENSORS, SensorModel, vision_covariance
from finssim.localization.fusion.streams import DepthSample, ImuSample, VisionSample
from localization.fusion.known_streams import (
    QUIET,
    SITE,
    attitude,
    position,
    run,
    shuffled,
    slope,
    streams,
    with_flips,
    with_outliers,
    without_vision,
    yaw,
)

both = pytest.mark.parametrize("mode", list(MODELS))
I = tuple(tuple(row) for row in np.diag([1e-4, 1e-4, 4e-4]))


def estimator(mode="constant-velocity", **changed):
    return Estimator(replace(Settings(), **changed), SITE, mode=mode)


def errors(estimates, times):
    """Return the errors of x, y, z [m] and yaw [rad], (n, 4)."""
    e = np.array([x.x[:3] for x in estimates]) - position(times)
    return np.column_stack([e, wrap_angle(np.array([x.yaw for x in estimates]) - yaw(times))])


def rms(e):
    return np.sqrt(np.mean(e**2, axis=0))


@pytest.mark.slow
@both
def test_the_path_is_followed(mode):
    """With 1 cm and 1.1 degrees of noise and a biased IMU, errors are 1 cm, half a degree, and 6 cm/s."""
    times = np.arange(2.0, 20.0, 1 / 60)
    found = run(estimator(mode), streams(20.0), times)
    assert np.all(rms(errors(found, times)) < [0.012, 0.012, 0.01, math.radians(0.5)])
    assert np.all(rms(np.array([x.x[3:] for x in found]) - slope(position, times)) < 0.06)


@pytest.mark.slow
@both
def test_tilt_is_found_where_the_imu_does_not_tell_it(mode):
    """From gyro and accelerometer alone, roll and pitch are right to a degree, and so is the depth's lever arm."""
    times = np.arange(8.0, 15.0, 0.1)
    found = run(estimator(mode), streams(15.0, tilt=False), times)
    assert rms(np.array([x.roll for x in found]) - 0.06 * np.sin(1.3 * times)) < math.radians(1.0)
    assert rms(np.array([x.pitch for x in found]) - 0.05 * np.sin(1.1 * times + 0.5)) < math.radians(1.0)


def test_the_estimator_is_its_filters():
    """Position and covariance equal predict and update by hand, so that the tests of the filters apply."""
    e, s = estimator(), Settings()
    up, state, then = np.array([[*SITE.up, 0.0, 0.0, 0.0]]), None, 0.0
    samples = sorted(streams(3.0, seed=2), key=lambda s: s.time)
    for sample in samples:
        e.add(sample)
    first = next(x for x in samples if x.stream == "vision")
    for x in (x for x in samples if x.stream != "imu" and x.time >= first.time):
        if state is None:  # the first fix, after one depth
            depth = next(y for y in samples if y.stream == "depth")
            state = by_hand_start(depth, first, s)
        else:
            state = position_filter.predict(state, x.time - then, s.motion)
            state = by_hand(state, x, s, up)
        then = x.time
    found = e.estimate(then)
    np.testing.assert_allclose(found.x, state.x, atol=1e-10)
    np.testing.assert_allclose(found.P, state.P, atol=1e-12)


def tilt_before(time):
    """Return roll and pitch of the last IMU sample before a time."""
    t = np.floor(time * 100.0 + 1e-6) / 100.0
    return 0.06 * np.sin(1.3 * t), 0.05 * np.sin(1.1 * t + 0.5)


def height_of(sample):
    """Return the height of the body from a depth."""
    return -sample.depth - SITE.offset - float(up_of(*tilt_before(sample.time)) @ np.array(SITE.depth_port))


def by_hand_start(depth, fix, s):
    """Return the state after one depth and the first fix."""
    P = np.diag([0.0, 0.0, s.depth_std**2] + [s.speed_std**2] * 3)
    state = PositionState(np.array([0.0, 0.0, height_of(depth), 0.0, 0.0, 0.0]), P)
    state = position_filter.predict(state, fix.time - depth.time, s.motion)
    R = vision_covariance(fix, s)[:2, :2]
    return position_filter.restarted(state, [0, 1], np.array(fix.position), R, s.speed_std)


def by_hand(state, sample, s, up):
    """Return the state after a depth or a fix."""
    if sample.stream == "depth":
        H, z, R = up, np.array([height_of(sample)]), np.array([[s.depth_std**2]])
    else:
        H, z, R = np.eye(6)[:2], np.array(sample.position), vision_covariance(sample, s)[:2, :2]
    return state.corrected(state.innovation(z - state.x @ H.T, H, R))


@pytest.mark.slow
@both
@pytest.mark.parametrize("seed", [0, 1])
def test_shuffled_delivery_ends_in_the_same_state(mode, seed):
    """Up to 200 ms late, duplicated, with outliers and flips: the state equals that of ordered delivery to 1e-9."""
    rng = np.random.default_rng(seed)
    samples = with_flips(with_outliers(streams(6.0, seed=seed), 0.05, rng), 0.05, rng)
    samples = sorted(samples, key=lambda s: s.time)
    late = shuffled(samples, 0.2, 0.1, rng)
    ordered, other = estimator(mode), estimator(mode)
    for s in samples:
        ordered.add(s)
    for s in late:
        other.add(s)
    a, b = ordered.estimate(6.1), other.estimate(6.1)
    np.testing.assert_allclose(b.x, a.x, rtol=0, atol=1e-9)
    np.testing.assert_allclose(b.P, a.P, rtol=0, atol=1e-9)
    assert b.yaw == pytest.approx(a.yaw, abs=1e-9)
    twice = {stream: verdicts.pop("duplicate", 0) for stream, verdicts in other.counts.items()}
    assert sum(twice.values()) == len(late) - len(samples)
    for stream, verdicts in other.counts.items():
        verdicts.pop("duplicate", None)
        assert verdicts == ordered.counts[stream]


def test_a_duplicate_makes_nothing_surer():
    """A fix delivered three times gives the covariance of one."""
    once, thrice = estimator(), estimator()
    for s in streams(1.0):
        once.add(s)
        for _ in range(3):
            thrice.add(s)
    np.testing.assert_array_equal(once.estimate().P, thrice.estimate().P)


def test_what_is_later_than_the_horizon_is_refused_and_counted():
    """A fix 1.2 s late is refused, one 0.8 s late is not."""
    e = estimator()
    for s in streams(3.0):
        e.add(s)
    assert e.add(VisionSample(e.estimate().time - 1.2, (0.0, 0.5), 0.1, I)) == "too late"
    at = e.estimate().time - 0.8
    assert e.add(VisionSample(at, tuple(position(at)[:2]), None, I)) == "accepted"
    assert e.counts["vision"]["too late"] == 1


@pytest.mark.slow
@both
@pytest.mark.parametrize(
    ("age", "mode_then"),
    [(0.24, "fresh"), (0.26, "coast"), (0.74, "coast"), (0.76, "hold"), (2.99, "hold"), (3.01, "lost")],
)
def test_states_follow_the_published_timings(mode, age, mode_then):
    """Fresh to 0.25 s, coast to 0.75 s, hold to 3 s after the last fix, then lost; only fresh and coast are ready."""
    samples = without_vision(streams(8.0), 4.0, 8.0)
    time = max(s.time for s in samples if s.stream == "vision") + age
    e = estimator(mode)
    for s in samples:
        if s.time <= time:
            e.add(s)
    health = e.health(e.estimate(time))
    assert health.vision_mode == mode_then
    assert health.vision_fresh == (mode_then == "fresh")
    assert health.ready == (mode_then in ("fresh", "coast"))


@both
@pytest.mark.parametrize(("largest", "ready"), [(0.04, False), (0.2, True)])
def test_a_position_that_is_not_precise_enough_is_not_ready(mode, largest, ready):
    """After one fix with a standard deviation of 0.3 m, the estimator is ready only if that variance is permitted."""
    e = estimator(mode, ready_position=largest)
    e.add(VisionSample(0.0, (1.0, 2.0), 0.1, tuple(map(tuple, np.diag([0.09, 0.09, 4e-4])))))
    for k in range(3):
        e.add(ImuSample(0.01 * k, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81), (0.0, 0.0)))
        e.add(DepthSample(0.01 * k, 0.5))
    health = e.health(e.estimate(0.02))
    assert health.initialized and health.vision_mode == "fresh" and health.imu_fresh and health.depth_fresh
    assert health.ready == ready


def test_nothing_is_initialized_before_the_first_fix():
    """Depth and IMU alone give the height but no position, and the estimate reports it."""
    e = estimator()
    for s in without_vision(streams(2.0), 0.0, 2.0):
        e.add(s)
    found = e.estimate()
    health = e.health(found)
    assert health.vision_mode == "uninitialized" and not health.initialized and not health.ready
    assert np.isnan(found.x[[0, 1, 3, 4]]).all() and math.isnan(found.yaw)
    assert found.x[2] == pytest.approx(position(2.0)[2], abs=0.02)


@pytest.mark.slow
@both
@pytest.mark.parametrize("all_silent", [False, True], ids=["camera", "everything"])
def test_the_state_never_runs_away(mode, all_silent):
    """Without vision the vehicle stays within its possible travel until it stops, and the uncertainty only grows."""
    e = estimator(mode)
    samples = without_vision(streams(14.0), 5.0, 99.0)
    samples = [s for s in samples if not all_silent or s.time < 5.0]
    for s in samples:
        e.add(s)
    start = e.estimate().vision_time
    ages = [10.0, 60.0, 3600.0, 1e6, 1e9]
    found = [e.estimate(start + age) for age in ages]
    stopped = found[0].x[:2]
    # At 0.3 m/s: 0.75 s on, then slowing with a half life of 1 s, or driven by an accelerometer 0.04 m/s² off.
    assert np.linalg.norm(stopped - position(start)[:2]) < 1.0
    for x in found:
        np.testing.assert_allclose(x.x[:2], stopped, atol=1e-4)  # speed of the IMU, with a lever arm of 5 cm
        np.testing.assert_array_equal(x.x[3:5], 0.0)
        assert np.isfinite(x.P).all() and math.isfinite(x.yaw)
        assert np.linalg.eigvalsh(x.P)[0] > -1e-6
    extra_variance = [x.P[0, 0] for x in found]
    assert all(b >= a * (1 - 1e-9) for a, b in zip(extra_variance, extra_variance[1:], strict=False))
    # Speed of the IMU, with a lever arm of 5 cm.
    assert extra_variance[-1] <= Settings().largest_variance * 1.001
    assert extra_variance[1] > 0.1


@pytest.mark.slow
@both
def test_dropouts_of_three_seconds_are_survived(mode):
    """In three silences of 3 s, errors stay within four of the stated deviations, and settle in half a second."""
    samples = streams(24.0, seed=4)
    for start in (5.0, 11.0, 17.0):
        samples = without_vision(samples, start, start + 3.0)
    times = np.arange(2.0, 24.0, 1 / 60)
    found = run(estimator(mode), samples, times)
    e = errors(found, times)
    assert np.all(np.abs(e[:, :2]) < 4.0 * np.array([x.std()[:2] for x in found]) + 0.01)
    silent = (times % 6.0 > 5.0) | (times % 6.0 < 2.6)
    assert np.abs(e[~silent, :2]).max() < 0.06
    # Half a second of a camera with white noise restores it.
    assert np.abs(e[silent, :2]).max() < (1.1 if mode == "constant-velocity" else 0.35)
    assert np.abs(e[:, 3]).max() < math.radians(2.5)  # the gyro carries the heading through


def flipped(samples, start, end, turn):
    """Return the samples with every yaw of a time interval turned."""
    return [
        replace(s, yaw=s.yaw + turn) if s.stream == "vision" and start <= s.time < end else s for s in samples
    ]


@pytest.mark.slow
@both
@pytest.mark.parametrize("lasts, turn", [(1.5, 0.47), (4.0, np.pi / 2)])
def test_a_flip_that_lasts_is_not_believed_surely(mode, lasts, turn):
    """The camera's yaw is wrong by 27 or 90 degrees for seconds: the gyro keeps the right one, or the deviation covers
    the error, and when the camera is right again the heading recovers at once."""
    samples = flipped(streams(26.0, seed=3), 12.0, 12.0 + lasts, turn)
    times = np.arange(8.0, 25.5, 0.1)
    found = run(estimator(mode), samples, times)
    wrong = np.abs(errors(found, times)[:, 3])
    told = np.array([math.sqrt(x.yaw_variance) for x in found])
    assert np.all(wrong < 3.5 * told), (wrong / told).max()
    assert np.all(wrong[times > 12.5 + lasts] < math.radians(3.0))
    assert np.all(wrong[times < 12.0] < math.radians(2.5))


@both
def test_a_heading_that_was_wrong_from_the_start_is_left(mode):
    """The camera's yaws are turned in the first second: later ones outvote them within a second."""
    times = np.arange(3.5, 8.0, 0.1)
    found = run(estimator(mode), flipped(streams(8.0, seed=4), 0.0, 1.0, 0.6), times)
    assert np.all(np.abs(errors(found, times)[:, 3]) < math.radians(4.0))


@both
def test_outliers_and_flips_are_refused(mode):
    """With 5 % of fixes off by 0.5 to 1 m and 5 % of yaws off by 90 or 180 degrees, the path is followed as without.

    The very first yaw is one of them; the next two outvote it, and no gate opens again after that.
    """
    rng = np.random.default_rng(5)
    samples = with_flips(with_outliers(streams(20.0, seed=5), 0.05, rng), 0.05, rng)
    times = np.arange(2.0, 20.0, 1 / 60)
    e = estimator(mode)
    found = errors(run(e, samples, times), times)
    assert np.abs(found[:, :2]).max() < 0.06
    assert np.abs(found[:, 3]).max() < math.radians(2.5)
    assert 20 <= e.counts["vision"]["gate"] <= 40
    assert 20 <= e.counts["yaw"]["gate"] <= 40
    assert abs(wrap_angle(next(s for s in samples if s.stream == "vision").yaw - yaw(0.011))) > 1.0
    assert "reacquired" not in e.counts["vision"] and e.counts["yaw"]["reacquired"] == 1


def kidnapped(seed=6):
    """Return fixes that jump by 1.5 m and 2 rad at 5 s: the vehicle was carried, or earlier fixes were wrong."""
    return [
        replace(s, position=(s.position[0] - 1.5, s.position[1]), yaw=s.yaw + 2.0)
        if s.stream == "vision" and s.time < 5.0
        else s
        for s in streams(8.0, seed=seed)
    ]


@both
def test_a_locked_gate_opens_again(mode):
    """Consistent fixes elsewhere are refused for a second, and then accepted."""
    e = estimator(mode)
    times = np.array([5.8, 6.5])
    before, after = errors(run(e, kidnapped(), times), times)
    assert abs(before[0]) > 1.0
    assert np.linalg.norm(after[:2]) < 0.05 and abs(after[3]) < math.radians(4.0)
    assert e.counts["vision"]["reacquired"] == e.counts["yaw"]["reacquired"] == 1


def broken():
    """Return samples that must change nothing."""
    nan, inf = math.nan, math.inf
    return [
        DepthSample(nan, 0.5),
        DepthSample(6.01, inf),
        DepthSample(5.987654, nan),
        ImuSample(6.02, (nan, 0.0, 0.0)),
        ImuSample(-3.0, (9.0, 9.0, 9.0)),
        ImuSample(1e9, (9.0, 9.0, 9.0)),
        VisionSample(5.99, (inf, 0.0), 0.0, I),
        VisionSample(5.99, (0.0, 0.0), 0.0, ((1.0, 2.0, 0.0), (2.0, 1.0, 0.0), (0.0, 0.0, 1.0))),
        VisionSample(2.0, (9.0, 9.0), 2.0, I),
        VisionSample(400.0, (9.0, 9.0), 2.0, I),
    ]


@pytest.mark.slow
@both
def test_broken_samples_are_refused_counted_and_leave_no_trace(mode):
    """NaN, infinities, times long past and far ahead are each counted, and the state is bit-identical."""
    clean, dirty = estimator(mode), estimator(mode)
    for s in streams(6.0):
        clean.add(s)
        dirty.add(s)
    verdicts = [dirty.add(s) for s in broken()]
    assert not {"accepted", "initialized"} & set(verdicts)
    a, b = clean.estimate(), dirty.estimate()
    np.testing.assert_array_equal(b.x, a.x)
    np.testing.assert_array_equal(b.P, a.P)
    refused = sum(
        n
        for v in dirty.counts.values()
        for word, n in v.items()
        if word not in ("accepted", "initialized", "gate")
    )
    assert refused == len(broken())
    assert dirty.health(b).reject_reason == "vision: clock jump"


@pytest.mark.parametrize("jump", [-1000.0, -3.0, 5000.0])
def test_another_clock_is_believed_once_all_agree_on_it(jump):
    """When every stamp jumps, a few samples are refused, then the estimator works with the new clock."""
    samples = streams(10.0)
    moved = [
        s if s.arrival < 5.0 else replace(s, time=s.time + jump, arrival=s.arrival + jump) for s in samples
    ]
    # Arrival times of a jumped clock jump too, and so cannot confirm it forwards.
    moved = [replace(s, arrival=None) for s in moved]
    e = estimator()
    for s in moved:
        e.add(s)
    found = e.estimate(10.0 + jump)
    assert np.linalg.norm(found.x[:2] - position(10.0)[:2]) < 0.05
    assert sum(v.get("too late", 0) + v.get("clock jump", 0) for v in e.counts.values()) < 40


def test_a_silence_is_no_clock_jump():
    """After half a minute without a sample, arrival times confirm the first one."""
    samples = [s for s in streams(40.0) if not 5.0 <= s.time < 36.0]
    e = estimator()
    verdicts = [e.add(s) for s in samples]
    assert "clock jump" not in verdicts
    assert np.linalg.norm(e.estimate(40.0).x[:2] - position(40.0)[:2]) < 0.05


@pytest.mark.parametrize("latency", [0.0, 0.1])
def test_the_camera_may_be_late(latency):
    """A delay of a tenth of a second adds the error of a prediction over that time, not speed times delay."""
    times = np.arange(2.0, 12.0, 1 / 60)
    found = run(estimator(), streams(12.0, noise=QUIET, latency=latency), times)
    e = errors(found, times)
    assert np.abs(e[:, :2]).max() < 0.005 + 0.5 * 0.3 * (latency + 0.06) ** 2 + 0.02 * (latency > 0)
    assert np.abs(e[:, 3]).max() < math.radians(0.3)


def test_a_latency_that_is_not_told_is_an_error_of_speed_times_delay():
    """The same delay, stamped as zero, gives an error of speed times delay."""
    samples = [
        replace(s, time=s.time + 0.1) if s.stream == "vision" else s for s in streams(12.0, noise=QUIET)
    ]
    times = np.arange(2.0, 12.0, 1 / 60)
    e = errors(run(estimator(), samples, times), times)
    expected = -0.1 * slope(position, times)[:, :2]
    assert rms(e[:, :2] - expected).max() < 0.4 * rms(expected).min()


def test_surroundings_are_those_of_the_exposure():
    """Tilt and depth are interpolated linearly between two samples to the time of the picture."""
    e = estimator()
    for s in streams(5.0, noise=QUIET):
        e.add(s)
    t = 4.8123
    near = e.at(t)
    assert near.roll == pytest.approx(0.06 * math.sin(1.3 * t), abs=1e-5)
    assert near.pitch == pytest.approx(0.05 * math.sin(1.1 * t + 0.5), abs=1e-5)
    port = position(t)[2] - 0.115 * math.cos(near.roll) * math.cos(near.pitch)
    assert near.depth == pytest.approx(1.0 - port, abs=1e-4)
    assert math.isnan(e.at(99.0).depth) and math.isnan(e.at(99.0).roll)


def test_a_tilt_of_the_vehicle_moves_the_depth_port():
    """On its side, the vehicle has the port beside the body, and the depth is the body's own."""
    e = estimator()
    e.add(ImuSample(1.0, (0.0, 0.0, 0.0), None, (math.pi / 2, 0.0)))
    e.add(DepthSample(1.0, 0.4))
    assert e.estimate(1.0).x[2] == pytest.approx(1.0 - 0.4)
    upright = estimator()
    upright.add(ImuSample(1.0, (0.0, 0.0, 0.0), None, (0.0, 0.0)))
    upright.add(DepthSample(1.0, 0.4))
    assert upright.estimate(1.0).x[2] == pytest.approx(1.0 - 0.4 + 0.115)


def test_health_is_plain_json_with_the_published_keys():
    """The health has every key of the status message, and only numbers that JSON can represent."""
    e = estimator()
    text = json.dumps(e.health(e.estimate()).as_json(), allow_nan=False)
    for s in streams(2.0):
        e.add(s)
    status = json.loads(json.dumps(e.health(e.estimate()).as_json(), allow_nan=False))
    assert status.keys() == json.loads(text).keys()
    assert {
        *("ready", "initialized", "vision_mode", "vision_source", "vision_fresh", "imu_fresh", "depth_fresh"),
        *("age_vision", "age_imu", "age_depth", "reject_reason", "mahalanobis", "position_covariance"),
        *("yaw_covariance", "velocity_world", "counts"),
    } <= status.keys()
    assert status["ready"] and status["vision_mode"] == "fresh"
    assert status["counts"]["imu"]["accepted"] == 200


@pytest.mark.slow
@both
def test_innovations_are_as_large_as_expected(mode):
    """NIS per dimension over 20 s is about 1 for the configured noises, below 1.2 as of an overconfident filter."""
    # Noises are as simulated; the path is smoother than white acceleration, so slightly below 1 is expected.
    e = estimator(mode, vision_floor=(0.0, 0.0))
    for s in streams(20.0, seed=8):
        e.add(s)
    for stream in ("vision", "yaw", "depth"):
        total, n = e.nis[stream]
        assert 0.6 < total / n < 1.2


@pytest.mark.slow
def test_acceleration_helps_where_the_camera_is_silent():
    """Over silences of 1.5 s, the error of the error-state filter is less than half of that of constant velocity."""
    samples = streams(20.0, seed=9)
    for start in (5.0, 10.0, 15.0):
        samples = without_vision(samples, start, start + 1.5)
    times = np.concatenate([np.arange(s, s + 1.5, 1 / 60) for s in (5.0, 10.0, 15.0)])
    found = {mode: rms(errors(run(estimator(mode), samples, times), times)[:, :2]).max() for mode in MODELS}
    assert found["error-state"] < 0.5 * found["constant-velocity"]


@both
def test_times_since_1970_are_as_good(mode):
    """With stamps of 1.7e9 s, which a double resolves to 0.2 microseconds, differences are negligible."""
    e, other = estimator(mode), estimator(mode)
    for s in streams(4.0, seed=3):
        e.add(s)
        other.add(replace(s, time=s.time + 1.7e9, arrival=s.arrival + 1.7e9))
    a, b = e.estimate(4.0), other.estimate(4.0 + 1.7e9)
    np.testing.assert_allclose(b.x, a.x, atol=1e-5)
    assert e.counts == other.counts


@dataclass(frozen=True)
class AltitudeSample:
    """Height above the surface, of an instrument that the package does not include."""

    time: float
    height: float
    arrival: float | None = None
    stream: str = "altitude"


@both
def test_a_new_sensor_is_one_entry_of_the_table(mode, monkeypatch):
    """A sensor of the port's height with millimetre accuracy is used, gated and counted by both filters."""
    entry = SensorModel(
        stream="altitude",
        quantity="height",
        reading=lambda sample: (sample.height,),
        noise=lambda sample, settings: np.array([[1e-6]]),
        drift=0.3,
    )
    monkeypatch.setitem(SENSORS, "altitude", entry)
    port = [position(t) + quat_to_matrix(attitude(t)) @ np.array(SITE.depth_port) for t in (3.0, 3.1, 3.2)]
    height = [float(np.array(SITE.up) @ p + SITE.offset) for p in port]
    e = estimator(mode)
    for sample in sorted(streams(3.25), key=lambda s: s.time):
        e.add(sample)
    before = e.estimate(3.25)
    assert e.add(AltitudeSample(3.0, height[0])) == "accepted"
    assert e.add(AltitudeSample(3.1, height[1] + 0.5)) == "gate"
    assert e.add(AltitudeSample(3.2, height[2])) == "accepted"
    after = e.estimate(3.25)
    assert e.counts["altitude"] == {"accepted": 2, "gate": 1} and e.nis["altitude"][1] == 2
    assert after.P[2, 2] < 0.25 * before.P[2, 2]
    assert abs(after.x[2] - position(3.25)[2]) < 0.003


def test_an_unknown_mode_is_refused_with_the_names():
    """An unknown mode is refused in a sentence that lists the available ones."""
    with pytest.raises(LocalizationError, match="constant-velocity, error-state"):
        Estimator(mode="kalman")
