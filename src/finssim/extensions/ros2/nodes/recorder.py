"""Recorder node: records all topics of a vehicle unchanged in one MCAP, which rosbag2 and Foxglove open."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from finssim.extensions.ros2.nodes.robot_node import RobotNode
from finssim.robot.recorder import Recorder
from finssim.vehicles import Vehicle

LEFT_OUT, RAW = ("clock", "done"), "sensor_msgs/msg/Image"
"""Topics that are not recorded: raw pictures fill disks and are recorded compressed; simulated time is in
every stamp."""


class RecorderNode(RobotNode):
    """Node that records from its start to its end; a full disk ends the record, not the node."""

    urgent = False

    def __init__(self) -> None:
        super().__init__("recorder")
        path, pool_file = self.parameter("record", ""), self.parameter("pool_file", "")
        pictures = self.parameter("pictures", True)
        self.sends("diagnostics", "event")
        self.mcap: _WireRecord | None = None
        if not path:
            self.get_logger().info("nothing is recorded: give a file by the parameter record")
            return
        files = {"pool.yaml": self.await_file(pool_file)} if pool_file not in ("", "none") else {}
        names = {key: self.resolve_topic_name(self.topic(key)) for key in self.table}
        self.mcap = _WireRecord(Path(path), self.filed, {"command": "ros2 recorder"}, files, names)
        for key, topic in self.table.items():
            if key not in LEFT_OUT and topic.type != RAW and (pictures or not key.endswith("picture")):
                with suppress(ImportError):  # a ROS 2 without marine_acoustic_msgs
                    self.hears(key, self._taker(key), raw=True)
        self.create_timer(1.0, self._publish_diagnostics)

    def _taker(self, key: str) -> Any:
        record, clock = self.mcap, self.get_clock()
        assert record is not None
        return lambda data: record.message(key, clock.now().nanoseconds, bytes(data))

    def _publish_diagnostics(self) -> None:
        if self.mcap is not None:
            problem = self.mcap.problem
            self.diagnose(
                "record", "error" if problem else "ok", problem or "recording", {"dropped": self.mcap.dropped}
            )

    def close(self) -> None:
        """Close the file."""
        if self.mcap is not None:
            self.mcap.close()


class _WireRecord(Recorder):
    """Record of serialized messages as received, under the topic names of the network."""

    def __init__(
        self,
        path: Path,
        vehicle: Vehicle,
        meta: Mapping[str, Any],
        files: Mapping[str, Path | str],
        names: Mapping[str, str],
    ) -> None:
        self._names = names
        super().__init__(path, vehicle, meta, files=files)

    def message(self, key: str, at: int, data: bytes) -> None:
        """Write one message that arrived at a time [ns]."""
        self._sink.put(key, at, data, len(data))

    def _topic_name(self, key: str) -> str:
        return self._names[key]
