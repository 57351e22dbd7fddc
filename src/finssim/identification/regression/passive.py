"""Trials with the thrusters off: one axis with no input, from its release until it rests or something pushes again.

    nu_dot + c1 nu + c2 |nu| nu + w2 (s - s_0) = e,    s_dot = nu,    c1 = d1/m,  c2 = d2/m

w2 = k/m where the weight rights the vehicle, s being the sine of its roll or pitch; e = (B - W)/m of a rise. Such a
motion shows ratios only, for no force is known; absolute values follow from one number that is given or the vehicle
file's, which every estimate names. All releases of an axis are fitted at once, with an initial state each.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.core.rotations import quat_inverse_rotate, quat_to_euler
from finssim.identification.fit import Curve, Estimate, Fit
from finssim.identification.regression.axis_estimates import AxisResult, Number
from finssim.identification.regression.axis_fit import Run, simulate_axis
from finssim.identification.regression.plant_terms import Matrices, matrices
from finssim.identification.uncertainty import Evidence, correlated_samples, trial_covariance
from finssim.trials.findings import CalibrationError, Finding, finding
from finssim.trials.motion import Motion, attitude_samples, motion, spans_of, white_noise, without_spikes
from finssim.trials.trial import NU, Trial
from finssim.vehicles import AXES, Vehicle

__all__ = ["free_motion", "passive"]

Array = NDArray[np.float64]
Samples = tuple[Array, Array]
"""Times [s] and values."""

SWINGING = ("roll", "pitch")
"""Axes that the weight rights."""

FEWEST_SAMPLES = 20

EXPLAINED = 0.2
"""R² below which no drag explains the motion."""

FEWEST_TRIALS = 4
"""With fewer, trials are cut into blocks to estimate the spread."""

LINEAR, QUADRATIC, BOTH = (True, False), (False, True), (True, True)
"""Which of c1, c2 are fitted."""

KINDS = {"auto": None, "linear": LINEAR, "quadratic": QUADRATIC, "both": BOTH}
"""Terms by word of the option."""

SHAPES = {LINEAR: "linear", QUADRATIC: "quadratic", BOTH: "linear and quadratic"}

USEFUL = 0.5
"""Half width of an interval, as a part of the estimate, up to which it is written: better than a guess."""

# Where a free motion begins and ends.

SLOWEST, FASTEST = 0.05, 3.0
"""Natural frequencies that are looked for [Hz]."""

FEWEST_PERIODS = 1.5
"""A decay has to last so long to count."""

DRIFT_PERIODS = 2.0
"""Where the equilibrium drifts, as while a manipulator moves, its straight pieces are so many periods long."""

FAINT = 4.0
"""A swing below so many standard deviations of the rate's noise tells nothing."""

LEAST_SPEED = 0.03
"""Speed at the release below which nothing coasts [m/s, rad/s]."""

FALLS_TO = 0.7
"""Part of its first speed to which a coast has to fall."""

GROWS = 1.15
"""Factor above the lowest speed so far at which something pushes again."""

RISING, SHORTEST_RISE = 0.01, 3.0
"""Vertical speed that counts as a rise [m/s] (published procedure), and how long it has to last [s]."""


@dataclass(frozen=True, kw_only=True)
class Release:
    """One trial from its release on."""

    trial: str
    begin: float
    """On the trial's clock [s]."""
    end: float
    rate: Samples
    """Velocity of the axis [m/s, rad/s]; empty where it was not measured."""
    travel: Samples
    """Height, heading, or sine of roll or pitch [m, rad, -]; empty where it was not measured or tells nothing more."""
    period: float = 0.0
    """Of a swing [s]; 0 where nothing swings."""
    pieces: int = 0
    """Straight pieces of an equilibrium that drifts; 0 where it stays."""

    @property
    def t(self) -> Array:
        """Times of all samples, those of `rate` first [s]."""
        return np.concatenate([self.rate[0], self.travel[0]])

    @property
    def grid(self) -> Array:
        """Times of the simulation [s]."""
        step = self.period / 60.0 if self.period else min(0.05, (self.end - self.begin) / 100.0)
        return np.linspace(self.begin, self.end, max(2, math.ceil((self.end - self.begin) / step) + 1))

    @property
    def own(self) -> int:
        """Unknowns of this release alone: speed and place at its begin, knots of its equilibrium."""
        placed = bool(len(self.travel[0])) or self.period > 0.0
        return 1 + placed + (self.pieces + 1) * (self.period > 0.0 and len(self.travel[0]) > 0)


