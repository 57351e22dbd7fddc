"""Trials with the thrusters off: free decay of roll and pitch, coasts of surge, sway and yaw, and buoyant rise.

Without a known force a motion shows ratios only: k/m, d1/m, d2/m of a decay, d1/m, d2/m of a coast, (B - W)/m of a
rise. Absolute values follow from one number that is given or the vehicle file's, which every estimate names.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, finding
from finssim.calibration.fit import Curve, Estimate, Fit
from finssim.calibration.regression.coast_down import COASTING, coast_of, coast_result
from finssim.calibration.regression.free_decay import BOTH, Decay, free_decay
from finssim.calibration.regression.instruments import Run, simulate_axis
from finssim.calibration.regression.plant_terms import Matrices, matrices
from finssim.calibration.trials.trial import Trial
from finssim.calibration.uncertainty import Evidence, correlated_samples, intervals, trial_covariance
from finssim.vehicles import AXES, Vehicle

__all__ = ["buoyant_rise", "passive", "pooled"]

Array = NDArray[np.float64]

# One estimate from several trials that were fitted one by one.


def pooled(values: Array, stds: Array, dof: Array) -> tuple[float, float, float]:
    """Mean of estimates of several trials, weighted by their certainty and what they differ by beyond it.

    The variance between trials is that of DerSimonian and Laird (1986).

    Args:
        values: (n,)
        stds: (n,)
        dof: Degrees of freedom of the standard errors, (n,).

    Returns:
        Mean and the two ends of its 95 % interval.
    """
    from scipy.stats import t

    stds = np.maximum(stds, 1e-9 * np.abs(values) + 1e-300)
    w = 1.0 / stds**2
    mean = float(np.sum(w * values) / w.sum())
    freedom = float(np.sum(np.where(np.isfinite(dof), dof, 1e6)))
    excess = float(np.sum(w * (values - mean) ** 2)) - (len(values) - 1)
    if len(values) > 1 and excess > 0.0:
        between = excess / (w.sum() - np.sum(w**2) / w.sum())
        w = 1.0 / (stds**2 + between)
        mean, freedom = float(np.sum(w * values) / w.sum()), float(len(values) - 1)
    half = float(t.ppf(0.975, max(freedom, 1.0)) / math.sqrt(w.sum()))
    return mean, mean - half, mean + half


def pooled_positive(values: Array, stds: Array, dof: Array) -> tuple[float, float, float]:
    """`pooled` on logarithms where all values are positive, as those of what cannot be negative are."""
    if not (values > 0.0).all():
        return pooled(values, stds, dof)
    mean, low, high = np.exp(np.clip(pooled(np.log(values), stds / values, dof), -500.0, 500.0))
    return float(mean), float(low), float(high)


# From free decays of roll or pitch to estimates, changes of the vehicle file and findings.

Of = Callable[[Array, Decay], float]
"""A function of x = ln w2, c1, c2 and the decay."""

SET = "hydrodynamics.calibrated"

INERTIA = "kg m²"


@dataclass(frozen=True, kw_only=True)
class DecayResult:
    """What the decays of one axis tell."""

    estimates: list[Estimate]
    changes: dict[str, Any]
    """Dotted path -> value, of the vehicle file."""
    findings: list[Finding]


@dataclass(frozen=True, kw_only=True)
class _Known:
    """The number of the vehicle file that makes absolute values of the ratios."""

    axis: str
    assume: Literal["restoring", "inertia"]
    k: float
    """B z_b - W z_g [N m/rad]"""
    m: float
    """M_RB + M_A [kg m²]"""
    rigid: float
    """M_RB [kg m²]"""

    def __post_init__(self) -> None:
        if self.assume == "restoring" and self.k <= 0.0:
            raise CalibrationError(
                f"{self.axis}: the vehicle file has a stiffness of {self.k:.4g} N m/rad, expected one above 0: give "
                "the centres of gravity and buoyancy, or assume the inertia"
            )

    @property
    def said(self) -> str:
        """For notes."""
        if self.assume == "restoring":
            return f"with the file's k = {self.k:.4g} N m/rad"
        return f"with the file's inertia {self.m:.4g} {INERTIA}"

    def inertia(self, x: Array, _: Decay) -> float:
        """[kg m²]"""
        return self.k / math.exp(x[0]) if self.assume == "restoring" else self.m

    def path(self, family: str) -> str:
        """Of the axis' own entry in a matrix of the vehicle file."""
        i = AXES.index(self.axis)
        return f"{SET}.{family}.{i}.{i}"


