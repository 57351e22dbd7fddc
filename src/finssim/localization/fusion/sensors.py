"""Table of the sensors of both filters, and the update with a sample of each.

A sensor measures one quantity that every filter predicts: its `reading` of a sample, minus that prediction, is the
residual; the filter provides the Jacobian and the sensor the noise. A new sensor is one entry of `SENSORS`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from finssim.localization.fusion.attitude import wrapped
from finssim.localization.fusion.fuse_settings import Aids, Settings, Site
from finssim.localization.fusion.gates import GateMemory, judge, judge_carried
from finssim.localization.fusion.position_filter import MotionModel
from finssim.localization.fusion.streams import (
    ImuSample,
    Outcome,
    PoseEstimate,
    Sample,
    VisionSample,
    changed,
)

Array = npt.NDArray[np.float64]

GYRO_HOLD = 0.3
"""Duration for which the gyro's last rate is used if samples are missing [s]."""


@dataclass(frozen=True, kw_only=True)
class SensorModel:
    """Model of one sensor."""

    stream: str
    """Stream of its samples."""
    quantity: str
    """Measured quantity, a method of `Filter`: position, height, yaw, heading or velocity."""
    reading: Callable[[Any], tuple[float, ...] | None]
    """Function of a sample that returns the value of the quantity (m,), in its units; None if the sample has none."""
    noise: Callable[[Any, Settings], Array]
    """Function of sample and settings that returns the covariance of the reading, (m, m)."""
    drift: float | None = None
    """Gate: largest rate of change among refused readings that agree [units/s]; None: `Settings.speed_std`."""
    axes: tuple[int, ...] = ()
    """Position axes that are restarted by the first reading, or by a run of refused ones."""
    angle: bool = False
    """True for an angle [rad]: its residual is wrapped."""
    turns: bool = False
    """True if yaw is restarted by the first reading, or by a run of refused ones."""

    @property
    def starts(self) -> bool:
        """Return whether a reading can initialize a part of the state."""
        return self.turns or bool(self.axes)


def vision_covariance(sample: VisionSample, settings: Settings) -> Array:
    """Return the covariance of x, y [m] and yaw [rad] of a position fix, (3, 3)."""
    floor = _diagonal(settings.vision_floor)
    if sample.covariance is None:
        return _diagonal(settings.vision_std) + floor
    return np.array(sample.covariance) + floor


def yaw_variance(sample: VisionSample, settings: Settings) -> float:
    """Return the variance of the yaw of a position fix [rad²]."""
    own = settings.vision_std[1] ** 2 if sample.covariance is None else sample.covariance[2][2]
    return own + settings.vision_floor[1] ** 2


@lru_cache(maxsize=64)
def _diagonal(std: tuple[float, float]) -> Array:
    """Return a diagonal covariance of x, y and yaw, from the standard deviations of position and yaw."""
    return np.diag([std[0] ** 2, std[0] ** 2, std[1] ** 2])


def _aids(settings: Settings) -> Aids:
    """Return the errors of log and compass; settings without them are a programming error."""
    assert settings.aids is not None
    return settings.aids


SENSORS: dict[str, SensorModel] = {
    "depth": SensorModel(
        stream="depth",
        quantity="height",
        reading=lambda sample: (-sample.depth,),
        noise=lambda _, s: np.array([[s.depth_std**2]]),
        axes=(2,),
    ),
    "vision": SensorModel(
        stream="vision",
        quantity="position",
        reading=lambda sample: sample.position,
        noise=lambda sample, s: vision_covariance(sample, s)[:2, :2],
        axes=(0, 1),
    ),
    "yaw": SensorModel(
        stream="vision",
        quantity="yaw",
        reading=lambda sample: None if sample.yaw is None else (sample.yaw,),
        noise=lambda sample, s: np.array([[yaw_variance(sample, s)]]),
        drift=0.05,
        angle=True,
        turns=True,
    ),
    "heading": SensorModel(
        stream="heading",
        quantity="heading",
        reading=lambda sample: (sample.yaw,),
        noise=lambda _, s: np.array([[_aids(s).heading_std ** 2]]),
        drift=0.05,
        angle=True,
    ),
    "velocity": SensorModel(
        stream="velocity",
        quantity="velocity",
        reading=lambda sample: sample.velocity,
        noise=lambda sample, s: max(sample.std, _aids(s).velocity_std) ** 2 * np.eye(3),
        drift=1.0,
    ),
}
"""Sensor -> model. Samples of equal time are applied in this order, after those of the IMU."""


