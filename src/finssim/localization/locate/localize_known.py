"""What is known of the vehicle's height and tilt at the exposure of a picture, from files or from one number."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from finssim.geometry.rotations import quat_inverse_rotate
from finssim.localization.errors import LocalizationError
from finssim.localization.fusion.attitude import roll_pitch, up_of
from finssim.localization.fusion.fuse_table import StreamTable, read_stream_table
from finssim.localization.locate.series import Series, series
from finssim.localization.pool import Pool
from finssim.localization.poses.measurement import Constraints
from finssim.vehicles import Vehicle

__all__ = ["Known", "known_of"]

Array = npt.NDArray[np.float64]

LEVEL_STD = math.radians(2.0)
"""Tilt of a vehicle of which nobody says how it leans [rad]."""
TILT_STD = math.radians(0.5)
"""Error of an IMU's roll and pitch [rad]."""
DEPTH_STD = 0.01
"""Error of a depth where the vehicle file has no sensor [m]."""


@dataclass(frozen=True, eq=False)
class Known:
    """Sources of height and tilt."""

    base: Constraints
    """All that does not change: vertical, port, standard deviations."""
    surface: float
    """Height of the still surface along `base.up`, from the pool's origin [m]."""
    depth: Series | float | None
    """Of the pressure port below the surface, positive down [m]."""
    up: Series | None
    """Unit vector upwards in the body frame; None: level."""
    assumed: tuple[str, ...]
    """Sentences on what was assumed."""

    @property
    def settings(self) -> dict[str, float]:
        """Standard deviations, as plain values."""
        return {
            "depth_std": self.base.z_std,
            "tilt_std_deg": math.degrees(self.base.tilt_std),
            "shared_pixel_std": self.base.shared_pixel_std,
        }

    def at(self, time: float, *, needs_height: bool) -> Constraints | str | None:
        """Height and tilt at a time [s], or why they are not known; None where nothing is known nor needed.

        z_b = surface - depth - e3 . R_y(θ) R_x(φ) P_port, along the vertical.
        """
        if not needs_height and self.up is None:
            return None
        roll, pitch = 0.0, 0.0
        if self.up is not None:
            up_b = self.up.at(time)
            if isinstance(up_b, str):
                return up_b if needs_height else None
            roll, pitch = (float(angle) for angle in roll_pitch(up_b))
        depth = self.depth.at(time) if isinstance(self.depth, Series) else self.depth
        if isinstance(depth, str):
            if needs_height:
                return depth
            depth = None
        below = math.nan if depth is None else float(np.ravel(depth)[0])
        lever = float(up_of(roll, pitch) @ np.array(self.base.port))
        return replace(self.base, z_b=self.surface - below - lever, roll=roll, pitch=pitch)


def known_of(
    pool: Pool,
    vehicle: Vehicle,
    *,
    depth: str | float | Path | None,
    imu: str | Path | None,
    depth_std: float | None = None,
    tilt_std: float | None = None,
    shared_pixel_std: float = 0.0,
    longest_gap: float = 1.0,
) -> Known:
    """Read the sources.

    Args:
        pool: Where the water is. Where its plane is a surface, depth and tilt are relative to it; where it is a wall,
            to the world frame of the pool file.
        vehicle: Where its pressure port is and how well that measures.
        depth: File with columns t, depth, or one number [m], or None.
        imu: File with columns t and roll, pitch or qx, qy, qz, qw, or None.
        depth_std: Standard deviation of the depth [m]; None: that of the vehicle file's sensor.
        tilt_std: Of roll and pitch [rad]; None: 0.5 degrees with an IMU, 2 degrees without.
        shared_pixel_std: Error that all corners share [px].
        longest_gap: Nothing is interpolated between samples further apart [s].

    Raises:
        LocalizationError: A file without the columns, or a number that is none.
    """
    up, surface = _vertical(pool)
    sensor = vehicle.sensors.depth
    port = (0.0, 0.0, 0.0) if sensor is None else tuple(float(x) for x in sensor.position)
    known_std = DEPTH_STD if sensor is None else math.hypot(sensor.noise_std, sensor.bias_initial)
    base = Constraints(
        math.nan,
        z_std=_spread("depth_std", depth_std, known_std),
        tilt_std=_spread("tilt_std", tilt_std, LEVEL_STD if imu is None else TILT_STD),
        up=up,
        port=(port[0], port[1], port[2]),
        shared_pixel_std=_spread("shared_pixel_std", shared_pixel_std, 0.0),
    )
    assumed = []
    if imu is None:
        spread = math.degrees(base.tilt_std)
        assumed.append(f"no --imu: the vehicle is taken as level, give or take {spread:.1f} degrees")
    if sensor is None and depth is not None:
        assumed.append(f"{vehicle.name} has no depth sensor: the depth is taken as that of the body origin")
    return Known(base, surface, _depth(depth, longest_gap), _tilt(imu, longest_gap), tuple(assumed))


