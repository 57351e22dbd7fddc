"""Whether a trial's numbers agree with each other: units, signs, axes."""

from __future__ import annotations

import numpy as np

from finssim.calibration.check.report import Finding
from finssim.calibration.motion.accelerations import holds_gravity
from finssim.calibration.motion.attitude_signal import (
    AttitudeSignal,
    attitude_samples,
    attitude_signal,
    up_in_body,
)
from finssim.calibration.motion.smoothing import longest_step, smooth
from finssim.calibration.motion.synchronisation import Offset
from finssim.calibration.trials.trial import Array, Trial
from finssim.geometry.rotations import quat_rotate, quat_to_euler
from finssim.vehicles import Vehicle

__all__ = ["frame_findings", "unit_findings"]

RATE = 25.0
"""Of the grid on which columns are compared [Hz]."""

AGAINST = -0.5
"""Correlation below which two columns that should agree run against each other."""

WITH = 0.7
"""Correlation above which their ratio means something."""

FEWEST = 25
"""Points of a grid with motion that a comparison needs."""

FASTEST_TURN = 15.0
"""No vehicle turns faster [rad/s]."""

DEGREES = 57.3

DRIFTS = 0.2
"""Range of the heading less the integrated gyro and its constant error that is a drift [rad]."""

GYRO_BIAS = 0.03
"""Steady difference between heading and integrated gyro that no calibrated gyro has [rad/s]."""


def unit_findings(trial: Trial) -> list[Finding]:
    """Angles in degrees, told from values that radians cannot have."""
    found = []
    for name, most in (("roll", 1.05 * np.pi), ("pitch", 0.55 * np.pi)):
        _, y = trial.series(name)
        if len(y) and np.abs(y).max() > most:
            found.append(_degrees(name, float(np.abs(y).max()), "rad"))
    _, yaw = trial.series("yaw")
    if len(yaw) > 1:
        jumps = np.abs(np.diff(yaw))
        if np.abs(yaw).max() > 2.5 * np.pi and (np.any(np.abs(jumps - 360.0) < 30.0) or not trial.has("r")):
            found.append(_degrees("yaw", float(np.abs(yaw).max()), "rad"))
    for name in ("p", "q", "r"):
        _, y = trial.series(name)
        if len(y) and np.percentile(np.abs(y), 99.0) > FASTEST_TURN:
            found.append(_degrees(name, float(np.percentile(np.abs(y), 99.0)), "rad/s"))
    return found


def _degrees(name: str, value: float, unit: str) -> Finding:
    return Finding(
        "refused",
        f"{name} reaches {value:.3g} {unit}: degrees? give 'convert: {{scale: {{{name}: 0.0174533}}}}'",
    )


def frame_findings(trial: Trial, vehicle: Vehicle, offsets: dict[str, Offset]) -> list[Finding]:
    """Gravity against the attitude, rates against its changes, velocity against those of position and depth."""
    t = np.arange(trial.t[0], trial.t[-1], 1.0 / RATE)
    if len(t) < FEWEST:
        return []
    by = offsets["attitude"].seconds if "attitude" in offsets else 0.0
    attitude = attitude_signal(trial, t - by)
    return [
        *_gravity(trial, vehicle.water.gravity, t, attitude),
        *_rates(trial, t, attitude),
        *_heading(trial, by),
        *_vertical(trial, t, attitude),
        *_horizontal(trial, t, attitude),
    ]


def _on(trial: Trial, names: tuple[str, ...], t: Array, order: int = 2) -> tuple[Array, Array]:
    """Smoothed columns and their slopes, (m, c) each; NaN where there are none."""
    value, slope = np.full((len(t), len(names)), np.nan), np.full((len(t), len(names)), np.nan)
    for i, name in enumerate(names):
        at, y = trial.series(name)
        if len(at) >= 5:
            s = smooth(at, y[:, None], t, order=order)
            value[:, i], slope[:, i] = s.value[:, 0], s.slope[:, 0]
    return value, slope