def _release(trial: Trial, axis: str, vehicle: Vehicle) -> Release:
    """The free motion of one axis in a trial.

    Raises:
        CalibrationError: Nothing was measured of that axis, or it does not move freely.
    """
    moved = motion(trial, vehicle)
    rate, travel = (_clean(samples) for samples in _samples(trial, axis, moved))
    if max(len(rate[0]), len(travel[0])) < FEWEST_SAMPLES:
        raise CalibrationError(f"the motion of {axis} was not measured", trial.name)
    period = 0.0
    if axis in SWINGING:
        seen = rate if len(rate[0]) >= FEWEST_SAMPLES else (travel[0], np.gradient(travel[1], travel[0]))
        begin, end, period = _ringing(seen, trial.name, axis)
    elif axis == "heave":
        begin, end = _rising(moved, trial.name)
    else:
        begin, end = _coasting(moved, axis, trial.name)
    rate, travel = (_between(samples, begin, end) for samples in (rate, travel))
    return Release(trial=trial.name, begin=begin, end=end, rate=rate, travel=travel, period=period)


def _samples(trial: Trial, axis: str, moved: Motion) -> tuple[Samples, Samples]:
    """Rate and travel as measured; a derived rate where neither is."""
    i = AXES.index(axis)
    rate, travel = trial.series(NU[i]), (np.empty(0), np.empty(0))
    if axis == "heave":
        t, height = trial.series("z") if trial.has("z") else trial.series("depth")
        return travel, (t, height if trial.has("z") else -height)
    t, q, measured = attitude_samples(trial)
    if axis in SWINGING and axis in measured:
        up = quat_inverse_rotate(q / np.linalg.norm(q, axis=1, keepdims=True), np.array([0.0, 0.0, 1.0]))
        travel = (t, up[:, 1] if axis == "roll" else -up[:, 0])
    elif axis == "yaw" and "yaw" in measured and not len(rate[0]):
        travel = (t, np.unwrap(quat_to_euler(q)[2]))
    elif axis not in SWINGING and not len(rate[0]):
        known = np.isfinite(moved.nu[:, i])
        rate = (moved.t[known], moved.nu[known, i])
    return rate, travel


def _clean(samples: Samples) -> Samples:
    """Without spikes."""
    good = without_spikes(samples[0], samples[1][:, None])
    return samples[0][good], samples[1][good]


def _between(samples: Samples, begin: float, end: float) -> Samples:
    inside = (samples[0] >= begin) & (samples[0] <= end)
    return samples[0][inside], samples[1][inside]


def _ringing(rate: Samples, name: str, axis: str) -> tuple[float, float, float]:
    """From the largest rate until the swing grows again or is lost in noise, and the period [s]."""
    from scipy.signal import lombscargle

    t, y = rate
    smooth = np.convolve(np.pad(y, 1, mode="edge"), [0.25, 0.5, 0.25], "valid")
    noise = white_noise(y)
    begin = float(t[int(np.argmax(np.abs(smooth)))])
    after = (t >= begin) & (t <= begin + 20.0)
    span = float(t[after][-1] - begin) if after.any() else 0.0
    refusal = CalibrationError(
        f"{axis} does not ring down: expected a release after which it swings freely for {FEWEST_PERIODS:g} periods or "
        "more",
        name,
    )
    if after.sum() < FEWEST_SAMPLES or span < 1.0:
        raise refusal
    frequencies = np.linspace(max(SLOWEST, 1.0 / span), FASTEST, 400)
    fade = np.exp(-2.0 * (t[after] - begin) / span)  # the first swings stand out most
    power = lombscargle(t[after], (smooth[after] - smooth[after].mean()) * fade, 2.0 * np.pi * frequencies)
    period = 1.0 / float(frequencies[int(np.argmax(power))])
    end, swing = begin, np.inf
    while end + 0.5 * period <= t[-1] + 0.25 * period:
        part = np.abs(smooth[(t >= end) & (t < end + 0.5 * period)])
        if not len(part) or part.max() > 1.1 * swing or part.max() < FAINT * noise:
            break
        end, swing = end + 0.5 * period, max(float(part.max()), 1e-12)
    if end - begin < FEWEST_PERIODS * period:
        raise refusal
    return begin, min(end, float(t[-1])), period


