"""Camera node: publishes received pictures: of the overhead camera with tags and calibration, and of onboard
sensors."""

from __future__ import annotations

from finssim.extensions.ros2.nodes.robot_node import RobotNode
from finssim.extensions.ros2.topics import own_topics
from finssim.localization.overhead_camera import load_pool
from finssim.robot.messages import Picture
from finssim.robot.pictures import DEFAULT_CAMERA, DEFAULT_PICTURES, open_pictures

POLL = 90.0
"""Rate of polling for new pictures [Hz]."""


class CameraNode(RobotNode):
    """Publisher of pictures, stamped with the middle of their exposure; each format only while it has a subscriber."""

    def __init__(self) -> None:
        super().__init__("camera")
        file = self.parameter("pool_file", "pool.yaml")
        self.pool = None if file == "none" else load_pool(self.await_file(file))
        address = self.parameter("pictures", f"udp://{DEFAULT_CAMERA}")
        simulated = self.get_parameter("use_sim_time").value
        self.source = open_pictures(
            address, self.parameter("pictures_bind", DEFAULT_PICTURES), polled=simulated
        )
        self.sends("diagnostics", "event")
        if self.pool is not None:
            self.sends("image", "picture", "camera_info", "tags")
            self.send("camera_info", self.make.camera_info(self.ns(self.now()), self.pool.camera.lens))
        for key, topic in own_topics(self.vehicle).items():
            try:
                self.sends(key)
            except ImportError as error:  # a ROS 2 without marine_acoustic_msgs
                self.event("error", f"{topic.name} is not sent: {error}")
        self.count = 0
        self.create_timer(1.0 / POLL, self._look)
        self.create_timer(1.0, self._publish_diagnostics)
        self.event("start", self.source.describe())

    def _look(self) -> None:
        for picture in self.source.receive(self.now()):
            self.count += 1
            if picture.source in self.vehicle.perception:
                self._publish_own(picture)
            elif not picture.source and self.pool is not None:
                self._publish(picture, picture.time - self.pool.latency)

    def _publish_own(self, picture: Picture) -> None:
        stamp = self.ns(picture.time - self.vehicle.perception[picture.source].latency)
        for key, make in self.make.of_own(stamp, picture).items():
            if self.heard(key):
                self.send(key, make())

    def _publish(self, picture: Picture, exposed: float) -> None:
        stamp = self.ns(exposed)
        if picture.tags or picture.image is None:
            self.send("tags", self.make.found_tags(stamp, picture, "camera"))
        if picture.image is None:
            return
        if self.heard("image"):
            self.send("image", self.make.image(stamp, picture.image))
        if self.heard("picture"):
            self.send("picture", self.make.compressed(stamp, picture.image))

    def _publish_diagnostics(self) -> None:
        level, self.count = ("ok" if self.count else "stale"), 0
        self.diagnose("pictures", level, self.source.describe(), {})

    def close(self) -> None:
        """Close the connection."""
        self.source.close()