def _gravity(trial: Trial, g: float, t: Array, attitude: AttitudeSignal) -> list[Finding]:
    if not trial.has("az") or trial.header.acceleration == "kinematic":
        return []
    f, _ = _on(trial, ("ax", "ay", "az"), t)
    f = np.nan_to_num(f[np.isfinite(f[:, 2])])
    mean = np.linalg.norm(f.mean(axis=0))
    for size, unit, scale in (
        (1.0, "g", 9.80665),
        (1000.0, "milli-g", 9.80665e-3),
        (100.0 * g, "cm/s²", 0.01),
    ):
        if abs(mean / size - 1.0) < 0.15:
            scales = ", ".join(f"{name}: {scale:g}" for name in ("ax", "ay", "az"))
            return [
                Finding(
                    "refused",
                    f"ax, ay, az are {mean:.4g} at rest: in {unit}? give 'convert: {{scale: {{{scales}}}}}'",
                )
            ]
    if not holds_gravity(trial, g):
        if abs(mean / g - 1.0) < 0.2:
            return [_upside_down(f.mean(axis=0))]
        return [Finding("note", "ax, ay, az hold no gravity")] if mean < 0.3 * g else []
    up = up_in_body(attitude.quaternion) if attitude.tilt else np.tile([0.0, 0.0, 1.0], (len(t), 1))
    f, _ = _on(trial, ("ax", "ay", "az"), t)
    good = np.isfinite(f).all(axis=1) & np.isfinite(up).all(axis=1)
    if good.sum() < FEWEST:
        return []
    f, up = f[good], up[good]
    middle, expected = np.median(f, axis=0), np.median(up, axis=0)
    cosine = float(middle @ expected / (np.linalg.norm(middle) * np.linalg.norm(expected)))
    if cosine < -0.5:
        return [_upside_down(middle)]
    found = []
    if cosine < np.cos(np.radians(15.0)):
        against = "the attitude" if attitude.tilt else "level"
        angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        found.append(
            Finding(
                "care", f"the accelerometer's gravity is {angle:.0f}° from {against}: is it mounted turned?"
            )
        )
    for i, angle_name in ((0, "pitch"), (1, "roll")):
        swing = g * np.std(up[:, i])
        if swing > 0.4 and _correlation(f[:, i], up[:, i]) < AGAINST:
            found.append(
                Finding(
                    "refused",
                    f"a{'xy'[i]} runs against the {angle_name} of the attitude: one of them has the other sign",
                )
            )
    return found


def _upside_down(felt: Array) -> Finding:
    return Finding(
        "refused",
        f"the accelerometer feels gravity the wrong way (az about {felt[2]:.3g} m/s², expected +9.81 when level): "
        "axes forward-right-down? give 'convert: {body: FRD}'",
    )


def _rates(trial: Trial, t: Array, attitude: AttitudeSignal) -> list[Finding]:
    found = []
    gyro, _ = _on(trial, ("p", "q", "r"), t)
    for i, (rate, angle) in enumerate((("p", "roll"), ("q", "pitch"), ("r", "yaw"))):
        derived = attitude.rates[:, i]
        moving = (
            np.isfinite(gyro[:, i]) & np.isfinite(derived) & (np.abs(derived) > 3.0 * attitude.rates_std[i])
        )
        if moving.sum() < FEWEST:
            continue
        still = np.isfinite(gyro[:, i]) & (np.abs(derived) <= 3.0 * attitude.rates_std[i])
        bias = float(np.median(gyro[still, i])) if still.sum() >= FEWEST else 0.0
        x, y = derived[moving], gyro[moving, i] - bias
        correlation, ratio = float(_cosine(x, y)), float(np.sum(x * y) / np.sum(x * x))
        if correlation < AGAINST:
            found.append(
                Finding(
                    "refused",
                    f"{rate} runs against the change of {angle}: one of them has the other sign (convert.body?)",
                )
            )
        elif correlation > WITH and 0.6 * DEGREES < ratio < 1.6 * DEGREES:
            found.append(_degrees(rate, float(np.abs(gyro[:, i][moving]).max()), "rad/s"))
        elif correlation > WITH and 0.6 < ratio * DEGREES < 1.6:
            found.append(_degrees(angle, float(np.nanmax(np.abs(trial.channels.get(angle, x)))), "rad"))
    return found


def _heading(trial: Trial, late: float) -> list[Finding]:
    """The heading against the integrated gyro, psi_dot = (q sin(roll) + r cos(roll)) / cos(pitch)."""
    t, r = trial.series("r")
    at, q, given = attitude_samples(trial)
    if len(t) < FEWEST or "yaw" not in given or len(at) < FEWEST:
        return []
    at, (roll, pitch, yaw) = at - late, quat_to_euler(q)
    inside = (t >= at[0]) & (t <= at[-1])
    if inside.sum() < FEWEST:
        return []
    t, r = t[inside], r[inside]
    phi, theta = np.interp(t, at, roll), np.interp(t, at, pitch)
    q_at = np.interp(t, *trial.series("q")) if trial.has("q") else np.zeros(len(t))
    rate = (q_at * np.sin(phi) + r * np.cos(phi)) / np.maximum(np.cos(theta), 0.2)
    # A gap of the gyro hides a turn: each stretch begins anew.
    step = np.diff(t)
    wide = step > longest_step(t)
    turned = np.concatenate([[0.0], np.cumsum(np.where(wide, 0.0, 0.5 * (rate[1:] + rate[:-1]) * step))])
    apart = np.interp(t, at, np.unwrap(yaw)) - turned
    for edge in np.flatnonzero(wide):
        apart[edge + 1 :] += apart[edge] - apart[edge + 1]
    bias, _ = np.polyfit(t - t[0], apart, 1) if t[-1] - t[0] > 5.0 else (0.0, 0.0)
    rest = apart - bias * (t - t[0])
    noise = 1.4826 * float(np.median(np.abs(np.diff(apart)))) * 6.0
    wander = float(np.ptp(rest)) - noise
    if wander < DRIFTS and abs(bias) < GYRO_BIAS:
        return []
    drift = float(np.ptp(apart)) - noise
    return [
        Finding(
            "care",
            f"the heading drifts by {drift:.2g} rad against the integrated gyro: a compass disturbed by the motors, or "
            "a gyro with a bias? Fits of yaw go by the gyro; velocities from x, y are turned by the heading, and are "
            "wrong where it is",
        )
    ]


