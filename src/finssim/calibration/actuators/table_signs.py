"""The signs of speeds and forces in a table, and the zero of its load cell."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.actuators.table_columns import Source
from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, finding

__all__ = ["STANDING", "check_pulses", "signed", "without_offset"]

Array = NDArray[np.float64]

STANDING = 0.01
"""Share of the fastest speed below which a shaft counts as standing."""


def without_offset(
    full: dict[str, Array], speed_known: bool, neutral: float, findings: list[Finding]
) -> Array:
    """Forces less the median reading at standstill."""
    force = full["force"]
    if speed_known:
        standing = np.abs(full["speed"]) <= STANDING * np.nanmax(np.abs(full["speed"]))
    else:
        standing = np.abs(full["pulse"] - neutral) <= 0.02 * neutral / 3.0
    if not np.any(standing):
        return force
    offset = float(np.median(force[standing]))
    if abs(offset) < 1e-3 * np.max(np.abs(force)):
        return force
    findings.append(finding("load_cell_offset", offset=offset))
    return force - offset


def check_pulses(pulse: Array, shown: str) -> None:
    """Refuse pulses that are no microseconds.

    Args:
        pulse: Of the motor controller [µs], (n,); NaN and 0 are passed over.
        shown: Name of the table, for messages.

    Raises:
        CalibrationError: A pulse is outside 500 to 2500 µs.
    """
    known = pulse[np.isfinite(pulse) & (pulse != 0.0)]
    if known.size and (known.min() < 500.0 or known.max() > 2500.0):
        raise CalibrationError(
            f"{shown}: pulses run from {known.min():g} to {known.max():g} µs, expected 500 to 2500 µs: give the right "
            "column or unit, pulse=COLUMN=UNIT"
        )


def signed(
    full: dict[str, Array],
    speed_known: bool,
    neutral: float,
    sources: Mapping[str, Source],
    shown: str,
    findings: list[Finding],
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Speed and force with the sign of rotation, and the rows whose sign is known."""
    speed, force, pulse = full["speed"], full["force"], full["pulse"]
    small = STANDING * np.max(np.abs(force))
    sign_pulse = np.sign(pulse - neutral) if np.any(np.isfinite(pulse)) else np.zeros_like(force)
    force_signed = bool(np.any(force > small) and np.any(force < -small))
    if sign_pulse.any() and np.nanmin(sign_pulse) < 0 < np.nanmax(sign_pulse) and not force_signed:
        findings.append(finding("force_sign", source="pulse"))
        force, force_signed = np.abs(force) * np.nan_to_num(sign_pulse), True
    if not speed_known:
        _same_way(sign_pulse, force, small, ("pulse", "force"), sources, shown)
        return speed, force, np.ones(force.shape, bool)
    fastest = np.max(np.abs(speed))
    turning = np.abs(speed) > STANDING * fastest
    if np.any(speed < -STANDING * fastest) and np.any(speed > STANDING * fastest):
        if not force_signed and not sign_pulse.any():
            findings.append(finding("force_sign", source="speed"))
            force = np.abs(force) * np.sign(speed)
        _same_way(np.sign(speed) * turning, force, small, ("speed", "force"), sources, shown)
        return speed, force, np.ones(force.shape, bool)
    sign = np.where(
        np.isfinite(sign_pulse) & (sign_pulse != 0.0), sign_pulse, np.sign(force) * (np.abs(force) > small)
    )
    if np.any(sign < 0.0):
        findings.append(finding("speed_sign"))
    if sign_pulse.any():
        _same_way(sign_pulse, force, small, ("pulse", "force"), sources, shown)
    keep = ~turning | (sign != 0.0)
    if not keep.all():
        findings.append(finding("rows_unsigned", rows=np.count_nonzero(~keep)))
    return np.abs(speed) * np.where(turning, sign, 1.0), force, keep


def _same_way(
    sign: Array, force: Array, small: float, names: tuple[str, str], sources: Mapping[str, Source], shown: str
) -> None:
    """Refuse a table in which most forces point against the speed or pulse."""
    clear = (np.abs(force) > 5.0 * small) & (np.nan_to_num(sign) != 0.0)
    against = np.count_nonzero(np.sign(force[clear]) != sign[clear])
    if against > 0.5 * np.count_nonzero(clear):
        header = sources[names[1]].header if names[1] in sources else names[1]
        raise CalibrationError(
            f"{shown}: {names[1]} is negative where {names[0]} is positive: say which of them to turn, such as "
            f"{names[1]}=-{header}"
        )
