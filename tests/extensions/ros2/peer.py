# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""The second process of the tests: `peer.py WHAT` communicates on the environment's domain until it is ended."""

import sys

from finssim.extensions.ros2.backend import activate

activate()

import rclpy
from finssim_msgs.msg import ThrusterCommand
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import Image
from std_srvs.srv import SetBool

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Echo(Node):
    """Node that returns its messages, serves a service, and latches a goal at its start."""

    def __init__(self) -> None:
        super().__init__("echo", namespace="peer")
        for kind, topic, qos in (
            (Odometry, "odom", 10),
            (Image, "image", qos_profile_sensor_data),
            (ThrusterCommand, "thruster_cmd", 10),
        ):
            back = self.create_publisher(kind, f"{topic}_back", qos)
            self.create_subscription(kind, topic, back.publish, qos)
        self.latched = self.create_publisher(PoseStamped, "goal", LATCHED)
        goal = PoseStamped()
        goal.pose.position.x = 1.5
        self.latched.publish(goal)
        self.create_service(SetBool, "set_armed", self.on_arm)

    def on_arm(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        """Answer with the requested value."""
        response.success, response.message = request.data, f"armed {request.data}"
        return response


class Settings(Node):
    """Node that publishes its parameters as a command, on a topic that the command line renames."""

    def __init__(self) -> None:
        super().__init__("settings", namespace="peer")
        gain = self.declare_parameter("gain", 0.0).value
        names = self.declare_parameter("names", [""]).value
        publisher = self.create_publisher(ThrusterCommand, "settings", LATCHED)
        publisher.publish(ThrusterCommand(names=names, force=[gain], source=self.get_fully_qualified_name()))


def main() -> None:
    """Spin until SIGTERM."""
    rclpy.init()
    node = {"echo": Echo, "settings": Settings}[sys.argv[1]]()
    try:
        rclpy.spin(node)
    except ExternalShutdownException:
        pass
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
