"""Pictures that a task observes besides its numbers."""

from __future__ import annotations

from dataclasses import dataclass

from finssim.tasks.validation import EnvironmentSetupError
from finssim.vehicles import Vehicle
from finssim.vehicles.device_files import CameraDevice, RangeDevice, SonarDevice, device_of


@dataclass(frozen=True)
class ObservedPicture:
    """A picture that a task observes: a colour image of a camera, or the echoes of a sonar by beam and range."""

    name: str
    """Name of the entry in the vehicle's `perception`, such as `front_camera`."""
    width: int | None = None
    """Columns of a camera's image [px], instead of those of the entry; the height follows."""
    bins: int | None = None
    """Number of range cells of a sonar, from the nearest; all if None."""

    def device(self, vehicle: Vehicle) -> CameraDevice | SonarDevice:
        """Return the device of the picture, a sonar with the range of the selected cells.

        Raises:
            EnvironmentSetupError: The vehicle's sensor does not produce pictures.
            DeviceError: The vehicle has no such sensor, or its description is invalid.
        """
        device = device_of(vehicle, self.name)
        if isinstance(device, RangeDevice):
            raise EnvironmentSetupError(
                f"{vehicle.name}: perception.{self.name} measures ranges, expected a camera or a sonar"
            )
        if isinstance(device, CameraDevice):
            return device
        bins = min(self.bins or device.bins, device.bins)
        return device.model_copy(update={"bins": bins, "range": device.range * bins / device.bins})

    def shape(self, vehicle: Vehicle) -> tuple[int, int, int]:
        """Return (height, width, 3), row 0 at the top; for a sonar (beams, range cells, 1), beam 0 at the left."""
        device = self.device(vehicle)
        if isinstance(device, SonarDevice):
            return device.beams, device.bins, 1
        lens = device.lens(self.width)
        return lens.height, lens.width, 3
