"""Roll or pitch left to itself: natural frequency and damping from the ring-down after a release."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.motion.attitude_signal import attitude_samples
from finssim.calibration.regression.instruments import Run, simulate_axis
from finssim.calibration.regression.robust import local_outliers
from finssim.calibration.trials.trial import Trial
from finssim.calibration.uncertainty import (
    Covariance,
    Evidence,
    correlated_samples,
    trial_covariance,
)
from finssim.geometry.rotations import quat_inverse_rotate

__all__ = ["Decay", "free_decay"]

Array = NDArray[np.float64]

RATES = {"roll": "p", "pitch": "q"}

SLOWEST, FASTEST = 0.05, 3.0
"""Natural frequencies that are looked for [Hz]."""

FEWEST_PERIODS = 1.5
"""A decay has to last so long to count."""

DRIFT_PERIODS = 2.0
"""Where the equilibrium drifts, as while a manipulator moves, its straight pieces are so many periods long."""

LINEAR, QUADRATIC, BOTH = (True, False), (False, True), (True, True)
"""Which of c1, c2 are fitted."""

FAINT = 4.0
"""A swing below so many standard deviations of the rate's noise tells nothing."""


@dataclass(frozen=True, kw_only=True)
class Decay:
    """Ring-down of one angle: s_dot_dot + c1 s_dot + c2 |s_dot| s_dot + w2 (s - s_0) = 0, s the sine of the angle."""

    trial: str
    axis: str
    begin: float
    """Release, on the trial's clock [s]."""
    end: float
    """When the swing is lost in noise or something pushes [s]."""
    theta: Array
    """w2 = k/m [1/s²], c1 = d1/m [1/s], c2 = d2/m [-], (3,); zero for what was not fitted."""
    terms: tuple[bool, bool]
    """Whether c1 and c2 were fitted: those that Akaike's criterion keeps."""
    swing: float
    """Largest fitted rate [rad/s]."""
    covariance: Covariance
    """Of ln w2 and the fitted ones of c1, c2, from blocks of half a period."""
    drift: bool
    """Whether s_0 moves."""
    t: Array
    """(n,) [s]"""
    rate: Array
    """Fitted on t [rad/s], (n,)."""
    sine: Array
    """(n,)"""
    rate_measured: tuple[Array, Array]
    """Times and values."""
    sine_measured: tuple[Array, Array]
    r2: float
    """Of the rate."""


def free_decay(trial: Trial, axis: str, *, terms: tuple[bool, bool] | None = None) -> Decay:
    """Fit the ring-down of a trial without thrust.

    The release is the instant of the largest rate; the decay ends where the swing grows again or is lost in noise. The
    model is simulated and fitted to the rate and the sine of the angle as sampled, each with its own noise.

    Args:
        trial: With a gyro and an attitude, at least one of them.
        axis: `roll` or `pitch`.
        terms: Which of c1, c2 to fit; what Akaike's criterion keeps if None.

    Raises:
        CalibrationError: Nothing was measured of that angle, or nothing rings down.
    """
    p, s = _samples(trial, axis)
    if len(p[0]) < 20 and len(s[0]) < 20:
        raise CalibrationError(f"neither rate nor attitude of {axis}: nothing to see a decay in", trial.name)
    rate = p if len(p[0]) >= 20 else (s[0], np.gradient(s[1], s[0]))
    begin, end, period = _window(rate, trial.name, axis)
    p, s = ((t[(t >= begin) & (t <= end)], y[(t >= begin) & (t <= end)]) for t, y in (p, s))
    pieces = int((end - begin) / (DRIFT_PERIODS * period))
    first = _Ringdown(p, s, begin, end, period, 0, terms or LINEAR)
    tried = [first]
    if pieces >= 1:
        tried.append(_Ringdown(p, s, begin, end, period, pieces, terms or LINEAR))
    knots = min(tried, key=lambda one: one.criterion(first)).pieces
    others = (QUADRATIC, BOTH) if terms is None else ()
    tried += [_Ringdown(p, s, begin, end, period, knots, other) for other in others]
    return min(tried, key=lambda one: one.criterion(first)).decay(trial.name, axis)


