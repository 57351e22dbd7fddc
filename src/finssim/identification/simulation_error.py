"""Identification of hydrodynamics by simulation error: the parameters for which the simulated motion fits the
measured one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.identification.confidence import Stage
from finssim.identification.drag_shape import DragShape, averaged, is_drag_known
from finssim.identification.estimates import (
    CERTAIN,
    AxisResult,
    Number,
    axis_result,
    changes,
    derived,
    numbers_of,
    other_estimates,
    terminal_speed,
)
from finssim.identification.excitation import SWINGING, excited, exciting_trials, observable, speeds
from finssim.identification.fit import Estimate, Fit
from finssim.identification.judgement import fit_findings, held_out, pictures, quality, unexplained
from finssim.identification.next_dive import next_dive
from finssim.identification.parameters import EXTRAS, actuator_fields
from finssim.identification.plant_terms import matrices
from finssim.identification.rollout import Streams, released, streams
from finssim.identification.stages import STEP, FitProgress, Stages
from finssim.identification.uncertainty import degeneracy, releases_disagree
from finssim.trials.findings import CalibrationError, Finding, finding
from finssim.trials.inputs import no_input, require_axes, require_fittable
from finssim.trials.trial import Trial
from finssim.vehicles import AXES, HydrodynamicSet, Vehicle

__all__ = ["fit_by_simulation"]

Array = NDArray[np.float64]

EXPLAINED = 0.2
"""R² below which the model of an axis is rejected: at 0 it is no better than the mean of the measurements."""


def finished(
    fit: Stages,
    stage: Stage,
    shapes: Mapping[str, DragShape],
    remarks: list[Finding],
    damping: str,
    kinds: Mapping[str, str],
) -> Fit:
    """Return the finished fit, with the drag of `shapes`."""
    p, x = stage.problem.parameters, stage.x
    numbers = numbers_of(p, x, stage.found, fit.own_error)
    for axis, shape in shapes.items():
        numbers |= {
            f"{axis}.{n}": Number(v, ends)
            for n, v, ends in zip(("d1", "d2"), shape.value, shape.ends, strict=True)
        }
    figures = quality(stage.problem, stage.solution, fit.axes, fit.used)
    error = None
    if not stage.solution.interrupted:
        several = stage.found.evidence.unit == "trials" and not stage.found.covariance.alone.any()
        file = fit.problem(dict.fromkeys(fit.axes, "both"), {})
        scores, error = held_out(stage, file, fit.axes, several)
        for axis, (after, before) in scores.items():
            figures[axis] |= {"held_out": after, "file": before}
    others, held = other_estimates(p, numbers)
    found, axes, bounds = axis_results(fit, stage, shapes, numbers, figures, others)
    sources = {s.drive.source for s in fit.used}
    unmeasured = [axis for axis in p.unseen if axis not in observable(fit.prepared)]
    new = changes(p, x, found, axes, unmeasured=unmeasured, scaled=sources <= {"rpm", "pwm"})
    P, local = stage.problem.judged, stage.found.covariance.local
    correlation, traded = degeneracy(p.names[:P], local[:P, :P], stage.found.free[:P])
    left_out = [one.trial.name for one in fit.prepared if one not in fit.used]
    averages = [
        finding("drag_averaged", axis, shapes=", ".join(f"{n} {w:.2f}" for n, w in shape.weights.items()))
        for axis, shape in shapes.items()
    ]
    remarks = [
        *remarks,
        *fit.remarks,
        *averages,
        *(finding("trial_left_out", name) for name in left_out),
        *fit_findings(stage.problem, stage.solution, stage.found, fit.used, fit.trial_counts()),
        *bounds,
        *held,
        *traded,
    ]
    fit.say("done")
    return Fit(
        kind="hydrodynamics",
        method="simulation",
        before=fit.vehicle,
        estimates=found,
        changes=new,
        quality=figures,
        correlation=correlation,
        findings=tuple(dict.fromkeys(remarks)),
        curves=pictures(stage, fit.axes, error),
        trials={one.trial.name: one.trial.sha256 for one in fit.used},
        settings={
            "axes": list(fit.axes),
            "damping": damping,
            "drag": dict(kinds) | {axis: shape.weights for axis, shape in shapes.items()},
            "estimate": sorted(fit.extras),
            "fix": {f"{axis}.m": m for axis, m in fit.known.items()},
            "published": fit.published,
            "speeds": {a: round(figures[a]["speed_high"], 4) for a in fit.axes if a in figures},
            "horizon": round(fit.length, 3),
            "step": STEP,
            "segments": len(fit.segments),
            "iterations": stage.solution.iterations,
        },
        interrupted=stage.solution.interrupted,
    )


def axis_results(
    fit: Stages,
    stage: Stage,
    shapes: Mapping[str, DragShape],
    numbers: Mapping[str, Number],
    figures: Mapping[str, Mapping[str, float]],
    others: Mapping[str, Estimate],
) -> tuple[dict[str, Estimate], dict[str, Any], list[Finding]]:
    """Return all estimates, the changes of the vehicle by axis, and findings about them.

    Args:
        fit: Trials and settings of the fit.
        stage: Finished fit.
        shapes: Drag of each axis with averaged drag models.
        numbers: Parameter -> value and interval.
        figures: Axis -> quality of the fit, in the units of `Fit.quality`.
        others: Estimates that belong to no axis.
    """
    p, x, others = stage.problem.parameters, stage.x, dict(others)
    found, axes, bounds = dict[str, Estimate](), dict[str, Any](), list[Finding]()
    for axis in fit.axes:
        own = speeds([s.motion for s in fit.used], axis)
        # A coast shows drag at all speeds, and most accurately at medium ones.
        speed = float(np.sqrt(own[0] * own[1])) if stage.problem.coasts else own[1]
        known = is_drag_known(p, x, stage.found, axis, speed, shapes.get(axis))
        result = axis_result(p, x, numbers, axis, speeds=own, drag_known=known, given=fit.known.get(axis))
        reason = rejection_reason(fit, stage, axis, figures.get(axis, {}).get("r2", 1.0))
        if reason:
            result.believe_nothing(reason)
        if axis == "heave":
            others["buoyancy_excess"], said = buoyancy(fit, others["buoyancy_excess"], reason)
            result.findings += said
        found |= result.estimates
        if axis in fit.free:
            found |= result.estimates if reason else free_estimates(fit, stage, result)
        axes |= result.changes
        bounds += result.findings
    return found | others, axes, bounds


def rejection_reason(fit: Stages, stage: Stage, axis: str, r2: float) -> str:
    """Return the reason why the fit of an axis is not credible, or an empty text.

    Args:
        fit: Trials and settings of the fit.
        stage: Finished fit.
        axis: Name of the axis.
        r2: R² of the complete axis [-].
    """
    if r2 < EXPLAINED:
        return f"the model does not explain the motion of this axis: R² {r2:.2f}"
    worst, least = unexplained(stage.problem, stage.solution, axis, fit.used)
    if least < EXPLAINED:
        return (
            f"the model does not explain the motion of {worst}, R² {least:.2f}: fit its releases separately"
        )
    return ""


def buoyancy(fit: Stages, excess: Estimate, reason: str) -> tuple[Estimate, list[Finding]]:
    """Return the excess of buoyancy, not identifiable if it depends on an assumed mass, and contradicting findings.

    Args:
        fit: Trials and settings of the fit.
        excess: Estimate from the simulation.
        reason: Reason why the axis is not credible; empty if it is.
    """
    file = matrices(fit.vehicle).excess
    assumed = "heave" in fit.free and "heave" not in fit.known
    if not (assumed or reason):
        return excess, []
    note = reason or f"from the acceleration, {fit.notes['heave']}"
    low, high = excess.ci95
    said = [] if reason or low <= file <= high else [
        finding("buoyancy_contradicted", "heave", file=file, low=low, high=high)
    ]  # fmt: skip
    return replace(excess, identifiable=False, note=note), said


def free_estimates(fit: Stages, stage: Stage, result: AxisResult) -> dict[str, Estimate]:
    """Return the estimates of an axis that moved without thrust: ratios, and the others with their assumption."""
    axis, (_, top) = result.axis, result.speeds
    p, i, out = stage.problem.parameters, AXES.index(result.axis), dict[str, Estimate]()
    for name, e in result.estimates.items():
        # The equilibrium of a swing may be due to a misaligned sensor.
        sure = e.identifiable and not name.endswith(".bias")
        out[name] = replace(e, identifiable=sure, note="; ".join(filter(None, [e.note, fit.notes.get(axis)])))

    def plant(x: Array) -> tuple[float, float, float, float, float]:
        """Return m, d1, d2, k and the excess of buoyancy of a vector."""
        M_A, D1, D2 = (matrix[0, i, i] for matrix in p.matrices(x))
        file = matrices(fit.vehicle)
        k = p.value(x[None], "k", float(file.arm[2]))
        excess = p.value(x[None], "buoyancy_excess", file.excess)
        return float(p.M_RB[i, i] + M_A), float(D1), float(D2), float(np.max(k)), float(np.max(excess))

    def add(name: str, value: float, ends: tuple[float, float], unit: str, note: str = "") -> None:
        sure = bool(value > 0.0 and 0.5 * (ends[1] - ends[0]) <= CERTAIN * value)
        note = note or ("" if sure else "uncertain by more than a fifth of its value")
        name = f"{axis}.{name}"
        out[name] = Estimate(name, value, ends, unit, sure, note)

    def of(number: Callable[..., float]) -> tuple[float, tuple[float, float]]:
        return derived(stage, lambda x: number(*plant(x)), fit.own_error)

    if axis in SWINGING:
        rubbed = 8.0 / (3.0 * np.pi) * top
        add("natural_frequency", *of(lambda m, d1, d2, k, e: float(np.sqrt(k / m))), "rad/s")
        # The quadratic term is converted to the linear one that dissipates equal energy in the largest swing.
        ratio = of(lambda m, d1, d2, k, e: (d1 + rubbed * d2) / (2.0 * float(np.sqrt(k * m))))
        add("damping_ratio", *ratio, "-", f"at a swing of {top:.2g} rad/s")
    if axis == "heave":
        add("terminal_speed", *of(lambda m, d1, d2, k, e: terminal_speed(d1, d2, e)), "m/s", "of a rise")
        return out
    m = plant(stage.x)[0]
    for name, unit in (("d1", "1/s"), ("d2", "1/m" if i < 3 else "1/rad")):
        drag = result.estimates.get(f"{axis}.{name}")
        if drag is not None:
            add(f"{name}/m_eff", drag.estimate / m, (drag.ci95[0] / m, drag.ci95[1] / m), unit)
    return out


Progress = Callable[[float, str], None]


def fit_by_simulation(
    trials: Sequence[Trial],
    vehicle: Vehicle,
    *,
    axes: Sequence[str] | None = None,
    estimate: Sequence[str] = (),
    damping: str | Mapping[str, str] = "auto",
    known: Mapping[str, float] | None = None,
    horizon: float | None = None,
    likely: bool = False,
    published: Mapping[str, float] | None = None,
    design: bool = False,
    progress: Progress | None = None,
) -> Fit:
    """Fit by simulation error over all trials together.

    Trials are cut into segments with an initial state each; Levenberg-Marquardt adjusts the parameters, the
    initial states, offsets of the sensors and lags of their streams, with derivatives from parallel worlds.
    All numbers refer to the reference point of the vehicle's calibrated set.

    Args:
        trials: Trials with any inputs, rates and measured columns.
        vehicle: Vehicle with the rigid body, the motors and everything that is not fitted.
        axes: Axes to fit; those that the trials excite if None.
        estimate: Names from `EXTRAS`, parameters of the vehicle's terms, such as `lift.coefficient`, and of
            its actuators, such as `fin.lift_slope`, for which a factor is fitted. Buoyancy is included with
            heave, stiffness with roll and pitch, a bias with the others.
        damping: `auto`, `linear`, `quadratic` or `both`; or one of the last three by axis.
        known: Known effective inertias M_RB + M_A, by axis [kg, kg m²].
        horizon: Length of the segments [s]; from the data if None.
        likely: True if the thrust is only known from usual battery voltages; its scale is then fitted with
            that prior, and written to the file with the other numbers.
        published: `top_speed` [m/s] and `bollard_pull` [N], both ahead: data on drag and thrust.
        design: True to design the next dive.
        progress: Function that is called with the completed fraction and a short text.

    Returns:
        The fit; after Ctrl-C the best result so far, with `interrupted`.

    Raises:
        CalibrationError: No trial can be used, one is held out, or a word is unknown.
    """
    _check(trials, vehicle, axes, damping, estimate, horizon)
    say = FitProgress(progress)
    prepared, remarks = prepare(trials, vehicle, axes, lambda name: say(f"preparing {name}", 0.1))
    chosen, more = _axes(prepared, vehicle, axes)
    strange = [axis for axis in known or {} if axis not in chosen]
    if strange:
        raise CalibrationError(
            f"the inertia of {', '.join(strange)} was given, but the fitted axes are {', '.join(chosen)}"
        )
    remarks = [*remarks, *more]
    say("preparing the start", 0.1)
    estimate = [*estimate, "thrust_scale"] if likely else estimate
    exciting = exciting_trials(prepared, vehicle, chosen)
    fit = Stages(exciting, vehicle, chosen, estimate, known or {}, horizon, say, likely, published)
    fit.require_shown()
    if isinstance(damping, str):
        kinds = dict.fromkeys(chosen, "both" if damping == "auto" else damping)
    else:
        kinds = {axis: damping.get(axis, "both") for axis in chosen}
    stage = fit.rough(kinds, [{}, fit.weak_start])
    start = dict(zip(stage.problem.parameters.names, stage.x.tolist(), strict=True))
    if not stage.solution.interrupted:
        stage = fit.first(kinds, start)
    spun = stage.problem.coasts and "yaw" in fit.axes and not stage.solution.interrupted
    if spun and releases_disagree(stage.found.evidence):
        fit.twisted = True
        stage = fit.first(kinds, start)
    shapes = fit.shapes(stage) if damping == "auto" and not stage.solution.interrupted else {}
    end = averaged(stage, shapes)
    result = finished(fit, end, shapes, remarks, str(damping), kinds)
    if design and not result.interrupted and result.changes:
        say("designing the next dive")
        return replace(result, next_dive=next_dive(fit, end, result.vehicle, result.estimates))
    return result


def prepare(
    trials: Sequence[Trial],
    vehicle: Vehicle,
    axes: Sequence[str] | None = None,
    show: Callable[[str], None] = lambda name: None,
) -> tuple[list[Streams], list[Finding]]:
    """Return the usable trials, and findings about assumptions and about unusable trials.

    A trial without thrust is cut to the free motions of its axes. `show` is called with the name of each trial.

    Raises:
        CalibrationError: No trial can be used.
    """
    prepared, remarks, reasons = list[Streams](), list[Finding](), list[str]()
    for trial in trials:
        show(trial.name)
        try:
            one = streams(trial, vehicle)
            for item in no_input(one.drive):
                raise CalibrationError(item.text, trial.name)
            if trial.header.passive:
                named = trial.header.axis or AXES
                one = released(one, [a for a in AXES if a in named and (axes is None or a in axes)])
        except CalibrationError as error:
            remarks.append(finding("unusable", trial.name, severity="care", reason=error.reason))
            reasons.append(str(error))
            continue
        prepared.append(one)
        remarks += [item.about(trial.name) for item in one.motion.findings]
    if not prepared:
        others = f"; and {len(reasons) - 1} more" if len(reasons) > 1 else ""
        raise CalibrationError(f"no trial can be used: {reasons[0]}{others}")
    return prepared, remarks


DAMPING = ("auto", "linear", "quadratic", "both")

HORIZONS = (0.5, 60.0)
"""Shortest and longest segments that can be requested [s]."""


def _check(
    trials: Sequence[Trial],
    vehicle: Vehicle,
    axes: Sequence[str] | None,
    damping: str | Mapping[str, str],
    estimate: Sequence[str],
    horizon: float | None,
) -> None:
    require_fittable(trials, vehicle)
    require_axes(axes)
    if horizon is not None and not HORIZONS[0] <= horizon <= HORIZONS[1]:
        raise CalibrationError(f"horizon is {horizon:g} s, expected {HORIZONS[0]:g} to {HORIZONS[1]:g} s")
    if isinstance(damping, str) and damping not in DAMPING:
        raise CalibrationError(f"unknown damping '{damping}'; available: {', '.join(DAMPING)}")
    chosen = vehicle.hydrodynamics.get("calibrated")
    known = [*EXTRAS, *(chosen.term_scalars if isinstance(chosen, HydrodynamicSet) else ())]
    known += actuator_fields(vehicle)
    for word in estimate:
        if word not in known:
            raise CalibrationError(
                f"cannot estimate '{word}'; available: {', '.join(known)}"
                + ("; a term's parameter only where the vehicle file has the term" if "." in word else "")
            )


def _axes(
    prepared: Sequence[Streams], vehicle: Vehicle, axes: Sequence[str] | None
) -> tuple[tuple[str, ...], list[Finding]]:
    """Return the axes to fit, and findings about requested axes that cannot be fitted."""
    moved, seen = excited(prepared, vehicle), observable(prepared)
    if axes is None:
        if not moved:
            raise CalibrationError(
                f"{vehicle.name}: {finding('nothing_excited').text}; name the axes, or give trials with larger inputs"
            )
        named = {axis for s in prepared for axis in s.trial.header.axis}
        return moved, [
            finding("axis_undetermined", axis) for axis in AXES if axis in named and axis not in seen
        ]
    driven = any(s.drive.source != "passive" for s in prepared)
    remarks = [finding("axis_undetermined", axis) for axis in axes if axis not in seen]
    unmoved = [axis for axis in axes if axis in seen and axis not in moved]
    remarks += [finding("axis_doubtful" if driven else "axis_not_free", axis) for axis in unmoved]
    chosen = tuple(a for a in AXES if a in axes and a in seen and (driven or a in moved))
    if not chosen:
        raise CalibrationError(f"no measurement that determines {', '.join(axes)} is in these trials")
    return chosen, remarks
