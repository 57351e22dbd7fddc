"""Hydrodynamics by simulation error: candidate plants as parallel worlds."""
