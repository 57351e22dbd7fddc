"""From mapped columns to a trial: axes, velocities of the world, pressure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from finssim.calibration.errors import CalibrationError
from finssim.calibration.importers.column_map import ColumnMap
from finssim.calibration.importers.source_map import Frame
from finssim.calibration.importers.streams import Stream, Table
from finssim.calibration.importers.units import GRAVITY
from finssim.calibration.trials.columns import NU
from finssim.calibration.trials.conversion import in_our_frames, tidy_quaternions
from finssim.calibration.trials.header import Conversion, Header
from finssim.calibration.trials.trial import PHASES, Array, Trial
from finssim.geometry.frames import FROM_FOSSEN
from finssim.geometry.rotations import quat_from_euler, quat_inverse_rotate
from finssim.vehicles import load_vehicle

__all__ = ["in_our_axes", "trial_of"]

EULER = ("roll", "pitch", "yaw")
QUATERNION = ("qx", "qy", "qz", "qw")
WORLD_VELOCITY = ("vx", "vy", "vz")
STANDARD_ATMOSPHERE = 101325.0
LONGEST_BRIDGE = 0.5
"""Between two attitudes that a velocity of the world is turned with [s]."""


def in_our_axes(stream: Stream, frame: Frame) -> Stream:
    """The stream in x forward, y left, z up and a world with z up."""
    channels = in_our_frames(stream.channels, Conversion(body=frame.body, world=frame.world))
    if frame.world == "NED":
        for name, sign in zip(WORLD_VELOCITY, FROM_FOSSEN.A.diagonal(), strict=True):
            if name in channels:
                channels[name] = sign * channels[name]
    return replace(stream, channels=channels)


def trial_of(name: str, table: Table, header: Header, column_map: ColumnMap) -> Trial:
    """The trial that a table makes, with u v w and depth in place of world velocities and pressure.

    Raises:
        CalibrationError: World velocities without an attitude, or beside body velocities.
    """
    channels, notes = dict(table.channels), list(table.notes)
    if any(c in channels for c in WORLD_VELOCITY):
        channels |= _body_velocity(name, table.t, channels)
        channels = {c: v for c, v in channels.items() if c not in WORLD_VELOCITY}
    if "pressure" in channels:
        depth, note = _depth(name, channels.pop("pressure"), header, column_map)
        notes += note
        channels["depth"] = depth
    notes += tidy_quaternions(channels)
    for column in [c for c, v in channels.items() if not np.isfinite(v).any()]:
        notes.append(f"{column} holds no finite number and is left out")
        del channels[column]
    if not channels:
        raise CalibrationError(f"{name}: no column of a trial holds a number")
    return Trial(
        name=name, t=table.t, channels=channels, phase=_phase(table), header=header, notes=tuple(notes)
    )


def _phase(table: Table) -> np.ndarray | None:
    if "phase" not in table.words:
        return None
    said = table.words["phase"]
    return np.where(np.isin(said, PHASES), said, "").astype(np.str_)


def _body_velocity(name: str, t: Array, channels: dict[str, Array]) -> dict[str, Array]:
    """u v w from world velocities and the attitude interpolated to their times."""
    from scipy.spatial.transform import Rotation, Slerp

    missing = [c for c in WORLD_VELOCITY if c not in channels]
    if missing or any(c in channels for c in NU[:3]):
        raise CalibrationError(
            f"{name}: expected all of vx, vy, vz (in the world) or u, v, w (in the body), not both"
            + (f": {', '.join(missing)} missing" if missing else "")
        )
    if all(c in channels for c in QUATERNION):
        q = np.stack([channels[c] for c in QUATERNION], axis=-1)
    elif all(c in channels for c in EULER):
        q = quat_from_euler(*(channels[c] for c in EULER))
    else:
        raise CalibrationError(
            f"{name}: vx, vy, vz are velocities in the world, and without an attitude they cannot become u, v, w: "
            "map roll pitch yaw or qx qy qz qw"
        )
    known = np.isfinite(q).all(axis=-1) & (np.linalg.norm(np.nan_to_num(q), axis=-1) > 0.5)
    velocity = np.stack([channels[c] for c in WORLD_VELOCITY], axis=-1)
    if known.sum() < 2:
        raise CalibrationError(f"{name}: the attitude that turns vx, vy, vz holds fewer than two samples")
    times = t[known]
    after = np.clip(np.searchsorted(times, t), 1, len(times) - 1)
    near = (t >= times[0]) & (t <= times[-1]) & (times[after] - times[after - 1] <= LONGEST_BRIDGE)
    usable = near & np.isfinite(velocity).all(axis=-1)
    body = np.full_like(velocity, np.nan)
    if usable.any():
        attitude = Slerp(times, Rotation.from_quat(q[known]))(t[usable]).as_quat()
        body[usable] = quat_inverse_rotate(attitude, velocity[usable])
    return dict(zip(NU[:3], body.T, strict=True))


def _depth(name: str, pressure: Array, header: Header, column_map: ColumnMap) -> tuple[Array, list[str]]:
    """Depth of the pressure sensor [m]: (p - p_surface) / (rho g)."""
    vehicle = load_vehicle(header.vehicle) if header.vehicle is not None else None
    density = header.water.density or (vehicle.water.density if vehicle else 1000.0)
    gravity = vehicle.water.gravity if vehicle else GRAVITY
    surface = column_map.surface_pressure
    notes = [f"depth from pressure with {density:g} kg/m³"]
    if surface is None:
        surface = STANDARD_ATMOSPHERE
        notes = [f"{notes[0]} and 101325 Pa at the surface: give surface_pressure, 1 hPa is 1 cm"]
    return (pressure - surface) / (density * gravity), notes
