"""Hydrodynamics axis by axis: the regression of paper, eq. 6, over many trials."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.core.rotations import quat_inverse_rotate
from finssim.identification.fit import Correlation, Curve, Estimate, Fit
from finssim.identification.regression.axis_estimates import (
    LARGE_DELAY,
    curves_of,
    hydrostatics,
    quality,
    regression_result,
    worthless,
)
from finssim.identification.regression.axis_fit import (
    DAMPING,
    TERMS,
    AxisData,
    Selection,
    Signals,
    axis_rows,
    informative,
    kernel,
    select,
    signals,
)
from finssim.identification.regression.passive import passive
from finssim.identification.regression.plant_terms import Matrices, matrices
from finssim.identification.uncertainty import degeneracy
from finssim.trials.findings import CalibrationError, Finding, finding, sentences
from finssim.trials.inputs import drive, require_axes, require_fittable
from finssim.trials.motion import Motion, attitude_samples, motion, white_noise
from finssim.trials.trial import Trial
from finssim.vehicles import AXES, Vehicle

__all__ = ["axis_data", "prepare", "regress"]

Array = NDArray[np.float64]

USEFUL = 0.5
"""Half width of the interval, as a part of the excess, up to which it is written to the vehicle file."""

FAINT = 0.002
"""The same as a part of the weight: what a thousandth of the volume does matters little."""


def buoyancy_estimate(chosen: Selection, vehicle: Vehicle) -> Estimate:
    """B - W from the bias of heave: m w_dot + d1 w + d2 |w| w + b = tau_z, b = -(B - W).

    Coasts and motion both ways tell it from the damping; without them the interval is wide.

    Args:
        chosen: The model of heave.
        vehicle: For its weight, which is taken as exact.
    """
    bias = TERMS.index("bias")
    low, high = (float(x) for x in chosen.interval[bias])
    value = -float(chosen.fit.theta[bias])
    half = 0.5 * (high - low)
    known = bool(np.isfinite(half) and half <= max(USEFUL * abs(value), FAINT * vehicle.weight))
    volume = (vehicle.weight + value) / (vehicle.water.density * vehicle.water.gravity)
    note = f"with the file's weight a displaced volume of {volume:.6g} m³"
    return Estimate(
        name="buoyancy_excess",
        estimate=value,
        ci95=(-high, -low),
        unit="N",
        identifiable=known,
        note=note if known else f"uncertain by more than half its value: dive and coast; {note}",
        path="body.displaced_volume",
    )


# Which trials tell of which axis, and their rows.

LEAST_WRENCH = 0.05
"""Part of the vehicle's wrench limit that an input has to span to count as an excitation of its axis."""

LEAST_OF_LARGEST = 0.1
"""Part of the largest span among the trials that an input has to reach."""

FEWEST_ROWS = 10

HALF_WIDTH = (0.5, 0.25)
"""Of the bump [s]: wide, so that a smoothed velocity is no harm; shorter for roll and pitch, which swing."""

QUIET = 0.02
"""Noise of the velocity, as a part of its range, that needs no smoothing before |nu| nu is formed."""


LARGEST_TILT = 25.0
"""Beyond it samples of surge, sway, heave and yaw rest on the other axes [deg] (published procedure: 20)."""


WORTH_SAYING = 0.1
"""Share of tilted samples that were kept from which a warning says so."""


@dataclass(frozen=True, kw_only=True)
class Prepared:
    """A trial on its grid."""

    trial: Trial
    motion: Motion
    up: Array
    """World z in the body frame, in straight lines between samples and not smoothed, (n, 3); NaN where unknown."""
    current: Array | None
    """Of the water, where the velocity does not know of it, world frame [m/s], (3,)."""


