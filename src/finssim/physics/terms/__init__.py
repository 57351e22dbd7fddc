"""Hydrodynamic terms, one file each: keys in a vehicle file, wrench, and entries in draws and fits."""

from finssim.physics.terms.composed import add_term
from finssim.vehicles.terms import Term

__all__ = ["Term", "add_term"]
