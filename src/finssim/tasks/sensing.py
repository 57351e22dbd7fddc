"""Readings of the vehicle's own instruments and position fixes, fused by a filter in the batch, world by world.

Gyroscope and accelerometer give rates, roll and pitch (the complementary filter of `localization.fusion.attitude`);
external fixes give x, y and yaw, and z if there is no pressure sensor; a DVL gives velocity if there is one. Each axis
has a Kalman filter of two states, as in `localization.fusion`: position and velocity with white acceleration, and yaw
with an unknown bias of the gyroscope (the paper's equations 14 and 15). A delayed measurement is compared with the
estimate of its own time, and corrects all estimates since then.
"""
# mypy: disable-error-code="valid-type,misc,index,no-any-return,no-untyped-def,untyped-decorator,attr-defined"

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import warp as wp

from finssim.core.yaml_file import read_mapping
from finssim.localization.fusion.attitude import TiltGains, YawNoise
from finssim.localization.fusion.position_filter import MotionModel
from finssim.physics.types import join
from finssim.sim import Simulator
from finssim.sim.launch import KernelSequence
from finssim.sim.measured import MeasurementErrors
from finssim.sim.packed import Packed
from finssim.sim.sensors import SensorSuite
from finssim.sim.sensors.depth import DepthArrays, DepthParameters
from finssim.sim.sensors.dvl import DvlArrays, DvlParameters
from finssim.sim.sensors.imu import ImuArrays, ImuParameters
from finssim.sim.sensors.sampling import (
    DROPOUT,
    TURN_ON,
    TURN_ON_2,
    WALK,
    WALK_2,
    WHITE,
    WHITE_2,
    Sampling,
    normal,
    normal3,
    sample_key,
    samples_until,
)
from finssim.sim.state import HISTORY, State
from finssim.tasks.arrays import TaskArrays, allocated
from finssim.tasks.measurement import LONGEST_DELAY, MeasurementNoise
from finssim.tasks.validation import EnvironmentSetupError
from finssim.vehicles import Vehicle

FIX = 100
"""Number of the fixes in the key of random numbers, different from those of the sensors."""
STANDING = 400
"""Control steps after which the covariance of a filter has settled."""
FASTEST = 0.3
"""Standard deviation of a vehicle's speed per axis without any measurement [m/s], as in `localization.fusion`."""
MOUNT = ("position", "orientation")
PER_FIX = ("position_std", "yaw_std", "position_bias", "yaw_bias", "dropout", "delay")
"""Fields of a measurement noise that apply to a fix."""

_q, _gyro, _tilt = MotionModel().density, YawNoise(), TiltGains()
ACCELERATION = wp.vec3(*_q)
"""Spectral density of a vehicle's acceleration, world axes [m²/s³]."""
GYRO_FLOOR, GYRO_WALK = _gyro.rate, _gyro.bias_walk
"""Least noise density of a rate [rad/s/√Hz], due to mounting and sampling, and random walk of its bias."""
TILT_P, TILT_I, TILT_TOLERANCE = _tilt.proportional, _tilt.integral, _tilt.tolerance


