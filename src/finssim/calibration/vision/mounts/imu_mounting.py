"""How an IMU is mounted in the body, from the attitude that something else saw: orientation, bias and time offset."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.fit import Estimate
from finssim.calibration.uncertainty import Covariance, Evidence, intervals, trial_covariance
from finssim.calibration.vision.mounts.turns import Attitude, Gyro, TurnPairs, turn_pairs
from finssim.geometry.rotations import (
    matrix_to_quat,
    quat_conjugate,
    quat_from_rotvec,
    quat_inverse_rotate,
    quat_multiply,
    quat_rotate,
    quat_to_matrix,
    quat_to_rotvec,
    skew,
)

__all__ = ["ImuMounting", "fit_imu_mounting", "level_from_rest", "rotation_between", "turn_residual"]

# Estimates of an IMU's mounting with their intervals, and what the motion leaves open.

UNSURE = math.radians(5.0)
"""Half width of the 95 % interval of an angle beyond which it does not count as identified."""


def imu_estimates(theta: Array, ends: Array) -> dict[str, Estimate]:
    """By name.

    Args:
        theta: Turn about the body axes [rad] (3), gyro bias [rad/s] (3) and, if it was free, the time offset [s].
        ends: Of the 95 % intervals, (6 or 7, 2).
    """
    found = {}
    for i, axis in enumerate("xyz"):
        half = 0.5 * (ends[i, 1] - ends[i, 0])
        sure = bool(half < UNSURE)
        note = (
            "" if sure else f"the vehicle hardly turns about any axis but {axis}: this angle keeps the file's"
        )
        low, high = np.degrees(ends[i])
        found[f"imu.turn_{axis}"] = Estimate(
            name=f"imu.turn_{axis}",
            estimate=float(np.degrees(theta[i])),
            ci95=(float(low), float(high)),
            unit="deg",
            identifiable=sure,
            note=note,
        )
    for i, axis in enumerate("xyz", start=3):
        name = f"imu.gyro_bias_{axis}"
        ci = (float(ends[i, 0]), float(ends[i, 1]))
        found[name] = Estimate(
            name=name,
            estimate=float(theta[i]),
            ci95=ci,
            unit="rad/s",
            identifiable=bool(np.isfinite(ci).all()),
        )
    if len(theta) > 6:
        ci = (float(ends[6, 0]), float(ends[6, 1]))
        found["imu.time_offset"] = Estimate(
            name="imu.time_offset",
            estimate=float(theta[6]),
            ci95=ci,
            unit="s",
            identifiable=bool(ci[1] - ci[0] < 0.2),
        )
    return found


def imu_advice(estimates: dict[str, Estimate], rejected: float) -> tuple[str, ...]:
    """Sentences on what is not told; `rejected` is the share of windows without weight."""
    sentences = []
    unsure = [axis for axis in "xyz" if not estimates[f"imu.turn_{axis}"].identifiable]
    if unsure:
        sentences.append(
            f"the motion does not tell how the IMU is turned about body {' and '.join(unsure)}: rock the "
            "vehicle about at least two axes, by 10 degrees and more"
        )
    if rejected > 0.1:
        sentences.append(
            f"{100.0 * rejected:.0f} % of the windows disagree and have no weight: look at the attitude"
        )
    return tuple(sentences)


Array = NDArray[np.float64]

WINDOW = 0.5
"""Over which turns are compared [s]: long against the noise of an attitude, short against drift and swinging."""

LONGEST_OFFSET = 1.0
"""Offsets up to this are looked for [s]."""

OFFSET_STEP = 0.02
LEAST_CORRELATION = 0.6
BLOCKS = 12
TUKEY = 4.685
ROUNDS = 12
FEWEST = 20
NUDGE = 0.005
"""Step of the derivative with respect to the time offset [s]."""


@dataclass(frozen=True, kw_only=True)
class ImuMounting:
    """A mounted IMU."""

    orientation: Array
    """Sensor axes to body axes, xyzw, (4,); for `sensors.imu.orientation`."""
    gyro_bias: Array
    """To be taken off the rate, sensor axes [rad/s], (3,)."""
    time_offset: float
    """To be added to the IMU's times [s]."""
    covariance: Array
    """Of a small turn of the mounting about the body axes [rad²], (3, 3); infinite where nothing tells."""
    estimates: dict[str, Estimate]
    """imu.turn_x, _y, _z [deg] (from the orientation it started from, about the body axes), imu.gyro_bias_*,
    imu.time_offset."""
    residual: float
    """Robust root mean square of the turns' disagreement over one window [rad]."""
    rejected: int
    """Windows without weight."""
    windows: int
    correlation: float
    """Of the turns' sizes once the clocks agree."""
    advice: tuple[str, ...]

    @property
    def whole(self) -> bool:
        """Whether all three angles are told."""
        return all(self.estimates[f"imu.turn_{axis}"].identifiable for axis in "xyz")


