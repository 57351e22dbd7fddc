"""What a trial tells of an axis, parameter by parameter, and why not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from finssim.calibration.check.report import AxisReport, Told
from finssim.calibration.motion.signals import Motion
from finssim.calibration.trials.columns import NU
from finssim.calibration.trials.inputs import Drive
from finssim.vehicles import AXES, Vehicle

__all__ = ["with_tells"]

SEPARATE = 0.6
"""Decades of speed that linear and quadratic damping need to be told apart."""

LEAST_TILT = np.radians(1.0)
"""Standard deviation of an angle that its restoring moment needs [rad]."""

SHORT = 0.5
"""Time over which a change of speed is looked for [s]."""

LEAST_INERTIA = 0.05
"""Part of the strongest wrench that went into a change of speed, for the effective mass to be seen."""

SLOW = 8.0
"""Rate below which a motor's lag lies between two samples [Hz]."""


def with_tells(report: AxisReport, motion: Motion, inputs: Drive, vehicle: Vehicle) -> AxisReport:
    """The report with what the axis tells."""
    wanted = ["m_eff", "d1", "d2", "bias"]
    wanted += ["k"] if report.axis in ("roll", "pitch") else []
    wanted += ["thrust_scale", "thrust_lag"]
    wanted += ["buoyancy"] if report.axis == "heave" else []
    blocked = _blocked(report, inputs)
    if blocked:
        return replace(report, tells={name: Told(can=False, why=blocked) for name in wanted})
    by_name = {
        "m_eff": _m_eff(report, motion, inputs, vehicle),
        **_damping(report, inputs),
        "bias": _bias(report, inputs),
        "k": _k(report, motion, inputs),
        "thrust_scale": _thrust_scale(report, inputs),
        "thrust_lag": _thrust_lag(inputs),
        "buoyancy": _buoyancy(report, inputs),
    }
    return replace(report, tells={name: by_name[name] for name in wanted})


def _blocked(report: AxisReport, inputs: Drive) -> str:
    """Why the axis tells nothing at all, or nothing."""
    if not report.source:
        return _no_velocity(report.axis)
    if not np.isfinite(report.fastest):
        return "velocity and input are never known together"
    if report.excited and inputs.source != "passive" and report.coasts > 10.0 * report.driven:
        return f"driven for {report.driven:.1f} s and moving for {report.coasts:.0f} s without: something else moves it"
    if report.excited:
        return ""
    if inputs.source != "passive" and report.strongest < 1e-6:
        return "not driven"
    if report.fastest <= max(3.0 * report.noise, 0.005):
        return f"no motion above the noise: speeds up to {report.fastest:.2g}, noise {report.noise:.2g}"
    return f"moves, but is hardly driven: wrench up to {report.strongest:.2g}"


def _no_velocity(axis: str) -> str:
    column = dict(zip(map(str, AXES), NU, strict=True))[axis]
    other = {
        "surge": " nor x, y with a heading",
        "sway": " nor x, y with a heading",
        "heave": ", z or depth",
        "roll": " nor an attitude",
        "pitch": " nor an attitude",
        "yaw": " nor a heading",
    }[axis]
    return (
        f"no velocity: neither {column}{other}"
        if not other.startswith(",")
        else f"no velocity: no {column}{other}"
    )


def _m_eff(report: AxisReport, motion: Motion, inputs: Drive, vehicle: Vehicle) -> Told:
    i = AXES.index(report.axis)
    if inputs.source == "passive":
        return _relative(report.axis)
    n = max(1, round(SHORT * motion.rate))
    change = np.abs(motion.nu[n:, i] - motion.nu[:-n, i])
    fastest = float(np.nanmax(change)) if np.isfinite(change).any() else 0.0
    impulse = float(vehicle.rigid_body_mass_matrix()[i, i]) * fastest
    if impulse < LEAST_INERTIA * report.strongest * SHORT or fastest < 3.0 * report.noise:
        return Told(can=False, why="speeds hardly change: steps, pulses or coasts are missing")
    return Told(can=True, why=f"acceleration from {motion.nu_dot_source[i] or 'the velocity'}")


def _relative(axis: str) -> Told:
    if axis in ("roll", "pitch"):
        return Told(can=True, why="passive: relative to the vehicle file's restoring moment")
    if axis == "heave":
        return Told(can=True, why="passive: relative to the vehicle file's buoyancy excess")
    return Told(can=False, why="passive, and no force along this axis is known: d1/m_eff and d2/m_eff alone")


def _damping(report: AxisReport, inputs: Drive) -> dict[str, Told]:
    decades = f"{report.decades:.1f} decades of speed up to {report.fastest:.2g}"
    if report.decades < SEPARATE:
        one = f"{decades}: only their sum at that speed; more levels or a coast would part them"
        return {"d1": Told(can=False, why=one), "d2": Told(can=False, why=one)}
    short = "" if report.decades >= 1.0 else ", less than one: intervals will be wide"
    return {"d1": Told(can=True, why=decades + short), "d2": Told(can=True, why=decades + short)}


def _bias(report: AxisReport, inputs: Drive) -> Told:
    if inputs.source == "passive":
        return Told(can=False, why="passive: goes with the force that moves it")
    if report.both_directions:
        return Told(can=True, why="driven both ways")
    if report.rests >= 1.0:
        return Told(can=True, why=f"{report.rests:.1f} s of rest")
    return Told(can=False, why="one direction and no rest: goes with d1")


def _k(report: AxisReport, motion: Motion, inputs: Drive) -> Told:
    if inputs.source == "passive":
        return Told(can=False, why="passive: sets the scale of the others")
    q = motion.quaternion
    known = np.isfinite(q).all(axis=1)
    if known.sum() < 10:
        return Told(can=False, why="no roll and pitch")
    spread = float(np.std(2.0 * q[known, 0 if report.axis == "roll" else 1]))  # small angles about the mean
    if spread < LEAST_TILT:
        return Told(can=False, why=f"{report.axis} angle varies by {np.degrees(spread):.2g}° only")
    return Told(can=True, why=f"{report.axis} angle varies by {np.degrees(spread):.2g}°")


def _thrust_scale(report: AxisReport, inputs: Drive) -> Told:
    if inputs.source == "passive":
        return Told(can=False, why="passive: no thrust")
    if report.axis in ("heave", "roll", "pitch"):
        return Told(can=True, why="against the weight and centres of the vehicle file, if those are right")
    return Told(can=False, why="goes with m_eff, d1, d2: doubling all of them changes nothing")


def _thrust_lag(inputs: Drive) -> Told:
    if inputs.source == "passive":
        return Told(can=False, why="passive: no thrust")
    if not inputs.commanded:
        return Told(can=False, why="the inputs are what acted, after the lag")
    rate = 1.0 / float(np.median(np.diff(inputs.t)))
    if rate < SLOW:
        return Told(can=False, why=f"inputs at {rate:.2g} Hz: a lag lies between two samples")
    return Told(can=True, why=f"commands at {rate:.3g} Hz, by simulation")


def _buoyancy(report: AxisReport, inputs: Drive) -> Told:
    if inputs.source == "passive":
        return Told(can=False, why="passive: sets the scale of the others")
    if report.coasts >= 1.0 or report.rests >= 1.0 or report.both_directions:
        what = f"{report.coasts:.1f} s of coasting" if report.coasts >= 1.0 else "driven both ways or at rest"
        return Told(can=True, why=what)
    return Told(can=False, why="one direction and no coast: goes with d1; dive and coast")
