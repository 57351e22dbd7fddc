"""Perception: worlds as data, and the sensors that observe them: cameras, imaging sonars, altimeters, DVL beams.

`WorldLayout`, `description` and `rays` need only the core; `WorldBatch` needs Newton
(`pip install 'finssim[perception]'`). Modules that compute are imported when they are first used: a robot that
only reads its device descriptions starts without Warp.
"""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.extensions.perception.cameras import CameraBatch, Headlight
    from finssim.extensions.perception.delivery import DelayedSensor
    from finssim.extensions.perception.description import World, WorldError, load_world, sites
    from finssim.extensions.perception.layout import WorldLayout
    from finssim.extensions.perception.model import WorldBatch
    from finssim.extensions.perception.rangers import DopplerBatch, RangeBatch
    from finssim.extensions.perception.ray_batch import poses_of
    from finssim.extensions.perception.sensors import sensor_of
    from finssim.extensions.perception.sonars import SonarBatch

__all__ = [
    "CameraBatch",
    "DelayedSensor",
    "DopplerBatch",
    "Headlight",
    "RangeBatch",
    "SonarBatch",
    "World",
    "WorldBatch",
    "WorldError",
    "WorldLayout",
    "load_world",
    "poses_of",
    "sensor_of",
    "sites",
]

__getattr__, __dir__ = exports(__name__)