def rotation_between(vectors_a: Array, vectors_b: Array, weights: Array, start: ArrayLike) -> Array:
    """Rotation q_ab with a = R_ab b in least squares; where the vectors leave it open, as in `start`  (Kabsch 1976).

    Args:
        vectors_a: (n, 3).
        vectors_b: The same in other axes, (n, 3).
        weights: (n,).
        start: q_ab, xyzw, (4,).

    Returns:
        xyzw, (4,).
    """
    B = (weights[:, None] * vectors_a).T @ vectors_b
    R0 = quat_to_matrix(start)
    # From the start's axes, so that a direction without information stays where it is.
    left, _, right = np.linalg.svd(B @ R0.T + 1e-6 * np.linalg.norm(B) * np.eye(3))
    R = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return matrix_to_quat(R @ R0)


def fit_imu_mounting(
    attitude: Attitude,
    gyro: Gyro,
    *,
    start: ArrayLike = (0.0, 0.0, 0.0, 1.0),
    window: float = WINDOW,
    time_offset: float | None = None,
) -> ImuMounting:
    """Orientation, gyro bias and time offset under which the gyro turns as the attitude does.

    theta_b = R_bs (theta_s(t + offset) - b T) over windows of length T; robust least squares (Tukey), intervals
    from the disagreement of blocks of the recording.

    Args:
        attitude: Body attitude by vision or motion capture; noise of a degree is fine.
        gyro: In the sensor's own axes.
        start: Orientation so far, sensor to body, xyzw, (4,); kept about an axis that the motion leaves open.
        window: T [s].
        time_offset: Where it is known [s]; found if None.

    Raises:
        CalibrationError: The two share too little time or no rotation.
    """
    pairs = turn_pairs(attitude, window) if len(attitude.t) > 2 and len(gyro.t) > 2 else None
    if pairs is None or len(pairs.start) < FEWEST:
        raise CalibrationError(
            f"the attitude holds {0 if pairs is None else len(pairs.start)} windows of {window:g} s, expected at least "
            f"{FEWEST}: record a minute in which the vehicle turns about all its axes"
        )
    offset, correlation = _time_offset(pairs, gyro) if time_offset is None else (time_offset, math.nan)
    body, sensor = _both(pairs, gyro, offset)
    q = rotation_between(
        body, sensor, np.minimum(1.0, 0.2 / np.maximum(np.linalg.norm(body, axis=1), 1e-9)), start
    )
    return _refined(pairs, gyro, q, offset, time_offset is None, correlation, np.asarray(start, float))


def _both(pairs: TurnPairs, gyro: Gyro, offset: float) -> tuple[Array, Array]:
    sensor = pairs.sensor(gyro, offset)
    known = np.isfinite(sensor[:, 0])
    return pairs.body[known], sensor[known]


