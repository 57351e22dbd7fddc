"""Excitation programmes run by the robot's whole software in the virtual pool, and the trials they make."""
