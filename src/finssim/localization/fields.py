"""Reading typed values out of a YAML mapping, each refusal one sentence with the place."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from finssim.localization.errors import LocalizationError

__all__ = ["Fields"]


class Fields:
    """One section of a file; what was not asked for is refused by `finish`."""

    def __init__(self, values: Mapping[Any, Any], where: str) -> None:
        """
        Args:
            values: The section.
            where: File and section, as messages call it.
        """
        self._values = dict(values)
        self._known: list[str] = []
        self.where = where

    def has(self, key: str) -> bool:
        """Whether the key is given, and not null."""
        return self._values.get(key) is not None

    def take(self, key: str, default: Any = None) -> Any:
        """The value as it stands, or the default."""
        self._known.append(key)
        value = self._values.get(key)
        return default if value is None else value

    def number(self, key: str, default: float | None = None) -> float:
        """A finite number.

        Raises:
            LocalizationError: It is missing without a default, or not a finite number.
        """
        value = self.take(key, default)
        if value is None:
            raise self.error(f"{key} is missing, expected a number")
        return self._finite(key, value)

    def numbers(self, key: str, count: int | None, default: Any = None) -> tuple[float, ...]:
        """A list of finite numbers, of that many where `count` is given.

        Raises:
            LocalizationError: It is missing without a default, of another length, or holds something else.
        """
        value = self.take(key, default)
        if value is None:
            raise self.error(f"{key} is missing, expected {count or 'some'} numbers")
        if not isinstance(value, (list, tuple)) or (count is not None and len(value) != count):
            raise self.error(f"{key} is {value!r}, expected {count or 'a list of'} numbers")
        return tuple(self._finite(key, item) for item in value)

    def word(self, key: str, default: str | None = None) -> str:
        """A word.

        Raises:
            LocalizationError: It is missing without a default, or is not a word.
        """
        value = self.take(key, default)
        if not isinstance(value, str):
            raise self.error(f"{key} is {value!r}, expected a word")
        return value

    def section(self, key: str) -> Fields:
        """A mapping inside this one; empty where it is not given.

        Raises:
            LocalizationError: It is no mapping.
        """
        value = self.take(key, {})
        if not isinstance(value, Mapping):
            raise self.error(f"{key} is {value!r}, expected a section of keys and values")
        return Fields(value, f"{self.where}: {key}")

    def finish(self) -> None:
        """Refuse keys that nobody asked for.

        Raises:
            LocalizationError: There is one.
        """
        for key in self._values:
            if key not in self._known:
                raise self.error(f"unknown key '{key}'; known keys: {', '.join(self._known)}")

    def error(self, sentence: str) -> LocalizationError:
        """The error that says so of this section."""
        return LocalizationError(f"{self.where}: {sentence}")

    def _finite(self, key: str, value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise self.error(f"{key} holds {value!r}, expected finite numbers")
        return float(value)