@dataclass(frozen=True, kw_only=True)
class Sensing:
    """Sensors of the vehicle files, and external position fixes; see `finssim.tasks.sensing`.

    The defaults are roughly those of the overhead camera of a virtual pool of severity realistic.
    """

    rate: float = 30.0
    """Rate of the fixes [Hz]; 0: none, only a known start."""
    fixes: MeasurementNoise = MeasurementNoise(
        position_std=0.0035,
        yaw_std=math.radians(0.18),
        position_bias=0.01,
        yaw_bias=math.radians(0.2),
        dropout=0.005,
        delay=0.045,
    )
    """Noise of a fix, its offset per episode, its dropout probability and its delay."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.rate) and self.rate >= 0.0):
            raise ValueError(f"rate of the fixes is {self.rate} Hz, expected a finite number of 0 or more")
        others = [name for name, x in asdict(self.fixes).items() if x and name not in PER_FIX]
        if others:
            raise ValueError(
                f"{others[0]} of the fixes is given, expected of: {', '.join(PER_FIX)}; "
                "errors of velocities and rates are under sensors in the vehicle file"
            )


def load_sensing(path: str | Path) -> Sensing:
    """Read the fixes of a site from a YAML file: `rate`, and under `fixes` the nonzero errors of a fix.

    Raises:
        EnvironmentSetupError: The file is missing or invalid; the message names the file and the key.
    """
    data = read_mapping(Path(path), EnvironmentSetupError, such_as="rate: 1.0")
    fixes = data.get("fixes", {})
    if not isinstance(fixes, Mapping):
        raise EnvironmentSetupError(f"{path}: fixes is {fixes!r}, expected keys such as position_std: 0.2")
    for stated, allowed in ((data, ("rate", "fixes")), (fixes, PER_FIX)):
        for key, value in stated.items():
            if key not in allowed:
                raise EnvironmentSetupError(f"{path}: unknown key '{key}', expected {', '.join(allowed)}")
            if key != "fixes" and (isinstance(value, bool) or not isinstance(value, int | float)):
                raise EnvironmentSetupError(f"{path}: {key} is {value!r}, expected a number")
    if "rate" not in data:
        raise EnvironmentSetupError(f"{path}: rate is missing: give the fixes a second [Hz], 0 for none")
    try:
        return Sensing(
            rate=float(data["rate"]), fixes=MeasurementNoise(**{name: float(x) for name, x in fixes.items()})
        )
    except ValueError as error:
        raise EnvironmentSetupError(f"{path}: {error}") from None


def seen_with(noise: MeasurementNoise | Sensing, vehicle: Vehicle) -> dict[str, Any]:
    """Return the observation of a controller as plain data: errors, or fixes and on-board sensors, without mounting
    poses and zeros."""
    if isinstance(noise, MeasurementNoise):
        return {name: value for name, value in asdict(noise).items() if value}
    fixes = {"rate": noise.rate, **seen_with(noise.fixes, vehicle)} if noise.rate else None
    return {
        "fixes": fixes,
        **{
            kind: {name: x for name, x in values.items() if name not in MOUNT and x and x != math.inf}
            for kind, values in vehicle.sensors.model_dump(mode="json").items()
            if values
        },
    }


@wp.struct
class FilterConstants:
    """Constants of the filter of one vehicle; a covariance is (variance, covariance, variance) of a value and its
    rate."""

    gauge: wp.bool  # True if z is measured by a pressure sensor
    plane: wp.vec3  # settled covariance of x, and of y [m², m²/s, m²/s²]
    height: wp.vec3  # covariance of z [m², m²/s, m²/s²]
    yaw: wp.vec3  # covariance of yaw [rad², rad²/s, rad²/s²]


@wp.struct
class Estimates:
    """State of the filters, by (world, vehicle); position, velocity and attitude of recent control steps in a ring
    buffer."""

    filter_constants: wp.array(dtype=FilterConstants)  # by vehicle
    position: wp.array3d(dtype=wp.vec3)  # world frame [m]
    velocity: wp.array3d(dtype=wp.vec3)  # world frame [m/s]
    quaternion: wp.array3d(dtype=wp.quat)  # body to world
    bias: wp.array2d(dtype=wp.vec3)  # bias of the gyroscope, body frame [rad/s]
    rate: wp.array2d(dtype=wp.vec3)  # angular rate in the previous step, body frame [rad/s]
    plane: wp.array2d(dtype=wp.vec3)  # covariances, as in `FilterConstants`
    height: wp.array2d(dtype=wp.vec3)
    yaw: wp.array2d(dtype=wp.vec3)


@wp.struct
class InstrumentReadings:
    """Readings of the instruments; arrays of a kind that no vehicle has are empty. Fixes are drawn on arrival."""

    control_step: float  # [s]
    fix_errors: wp.array2d(dtype=MeasurementErrors)  # by (world, vehicle)
    fixes_per_step: wp.float64  # fixes in a control step [-]; 0: none
    imu_errors: wp.array2d(dtype=ImuParameters)
    imu: ImuArrays
    imu_samples: Sampling
    gauge_errors: wp.array2d(dtype=DepthParameters)
    gauge: DepthArrays
    gauge_samples: Sampling
    dvl_errors: wp.array2d(dtype=DvlParameters)
    dvl: DvlArrays
    dvl_samples: Sampling


@wp.func
def propagated_covariance(P: wp.vec3, q: float, dt: float) -> wp.vec3:
    """Propagate the covariance of a value and its rate, P <- A P A' + Q, for a rate driven by white noise of density q.

    `dt` is in [s]; P and q have the unit of the value squared.
    """
    return wp.vec3(
        P[0] + 2.0 * dt * P[1] + dt * dt * P[2] + q * dt * dt * dt / 3.0,
        P[1] + dt * P[2] + 0.5 * q * dt * dt,
        P[2] + q * dt,
    )


@wp.func
def value_gain(P: wp.vec3, R: float) -> wp.vec2:
    """Return the gain of value and rate for a measured value of variance R. P and R have the unit of the value
    squared."""
    return wp.vec2(P[0], P[1]) / (P[0] + R)


@wp.func
def covariance_after_value(P: wp.vec3, R: float) -> wp.vec3:
    """Return the covariance after a measured value of variance R. P and R have the unit of the value squared."""
    s = P[0] + R
    return wp.vec3(P[0] * R / s, P[1] * R / s, P[2] - P[1] * P[1] / s)


@wp.func
def rate_gain(P: wp.vec3, R: float) -> wp.vec2:
    """Return the gain of value and rate for a measured rate of variance R. P and R have the unit of the value
    squared."""
    return wp.vec2(P[1], P[2]) / (P[2] + R)


@wp.func
def covariance_after_rate(P: wp.vec3, R: float) -> wp.vec3:
    """Return the covariance after a measured rate of variance R. P and R have the unit of the value squared."""
    s = P[2] + R
    return wp.vec3(P[0] - P[1] * P[1] / s, P[1] * R / s, P[2] * R / s)


@wp.func
def measurement_variance(noise: float, quantum: float) -> float:
    """Return the variance of a measurement with noise that is rounded to a multiple of the quantum; never 0.

    Noise and quantum have one unit.
    """
    return noise * noise + quantum * quantum / 12.0 + 1.0e-10


@wp.func
def about_z(angle: float) -> wp.quat:
    """Return the rotation about world z by an angle [rad]."""
    return wp.quat(0.0, 0.0, wp.sin(0.5 * angle), wp.cos(0.5 * angle))


@wp.func
def turned_by(rotation: wp.vec3) -> wp.quat:
    """Return the quaternion of a rotation vector of less than half a turn."""
    angle = wp.length(rotation)
    k = 0.5 - angle * angle / 48.0
    if angle > 1.0e-3:
        k = wp.sin(0.5 * angle) / angle
    return wp.quat(k * rotation[0], k * rotation[1], k * rotation[2], wp.cos(0.5 * angle))


@wp.func
def turn_about_z(q: wp.quat, p: wp.quat) -> float:
    """Return the yaw difference of attitude q from p, wrapped to half a turn [rad]."""
    d = q * wp.quat_inverse(p)
    return 2.0 * wp.atan2(wp.where(d[3] < 0.0, -d[2], d[2]), wp.abs(d[3]))


@wp.func
def drawn_errors(P: wp.vec3, a: float, b: float) -> wp.vec2:
    """Return errors of value and rate with the covariance P, from two standard normal numbers."""
    std = wp.sqrt(wp.max(P[0], 1.0e-12))
    return wp.vec2(std * a, P[1] / std * a + wp.sqrt(wp.max(P[2] - P[1] * P[1] / (std * std), 0.0)) * b)


@wp.func
def initialise(
    state: State,
    r: InstrumentReadings,
    e: Estimates,
    has_fixes: bool,
    seed: int,
    w: int,
    v: int,
):
    """Start the filter in its steady state: with errors of its settled covariance and with the persistent offsets."""
    key = sample_key(seed, FIX, w, v, state.episode[w], 0)
    filter_constants = e.filter_constants[v]
    x = state.position[w, v]
    q = state.quaternion[w, v]
    a = normal3(key, WHITE)
    b = normal3(key, WALK)
    px = drawn_errors(filter_constants.plane, a[0], b[0])
    py = drawn_errors(filter_constants.plane, a[1], b[1])
    pz = drawn_errors(filter_constants.height, a[2], b[2])
    turn = drawn_errors(filter_constants.yaw, normal(key, WHITE_2), normal(key, WALK_2))
    lasting = wp.vec3()
    if has_fixes:
        m = r.fix_errors[w, v]
        lasting = m.position_bias * normal3(key, TURN_ON)
        turn[0] = turn[0] + m.yaw_bias * normal(key, TURN_ON_2)
    if filter_constants.gauge:
        lasting[2] = -r.gauge.bias[w, v]
    imu = r.imu_errors[w, v]
    up = wp.quat_rotate_inv(q, wp.vec3(0.0, 0.0, 1.0))
    felt = wp.normalize(imu.gravity * up + wp.quat_rotate(imu.orientation, r.imu.accel_bias[w, v]))
    nu = state.velocity[w, v]
    k = state.steps[w] % e.position.shape[2]
    e.position[w, v, k] = x + wp.vec3(px[0], py[0], pz[0]) + lasting
    e.quaternion[w, v, k] = wp.normalize(about_z(turn[0]) * q * turned_by(wp.cross(felt, up)))
    e.velocity[w, v, k] = wp.quat_rotate(q, wp.vec3(nu[0], nu[1], nu[2])) + wp.vec3(px[1], py[1], pz[1])
    e.bias[w, v] = wp.quat_rotate(imu.orientation, r.imu.gyro_bias[w, v]) - turn[1] * up
    e.rate[w, v] = wp.quat_rotate(imu.orientation, r.imu.gyro[w, v]) - e.bias[w, v]
    e.plane[w, v] = filter_constants.plane
    e.height[w, v] = filter_constants.height
    e.yaw[w, v] = filter_constants.yaw


@wp.func
def propagate(r: InstrumentReadings, e: Estimates, step: int, dt: float, w: int, v: int):
    """Propagate the state by a control step: attitude from the gyroscope, tilt corrected by the accelerometer, position
    from the velocity.

    `dt` is in [s].
    """
    before = (step - 1) % e.position.shape[2]
    now = step % e.position.shape[2]
    imu = r.imu_errors[w, v]
    rate = wp.quat_rotate(imu.orientation, r.imu.gyro[w, v]) - e.bias[w, v]
    q = e.quaternion[w, v, before] * turned_by(0.5 * dt * (rate + e.rate[w, v]))
    if r.imu_samples.fresh[w, v]:
        force = wp.quat_rotate(imu.orientation, r.imu.accel[w, v])
        size = wp.max(wp.length(force), 1.0e-6)
        off = (size - imu.gravity) / TILT_TOLERANCE
        up = wp.quat_rotate_inv(q, wp.vec3(0.0, 0.0, 1.0))
        error = wp.exp(-0.5 * off * off) * wp.cross(force / size, up)
        q = q * turned_by(TILT_P * dt * error)
        e.bias[w, v] = e.bias[w, v] - TILT_I * dt * error
        rate += TILT_I * dt * error
    e.quaternion[w, v, now] = wp.normalize(q)
    e.rate[w, v] = rate
    e.position[w, v, now] = e.position[w, v, before] + dt * e.velocity[w, v, before]
    e.velocity[w, v, now] = e.velocity[w, v, before]
    noise = wp.max(imu.gyro_noise * imu.gyro_noise * dt, GYRO_FLOOR * GYRO_FLOOR) * dt
    e.yaw[w, v] = propagated_covariance(e.yaw[w, v], GYRO_WALK * GYRO_WALK, dt) + wp.vec3(noise, 0.0, 0.0)
    e.plane[w, v] = propagated_covariance(e.plane[w, v], ACCELERATION[0], dt)
    e.height[w, v] = propagated_covariance(e.height[w, v], ACCELERATION[2], dt)


@wp.func
def measured_at(e: Estimates, latency: int, step: int) -> int:
    """Return the control step of a measurement of a given latency, limited to the stored steps and to the episode."""
    return step - wp.min(wp.min(latency, e.position.shape[2] - 1), step)


@wp.struct
class Correction:
    """Correction of an estimate by a measurement."""

    position: wp.vec3  # world frame [m]
    velocity: wp.vec3  # world frame [m/s]
    turn: wp.vec2  # correction of yaw, and of the gyroscope's bias about the vertical [rad, rad/s]


@wp.func
def translation_correction(position: wp.vec3, velocity: wp.vec3) -> Correction:
    """Return a correction of position [m] and velocity [m/s] alone, world frame."""
    c = Correction()
    c.position = position
    c.velocity = velocity
    return c


@wp.func
def correct(e: Estimates, w: int, v: int, at: int, step: int, dt: float, c: Correction):
    """Apply a correction of control step `at` to all estimates since then, and to the gyroscope's bias.

    `dt` is in [s].
    """
    up = wp.quat_rotate_inv(e.quaternion[w, v, step % e.position.shape[2]], wp.vec3(0.0, 0.0, 1.0))
    e.bias[w, v] = e.bias[w, v] - c.turn[1] * up
    e.rate[w, v] = e.rate[w, v] + c.turn[1] * up
    for j in range(at, step + 1):
        k = j % e.position.shape[2]
        t = float(j - at) * dt
        e.position[w, v, k] = e.position[w, v, k] + c.position + t * c.velocity
        e.velocity[w, v, k] = e.velocity[w, v, k] + c.velocity
        e.quaternion[w, v, k] = about_z(c.turn[0] + t * c.turn[1]) * e.quaternion[w, v, k]


@wp.func
def update_with_fix(state: State, r: InstrumentReadings, e: Estimates, seed: int, w: int, v: int):
    """Apply the fixes that arrive in this step, the mean of several in a control step."""
    m = r.fix_errors[w, v]
    dt = r.control_step
    step = state.steps[w]
    at = measured_at(e, int(wp.rint(m.delay / dt)), step)
    if at < 1:
        return
    key = sample_key(seed, FIX, w, v, state.episode[w], at)
    came = float(0.0)
    for i in range(samples_until(r.fixes_per_step, at) - samples_until(r.fixes_per_step, at - 1)):
        if wp.randf(wp.rand_init(int(key), DROPOUT + i)) >= m.dropout:
            came += 1.0
    if came == 0.0:
        return
    x = state.position[w, v]
    q = state.quaternion[w, v]
    if at < step:
        true = state.history[(at - 1) % wp.static(HISTORY), w, v]
        x = wp.vec3(true[0], true[1], true[2])
        q = wp.quat(true[3], true[4], true[5], true[6])
    k = at % e.position.shape[2]
    begun = sample_key(seed, FIX, w, v, state.episode[w], 0)
    fewer = 1.0 / wp.sqrt(came)
    lasting = m.position_bias * normal3(begun, TURN_ON)
    off = x + lasting + fewer * m.position_std * normal3(key, WHITE) - e.position[w, v, k]
    angle = m.yaw_bias * normal(begun, TURN_ON_2) + fewer * m.yaw_std * normal(key, WHITE_2)
    turn_off = turn_about_z(about_z(angle) * q, e.quaternion[w, v, k])
    R = measurement_variance(fewer * m.position_std, 0.0)
    A = value_gain(e.plane[w, v], R)
    B = wp.vec2(0.0, 0.0)
    e.plane[w, v] = covariance_after_value(e.plane[w, v], R)
    if not e.filter_constants[v].gauge:
        B = value_gain(e.height[w, v], R)
        e.height[w, v] = covariance_after_value(e.height[w, v], R)
    R_yaw = measurement_variance(fewer * m.yaw_std, 0.0)
    c = translation_correction(
        wp.cw_mul(wp.vec3(A[0], A[0], B[0]), off), wp.cw_mul(wp.vec3(A[1], A[1], B[1]), off)
    )
    c.turn = value_gain(e.yaw[w, v], R_yaw) * turn_off
    e.yaw[w, v] = covariance_after_value(e.yaw[w, v], R_yaw)
    correct(e, w, v, at, step, dt, c)


@wp.func
def update_with_depth(r: InstrumentReadings, e: Estimates, step: int, dt: float, w: int, v: int):
    """Apply a depth reading: -z - (R r)_z at the sensor's port. `dt` is in [s]."""
    at = measured_at(e, r.gauge_samples.timing[v].latency, step)
    k = at % e.position.shape[2]
    gauge = r.gauge_errors[w, v]
    port = wp.quat_rotate(e.quaternion[w, v, k], gauge.position)
    off = -r.gauge.depth[w, v] - port[2] - e.position[w, v, k][2]
    R = measurement_variance(gauge.noise_std, gauge.quantisation)
    K = value_gain(e.height[w, v], R) * off
    e.height[w, v] = covariance_after_value(e.height[w, v], R)
    correct(e, w, v, at, step, dt, translation_correction(wp.vec3(0.0, 0.0, K[0]), wp.vec3(0.0, 0.0, K[1])))


