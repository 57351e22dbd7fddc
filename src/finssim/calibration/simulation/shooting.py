"""The fit of simulations to segments, as `gauss_newton` asks for it: finite differences are worlds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.simulation.bordered import Linear
from finssim.calibration.simulation.gauss_newton import Point
from finssim.calibration.simulation.initial_states import InitialStates
from finssim.calibration.simulation.parameters import LONGEST_DELAY, Parameters
from finssim.calibration.simulation.residuals import ANGLES, Residuals
from finssim.calibration.simulation.rollout import Rollouts
from finssim.calibration.simulation.segments import Segment
from finssim.calibration.simulation.sensor_errors import LATE_STD, LATEST, STREAMS, SensorErrors
from finssim.geometry.rotations import wrap_angle
from finssim.vehicles import AXES

__all__ = ["Shooting"]

Array = NDArray[np.float64]

RELATIVE_STEP = 0.006
"""Of the finite differences, against a coordinate's size: single precision leaves them three digits."""

GRAIN = 0.004
"""Part of a number that nobody minds."""

COARSE = 0.05
"""Of a channel's range: residuals of that size are small while the parameters are still far off."""

VAGUE = 8.0
"""What is known of a fitted number beforehand: the file's within so many times its scale."""

EXACT_CLOCK = 1e-3
"""How far the stream that serves as the clock may lag [s]."""

FLOOR = 1e-4
"""Smallest noise of a channel, against the range it covers: below it are the simulation's own errors."""


