"""Synthetic trials: programmes run in the simulator, measured with noise, logged as a robot would log them.

Time stamps. Row k of a trial at `rate` has time t_k = k / rate and holds

- the state at t_k: velocity of the body origin, attitude, position, angular rate, and what an accelerometer at the
  IMU's place reads at t_k (later by the sensor's latency where the vehicle's own sensors measure);
- commands that are held over [t_k, t_k + 1/rate);
- applied inputs (`rpm_*`, `force_*`, `tau_*`) as `sampling` says: `instant`, the value at t_k, as telemetry gives it
  (motors lag, so they are continuous); or `held`, the mean over [t_k, t_k + 1/rate), the impulse of the row.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.excitation.programmes import Programme
from finssim.calibration.excitation.recording import Recording, record
from finssim.calibration.trials.header import Header, TrialWater
from finssim.calibration.trials.trial import TAU, Trial
from finssim.geometry.rotations import (
    quat_from_euler,
    quat_inverse_rotate,
    quat_multiply,
    quat_rotate,
    quat_to_euler,
)
from finssim.physics.types import vec6
from finssim.sensors import SensorSuite
from finssim.vehicles import Vehicle

__all__ = ["DEFAULT_COLUMNS", "NOISE_PROFILES", "NoiseProfile", "simulate_programme", "trials_of"]

# What sensors make of a true motion: noise profiles for synthetic trials.


@dataclass(frozen=True, kw_only=True)
class NoiseProfile:
    """Errors of the measurements of a trial; standard deviations are per logged sample."""

    own_sensors: bool = False
    """IMU and depth as the vehicle file's sensors give them: rate, noise, bias, quantisation, latency, dropout."""
    velocity_std: float = 0.0
    """Of u, v, w from outside [m/s]."""
    attitude_std: float = 0.0
    """Of roll and pitch [rad]."""
    yaw_std: float = 0.0
    """[rad]"""
    position_std: float = 0.0
    """Of x, y, z [m]."""
    depth_std: float = 0.0
    """Where the vehicle's own sensor is not used [m]."""
    gyro_std: float = 0.0
    """Where the vehicle's own IMU is not used [rad/s]."""
    accel_std: float = 0.0
    """Where the vehicle's own IMU is not used [m/s²]."""
    velocity_window: float | None = None
    """u, v, w come from measured position, depth and attitude by local parabolas over this time [s], as an offline
    smoother makes them; `velocity_std` is then not used."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, float) and not (math.isfinite(value) and value >= 0.0):
                raise CalibrationError(f"noise: {field.name} is {value}, expected a finite number from 0 on")


NOISE_PROFILES: dict[str, NoiseProfile] = {
    "none": NoiseProfile(),
    "sensors": NoiseProfile(
        own_sensors=True, velocity_std=0.01, attitude_std=0.005, yaw_std=0.005, position_std=0.01
    ),
    "published": NoiseProfile(
        attitude_std=0.02,
        yaw_std=0.2,
        position_std=0.05,
        depth_std=0.05,
        gyro_std=0.1,
        accel_std=0.32,
        velocity_window=1.0,
    ),
}
"""`sensors`: the vehicle's own IMU and pressure sensor, and a velocity from outside of 1 cm/s; `published`: the fusion
settings that FinsROV's software was published with, which are larger than any noise; `none`: the truth."""


class _Recorded:
    """Arrays that a `SensorSuite` reads, filled from a recording."""

    def __init__(self, worlds: int) -> None:
        shape = (worlds, 1)
        self.position = wp.zeros(shape, dtype=wp.vec3, device="cpu")
        self.quaternion = wp.zeros(shape, dtype=wp.quat, device="cpu")
        self.velocity = wp.zeros(shape, dtype=vec6, device="cpu")
        self.acceleration = wp.zeros(shape, dtype=vec6, device="cpu")
        self.steps = wp.zeros(worlds, dtype=wp.int32, device="cpu")
        self.episode = wp.ones(worlds, dtype=wp.int32, device="cpu")

    def show(self, step: int, recording: Recording) -> None:
        """Put the state of one step there."""
        for name in ("position", "quaternion", "velocity", "acceleration"):
            getattr(self, name).numpy()[:, 0] = getattr(recording, name)[step]
        self.steps.fill_(step)