def _vertical(pool: Pool) -> tuple[tuple[float, float, float], float]:
    """The unit vector upwards, pool frame, and the height of the still surface along it.

    It is the plane's own normal where that is within 45 degrees of the world's z axis: water is level, surveys are
    nearly so.
    """
    T_pw = pool.T_pw
    if float(T_pw[:3, 2] @ pool.interface.normal) > math.sqrt(0.5):
        x, y, z = (float(a) for a in pool.interface.normal)
        return (x, y, z), -float(pool.interface.offset)
    x, y, z = (float(a) for a in T_pw[:3, 2])
    return (x, y, z), float(T_pw[:3, 2] @ T_pw[:3, 3])


def _depth(depth: str | float | Path | None, longest_gap: float) -> Series | float | None:
    if depth is None:
        return None
    try:
        number = float(str(depth))
    except ValueError:
        table = read_stream_table(Path(str(depth)))
        if not table.has("depth"):
            raise LocalizationError(
                f"{depth}: no column 'depth' with numbers: expected t [s] and depth [m], positive down"
            ) from None
        return series("depth", table.t, table.columns("depth"), longest_gap, where=str(depth))
    if not math.isfinite(number):
        raise LocalizationError(
            f"depth is {depth}, expected metres below the surface, or a file with t, depth"
        )
    return number


def _tilt(imu: str | Path | None, longest_gap: float) -> Series | None:
    if imu is None:
        return None
    table = read_stream_table(Path(imu))
    return series("attitude", table.t, _up(table, str(imu)), longest_gap, where=str(imu))


def _up(table: StreamTable, where: str) -> Array:
    """Up in the body frame for each row, (n, 3); its straight line between rows is how a vehicle leans."""
    if table.has("qx", "qy", "qz", "qw"):
        q = table.columns("qx", "qy", "qz", "qw")
        size = np.linalg.norm(q, axis=1, keepdims=True)
        if (np.abs(size[np.isfinite(size)] - 1.0) > 0.01).any():
            raise LocalizationError(f"{where}: qx, qy, qz, qw are not of unit length: expected body to world")
        return quat_inverse_rotate(q / size, np.array([0.0, 0.0, 1.0]))
    for names, unit in ((("roll", "pitch"), 1.0), (("roll_deg", "pitch_deg"), math.pi / 180.0)):
        if table.has(*names):
            roll, pitch = (table.columns(*names) * unit).T
            if np.nanmax(np.abs(table.columns(*names) * unit)) > 2.0 * math.pi:
                raise LocalizationError(f"{where}: roll or pitch exceeds a turn: expected radians, or *_deg")
            return up_of(roll, pitch)
    raise LocalizationError(
        f"{where}: no attitude: expected columns roll, pitch [rad] or qx, qy, qz, qw; of gyro and accelerometer alone "
        "`finssim fuse` makes one"
    )


def _spread(name: str, value: float | None, default: float) -> float:
    if value is None:
        return default
    if not (math.isfinite(value) and value >= 0.0):
        raise LocalizationError(f"{name} is {value}, expected a standard deviation that is not negative")
    return float(value)
