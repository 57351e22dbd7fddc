"""Train RSL-RL's PPO to hold a pose, in about ten seconds."""

import torch
from rsl_rl.runners import OnPolicyRunner

from finssim.learning import RslRlVecEnv

torch.manual_seed(1)
torch.set_num_threads(1)  # a second thread gains nothing on so small a network
network = {"class_name": "MLPModel", "hidden_dims": [64, 64], "activation": "elu"}
noise = {"class_name": "GaussianDistribution", "init_std": 0.4, "std_type": "log"}
settings = {
    "num_steps_per_env": 32,
    "save_interval": 100,
    "obs_groups": {"actor": ["policy"], "critic": ["critic"]},
    "actor": {**network, "distribution_cfg": noise},
    "critic": network,
    "algorithm": {
        "class_name": "PPO",
        "gamma": 0.98,
        "learning_rate": 1e-3,
        "schedule": "adaptive",
        "desired_kl": 0.02,
        "entropy_coef": 0.0,
        "num_learning_epochs": 5,
        "num_mini_batches": 4,
    },
}
worlds = RslRlVecEnv("t1", worlds=256, vehicle="finsrov", seed=1)
runner = OnPolicyRunner(worlds, settings)


def held() -> float:
    """Return the success rate in 64 new episodes, without action noise: the pose is held for ten seconds at
    the end."""
    trial, policy = RslRlVecEnv("t1", worlds=64, vehicle="finsrov", seed=2), runner.get_inference_policy()
    observation = trial.get_observations()
    with torch.inference_mode():
        for _ in range(200):
            observation, *_ = trial.step(policy(observation))
    return trial.environment.task.metrics(trial.environment.arrays)["success"].mean()


before = held()
runner.learn(60, init_at_random_ep_len=True)
print(f"held before: {before:.0%}, after {60 * 32 * 256:,} control steps: {held():.0%}")
