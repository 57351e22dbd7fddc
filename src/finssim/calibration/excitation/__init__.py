"""Programmes that make a vehicle tell its hydrodynamics, for robots and for the simulator."""
