"""Error-state filter: fusion with the IMU's accelerations. Models are pure functions over a leading `...` batch.

Nominal state: position and velocity of the IMU in the pool frame, attitude, gyro bias, accelerometer bias.
Error state (15): [δp, δv, δθ, δb_g, δb_a], with the attitude error in pool axes, R = exp([δθ]x) R̂.

A Doppler log or a compass adds five states (20): [δb_c, δs, δb_v], the compass offset, and scale and offset
of the log.

    p_dot = v,  v_dot = R (f - b_a) + g,  R_dot = R [ω - b_g]x
    δp_dot = δv,  δv_dot = -[R (f - b_a)]x δθ - R δb_a + n_a,  δθ_dot = -R δb_g + n_g
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Self

import numpy as np
import numpy.typing as npt

from finssim.core.rotations import (
    cross,
    matrix_to_quat,
    quat_from_euler,
    quat_from_rotvec,
    quat_multiply,
    quat_to_matrix,
    skew,
)
from finssim.localization.fusion import position_filter
from finssim.localization.fusion.attitude import roll_pitch
from finssim.localization.fusion.constant_velocity import YAW_CAP, ConstantVelocity, PlaneTrack
from finssim.localization.fusion.fuse_settings import Settings, Site
from finssim.localization.fusion.kalman import bounded, isolated
from finssim.localization.fusion.position_filter import PositionState, frozen, restarted
from finssim.localization.fusion.sensors import GYRO_HOLD, Filter, FilterMemory, Prediction, motion_of, steps
from finssim.localization.fusion.streams import ImuSample, Outcome, PoseEstimate, Sample, changed
from finssim.localization.poses import axes_of_up

Array = npt.NDArray[np.float64]
Vector = tuple[float, float, float]

P, V, A, G, B = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 15)
"""Indices of δp, δv, δθ, δb_g and δb_a in the error state."""
C, S, D = 15, 16, slice(17, 20)
"""Indices of the compass offset, the scale of the Doppler log and its offset in the extended error state."""
TILT_CAP = 0.5
"""Largest standard deviation of roll and pitch [rad]."""
_I3 = np.eye(3)


@dataclass(frozen=True)
class InertialState(PositionState):
    """State of the filter: `x` is position [m] and velocity [m/s] of the IMU, `P` the covariance of the error
    state."""

    q: Array
    """Attitude q_pb, body to pool, xyzw, (..., 4)."""
    gyro_bias: Array
    """Gyro bias, body frame [rad/s], (..., 3)."""
    accel_bias: Array
    """Accelerometer bias, body frame [m/s²], (..., 3)."""
    extra: Array = field(default_factory=lambda: np.zeros(0))
    """Offset of the compass [rad], scale error [-] and offset of the Doppler log [m/s], (..., 5); (0,)
    without these sensors."""

    def moved(self, error: Array, P: Array) -> Self:
        """Return the state corrected by an error (..., n), with a new covariance (..., n, n).

        Errors have the units of the state.
        """
        q = quat_multiply(quat_from_rotvec(error[..., A]), self.q)
        return changed(
            self,
            x=self.x + error[..., :6],
            P=P,
            q=q / np.linalg.norm(q, axis=-1, keepdims=True),
            gyro_bias=self.gyro_bias + error[..., G],
            accel_bias=self.accel_bias + error[..., B],
            extra=self.extra + error[..., 15:],
        )


@dataclass(frozen=True)
class ErrorStateNoise:
    """Noise densities of the IMU."""

    gyro: float
    """Gyro noise [rad/s/√Hz]."""
    accel: float
    """Accelerometer noise [m/s²/√Hz]."""
    gyro_walk: float
    """Random walk of the gyro bias [rad/s²/√Hz]."""
    accel_walk: float
    """Random walk of the accelerometer bias [m/s³/√Hz]."""
    log_walk: float = 0.0
    """Random walk of the Doppler log's offset [m/s²/√Hz]."""


