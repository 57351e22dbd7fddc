"""The batched environment as a TorchRL `EnvBase`: TensorDicts on the environment's device, one row per world."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from finssim.learning.adapter import adapter_environment, age_episodes
from finssim.learning.tensors import Tensors
from finssim.tasks import Environment, EnvironmentSetupError, Task
from finssim.tasks.environment import GREATEST_SEED


class TorchRlEnv(EnvBase):
    """TorchRL environment of batch size (worlds,). Keys: observation, action, reward, done, terminated, truncated.

    Several agents have them in groups, ("agents", "observation") and so on with batch size (worlds, agents), as
    TorchRL's multi-agent losses expect; done, terminated and truncated stay at the root: a world ends for all agents.

    ("next", "observation") is the last observation of the old episode where one ended, so TorchRL's value estimators
    bootstrap from it after a time limit, and do not bootstrap after an end by the task. The world has already begun its
    next episode, so `maybe_reset` costs no step of the simulator.
    """

    def __init__(
        self,
        task: str | Task | Environment = "t1",
        *,
        groups: Mapping[str, Sequence[str]] | None = None,
        stagger: bool = False,
        **options: Any,
    ) -> None:
        """Set up the worlds.

        Args:
            task: A task or its name; or an environment.
            groups: Groups of several agents: group -> names, each agent in one group. All in "agents" if None.
            stagger: True to set episodes to random ages after each reset of all worlds.
            options: Other arguments of `finssim.make`: worlds, vehicle, hydrodynamics, randomize, seed, device, ...

        Raises:
            EnvironmentSetupError: As for `finssim.make`; or groups do not contain every agent exactly once.
        """
        environment = adapter_environment(task, options)
        tensors = Tensors(environment)
        super().__init__(device=tensors.device, batch_size=[environment.worlds])
        self.environment, self._tensors, self._stagger = environment, tensors, stagger
        self._seed: int | None = None
        self._begun = torch.zeros(environment.worlds, dtype=torch.bool, device=tensors.device)
        self.group_map = _checked(groups, environment) if environment.agents > 1 else {}
        # A group of all agents in their order is a view; other groups are copies of rows.
        names = environment.task.agents
        self._rows = {
            group: None if tuple(members) == names else [names.index(member) for member in members]
            for group, members in self.group_map.items()
        }
        self._make_specs()

    def _make_specs(self) -> None:
        worlds, device = self.environment.worlds, self.device
        sizes = {None: None} if not self.group_map else {g: len(m) for g, m in self.group_map.items()}
        action, observation, reward = Composite(), Composite(), Composite()
        for spec in (action, observation, reward):
            spec.batch_size = (worlds,)
        for group, agents in sizes.items():
            shape = (worlds,) if agents is None else (worlds, agents)
            many, act = (*shape, self.environment.observation_size), (*shape, self.environment.action_size)
            for spec, key, leaf in (
                (action, "action", Bounded(-1.0, 1.0, shape=act, device=device, dtype=torch.float32)),
                (observation, "observation", Unbounded(shape=many, device=device, dtype=torch.float32)),
                (reward, "reward", Unbounded(shape=(*shape, 1), device=device, dtype=torch.float32)),
            ):
                if group is None:
                    spec[key] = leaf
                else:
                    spec[group] = Composite({key: leaf}, shape=shape)
        self.action_spec, self.observation_spec, self.reward_spec = action, observation, reward
        self.done_spec = Composite(
            {
                key: Categorical(n=2, shape=(worlds, 1), dtype=torch.bool, device=device)
                for key in ("done", "terminated", "truncated")
            },
            shape=(worlds,),
        )

    def _set_seed(self, seed: int | None) -> None:
        """Restart the random streams at the next reset; TorchRL's larger seeds are wrapped to the range of the
        kernels."""
        self._seed = None if seed is None else seed % (GREATEST_SEED + 1)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None or self._seed is not None:
            self.environment.reset(seed=self._seed)
            self._seed = None
            if self._stagger:
                age_episodes(self.environment)
            self._begun = torch.zeros_like(self._begun)
        else:
            requested = mask.view(-1)
            remaining = requested & ~self._begun
            if remaining.any():
                self.environment.reset(mask=remaining.cpu().numpy())
            self._begun = self._begun & ~requested
        return self._by_group(self._tensors.observation.clone())

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        tensors = self._tensors
        terminated, truncated = tensors.step(self._action(tensordict))
        done = terminated | truncated
        self._begun = done
        last = torch.where(done[:, None, None], tensors.final_observation, tensors.observation)
        out = self._by_group(last, tensors.reward.clone())
        out["done"], out["terminated"], out["truncated"] = (
            done[:, None],
            terminated[:, None],
            truncated[:, None],
        )
        return out

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """Return TorchRL's step; the first observations of new episodes already exist, and only their rows are
        updated."""
        tensordict = self.step(tensordict)
        following = self._step_mdp(tensordict)
        if self._begun.any():
            following.update(self._by_group(self._tensors.observation.clone()))
            over = torch.zeros(self.environment.worlds, 1, dtype=torch.bool, device=self.device)
            for key in ("done", "terminated", "truncated"):
                following.set(key, over.clone())
            self._begun = over[:, 0]
        return tensordict, following

    def _action(self, tensordict: TensorDictBase) -> torch.Tensor:
        if not self.group_map:
            return tensordict.get("action")
        parts = {group: tensordict.get((group, "action")) for group in self.group_map}
        if len(parts) == 1 and None in self._rows.values():
            return next(iter(parts.values()))
        action = torch.empty(
            self.environment.worlds, self.environment.agents, self.environment.action_size, device=self.device
        )
        for group, part in parts.items():
            rows = self._rows[group]
            action[:, slice(None) if rows is None else rows] = part
        return action

    def _by_group(self, observation: torch.Tensor, reward: torch.Tensor | None = None) -> TensorDict:
        """Return a TensorDict of (worlds, agents, size) and (worlds, agents)."""
        worlds = self.environment.worlds
        if not self.group_map:
            fields: dict[str, Any] = {"observation": observation[:, 0]}
            if reward is not None:
                fields["reward"] = reward
            return TensorDict(fields, batch_size=[worlds], device=self.device)
        out = TensorDict({}, batch_size=[worlds], device=self.device)
        for group, rows in self._rows.items():
            pick = slice(None) if rows is None else rows
            fields = {"observation": observation[:, pick]}
            if reward is not None:
                fields["reward"] = reward[:, pick, None]
            out[group] = TensorDict(fields, batch_size=fields["observation"].shape[:2], device=self.device)
        return out


def _checked(groups: Mapping[str, Sequence[str]] | None, environment: Environment) -> dict[str, list[str]]:
    names = environment.task.agents
    if groups is None:
        return {"agents": list(names)}
    named = [name for members in groups.values() for name in members]
    if sorted(named) != sorted(names):
        raise EnvironmentSetupError(
            f"groups name {', '.join(named) or 'nobody'}, expected each of {', '.join(names)} once"
        )
    return {group: list(members) for group, members in groups.items()}
