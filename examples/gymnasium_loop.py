"""Station keeping in a Gymnasium environment, with six lines of feedback control instead of a learner."""

import gymnasium
import numpy as np

from finssim.learning import gymnasium_env  # registers the tasks  # noqa: F401

env = gymnasium.make("finssim/StationKeeping-v0", vehicle="finsrov", action="wrench4")
observation, info = env.reset(seed=4)
print(f"start: {info['position_error']:.2f} m from the goal")

ended = False
while not ended:
    offset, velocity = 3.0 * observation[:3], observation[9:12]  # body frame [m], [m/s]
    sine_of_yaw_error, yaw_rate = observation[4], observation[14]
    force = 1.5 * offset - 1.0 * velocity
    yaw = 0.3 * sine_of_yaw_error - 0.3 * yaw_rate
    action = np.clip([*force, yaw], -1.0, 1.0).astype(np.float32)  # fractions of each axis' wrench limit
    observation, reward, terminated, truncated, info = env.step(action)
    ended = terminated or truncated

print(
    f"end after {info['episode']['l']} steps: {100.0 * info['position_error']:.1f} cm, held for {info['held']:.1f} s"
)
