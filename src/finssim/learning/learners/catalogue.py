"""The protocol of learners, and all learners by name. Nothing here imports a library of learning before it is used."""

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
    """A learner that there is not, that cannot do what is asked, or whose numbers ran away."""


class Learner(Protocol):
    """Learns in an environment, one update at a time; who calls `update` owns progress, checkpoints and export."""

    settings: Any
    """A frozen dataclass with at least `worlds` and `steps`; recorded in policy.yaml."""
    steps: int
    """Control steps of all worlds together so far."""

    def update(self) -> dict[str, float]:
        """One rollout and what is learnt from it.

        Returns:
            A row of the training curve with the same keys every time: mean_return, mean_length, held (share of the
            last episodes that succeeded), mean_reward, and the learner's own numbers.
        """

    def network(self) -> nn.Module | Network:
        """Observation of one agent to its mean action, for evaluation and export; a torch module or a `Network`."""

    def state(self) -> dict[str, Any]:
        """Everything that decides what comes next: parameters, optimisers, random streams, the environment."""

    def load(self, state: dict[str, Any]) -> None:
        """Continue from a state of a learner that was made in the same way, bit for bit."""


@dataclass(frozen=True)
class LearnerKind:
    """A learner that can be made: call it for one."""

    key: str
    """Name that commands take; FILE.py:CLASS of a user's own."""
    module: str
    """Module of its class."""
    name: str
    """Its class."""
    what: str
    """Short description."""
    extra: str = "learn"
    """Extra of FinsSim that it needs, as pip takes it."""
    agents: str = "any"
    """Number of agents of a task that it can train: one, several, or any."""
    sees: bool | None = False
    """True if it trains only tasks that observe pictures, False only tasks without; None: both."""
    own: type | None = None
    """The class itself, of a learner from outside the package."""

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
        """The settings of a training; what is None keeps its default for the task and the device, cpu or cuda.

        Raises:
            LearningError: A change names no setting, has another type than the setting's own, or counts too few.
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
        """A learner in an environment; it owns the environment's episodes from then on.

        Args:
            environment: Environment.
            settings: Settings of the learner.
            seed: Seed of everything random.
            device: cpu or cuda.
            options: Further arguments of the learner's class.

        Raises:
            LearningError: It cannot train the task's number of agents.
        """
        self.check(environment.task)
        learner: Learner = self._class()(environment, settings, seed=seed, device=device, **options)
        return learner

    def check(self, task: Task) -> None:
        """Refuse a task with a number of agents that it cannot train.

        Raises:
            LearningError: It cannot.
        """
        sees = bool(task.pictures)
        if self.sees not in (sees, None) and self.own is None:
            able = [name for name, kind in _ours() if kind.sees in (sees, None)]
            observes = "pictures" if task.pictures else "no pictures"
            raise LearningError(f"task '{task.name}' observes {observes}: take {', '.join(able)}")
        n = len(task.agents)
        if (self.agents == "one" and n > 1) or (self.agents == "several" and n == 1):
            able = [name for name, kind in _ours() if kind.agents in ("any", "one" if n == 1 else "several")]
            has = "one agent" if n == 1 else f"{n} agents"
            raise LearningError(
                f"task '{task.name}' has {has}, and this learner trains {self.agents}: take {', '.join(able)}"
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
    """Refuse what is no learner.

    Args:
        name: Name of the learner.
        learner: The object that is registered under it.

    Raises:
        LearningError: It is no class derived from `ActingLearner` with settings.
    """
    if not (
        isinstance(learner, type) and issubclass(learner, ActingLearner) and hasattr(learner, "Settings")
    ):
        raise LearningError(
            f"'{name}' is no learner: derive it from finssim.learning.learners.base.ActingLearner, with a frozen "
            "dataclass Settings"
        )


MAY_BE_ZERO = ("warm_up", "expert_rounds", "history", "memory")
"""Settings that count what may be left out; of all others there is at least one."""
LARGEST = 10**9
"""Greatest value of any count."""
SIGNED = ("log_std", "entropy")
"""Numbers that may be negative."""
SHARES = ("discount", "gae_lambda", "smoothing", "taught")
"""Numbers from 0 to 1."""


def learner_named(name: str) -> LearnerKind:
    """Return the learner of a name; or a user's own, FILE.py:CLASS or MODULE:CLASS, derived from `ActingLearner`.

    Raises:
        LearningError: There is none, or the class is no learner.
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
    """The value, as the type of the setting of that name."""
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
