"""How the sensors of a vehicle sit: an IMU's orientation, bias and clock, a pressure sensor's offset and scale."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, finding
from finssim.calibration.fit import Estimate
from finssim.calibration.motion.smoothing import longest_step
from finssim.calibration.uncertainty import Covariance, intervals, trial_covariance
from finssim.calibration.vision.least_squares import TukeyFit, tukey
from finssim.geometry.rotations import (
    matrix_to_quat,
    quat_conjugate,
    quat_from_rotvec,
    quat_multiply,
    quat_rotate,
    quat_to_matrix,
    quat_to_rotvec,
    skew,
)

__all__ = [
    "Attitude", "DepthFit", "Gyro", "ImuMounting", "SALT", "UNSURE_TURN", "fit_depth",
    "fit_imu_mounting", "imu_clock", "rotation_between", "turn_pairs",
]  # fmt: skip

Array = NDArray[np.float64]

THIN = 0.1
"""Least time between the starts of two windows [s]: denser ones tell the same."""

WINDOW = 0.5
"""Over which turns are compared [s]: long against the noise of an attitude, short against drift and swinging."""

FEWEST = 20
"""Turns without which nothing is fitted."""

LONGEST_OFFSET = 1.0
"""Offsets of the clock up to this are looked for [s]."""

OFFSET_STEP = 0.02
"""Between the offsets that are tried [s]."""

NUDGE = 0.005
"""Step of the derivative with respect to the time offset [s]."""

LEAST_CORRELATION = 0.6
"""Of the sizes of the turns by attitude and gyro, below which they are not of one recording."""

UNSURE_TURN = math.radians(5.0)
"""Half width of the 95 % interval of an angle beyond which it does not count as identified."""

UNSURE_CLOCK = 0.05
"""The same for the offset of a clock that turns about the vertical alone tell [s]."""


@dataclass(frozen=True, kw_only=True)
class Attitude:
    """Attitude of the body as something other than the IMU saw it."""

    t: Array
    """Increasing [s], (n,)."""
    quaternion: Array
    """Body to an upright frame that does not turn, xyzw, (n, 4)."""


@dataclass(frozen=True, kw_only=True)
class Gyro:
    """Angular rate in the sensor's own axes."""

    t: Array
    """Increasing [s], (m,)."""
    rate: Array
    """[rad/s], (m, 3)."""

    def turn(self, start: Array, end: Array) -> Array:
        """Sensor axes at `end` to sensor axes at `start`, xyzw, (k, 4); NaN outside the record and across its gaps."""
        product, gaps = self._integrated()
        first, last = self._at(start, product), self._at(end, product)
        known = (start >= self.t[0]) & (end <= self.t[-1])
        known &= np.interp(start, self.t, gaps) == np.interp(end, self.t, gaps)
        turned = quat_multiply(quat_conjugate(first), last)
        return np.where(known[:, None], turned, np.nan)

    def _integrated(self) -> tuple[Array, Array]:
        """Product of all turns up to each sample (m, 4), and the number of gaps until then (m,)."""
        dt = np.diff(self.t)[:, None]
        turns = quat_from_rotvec(0.5 * (self.rate[1:] + self.rate[:-1]) * dt)
        product = np.concatenate([[[0.0, 0.0, 0.0, 1.0]], turns])
        shift = 1
        while shift < len(product):  # running product by doubling
            product[shift:] = quat_multiply(product[:-shift], product[shift:])
            shift *= 2
        gaps = np.concatenate([[0.0], np.cumsum(dt[:, 0] > longest_step(self.t))])
        return product / np.linalg.norm(product, axis=-1, keepdims=True), gaps

    def _at(self, t: Array, product: Array) -> Array:
        k = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 2)
        part = np.clip(t - self.t[k], 0.0, None)[:, None]
        slope = (self.rate[k + 1] - self.rate[k]) / (self.t[k + 1] - self.t[k])[:, None]
        return quat_multiply(product[k], quat_from_rotvec((self.rate[k] + 0.5 * slope * part) * part))


