"""Assignment of ArduSub's outputs to thrusters, with their directions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from finssim.control.ardusub import NEUTRAL, Mixer
from finssim.core.frames import FROM_FOSSEN
from finssim.trials.findings import CalibrationError, Finding, finding
from finssim.trials.trial import Array
from finssim.vehicles import Vehicle
from finssim.vehicles.autopilot import DEMANDS, FRAMES
from finssim.vehicles.part import did_you_mean

__all__ = ["STICKS", "mixed_pulses", "outputs_of", "thrusters_of"]

STICKS = tuple(f"stick_{name}" for name in DEMANDS)
"""Stick columns, in the order of the mixer's factors."""

STICK_CHANNELS = ("pitch", "roll", "throttle", "yaw", "forward", "lateral")
"""Demands of channels 1 to 6 of ArduSub."""

MOTOR_1 = 33
"""SERVOn_FUNCTION of the first motor."""

LEAST_LIKENESS = 1.4
"""Least similarity between a motor's factors and a thruster: at most 1 from the direction of the force and 1
from the signs of its moments."""


def outputs_of(
    vehicle: Vehicle, parameters: Mapping[str, float], requested: Mapping[str, str]
) -> tuple[dict[int, tuple[str, int]], Finding]:
    """Return output (from 1) -> thruster, and -1 where its pulses must be mirrored about neutral; and a
    finding about the source.

    Mirrored pulses agree with the wiring in the vehicle file: longer pulses push along the thruster's axis,
    or against it if its motor_sign is -1.

    The assignment follows `requested` (`C1: T1`, `C2: -T2`), otherwise the vehicle's motor_index, otherwise the frame
    and the motor directions in the autopilot's parameters, matched with the poses of the vehicle's thrusters.

    Parameters have the autopilot's units.

    Raises:
        CalibrationError: Outputs or thrusters do not exist, or there is no information on the assignment.
    """
    if requested:
        outputs = _stated_outputs(vehicle, requested)
        basis = "as the map says"
    elif all(thruster.motor_index is not None for thruster in vehicle.thrusters.values()):
        outputs = {
            _output_of(int(thruster.motor_index or 0) + 1, parameters): (name, thruster.motor_sign or 1)
            for name, thruster in vehicle.thrusters.items()
        }  # the motor_sign is that of the vehicle file, so that no pulse is mirrored below
        basis = "by the motor_index of the vehicle file"
    else:
        outputs, frame = _by_frame(vehicle, parameters)
        basis = f"by the frame {frame}"
    outputs = {
        output: (name, sign * (vehicle.thrusters[name].motor_sign or 1))
        for output, (name, sign) in outputs.items()
    }
    pairs = tuple(
        f"C{output} {'-' if sign < 0 else ''}{name}" for output, (name, sign) in sorted(outputs.items())
    )
    return outputs, finding("outputs_mapped", how=basis, pairs=pairs, neutral=NEUTRAL)


def mixed_pulses(
    vehicle: Vehicle,
    demands: Array,
    parameters: Mapping[str, float],
    directions: Sequence[int],
    requested: Mapping[str, str],
) -> tuple[dict[str, Array], Finding]:
    """Return pwm_NAME of each thruster [µs] from demands, by ArduSub's mixer, and a finding about the assignment.

    Args:
        vehicle: Vehicle with the thrusters.
        demands: Demands in the order of `STICKS` [-1, 1], (n, 6); incomplete rows give NaN.
        parameters: FRAME_CONFIG, one of `FRAMES`, and MOT_n_DIRECTION for `outputs_of`, in the autopilot's units.
        directions: MOT_n_DIRECTION for the mixer; 1 where not given.
        requested: As in `outputs_of`.

    Raises:
        CalibrationError: The motors do not match the thrusters.
    """
    outputs, mapped = outputs_of(vehicle, parameters, requested)
    valid = np.isfinite(demands).all(axis=-1)
    frame, _ = FRAMES[int(parameters["FRAME_CONFIG"])]
    mixed = Mixer.of_frame(frame, directions).pulses(np.where(valid[:, None], demands, 0.0))
    pulses = {
        f"pwm_{thruster}": np.where(
            valid, NEUTRAL + sign * (mixed[:, _motor(output, parameters)] - NEUTRAL), np.nan
        )
        for output, (thruster, sign) in outputs.items()
    }
    return pulses, mapped


