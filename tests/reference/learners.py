"""Settings of small learners, for tests of the environments' outputs."""


def rsl_rl_settings(steps=4, gamma=0.9, rate=1e-3):
    """Return the settings of RSL-RL's runner."""
    model = {"class_name": "MLPModel", "hidden_dims": [8], "activation": "elu"}
    noise = {"class_name": "GaussianDistribution", "init_std": 0.5, "std_type": "log"}
    return {
        "num_steps_per_env": steps,
        "save_interval": 100,
        "obs_groups": {"actor": ["policy"], "critic": ["critic"]},
        "actor": {**model, "distribution_cfg": noise},
        "critic": model,
        "algorithm": {
            "class_name": "PPO",
            "gamma": gamma,
            "learning_rate": rate,
            "schedule": "fixed",
            "num_learning_epochs": 1,
            "num_mini_batches": 1,
        },
    }