def measure(
    recording: Recording, vehicle: Vehicle, noise: NoiseProfile, *, every: int, seed: int
) -> dict[str, Array]:
    """Measured columns of all worlds of a recording at every `every`-th step.

    Args:
        recording: The true motion.
        vehicle: Whose sensors measure.
        noise: Errors.
        every: Steps between rows.
        seed: Of all errors.

    Returns:
        Canonical column -> values (rows, worlds); NaN where a sensor had no new sample.
    """
    rng = np.random.default_rng(seed)
    nu = recording.velocity[::every].astype(float)
    q = recording.quaternion[::every].astype(float)
    x = recording.position[::every].astype(float)
    shape = nu.shape[:2]

    def error(std: float, *tail: int) -> Array:
        return std * rng.standard_normal((*shape, *tail))

    # Roll and pitch errors are about body axes, the yaw error about the world's vertical.
    tilt = quat_from_euler(error(noise.attitude_std), error(noise.attitude_std), 0.0)
    heading = quat_from_euler(0.0, 0.0, error(noise.yaw_std))
    q_measured = quat_multiply(heading, quat_multiply(q, tilt))
    x_measured = x + error(noise.position_std, 3)
    out: dict[str, Array] = {}
    for i, name in enumerate(("qx", "qy", "qz", "qw")):
        out[name] = q_measured[..., i]
    out |= dict(zip(("roll", "pitch", "yaw"), quat_to_euler(q_measured), strict=True))
    for i, name in enumerate("xyz"):
        out[name] = x_measured[..., i]
    out |= _own_sensors(recording, vehicle, noise, every, seed)
    if "depth" not in out:
        at = vehicle.sensors.depth.position if vehicle.sensors.depth else np.zeros(3)
        out["depth"] = -(x + quat_rotate(q, np.broadcast_to(at, x.shape)))[..., 2] + error(noise.depth_std)
    if "p" not in out:
        rates = nu[..., 3:] + error(noise.gyro_std, 3)
        force = _specific_force(recording, vehicle, every) + error(noise.accel_std, 3)
        out |= {name: rates[..., i] for i, name in enumerate("pqr")}
        out |= {f"a{name}": force[..., i] for i, name in enumerate("xyz")}
    if noise.velocity_window is None:
        velocity = nu[..., :3] + error(noise.velocity_std, 3)
    else:
        velocity = _from_position(x_measured, q_measured, noise.velocity_window, recording.step * every)
    return out | {name: velocity[..., i] for i, name in enumerate("uvw")}


