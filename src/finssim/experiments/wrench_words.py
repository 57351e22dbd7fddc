"""A wrench from words, as on the command line: "surge=10 yaw=1"."""

from __future__ import annotations

import difflib
import math

import numpy as np
from numpy.typing import NDArray

from finssim.vehicles import AXES

__all__ = ["CommandError", "parse_wrench"]

UNITS = ("N", "N", "N", "N m", "N m", "N m")


class CommandError(ValueError):
    """The words of a command line do not describe a wrench or a run; the message says which and what to write."""


def parse_wrench(text: str) -> NDArray[np.float64]:
    """Wrench from words such as "surge=10 yaw=-1".

    Args:
        text: `axis=number` separated by spaces or commas; axes left out are 0.

    Returns:
        Wrench, body frame, order surge sway heave roll pitch yaw [N, N m], (6,).

    Raises:
        CommandError: An axis is unknown or given twice, or a number is missing or not finite.
    """
    tau = np.zeros(6)
    seen: set[str] = set()
    words = text.replace(",", " ").split()
    if not words:
        raise CommandError('command is empty: give axis=number, such as "surge=10 yaw=1" [N, N m]')
    for word in words:
        axis, _, number = word.partition("=")
        if axis not in AXES:
            close = difflib.get_close_matches(axis, AXES, n=1)
            hint = f"; did you mean '{close[0]}'?" if close else ""
            raise CommandError(f"command: unknown axis '{axis}'; available: {', '.join(AXES)}{hint}")
        if axis in seen:
            raise CommandError(f"command: '{axis}' is given twice")
        seen.add(axis)
        tau[AXES.index(axis)] = _finite(axis, number)
    return tau


def _finite(axis: str, number: str) -> float:
    unit = UNITS[AXES.index(axis)]
    try:
        value = float(number)
    except ValueError:
        raise CommandError(f"command: {axis} is '{number}', expected a number: {axis}=1.5 [{unit}]") from None
    if not math.isfinite(value):
        raise CommandError(f"command: {axis} is {value}, expected a finite number [{unit}]")
    return value
