"""Synthetic trials: programmes run in the simulator, measured with noise, logged as by a robot.

Row k of a trial at `rate` has time t_k = k / rate and contains

- the state at t_k: velocity of the body origin, attitude, position, angular rate, and the specific force measured by an
  accelerometer at the IMU's position (later by the sensor's latency if the vehicle's own sensors measure);
- commands that are constant over [t_k, t_k + 1/rate);
- applied inputs (`rpm_*`, `force_*`, `tau_*`, `actuator_*`) at t_k, as in telemetry (they are continuous, since motors
  have a lag).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from finssim.control.allocation import Allocator
from finssim.core.rotations import (
    quat_from_euler,
    quat_inverse_rotate,
    quat_multiply,
    quat_rotate,
    quat_to_euler,
)
from finssim.identification.programme import Programme
from finssim.physics.plant import DERIVED
from finssim.physics.types import vec6
from finssim.sim import Simulator, TetherLine, Water
from finssim.sim.sensors import SensorSuite
from finssim.trials.conversion import EULER, QUATERNION
from finssim.trials.findings import CalibrationError
from finssim.trials.trial import TAU, Header, Trial, TrialWater
from finssim.vehicles import Vehicle, catalogue

__all__ = ["NoiseProfile", "Recording", "record", "simulate_programme", "trials_of"]


Array = NDArray[np.float64]

STEP = 0.005
"""Physics step and interval between recorded states [s]."""


@dataclass(frozen=True, kw_only=True)
class Recording:
    """True motion of some worlds, one programme each, by (step, world)."""

    step: float
    """Interval between states [s]."""
    position: NDArray[np.float32]
    """Body origin, world frame [m], (n, W, 3)."""
    quaternion: NDArray[np.float32]
    """Body to world, xyzw, (n, W, 4)."""
    velocity: NDArray[np.float32]
    """nu [m/s, rad/s], (n, W, 6)."""
    acceleration: NDArray[np.float32]
    """nu_dot [m/s², rad/s²], (n, W, 6)."""
    thrust: NDArray[np.float32]
    """Thrust according to the vehicle file at the propellers' speeds, before a plant's `gain` [N], and the
    values of the other actuators, by channel, (n, W, k)."""
    command: NDArray[np.float32]
    """Command of each channel from this state on: thrust [N], others in their unit, (n, W, k)."""


def record(
    programmes: Sequence[Programme],
    vehicle: Vehicle,
    *,
    seed: int = 0,
    hydrodynamics: str = "calibrated",
    plant: Mapping[str, ArrayLike] | None = None,
    disturbance: ArrayLike = 0.0,
    water: Water | None = None,
    tether: TetherLine | None = None,
    depth: float = 20.0,
    speed: ArrayLike = 0.0,
    spread: float = 1.0,
    each_step: Callable[[Simulator], None] | None = None,
) -> Recording:
    """Simulate the motion that programmes cause, each in one world of a simulator, through motors and allocation.

    Args:
        programmes: Programmes to run, W of them.
        vehicle: The vehicle; its thrusters are commanded by the allocator of `finssim.control.allocation`.
        seed: Seed of the initial conditions.
        hydrodynamics: Key of the vehicle's hydrodynamic sets.
        plant: Differences of the real plant from the file: field of `VehicleParameters` -> value in its unit,
            or one for each world.
        disturbance: Additional wrench about the body origin, body frame [N, N m], (6,) or (W, 6).
        water: Currents and waves; still water if None.
        tether: Tether of the vehicle; none if None.
        depth: Initial depth of the body origin [m].
        speed: Mean initial surge velocity [m/s], one number or (W,).
        spread: Scale of the scatter of the initial conditions around level attitude and zero other velocities: at 1,
            standard deviations of 0.02 m/s, 0.02 rad/s, 0.01 rad of roll and pitch, and any heading.
        each_step: Function that is called before every step, for effects that the engine lacks: it may read
            the simulator's state and write `command.thrust`, `command.disturbance` or plant fields from which
            nothing is derived, such as `gain`.

    Raises:
        CalibrationError: There is no programme, a field of the plant is unknown, or the motion did not stay finite.
    """
    if not programmes:
        raise CalibrationError("no programme to simulate: give at least one")
    worlds, per_command = len(programmes), round(1.0 / (programmes[0].rate * STEP))
    if any(p.rate != programmes[0].rate for p in programmes) or per_command < 1:
        raise CalibrationError(f"programmes need one common rate of at most {1.0 / STEP:g} Hz")
    simulator = Simulator(
        vehicle,
        worlds=worlds,
        hydrodynamics=hydrodynamics,
        control_step=STEP,
        substeps=1,
        integrator="rk4",
        water=water,
        tether=tether,
        seed=seed,
        max_delay=_longest_delay(vehicle, plant),
    )
    _override(simulator, plant or {})
    simulator.command.disturbance.numpy()[:, 0] = np.asarray(disturbance)
    _start(simulator, depth, speed, spread, seed)
    command = np.repeat(_commands(programmes, vehicle), per_command, axis=0)
    n, thrusters, k = len(command) + 1, len(vehicle.thrusters), len(vehicle.channel_names)
    applied = np.zeros((n, worlds, k), dtype=np.float32)
    shapes = {"position": 3, "quaternion": 4, "velocity": 6, "acceleration": 6, "actuator": k}
    states = {name: np.empty((n, worlds, size), dtype=np.float32) for name, size in shapes.items()}
    thrust = simulator.command.thrust.numpy()[:, 0]
    views = [(out, simulator.numpy(name)[:, 0, : shapes[name]]) for name, out in states.items()]
    for i in range(n):
        if i > 0:
            thrust[:, :thrusters] = command[i - 1]
            if each_step is not None:
                each_step(simulator)
            applied[i - 1] = thrust[:, :k]
            simulator.step()
        for out, view in views:
            out[i] = view
    if len(simulator.frozen_worlds()):
        first = programmes[int(simulator.frozen_worlds()[0])].name
        raise CalibrationError(f"{first}: the motion did not stay finite; give lower levels")
    # There is no acceleration before the first step; that of the start is the first one after it.
    states["acceleration"][0] = states["acceleration"][1]
    nominal = _nominal_thrust(states.pop("actuator"), vehicle, bool(simulator.plant.speed_lag.numpy().any()))
    applied[-1] = applied[-2]
    return Recording(step=STEP, thrust=nominal, command=applied, **states)


def _longest_delay(vehicle: Vehicle, plant: Mapping[str, ArrayLike] | None) -> float:
    longest = max(t.delay for t in vehicle.thrusters.values())
    return max(longest, float(np.max((plant or {}).get("delay", 0.0))))


def _override(simulator: Simulator, plant: Mapping[str, ArrayLike]) -> None:
    """Write fields of the plant and update the fields derived from them."""
    for name, value in plant.items():
        if name not in simulator.plant.fields or name in DERIVED:
            available = ", ".join(f for f in simulator.plant.fields if f not in DERIVED)
            raise CalibrationError(f"plant has no field '{name}'; available: {available}")
        view = simulator.plant.fields[name].numpy()[:, 0]
        try:
            view[...] = np.asarray(value)
        except ValueError:
            raise CalibrationError(
                f"plant.{name} has shape {np.shape(value)}, expected {view.shape[1:]} or that for each world"
            ) from None
    simulator.refresh()


def _start(simulator: Simulator, depth: float, speed: ArrayLike, spread: float, seed: int) -> None:
    rng = np.random.default_rng([seed, 1])
    worlds = simulator.worlds
    tilt = 0.01 * spread * rng.standard_normal((2, worlds))
    yaw = spread * rng.uniform(-np.pi, np.pi, worlds)
    velocity = 0.02 * spread * rng.standard_normal((worlds, 6))
    velocity[:, 0] += speed
    simulator.place(
        position=(0.0, 0.0, -depth),
        quaternion=quat_from_euler(tilt[0], tilt[1], yaw)[:, None],
        velocity=velocity[:, None],
    )


def _commands(programmes: Sequence[Programme], vehicle: Vehicle) -> NDArray[np.float32]:
    """Return thrusts by (row, world, thruster) [N] as produced by the speed controllers, zero after the end
    of a programme."""
    allocator = Allocator.from_vehicle(vehicle)
    length = max(len(p.phase) for p in programmes)
    tau = np.zeros((length, len(programmes), 6))
    for w, programme in enumerate(programmes):
        tau[: len(programme.phase), w] = programme.tau_desired
    distinct, index = np.unique(tau.reshape(-1, 6), axis=0, return_inverse=True)
    thrust = allocator.allocate(distinct)
    # The allocator leaves rounding errors where the requested wrench is zero.
    thrust[~distinct.any(axis=1)] = 0.0
    for k, thruster in enumerate(vehicle.thrusters.values()):
        if thruster.esc is not None:  # the controller cannot turn the shaft slowly
            pulse = thruster.pulse(thruster.speed(thrust[:, k]))
            thrust[:, k] = thruster.thrust(thruster.shaft_speed(pulse))
    return np.asarray(thrust[index.ravel()].reshape(length, len(programmes), -1), dtype=np.float32)


def _nominal_thrust(actuator: NDArray[np.float32], vehicle: Vehicle, speeds: bool) -> NDArray[np.float32]:
    """Return thrusts from the lagged quantity in the simulator, force or shaft speed; other actuators are
    unchanged."""
    out = actuator.copy()
    for k, thruster in enumerate(vehicle.thrusters.values() if speeds else ()):
        out[..., k] = thruster.thrust(actuator[..., k])
    return out


# Measurement of a true motion: noise profiles for synthetic trials.


@dataclass(frozen=True, kw_only=True)
class NoiseProfile:
    """Errors of the measurements of a trial; standard deviations are per logged sample."""

    own_sensors: bool = False
    """True to use the vehicle file's IMU and depth sensor: rate, noise, bias, quantisation, latency, dropout."""
    velocity_std: float = 0.0
    """Standard deviation of externally measured u, v, w [m/s]."""
    attitude_std: float = 0.0
    """Standard deviation of roll and pitch [rad]."""
    yaw_std: float = 0.0
    """Standard deviation of the yaw [rad]."""
    position_std: float = 0.0
    """Standard deviation of x, y, z [m]."""
    depth_std: float = 0.0
    """Standard deviation of the depth, if the vehicle's own sensor is not used [m]."""
    gyro_std: float = 0.0
    """Standard deviation of the gyro, if the vehicle's own IMU is not used [rad/s]."""
    accel_std: float = 0.0
    """Standard deviation of the accelerometer, if the vehicle's own IMU is not used [m/s²]."""
    velocity_window: float | None = None
    """Window of local parabolas by which u, v, w are computed from measured position, depth and attitude [s],
    as by an offline smoother; `velocity_std` is then unused."""

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
"""`sensors`: the vehicle's own IMU and pressure sensor, and an external velocity of 1 cm/s; `published`: the fusion
settings that FinsROV's software was published with, which exceed any actual noise; `none`: the truth."""


