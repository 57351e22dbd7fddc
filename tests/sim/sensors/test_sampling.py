"""Rate, hold, latency, dropout and reset, seen through a depth gauge whose reading names the step it was taken in."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from finssim.sim.sensors import SensorSuite


def run(suite: SensorSuite, state: Any, steps: int) -> dict[str, np.ndarray]:
    """Readings of the gauge after the reset and after each step, (steps + 1, W, V); the vehicle sinks 1 m a step."""
    state.put(position=[0.0, 0.0, -1000.0])
    suite.reset(state)
    log = [suite.depth.numpy()]
    for k in range(1, steps + 1):
        state.advance()
        state.put(position=[0.0, 0.0, -1000.0 - k])
        suite.update(state)
        log.append(suite.depth.numpy())
    return {name: np.stack([entry[name] for entry in log]) for name in log[0]}


def gauge(
    vehicle: Any, ideal: Any, worlds: int = 1, control_step: float = 0.1, **timing: float
) -> SensorSuite:
    """A suite with an exact gauge of the given rate, latency and dropout at the body origin."""
    changes = {f"sensors.depth.{name}": value for name, value in timing.items()}
    suite = SensorSuite(vehicle.replace(changes), worlds=worlds, control_step=control_step)
    ideal(suite.depth).set(position=[0.0, 0.0, 0.0], dropout=timing.get("dropout", 0.0))
    return suite


@pytest.mark.parametrize(
    ("rate", "dt"), [(1.0, 0.1), (3.0, 0.1), (10.0, 0.1), (25.0, 0.1), (7.0, 0.05), (29.0, 0.01)]
)
def test_samples_fall_due_at_their_own_rate(
    rate: float, dt: float, vehicle: Any, ideal: Any, rest: Any
) -> None:
    """After time t, the newest sample is number floor(rate t): it was taken in the first step that reached its time."""
    steps = (
        200  # 100 steps at 29 Hz and 10 ms are 29 samples, though 100 * (29 * 0.01) < 29 in floating point
    )
    log = run(gauge(vehicle, ideal, control_step=dt, rate=rate, latency=0.0), rest(1), steps)
    k = np.arange(steps + 1)
    number = np.floor(k * dt * rate + 1e-9)
    taken = np.ceil(number / (dt * rate) - 1e-9)
    if rate * dt > 1.0:  # several in a step: the newest is measured at its end
        taken = k.astype(float)
    np.testing.assert_array_equal(log["depth"][:, 0, 0], 1000.0 + taken)
    np.testing.assert_allclose(log["stamp"][:, 0, 0], taken * dt, rtol=1e-6)
    np.testing.assert_array_equal(log["fresh"][1:, 0, 0], np.diff(taken) > 0)
    assert abs(log["fresh"][1:].sum() - min(rate * dt, 1.0) * steps) <= 1


@pytest.mark.parametrize("n", [0, 1, 2, 5])
@pytest.mark.parametrize("rate", [10.0, 5.0])
def test_latency_is_a_whole_number_of_samples(
    n: int, rate: float, vehicle: Any, ideal: Any, rest: Any
) -> None:
    """With a latency of n sample periods, every reading on display is n samples old, value and stamp alike."""
    dt, steps = 0.1, 60
    period = round(1 / (rate * dt))
    log = run(gauge(vehicle, ideal, control_step=dt, rate=rate, latency=n / rate), rest(1), steps)
    k = np.arange(steps + 1)
    taken = np.maximum(k // period - n, 0) * period  # until the first arrives, the one taken at the reset
    np.testing.assert_array_equal(log["depth"][:, 0, 0], 1000.0 + taken)
    np.testing.assert_allclose(log["stamp"][:, 0, 0], taken * dt, rtol=1e-6)
    np.testing.assert_array_equal(log["fresh"][1:, 0, 0], np.diff(taken) > 0)


@pytest.mark.parametrize(("latency", "late"), [(0.04, 0), (0.05, 1), (0.12, 1), (0.26, 3)])
def test_latency_goes_to_the_nearest_control_step(
    latency: float, late: int, vehicle: Any, ideal: Any, rest: Any
) -> None:
    """Nobody can look between control steps of 0.1 s."""
    log = run(gauge(vehicle, ideal, rate=10.0, latency=latency), rest(1), 10)
    assert log["depth"][10, 0, 0] == 1010.0 - late


def test_dropout_is_binomial(vehicle: Any, ideal: Any, rest: Any) -> None:
    """Each sample is lost with probability p by itself: the losses of W worlds are W draws of Binomial(n, p)."""
    p, n, worlds = 0.2, 60, 1500
    log = run(gauge(vehicle, ideal, worlds, rate=10.0, latency=0.0, dropout=p), rest(worlds), n)
    lost = (~log["fresh"][1:, :, 0]).sum(axis=0)
    variance = n * p * (1 - p)
    assert abs(lost.sum() - worlds * n * p) < 4.5 * np.sqrt(worlds * variance)
    # The spread of the counts, by chi-square, shows that losses neither cluster nor repel.
    assert 1e-4 < stats.chi2.cdf(((lost - n * p) ** 2).sum() / variance, worlds) < 1 - 1e-4
    in_step = (~log["fresh"][1:, :, 0]).sum(axis=1)
    chi2 = ((in_step - worlds * p) ** 2).sum() / (worlds * p * (1 - p))
    assert 1e-4 < stats.chi2.cdf(chi2, n) < 1 - 1e-4


def test_a_lost_sample_leaves_the_last_one_on_display(vehicle: Any, ideal: Any, rest: Any) -> None:
    """Value, stamp and freshness tell one story: display = the newest step that was fresh."""
    log = run(gauge(vehicle, ideal, 50, rate=10.0, latency=0.0, dropout=0.5), rest(50), 40)
    k = np.arange(41)[:, None]
    newest = np.maximum.accumulate(np.where(log["fresh"][..., 0], k, 0), axis=0)
    np.testing.assert_array_equal(log["depth"][..., 0], 1000.0 + newest)
    np.testing.assert_allclose(log["stamp"][..., 0], 0.1 * newest, rtol=1e-6)


def test_a_reset_reads_at_once_and_forgets_samples_on_their_way(vehicle: Any, ideal: Any, rest: Any) -> None:
    """Only the masked world starts again: it shows its start state, then waits out the latency for the next sample."""
    suite, state = gauge(vehicle, ideal, 2, rate=10.0, latency=0.3), rest(2)
    run(suite, state, 7)
    mask = state.steps.__class__([0, 1], dtype=int)
    state.steps.numpy()[1], state.episode.numpy()[1] = 0, 1
    state.position.numpy()[:, :, 2] = -5.0
    suite.reset(state, mask)
    np.testing.assert_array_equal(suite.depth.depth.numpy().ravel(), [1004.0, 5.0])
    np.testing.assert_allclose(suite.depth.stamp.numpy().ravel(), [0.4, 0.0])
    seen = []
    for k in range(1, 6):
        state.advance()
        state.position.numpy()[:, :, 2] = -5.0 - k
        suite.update(state)
        seen.append(suite.depth.depth.numpy().ravel().tolist())
    assert seen == [[1005.0, 5.0], [1006.0, 5.0], [1007.0, 5.0], [6.0, 6.0], [7.0, 7.0]]


def test_a_sample_on_its_way_at_a_reset_never_arrives(vehicle: Any, ideal: Any, rest: Any) -> None:
    """Not even in a step whose own sample would have arrived then, had one been due."""
    suite, state = gauge(vehicle, ideal, rate=10.0 / 3.0, latency=0.3), rest(1)
    run(suite, state, 7)  # the sample of step 6 is on its way
    state.put(steps=0, episode=1)
    seen = run(suite, state, 9)
    assert seen["fresh"].ravel().nonzero()[0].tolist() == [0, 6, 9]
    assert seen["depth"][[0, 6, 9]].ravel().tolist() == [1000.0, 1003.0, 1006.0]


def test_the_reading_at_a_reset_is_never_lost(vehicle: Any, ideal: Any, rest: Any) -> None:
    """Even a sensor that loses everything knows where the episode starts."""
    log = run(gauge(vehicle, ideal, 20, rate=10.0, latency=0.2, dropout=1.0), rest(20), 5)
    assert log["fresh"][0].all() and not log["fresh"][1:].any()


@pytest.mark.parametrize("late", [0, 1])
def test_time_that_stands_still_brings_no_samples(late: int, vehicle: Any, ideal: Any, rest: Any) -> None:
    """A world that does not step keeps its reading, fresh only once, and what is on its way still arrives."""
    suite, state = gauge(vehicle, ideal, rate=10.0, latency=0.1 * late), rest(1)
    run(suite, state, 3)
    before = suite.depth.numpy()
    for _ in range(3):
        suite.update(state.put(position=[0.0, 0.0, -9.0]))
    after = suite.depth.numpy()
    assert before["fresh"].all() and not after["fresh"].any()
    assert after["depth"] == before["depth"] and after["stamp"] == before["stamp"]
    state.advance()
    suite.update(state)
    assert suite.depth.fresh.numpy().all()
    assert suite.depth.depth.numpy()[0, 0] == (1003.0 if late else 9.0)


def test_the_bias_walks_by_time_and_not_by_samples(vehicle: Any, ideal: Any, rest: Any) -> None:
    """At any rate the bias after t has the variance K² t, t to the last sample."""
    K, worlds, steps = 0.03, 4000, 50
    for rate in (2.0, 10.0, 40.0):
        suite = gauge(vehicle, ideal, worlds, rate=rate, latency=0.0)
        suite.depth.set(bias_walk=K)
        run(suite, rest(worlds), steps)
        z = suite.depth.bias.numpy() / (K * np.sqrt(steps * 0.1))
        assert 1e-4 < stats.chi2.cdf((z**2).sum(), worlds) < 1 - 1e-4