def decay_result(
    axis: str, decays: Sequence[Decay], plant: Matrices, assume: Literal["restoring", "inertia"]
) -> DecayResult:
    """Estimates of roll or pitch, pooled over its decays.

    Args:
        axis: `roll` or `pitch`.
        decays: One or more.
        plant: Of the vehicle file.
        assume: Which of its numbers is right, as of `passive`.

    Raises:
        CalibrationError: The stiffness is to be right, and is not above 0.
    """
    i = AXES.index(axis)
    rigid = float(plant.M_RB[i, i])
    known = _Known(
        axis=axis, assume=assume, k=float(plant.arm[2]), m=float(plant.M_RB[i, i] + plant.M_A[i, i]), rigid=rigid
    )  # fmt: skip
    swing = _swings(decays)
    frequency = _positive(f"{axis}.natural_frequency", "rad/s", decays, lambda x, _: math.exp(0.5 * x[0]))
    ratio = _positive(f"{axis}.damping_ratio", "-", decays, _damping_ratio, note=f"at {swing}")
    whole = _positive(f"{axis}.m_eff", INERTIA, decays, known.inertia, note=known.said)
    damping = [
        _damping("d1", 1, "N m s", known.path("linear_damping"), decays, known, swing),
        _damping("d2", 2, "N m s²", known.path("quadratic_damping"), decays, known, swing),
    ]
    changes: dict[str, Any] = {}
    if ratio.identifiable and whole.identifiable:
        changes |= {str(e.path): max(e.estimate, 0.0) for e in damping}
    drifts = [finding("equilibrium_moved", d.trial, axis=axis) for d in decays if d.drift]
    if assume == "inertia":
        k = _stiffness(decays, known)
        taken = replace(whole, identifiable=False)
        return DecayResult(estimates=[frequency, ratio, taken, *damping, k], changes=changes, findings=drifts)
    added, contradictions = _added_mass(whole, known)
    if added.estimate > 0.0 and whole.identifiable:
        changes[str(added.path)] = added.estimate
    return DecayResult(
        estimates=[frequency, ratio, whole, added, *damping], changes=changes, findings=contradictions + drifts
    )  # fmt: skip


def _swings(decays: Sequence[Decay]) -> str:
    """The largest rates, for notes."""
    swings = sorted(d.swing for d in decays)
    if len(swings) > 1:
        return f"swings of {swings[0]:.2g}-{swings[-1]:.2g} rad/s"
    return f"a swing of {swings[0]:.2g} rad/s"


def _damping_ratio(x: Array, d: Decay) -> float:
    # A quadratic term counts as the linear one that takes the same energy out of the largest swing.
    return float((x[1] + 8.0 / (3.0 * math.pi) * x[2] * d.swing) / (2.0 * math.exp(0.5 * x[0])))


def _positive(
    name: str, unit: str, decays: Sequence[Decay], of: Of, *, note: str = "", path: str | None = None
) -> Estimate:
    """A number that cannot be negative, pooled over the decays."""
    value, low, high = pooled_positive(*_derived(decays, of))
    sure = bool(np.isfinite([low, high]).all() and 0.5 * (high - low) <= 0.5 * abs(value))
    return Estimate(
        name=name, estimate=value, ci95=(low, high), unit=unit, identifiable=sure,
        note=note if sure or note else "not known to half its size", path=path,
    )  # fmt: skip