def _own_sensors(
    recording: Recording, vehicle: Vehicle, noise: NoiseProfile, every: int, seed: int
) -> dict[str, Array]:
    """IMU and depth through the vehicle's own sensors: at each row the newest sample since the last."""
    if not noise.own_sensors:
        return {}
    steps, worlds = recording.velocity.shape[:2]
    state = _Recorded(worlds)
    suite = SensorSuite(vehicle, worlds=worlds, control_step=recording.step, seed=seed)
    rows = len(range(0, steps, every))
    gyro, accel = np.full((rows, worlds, 3), np.nan), np.full((rows, worlds, 3), np.nan)
    depth = np.full((rows, worlds), np.nan)
    for step in range((rows - 1) * every + 1):
        state.show(step, recording)
        (suite.reset if step == 0 else suite.update)(state)
        row = -(-step // every)
        if suite.imu is not None:
            fresh = suite.imu.fresh.numpy()[:, 0]
            gyro[row, fresh] = suite.imu.gyro.numpy()[fresh, 0]
            accel[row, fresh] = suite.imu.accel.numpy()[fresh, 0]
        if suite.depth is not None:
            fresh = suite.depth.fresh.numpy()[:, 0]
            depth[row, fresh] = suite.depth.depth.numpy()[fresh, 0]
    out: dict[str, Array] = {}
    if vehicle.sensors.imu is not None:
        q_bs = np.broadcast_to(vehicle.sensors.imu.orientation, (rows, worlds, 4))
        gyro, accel = quat_rotate(q_bs, gyro), quat_rotate(q_bs, accel)
        out |= {name: gyro[..., i] for i, name in enumerate("pqr")}
        out |= {f"a{name}": accel[..., i] for i, name in enumerate("xyz")}
    if vehicle.sensors.depth is not None:
        out["depth"] = depth
    return out


def _specific_force(recording: Recording, vehicle: Vehicle, every: int) -> Array:
    """What an ideal accelerometer at the IMU's place reads, body axes [m/s²]: see `finssim.sensors.imu`."""
    nu, nu_dot = recording.velocity[::every].astype(float), recording.acceleration[::every].astype(float)
    q = recording.quaternion[::every].astype(float)
    imu = vehicle.sensors.imu
    r = np.broadcast_to(imu.position if imu else np.zeros(3), nu[..., :3].shape)
    omega = nu[..., 3:]
    a = nu_dot[..., :3] + np.cross(omega, nu[..., :3])
    a = a + np.cross(nu_dot[..., 3:], r) + np.cross(omega, np.cross(omega, r))
    up = quat_inverse_rotate(q, np.broadcast_to([0.0, 0.0, 1.0], r.shape))
    return np.asarray(a + vehicle.water.gravity * up)


def _from_position(x: Array, q: Array, window: float, interval: float) -> Array:
    """Body velocity from measured positions and attitudes by local parabolas over a window [m/s]."""
    from scipy.signal import savgol_filter

    n = max(3, 2 * round(0.5 * window / interval) + 1)
    n = min(n, len(x) - 1 + len(x) % 2)
    v = savgol_filter(x, n, 2, deriv=1, delta=interval, axis=0, mode="interp")
    # q and -q are one attitude: choose signs so that the numbers do not jump, also after a whole turn.
    jump = np.where(np.sum(q[1:] * q[:-1], axis=-1, keepdims=True) < 0.0, -1.0, 1.0)
    q = np.concatenate([q[:1], q[1:] * np.cumprod(jump, axis=0)])
    smooth = savgol_filter(q, n, 2, axis=0, mode="interp")
    smooth = smooth / np.linalg.norm(smooth, axis=-1, keepdims=True)
    return np.asarray(quat_inverse_rotate(smooth, v))


Array = NDArray[np.float64]

DEFAULT_COLUMNS = (
    *("u", "v", "w", "p", "q", "r", "ax", "ay", "az"),
    *("qx", "qy", "qz", "qw", "x", "y", "z", "depth"),
)
"""Measured columns of a synthetic trial."""

INPUTS = ("rpm", "force", "wrench", "pwm", "command")

Input = Literal["rpm", "force", "wrench", "pwm", "command"]


def simulate_programme(
    programmes: Sequence[Programme],
    vehicle: Vehicle,
    *,
    noise: NoiseProfile | str = "sensors",
    seed: int = 0,
    rate: float = 50.0,
    columns: Sequence[str] | None = None,
    inputs: Sequence[Input] = ("rpm", "wrench"),
    sampling: Literal["instant", "held"] = "instant",
    **plant: Any,
) -> list[Trial]:
    """Trials of a vehicle, one for each programme: `record` and then `trials_of`.

    Args:
        programmes: What to run.
        vehicle: The vehicle, whose file says what it believes of itself.
        noise: A profile or the name of one.
        seed: Of initial conditions and noise; equal seeds give equal trials.
        rate: Of the rows [Hz].
        columns: Measured columns to log; `DEFAULT_COLUMNS` if None.
        inputs: Which inputs to log.
        sampling: See the module.
        plant: As for `record`: hydrodynamics, plant, disturbance, water, pool, tether, depth, spread, threads.

    Raises:
        CalibrationError: An argument that cannot be.
    """
    recording = record(programmes, vehicle, seed=seed, **plant)
    water = plant.get("water")
    return trials_of(
        recording,
        programmes,
        vehicle,
        noise=noise,
        seed=seed,
        rate=rate,
        columns=columns,
        inputs=inputs,
        sampling=sampling,
        current=tuple(water.current) if water is not None and any(water.current) else None,
    )


def trials_of(
    recording: Recording,
    programmes: Sequence[Programme],
    vehicle: Vehicle,
    *,
    noise: NoiseProfile | str = "sensors",
    seed: int = 0,
    rate: float = 50.0,
    columns: Sequence[str] | None = None,
    inputs: Sequence[Input] = ("rpm", "wrench"),
    sampling: Literal["instant", "held"] = "instant",
    current: tuple[float, float, float] | None = None,
) -> list[Trial]:
    """Trials that measure a recording; arguments as for `simulate_programme`.

    Calling it again with another seed gives the same motion with other noise.

    Args:
        current: What the header says of the water's velocity, world frame [m/s].

    Raises:
        CalibrationError: A rate, column, input or profile that cannot be.
    """
    profile = _profile(noise)
    every = round(1.0 / (rate * recording.step)) if rate > 0.0 else 0
    if every < 1 or abs(every * recording.step * rate - 1.0) > 1e-6:
        raise CalibrationError(
            f"rate is {rate:g} Hz, expected {1.0 / recording.step:g} Hz over a whole number"
        )
    chosen = DEFAULT_COLUMNS if columns is None else tuple(columns)
    measured = measure(recording, vehicle, profile, every=every, seed=seed)
    for name in chosen:
        if name not in measured:
            raise CalibrationError(
                f"synthetic trials have no column '{name}'; available: {', '.join(measured)}"
            )
    logged = _inputs(recording, vehicle, inputs, every, sampling)
    water = TrialWater(current=current) if current is not None else TrialWater()
    out = []
    for w, programme in enumerate(programmes):
        end = _end(programme, recording, w)
        t = np.arange(0.0, end - 1e-9, 1.0 / rate)
        rows = np.minimum(np.floor(t * programme.rate + 1e-6).astype(int), len(programme.phase) - 1)
        out.append(
            Trial(
                name=programme.name,
                t=t,
                channels={name: logged[name][: len(t), w].copy() for name in logged}
                | {name: measured[name][: len(t), w].copy() for name in chosen},
                phase=programme.phase[rows],
                header=Header(
                    vehicle=vehicle.name,
                    axis=programme.axes,
                    description=f"simulated: {programme.name}",
                    inputs="commanded" if set(inputs) <= {"command", "pwm"} else "applied",
                    inputs_between="held" if sampling == "held" else None,
                    acceleration="specific_force",
                    water=water,
                ),
            )
        )
    return out


def _profile(noise: NoiseProfile | str) -> NoiseProfile:
    if isinstance(noise, NoiseProfile):
        return noise
    if noise not in NOISE_PROFILES:
        raise CalibrationError(f"unknown noise '{noise}'; available: {', '.join(NOISE_PROFILES)}")
    return NOISE_PROFILES[noise]


def _inputs(
    recording: Recording, vehicle: Vehicle, inputs: Sequence[str], every: int, sampling: str
) -> dict[str, Array]:
    """Input columns, (rows, W) each."""
    for name in inputs:
        if name not in INPUTS:
            raise CalibrationError(f"unknown input '{name}'; available: {', '.join(INPUTS)}")
    thrust = recording.thrust.astype(float)
    if sampling == "held":
        # Thrust is linear between states, to second order in the step: the mean is the trapezoid's.
        rows = (len(thrust) - 1) // every
        middle = 0.5 * (thrust[1:] + thrust[:-1])[: rows * every]
        thrust = middle.reshape(rows, every, *thrust.shape[1:]).mean(axis=1)
    else:
        thrust = thrust[::every]
    command = recording.command[::every].astype(float)
    out: dict[str, Array] = {}
    names = vehicle.thruster_names
    if "rpm" in inputs:
        out |= {f"rpm_{name}": _rpm(thrust[..., k], vehicle, k) for k, name in enumerate(names)}
    if "force" in inputs:
        out |= {f"force_{name}": thrust[..., k] for k, name in enumerate(names)}
    if "wrench" in inputs:
        tau = thrust @ vehicle.control_matrix.T
        out |= {name: tau[..., i] for i, name in enumerate(TAU)}
    if "command" in inputs:
        out |= {f"command_{name}": command[..., k] for k, name in enumerate(names)}
    if "pwm" in inputs:
        out |= {f"pwm_{name}": _pulse(command[..., k], vehicle, k) for k, name in enumerate(names)}
    return out


def _rpm(thrust: Array, vehicle: Vehicle, k: int) -> Array:
    """Shaft speed at which the file says thruster k gives a thrust [rpm]."""
    return vehicle.thrusters[vehicle.thruster_names[k]].speed(thrust) * (60.0 / (2.0 * np.pi))


def _pulse(thrust: Array, vehicle: Vehicle, k: int) -> Array:
    """Pulse width at which the file says thruster k gives a thrust [µs]."""
    thruster = vehicle.thrusters[vehicle.thruster_names[k]]
    return thruster.pulse(thruster.speed(thrust))


def _end(programme: Programme, recording: Recording, world: int) -> float:
    """When the trial ends [s]: with the programme, or with the part of the coast that shows a steady ascent."""
    if programme.ascent_speed is None:
        return programme.duration
    t = np.arange(len(recording.position)) * recording.step
    coasting = np.flatnonzero(programme.phase == "coast") / programme.rate
    rising = (
        np.gradient(recording.position[:, world, 2].astype(float), recording.step) > programme.ascent_speed
    )
    since = np.where((t >= coasting[0]) & rising, t, np.inf)
    found = float(since.min()) + programme.ascent_time
    return min(programme.duration, found)
