"""Position, velocity and heading from camera, depth and inertia."""
