"""ArduSub's mixer: conversion of a pilot's six axes to pulses and thrusts of the motors, and back.

    out = rpy + linear, limited by the rule of the frame,   pulse = 1500 + 400 direction out
    T = c± ω|ω|,   ω = ESC(pulse)

The batch mixes for all worlds, the robot and the virtual firmware for one vehicle, with the same function
and numbers.
"""
# mypy: disable-error-code="no-untyped-def,no-untyped-call,no-any-return,valid-type,misc,untyped-decorator"

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from finssim.control import ControlError
from finssim.control.allocation import RowLaunch
from finssim.physics.types import MAX_THRUSTERS, vec6, vec8
from finssim.vehicles.autopilot import DEMANDS, Autopilot

__all__ = ["FULL", "NEUTRAL", "Mixer", "MixerData", "mix", "mixed_thrusts", "mixer_data"]

Array = npt.NDArray[np.float64]

NEUTRAL, FULL = 1500.0, 400.0
"""Pulse width of zero thrust, and its change to full output [µs]."""
PULSES = np.arange(NEUTRAL - FULL, NEUTRAL + FULL + 1.0)
"""Pulse widths of the thrust tables [µs], (801,)."""
RULES = {"VECTORED": 1, "VECTORED_6DOF": 2}
"""Frame -> rule that limits the outputs of its motors; other frames, with rule 0, clip each output separately."""
CORRECTIONS, NEAR = 20, 1e-4
"""Largest number of iterations of `Mixer.demands`, and tolerance of the outputs [-]."""

FROM_BODY = np.zeros((6, 6))
"""Surge, sway, heave, roll, pitch, yaw (forward, left, up) -> `DEMANDS` (forward, right, down), (6, 6)."""
for _row, (_axis, _sign) in enumerate([(3, 1.0), (4, -1.0), (5, -1.0), (2, 1.0), (0, 1.0), (1, -1.0)]):
    FROM_BODY[_row, _axis] = _sign


@wp.struct
class MixerData:
    """Numbers of each vehicle for `mix` and `mixed_thrusts`, built by `mixer_data`, with the vehicle as first
    index."""

    factors: wp.array2d(dtype=vec8)
    """Factors of the demands by motor, (vehicles, motors)."""
    rule: wp.array(dtype=int)
    """Rule of `RULES`, (vehicles,)."""
    motor: wp.array2d(dtype=int)
    """Motor of each thruster, canonical order, (vehicles, motors)."""
    direction: wp.array2d(dtype=float)
    """MOT_n_DIRECTION, by motor, -1 or 1 [-], (vehicles, motors)."""
    thrust: wp.array3d(dtype=float)
    """Steady thrust of each thruster, canonical order, at the pulses of `PULSES` [N], (vehicles, motors, 801)."""


@wp.func
def mix(demand: vec6, vehicle: int, data: MixerData) -> vec8:
    """Return the outputs of the motors before directions [-1, 1]      (ArduPilot,
    AP_Motors6DOF::output_armed_stabilizing_*).

    VECTORED clips each sum, and limits the forward demand of the rear pair (in the direction of travel) to 1 -
    |throttle|; VECTORED_6DOF divides vertical and horizontal motors each by their largest sum if it exceeds 1.

    Args:
        demand: Demands in the order of `DEMANDS` [-1, 1]; larger ones saturate.
        vehicle: First index into `data`.
        data: Numbers from `mixer_data`.
    """
    d = vec6()
    for k in range(6):
        d[k] = wp.clamp(demand[k], -1.0, 1.0)
    free = wp.max(1.0 - wp.abs(d[3]), 0.0)
    out = vec8()
    vertical, horizontal = float(1.0), float(1.0)
    for m in range(data.factors.shape[1]):
        factor = data.factors[vehicle, m]
        total = float(0.0)
        for k in range(6):
            part = d[k]
            if k == 4 and data.rule[vehicle] == 1 and factor[4] * d[4] > 0.0:
                part = wp.clamp(part, -free, free)
            total += factor[k] * part
        out[m] = total
        if factor[3] == 0.0:
            horizontal = wp.max(horizontal, wp.abs(total))
        else:
            vertical = wp.max(vertical, wp.abs(total))
    for m in range(data.factors.shape[1]):
        if data.rule[vehicle] == 2:
            out[m] /= wp.where(data.factors[vehicle, m][3] == 0.0, horizontal, vertical)
        out[m] = wp.clamp(out[m], -1.0, 1.0)
    return out


