"""Equations of motion of one underwater vehicle, written once for CPU and GPU in Warp."""