@wp.func
def update_with_velocity(r: InstrumentReadings, e: Estimates, step: int, dt: float, w: int, v: int):
    """Apply a velocity reading of the DVL: velocity of the body's origin, v = R_bs z - ω × r, in world axes.

    `dt` is in [s].
    """
    at = measured_at(e, r.dvl_samples.timing[v].latency, step)
    k = at % e.position.shape[2]
    dvl = r.dvl_errors[w, v]
    body_velocity = wp.quat_rotate(dvl.orientation, r.dvl.velocity[w, v]) - wp.cross(
        e.rate[w, v], dvl.position
    )
    off = wp.quat_rotate(e.quaternion[w, v, k], body_velocity) - e.velocity[w, v, k]
    R = measurement_variance(dvl.noise_std, dvl.quantisation) + dvl.bias_initial * dvl.bias_initial
    A = rate_gain(e.plane[w, v], R)
    B = rate_gain(e.height[w, v], R)
    e.plane[w, v] = covariance_after_rate(e.plane[w, v], R)
    e.height[w, v] = covariance_after_rate(e.height[w, v], R)
    dx = wp.cw_mul(wp.vec3(A[0], A[0], B[0]), off)
    correct(e, w, v, at, step, dt, translation_correction(dx, wp.cw_mul(wp.vec3(A[1], A[1], B[1]), off)))


