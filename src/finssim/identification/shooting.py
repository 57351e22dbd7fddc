"""Multiple shooting: residuals of simulated against measured segments, their derivatives, and the minimisation."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.core.least_squares import Block, arrow_reduced, block_of, boxed, huber_loss, huber_weight
from finssim.core.rotations import quat_conjugate, quat_from_rotvec, quat_multiply, quat_rotate, wrap_angle
from finssim.identification.parameters import LONGEST_DELAY, Parameters, horizontal
from finssim.identification.rollout import Response, Rollouts, Segment
from finssim.identification.uncertainty import correlated_samples
from finssim.physics.types import MAX_THRUSTERS
from finssim.trials.conversion import EULER
from finssim.trials.free_motion import CHANNELS
from finssim.vehicles import AXES

Array = NDArray[np.float64]


CUT = 2.5
"""Whitened residual above which Huber's loss grows linearly."""

LARGE_CURVATURE = 0.1
"""Curvature of the loss of a large residual, relative to its weight."""

CLOSE = 0.25
"""Largest error of a converged estimate, as a fraction of its standard error for independent noise."""

DAMPINGS = np.array([1e-2, 1e-1, 1.0, 1e1, 1e2, 1e4])
"""Factors on the damping that are evaluated together."""

PARTS = (1.0, 0.3, 0.1, 0.03)
"""Fractions of the step of a segment's own unknowns that are evaluated: the times of its changes of command,
which are meaningless beyond the adjacent samples, may overshoot while all other segments proceed."""

SMALL = 0.05
"""Decrease of half the sum of losses below which the iteration ends: an error of a third of a standard error."""


class Point(NamedTuple):
    """Values of all unknowns; with a leading axis of candidates if several points are evaluated together."""

    theta: Array
    """Coordinates shared by all segments in their units, (P,)."""
    z: Array
    """Coordinates of each segment in their units, as deviations from the prior's mean, (S, q)."""


class Linearization(NamedTuple):
    """Residuals at a point, sorted by segment, and derivatives of the predictions."""

    residual: Array
    """Measured minus predicted in the unit of the channel, (N,)."""
    shared: Array
    """d predicted / d theta in the units of both, (N, P)."""
    own: Array
    """d predicted / d z of the sample's own segment, in the units of both, (N, q)."""


@dataclass(frozen=True)
class FitSolution:
    """Result of a fit."""

    point: Point
    std: Array
    """Standard deviation of every sample in the unit of its channel, (N,)."""
    cost: float
    """Half the sum of the losses [-]."""
    linear: Linearization
    iterations: int
    converged: bool
    """True if the last step is negligible relative to the error that independent noise would leave."""
    step: Array
    """Change of theta, in its units, by an undamped step, (P,)."""
    interrupted: bool = False


def weights_of(residual: Array, std: Array, cut: float = CUT) -> Array:
    """Return Huber's weights over the variance of the samples, (N,): times the residual, the slope of half
    the loss."""
    return huber_weight(np.abs(residual / std), cut) / std**2


def curvatures_of(residual: Array, std: Array, cut: float = CUT) -> Array:
    """Return the second derivative of half the loss of every sample, (N,), per square of its unit.

    Where the loss is linear it is zero; `LARGE_CURVATURE` of the weight is used instead, since all residuals
    are large far from a solution. With the full weight, a step among many large residuals would be much too
    short, and an interval too narrow.
    """
    return np.where(np.abs(residual) <= cut * std, 1.0, LARGE_CURVATURE) * weights_of(residual, std, cut)


def blocks_of(
    problem: Shooting, linear: Linearization, std: Array, point: Point, cut: float = CUT
) -> list[Block]:
    """Return Newton's equations of every segment with the prior of z; the prior of theta is added to the first.

    `std` has the unit of each sample; `cut` is in standard deviations [-].
    """
    root = np.sqrt(curvatures_of(linear.residual, std, cut))[:, None]
    loss_slope = weights_of(linear.residual, std, cut) * linear.residual
    blocks = []
    for s, (a, b) in enumerate(zip(problem.edges, problem.edges[1:], strict=False)):
        shared, own, stiff = linear.shared[a:b], linear.own[a:b], problem.prior_std[s] ** -2.0
        block = block_of(shared * root[a:b], own * root[a:b], np.zeros(b - a))
        right = own.T @ loss_slope[a:b] - stiff * point.z[s]
        blocks.append(block._replace(bb=block.bb + np.diag(stiff), a=shared.T @ loss_slope[a:b], b=right))
    (off, slope), first = problem.prior(point.theta), blocks[0]
    blocks[0] = first._replace(aa=first.aa + slope.T @ slope, a=first.a - slope.T @ off)
    return blocks


def step_of(
    problem: Shooting, reduced: tuple[Array, Array, list[Array]], point: Point, damping: float
) -> tuple[Array, Array, Array]:
    """Return steps of theta (P,) within the bounds and of z (S, q), and standard errors of theta, (P,).

    The results have the units of the coordinates.

    Args:
        problem: Problem with the bounds.
        reduced: Normal equations of theta alone at the point, per unit of theta, and the dependence of z;
            from `arrow_reduced`.
        point: Start of the step.
        damping: Relative increase of the diagonal for theta [-].
    """
    total, right, inners = reduced
    scale = np.sqrt(np.maximum(np.diagonal(total), 1e-30 + 1e-12 * np.diagonal(total).max()))
    A = total / np.outer(scale, scale) + (damping + 1e-9) * np.eye(len(scale))
    low, high = problem.low - point.theta, problem.high - point.theta
    step = boxed(A, right / scale, np.minimum(low * scale, -1e-12), np.maximum(high * scale, 1e-12)) / scale
    z = np.array([inner[:, -1] - inner[:, :-1] @ step for inner in inners])
    return step, z, np.sqrt(np.diagonal(np.linalg.inv(A))) / scale


