"""Consistency checks of a trial's columns with each other: units, signs, axes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from finssim.core.rotations import quat_rotate, quat_to_euler
from finssim.trials.findings import Finding, finding
from finssim.trials.motion import (
    AttitudeSignal,
    attitude_samples,
    attitude_signal,
    holds_gravity,
    longest_step,
    on_grid,
    up_in_body,
    white_noise,
)
from finssim.trials.significance import Relation, relation
from finssim.trials.trial import Array, Trial
from finssim.vehicles import Vehicle

if TYPE_CHECKING:
    pass

RATE = 25.0
"""Rate of the grid on which columns are compared [Hz]."""

AGAINST = -0.5
"""Correlation below which two columns that should be equal have opposite signs."""

NEGATIVE = 4.0
"""Largest factor by which noise, smoothing and scale errors change a slope of -1."""

WITH = 0.7
"""Correlation above which the ratio of two columns is meaningful."""

FEWEST = 25
"""Number of grid points with motion that a comparison needs."""

DEGREES = 57.3

DRIFTS = 0.2
"""Range of the heading minus the integrated gyro and its constant bias above which they drift apart [rad]."""

WALK = 2.5
"""Range of a detrended random walk, in standard deviations of its end, that is rarely exceeded by chance."""

WIGGLES = 10.0
"""Number of independent values that smoothing leaves of pure noise."""

LARGEST_TURN = 1.0
"""Turn between two samples of an attitude above which the derived rates may be aliased [rad]."""

STEEP = 0.6
"""Cosine of the pitch below which the heading is undefined."""

LEVEL = 0.7
"""Cosine of the tilt below which restoring moments act on yaw, and weight acts on surge and sway."""

GYRO_BIAS = 0.03
"""Constant difference between heading rate and gyro that no calibrated gyro has [rad/s]."""


def unit_findings(trial: Trial) -> list[Finding]:
    """Return findings about angles in degrees, recognised by values that are impossible in radians."""
    findings = []
    for name, limit in (("roll", 1.05 * np.pi), ("pitch", 0.55 * np.pi)):
        _, y = trial.series(name)
        if len(y) and np.abs(y).max() > limit:
            findings.append(finding("degrees", column=name, value=float(np.abs(y).max()), unit="rad"))
    _, yaw = trial.series("yaw")
    if len(yaw) > 1:
        jumps = np.abs(np.diff(yaw))
        if np.abs(yaw).max() > 2.5 * np.pi and (np.any(np.abs(jumps - 360.0) < 30.0) or not trial.has("r")):
            findings.append(finding("degrees", column="yaw", value=float(np.abs(yaw).max()), unit="rad"))
    return findings


def frame_findings(trial: Trial, vehicle: Vehicle) -> list[Finding]:
    """Compare gravity with the attitude, rates with its changes, and velocity with those of position and depth."""
    t = np.arange(trial.t[0], trial.t[-1], 1.0 / RATE)
    if len(t) < FEWEST:
        return []
    attitude = attitude_signal(trial, t)
    return [
        *_gravity(trial, vehicle.water.gravity, t, attitude),
        *_rates(trial, t, attitude),
        *_heading(trial),
        *_vertical(trial, t, attitude),
        *_horizontal(trial, t, attitude),
    ]


def _gravity(trial: Trial, g: float, t: Array, attitude: AttitudeSignal) -> list[Finding]:
    if not trial.has("az") or trial.header.acceleration == "kinematic":
        return []
    f, _ = on_grid(trial, ("ax", "ay", "az"), t)
    f = np.nan_to_num(f[np.isfinite(f[:, 2])])
    mean = np.linalg.norm(f.mean(axis=0))
    usual = np.median(np.linalg.norm(f, axis=1))  # also valid for a vehicle that turns over
    for size, unit, scale in (
        (1.0, "g", 9.80665),
        (1000.0, "milli-g", 9.80665e-3),
        (100.0 * g, "cm/s²", 0.01),
    ):
        if abs(mean / size - 1.0) < 0.15 and abs(usual / size - 1.0) < 0.3:
            return [finding("acceleration_unit", value=mean, unit=unit, factor=scale)]
    if not holds_gravity(trial, g):
        if abs(mean / g - 1.0) < 0.2:
            return [finding("gravity_wrong_way", az=f.mean(axis=0)[2])]
        return [finding("no_gravity")] if mean < 0.3 * g else []
    up = up_in_body(attitude.quaternion) if attitude.tilt else np.tile([0.0, 0.0, 1.0], (len(t), 1))
    f, _ = on_grid(trial, ("ax", "ay", "az"), t)
    good = np.isfinite(f).all(axis=1) & np.isfinite(up).all(axis=1)
    if good.sum() < FEWEST:
        return []
    f, up = f[good], up[good]
    middle, expected = np.median(f, axis=0), np.median(up, axis=0)
    cosine = float(middle @ expected / (np.linalg.norm(middle) * np.linalg.norm(expected)))
    if cosine < -0.5:
        return [finding("gravity_wrong_way", az=middle[2])]
    findings = []
    if cosine < np.cos(np.radians(15.0)):
        against = "the attitude" if attitude.tilt else "level"
        angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        # Without an attitude, a vehicle that is level at any time reveals the orientation of its accelerometer.
        cosines = np.sum(f * up, axis=1) / np.linalg.norm(f, axis=1)
        if attitude.tilt or np.percentile(cosines, 98.0) < np.cos(np.radians(15.0)):
            findings.append(finding("accelerometer_turned", angle=angle, reference=against))
    for i, angle_name in ((0, "pitch"), (1, "roll")):
        swing = g * np.std(up[:, i])
        if swing > 0.4 and _against(relation(g * up[:, i], f[:, i], nuisances=np.ones((len(f), 1)))):
            findings.append(finding("acceleration_sign", column=f"a{'xy'[i]}", angle=angle_name))
    return findings


def _rates(trial: Trial, t: Array, attitude: AttitudeSignal) -> list[Finding]:
    findings: list[Finding] = []
    _, q, _ = attitude_samples(trial)
    if len(q) < FEWEST or _too_slow(trial, q):
        return []
    gyro, _ = on_grid(trial, ("p", "q", "r"), t)
    angles = quat_to_euler(q)
    for i, (rate, angle) in enumerate((("p", "roll"), ("q", "pitch"), ("r", "yaw"))):
        derived = attitude.rates[:, i]
        moving = (
            np.isfinite(gyro[:, i]) & np.isfinite(derived) & (np.abs(derived) > 3.0 * attitude.rates_std[i])
        )
        if moving.sum() < FEWEST or not _stands_out(derived, np.unwrap(angles[i])):
            continue
        found = relation(derived, gyro[:, i], nuisances=np.ones((len(t), 1)))  # a gyro may have a bias
        with_it = found.correlation > WITH and found.sure
        if _against(found):
            findings.append(finding("rate_sign", column=rate, other=angle))
        elif with_it and 0.6 * DEGREES < found.slope < 1.6 * DEGREES:
            fastest = float(np.abs(gyro[:, i][moving]).max())
            findings.append(finding("degrees", column=rate, value=fastest, unit="rad/s"))
        elif with_it and 0.6 < found.slope * DEGREES < 1.6:
            largest = float(np.nanmax(np.abs(trial.channels.get(angle, derived))))
            findings.append(finding("degrees", column=angle, value=largest, unit="rad"))
    return findings


def _heading(trial: Trial) -> list[Finding]:
    """Compare the heading with the integrated gyro, psi_dot = (q sin(roll) + r cos(roll)) / cos(pitch)."""
    t, r = trial.series("r")
    at, q, named = attitude_samples(trial)
    if len(t) < FEWEST or "yaw" not in named or len(at) < FEWEST or _too_slow(trial, q):
        return []
    roll, pitch, yaw = quat_to_euler(q)
    inside = (t >= at[0]) & (t <= at[-1])
    if inside.sum() < FEWEST:
        return []
    t, r = t[inside], r[inside]
    phi, theta = np.interp(t, at, roll), np.interp(t, at, pitch)
    q_at = np.interp(t, *trial.series("q")) if trial.has("q") else np.zeros(len(t))
    if not {"roll", "pitch"} & set(named) and _tilts_unseen(trial):
        return []
    rate = (q_at * np.sin(phi) + r * np.cos(phi)) / np.maximum(np.cos(theta), STEEP)
    # A gap of the gyro hides a turn, and the heading is undefined at steep pitch: each segment starts again.
    step = np.diff(t)
    wide = (step > longest_step(t)) | (np.cos(theta[1:]) < STEEP) | (np.cos(theta[:-1]) < STEEP)
    turns = np.where(wide, 0.0, 0.5 * (rate[1:] + rate[:-1]) * step)
    turned = np.concatenate([[0.0], np.cumsum(turns)])
    difference = np.interp(t, at, np.unwrap(yaw)) - turned
    for edge in np.flatnonzero(wide):
        difference[edge + 1 :] += difference[edge] - difference[edge + 1]
    bias, _ = np.polyfit(t - t[0], difference, 1) if t[-1] - t[0] > 5.0 else (0.0, 0.0)
    rest = difference - bias * (t - t[0])
    noise = 1.4826 * float(np.median(np.abs(np.diff(difference)))) * 6.0
    # Gyro noise integrates to a random walk; every second sample estimates the error between samples.
    noise += WALK * white_noise(r) * float(np.sqrt(np.median(step) * (t[-1] - t[0])))
    coarse = np.cumsum(0.5 * (rate[2::2] + rate[:-2:2]) * (step[1::2] + step[: 2 * (len(step) // 2) : 2]))
    noise += float(np.ptp(coarse - np.cumsum(0.5 * (rate[1:] + rate[:-1]) * step)[1::2]))
    wander = float(np.ptp(rest)) - noise
    if wander < DRIFTS and abs(bias) * (t[-1] - t[0]) < GYRO_BIAS * (t[-1] - t[0]) + noise:
        return []
    drift = float(np.ptp(difference)) - noise
    return [finding("heading_drift", drift=drift)]


def _vertical(trial: Trial, t: Array, attitude: AttitudeSignal) -> list[Finding]:
    _, up = on_grid(trial, ("z", "depth"), t, 3)
    moves = [
        np.nanstd(rate) > 0.01 and _stands_out(rate, trial.series(name)[1])
        for name, rate in zip(("z", "depth"), up.T, strict=True)
        if np.isfinite(rate).sum() >= FEWEST
    ]
    if sum(moves) == 2:
        if _against(relation(-up[:, 1], up[:, 0], nuisances=np.ones((len(t), 1)))):
            return [finding("z_down")]
        if wrong_unit := _unit_ratio(-up[:, 1], up[:, 0], "z", "depth"):
            return wrong_unit
    if not attitude.tilt and _tilts_unseen(trial):
        return []
    vertical = "z" if trial.has("z") else "depth"
    rising = np.where(np.isfinite(up[:, 0]), up[:, 0], -up[:, 1])
    through = _through_world(trial, t, attitude)[:, 2]
    good = np.isfinite(rising) & np.isfinite(through)
    if good.sum() < FEWEST or min(np.std(rising[good]), np.std(through[good])) < 0.015:
        return []
    if not _stands_out(np.where(good, rising, np.nan), trial.series(vertical)[1]):
        return []
    found = relation(rising, through, nuisances=np.ones((len(t), 1)))
    if _against(found):
        return [finding("rate_sign", column="w", other=vertical)]
    return _unit_ratio(through, rising, vertical, "w") if attitude.tilt else []


def _unit_ratio(x: Array, y: Array, of: str, over: str) -> list[Finding]:
    """Return a finding if y is correlated with x at a ratio that noise in either cannot explain."""
    one = np.ones((len(x), 1))
    found, back = relation(x, y, nuisances=one), relation(y, x, nuisances=one)
    if found.correlation < WITH or not found.sure:
        return []
    low, high = found.slope, 1.0 / back.slope
    if low > 1.6 or high < 0.6:
        return [finding("speed_ratio", columns=of, ratio=float(np.sqrt(low * high)), velocity=over)]
    return []


def _horizontal(trial: Trial, t: Array, attitude: AttitudeSignal) -> list[Finding]:
    if not (trial.has("x", "y", "u", "v") and attitude.heading):
        return []
    if not attitude.tilt and _tilts_unseen(trial):
        return []
    _, world = on_grid(trial, ("x", "y"), t, 3)
    through = _through_world(trial, t, attitude)[:, :2]
    good = np.isfinite(world).all(axis=1) & np.isfinite(through).all(axis=1)
    if good.sum() < FEWEST or min(np.std(world[good]), np.std(through[good])) < 0.02:
        return []
    if not any(_stands_out(world[good, i], trial.series("xy"[i])[1]) for i in range(2)):
        return []
    a, b = (v[good, 0] + 1j * v[good, 1] for v in (through, world))
    size = np.linalg.norm(a) * np.linalg.norm(b)
    turned, mirrored = np.vdot(a, b) / size, np.vdot(a.conj(), b) / size
    likelier = mirrored if abs(mirrored) > abs(turned) else turned
    expected = through * [1.0, -1.0 if likelier is mirrored else 1.0]
    c, s = likelier.real / abs(likelier), likelier.imag / abs(likelier)
    expected = expected @ np.array([[c, s], [-s, c]])
    if not relation(np.where(good[:, None], expected, np.nan).T.ravel(), world.T.ravel()).sure:
        return []
    if abs(turned) > WITH and abs(np.angle(turned)) > np.radians(15.0):
        angle = float(np.degrees(np.angle(turned)))
        return [finding("heading_disagrees", angle=angle)]
    if abs(mirrored) > WITH > abs(turned) + 0.3:
        return [finding("mirrored")]
    ratio = float(np.linalg.norm(b) / np.linalg.norm(a))
    if abs(turned) > WITH and not 0.6 < ratio < 1.6:
        return [finding("speed_ratio", columns="x, y", ratio=ratio, velocity="u, v")]
    return []


def _through_world(trial: Trial, t: Array, attitude: AttitudeSignal) -> Array:
    nu, _ = on_grid(trial, ("u", "v", "w"), t)
    valid = np.isfinite(attitude.turn).all(axis=1)
    through = quat_rotate(np.where(valid[:, None], attitude.turn, [0.0, 0.0, 0.0, 1.0]), np.nan_to_num(nu))
    if attitude.heading:
        through[~valid] = np.nan
    through[~np.isfinite(nu[:, :2]).all(axis=1), :2] = np.nan
    through[~np.isfinite(nu[:, 2]), 2] = np.nan
    return np.asarray(through)


def _too_slow(trial: Trial, q: Array) -> bool:
    """Return whether a vehicle turns so far between two attitude samples that the derived rates may be aliased.

    The gyro must confirm it: an angle in degrees would appear to turn far, too.
    """
    turns = 2.0 * np.arccos(np.clip(np.abs(np.sum(q[1:] * q[:-1], axis=1)), 0.0, 1.0))
    step = trial.duration / max(len(q) - 1, 1)
    gyro = [float(np.percentile(np.abs(trial.series(name)[1]), 98.0)) for name in "pqr" if trial.has(name)]
    return bool(np.percentile(turns, 98.0) > LARGEST_TURN and max(gyro, default=0.0) * step > LARGEST_TURN)


def _tilts_unseen(trial: Trial) -> bool:
    """Return whether the gyro shows tilts of a vehicle that is assumed level because no tilt was measured."""
    for t, rate in (trial.series(name) for name in "pq" if trial.has(name)):
        if np.ptp(np.cumsum((rate - np.median(rate))[1:] * np.diff(t))) > LARGEST_TURN:
            return True
    return False


def _stands_out(rates: Array, samples: Array) -> bool:
    """Return whether a signal with these rates on the grid moved by more than smoothed noise would."""
    moved = np.cumsum(np.nan_to_num(rates - np.nanmean(rates))) / RATE
    return not float(np.std(moved)) < white_noise(samples) * np.sqrt(WIGGLES / len(samples))


def _against(found: Relation) -> bool:
    """Return whether a signal is significantly the negative of another that it should equal."""
    return found.correlation < AGAINST and found.sure and -NEGATIVE < found.slope < -1.0 / NEGATIVE
