"""Motion of a trial on a uniform grid: velocities, attitude and applied wrench about the body origin.

Measured quantities are smoothed (`smooth`) and transferred to the body origin; others are derived if the remaining
columns determine them, and NaN otherwise. Nothing is interpolated across a gap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dst
from scipy.linalg import solveh_banded

from finssim.core.rotations import (
    quat_conjugate,
    quat_from_euler,
    quat_inverse_rotate,
    quat_multiply,
    quat_rotate,
)
from finssim.physics.terms.composed import actuator_wrenches
from finssim.trials.conversion import EULER, QUATERNION
from finssim.trials.findings import Finding, finding
from finssim.trials.inputs import InputForces, acting, applied_wrench, drive
from finssim.trials.trial import COLUMNS, NU, Trial
from finssim.vehicles import Vehicle

__all__ = [
    "attitude_samples", "attitude_signal", "AttitudeSignal", "gyroscope_bias", "holds_gravity", "motion", "Motion",
    "offset", "Offset", "on_grid", "phase_at", "up_in_body",
]  # fmt: skip

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class AttitudeSignal:
    """Attitude on a grid of m times, as far as it is known."""

    quaternion: Array
    """Body to world, (m, 4); NaN where unknown, and everywhere if the tilt is not measured."""
    rates: Array
    """omega from the derivative of the attitude, body frame [rad/s], (m, 3); NaN where unknown."""
    rates_std: Array
    """Standard deviation of `rates` [rad/s], (3,)."""
    turn: Array
    """Rotation for vectors: `quaternion`, or level with the measured heading, (m, 4); NaN where unknown."""
    heading: bool
    """True if the heading is measured; otherwise `quaternion` has heading 0 and only its tilt is meaningful."""
    tilt: bool
    """True if roll and pitch are measured."""


def attitude_samples(trial: Trial) -> tuple[Array, Array, tuple[str, ...]]:
    """Return the attitude as sampled.

    Returns:
        Times (n,) [s], quaternions (n, 4) with 0 for unmeasured angles, and the names of the measured ones of
        roll, pitch, yaw.
    """
    if trial.has(*QUATERNION):
        q = np.stack([trial.channels[name] for name in QUATERNION], axis=-1)
        good = np.isfinite(q).all(axis=1)
        return trial.t[good], q[good], EULER
    given = tuple(name for name in EULER if trial.has(name))
    if "roll" in given and "pitch" not in given or "pitch" in given and "roll" not in given:
        # Roll or pitch alone does not determine the tilt.
        given = tuple(name for name in given if name == "yaw")
    if not given:
        return np.empty(0), np.empty((0, 4)), ()
    t = max((trial.series(name)[0] for name in given), key=len)
    t = t[
        (t >= max(trial.series(n)[0][0] for n in given)) & (t <= min(trial.series(n)[0][-1] for n in given))
    ]
    angles = {name: np.interp(t, trial.series(name)[0], np.unwrap(trial.series(name)[1])) for name in given}
    zero = np.zeros(len(t))
    q = quat_from_euler(*(angles.get(name, zero) for name in EULER))
    flips = np.cumsum(np.sum(q[1:] * q[:-1], axis=-1) < 0.0) % 2 == 1
    q[1:][flips] *= -1.0
    return t, q, given


def attitude_signal(trial: Trial, at: Array) -> AttitudeSignal:
    """Return the smoothed attitude of a trial at given times (m,)."""
    t, q, given = attitude_samples(trial)
    nothing = np.full((len(at), 4), np.nan)
    if len(t) < 2:
        return AttitudeSignal(
            quaternion=nothing,
            rates=nothing[:, :3],
            rates_std=np.full(3, np.nan),
            turn=nothing,
            heading=False,
            tilt=False,
        )
    s = smooth(t, q, at, order=3, together=True)
    length = np.linalg.norm(s.value, axis=1, keepdims=True)
    quaternion = s.value / length
    # q_dot = q omega / 2, with omega in body axes; the norm of q does not affect the vector part.
    rates = 2.0 * quat_multiply(quat_conjugate(quaternion), s.slope / length)[:, :3]
    tilt, heading = "roll" in given, "yaw" in given
    measured = np.array([tilt, tilt, heading])
    rates[:, ~measured] = np.nan
    return AttitudeSignal(
        quaternion=quaternion if tilt else nothing,
        rates=rates,
        rates_std=np.where(measured, 2.0 * np.mean(s.slope_std), np.nan),
        turn=quaternion,
        heading=heading,
        tilt=tilt,
    )


def up_in_body(quaternion: Array) -> Array:
    """Return the unit vector of world z in the body frame, (m, 4) -> (m, 3)."""
    return quat_rotate(quat_conjugate(quaternion), np.array([0.0, 0.0, 1.0]))


# Velocity and position of the body origin on a grid, measured or derived.

STEEPEST = 0.3
"""Cosine of the tilt below which a vertical velocity does not determine heave."""


@dataclass
class _Column:
    """Column on the grid; all NaN if the trial lacks it."""

    value: Array
    slope: Array
    raw: Array
    noise: float = np.nan
    slope_std: float = np.nan


def velocities(trial: Trial, vehicle: Vehicle, at: Array, attitude: AttitudeSignal) -> dict[str, Any]:
    """Return velocity and position of the body origin: the fields of `Motion` that follow from the measured columns.

    Args:
        trial: The trial.
        vehicle: Vehicle with the position of the pressure sensor, if the header lacks it.
        at: Times [s], (m,).
        attitude: Attitude at these times.
    """
    header, findings = trial.header, list[Finding]()
    measured = [_column(trial, name, at, 2) for name in NU]
    nu = np.stack([c.value for c in measured], axis=-1)
    raw = np.stack([c.raw for c in measured], axis=-1)
    noise = np.array([c.noise for c in measured])
    source = ["measured" if trial.has(name) else "" for name in NU]
    for i in range(3, 6):
        if not source[i] and np.isfinite(attitude.rates[:, i - 3]).any():
            nu[:, i], noise[i] = attitude.rates[:, i - 3], attitude.rates_std[i - 3]
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
    position, flow, stds = _origin(trial, vehicle, at, attitude, omega)
    for i, (column, name) in enumerate(_derived(nu, source, flow, attitude, trial, findings)):
        if name:
            nu[:, i], source[i] = column, name
            noise[i] = stds[2] if i == 2 else stds[:2].mean()
    return {
        "nu": nu,
        "raw": raw,
        "nu_source": tuple(source),
        "noise_std": noise,
        "position": position,
        "findings": tuple(findings),
    }


def arm_velocity(omega: Array, arm: Array) -> Array:
    """Return omega × r, with unknown rates set to 0, body frame [m/s], (m, 3).

    Args:
        omega: Angular velocity, body frame [rad/s], (m, 3).
        arm: r from the body origin, body frame [m], (3,).
    """
    return np.cross(np.nan_to_num(omega), arm)


def _lacks(omega: Array, arm: Array) -> bool:
    """Return whether a rate that affects the velocity of a point at `arm` is unknown throughout."""
    unknown = ~np.asarray(np.isfinite(omega).any(axis=0))
    return any(unknown[i] and np.delete(arm, i).any() for i in range(3))


def _column(trial: Trial, name: str, at: Array, order: int) -> _Column:
    t, y = trial.series(name)
    nothing = np.full(len(at), np.nan)
    if len(t) < 2:
        return _Column(nothing, nothing, nothing)
    s = smooth(t, y[:, None], at, order=order)
    i = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    gap = longest_step(t)
    bridged = (at >= t[0] - 1e-6) & (at <= t[-1] + 1e-6) & (t[i + 1] - t[i] <= gap)
    raw = np.where(bridged, np.interp(at, t, y), np.nan)
    return _Column(s.value[:, 0], s.slope[:, 0], raw, float(s.noise[0]), float(s.slope_std[0]))


def _origin(
    trial: Trial, vehicle: Vehicle, at: Array, attitude: AttitudeSignal, omega: Array
) -> tuple[Array, Array, Array]:
    """Return position and velocity of the body origin in the world, (m, 3) each, and the standard deviations
    of the velocity and of its slope by axis, (3, 2)."""
    header = trial.header
    x, y, z = (_column(trial, name, at, 3) for name in "xyz")
    arms = [np.asarray(header.position_at, float)] * 3
    if not trial.has("z") and trial.has("depth"):
        depth = _column(trial, "depth", at, 3)
        z = replace(depth, value=-depth.value, slope=-depth.slope)
        arms[2] = depth_place(trial, vehicle)
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
    return value, slope, np.array([c.slope_std for c in (x, y, z)])


def depth_place(trial: Trial, vehicle: Vehicle) -> Array:
    """Return the body point of the pressure sensor [m], (3,): from the header, the vehicle, or the origin."""
    if trial.header.depth_at is not None:
        return np.asarray(trial.header.depth_at, float)
    return np.zeros(3) if vehicle.sensors.depth is None else np.asarray(vehicle.sensors.depth.position, float)


def _derived(
    nu: Array, source: list[str], flow: Array, attitude: AttitudeSignal, trial: Trial, findings: list[Finding]
) -> list[tuple[Array, str]]:
    """Return u, v, w from the world velocity of the origin, and the names of their sources; an empty name if
    a velocity is not determined."""
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
        # Vertical velocity alone: z_dot = up · v, solved for heave with surge and sway where they are known.
        up = quat_inverse_rotate(turn, np.array([0.0, 0.0, 1.0]))
        if attitude.tilt:
            up[~known] = np.nan
        rest = np.sum(up[:, :2] * np.nan_to_num(nu[:, :2]), axis=1)
        heave = np.where(up[:, 2] > STEEPEST, (flow[:, 2] - rest) / up[:, 2], np.nan)
        body = np.stack([heave * np.nan, heave * np.nan, heave], axis=-1)
    names = ["derived from position"] * 2 + [f"derived from {'position' if trial.has('z') else 'depth'}"]
    return [(column, name if use else "") for column, name, use in zip(body.T, names, wanted, strict=True)]


ACCELERATION = ("ax", "ay", "az")


def holds_gravity(trial: Trial, gravity: float) -> bool:
    """Return whether the accelerations are specific force, from the header or from their magnitude.

    Submerged vehicles accelerate far less than gravity: values of about its magnitude include it. If only ax
    or ay exists, they are assumed to come from an accelerometer.

    Args:
        trial: Trial with its header and its columns ax, ay, az.
        gravity: Gravity [m/s²].
    """
    if trial.header.acceleration != "auto":
        return trial.header.acceleration == "specific_force"
    given = [name for name in ACCELERATION if trial.has(name)]
    if "az" not in given:
        return True
    squares = [np.median(np.square(trial.series(name)[1])) for name in given]
    return float(np.sqrt(np.sum(squares))) > 0.5 * gravity


FASTEST = 100.0
"""Largest default rate of the grid [Hz]; motions in water do not need more."""

MOST = 0.5
"""Fraction of a trial for which an axis must be known to decide which rows are valid."""


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Trial on a uniform grid of n times. Body frame, about the body origin, unless stated otherwise."""

    t: Array
    """Times on the trial's clock [s], (n,)."""
    rate: float
    """Rate of the grid [Hz]."""
    nu: Array
    """Smoothed velocities u, v, w, p, q, r [m/s, rad/s], (n, 6); NaN where unknown. Relative to the ground,
    or to the water if the header states so and gives no current."""
    raw: Array
    """Unsmoothed velocities of measured axes, interpolated linearly [m/s, rad/s], (n, 6); NaN if not measured."""
    quaternion: Array
    """Rotation from body to world, (n, 4); NaN without roll and pitch. The heading is 0 if it was not measured."""
    position: Array
    """Position in the world frame [m], (n, 3); NaN where unknown."""
    tau: Array
    """Applied wrench [N, N m], (n, 6), with commands passed through the motors of the vehicle file. NaN where
    unknown."""
    phase: NDArray[np.str_]
    """Phase of each row, (n,); empty if the trial names none."""
    valid: NDArray[np.bool_]
    """True if the wrench and all axes that are known for most of the trial are known, (n,)."""
    nu_source: tuple[str, ...]
    """Source of each axis: `measured`, `derived from position`, `derived from depth`, `derived from
    attitude`, or empty."""
    noise_std: Array
    """Standard deviation by axis of one sample of a measured velocity, or of a derived velocity [m/s, rad/s],
    (6,)."""
    findings: tuple[Finding, ...] = ()
    """Assumptions made."""


