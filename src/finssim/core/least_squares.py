"""Levenberg and Marquardt's method: one kernel for every least-squares problem with a state or steps of its own.

Problems with a plain vector of parameters and no time limit use `scipy.optimize.least_squares`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

State = TypeVar("State")
Step = Callable[[float], tuple[State | None, float]]
"""Function of the damping -> state a damped step away, None where there is none, and the decrease of the cost that the
linearisation promises for it."""

STEADIEST = 1e12
"""Damping at which the search gives up."""


class Descent(NamedTuple, Generic[State]):
    """End of a search."""

    state: State
    """Best state found."""
    cost: float
    """Its cost, in the unit of the cost function."""
    steps: int
    """Number of steps tried."""
    converged: bool
    """True if the last step promised a negligible decrease."""


def descend(
    state: State,
    cost: Callable[[State], float],
    linearise: Callable[[State], Step[State]],
    *,
    steps: int,
    still: float = 0.0,
    share: float = 0.0,
    damping: float = 1e-3,
) -> Descent[State]:
    """Minimise a cost by damped Gauss-Newton steps (Levenberg and Marquardt).

    The damping follows Nielsen (1999), "Damping parameter in Marquardt's method": it stays where a step keeps half of
    what it promised, as in a flat valley.

    Args:
        state: Start.
        cost: Function to be minimised; infinite where a state is impossible.
        linearise: State -> its steps.
        steps: Largest number of steps.
        still: Promised decrease at or below which a step is the last, in the unit of the cost.
        share: The same, as a share of the cost [-].
        damping: First damping [-].
    """
    value, growth, tried, converged = cost(state), 2.0, 0, False
    step = linearise(state)
    while tried < steps and not converged and damping < STEADIEST:
        tried += 1
        trial, promised = step(damping)
        converged = abs(promised) <= max(still, share * value)
        after = math.inf if trial is None else cost(trial)
        if trial is None or not after <= value:
            damping, growth = damping * growth, 2.0 * growth
            continue
        gain = min((value - after) / max(promised, 1e-300), 2.0) if math.isfinite(value) else 1.0
        state, value, growth = trial, after, 2.0
        damping = max(damping * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), 1e-12)
        if tried < steps and not converged:
            step = linearise(state)
    return Descent(state, value, tried, converged)
