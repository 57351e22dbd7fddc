"""Worlds as data, and the sensors that see and hear them: cameras, imaging sonars, altimeters, DVL beams.

`WorldLayout`, `description` and `rays` need nothing beside the core; `WorldBatch` needs Newton
(`pip install 'finssim[perception]'`).
"""

from finssim.worlds.delivery import Delivery
from finssim.worlds.description import (
    World,
    WorldError,
    device_of,
    devices,
    load_device,
    load_world,
    sites,
)
from finssim.worlds.layout import WorldLayout
from finssim.worlds.model import WorldBatch
from finssim.worlds.sensors import CameraBatch, Headlight, RangeBatch, SonarBatch, poses_of, sensor_of

__all__ = [
    "CameraBatch",
    "Delivery",
    "Headlight",
    "RangeBatch",
    "SonarBatch",
    "World",
    "WorldBatch",
    "WorldError",
    "WorldLayout",
    "device_of",
    "devices",
    "load_device",
    "load_world",
    "poses_of",
    "sensor_of",
    "sites",
]
