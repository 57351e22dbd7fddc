"""Memories of agents: arrays in tuples, one row for each episode."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray


def mapped(function: Callable[..., Any], memory: Any, *others: Any) -> Any:
    """A baseline's memory, which is arrays in tuples, or None, with a function applied to every array.

    Args:
        function: Takes an array and those of `others` in its place.
        memory: Its classes are those of the result.
        others: Memories of the same baseline.
    """
    if memory is None or isinstance(memory, np.ndarray):
        return None if memory is None else function(memory, *others)
    if not isinstance(memory, tuple):
        raise TypeError(f"memory of a baseline is a {type(memory).__name__}, expected arrays in tuples")
    parts = [mapped(function, *each) for each in zip(memory, *others, strict=True)]
    return type(memory)(*parts) if hasattr(memory, "_fields") else tuple(parts)


def memory_leaves(memory: Any) -> list[Any]:
    """The arrays of a baseline's memory in their order; of None none."""
    leaves: list[Any] = []
    mapped(leaves.append, memory)
    return leaves


def memory_from(leaves: Iterable[Any], fresh: Any) -> Any:
    """Return the memory whose leaves `memory_leaves` listed.

    Args:
        leaves: What it gave.
        fresh: A memory of the same baseline, whose classes are taken.
    """
    rest = iter(leaves)
    return mapped(lambda _: next(rest), fresh)


def restarted(memory: Any, fresh: Any, mask: NDArray[Any]) -> Any:
    """A baseline's memory after some episodes started over.

    Args:
        memory: What `act` gave.
        fresh: What `reset` gives for as many episodes.
        mask: Which episodes started over, bool, (n,).

    Returns:
        The rows of `fresh` where mask is true, those of `memory` elsewhere.
    """
    return mapped(lambda old, new: np.where(mask.reshape(-1, *[1] * (old.ndim - 1)), new, old), memory, fresh)
