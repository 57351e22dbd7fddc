# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""Drive the vehicles of a running ROS 2 graph by topics alone: arm, a goal, a path, teleoperation, disarm; a team also
exchanges messages. Exit status 1: a step was not completed in time.

finssim ros2 up pool --camera corners --lockstep
python examples/ros2/drive_graph.py finsrov

finssim ros2 up pool --team finsrov,finsrov,finsrov --site open-water --positioning motion-capture --lockstep
python examples/ros2/drive_graph.py robot_1 robot_2 robot_3

The script is the same for the built-in rclpy and for a sourced ROS 2. Its times are those of /clock, on any machine.
"""

import sys
import time

import numpy as np

from finssim.extensions.ros2 import activate

activate()

import rclpy
from finssim_msgs.msg import TeamMessage, ThrusterCommand, ThrusterState
from geometry_msgs.msg import PoseStamped, WrenchStamped
from nav_msgs.msg import Odometry, Path
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Bool, Header, String

SILENT = 120.0
"""Longest wait for the next message of /clock [s]."""


class Vehicle:
    """Latest messages of a vehicle, and publishers to it."""

    def __init__(self, node, name):
        self.name, self.odometry, self.state, self.command = name, None, None, None
        self.arm = node.create_publisher(Bool, f"/{name}/arm", 1)
        self.goal = node.create_publisher(PoseStamped, f"/{name}/goal", 1)
        self.path = node.create_publisher(Path, f"/{name}/follow_path", 1)
        self.mode = node.create_publisher(String, f"/{name}/mode", 1)
        self.wrench = node.create_publisher(WrenchStamped, f"/{name}/wrench_cmd", 1)
        self.message = node.create_publisher(TeamMessage, f"/{name}/messages/sent", 10)
        self.heard = []
        for kind, topic in (
            (Odometry, "odom"),
            (ThrusterState, "thruster_state"),
            (ThrusterCommand, "thruster_cmd"),
        ):
            node.create_subscription(kind, f"/{name}/{topic}", self.take, 10)
        node.create_subscription(
            TeamMessage, f"/{name}/messages/received", lambda m: self.heard.append((node.now, m)), 10
        )

    def take(self, message):
        kind = {"Odometry": "odometry", "ThrusterState": "state", "ThrusterCommand": "command"}
        setattr(self, kind[type(message).__name__], message)

    @property
    def place(self):
        """Position in the map [m]."""
        p = self.odometry.pose.pose.position
        return np.array([p.x, p.y, p.z])

    @property
    def speed(self):
        """Forward speed [m/s]."""
        return self.odometry.twist.twist.linear.x

    def is_in(self, state):
        """Return True if the bridge is in the given state."""
        return self.state is not None and self.state.state == state


class Driver(Node):
    """Node that advances the graph step by step of /clock, and commands the vehicles."""

    def __init__(self, names, context=None):
        super().__init__("driver", context=context)
        self.now, self.loop = -1.0, SingleThreadedExecutor(context=self.context)
        self.loop.add_node(self)
        self.done = self.create_publisher(Header, "/clock_done", 10)
        self.create_subscription(Clock, "/clock", self.on_clock, qos_profile_sensor_data)
        self.vehicles = [Vehicle(self, name) for name in names]

    def on_clock(self, message):
        self.stamp, self.now = message.clock, message.clock.sec + 1e-9 * message.clock.nanosec

    def step(self):
        """Report that this node has finished the present time step, and wait for the next one."""
        before, begun, reported = self.now, time.monotonic(), 0.0
        while self.now == before:
            if time.monotonic() - begun > SILENT:
                raise SystemExit("/clock stands still: start the graph with --lockstep or --real-time-factor")
            if before >= 0.0 and time.monotonic() - reported > 0.5:
                self.done.publish(Header(stamp=self.stamp, frame_id=self.get_fully_qualified_name()))
                reported = time.monotonic()
            self.loop.spin_once(timeout_sec=0.1)

    def until(self, what, holds, longest, each=lambda vehicle: None):
        """Step until a condition holds for every vehicle, or exit after `longest` seconds; `each` is called
        at every step."""
        end = self.now + longest
        while not all(holds(vehicle) for vehicle in self.vehicles):
            if self.now > end:
                late = [vehicle.name for vehicle in self.vehicles if not holds(vehicle)]
                raise SystemExit(f"{what}: not done in {longest:g} s by {', '.join(late)}")
            for vehicle in self.vehicles:
                each(vehicle)
            self.step()
        print(f"{self.now:7.2f} s  {what}", flush=True)


def pose(place, seconds=0.0):
    """Return a level pose in the map frame; `seconds` is its time after the first one [s]."""
    message = PoseStamped()
    message.header.frame_id = "map"
    message.header.stamp.sec, message.header.stamp.nanosec = int(seconds), int(seconds % 1.0 * 1e9)
    p = message.pose.position
    p.x, p.y, p.z = (float(x) for x in place)
    return message


def drive(driver):
    """Command the vehicles, and exit if a command is not followed; return the result of `talk`."""

    def arm(vehicle):
        if vehicle.is_in(ThrusterState.DISARMED) and round(60.0 * driver.now) % 60 == 0:
            vehicle.arm.publish(Bool(data=True))

    def push(vehicle):
        message = WrenchStamped()
        message.wrench.force.x = 10.0
        vehicle.mode.publish(String(data="teleop"))
        vehicle.wrench.publish(message)

    driver.until("armed", lambda v: v.is_in(ThrusterState.ARMED) and v.odometry is not None, 60.0, arm)
    begun = {v.name: v.place for v in driver.vehicles}
    goals = {v.name: begun[v.name] + (0.3, 0.2, 0.0) for v in driver.vehicles}
    for v in driver.vehicles:
        v.goal.publish(pose(goals[v.name]))
    driver.until("at the goal", lambda v: np.linalg.norm(v.place - goals[v.name]) < 0.08, 30.0)
    for v in driver.vehicles:
        back = [pose(goals[v.name] + s * (begun[v.name] - goals[v.name]), 3.0 * s) for s in (0.0, 0.5, 1.0)]
        path = Path(poses=back)
        path.header.frame_id = "map"
        v.path.publish(path)
    driver.until("at the end of the path", lambda v: np.linalg.norm(v.place - begun[v.name]) < 0.08, 30.0)
    slow = {v.name: v.speed for v in driver.vehicles}
    driver.until("pushed by teleoperation", lambda v: v.speed > slow[v.name] + 0.1, 10.0, push)
    driver.until("commanded so", lambda v: v.command.source.endswith("/teleop"), 1.0, push)
    late = talk(driver) if len(driver.vehicles) > 1 else {}
    for v in driver.vehicles:
        v.mode.publish(String(data="pid"))
        v.arm.publish(Bool(data=False))
    driver.until("disarmed", lambda v: v.is_in(ThrusterState.DISARMED) and not any(v.state.force), 2.0)
    return late


def talk(driver, period=0.05, count=20):
    """Let every vehicle send numbered messages; print and return their delays [s], by receiver."""
    sent, late = {}, {}
    for number in range(count):
        for v in driver.vehicles:
            sent[v.name, number] = driver.now
            v.message.publish(TeamMessage(sender=v.name, data=[number]))
        end = driver.now + (period if number < count - 1 else 0.5)
        while driver.now < end:
            driver.step()
    for v in driver.vehicles:
        late[v.name] = {(m.sender, m.data[0]): at - sent[m.sender, m.data[0]] for at, m in v.heard}
        least, expected = min(late[v.name].values(), default=np.nan), count * (len(driver.vehicles) - 1)
        print(f"{v.name} heard {len(late[v.name])} of {expected} messages, {least:.3f} s late or more")
    return late


if __name__ == "__main__":
    rclpy.init()
    drive(Driver(sys.argv[1:] or ["finsrov"]))
