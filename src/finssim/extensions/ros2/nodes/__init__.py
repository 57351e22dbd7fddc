"""The robot's nodes, each a module with `main`. Importing this package makes `import rclpy` work, real or ours."""

from finssim.extensions.ros2.backend import activate

activate()
