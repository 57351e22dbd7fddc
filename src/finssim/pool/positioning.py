"""Position fixes on a wire: motion capture, or acoustic positioning, with their rate, latency, losses and outliers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from finssim.geometry.rotations import quat_yaw
from finssim.pool.exposures import Mail, PoseAt, Shutter
from finssim.robot.link.frames import encode_navigation
from finssim.robot.messages import POSE, POSITION, NavigationAid

__all__ = ["POSITIONING", "Positioning", "PositioningSettings"]


@dataclass(frozen=True, kw_only=True)
class PositioningSettings:
    """One positioning system."""

    rate: float
    """Fixes a second [Hz]."""
    std: float
    """Per axis [m]."""
    yaw_std: float = 0.0
    """[rad]; 0: it tells no heading."""
    latency: float = 0.0
    """From the measurement to arrival, on average [s]."""
    jitter: float = 0.0
    """Standard deviation of the latency [s]."""
    dropout: float = 0.0
    """Chance that a fix is lost."""
    outliers: float = 0.0
    """Chance that a fix is wrong by up to `outlier_size`."""
    outlier_size: float = 10.0
    """Largest offset of a wrong fix, per axis [m]."""


POSITIONING: Mapping[str, PositioningSettings] = {
    "motion-capture": PositioningSettings(
        rate=50.0, std=0.002, yaw_std=math.radians(0.3), latency=0.02, jitter=0.003, dropout=0.01
    ),
    "usbl": PositioningSettings(
        rate=0.5, std=0.5, latency=0.4, jitter=0.1, dropout=0.1, outliers=0.05, outlier_size=15.0
    ),
}
"""By name. Motion capture as under water or above; an ultra-short baseline at some ten metres."""


class Positioning:
    """Measures where the vehicle is, and tells the robot late."""

    def __init__(self, settings: PositioningSettings, seed: int) -> None:
        """
        Args:
            settings: Of the system.
            seed: Of noise, outliers, jitter and losses.
        """
        s = settings
        self.settings = s
        self._shutter = Shutter(
            rate=s.rate, exposure=0.0, latency=s.latency, jitter=s.jitter, dropout=s.dropout, seed=seed
        )
        self._mail, self._random = Mail(), np.random.default_rng([seed, 0xF1])

    def advance(self, t0: float, t1: float, pose_at: PoseAt) -> list[tuple[float, bytes]]:
        """Frames that arrive in (t0, t1], each with its arrival [s], oldest first; `pose_at` as for a camera."""
        self._mail.post(self._shutter.advance(t0, t1, pose_at))
        frames = []
        for fix in self._mail.arrived(t1):
            s, (position, quaternion) = self.settings, fix.start
            x = position + s.std * self._random.standard_normal(3)
            wrong, turned = self._random.random() < s.outliers, s.yaw_std * self._random.standard_normal()
            offset = self._random.uniform(-s.outlier_size, s.outlier_size, 3)
            x = x + offset if wrong else x
            yaw = float(quat_yaw(quaternion)) + turned
            kind, third = (POSE, yaw) if s.yaw_std else (POSITION, float(x[2]))
            aid = NavigationAid(
                fix.sequence & 0xFFFF,
                kind,
                fix.arrival - fix.middle,
                (float(x[0]), float(x[1]), third),
                (s.std, s.yaw_std),
            )
            frames.append((fix.arrival, encode_navigation(aid)))
        return frames
