"""What a simulation would have measured, against what was measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.simulation.rollout import Response
from finssim.calibration.simulation.segments import CHANNELS, Segment
from finssim.geometry.rotations import quat_conjugate, quat_rotate, wrap_angle

__all__ = ["ANGLES", "Residuals", "channel", "euler_angle"]

Array = NDArray[np.float64]

CUT = 2.5
"""Residual, in standard deviations, above which the weight falls (Huber 1964)."""

ANGLES = ("roll", "pitch", "yaw")


class Residuals:
    """Samples of all segments in one list, sorted by segment, then by channel.

    Attributes:
        names: Channels in use.
        channel: Index into `names` of each sample, (N,).
        segment: Index of its segment, (N,).
        edges: First sample of each segment, and N, (S + 1,).
        value: Measured, (N,).
        time: Since the segment's start [s], (N,).
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
        self._steps = np.array([s.steps for s in segments])[self.segment]
        self.edges = np.searchsorted(self.segment, np.arange(len(segments) + 1))

    def __len__(self) -> int:
        return len(self.value)

    def predicted(self, response: Response, late: Array, current: Array | None = None) -> tuple[Array, Array]:
        """What every candidate's sensors would have read at the samples' times, and its rate of change.

        Args:
            response: Of the candidates.
            late: By how much each sample lags what it shows [s], (N, C) or (N, 1).
            current: As for `channel`.

        Returns:
            (N, C) each [unit of the channel, and the same per second]; NaN where a candidate diverged. Before a
            segment's start it is extrapolated in a straight line.
        """
        step = self.segments[0].step
        candidates = response.nu.shape[1]
        value, rate = (np.empty((len(self), candidates)) for _ in range(2))
        for j, name in enumerate(self.names):
            which = np.flatnonzero(self.channel == j)
            grid = channel(name, response, self.segments, current)
            for c in range(late.shape[1]):
                those = slice(None) if late.shape[1] == 1 else slice(c, c + 1)
                at = (self.time[which] - late[which, c]) / step
                row = np.clip(np.floor(at).astype(int), 0, self._steps[which] - 1)
                segment = self.segment[which]
                a = grid[row, those, segment].astype(float)
                rise = grid[row + 1, those, segment].astype(float) - a
                if name in ANGLES:
                    rise = wrap_angle(rise)
                value[which, those] = a + (at - row)[:, None] * rise
                rate[which, those] = rise / step
        return value, rate

    def difference(self, predicted: Array) -> Array:
        """Measured minus predicted, angles the short way round, (N, C)."""
        out = self.value[:, None] - predicted
        for j, name in enumerate(self.names):
            if name in ANGLES:
                which = self.channel == j
                out[which] = wrap_angle(out[which])
        return np.asarray(out)

    def noise(self, residual: Array, floor: Array) -> Array:
        """Standard deviation of each channel from clipped residuals, (channels,).

        Args:
            residual: Measured minus predicted, (N,).
            floor: Smallest per channel, (channels,).
        """
        out = np.array(floor, float)
        for j in range(len(self.names)):
            r = residual[self.channel == j]
            r = np.abs(r[np.isfinite(r)])
            sigma = 1.4826 * float(np.median(r)) if len(r) else 0.0
            sigma = sigma or float(np.sqrt(np.mean(r**2))) if len(r) else floor[j]
            for _ in range(10):
                # The factor undoes the clipping for a normal distribution at 2.5 standard deviations.
                sigma = (
                    1.011 * float(np.sqrt(np.mean(np.minimum(r, CUT * sigma) ** 2))) if sigma > 0.0 else 0.0
                )
            out[j] = max(sigma, floor[j])
        return out

    def spread(self) -> Array:
        """Range from the 2nd to the 98th percentile of each channel, the largest of the segments, (channels,)."""
        out = np.zeros(len(self.names))
        for a, b in zip(self.edges, self.edges[1:], strict=False):
            for j in np.unique(self.channel[a:b]):
                values = self.value[a:b][self.channel[a:b] == j]
                out[j] = max(out[j], float(np.ptp(np.percentile(values, [2.0, 98.0]))))
        return out

    def roughness(self) -> Array:
        """Noise of each channel from third differences of successive samples, robust, (channels,)."""
        out = np.zeros(len(self.names))
        for j in range(len(self.names)):
            parts = [
                np.diff(self.value[a:b][self.channel[a:b] == j], 3)
                for a, b in zip(self.edges, self.edges[1:], strict=False)
            ]
            d = np.abs(np.concatenate(parts)) if parts else np.empty(0)
            out[j] = (
                float(np.sqrt(np.mean(np.minimum(d, 3.0 * 1.4826 * np.median(d) + 1e-12) ** 2) / 20.0))
                if len(d)
                else 0.0
            )
        return out


def channel(
    name: str, response: Response, segments: Sequence[Segment], current: Array | None = None
) -> NDArray[np.float32]:
    """A measured column on the simulation's grid.

    Args:
        name: Of `CHANNELS`.
        response: Of every candidate over these segments.
        segments: Give the sensors' places.
        current: World frame [m/s], in place of the segments' own, (C, S, 3).

    Returns:
        (n + 1, C, S)
    """
    nu, q = response.nu, response.quaternion
    if name in ("p", "q", "r"):
        return nu[..., 3 + "pqr".index(name)]
    if name in ("u", "v", "w"):
        i = "uvw".index(name)
        at = np.stack([s.velocity_at for s in segments]).astype(np.float32)
        j, k = (i + 1) % 3, (i + 2) % 3
        out = nu[..., i] + (nu[..., 3 + j] * at[:, k] - nu[..., 3 + k] * at[:, j] if at.any() else 0.0)
        in_water = np.array([s.velocity_in_water for s in segments])
        if in_water.any():
            flow = np.stack([s.current for s in segments])[None] if current is None else current
            body = quat_rotate(quat_conjugate(q), np.broadcast_to(flow, (*q.shape[1:3], 3)))[..., i]
            out = out - np.where(in_water, body, 0.0)
        return np.asarray(out, np.float32)
    if name in ANGLES:
        return euler_angle(name, q)
    sensor = "depth_at" if name == "depth" else "position_at"
    at = np.stack([getattr(s, sensor) for s in segments])
    i = 2 if name == "depth" else "xyz".index(name)
    out = response.position[..., i] + (quat_rotate(q, at)[..., i] if at.any() else 0.0)
    return np.asarray(-out if name == "depth" else out, np.float32)


def euler_angle(name: str, q: NDArray[np.float32]) -> NDArray[np.float32]:
    """Roll, pitch or yaw of unit quaternions, in their own precision, (..., 4) -> (...)."""
    x, y, z, w = (q[..., i] for i in range(4))
    if name == "roll":
        return np.asarray(np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)))
    if name == "yaw":
        return np.asarray(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
    return np.asarray(np.arcsin(np.clip(2.0 * (w * y - x * z), -1.0, 1.0)))
