"""The stages of a simulation-error fit: short segments first, then longer ones, then other choices of parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.degeneracy import degeneracy
from finssim.calibration.errors import CalibrationError
from finssim.calibration.fit import Fit
from finssim.calibration.simulation.bordered import huber
from finssim.calibration.simulation.changes import changes
from finssim.calibration.simulation.coarse_search import coarse_search
from finssim.calibration.simulation.estimates import estimates
from finssim.calibration.simulation.evidence import FEWEST_TRIALS, Findings, findings
from finssim.calibration.simulation.excited import (
    TELL,
    compared,
    excites,
    horizon,
    observable,
    sampling,
    speeds,
)
from finssim.calibration.simulation.gauss_newton import Point, Solution, solve
from finssim.calibration.simulation.parameters import EXTRAS, Parameters
from finssim.calibration.simulation.report import Clock, doubts, pictures, quality
from finssim.calibration.simulation.segments import Segment, Streams, segments
from finssim.calibration.simulation.shooting import Shooting
from finssim.vehicles import Vehicle

__all__ = ["Stage", "Stages"]

Array = NDArray[np.float64]

STEP = 0.02
"""Of the simulation [s]."""

SHORT = 2.5
"""Of the segments at first [s]: over so short a time every problem is nearly linear."""

OWN_ERROR, BETWEEN = 0.003, 0.05
"""Error of the simulation itself, as a part of an estimate; and how it grows with the time between samples of the
inputs [1/s], for nobody recorded what happened in between."""

GROWTH = 12.0
"""Growth of a disturbance of the initial velocity over a segment above which its trial is cut into shorter ones.