def prepare(trials: Sequence[Trial], vehicle: Vehicle) -> tuple[list[Prepared], list[Finding]]:
    """Trials on their grids, and a finding on each that cannot be used or that something was assumed of."""
    out, findings = [], []
    for trial in trials:
        try:
            found = motion(trial, vehicle)
            held = drive(trial, vehicle)
        except CalibrationError as error:
            findings.append(finding("unusable", trial.name, severity="care", reason=error.reason))
            continue
        findings += [one.about(trial.name) for one in found.findings]
        if held.held and not held.commanded:
            # A row's value acts until the next row: at the row itself the wrench jumps, and the middle of the jump has
            # the same integral under any smooth weight.
            before = np.concatenate([found.tau[:1], found.tau[:-1]])
            found = replace(found, tau=0.5 * (np.where(np.isfinite(before), before, found.tau) + found.tau))
        water = trial.header.water
        moving = water.current is not None and any(water.current)
        current = np.asarray(water.current) if moving else None
        out.append(Prepared(trial=trial, motion=found, up=_up(trial, found), current=current))
    return out, findings


def _up(trial: Trial, found: Motion) -> Array:
    """Not smoothed, for that would bias inertia and damping of roll and pitch; the regression handles noise itself."""
    t, q, _ = attitude_samples(trial)
    known = np.asarray(np.isfinite(found.quaternion).all(axis=1))
    if not known.any():
        return np.full((len(found.t), 3), np.nan)
    sampled = quat_inverse_rotate(q / np.linalg.norm(q, axis=1, keepdims=True), np.array([0.0, 0.0, 1.0]))
    up = np.stack([np.interp(found.t, t, column) for column in sampled.T], axis=-1)
    return np.where(known[:, None], up, np.nan)


def excited(prepared: Sequence[Prepared], vehicle: Vehicle) -> NDArray[np.bool_]:
    """Which axes each trial excites, (trials, 6): as its header says, else by the span of its input."""
    span = np.array([_span(one.motion.tau, vehicle) for one in prepared]).reshape(-1, 6)
    enough = span >= np.maximum(
        LEAST_WRENCH * vehicle.wrench_limits, LEAST_OF_LARGEST * span.max(axis=0, initial=0.0)
    )
    for g, one in enumerate(prepared):
        if one.trial.header.axis:
            enough[g] = [axis in one.trial.header.axis for axis in AXES]
        elif one.trial.header.passive:
            enough[g] = False
    return np.asarray(enough & (span > 0.0))


def _span(tau: Array, vehicle: Vehicle) -> Array:
    """Range of the wrench about the vehicle's wrench reference without the outermost hundredths, (6,)."""
    from finssim.sim.plant_arrays import twist_shift

    about = tau @ np.linalg.inv(twist_shift(list(vehicle.wrench_reference)))
    good = about[np.isfinite(about).all(axis=1)]
    if len(good) < 2:
        return np.zeros(6)
    low, high = np.percentile(good, [1.0, 99.0], axis=0)
    return np.asarray(high - low)


def axis_data(
    axis: int, prepared: Sequence[Prepared], plants: Sequence[Matrices], *, keep_tilted: bool = False
) -> tuple[AxisData | None, list[Finding]]:
    """Rows of one axis from the trials that excite it.

    Args:
        axis: 0 surge to 5 yaw.
        prepared: The trials.
        plants: The vehicle in the water of each.
        keep_tilted: Whether samples beyond `LARGEST_TILT` stay: where the axes that they depend on are fitted too.

    Returns:
        None where no trial can be used; and findings on what was left out.
    """
    said, kept, tilted, of = list[Finding](), [], 0.0, str(AXES[axis])
    for one, plant in zip(prepared, plants, strict=True):
        found, name = one.motion, one.trial.name
        if not np.isfinite(found.nu[:, axis]).any():
            said.append(finding("axis_unmeasured", name, axis=of))
        elif axis in (3, 4) and not np.isfinite(found.quaternion).any():
            said.append(finding("attitude_needed", name, axis=of))
        else:
            kept.append(signals(name, found, one.up, plant, current=one.current))
    if axis not in (3, 4):
        kept, tilted, cut = _level(kept, keep_tilted)
        said += [one.about(of) for one in cut]
    speeds = [s.nu[s.usable & np.isfinite(s.nu[:, axis]), axis] for s in kept]
    largest = max((float(np.percentile(np.abs(nu), 95.0)) for nu in speeds if len(nu) >= 10), default=0.0)
    out = []
    for s, nu in zip(kept, speeds, strict=True):
        noise = float(np.nan_to_num(white_noise(nu)))
        # White noise of n samples shrinks by √n; a bump of half width w averages some 1.2 w rate of them.
        needed = (noise / max(QUIET * largest, 1e-12)) ** 2
        kernels = kernel(
            s.rate, half_width=HALF_WIDTH[axis in (3, 4)], short=float(min(0.15, needed / (1.2 * s.rate)))
        )
        rows = axis_rows(s, axis, kernels)
        if rows is None:
            said.append(finding("no_stretch", s.name, axis=of, seconds=len(kernels.phi) / s.rate))
        elif informative(rows, s).sum() < FEWEST_ROWS:
            said.append(finding("axis_idle", s.name, axis=of))
        else:
            out.append((s, rows, kernels))
    if not out:
        return None, said
    return AxisData(
        axis=axis,
        signals=tuple(s for s, _, _ in out),
        rows=tuple(r for _, r, _ in out),
        kernels=tuple(k for _, _, k in out),
        tilted=tilted,
    ), said


