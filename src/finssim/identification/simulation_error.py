"""Hydrodynamics by simulation error: numbers with which the simulator, driven as the vehicle was, moves as it did."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.identification.confidence import FEWEST_TRIALS, Stage, confidence
from finssim.identification.drag_shape import (
    DragShape,
    averaged,
    drag_of_size,
    drag_shape,
    is_drag_known,
    levels_of,
)
from finssim.identification.estimates import (
    CERTAIN,
    AxisResult,
    Number,
    axis_result,
    changes,
    derived,
    matrix_changes,
    numbers_of,
    other_estimates,
    terminal_speed,
)
from finssim.identification.excitation import (
    SWINGING,
    compared,
    excitations,
    excited,
    horizon,
    observable,
    sampling,
    speeds,
    telling,
)
from finssim.identification.fit import Estimate, Fit
from finssim.identification.judgement import fit_findings, held_out, pictures, quality, unexplained
from finssim.identification.next_dive import next_dive
from finssim.identification.parameters import (
    EXTRAS,
    GAINS,
    LIKELY_SCALE,
    Parameters,
    actuator_fields,
    places,
)
from finssim.identification.plant_terms import matrices
from finssim.identification.rollout import (
    Segment,
    Streams,
    is_sampled,
    released,
    segments,
    streams,
    without,
)
from finssim.identification.shooting import FitSolution, Point, Shooting, solve
from finssim.identification.uncertainty import (
    degeneracy,
    releases_disagree,
)
from finssim.identification.weak_form import weak_form
from finssim.trials.findings import CalibrationError, Finding, finding
from finssim.trials.free_motion import DETERMINED_BY
from finssim.trials.inputs import no_input, require_axes, require_fittable
from finssim.trials.motion import answers
from finssim.trials.trial import Trial
from finssim.vehicles import AXES, HydrodynamicSet, Vehicle

__all__ = ["fit_by_simulation"]

Array = NDArray[np.float64]


STEP = 0.02
"""Step of the simulation [s]."""

SHORT = 2.5
"""Initial length of the segments [s]: over so short a time every problem is nearly linear."""

ENOUGH = 120.0
"""Length of all segments together that suffices for a start [s]."""

OWN_ERROR, BETWEEN = 0.003, 0.05
"""Error of the simulation itself, as a part of an estimate; and how it grows with the time between samples of the
inputs [1/s], for nobody recorded what happened in between."""

GROWTH = 12.0
"""Growth of a disturbance of the initial velocity over a segment above which its trial is cut into shorter ones.

A fast vehicle without fins turns broadside by itself, and derivatives over a long run of that mean little."""

HALVINGS = 3
"""How often a trial's segments are halved at most for that."""

EXPLAINED = 0.2
"""R² below which the model of an axis explains nothing: at 0 the mean of the measurements does as well."""


class FitProgress:
    """Progress over several stages: iteration, cost, rate and remaining time."""

    def __init__(self, progress: Callable[[float, str], None] | None) -> None:
        self.progress, self.begin, self.part = progress, time.perf_counter(), 0.0

    def __call__(self, words: str, toward: float = 1.0) -> None:
        # The number of remaining iterations is unknown; each takes a share of the rest.
        self.part += 0.2 * max(toward - self.part, 0.0)
        spent = time.perf_counter() - self.begin
        if self.progress:
            self.progress(self.part, f"{words}, {spent:.0f} s")