def _time_offset(pairs: TurnPairs, gyro: Gyro) -> tuple[float, float]:
    """Where the sizes of the turns go together best, which needs no orientation; and their correlation there."""
    best, highest = 0.0, -1.0
    for offset in np.arange(-LONGEST_OFFSET, LONGEST_OFFSET + 1e-9, OFFSET_STEP):
        body, sensor = _both(pairs, gyro, float(offset))
        if len(body) < FEWEST:
            continue
        seen, felt = np.linalg.norm(body, axis=1), np.linalg.norm(sensor, axis=1)
        with np.errstate(invalid="ignore"):  # a gyro that stands still correlates with nothing
            capped = np.minimum(seen, 1.5 * felt.max())  # flips must not decide
            together = float(np.corrcoef(capped, felt)[0, 1])
        if together > highest:
            best, highest = float(offset), together
    if highest < LEAST_CORRELATION:
        raise CalibrationError(
            f"attitude and gyro do not turn together (correlation {max(highest, 0.0):.2f} at best, within "
            f"{LONGEST_OFFSET:g} s): are they of one recording, and does the vehicle turn?"
        )
    return best, highest


def _refined(
    pairs: TurnPairs, gyro: Gyro, q: Array, offset: float, free_offset: bool, correlation: float, start: Array
) -> ImuMounting:
    bias, span = np.zeros(3), (pairs.end - pairs.start)[:, None]
    for _ in range(ROUNDS):
        residual, J = _linearised(pairs, gyro, q, bias, offset, span)
        good = np.isfinite(residual).all(axis=1) & np.isfinite(J).all(axis=(1, 2))
        size = np.linalg.norm(np.where(good[:, None], residual, 0.0), axis=1)
        sigma = max(1.4826 * float(np.median(np.abs(residual[good]))), 1e-9)
        weight = np.where(
            good, np.clip(1.0 - (size / (TUKEY * math.sqrt(3.0) * sigma)) ** 2, 0.0, None) ** 2, 0.0
        )
        if not free_offset:
            J[..., 6] = 0.0
        step = _solve(J[good], residual[good], weight[good])
        q = quat_multiply(quat_from_rotvec(step[:3]), q)
        bias, offset = bias + step[3:6], offset + float(step[6])
        if np.abs(step).max() < 1e-9:
            break
    names = ("turn_x", "turn_y", "turn_z", "bias_x", "bias_y", "bias_z", "offset")
    used = 7 if free_offset else 6
    evidence = _evidence(names[:used], J[good][..., :used], residual[good], weight[good] / sigma**2)
    covariance = trial_covariance(evidence)
    q = _kept_where_untold(q, start, covariance)
    turn = quat_to_rotvec(quat_multiply(q, quat_conjugate(start)))
    theta = np.concatenate([turn, bias, [offset]])[:used]
    estimates = imu_estimates(theta, intervals(theta, covariance))
    std, tied = covariance.std[:3], covariance.local[:3, :3]
    ratio = std / np.sqrt(np.diagonal(tied)) if np.isfinite(tied).all() else np.full(3, np.inf)
    kept = weight > 0.0
    return ImuMounting(
        orientation=np.asarray(q / np.linalg.norm(q)),
        gyro_bias=bias,
        time_offset=offset,
        covariance=tied * np.outer(ratio, ratio) if np.isfinite(ratio).all() else np.diag(std**2),
        estimates=estimates,
        residual=float(np.sqrt(np.average(size[good] ** 2, weights=weight[good]))),
        rejected=int(np.sum(good & ~kept)),
        windows=int(good.sum()),
        correlation=correlation,
        advice=imu_advice(estimates, float(np.mean(~kept[good]))),
    )


def _kept_where_untold(q: Array, start: Array, covariance: Covariance) -> Array:
    """The mounting, turned back as near to the start as it goes about the axes that the motion does not tell."""
    ratio = covariance.std[:3] ** 2 / np.maximum(np.diagonal(covariance.local)[:3], 1e-300)
    if not np.isfinite(covariance.local[:3, :3]).all():
        return start
    variances, axes = np.linalg.eigh(covariance.local[:3, :3])
    for variance, axis in zip(variances, axes.T, strict=True):
        if 1.96 * math.sqrt(variance * max(1.0, float(axis**2 @ ratio))) > UNSURE:
            away = quat_multiply(q, quat_conjugate(start))
            back = -2.0 * math.atan2(float(axis @ away[:3]), float(away[3]))
            q = quat_multiply(quat_from_rotvec(back * axis), q)
    return q