def predict(
    state: InertialState, omega: Array, force: Array, dt: float, noise: ErrorStateNoise, gravity: Array
) -> InertialState:
    """Return the state after a step with constant angular rate and specific force, integrated with the
    mid-step attitude.

    Args:
        state: State before the step.
        omega: Angular rate, body frame [rad/s], (..., 3).
        force: Specific force at the IMU, body frame [m/s²], (..., 3).
        dt: Length of the step [s].
        noise: Noise densities of the IMU.
        gravity: Acceleration of gravity, pool frame [m/s²], (3,): downwards.
    """
    turn = (omega - state.gyro_bias) * dt
    half = quat_from_rotvec(0.5 * turn)
    middle = quat_multiply(state.q, half)
    q = quat_multiply(middle, half)
    R = quat_to_matrix(middle)
    pushed = (R @ (force - state.accel_bias)[..., None])[..., 0]
    a = pushed + gravity
    n = state.P.shape[-1]
    F = np.eye(n) if turn.ndim == 1 else np.tile(np.eye(n), (*turn.shape[:-1], 1, 1))
    F[..., P, V] = dt * _I3
    swing, turned = -dt * skew(pushed), -dt * R
    F[..., V, A], F[..., P, A] = swing, (0.5 * dt) * swing
    F[..., V, B], F[..., P, B] = turned, (0.5 * dt) * turned
    F[..., A, G] = turned
    covariance = F @ state.P @ F.swapaxes(-1, -2) + _noise(dt, noise, n)
    v = state.x[..., V]
    return changed(
        state,
        x=np.concatenate([state.x[..., P] + dt * v + 0.5 * dt**2 * a, v + dt * a], axis=-1),
        q=q / np.sqrt((q * q).sum(axis=-1, keepdims=True)),
        P=0.5 * (covariance + covariance.swapaxes(-1, -2)),
    )


def _noise(dt: float, noise: ErrorStateNoise, n: int) -> Array:
    """Return the process noise of one step, (n, n); it is isotropic, so that no rotation is needed."""
    powers = np.array([dt, 0.5 * dt**2, dt**3 / 3.0])
    return np.asarray((powers @ _noise_powers(noise, n)).reshape(n, n))


@lru_cache(maxsize=8)
def _noise_powers(noise: ErrorStateNoise, n: int) -> Array:
    """Return the coefficients of dt, dt²/2 and dt³/3 in the noise of a step, (3, n²)."""
    first, second, third = powers = np.zeros((3, n, n))
    if n > 15:
        first[D, D] = noise.log_walk**2 * _I3
    i = np.arange(3)
    third[i, i] = second[i, i + 3] = second[i + 3, i] = first[i + 3, i + 3] = noise.accel**2
    first[i + 6, i + 6] = noise.gyro**2
    first[i + 9, i + 9] = noise.gyro_walk**2
    first[i + 12, i + 12] = noise.accel_walk**2
    return powers.reshape(3, n * n)


def position_model(state: InertialState, lever: Array) -> Prediction:
    """Predict the position of a body point, pool frame [m], (..., 3).

    Args:
        state: The state.
        lever: Position of the point relative to the IMU, body frame [m], (3,).
    """
    arm = (quat_to_matrix(state.q) @ lever[:, None])[..., 0]
    H = np.zeros((*arm.shape[:-1], 3, state.P.shape[-1]))
    H[..., P] = _I3
    H[..., A] = -skew(arm)
    return Prediction(state.x[..., P] + arm, H)


def depth_model(state: InertialState, lever: Array, up: Array, offset: float) -> Prediction:
    """Predict the height of a body point above the surface [m], (..., 1).

    Args:
        state: The state.
        lever: Position of the point relative to the IMU, body frame [m], (3,).
        up: Unit normal of the surface, pool frame, (3,).
        offset: Offset of the height: up . p + offset [m].
    """
    point, H, *_ = position_model(state, lever)
    return Prediction(np.asarray(point @ up[:, None] + offset), np.asarray(up[None, :] @ H))


