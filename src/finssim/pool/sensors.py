"""The instruments aboard: the simulator's IMU and pressure gauge, sampled on the motor controller's clock."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from finssim.pool.plant import Plant, captured
from finssim.pool.plant_spec import Instruments
from finssim.robot.messages import HEADING, VELOCITY, NavigationAid
from finssim.sensors import SensorSuite
from finssim.vehicles import Vehicle

__all__ = ["PoolSensors", "Sample"]

IMU_ERRORS = (
    "gyro_noise_density",
    "gyro_bias_walk",
    "gyro_bias_initial",
    "accel_noise_density",
    "accel_bias_walk",
    "accel_bias_initial",
)


class Sample(NamedTuple):
    """What the motor controller has read at one time."""

    gyro: tuple[float, float, float]
    """IMU frame [rad/s]."""
    accel: tuple[float, float, float]
    """Specific force, IMU frame [m/s²]."""
    depth: float
    """Of the pressure port, positive down [m]."""
    pressure: float
    """Absolute [Pa]."""


class PoolSensors:
    """IMU and pressure gauge of one plant; `sample` reads both once per period of the IMU."""

    def __init__(self, plant: Plant, seed: int) -> None:
        """Switch them on: turn-on biases are drawn.

        Args:
            plant: What they measure.
            seed: Of their errors.
        """
        self.period = 1.0 / plant.vehicle.sensors.imu.rate  # type: ignore[union-attr]
        """Between samples [s]."""
        vehicle = with_instruments(plant.vehicle, plant.spec.instruments)
        key = int(np.random.SeedSequence([seed, 72]).generate_state(1)[0] >> 1)
        floor = plant.spec.basin.depth
        suite = SensorSuite(vehicle, worlds=1, control_step=self.period, seed=key, floor_depth=floor)
        state = plant.simulator.state
        self._state = SimpleNamespace(
            position=state.position,
            quaternion=state.quaternion,
            velocity=state.velocity,
            acceleration=state.acceleration,
            steps=wp.zeros(1, dtype=int, device="cpu"),
            episode=wp.zeros(1, dtype=int, device="cpu"),
        )
        suite.reset(self._state)
        self._update, self._suite = captured(lambda: suite.update(self._state)), suite
        self._count: Any = self._state.steps.numpy()

        def view(readings: Any) -> Any:
            return readings.numpy()[0]

        imu, gauge = suite.imu, suite.depth
        assert imu is not None and gauge is not None  # draw_plant refuses a vehicle without them
        self._gyro, self._accel = view(imu.gyro)[0], view(imu.accel)[0]
        self._depth, self._pressure = view(gauge.depth), view(gauge.pressure)
        self._aids = [
            (kind, view(batch.fresh), view(batch.stamp), np.atleast_2d(view(reading)))
            for kind, batch, reading in (
                (VELOCITY, suite.dvl, suite.dvl and suite.dvl.velocity),
                (HEADING, suite.compass, suite.compass and suite.compass.heading),
            )
            if batch is not None
        ]
        self._sent = 0

    def sample(self) -> Sample:
        """Read both; the gauge gives its newest sample that has arrived."""
        self._count[0] += 1
        self._update()
        return Sample(
            tuple(self._gyro.tolist()),
            tuple(self._accel.tolist()),
            float(self._depth[0]),
            float(self._pressure[0]),
        )

    def aids(self) -> list[NavigationAid]:
        """What Doppler log and compass have delivered at the newest `sample`."""
        found = []
        for kind, fresh, stamp, reading in self._aids:
            if not fresh[0]:
                continue
            values = [*reading[0].tolist(), 0.0, 0.0]
            age = max(float(self._count[0]) * self.period - float(stamp[0]), 0.0)
            self._sent += 1
            found.append(
                NavigationAid(self._sent & 0xFFFF, kind, age, (values[0], values[1], values[2]), (0.0, 0.0))
            )
        return found


def with_instruments(vehicle: Vehicle, instruments: Instruments) -> Vehicle:
    """The vehicle with the errors that its instruments have in this plant.

    The IMU's latency is left out: it is the time between a sample and its frame, which the firmware takes.
    """
    factor = instruments.noise
    imu, gauge = vehicle.sensors.imu, vehicle.sensors.depth
    assert imu is not None and gauge is not None
    scaled = {name: factor * getattr(imu, name) for name in IMU_ERRORS}
    walk = float(np.hypot(factor * gauge.bias_walk, instruments.pressure_drift))
    drifting = {
        "noise_std": factor * gauge.noise_std,
        "bias_initial": factor * gauge.bias_initial,
        "bias_walk": walk,
    }
    sensors = vehicle.sensors.model_copy(
        update={
            "imu": imu.model_copy(update={**scaled, "latency": 0.0}),
            "depth": gauge.model_copy(update=drifting),
        }
    )
    return vehicle.model_copy(update={"sensors": sensors})
