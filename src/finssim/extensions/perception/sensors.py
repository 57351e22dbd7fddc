"""Construction of the sensor for an entry of a vehicle's `perception`."""
# mypy: ignore-errors

from __future__ import annotations

from finssim.extensions.perception.cameras import CameraBatch, Headlight
from finssim.extensions.perception.model import WorldBatch
from finssim.extensions.perception.rangers import RangeBatch
from finssim.extensions.perception.sonars import SonarBatch
from finssim.vehicles import Vehicle
from finssim.vehicles.device_files import CameraDevice, SonarDevice, device_of


def sensor_of(
    batch: WorldBatch, vehicle: Vehicle, name: str, *, vehicles: int = 1, lamps: tuple[Headlight, ...] = ()
) -> CameraBatch | SonarBatch | RangeBatch:
    """Return the sensor for an entry of a vehicle's `perception`, on every vehicle of a batch.

    Args:
        batch: The worlds.
        vehicle: Vehicle whose file contains mount, rate, width and range cells.
        name: Name of the entry, such as `front_camera`.
        vehicles: Number of vehicles in each world.
        lamps: Lights on each vehicle, for cameras.

    Raises:
        WorldError: The vehicle has no such entry, or its device is refused.
    """
    device = device_of(vehicle, name)
    if isinstance(device, CameraDevice):
        return CameraBatch(batch, device, vehicles=vehicles, lamps=lamps)
    if isinstance(device, SonarDevice):
        return SonarBatch(batch, device, vehicles=vehicles)
    return RangeBatch(batch, device, vehicles=vehicles)
