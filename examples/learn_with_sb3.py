"""Train Stable-Baselines3's PPO to hold a pose, in about ten seconds."""

import torch
from stable_baselines3 import PPO
from torch import nn

from finssim.learning import Sb3VecEnv

torch.set_num_threads(1)  # a second thread gains nothing on so small a network
worlds = Sb3VecEnv("t1", worlds=256, vehicle="finsrov", seed=1, stagger=True)
model = PPO(
    "MlpPolicy",
    worlds,
    n_steps=32,
    batch_size=2048,
    n_epochs=5,
    learning_rate=lambda left: 1.5e-3 * left,
    gamma=0.98,
    policy_kwargs={"net_arch": [64, 64], "activation_fn": nn.ELU, "log_std_init": -1.0},
    seed=1,
    device="cpu",
)


def held() -> float:
    """Return the success rate in 64 new episodes, without action noise: the pose is held for ten seconds at
    the end."""
    trial = Sb3VecEnv("t1", worlds=64, vehicle="finsrov", seed=2)
    observation = trial.reset()
    for _ in range(200):
        observation, *_ = trial.step(model.predict(observation, deterministic=True)[0])
    return trial.environment.task.metrics(trial.environment.arrays)["success"].mean()


print(f"before: {held():.0%} of the episodes hold")
model.learn(500_000)
print(f"after 500,000 control steps: {held():.0%}")
