"""nu_dot on a grid: from an accelerometer, or as the slope of the smoothed velocity."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from finssim.calibration.findings import Finding, finding
from finssim.calibration.motion.attitude_signal import AttitudeSignal, up_in_body
from finssim.calibration.motion.smoothing import longest_step, smooth
from finssim.calibration.trials.trial import NU, Trial
from finssim.geometry.rotations import quat_inverse_rotate, quat_rotate
from finssim.vehicles import Vehicle

__all__ = ["accelerations", "accelerometer_place", "holds_gravity", "slopes"]

Array = NDArray[np.float64]

# Velocity and position of the body origin on a grid, measured or derived from what is.

STEEPEST = 0.3
"""Cosine of the tilt below which a vertical velocity tells nothing of heave."""


@dataclass(frozen=True, kw_only=True)
class Velocities:
    """Velocity and position of the body origin, (m, ...) on the grid."""

    nu: Array
    """(m, 6)"""
    raw: Array
    """(m, 6)"""
    source: tuple[str, ...]
    noise_std: Array
    """(6,)"""
    slope_std: Array
    """Standard deviation of the slope of `nu` [m/s², rad/s²], (6,)."""
    position: Array
    """World frame [m], (m, 3)."""
    findings: tuple[Finding, ...]


@dataclass
class _Column:
    """One column on the grid; all NaN if the trial does not have it."""

    value: Array
    slope: Array
    raw: Array
    noise: float = np.nan
    slope_std: float = np.nan
    bend_std: float = np.nan


def velocities(
    trial: Trial, vehicle: Vehicle, at: Array, attitude: AttitudeSignal, max_gap: float | None = None
) -> Velocities:
    """Velocity and position of the body origin.

    Args:
        trial: The trial.
        vehicle: Gives the place of the pressure sensor where the header does not.
        at: Times [s], (m,).
        attitude: At these times.
        max_gap: As for `smooth`.
    """
    header, findings = trial.header, list[Finding]()
    measured = [_column(trial, name, at, 2, max_gap) for name in NU]
    nu = np.stack([c.value for c in measured], axis=-1)
    raw = np.stack([c.raw for c in measured], axis=-1)
    noise, slope_std = np.array([(c.noise, c.slope_std) for c in measured]).T
    source = ["measured" if trial.has(name) else "" for name in NU]
    for i in range(3, 6):
        if not source[i] and np.isfinite(attitude.rates[:, i - 3]).any():
            nu[:, i], noise[i] = attitude.rates[:, i - 3], attitude.rates_std[i - 3]
            slope_std[i] = attitude.rates_slope_std[i - 3]
            source[i] = "derived from attitude"
    omega = nu[:, 3:]
    arm = np.asarray(header.velocity_at, float)
    if arm.any():
        if _lacks(omega, arm) and any(source[:3]):
            findings.append(finding("rates_unknown"))
        nu[:, :3] -= arm_velocity(omega, arm)
        raw[:, :3] -= arm_velocity(omega, arm)
    if header.velocity == "water" and header.water.current is not None:
        drift = quat_inverse_rotate(attitude.turn, np.asarray(header.water.current, float))
        nu[:, :3] += drift
        raw[:, :3] += drift
    position, flow, stds = _origin(trial, vehicle, at, attitude, omega, max_gap)
    for i, (column, name) in enumerate(_derived(nu, source, flow, attitude, trial, findings)):
        if name:
            nu[:, i], source[i] = column, name
            noise[i], slope_std[i] = stds[2] if i == 2 else stds[:2].mean(axis=0)
    return Velocities(
        nu=nu,
        raw=raw,
        source=tuple(source),
        noise_std=noise,
        slope_std=slope_std,
        position=position,
        findings=tuple(findings),
    )


def arm_velocity(omega: Array, arm: Array) -> Array:
    """omega × r, with unknown rates taken as 0, body frame [m/s], (m, 3).

    Args:
        omega: Angular velocity, body frame [rad/s], (m, 3).
        arm: r from the body origin, body frame [m], (3,).
    """
    return np.cross(np.nan_to_num(omega), arm)


def _lacks(omega: Array, arm: Array) -> bool:
    """Whether a rate that would move a point at `arm` is unknown throughout."""
    unknown = ~np.asarray(np.isfinite(omega).any(axis=0))
    return any(unknown[i] and np.delete(arm, i).any() for i in range(3))


def _column(trial: Trial, name: str, at: Array, order: int, max_gap: float | None) -> _Column:
    t, y = trial.series(name)
    nothing = np.full(len(at), np.nan)
    if len(t) < 2:
        return _Column(nothing, nothing, nothing)
    s = smooth(t, y[:, None], at, order=order, max_gap=max_gap)
    i = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    gap = longest_step(t) if max_gap is None else max_gap
    bridged = (at >= t[0] - 1e-6) & (at <= t[-1] + 1e-6) & (t[i + 1] - t[i] <= gap)
    raw = np.where(bridged, np.interp(at, t, y), np.nan)
    return _Column(
        s.value[:, 0], s.slope[:, 0], raw, *(float(std[0]) for std in (s.noise, s.slope_std, s.bend_std))
    )


def _origin(
    trial: Trial,
    vehicle: Vehicle,
    at: Array,
    attitude: AttitudeSignal,
    omega: Array,
    max_gap: float | None,
) -> tuple[Array, Array, Array]:
    """Position and velocity of the body origin in the world, (m, 3) each, and the standard deviations of the latter and
    of its slope by axis, (3, 2)."""
    header = trial.header
    x, y, z = (_column(trial, name, at, 3, max_gap) for name in "xyz")
    arms = [np.asarray(header.position_at, float)] * 3
    if not trial.has("z") and trial.has("depth"):
        depth = _column(trial, "depth", at, 3, max_gap)
        z = replace(depth, value=-depth.value, slope=-depth.slope)
        arms[2] = _depth_at(trial, vehicle)
    known = np.asarray(np.isfinite(attitude.turn).all(axis=1))
    turn = np.where(known[:, None], attitude.turn, [0.0, 0.0, 0.0, 1.0])
    value = np.stack([x.value, y.value, z.value], axis=-1)
    slope = np.stack([x.slope, y.slope, z.slope], axis=-1)
    for i, arm in enumerate(arms):
        if arm.any():
            value[:, i] -= quat_rotate(turn, arm)[:, i]
            slope[:, i] -= quat_rotate(turn, arm_velocity(omega, arm))[:, i]
            if attitude.tilt or attitude.heading:
                value[~known, i] = slope[~known, i] = np.nan
    return value, slope, np.array([(c.slope_std, c.bend_std) for c in (x, y, z)])


def _depth_at(trial: Trial, vehicle: Vehicle) -> Array:
    if trial.header.depth_at is not None:
        return np.asarray(trial.header.depth_at, float)
    return np.zeros(3) if vehicle.sensors.depth is None else np.asarray(vehicle.sensors.depth.position, float)


def _derived(
    nu: Array, source: list[str], flow: Array, attitude: AttitudeSignal, trial: Trial, findings: list[Finding]
) -> list[tuple[Array, str]]:
    """u, v, w from the world velocity of the origin, and the names of their sources; no name where it tells nothing."""
    known = np.asarray(np.isfinite(attitude.turn).all(axis=1))
    turn = np.where(known[:, None], attitude.turn, [0.0, 0.0, 0.0, 1.0])
    horizontal = trial.has("x", "y") and attitude.heading
    vertical = bool(np.isfinite(flow[:, 2]).any())
    wanted = [not source[i] and (vertical if i == 2 else horizontal) for i in range(3)]
    if any(wanted) and not attitude.tilt:
        findings.append(finding("taken_level"))
    if horizontal:
        world = flow if vertical else np.concatenate([flow[:, :2], np.zeros((len(flow), 1))], axis=1)
        body = quat_inverse_rotate(turn, world)
        body[~known] = np.nan
    else:
        # Vertical velocity alone: z_dot = up · v, solved for heave with surge and sway as far as they are known.
        up = quat_inverse_rotate(turn, np.array([0.0, 0.0, 1.0]))
        if attitude.tilt:
            up[~known] = np.nan
        rest = np.sum(up[:, :2] * np.nan_to_num(nu[:, :2]), axis=1)
        heave = np.where(up[:, 2] > STEEPEST, (flow[:, 2] - rest) / up[:, 2], np.nan)
        body = np.stack([heave * np.nan, heave * np.nan, heave], axis=-1)
    names = ["derived from position"] * 2 + [f"derived from {'position' if trial.has('z') else 'depth'}"]
    return [(column, name if use else "") for column, name, use in zip(body.T, names, wanted, strict=True)]


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
