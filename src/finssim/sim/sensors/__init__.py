"""Sensors of a vehicle's own motion, with the noise, delays and dropouts of real instruments."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.sim.sensors.batch import SensorBatch, SensorError
    from finssim.sim.sensors.sampling import (
        DROPOUT,
        TURN_ON,
        TURN_ON_2,
        WALK,
        WALK_2,
        WHITE,
        WHITE_2,
        SampledState,
        digitised,
        digitised3,
        normal,
        normal3,
        parameters_of,
        sampling_kernel,
    )
    from finssim.sim.sensors.suite import SensorSuite, add_sensor

__all__ = [
    "DROPOUT",
    "TURN_ON",
    "TURN_ON_2",
    "WALK",
    "WALK_2",
    "WHITE",
    "WHITE_2",
    "SensorBatch",
    "SensorError",
    "SensorSuite",
    "SampledState",
    "add_sensor",
    "digitised",
    "digitised3",
    "normal",
    "normal3",
    "parameters_of",
    "sampling_kernel",
]

__getattr__, __dir__ = exports(__name__)
