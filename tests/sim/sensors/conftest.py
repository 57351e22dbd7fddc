"""Motion for the sensors to measure, and vehicles that carry them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

from finssim.physics.types import vec6
from finssim.vehicles import Vehicle, load_vehicle

DVL = {
    "rate": 5.0,
    "position": [0.12, -0.03, -0.10],
    "orientation": [0.0, 0.0, 0.3826834323650898, 0.9238795325112867],  # turned 45° to the left
    "noise_std": 0.01,
    "bias_initial": 0.002,
    "quantisation": 0.001,
    "latency": 0.06,
}


class Motion:
    """State arrays as the engine has them, level and at rest at the origin until a test writes to them."""

    def __init__(self, worlds: int, vehicles: int = 1) -> None:
        shape = (worlds, vehicles)
        self.position = wp.zeros(shape, dtype=wp.vec3)
        self.quaternion = wp.array(np.tile([0.0, 0.0, 0.0, 1.0], (*shape, 1)), dtype=wp.quat)
        self.velocity = wp.zeros(shape, dtype=vec6)
        self.acceleration = wp.zeros(shape, dtype=vec6)
        self.steps = wp.zeros(worlds, dtype=int)
        self.episode = wp.zeros(worlds, dtype=int)

    def put(self, **values: Any) -> Motion:
        """Write state arrays by name, each broadcast over (W, V)."""
        for name, value in values.items():
            getattr(self, name).numpy()[...] = value
        return self

    def advance(self) -> None:
        """Let one control step pass."""
        self.steps.numpy()[...] += 1


@pytest.fixture
def rest() -> type[Motion]:
    """Makes a motion: `rest(worlds, vehicles)`."""
    return Motion


@pytest.fixture(scope="session")
def vehicle() -> Vehicle:
    """A FinsROV that also carries a DVL, off centre and turned."""
    return load_vehicle("finsrov").replace({"sensors.dvl": DVL})


def ideal(batch: Any) -> Any:
    """The same sensors without any error; rate, latency and mounts stay."""
    exact = {
        "position",
        "orientation",
        "gravity",
        "specific_weight",
        "velocity_range",
        "gyro_range",
        "accel_range",
    }
    exact |= {"tilt_cosine", "max_tilt", "floor_depth", "altitude_min", "altitude_max"}
    names = batch.parameters.numpy().dtype.names
    batch.set(**{name: 0.0 for name in names if name not in exact})
    return batch


@pytest.fixture(name="ideal")
def _ideal() -> Any:
    return ideal