def motion(trial: Trial, vehicle: Vehicle) -> Motion:
    """Return a trial on a uniform grid, at the rate of its fastest stream up to 100 Hz.

    Intervals between samples of a stream are bridged up to 0.2 s or four median intervals.

    Args:
        trial: The trial.
        vehicle: Vehicle with the sensor positions that the header lacks, the motors and gravity.

    Raises:
        CalibrationError: The inputs are missing or do not belong to this vehicle.
    """
    inputs = drive(trial, vehicle)
    rate = grid_rate(trial, inputs)
    t = trial.t[0] + np.arange(int(np.floor(trial.duration * rate + 1e-6)) + 1) / rate
    attitude = attitude_signal(trial, t)
    found = velocities(trial, vehicle, t, attitude)
    found["findings"] = (*inputs.findings, *found["findings"])
    tau = applied_wrench(inputs, vehicle, t)
    if inputs.thrusters and vehicle.actuators:
        nu, up = np.nan_to_num(found["nu"]), np.nan_to_num(up_in_body(attitude.quaternion))
        tau = tau + actuator_wrenches(vehicle, nu, up, 10.0, acting(inputs, vehicle, t))
    return Motion(
        t=t,
        rate=rate,
        quaternion=attitude.quaternion,
        tau=tau,
        phase=phase_at(trial, t),
        valid=_valid(tau, found["nu"]),
        **found,
    )