def _damping(
    name: str, j: int, unit: str, path: str, decays: Sequence[Decay], known: _Known, swing: str
) -> Estimate:
    """m c_j, pooled over the decays in which c_j was fitted."""
    some = [d for d in decays if d.terms[j - 1]]
    value, low, high, note = 0.0, math.nan, math.nan, f"{swing} need it not"
    if some:
        value, low, high = pooled(*_derived(some, lambda x, d: float(x[j]) * known.inertia(x, d)))
        note = known.said
    return Estimate(
        name=f"{known.axis}.{name}", estimate=value, ci95=(low, high), unit=unit, identifiable=low > 0.0, note=note,
        path=path,
    )  # fmt: skip


def _stiffness(decays: Sequence[Decay], known: _Known) -> Estimate:
    """k = m w2 of a known inertia."""
    return _positive(
        f"{known.axis}.k", "N m/rad", decays, lambda x, _: known.m * math.exp(x[0]), note=known.said,
        path="body.center_of_buoyancy.2",
    )  # fmt: skip


def _added_mass(whole: Estimate, known: _Known) -> tuple[Estimate, list[Finding]]:
    """The inertia less the file's rigid one, and a finding where that is negative."""
    rigid, (low, high) = known.rigid, whole.ci95
    added = Estimate(
        name=f"{known.axis}.added_mass", estimate=whole.estimate - rigid, ci95=(low - rigid, high - rigid),
        unit=INERTIA, identifiable=whole.identifiable and low > rigid, note=known.said,
        path=known.path("added_mass"),
    )  # fmt: skip
    if added.estimate > 0.0:
        return added, []
    return added, [
        finding("inertia_below_rigid", known.axis, assumed=known.said, inertia=whole.estimate, rigid=rigid)
    ]


def _derived(decays: Sequence[Decay], of: Of) -> tuple[Array, Array, Array]:
    """A function of every decay: its values, their standard errors and degrees of freedom, (n,) each."""
    found = np.array([_of_one(d, of) for d in decays]).reshape(len(decays), 3)
    return found[:, 0], found[:, 1], found[:, 2]


def _of_one(decay: Decay, of: Of) -> tuple[float, float, float]:
    x = np.array([math.log(decay.theta[0]), decay.theta[1], decay.theta[2]])
    free = np.array([True, *decay.terms])
    slope = np.zeros(3)
    for j in np.flatnonzero(free):
        h = 1e-6 * max(1.0, abs(x[j]))
        step = np.zeros(3)
        step[j] = h
        slope[j] = (of(x + step, decay) - of(x - step, decay)) / (2.0 * h)
    C = decay.covariance
    matrix = np.where(C.alone.any(), C.local, C.trials)
    variance = float(slope[free] @ matrix @ slope[free])
    dof = float(np.min(C.dof[np.isfinite(C.dof)], initial=np.inf))
    return float(of(x, decay)), math.sqrt(max(variance, 0.0)), dof


# A vehicle let go under water: the terminal speed of its rise, and what the rise says of buoyancy.


RISING = 0.01
"""Vertical speed that counts as a rise [m/s] (published procedure)."""

SHORTEST = 3.0
"""[s]"""

STEP = 0.02
"""Of the simulation [s]."""


@dataclass(frozen=True, kw_only=True)
class Rise:
    """z_dot_dot = e - c1 z_dot, or e - c2 |z_dot| z_dot; z up."""

    trial: str
    begin: float
    """On the trial's clock [s]."""
    end: float
    quadratic: bool
    """Whether the drag is c2 (the better of the two; one rise cannot show both)."""
    terminal_speed: float
    """[m/s]"""
    terminal_ci95: tuple[float, float]
    excess_ratio: float
    """e = (B - W) / m_eff [m/s²]."""
    excess_ci95: tuple[float, float]
    """Wide where the rise was steady from the start, for then only the terminal speed is known."""
    t: Array
    z: Array
    """Fitted [m]."""
    measured: Array
    """[m]"""