def later(data: AxisData, by: float) -> AxisData:
    """The same with the wrench put later by a time [s], as the motion was recorded; the column of `delay` has the rest.

    That column alone is right to first order only, which a tenth of a second is too long for.
    """
    moved, rows = [], []
    for s, own, kernels in zip(data.signals, data.rows, data.kernels, strict=True):
        known = np.isfinite(s.left[:, data.axis])
        left = s.left.copy()
        if known.any():
            line = np.interp(s.t - by, s.t[known], s.left[known, data.axis])
            left[:, data.axis] = np.where(known, line, np.nan)
        moved.append(replace(s, left=left))
        rows.append(axis_rows(moved[-1], data.axis, kernels) or own)
    return replace(data, signals=tuple(moved), rows=tuple(rows), shift=data.shift + by)


def _level(found: list[Signals], keep: bool) -> tuple[list[Signals], float, list[Finding]]:
    """Without samples at large tilt, the share of those, and a finding where there were any.

    There weight, Coriolis forces and the other axes' drag are as large as the thrust; the file knows them at best.
    """
    level = [~(s.up[:, 2] < np.cos(np.radians(LARGEST_TILT))) for s in found]
    inside = [s.usable & s.wanted for s in found]
    total = sum(int(own.sum()) for own in inside)
    beyond = sum(int((own & ~flat).sum()) for own, flat in zip(inside, level, strict=True))
    if not beyond:
        return found, 0.0, []
    percent = 100.0 * beyond / total
    if keep and beyond < WORTH_SAYING * total:
        return found, 0.0, []
    if keep:
        return found, 0.0, [finding("tilted_kept", percent=percent, tilt=LARGEST_TILT)]
    cut = [replace(s, usable=s.usable & flat) for s, flat in zip(found, level, strict=True)]
    return cut, beyond / total, [finding("tilted_left_out", percent=percent, tilt=LARGEST_TILT)]


PASSES = 3
"""Rounds in which the couplings between axes are formed with the latest estimates."""

LARGEST_SHIFT = 0.5
"""Lag beyond which the wrench is not put later, but the trial doubted [s]."""

TILTS_INTO = {0: {1, 2}, 1: {0, 2}, 2: {0, 1}, 5: {0, 1}}
"""Axes whose coefficients decide an axis' motion at large tilt: what surge turns over sways too."""

INERTIA_PRIOR = (0.7, 0.3, 0.5)
"""Standard deviation of what the file expects: of added mass, as a part of it (a factor of two); of an effective mass
at least, as a part of it; of an effective moment of inertia, as a part of it."""

DRAG_PRIOR = 1.0
"""The same of its drag at the highest speed of the trials, for either of the two terms alone."""

DELAY_STD = 0.15
"""Of the time by which motion lags or leads the wrench [s]: motors, filters and two clocks."""

SETTLED = 2e-3
"""Change of the left side, as a part of it, below which another round is not needed."""


