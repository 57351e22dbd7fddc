"""Where the vehicle is: tags seen through the water, their pose, and its fusion with depth and inertia."""
