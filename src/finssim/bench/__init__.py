"""Bench measurements: fits of thrust curves, speed controllers and motor responses."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.bench.thruster import fit_thruster

__all__ = ["fit_thruster"]

__getattr__, __dir__ = exports(__name__)