def regress(
    trials: Sequence[Trial],
    vehicle: Vehicle,
    *,
    axes: Sequence[str] | None = None,
    damping: str = "auto",
    known: Mapping[str, float] | None = None,
    file_prior: bool = True,
    progress: Callable[[float, str], None] | None = None,
) -> Fit:
    """Effective mass, damping, bias and, in roll and pitch, stiffness of every axis that the trials excite.

    m_eff nu_dot + d1 nu + d2 |nu| nu + b (+ k sin eta) = tau                                (paper, eq. 6)

    about the reference point of the vehicle's calibrated coefficients, in the weak form, with velocities simulated from
    the recorded wrench as instruments, Huber weights, and intervals from the disagreement of the trials.

    Args:
        trials: Trials; each names the axes it excites, or they are found from its input.
        vehicle: Gives the rigid body, what is known of couplings, and where the numbers go.
        axes: Axes to fit; all that are excited if None.
        damping: `auto`, `linear`, `quadratic` or `both`.
        known: Effective inertias M_RB + M_A that are known, by axis [kg, kg m²].
        file_prior: Whether the inertia and drag of the vehicle file count as a prior, within a factor of two or so.
        progress: Called with the part done and a few words.

    Raises:
        CalibrationError: No trial can be used, one is held out, an axis or damping is unknown, or two share a
            name.
    """
    require_axes(axes)
    wanted = [i for i, axis in enumerate(AXES) if axes is None or axis in axes]
    if damping not in DAMPING:
        raise CalibrationError(f"unknown damping '{damping}'; available: {', '.join(DAMPING)}")
    require_fittable(trials, vehicle)
    driven = [trial for trial in trials if not trial.header.passive]
    tell = progress or (lambda part, text: None)
    tell(0.0, "smoothing the trials")
    prepared, findings = prepare(driven, vehicle)
    chosen, more = _fit_axes(
        prepared, vehicle, wanted, axes is not None, damping, known or {}, file_prior, tell
    )
    findings += more
    file = matrices(vehicle)
    estimates: dict[str, Estimate] = {}
    changes: dict[str, Any] = {}
    figures: dict[str, dict[str, float]] = {}
    curves: list[Curve] = []
    told = []
    for i, (data, selection) in chosen.items():
        result, worthless_for = regression_result(data, selection, file)
        estimates |= result.estimates
        changes |= result.changes
        findings += result.findings
        figures[AXES[i]] = quality(data, selection)
        curves += curves_of(data, selection)
        told += [] if worthless_for else [i]
        if i == 2:
            buoyancy = buoyancy_estimate(selection, vehicle)
            if worthless_for:
                buoyancy = replace(buoyancy, identifiable=False, note=worthless_for)
            estimates[buoyancy.name] = buoyancy
    used = {s.name for data, _ in chosen.values() for s in data.signals}
    still, notes = hydrostatics(estimates, vehicle)
    changes |= still
    findings += notes
    quiet_trials, open_axes = (
        [t for t in trials if t.header.passive],
        [AXES[i] for i in wanted if i not in told],
    )
    if quiet_trials and open_axes:
        quiet = passive(
            quiet_trials, vehicle, axes=open_axes, damping=damping, known=known, progress=progress
        )
        estimates |= quiet.estimates
        changes |= quiet.changes
        figures |= quiet.quality
        findings += quiet.findings
        curves += quiet.curves
        used |= set(quiet.trials)
    if not estimates:
        raise CalibrationError(
            f"no axis of {vehicle.name} can be fitted from these trials: "
            f"{'; '.join(sentences(findings)) or 'none excites an axis'}"
        )
    correlation, traded = _correlation(chosen)
    return Fit(
        kind="hydrodynamics",
        method="regression",
        before=vehicle,
        estimates=estimates,
        changes=changes,
        quality=figures,
        correlation=correlation,
        findings=tuple(dict.fromkeys([*findings, *traded])),
        curves=tuple(curves),
        trials={trial.name: trial.sha256 for trial in trials if trial.name in used},
        settings={
            "damping": damping,
            "axes": [AXES[i] for i in chosen],
            **({"fix": {f"{axis}.m": m for axis, m in known.items()}} if known else {}),
        },
    )