def buoyant_rise(trial: Trial) -> Rise:
    """Fit the longest rise of a trial without thrust.

    Args:
        trial: With `z` or `depth`.

    Raises:
        CalibrationError: Neither was measured, or nothing rises for 3 s.
    """
    t, z = trial.series("z") if trial.has("z") else trial.series("depth")
    z = z if trial.has("z") else -z
    if len(t) < 20:
        raise CalibrationError("neither z nor depth: nothing to see a rise in", trial.name)
    begin, end = _longest_rise(t, z, trial.name)
    inside = (t >= begin) & (t <= end)
    t, z = t[inside], z[inside]
    fits = [_fit(t, z, quadratic) for quadratic in (False, True)]
    best = int(np.argmin([float(np.sum(r**2)) for _, r, _ in fits]))
    x, r, J = fits[best]
    correlated = correlated_samples(r)
    blocks = max(6, int(len(r) / (4.0 * correlated)))
    cut = np.array_split(np.arange(len(r)), min(blocks, 24))
    k = 2
    project = np.linalg.lstsq(J[:, k:], J[:, :k], rcond=1e-12)[0]
    own = J[:, :k] - J[:, k:] @ project
    variance = float(np.mean(r**2)) * correlated
    covariance = trial_covariance(
        Evidence(
            names=("ln_speed", "ln_excess"),
            normal=np.array([own[i].T @ own[i] for i in cut]) / variance,
            score=np.array([-own[i].T @ r[i] for i in cut]) / variance,
            unit="blocks",
        )
    )
    ends = np.exp(np.clip(intervals(x[:k], covariance), -50.0, 50.0))
    return Rise(
        trial=trial.name,
        begin=begin,
        end=end,
        quadratic=bool(best),
        terminal_speed=float(np.exp(x[0])),
        terminal_ci95=(float(ends[0, 0]), float(ends[0, 1])),
        excess_ratio=float(np.exp(x[1])),
        excess_ci95=(float(ends[1, 0]), float(ends[1, 1])),
        t=t,
        z=z + r,
        measured=z,
    )


def _longest_rise(t: Array, z: Array, name: str) -> tuple[float, float]:
    """The longest stretch in which the height over half a second grows faster than `RISING`."""
    grid = np.arange(t[0], t[-1], 0.1)
    height = np.interp(grid, t, z)
    if len(height) > 5:
        height = np.convolve(np.pad(height, 2, mode="edge"), np.full(5, 0.2), "valid")
    up = np.gradient(height, 0.1) > RISING
    edges = np.flatnonzero(np.diff(np.concatenate([[False], up, [False]]).astype(np.int8))).reshape(-1, 2)
    longest = max(edges, key=lambda e: e[1] - e[0], default=(0, 0))
    if (longest[1] - longest[0]) * 0.1 < SHORTEST:
        raise CalibrationError(
            f"nothing rises faster than {RISING} m/s for {SHORTEST:g} s: expected a vehicle let go under water",
            name,
        )
    return float(grid[longest[0]]), float(grid[longest[1] - 1])


def _fit(t: Array, z: Array, quadratic: bool) -> tuple[Array, Array, Array]:
    """x = ln terminal speed, ln e, w(0), z(0); residuals fitted - measured [m]; their Jacobian."""
    from scipy.optimize import least_squares

    grid = np.arange(t[0], t[-1] + STEP, STEP)

    def run(x: Array) -> Array:
        speed, e = np.exp(x[0]), np.exp(x[1])
        one, none = np.ones_like(e), np.zeros_like(e)
        theta = np.stack([one, none if quadratic else e / speed, e / speed**2 if quadratic else none, none])
        runs = [
            Run(np.full(len(grid) - 1, value), STEP, float(w), float(h))
            for value, w, h in zip(e, x[2], x[3], strict=True)
        ]
        _, heights = simulate_axis(theta, runs)
        return np.stack([np.interp(t, grid, h) for h in heights], axis=1)

    def residual(x: Array) -> Array:
        return np.asarray(run(x[:, None])[:, 0] - z)

    def jacobian(x: Array) -> Array:
        h = 1e-5
        both = run(x[:, None] + h * np.concatenate([np.eye(4), -np.eye(4)], axis=1))
        return np.asarray((both[:, :4] - both[:, 4:]) / (2.0 * h))

    late = t > t[-1] - 0.3 * (t[-1] - t[0])
    speed = max(float(np.polyfit(t[late], z[late], 1)[0]), RISING)
    early = t < t[0] + 0.2 * (t[-1] - t[0])
    first = float(np.polyfit(t[early], z[early], 1)[0])
    start = np.array([np.log(speed), np.log(speed), first, z[0]])
    low = np.array([np.log(speed) - 3.0, np.log(speed) - 6.0, -np.inf, -np.inf])
    high = np.array([np.log(speed) + 3.0, np.log(speed) + 6.0, np.inf, np.inf])
    solved = least_squares(residual, start, jacobian, bounds=(low, high), x_scale="jac")
    return solved.x, residual(solved.x), jacobian(solved.x)


