"""Hydrodynamic terms, a file each: what a vehicle file says of them, their wrench, their place in draws and fits."""

from finssim.physics.terms.composed import add_term
from finssim.vehicles.terms import Term

__all__ = ["Term", "add_term"]
