"""Hydrodynamic models by name. A model is one Warp function with the signature of `fossen_wrench`."""

from finssim.physics.hydrodynamics.fossen import fossen_wrench
from finssim.physics.hydrodynamics.mesh import mesh_wrench
from finssim.physics.hydrodynamics.simplified import simplified_wrench

HYDRODYNAMICS = {"calibrated": fossen_wrench, "mesh": mesh_wrench, "simplified": simplified_wrench}
"""Wrench function of each model; the keys are the values of `Simulator(hydrodynamics=...)`."""

__all__ = ["HYDRODYNAMICS"]