class _Recorded:
    """Arrays that a `SensorSuite` reads, filled from a recording."""

    def __init__(self, recording: Recording) -> None:
        worlds = recording.velocity.shape[1]
        shape = (worlds, 1)
        self.position = wp.zeros(shape, dtype=wp.vec3, device="cpu")
        self.quaternion = wp.zeros(shape, dtype=wp.quat, device="cpu")
        self.velocity = wp.zeros(shape, dtype=vec6, device="cpu")
        self.acceleration = wp.zeros(shape, dtype=vec6, device="cpu")
        self.steps = wp.zeros(worlds, dtype=wp.int32, device="cpu")
        self.episode = wp.ones(worlds, dtype=wp.int32, device="cpu")
        fields = ("position", "quaternion", "velocity", "acceleration")
        self._views = [(getattr(self, name).numpy()[:, 0], getattr(recording, name)) for name in fields]
        self._clock = self.steps.numpy()

    def show(self, step: int) -> None:
        """Copy the state of one step to the arrays."""
        for view, values in self._views:
            view[...] = values[step]
        self._clock[...] = step


def measure(
    recording: Recording, vehicle: Vehicle, noise: NoiseProfile, *, every: int, seed: int
) -> dict[str, Array]:
    """Return measured columns of all worlds of a recording at every `every`-th step.

    Args:
        recording: The true motion.
        vehicle: Vehicle with the sensors.
        noise: Errors of the measurements.
        every: Number of steps between rows.
        seed: Seed of all errors.

    Returns:
        Canonical column -> values in the unit of the column (rows, worlds); NaN where a sensor had no new sample.
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
    out: dict[str, Array] = {name: q_measured[..., i] for i, name in enumerate(QUATERNION)}
    out |= dict(zip(EULER, quat_to_euler(q_measured), strict=True))
    out |= {name: x_measured[..., i] for i, name in enumerate("xyz")}
    rates, force, depth = _sensor_channels(recording, vehicle, noise, every, seed)
    if depth is None:
        at = vehicle.sensors.depth.position if vehicle.sensors.depth else np.zeros(3)
        depth = -(x + quat_rotate(q, np.broadcast_to(at, x.shape)))[..., 2] + error(noise.depth_std)
    if rates is None or force is None:
        rates = nu[..., 3:] + error(noise.gyro_std, 3)
        force = _specific_force(recording, vehicle, every) + error(noise.accel_std, 3)
    out["depth"] = depth
    out |= {name: rates[..., i] for i, name in enumerate("pqr")}
    out |= {f"a{name}": force[..., i] for i, name in enumerate("xyz")}
    if noise.velocity_window is None:
        velocity = nu[..., :3] + error(noise.velocity_std, 3)
    else:
        velocity = _from_position(x_measured, q_measured, noise.velocity_window, recording.step * every)
    return out | {name: velocity[..., i] for i, name in enumerate("uvw")}


def _sensor_channels(
    recording: Recording, vehicle: Vehicle, noise: NoiseProfile, every: int, seed: int
) -> tuple[Array | None, Array | None, Array | None]:
    """Rates, specific force and depth by the vehicle's own sensors, the newest sample since the last row; None where
    they do not measure."""
    if not noise.own_sensors:
        return None, None, None
    steps, worlds = recording.velocity.shape[:2]
    state = _Recorded(recording)
    suite = SensorSuite(vehicle, worlds=worlds, control_step=recording.step, seed=seed)
    rows = len(range(0, steps, every))
    gyro, accel = np.full((rows, worlds, 3), np.nan), np.full((rows, worlds, 3), np.nan)
    depth = np.full((rows, worlds), np.nan)
    readings: list[tuple[Array, Array, Array]] = []
    """Return which worlds have a new sample, the samples, and the rows that receive them."""
    if (imu := suite.imu) is not None:
        readings += [
            (imu.fresh.numpy(), imu.gyro.numpy(), gyro),
            (imu.fresh.numpy(), imu.accel.numpy(), accel),
        ]
    if suite.depth is not None:
        readings.append((suite.depth.fresh.numpy(), suite.depth.depth.numpy(), depth))
    update = suite.launches(state)
    for step in range((rows - 1) * every + 1):
        state.show(step)
        if step == 0:
            suite.reset(state)
        else:
            for launch in update:
                launch.launch()
        row = -(-step // every)
        for fresh, samples, out in readings:
            now = fresh[:, 0]
            out[row, now] = samples[now, 0]
    measured_depth = None if suite.depth is None else depth
    if vehicle.sensors.imu is None:
        return None, None, measured_depth
    q_bs = np.broadcast_to(vehicle.sensors.imu.orientation, (rows, worlds, 4))
    return quat_rotate(q_bs, gyro), quat_rotate(q_bs, accel), measured_depth


def _specific_force(recording: Recording, vehicle: Vehicle, every: int) -> Array:
    """Return the reading of an ideal accelerometer at the IMU's position, body axes [m/s²]."""
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
    """Return the body velocity from measured positions and attitudes by local parabolas over a window [m/s]."""
    from scipy.signal import savgol_filter

    n = max(3, 2 * round(0.5 * window / interval) + 1)
    n = min(n, len(x) - 1 + len(x) % 2)
    v = savgol_filter(x, n, 2, deriv=1, delta=interval, axis=0, mode="interp")
    # q and -q are the same attitude: choose signs so that the numbers are continuous, also after a full turn.
    jump = np.where(np.sum(q[1:] * q[:-1], axis=-1, keepdims=True) < 0.0, -1.0, 1.0)
    q = np.concatenate([q[:1], q[1:] * np.cumprod(jump, axis=0)])
    smooth = savgol_filter(q, n, 2, axis=0, mode="interp")
    smooth = smooth / np.linalg.norm(smooth, axis=-1, keepdims=True)
    return np.asarray(quat_inverse_rotate(smooth, v))