A fast vehicle without fins turns broadside by itself, and derivatives over a long run of that mean little."""

HALVINGS = 2

ROUGH = 3.0
"""Residual, against a twentieth of the range, from which a coarse search comes first."""

COARSE_SEGMENTS = 24


@dataclass
class Stage:
    """One fit of one set of parameters."""

    problem: Shooting
    solution: Solution
    found: Findings

    @property
    def x(self) -> Array:
        """Where the parameters ended, (P,)."""
        return self.solution.point.theta[: len(self.problem.parameters.names)]


class Stages:
    """The stages of one fit: they share trials and segments."""

    def __init__(
        self,
        prepared: Sequence[Streams],
        vehicle: Vehicle,
        axes: tuple[str, ...],
        estimate: tuple[str, ...],
        length: float | None,
        start: Fit | None,
        seed: int,
        say: Clock,
    ) -> None:
        self.prepared, self.vehicle, self.axes, self.seed, self.say = prepared, vehicle, axes, seed, say
        self.base = vehicle.replace(start.changes) if start is not None and start.changes else vehicle
        self.given = length
        self.excites = [excites(s, vehicle) for s in prepared]
        # The added mass of axes that are not fitted pushes and turns the others; roll's and pitch's hardly does.
        self.imposed = tuple(a for a in ("surge", "sway", "heave", "yaw") if a not in axes)
        measured = observable(prepared)
        self.unseen = tuple(a for a in self.imposed if a not in measured)
        apart = [float(np.median(np.diff(s.drive.t))) for s in prepared if not s.drive.held]
        self.own_error = OWN_ERROR + BETWEEN * max([0.0, *(dt - STEP for dt in apart)])
        self.shorter: dict[str, float] = {}
        self.used: list[Streams] = []
        self.segments: list[Segment] = []
        self.extras = {word for word in estimate if word in EXTRAS}
        if "heave" in axes:
            self.extras.add("buoyancy_excess")
        if {"roll", "pitch"} & set(axes):
            self.extras.add("k")
        biased = [a for a in axes if a != "heave"]
        self.trial_biases = biased if "trial_bias" in estimate else []
        self.biases = [] if self.trial_biases else biased
        self.guess = {} if start is None else {name: e.estimate for name, e in start.estimates.items()}

    def first(self, kinds: dict[str, str]) -> Stage:
        """Short segments from a rough start, then segments of the length that the answer calls for."""
        short = max(SHORT, 15.0 * sampling(self.prepared))
        self.cut(min(short, self.given or short))
        problem = self.problem(kinds, self.base, self.guess)
        point = self._rough(problem, problem.start())
        problem.hold_clocks(True)
        rough = solve(
            problem, point, iterations=12, std=problem.size(), rough=True, report=self.report("start", 0.3)
        )
        if not np.isfinite(rough.cost):
            raise CalibrationError(
                "the simulation diverges with the vehicle file's numbers: give better ones, or shorter segments "
                f"(now {self.length:.3g} s)"
            )
        p, x = problem.parameters, rough.point.theta[: len(problem.parameters.names)]
        if rough.interrupted:
            problem.hold_clocks(False)
            return Stage(problem, rough, findings(problem, rough))
        self.cut(self.given or horizon(self.base.replace(_matrices(p, x)), self.prepared, self.axes))
        problem = self.problem(kinds, self.base, dict(zip(p.names, x, strict=True)))
        for _ in range(0 if self.given else HALVINGS):
            growth = problem.growth(problem.start())
            wild = {self.used[g].trial.name for g in np.unique(problem.groups[growth > GROWTH])}
            if not wild:
                break
            for name in wild:
                self.shorter[name] = 0.5 * self.shorter.get(name, 1.0)
            self.cut(self.length)
            problem = self.problem(kinds, self.base, dict(zip(p.names, x, strict=True)))
        return self.finish(problem, problem.start(), 0.6)

    def next(self, kinds: dict[str, str], before: Stage, full: bool = False) -> Stage:
        """Another set of parameters, from where a fit ended."""
        old, x = before.problem.parameters, before.x
        base = self.base.replace(_matrices(old, x)) if full else self.base
        problem = self.problem(kinds, base, dict(zip(old.names, x, strict=True)), full)
        point = problem.start()
        late = len(problem.errors.streams)
        theta = np.concatenate([point.theta[:-late], before.solution.point.theta[-late:]])
        point = Point(theta, before.solution.point.phi, before.solution.point.z)
        return self.finish(problem, point, 0.95, before.solution.std)

    def finish(self, problem: Shooting, point: Point, toward: float, std: Array | None = None) -> Stage:
        """Fit with robust weights and clocks let go, after a first approach without."""
        words = "couplings" if problem.parameters.coupled else "fit"
        if std is None:
            problem.hold_clocks(True)
            rough = solve(
                problem,
                point,
                iterations=6,
                std=problem.size(),
                rough=True,
                report=self.report(words, toward),
            )
            problem.hold_clocks(False)
            point = rough.point
            if rough.interrupted:
                return Stage(problem, rough, findings(problem, rough))
        solution = solve(problem, point, std=std, report=self.report(words, toward))
        return Stage(problem, solution, findings(problem, solution))

    def report(self, words: str, toward: float) -> Callable[[int, float], None]:
        return lambda i, rms: self.say(f"{words}: iteration {i}, residual {rms:.4g} σ", toward)

    def cut(self, length: float) -> None:
        """Cut the trials into segments of about a length [s]."""
        tells = {column for axis in self.axes for column in TELL[axis]}
        cut = [
            [
                compared(s, one.motion, self.axes)
                for s in segments(one, self.vehicle, length=length * self._part(one), step=STEP)
            ]
            for one in self.prepared
        ]
        kept = [[s for s in stretch if tells & set(s.measured)] for stretch in cut]
        self.length = length
        self.used = [one for one, stretch in zip(self.prepared, kept, strict=True) if stretch]
        self.segments = [replace(s, index=g) for g, stretch in enumerate(filter(None, kept)) for s in stretch]
        if not self.segments:
            raise CalibrationError(
                f"no stretch of these trials has both inputs and measurements that tell of {', '.join(self.axes)}"
            )
        commanded = np.array([s.commanded for s in self.segments])
        # Where every input is said to have acted, whoever asks for a lag doubts that.
        self.lagged = commanded if commanded.any() else np.ones_like(commanded)

    def _part(self, one: Streams) -> float:
        return self.shorter.get(one.trial.name, 1.0)

    def problem(
        self, kinds: dict[str, str], base: Vehicle, start: dict[str, float], full: bool = False
    ) -> Shooting:
        """What is free, over the segments."""
        parameters = Parameters(
            base,
            axes=self.axes,
            damping=kinds,
            full=full,
            extras=tuple(self.extras),
            biases=self.biases,
            start=start,
            imposed=() if full else self.imposed,
            unseen=() if full else self.unseen,
        )
        return Shooting(
            self.segments,
            parameters,
            sorted({c for s in self.segments for c in s.measured}),
            trial_biases=self.trial_biases,
            lagged=self.lagged,
            few=min(sum(axis in one for one in self.excites) for axis in self.axes) < FEWEST_TRIALS,
        )

    def _rough(self, problem: Shooting, point: Point) -> Point:
        """The start, or a better one from a coarse search over some of the segments."""
        every = max(1, len(self.segments) // COARSE_SEGMENTS)
        few = Shooting(
            self.segments[::every], problem.parameters, problem.measured.names, lagged=self.lagged[::every]
        )
        size, own = few.size(), few.start()
        P, late = len(problem.parameters.names), len(few.errors.streams)

        def cost(x: Array) -> Array:
            theta = np.concatenate([x, np.zeros((len(x), late))], axis=1)
            parts = (np.repeat(part[None], len(x), axis=0) for part in (own.phi, own.z))
            loss = huber(few.residuals(Point(theta, *parts)) / size[:, None])[0].mean(axis=0)
            return np.asarray(np.where(np.isfinite(loss), loss, np.inf))

        first = float(cost(point.theta[None, :P])[0])
        if first < 0.5 * ROUGH**2:
            return point
        self.say("coarse search", 0.2)
        p = problem.parameters
        best, lowest = coarse_search(cost, point.theta[:P], p.low, p.high, p.scale, seed=self.seed)
        if not lowest < first:
            return point
        return Point(np.concatenate([best, point.theta[P:]]), point.phi, point.z)

    def result(
        self,
        stage: Stage,
        wider: dict[str, tuple[float, float]],
        dropped: dict[str, str],
        warnings: list[str],
        *,
        full: bool,
        damping: str,
    ) -> Fit:
        """The finished fit."""
        p, x = stage.problem.parameters, stage.x
        found, _ = estimates(
            p, x, stage.found, axes=self.axes, own_error=self.own_error, wider=wider, dropped=dropped
        )
        top = {axis: speeds([s.motion for s in self.used], axis)[1] for axis in self.axes}
        sources = {s.drive.source for s in self.used}
        new = changes(p, x, found, stage.found, self.axes, top, scaled=sources <= {"rpm", "pwm"})
        P, local = stage.problem.judged, stage.found.covariance.local
        correlation, sentences = degeneracy(p.names[:P], local[:P, :P], stage.found.free[:P])
        left_out = [one.trial.name for one in self.prepared if one not in self.used]
        warnings = [
            *warnings,
            *(f"{name}: left out: no stretch has both inputs and measurements" for name in left_out),
            *doubts(stage.problem, stage.solution, stage.found, found, self.used),
            *sentences,
        ]
        settings: dict[str, Any] = {
            "axes": list(self.axes),
            "damping": damping,
            "full": full,
            "estimate": sorted(self.extras) + (["trial_bias"] if self.trial_biases else []),
            "horizon": round(self.length, 3),
            "step": STEP,
            "segments": len(self.segments),
            "iterations": stage.solution.iterations,
            "seed": self.seed,
        }
        self.say("done")
        return Fit(
            kind="hydrodynamics",
            method="simulation",
            vehicle=self.vehicle,
            estimates=found,
            changes=new,
            quality=quality(stage.problem, stage.solution, self.axes, self.used),
            correlation=correlation,
            warnings=tuple(dict.fromkeys(warnings)),
            curves=pictures(stage.problem, stage.solution, self.axes),
            trials={one.trial.name: one.trial.sha256 for one in self.used},
            settings=settings,
            interrupted=stage.solution.interrupted,
        )


def _matrices(p: Parameters, x: Array) -> dict[str, Any]:
    """Changes of the vehicle file to the matrices of a vector."""
    base = f"hydrodynamics.{p.hydrodynamics}"
    names = ("added_mass", "linear_damping", "quadratic_damping")
    return {f"{base}.{name}": m[0] for name, m in zip(names, p.matrices(x), strict=True)}