@wp.func
def mixed_thrusts(demand: vec6, vehicle: int, data: MixerData) -> vec8:
    """Return the steady thrusts for demands, canonical order [N].

    Args:
        demand: Demands in the order of `DEMANDS` [-1, 1]; larger ones saturate.
        vehicle: First index into `data`.
        data: Numbers from `mixer_data`.
    """
    out, f = mix(demand, vehicle, data), vec8()
    for k in range(data.factors.shape[1]):
        m = data.motor[vehicle, k]
        at = wp.static(FULL) * (1.0 + data.direction[vehicle, m] * out[m])
        i = wp.min(int(at), wp.static(len(PULSES) - 2))
        part = at - float(i)
        f[k] = (1.0 - part) * data.thrust[vehicle, k, i] + part * data.thrust[vehicle, k, i + 1]
    return f


@wp.kernel(enable_backward=False)
def mix_row(demand: wp.array(dtype=vec6), data: MixerData, out: wp.array(dtype=vec8)):
    """Run `mix` for the first vehicle.

    Args:
        demand: Demands in the order of `DEMANDS` [-1, 1], (N,).
        data: Numbers from `mixer_data`.
        out: Resulting outputs before directions [-1, 1], by motor, (N,).
    """
    i = wp.tid()
    out[i] = mix(demand[i], 0, data)


def autopilot_of(vehicle: Any) -> Autopilot:
    """Return the autopilot section of a vehicle.

    Raises:
        ControlError: The file has no autopilot, or a thruster has no `esc`.
    """
    autopilot: Autopilot | None = getattr(vehicle, "autopilot", None)
    if autopilot is None:
        raise ControlError(
            f"{vehicle.name} has no 'autopilot' section, so axes cannot be converted to pulses: add one to its file, "
            "'autopilot: {frame: VECTORED_6DOF}'"
        )
    bare = [name for name, thruster in vehicle.thrusters.items() if thruster.esc is None]
    if bare:
        raise ControlError(
            f"{vehicle.name}: thruster '{bare[0]}' has no 'esc' section, so pulses cannot be converted to thrusts: fit "
            "one with 'finssim calibrate thruster'"
        )
    return autopilot


def thrust_tables(vehicle: Any) -> Array:
    """Return the steady thrust of each thruster at the pulses of `PULSES` and the autopilot's voltage [N],
    (n, 801)."""
    autopilot = autopilot_of(vehicle)
    return np.stack(
        [
            np.clip(t.thrust(t.shaft_speed(PULSES, autopilot.voltage)), t.force_min, t.force_max)
            for t in vehicle.thrusters.values()
        ]
    )


def dead_band(vehicle: Any) -> float:
    """Return the output up to which no motor of a vehicle turns in either direction, at the autopilot's
    voltage [-]."""
    voltage = autopilot_of(vehicle).voltage
    edges = [t.esc.dead_band(voltage) for t in vehicle.thrusters.values()]
    return float(np.abs(np.array(edges) - NEUTRAL).max() / FULL)


def motors_of(vehicle: Any) -> npt.NDArray[np.int64]:
    """Return the motor of each thruster, canonical order, from 0, (n,)."""
    thrusters = vehicle.thrusters.values()
    return np.array([k if t.motor_index is None else t.motor_index for k, t in enumerate(thrusters)])


def mixer_data(vehicles: Sequence[Any], device: Any = "cpu") -> MixerData:
    """Return the numbers of `mix` and `mixed_thrusts` for vehicles with equal numbers of thrusters.

    Raises:
        ControlError: A vehicle has no `autopilot`, or thrusters without `esc`.
    """
    autopilots = [autopilot_of(vehicle) for vehicle in vehicles]
    data = _frames(autopilots, device)
    data.motor = wp.array(np.stack([motors_of(v) for v in vehicles]), dtype=int, device=device)
    data.thrust = wp.array(np.stack([thrust_tables(v) for v in vehicles]), dtype=float, device=device)
    return data


