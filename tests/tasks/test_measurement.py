"""Measurements of the controller: gaps, offsets and delays, fixed or drawn for every episode."""

from __future__ import annotations

import numpy as np
import pytest

from finssim.sim.randomize import Randomization
from finssim.sim.ranges_file import Ranges
from finssim.tasks import Environment, MeasurementNoise, StationKeeping

WORLDS = 400


def environment(noise=None, worlds=WORLDS, **sensors) -> Environment:
    ranges = Randomization(Ranges.model_validate({"name": "test", "sensors": sensors})) if sensors else None
    return Environment(StationKeeping(), worlds=worlds, noise=noise, randomization=ranges, seed=9)


def run(env: Environment, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return measured and true positions after each step, (steps + 1, worlds, 3)."""
    action = np.full((env.worlds, 6), 0.4, np.float32)
    seen, true = (
        [env.arrays.position.numpy()[:, 0].copy()],
        [env.simulator.state.position.numpy()[:, 0].copy()],
    )
    for _ in range(steps):
        env.step(action)
        seen.append(env.arrays.position.numpy()[:, 0].copy())
        true.append(env.simulator.state.position.numpy()[:, 0].copy())
    return np.array(seen), np.array(true)


def test_a_gap_repeats_what_was_seen_last_as_often_as_its_probability_says():
    seen, true = run(environment(MeasurementNoise(dropout=0.3)), 20)
    repeated = (seen[1:] == seen[:-1]).all(axis=2)
    assert repeated.mean() == pytest.approx(0.3, abs=0.02)
    fresh = ~repeated
    np.testing.assert_array_equal(seen[1:][fresh], true[1:][fresh])
    np.testing.assert_array_equal(seen[0], true[0])  # an episode starts with a measurement


def test_a_reset_elsewhere_does_not_change_what_is_seen():
    env = environment(MeasurementNoise(dropout=0.5, position_std=0.01), worlds=8)
    run(env, 5)
    before = env.arrays.position.numpy().copy()
    env.reset(mask=np.arange(8) < 3)
    np.testing.assert_array_equal(env.arrays.position.numpy()[3:], before[3:])


def test_offsets_of_velocities_last_an_episode():
    """Their deviations are as given, and they do not change from step to step."""
    env = environment(MeasurementNoise(velocity_bias=0.05, rate_bias=0.02))
    offsets = []
    for _ in range(3):
        env.step(np.zeros((WORLDS, 6)))
        offsets.append((env.arrays.velocity.numpy() - env.simulator.state.velocity.numpy())[:, 0])
    np.testing.assert_allclose(offsets[0], offsets[2], atol=1e-6)
    np.testing.assert_allclose(offsets[0].std(axis=0), [0.05] * 3 + [0.02] * 3, rtol=0.12)


def test_a_drawn_deviation_is_that_of_its_world():
    """Noise divided by the drawn deviation is normal with deviation 1."""
    env = environment(position_std=[0.005, 0.05])
    seen, true = run(env, 12)
    std = env.draws.numpy(["sensors.position_std"])[:, 0, 0]
    assert np.ptp(std) > 0.04
    assert ((seen - true) / std[None, :, None]).std() == pytest.approx(1.0, abs=0.03)


def test_a_drawn_delay_is_that_of_its_world():
    """It is rounded to the nearest control step; nothing is older than the episode."""
    env = environment(delay=[0.0, 0.44])
    seen, true = run(env, 10)
    steps = np.rint(env.draws.numpy(["sensors.delay"])[:, 0, 0].astype(float) / 0.1).astype(int)
    assert set(steps) == {0, 1, 2, 3, 4}
    for w in range(WORLDS):
        np.testing.assert_array_equal(seen[10, w], true[10 - steps[w], w])


def test_a_drawn_gap_is_that_of_its_world():
    env = environment(dropout={"choice": [0.0, 0.6]})
    seen, _ = run(env, 25)
    repeated = (seen[1:] == seen[:-1]).all(axis=2).mean(axis=0)
    chance = env.draws.numpy(["sensors.dropout"])[:, 0, 0]
    assert not repeated[chance == 0.0].any()
    assert repeated[chance > 0.0].mean() == pytest.approx(0.6, abs=0.02)


def test_what_is_not_drawn_keeps_the_given_noise():
    """An offset given to the environment remains beside a drawn deviation."""
    env = environment(MeasurementNoise(position_bias=0.1), position_std=[0.0, 0.0])
    seen, true = run(env, 3)
    np.testing.assert_allclose(seen - true, (seen - true)[:1].repeat(4, axis=0), atol=1e-6)
    assert (seen - true).std() == pytest.approx(0.1, rel=0.1)


def test_a_gap_at_every_step_is_refused():
    with pytest.raises(ValueError, match="dropout of the measurement is 1.0, expected a probability below 1"):
        MeasurementNoise(dropout=1.0)


def test_graded_noise_grows_from_none_in_the_first_world_to_all_in_the_last():
    """The spread over many steps is proportional to the world's number."""
    env = environment(MeasurementNoise(position_std=0.1, delay=0.3, graded=True))
    rows = []
    for _ in range(200):
        env.step(np.zeros((env.worlds, env.action_size)))
        rows.append(env.arrays.position.numpy()[:, 0] - env.simulator.state.position.numpy()[:, 0])
    spread = np.std(rows, axis=(0, 2))
    assert spread[0] == 0.0
    part = np.linspace(0.0, 1.0, env.worlds)
    np.testing.assert_allclose(spread[-8:], 0.1 * part[-8:], rtol=0.15)