class Prediction(NamedTuple):
    """Predicted quantity of a filter."""

    value: Array
    """Value in the unit of the measurement, (m,)."""
    H: Array
    """Jacobian with respect to the errors of `part`, in their units, (m, n)."""
    extra_variance: Array | float | None = None
    """Covariance of errors that the filter does not estimate, such as an offset of the sensor, in the unit of the
    measurement, (m, m); None: zero."""
    turning: float = 0.0
    """Variance of a rotation that the filter does not estimate [rad²]; it is multiplied by the squared norm
    of the reading."""
    part: str = "state"
    """Name of the field of the filter's track that contains the measured state."""


@dataclass(frozen=True, kw_only=True)
class FilterMemory:
    """Base of a filter's track: memory common to all filters; subclasses add the states."""

    gates: Mapping[str, GateMemory] = field(default_factory=dict)
    """Sensor -> memory of its gate."""
    seen: Mapping[str, float] = field(default_factory=dict)
    """Sensor -> time of its latest accepted reading [s]."""
    imu_time: float | None = None
    """Time of the latest IMU sample [s]; None before the first."""

    @property
    def aided(self) -> float:
        """Time of the latest accepted position fix or Doppler velocity [s]; -inf before the first."""
        return max(self.seen.get("vision", -math.inf), self.seen.get("velocity", -math.inf))

    def extra_variance(self, name: str) -> float:
        """Return the variance that a sensor's gate adds to that of the state [units²]."""
        return self.gates[name].extra_variance if name in self.gates else 0.0

    def times(self) -> dict[str, float | None]:
        """Return the times of the latest accepted samples [s], by their field names in `PoseEstimate`."""
        seen = {f"{name}_time": self.seen.get(name) for name in ("vision", "depth", "velocity")}
        return {**seen, "imu_time": self.imu_time}

    def heard(self, time: float) -> bool:
        """Return whether an IMU sample is recent enough at a time [s]."""
        return self.imu_time is not None and time - self.imu_time <= GYRO_HOLD


T = TypeVar("T", bound=FilterMemory)


