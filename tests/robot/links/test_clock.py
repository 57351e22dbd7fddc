"""The controller's clock against the robot's: late by jitter, gaining or losing, wrapping, set back and moved."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from finssim.robot.links.clock import ClockMap

LEAST = 0.002
"""Delay that no frame is spared [s]."""


def frames(duration, *, rate=100.0, drift=0.0, start_ms=0, jitter=0.004, seed=0):
    """Times at which frames are made, robot's clock [s], their stamps modulo 2³² [ms], and their arrivals [s]."""
    rng = np.random.default_rng(seed)
    made = 1000.0 + np.arange(0.0, duration, 1.0 / rate)
    ms = (start_ms + np.floor(1e3 * (made - made[0]) / (1.0 + drift))).astype(np.int64) % (1 << 32)
    arrival = np.maximum.accumulate(made + LEAST + rng.exponential(jitter, made.size))
    return made, ms, arrival


def stamps(clock, ms, arrival):
    return np.array([clock.stamp(int(m), float(a)) for m, a in zip(ms, arrival, strict=True)])


def test_jitter_of_arrival_is_removed():
    """After ten seconds stamps are the true times plus the least delay, within the clock's millisecond and one more."""
    made, ms, arrival = frames(60.0)
    error = (stamps(ClockMap(), ms, arrival) - made - LEAST)[1000:]
    assert np.abs(error).max() < 0.002
    assert np.std(arrival - made) > 0.003


@pytest.mark.parametrize("drift", [-0.01, -2e-4, 5e-5, 0.003])
def test_drift_is_found_and_followed(drift):
    """A crystal that loses or gains, up to that of an RC oscillator, is told to 20 ppm and does not show in stamps."""
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
    """Whatever the controller's clock says and however the robot's own moves."""
    clock, arrival = ClockMap(), 5.0
    for i, (ms, gap) in enumerate(steps):
        arrival += gap
        assert clock.stamp((start + ms * (i % 3)) % (1 << 32), arrival) <= arrival


def test_the_clock_goes_through_its_wrap():
    """Forty-nine days after its start the counter begins at 0 again, and the stamps go on."""
    clock = ClockMap()
    made, ms, arrival = frames(40.0, start_ms=(1 << 32) - 20_000)
    assert ms[-1] < ms[0]
    error = stamps(clock, ms, arrival) - made - LEAST
    assert np.abs(error[1000:]).max() < 0.002
    assert (clock.jumps, clock.reboots) == (0, 0)


@pytest.mark.parametrize("uptime", [2_000, 3_000_000_000])
def test_a_reboot_is_noticed_with_its_first_frame(uptime):
    """The counter small again after seconds or weeks: counted at once, and stamps are right from then on."""
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
    """Late by up to seconds, it is stamped between its neighbours; no reboot would have counted so far so soon."""
    clock = ClockMap()
    made, ms, arrival = frames(20.0)
    stamps(clock, ms, arrival)
    late = clock.stamp(int(ms[-old]), arrival[-1] + 0.001)
    assert late == pytest.approx(made[-old] + LEAST, abs=0.002)
    assert clock.stamp(int(ms[-1]), arrival[-1] + 0.002) == pytest.approx(made[-1] + LEAST, abs=0.002)
    assert (clock.jumps, clock.reboots) == (0, 0)


def test_a_reboot_soon_after_the_start_is_no_overtaken_frame():
    """Up for 3 s, then up for 0.1 s: only three seconds back, and still a reboot."""
    clock = ClockMap()
    made, ms, arrival = frames(3.0)
    stamps(clock, ms, arrival)
    clock.stamp(100, arrival[-1] + 0.5)
    assert (clock.reboots, clock.jumps) == (1, 0)


@pytest.mark.parametrize("back", [2_000, 8_000])
def test_a_step_back_of_the_controllers_clock_is_a_jump(back):
    """Set back while it runs, as no reboot does: counted once, and in time stamps are right again."""
    clock = ClockMap()
    made, ms, arrival = frames(60.0, start_ms=50_000)
    half = ms.size // 2
    ms[half:] -= back
    error = stamps(clock, ms, arrival) - made - LEAST
    assert (clock.jumps, clock.reboots) == (1, 0)
    assert np.abs(error[half + 500 :]).max() < 0.02


@pytest.mark.parametrize("step", [40.0, -40.0, 0.6, -0.6])
def test_a_step_of_the_robots_clock_is_a_jump(step):
    """Forward or back, it is counted once, and two seconds later stamps are right again."""
    clock = ClockMap()
    made, ms, arrival = frames(30.0)
    half = ms.size // 2
    stamps(clock, ms[:half], arrival[:half])
    error = stamps(clock, ms[half:], arrival[half:] + step) - (made[half:] + LEAST + step)
    assert (clock.jumps, clock.reboots) == (1, 0)
    assert np.abs(error[210:]).max() < 0.02


def test_frames_that_waited_together_keep_their_own_times():
    """A stall of two seconds, then everything at once: stamps are those of a wire without a stall."""
    clock = ClockMap()
    made, ms, arrival = frames(30.0)
    stalled = (arrival > 1020.0) & (arrival < 1022.0)
    arrival[stalled] = 1022.0
    error = stamps(clock, ms, arrival) - made - LEAST
    assert np.abs(error[1000:]).max() < 0.002
    assert clock.jumps == 0


def test_what_waited_before_the_start_does_not_stay_in_the_stamps():
    """Three seconds of frames read at once: from the last of them on, stamps are right."""
    clock = ClockMap()
    made, ms, arrival = frames(30.0)
    arrival[:300] = arrival[299]
    error = stamps(clock, ms, arrival) - made - LEAST
    assert np.abs(error[400:]).max() < 0.008
    assert np.abs(error[2000:]).max() < 0.002


def test_memory_stays_small():
    """An hour keeps no more frames than seconds in the window."""
    clock = ClockMap(window=10.0)
    _, ms, arrival = frames(3600.0, rate=10.0)
    stamps(clock, ms, arrival)
    assert len(clock._kept) <= 13


def test_a_short_window_forgets_a_wire_that_was_faster():
    """Delay grows by 50 ms for good: stamps follow when the window has passed."""
    made, ms, arrival = frames(60.0)
    arrival[3000:] += 0.05
    late = {}
    for window in (10.0, 1000.0):
        late[window] = (stamps(ClockMap(window), ms, arrival) - made - LEAST)[4500:]
    assert np.abs(late[10.0] - 0.05).max() < 0.003
    assert late[1000.0].max() < 0.04
