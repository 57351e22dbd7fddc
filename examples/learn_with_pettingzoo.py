"""Random search over eight feedback gains that reach a pose, in one world of a PettingZoo environment."""

import numpy as np

from finssim.learning import PettingZooEnv
from finssim.tasks import task_named

TURNS, TRIES = 30, 4
env = PettingZooEnv(task_named("t1", time_limit=6.0), vehicle="finsrov", action="wrench4")


def act(gains: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return fractions of the wrench limits in surge, sway, heave and yaw from error and velocity of the same
    axis."""
    error = [*(3.0 * seen[:3]), seen[4]]  # body frame [m], sine of the yaw error
    velocity = [*seen[9:12], seen[14]]  # body frame [m/s], [rad/s]
    return np.clip(gains[0] * error + gains[1] * velocity, -1.0, 1.0).astype(np.float32)


def episode(gains: np.ndarray, seed: int) -> float:
    """Return the mean reward per step; every agent of the task acts with the same gains."""
    observations, _ = env.reset(seed=seed)
    rewards = []
    while env.agents:
        observations, reward, *_ = env.step({name: act(gains, seen) for name, seen in observations.items()})
        rewards += reward.values()
    return float(np.mean(rewards))


def score(gains: np.ndarray) -> float:
    """Return the mean over ten episodes that are not used for learning."""
    return float(np.mean([episode(gains, 10_000 + k) for k in range(10)]))


rng, gains = np.random.default_rng(1), np.zeros((2, 4))
before = score(gains)
for turn in range(TURNS):
    tries = rng.normal(size=(TRIES, 2, 4))
    # Both sides of a perturbation play the same episode, so that their difference is due to the gains alone.
    returns = np.array(
        [[episode(gains + side * 0.5 * t, TRIES * turn + k) for side in (1, -1)] for k, t in enumerate(tries)]
    )
    gains += 0.3 * np.tensordot(returns[:, 0] - returns[:, 1], tries, axes=1) / (TRIES * returns.std())
episodes = 2 * TURNS * TRIES
print(f"mean reward of a step before: {before:.2f}, after {episodes} episodes: {score(gains):.2f}")