@dataclass(frozen=True, kw_only=True)
class TurnPairs:
    """Turns of the body over many windows, and the windows, so that a gyro can be laid beside them."""

    start: Array
    """[s], (k,)."""
    end: Array
    """[s], (k,)."""
    body: Array
    """Rotation vectors, body axes [rad], (k, 3)."""

    def sensor(self, gyro: Gyro, offset: float) -> Array:
        """Rotation vectors by the gyro over the same windows, sensor axes [rad], (k, 3).

        Args:
            gyro: The gyro.
            offset: What is to be added to its times [s].
        """
        turned = gyro.turn(self.start - offset, self.end - offset)
        known = np.isfinite(turned[:, 0])
        vectors = np.full((len(turned), 3), np.nan)
        vectors[known] = quat_to_rotvec(turned[known])
        return vectors


def turn_pairs(attitude: Attitude, window: float) -> TurnPairs:
    """Turns of the body over windows of about the same length, at most ten a second.

    R_b(t) R_b(t + T)⁻¹ is the same rotation for every frame fixed to the body but for the axes it is written in, so
    that attitude and gyro are compared without a derivative (the rotation part of A X = X B; Park and Martin 1994).

    Args:
        attitude: The attitude.
        window: T [s].
    """
    t = attitude.t
    starts = np.unique(np.searchsorted(t, np.arange(t[0], t[-1] - window, THIN)))
    ends = np.searchsorted(t, t[starts] + window)
    ends = np.minimum(ends, len(t) - 1)
    earlier = np.maximum(ends - 1, 0)
    nearer = np.abs(t[earlier] - t[starts] - window) < np.abs(t[ends] - t[starts] - window)
    ends = np.where(nearer, earlier, ends)
    good = np.abs(t[ends] - t[starts] - window) < 0.25 * window
    starts, ends = starts[good], ends[good]
    q = attitude.quaternion
    body = quat_to_rotvec(quat_multiply(quat_conjugate(q[starts]), q[ends]))
    return TurnPairs(start=t[starts], end=t[ends], body=body)


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
    findings: tuple[Finding, ...]


def rotation_between(
    vectors_a: Array, vectors_b: Array, weights: ArrayLike = 1.0, start: ArrayLike = (0.0, 0.0, 0.0, 1.0)
) -> Array:
    """Rotation q_ab with a = R_ab b in least squares; where the vectors leave it open, as in `start`  (Kabsch 1976).

    Args:
        vectors_a: (n, 3).
        vectors_b: The same in other axes, (n, 3).
        weights: (n,), or one for all.
        start: q_ab, xyzw, (4,).

    Returns:
        xyzw, (4,).
    """
    B = (np.reshape(weights, (-1, 1)) * vectors_a).T @ vectors_b
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
    offset = _time_offset(pairs, gyro) if time_offset is None else time_offset
    body, sensor = _both(pairs, gyro, offset)
    size, before = np.linalg.norm(body, axis=1), np.asarray(start, float)
    q = rotation_between(body, sensor, np.minimum(1.0, 0.2 / np.maximum(size, 1e-9)), before)
    fit = _turned_alike(pairs, gyro, q, offset, free_offset=time_offset is None)
    (q, bias, offset), names = (
        fit.state,
        ("turn_x", "turn_y", "turn_z", "bias_x", "bias_y", "bias_z", "offset"),
    )
    covariance = trial_covariance(fit.evidence(names[: fit.jacobian.shape[-1]]))
    q = _kept_where_untold(q, before, covariance)
    theta = np.array([*quat_to_rotvec(quat_multiply(q, quat_conjugate(before))), *bias, offset])
    half = intervals(np.zeros(len(covariance.names)), covariance)[:, 1]
    estimates = _imu_estimates(theta[: len(half)], half)
    std, tied = covariance.std[:3], covariance.local[:3, :3]
    ratio = std / np.sqrt(np.diagonal(tied)) if np.isfinite(tied).all() else np.full(3, np.inf)
    return ImuMounting(
        orientation=np.asarray(q / np.linalg.norm(q)),
        gyro_bias=bias,
        time_offset=offset,
        covariance=tied * np.outer(ratio, ratio) if np.isfinite(ratio).all() else np.diag(std**2),
        estimates=estimates,
        residual=fit.rms,
        rejected=fit.rejected,
        findings=_imu_findings(estimates, fit.rejected / len(fit.weight)),
    )