class Shooting:
    """Residuals of segments under parameters, trial biases and initial states; satisfies `gauss_newton.Problem`.

    Attributes:
        axes_of_trials: Axes with a constant wrench that differs from trial to trial.
    """

    def __init__(
        self,
        segments: Sequence[Segment],
        parameters: Parameters,
        channels: Sequence[str],
        *,
        trial_biases: Sequence[str] = (),
        lagged: NDArray[np.bool_] | None = None,
        few: bool = False,
    ) -> None:
        """Set up.

        Args:
            segments: What to fit.
            parameters: What is free.
            channels: Measured columns to compare.
            trial_biases: Axes whose constant wrench is free in every trial.
            lagged: Which segments' inputs an estimated lag or delay acts on, (S,); the commanded ones if None.
            few: Whether some axis is excited by too few trials to show how trials differ.
        """
        self.segments, self.parameters = tuple(segments), parameters
        self.measured = Residuals(segments, channels)
        self.states = InitialStates(segments)
        self.rollouts = Rollouts(
            parameters.vehicle,
            segments,
            hydrodynamics=parameters.hydrodynamics,
            max_delay=LONGEST_DELAY if "thrust_delay" in parameters.names else 0.5,
            moving_water="current.x" in parameters.names,
        )
        self.edges = self.measured.edges
        self.groups = np.array([s.index for s in segments])
        self.few = few
        self.judged = len(parameters.names) - parameters.nuisances
        self.errors = SensorErrors(self.measured)
        far = np.full(len(self.errors.streams), LATEST)
        self.low, self.high = np.append(parameters.low, -far), np.append(parameters.high, far)
        # Imposed axes have the file's inertia within a factor, the others within an order of magnitude: far from a
        # solution, over short segments, nothing else keeps them from infinity. Streams tell the same time to hundredths
        # of a second.
        self.prior_mean = np.append(parameters.expected, 0.0 * far)
        imposed = np.arange(len(parameters.low)) >= self.judged
        wide = [VAGUE * (name != "thrust_scale" and not parameters.coupled) for name in parameters.names]
        size = np.where(imposed, 1.0, np.array(wide, float)) * parameters.scale
        known = np.where(size > 0.0, 1.0 / np.maximum(size, 1e-300) ** 2, 0.0)
        self.prior_precision = np.append(known, 0.0 * far + LATE_STD**-2.0)
        if "thrust_delay" in parameters.names:
            # A common lag of all streams is a delay of the thrust: the first stream is the clock then.
            self.prior_precision[len(parameters.names)] = EXACT_CLOCK**-2.0
        width = (len(segments), len(self.errors.std))
        self.prior_std = np.concatenate([self.states.std, np.broadcast_to(self.errors.std, width)], axis=1)
        self.axes_of_trials = tuple(a for a in AXES if a in trial_biases)
        self._bias_rows = np.array([AXES.index(a) for a in self.axes_of_trials], int)
        self.lagged = np.array([s.commanded for s in segments]) if lagged is None else lagged
        self._floor = FLOOR * self.measured.spread() + 1e-12
        self.first_noise = np.maximum(self.measured.roughness(), self._floor)

    @property
    def names(self) -> tuple[str, ...]:
        """Of theta: the parameters, then the lags of the streams [s]."""
        return self.parameters.names + tuple(f"{stream}.late" for stream in self.errors.streams)

    def start(self) -> Point:
        """The vehicle file's numbers, the measured initial states, no errors of sensors."""
        theta = np.concatenate([self.parameters.start, np.zeros(len(self.errors.streams))])
        G = int(self.groups.max()) + 1
        return Point(theta, np.zeros((G, len(self.axes_of_trials))), np.zeros(self.prior_std.shape))

    def residuals(self, points: Point) -> Array:
        """Measured minus predicted of several points, (N, C)."""
        return self._residual(points, self._predicted(points)[0])

    def _residual(self, points: Point, value: Array) -> Array:
        offset = points.z[..., len(self.states.free) :]
        return self.measured.difference(value + self.errors.offset(offset))

    def _predicted(self, points: Point) -> tuple[Array, Array]:
        """What sensors without offsets would have read and its rate of change, (N, C) each."""
        P = len(self.parameters.names)
        p = self.parameters.plants(points.theta[:, :P])
        fields = dict(p.fields)
        own = self.rollouts.own
        for name, values in (("time_constant", p.lag), ("delay", p.delay)):
            if values is not None:
                tail = (1,) * (own[name].ndim - 1)
                mask = self.lagged.reshape(-1, *tail)
                fields[name] = np.where(mask, values.reshape(-1, 1, *tail), own[name])
        bias = np.repeat(p.bias, len(self.segments), axis=1)
        if len(self._bias_rows):
            extra = np.zeros((len(points.phi), len(self.segments), 6))
            extra[..., self._bias_rows] = points.phi[:, self.groups]
            bias = bias + extra @ self.parameters.H
        current = None
        if p.current is not None:
            current = p.current + np.stack([s.current for s in self.segments])
        response = self.rollouts.run(
            fields,
            initial=self.states.initial(points.z[..., : len(self.states.free)]),
            disturbance=bias,
            current=current,
            candidates=len(points.theta),
        )
        return self.measured.predicted(response, self.errors.late(points.theta[:, P:]), current)

    def linearise(self, point: Point) -> Linear:
        """Residuals and derivatives: central differences for what moves the vehicle, exact for what sensors add."""
        points, wide = self._neighbours(point)
        value, rate = self._predicted(points)
        rise = value[:, 1::2] - value[:, 2::2]
        for j, name in enumerate(self.measured.names):
            if name in ANGLES:
                which = self.measured.channel == j
                rise[which] = wrap_angle(rise[which])
        slopes = np.nan_to_num(rise / wide)
        late, offset = self.errors.slopes(np.nan_to_num(rate[:, 0]))
        P, b = len(self.parameters.names), len(self._bias_rows)
        one = Point(*(part[:1] for part in points))
        return Linear(
            self._residual(one, value[:, :1])[:, 0],
            np.concatenate([slopes[:, :P], late, slopes[:, P : P + b]], axis=1),
            np.concatenate([slopes[:, P + b :], offset], axis=1),
        )

    def _neighbours(self, point: Point) -> tuple[Point, Array]:
        """The point, one on either side of it for every unknown that moves the vehicle, and their distances."""
        P, b, q = len(self.parameters.names), len(self._bias_rows), len(self.states.free)
        count = P + b + q
        theta, phi, z = (np.repeat(part[None], 1 + 2 * count, axis=0) for part in point)
        up, down = 1 + 2 * np.arange(count), 2 + 2 * np.arange(count)
        i = np.arange(P)
        step = RELATIVE_STEP * np.maximum(np.abs(point.theta[:P]), 0.25 * self.parameters.scale)
        theta[up[:P], i] = np.minimum(point.theta[:P] + step, self.high[:P])
        theta[down[:P], i] = np.maximum(point.theta[:P] - step, self.low[:P])
        wide = [theta[up[:P], i] - theta[down[:P], i]]
        push = RELATIVE_STEP * np.diag(self.parameters.M_RB)[self._bias_rows]
        for k in range(b):
            phi[up[P + k], :, k] += push[k]
            phi[down[P + k], :, k] -= push[k]
        for k, step_k in enumerate(self.states.steps):
            z[up[P + b + k], :, k] += step_k
            z[down[P + b + k], :, k] -= step_k
        return Point(theta, phi, z), np.concatenate([*wide, 2.0 * push, 2.0 * self.states.steps])

    def growth(self, point: Point) -> Array:
        """Largest factor by which a small change of the initial velocity grows within each segment, (S,)."""
        own = np.abs(self.linearise(point).own[:, :6])
        speeds = [
            i for i, name in enumerate(self.measured.names) if name in STREAMS["velocity"] + STREAMS["rates"]
        ]
        own[~np.isin(self.measured.channel, speeds)] = 0.0
        return np.asarray(np.maximum.reduceat(own.max(axis=1), self.edges[:-1]))

    def grain(self, theta: Array) -> Array:
        """Differences of theta that nobody minds, (P,)."""
        P = len(self.parameters.names)
        size = np.maximum(np.abs(theta[:P]), 0.1 * self.parameters.scale)
        return GRAIN * np.append(size, np.full(len(theta) - P, 1.0))

    def hold_clocks(self, hold: bool) -> None:
        """Keep the lags of all streams at zero, or let them go: far from a solution they imitate inertia."""
        P, far = len(self.parameters.names), 0.0 if hold else LATEST
        self.low[P:], self.high[P:] = -far, far

    def size(self) -> Array:
        """What counts as a large residual of every sample far from a solution, (N,)."""
        size = np.maximum(3.0 * self.first_noise, COARSE * self.measured.spread())
        return np.asarray(size[self.measured.channel])

    def noise(self, residual: Array) -> Array:
        """Standard deviation of every sample: that of its channel."""
        return np.asarray(self.measured.noise(residual, self._floor)[self.measured.channel])
