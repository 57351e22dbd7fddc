"""PPO and SAC of Stable-Baselines3 on the batched environment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from torch import nn

from finssim.learning.episodes import EpisodeTally
from finssim.learning.learners.base import ROLLOUT_SAMPLES, ActingLearner, OnPolicySettings
from finssim.learning.learners.catalogue import LearningError
from finssim.learning.sb3 import Sb3VecEnv
from finssim.tasks import Environment

# What the learners of Stable-Baselines3 share: the worlds under a tally, and a logger that only collects.


class TalliedWorlds(Sb3VecEnv):
    """Worlds of which some episodes end in every step, and each step is tallied."""

    def __init__(self, tally: EpisodeTally) -> None:
        """Adapt the tally's environment."""
        super().__init__(tally.environment, stagger=True)
        self.tally = tally

    def step_wait(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """As every SB3 environment; and the tally looks."""
        result = super().step_wait()
        self.tally.look()
        return result


class Sb3Learner(ActingLearner):
    """One of SB3's algorithms, an update at a time: what its `learn` does, without its loop."""

    def start(self, model: Any) -> None:
        """Take the algorithm and start its first episodes."""
        self.model = model
        model.set_logger(Logger(None, []))
        _, callback = BaseAlgorithm._setup_learn(model, self.settings.steps * self.environment.agents)
        self.callback: BaseCallback = callback

    def counted(self) -> None:
        """Bring steps and the share of the training up to date."""
        self.steps = self.model.num_timesteps // self.environment.agents
        self.model._update_current_progress_remaining(self.steps, self.settings.steps)

    def losses(self, *names: str) -> dict[str, float]:
        """What the algorithm logged of its last update; 0 before the first."""
        logged = {name: float(self.model.logger.name_to_value.get(f"train/{name}", 0.0)) for name in names}
        self.model.logger.name_to_value.clear()
        return logged

    def learned(self) -> dict[str, Any]:
        """Parameters and counters; what else an algorithm has it adds."""
        m = self.model
        return {
            "policy": m.policy.state_dict(),
            "timesteps": m.num_timesteps,
            "updates": m._n_updates,
            "observation": m._last_obs,
            "starts": m._last_episode_starts,
        }

    def load_learned(self, state: dict[str, Any]) -> None:
        """Take what `learned` gave."""
        m = self.model
        m.policy.load_state_dict(state["policy"])
        m.num_timesteps, m._n_updates = int(state["timesteps"]), int(state["updates"])
        m._last_obs, m._last_episode_starts = state["observation"], state["starts"]
        self.counted()


# PPO of Stable-Baselines3 on the batched environment.


def ppo_arguments(settings: OnPolicySettings) -> dict[str, Any]:
    """The settings as SB3's PPO takes them."""
    return {
        "learning_rate": lambda left: settings.learning_rate * max(left, 0.0),
        "n_steps": settings.rollout,
        "batch_size": settings.batch,
        "n_epochs": settings.epochs,
        "gamma": settings.discount,
        "gae_lambda": settings.gae_lambda,
        "clip_range": settings.clip,
        "vf_coef": settings.value_weight,
        "max_grad_norm": settings.largest_gradient,
        "ent_coef": settings.entropy_weight,
    }


class Sb3Ppo(Sb3Learner):
    """PPO; several agents of a world are rows of their own and share the network."""

    Settings = OnPolicySettings
    rollout_samples = ROLLOUT_SAMPLES
    settings: OnPolicySettings
    algorithm: Any = PPO
    policy = "MlpPolicy"

    def __init__(
        self, environment: Environment, settings: OnPolicySettings, *, seed: int, device: str = "cpu"
    ) -> None:
        """Set up PPO and start its first episodes."""
        super().__init__(environment, settings)
        arguments = {**ppo_arguments(settings), "policy_kwargs": self.policy_arguments()}
        self.start(
            self.algorithm(self.policy, TalliedWorlds(self.tally), seed=seed, device=device, **arguments)
        )

    def policy_arguments(self) -> dict[str, Any]:
        """The networks' settings as SB3 takes them."""
        s = self.settings
        return {"net_arch": list(s.hidden), "activation_fn": nn.ELU, "log_std_init": s.log_std}

    def update(self) -> dict[str, float]:
        """One rollout, and `epochs` passes over it."""
        m = self.model
        m.collect_rollouts(m.env, self.callback, m.rollout_buffer, n_rollout_steps=m.n_steps)
        self.counted()
        m.train()
        losses = self.losses(
            "value_loss", "policy_gradient_loss", "approx_kl", "clip_fraction", "explained_variance"
        )
        return {**self.tally.row(), "action_std": torch.exp(m.policy.log_std).mean().item(), **losses}

    def network(self) -> nn.Module:
        """Observation to mean action, as a plain stack of layers."""
        policy: Any = self.model.policy
        return nn.Sequential(policy.mlp_extractor.policy_net, policy.action_net)

    def learned(self) -> dict[str, Any]:
        """And the optimiser."""
        return {**super().learned(), "optimizer": self.model.policy.optimizer.state_dict()}

    def load_learned(self, state: dict[str, Any]) -> None:
        """And the optimiser."""
        super().load_learned(state)
        self.model.policy.optimizer.load_state_dict(state["optimizer"])


# SAC of Stable-Baselines3 on the batched environment.


@dataclass(frozen=True, kw_only=True)
class SacSettings:
    """Settings of SAC, which learns from far fewer steps than PPO and takes far longer for each."""

    worlds: int = 64
    steps: int = 400_000
    """Control steps of all worlds together."""
    rollout: int = 8
    """Control steps of each world between two updates."""
    gradient_steps: int = 64
    """In an update; with the batch, each sample is learnt from some 32 times. They take most of a training's time, and
    with a quarter of them T1 is far from learnt."""
    batch: int = 256
    """Samples in a gradient step, drawn from the memory."""
    memory: int = 400_000
    """Steps that are remembered: all of a training."""
    warm_up: int = 5_000
    """Steps of random actions at the start, so that the first values rest on more than one corner of the pool."""
    learning_rate: float = 1e-3
    """At the start; falls linearly to zero."""
    discount: float = 0.98
    """Per control step: 5 s of foresight at 10 Hz, as PPO has."""
    smoothing: float = 0.01
    """Part of the way that the target values go in a gradient step."""
    entropy_weight: float = 0.02
    """Reward for a unit of the action's entropy, at the start; adapts so that the entropy becomes `entropy`.

    At 1, which is usual, a short training is over before noise stops paying better than the task.
    """
    entropy: float = -1.0
    """Of the action, per component: -1 is noise of 0.09 of full action."""
    hidden: tuple[int, ...] = (128, 128)
    """Units of the hidden layers, ELU, of the policy and of each of the two values."""


MEMORY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
"""Arrays of SB3's replay buffer."""


class Sb3Sac(Sb3Learner):
    """SAC; several agents of a world are rows of their own and share the network."""

    Settings = SacSettings
    settings: SacSettings

    def __init__(
        self, environment: Environment, settings: SacSettings, *, seed: int, device: str = "cpu"
    ) -> None:
        """Set up SAC and start its first episodes.

        Raises:
            LearningError: The memory does not hold the warm-up, or entropy has no weight to begin with.
        """
        if not settings.entropy_weight > 0.0:
            raise LearningError(f"entropy_weight is {settings.entropy_weight}, expected more than 0")
        if not settings.warm_up < settings.memory:
            raise LearningError(
                f"warm_up is {settings.warm_up}, expected less than the memory of {settings.memory} steps"
            )
        super().__init__(environment, settings)
        model = SAC(
            "MlpPolicy",
            TalliedWorlds(self.tally),
            learning_rate=lambda left: settings.learning_rate * max(left, 0.0),
            buffer_size=settings.memory,
            learning_starts=settings.warm_up,
            batch_size=settings.batch,
            tau=settings.smoothing,
            gamma=settings.discount,
            ent_coef=f"auto_{settings.entropy_weight}",
            target_entropy=settings.entropy * environment.action_size,
            train_freq=(settings.rollout, "step"),
            gradient_steps=settings.gradient_steps,
            seed=seed,
            device=device,
            policy_kwargs={"net_arch": list(settings.hidden), "activation_fn": nn.ELU},
        )
        self.start(model)

    def update(self) -> dict[str, float]:
        """One rollout into the memory, and `gradient_steps` from it once the warm-up is over."""
        m, s = self.model, self.settings
        m.collect_rollouts(
            m.env,
            self.callback,
            train_freq=m.train_freq,
            replay_buffer=m.replay_buffer,
            learning_starts=s.warm_up,
        )
        self.counted()
        if m.num_timesteps > s.warm_up:
            m.train(batch_size=s.batch, gradient_steps=s.gradient_steps)
        return {**self.tally.row(), **self.losses("actor_loss", "critic_loss", "ent_coef")}

    def network(self) -> nn.Module:
        """Observation to mean action, as a plain stack of layers."""
        actor: Any = self.model.actor
        return nn.Sequential(actor.latent_pi, actor.mu, nn.Tanh())

    def learned(self) -> dict[str, Any]:
        """And the optimisers, the weight of the entropy, the memory and the stream of the warm-up's actions."""
        m, buffer = self.model, self.model.replay_buffer
        filled = slice(None) if buffer.full else slice(buffer.pos)
        return {
            **super().learned(),
            "optimizers": [optimizer.state_dict() for optimizer in self._optimizers()],
            "log_entropy_weight": m.log_ent_coef.detach(),
            "memory": {name: getattr(buffer, name)[filled] for name in MEMORY},
            "place": buffer.pos,
            "full": buffer.full,
            "space": m.action_space.np_random.bit_generator.state,
        }

    def load_learned(self, state: dict[str, Any]) -> None:
        """Take what `learned` gave."""
        super().load_learned(state)
        m, buffer = self.model, self.model.replay_buffer
        for optimizer, saved in zip(self._optimizers(), state["optimizers"], strict=True):
            optimizer.load_state_dict(saved)
        with torch.no_grad():
            m.log_ent_coef.copy_(state["log_entropy_weight"])
        buffer.pos, buffer.full = int(state["place"]), bool(state["full"])
        for name in MEMORY:
            saved = np.asarray(state["memory"][name])
            getattr(buffer, name)[: len(saved)] = saved
        m.action_space.np_random.bit_generator.state = state["space"]

    def _optimizers(self) -> list[Any]:
        m = self.model
        return [m.actor.optimizer, m.critic.optimizer, m.ent_coef_optimizer]