def _both(pairs: TurnPairs, gyro: Gyro, offset: float) -> tuple[Array, Array]:
    sensor = pairs.sensor(gyro, offset)
    known = np.isfinite(sensor[:, 0])
    return pairs.body[known], sensor[known]


def _time_offset(pairs: TurnPairs, gyro: Gyro) -> float:
    """Where the sizes of the turns go together best, which needs no orientation [s]."""
    best, highest = 0.0, -1.0
    for offset in np.arange(-LONGEST_OFFSET, LONGEST_OFFSET + 1e-9, OFFSET_STEP):
        body, sensor = _both(pairs, gyro, float(offset))
        if len(body) < FEWEST:
            continue
        seen, felt = np.linalg.norm(body, axis=1), np.linalg.norm(sensor, axis=1)
        with np.errstate(invalid="ignore"):  # a gyro that stands still correlates with nothing
            capped = np.minimum(seen, 1.5 * felt.max())  # flips must not decide
            joint = float(np.corrcoef(capped, felt)[0, 1])
        if joint > highest:
            best, highest = float(offset), joint
    if highest < LEAST_CORRELATION:
        raise CalibrationError(
            f"attitude and gyro do not turn together (correlation {max(highest, 0.0):.2f} at best, within "
            f"{LONGEST_OFFSET:g} s): are they of one recording, and does the vehicle turn?"
        )
    return best


Mounted = tuple[Array, Array, float]
"""Orientation xyzw (4,), gyro bias [rad/s] (3,) and time offset [s] of an IMU."""


def _turned_alike(
    pairs: TurnPairs, gyro: Gyro, q: Array, offset: float, *, free_offset: bool
) -> TukeyFit[Mounted]:
    """Least squares on the turns, from near the solution."""
    span = (pairs.end - pairs.start)[:, None]

    def linearise(state: Mounted) -> tuple[Array, Array]:
        q, bias, offset = state
        predicted = quat_rotate(q, pairs.sensor(gyro, offset) - bias * span)
        J = [-skew(predicted), -span[..., None] * quat_to_matrix(q)]
        if free_offset:
            later, earlier = pairs.sensor(gyro, offset + NUDGE), pairs.sensor(gyro, offset - NUDGE)
            J.append(quat_rotate(q, (later - earlier) / (2.0 * NUDGE))[..., None])
        return pairs.body - predicted, np.concatenate(J, axis=-1)

    def moved(state: Mounted, step: Array) -> Mounted:
        q, bias, offset = state
        q = quat_multiply(quat_from_rotvec(step[:3]), q)
        return q, bias + step[3:6], offset + float(step[6:].sum())

    return tukey((q, np.zeros(3), offset), linearise, moved, rcond=1e-5)


def _kept_where_untold(q: Array, start: Array, covariance: Covariance) -> Array:
    """The mounting, turned back as near to the start as it goes about the axes that the motion does not tell."""
    ratio = covariance.std[:3] ** 2 / np.maximum(np.diagonal(covariance.local)[:3], 1e-300)
    if not np.isfinite(covariance.local[:3, :3]).all():
        return start
    variances, axes = np.linalg.eigh(covariance.local[:3, :3])
    for variance, axis in zip(variances, axes.T, strict=True):
        if 1.96 * math.sqrt(variance * max(1.0, float(axis**2 @ ratio))) > UNSURE_TURN:
            away = quat_multiply(q, quat_conjugate(start))
            back = -2.0 * math.atan2(float(axis @ away[:3]), float(away[3]))
            q = quat_multiply(quat_from_rotvec(back * axis), q)
    return q


