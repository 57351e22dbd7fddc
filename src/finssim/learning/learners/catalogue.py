"""The protocol of learners, and all learners by name. Training libraries are imported only when they are used."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from importlib import import_module
from typing import TYPE_CHECKING, Any, Protocol

from finssim.core.registry import LEARNERS, RegistryError
from finssim.learning.learners.base import ActingLearner, task_settings
from finssim.tasks import Environment, Task
from finssim.tasks.catalogue import own_class

if TYPE_CHECKING:
    from torch import nn

    from finssim.learning.network import Network


class LearningError(ValueError):
    """A learner does not exist, does not support a request, or has diverged."""


class Learner(Protocol):
    """A learner in an environment, with one update at a time; its caller handles progress, checkpoints and export."""

    settings: Any
    """A frozen dataclass with at least `worlds` and `steps`; recorded in policy.yaml."""
    steps: int
    """Control steps so far, summed over all worlds."""

    def update(self) -> dict[str, float]:
        """Run one rollout and learn from it.

        Returns:
            A row of the training curve, always with the same keys and units: mean_return, mean_length, held (success
            rate of the last episodes), mean_reward, and the learner's own numbers.
        """

    def network(self) -> nn.Module | Network:
        """Return the map from one agent's observation to its mean action, for evaluation and export."""

    def state(self) -> dict[str, Any]:
        """Return the complete state: parameters, optimisers, random streams, the environment."""

    def load(self, state: dict[str, Any]) -> None:
        """Continue from the state of a learner that was created in the same way, bit for bit."""


@dataclass(frozen=True)
class LearnerKind:
    """A kind of learner; calling it creates a learner."""

    key: str
    """Name on the command line; FILE.py:CLASS for a user's own."""
    module: str
    """Module of its class."""
    name: str
    """Name of its class."""
    what: str
    """Short description."""
    extra: str = "learn"
    """Extra of FinsSim that it needs, in pip's notation."""
    agents: str = "any"
    """Supported number of agents of a task: one, several, or any."""
    sees: bool | None = False
    """True if it trains only tasks with pictures, False only tasks without; None: both."""
    own: type | None = None
    """Class of a learner from outside the package."""

    def settings(
        self,
        task: Task,
        *,
        randomized: bool = False,
        worlds: int | None = None,
        steps: int | None = None,
        changes: Mapping[str, Any] | None = None,
        device: str = "cpu",
    ) -> Any:
        """Return the settings of a training; None keeps the default for the task and the device, cpu or cuda.

        Raises:
            LearningError: A change names an unknown setting, has the wrong type, or is out of range.
        """
        task_changes = {}
        if self.own is None:
            task_changes = task_settings(task.name, self.key, randomized)
        chosen = self._class().settings_for(task, task_changes, worlds, steps, device)
        return replace(
            chosen, **{name: _fitting(chosen, name, value) for name, value in (changes or {}).items()}
        )

    def __call__(
        self, environment: Environment, settings: Any, *, seed: int, device: str = "cpu", **options: Any
    ) -> Learner:
        """Create a learner in an environment, whose episodes it controls from then on.

        Args:
            environment: Environment.
            settings: Settings of the learner.
            seed: Seed of all random numbers.
            device: cpu or cuda.
            options: Further arguments of the learner's class.

        Raises:
            LearningError: It does not support the task.
        """
        self.check(environment.task)
        learner: Learner = self._class()(environment, settings, seed=seed, device=device, **options)
        return learner

    def check(self, task: Task) -> None:
        """Refuse a task with pictures or a number of agents that the learner does not support.

        Raises:
            LearningError: The learner does not support the task.
        """
        sees = bool(task.pictures)
        if self.sees not in (sees, None) and self.own is None:
            able = [name for name, kind in _ours() if kind.sees in (sees, None)]
            observes = "pictures" if task.pictures else "no pictures"
            raise LearningError(f"task '{task.name}' observes {observes}: use {', '.join(able)}")
        n = len(task.agents)
        if (self.agents == "one" and n > 1) or (self.agents == "several" and n == 1):
            able = [name for name, kind in _ours() if kind.agents in ("any", "one" if n == 1 else "several")]
            has = "one agent" if n == 1 else f"{n} agents"
            raise LearningError(
                f"task '{task.name}' has {has}, and this learner trains {self.agents}: use {', '.join(able)}"
            )

    def _class(self) -> Any:
        if self.own is not None:
            return self.own
        try:
            return getattr(import_module(f"finssim.learning.learners.{self.module}"), self.name)
        except ModuleNotFoundError as error:
            if str(error.name).startswith("finssim"):
                raise
            extras = self.extra if self.extra == "learn" else f"learn,{self.extra}"
            raise LearningError(
                f"this learner needs {error.name}: pip install 'finssim[{extras}]'"
            ) from error


