# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""A controller of your own as a ROS 2 node: it holds a position by odometry, and commands the thrust of each thruster.

finssim ros2 up sim --vehicle bluerov2_heavy --policy none --arm --lockstep
python examples/ros2/own_controller.py
"""

import numpy as np

from finssim import load_vehicle
from finssim.extensions.ros2 import activate

activate()  # the rclpy of a sourced ROS 2, or the built-in one

import rclpy
from finssim_msgs.msg import ThrusterCommand, ThrusterState
from nav_msgs.msg import Odometry
from rclpy.node import Node
from std_msgs.msg import Header


class OwnController(Node):
    def __init__(self, vehicle="bluerov2_heavy", goal=(0.5, 0.3, -0.7)):
        body = load_vehicle(vehicle)  # a name or a file; its name is the namespace of its topics
        super().__init__("own_controller", namespace=body.name)
        thrusters = body.thrusters
        columns = [(*t.axis, *np.cross(t.position, t.axis)) for t in thrusters.values()]
        self.names, self.allocation = list(thrusters), np.linalg.pinv(np.array(columns).T)
        self.goal, self.armed = np.array(goal), False
        self.out = self.create_publisher(ThrusterCommand, "thruster_cmd", 1)
        self.done = self.create_publisher(Header, "/clock_done", 10)
        self.create_subscription(ThrusterState, "thruster_state", self.on_state, 10)
        self.create_subscription(Odometry, "odom", self.on_odometry, 10)

    def on_state(self, state):
        self.armed = state.state in (ThrusterState.ARMED, ThrusterState.HOLD)

    def on_odometry(self, odometry):
        p, q, v = odometry.pose.pose.position, odometry.pose.pose.orientation, odometry.twist.twist
        self.error = self.goal - (p.x, p.y, p.z)  # in the map [m]
        yaw = 2.0 * np.arctan2(q.z, q.w)  # of a vehicle that is nearly level
        ahead, left = np.array([np.cos(yaw), np.sin(yaw), 0.0]), np.array([-np.sin(yaw), np.cos(yaw), 0.0])
        force = 20.0 * np.array([ahead @ self.error, left @ self.error, self.error[2]])
        force = np.clip(force, -15.0, 15.0) - 30.0 * np.array([v.linear.x, v.linear.y, v.linear.z])
        wrench = np.array([*force, 0.0, 0.0, -2.0 * yaw - 2.0 * v.angular.z])
        thrust = self.allocation @ wrench * self.armed  # arming is refused while a command is not zero
        header = Header(stamp=odometry.header.stamp, frame_id="base_link")
        command = ThrusterCommand(header=header, source="own", names=self.names, force=thrust.tolist())
        self.out.publish(command)
        # In lock-step, time advances when every node has reported that it has finished the present step.
        self.done.publish(Header(stamp=header.stamp, frame_id=self.get_fully_qualified_name()))


if __name__ == "__main__":
    rclpy.init()
    try:
        rclpy.spin(OwnController())
    except KeyboardInterrupt:
        pass