def _fit_axes(
    prepared: list[Prepared],
    vehicle: Vehicle,
    wanted: list[int],
    asked: bool,
    damping: str,
    known: Mapping[str, float],
    file_prior: bool,
    tell: Callable[[float, str], None],
) -> tuple[dict[int, tuple[AxisData, Selection]], list[Finding]]:
    """Data and model of every axis that can be fitted; couplings between axes use the estimates of the round before."""
    file = matrices(vehicle)
    findings = list[Finding]()
    waters = [matrices(vehicle, one.trial.header.water.density) for one in prepared]
    active = excited(prepared, vehicle) if prepared else np.zeros((0, 6), bool)
    fitted = {i for i in wanted if active[:, i].any()}
    chosen: dict[int, tuple[AxisData, Selection]] = {}
    for round_ in range(PASSES):
        settled, former = True, chosen
        chosen, findings = {}, []
        for k, i in enumerate(wanted):
            tell((round_ + k / len(wanted)) / PASSES, f"regression of {AXES[i]}")
            those = np.flatnonzero(active[:, i])
            keep = TILTS_INTO.get(i, set()) <= fitted
            data, said = axis_data(
                i, [prepared[g] for g in those], [waters[g] for g in those], keep_tilted=keep
            )
            findings += said
            if data is None:
                if asked and not len(those):
                    findings.append(finding("axis_not_driven", str(AXES[i])))
                continue
            data = replace(data, inertia=known.get(AXES[i]), prior=prior(data, file, file_prior))
            if i in former and former[i][0].shift:
                data = later(data, former[i][0].shift)
            if round_ and i in former and _same(former[i][0], data):
                chosen[i] = (data, former[i][1])
                continue
            settled = False
            chosen[i] = (data, select(data, damping))
            lag = float(chosen[i][1].fit.theta[TERMS.index("delay")])
            if not data.shift and LARGE_DELAY < abs(lag) < LARGEST_SHIFT:
                data = later(data, lag)
                chosen[i] = (data, select(data, damping))
        if settled:
            break
        for i, (data, selection) in chosen.items():
            m, d1, d2 = selection.fit.theta[:3]
            if not worthless(data, quality(data, selection), selection):
                waters = [w.with_axis(i, m - w.M_RB[i, i], max(d1, 0.0), max(d2, 0.0)) for w in waters]
    return chosen, findings


def prior(data: AxisData, file: Matrices, file_prior: bool) -> dict[str, tuple[float, float]]:
    """What is known of an axis before any trial: mean and standard deviation by term.

    Args:
        data: Its trials.
        file: The vehicle as its file has it.
        file_prior: Whether that counts; a delay is expected to be short in any case.
    """
    out, i = {"delay": (0.0, DELAY_STD)}, data.axis
    if not file_prior:
        return out
    m = float(file.M_RB[i, i] + file.M_A[i, i])
    added, least, turning = INERTIA_PRIOR
    std = turning * m if i > 2 else max(added * float(file.M_A[i, i]), least * m)
    top = float(np.percentile(np.concatenate([np.abs(rows.X[:, 1]) for rows in data.rows]), 95.0))
    d1, d2 = float(file.D1[i, i]), float(file.D2[i, i])
    drag = d1 * top + d2 * top**2
    out |= {"m_eff": (m, std)} if std > 0.0 else {}
    if drag > 0.0:
        out |= {"d1": (d1, DRAG_PRIOR * drag / top), "d2": (d2, DRAG_PRIOR * drag / top**2)}
    return out


def _same(before: AxisData, now: AxisData) -> bool:
    """Whether the left sides differ so little that the estimates need not be formed anew."""
    if [s.name for s in before.signals] != [s.name for s in now.signals]:
        return False
    old = np.concatenate([rows.y for rows in before.rows])
    new = np.concatenate([rows.y for rows in now.rows])
    return len(old) == len(new) and float(np.std(new - old)) <= SETTLED * float(np.std(new))


def _correlation(chosen: dict[int, tuple[AxisData, Selection]]) -> tuple[Correlation | None, list[Finding]]:
    """Of all axes together, block by block, with a finding for every trade-off."""
    names, blocks, findings = list[str](), list[Array](), list[Finding]()
    for i, (_, selection) in chosen.items():
        fit = selection.fit
        own = [f"{AXES[i]}.{name}" for name, on in zip(TERMS, fit.terms, strict=True) if on]
        found, said = degeneracy(own, fit.covariance.local, fit.free[fit.terms])
        names += own
        blocks.append(found.matrix)
        findings += said
    if not names:
        return None, []
    from scipy.linalg import block_diag

    return Correlation(names=tuple(names), matrix=block_diag(*blocks)), findings
