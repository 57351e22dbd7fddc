"""Pictures that a task observes besides its row of numbers."""

from __future__ import annotations

from dataclasses import dataclass

from finssim.tasks.given import EnvironmentSetupError
from finssim.vehicles import Vehicle
from finssim.vehicles.device_files import CameraDevice, RangeDevice, SonarDevice, device_of


@dataclass(frozen=True)
class ObservedPicture:
    """A picture that a task observes: of a camera in colours, of a sonar the echoes by beam and range."""

    name: str
    """Name of the entry in the vehicle's `perception`, such as `front_camera`."""
    width: int | None = None
    """Columns of a camera's [px], in place of the entry's; the height follows."""
    bins: int | None = None
    """The nearest range cells of a sonar, so many; all if None."""

    def device(self, vehicle: Vehicle) -> CameraDevice | SonarDevice:
        """Return the device that takes it, a sonar with the range of its cells.

        Raises:
            EnvironmentSetupError: The vehicle's sensor takes no pictures.
            DeviceError: The vehicle has no such sensor, or it is refused.
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
        """(height, width, 3), row 0 at the top; of a sonar (beams, range cells, 1), beam 0 at the left."""
        device = self.device(vehicle)
        if isinstance(device, SonarDevice):
            return device.beams, device.bins, 1
        lens = device.lens(self.width)
        return lens.height, lens.width, 3
