"""Errors of sensors that a fit allows for: offsets of a stretch, and streams that come late."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.simulation.residuals import Residuals

__all__ = ["LATEST", "LATE_STD", "STREAMS", "SensorErrors"]

Array = NDArray[np.float64]

STREAMS = {
    "velocity": ("u", "v", "w"),
    "rates": ("p", "q", "r"),
    "attitude": ("roll", "pitch", "yaw"),
    "position": ("x", "y", "z"),
    "depth": ("depth",),
}
"""Channels that share a clock."""

OFFSETS = {"p": 0.02, "q": 0.02, "r": 0.02, "roll": 0.03, "pitch": 0.03, "depth": 0.1}
"""Channels with an offset that is constant over a segment, and its standard deviation: biases of gyroscopes [rad/s],
levels that were mounted askew [rad], pressure at the surface [m]."""

LATEST = 0.3
"""By how much a stream may lag or lead the inputs [s]."""

LATE_STD = 0.05
"""By how much streams lag or lead, as far as one knows beforehand [s]: noisy data cannot tell a lag from inertia."""


class SensorErrors:
    """Offsets by segment, and lags of the streams common to all segments.

    Attributes:
        streams: Names of the streams in use.
        offsets: Names of the channels that have an offset.
        std: Prior of the offsets, (k,).
    """

    def __init__(self, measured: Residuals) -> None:
        """Allow for what the channels in use may suffer from."""
        names = measured.names
        self.streams = tuple(stream for stream, of in STREAMS.items() if set(of) & set(names))
        # The initial height already takes up an offset of the depth, unless z is measured too.
        self.offsets = tuple(c for c in names if c in OFFSETS and (c != "depth" or "z" in names))
        self.std = np.array([OFFSETS[c] for c in self.offsets])
        stream_of = {c: i for i, stream in enumerate(self.streams) for c in STREAMS[stream]}
        self._stream = np.array([stream_of[c] for c in names], int)[measured.channel]
        self._offset = np.zeros((len(measured), len(self.offsets)))
        for k, name in enumerate(self.offsets):
            self._offset[measured.channel == names.index(name), k] = 1.0
        self._segment = measured.segment

    def late(self, late: Array) -> Array:
        """Lag of every sample [s], (N, C), or (N, 1) where all candidates agree, from the streams', (C, streams)."""
        same = bool((late == late[:1]).all())
        return np.asarray((late[:1] if same else late).T[self._stream])

    def offset(self, offset: Array) -> Array:
        """What offsets (C, S, k) add to every sample, (N, C)."""
        out = np.zeros((len(self._segment), len(offset)))
        for k in range(offset.shape[2]):
            out += self._offset[:, k : k + 1] * offset[:, self._segment, k].T
        return out

    def slopes(self, rate: Array) -> tuple[Array, Array]:
        """Derivatives of the readings by lag (N, streams) and by offset (N, k), for rates (N,)."""
        late = np.where(self._stream[:, None] == np.arange(len(self.streams)), -rate[:, None], 0.0)
        return late, self._offset