def passive(
    trials: Sequence[Trial],
    vehicle: Vehicle,
    *,
    axes: Sequence[str] | None = None,
    assume: Literal["restoring", "inertia"] = "restoring",
    known: Mapping[str, float] | None = None,
) -> Fit:
    """What trials without thrust tell.

    Args:
        trials: Each with one release.
        vehicle: Gives the number that is taken as known.
        axes: All if None.
        assume: `restoring`: the stiffness k = B z_b - W z_g of the file is right; `inertia`: its M_RB + M_A is.
        known: Effective inertias M_RB + M_A that are known, by axis [kg, kg m²], for coasts.

    Raises:
        CalibrationError: No trial shows a decay or a rise.
    """
    plant = matrices(vehicle)
    estimates: dict[str, Estimate] = {}
    changes: dict[str, Any] = {}
    quality: dict[str, dict[str, float]] = {}
    findings, missing = list[Finding](), list[CalibrationError]()
    curves, used = list[Curve](), set[str]()
    for axis in ("roll", "pitch"):
        decays = _decays(trials, axis, missing) if axes is None or axis in axes else []
        if not decays:
            continue
        found = decay_result(axis, decays, plant, assume)
        estimates |= {e.name: e for e in found.estimates}
        changes |= found.changes
        findings += found.findings
        quality[axis] = _decay_quality(decays)
        curves += [_decay_curve(d) for d in decays]
        used |= {d.trial for d in decays}
    rises = _each(trials, buoyant_rise, missing) if axes is None or "heave" in axes else []
    if rises:
        risen = _rise_estimates(rises, plant)
        estimates |= risen
        findings += _contradictions(risen, plant)
        curves += [_rise_curve(rise) for rise in rises]
        used |= {rise.trial for rise in rises}
    for axis in COASTING:
        wanted = axes is None or axis in axes
        coasts = _each(trials, partial(coast_of, axis=axis, vehicle=vehicle), missing) if wanted else []
        if coasts:
            coasted = coast_result(axis, coasts, vehicle, plant, known or {})
            estimates |= {e.name: e for e in coasted.estimates}
            changes |= coasted.changes
            quality[axis] = coasted.quality
            curves += coasted.curves
            used |= {coast.trial for coast in coasts}
    if not estimates:
        reasons = "; ".join(str(error) for error in missing if error.subject == trials[0].name)
        others = f"; and {len(trials) - 1} trials more" if len(trials) > 1 else ""
        raise CalibrationError(
            f"no trial shows a free decay, a coast or a rise: {reasons or 'none was given'}{others}"
        )
    # That a trial shows one motion and not the others is no news.
    findings += [
        finding("unusable", error.subject, severity="care", reason=error.reason)
        for error in missing
        if error.subject not in used
    ]
    return Fit(
        kind="hydrodynamics",
        method="passive",
        vehicle=vehicle,
        estimates=estimates,
        changes=changes,
        quality=quality,
        findings=tuple(dict.fromkeys(findings)),
        curves=tuple(curves),
        trials={trial.name: trial.sha256 for trial in trials if trial.name in used},
        settings={"assume": assume},
    )


