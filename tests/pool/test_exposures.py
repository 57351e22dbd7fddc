"""The shutter's rate, exposure, latency, jitter and losses do not depend on the ticks."""

import numpy as np

from finssim.pool.positioning import ArrivalQueue, Shutter

SETTINGS = {"rate": 30.0, "exposure": 0.006, "latency": 0.045, "jitter": 0.0, "dropout": 0.0, "seed": 1}
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])


def pose_at(t):
    """Return a pose that moves along x at 1 m/s, so that it gives its time."""
    return np.array([t, 0.0, -0.5]), UPRIGHT


def exposures(duration=20.0, tick=0.003, **changed):
    """Return all exposures of a run."""
    shutter, found, t = Shutter(**{**SETTINGS, **changed}), [], 0.0
    while t < duration:
        found += shutter.advance(t, t + tick, pose_at)
        t += tick
    return found


def test_pictures_come_at_their_rate():
    """Pictures are evenly spaced at the requested rate."""
    for rate in (10.0, 30.0):
        middles = [e.middle for e in exposures(rate=rate)]
        assert np.allclose(np.diff(middles), 1.0 / rate) and abs(len(middles) - 20.0 * rate) <= 1


def test_the_poses_are_those_of_the_exposure():
    """Poses are taken when the shutter opens and when it closes, to within the ticks."""
    for exposure in (0.0, 0.02):
        for e in exposures(exposure=exposure, tick=0.001):
            assert abs(e.start[0][0] - (e.middle - 0.5 * exposure)) < 1e-9
            assert abs(e.end[0][0] - (e.middle + 0.5 * exposure)) < 1e-9


def test_ticks_change_nothing():
    """Long and short ticks give the same pictures at the same times."""
    fine, coarse = (
        exposures(tick=0.001, jitter=0.003, dropout=0.1),
        exposures(tick=0.05, jitter=0.003, dropout=0.1),
    )
    n = min(len(fine), len(coarse))
    assert n > 500
    assert [(e.sequence, e.arrival) for e in fine[:n]] == [(e.sequence, e.arrival) for e in coarse[:n]]


def test_latency_and_jitter_are_those_given():
    """Mean and standard deviation of arrival after mid-exposure are as given; no picture overtakes another."""
    late = np.array([e.arrival - e.middle for e in exposures(200.0, 0.05, jitter=0.004)])
    assert abs(late.mean() - 0.045) < 4 * 0.004 / np.sqrt(len(late)) and 0.0035 < late.std() < 0.0045
    arrivals = [e.arrival for e in exposures(50.0, 0.05, jitter=0.1, latency=0.1)]
    assert (np.diff(arrivals) >= 0.0).all()
    early = [e.arrival - e.middle for e in exposures(latency=0.0)]
    assert np.allclose(early, 0.003)  # not before the exposure ends


def test_lost_pictures_leave_a_gap_in_the_sequence():
    """With one in five lost, the losses seen in the sequence numbers are a binomial share."""
    found = exposures(200.0, 0.05, dropout=0.2)
    assert abs(1.0 - len(found) / 6000 - 0.2) < 4 * np.sqrt(0.2 * 0.8 / 6000)
    assert found[-1].sequence > len(found)


def test_pictures_arrive_once_and_in_time():
    """A picture is available from its arrival on, and delivered once."""
    queue = ArrivalQueue()
    sent = exposures(1.0)
    queue.post(sent)
    assert queue.arrived(sent[3].arrival - 1e-6) == sent[:3]
    assert queue.arrived(sent[3].arrival) == sent[3:4] and queue.arrived(99.0) == sent[4:]
