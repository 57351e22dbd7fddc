"""Trials on a robot: real or virtual, the same software, the same steps."""