def _decays(trials: Sequence[Trial], axis: str, missing: list[CalibrationError]) -> list[Decay]:
    """Those of one axis, all with the same kind of damping."""
    decays: list[Decay] = _each(trials, partial(free_decay, axis=axis), missing)
    if len({d.terms for d in decays}) > 1:  # one vehicle, one kind of damping
        swinging = {d.trial for d in decays}
        decays = [free_decay(trial, axis, terms=BOTH) for trial in trials if trial.name in swinging]
    return decays


def _decay_quality(decays: Sequence[Decay]) -> dict[str, float]:
    return {
        "r2": float(np.mean([d.r2 for d in decays])),
        "trials": float(len(decays)),
        "seconds": float(sum(d.end - d.begin for d in decays)),
    }


def _each(
    trials: Sequence[Trial], find: Callable[[Trial], Any], missing: list[CalibrationError]
) -> list[Any]:
    """What is found in each trial; why one shows nothing goes to `missing`."""
    found = []
    for trial in trials:
        try:
            found.append(find(trial))
        except CalibrationError as error:
            missing.append(error)
    return found


def _rise_estimates(rises: list[Rise], plant: Matrices) -> dict[str, Estimate]:
    """Pooled over the trials, on logarithms."""
    m = float(plant.M_RB[2, 2] + plant.M_A[2, 2])
    speed = _pooled([(r.terminal_speed, *r.terminal_ci95) for r in rises])
    ratio = _pooled([(r.excess_ratio, *r.excess_ci95) for r in rises])
    drag = ", ".join(f"{r.trial}: {'quadratic' if r.quadratic else 'linear'} drag" for r in rises)
    found = [
        Estimate(
            name="heave.terminal_speed", estimate=speed[0], ci95=speed[1:], unit="m/s",
            identifiable=speed[2] < 3.0 * speed[1], note=f"of a rise; {drag}",
        ),
        Estimate(
            name="buoyancy_excess", estimate=m * ratio[0], ci95=(m * ratio[1], m * ratio[2]), unit="N",
            identifiable=ratio[2] < 3.0 * ratio[1],
            note=f"from the acceleration, with the file's mass and added mass in heave, {m:.4g} kg",
            path="body.displaced_volume",
        ),
    ]  # fmt: skip
    return {e.name: e for e in found}


def _contradictions(found: dict[str, Estimate], plant: Matrices) -> list[Finding]:
    """A finding where the file's excess of buoyancy, which a rise does not replace, lies outside the interval."""
    excess = found.get("buoyancy_excess")
    if excess is None or excess.ci95[0] <= plant.excess <= excess.ci95[1]:
        return []
    low, high = excess.ci95
    fields = {"file": plant.excess, "low": low, "high": high}
    sinks = plant.excess < 0.0 < low
    return [
        finding("buoyancy_sign", "heave", **fields)
        if sinks
        else finding("buoyancy_contradicted", "heave", **fields)
    ]


def _pooled(found: list[tuple[float, float, float]]) -> tuple[float, float, float]:
    """Of estimates with 95 % intervals that are symmetric on logarithms."""
    value, low, high = np.array(found).T
    return pooled_positive(value, value * np.log(high / low) / (2.0 * 1.96), np.full(len(found), np.inf))


def _decay_curve(d: Decay) -> Curve:
    t, measured = d.rate_measured if len(d.rate_measured[0]) else d.sine_measured
    line = d.rate if len(d.rate_measured[0]) else d.sine
    return Curve(
        title=f"{d.trial}: free decay of {d.axis}", x_label="time [s]",
        y_label="rate [rad/s]" if line is d.rate else "sine of the angle [-]",
        x=t, measured=measured, fitted=np.interp(t, d.t, line),
    )  # fmt: skip


def _rise_curve(rise: Rise) -> Curve:
    return Curve(
        title=f"{rise.trial}: rise", x_label="time [s]", y_label="height [m]", x=rise.t, measured=rise.measured,
        fitted=rise.z,
    )  # fmt: skip
