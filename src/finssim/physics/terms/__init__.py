"""Hydrodynamic terms, one file each: keys in a vehicle file, wrench, and entries in ranges files and fits."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.physics.terms.composed import add_term
    from finssim.vehicles.terms import Term

__all__ = ["Term", "add_term"]

__getattr__, __dir__ = exports(__name__)