def _imu_estimates(theta: Array, half: Array) -> dict[str, Estimate]:
    """By name.

    Args:
        theta: Turn about the body axes [rad] (3), gyro bias [rad/s] (3) and, if it was free, the time offset [s].
        half: Half widths of the 95 % intervals, (6 or 7,).
    """
    rows = []
    for axis, value, width in zip("xyz", theta, half, strict=False):
        note = f"the vehicle hardly turns about any axis but {axis}: this angle keeps the file's"
        angle, width_deg = np.degrees(value), np.degrees(width)
        rows.append(Estimate.within(f"imu.turn_{axis}", angle, width_deg, "deg", width < UNSURE_TURN, note))
    for axis, value, width in zip("xyz", theta[3:], half[3:], strict=False):
        rows.append(Estimate.within(f"imu.gyro_bias_{axis}", value, width, "rad/s", math.isfinite(width)))
    for value, width in zip(theta[6:], half[6:], strict=True):
        rows.append(Estimate.within("imu.time_offset", value, width, "s", width < 0.1))
    return {row.name: row for row in rows}


def _imu_findings(estimates: dict[str, Estimate], rejected: float) -> tuple[Finding, ...]:
    """What is not told; `rejected` is the share of windows without weight."""
    findings = []
    unsure = [axis for axis in "xyz" if not estimates[f"imu.turn_{axis}"].identifiable]
    if unsure:
        findings.append(finding("imu_turn_unknown", axes=tuple(unsure)))
    if rejected > 0.1:
        findings.append(finding("windows_disagree", share=rejected))
    return tuple(findings)


def imu_clock(attitude: Attitude, up_p: Array, t: Array, vertical_rate: Array) -> Estimate | None:
    """What is to be added to the IMU's times, from turns about the vertical between neighbouring pictures.

    n · log(R_2 R_1ᵀ) = ∫ ω · up dt over the same time, less a bias; ω and up in any one frame of the vehicle, so that
    neither the IMU's mounting nor the tilt is needed.

    Args:
        attitude: From the pixels; its tilt may be poor.
        up_p: n, upwards in the attitude's outer frame, (3,).
        t: Times of the IMU, increasing [s], (m,).
        vertical_rate: ω · up [rad/s], (m,).

    Returns:
        `imu.time_offset` [s], or None if there are too few pictures.
    """
    q = attitude.quaternion
    seen = quat_to_rotvec(quat_multiply(q[1:], quat_conjugate(q[:-1]))) @ up_p
    start, end = attitude.t[:-1], attitude.t[1:]
    known = (start > t[0] + LONGEST_OFFSET) & (end < t[-1] - LONGEST_OFFSET) & (end - start < 3.0)
    seen, start, end = seen[known], start[known], end[known]
    if len(seen) < FEWEST:
        return None
    heading = np.concatenate([[0.0], np.cumsum(0.5 * (vertical_rate[1:] + vertical_rate[:-1]) * np.diff(t))])

    def off(offset: float) -> Array:
        return np.asarray(seen - np.interp(end - offset, t, heading) + np.interp(start - offset, t, heading))

    def linearise(theta: Array) -> tuple[Array, Array]:
        bias, offset = theta
        slope = (off(offset - NUDGE) - off(offset + NUDGE)) / (2.0 * NUDGE)
        J = np.column_stack([start - end, slope])
        return (off(offset) + bias * (end - start))[:, None], J[:, None]

    trials = np.arange(-LONGEST_OFFSET, LONGEST_OFFSET + 1e-9, OFFSET_STEP)
    first = min(trials, key=lambda x: np.sum(np.abs(off(x) - np.median(off(x)))))
    bias = -float(np.median(off(first) / (end - start)))
    fit = tukey(np.array([bias, first]), linearise, np.add)
    half = float(
        intervals(fit.state, trial_covariance(fit.evidence(("bias", "offset"))))[1, 1] - fit.state[1]
    )
    sure = half < UNSURE_CLOCK and abs(fit.state[1]) <= LONGEST_OFFSET
    note = "the vehicle turns too evenly to tell the clocks apart: taken as 0"
    return Estimate.within("imu.time_offset", fit.state[1], half, "s", sure, note)