class Stages:
    """The stages of one fit: they share trials and segments."""

    def __init__(
        self,
        prepared: Sequence[Streams],
        vehicle: Vehicle,
        axes: tuple[str, ...],
        estimate: tuple[str, ...],
        known: Mapping[str, float],
        length: float | None,
        say: FitProgress,
        likely: bool = False,
        published: Mapping[str, float] | None = None,
    ) -> None:
        self.published = dict(published or {})
        self.prepared, self.vehicle, self.axes, self.say = prepared, vehicle, axes, say
        self.given, self.known, self.likely = length, dict(known), likely
        self.excites = excitations(prepared, vehicle)
        # The added mass of axes that are not fitted pushes and turns the others; roll's and pitch's hardly does, and
        # without thrust nothing does.
        driven = any(one.drive.source != "passive" for one in prepared)
        self.imposed = tuple(a for a in ("surge", "sway", "heave", "yaw") if a not in axes and driven)
        self.unseen = tuple(
            a for a in self.imposed if not any(answers(one.motion, AXES.index(a)) for one in prepared)
        )
        apart = [float(np.median(np.diff(s.drive.t))) for s in prepared if not s.drive.held]
        self.own_error = OWN_ERROR + BETWEEN * max([0.0, *(dt - STEP for dt in apart)])
        self.shorter: dict[str, float] = {}
        self.twisted = False
        self.used: list[Streams] = []
        self.segments: list[Segment] = []
        self.extras = set(estimate)
        if "heave" in axes:
            self.extras.add("buoyancy_excess")
        self.free = self._free_axes()
        swinging = [a for a in axes if a in SWINGING]
        self.held, self.notes = self._assumed(swinging)
        if any(a not in self.free or a in self.held for a in swinging):
            self.extras.add("k")
        self.slow = False
        rolled = any(a not in self.free and a not in self.held for a in swinging)
        if rolled and any(s.drive.thrusters for s in prepared):
            self.extras |= set(places(vehicle))
            # Unequal thrusters show in what a push along one axis does to all others.
            self.slow = any(map(is_sampled, prepared))
            self.extras |= {GAINS} if self.slow and not self.imposed else set()
        self.fitted = self._fitted_axes()
        # In a free swing alone, what tilts the vehicle at rest acts as a sensor that was mounted askew.
        self.biases = [a for a in axes if a != "heave" and (a not in self.free or a in SWINGING and driven)]
        self.remarks: list[Finding] = []
        self.weak_start = self._weak_start()

    def trial_counts(self) -> dict[str, int]:
        """Return the number of trials that excite each axis."""
        return {axis: sum(axis in one for one in self.excites) for axis in self.axes}

    def require_shown(self) -> None:
        """Refuse a published number that is not of what is fitted.

        Raises:
            CalibrationError: Surge is not fitted, or the thrust is known.
        """
        if "top_speed" in self.published and "surge" not in self.axes:
            raise CalibrationError(
                f"a top speed shows the drag of surge, but the fitted axes are {', '.join(self.axes)}: "
                "leave it out, or fit surge too"
            )
        if "top_speed" in self.published and "surge" in self.free:
            raise CalibrationError(
                "a top speed shows the drag of surge, which no trial here drives: leave it out"
            )
        if "bollard_pull" in self.published and "thrust_scale" not in self.extras:
            raise CalibrationError(
                "a bollard pull shows the thrust, which is taken as known here: leave it out, or give --estimate "
                "thrust_scale"
            )

    def _fitted_axes(self) -> list[list[str]]:
        """Return the axes of each trial whose motion is simulated and compared; the others move as they were seen to.

        A surge, sway or yaw that a trial does not excite comes from couplings and disturbances. Where the centre of
        gravity is not free the model lacks these: compared, it would determine the added mass of other axes through
        their Coriolis moments. Where it is only noise it stays, for it keeps the initial state in place. So do heave,
        roll and pitch: weight acts on them in every trial. In slow logs with a free centre of gravity all stay: it
        shows in what a push along one axis does to the others, and as an imposed motion their noise would shake roll
        and pitch. A fast log averages that noise, and what its thrusters do to other axes, being unequal, would be
        taken for a bias.
        """
        if self.slow:
            return [list(self.axes) for _ in self.prepared]
        out, nowhere = list[list[str]](), set(self.axes).difference(*self.excites)
        for one, moved in zip(self.prepared, self.excites, strict=True):
            own = moved if one.released else moved | nowhere | {"heave", *SWINGING}
            still = [a for a in AXES if not (one.released or answers(one.motion, AXES.index(a)))]
            out.append([a for a in self.axes if a in own or a in still])
        return out

    def _free_axes(self) -> tuple[str, ...]:
        """Return the axes that move only in trials without thrust, which show ratios alone."""
        driven = {
            axis
            for one, moved in zip(self.prepared, self.excites, strict=True)
            if one.drive.source != "passive"
            for axis in moved
        }
        moving = {axis for one in self.prepared for axis in one.released}
        return tuple(a for a in self.axes if a in moving - driven)

    def _assumed(self, swinging: Sequence[str]) -> tuple[dict[str, float], dict[str, str]]:
        """Return effective inertias that are not fitted [kg, kg m²], and what the numbers of an axis rest on.

        Where the weight rights the vehicle, the file's stiffness gives the scale of a free motion, elsewhere the file's
        inertia does, unless an inertia is given.
        """
        plant = matrices(self.vehicle)
        k = float(plant.arm[2])
        stiff = k > 0.0 and not any(a in self.known or a not in self.free for a in swinging)
        held, notes = dict(self.known), dict[str, str]()
        for axis in self.free:
            i, unit = AXES.index(axis), "kg" if AXES.index(axis) < 3 else "kg m²"
            if axis in held:
                notes[axis] = f"with the given inertia {held[axis]:.4g} {unit}"
            elif axis in SWINGING and stiff:
                notes[axis] = f"with the file's k = {k:.4g} N m/rad"
            elif axis not in SWINGING or not any(a in self.known or a not in self.free for a in swinging):
                held[axis] = float((plant.M_RB + plant.M_A)[i, i])
                notes[axis] = f"with the file's inertia {held[axis]:.4g} {unit}"
        return held, notes

    def _weak_start(self) -> dict[str, float]:
        """Return the numbers of the weak form, and cut the trials where it finds a jolt.

        A vehicle with fins or other actuators has none, because the weak form leaves out their forces: fits of a
        torpedo that began with its numbers often ended at a wrong minimum.
        """
        if self.vehicle.actuators:
            return {}
        plant, start = matrices(self.vehicle), dict[str, float]()
        gaps: dict[int, list[tuple[float, float]]] = {}
        for axis in self.axes:
            known = {"m_eff": self.held[axis]} if axis in self.held else {}
            known |= {"k": float(plant.arm[2])} if axis in SWINGING and "k" not in self.extras else {}
            those = [g for g, moved in enumerate(self.excites) if axis in moved]
            found, jolts = weak_form([self.prepared[g] for g in those], axis, self.vehicle, known)
            for k, begin, end in jolts:
                gaps.setdefault(those[k], []).append((begin, end))
                name = self.prepared[those[k]].trial.name
                self.remarks.append(finding("jolt", name, axis=axis, begin=begin, end=end))
            found = {name: (LIKELY_SCALE if self.likely else 1.0) * value for name, value in found.items()}
            start |= {f"{axis}.{name}": value for name, value in found.items()}
            if found:
                start[f"{axis}.added_mass"] = found["m_eff"] - float(
                    plant.M_RB[AXES.index(axis), AXES.index(axis)]
                )
            if found and axis == "heave":
                start["buoyancy_excess"] = -found["bias"]
            if found and axis in SWINGING:
                start["k"] = found["k"]
        self.prepared = [without(s, gaps.get(g, [])) for g, s in enumerate(self.prepared)]
        return start

    def rough(self, kinds: dict[str, str], starts: Sequence[Mapping[str, float]]) -> Stage:
        """Fit short segments from the best of several starts, without regard to outliers and clocks.

        Starts have the units of the coordinates.
        """
        short = max(SHORT, 15.0 * sampling(self.prepared))
        self.cut(min(short, self.given or short))
        self.thin_out()
        problem = min((self.problem(kinds, start) for start in starts), key=lambda one: one.cost(one.start()))
        point = problem.start()
        problem.hold_clocks(True)
        rough = solve(
            problem, point, iterations=12, std=problem.size(), rough=True, report=self.report("start", 0.3)
        )
        self.refuse_divergence(rough)
        problem.hold_clocks(False)
        return Stage(problem, rough, confidence(problem, rough))

    def thin_out(self) -> None:
        """Keep the segments of each trial in which the inputs change most, about `ENOUGH` of all."""
        part = min(1.0, ENOUGH / sum(s.duration for s in self.segments))
        kept = list[Segment]()
        for g in range(len(self.used)):
            own = [s for s in self.segments if s.index == g]
            own.sort(key=lambda s: -float(np.ptp(s.drive.force, axis=0).sum()))
            kept += own[: math.ceil(part * len(own))] if np.any(own[0].drive.force) else own
        self.segments = kept

    def refuse_divergence(self, solution: FitSolution) -> None:
        """Raise a `CalibrationError` if the simulation has no finite answer."""
        if not np.isfinite(solution.cost):
            raise CalibrationError(
                f"the simulation diverges within segments of {self.length:.3g} s: give a vehicle file with better "
                "numbers, or a shorter --horizon"
            )

    def first(self, kinds: dict[str, str], start: Mapping[str, float]) -> Stage:
        """Fit segments of the length that the numbers of a start call for.

        If the simulation with them diverges, the fit begins with the vehicle file's numbers instead.
        """
        p = self.parameters(kinds, start)
        self.cut(
            self.given or horizon(self.vehicle.replace(matrix_changes(p, p.start)), self.prepared, self.axes)
        )
        problem = self.problem(kinds, start)
        for _ in range(0 if self.given else HALVINGS):
            growth = problem.growth(problem.start())
            wild = {self.used[g].trial.name for g in np.unique(problem.groups[growth > GROWTH])}
            if not wild:
                break
            for name in wild:
                self.shorter[name] = 0.5 * self.shorter.get(name, 1.0)
            self.cut(self.length)
            problem = self.problem(kinds, start)
        if start and not np.isfinite(problem.cost(problem.start())):
            self.shorter.clear()
            return self.first(kinds, {})
        stage = self.finish(problem, problem.start(), 0.6)
        least = 0.5**HALVINGS
        long = [one.trial.name for one in self.used if self._part(one) > least]
        if (
            stage.solution.converged
            or stage.solution.interrupted
            or self.given
            or not self.shorter
            or not long
        ):
            return stage
        # Where some trials grow so fast that they were cut shorter, the others may do so on the way to the solution.
        self.shorter |= dict.fromkeys(long, least)
        self.cut(self.length)
        problem = self.problem(kinds, start)
        return self.finish(problem, problem.start(), 0.6)

    def finish(self, problem: Shooting, point: Point, toward: float, std: Array | None = None) -> Stage:
        """Fit with robust weights and clocks let go, after a first approach without."""
        if std is None:
            problem.hold_clocks(True)
            rough = solve(
                problem,
                point,
                iterations=6,
                std=problem.size(),
                rough=True,
                report=self.report("fit", toward),
            )
            problem.hold_clocks(False)
            point = rough.point
            if rough.interrupted:
                return Stage(problem, rough, confidence(problem, rough))
            self.refuse_divergence(rough)
        solution = solve(problem, point, std=std, report=self.report("fit", toward))
        return Stage(problem, solution, confidence(problem, solution))

    def shapes(self, stage: Stage) -> dict[str, DragShape]:
        """Return what the trials show of the drag of each axis, over its shapes."""
        problem, motions, out = stage.problem, [s.motion for s in self.used], dict[str, DragShape]()
        for axis in self.axes:
            low, top = speeds(motions, axis)
            top = float(np.sqrt(low * top)) if problem.coasts else top
            levels = [low, top] if problem.released else levels_of(problem, axis)
            out[axis] = drag_shape(stage, axis, drag_of_size(self.vehicle, axis), levels)
        return out

    def report(self, words: str, toward: float) -> Callable[[int, float], None]:
        """Return a function that reports an iteration and its residual; `toward` is the share of the work done then."""
        return lambda i, rms: self.say(f"{words}: iteration {i}, residual {rms:.4g} σ", toward)

    def cut(self, length: float) -> None:
        """Cut the trials into segments of about a length [s]."""
        shown = {column for axis in self.axes for column in DETERMINED_BY[axis]}
        aside = [
            frozenset(
                c for axis in ("surge", "sway", "yaw") if axis not in moved for c in DETERMINED_BY[axis]
            )
            for moved in self.excites
        ]
        cut = [
            [
                replace(compared(s, one.motion, axes, free=bool(one.released)), aside=own)
                for s in segments(one, self.vehicle, length=length * self._part(one), step=STEP, changes=True)
            ]
            for one, axes, own in zip(self.prepared, self.fitted, aside, strict=True)
        ]
        kept = [[s for s in stretch if shown & set(s.measured)] for stretch in cut]
        self.length = length
        self.used = [one for one, stretch in zip(self.prepared, kept, strict=True) if stretch]
        self.segments = [replace(s, index=g) for g, stretch in enumerate(filter(None, kept)) for s in stretch]
        if not self.segments:
            raise CalibrationError(
                f"no interval of these trials has both inputs and measurements of {', '.join(self.axes)}"
            )

    def _part(self, one: Streams) -> float:
        return self.shorter.get(one.trial.name, 1.0)

    def parameters(self, kinds: dict[str, str], start: Mapping[str, float]) -> Parameters:
        """Return the free parameters for a choice of damping, from a start.

        The start has the units of the coordinates.
        """
        return Parameters(
            self.vehicle,
            axes=self.axes,
            damping=kinds,
            extras=tuple(self.extras),
            biases=self.biases,
            start=start,
            imposed=self.imposed,
            unseen=self.unseen,
            held=self.held,
            likely=self.likely,
            published=self.published,
        )

    def problem(
        self, kinds: dict[str, str], start: Mapping[str, float], other: Sequence[Segment] = ()
    ) -> Shooting:
        """Return the problem of the free parameters, over the segments or over other, driven ones.

        The start has the units of the coordinates.
        """
        swinging = np.array([not other and bool(self.used[s.index].released) for s in other or self.segments])
        # If every input is stated to have acted, a request for a lag doubts that.
        acted = not any(s.drive.commanded for s in self.segments)
        return Shooting(
            other or self.segments,
            self.parameters(kinds, start),
            sorted({c for s in self.segments for c in s.measured}),
            lagged=np.ones(len(self.segments), bool) if acted and not other else None,
            swinging=swinging,
            twisted=self.twisted,
            few=min(self.trial_counts().values()) < FEWEST_TRIALS,
        )

    def result(
        self,
        stage: Stage,
        shapes: Mapping[str, DragShape],
        remarks: list[Finding],
        *,
        damping: str,
        kinds: Mapping[str, str],
    ) -> Fit:
        """Return the finished fit, with the drag of `shapes`."""
        p, x = stage.problem.parameters, stage.x
        numbers = numbers_of(p, x, stage.found, self.own_error)
        for axis, shape in shapes.items():
            numbers |= {
                f"{axis}.{n}": Number(v, ends)
                for n, v, ends in zip(("d1", "d2"), shape.value, shape.ends, strict=True)
            }
        figures = quality(stage.problem, stage.solution, self.axes, self.used)
        error = None
        if not stage.solution.interrupted:
            several = stage.found.evidence.unit == "trials" and not stage.found.covariance.alone.any()
            file = self.problem(dict.fromkeys(self.axes, "both"), {})
            scores, error = held_out(stage, file, self.axes, several)
            for axis, (after, before) in scores.items():
                figures[axis] |= {"held_out": after, "file": before}
        others, held = other_estimates(p, numbers)
        found, axes, bounds = self.axis_results(stage, shapes, numbers, figures, others)
        sources = {s.drive.source for s in self.used}
        unmeasured = [axis for axis in p.unseen if axis not in observable(self.prepared)]
        new = changes(p, x, found, axes, unmeasured=unmeasured, scaled=sources <= {"rpm", "pwm"})
        P, local = stage.problem.judged, stage.found.covariance.local
        correlation, traded = degeneracy(p.names[:P], local[:P, :P], stage.found.free[:P])
        left_out = [one.trial.name for one in self.prepared if one not in self.used]
        averages = [
            finding("drag_averaged", axis, shapes=", ".join(f"{n} {w:.2f}" for n, w in shape.weights.items()))
            for axis, shape in shapes.items()
        ]
        remarks = [
            *remarks,
            *self.remarks,
            *averages,
            *(finding("trial_left_out", name) for name in left_out),
            *fit_findings(stage.problem, stage.solution, stage.found, self.used, self.trial_counts()),
            *bounds,
            *held,
            *traded,
        ]
        self.say("done")
        return Fit(
            kind="hydrodynamics",
            method="simulation",
            before=self.vehicle,
            estimates=found,
            changes=new,
            quality=figures,
            correlation=correlation,
            findings=tuple(dict.fromkeys(remarks)),
            curves=pictures(stage, self.axes, error),
            trials={one.trial.name: one.trial.sha256 for one in self.used},
            settings={
                "axes": list(self.axes),
                "damping": damping,
                "drag": dict(kinds) | {axis: shape.weights for axis, shape in shapes.items()},
                "estimate": sorted(self.extras),
                "fix": {f"{axis}.m": m for axis, m in self.known.items()},
                "published": self.published,
                "speeds": {a: round(figures[a]["speed_high"], 4) for a in self.axes if a in figures},
                "horizon": round(self.length, 3),
                "step": STEP,
                "segments": len(self.segments),
                "iterations": stage.solution.iterations,
            },
            interrupted=stage.solution.interrupted,
        )

    def axis_results(
        self,
        stage: Stage,
        shapes: Mapping[str, DragShape],
        numbers: Mapping[str, Number],
        figures: Mapping[str, Mapping[str, float]],
        others: Mapping[str, Estimate],
    ) -> tuple[dict[str, Estimate], dict[str, Any], list[Finding]]:
        """Return all estimates, the changes of the vehicle by axis, and what has to be said of them.

        Args:
            stage: The finished fit.
            shapes: Drag of each axis whose shape was averaged.
            numbers: Parameter -> value and interval.
            figures: Axis -> quality of the fit, in the units of `Fit.quality`.
            others: Estimates that belong to no axis.
        """
        p, x, others = stage.problem.parameters, stage.x, dict(others)
        found, axes, bounds = dict[str, Estimate](), dict[str, Any](), list[Finding]()
        for axis in self.axes:
            own = speeds([s.motion for s in self.used], axis)
            # A coast shows drag at all speeds, and those in the middle best.
            speed = float(np.sqrt(own[0] * own[1])) if stage.problem.coasts else own[1]
            known = is_drag_known(p, x, stage.found, axis, speed, shapes.get(axis))
            result = axis_result(
                p, x, numbers, axis, speeds=own, drag_known=known, given=self.known.get(axis)
            )
            reason = self.unbelievable(stage, axis, figures.get(axis, {}).get("r2", 1.0))
            if reason:
                result.believe_nothing(reason)
            if axis == "heave":
                others["buoyancy_excess"], said = self.buoyancy(others["buoyancy_excess"], reason)
                result.findings += said
            found |= result.estimates
            if axis in self.free:
                found |= result.estimates if reason else self.free_estimates(stage, result)
            axes |= result.changes
            bounds += result.findings
        return found | others, axes, bounds

    def unbelievable(self, stage: Stage, axis: str, r2: float) -> str:
        """Return why nothing that was fitted to an axis can be believed, or an empty text.

        Args:
            stage: The finished fit.
            axis: The axis.
            r2: R² of the whole axis [-].
        """
        if r2 < EXPLAINED:
            return f"the model explains nothing of this axis' motion: R² {r2:.2f}"
        worst, least = unexplained(stage.problem, stage.solution, axis, self.used)
        if least < EXPLAINED:
            return f"the model explains nothing of how {worst} moves, R² {least:.2f}: fit its releases apart"
        return ""

    def buoyancy(self, excess: Estimate, reason: str) -> tuple[Estimate, list[Finding]]:
        """Return the excess of buoyancy, not identifiable where it rests on an assumed mass, and what contradicts it.

        Args:
            excess: Estimate from the simulation.
            reason: Why the axis cannot be believed; empty where it can.
        """
        file = matrices(self.vehicle).excess
        assumed = "heave" in self.free and "heave" not in self.known
        if not (assumed or reason):
            return excess, []
        note = reason or f"from the acceleration, {self.notes['heave']}"
        low, high = excess.ci95
        said = [] if reason or low <= file <= high else [
            finding("buoyancy_contradicted", "heave", file=file, low=low, high=high)
        ]  # fmt: skip
        return replace(excess, identifiable=False, note=note), said

    def free_estimates(self, stage: Stage, result: AxisResult) -> dict[str, Estimate]:
        """Return the estimates of an axis that moved without thrust: ratios, and the others with their assumption."""
        axis, (_, top) = result.axis, result.speeds
        p, i, out = stage.problem.parameters, AXES.index(result.axis), dict[str, Estimate]()
        for name, e in result.estimates.items():
            # The equilibrium of a swing may be that of a sensor that was mounted askew.
            sure = e.identifiable and not name.endswith(".bias")
            out[name] = replace(
                e, identifiable=sure, note="; ".join(filter(None, [e.note, self.notes.get(axis)]))
            )

        def plant(x: Array) -> tuple[float, float, float, float, float]:
            """Return m, d1, d2, k and the excess of buoyancy of a vector."""
            M_A, D1, D2 = (matrix[0, i, i] for matrix in p.matrices(x))
            file = matrices(self.vehicle)
            k = p.value(x[None], "k", float(file.arm[2]))
            excess = p.value(x[None], "buoyancy_excess", file.excess)
            return float(p.M_RB[i, i] + M_A), float(D1), float(D2), float(np.max(k)), float(np.max(excess))

        def add(name: str, value: float, ends: tuple[float, float], unit: str, note: str = "") -> None:
            sure = bool(value > 0.0 and 0.5 * (ends[1] - ends[0]) <= CERTAIN * value)
            note = note or ("" if sure else "uncertain by more than a fifth of its value")
            name = f"{axis}.{name}"
            out[name] = Estimate(
                name=name, estimate=value, ci95=ends, unit=unit, identifiable=sure, note=note
            )

        def of(number: Callable[..., float]) -> tuple[float, tuple[float, float]]:
            return derived(stage, lambda x: number(*plant(x)), self.own_error)

        if axis in SWINGING:
            rubbed = 8.0 / (3.0 * np.pi) * top
            add("natural_frequency", *of(lambda m, d1, d2, k, e: float(np.sqrt(k / m))), "rad/s")
            # A quadratic term counts as the linear one that takes as much energy out of the largest swing.
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

    Trials are cut into segments with an initial state each; Levenberg-Marquardt moves the parameters, the initial
    states, offsets of the sensors and lags of their streams, with derivatives from parallel worlds. All numbers hold at
    the reference point of the vehicle's calibrated set.

    Args:
        trials: Of any inputs, rates and measured columns.
        vehicle: Gives the rigid body, the motors and everything that is not fitted.
        axes: Axes to fit; those that the trials excite if None.
        estimate: Of `EXTRAS`, parameters of the vehicle's terms, such as `lift.coefficient`, and of its actuators, such
            as `fin.lift_slope`, of which a factor is fitted. Buoyancy comes
            with heave, stiffness with roll and pitch, a bias with the others.
        damping: `auto`, `linear`, `quadratic` or `both`; or one of the last three by axis.
        known: Effective inertias M_RB + M_A that are known, by axis [kg, kg m²].
        horizon: Length of the segments [s]; from the data if None.
        likely: Whether the thrust is known no better than by the voltages that batteries have; its scale is then fitted
            with that as its prior, and goes to the file with the rest.
        published: `top_speed` [m/s] and `bollard_pull` [N], both ahead: data on drag and thrust.
        design: Whether the next dive is designed.
        progress: Called with the part done and a few words.

    Returns:
        After Ctrl-C the best until then, with `interrupted`.

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
    fit = Stages(
        telling(prepared, vehicle, chosen),
        vehicle,
        chosen,
        tuple(estimate),
        known or {},
        horizon,
        say,
        likely,
        published,
    )
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
    result = fit.result(end, shapes, remarks, damping=str(damping), kinds=kinds)
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
    """Return the trials that can be used, and findings on what was assumed of them and on those that cannot.

    A trial without thrust is cut to the free motions of its axes. `show` is called with the name of each.

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
"""Shortest and longest segments that can be asked for [s]."""


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
    """Axes to fit, and why some that were asked for are not."""
    moved, seen = excited(prepared, vehicle), observable(prepared)
    if axes is None:
        if not moved:
            raise CalibrationError(
                f"{vehicle.name}: {finding('nothing_excited').text}; name the axes, or give trials with larger inputs"
            )
        named = {axis for s in prepared for axis in s.trial.header.axis}
        return moved, [finding("axis_untold", axis) for axis in AXES if axis in named and axis not in seen]
    driven = any(s.drive.source != "passive" for s in prepared)
    remarks = [finding("axis_untold", axis) for axis in axes if axis not in seen]
    unmoved = [axis for axis in axes if axis in seen and axis not in moved]
    remarks += [
        finding("axis_doubtful", axis) if driven else finding("axis_not_free", axis) for axis in unmoved
    ]
    chosen = tuple(a for a in AXES if a in axes and a in seen and (driven or a in moved))
    if not chosen:
        raise CalibrationError(f"no measurement that determines {', '.join(axes)} is in these trials")
    return chosen, remarks
