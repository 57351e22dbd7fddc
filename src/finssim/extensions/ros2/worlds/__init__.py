"""Nodes that simulate a world: the simulator and the virtual pool. They need the engine, which the robot's
nodes do not."""

from finssim.extensions.ros2.backend import activate

activate()