DEFAULT_COLUMNS = (
    *("u", "v", "w", "p", "q", "r", "ax", "ay", "az"),
    *("qx", "qy", "qz", "qw", "x", "y", "z", "depth"),
)
"""Measured columns of a synthetic trial."""

Input = Literal["rpm", "force", "wrench", "pwm", "command"]


def simulate_programme(
    programmes: Sequence[Programme], vehicle: Vehicle, *, seed: int = 0, **options: Any
) -> list[Trial]:
    """Return trials of a vehicle, one for each programme: `record` followed by `trials_of`.

    Args:
        programmes: Programmes to run.
        vehicle: The vehicle, as its file describes it.
        seed: Seed of initial conditions and noise; equal seeds give equal trials.
        options: Arguments of `trials_of` (noise, rate, columns, inputs) and of `record` (hydrodynamics,
            plant, disturbance, water, tether, depth, speed, spread).

    Raises:
        CalibrationError: An argument is invalid.
    """
    measured = {name: options.pop(name) for name in MEASURED & options.keys()}
    recording = record(programmes, vehicle, seed=seed, **options)
    if (water := options.get("water")) is not None and any(water.current):
        measured["current"] = tuple(water.current)
    return trials_of(recording, programmes, vehicle, seed=seed, **measured)


MEASURED = {"noise", "rate", "columns", "inputs"}
"""Arguments of `simulate_programme` that specify the measurement of the motion."""


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
    current: tuple[float, float, float] | None = None,
) -> list[Trial]:
    """Return trials that measure a recording.

    Another call with another seed returns the same motion with other noise.

    Args:
        recording: The true motion.
        programmes: Programmes that were run.
        vehicle: Vehicle with the sensors.
        noise: Noise profile or its name.
        seed: Seed of the noise.
        rate: Rate of the rows [Hz].
        columns: Measured columns to log; `DEFAULT_COLUMNS` if None.
        inputs: Inputs to log.
        current: Water velocity in the header, world frame [m/s].

    Raises:
        CalibrationError: A rate, column, input or profile is invalid.
    """
    if isinstance(noise, str) and noise not in NOISE_PROFILES:
        raise CalibrationError(f"unknown noise '{noise}'; available: {', '.join(NOISE_PROFILES)}")
    profile = NOISE_PROFILES[noise] if isinstance(noise, str) else noise
    every = round(1.0 / (rate * recording.step)) if rate > 0.0 else 0
    if every < 1 or abs(every * recording.step * rate - 1.0) > 1e-6:
        raise CalibrationError(f"rate is {rate:g} Hz, expected {1.0 / recording.step:g} Hz over an integer")
    chosen = DEFAULT_COLUMNS if columns is None else tuple(columns)
    measured = measure(recording, vehicle, profile, every=every, seed=seed)
    for name in chosen:
        if name not in measured:
            raise CalibrationError(
                f"synthetic trials have no column '{name}'; available: {', '.join(measured)}"
            )
    logged = _inputs(recording, vehicle, inputs, every) | {name: measured[name] for name in chosen}
    named = vehicle.name
    if vehicle.path is not None and vehicle.name not in catalogue():
        named = str(vehicle.path.resolve())
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
                channels={name: values[: len(t), w].copy() for name, values in logged.items()},
                phase=programme.phase[rows],
                header=Header(
                    vehicle=named,
                    axis=programme.axes,
                    description=f"simulated: {programme.name}",
                    inputs="commanded" if set(inputs) <= {"command", "pwm"} else "applied",
                    acceleration="specific_force",
                    water=water,
                ),
            )
        )
    return out