def _coasting(moved: Motion, axis: str, name: str) -> tuple[float, float]:
    """From the largest speed until something pushes again [s]."""
    nu = moved.nu[:, AXES.index(axis)]
    known = np.isfinite(nu)
    noise = float(np.nan_to_num(moved.noise_std[AXES.index(axis)]))
    t, speed = moved.t[known], np.abs(nu[known])
    begin = int(np.argmax(speed)) if len(speed) else 0
    after = speed[begin:]
    floor = max(3.0 * noise, 0.02 * float(after.max(initial=0.0)))
    pushed = np.flatnonzero(after > GROWS * np.minimum.accumulate(after) + floor)
    end = begin + (int(pushed[0]) if len(pushed) else len(after)) - 1
    slow = end - begin < FEWEST_SAMPLES or speed[begin] < max(LEAST_SPEED, 5.0 * noise)
    if slow or speed[end] > FALLS_TO * speed[begin]:
        raise CalibrationError(f"{axis} does not coast to a lower speed", name)
    return float(t[begin]), float(t[end])


def _rising(moved: Motion, name: str) -> tuple[float, float]:
    """The longest stretch in which the height grows faster than `RISING` [s]."""
    up = np.gradient(moved.position[:, 2], moved.t) > RISING
    begin, end = max(spans_of(up), key=lambda e: e[1] - e[0], default=(0, 1))
    if moved.t[end - 1] - moved.t[begin] < SHORTEST_RISE:
        raise CalibrationError(
            f"nothing rises faster than {RISING} m/s for {SHORTEST_RISE:g} s: expected a vehicle let go under water",
            name,
        )
    return float(moved.t[begin]), float(moved.t[end - 1])


# The fit of all releases of an axis.


