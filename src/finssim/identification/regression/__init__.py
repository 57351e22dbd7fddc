"""Hydrodynamics axis by axis, from driven and from passive trials."""
