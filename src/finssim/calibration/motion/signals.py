"""One trial on a uniform grid: velocities, accelerations, attitude and applied wrench about the body origin.

What is measured is smoothed (`finssim.calibration.motion.smoothing`) and moved to the body origin; what is not is
derived where the other columns allow it, and NaN where they do not. Nothing is interpolated across a gap.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding
from finssim.calibration.motion.accelerations import Velocities, accelerations, velocities
from finssim.calibration.motion.attitude_signal import attitude_signal
from finssim.calibration.trials.inputs import Drive, applied_wrench, drive
from finssim.calibration.trials.trial import COLUMNS, NU, Trial
from finssim.vehicles import Vehicle

__all__ = ["Motion", "grid_rate", "motion"]

Array = NDArray[np.float64]

FASTEST = 100.0
"""Rate of the grid that is not exceeded unless asked for [Hz]; bodies in water do not need more."""

MOST = 0.5
"""An axis that is known for less than this part of a trial does not decide which rows are valid."""


@dataclass(frozen=True, kw_only=True)
class Motion:
    """A trial on a uniform grid of n times. Body frame, about the body origin, unless said otherwise."""

    t: Array
    """On the trial's clock [s], (n,)."""
    rate: float
    """Of the grid [Hz]."""
    nu: Array
    """u, v, w, p, q, r, smoothed [m/s, rad/s], (n, 6); NaN where unknown. Relative to the ground, or to the water where
    the header says so and gives no current."""
    raw: Array
    """The same for measured axes, not smoothed, in straight lines between samples, (n, 6); NaN where not measured."""
    nu_dot: Array
    """Rate of the components of nu [m/s², rad/s²], (n, 6); NaN where unknown."""
    quaternion: Array
    """Body to world, (n, 4); NaN where roll and pitch are unknown. The heading is 0 where nobody measured it."""
    position: Array
    """World frame [m], (n, 3); NaN where unknown."""
    tau: Array
    """Wrench that acted [N, N m], (n, 6); commands have passed the motors of the vehicle file. NaN where unknown."""
    phase: NDArray[np.str_]
    """(n,); empty words where the trial names none."""
    valid: NDArray[np.bool_]
    """Whether the wrench and every axis that is known for most of the trial are known, (n,)."""
    nu_source: tuple[str, ...]
    """By axis: `measured`, `derived from position`, `derived from depth`, `derived from attitude`, or nothing."""
    nu_dot_source: tuple[str, ...]
    """By axis: `imu`, where that tells more than the velocity, `smoothed velocity`, or nothing."""
    noise_std: Array
    """By axis, the standard deviation of one sample of a measured velocity, or of the value of a derived one, (6,)."""
    findings: tuple[Finding, ...] = ()
    """What was assumed."""


def motion(
    trial: Trial, vehicle: Vehicle, *, rate: float | None = None, max_gap: float | None = None
) -> Motion:
    """A trial on a uniform grid.

    Args:
        trial: The trial.
        vehicle: Gives the places of sensors that the header leaves out, the motors and gravity.
        rate: Of the grid [Hz]; that of the fastest stream, up to 100, if None.
        max_gap: Longest time between samples of a stream that is bridged [s]; 0.2 s or four usual steps if None.

    Raises:
        CalibrationError: The inputs are missing or not of this vehicle, or a rate or gap is not above zero.
    """
    for name, value in (("rate", rate), ("max_gap", max_gap)):
        if value is not None and not value > 0.0:
            raise CalibrationError(f"{name} is {value}, expected a number above 0", trial.name)
    inputs = drive(trial, vehicle)
    rate = grid_rate(trial, inputs) if rate is None else rate
    t = trial.t[0] + np.arange(int(np.floor(trial.duration * rate + 1e-6)) + 1) / rate
    attitude = attitude_signal(trial, t, max_gap)
    found = velocities(trial, vehicle, t, attitude, max_gap)
    nu_dot, nu_dot_source, unused = accelerations(trial, vehicle, t, attitude, found, max_gap)
    tau = applied_wrench(inputs, vehicle, t)
    return Motion(
        t=t,
        rate=rate,
        nu=found.nu,
        raw=found.raw,
        nu_dot=nu_dot,
        quaternion=attitude.quaternion,
        position=found.position,
        tau=tau,
        phase=_phase(trial, t),
        valid=_valid(tau, found),
        nu_source=found.source,
        nu_dot_source=nu_dot_source,
        noise_std=found.noise_std,
        findings=(*inputs.findings, *found.findings, *unused),
    )


def grid_rate(trial: Trial, inputs: Drive) -> float:
    """Rate of the fastest stream of inputs or motion, up to `FASTEST` [Hz]."""
    steps = [float(np.median(np.diff(inputs.t)))] if inputs.source != "passive" else []
    for column in trial.channels:
        if column in COLUMNS and COLUMNS[column].group != "command" and trial.has(column):
            steps.append(float(np.median(np.diff(trial.series(column)[0]))))
    rate = 1.0 / min(steps) if steps else 1.0 / float(np.median(np.diff(trial.t)))
    whole = round(rate)
    return float(min(FASTEST, whole if whole >= 5 and abs(rate / whole - 1.0) < 0.01 else rate))


def _phase(trial: Trial, t: Array) -> NDArray[np.str_]:
    if trial.phase is None:
        return np.full(len(t), "", dtype="<U10")
    return trial.phase[np.maximum(np.searchsorted(trial.t, t + 1e-9, side="right") - 1, 0)]


def _valid(tau: Array, found: Velocities) -> NDArray[np.bool_]:
    known = np.isfinite(found.nu)
    counted = known.mean(axis=0) >= MOST if known.any() else np.zeros(len(NU), bool)
    return np.asarray(np.isfinite(tau).all(axis=1) & known.any(axis=1) & known[:, counted].all(axis=1))
