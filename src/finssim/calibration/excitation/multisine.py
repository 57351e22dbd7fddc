"""Multi-sines: all axes at once, each with frequencies of its own, for fits of coupled dynamics."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.excitation.programmes import RATE, Programme
from finssim.calibration.excitation.travel import within
from finssim.control.allocation import Allocator
from finssim.quiet import start_warp
from finssim.vehicles import AXES, Vehicle
from finssim.vehicles.vehicle import Axis

__all__ = ["multisine"]

Array = NDArray[np.float64]

DRAWS = 30
"""Random phases tried; those with the lowest peaks are taken."""


def multisine(
    peaks: Mapping[Axis, float],
    vehicle: Vehicle,
    *,
    index: int = 1,
    seed: int = 0,
    duration: float = 60.0,
    band: tuple[float, float] = (0.05, 1.0),
    room: float | None = None,
) -> Programme:
    """One programme that drives several axes with interleaved harmonics of 1/duration.

    tau_i(t) = a_i Σ_k k^(-1/2) cos(2π k t / duration + φ_k),   k = i-th, (i+n)-th, ... harmonic in the band

    No two axes share a frequency, so their responses can be told apart; amplitudes fall with the root of frequency, so
    that both speeds (damping) and accelerations (mass) are excited. Phases are the random ones, of a few draws, with
    the lowest peaks.

    Args:
        peaks: Axis -> largest wrench [N, N m]; all are scaled down together until the thrusters can give the sum.
        vehicle: Whose thrusters and damping count.
        index: Number in the name.
        seed: Of the phases.
        duration: Of the excitation [s].
        band: Lowest and highest frequency [Hz].
        room: Longest way along a linear axis, by the damping of the vehicle's file [m]; no bound if None.

    Raises:
        CalibrationError: The band is too narrow for so many axes in this time, or too fast for the commands.
    """
    low, high = band
    if not (0.0 < low < high <= 0.2 * RATE):
        raise CalibrationError(
            f"band is {low:g} to {high:g} Hz, expected rising, above 0 and up to {0.2 * RATE:g} Hz"
        )
    harmonics = np.arange(math.ceil(low * duration - 1e-9), math.floor(high * duration + 1e-9) + 1)
    if len(harmonics) < 3 * len(peaks):
        raise CalibrationError(
            f"{len(harmonics)} frequencies between {low:g} and {high:g} Hz in {duration:g} s are too few for "
            f"{len(peaks)} axes: give a longer duration or a wider band"
        )
    rng = np.random.default_rng(seed)
    t = np.arange(round(duration * RATE)) / RATE
    tau = np.zeros((len(t), 6))
    for i, (axis, peak) in enumerate(peaks.items()):
        shape = _lowest_peak(harmonics[i :: len(peaks)], t / duration, rng)
        tau[:, AXES.index(axis)] = peak * shape / np.abs(shape).max()
        if room is not None and AXES.index(axis) < 3:
            tau[:, AXES.index(axis)] *= within(room, tau[:, AXES.index(axis)], RATE, axis, vehicle)
    tau *= _feasible(tau, vehicle)
    parts = (("rest", 50), ("baseline", 50), ("excitation", len(t)), ("coast", 100), ("rest", 50))
    phase = np.concatenate([np.full(count, word) for word, count in parts])
    full = np.zeros((len(phase), 6))
    full[phase == "excitation"] = tau
    return Programme(name=f"multisine_{index}", axes=tuple(peaks), rate=RATE, tau_desired=full, phase=phase)


def _lowest_peak(harmonics: NDArray[np.int64], turns: Array, rng: np.random.Generator) -> Array:
    """The sum of cosines whose random phases give the lowest peak."""
    amplitude = harmonics**-0.5
    best = None
    for _ in range(DRAWS):
        phases = rng.uniform(0.0, 2.0 * math.pi, len(harmonics))
        wave = np.cos(2.0 * math.pi * turns[:, None] * harmonics + phases) @ amplitude
        if best is None or np.abs(wave).max() < np.abs(best).max():
            best = wave
    assert best is not None
    return np.asarray(best)


def _feasible(tau: Array, vehicle: Vehicle) -> float:
    """Largest factor up to 1 at which the thrusters give the whole wrench at every time."""
    start_warp()
    allocator = Allocator.from_vehicle(vehicle)
    weights = np.where(vehicle.wrench_limits > 0.0, 1.0 / np.maximum(vehicle.wrench_limits, 1e-9), 0.0)

    def given(factor: float) -> bool:
        thrust, _ = allocator.allocate(factor * tau)
        missing = np.abs(allocator.achieved(thrust) - factor * tau) * weights
        return bool(missing.max() < 2e-3)

    low, high = 0.0, 1.0
    if given(high):
        return high
    for _ in range(10):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if given(middle) else (low, middle)
    return low