@wp.kernel(enable_backward=False)
def estimate(
    state: State, arrays: TaskArrays, r: InstrumentReadings, e: Estimates, seed: int, mask: wp.array(dtype=int),
    starting: bool, world_offset: int,
):  # fmt: skip
    """Write the estimates of all vehicles after a control step, or those of starting episodes where mask is not 0."""
    i, v = wp.tid()
    w = world_offset + i
    if mask[w] == 0 or state.frozen[w] != 0:
        return
    step = state.steps[w]
    dt = r.control_step
    has_fixes = r.fixes_per_step > wp.float64(0.0)
    if starting:
        initialise(state, r, e, has_fixes, seed, w, v)
    else:
        propagate(r, e, step, dt, w, v)
        if has_fixes:
            update_with_fix(state, r, e, seed, w, v)
        if r.gauge_errors.shape[0] > 0 and r.gauge_samples.fresh[w, v]:
            update_with_depth(r, e, step, dt, w, v)
        if r.dvl_errors.shape[0] > 0 and r.dvl_samples.fresh[w, v]:
            update_with_velocity(r, e, step, dt, w, v)
    k = step % e.position.shape[2]
    q = e.quaternion[w, v, k]
    arrays.position[w, v] = e.position[w, v, k]
    arrays.quaternion[w, v] = q
    arrays.velocity[w, v] = join(wp.quat_rotate_inv(q, e.velocity[w, v, k]), e.rate[w, v])


