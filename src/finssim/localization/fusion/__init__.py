"""Estimation of position, velocity and heading from camera, depth sensor and IMU."""