def _inputs(recording: Recording, vehicle: Vehicle, inputs: Sequence[str], every: int) -> dict[str, Array]:
    """Return the input columns, (rows, W) each."""
    for name in inputs:
        if name not in get_args(Input):
            raise CalibrationError(f"unknown input '{name}'; available: {', '.join(get_args(Input))}")
    thrust = recording.thrust[::every].astype(float)
    command = recording.command[::every].astype(float)
    out: dict[str, Array] = {}
    thrusters = list(enumerate(vehicle.thrusters.items()))
    if "rpm" in inputs:
        turns = 60.0 / (2.0 * np.pi)
        out |= {f"rpm_{name}": thruster.speed(thrust[..., k]) * turns for k, (name, thruster) in thrusters}
    if "force" in inputs:
        out |= {f"force_{name}": thrust[..., k] for k, (name, _) in thrusters}
    if "wrench" in inputs:
        tau = thrust[..., : len(thrusters)] @ vehicle.control_matrix.T
        out |= {name: tau[..., i] for i, name in enumerate(TAU)}
    if "command" in inputs:
        out |= {f"command_{name}": command[..., k] for k, (name, _) in thrusters}
    if "pwm" in inputs:
        out |= {
            f"pwm_{name}": thruster.pulse(thruster.speed(command[..., k]))
            for k, (name, thruster) in thrusters
        }
    values = command if set(inputs) <= {"command", "pwm"} else thrust
    others = enumerate(vehicle.actuators, start=len(thrusters))
    return out | {f"actuator_{name}": values[..., k] for k, name in others}


def _end(programme: Programme, recording: Recording, world: int) -> float:
    """Return the end of the trial [s]: that of the programme, or of the part of the coast with a steady ascent."""
    if programme.ascent_speed is None:
        return programme.duration
    t = np.arange(len(recording.position)) * recording.step
    coasting = np.flatnonzero(programme.phase == "coast") / programme.rate
    height = recording.position[:, world, 2].astype(float)
    rising = np.gradient(height, recording.step) > programme.ascent_speed
    since = np.where((t >= coasting[0]) & rising, t, np.inf)
    settled = float(since.min()) + programme.ascent_time
    return min(programme.duration, settled)