class SensingBatch:
    """Instruments and filters of all vehicles of all worlds of one environment."""

    def __init__(
        self,
        sensing: Sensing,
        simulator: Simulator,
        arrays: TaskArrays,
        measurement: Packed,
        floor_depth: float | None,
        seed: int,
        drawn: bool,
    ) -> None:
        """Allocate instruments and filters.

        Args:
            sensing: Settings of the fixes.
            simulator: The worlds.
            arrays: Arrays that receive the estimates.
            measurement: Noise of the fixes by (world, vehicle).
            floor_depth: Depth of the floor, for a DVL [m]; the floor is always in range if None.
            seed: Seed of all errors.
            drawn: True if noise and delay of the fixes are randomised.

        Raises:
            EnvironmentSetupError: A vehicle has no IMU.
        """
        for vehicle in simulator.vehicles:
            if vehicle.sensors.imu is None:
                raise EnvironmentSetupError(
                    f"vehicle {vehicle.name} has no IMU for its attitude: give sensors.imu in its "
                    "file, or use another observation"
                )
        self._simulator, self._arrays = simulator, arrays
        dt = simulator.control_step
        self.suite = SensorSuite(
            simulator.vehicles, worlds=simulator.worlds, control_step=dt, seed=seed, device=simulator.device,
            floor_depth=floor_depth,
        )  # fmt: skip
        self.readings, slow = InstrumentReadings(), [0]
        self.readings.fix_errors, self.readings.fixes_per_step = measurement.array, sensing.rate * dt
        self.readings.control_step = dt
        for name, batch in (("imu", self.suite.imu), ("gauge", self.suite.depth), ("dvl", self.suite.dvl)):
            if batch is not None:
                setattr(self.readings, name, batch.arrays)
                setattr(self.readings, f"{name}_errors", batch.parameters)
                setattr(self.readings, f"{name}_samples", batch.sampling)
                if name != "imu":
                    slow.append(int(batch.sampling.timing.numpy()["latency"].max()))
        delay = LONGEST_DELAY if drawn else sensing.fixes.delay
        late = min(max(round(delay / dt), *slow), HISTORY - 1)
        vehicles, past = len(simulator.vehicles), (len(simulator.vehicles), late + 1)
        self.estimates = allocated(
            Estimates, simulator.worlds, simulator.device, position=past, velocity=past, quaternion=past,
            bias=vehicles, rate=vehicles, plane=vehicles, height=vehicles, yaw=vehicles,
        )  # fmt: skip
        filter_constants = [_filter_constants(vehicle, sensing, dt) for vehicle in simulator.vehicles]
        self.estimates.filter_constants = wp.array(
            filter_constants, dtype=FilterConstants, device=simulator.device
        )

    def add(self, pipeline: KernelSequence, seed: int, mask: wp.array | None = None) -> None:
        """Append the update after a control step, or the start of episodes in the worlds where mask is not 0."""
        state, count = self._simulator.state, len(self._simulator.vehicles)
        for batch in self.suite.batches:
            batch.seed = seed
        starting = mask is not None
        stages = self.suite.reset_stages(state, mask) if starting else self.suite.update_stages(state)
        for kernel, inputs in stages:
            pipeline.add(kernel, inputs, vehicles=count)
        worlds_mask = mask if starting else self._simulator._all
        pipeline.add(
            estimate,
            [state, self._arrays, self.readings, self.estimates, seed, worlds_mask, starting],
            vehicles=count,
        )

    def structs(self) -> dict[str, Any]:
        """Return the state that determines later estimates, by name; without the parameters of `suite`."""
        return {"estimates": self.estimates, "readings": self.readings}


