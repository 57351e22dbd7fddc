# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""Pictures and telemetry are sent as messages; odometry equals the true pose."""

import math
from dataclasses import replace
from itertools import cycle

import numpy as np
import pytest

from finssim.extensions.ros2.backend import activate

activate(announce=False)

import rclpy
from rclpy.node import Node

from finssim.core.rotations import quat_from_euler, quat_to_matrix, quat_yaw
from finssim.extensions.ros2.nodes.conversions import RosMessages, nanoseconds, ros_type, tags_of, xyz, xyzw
from finssim.extensions.ros2.nodes.frames import FramePose, urdf_of
from finssim.extensions.ros2.nodes.localizer import Localizer
from finssim.extensions.ros2.nodes.state_estimation import StateEstimation
from finssim.extensions.ros2.topics import TOPICS, quality_profile
from finssim.extensions.ros2.worlds.sim import IdealSensors
from finssim.localization.overhead_camera import write_pool
from finssim.pool.camera import PoolCamera, camera_of
from finssim.robot.messages import Picture
from finssim.robot.reading import Reading
from finssim.vehicles import load_vehicle
from reference.ros_time import RosTime

VEHICLE = load_vehicle("finsrov")
PLACE, TURN = np.array([0.25, -0.15, -0.5]), np.asarray(quat_from_euler(0.02, -0.03, 0.8))
HEARD = ("fix", "tags", "odometry", "estimator", "transform", "fixed_transform", "robot", "diagnostics")
SENT = ("telemetry", "image", "picture", "tags")


def chained(first, second):
    """Return position and quaternion of the second transform's child in the first one's parent."""
    first, second = (
        FramePose(np.array(xyz(t.translation)), np.array(xyzw(t.rotation)))
        for t in (first.transform, second.transform)
    )
    return first.times(second)


class Album:
    """Pictures that are shown repeatedly."""

    def __init__(self, pictures):
        self._next = cycle(pictures)

    def advance(self, before, now, pose_at):
        return [replace(next(self._next), time=now)]


class Room:
    """Both nodes, and a peer that simulates the vehicle's instruments and the camera."""

    def __init__(self, folder, mode, *arguments):
        site, calibrated, settings = camera_of(VEHICLE, 1, "nominal")
        self.camera = PoolCamera(VEHICLE, site, mode=mode, settings=settings)
        self.pool, file = calibrated, folder / "pool.yaml"
        write_pool(calibrated, file)
        words = ["-r", "__ns:=/finsrov", "-p", f"pool_file:={file}", "-p", "use_sim_time:=true", *arguments]
        rclpy.init(args=["--ros-args", *words])
        self.peer = Node("peer")
        self.heard = {key: [] for key in HEARD}
        for key in HEARD:
            topic = TOPICS[key]
            self.peer.create_subscription(
                ros_type(topic.type), topic.name, self.heard[key].append, quality_profile(topic.quality)
            )
        self.nodes = (Localizer(), StateEstimation(), self.peer)
        self.out = {
            key: self.peer.create_publisher(
                ros_type(TOPICS[key].type), TOPICS[key].name, quality_profile(TOPICS[key].quality)
            )
            for key in SENT
        }
        self.time = RosTime(self.peer, self.nodes[:2])
        self.make, self.sensors, self.random = (
            RosMessages(VEHICLE),
            IdealSensors(VEHICLE),
            np.random.default_rng(0),
        )
        self.drawn, self.broken = self.time.now, lambda telemetry: telemetry

    def instruments(self, show):
        """Publish telemetry of the time and, thirty times a second, a picture by `show`."""
        now, stamp = self.time.now, self.time.ns
        reading = Reading(now, PLACE, TURN, np.zeros(6), True)
        exact = self.sensors.sample(reading, 0.01)
        noise = self.random.normal(0.0, 1e-3, (2, 3))
        telemetry = replace(
            exact,
            gyro=tuple((np.array(exact.gyro) + noise[0]).tolist()),
            accel=tuple((np.array(exact.accel) + noise[1]).tolist()),
            depth=exact.depth + 1e-3 * float(noise[0, 0]),
        )
        self.out["telemetry"].publish(self.make.telemetry(stamp, stamp, self.broken(telemetry)))
        if now - self.drawn > 0.033:
            for picture in self.camera.advance(self.drawn, now, lambda t: (PLACE, TURN)):
                show(round((picture.time - self.pool.latency) * 1e9), picture)
            self.drawn = now

    def until(self, condition, show):
        """Step until a condition is true; return whether it became true in time."""
        return self.time.until(condition, lambda: self.instruments(show))

    def tags(self, stamp, picture):
        self.out["tags"].publish(self.make.found_tags(stamp, picture, "camera"))

    def image(self, stamp, picture):
        self.out["image"].publish(self.make.image(stamp, picture.image))

    def jpeg(self, stamp, picture):
        self.out["picture"].publish(self.make.compressed(stamp, picture.image))

    def ready(self):
        return bool(self.heard["estimator"]) and self.heard["estimator"][-1].ready


@pytest.fixture
def room(tmp_path):
    """Function that makes a room; its nodes leave at the end."""
    rooms = []

    def make(mode, *arguments):
        rooms.append(Room(tmp_path, mode, *arguments))
        return rooms[-1]

    yield make
    for one in rooms:
        for node in one.nodes:
            node.destroy_node()
    rclpy.try_shutdown()


