"""Which output of an ArduSub autopilot drives which thruster, and which way."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, finding
from finssim.geometry.frames import FROM_FOSSEN
from finssim.vehicles import Vehicle
from finssim.vehicles.part import did_you_mean

__all__ = ["NEUTRAL", "STICKS", "mixed_pulses", "outputs_of"]

NEUTRAL = 1500.0
"""Pulse width of no thrust [µs]."""

HALF_RANGE = 400.0
"""Pulse width of full output, from neutral [µs]."""

STICKS = ("stick_roll", "stick_pitch", "stick_yaw", "stick_throttle", "stick_forward", "stick_lateral")
"""Demands in the order of the mixer's factors."""

MOTOR_1 = 33
"""SERVOn_FUNCTION of the first motor."""

_HORIZONTAL: list[list[float]] = [
    [0, 0, 1, 0, -1, 1],
    [0, 0, -1, 0, -1, -1],
    [0, 0, -1, 0, 1, 1],
    [0, 0, 1, 0, 1, -1],
]

FRAMES: dict[int, tuple[str, list[list[float]]]] = {
    0: (
        "BLUEROV1",
        [
            [0, 0, -1, 0, 1, 0],
            [0, 0, 1, 0, 1, 0],
            [-0.5, 0.5, 0, 0.45, 0, 0],
            [0.5, 0.5, 0, 0.45, 0, 0],
            [0, -1, 0, 1, 0, 0],
            [-0.25, 0, 0, 0, 0, 1],
        ],
    ),
    1: ("VECTORED", [*_HORIZONTAL, [1, 0, 0, -1, 0, 0], [-1, 0, 0, -1, 0, 0]]),
    2: (
        "VECTORED_6DOF",
        [
            *_HORIZONTAL,
            [1, -1, 0, -1, 0, 0],
            [-1, -1, 0, -1, 0, 0],
            [1, 1, 0, -1, 0, 0],
            [-1, 1, 0, -1, 0, 0],
        ],
    ),
    4: ("SIMPLEROV_3", [[0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 1, 0], [0, 0, 0, -1, 0, 0]]),
    5: (
        "SIMPLEROV_4",
        [[0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 1, 0], [1, 0, 0, -1, 0, 0], [-1, 0, 0, -1, 0, 0]],
    ),
    6: (
        "SIMPLEROV_5",
        [
            [0, 0, -1, 0, 1, 0],
            [0, 0, 1, 0, 1, 0],
            [1, 0, 0, -1, 0, 0],
            [-1, 0, 0, -1, 0, 0],
            [0, 0, 0, 0, 0, 1],
        ],
    ),
}
"""FRAME_CONFIG -> name, and of each motor its factors of roll right, pitch up, yaw right, up, forward, right
(ArduPilot, AP_Motors6DOF::setup_motors)."""

LEAST_LIKENESS = 1.4
"""Of a motor's factors to a thruster: 1 from the direction of the force and 1 from the signs of its moments at most."""


def mixed_pulses(frame: str, demands: np.ndarray, directions: Sequence[int] = ()) -> np.ndarray:
    """Pulse widths of ArduSub's motors 1, 2, ... for the demands of a pilot in manual mode.

    VECTORED adds a motor's demands and clips them, and limits the forward demand of the rear pair (in the direction of
    travel) to 1 - |throttle|; VECTORED_6DOF divides verticals and horizontals each by their largest sum above 1
    (ArduPilot, AP_Motors6DOF::output_armed_stabilizing_vectored, _vectored_6dof).

    Args:
        frame: VECTORED or VECTORED_6DOF.
        demands: Roll right, pitch up, yaw clockwise, throttle up, forward, lateral right in [-1, 1], (n, 6).
        directions: MOT_n_DIRECTION of each motor; 1 where not given.

    Returns:
        [µs], (n, motors).
    """
    factors = np.array(next(rows for name, rows in FRAMES.values() if name == frame), dtype=float)
    demands = np.clip(demands, -1.0, 1.0)
    output = demands @ factors.T
    if frame == "VECTORED":
        forward = demands[:, 4]
        limit = np.maximum(1.0 - np.abs(demands[:, 3]), 0.0)
        rear = np.sign(factors[:, 4]) * np.sign(forward)[:, None] > 0.0
        output += np.where(rear, (np.clip(forward, -limit, limit) - forward)[:, None] * factors[:, 4], 0.0)
    else:
        for group in (factors[:, 3] == 0.0, factors[:, 3] != 0.0):
            output[:, group] /= np.maximum(np.abs(output[:, group]).max(axis=-1, keepdims=True), 1.0)
    sign = np.ones(len(factors))
    sign[: len(directions)] = directions
    return np.asarray(NEUTRAL + HALF_RANGE * np.clip(sign * output, -1.0, 1.0))