def costs_of(problem: Shooting, residual: Array, std: Array, points: Point, cut: float = CUT) -> Array:
    """Return half the robust loss of several points with residuals (N, C), (C,); infinite where the
    simulation diverged.

    Residuals and `std` have the unit of each sample; losses are dimensionless [-].
    """
    own = segment_costs(problem, residual, std, points.z, cut).sum(axis=-1)
    return np.asarray(own + 0.5 * np.square(problem.prior(points.theta)[0]).sum(axis=-1))


def segment_costs(problem: Shooting, residual: Array, std: Array, z: Array, cut: float) -> Array:
    """Return half the losses within each segment of several points, (C, S); infinite where the simulation diverged.

    Residuals (N, C), `std` (N,) and z (C, S, q) have the units of each sample and coordinate; losses are
    dimensionless [-].
    """
    loss = np.add.reduceat(huber_loss(np.abs(residual.T / std), cut), problem.edges[:-1], axis=-1)
    loss = loss + np.square(z / problem.prior_std).sum(axis=-1)
    return np.asarray(np.where(np.isfinite(loss), 0.5 * loss, np.inf))


def best_points(
    problem: Shooting, point: Point, steps: Sequence[tuple[Array, Array]], own: Array, std: Array, cut: float
) -> tuple[Point, Array]:
    """Return the points that result from several steps, and half their losses, (C,).

    Each segment takes the fraction of its own step, from `PARTS`, that fits best: given theta, segments are
    independent.

    Args:
        problem: Problem with the bounds and residuals.
        point: Start of the steps.
        steps: Steps of theta (P,) and of z (S, q), in the units of the coordinates.
        own: Part of these that is the best step of z without a step of theta, in its units, (S, q).
        std: Standard deviation of each sample in its unit, (N,).
        cut: Huber's limit, in standard deviations [-].
    """
    theta = np.clip(point.theta + np.array([step for step, _ in steps]), problem.low, problem.high)
    less = np.multiply.outer(1.0 - np.array(PARTS), own)[:, None]
    z = point.z + np.array([step for _, step in steps]) - less
    z = np.clip(z, -problem.farthest, problem.farthest)
    flat = Point(np.tile(theta, (len(PARTS), 1)), z.reshape(-1, *point.z.shape))
    costs = segment_costs(problem, problem.residuals(flat), std, flat.z, cut).reshape(*z.shape[:3])
    best = costs.argmin(axis=0)[None]
    total = np.take_along_axis(costs, best, axis=0)[0].sum(axis=-1)
    chosen = Point(theta, np.take_along_axis(z, best[..., None], axis=0)[0])
    return chosen, total + 0.5 * np.square(problem.prior(theta)[0]).sum(axis=-1)


def solve(
    problem: Shooting,
    start: Point,
    *,
    iterations: int = 60,
    std: Array | None = None,
    rough: bool = False,
    report: Callable[[int, float], None] | None = None,
) -> FitSolution:
    """Minimise the loss; noise and robust weights are estimated during the iteration.

    The fit has converged when the undamped step moves no judged parameter by more than `CLOSE` times its
    standard error plus its grain, and the noise no longer changes.

    Args:
        problem: Problem to solve.
        start: Initial point.
        iterations: Largest number of iterations.
        std: Initial standard deviation of every sample, in the unit of its channel, (N,); estimated from the
            residuals if None.
        rough: True far from a solution: `std` is kept, and no residual is treated as an outlier, since a wrong
            parameter has the same effect. The iteration ends when the cost decreases by less than a hundredth.
        report: Function that is called with each iteration and the root mean square of the whitened residuals.

    Returns:
        The best point; after Ctrl-C the best so far, with `interrupted`.
    """
    point, damping, done = start, 1e-2, 0
    linear = problem.linearise(point, one_sided=rough)
    if not np.isfinite(linear.residual).all():
        return FitSolution(
            point, np.ones(len(linear.residual)), np.inf, linear, 0, False, np.full(len(point.theta), np.inf)
        )
    std = problem.noise(linear.residual) if std is None else std
    converged, interrupted, settled, cut = False, False, rough, np.inf if rough else CUT
    step = np.full(len(point.theta), np.inf)

    def cost_at(std: Array) -> float:
        one = Point(point.theta[None], point.z[None])
        return float(costs_of(problem, linear.residual[:, None], std, one, cut)[0])

    cost = cost_at(std)
    try:
        for done in range(1, iterations + 1):
            if report:
                report(done, float(np.sqrt(2.0 * cost / max(len(std), 1))))
            reduced = arrow_reduced(blocks_of(problem, linear, std, point, cut), 0.0)
            step, _, error = step_of(problem, reduced, point, 0.0)
            near = error + problem.grain(point.theta)
            remaining = float(np.max(np.abs(step / near)[: problem.judged], initial=0.0))
            if settled and remaining < CLOSE:
                converged = True
                break
            steps = [step_of(problem, reduced, point, damping * factor)[:2] for factor in DAMPINGS]
            own = np.array([inner[:, -1] for inner in reduced[2]])
            points, costs = best_points(problem, point, steps, own, std, cut)
            best = int(np.argmin(costs))
            if costs[best] < cost:
                damping = float(np.clip(damping * DAMPINGS[best], 1e-9, 1e9))
                stuck = cost - costs[best] < (1e-2 * cost if rough else SMALL)
                point = Point(points.theta[best], points.z[best])
                linear = problem.linearise(point, one_sided=rough)
            else:
                damping = min(damping * 1e5, 1e12)
                stuck = damping >= 1e12
            new = std if rough else problem.noise(linear.residual)
            settled = rough or bool(np.all(np.abs(np.log(new / std)) < 0.01)) or done > 12
            if stuck and settled:
                converged = remaining < 1.0
                break
            if not settled:
                std, damping = new, min(damping, 1e-2)
            cost = cost_at(std)
    except KeyboardInterrupt:
        interrupted = True
    return FitSolution(point, std, cost, linear, done, converged, step, interrupted)


