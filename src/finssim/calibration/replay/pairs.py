"""A recorded trial beside what the models made of it, on one grid of times; its excited axes, phases and onset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.findings import Finding
from finssim.calibration.trials.trial import NU, Array
from finssim.vehicles.vehicle import AXES, Axis

__all__ = ["RESPONSES", "UNITS", "Pair", "excited_axes", "find_phases", "models_of", "onset", "resampled"]

RESPONSES = (*NU, "roll", "pitch", "depth")
"""What is compared: body velocities, and attitude and depth where they were measured."""

UNITS = {
    **dict.fromkeys("uvw", "m/s"),
    **dict.fromkeys("pqr", "rad/s"),
    "roll": "rad",
    "pitch": "rad",
    "depth": "m",
}
"""Response -> unit."""

EXCITED = 0.3
"""An axis counts as excited where its input reaches this share of that of the most excited axis."""

ONSET = 0.1
"""The input has begun, and has ended, where it is this share of its greatest magnitude."""


@dataclass(frozen=True, kw_only=True)
class Pair:
    """One trial and its replays. All arrays are over the same n times; numbers that are not there are NaN."""

    name: str
    sha256: str
    t: Array
    """Since the trial's first sample [s], uniform, (n,)."""
    t0: float = 0.0
    """The trial's first sample on its own clock [s]."""
    rate: float
    """[1/s]"""
    axes: tuple[Axis, ...]
    """Which the trial excites; scored."""
    phase: NDArray[np.str_]
    """Words of `PHASES`, (n,)."""
    tau: Array
    """Wrench that acted, from the log, about the vehicle's `wrench_reference` [N, N m], (n, 6)."""
    measured: dict[str, Array]
    """Response (of `RESPONSES`) -> (n,); velocities and angles smoothed as for a fit."""
    raw: dict[str, Array] = field(default_factory=dict)
    """The same as it was measured; only where it was."""
    source: dict[str, str] = field(default_factory=dict)
    """Response -> "measured", or what it was derived from."""
    noise: dict[str, float] = field(default_factory=dict)
    """Response -> standard deviation of the noise of one measured sample, in its unit."""
    simulated: dict[str, dict[str, Array]] = field(default_factory=dict)
    """Model -> response -> (n,)."""
    applied: dict[str, Array] = field(default_factory=dict)
    """Model -> wrench that the simulation applied, as `tau`, (n, 6)."""
    segment: NDArray[np.int64] | None = None
    """Which uninterrupted replay a sample belongs to, -1 for none, (n,); None for a single one."""
    diverged: dict[str, float] = field(default_factory=dict)
    """Model -> time when its simulation stopped being finite [s]; only where it did."""
    late: dict[str, float] = field(default_factory=dict)
    """Model -> by how much the recorded motion lags the recorded commands beyond the model's motors [s], for which the
    comparison allows; only where it shows."""
    in_sample: bool = False
    """Whether the vehicle was fitted on this very trial."""
    findings: tuple[Finding, ...] = ()

    def response(self, axis: Axis) -> str:
        """The velocity of an axis: `u` of surge."""
        return NU[AXES.index(axis)]

    def scored(self) -> NDArray[np.bool_]:
        """Samples that a score of the whole trial covers: excitation and coast; all where there is neither, (n,)."""
        inside = np.isin(self.phase, ("excitation", "coast"))
        return inside if inside.any() else np.ones(len(self.t), dtype=bool)


def excited_axes(tau: Array, limits: Array, named: Sequence[Axis] = ()) -> tuple[Axis, ...]:
    """The axes that a trial excites.

    Args:
        tau: Wrench about the vehicle's `wrench_reference` [N, N m], (n, 6).
        limits: `Vehicle.wrench_limits` [N, N m], (6,): what counts as much on each axis; 0 where the thrusters have
            no hold on an axis.
        named: What the header says; taken as it is where it says anything.

    Returns:
        In canonical order; empty where there is no input (a passive trial, thrusters off).
    """
    if named:
        return tuple(axis for axis in AXES if axis in named)
    # A vehicle without a limit on an axis can still be towed or pushed there: count it against 1 N or 0.1 N m of arm.
    scale = np.where(
        limits > 0.0, limits, max(float(limits.max(initial=0.0)), 1.0) * np.repeat([1.0, 0.1], 3)
    )
    share = np.sqrt(np.nanmean(np.square(tau / scale), axis=0)) if len(tau) else np.zeros(6)
    most = float(share.max(initial=0.0))
    return tuple(a for a, x in zip(AXES, share, strict=True) if most > 1e-9 and x >= EXCITED * most)


def find_phases(
    t: Array, tau: Array, axes: Sequence[Axis], named: NDArray[np.str_] | None = None
) -> NDArray[np.str_]:
    """Phase of every sample: as the log names it, else found from the input of the excited axes.

    Excitation lasts from the first to the last time that the input is above a tenth of its greatest magnitude; before
    it is baseline, after it coast. Without input there is only coast.

    Args:
        t: [s], (n,).
        tau: Wrench [N, N m], (n, 6).
        axes: The excited axes.
        named: Phases of the log, (n,), or None.

    Returns:
        Words of `PHASES`, (n,).
    """
    if named is not None and np.isin(named, ("excitation", "coast")).any():
        return named.astype("<U10")
    phase = np.full(len(t), "coast", dtype="<U10")
    active = np.flatnonzero(_active(tau, axes))
    if len(active):
        phase[: active[0]] = "baseline"
        phase[active[0] : active[-1] + 1] = "excitation"
    return phase


def onset(pair: Pair, axis: Axis) -> int | None:
    """Index of the sample where the input of an axis first reaches a tenth of its greatest magnitude."""
    active = np.flatnonzero(_active(pair.tau, (axis,)))
    return int(active[0]) if len(active) else None


def _active(tau: Array, axes: Sequence[Axis]) -> NDArray[np.bool_]:
    """Where the input of one of the axes is above a tenth of its greatest magnitude there, (n,)."""
    magnitude = np.abs(np.nan_to_num(tau[:, [AXES.index(a) for a in axes]]))
    greatest = magnitude.max(axis=0, initial=0.0)
    return np.asarray(((magnitude >= ONSET * greatest) & (greatest > 0.0)).any(axis=1))


def models_of(pairs: Sequence[Pair]) -> tuple[str, ...]:
    """The replayed models, in their order."""
    found: Mapping[str, None] = {model: None for pair in pairs for model in pair.simulated}
    return tuple(found)


def resampled(t: Array, values: Array, wanted: Array) -> Array:
    """Linear interpolation that leaves holes holes: NaN where a neighbour is, or is far, or there is none."""
    if values.ndim == 2:
        return np.stack([resampled(t, column, wanted) for column in values.T], axis=-1)
    good = np.isfinite(values)
    if not good.any():
        return np.full(len(wanted), np.nan)
    t, values = t[good], values[good]
    out = np.interp(wanted, t, values, left=np.nan, right=np.nan)
    right = np.clip(np.searchsorted(t, wanted), 0, len(t) - 1)
    left = np.maximum(np.searchsorted(t, wanted, side="right") - 1, 0)
    usual = float(np.median(np.diff(t))) if len(t) > 1 else np.inf
    out[t[right] - t[left] > max(3.0 * usual, 0.1)] = np.nan
    return np.asarray(out)
