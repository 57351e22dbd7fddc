"""Software of the robot: links, the bridge, the control loop, the recorder. No simulator, no torch, no ROS."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.robot.bridge import Bridge, BridgeSettings
    from finssim.robot.goals import station_of
    from finssim.robot.links.frames import MCU, Decoder, encode_command, encode_telemetry
    from finssim.robot.links.transports import host_port, memory_pair
    from finssim.robot.links.water_linked import DvlClient, decode_line
    from finssim.robot.lockstep import run_lockstep
    from finssim.robot.messages import Telemetry, ThrusterCommand
    from finssim.robot.perception import Perception
    from finssim.robot.pilots import make_pilot
    from finssim.robot.reading import Reading
    from finssim.robot.record_reader import open_record
    from finssim.robot.recorder import Recorder
    from finssim.robot.runtime import Runtime
    from finssim.robot.teleop import Hands, Operator

__all__ = [
    "Bridge",
    "BridgeSettings",
    "Decoder",
    "DvlClient",
    "Hands",
    "MCU",
    "Operator",
    "Perception",
    "Reading",
    "Recorder",
    "Runtime",
    "Telemetry",
    "ThrusterCommand",
    "decode_line",
    "encode_command",
    "encode_telemetry",
    "host_port",
    "make_pilot",
    "memory_pair",
    "open_record",
    "run_lockstep",
    "station_of",
]

__getattr__, __dir__ = exports(__name__)