class Residuals:
    """Samples of all segments in one list, sorted by segment, then by channel.

    Attributes:
        names: Channels in use.
        channel: Index into `names` of each sample, (N,).
        kind: As `channel`, plus `len(names)` if the trial does not drive the axis: samples with a common
            noise level, (N,).
        segment: Index of the segment, (N,).
        edges: First sample of each segment, and N, (S + 1,).
        value: Measured values, (N,).
        time: Times since the segment's start [s], (N,).
        clock: Times on the trial's clock [s], (N,).
    """

    def __init__(self, segments: Sequence[Segment], channels: Sequence[str]) -> None:
        """Collect the samples of some channels."""
        self.segments = tuple(segments)
        self.names = tuple(c for c in CHANNELS if c in channels and any(c in s.measured for s in segments))
        rows: dict[str, list[Array]] = {k: [] for k in ("segment", "channel", "time", "value")}
        for i, s in enumerate(segments):
            for j, name in enumerate(self.names):
                t, values = s.measured.get(name, (np.empty(0), np.empty(0)))
                rows["segment"].append(np.full(len(t), i))
                rows["channel"].append(np.full(len(t), j))
                rows["time"].append(t / s.step)
                rows["value"].append(values)
        joined = {k: np.concatenate(v) if v else np.empty(0) for k, v in rows.items()}
        self.segment, self.channel = joined["segment"].astype(int), joined["channel"].astype(int)
        self.value, time = joined["value"], joined["time"]
        self.time = time * segments[0].step
        self.clock = self.time + np.array([s.t0 for s in segments])[self.segment]
        self._steps = np.array([s.steps for s in segments])[self.segment]
        self.edges = np.searchsorted(self.segment, np.arange(len(segments) + 1))
        aside = np.array([[c in s.aside for c in self.names] for s in segments])
        self.kind = self.channel + len(self.names) * aside[self.segment, self.channel]

    def __len__(self) -> int:
        return len(self.value)

    def predicted(self, response: Response, late: Array) -> tuple[Array, Array]:
        """Return the predicted sensor readings of every candidate at the samples' times, and the rate of
        change of the first.

        Args:
            response: Responses of the candidates.
            late: Lag of each sample behind the measured quantity [s], (N, C) or (N, 1).

        Returns:
            (N, C) and (N, 1) [unit of the channel, and the same per second]; NaN where a candidate diverged.
            Before a segment's start the response is extrapolated linearly.
        """
        step = self.segments[0].step
        candidates = response.nu.shape[1]
        value, rate = np.empty((len(self), candidates)), np.empty((len(self), 1))
        for j, name in enumerate(self.names):
            which = np.flatnonzero(self.channel == j)
            grid = channel(name, response, self.segments)
            for c in range(late.shape[1]):
                those = slice(None) if late.shape[1] == 1 else slice(c, c + 1)
                at = (self.time[which] - late[which, c]) / step
                row = np.clip(np.floor(at).astype(int), 0, self._steps[which] - 1)
                segment = self.segment[which]
                a = grid[row, those, segment].astype(float)
                rise = grid[row + 1, those, segment].astype(float) - a
                if name in EULER:
                    rise = wrap_angle(rise)
                value[which, those] = a + (at - row)[:, None] * rise
                if c == 0:
                    rate[which, 0] = rise[:, 0] / step
        return value, rate

    def difference(self, predicted: Array) -> Array:
        """Return measured minus predicted values, with angles wrapped, (N, C). The unit is that of the channel."""
        out = self.value[:, None] - predicted
        for j, name in enumerate(self.names):
            if name in EULER:
                which = self.channel == j
                out[which] = wrap_angle(out[which])
        return np.asarray(out)

    def noise(self, residual: Array, floor: Array) -> Array:
        """Return the standard deviation of each kind of sample from clipped residuals, (2 channels,).

        The unit is that of the channel.

        Args:
            residual: Measured minus predicted in the unit of the channel, (N,).
            floor: Least value per channel, in its unit, (channels,).
        """
        floor = np.tile(floor, 2)
        out = np.array(floor, float)
        for j in np.unique(self.kind):
            r = residual[self.kind == j]
            r = np.abs(r[np.isfinite(r)])
            sigma = 1.4826 * float(np.median(r)) if len(r) else 0.0
            sigma = sigma or float(np.sqrt(np.mean(r**2))) if len(r) else floor[j]
            for _ in range(10):
                # The factor compensates the clipping for a normal distribution at 2.5 standard deviations.
                clipped = np.minimum(r, CUT * sigma)
                sigma = 1.011 * float(np.sqrt(np.mean(clipped**2))) if sigma > 0.0 else 0.0
            out[j] = max(sigma, floor[j])
        return out

    def spread(self) -> Array:
        """Return the range from the 2nd to the 98th percentile of each channel, the largest of the segments,
        (channels,).

        The unit is that of the channel.
        """
        out = np.zeros(len(self.names))
        for j, values in self._runs():
            out[j] = max(out[j], float(np.ptp(np.percentile(values, [2.0, 98.0]))))
        return out

    def roughness(self) -> Array:
        """Return a robust estimate of the noise of each channel from third differences of successive samples,
        (channels,).

        The unit is that of the channel.
        """
        steps: list[list[Array]] = [[np.empty(0)] for _ in self.names]
        for j, values in self._runs():
            steps[j].append(np.abs(np.diff(values, 3)))
        out = np.zeros(len(self.names))
        for j, d in enumerate(map(np.concatenate, steps)):
            if len(d):
                cut = 3.0 * 1.4826 * np.median(d) + 1e-12
                out[j] = float(np.sqrt(np.mean(np.minimum(d, cut) ** 2) / 20.0))
        return out

    def _runs(self) -> Iterator[tuple[int, Array]]:
        """Yield each segment's samples of each of its channels, by the index of the channel."""
        for a, b in zip(self.edges, self.edges[1:], strict=False):
            for j in np.unique(self.channel[a:b]):
                yield int(j), self.value[a:b][self.channel[a:b] == j]


