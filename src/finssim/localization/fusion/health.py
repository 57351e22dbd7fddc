"""What the estimator says of itself: estimate, vision state, ages, readiness, and what it refused and why."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.localization.fusion.fuse_settings import Settings, Site

__all__ = ["MODES", "Estimate", "Health", "Outcome", "health_of", "mode_of"]

Array = npt.NDArray[np.float64]

MODES = ("uninitialized", "fresh", "coast", "hold", "lost")


@dataclass(frozen=True)
class Outcome:
    """What became of one sample."""

    stream: str
    """`vision` (x and y), `yaw`, `depth` or `imu`."""
    verdict: str
    """`accepted`, `initialized` or `reacquired`; else why it was refused: `gate`, `duplicate`, `too late`, ..."""
    mahalanobis: float = math.nan
    """Squared distance from the prediction."""
    dimension: int = 0

    @property
    def used(self) -> bool:
        """Whether the state took it in."""
        return self.verdict in ("accepted", "initialized", "reacquired")


@dataclass(frozen=True)
class Estimate:
    """Where the vehicle is at one time. NaN: not known yet."""

    time: float
    x: Array
    """Position [m] and velocity [m/s] of the body origin, pool frame, (6,)."""
    P: Array
    """Covariance of `x`, (6, 6)."""
    yaw: float
    """[rad]"""
    yaw_variance: float
    yaw_rate: float
    """[rad/s]"""
    roll: float
    pitch: float
    vision_time: float | None
    """Time of the latest position fix that was believed [s]."""
    depth_time: float | None
    imu_time: float | None
    velocity_time: float | None = None
    """Time of the latest Doppler velocity that was believed [s]."""

    def std(self) -> Array:
        """Standard deviations of position, velocity and yaw, (7,)."""
        return np.asarray(np.sqrt(np.array([*self.P.diagonal().tolist(), self.yaw_variance])))


@dataclass(frozen=True)
class Health:
    """Condition of the estimator at one time."""

    ready: bool
    """Initialized, every sensor fresh, vision fresh or coasting, and the variances within the settings' limits."""
    initialized: bool
    vision_mode: str
    """One of `MODES`."""
    vision_fresh: bool
    imu_fresh: bool
    depth_fresh: bool
    age_vision: float
    """[s]; NaN before the first."""
    age_imu: float
    age_depth: float
    reject_reason: str
    """Stream and reason of the latest refusal; empty before the first."""
    mahalanobis: dict[str, float]
    """Squared distance of each stream's latest measurement."""
    position_covariance: tuple[float, ...]
    """Diagonal, position then velocity, (6,)."""
    yaw_covariance: float
    velocity_world: tuple[float, ...]
    """World axes [m/s]."""
    counts: dict[str, dict[str, int]] = field(default_factory=dict)
    """Stream -> verdict -> samples."""

    def as_json(self) -> dict[str, Any]:
        """Plain values, numbers that are not known as None."""
        return {
            "vision_source": "overhead_tags",
            **{name: _plain(value) for name, value in self.__dict__.items()},
        }


def mode_of(age: float, settings: Settings) -> str:
    """The vision state at that age of vision [s]; NaN: there was none."""
    if math.isnan(age):
        return "uninitialized"
    for mode, limit in (("fresh", settings.fresh), ("coast", settings.coast), ("hold", settings.hold)):
        if age <= limit + 1e-9:
            return mode
    return "lost"


def health_of(
    estimate: Estimate,
    settings: Settings,
    site: Site,
    latest: dict[str, float],
    reason: str,
    counts: dict[str, dict[str, int]],
) -> Health:
    """The condition that goes with an estimate.

    Args:
        estimate: The estimate.
        settings: Limits of ages and variances.
        site: Turns velocities into world axes.
        latest: Squared Mahalanobis distance of each stream's latest measurement.
        reason: Stream and reason of the latest refusal.
        counts: Stream -> verdict -> samples.
    """
    vision, imu, depth = (
        math.nan if then is None else estimate.time - then
        for then in (estimate.vision_time, estimate.imu_time, estimate.depth_time)
    )
    told = [t for t in (estimate.vision_time, estimate.velocity_time) if t is not None]
    mode = mode_of(
        estimate.time - max(told) if told and estimate.vision_time is not None else vision, settings
    )
    variances = estimate.P.diagonal().tolist()
    vx, vy, vz = estimate.x[3:].tolist()
    imu_fresh, depth_fresh = imu <= settings.imu_fresh + 1e-9, depth <= settings.depth_fresh + 1e-9
    known = all(map(math.isfinite, (*variances[:3], estimate.yaw_variance)))
    sure = known and max(variances[:3]) <= settings.ready_position
    return Health(
        ready=sure
        and estimate.yaw_variance <= settings.ready_yaw
        and imu_fresh
        and depth_fresh
        and mode in ("fresh", "coast"),
        initialized=known,
        vision_mode=mode,
        vision_fresh=mode == "fresh",
        imu_fresh=imu_fresh,
        depth_fresh=depth_fresh,
        age_vision=vision,
        age_imu=imu,
        age_depth=depth,
        reject_reason=reason,
        mahalanobis=dict(latest),
        position_covariance=tuple(variances),
        yaw_covariance=estimate.yaw_variance,
        velocity_world=tuple(a * vx + b * vy + c * vz for a, b, c in site.R_wp),
        counts={stream: dict(verdicts) for stream, verdicts in counts.items()},
    )


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
