"""The controller's clock mapped to the robot's under jitter, drift, wrap-around, resets and steps."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from finssim.robot.links.clock import ClockMap

LEAST = 0.002
"""Minimum delay of every frame [s]."""


def frames(duration, *, rate=100.0, drift=0.0, start_ms=0, jitter=0.004, seed=0):
    """Return creation times on the robot's clock [s], stamps modulo 2³² [ms] and arrival times [s] of frames."""
    rng = np.random.default_rng(seed)
    made = 1000.0 + np.arange(0.0, duration, 1.0 / rate)
    ms = (start_ms + np.floor(1e3 * (made - made[0]) / (1.0 + drift))).astype(np.int64) % (1 << 32)
    arrival = np.maximum.accumulate(made + LEAST + rng.exponential(jitter, made.size))
    return made, ms, arrival


def stamps(clock, ms, arrival):
    return np.array([clock.stamp(int(m), float(a)) for m, a in zip(ms, arrival, strict=True)])


def test_jitter_of_arrival_is_removed():
    """After ten seconds stamps are the true times plus the least delay, to within the clock's millisecond
    plus one more."""
    made, ms, arrival = frames(60.0)
    error = (stamps(ClockMap(), ms, arrival) - made - LEAST)[1000:]
    assert np.abs(error).max() < 0.002
    assert np.std(arrival - made) > 0.003


@pytest.mark.parametrize("drift", [-0.01, -2e-4, 5e-5, 0.003])
def test_drift_is_found_and_followed(drift):
    """A drift of up to that of an RC oscillator is estimated to 20 ppm and does not show in the stamps."""
    clock = ClockMap()
    made, ms, arrival = frames(120.0, drift=drift)
    error = (stamps(clock, ms, arrival) - made - LEAST)[1000:]
    assert clock.drift == pytest.approx(drift, abs=2e-5)
    assert np.abs(error).max() < 0.003
    assert (clock.jumps, clock.reboots) == (0, 0)


@given(
    st.lists(st.tuples(st.integers(0, 2**32 - 1), st.floats(-2.0, 5.0)), max_size=60),
    st.integers(0, 2**32 - 1),
)
@settings(max_examples=300, deadline=None)
def test_no_stamp_is_later_than_its_arrival(steps, start):
    """This holds for any controller clock and any motion of the robot's own clock."""
    clock, arrival = ClockMap(), 5.0
    for i, (ms, gap) in enumerate(steps):
        arrival += gap
        assert clock.stamp((start + ms * (i % 3)) % (1 << 32), arrival) <= arrival


def test_the_clock_goes_through_its_wrap():
    """After forty-nine days the counter restarts at 0 and the stamps continue."""
    clock = ClockMap()
    made, ms, arrival = frames(40.0, start_ms=(1 << 32) - 20_000)
    assert ms[-1] < ms[0]
    error = stamps(clock, ms, arrival) - made - LEAST
    assert np.abs(error[1000:]).max() < 0.002
    assert (clock.jumps, clock.reboots) == (0, 0)


@pytest.mark.parametrize("uptime", [2_000, 3_000_000_000])
def test_a_reboot_is_noticed_with_its_first_frame(uptime):
    """A small counter after seconds or weeks is counted at once, and stamps are right from then on."""
    clock = ClockMap()
    made, ms, arrival = frames(20.0, start_ms=uptime)
    stamps(clock, ms, arrival)
    made, ms, arrival = made + 21.5, ms - uptime + 300, arrival + 21.5
    clock.stamp(int(ms[0]), arrival[0])
    assert (clock.reboots, clock.jumps) == (1, 0)
    error = stamps(clock, ms[1:], arrival[1:]) - made[1:] - LEAST
    assert np.abs(error[1000:]).max() < 0.002
    assert clock.reboots == 1