def channel(name: str, response: Response, segments: Sequence[Segment]) -> NDArray[np.float32]:
    """Return a measured column on the simulation's grid.

    Args:
        name: One of `CHANNELS`.
        response: Responses of every candidate over these segments.
        segments: Segments with the sensor positions.

    Returns:
        Values in the unit of the response, (n + 1, C, S).
    """
    nu, q = response.nu, response.quaternion
    if name in ("p", "q", "r"):
        return nu[..., 3 + "pqr".index(name)]
    if name in ("u", "v", "w"):
        i = "uvw".index(name)
        at = np.stack([s.sensors.velocity_at for s in segments]).astype(np.float32)
        j, k = (i + 1) % 3, (i + 2) % 3
        out = nu[..., i] + (nu[..., 3 + j] * at[:, k] - nu[..., 3 + k] * at[:, j] if at.any() else 0.0)
        in_water = np.array([s.sensors.velocity_in_water for s in segments])
        if in_water.any():
            flow = np.stack([s.current for s in segments])
            body = quat_rotate(quat_conjugate(q), np.broadcast_to(flow, (*q.shape[1:3], 3)))[..., i]
            out = out - np.where(in_water, body, 0.0)
        return np.asarray(out, np.float32)
    if name in EULER:
        return euler_angle(name, q)
    sensor = "depth_at" if name == "depth" else "position_at"
    at = np.stack([getattr(s.sensors, sensor) for s in segments])
    i = 2 if name == "depth" else "xyz".index(name)
    out = response.position[..., i] + (quat_rotate(q, at)[..., i] if at.any() else 0.0)
    return np.asarray(-out if name == "depth" else out, np.float32)


