"""Stages of a fit by simulation error: selection of free axes and parameters, and fits of increasingly long
segments."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from finssim.identification.confidence import FEWEST_TRIALS, Stage, confidence
from finssim.identification.drag_shape import DragShape, drag_of_size, drag_shape, levels_of
from finssim.identification.estimates import matrix_changes
from finssim.identification.excitation import SWINGING, compared, excitations, horizon, sampling, speeds
from finssim.identification.parameters import GAINS, LIKELY_SCALE, Parameters, places
from finssim.identification.plant_terms import matrices
from finssim.identification.rollout import Segment, Streams, is_sampled, segments, without
from finssim.identification.shooting import FitSolution, Point, Shooting, solve
from finssim.identification.weak_form import weak_form
from finssim.trials.findings import CalibrationError, Finding, finding
from finssim.trials.free_motion import DETERMINED_BY
from finssim.trials.motion import answers
from finssim.vehicles import AXES, Vehicle

Array = NDArray[np.float64]

STEP = 0.02
"""Time step of the simulation [s]."""

SHORT = 2.5
"""Initial length of the segments [s]: over such a short time every problem is nearly linear."""

ENOUGH = 120.0
"""Total length of all segments that suffices for the first stage [s]."""

OWN_ERROR, BETWEEN = 0.003, 0.05
"""Relative error of the simulation itself; and its increase with the sample interval of the inputs [1/s],
since their course between samples is unknown."""

GROWTH = 12.0
"""Growth of a disturbance of the initial velocity over a segment above which its trial is cut into shorter ones.

A fast vehicle without fins turns broadside on its own, so that derivatives over long segments are not useful.
"""

HALVINGS = 3
"""Largest number of times that a trial's segments are halved for this reason."""


class FitProgress:
    """Progress over several stages: iteration, cost, rate and remaining time."""

    def __init__(self, progress: Callable[[float, str], None] | None) -> None:
        self.progress, self.begin, self.part = progress, time.perf_counter(), 0.0

    def __call__(self, words: str, toward: float = 1.0) -> None:
        # The number of remaining iterations is unknown; each advances by a fraction of the remainder.
        self.part += 0.2 * max(toward - self.part, 0.0)
        spent = time.perf_counter() - self.begin
        if self.progress:
            self.progress(self.part, f"{words}, {spent:.0f} s")