def yaw_model(state: InertialState) -> Prediction:
    """Predict the yaw of the body x axis [rad], (..., 1).

    With c = R e_x:  dψ = δθ_z - c_z (c_x δθ_x + c_y δθ_y) / (c_x² + c_y²)
    """
    c = quat_to_matrix(state.q)[..., :, 0]
    level = c[..., 0] ** 2 + c[..., 1] ** 2
    H = np.zeros((*c.shape[:-1], 1, state.P.shape[-1]))
    H[..., 0, 6] = -c[..., 2] * c[..., 0] / level
    H[..., 0, 7] = -c[..., 2] * c[..., 1] / level
    H[..., 0, 8] = 1.0
    return Prediction(np.arctan2(c[..., 1], c[..., 0])[..., None], H)


def heading_model(state: InertialState) -> Prediction:
    """Predict the reading of a compass, yaw plus the compass's offset [rad], (..., 1)."""
    yaw, H, *_ = yaw_model(state)
    H[..., 0, C] = 1.0
    return Prediction(yaw + state.extra[..., :1], H)


def velocity_model(state: InertialState, omega: Array, lever: Array) -> Prediction:
    """Predict the reading of a Doppler log: (1 + s) [R' v + (ω - b_g) x l] + b_v, body frame [m/s], (..., 3).

    Args:
        state: The state.
        omega: Measured angular rate, body frame [rad/s], (..., 3).
        lever: Position of the log relative to the IMU, body frame [m], (3,).
    """
    back = np.swapaxes(quat_to_matrix(state.q), -1, -2)
    v = state.x[..., V]
    predicted = (back @ v[..., None])[..., 0] + cross(omega - state.gyro_bias, lever)
    gain = 1.0 + state.extra[..., 1]
    H = np.zeros((*predicted.shape[:-1], 3, state.P.shape[-1]))
    H[..., V] = gain * back
    H[..., A] = gain * (back @ skew(v))
    H[..., G] = gain * skew(lever)
    H[..., S] = predicted
    H[..., D] = _I3
    return Prediction(gain * predicted + state.extra[..., 2:], H)


def turned(state: InertialState, angle: float, variance: float) -> InertialState:
    """Rotate the attitude of one state about the pool's z axis by `angle` [rad], with yaw variance `variance`
    [rad²]."""
    q = quat_multiply(quat_from_rotvec(np.array([0.0, 0.0, angle])), state.q)
    return changed(state, q=q, P=isolated(state.P, [8], np.array([[variance]])))


@lru_cache(maxsize=8)
def limits(variance: float, n: int) -> Array:
    """Return the largest variance of each error, (n,), with `variance` for the positions [m²]."""
    return np.array([variance] * 3 + [np.inf] * 3 + [TILT_CAP**2] * 2 + [YAW_CAP] + [np.inf] * (n - 9))


@dataclass(frozen=True, kw_only=True)
class InertialTrack(FilterMemory):
    """State of the filter with the filter memory."""

    state: InertialState | None = None
    before: PlaneTrack
    """Track of the constant-velocity filters, which initializes this filter once every sensor has delivered a
    sample."""
    time: float = math.nan
    """Time of the state [s]."""
    omega: Vector = (0.0, 0.0, 0.0)
    """Latest angular rate, body frame [rad/s]."""
    force: Vector | None = None
    """Latest specific force, body frame [m/s²]."""


