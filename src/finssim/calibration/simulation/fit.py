"""Hydrodynamics by simulation error: numbers with which the simulator, driven as the vehicle was, moves as it did."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, finding
from finssim.calibration.fit import Fit
from finssim.calibration.regression.selection import AKAIKE, DAMPING
from finssim.calibration.simulation.estimates import estimates
from finssim.calibration.simulation.excited import excited, observable, speeds, telling
from finssim.calibration.simulation.parameters import EXTRAS
from finssim.calibration.simulation.report import Clock
from finssim.calibration.simulation.segments import Streams, streams
from finssim.calibration.simulation.stages import Stages
from finssim.calibration.trials.fittable import require_axes, require_fittable
from finssim.calibration.trials.trial import Trial
from finssim.vehicles import AXES, HydrodynamicSet, Vehicle

__all__ = ["ESTIMATE", "fit_by_simulation"]

Progress = Callable[[float, str], None]

ESTIMATE = (*EXTRAS, "bias", "trial_bias")
"""Words for `estimate`; `trial_bias` gives every trial a bias of its own, as a tether does."""


def fit_by_simulation(
    trials: Sequence[Trial],
    vehicle: Vehicle,
    *,
    axes: Sequence[str] | None = None,
    full: bool = False,
    estimate: Sequence[str] = (),
    damping: str = "auto",
    horizon: float | None = None,
    seed: int = 0,
    start: Fit | None = None,
    progress: Progress | None = None,
) -> Fit:
    """Fit by simulation error over all trials at once.

    Trials are cut into segments with an initial state each; Levenberg-Marquardt moves the parameters, the initial
    states, offsets of the sensors and lags of their streams, with derivatives from parallel worlds. All numbers hold at
    the reference point of the vehicle's calibrated set.

    Args:
        trials: Of any inputs, rates and measured columns.
        vehicle: Gives the rigid body, the motors and everything that is not fitted.
        axes: Axes to fit; those that the trials excite if None.
        full: Also couplings of these axes: symmetric added mass, full damping.
        estimate: Words of `ESTIMATE`, and parameters of the vehicle's terms, such as `lift.coefficient`. Buoyancy comes
            with heave, stiffness with roll and pitch, a bias with the others.
        damping: `auto`, `linear`, `quadratic` or `both`.
        horizon: Length of the segments [s]; from the data if None.
        seed: Of the coarse search.
        start: A fit to begin from, such as that of a regression.
        progress: Called with the part done and a few words.

    Returns:
        After Ctrl-C the best until then, with `interrupted`.

    Raises:
        CalibrationError: No trial can be used, one is held out, or a word is unknown.
    """
    _check(trials, vehicle, axes, damping, estimate)
    prepared = [streams(trial, vehicle) for trial in trials]
    chosen, remarks = _axes(prepared, vehicle, axes)
    say = Clock(progress)
    fit = Stages(
        telling(prepared, vehicle, chosen), vehicle, chosen, tuple(estimate), horizon, start, seed, say
    )
    kinds = dict.fromkeys(chosen, "both" if damping == "auto" else damping)
    stage = fit.first(kinds)
    wider: dict[str, tuple[float, float]] = {}
    dropped: dict[str, str] = {}
    if damping == "auto" and not stage.solution.interrupted:
        first, p_value, _ = estimates(
            stage.problem.parameters, stage.x, stage.found, axes=chosen, own_error=fit.own_error
        )
        kinds, dropped = _select(kinds, p_value, prepared)
        if dropped:
            wider = {name: e.ci95 for name, e in first.items()}
            stage = fit.next(kinds, stage)
    if full and len(chosen) > 1 and not stage.solution.interrupted:
        stage = fit.next(kinds, stage, full=True)
    return fit.result(stage, wider, dropped, remarks, full=full, damping=damping)


def _check(
    trials: Sequence[Trial],
    vehicle: Vehicle,
    axes: Sequence[str] | None,
    damping: str,
    estimate: Sequence[str],
) -> None:
    require_fittable(trials)
    require_axes(axes)
    if damping not in DAMPING:
        raise CalibrationError(f"unknown damping '{damping}'; available: {', '.join(DAMPING)}")
    chosen = vehicle.hydrodynamics.get("calibrated")
    known = [*ESTIMATE, *(chosen.term_scalars if isinstance(chosen, HydrodynamicSet) else ())]
    for word in estimate:
        if word not in known:
            raise CalibrationError(
                f"cannot estimate '{word}'; available: {', '.join(known)}"
                + ("; a term's parameter only where the vehicle file has the term" if "." in word else "")
            )


def _axes(
    prepared: Sequence[Streams], vehicle: Vehicle, axes: Sequence[str] | None
) -> tuple[tuple[str, ...], list[Finding]]:
    """Axes to fit, and why some that were asked for are not."""
    moved, seen = excited(prepared, vehicle), observable(prepared)
    if axes is None:
        if not moved:
            raise CalibrationError(
                f"no trial excites an axis of {vehicle.name}: name the axes, or give trials with larger inputs"
            )
        return moved, []
    remarks = [finding("axis_untold", axis) for axis in axes if axis not in seen]
    remarks += [finding("axis_doubtful", axis) for axis in axes if axis in seen and axis not in moved]
    chosen = tuple(a for a in AXES if a in axes and a in seen)
    if not chosen:
        raise CalibrationError(f"nothing that tells of {', '.join(axes)} was measured in these trials")
    return chosen, remarks


def _select(
    kinds: dict[str, str], p_value: dict[str, float], prepared: Sequence[Streams]
) -> tuple[dict[str, str], dict[str, str]]:
    """Damping of each axis by Akaike's criterion, and what that leaves out."""
    new, dropped = dict(kinds), {}
    for axis in kinds:
        weak = [name for name in ("d1", "d2") if p_value[f"{axis}.{name}"] > AKAIKE]
        if weak:
            name = max(weak, key=lambda n: p_value[f"{axis}.{n}"])
            low, high = speeds([s.motion for s in prepared], axis)
            new[axis] = "quadratic" if name == "d1" else "linear"
            unit = "m/s" if AXES.index(axis) < 3 else "rad/s"
            dropped[f"{axis}.{name}"] = (
                f"not distinguishable from zero at speeds of {low:.2g}-{high:.2g} {unit}"
            )
    return new, dropped
