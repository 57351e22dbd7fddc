"""Records with some fields changed, hundreds of times a second."""

from __future__ import annotations

from typing import Any, TypeVar

__all__ = ["changed"]

T = TypeVar("T")


def changed(record: T, **fields: Any) -> T:
    """What `dataclasses.replace` gives, several times quicker, for frozen dataclasses that check nothing when made.

    Args:
        record: The record, which stays as it is.
        fields: New values by field name.
    """
    new = object.__new__(type(record))
    new.__dict__.update(record.__dict__, **fields)
    return new