# A pressure sensor against depths known by other means.

SALT = 1.025
"""Density of sea water over that of fresh water: what a sensor set to the wrong one is wrong by."""

FEWEST_DEPTHS = 5
UNSURE_OFFSET = 0.02
"""Half width of the 95 % interval beyond which the offset does not count as told [m]."""

UNSURE_SCALE = 0.02
"""The same for the scale: less than what fresh and salt water differ by."""


@dataclass(frozen=True, kw_only=True)
class DepthFit:
    """reading = scale · depth + offset."""

    offset: float
    """[m]"""
    scale: float
    """1 where the depths span too little to tell."""
    estimates: dict[str, Estimate]
    """depth.offset [m] and depth.scale [-]."""
    rms: float
    """Of what is left over, robust [m]."""
    rejected: int
    """Samples without weight."""
    findings: tuple[Finding, ...]


def fit_depth(known: ArrayLike, reading: ArrayLike, *, known_std: float = 0.0) -> DepthFit:
    """Offset, and scale if the depths span enough, by robust least squares (Tukey).

    The scale is told apart from 1 or kept at 1; then the offset is that of a sensor without an error of scale.

    Args:
        known: Depths of the pressure port below the surface [m], (n,), in order of time.
        reading: What the sensor said [m], (n,).
        known_std: An error that all known depths share, such as that of the water level [m]; widens the offset's
            interval.

    Raises:
        CalibrationError: Fewer than five pairs.
    """
    x, y = np.asarray(known, float), np.asarray(reading, float)
    good = np.isfinite(x) & np.isfinite(y)
    x, y = x[good], y[good]
    if len(x) < FEWEST_DEPTHS:
        raise CalibrationError(
            f"{len(x)} pairs of known depth and reading, expected at least {FEWEST_DEPTHS}"
        )
    one = np.ones_like(x)
    (_, slope), (_, half_scale), fit = _line(np.column_stack([one, x - x.mean()]), y - x)
    told = bool(half_scale < UNSURE_SCALE)
    A = np.column_stack([one, x]) if told else one[:, None]
    (offset, *slopes), (half, *_), fit = _line(A, y - x)
    scale = 1.0 + sum(slopes)
    wide, note = float(np.hypot(half, 1.96 * known_std)), "rests on too few or too noisy depths"
    rows = (
        Estimate.within("depth.offset", offset, wide, "m", wide < UNSURE_OFFSET, note),
        Estimate.within(
            "depth.scale", scale, half_scale, "-", told, "the depths span too little: taken as 1"
        ),
    )
    return DepthFit(
        offset=float(offset),
        scale=float(scale),
        estimates={row.name: row for row in rows},
        rms=fit.rms,
        rejected=fit.rejected,
        findings=_depth_findings(rows[1], float(np.ptp(x))),
    )


def _line(A: Array, y: Array) -> tuple[Array, Array, TukeyFit[Array]]:
    """Robust solution of A theta = y, half widths of its 95 % intervals, and the fit."""
    start = np.array([np.median(y), 0.0])[: A.shape[1]]
    fit = tukey(start, lambda theta: ((y - A @ theta)[:, None], A[:, None]), np.add)
    covariance = trial_covariance(fit.evidence(("offset", "scale")[: A.shape[1]]))
    return fit.state, intervals(np.zeros(A.shape[1]), covariance)[:, 1], fit


def _depth_findings(scale: Estimate, span: float) -> tuple[Finding, ...]:
    if not scale.identifiable:
        return (finding("depths_alike", span=span, share=SALT - 1.0),)
    low, high = scale.ci95
    for right, others in (
        (1.0, ""),
        (SALT, "fresh water in salt water"),
        (1.0 / SALT, "salt water in fresh water"),
    ):
        if low <= right <= high:
            return (finding("water_setting", setting=others),) if others else ()
    return (finding("scale_unexplained", scale=scale.estimate),)