def check(room, tolerance, show):
    """Check that fix and odometry are the true pose, and that the fix is of an exposure from now on."""
    now = room.time.ns
    assert room.until(lambda: nanoseconds(room.heard["fix"][-1].header.stamp) > now, show)
    fix, odometry = room.heard["fix"][-1], room.heard["odometry"][-1]
    for message in (fix, odometry):
        p, q = message.pose.pose.position, message.pose.pose.orientation
        assert (p.x, p.y, p.z) == pytest.approx(PLACE, abs=tolerance)
        turned = float(quat_yaw([q.x, q.y, q.z, q.w]) - quat_yaw(TURN))
        assert abs(math.remainder(turned, 2.0 * math.pi)) < math.radians(1.5)
        assert message.header.frame_id == "map"


def test_tags_of_the_camera_become_the_true_pose(room):
    """The pose is stamped in the middle of the exposure, with the frames that viewers need."""
    room = room("corners")
    sent = []

    def show(stamp, picture):
        sent.append(stamp)
        room.tags(stamp, picture)

    assert room.until(room.ready, show)
    check(room, 0.01, show)
    assert nanoseconds(room.heard["fix"][-1].header.stamp) == pytest.approx(
        min(sent, key=lambda s: abs(s - nanoseconds(room.heard["fix"][-1].header.stamp))), abs=2_000
    )
    assert room.until(lambda: room.heard["fixed_transform"], show)
    tree = {t.child_frame_id: t for t in room.heard["fixed_transform"][0].transforms}
    assert {"imu_link", "pressure_link", "tag_15_link", "V_LF_link", "camera_link"} <= tree.keys()
    pool = room.pool.T_wp
    camera = chained(tree["camera_link"], tree["camera_optical"])
    assert camera[0] == pytest.approx(pool[:3, :3] @ room.pool.camera.position + pool[:3, 3])
    R = pool[:3, :3] @ quat_to_matrix(room.pool.camera.orientation)
    assert quat_to_matrix(camera[1]) == pytest.approx(R, abs=1e-9)
    assert room.until(lambda: room.heard["robot"], show)
    assert room.heard["robot"][0].data == urdf_of(VEHICLE)
    odometry = {nanoseconds(m.header.stamp): m.pose.pose for m in room.heard["odometry"]}
    both = [
        m.transforms for m in room.heard["transform"] if nanoseconds(m.transforms[0].header.stamp) in odometry
    ]
    for drift, odom in both:
        assert (drift.header.frame_id, drift.child_frame_id) == ("map", "odom")
        assert (odom.header.frame_id, odom.child_frame_id) == ("odom", "base_link")
        pose = odometry[nanoseconds(odom.header.stamp)]
        place, q = chained(drift, odom)
        assert place == pytest.approx(xyz(pose.position)) and abs(
            q @ xyzw(pose.orientation)
        ) == pytest.approx(1.0)
    assert both
    assert room.heard["estimator"][-1].fixes_accepted > 0


def test_bad_messages_never_raise_and_never_get_through(room):
    """NaN in telemetry, broken JSON and data that are not pictures are counted, and good messages still work."""
    room = room("corners")
    assert room.until(room.ready, room.tags)
    room.broken = lambda t: replace(t, gyro=(math.nan,) * 3, depth=math.inf, quaternion=(0.0,) * 4)
    text, image = ros_type("std_msgs/msg/String"), ros_type("sensor_msgs/msg/Image")
    for _ in range(30):
        room.out["tags"].publish(text(data='{"tags": [{"id": 1, "corners": [[NaN]]}]'))
        room.out["image"].publish(image(height=3, width=2**31, encoding="mono8", data=b"12"))
        room.instruments(lambda stamp, picture: room.tags(stamp - 50 * 10**9, picture))
        room.time.turn()
    assert room.until(lambda: not room.ready(), room.tags)
    room.broken = lambda t: t
    assert room.until(room.ready, room.tags)
    check(room, 0.02, room.tags)
    words = {"malformed tags", "not a picture of this camera", "imu: implausible"}
    told = lambda: {v.key for m in room.heard["diagnostics"] for s in m.status for v in s.values}  # noqa: E731
    assert room.until(lambda: words <= told(), room.tags)


@pytest.mark.slow
@pytest.mark.parametrize("form", ["image", "jpeg"])
def test_pictures_become_the_true_pose(room, form):
    """Raw and compressed pictures are drawn by the pool's camera; the detected tags are published."""
    room = room("pictures", "-p", f"image_transport:={'raw' if form == 'image' else 'compressed'}")
    # Drawn once beforehand, not in each turn.
    drawn = [room.camera.develop(e) for e in room.camera.exposures(0.0, 0.3, lambda t: (PLACE, TURN))]
    assert len(drawn) > 3
    room.camera = Album(drawn)
    assert room.until(lambda: room.ready() and len(room.heard["fix"]) > 3, getattr(room, form))
    check(room, 0.02, getattr(room, form))
    stamp, finder, picture = tags_of(room.heard["tags"][-1])
    assert (
        finder == "localizer"
        and isinstance(picture, Picture)
        and picture.tags
        and 100e9 < stamp <= room.time.ns
    )