def _frames(autopilots: Sequence[Autopilot], device: Any = "cpu") -> MixerData:
    data = MixerData()
    factors = [np.pad(a.factors, [(0, 0), (0, MAX_THRUSTERS - len(DEMANDS))]) for a in autopilots]
    data.factors = wp.array(np.stack(factors), dtype=vec8, device=device)
    data.rule = wp.array([RULES.get(a.name, 0) for a in autopilots], dtype=int, device=device)
    signs = np.stack([a.signs(len(a.factors)) for a in autopilots])
    data.direction = wp.array(signs, dtype=float, device=device)
    return data


class Mixer:
    """Mixer of one vehicle, for use with NumPy.

    Note:
        It runs on the CPU and reuses its launch buffers, so each instance must be used by one thread only.
    """

    def __init__(self, autopilot: Autopilot) -> None:
        """
        Args:
            autopilot: Autopilot with its frame and directions.
        """
        self.autopilot = autopilot
        self.directions = autopilot.signs(len(autopilot.factors))
        """MOT_n_DIRECTION, by motor, (motors,)."""
        self._launch = RowLaunch(mix_row, vec6, _frames([autopilot]))
        self._inverse = np.linalg.pinv(autopilot.factors)
        self._motor: npt.NDArray[np.int64] | None = None
        self._tables: Array | None = None

    @classmethod
    def of(cls, vehicle: Any) -> Mixer:
        """Return the mixer of a vehicle's `autopilot`.

        Raises:
            ControlError: The vehicle has no autopilot, or thrusters without `esc`.
        """
        mixer = cls(autopilot_of(vehicle))
        mixer._motor, mixer._tables = motors_of(vehicle), thrust_tables(vehicle)
        return mixer

    @classmethod
    def of_frame(cls, frame: str, directions: Sequence[Any] = ()) -> Mixer:
        """Return the mixer of a frame by name; MOT_n_DIRECTION of each motor is 1 if not given."""
        return cls(Autopilot(frame=frame, directions=tuple(directions)))

    def outputs(self, demands: npt.ArrayLike) -> Array:
        """Return the outputs of the motors before directions [-1, 1], (..., motors).

        Args:
            demands: Demands in the order of `DEMANDS` in [-1, 1], (..., 6).
        """
        return self._launch(demands)[..., : len(self.directions)]

    def pulses(self, demands: npt.ArrayLike) -> Array:
        """Return the pulse widths of motors 1, 2, ... [µs], (..., motors), for demands (..., 6)."""
        return NEUTRAL + FULL * self.directions * self.outputs(demands)

    def demands(self, force: npt.ArrayLike) -> Array:
        """Return the demands whose thrusts are closest to the given ones, within [-1, 1], (6,).

        Outputs in the dead band are free within it; each iteration steps by the pseudo-inverse of the factors
        towards the required outputs.

        Args:
            force: Thrusts along the thrusters' axes, canonical order [N], (n,); 0 means that a motor is at rest.
        """
        assert self._motor is not None and self._tables is not None  # made by `of`
        low, high = np.zeros((2, len(self._motor)))
        for motor, table, thrust in zip(self._motor, self._tables, np.asarray(force, float), strict=True):
            rising = 1.0 if table[-1] > table[0] else -1.0
            if thrust == 0.0:  # any value in the dead band
                pulses = PULSES[table == 0.0][[0, -1]]
            else:
                pulses = np.interp(np.full(2, rising * thrust), rising * table, PULSES)
            ends = self.directions[motor] * (pulses - NEUTRAL) / FULL
            low[motor], high[motor] = ends.min(), ends.max()
        demand: Any = self._inverse @ np.where(low < high, 0.0, low)
        for _ in range(CORRECTIONS):
            out = self.outputs(demand)
            missing = np.clip(out, low, high) - out
            if np.abs(missing).max() < NEAR:
                break
            demand = np.clip(demand + self._inverse @ missing, -1.0, 1.0)
        return np.asarray(demand)
