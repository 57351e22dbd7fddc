"""Velocity and position in ArduSub logs: what the autopilot estimates, and what a DVL or camera told it."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.importers.ardupilot_log import Log
from finssim.calibration.importers.assemble import in_our_axes
from finssim.calibration.importers.source_map import Frame
from finssim.calibration.importers.streams import Stream

__all__ = ["VELOCITY_KINDS", "velocity_stream"]

FRD = Frame(body="FRD", world="NED")

VELOCITY_KINDS = frozenset(
    (
        "XKF1",
        "NKF1",
        "XKF4",
        "NKF4",
        "VISO",
        "LOCAL_POSITION_NED",
        "EKF_STATUS_REPORT",
        "VISION_POSITION_DELTA",
    )
)

HORIZONTAL_VELOCITY, RELATIVE_POSITION, ABSOLUTE_POSITION, STANDING_STILL = 2, 8, 16, 128
"""Flags of the filter's state; the last says that it assumes a constant position, for it has no measurement of one."""

ESTIMATES = {
    "XKF1": ("XKF4", "SS", ("VN", "VE", "VD", "PN", "PE", "PD")),
    "NKF1": ("NKF4", "SS", ("VN", "VE", "VD", "PN", "PE", "PD")),
    "LOCAL_POSITION_NED": ("EKF_STATUS_REPORT", "flags", ("vx", "vy", "vz", "x", "y", "z")),
}
"""Kind of message -> the one of its filter's state, the field of that, and the fields of velocity and position."""

LEAST_USABLE = 0.2
"""Part of the estimates that must rest on a measurement of position or velocity."""


def velocity_stream(log: Log, asked: Literal["auto", "ekf", "vision", "none"]) -> Stream | None:
    """Velocity from position deltas if there are any, else velocity and position from the autopilot's estimate.

    The estimate is left out where the filter had no measurement of horizontal position or velocity: what it says then
    is that the vehicle stands still.
    """
    if asked == "none":
        return None
    if asked in ("auto", "vision"):
        deltas = _position_deltas(log)
        if deltas is not None or asked == "vision":
            return deltas
    return _estimate(log)


def _position_deltas(log: Log) -> Stream | None:
    """Position deltas over the time they took, body frame."""
    if log.has("VISO"):
        kind, dt = "VISO", log.numbers("VISO", "dt")
        delta = np.stack([log.numbers(kind, f"PosD{axis}") for axis in "XYZ"], axis=-1)
    elif log.has("VISION_POSITION_DELTA"):
        kind = "VISION_POSITION_DELTA"
        dt = 1e-6 * log.numbers(kind, "time_delta_usec")
        delta = np.array([message["position_delta"] for message in log.messages[kind]], dtype=float)
    else:
        return None
    good = dt > 1e-3
    velocity = np.where(good[:, None], delta / np.where(good, dt, 1.0)[:, None], np.nan)
    # A delta is the mean over the time before its stamp.
    stream = Stream(
        source=f"{log.shown} {kind}",
        t=log.times[kind] - 0.5 * np.where(good, dt, 0.0),
        channels=dict(zip("uvw", velocity.T, strict=True)),
        notes=(f"u v w from {kind}, at the sensor: give velocity_at if it is not at the body origin",),
    )
    return in_our_axes(stream, FRD)


def _estimate(log: Log) -> Stream | None:
    kind = next((kind for kind in ESTIMATES if log.has(kind)), None)
    if kind is None:
        return None
    status, flag_name, names = ESTIMATES[kind]
    first_core = log.some(kind, "C", 0).some(status, "C", 0)
    flags = _held(first_core, status, flag_name, first_core.times[kind])
    moving = (flags & HORIZONTAL_VELOCITY > 0) & (flags & STANDING_STILL == 0)
    source = f"{log.shown} {kind}"
    if moving.mean() < LEAST_USABLE:
        note = (
            f"the velocity of {kind} is left out: in {1.0 - moving.mean():.0%} of it the autopilot had no measurement "
            "of horizontal velocity or position"
        )
        return Stream(source=source, t=first_core.times[kind], notes=(note,))
    placed = moving & (flags & (RELATIVE_POSITION | ABSOLUTE_POSITION) > 0)
    values = [first_core.numbers(kind, name) for name in names]
    channels = {c: np.where(moving, v, np.nan) for c, v in zip(("vx", "vy", "vz"), values[:3], strict=True)}
    if placed.any():
        channels |= {c: np.where(placed, v, np.nan) for c, v in zip("xyz", values[3:], strict=True)}
    note = f"u v w from {kind}, an estimate by the autopilot's filter: smoother and later than a measurement"
    return in_our_axes(Stream(source=source, t=first_core.times[kind], channels=channels, notes=(note,)), FRD)


def _held(log: Log, kind: str, name: str, t: NDArray[np.float64]) -> NDArray[np.int64]:
    """A field of flags at other times, each held until the next; all usable where the log has none."""
    if not log.has(kind):
        return np.full(len(t), HORIZONTAL_VELOCITY | RELATIVE_POSITION)
    held = np.searchsorted(log.times[kind], t, side="right") - 1
    return log.numbers(kind, name).astype(np.int64)[np.maximum(held, 0)]