class Stages:
    """Stages of one fit, which share trials and segments.

    Attributes:
        excites: Axes that each trial excites.
        imposed: Axes that are not fitted and whose added mass pushes and rotates the others.
        unseen: Axes of `imposed` that no trial measures, and that are therefore simulated.
        free: Axes that move only in trials without thrust, which determine only ratios.
        held: Effective inertias that are not fitted [kg, kg m²].
        notes: Axis -> basis of its numbers.
        extras: Fitted parameters besides the axes' own.
        own_error: Relative error of the simulation itself [-].
        used: Trials with a segment.
        remarks: Findings about the trials.
    """

    def __init__(
        self,
        prepared: Sequence[Streams],
        vehicle: Vehicle,
        axes: tuple[str, ...],
        estimate: Sequence[str],
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
        # The added mass of axes that are not fitted pushes and rotates the others; that of roll and pitch hardly does,
        # and without thrust none does.
        driven = any(one.drive.source != "passive" for one in prepared)
        self.imposed = tuple(a for a in ("surge", "sway", "heave", "yaw") if a not in axes and driven)
        self.unseen = tuple(
            a for a in self.imposed if not any(answers(one.motion, AXES.index(a)) for one in prepared)
        )
        apart = [float(np.median(np.diff(s.drive.t))) for s in prepared if not s.drive.held]
        self.own_error = OWN_ERROR + BETWEEN * max([0.0, *(dt - STEP for dt in apart)])
        self.shorter: dict[str, float] = {}
        self.twisted = False
        self.used, self.segments, self.remarks = list[Streams](), list[Segment](), list[Finding]()
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
            # Unequal thrusters are identifiable from the effect of a push along one axis on all others.
            self.slow = any(map(is_sampled, prepared))
            self.extras |= {GAINS} if self.slow and not self.imposed else set()
        self.fitted = self._fitted_axes()
        # In free swings alone, a static tilt of the vehicle is equivalent to a misaligned sensor.
        self.biases = [a for a in axes if a != "heave" and (a not in self.free or a in SWINGING and driven)]
        self.weak_start = self._weak_start()

    def trial_counts(self) -> dict[str, int]:
        """Return the number of trials that excite each axis."""
        return {axis: sum(axis in one for one in self.excites) for axis in self.axes}

    def require_shown(self) -> None:
        """Refuse a published number that does not concern the fit.

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
        """Return the axes of each trial whose motion is simulated and compared; the others follow their
        measured motion.

        Motion in surge, sway or yaw that a trial does not excite is caused by couplings and disturbances. If
        the centre of gravity is not free, the model lacks these: if compared, they would determine the added
        mass of other axes through their Coriolis moments. An axis with noise only stays, since it constrains
        the initial state. So do heave, roll and pitch: hydrostatic forces act on them in every trial. In slow
        logs with a free centre of gravity all axes stay: it is identifiable from the effect of a push along
        one axis on the others, and the noise of an imposed motion would excite roll and pitch. A fast log
        averages that noise, and effects of unequal thrusters on other axes would be attributed to a bias.
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
        """Return the axes that move only in trials without thrust, which determine only ratios."""
        trials = zip(self.prepared, self.excites, strict=True)
        driven = set[str]().union(*(moved for one, moved in trials if one.drive.source != "passive"))
        moving = set[str]().union(*(one.released for one in self.prepared))
        return tuple(a for a in self.axes if a in moving - driven)

    def _assumed(self, swinging: Sequence[str]) -> tuple[dict[str, float], dict[str, str]]:
        """Return effective inertias that are not fitted [kg, kg m²], and the basis of an axis' numbers.

        For axes with a restoring moment, the file's stiffness determines the scale of a free motion, for
        others the file's inertia, unless an inertia is given.
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
        """Return the numbers of the weak form, and cut the trials where it detects a jolt.

        For a vehicle with fins or other actuators there are none, since the weak form omits their forces:
        fits of a torpedo that started from its numbers often ended in a wrong minimum.
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
        """Fit short segments from the best of several starts, ignoring outliers and clock offsets.

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
        """Keep the segments of each trial in which the inputs change most, about `ENOUGH` in total."""
        part = min(1.0, ENOUGH / sum(s.duration for s in self.segments))
        kept = list[Segment]()
        for g in range(len(self.used)):
            own = [s for s in self.segments if s.index == g]
            own.sort(key=lambda s: -float(np.ptp(s.drive.force, axis=0).sum()))
            kept += own[: math.ceil(part * len(own))] if np.any(own[0].drive.force) else own
        self.segments = kept

    def refuse_divergence(self, solution: FitSolution) -> None:
        """Raise a `CalibrationError` if the simulation has diverged."""
        if not np.isfinite(solution.cost):
            raise CalibrationError(
                f"the simulation diverges within segments of {self.length:.3g} s: give a vehicle file with better "
                "numbers, or a shorter --horizon"
            )

    def first(self, kinds: dict[str, str], start: Mapping[str, float]) -> Stage:
        """Fit segments of a length that suits the numbers of a start.

        If the simulation with them diverges, the fit starts from the vehicle file's numbers instead.
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
        ended = stage.solution.converged or stage.solution.interrupted
        if ended or self.given or not self.shorter or not long:
            return stage
        # If some trials grow so fast that they were cut shorter, others may do so during the iteration.
        self.shorter |= dict.fromkeys(long, least)
        self.cut(self.length)
        problem = self.problem(kinds, start)
        return self.finish(problem, problem.start(), 0.6)

    def finish(self, problem: Shooting, point: Point, toward: float) -> Stage:
        """Fit with robust weights and free clocks, after a first approximation without."""
        report = self.report("fit", toward)
        problem.hold_clocks(True)
        rough = solve(problem, point, iterations=6, std=problem.size(), rough=True, report=report)
        problem.hold_clocks(False)
        if rough.interrupted:
            return Stage(problem, rough, confidence(problem, rough))
        self.refuse_divergence(rough)
        solution = solve(problem, rough.point, report=report)
        return Stage(problem, solution, confidence(problem, solution))

    def shapes(self, stage: Stage) -> dict[str, DragShape]:
        """Return the drag of each axis, averaged over its models."""
        problem, motions, out = stage.problem, [s.motion for s in self.used], dict[str, DragShape]()
        for axis in self.axes:
            low, top = speeds(motions, axis)
            top = float(np.sqrt(low * top)) if problem.coasts else top
            levels = [low, top] if problem.released else levels_of(problem, axis)
            out[axis] = drag_shape(stage, axis, drag_of_size(self.vehicle, axis), levels)
        return out

    def report(self, words: str, toward: float) -> Callable[[int, float], None]:
        """Return a function that reports an iteration and its residual; `toward` is the completed fraction of
        the work then."""
        return lambda i, rms: self.say(f"{words}: iteration {i}, residual {rms:.4g} σ", toward)

    def cut(self, length: float) -> None:
        """Cut the trials into segments of about this length [s]."""
        shown = {column for axis in self.axes for column in DETERMINED_BY[axis]}
        aside = [
            frozenset(c for axis in {"surge", "sway", "yaw"} - moved for c in DETERMINED_BY[axis])
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
        """Return the free parameters for given damping models and initial values.

        The initial values have the units of the coordinates.
        """
        return Parameters(
            self.vehicle, axes=self.axes, damping=kinds, extras=tuple(self.extras), biases=self.biases, start=start,
            imposed=self.imposed, unseen=self.unseen, held=self.held, likely=self.likely, published=self.published,
        )  # fmt: skip

    def problem(
        self, kinds: dict[str, str], start: Mapping[str, float], other: Sequence[Segment] = ()
    ) -> Shooting:
        """Return the problem of the free parameters, over the segments or over other, driven ones.

        The initial values have the units of the coordinates.
        """
        swinging = np.array([not other and bool(self.used[s.index].released) for s in other or self.segments])
        # If every input is stated to have been applied, a requested lag contradicts that.
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