def _vertical(trial: Trial, t: Array, attitude: AttitudeSignal) -> list[Finding]:
    found = []
    _, up = _on(trial, ("z", "depth"), t, 3)
    both = np.isfinite(up).all(axis=1)
    if (
        both.sum() >= FEWEST
        and np.std(up[both, 0]) > 0.01
        and _correlation(up[both, 0], up[both, 1]) > -AGAINST
    ):
        found.append(Finding("refused", "z grows with depth: positive down? give 'convert: {world: NED}'"))
        return found
    rising = np.where(np.isfinite(up[:, 0]), up[:, 0], -up[:, 1])
    through = _through_world(trial, t, attitude)[:, 2]
    good = np.isfinite(rising) & np.isfinite(through)
    if good.sum() >= FEWEST and min(np.std(rising[good]), np.std(through[good])) > 0.015:
        correlation = _correlation(rising[good], through[good])
        what = "z" if trial.has("z") else "depth"
        if correlation < AGAINST:
            found.append(
                Finding(
                    "refused",
                    f"w runs against the change of {what}: one of them has the other sign (convert.body?)",
                )
            )
    return found


def _horizontal(trial: Trial, t: Array, attitude: AttitudeSignal) -> list[Finding]:
    if not (trial.has("x", "y", "u", "v") and attitude.heading):
        return []
    _, world = _on(trial, ("x", "y"), t, 3)
    through = _through_world(trial, t, attitude)[:, :2]
    good = np.isfinite(world).all(axis=1) & np.isfinite(through).all(axis=1)
    if good.sum() < FEWEST or min(np.std(world[good]), np.std(through[good])) < 0.02:
        return []
    a, b = (v[good, 0] + 1j * v[good, 1] for v in (through, world))
    size = np.linalg.norm(a) * np.linalg.norm(b)
    turned, mirrored = np.vdot(a, b) / size, np.vdot(a.conj(), b) / size
    if abs(turned) > WITH and abs(np.angle(turned)) > np.radians(15.0):
        angle = float(np.degrees(np.angle(turned)))
        return [
            Finding(
                "care",
                f"x, y and the heading disagree by {angle:.0f}°: u, v come out turned if derived from x, y",
            )
        ]
    if abs(mirrored) > WITH > abs(turned) + 0.3:
        return [
            Finding(
                "refused",
                "u, v turned by the yaw run mirrored to x, y: the sign of v, y or yaw is the other one",
            )
        ]
    ratio = float(np.linalg.norm(b) / np.linalg.norm(a))
    if abs(turned) > WITH and not 0.6 < ratio < 1.6:
        return [Finding("care", f"x, y change {ratio:.3g} times as fast as u, v say: a wrong unit?")]
    return []


def _through_world(trial: Trial, t: Array, attitude: AttitudeSignal) -> Array:
    nu, _ = _on(trial, ("u", "v", "w"), t)
    known = np.isfinite(attitude.turn).all(axis=1)
    through = quat_rotate(np.where(known[:, None], attitude.turn, [0.0, 0.0, 0.0, 1.0]), np.nan_to_num(nu))
    if attitude.heading:
        through[~known] = np.nan
    through[~np.isfinite(nu[:, :2]).all(axis=1), :2] = np.nan
    through[~np.isfinite(nu[:, 2]), 2] = np.nan
    return np.asarray(through)


def _correlation(x: Array, y: Array) -> float:
    return _cosine(x - x.mean(), y - y.mean())


def _cosine(x: Array, y: Array) -> float:
    size = np.linalg.norm(x) * np.linalg.norm(y)
    return float(x @ y / size) if size > 0.0 else 0.0
