"""nu_dot on a grid: from an accelerometer, or as the slope of the smoothed velocity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from finssim.calibration.findings import Finding, finding
from finssim.calibration.motion.attitude_signal import AttitudeSignal, up_in_body
from finssim.calibration.motion.smoothing import smooth
from finssim.calibration.motion.velocities import Velocities
from finssim.calibration.trials.trial import Trial
from finssim.vehicles import Vehicle

__all__ = ["accelerations", "accelerometer_place", "holds_gravity", "slopes"]

Array = NDArray[np.float64]

ACCELERATION = ("ax", "ay", "az")

NOTHING = 1e-3
"""Errors below this are no reason to prefer one source to another [m/s²]."""


def accelerations(
    trial: Trial,
    vehicle: Vehicle,
    at: Array,
    attitude: AttitudeSignal,
    found: Velocities,
    max_gap: float | None = None,
) -> tuple[Array, tuple[str, ...], tuple[Finding, ...]]:
    """Rates of the components of nu.

    An accelerometer at body point P reads f = a_P - g in body axes, and

        a_P = v_dot + ω × v + ω_dot × r + ω × (ω × r),   so   v_dot = f + g - ω × v - ω_dot × r - ω × (ω × r).

    Its bias, and what a wrong attitude leaves of gravity, would be a force: the median difference from the slope of the
    smoothed velocity is taken off. ω_dot is the slope of the smoothed rates. An accelerometer that is sampled much more
    slowly than the velocity, or tells less than its slope by the errors that smoothing estimates of both, is not used.

    Returns:
        nu_dot (m, 6), its source by axis, and findings.
    """
    nu_dot = slopes(at, found.nu)
    source = ["smoothed velocity" if np.isfinite(column).any() else "" for column in nu_dot.T]
    given = [name for name in ACCELERATION if trial.has(name)]
    if not given:
        return nu_dot, tuple(source), ()
    f, std = np.full((len(at), 3), np.nan), np.full(3, np.nan)
    for i, name in enumerate(ACCELERATION):
        t, y = trial.series(name)
        if len(t) >= 2:
            s = smooth(t, y[:, None], at, order=2, max_gap=max_gap)
            f[:, i], std[i] = s.value[:, 0], s.value_std[0]
    slow = _slow(trial)
    gravity = vehicle.water.gravity
    if holds_gravity(trial, gravity):
        if not attitude.tilt:
            return nu_dot, tuple(source), (finding("accelerations_unused"),)
        f = f - gravity * up_in_body(attitude.quaternion)
    r = accelerometer_place(trial, vehicle)
    nu = np.nan_to_num(found.nu)
    v, omega, omega_dot = nu[:, :3], nu[:, 3:], np.nan_to_num(nu_dot[:, 3:])
    a = f - np.cross(omega, v) - np.cross(omega_dot, r) - np.cross(omega, np.cross(omega, r))
    for i in range(3):
        both = np.isfinite(a[:, i]) & np.isfinite(nu_dot[:, i])
        if both.any() and std[i] <= found.slope_std[i] + NOTHING and not slow[i]:
            nu_dot[:, i] = a[:, i] - np.median(a[both, i] - nu_dot[both, i])
            nu_dot[~np.isfinite(found.nu[:, i]), i] = np.nan
            source[i] = "imu"
    return nu_dot, tuple(source), ()


def _slow(trial: Trial) -> list[bool]:
    """Whether ax, ay, az are sampled at less than half the rate of what the velocity comes from."""

    def step(names: tuple[str, ...]) -> float:
        return min(float(np.median(np.diff(trial.series(n)[0]))) if trial.has(n) else np.inf for n in names)

    from_velocity = [step((name,)) for name in ("u", "v", "w")]
    usual = step(("x", "y", "z", "depth"))
    return [
        step((name,)) > 2.0 * (usual if np.isinf(own) else own)
        for name, own in zip(ACCELERATION, from_velocity, strict=True)
    ]


def accelerometer_place(trial: Trial, vehicle: Vehicle) -> Array:
    """Body point of the accelerometer [m], (3,): the header's, the vehicle's IMU, or the origin."""
    if trial.header.acceleration_at is not None:
        return np.asarray(trial.header.acceleration_at, float)
    imu = vehicle.sensors.imu
    return np.zeros(3) if imu is None else np.asarray(imu.position, float)


def holds_gravity(trial: Trial, gravity: float) -> bool:
    """Whether the accelerations are specific force, from the header or from their size.

    Vehicles under water accelerate far less than gravity: what is about as large as gravity holds it. With only ax or
    ay there is nothing to tell it by, and an accelerometer is assumed.

    Args:
        trial: Its header and its columns ax, ay, az.
        gravity: [m/s²]
    """
    if trial.header.acceleration != "auto":
        return trial.header.acceleration == "specific_force"
    given = [name for name in ACCELERATION if trial.has(name)]
    if "az" not in given:
        return True
    squares = [np.median(np.square(trial.series(name)[1])) for name in given]
    return float(np.sqrt(np.sum(squares))) > 0.5 * gravity


def slopes(t: Array, x: Array) -> Array:
    """Time derivative of smooth columns, by cubic splines through every stretch without NaN, (m, c)."""
    out = np.full(x.shape, np.nan)
    for i, column in enumerate(x.T):
        known = np.isfinite(column)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(np.int8)))
        for a, b in edges.reshape(-1, 2):
            if b - a >= 4:
                out[a:b, i] = CubicSpline(t[a:b], column[a:b])(t[a:b], 1)
    return out
