"""Thrust as a function of rotor speed, as in uuv_simulator and Stonefish, and thrusters with such curves."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.vehicles.importers.draft import GRAVITY, SHARE, Draft
from finssim.vehicles.part import VehicleError

__all__ = [
    "ThrustCurve",
    "dead_zone",
    "interpolated",
    "mirrored",
    "put_curve",
    "quadratic",
    "scaled",
    "steady_speed",
]


class ThrustCurve(NamedTuple):
    """Thrust of a thruster as a function of its rotor speed, and the inverse."""

    thrust: Callable[[float], float]
    """Function of the speed [rad/s] that returns the thrust [N]."""
    speed: Callable[[float], float]
    """Function of the thrust [N] that returns the least speed that produces it [rad/s]."""
    ends: tuple[float, float] = (-math.inf, math.inf)
    """Least and greatest thrust [N]."""


def dead_zone(left: float, right: float, low: float, high: float, where: str) -> ThrustCurve:
    """Return thrust = right (w|w| - high) above high, left (w|w| - low) below low, and 0 between.

    Args:
        left: Factor of reverse thrust [N s²/rad²].
        right: Factor of forward thrust [N s²/rad²].
        low: Edge of the dead zone in reverse, 0 or less [rad²/s²].
        high: Edge of the dead zone forward, 0 or more [rad²/s²].
        where: Name of the curve in messages.
    """
    if min(left, right) <= 0.0 or low > 0.0 or high < 0.0:
        raise VehicleError(
            f"{where}: expected factors above 0 and a dead zone around 0, found {left:g}, {right:g}, {low:g}, {high:g}"
        )

    def speed(force: float) -> float:
        square = force / right + high if force > 0.0 else force / left + low
        return math.copysign(math.sqrt(abs(square)), force)

    return ThrustCurve(
        lambda w: right * max(w * abs(w) - high, 0.0) + left * min(w * abs(w) - low, 0.0), speed
    )


def quadratic(forward: float, reverse: float, where: str) -> ThrustCurve:
    """Return the curve thrust = forward w² or -reverse w² [N s²/rad²]; `where` is its name in messages."""
    return dead_zone(reverse, forward, 0.0, 0.0, where)


def interpolated(inputs: NDArray[np.float64], outputs: NDArray[np.float64], where: str) -> ThrustCurve:
    """Return the curve that interpolates between points.

    Args:
        inputs: Speeds [rad/s], (n,).
        outputs: Thrusts [N], (n,).
        where: Name of the curve in messages.
    """
    order = np.argsort(inputs)
    inputs, outputs = inputs[order], outputs[order]
    rises = len(inputs) > 1 and np.all(np.diff(outputs) >= 0.0)
    if not (rises and inputs[0] < 0.0 < inputs[-1] and outputs[0] < 0.0 < outputs[-1]):
        raise VehicleError(f"{where}: expected inputs and outputs that rise together from below 0 to above 0")
    rising = np.r_[True, np.diff(outputs) > 0.0]
    return ThrustCurve(
        lambda w: float(np.interp(w, inputs, outputs)),
        lambda f: float(np.interp(f, outputs[rising], inputs[rising])),
        (float(outputs[0]), float(outputs[-1])),
    )


def scaled(curve: ThrustCurve, push: float, turn: float) -> ThrustCurve:
    """Return the curve thrust = push f(turn w) of a curve f; both factors are fractions [-]."""
    low, high = curve.ends
    return ThrustCurve(
        lambda w: push * curve.thrust(turn * w),
        lambda f: curve.speed(f / push) / turn,
        (push * low, push * high),
    )


def mirrored(curve: ThrustCurve) -> ThrustCurve:
    """Return the curve thrust = -f(-w) of a curve f: that of a propeller with the opposite direction of rotation."""
    low, high = curve.ends
    return ThrustCurve(lambda w: -curve.thrust(-w), lambda f: -curve.speed(-f), (-high, -low))


def steady_speed(gain: float, linear: float, square: float, where: str) -> Callable[[float], float]:
    """Return the speed [rad/s] at which gain u = linear w + square w|w|, as a function of u.

    Args:
        gain: Gain of the input, in the unit of the other terms per unit of u.
        linear: Loss proportional to the speed [unit of gain u per rad/s].
        square: Loss proportional to its square [unit of gain u per rad²/s²].
        where: Name of the rotor in messages.
    """
    if square <= 0.0 or linear < 0.0:
        raise VehicleError(f"{where}: its losses are {linear:g} and {square:g}, expected more than 0")

    def steady(u: float) -> float:
        root = math.sqrt(linear**2 + 4.0 * square * abs(gain * u))
        return math.copysign((root - linear) / (2.0 * square), gain * u)

    return steady


def put_curve(draft: Draft, name: str, curve: ThrustCurve, low: float, high: float, limits: str) -> None:
    """Set limits, dead zone and thrust of a thruster: the parabola through the limit.

    Args:
        draft: Draft with the mass, to which the values are written.
        name: Name of the thruster.
        curve: Thrust curve.
        low: Least thrust [N]; -inf if the file sets no limit.
        high: Greatest thrust [N]; inf if the file sets no limit.
        limits: Source of the limits.
    """
    path = f"thrusters.{name}"
    low, high = max(low, curve.ends[0]), min(high, curve.ends[1])
    if low >= 0.0 or high <= 0.0:
        raise VehicleError(
            f"{draft.label}: thruster {name}: its thrust is {low:g} to {high:g} N, expected one that reverses: change "
            "its limits"
        )
    usual = SHARE * draft.values["body"]["mass"] * GRAVITY
    for side, sign, end in (("minus", -1.0, low), ("plus", 1.0, high)):
        force = end if math.isfinite(end) else sign * usual
        speed, key = curve.speed(force), "min" if sign < 0.0 else "max"
        for word, value in ((f"force_{key}", force), (f"rpm_{key}", speed * 30.0 / math.pi)):
            if math.isfinite(end):
                draft.put(f"{path}.{word}", value, "derived", limits)
            else:
                draft.guess(
                    f"{path}.{word}", value, f"no limit in the file: {SHARE:g} of the vehicle's weight"
                )
        draft.put(f"{path}.c_{side}", abs(force) / speed**2, "derived", "parabola through the limit")
        dead = curve.speed(sign * 1e-9)
        if abs(dead) > 1e-3 * abs(speed):
            draft.put(f"{path}.dead_rpm_{side}", dead * 30.0 / math.pi, "derived", "dead zone")
        off = max(abs(curve.thrust(speed * x) / force - x**2) for x in np.linspace(0.1, 1.0, 10))
        sentence = (
            f"thrust is a parabola through {force:.4g} N here, and up to {100.0 * off:.2g} % of that away from it in "
            "the file; commands in newtons are not affected"
        )
        if off > 1e-6 and sentence not in draft.different:
            draft.different.append(sentence)
    draft.values["thrusters"][name] |= {"domain": "speed", "group": "propeller"}