def _filter_constants(vehicle: Vehicle, sensing: Sensing, dt: float) -> Any:
    """Return the initial state of the filter of a vehicle, with its covariance after many control steps."""
    sensors, fixes = vehicle.sensors, sensing.fixes
    filter_constants = FilterConstants()
    filter_constants.gauge = sensors.depth is not None
    start = (0.0, 0.0, FASTEST**2)
    plane, height = (wp.vec3(*start) for _ in range(2))
    yaw = wp.vec3(0.0, 0.0, sensors.imu.gyro_bias_initial**2 if sensors.imu else 0.0)
    noise = 0.0 if sensors.imu is None else sensors.imu.gyro_noise_density**2 * sensors.imu.rate * dt
    for step in range(1, STANDING + 1):
        plane, height = (
            propagated_covariance(plane, ACCELERATION[0], dt),
            propagated_covariance(height, ACCELERATION[2], dt),
        )
        yaw = propagated_covariance(yaw, GYRO_WALK**2, dt) + wp.vec3(max(noise, GYRO_FLOOR**2) * dt, 0.0, 0.0)
        came = _due(sensing.rate, step, dt)
        if came:
            R = measurement_variance(fixes.position_std, 0.0) / came
            plane = covariance_after_value(plane, R)
            height = height if filter_constants.gauge else covariance_after_value(height, R)
            yaw = covariance_after_value(yaw, measurement_variance(fixes.yaw_std, 0.0) / came)
        if sensors.depth is not None and _due(sensors.depth.rate, step, dt):
            height = covariance_after_value(
                height, measurement_variance(sensors.depth.noise_std, sensors.depth.quantisation)
            )
        if sensors.dvl is not None and _due(sensors.dvl.rate, step, dt):
            R = (
                measurement_variance(sensors.dvl.noise_std, sensors.dvl.quantisation)
                + sensors.dvl.bias_initial**2
            )
            plane, height = covariance_after_rate(plane, R), covariance_after_rate(height, R)
    if not sensing.rate:  # without fixes, the start is known and only velocities are uncertain
        plane, yaw = wp.vec3(0.0, 0.0, min(plane[2], FASTEST**2)), wp.vec3(0.0, 0.0, yaw[2])
        if not filter_constants.gauge:
            height = wp.vec3(0.0, 0.0, min(height[2], FASTEST**2))
    filter_constants.plane, filter_constants.height, filter_constants.yaw = plane, height, yaw
    return filter_constants


def _due(rate: float, step: int, dt: float) -> int:
    """Return the number of samples due in a control step."""
    return math.floor(step * rate * dt + 1e-6) - math.floor((step - 1) * rate * dt + 1e-6)