def _stated_outputs(vehicle: Vehicle, requested: Mapping[str, str]) -> dict[int, tuple[str, int]]:
    outputs = {}
    for output, target in requested.items():
        number = output.upper().removeprefix("SERVO").removeprefix("C")
        if not number.isdigit() or int(number) < 1:
            raise CalibrationError(f"ardusub.outputs names '{output}', expected C1, C2, ...")
        name, sign = (target[1:].strip(), -1) if target.startswith("-") else (target, 1)
        if name not in vehicle.thrusters:
            raise CalibrationError(
                f"ardusub.outputs.{output}: {vehicle.name} has no thruster '{name}'"
                f"{did_you_mean(name, list(vehicle.thrusters))} it has {', '.join(vehicle.thrusters)}"
            )
        outputs[int(number)] = (name, sign)
    return outputs


def _output_of(motor: int, parameters: Mapping[str, float]) -> int:
    """Return the output of a motor, both from 1."""
    for output in range(1, 33):
        if parameters.get(f"SERVO{output}_FUNCTION") == MOTOR_1 + motor - 1:
            return output
    return motor


def _motor(output: int, parameters: Mapping[str, float]) -> int:
    """Return the motor, from 0, of an output, from 1."""
    return int(parameters.get(f"SERVO{output}_FUNCTION", MOTOR_1 + output - 1)) - MOTOR_1


def _by_frame(vehicle: Vehicle, parameters: Mapping[str, float]) -> tuple[dict[int, tuple[str, int]], str]:
    way_out = "give it in a map: 'ardusub: {outputs: {C1: THRUSTER, C2: -THRUSTER, ...}}'"
    config = parameters.get("FRAME_CONFIG")
    if config is None or int(config) not in FRAMES:
        lack = "does not name its frame"
        if config is not None:
            lack = f"has FRAME_CONFIG {int(config)}, which is not known here"
        raise CalibrationError(
            f"the log {lack}, so it is unknown which output drives which thruster: {way_out}"
        )
    frame, factors = FRAMES[int(config)]
    if len(factors) != len(vehicle.thrusters):
        raise CalibrationError(
            f"frame {frame} of the log has {len(factors)} motors, "
            f"{vehicle.name} has {len(vehicle.thrusters)} thrusters: {way_out}"
        )
    roll, pitch, yaw, up, forward, right = np.array(factors, dtype=float).T
    # ArduSub's "up" is positive against the z axis of its forward-right-down body frame.
    motors = FROM_FOSSEN.twist(np.stack([forward, right, -up, roll, pitch, yaw], axis=-1))
    matched = thrusters_of(vehicle, motors)
    if matched is None:
        raise CalibrationError(
            f"frame {frame} of the log does not fit the thrusters of {vehicle.name}: {way_out}"
        )
    outputs = {}
    for motor, (name, sign) in enumerate(matched, start=1):
        direction = parameters.get(f"MOT_{motor}_DIRECTION")
        if direction not in (1.0, -1.0):
            raise CalibrationError(f"the log does not contain MOT_{motor}_DIRECTION: {way_out}")
        outputs[_output_of(motor, parameters)] = (name, int(sign * direction))
    return outputs, frame


def thrusters_of(vehicle: Vehicle, motors: Array) -> list[tuple[str, int]] | None:
    """Return the thruster of each motor, and -1 if the motor pushes against its axis; None if the motors do
    not match.

    Args:
        vehicle: Vehicle with as many thrusters as motors.
        motors: Direction of the wrench of each motor about the centre of gravity, body frame [-, m], (n, 6).
    """
    from scipy.optimize import linear_sum_assignment

    likeness = np.array(
        [[_likeness(motor, column) for column in vehicle.control_matrix.T] for motor in motors]
    )
    chosen = linear_sum_assignment(-np.abs(likeness))
    if np.abs(likeness[chosen]).min() < LEAST_LIKENESS:
        return None
    signs = np.sign(likeness[chosen]).astype(int)
    return [(vehicle.thruster_names[k], int(sign)) for k, sign in zip(chosen[1], signs, strict=True)]


def _likeness(motor: np.ndarray, column: np.ndarray) -> float:
    """Return the cosine between the forces, plus the mean agreement of the signs of the motor's nonzero moments."""
    force = motor[:3] @ column[:3] / np.linalg.norm(motor[:3])
    used = motor[3:] != 0.0
    if not used.any():
        return float(force + np.sign(force))
    return float(force + np.mean(np.sign(motor[3:][used]) * np.sign(np.round(column[3:][used], 3))))
