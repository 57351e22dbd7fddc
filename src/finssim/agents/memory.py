"""Memories of agents: tuples of arrays with one row per episode."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray


def mapped(function: Callable[..., Any], memory: Any, *others: Any) -> Any:
    """Return a baseline's memory, which is tuples of arrays or None, with a function applied to each array.

    Args:
        function: Function of an array and the corresponding arrays of `others`.
        memory: Memory, whose classes the result has.
        others: Memories of the same baseline.
    """
    if memory is None or isinstance(memory, np.ndarray):
        return None if memory is None else function(memory, *others)
    if not isinstance(memory, tuple):
        raise TypeError(f"memory of a baseline is a {type(memory).__name__}, expected tuples of arrays")
    parts = [mapped(function, *each) for each in zip(memory, *others, strict=True)]
    return type(memory)(*parts) if hasattr(memory, "_fields") else tuple(parts)


def memory_leaves(memory: Any) -> list[Any]:
    """Return the arrays of a baseline's memory in their order; none for None."""
    leaves: list[Any] = []
    mapped(leaves.append, memory)
    return leaves


def memory_from(leaves: Iterable[Any], fresh: Any) -> Any:
    """Return the memory with the arrays that `memory_leaves` returned.

    Args:
        leaves: Result of `memory_leaves`.
        fresh: Memory of the same baseline, whose classes the result has.
    """
    rest = iter(leaves)
    return mapped(lambda _: next(rest), fresh)


def restarted(memory: Any, fresh: Any, mask: NDArray[Any]) -> Any:
    """Return a baseline's memory after some episodes have restarted.

    Args:
        memory: Memory from `act`.
        fresh: Memory from `reset` for the same number of episodes.
        mask: True for the episodes that have restarted, bool, (n,).

    Returns:
        The rows of `fresh` where `mask` is true, those of `memory` elsewhere.
    """
    return mapped(lambda old, new: np.where(mask.reshape(-1, *[1] * (old.ndim - 1)), new, old), memory, fresh)