def _linearised(
    pairs: TurnPairs, gyro: Gyro, q: Array, bias: Array, offset: float, span: Array
) -> tuple[Array, Array]:
    """Disagreement of the turns (k, 3) and its change with turn, bias and offset, with the sign of a prediction."""
    sensor = pairs.sensor(gyro, offset)
    slope = (pairs.sensor(gyro, offset + NUDGE) - pairs.sensor(gyro, offset - NUDGE)) / (2.0 * NUDGE)
    predicted = quat_rotate(q, sensor - bias * span)
    R = quat_to_matrix(q)
    J = np.concatenate(
        [-skew(predicted), -span[..., None] * R, quat_rotate(q, slope)[..., None]],
        axis=-1,
    )
    return pairs.body - predicted, J


def _solve(J: Array, residual: Array, weight: Array) -> Array:
    root = np.sqrt(weight)[:, None]
    step, *_ = np.linalg.lstsq((root[..., None] * J).reshape(-1, 7), (root * residual).ravel(), rcond=1e-5)
    return np.asarray(step)


def _evidence(names: tuple[str, ...], J: Array, residual: Array, weight: Array) -> Evidence:
    blocks = [b for b in np.array_split(np.arange(len(J)), min(BLOCKS, len(J) // 4)) if len(b)]
    normal = [np.einsum("n,nki,nkj->ij", weight[b], J[b], J[b]) for b in blocks]
    score = [np.einsum("n,nki,nk->i", weight[b], J[b], residual[b]) for b in blocks]
    return Evidence(names=names, normal=np.array(normal), score=np.array(score), unit="blocks")


def turn_residual(
    mounting: ImuMounting,
    attitude: Attitude,
    gyro: Gyro,
    *,
    time_offset: float | None = None,
    window: float = WINDOW,
) -> float:
    """Disagreement of gyro and attitude on a recording that the mounting was not fitted to, robust rms [rad].

    The bias, which a gyro has anew at every power-on, is that of this recording.

    Args:
        mounting: From another recording.
        attitude: Of this one.
        gyro: Of this one.
        time_offset: Of its clocks [s]; the mounting's if None.
        window: Length of the turns [s].
    """
    pairs = turn_pairs(attitude, window)
    offset = mounting.time_offset if time_offset is None else time_offset
    body, sensor = _both(pairs, gyro, offset)
    residual = quat_inverse_rotate(mounting.orientation, body) - sensor
    residual -= np.median(residual, axis=0)
    size = np.linalg.norm(residual, axis=1)
    usual = size < 4.0 * np.median(size)
    return float(np.sqrt(np.mean(size[usual] ** 2)))


def level_from_rest(up_b: Array, force_s: Array, start: ArrayLike) -> tuple[Array, Array]:
    """Orientation from the accelerometer at rest: gravity tells the tilt of the mounting, and not its turn about it.

    Args:
        up_b: Direction of up in body axes, (n, 3).
        force_s: Accelerometer at the same times, sensor axes [m/s²], (n, 3).
        start: Orientation so far, sensor to body, xyzw, (4,); kept about the axis that all rests share.

    Returns:
        Orientation, sensor to body, xyzw (4,), and its information about the body axes for unit noise of a direction,
        Σ -S(u)², (3, 3): singular along up if the vehicle always rested alike.
    """
    felt = force_s / np.linalg.norm(force_s, axis=-1, keepdims=True)
    q = rotation_between(up_b, felt, np.ones(len(up_b)), start)
    S = skew(up_b)
    return q, np.asarray(-np.sum(S @ S, axis=0))