@dataclass(kw_only=True)
class FreeMotion:
    """Least squares of all releases of an axis: the simulated motion against the samples."""

    axis: str
    releases: tuple[Release, ...]
    terms: tuple[bool, bool]
    """Whether c1 and c2 are fitted."""
    x: Array = field(init=False)
    """ln w2 of a swing or ln e of a rise, the fitted ones of c1 and c2, then what each release has for itself."""

    def __post_init__(self) -> None:
        """Fit; every stream of every release gets the spread that it turns out to have."""
        from scipy.optimize import least_squares

        self.head = int(self.axis in (*SWINGING, "heave"))
        self.shared = self.head + sum(self.terms)
        self._at = np.cumsum([self.shared, *(r.own for r in self.releases)])
        sizes = [len(values) for r in self.releases for _, values in (r.rate, r.travel)]
        self._stream = np.repeat(np.arange(len(sizes)), sizes)
        self.measured = np.concatenate(
            [values for r in self.releases for _, values in (r.rate, r.travel)], dtype=float
        )
        scale = np.array([max(float(np.std(self._of(self.measured, s))), 1e-9) for s in range(len(sizes))])
        x, low, high = self._start()
        for _ in range(2):
            solved = least_squares(
                lambda x, scale=scale: self._residual(x) / scale[self._stream],
                x,
                lambda x, scale=scale: self._jacobian(x) / scale[self._stream, None],
                bounds=(low, high),
                x_scale="jac",
            )
            x = np.clip(solved.x, low + 1e-12, high - 1e-12)
            residual = self._residual(x)
            scale = np.array(
                [max(float(np.sqrt(np.mean(self._of(residual, s) ** 2))), 1e-9) for s in range(len(sizes))]
            )
        self.x, self.scale, self.residual, self.slopes = x, scale, residual, self._jacobian(x)
        self.correlated = np.array([correlated_samples(self._of(residual, s)) for s in range(len(sizes))])
        self.covariance = trial_covariance(self._evidence())
        # Blocks do not show by how much more than their noise a few releases differ; a fit of each does.
        few = self.releases if 1 < len(self.releases) < FEWEST_TRIALS else ()
        self.alone = [FreeMotion(axis=self.axis, releases=(one,), terms=self.terms) for one in few]

    def _of(self, values: Array, stream: int) -> Array:
        """Values of one stream; a zero where it is empty."""
        own = values[self._stream == stream]
        return own if len(own) else np.zeros(1)

    def _start(self) -> tuple[Array, Array, Array]:
        """Start and box."""
        longest = max(r.end - r.begin for r in self.releases)
        first = [_first(r) for r in self.releases]
        speed = max(float(np.median(np.abs([nu for nu, _ in first]))), RISING)
        rate = 2.0 / longest
        head, wide = [], (2.0, 2.0)
        if self.axis in SWINGING:
            w = 2.0 * np.pi / float(np.median([r.period for r in self.releases]))
            head, rate = [2.0 * math.log(w)], 0.1 * w
        elif self.axis == "heave":
            late = [_between(r.travel, 0.7 * r.end + 0.3 * r.begin, r.end) for r in self.releases]
            speed = max(float(np.median([np.polyfit(*samples, 1)[0] for samples in late])), RISING)
            head, wide, rate = [math.log(speed)], (6.0, 3.0), 1.0
        drag = np.array([rate, rate / speed])[list(self.terms)]
        own = [_own(r, nu, s) for r, (nu, s) in zip(self.releases, first, strict=True)]
        x = np.concatenate([head, drag, *own])
        low, high = np.full(len(x), -np.inf), np.full(len(x), np.inf)
        low[: self.head], high[: self.head] = x[: self.head] - wide[0], x[: self.head] + wide[1]
        low[self.head : self.shared] = 0.0
        return x, low, high

    def ratios(self, shared: Array) -> tuple[Array, Array, Array, Array]:
        """w2 [1/s²], e [m/s²], c1 [1/s], c2 [1/m, 1/rad] of vectors that begin with the shared unknowns, (C, ...)."""
        zero = np.zeros(len(shared))
        head = np.exp(shared[:, 0]) if self.head else zero
        drag = iter(shared[:, self.head : self.shared].T)
        c1, c2 = (next(drag) if on else zero for on in self.terms)
        return (zero, head, c1, c2) if self.axis == "heave" else (head, zero, c1, c2)

    def _lines(self, points: Sequence[Array]) -> list[tuple[Array, Array]]:
        """Rate and travel of every release on its grid, of vectors of shared and own unknowns (C, ...): (n, C) each."""
        runs, thetas = list[Run](), []
        for release, point in zip(self.releases, points, strict=True):
            w2, e, c1, c2 = self.ratios(point)
            grid, own = release.grid, point[:, self.shared :].T
            push = e[:, None] + w2[:, None] * _equilibrium(release, grid, own[2:]).T
            place = own[1] if release.own > 1 else np.zeros(len(point))
            step = float(grid[1] - grid[0])
            runs += [
                Run(0.5 * (p[:-1] + p[1:]), step, float(v), float(s))
                for p, v, s in zip(push, own[0], place, strict=True)
            ]
            thetas.append(np.stack([np.ones_like(w2), c1, c2, w2]))
        nu, s = simulate_axis(np.concatenate(thetas, axis=1), runs)
        cuts = np.cumsum([0, *(len(point) for point in points)])
        return [
            (np.stack(nu[a:b], axis=1), np.stack(s[a:b], axis=1))
            for a, b in zip(cuts, cuts[1:], strict=False)
        ]

    def _predicted(self, points: Sequence[Array]) -> list[Array]:
        """What the samples of every release would be, (n, C) each."""
        out = []
        for release, (nu, s) in zip(self.releases, self._lines(points), strict=True):
            parts = [
                [np.interp(at, release.grid, column) for column in line.T]
                for at, line in ((release.rate[0], nu), (release.travel[0], s))
            ]
            out.append(np.concatenate([np.stack(part, axis=1) for part in parts]))
        return out

    def _points(self, x: Array) -> list[Array]:
        """Shared and own unknowns of every release, (1, ...) each."""
        cuts = zip(self._at, self._at[1:], strict=False)
        return [np.concatenate([x[: self.shared], x[a:b]])[None] for a, b in cuts]

    def _residual(self, x: Array) -> Array:
        return np.concatenate([p[:, 0] for p in self._predicted(self._points(x))]) - self.measured

    def _jacobian(self, x: Array) -> Array:
        """By central differences; what releases have for themselves is moved in all of them at once."""
        steps = [1e-5 * np.maximum(np.abs(point[0]), 1e-2) for point in self._points(x)]
        points = [
            point + np.concatenate([np.diag(h), -np.diag(h)])
            for point, h in zip(self._points(x), steps, strict=True)
        ]
        J, row = np.zeros((len(self.measured), len(x))), 0
        predicted = self._predicted(points)
        for g, (p, h) in enumerate(zip(predicted, steps, strict=True)):
            slope = (p[:, : len(h)] - p[:, len(h) :]) / (2.0 * h)
            rows = slice(row, row + len(p))
            J[rows, : self.shared] = slope[:, : self.shared]
            J[rows, self._at[g] : self._at[g + 1]] = slope[:, self.shared :]
            row += len(p)
        return J

    def _evidence(self) -> Evidence:
        """By release, or by blocks of time where there are few; what a release has for itself is eliminated."""
        weight = 1.0 / (self.scale * np.sqrt(self.correlated))[self._stream]
        J, r = self.slopes * weight[:, None], self.residual * weight
        few = len(self.releases) < FEWEST_TRIALS
        normal, score = [], []
        for g, release in enumerate(self.releases):
            rows = self._stream // 2 == g
            shared, own = J[rows][:, : self.shared], J[rows][:, self._at[g] : self._at[g + 1]]
            shared = shared - own @ np.linalg.lstsq(own, shared, rcond=1e-12)[0]
            longest = float(self.correlated[2 * g : 2 * g + 2].max())
            count = int(np.clip(rows.sum() / (4.0 * longest), 6, 24)) if few else 1
            for block in np.array_split(np.argsort(release.t, kind="stable"), count):
                normal.append(shared[block].T @ shared[block])
                score.append(-shared[block].T @ r[rows][block])
        names = (*("head",) * self.head, *(n for n, on in zip(("c1", "c2"), self.terms, strict=True) if on))
        return Evidence(
            names=names, normal=np.array(normal), score=np.array(score), unit="blocks" if few else "trials"
        )

    def criterion(self, full: FreeMotion) -> float:
        """Schwarz' criterion, with as many samples as are independent by a fuller model."""
        independent = np.bincount(self._stream, minlength=len(self.scale)) / full.correlated
        return float(
            2.0 * independent @ np.log(self.scale) + len(self.x) * np.log(max(independent.sum(), 2.0))
        )

    # What follows from it.

    @property
    def theta(self) -> tuple[float, float, float, float]:
        """w2, e, c1 and c2; zero for what is not fitted."""
        w2, e, c1, c2 = (float(value[0]) for value in self.ratios(self.x[None]))
        return w2, e, c1, c2

    def speeds(self) -> tuple[float, float]:
        """Lowest that stands out of its noise, and highest fitted speed [m/s, rad/s]."""
        lines = [np.abs(nu[:, 0]) for nu, _ in self._lines(self._points(self.x))]
        top = max(float(line.max()) for line in lines)
        low = min(float(line.min()) for line in lines)
        return max(
            low, 0.02 * top, 3.0 * float(self.scale[::2].min()) if len(self.releases[0].rate[0]) else 0.0
        ), top

    @property
    def r2(self) -> float:
        """Share of the variance of each release's samples that is explained, the mean over releases."""
        parts = [2 * g + (not len(r.rate[0])) for g, r in enumerate(self.releases)]
        spread = [float(np.var(self._of(self.measured, s))) for s in parts]
        return float(np.mean(1.0 - self.scale[parts] ** 2 / np.maximum(spread, 1e-300)))

    def interval(
        self, of: Callable[[tuple[Array, ...]], Array], *, positive: bool = False
    ) -> tuple[float, float, float]:
        """A function of the ratios and the ends of its 95 % interval.

        Where the intervals of a few releases one by one do not overlap, the mean of what they show, and its interval.

        Args:
            of: Of w2, e, c1 and c2, (C,) each -> (C,).
            positive: Whether the interval is one of its logarithm.
        """
        from scipy.stats import norm, t

        x = self.x[: self.shared]
        h = 1e-6 * np.maximum(np.abs(x), 1e-3)
        points = np.concatenate([x[None], x + np.diag(h), x - np.diag(h)])
        values = np.asarray(of(self.ratios(points)), float)
        value, n = float(values[0]), self.shared
        slope = (values[1 : n + 1] - values[n + 1 :]) / (2.0 * h)
        used = np.flatnonzero(slope)
        C = self.covariance
        matrix = np.maximum(C.local, C.trials) if C.alone[used].any() else C.trials
        dof = float(np.min(C.dof[used], initial=np.inf))
        quantile = t.ppf(0.975, dof) if math.isfinite(dof) else norm.ppf(0.975)
        variance = float(slope[used] @ matrix[np.ix_(used, used)] @ slope[used])
        half = float(quantile) * math.sqrt(variance) if math.isfinite(variance) else math.inf
        alone = np.array([one.interval(of, positive=positive) for one in self.alone])
        if len(alone) and alone[:, 1].max() > alone[:, 2].min():
            value, n = float(np.mean(alone[:, 0])), len(alone)
            half = float(t.ppf(0.975, n - 1) * np.std(alone[:, 0], ddof=1)) / math.sqrt(n)
        if positive and value > 0.0:
            factor = math.exp(min(half / value, 50.0))
            return value, value / factor, value * factor
        return value, value - half, value + half

    def curves(self) -> list[Curve]:
        """Measured and fitted of every release."""
        out, unit = [], "m/s" if AXES.index(self.axis) < 3 else "rad/s"
        place = {"heave": "height [m]", "yaw": "heading [rad]"}.get(self.axis, "sine of the angle [-]")
        for g, release in enumerate(self.releases):
            stream = 2 * g + (not len(release.rate[0]))
            t, measured = release.rate if len(release.rate[0]) else release.travel
            out.append(
                Curve(
                    title=f"{release.trial}: {self.axis} with the thrusters off", x_label="time [s]",
                    y_label=f"velocity [{unit}]" if len(release.rate[0]) else place,
                    x=t, measured=measured, fitted=measured + self._of(self.residual, stream),
                )
            )  # fmt: skip
        return out