class ErrorState(Filter[InertialTrack]):
    """Error-state filter of one vehicle."""

    def __init__(self, settings: Settings, site: Site) -> None:
        """
        Args:
            settings: Settings of the estimator.
            site: Parameters of pool and vehicle.
        """
        super().__init__(settings, site)
        self._before = ConstantVelocity(settings, site)
        self._up = np.array(site.up)
        self._gravity = -site.gravity * self._up
        imu = np.array(site.imu)
        self._body, self._port, self._log = -imu, np.array(site.depth_port) - imu, np.array(site.dvl) - imu
        self._noise = ErrorStateNoise(
            settings.imu.gyro.rate,
            settings.imu.accel_noise,
            settings.imu.gyro.bias_walk,
            settings.imu.accel_bias_walk,
            settings.aids.velocity_walk if settings.aids else 0.0,
        )
        self._drifts = {slow: motion_of(settings, slow, False) for slow in (False, True)}

    def start(self) -> InertialTrack:
        """Return the track before the first sample."""
        return InertialTrack(before=self._before.start())

    def apply(self, track: InertialTrack, sample: Sample) -> tuple[InertialTrack, tuple[Outcome, ...]]:
        """Return the track after a sample, and the outcome for each sensor in it."""
        if track.state is not None:
            return super().apply(track, sample)
        if isinstance(sample, ImuSample):
            if sample.force is None:
                return track, (Outcome("imu", "no acceleration"),)
            track = changed(track, omega=sample.omega, force=sample.force, imu_time=sample.time)
        before, outcomes = self._before.apply(track.before, sample)
        return self._begun(changed(track, before=before), sample.time), outcomes

    def imu(self, track: InertialTrack, sample: ImuSample) -> tuple[InertialTrack, tuple[Outcome, ...]]:
        """Return the track at the time of an IMU sample."""
        if sample.force is None:
            return track, (Outcome("imu", "no acceleration"),)
        if track.heard(sample.time) and track.force is not None:
            # The mean over the step, rather than its first sample.
            omega, force = _mean(track.omega, sample.omega), _mean(track.force, sample.force)
            track = changed(track, omega=omega, force=force)
        track = self.advanced(track, sample.time)
        track = changed(track, omega=sample.omega, force=sample.force, imu_time=sample.time)
        return track, (Outcome("imu", "accepted"),)

    def position(self, track: InertialTrack) -> Prediction:
        """Predict x and y of the body origin, pool frame [m]."""
        point, H, *_ = position_model(_state(track), self._body)
        return Prediction(point[:2], H[:2])

    def height(self, track: InertialTrack) -> Prediction:
        """Predict the height of the pressure port above the surface [m]."""
        return depth_model(_state(track), self._port, self._up, self.site.offset)

    def yaw(self, track: InertialTrack) -> Prediction:
        """Predict yaw, pool frame [rad]."""
        return yaw_model(_state(track))

    def heading(self, track: InertialTrack) -> Prediction | str:
        """Predict the reading of a compass, pool frame [rad]."""
        return "no compass" if self.settings.aids is None else heading_model(_state(track))

    def velocity(self, track: InertialTrack) -> Prediction | str:
        """Predict the reading of a Doppler log, body frame [m/s]."""
        if self.settings.aids is None:
            return "no heading"
        return velocity_model(_state(track), np.array(track.omega), self._log)

    def restarted(self, track: InertialTrack, axes: list[int], step: Array, R: Array) -> InertialTrack:
        """Restart position axes at a measurement, `step` [m] from the estimate, with covariance `R` [m²]."""
        state = _state(track)
        state = restarted(state, axes, state.x[axes] + step, R, self.settings.speed_std)
        return changed(track, state=state)

    def turned(self, track: InertialTrack, angle: float, variance: float) -> InertialTrack:
        """Restart yaw at a measurement, `angle` [rad] from the estimate, with variance `variance` [rad²]."""
        return changed(track, state=turned(_state(track), angle, variance))

    def tilt(self, track: InertialTrack) -> tuple[float, float]:
        """Return roll and pitch of a track [rad]."""
        if track.state is None:
            return track.before.roll, track.before.pitch
        roll, pitch = roll_pitch(self._up @ quat_to_matrix(track.state.q))
        return float(roll), float(pitch)

    def estimate(self, track: InertialTrack, time: float) -> PoseEstimate:
        """Return the estimate at a time [s], or at the track's own time if later; unknown values are NaN."""
        if track.state is None:
            return self._before.estimate(track.before, time)
        track = self.advanced(track, time)
        state, n = _state(track), _state(track).P.shape[-1]
        point, H, *_ = position_model(state, self._body)
        R, rates = quat_to_matrix(state.q), np.array(track.omega) - state.gyro_bias
        x = np.concatenate([point, state.x[V] + R @ cross(rates, self._body)])
        if time - track.aided > self.settings.ages.hold:
            x[3:5] = 0.0
        T = np.vstack([H, np.eye(n)[V]])
        yaw, H, *_ = yaw_model(state)
        roll, pitch = self.tilt(track)
        return PoseEstimate(
            time=time,
            x=x,
            P=T @ state.P @ T.T,
            yaw=float(yaw[0]),
            yaw_variance=float((H @ state.P @ H.T)[0, 0]) + track.extra_variance("yaw"),
            yaw_rate=float(H[0, A] @ R @ rates),
            roll=roll,
            pitch=pitch,
            **track.times(),
        )

    def _begun(self, track: InertialTrack, time: float) -> InertialTrack:
        """Return the track with the filter initialized, once position, yaw, depth and tilt are known."""
        before, s = track.before, self.settings
        if track.force is None or not {"vision", "yaw", "depth"} <= before.seen.keys():
            return track
        prior = self._before.estimate(before, time)
        level = quat_from_euler(prior.roll, prior.pitch, prior.yaw)
        from_level = axes_of_up(self.site.up)
        x = prior.x.copy()
        x[P] -= from_level @ quat_to_matrix(level) @ self._body
        q = quat_multiply(matrix_to_quat(from_level), level)
        variances = [s.imu.tilt_std**2, s.imu.tilt_std**2, prior.yaw_variance]
        variances += [s.imu.gyro_bias_std**2] * 3 + [s.imu.accel_bias_std**2] * 3
        if s.aids is not None:
            a = s.aids
            variances += [a.heading_bias**2, a.velocity_scale**2, *[a.velocity_bias**2] * 3]
        covariance = np.diag([0.0] * 6 + variances)
        covariance[:6, :6] = prior.P
        if s.aids is not None and before.compass:  # yaw is then the compass's reading minus its offset
            covariance[8, 8] += s.aids.heading_bias**2
            covariance[8, C] = covariance[C, 8] = -(s.aids.heading_bias**2)
        state = InertialState(x, covariance, q, np.zeros(3), np.zeros(3), np.zeros(len(variances) - 9))
        return changed(track, state=state, time=time, seen=before.seen, gates=before.gates)

    def advanced(self, track: InertialTrack, time: float) -> InertialTrack:
        """Return the track advanced to a time [s]; without measurements the velocity decays, then the
        position is frozen."""
        s, state = self.settings, _state(track)
        if time <= track.time:
            return track
        aided = track.aided
        heard = -math.inf if track.imu_time is None else track.imu_time + GYRO_HOLD
        for dt, middle in steps(track.time, time, (aided + s.ages.coast, aided + s.ages.hold, heard)):
            state = self._step(state, track, dt, blind=middle > heard, age=middle - aided)
        P = bounded(state.P, limits(s.largest_variance, state.P.shape[-1]))
        return changed(track, state=changed(state, P=P), time=time)

    def _step(
        self, state: InertialState, track: InertialTrack, dt: float, *, blind: bool, age: float
    ) -> InertialState:
        """Return the state after a step [s], without the IMU if `blind`; `age` is the time since the last
        position or velocity [s]."""
        s, lost = self.settings, age > self.settings.ages.hold
        if lost:
            state = frozen(state, [0, 1])
        if blind or track.force is None:
            after = position_filter.predict(state, dt, self._drifts[age > s.ages.coast])
            P = after.P.copy()
            P[A, A] += s.imu.blind_rate**2 * dt * _I3
            return changed(after, P=P)
        omega, force = np.array(track.omega), np.array(track.force)
        after = predict(state, omega, force, dt, self._noise, self._gravity)
        if age <= s.ages.coast:
            return after
        if lost:  # the accelerometer no longer determines the position: it becomes increasingly uncertain
            x, xy = after.x.copy(), [0, 1]
            x[xy] = state.x[xy]
            spread = after.P[:2, :2] + 2.0 * s.speed_std**2 / s.decay * dt * np.eye(2)
            after = changed(after, x=x, P=isolated(after.P, xy, spread))
        H = np.eye(len(after.P))[3:5]
        R = np.eye(2) * s.speed_std**2 / (s.decay * dt)
        return after.corrected(after.innovation(-after.x[3:5], H, R))


def _state(track: InertialTrack) -> InertialState:
    """Return the state of a filter that has started."""
    assert track.state is not None
    return track.state


def _mean(a: Vector, b: Vector) -> Vector:
    return 0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]), 0.5 * (a[2] + b[2])