def _samples(trial: Trial, axis: str) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Rate and sine of the angle with their times, without spikes."""
    p = trial.series(RATES[axis])
    t, q, given = attitude_samples(trial)
    s = (np.empty(0), np.empty(0))
    if axis in given:
        up = quat_inverse_rotate(q / np.linalg.norm(q, axis=1, keepdims=True), np.array([0.0, 0.0, 1.0]))
        s = (t, up[:, 1] if axis == "roll" else -up[:, 0])
    clean = []
    for at, value in (p, s):
        keep = ~local_outliers(value) if len(value) > 11 else np.ones(len(value), bool)
        clean.append((at[keep], value[keep]))
    return clean[0], clean[1]


def _window(rate: tuple[Array, Array], name: str, axis: str) -> tuple[float, float, float]:
    """Begin and end of the decay, and its period [s]."""
    from scipy.signal import lombscargle

    t, y = rate
    smooth = np.convolve(np.pad(y, 1, mode="edge"), [0.25, 0.5, 0.25], "valid")
    noise = float(np.median(np.abs(np.diff(y, 2)))) / 0.6745 / np.sqrt(6.0)
    begin = float(t[int(np.argmax(np.abs(smooth)))])
    after = (t >= begin) & (t <= begin + 20.0)
    span = float(t[after][-1] - begin) if after.any() else 0.0
    refusal = CalibrationError(
        f"{axis} does not ring down: expected a release after which it swings freely for {FEWEST_PERIODS:g} periods or "
        "more",
        name,
    )
    if after.sum() < 20 or span < 1.0:
        raise refusal
    low = max(SLOWEST, 1.0 / span)
    frequencies = np.linspace(low, FASTEST, 400)
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


class _Ringdown:
    """Least squares of one decay; x = ln w2, c1, c2, p(0), s(0), knots of s_0."""

    def __init__(
        self,
        p: tuple[Array, Array],
        s: tuple[Array, Array],
        begin: float,
        end: float,
        period: float,
        pieces: int,
        terms: tuple[bool, bool],
    ) -> None:
        from scipy.optimize import least_squares

        self.p, self.s, self.period, self.pieces, self.terms = p, s, period, pieces, terms
        self.free = np.array([True, *terms, *[True] * (pieces + 3)])
        step = period / 60.0
        self.t = begin + step * np.arange(int(np.ceil((end - begin) / step)) + 1)
        place = np.linspace(0.0, pieces, len(self.t))
        self.hats = (
            np.clip(1.0 - np.abs(place[:, None] - np.arange(pieces + 1)), 0.0, None)
            if pieces
            else np.ones((len(self.t), 1))
        )
        self.scale = np.array([_spread(p[1]), _spread(s[1])])
        mean = float(np.mean(s[1])) if len(s[1]) else 0.0
        first = float(s[1][0]) if len(s[1]) else 0.0
        speed = float(p[1][0]) if len(p[1]) else 0.0
        w = 2.0 * np.pi / period
        start = np.concatenate([[2.0 * np.log(w), 0.1 * w, 0.1], [speed, first], np.full(pieces + 1, mean)])
        low = np.concatenate([[start[0] - 2.0, 0.0, 0.0], np.full(pieces + 3, -np.inf)])
        high = np.concatenate([[start[0] + 2.0, 4.0 * w, 1e3], np.full(pieces + 3, np.inf)])
        start, low, high = start[self.free], low[self.free], high[self.free]
        for _ in range(3):
            solved = least_squares(self._residual, start, self._jacobian, bounds=(low, high), x_scale="jac")
            start = np.clip(solved.x, low + 1e-9, high - 1e-9)
            r = solved.fun
            n = len(p[1])
            # Each stream gets the spread that it turns out to have: noise, and what the model leaves.
            self.scale = self.scale * [
                max(float(np.std(part)), 1e-6) if len(part) else 1.0 for part in (r[:n], r[n:])
            ]
        self.x, self.J, self.r = start, self._jacobian(start), self._residual(start)

    def run(self, x: Array) -> tuple[Array, Array]:
        """Rate and sine on `t` for every column of free parameters, (P, C) -> (n, C) each."""
        full = np.zeros((len(self.free), x.shape[1]))
        full[self.free] = x
        x = full
        w2 = np.exp(x[0])
        push = w2 * (self.hats @ x[5:])
        theta = np.stack([np.ones_like(w2), x[1], x[2], w2])
        step, mean = float(self.t[1] - self.t[0]), 0.5 * (push[:-1] + push[1:])
        runs = [Run(p, step, float(a), float(b)) for p, a, b in zip(mean.T, x[3], x[4], strict=True)]
        nu, s = simulate_axis(theta, runs)
        return np.stack(nu, axis=1), np.stack(s, axis=1)

    def _errors(self, x: Array) -> Array:
        """Simulated over scale at the samples, (P, C) -> (samples, C)."""
        nu, s = self.run(x)
        parts = [
            np.stack([np.interp(at, self.t, column) for column in line.T], axis=1) / scale
            for at, line, scale in ((self.p[0], nu, self.scale[0]), (self.s[0], s, self.scale[1]))
        ]
        return np.concatenate(parts)

    def _residual(self, x: Array) -> Array:
        measured = np.concatenate([self.p[1] / self.scale[0], self.s[1] / self.scale[1]])
        return np.asarray(self._errors(x[:, None])[:, 0] - measured)

    def _jacobian(self, x: Array) -> Array:
        h = 1e-5 * np.maximum(1.0, np.abs(x))
        both = self._errors(x[:, None] + np.concatenate([np.diag(h), -np.diag(h)], axis=1))
        return np.asarray((both[:, : len(x)] - both[:, len(x) :]) / (2.0 * h))

    def criterion(self, reference: _Ringdown) -> float:
        """Akaike's, with the reference's scale and as many independent samples as its residual has."""
        n = len(self.p[1])
        r = self.r * np.repeat(self.scale / reference.scale, [n, len(self.s[1])])
        samples = len(r) / max(
            correlated_samples(reference.r[:n]) if n else 1.0, correlated_samples(reference.r[n:])
        )
        return samples * float(np.mean(r**2)) + 2.0 * float(self.free.sum())

    def _theta(self) -> Array:
        """w2, c1, c2."""
        full = np.zeros(len(self.free))
        full[self.free] = self.x
        return np.array([np.exp(full[0]), full[1], full[2]])

    def decay(self, name: str, axis: str) -> Decay:
        """The result; parameters that only describe this swing are eliminated from the evidence."""
        times = np.concatenate([self.p[0], self.s[0]])
        block = np.minimum(
            ((times - self.t[0]) / (0.5 * self.period)).astype(int),
            int((self.t[-1] - self.t[0]) / (0.5 * self.period)) - 1,
        )
        k = 1 + sum(self.terms)
        N = self.J.T @ self.J
        project = np.linalg.lstsq(N[k:, k:], N[k:, :k], rcond=1e-12)[0]
        J = self.J[:, :k] - self.J[:, k:] @ project
        cut = [np.flatnonzero(block == b) for b in np.unique(block)]
        covariance = trial_covariance(
            Evidence(
                names=("ln_w2", *(c for c, on in zip(("c1", "c2"), self.terms, strict=True) if on)),
                normal=np.array([J[i].T @ J[i] for i in cut]),
                score=np.array([-J[i].T @ self.r[i] for i in cut]),
                unit="blocks",
            )
        )
        nu, s = self.run(self.x[:, None])
        n = len(self.p[1])
        which = slice(0, n) if n else slice(n, None)
        measured = self.p[1] / self.scale[0] if n else self.s[1] / self.scale[1]
        return Decay(
            trial=name,
            axis=axis,
            begin=float(self.t[0]),
            end=float(self.t[-1]),
            theta=self._theta(),
            terms=self.terms,
            swing=float(np.abs(nu[:, 0]).max()),
            covariance=covariance,
            drift=self.hats.shape[1] > 1,
            t=np.asarray(self.t, float),
            rate=nu[:, 0],
            sine=s[:, 0],
            rate_measured=self.p,
            sine_measured=self.s,
            r2=1.0 - float(np.mean(self.r[which] ** 2)) / max(float(np.var(measured)), 1e-300),
        )


def _spread(y: Array) -> float:
    return max(float(np.std(y)), 1e-9) if len(y) else 1.0
