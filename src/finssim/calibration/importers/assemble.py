"""From mapped columns to a trial: axes, velocities of the world, pressure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, finding
from finssim.calibration.importers.ardusub_outputs import FRAMES, NEUTRAL, STICKS, mixed_pulses, outputs_of
from finssim.calibration.importers.column_map import ArduSubMap, ColumnMap
from finssim.calibration.importers.source_map import Frame
from finssim.calibration.importers.streams import Stream, Table
from finssim.calibration.trials.conversion import in_our_frames, tidy_quaternions
from finssim.calibration.trials.header import Conversion, Header
from finssim.calibration.trials.trial import NU, PHASES, Array, Trial
from finssim.calibration.trials.units import GRAVITY
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
    channels, findings = dict(table.channels), list(table.findings)
    if any(c in channels for c in WORLD_VELOCITY):
        channels |= _body_velocity(name, table.t, channels)
        channels = {c: v for c, v in channels.items() if c not in WORLD_VELOCITY}
    if "pressure" in channels:
        depth, assumed = _depth(channels.pop("pressure"), header, column_map)
        findings += assumed
        channels["depth"] = depth
    if any(c in channels for c in STICKS):
        pulses, mixed = _pulses(name, channels, header, column_map.ardusub)
        channels = {c: v for c, v in channels.items() if c not in STICKS} | pulses
        findings += mixed
    findings += tidy_quaternions(channels)
    for column in [c for c, v in channels.items() if not np.isfinite(v).any()]:
        findings.append(finding("column_empty", column=column))
        del channels[column]
    if not channels:
        raise CalibrationError(f"{name}: no column of a trial holds a number")
    return Trial(
        name=name, t=table.t, channels=channels, phase=_phase(table), header=header, findings=tuple(findings)
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


def _pulses(
    name: str, channels: dict[str, Array], header: Header, asked: ArduSubMap
) -> tuple[dict[str, Array], list[Finding]]:
    """Pulse widths of the vehicle's thrusters [µs] from the sticks, by ArduSub's mixer; and findings."""
    if asked.frame is None or header.vehicle is None:
        raise CalibrationError(
            f"{name}: stick_* columns go through ArduSub's mixer: give its frame in the map, "
            "'ardusub: {frame: VECTORED_6DOF}' or VECTORED, and the vehicle"
        )
    pulses = [c for c in channels if c.startswith("pwm_")]
    if pulses:
        raise CalibrationError(
            f"{name}: expected stick_* or pwm_* columns, not both: {pulses[0]} is there as well"
        )
    given = [channels[c] for c in STICKS if c in channels]
    known = np.all([np.isfinite(v) for v in given], axis=0)
    demands = np.stack([channels.get(c, np.zeros(len(known))) for c in STICKS], axis=-1)
    beyond = float(np.abs(demands[known]).max(initial=0.0))
    if beyond > 1.01:
        raise CalibrationError(
            f"{name}: stick_* reach {beyond:g}, expected demands in [-1, 1]: "
            "give scale and offset in the map, scale: 0.0025 and offset: -3.75 for channels of 1100 to 1900 µs"
        )
    vehicle = load_vehicle(header.vehicle)
    config = next(number for number, (frame, _) in FRAMES.items() if frame == asked.frame)
    directions = {f"MOT_{motor + 1}_DIRECTION": 1.0 for motor in range(len(FRAMES[config][1]))}
    outputs, mapped = outputs_of(vehicle, {"FRAME_CONFIG": config, **directions}, asked.outputs)
    mixed = mixed_pulses(asked.frame, asked.gain * demands, asked.motor_directions)
    found = {}
    for output, (thruster, sign) in outputs.items():
        pulse = NEUTRAL + sign * (mixed[:, output - 1] - NEUTRAL)
        found[f"pwm_{thruster}"] = np.where(known, pulse, np.nan)
    return found, [finding("sticks_mixed", frame=asked.frame, gain=asked.gain), mapped]


def _depth(pressure: Array, header: Header, column_map: ColumnMap) -> tuple[Array, list[Finding]]:
    """Depth of the pressure sensor [m]: (p - p_surface) / (rho g)."""
    vehicle = load_vehicle(header.vehicle) if header.vehicle is not None else None
    density = header.water.density or (vehicle.water.density if vehicle else 1000.0)
    gravity = vehicle.water.gravity if vehicle else GRAVITY
    surface = column_map.surface_pressure
    findings = [finding("depth_of_pressure", density=density)]
    if surface is None:
        surface = STANDARD_ATMOSPHERE
        findings.append(finding("surface_pressure_assumed", pressure=surface))
    return (pressure - surface) / (density * gravity), findings
