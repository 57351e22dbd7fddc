"""Design of the next dive: the steps that reduce the intervals of a fit most per duration, from its
information matrix."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from finssim.identification.confidence import Stage, evidence_of
from finssim.identification.excitation import compared, sampling
from finssim.identification.fit import Dive, Estimate
from finssim.identification.programme import Leg, alternating
from finssim.identification.rollout import Segment, segments, streams
from finssim.identification.shooting import FitSolution, Point
from finssim.identification.synthetic import STEP, simulate_programme
from finssim.trials.findings import CalibrationError
from finssim.trials.motion import up_in_body
from finssim.vehicles import AXES, Vehicle

if TYPE_CHECKING:
    from finssim.identification.stages import Stages

Array = NDArray[np.float64]

LEVELS = (0.15, 0.4, 0.9)
"""Levels that are compared, relative to the vehicle's wrench limit."""

HOLDS = (3.0, 8.0)
"""Durations of the first step that are compared [s]."""

UPRIGHT = 0.8
"""Cosine of the tilt below which a step counts as too strong."""

SHORTEST, LONGEST = 30.0, 600.0
"""Shortest and longest duration of a dive [s]."""

WRITTEN = ("added_mass", "d1", "d2", "k")
"""Coordinates whose intervals a dive is designed to reduce."""


def next_dive(
    stages: Stages, stage: Stage, vehicle: Vehicle, estimates: Mapping[str, Estimate]
) -> Dive | None:
    """Return a dive as long as the fitted trials whose steps reduce the intervals of inertia, drag and
    stiffness most.

    Every step is simulated with the calibrated vehicle and measured like the fitted trials, with the noise
    estimated by the fit. It adds J^T W J to the fit's information N, after elimination of its initial state
    and offsets. Steps are selected one by one, each time the one that reduces the sum of the logarithms of
    the variances most per duration.

    Args:
        stages: Trials and settings of the fit.
        stage: Finished fit.
        vehicle: Calibrated vehicle.
        estimates: Estimates of the fit; the dive's summary refers to the widest interval.

    Returns:
        The dive; None if no step keeps the vehicle upright, or no axis was driven.
    """
    driven = [one for one in stages.used if one.drive.source != "passive"]
    legs = [
        Leg(axis, float(f"{part * limit:.2g}"), hold)
        for axis, limit in zip(AXES, vehicle.wrench_limits, strict=True)
        for part in LEVELS
        for hold in HOLDS
        if axis in stages.axes and axis in vehicle.controlled_axes and axis not in stages.free
    ]
    if not driven or not legs:
        return None
    legs, normal = _information(stages, stage, vehicle, legs)
    names = stage.problem.names
    at = [i for i, name in enumerate(names) if name.rpartition(".")[2] in WRITTEN]
    if not legs or not at:
        return None
    before = total = stage.found.evidence.information
    budget = float(np.clip(sum(one.trial.duration for one in driven), SHORTEST, LONGEST))
    count, spent = [0] * len(legs), 0.0
    first = np.log(_variances(before, at))
    while spent < budget:
        now = np.log(_variances(total, at)).sum()
        gain = [
            (now - np.log(_variances(total + one, at)).sum()) / leg.duration
            for one, leg in zip(normal, legs, strict=True)
        ]
        best = int(np.argmax(gain))
        count[best] += 1
        total = total + normal[best]
        spent += legs[best].duration
    # The summary: the widest interval of the fit, relative to its value.
    factors = dict(
        zip((names[i] for i in at), np.exp(0.5 * (np.log(_variances(total, at)) - first)), strict=True)
    )
    widths = {
        name: (e.ci95[1] - e.ci95[0]) / max(abs(e.estimate), 1e-12)
        for name in factors
        if (e := estimates.get(name.replace("added_mass", "m_eff"))) and np.isfinite(e.ci95).all()
    }
    widest = max(widths, key=lambda name: widths[name], default=next(iter(factors)))
    chosen = tuple(replace(leg, times=n) for leg, n in zip(legs, count, strict=True) if n)
    return Dive(legs=chosen, widest=widest.replace("added_mass", "m_eff"), factor=float(factors[widest]))


def _variances(information: Array, at: Sequence[int]) -> Array:
    """Return the variances of some parameters in their units squared, (n,)."""
    scale = np.sqrt(np.maximum(np.diagonal(information), 1e-300))
    inverse = np.linalg.pinv(information / np.outer(scale, scale), rcond=1e-12, hermitian=True)
    return np.maximum((np.diagonal(inverse) / scale**2)[list(at)], 1e-300)


def _information(
    stages: Stages, stage: Stage, vehicle: Vehicle, legs: Sequence[Leg]
) -> tuple[list[Leg], Array]:
    """Return the feasible steps, and the information that each adds, per product of the units of theta."""
    old, solution = stage.problem, stage.solution
    rate = 1.0 / (STEP * max(round(sampling(stages.used) / STEP), 1))
    try:
        trials = simulate_programme(
            [alternating(leg) for leg in legs],
            vehicle,
            spread=0.0,
            noise="none",
            rate=rate,
            columns=old.measured.names,
            inputs=("wrench",),
        )
    except CalibrationError:
        return [], np.empty(0)
    cut, kept = list[Segment](), list[Leg]()
    for leg, trial in zip(legs, trials, strict=True):
        one = streams(trial, stages.vehicle)
        attitude = one.motion.quaternion[np.isfinite(one.motion.quaternion).all(axis=1)]
        if len(attitude) and up_in_body(attitude)[:, 2].min() < UPRIGHT:
            continue
        parts = [
            replace(compared(s, one.motion, stages.axes), index=len(kept))
            for s in segments(one, stages.vehicle, length=stages.length, step=old.segments[0].step)
        ]
        cut += parts
        kept.append(leg)
    if not cut:
        return [], np.empty(0)
    problem = stages.problem(dict(old.parameters.damping), {}, cut)
    std = dict(zip(old.measured.names, _std_by_channel(stage), strict=True))
    # The lag of a stream that only some fitted trials have, such as positions beside velocities, does not occur here.
    own = [old.names.index(name) for name in problem.names]
    point = Point(solution.point.theta[own], np.zeros(problem.prior_std.shape))
    linear = problem.linearise(point)
    clean = replace(
        solution,
        point=point,
        linear=linear._replace(residual=np.zeros(len(linear.residual))),
        std=np.array([std[name] for name in problem.measured.names])[problem.measured.channel],
    )
    assert isinstance(clean, FitSolution)
    evidence = evidence_of(problem, clean, problem.groups[problem.measured.segment])
    finite = np.isfinite(evidence.normal).all(axis=(1, 2))
    normal = np.zeros((int(finite.sum()), len(old.names), len(old.names)))
    normal[:, np.array(own)[:, None], own] = evidence.normal[finite] / old.repeats
    return [leg for leg, good in zip(kept, finite, strict=True) if good], normal


def _std_by_channel(stage: Stage) -> list[float]:
    """Return the noise of each channel of a fit, from trials that drive its axis if there are any, in its unit."""
    m, std = stage.problem.measured, stage.solution.std
    driven = [std[m.kind == j] if (m.kind == j).any() else std[m.channel == j] for j in range(len(m.names))]
    return [float(one[0]) for one in driven]