class Filter(ABC, Generic[T]):
    """Filter of one vehicle: pure functions of its track, with settings and site fixed.

    A subclass predicts between samples and provides the quantities that sensors measure. A quantity is a
    `Prediction`, or the reason for having none as text.
    """

    gate_of: ClassVar[Mapping[str, str | None]] = {}
    """Sensor -> sensor whose gate is used for its readings, if different; None: all are accepted."""

    def __init__(self, settings: Settings, site: Site) -> None:
        """
        Args:
            settings: Settings of the estimator.
            site: Parameters of pool and vehicle.
        """
        self.settings, self.site = settings, site

    @abstractmethod
    def start(self) -> T:
        """Return the track before the first sample."""

    @abstractmethod
    def imu(self, track: T, sample: ImuSample) -> tuple[T, tuple[Outcome, ...]]:
        """Return the track after an IMU sample, and the outcome of the sample."""

    @abstractmethod
    def advanced(self, track: T, time: float) -> T:
        """Return the track advanced to a time [s]; never to an earlier one."""

    @abstractmethod
    def estimate(self, track: T, time: float) -> PoseEstimate:
        """Return the estimate at a time [s], or at the track's own time if later; unknown values are NaN."""

    @abstractmethod
    def tilt(self, track: T) -> tuple[float, float]:
        """Return roll and pitch of a track [rad]."""

    @abstractmethod
    def position(self, track: T) -> Prediction | str:
        """Predict x and y of the body origin, pool frame [m]."""

    @abstractmethod
    def height(self, track: T) -> Prediction | str:
        """Predict the height of the pressure port above the surface [m]."""

    @abstractmethod
    def yaw(self, track: T) -> Prediction | str:
        """Predict yaw, pool frame [rad]."""

    @abstractmethod
    def heading(self, track: T) -> Prediction | str:
        """Predict the reading of a compass, pool frame [rad]."""

    @abstractmethod
    def velocity(self, track: T) -> Prediction | str:
        """Predict the reading of a Doppler log, body frame [m/s]."""

    @abstractmethod
    def restarted(self, track: T, axes: list[int], step: Array, R: Array) -> T:
        """Restart position axes at a measurement, `step` [m] from the estimate, with covariance `R` [m²]."""

    @abstractmethod
    def turned(self, track: T, angle: float, variance: float) -> T:
        """Restart yaw at a measurement, `angle` [rad] from the estimate, with variance `variance` [rad²]."""

    def apply(self, track: T, sample: Sample) -> tuple[T, tuple[Outcome, ...]]:
        """Return the track after a sample, and the outcome for each sensor in it."""
        if isinstance(sample, ImuSample):
            return self.imu(track, sample)
        track, outcomes = self.advanced(track, sample.time), []
        for name, sensor in SENSORS.items():
            if sensor.stream == sample.stream and (reading := sensor.reading(sample)) is not None:
                track, outcome = self.update(track, name, sample, np.array(reading))
                outcomes.append(outcome)
        return track, tuple(outcomes)

    def update(self, track: T, name: str, sample: Sample, reading: Array) -> tuple[T, Outcome]:
        """Return the track after a sensor's reading (m,), and the gate's verdict.

        A run of refused readings restarts the axes in the sensor's entry; without such axes it corrects the state.

        The reading has the unit of the sensor.
        """
        sensor = SENSORS[name]
        predicted: Prediction | str = getattr(self, sensor.quantity)(track)
        if isinstance(predicted, str):
            return track, Outcome(name, predicted)
        residual = reading - predicted.value
        if sensor.angle:
            residual = np.array([wrapped(residual.item())])
        R = sensor.noise(sample, self.settings)
        if predicted.extra_variance is not None:
            R = R + predicted.extra_variance
        if predicted.turning:
            R = R + predicted.turning * float(reading @ reading) * np.eye(len(reading))
        state = getattr(track, predicted.part)
        found = state.innovation(residual, predicted.H, R)
        gate = self.gate_of.get(name, name)
        rule = sensor if gate is None else SENSORS[gate]
        verdict, distance = "accepted", float(found.mahalanobis)
        fields: dict[str, Any] = {}
        if gate is not None:
            value = residual if sensor.angle else reading
            verdict, memory = self._judged(track, gate, sample.time, value, R, distance)
            fields["gates"] = {**track.gates, gate: memory}
        if verdict != "gate":
            fields["seen"] = {**track.seen, gate or name: sample.time}
            if verdict == "accepted" or not rule.starts:
                fields[predicted.part] = state.corrected(found)
            elif rule.turns:
                track = self.turned(track, float(residual[0]), float(R[0, 0]))
            else:
                axes = list(rule.axes)
                step = np.asarray(np.linalg.solve(predicted.H[:, axes], residual), float)
                track = self.restarted(track, axes, step, R)
        return changed(track, **fields), Outcome(name, verdict, distance, len(residual))

    def _judged(
        self, track: T, name: str, time: float, value: Array, R: Array, distance: float
    ) -> tuple[str, GateMemory]:
        """Return the verdict of a sensor's gate on a value (m,) of covariance R, and the gate's memory after it."""
        rule, gate = SENSORS[name], self.settings.gate
        memory = track.gates.get(name) or GateMemory(0 if rule.starts else 1)
        drift = self.settings.speed_std if rule.drift is None else rule.drift
        if rule.turns and track.heard(time):
            # Flipped yaws agree with one another only relative to the prediction, which turns with the vehicle.
            return judge_carried(gate, memory, time, float(value[0]), float(R[0, 0]), distance, drift)
        return judge(gate, memory, time, value, R, distance, drift)


def motion_of(settings: Settings, xy_slows: bool, z_slows: bool) -> MotionModel:
    """Return the motion model in which the velocity of axes without measurements decays to zero, within
    `speed_std`."""
    slows = (xy_slows, xy_slows, z_slows)
    rate, motion = settings.decay, settings.motion
    density = [
        2.0 * rate * settings.speed_std**2 if slow else q
        for slow, q in zip(slows, motion.density, strict=True)
    ]
    decay = [rate if slow else nominal for slow, nominal in zip(slows, motion.decay, strict=True)]
    return replace(motion, density=(density[0], density[1], density[2]), decay=(decay[0], decay[1], decay[2]))


def steps(start: float, end: float, cuts: Iterable[float]) -> list[tuple[float, float]]:
    """Return the lengths and midpoints of the steps from `start` to `end` [s], divided at `cuts`."""
    inside = {cut for cut in cuts if start < cut < end}
    if not inside:
        return [(end - start, 0.5 * (start + end))]
    times = [start, *sorted(inside), end]
    return [(b - a, 0.5 * (a + b)) for a, b in zip(times, times[1:], strict=False)]
