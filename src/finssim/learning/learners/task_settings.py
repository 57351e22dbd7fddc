"""What a learner's settings are for a task, where they are not the defaults: the one place for them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypeVar

__all__ = ["ON_POLICY", "RANDOMIZED", "SETTINGS", "applied", "own_settings"]

ON_POLICY = ("sb3-ppo", "sb3-recurrent-ppo", "rsl-rl", "torchrl-ppo", "torchrl-ippo", "torchrl-mappo")
"""The learners that `on-policy` means below: those of outside libraries with `OnPolicySettings`."""

Table = dict[str, dict[str, dict[str, Any]]]
"""Task -> `on-policy` or a learner's name, which outranks it -> changes of the defaults. `*` is every task, which the
task's own lines outrank."""

CHASE: dict[str, dict[str, Any]] = {
    # A capture or delivery lies far ahead: ten seconds of foresight. It is worth so much more than a step that what the
    # value is wrong by must not use up the gradient that policy and value share; RSL-RL's do not share one.
    "on-policy": {"discount": 0.99, "value_weight": 0.05, "learning_rate": 2.0e-3, "steps": 1_000_000},
    "rsl-rl": {"value_weight": 1.0},
    "ppo": {"discount": 0.99, "steps": 600_000},
}

SETTINGS: Table = {
    # Smaller networks than the default are as good here, and are learnt in three quarters of the time.
    "t1": {"ppo": {"hidden": (48, 48)}},
    "t2": {
        # A reference is close all the time: one second of foresight is enough, and learns faster than five.
        "ppo": {"discount": 0.9, "steps": 500_000},
        "on-policy": {"discount": 0.9},
        "sb3-sac": {"discount": 0.9},
    },
    # So is a target that moves, once it has been reached.
    "t3": {"on-policy": {"discount": 0.95}, "ppo": {"steps": 600_000}},
    "docking": {"ppo": {"steps": 900_000}},
    "pursuit": CHASE,
    # With 1.5 million, half of the seeds have only begun to capture.
    "team-pursuit": {
        "on-policy": {**CHASE["on-policy"], "steps": 3_600_000},
        "rsl-rl": CHASE["rsl-rl"],
        # The first captures are found by luck: a little reward for noise keeps the search going until they are.
        "ppo": {"discount": 0.99, "learning_rate": 2.0e-3, "entropy_weight": 0.003, "steps": 1_500_000},
    },
    "formation": {
        "on-policy": {**CHASE["on-policy"], "learning_rate": 2.5e-3, "steps": 1_800_000},
        "rsl-rl": CHASE["rsl-rl"],
        "ppo": {"discount": 0.99, "learning_rate": 2.0e-3, "steps": 1_500_000},
    },
}
"""Of every training."""

RANDOMIZED: Table = {
    # What must be learnt is more.
    "*": {
        "ppo": {"steps": 1_000_000},
        "on-policy": {"steps": 3_000_000},
        "sb3-sac": {"steps": 800_000, "memory": 800_000},
    },
    # What it saw and did in the last steps tells how this vehicle answers: thrust, lag, and how late the state comes.
    "t1": {"ppo": {"steps": 2_000_000, "history": 2, "last_action": True}},
    "t2": {
        "ppo": {"steps": 2_000_000, "history": 2, "last_action": True},
        "on-policy": {"steps": 2_000_000},
    },
    "t3": {"ppo": {"steps": 1_500_000}},
    "docking": {"ppo": {"steps": 2_000_000}},
    "pursuit": {"ppo": {"steps": 1_500_000}, "on-policy": {"steps": 2_500_000}},
    "team-pursuit": {"ppo": {"steps": 3_000_000}, "on-policy": {"steps": 6_000_000}},
    "formation": {"ppo": {"steps": 3_000_000}, "on-policy": {"steps": 4_000_000}},
}
"""On top of those, where every episode has another vehicle (`--randomize`)."""


def own_settings(task: str, learner: str, randomized: bool) -> dict[str, Any]:
    """Changes of a learner's defaults for a task; none for a task that no table names."""
    found: dict[str, Any] = {}
    for name in ("*", task):
        for table in (SETTINGS, RANDOMIZED) if randomized else (SETTINGS,):
            rows = table.get(name, {})
            found |= rows.get("on-policy", {}) if learner in ON_POLICY else {}
            found |= rows.get(learner, {})
    return found


S = TypeVar("S")


def applied(settings: S, own: Mapping[str, Any], worlds: int | None, steps: int | None) -> S:
    """Defaults with the task's own changes; then worlds and steps, unless None."""
    given = {name: value for name, value in (("worlds", worlds), ("steps", steps)) if value is not None}
    changed: S = replace(settings, **{**own, **given})  # type: ignore[type-var]
    return changed