def outputs_of(
    vehicle: Vehicle, parameters: Mapping[str, float], given: Mapping[str, str]
) -> tuple[dict[int, tuple[str, int]], Finding]:
    """Output (from 1) -> thruster, and -1 where its pulses have to be turned about neutral; and what that rests on.

    Turned pulses are as the vehicle file has the thruster wired: longer ones push along its axis, or against it where
    its motor_sign is -1.

    From `given` (`C1: T1`, `C2: -T2`), else from the vehicle's motor_index, else from the frame and the motor
    directions that the autopilot's parameters name, matched with where the vehicle's thrusters sit.

    Raises:
        CalibrationError: Outputs or thrusters that do not exist, or nothing to go by.
    """
    if given:
        found = _given(vehicle, given)
        how = "as the map says"
    elif all(thruster.motor_index is not None for thruster in vehicle.thrusters.values()):
        found = {
            _output_of(int(thruster.motor_index or 0) + 1, parameters): (name, thruster.motor_sign or 1)
            for name, thruster in vehicle.thrusters.items()
        }  # the motor_sign is the vehicle file's, so that no pulse is turned below
        how = "by the motor_index of the vehicle file"
    else:
        found, frame = _by_frame(vehicle, parameters)
        how = f"by the frame {frame} of the log"
    found = {
        output: (name, sign * (vehicle.thrusters[name].motor_sign or 1))
        for output, (name, sign) in found.items()
    }
    pairs = tuple(
        f"C{output} {'-' if sign < 0 else ''}{name}" for output, (name, sign) in sorted(found.items())
    )
    return found, finding("outputs_mapped", how=how, pairs=pairs, neutral=NEUTRAL)


def _given(vehicle: Vehicle, given: Mapping[str, str]) -> dict[int, tuple[str, int]]:
    found = {}
    for output, target in given.items():
        number = output.upper().removeprefix("SERVO").removeprefix("C")
        if not number.isdigit() or int(number) < 1:
            raise CalibrationError(f"ardusub.outputs names '{output}', expected C1, C2, ...")
        name, sign = (target[1:].strip(), -1) if target.startswith("-") else (target, 1)
        if name not in vehicle.thrusters:
            raise CalibrationError(
                f"ardusub.outputs.{output}: {vehicle.name} has no thruster '{name}'"
                f"{did_you_mean(name, list(vehicle.thrusters))} it has {', '.join(vehicle.thrusters)}"
            )
        found[int(number)] = (name, sign)
    return found


def _output_of(motor: int, parameters: Mapping[str, float]) -> int:
    """The output that carries a motor, both from 1."""
    for output in range(1, 33):
        if parameters.get(f"SERVO{output}_FUNCTION") == MOTOR_1 + motor - 1:
            return output
    return motor


def _by_frame(vehicle: Vehicle, parameters: Mapping[str, float]) -> tuple[dict[int, tuple[str, int]], str]:
    from scipy.optimize import linear_sum_assignment

    way_out = "say it in a map: 'ardusub: {outputs: {C1: THRUSTER, C2: -THRUSTER, ...}}'"
    config = parameters.get("FRAME_CONFIG")
    if config is None or int(config) not in FRAMES:
        what = (
            "does not name its frame"
            if config is None
            else f"has FRAME_CONFIG {int(config)}, which is not known here"
        )
        raise CalibrationError(
            f"the log {what}, so nothing tells which output drives which thruster: {way_out}"
        )
    frame, factors = FRAMES[int(config)]
    names = list(vehicle.thrusters)
    if len(factors) != len(names):
        raise CalibrationError(
            f"frame {frame} of the log has {len(factors)} motors, {vehicle.name} has {len(names)} thrusters: {way_out}"
        )
    roll, pitch, yaw, up, forward, right = np.array(factors, dtype=float).T
    # ArduSub's "up" is positive against the z axis of its forward-right-down body.
    motors = FROM_FOSSEN.twist(np.stack([forward, right, -up, roll, pitch, yaw], axis=-1))
    likeness = np.array(
        [[_likeness(motor, column) for column in vehicle.control_matrix.T] for motor in motors]
    )
    chosen = linear_sum_assignment(-np.abs(likeness))
    if np.abs(likeness[chosen]).min() < LEAST_LIKENESS:
        raise CalibrationError(
            f"frame {frame} of the log does not fit the thrusters of {vehicle.name}: {way_out}"
        )
    found = {}
    for motor, thruster in zip(*chosen, strict=True):
        direction = parameters.get(f"MOT_{motor + 1}_DIRECTION")
        if direction not in (1.0, -1.0):
            raise CalibrationError(f"the log does not say MOT_{motor + 1}_DIRECTION: {way_out}")
        sign = int(np.sign(likeness[motor, thruster]) * direction)
        found[_output_of(int(motor) + 1, parameters)] = (names[thruster], sign)
    return found, frame


def _likeness(motor: np.ndarray, column: np.ndarray) -> float:
    """Cosine between the forces, plus the mean agreement of the signs of the moments that the motor is used for."""
    force = motor[:3] @ column[:3] / np.linalg.norm(motor[:3])
    used = motor[3:] != 0.0
    moments = (
        float(np.mean(np.sign(motor[3:][used]) * np.sign(np.round(column[3:][used], 3))))
        if used.any()
        else 0.0
    )
    return float(force + (moments if used.any() else np.sign(force)))