def _first(release: Release) -> tuple[float, float]:
    """Speed and place at the begin, from the first samples."""
    rate, (at, travel) = release.rate[1], release.travel
    place = float(travel[0]) if len(travel) else 0.0
    if len(rate):
        return float(rate[0]), place
    few = slice(0, max(5, len(at) // 10))
    return float(np.polyfit(at[few], travel[few], 1)[0]), place


def _own(release: Release, nu: float, s: float) -> Array:
    """Start of what a release has for itself."""
    mean = float(np.mean(release.travel[1])) if len(release.travel[1]) else 0.0
    return np.array([nu, s, *[mean] * (release.pieces + 1)][: release.own])


def _equilibrium(release: Release, grid: Array, knots: Array) -> Array:
    """Place to which a swing returns, straight between knots (k, C), (n, C); 0 where nothing swings."""
    if not len(knots):
        return np.zeros((len(grid), 1))
    at = np.linspace(0.0, len(knots) - 1.0, len(grid))[:, None]
    return np.asarray(np.clip(1.0 - np.abs(at - np.arange(len(knots))), 0.0, None) @ knots)


def free_motion(
    trials: Sequence[Trial],
    axis: str,
    vehicle: Vehicle,
    *,
    terms: tuple[bool, bool] | None = None,
    refused: list[CalibrationError] | None = None,
) -> list[FreeMotion]:
    """Fit the free motion of one axis over all trials that show one, with each kind of drag.

    The drag is linear, quadratic or both by Schwarz' criterion, which also says where an equilibrium drifts.

    Args:
        trials: Passive ones.
        axis: One of six: a decay of roll and pitch, a coast of surge, sway and yaw, a rise in heave.
        vehicle: Gives the places of sensors.
        terms: Whether c1 and c2 are fitted in the best, in place of a choice.
        refused: Takes why a trial shows nothing.

    Returns:
        The best of them first, the fullest last.

    Raises:
        CalibrationError: No trial shows one.
    """
    releases, errors = list[Release](), [] if refused is None else refused
    for trial in trials:
        try:
            releases.append(_steady(_release(trial, axis, vehicle), axis))
        except CalibrationError as error:
            errors.append(error)
    if not releases:
        raise errors[-1] if errors else CalibrationError("no trials were given")
    # A single rise cannot show both kinds of drag.
    kinds = [LINEAR, QUADRATIC] if axis == "heave" else [LINEAR, QUADRATIC, BOTH]
    fits = [FreeMotion(axis=axis, releases=tuple(releases), terms=kind) for kind in kinds]
    wanted = [fit for fit in fits if fit.terms == terms] or fits
    best = min(wanted, key=lambda fit: fit.criterion(fits[-1]))
    if best.r2 < EXPLAINED:
        errors += [CalibrationError(f"{axis} does not move as if left to itself", r.trial) for r in releases]
        raise errors[-1]
    return [best, *fits]


def _steady(release: Release, axis: str) -> Release:
    """The release, its equilibrium in pieces where one that stays explains it worse."""
    pieces = int((release.end - release.begin) / (DRIFT_PERIODS * release.period)) if release.period else 0
    if not pieces or not len(release.travel[0]):
        return release
    both = [
        FreeMotion(axis=axis, releases=(one,), terms=LINEAR)
        for one in (release, replace(release, pieces=pieces))
    ]
    return min(both, key=lambda fit: fit.criterion(both[-1])).releases[0]


# From free motions to estimates, changes of the vehicle file and findings.

Of = Callable[[tuple[Array, ...]], Array]
"""A number of w2, e, c1 and c2, (C,) each -> (C,)."""


class _Result:
    """What the free motion of one axis shows."""

    def __init__(self, free: FreeMotion, full: FreeMotion, file: Matrices, known: float | None) -> None:
        """
        Args:
            free: The best of its fits.
            full: That with the fullest drag, for intervals of what was left out.
            file: The vehicle as its file has it.
            known: Effective inertia that is known [kg, kg m²].
        """
        self.free, self.full, self.file, self.i = free, full, file, AXES.index(free.axis)
        self.low, self.top = free.speeds()
        self.estimates: dict[str, Estimate] = {}
        self.changes: dict[str, Any] = {}
        self.findings = [
            finding("equilibrium_moved", r.trial, axis=free.axis) for r in free.releases if r.pieces
        ]
        k, swings = float(file.arm[2]), free.axis in SWINGING
        m, unit = float((file.M_RB + file.M_A)[self.i, self.i]), "kg" if self.i < 3 else "kg m²"
        stiff = swings and known is None and k > 0.0
        source, m = ("the file's", m) if known is None else ("the given", known)
        self.note = (
            f"with the file's k = {k:.4g} N m/rad" if stiff else f"with {source} inertia {m:.4g} {unit}"
        )
        inertia: Of = lambda r: k / r[0] if stiff else np.full(len(r[0]), m)  # noqa: E731
        numbers = {}
        if swings:
            self.swing()
            name, of = ("m_eff", inertia) if stiff else ("k", lambda r: inertia(r) * r[0])
            numbers[name] = self.number(free, of, positive=True)
        elif free.axis == "heave":
            self.rise(m)
        if free.axis != "heave":
            self.damping(inertia, numbers, known)

    def number(self, fit: FreeMotion, of: Of, *, positive: bool = False) -> Number:
        """A number with its interval; one that cannot be negative has the interval of its logarithm."""
        value, low, high = fit.interval(of, positive=positive)
        return Number(value, (low if positive else max(low, 0.0), high))

    def add(self, name: str, number: Number, unit: str, note: str = "", path: str | None = None) -> Estimate:
        """Take an estimate that rests on no assumption, or on the one that its note names."""
        value, (low, high), _ = number
        sure = bool(value > 0.0 and 0.5 * (high - low) <= USEFUL * value)
        self.estimates[name] = Estimate(
            name=name, estimate=value, ci95=(low, high), unit=unit, identifiable=sure, path=path,
            note=note or ("" if sure else "uncertain by more than half its value"),
        )  # fmt: skip
        return self.estimates[name]

    def swing(self) -> None:
        """Frequency, and damping ratio: a quadratic term counts as the linear one that takes the same energy out of the
        largest swing."""
        axis, rubbed = self.free.axis, 8.0 / (3.0 * math.pi) * self.top
        frequency = self.number(self.free, lambda r: np.sqrt(r[0]), positive=True)
        ratio = self.number(
            self.free, lambda r: (r[2] + rubbed * r[3]) / (2.0 * np.sqrt(r[0])), positive=True
        )
        self.add(f"{axis}.natural_frequency", frequency, "rad/s")
        self.add(f"{axis}.damping_ratio", ratio, "-", f"at a swing of {self.top:.2g} rad/s")

    def rise(self, m: float) -> None:
        """Terminal speed, and the excess of buoyancy that the acceleration shows, which the file does not take over."""
        linear = self.free.terms == LINEAR
        speed: Of = (lambda r: r[1] / r[2]) if linear else (lambda r: np.sqrt(r[1] / r[3]))
        trials = ", ".join(r.trial for r in self.free.releases)
        note = f"of a rise with {SHAPES[self.free.terms]} drag: {trials}"
        self.add("heave.terminal_speed", self.number(self.free, speed, positive=True), "m/s", note)
        excess = self.number(self.free, lambda r: m * r[1], positive=True)
        note, (low, high) = f"from the acceleration, {self.note}", excess.ends
        self.add("buoyancy_excess", excess, "N", note, "body.displaced_volume")
        if not low <= self.file.excess <= high:
            self.findings.append(
                finding("buoyancy_contradicted", "heave", file=self.file.excess, low=low, high=high)
            )

    def damping(self, inertia: Of, numbers: dict[str, Number], known: float | None) -> None:
        """Drag over inertia, and the drag itself with what else rests on an assumption."""
        free, top, axis = self.free, self.top, self.free.axis
        rate, share = "m/s" if self.i < 3 else "rad/s", ""
        if free.terms == BOTH:
            quadratic = free.theta[3] * top / (free.theta[2] + free.theta[3] * top)
            share = f", {quadratic:.0%} of it quadratic at the fastest"
        alone = "" if free.terms == BOTH else " alone"
        note = f"{SHAPES[free.terms]} drag{alone} explains speeds of {self.low:.2g}-{top:.2g} {rate}{share}"
        dropped = {}
        for j, (name, unit) in enumerate((("d1", "1/s"), ("d2", "1/m" if self.i < 3 else "1/rad"))):
            fit = free if free.terms[j] else self.full
            ratio = self.number(fit, lambda r, j=j: r[2 + j])
            drag = self.number(fit, lambda r, j=j: inertia(r) * r[2 + j])
            if free.terms[j]:
                numbers[name] = drag
            else:
                ratio, dropped[name] = Number(0.0, (0.0, ratio.ends[1])), (0.0, drag.ends[1])
            self.add(f"{axis}.{name}/m_eff", ratio, unit, note)
        value, low, high = free.interval(lambda r: inertia(r) * (r[2] + r[3] * top))
        result = AxisResult(
            axis=axis, numbers=numbers, file=self.file, speeds=(self.low, top), dropped=dropped, given=known,
            drag_known=0.5 * (high - low) <= USEFUL * value,
        )  # fmt: skip
        for name, e in result.estimates.items():
            self.estimates[name] = replace(e, note="; ".join(filter(None, [e.note, self.note])))
        self.changes |= result.changes
        self.findings += result.findings

    def quality(self, fits: Sequence[FreeMotion]) -> dict[str, float]:
        """Figures of the fit, with the residual of either kind of drag."""
        releases = self.free.releases
        rmse = {fit.terms: float(np.sqrt(np.mean(fit.residual**2))) for fit in fits}
        return {
            "r2": self.free.r2,
            "rmse": rmse[self.free.terms],
            **{f"rmse_{SHAPES[kind]}": rmse[kind] for kind in (LINEAR, QUADRATIC)},
            "trials": float(len(releases)),
            "seconds": float(sum(r.end - r.begin for r in releases)),
            "speed_low": self.low,
            "speed_high": self.top,
        }


def passive(
    trials: Sequence[Trial],
    vehicle: Vehicle,
    *,
    axes: Sequence[str] | None = None,
    damping: str = "auto",
    known: Mapping[str, float] | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> Fit:
    """Estimate what trials without thrust show.

    Args:
        trials: Each with one release.
        vehicle: Gives what is taken as known: the stiffness k = B z_b - W z_g of roll and pitch, else M_RB + M_A.
        axes: All if None.
        damping: `auto`, `linear`, `quadratic` or `both`; a rise takes one of the first two for `both`, since it cannot
            show both.
        known: Effective inertias M_RB + M_A that are known, by axis [kg, kg m²], in place of the file's numbers.
        progress: Called with the part done and a few words.

    Raises:
        CalibrationError: No trial shows a decay, a coast or a rise.
    """
    plant = matrices(vehicle)
    estimates: dict[str, Estimate] = {}
    changes: dict[str, Any] = {}
    quality: dict[str, dict[str, float]] = {}
    findings, curves, refused, used = list[Finding](), list[Curve](), list[CalibrationError](), set[str]()
    wanted = [a for a in AXES if axes is None or a in axes]
    for k, axis in enumerate(wanted):
        if progress:
            progress(k / len(wanted), f"free motion of {axis}")
        try:
            chosen, *fits = free_motion(trials, axis, vehicle, terms=KINDS[damping], refused=refused)
        except CalibrationError:
            continue
        result = _Result(chosen, fits[-1], plant, (known or {}).get(axis))
        estimates |= result.estimates
        changes |= result.changes
        findings += result.findings
        quality[axis] = result.quality(fits)
        curves += chosen.curves()
        used |= {release.trial for release in chosen.releases}
    if not estimates:
        reasons = "; ".join(str(error) for error in refused if error.subject == trials[0].name)
        others = f"; and {len(trials) - 1} trials more" if len(trials) > 1 else ""
        raise CalibrationError(
            f"no trial shows a free decay, a coast or a rise: {reasons or 'none was given'}{others}"
        )
    # That a trial shows one motion and not the others is no news.
    findings += [
        finding("unusable", error.subject, severity="care", reason=error.reason)
        for error in refused
        if error.subject not in used
    ]
    return Fit(
        kind="hydrodynamics",
        method="passive",
        before=vehicle,
        estimates=estimates,
        changes=changes,
        quality=quality,
        findings=tuple(dict.fromkeys(findings)),
        curves=tuple(curves),
        trials={trial.name: trial.sha256 for trial in trials if trial.name in used},
        settings={"fix": {f"{axis}.m": m for axis, m in known.items()}} if known else {},
    )
