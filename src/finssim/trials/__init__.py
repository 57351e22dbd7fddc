"""Trials: recorded motion on disk and in memory, and what pushed the vehicle."""
