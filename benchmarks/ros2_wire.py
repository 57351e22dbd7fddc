# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""Cost of one message on the built-in ROS 2 wire: python benchmarks/ros2_wire.py

Prints times of publishing to a subscription of the same process, and their ratio to the time in which NumPy copies
the same number of bytes, which depends less on the machine.
"""

import argparse
import os
import time

import numpy as np

os.environ.setdefault("ROS_DOMAIN_ID", "77")

from finssim.extensions.ros2.backend import activate

activate()

import rclpy
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Image


def best(call, count, rounds=7):
    """Return the median time of a call in the best of several rounds [µs]."""
    medians = []
    for _ in range(rounds):
        times = []
        for _ in range(count):
            began = time.perf_counter()
            call()
            times.append(time.perf_counter() - began)
        medians.append(float(np.median(times)))
    return min(medians) * 1e6


def round_trip(node, publisher, message, arrived, count):
    """Return the median time from publishing to the callback [µs], both in this process."""
    times = []
    for _ in range(count):
        seen, began = len(arrived), time.perf_counter()
        publisher.publish(message)
        while len(arrived) == seen and time.perf_counter() - began < 1.0:
            rclpy.spin_once(node, timeout_sec=0.1)
        times.append(time.perf_counter() - began)
    return float(np.median(times)) * 1e6


def main():
    """Measure and print."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    rclpy.init(args=[])
    node = Node("benchmark")
    picture = Image(height=1000, width=1000, data=bytes(10**6))
    print(f"{'message':10}{'serialize':>11}{'publish':>10}{'read':>9}{'there':>9}  [µs]  publish / copy")
    for name, message, qos, count in (
        ("Odometry", Odometry(), 10, 300),
        ("1 MB image", picture, qos_profile_sensor_data, 30),
    ):
        topic, arrived = name.split()[-1].lower(), []
        node.create_subscription(type(message), topic, arrived.append, qos)
        publisher = node.create_publisher(type(message), topic, qos)
        data = serialize_message(message)
        source = np.frombuffer(data, np.uint8)
        numbers = [
            best(lambda: serialize_message(message), count),  # noqa: B023 - called in this round
            best(lambda: publisher.publish(message), count),  # noqa: B023
            best(lambda: deserialize_message(data, type(message)), count),  # noqa: B023
            round_trip(node, publisher, message, arrived, count),
        ]
        ratio = numbers[1] / best(source.copy, count)
        print(f"{name:10}{numbers[0]:11.1f}{numbers[1]:10.1f}{numbers[2]:9.1f}{numbers[3]:9.1f}{ratio:22.1f}")
    rclpy.shutdown()


if __name__ == "__main__":
    main()