BLOCK, BLOCKS, CLEAR = 1.0, 10, 3.0
"""Length of the segments over which a rate is compared with that of the attitude [s], least number of
segments, and significance of their mean difference in standard errors."""


def gyroscope_bias(motion: Motion) -> Array:
    """Return the mean difference between the angular velocity and that of the measured attitude [rad/s], (3,).

    It is 0 if too little of the attitude is known, or if noise explains the difference.
    """
    q, rates = motion.quaternion, motion.nu[:, 3:]
    turn = quat_multiply(quat_conjugate(q[:-1]), q[1:])
    measured = 2.0 * motion.rate * np.sign(turn[:, 3:]) * turn[:, :3]
    gap = 0.5 * (rates[:-1] + rates[1:]) - measured
    n = max(1, round(BLOCK * motion.rate))
    means = gap[: len(gap) // n * n].reshape(-1, n, 3).mean(axis=1)
    bias = np.zeros(3)
    for k in range(3):
        known = means[np.isfinite(means[:, k]), k]
        if len(known) >= BLOCKS:
            error = float(known.std(ddof=1)) / np.sqrt(len(known))
            bias[k] = known.mean() if abs(known.mean()) > CLEAR * error else 0.0
    return bias


def grid_rate(trial: Trial, inputs: InputForces) -> float:
    """Return the rate of the fastest stream of inputs or motion, up to `FASTEST` [Hz]."""
    steps = [float(np.median(np.diff(inputs.t)))] if inputs.source != "passive" else []
    for column in trial.channels:
        if column in COLUMNS and COLUMNS[column].group != "command" and trial.has(column):
            steps.append(float(np.median(np.diff(trial.series(column)[0]))))
    rate = 1.0 / min(steps) if steps else 1.0 / float(np.median(np.diff(trial.t)))
    whole = round(rate)
    return float(min(FASTEST, whole if whole >= 5 and abs(rate / whole - 1.0) < 0.01 else rate))


def phase_at(trial: Trial, t: Array) -> NDArray[np.str_]:
    """Return the phase in the log at given times on the trial's clock [s], (n,); empty words if the log has
    no phases."""
    if trial.phase is None:
        return np.full(len(t), "", dtype="<U10")
    return trial.phase[np.maximum(np.searchsorted(trial.t, t + 1e-9, side="right") - 1, 0)]


def _valid(tau: Array, nu: Array) -> NDArray[np.bool_]:
    known = np.isfinite(nu)
    counted = known.mean(axis=0) >= MOST if known.any() else np.zeros(len(NU), bool)
    return np.asarray(np.isfinite(tau).all(axis=1) & known.any(axis=1) & known[:, counted].all(axis=1))


# Constant time offset between two signals of the same motion.


RATE = 100.0
"""Rate of the grid on which streams are compared [Hz]; the peak is interpolated between its points."""

LONGEST = 1.0
"""Largest offset that is searched [s]."""

NEAR = 0.15
"""Distance from the offset with the most common motion within which the peak is refined [s]."""

PARTS = 10
"""Number of parts of a recording for the jackknife estimate of the offset's uncertainty."""

LEAST = 0.6
"""Correlation below which two streams do not show a common motion, so that their offset is unknown."""


class Offset(NamedTuple):
    """Time offset between two streams."""

    seconds: float
    """Time to add to the stream's times so that both agree [s]."""
    std: float
    """Standard deviation of `seconds` [s]."""
    correlation: float
    """Correlation of the two streams once they agree, -1 to 1."""


def on_grid(trial: Trial, columns: tuple[str, ...], t: Array, order: int = 2) -> tuple[Array, Array]:
    """Return smoothed columns of a trial and their slopes at times t (m,), (m, c) each; NaN if there are no data.

    Times are in [s]; columns have the units of a trial, slopes these units per second.
    """
    value, slope = np.full((len(t), len(columns)), np.nan), np.full((len(t), len(columns)), np.nan)
    for i, name in enumerate(columns):
        at, y = trial.series(name)
        if len(at) >= 2:
            s = smooth(at, y[:, None], t, order=order)
            value[:, i], slope[:, i] = s.value[:, 0], s.slope[:, 0]
    return value, slope


def offset(fixed: Array, moved: Array) -> Offset | None:
    """Return the time offset of a signal relative to another of the same motion, from the peak of their correlation.

    Args:
        fixed: Signals in any unit at `RATE`, NaN where unknown, (m, c).
        moved: The same signals in the same unit, with the unknown time offset, (m, c).

    Returns:
        None if the signals show no common motion.
    """
    both = np.isfinite(fixed).any(axis=0) & np.isfinite(moved).any(axis=0)
    if not both.any():
        return None
    x, y = _centred(fixed[:, both]), _centred(moved[:, both])
    longest = min(int(LONGEST * RATE), len(x) // 3)
    lags = np.arange(-longest, longest + 1)
    edges = np.linspace(0, len(x), PARTS + 1).astype(int)[:-1]
    sums = np.array([_sums(x, y, int(k), edges) for k in lags])  # (lags, blocks, xx yy xy)
    energy = np.sqrt(np.nansum(x**2) * np.nansum(y**2))
    if not energy > 0.0:
        return None
    # The most common motion locates the peak; the correlation over the overlap, unbiased at the ends, refines it.
    near = np.abs(lags - lags[int(np.argmax(sums[..., 2].sum(axis=1)))]) <= NEAR * RATE
    place, height = _peak(_correlation(sums.sum(axis=1)), near)
    if not height >= LEAST:
        return None
    parts = [_peak(_correlation(np.delete(sums, b, axis=1).sum(axis=1)), near)[0] for b in range(PARTS)]
    # Jackknife: a single short event must not appear certain.
    spread = float(np.sqrt((PARTS - 1) * np.var(parts)))
    if not np.isfinite(spread):  # without one of the parts there is no peak
        return None
    return Offset(-float(lags[0] + place) / RATE, max(spread, 0.1) / RATE, height)


def _peak(correlation: Array, near: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the interpolated position and the height of the highest peak within the mask; NaN if it is on
    its edge."""
    best = int(np.argmax(np.where(near, correlation, -2.0)))
    if best in (0, len(near) - 1) or not (near[best - 1] and near[best + 1]):
        return np.nan, np.nan
    before, peak, after = correlation[best - 1 : best + 2]
    bend = before - 2.0 * peak + after
    return best + (0.5 * (before - after) / bend if bend < 0.0 else 0.0), float(peak)


def _centred(x: Array) -> Array:
    return np.asarray(x - np.nanmedian(x, axis=0))


def _sums(x: Array, y: Array, lag: int, edges: NDArray[np.int64]) -> Array:
    """Return the sums of x², y² and x y of x(t) and y(t + lag) where both are known, by block of t, (blocks, 3)."""
    n = len(x)
    products = np.zeros((n, 3))
    rows = slice(max(0, -lag), n - max(0, lag))
    a, b = x[rows], y[max(0, lag) : n - max(0, -lag)]
    known = np.isfinite(a) & np.isfinite(b)
    a, b = np.where(known, a, 0.0), np.where(known, b, 0.0)
    products[rows] = np.stack([np.sum(a * a, axis=1), np.sum(b * b, axis=1), np.sum(a * b, axis=1)], axis=-1)
    return np.add.reduceat(products, edges, axis=0)


def _correlation(sums: Array) -> Array:
    """Return the correlation from sums of x², y² and x y, (lags, 3) -> (lags,)."""
    return np.asarray(sums[:, 2] / np.maximum(np.sqrt(sums[:, 0] * sums[:, 1]), 1e-300))


# Zero-phase smoothing of unevenly sampled signals, with a strength estimated from the data.
#
# A penalised cubic B-spline (Eilers and Marx 1996), with up to one knot per sample, fitted to every segment without a
# gap:
#
#     min Σ (y_i - f(t_i))² + λ Σ (Δᵐ c)²
#
# λ maximises the likelihood of the data (restricted maximum likelihood; Wahba 1985), using the spectrum of the
# smoother on a uniform grid, where sines diagonalise it. It is estimated for windows of some seconds and interpolated
# between them, so that a push is followed closely and the calm motion after it is smoothed. The noise is only assumed
# to be white.

FEWEST = 5
"""Least number of samples of a segment; shorter ones are discarded."""

CANDIDATES = 48
"""Number of values of λ that are evaluated."""

WINDOW = 200
"""Least number of samples of a window, half of which overlaps the next; shorter segments have one λ."""

WINDOW_TIME = 4.0
"""Least length of a window [s]."""

SHARE = 0.3
"""Weight, for each sample of a window, of the mean likelihood over all windows, which decides where a window
does not."""

STIFFEST = 1e9
"""Largest λ if it varies: next to closely followed parts, much larger values would make the equations
ill-conditioned."""

KNOT_PHASE = 0.2
"""Largest phase of the half-loss frequency from one knot to the next [rad]."""

MIN_INTERVALS = 4

SPIKE = 8.0
"""Number of robust standard deviations beyond which a sample is a spike."""


class Smooth(NamedTuple):
    """Signals on a grid; NaN outside the segments of samples."""

    value: Array
    """Values in the unit of the signal, (m, c)."""
    slope: Array
    """Time derivative, unit of the signal per second, (m, c)."""
    noise: Array
    """Standard deviation of one sample, in the unit of the signal, (c,)."""
    slope_std: Array
    """Standard deviation of `slope`, in its unit, due to remaining noise and lost signal (Wahba 1983), (c,)."""


def longest_step(t: Array) -> float:
    """Return the longest interval between samples that is bridged [s]: 0.2 s, or four median intervals."""
    return max(0.2, 4.0 * float(np.median(np.diff(t)))) if len(t) > 1 else 0.2


def stretches(t: Array, max_gap: float) -> list[slice]:
    """Return the runs of samples without a step longer than `max_gap`. Times are in [s]."""
    edges = [0, *(np.flatnonzero(np.diff(t) > max_gap) + 1), len(t)]
    return [slice(a, b) for a, b in zip(edges, edges[1:], strict=False) if b > a]


def spans_of(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the runs of true samples as (begin, end) pairs, end exclusive."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(b), int(e)) for b, e in edges.reshape(-1, 2)]


def white_noise(values: Array) -> float:
    """Return the standard deviation of white noise on a signal that is smooth from sample to sample, from
    second differences.

    Args:
        values: Evenly sampled finite values, in any unit, (n,).

    Returns:
        Standard deviation in the unit of the values; NaN for fewer than ten samples.
    """
    if len(values) < 10:
        return math.nan
    return float(np.median(np.abs(np.diff(values, 2)))) / (0.6745 * math.sqrt(6.0))


def without_spikes(t: Array, y: Array) -> NDArray[np.bool_]:
    """Return a mask of the samples that are not spikes: spikes are far from the median of their five nearest
    samples, relative to the spread of these distances.

    Args:
        t: Times [s], (n,).
        y: Values in any unit, (n, c).

    Returns:
        Mask, (n,); at most a twentieth of the samples is rejected, since spikes are rare.
    """
    n = len(t)
    if n < 9:
        return np.ones(n, bool)
    padded = np.concatenate([y[2:0:-1], y, y[-2:-4:-1]])
    median = np.median(np.lib.stride_tricks.sliding_window_view(padded, 5, axis=0), axis=-1)
    distance = np.abs(y - median)
    usual_step = np.median(np.abs(np.diff(y, axis=0)), axis=0)
    spread = np.maximum(1.4826 * np.median(distance, axis=0), 0.5 * usual_step)
    floor = 0.02 * (np.percentile(y, 95.0, axis=0) - np.percentile(y, 5.0, axis=0)) + 1e-12
    bad = np.any(distance > SPIKE * np.maximum(spread, floor), axis=1)
    return ~bad if bad.sum() <= 0.05 * n else np.ones(n, bool)


def smooth(t: Array, y: Array, at: Array, *, order: int = 2, together: bool = False) -> Smooth:
    """Smooth signals that share their sample times.

    Args:
        t: Times of the samples, increasing [s], (n,).
        y: Finite values in any unit, (n, c).
        at: Times of the result [s], (m,).
        order: Order m of the penalised difference: 2 for signals with jumps in slope, such as velocities
            under a step of force; 3 for their integrals.
        together: True for one λ for all columns, such as the components of a quaternion.

    Returns:
        Smoothed signals at `at`.
    """
    good = without_spikes(t, y)
    gap = longest_step(t)
    t, y = t[good], y[good]
    m, c = len(at), y.shape[1]
    value, slope = np.full((m, c), np.nan), np.full((m, c), np.nan)
    runs = [run for run in stretches(t, gap) if run.stop - run.start >= FEWEST]
    if not runs:
        return Smooth(value, slope, *(np.full(c, np.nan) for _ in range(2)))
    shared = [slice(0, c)] if together else [slice(i, i + 1) for i in range(c)]
    figures = np.empty((2, c))
    for columns in shared:
        windows = [window for run in runs for window in _windows(t, run)]
        strength, figures[:, columns] = _choose([_spectrum(t[w], y[w, columns], order) for w in windows])
        middle = np.array([0.5 * (t[w][0] + t[w][-1]) for w in windows])
        for run in runs:
            inside = (at >= t[run][0] - 1e-6) & (at <= t[run][-1] + 1e-6)
            if inside.any():
                own = (middle >= t[run][0]) & (middle <= t[run][-1])
                f = _fit(t[run], y[run, columns], middle[own], strength[own], order, at[inside])
                value[inside, columns], slope[inside, columns] = f
    return Smooth(value, slope, *figures)


def _windows(t: Array, run: slice) -> list[slice]:
    """Return windows of equal length that overlap by half."""
    n = run.stop - run.start
    whole = int(min(n / WINDOW, (t[run][-1] - t[run][0]) / WINDOW_TIME))
    count = max(1, 2 * whole - 1)
    width = 2 * n // (count + 1)
    starts = np.linspace(run.start, run.stop - width, count)
    return [slice(int(a), int(a) + width) for a in starts]


def _spectrum(t: Array, y: Array, order: int) -> tuple[Array, Array, Array]:
    """Return penalty eigenvalue (k,), angular frequency (k,) [rad/s] and power by column (k, c) of the sines
    of a window."""
    n = len(t)
    grid = np.linspace(t[0], t[-1], n)
    even = np.stack([np.interp(grid, t, column) for column in y.T], axis=-1)
    part = (np.arange(n) / (n - 1))[:, None]
    even = even - (1.0 - part) * _first(even) - part * _first(even[::-1])
    theta = np.pi * np.arange(1, n - 1) / (n - 1)
    symbol = (2.0 + np.cos(theta)) / 3.0  # a cubic B-spline sampled at its knots
    penalty = (2.0 * np.sin(theta / 2.0)) ** (2 * order) / symbol**2
    omega = theta * (n - 1) / (t[-1] - t[0])
    return penalty, omega, dst(even[1:-1], type=1, norm="ortho", axis=0) ** 2


def _first(y: Array) -> Array:
    """Return the first value without noise, (n, c) -> (c,), from the longest line that fits the first samples.

    A line through two noisy ends would add a spurious signal.
    """
    noise = np.median(np.abs(np.diff(y, 2, axis=0)), axis=0) / (0.6745 * np.sqrt(6.0))
    value, following = y[0].copy(), np.ones(y.shape[1], bool)
    k = 4
    while k <= len(y) // 8 and following.any():
        x = np.arange(k) - 0.5 * (k - 1)
        mean, slope = y[:k].sum(axis=0) / k, 12.0 * (x @ y[:k]) / (k * (k * k - 1.0))
        rest = y[:k] - mean - x[:, None] * slope
        fits = following & (np.sqrt(np.sum(rest**2, axis=0) / (k - 2)) <= (1.1 + np.sqrt(2.0 / k)) * noise)
        value = np.where(fits, mean + x[0] * slope, value)
        following = fits if k >= 16 else following  # four samples may deviate by chance
        k *= 4
    return value


def _choose(spectra: list[tuple[Array, Array, Array]]) -> tuple[Array, Array]:
    """Return λ of every window (w,), and noise and slope_std by column (2, c)."""
    smallest, largest = min(p.min() for p, _, _ in spectra), max(p.max() for p, _, _ in spectra)
    candidates = np.geomspace(1e-4 / largest, 1e1 / smallest, CANDIDATES)
    unlikely, sizes = np.empty((len(spectra), CANDIDATES)), np.array([len(p) for p, _, _ in spectra])
    for w, (penalty, _, power) in enumerate(spectra):
        lost = candidates[:, None] * penalty / (1.0 + candidates[:, None] * penalty)  # eigenvalues of 1 - H
        unlikely[w] = sizes[w] * np.log(lost @ power.sum(axis=1) + 1e-300) - np.log(lost).sum(axis=1)
    mean = unlikely.sum(axis=0) / sizes.sum()
    best = candidates[np.argmin(unlikely + SHARE * sizes[:, None] * mean, axis=1)]
    figures = []
    for strength, (penalty, omega, power) in zip(best, spectra, strict=True):
        lost = strength * penalty / (1.0 + strength * penalty)
        noise = np.sqrt((lost**2 @ power) / lost.sum())
        figures.append([noise, noise * np.sqrt(np.mean((1.0 - lost) * omega**2))])
    squares = np.square(figures)  # (w, 2, c)
    errors = np.sqrt(np.average(squares, axis=0, weights=sizes))
    errors[0] = np.sqrt(np.median(squares[:, 0], axis=0))
    return best, errors


def _fit(t: Array, y: Array, middle: Array, strength: Array, order: int, at: Array) -> tuple[Array, Array]:
    """Return value and slope at given times inside [t[0], t[-1]] of the penalised spline, (m, c) each; λ at
    `middle` (w,)."""
    # Strong smoothing needs few knots; many would make the equations ill-conditioned.
    usual = len(t) - 1
    intervals = max(MIN_INTERVALS, math.ceil(usual * min(1.0, strength.min() ** (-0.5 / order) / KNOT_PHASE)))
    h = (t[-1] - t[0]) / intervals
    trend = (y[-1] - y[0]) / (t[-1] - t[0])  # subtracted, since small values have small rounding errors
    line, y = y[0] + (at - t[0])[:, None] * trend, y - y[0] - (t - t[0])[:, None] * trend
    count = intervals + 3
    if len(strength) > 1:
        place = t[0] + h * (np.arange(count - order) + 0.5 * order - 1.0)
        strength = np.exp(np.interp(place, middle, np.log(np.minimum(strength, STIFFEST))))
    strength = strength * (intervals / usual) ** (2 * order - 1)
    cell, weights, _ = _basis((t - t[0]) / h, intervals)
    band = np.zeros((4, count))
    for a in range(4):
        for b in range(a, 4):
            band[b - a] += np.bincount(cell + a, weights[a] * weights[b], count)
    difference = np.array([1.0])
    for _ in range(order):
        difference = np.convolve(difference, [1.0, -1.0])
    for a in range(order + 1):
        for b in range(a, order + 1):
            band[b - a, a : a + count - order] += strength * difference[a] * difference[b]
    right = np.stack(
        [sum(np.bincount(cell + a, weights[a] * column, count) for a in range(4)) for column in y.T], axis=-1
    )
    coefficients = solveh_banded(band, right, lower=True, check_finite=False)
    cell, weights, slopes = _basis((at - t[0]) / h, intervals)
    parts = coefficients[cell[:, None] + np.arange(4)]
    return line + np.einsum("am,mac->mc", weights, parts), trend + np.einsum("am,mac->mc", slopes, parts) / h


def _basis(x: Array, intervals: int) -> tuple[NDArray[np.intp], Array, Array]:
    """Return the cell, and values and slopes of the four nonzero uniform cubic B-splines there, (4, m) each."""
    cell = np.clip(np.floor(x).astype(np.intp), 0, intervals - 1)
    s = x - cell
    r = 1.0 - s
    values = [r**3, 3.0 * s**3 - 6.0 * s**2 + 4.0, 3.0 * r**3 - 6.0 * r**2 + 4.0, s**3]
    slopes = [-(r**2), 3.0 * s**2 - 4.0 * s, -3.0 * r**2 + 4.0 * r, s**2]
    return cell, np.stack(values) / 6.0, np.stack(slopes) / 2.0


ANSWER = (0.02, 0.02, 0.02, 0.04, 0.04, 0.04)
"""Range of a velocity below which an axis does not respond [m/s, rad/s]."""


def answers(moved: Motion, i: int) -> bool:
    """Return whether the velocity of an axis, 0 surge to 5 yaw, exceeds its noise."""
    noise = moved.noise_std[i]
    return usual_range(moved.nu[:, i]) > max(ANSWER[i], 4.0 * noise if np.isfinite(noise) else 0.0)


def usual_range(values: Array) -> float:
    """Return the range from the 2nd to the 98th percentile of the finite values, in their unit; 0 if there
    are none."""
    finite = values[np.isfinite(values)]
    return float(np.ptp(np.percentile(finite, [2.0, 98.0]))) if len(finite) else 0.0
