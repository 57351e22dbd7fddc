"""Messages arrive after sound travel and processing, are lost with the given probability, and contain what
was sent."""

import math

import numpy as np
import pytest

pytest.importorskip("finssim.extensions.teams")

from finssim.extensions.teams.pursuit import TeamPursuit
from finssim.tasks import Environment, EnvironmentSetupError
from finssim.tasks.communication import Communication

SLOW = Communication(period=0.5, processing=0.23, loss=0.0, speed_of_sound=6.0)
"""Sound so slow that one more metre delays a message by one or two control steps."""


def environment(talk, worlds=4, **options):
    return Environment(TeamPursuit(communication=talk), worlds=worlds, auto_reset=False, **options)


def wander(env, steps, seed=0):
    """Apply random actions; yield after every step."""
    rng = np.random.default_rng(seed)
    action = rng.uniform(-1.0, 1.0, (env.worlds, env.agents, env.action_size))
    for k in range(steps):
        if k % 10 == 0:
            action = rng.uniform(-1.0, 1.0, action.shape)
        env.step(action)
        yield k + 1


def test_delay_is_the_way_over_the_speed_of_sound_and_processing():
    """An independent queue in NumPy receives the same messages at the same control steps."""
    env = environment(SLOW)
    heard = np.zeros((4, 3, 3), dtype=int)
    queue, places = [], {0: env.arrays.position.numpy().copy()}
    for step in wander(env, 80):
        x = env.simulator.state.position.numpy().astype(float).copy()
        places[step] = x
        for b in range(3):
            if step % 5 == (0, 1, 3)[b]:
                for w in range(4):
                    for a in {0, 1, 2} - {b}:
                        delay = np.linalg.norm(x[w, a] - x[w, b]) / 6.0 + 0.23
                        queue.append((step + math.ceil(delay / 0.1 - 1e-3), step, w, a, b))
        for arrives, sent, w, a, b in queue:
            if arrives == step:
                heard[w, a, b] = max(heard[w, a, b], sent)
        table = env.arrays.messages
        np.testing.assert_array_equal(table.step.numpy().reshape(4, 3, 3), heard)
        for a in range(3):
            for b in {0, 1, 2} - {a}:
                told = table.position.numpy().reshape(4, 3, 3, 3)[:, a, b]
                expected = [places[heard[w, a, b]][w, b] for w in range(4)]
                np.testing.assert_allclose(told, expected, atol=1e-6)
    assert heard.max() > 70


@pytest.mark.slow
@pytest.mark.parametrize("loss", [0.0, 0.3, 1.0])
def test_as_many_are_lost_as_told(loss):
    """512 worlds, 6 pairs, 8 messages each: binomial, to four standard deviations."""
    talk = Communication(period=0.5, processing=0.0, loss=loss, speed_of_sound=1e6)
    env = environment(talk, worlds=512)
    received, possible = 0, 0
    before = np.zeros((512, 9), dtype=int)
    for _ in wander(env, 40):
        step = env.arrays.messages.step.numpy()
        received += int((step != before).sum())
        before = step.copy()
    possible = 512 * 6 * 8
    spread = math.sqrt(possible * loss * (1.0 - loss))
    assert abs(received - possible * (1.0 - loss)) <= 4.0 * spread


def test_pairs_and_worlds_lose_different_messages():
    """With half lost, no two of the six pairs receive the same messages."""
    talk = Communication(period=0.1, processing=0.0, loss=0.5, speed_of_sound=1e6)
    env = environment(talk, worlds=8)
    seen = np.stack([env.arrays.messages.step.numpy().copy() for _ in wander(env, 60)])
    pairs = [seen[:, w, k] for w in range(8) for k in (1, 2, 3, 5, 6, 7)]
    assert len({tuple(pair) for pair in pairs}) == len(pairs)


def test_everybody_knows_the_start_and_then_only_what_was_heard():
    """With all lost, a team-mate's track stays at the start; without communication, the track is the true
    position."""
    still = environment(Communication(loss=1.0))
    free = environment(None)
    start = still.arrays.position.numpy().copy()
    for _ in wander(still, 30):
        pass
    for _ in wander(free, 30):
        pass
    told = still.arrays.messages.position.numpy().reshape(4, 3, 3, 3)
    np.testing.assert_array_equal(told[:, 0, 1], start[:, 1])
    assert np.abs(still.arrays.position.numpy() - start)[:, :3].max() > 0.1
    np.testing.assert_array_equal(still.arrays.position.numpy(), free.arrays.position.numpy())
    gaps = [env.arrays.observation.numpy()[:, 16:19] for env in (still, free)]
    assert np.abs(gaps[0] - gaps[1]).max() > 0.01


def test_equal_seeds_lose_the_same_messages():
    def one(seed):
        env = environment(Communication(period=0.2, loss=0.4), worlds=6, seed=seed)
        return [env.arrays.messages.step.numpy().copy() for _ in wander(env, 30)]

    assert np.array_equal(one(3), one(3))
    assert not np.array_equal(one(3), one(4))


@pytest.mark.parametrize(
    "settings",
    [{"period": 0.0}, {"loss": 1.5}, {"processing": -1.0}, {"speed_of_sound": 0.0}, {"loss": math.nan}],
)
def test_impossible_settings_are_refused(settings):
    with pytest.raises(EnvironmentSetupError, match=next(iter(settings))):
        Communication(**settings)


def test_more_under_way_than_there_is_room_for_is_refused():
    with pytest.raises(EnvironmentSetupError, match="under way"):
        environment(Communication(period=0.1, processing=5.0))