PPO = LearnerKind("ppo", "ppo", "Ppo", "PPO of our own, NumPy on a processor and torch on a GPU")
SB3_PPO = LearnerKind("sb3-ppo", "sb3", "Sb3Ppo", "PPO of Stable-Baselines3")
RSL_RL = LearnerKind("rsl-rl", "rsl_rl_ppo", "RslRlPpo", "PPO of RSL-RL", extra="rsl-rl")
TORCHRL_PPO = LearnerKind(
    "torchrl-ppo", "torchrl_ppo", "TorchRlPpo", "PPO of TorchRL", extra="torchrl", agents="one"
)
TORCHRL_IPPO = LearnerKind(
    "torchrl-ippo",
    "torchrl_ppo",
    "TorchRlIppo",
    "independent PPO of TorchRL: each agent's value from its own observation",
    extra="torchrl",
    agents="several",
)
TORCHRL_MAPPO = LearnerKind(
    "torchrl-mappo",
    "torchrl_ppo",
    "TorchRlMappo",
    "multi-agent PPO of TorchRL: values from the observations of all agents",
    extra="torchrl",
    agents="several",
)
BC = LearnerKind("bc", "imitation", "Bc", "behaviour cloning of demonstrations", extra="imitation", sees=None)
DAGGER = LearnerKind("dagger", "imitation", "Dagger", "DAgger: an expert labels each step", extra="imitation")
DISTILL = LearnerKind(
    "distill",
    "distill",
    "Distill",
    "a teacher by PPO, distilled into a student with images",
    extra="perception",
    agents="one",
    sees=True,
)


def check_registered(name: str, learner: Any) -> None:
    """Refuse a registered object that is not a learner.

    Args:
        name: Name of the learner.
        learner: The object that is registered under it.

    Raises:
        LearningError: It is not a class derived from `ActingLearner` with settings.
    """
    if not (
        isinstance(learner, type) and issubclass(learner, ActingLearner) and hasattr(learner, "Settings")
    ):
        raise LearningError(
            f"'{name}' is no learner: derive it from finssim.learning.learners.base.ActingLearner, with a frozen "
            "dataclass Settings"
        )


MAY_BE_ZERO = ("warm_up", "expert_rounds", "history", "memory")
"""Counts that may be 0; all other counts are at least 1."""
LARGEST = 10**9
"""Greatest value of any count."""
SIGNED = ("log_std", "entropy")
"""Numbers that may be negative."""
SHARES = ("discount", "gae_lambda", "smoothing", "taught")
"""Numbers from 0 to 1."""


def learner_named(name: str) -> LearnerKind:
    """Return a learner by its name; or a user's own, FILE.py:CLASS or MODULE:CLASS, derived from `ActingLearner`.

    Raises:
        LearningError: There is none with that name, or the class is not a learner.
        EnvironmentSetupError: There is no such file or class, or its code fails.
    """
    if ":" in name:
        learner = own_class(name, ActingLearner, "learner")
        check_registered(name, learner)
    elif name not in LEARNERS:
        raise LearningError(f"unknown learner '{name}'; available: {', '.join(LEARNERS)}, or FILE.py:CLASS")
    else:
        try:
            learner = LEARNERS[name]
        except RegistryError as error:
            raise LearningError(str(error)) from error
    if isinstance(learner, LearnerKind):
        return learner
    title = (learner.__doc__ or learner.__name__).strip().splitlines()[0]
    return LearnerKind(name, learner.__module__, learner.__name__, title, own=learner)


def _ours() -> list[tuple[str, LearnerKind]]:
    """Return name and kind of the learners of FinsSim, for messages."""
    return [
        (kind.key, kind) for kind in vars(sys.modules[__name__]).values() if isinstance(kind, LearnerKind)
    ]


def _fitting(settings: Any, name: str, value: Any) -> Any:
    """Return the value with the type of the setting of that name."""
    values = {field.name: getattr(settings, field.name) for field in fields(settings)}
    if name not in values:
        raise LearningError(f"unknown setting '{name}'; available: {', '.join(values)}")
    kind = type(values[name])
    try:
        fitting = _as_kind(kind, value)
    except (KeyError, TypeError, ValueError) as error:
        raise LearningError(
            f"setting {name} is {value!r}, expected {kind.__name__} such as {values[name]!r}"
        ) from error
    least = 0 if name in MAY_BE_ZERO else 1
    counts = fitting if kind is tuple else (fitting,) if kind is int else ()
    if any(not least <= count <= LARGEST for count in counts):
        raise LearningError(f"setting {name} is {value!r}, expected {least} or more, at most {LARGEST}")
    if kind is float and not math.isfinite(fitting):
        raise LearningError(f"setting {name} is {value!r}, expected a finite number")
    if kind is float and name not in SIGNED and not 0.0 <= fitting <= (1.0 if name in SHARES else math.inf):
        expected = "from 0 to 1" if name in SHARES else "of 0 or more"
        raise LearningError(f"setting {name} is {value!r}, expected a number {expected}")
    return fitting


def _as_kind(kind: type, value: Any) -> Any:
    if kind is tuple:
        return tuple(int(v) for v in ([value] if isinstance(value, str | int) else value))
    if kind is bool:
        return {"true": True, "false": False}[str(value).lower()]
    if kind is int and float(value) != int(value):
        raise ValueError
    return kind(value)
