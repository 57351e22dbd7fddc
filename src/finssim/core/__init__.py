"""Rotations, frames, camera optics and hull meshes."""
