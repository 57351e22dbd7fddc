"""What the intervals support, in words: one sentence for each module that a row takes away or exchanges."""

from __future__ import annotations

from finssim.experiments.transfer.intervals import Interval

__all__ = ["sentence"]

WORDS = {
    "success_rate": ("the share of setpoints held", 100.0, "percentage points", ".0f"),
    "e_p_m": ("the position error", 100.0, "cm", ".1f"),
    "e_psi_deg": ("the heading error", 1.0, "°", ".1f"),
    "horizontal_rmse_m": ("the horizontal error", 100.0, "cm", ".1f"),
    "vertical_rmse_m": ("the vertical error", 100.0, "cm", ".1f"),
    "p95_m": ("the 95th percentile of the distance", 100.0, "cm", ".1f"),
}
"""Key -> words, factor, unit and format of a difference."""


def sentence(module: str, differences: dict[str, Interval | None]) -> str:
    """What a module changes, with what the intervals leave open said as such.

    Args:
        module: How the sentence begins, such as "Domain randomisation".
        differences: Key of `WORDS` -> other less reference; None where no pair of trials has both.
    """
    told = [_clause(key, d) for key, d in differences.items() if d is not None and d.excludes_zero]
    open_ = [WORDS[key][0] for key, d in differences.items() if d is not None and not d.excludes_zero]
    unknown = [WORDS[key][0] for key, d in differences.items() if d is None]
    parts = []
    if told:
        parts.append(f"{module} {_listed(told)}")
    if open_:
        start = "it" if told else module
        parts.append(f"{start} makes no difference to {_listed(open_)} that the intervals support")
    if unknown:
        parts.append(f"{_listed(unknown)} cannot be compared: no pair of trials has both")
    return "; ".join(parts) + "."


def _clause(key: str, d: Interval) -> str:
    words, factor, unit, form = WORDS[key]
    verb = "raises" if d.value > 0.0 else "lowers"
    low, high = sorted(abs(factor * x) for x in (d.low, d.high))
    space = "" if unit == "°" else " "
    return f"{verb} {words} by {abs(factor * d.value):{form}}{space}{unit} [{low:{form}}, {high:{form}}]"


def _listed(items: list[str]) -> str:
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}"
