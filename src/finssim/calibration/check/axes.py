"""Excitation of every axis of a trial: speeds, wrenches, levels, coasts, work."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from finssim.calibration.check.report import AxisReport, Finding
from finssim.calibration.motion.signals import Motion
from finssim.calibration.trials.columns import NU, TAU
from finssim.calibration.trials.inputs import Drive
from finssim.calibration.trials.trial import Array
from finssim.vehicles import AXES, Vehicle

__all__ = ["axis_reports", "work_findings"]

STANDS_OUT = 3.0
"""Speeds above so many standard deviations of a sample are motion."""

LEAST_SPEED = 0.005
"""[m/s, rad/s]; slower is rest."""

QUIET = 0.05
"""Part of the strongest wrench below which an axis coasts."""

LEAST_WRENCH = 0.01
"""Part of what the vehicle can give below which an axis is not driven."""

LONG_PUSH = 3.0
"""Time of input after which its work says something of its sign [s]."""

HOLD = 0.5
"""[s]"""


def axis_reports(motion: Motion, inputs: Drive, vehicle: Vehicle) -> list[AxisReport]:
    """One report per axis, without what it tells."""
    passive = inputs.source == "passive"
    return [_axis(i, motion, passive, vehicle) for i in range(6)]


def _axis(i: int, motion: Motion, passive: bool, vehicle: Vehicle) -> AxisReport:
    nu, tau, dt = motion.nu[:, i], motion.tau[:, i], 1.0 / motion.rate
    known = np.isfinite(nu) & np.isfinite(tau)
    blank = AxisReport(
        axis=AXES[i],
        source=motion.nu_source[i],
        fastest=np.nan,
        noise=np.nan,
        decades=0.0,
        strongest=0.0,
        levels=(),
        work=0.0,
        both_directions=False,
        driven=0.0,
        coasts=0.0,
        rests=0.0,
        excited=False,
    )
    if known.sum() < 10:
        return blank
    speed, wrench = np.abs(nu[known]), np.abs(tau[known])
    noise = float(np.nan_to_num(motion.noise_std[i]))
    floor = max(STANDS_OUT * noise, LEAST_SPEED)
    # Most of a trial may be rest: percentiles are of the times that are not.
    fastest = _strong(speed, floor)
    strongest = _strong(wrench, max(QUIET * float(wrench.max()), 1e-6))
    driven = strongest > LEAST_WRENCH * max(float(vehicle.wrench_limits[i]), 1e-3)
    quiet = np.abs(tau) <= QUIET * strongest if driven else np.ones(len(tau), bool)
    moving = np.abs(nu) > max(floor, QUIET * fastest)
    slowest = float(np.percentile(speed[speed > 0.5 * floor], 5.0)) if (speed > 0.5 * floor).any() else floor
    return replace(
        blank,
        fastest=fastest,
        noise=noise,
        decades=float(max(0.0, np.log10(max(fastest, 1e-9) / max(slowest, noise, 1e-9)))),
        strongest=strongest,
        levels=_levels(tau, motion.rate) if driven else (),
        work=0.0 if passive else float(np.sum((tau * nu)[known]) * dt),
        both_directions=bool(min((nu[known] > floor).sum(), (nu[known] < -floor).sum()) * dt > HOLD),
        driven=float((known & ~quiet).sum() * dt),
        coasts=float((known & quiet & moving).sum() * dt),
        rests=float((known & quiet & ~moving).sum() * dt),
        excited=bool(fastest > floor and (driven or passive)),
    )


def _strong(values: Array, least: float) -> float:
    """95th percentile of the values above `least`; of all where none is."""
    above = values[values > least]
    return float(np.percentile(above if len(above) else values, 95.0))


def _levels(tau: Array, rate: float) -> tuple[float, ...]:
    """Wrenches that stay within a thirtieth of the strongest for `HOLD` seconds, without zero; at most twelve."""
    most = float(np.nanmax(np.abs(tau)))
    n = max(2, round(HOLD * rate))
    if most == 0.0 or len(tau) < n:
        return ()
    windows = np.lib.stride_tricks.sliding_window_view(tau, n)
    held = np.sort(np.mean(windows[np.ptp(windows, axis=-1) < most / 30.0], axis=-1))
    if not len(held):
        return ()
    groups = np.split(held, np.flatnonzero(np.diff(held) > most / 15.0) + 1)
    levels = [float(np.median(group)) for group in groups if abs(np.median(group)) > QUIET * most]
    return tuple(levels) if len(levels) <= 12 else ()


def work_findings(reports: list[AxisReport], motion: Motion, named: tuple[str, ...]) -> list[Finding]:
    """Axes on which the inputs took energy out, where drag should have: a sign is wrong.

    On roll and pitch the restoring moment gives back what it took; along heave the weight does work too.
    """
    found = []
    for i, report in enumerate(reports):
        both = np.isfinite(motion.nu[:, i]) & np.isfinite(motion.tau[:, i])
        effort = float(np.sum(np.abs(motion.tau[both, i] * motion.nu[both, i])) / motion.rate)
        if not report.excited or effort == 0.0 or report.axis in ("roll", "pitch"):
            continue
        ratio = report.work / effort
        if ratio < -0.4:
            held = np.abs(motion.tau[both, i]) > QUIET * report.strongest
            sure = report.axis in named or (not named and held.sum() / motion.rate > LONG_PUSH)
            found.append(
                Finding(
                    "refused" if sure and ratio < -0.6 and report.axis != "heave" else "care",
                    f"the inputs take {-report.work:.3g} J out of {report.axis}: {TAU[i]} runs against {NU[i]}: one "
                    "has the wrong sign, or something else drove the vehicle",
                )
            )
    return found