def euler_angle(name: str, q: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return roll, pitch or yaw of unit quaternions, in their own precision, (..., 4) -> (...)."""
    x, y, z, w = (q[..., i] for i in range(4))
    if name == "roll":
        return np.asarray(np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)))
    if name == "yaw":
        return np.asarray(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
    return np.asarray(np.arcsin(np.clip(2.0 * (w * y - x * z), -1.0, 1.0)))


# Sensor errors that a fit estimates: offsets of a segment, and delayed streams.

STREAMS = {
    "velocity": ("u", "v", "w"),
    "rates": ("p", "q", "r"),
    "attitude": ("roll", "pitch", "yaw"),
    "position": ("x", "y", "z"),
    "depth": ("depth",),
}
"""Channels that share a clock."""

OFFSETS = {"p": 0.02, "q": 0.02, "r": 0.02, "roll": 0.03, "pitch": 0.03, "depth": 0.1}
"""Channels with an offset that is constant over a segment, and its standard deviation: biases of gyroscopes
in free motions and slow logs [rad/s], misaligned tilt sensors [rad], pressure at the surface [m]."""

DRIFTING_REST = {"roll drift": ("roll", "p"), "pitch drift": ("pitch", "q")}
"""Angle and rate of an equilibrium that changes at constant speed within a segment, for example with a moving
manipulator."""

REST_STD, DRIFT_STD = 0.3, 0.02
"""Standard deviations of the equilibrium of a free swing [rad] and of its speed [rad/s]."""

PULL, COASTING = 0.003, (0, 1, 5)
"""Standard deviation of a constant pull on a coasting vehicle, such as that of a tether, relative to its
weight, with half its length as the lever arm; and the axes that coast."""

TETHER = 0.01
"""Standard deviation of the horizontal pull of a tether on a driven vehicle in slow logs, relative to its
weight. Within a segment its direction is constant in the world frame."""

CHANGE_STD = 12.0**-0.5
"""Standard deviation of the time of a change between two samples of a command, relative to the sample interval."""

CHANGE_STEP = 0.05
"""Step of its finite differences: a longer one would often exceed the sample interval, where nothing changes
any more."""

LATEST = 0.3
"""Largest lag or lead of a stream relative to the inputs [s]."""

CLOCK_STD, LATE_STD = 0.05, 0.03
"""Prior standard deviations of the common lag of all streams of a log and of the individual additional lags
[s]: noisy data do not distinguish a lag from inertia."""


# Initial state of each segment: measured values, and the range in which a fit may change them.

UNKNOWN = np.array([0.5, 0.5, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 1e-6, 1e-6, 1e-6, 1e-6])
"""Standard deviation of unmeasured values; heading and position are irrelevant then."""

UNMOVED = np.array([0.05] * 6 + [0.3, 0.3, *UNKNOWN[8:]])
"""Standard deviation of unmeasured values in a free motion, in which the other axes are not driven."""

LOOSE = np.array([0.2, 0.2, 0.2, 0.3, 0.3, 0.3, 0.1, 0.1, 0.1, 0.2, 0.2, 0.2])
"""Standard deviation of measured and compared values: large, since the same measurements count as residuals."""

TIGHT = np.array([0.03, 0.03, 0.03, 0.03, 0.03, 0.03, 0.02, 0.02, 0.02, 0.03, 0.03, 0.03])
"""Standard deviation of measured values that are not compared."""

SHOWN_BY = (
    *(("u", "x", "y"), ("v", "x", "y"), ("w", "z", "depth"), ("p", "roll"), ("q", "pitch"), ("r", "yaw")),
    *(("roll",), ("pitch",), ("yaw",), ("x",), ("y",), ("z", "depth")),
)
"""Channels that determine a state, in the order of `STATES`."""

STEPS = np.array([0.002] * 9 + [0.005] * 3)
"""Steps of the finite differences of initial states [m/s, rad/s, rad, m]."""

LINEAR_GROWTH = 8.0
"""Growth within a segment above which these steps are reduced in proportion, since differences over large
responses do not approximate derivatives."""


RELATIVE_STEP = 0.006
"""Step of the finite differences, relative to a coordinate's size: single precision leaves three digits."""

FORCE_STEP = 0.15
"""Relative step of damping and excess of a rise, which are nearly degenerate: rounding errors of small steps
would appear as information."""

GRAIN = 0.004
"""Relative change of a number that is negligible."""

COARSE = 0.05
"""Size of residuals relative to a channel's range that counts as small while the parameters are far from the
solution."""

VAGUE = 8.0
"""Prior standard deviation of a fitted number about the file's value, in units of its scale."""

EXACT_CLOCK = 1e-3
"""Largest lag of the stream that serves as the clock [s]."""

CONSTANT = 1e-3
"""Least noise of a constant channel, for example without a sensor [m, rad, m/s, rad/s]: the resolution of
single precision."""

FEWEST_CORRELATED = 20
"""Least number of samples of a channel for an estimate of their correlation."""

FLOOR = 1e-4
"""Least noise of a channel, relative to its range: smaller values are below the simulation's own errors."""


class ParameterPrior:
    """Prior of theta: of the parameters and of the lags of the streams.

    The inertia of imposed axes is that of the file within a factor, that of the others within an order of
    magnitude: far from a solution, over short segments, nothing else keeps them finite. The clocks of streams
    agree to hundredths of a second.
    """

    def __init__(self, parameters: Parameters, streams: int, released: bool) -> None:
        """Set up the prior for a number of streams, for segments that are driven or `released`."""
        P, judged = len(parameters.names), len(parameters.names) - parameters.nuisances
        none = np.zeros(streams)
        self.mean = np.concatenate([parameters.expected, none])
        size = np.array([VAGUE * c.scale if c.std is None else c.std for c in parameters.coordinates])
        size[judged:] = parameters.scale[judged:]
        rigid = [np.nan if c.rigid is None else c.rigid for c in parameters.coordinates[:judged]]
        self.rigid = np.concatenate([rigid, np.full(parameters.nuisances + streams, np.nan)])
        self.known = np.concatenate([size**-1.0, none])
        clocks = LATE_STD**2 * np.eye(streams) + CLOCK_STD**2
        if "thrust_delay" in parameters.names or released:
            # A common lag of all streams is equivalent to a delay of the thrust: the first stream is then the clock.
            clocks = np.diag(np.where(np.arange(streams) == 0, EXACT_CLOCK, CLOCK_STD) ** 2)
        rows, target = parameters.prior_rows()
        self.rows = np.zeros((len(rows) + streams, P + streams))
        self.rows[: len(rows), :P] = rows
        self.rows[len(rows) :, P:] = np.linalg.inv(np.linalg.cholesky(clocks))
        self.target = np.concatenate([target, none])

    def __call__(self, theta: Array, weight: float) -> tuple[Array, Array]:
        """Return the whitened differences of vectors (..., P) from the prior, (..., R), and the slopes for
        one vector, (R, P).

        Both are multiplied by a weight [-].
        """
        logarithmic = np.isfinite(self.rigid)
        whole, mean = theta + self.rigid, self.mean + self.rigid
        whole = np.where(logarithmic, np.maximum(whole, 1e-3 * np.abs(mean)), 1.0)
        off = np.where(logarithmic, np.log(whole / np.where(logarithmic, mean, 1.0)), theta - self.mean)
        off = weight * np.concatenate([off * self.known, theta @ self.rows.T - self.target], axis=-1)
        return off, weight * np.concatenate([np.diag(np.atleast_2d(self.known / whole)[0]), self.rows])


class Shooting:
    """Residuals of segments for given parameters and initial states.

    Attributes:
        streams: Names of the streams in use; each may lag the inputs.
        offsets: Names of the channels with a separate offset in every segment, then of `DRIFTING_REST`.
        free: Indices into `STATES` of the components that a fit changes from their measured values, (q,):
            velocities and tilt always, heading and position if they are known in some segment and relevant;
            from 12 to 17, the wrench of a tether; from 18 on, the times of changes of the command.
        edges: First sample of each segment, and N, (S + 1,).
        low: Lower bounds of theta, (P,).
        high: Upper bounds of theta, (P,).
        prior_std: Standard deviations of z around zero, (S, q).
        released: True if no segment is driven.
        coasts: True if, in addition, the axes come to rest by drag alone.
        farthest: Largest deviations of z, (q,): for the time of a change half the sample interval.
        judged: Number of components of theta, from the first, that must be accurate; the others are nuisance
            parameters.
        repeats: Number of samples per independent one.
    """

    def __init__(
        self,
        segments: Sequence[Segment],
        parameters: Parameters,
        channels: Sequence[str],
        *,
        lagged: NDArray[np.bool_] | None = None,
        swinging: NDArray[np.bool_] | None = None,
        twisted: bool = True,
        few: bool = False,
        correlated: bool = True,
    ) -> None:
        """Set up the problem.

        Args:
            segments: Segments to fit.
            parameters: Free parameters.
            channels: Measured columns to compare.
            lagged: Mask of the segments whose inputs are subject to an estimated lag or delay, (S,); the
                commanded ones if None.
            swinging: Mask of the segments of a free motion, in which the equilibrium of roll and pitch may
                move, (S,).
            twisted: True if a constant moment may act on a coasting vehicle, if all trials are coasts; a
                force may act in any case.
            few: True if some axis is excited by too few trials to determine the differences between trials.
            correlated: True if samples with correlated errors count as fewer relative to the prior.
        """
        self.segments, self.parameters = tuple(segments), parameters
        self.groups = np.array([s.index for s in segments])
        self._slow = np.isin(self.groups, [s.index for s in segments if s.drive.changes is not None])
        self.measured = Residuals(segments, channels)
        self.edges = self.measured.edges
        self.few, self._correlated, self.repeats = few, correlated, 1.0
        self.judged = len(parameters.names) - parameters.nuisances
        swings = np.zeros(len(segments), bool) if swinging is None else swinging
        self.released = bool(swings.all())
        self.coasts = self.released and {AXES.index(a) for a in parameters.axes} <= set(COASTING)
        self.lagged = np.array([s.drive.commanded for s in segments]) if lagged is None else lagged
        longest = LONGEST_DELAY if "thrust_delay" in parameters.names else 0.5
        self.rollouts = Rollouts(parameters.vehicle, segments, max_delay=longest)
        self.streams = tuple(stream for stream, of in STREAMS.items() if set(of) & set(self.measured.names))
        self.prior_std = np.concatenate([self._states(swings, twisted), self._sensors(swings)], axis=1)
        self.farthest = np.full(self.prior_std.shape[1], np.inf)
        self.farthest[np.flatnonzero(self.free >= 18)] = 0.5
        far = np.full(len(self.streams), LATEST)
        self.low = np.concatenate([parameters.low, -far])
        self.high = np.concatenate([parameters.high, far])
        self._prior = ParameterPrior(parameters, len(self.streams), self.released)
        forces = np.isin(parameters.names, ("heave.d1", "heave.d2", "buoyancy_excess"))
        self._relative_step = np.where(forces & self.released, FORCE_STEP, RELATIVE_STEP)
        # A thruster that is 1 m higher adds the moment e_z × axis.
        by_thruster = np.array([s.drive.thrusters for s in segments])
        sideways = horizontal(parameters.vehicle)
        self._by_thruster = by_thruster[:, None, None]
        self._leverage = np.zeros((len(segments), 6, MAX_THRUSTERS))
        for j, (name, thruster) in enumerate(parameters.vehicle.thrusters.items()):
            if name in sideways:
                self._leverage[by_thruster, 3, j] = -thruster.axis[1]
                self._leverage[by_thruster, 4, j] = thruster.axis[0]
        noise = self.measured.roughness()
        self._floor = np.where(noise > 0.0, FLOOR * self.measured.spread() + 1e-12, CONSTANT)
        self.first_noise = np.maximum(noise, self._floor)
        self._grown = np.ones(len(segments))  # growth of changes of the start at the last linearisation
        self._latest: tuple[Point, Linearization, bool] | None = None

    def _states(self, swinging: NDArray[np.bool_], twisted: bool) -> Array:
        """Select the free initial states, pulls and times of changes, and return their standard deviations.

        `swinging` and `twisted` are those of the constructor.
        """
        segments, names, changes = self.segments, self.measured.names, self.rollouts.changes
        known = np.stack([s.start.known for s in segments])
        # Heading and position are free if a compared quantity depends on them.
        flat, deep = {"x", "y"} & set(names), all(s.sink for s in segments)
        turned = flat or "yaw" in names or any(s.current.any() for s in segments)
        felt = [turned, "x" in names, "y" in names, {"z", "depth"} & set(names) or not deep]
        somewhere = np.flatnonzero(known[:, 8:].any(axis=0) & [bool(x) for x in felt])
        states = np.concatenate([np.arange(8), 8 + somewhere])
        seen = np.array([[any(c in s.measured for c in columns) for columns in SHOWN_BY] for s in segments])
        unknown = np.where(swinging[:, None], UNMOVED, UNKNOWN)
        states_std = np.where(known, np.where(seen, LOOSE, TIGHT), unknown)[:, states]
        pulls = self._pulls(swinging, twisted)
        pulled = np.flatnonzero(pulls.any(axis=0))
        times = np.arange(changes.max())
        self.free = np.concatenate([states, 12 + pulled, 18 + times])
        push = 0.1 * PULL * self.parameters.vehicle.weight
        self._steps = np.concatenate([STEPS, np.full(6, push), np.full(len(times), CHANGE_STEP)])
        times_std = np.where(times < changes[:, None], CHANGE_STD, 1e-9)
        return np.hstack([states_std, np.maximum(pulls[:, pulled], 1e-9), times_std])

    def _sensors(self, swinging: NDArray[np.bool_]) -> Array:
        """Select the sensor errors that a fit estimates, and return the standard deviations of offsets."""
        m, names = self.measured, self.measured.names
        # The initial height is already equivalent to an offset of the depth, unless z is measured too.
        self.offsets = tuple(c for c in names if c in OFFSETS and (c != "depth" or "z" in names))
        stream_of = {c: i for i, stream in enumerate(self.streams) for c in STREAMS[stream]}
        self._stream = np.array([stream_of[c] for c in names], int)[m.channel]
        rows = [names.index(name) for name in self.offsets]
        self._offset = (m.channel[:, None] == np.array(rows, int)).astype(float)
        std = np.tile([OFFSETS[c] for c in self.offsets], (len(self.segments), 1))
        # In fast logs of a driven vehicle, an offset of the gyroscope would absorb errors of the drag.
        std[np.ix_(~swinging & ~self._slow, np.isin(self.offsets, STREAMS["rates"]))] = 1e-9
        for name, (angle, rate) in DRIFTING_REST.items() if swinging.any() else ():
            if angle in names:
                channel = np.array(names)[m.channel]
                column = np.where(channel == angle, m.time, channel == rate)
                self.offsets += (name,)
                self._offset = np.column_stack([self._offset, column])
                std = np.column_stack([std, np.where(swinging, DRIFT_STD, 1e-9)])
                std[swinging, self.offsets.index(angle)] = REST_STD
        return std

    def _pulls(self, swinging: NDArray[np.bool_], twisted: bool) -> Array:
        """Return the standard deviations of the constant pulls on the vehicle in each segment [N, N m], (S, 6).

        `swinging` and `twisted` are those of the constructor.
        """
        p, out = self.parameters, np.zeros((len(self.segments), 6))
        body, weight = p.vehicle.body, p.vehicle.weight
        # In fast logs, which resolve the motion well, pulls would absorb errors of the model.
        if {"surge", "sway"} & set(p.axes):
            out[self._slow & ~swinging, :2] = TETHER * weight
        coasting = set(p.axes).difference(p.biases)
        for i in COASTING:
            if AXES[i] in coasting and (i < 3 or twisted or not self.coasts):
                out[swinging, i] = PULL * weight * (1.0 if i < 3 else 0.5 * body.size[0])
        return out

    def _scale(self, theta: Array) -> Array:
        """Return the scale of thrust of vectors (C, P) [-], (C,), by which pulls are multiplied as well.

        With absolute standard deviations they would determine the scale of all forces, and therefore of all masses.
        """
        names = self.parameters.names
        return theta[:, names.index("thrust_scale")] if "thrust_scale" in names else np.ones(len(theta))

    def prior(self, theta: Array) -> tuple[Array, Array]:
        """Return the whitened differences of vectors (..., P) from the prior, (..., R), and the slopes for
        one vector, (R, P).

        Samples count as independent in the cost, so the prior counts `repeats` times.
        """
        return self._prior(theta, np.sqrt(self.repeats))

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of theta: the parameters, then the lags of the streams [s]."""
        return self.parameters.names + tuple(f"{stream}.late" for stream in self.streams)

    def start(self) -> Point:
        """Return the vehicle file's numbers, the measured initial states, and no sensor errors."""
        rest = np.zeros(len(self.low) - len(self.parameters.names))
        return Point(np.concatenate([self.parameters.start, rest]), np.zeros(self.prior_std.shape))

    def cost(self, point: Point) -> float:
        """Return half the loss of one point [-], with residual sizes typical far from a solution and zero clock
        offsets."""
        one = Point(point.theta[None], point.z[None])
        return float(costs_of(self, self.residuals(one), self.size(), one)[0])

    def residuals(self, points: Point) -> Array:
        """Return measured minus predicted values of several points, (N, C), in the unit of the channel."""
        return self._residual(points, self._predicted(points)[0])

    def _residual(self, points: Point, value: Array) -> Array:
        offset, out = points.z[..., len(self.free) :], np.zeros((len(self.measured), len(points.z)))
        for k in range(offset.shape[2]):
            out += self._offset[:, k : k + 1] * offset[:, self.measured.segment, k].T
        return self.measured.difference(value + out)

    def _predicted(self, points: Point) -> tuple[Array, Array]:
        """Return the sensor readings without offsets, (N, C), and the rate of change of the first, (N, 1)."""
        P, C = len(self.parameters.names), len(points.theta)
        p = self.parameters.plants(points.theta[:, :P])
        fields = dict(p.fields)
        own = self.rollouts.own
        for name, values in (("time_constant", p.lag), ("delay", p.delay)):
            if values is not None:
                tail = (1,) * (own[name].ndim - 1)
                mask = self.lagged.reshape(-1, *tail)
                fields[name] = np.where(mask, values.reshape(-1, 1, *tail), own[name])
        if p.lower is not None:
            fields["B"] = own["B"] + p.lower[:, None, None, None] * self._leverage
        if p.gains is not None:
            gains = np.where(self._by_thruster, p.gains[:, None, None], 1.0)
            fields["B"] = fields.get("B", own["B"]) * gains
        full = np.zeros((*points.z.shape[:2], 18 + int(self.rollouts.changes.max())))
        full[..., self.free] = points.z[..., : len(self.free)]
        nu, quaternion, position = (
            np.stack([getattr(s.start, name) for s in self.segments])
            for name in ("nu", "quaternion", "position")
        )
        initial = {
            "nu": nu + full[..., :6],
            "quaternion": quat_multiply(quaternion, quat_from_rotvec(full[..., 6:9])),
            "position": position + full[..., 9:12],
        }
        response = self.rollouts.run(
            fields,
            initial=initial,
            disturbance=p.bias + full[..., 12:18] * (np.arange(6) > 2),
            pull=full[..., 12:15] * self._scale(points.theta)[:, None, None],
            earlier=full[..., 18:],
            candidates=C,
        )
        late = points.theta[:, P:]
        same = bool((late == late[:1]).all())
        return self.measured.predicted(response, (late[:1] if same else late).T[self._stream])

    def linearise(self, point: Point, *, one_sided: bool = False) -> Linearization:
        """Return residuals and derivatives: finite differences for unknowns that affect the motion, exact for
        sensor errors.

        The result for the latest point is cached, since a solution often starts where another ended.

        Args:
            point: Point of the linearisation.
            one_sided: True if one-sided differences suffice, instead of central ones; never without thrust,
                where the parameters are more strongly correlated.
        """
        one_sided = one_sided and not self.released
        latest = self._latest
        known = latest is not None and all(map(np.array_equal, latest[0], point))
        if latest is None or not known or (latest[2] and not one_sided):
            latest = self._latest = point, self._linearised(point, one_sided), one_sided
        return latest[1]

    def _linearised(self, point: Point, one_sided: bool) -> Linearization:
        points, wide = self._neighbours(point, one_sided)
        value, rate = self._predicted(points)
        rise = value[:, 1:] - value[:, :1] if one_sided else value[:, 1::2] - value[:, 2::2]
        for j, name in enumerate(self.measured.names):
            if name in EULER:
                which = self.measured.channel == j
                rise[which] = wrap_angle(rise[which])
        slopes = np.nan_to_num(rise / np.where(wide != 0.0, wide, np.inf))
        late = np.where(self._stream[:, None] == np.arange(len(self.streams)), -np.nan_to_num(rate), 0.0)
        P = len(self.parameters.names)
        one = Point(*(part[:1] for part in points))
        linear = Linearization(
            self._residual(one, value[:, :1])[:, 0],
            np.concatenate([slopes[:, :P], late], axis=1),
            np.concatenate([slopes[:, P:], self._offset], axis=1),
        )
        grown = self._growth(linear)
        self._grown = np.where(np.isfinite(grown), grown, self._grown)
        return linear

    def _neighbours(self, point: Point, one_sided: bool) -> tuple[Point, Array]:
        """Return the point with one- or two-sided neighbours for every unknown that affects the motion, and
        the distances for each sample, (N, P + q)."""
        P = len(self.parameters.names)
        count, steps = P + len(self.free), np.tile(self._steps[self.free], (len(self.segments), 1))
        steps *= LINEAR_GROWTH / np.maximum(self._grown, LINEAR_GROWTH)[:, None]
        sides = 1 if one_sided else 2
        theta, z = (np.repeat(part[None], 1 + sides * count, axis=0) for part in point)
        up, i = 1 + sides * np.arange(count), np.arange(P)
        step = self._relative_step * np.maximum(np.abs(point.theta[:P]), 0.25 * self.parameters.scale)
        high = np.minimum(point.theta[:P] + step, self.high[:P])
        low = np.maximum(point.theta[:P] - step, self.low[:P])
        if one_sided:  # away from a bound
            theta[up[:P], i] = np.where(high > point.theta[:P], high, low)
            wide = theta[up[:P], i] - point.theta[:P]
        else:
            theta[up[:P], i], theta[up[:P] + 1, i] = high, low
            wide = high - low
        for k, step_k in enumerate(steps.T):
            z[up[P + k], :, k] += step_k
            if not one_sided:
                z[up[P + k] + 1, :, k] -= step_k
        shared = np.broadcast_to(wide, (len(self.measured), P))
        return Point(theta, z), np.concatenate([shared, sides * steps[self.measured.segment]], axis=1)

    def growth(self, point: Point) -> Array:
        """Return the largest factor by which a small change of the initial velocity grows within each segment, (S,).

        It is infinite where the simulation diverges.
        """
        return self._growth(self.linearise(point))

    def _growth(self, linear: Linearization) -> Array:
        own = np.abs(linear.own[:, :6])
        speeds = np.isin(self.measured.names, STREAMS["velocity"] + STREAMS["rates"])
        own[~speeds[self.measured.channel]] = 0.0
        own[~np.isfinite(linear.residual)] = np.inf
        return np.asarray(np.maximum.reduceat(own.max(axis=1), self.edges[:-1]))

    def grain(self, theta: Array) -> Array:
        """Return negligible differences of theta, (P,), in the units of theta."""
        P = len(self.parameters.names)
        size = np.maximum(np.abs(theta[:P]), 0.1 * self.parameters.scale)
        return GRAIN * np.append(size, np.full(len(theta) - P, 1.0))

    def hold_clocks(self, hold: bool) -> None:
        """Fix the lags of all streams at zero, or release them: far from a solution they imitate inertia."""
        late, far = slice(len(self.parameters.names), None), 0.0 if hold else LATEST
        self.low[late], self.high[late] = -far, far

    def size(self) -> Array:
        """Return the size of a large residual of every sample far from a solution, (N,).

        The unit is that of the channel.
        """
        size = np.maximum(3.0 * self.first_noise, COARSE * self.measured.spread())
        return np.asarray(size[self.measured.channel])

    def noise(self, residual: Array) -> Array:
        """Return the standard deviation of every sample, which is that of its channel and has its unit.

        The number of samples per independent one is computed from the same residuals.
        """
        m, found = self.measured, []
        for j in np.unique(m.kind) if self._correlated else ():
            rows = np.flatnonzero((m.kind == j) & np.isfinite(residual))
            if len(rows) > FEWEST_CORRELATED:
                found.append(correlated_samples(residual[rows], np.flatnonzero(np.diff(m.segment[rows])) + 1))
        self.repeats = float(np.mean(found)) if found else 1.0
        return np.asarray(m.noise(residual, self._floor)[m.kind])
