"""The nodes of a robot, written against rclpy: the real one in a sourced ROS 2, our shim elsewhere."""

from finssim.ros2.backend import activate

activate()
