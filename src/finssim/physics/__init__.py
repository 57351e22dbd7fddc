"""Equations of motion of one underwater vehicle, written once for CPU and GPU in Warp."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.physics.terms.composed import add_term
    from finssim.physics.types import join, vec6
    from finssim.vehicles.terms import Term

__all__ = [
    "Term",
    "add_term",
    "join",
    "vec6",
]

__getattr__, __dir__ = exports(__name__)