@pytest.mark.parametrize("old", [20, 200, 450])
def test_a_frame_overtaken_by_others_gets_its_own_time(old):
    """A frame up to seconds late is stamped between its neighbours; no rebooted counter could be so high so
    soon."""
    clock = ClockMap()
    made, ms, arrival = frames(20.0)
    stamps(clock, ms, arrival)
    late = clock.stamp(int(ms[-old]), arrival[-1] + 0.001)
    assert late == pytest.approx(made[-old] + LEAST, abs=0.002)
    assert clock.stamp(int(ms[-1]), arrival[-1] + 0.002) == pytest.approx(made[-1] + LEAST, abs=0.002)
    assert (clock.jumps, clock.reboots) == (0, 0)


def test_a_reboot_soon_after_the_start_is_no_overtaken_frame():
    """A counter of 0.1 s after 3 s is only three seconds back, and still a reboot."""
    clock = ClockMap()
    made, ms, arrival = frames(3.0)
    stamps(clock, ms, arrival)
    clock.stamp(100, arrival[-1] + 0.5)
    assert (clock.reboots, clock.jumps) == (1, 0)


@pytest.mark.parametrize("back", [2_000, 8_000])
def test_a_step_back_of_the_controllers_clock_is_a_jump(back):
    """A clock set back while running, unlike a reboot, is counted once, and stamps are eventually right
    again."""
    clock = ClockMap()
    made, ms, arrival = frames(60.0, start_ms=50_000)
    half = ms.size // 2
    ms[half:] -= back
    error = stamps(clock, ms, arrival) - made - LEAST
    assert (clock.jumps, clock.reboots) == (1, 0)
    assert np.abs(error[half + 500 :]).max() < 0.02


@pytest.mark.parametrize("step", [40.0, -40.0, 0.6, -0.6])
def test_a_step_of_the_robots_clock_is_a_jump(step):
    """A forward or backward step is counted once; two seconds later stamps are right again."""
    clock = ClockMap()
    made, ms, arrival = frames(30.0)
    half = ms.size // 2
    stamps(clock, ms[:half], arrival[:half])
    error = stamps(clock, ms[half:], arrival[half:] + step) - (made[half:] + LEAST + step)
    assert (clock.jumps, clock.reboots) == (1, 0)
    assert np.abs(error[210:]).max() < 0.02


def test_frames_that_waited_together_keep_their_own_times():
    """After a stall of two seconds and a burst, stamps are the same as without the stall."""
    clock = ClockMap()
    made, ms, arrival = frames(30.0)
    stalled = (arrival > 1020.0) & (arrival < 1022.0)
    arrival[stalled] = 1022.0
    error = stamps(clock, ms, arrival) - made - LEAST
    assert np.abs(error[1000:]).max() < 0.002
    assert clock.jumps == 0


def test_what_waited_before_the_start_does_not_stay_in_the_stamps():
    """After three seconds of frames read at once, stamps are right from the last of them on."""
    clock = ClockMap()
    made, ms, arrival = frames(30.0)
    arrival[:300] = arrival[299]
    error = stamps(clock, ms, arrival) - made - LEAST
    assert np.abs(error[400:]).max() < 0.008
    assert np.abs(error[2000:]).max() < 0.002


def test_memory_stays_small():
    """After an hour no more frames are kept than the window has seconds."""
    clock = ClockMap(window=10.0)
    _, ms, arrival = frames(3600.0, rate=10.0)
    stamps(clock, ms, arrival)
    assert len(clock._kept) <= 13


def test_a_short_window_forgets_a_wire_that_was_faster():
    """After a lasting increase of the delay by 50 ms, stamps follow once the window has passed."""
    made, ms, arrival = frames(60.0)
    arrival[3000:] += 0.05
    late = {}
    for window in (10.0, 1000.0):
        late[window] = (stamps(ClockMap(window), ms, arrival) - made - LEAST)[4500:]
    assert np.abs(late[10.0] - 0.05).max() < 0.003
    assert late[1000.0].max() < 0.04
