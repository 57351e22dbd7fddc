"""Nodes of the robot, each a module with `main`. Importing this package makes `import rclpy` work, real or
built-in."""

from finssim.extensions.ros2.backend import activate

activate()
