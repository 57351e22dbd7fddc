"""Observations of a policy from what a robot knows, by task: the same numbers as in training, without the simulator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.control.errors import ControlError
from finssim.control.guidance import Guide
from finssim.control.observe_t1 import SCHEMA as SCHEMA_T1
from finssim.control.observe_t1 import observe_t1
from finssim.control.observe_t2 import SCHEMA as SCHEMA_T2
from finssim.control.observe_t2 import observe_t2
from finssim.control.policy_description import ObservationSchema
from finssim.control.tracking import Measured

__all__ = ["OBSERVERS", "Observer", "observer"]

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Observer:
    """How the observation of one task is made."""

    schema: ObservationSchema
    """Which quantity stands where, in which unit and scale."""
    observe: Callable[[Measured, Guide, float], Array]
    """State, wanted motion and time since its start [s] -> observation, (..., schema.size)."""

    def describe(self, task: str) -> dict[str, Any]:
        """The task as `Policy.load` compares it."""
        return {"name": task, "observation": self.schema.model_dump(mode="json")}


OBSERVERS: dict[str, Observer] = {
    "t1": Observer(SCHEMA_T1, observe_t1),
    "t2": Observer(SCHEMA_T2, observe_t2),
}
"""Task -> its observer."""


def observer(task: str) -> Observer:
    """The observer of a task.

    Raises:
        ControlError: No robot knows how to observe it.
    """
    if task not in OBSERVERS:
        raise ControlError(f"unknown task '{task}'; a robot can do: {', '.join(OBSERVERS)}")
    return OBSERVERS[task]
