"""An expert's memory in the state of a training: its arrays without its classes, and back."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from typing import Any

__all__ = ["memory_from", "memory_numbers"]


def memory_numbers(memory: Any) -> Any:
    """The arrays of a memory, in lists as its tuples and dataclasses are nested; what is neither stays as it is."""
    if is_dataclass(memory) and not isinstance(memory, type):
        return [memory_numbers(getattr(memory, field.name)) for field in fields(memory)]
    if isinstance(memory, tuple):
        return [memory_numbers(part) for part in memory]
    return memory


def memory_from(numbers: Any, fresh: Any) -> Any:
    """The memory that `memory_numbers` took apart.

    Args:
        numbers: What it gave.
        fresh: A memory of the same expert, whose classes are taken.
    """
    if is_dataclass(fresh) and not isinstance(fresh, type):
        names = [field.name for field in fields(fresh)]
        parts = {name: memory_from(x, getattr(fresh, name)) for name, x in zip(names, numbers, strict=True)}
        return replace(fresh, **parts)
    if isinstance(fresh, tuple):
        rows = [memory_from(x, part) for x, part in zip(numbers, fresh, strict=True)]
        return type(fresh)(*rows) if hasattr(fresh, "_fields") else tuple(rows)
    return numbers
