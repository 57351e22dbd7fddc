"""Program of the motor controller: commands in, target speeds out, telemetry and echoes on the link."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.pool.plant import RPM, Plant, captured
from finssim.pool.plant_spec import Instruments, PlantSpec
from finssim.robot.links.frames import (
    DEBUG_ECHO,
    MCU,
    DebugConfig,
    Decoder,
    RejectFlag,
    StatusFlag,
    crc16_modbus,
    encode_command,
    encode_echo,
    encode_navigation,
)
from finssim.robot.messages import HEADING, VELOCITY, CommandEcho, NavigationAid, Telemetry, ThrusterCommand
from finssim.sim.sensors import SensorSuite
from finssim.vehicles import Vehicle

if TYPE_CHECKING:
    from finssim.pool.virtual_pool import Faults

__all__ = ["AttitudeFilter", "Firmware", "PoolSensors", "FirmwareSample"]


# Instruments of the vehicle: the simulator's IMU and pressure gauge, sampled on the motor controller's clock.


IMU_ERRORS = (
    "gyro_noise_density",
    "gyro_bias_walk",
    "gyro_bias_initial",
    "accel_noise_density",
    "accel_bias_walk",
    "accel_bias_initial",
)


class FirmwareSample(NamedTuple):
    """Readings of the motor controller at one time."""

    gyro: tuple[float, float, float]
    """Angular velocity, IMU frame [rad/s]."""
    accel: tuple[float, float, float]
    """Specific force, IMU frame [m/s²]."""
    depth: float
    """Depth of the pressure port, positive down [m]."""
    pressure: float
    """Absolute pressure [Pa]."""


class PoolSensors:
    """IMU and pressure gauge of one plant; `sample` reads both once per period of the IMU."""

    def __init__(self, plant: Plant, seed: int) -> None:
        """Power the sensors on: this draws their turn-on biases.

        Args:
            plant: Plant that they measure.
            seed: Seed of their errors.
        """
        self.period = 1.0 / plant.vehicle.sensors.imu.rate  # type: ignore[union-attr]
        """Sampling period [s]."""
        vehicle = with_instruments(plant.vehicle, plant.spec.instruments)
        key = int(np.random.SeedSequence([seed, 72]).generate_state(1)[0] >> 1)
        floor = plant.spec.basin.depth
        suite = SensorSuite(vehicle, worlds=1, control_step=self.period, seed=key, floor_depth=floor)
        state = plant.simulator.state
        self._state = SimpleNamespace(
            position=state.position,
            quaternion=state.quaternion,
            velocity=state.velocity,
            acceleration=state.acceleration,
            steps=wp.zeros(1, dtype=int, device="cpu"),
            episode=wp.zeros(1, dtype=int, device="cpu"),
        )
        suite.reset(self._state)
        self._update, self._suite = captured(lambda: suite.update(self._state)), suite
        self._count: Any = self._state.steps.numpy()

        def view(readings: Any) -> Any:
            return readings.numpy()[0]

        imu, gauge = suite.imu, suite.depth
        assert imu is not None and gauge is not None  # draw_plant refuses a vehicle without them
        self._gyro, self._accel = view(imu.gyro)[0], view(imu.accel)[0]
        self._depth, self._pressure = view(gauge.depth), view(gauge.pressure)
        self._aids = [
            (kind, view(batch.fresh), view(batch.stamp), np.atleast_2d(view(reading)))
            for kind, batch, reading in (
                (VELOCITY, suite.dvl, suite.dvl and suite.dvl.velocity),
                (HEADING, suite.compass, suite.compass and suite.compass.heading),
            )
            if batch is not None
        ]
        self._sent = 0

    def sample(self) -> FirmwareSample:
        """Return the readings of both; that of the gauge is its newest sample that has arrived."""
        self._count[0] += 1
        self._update()
        return FirmwareSample(
            tuple(self._gyro.tolist()),
            tuple(self._accel.tolist()),
            float(self._depth[0]),
            float(self._pressure[0]),
        )

    def aids(self, delay: float) -> list[NavigationAid]:
        """Return the readings of Doppler log and compass that arrived with the newest `sample`, sent a delay [s]
        later."""
        readings = []
        for kind, fresh, stamp, reading in self._aids:
            if not fresh[0]:
                continue
            values = [*reading[0].tolist(), 0.0, 0.0]
            age = max(float(self._count[0]) * self.period - float(stamp[0]), 0.0) + delay
            self._sent += 1
            readings.append(
                NavigationAid(self._sent & 0xFFFF, kind, age, (values[0], values[1], values[2]), (0.0, 0.0))
            )
        return readings


def with_instruments(vehicle: Vehicle, instruments: Instruments) -> Vehicle:
    """Return the vehicle with the errors of its instruments in this plant.

    The IMU's latency is set to 0: it is the time between a sample and its frame, which the firmware adds.
    """
    factor = instruments.noise
    imu, gauge = vehicle.sensors.imu, vehicle.sensors.depth
    assert imu is not None and gauge is not None
    scaled = {name: factor * getattr(imu, name) for name in IMU_ERRORS}
    walk = float(np.hypot(factor * gauge.bias_walk, instruments.pressure_drift))
    drifting = {
        "noise_std": factor * gauge.noise_std,
        "bias_initial": factor * gauge.bias_initial,
        "bias_walk": walk,
    }
    sensors = vehicle.sensors.model_copy(
        update={
            "imu": imu.model_copy(update={**scaled, "latency": 0.0}),
            "depth": gauge.model_copy(update=drifting),
        }
    )
    return vehicle.model_copy(update={"sensors": sensors})


# Attitude filter: integrated gyroscope, tilt from the accelerometer; yaw from a compass, or drifting.


Three = tuple[float, float, float]


class AttitudeFilter:
    """Complementary filter on the rotation group (Mahony, Hamel and Pflimlin 2008, explicit form).

    Without a compass its yaw drifts; `turn` corrects it by compass headings.

    With the direction up of the specific force and the estimate R: e = up × Rᵀ z, b_dot = -ki e, q_dot = ½ q (ω - b +
    kp e). It uses plain floats: at this size NumPy would cost ten times as much.
    """

    def __init__(self, gain: float, integral: float, gravity: float) -> None:
        """Initialise the filter without a sample.

        Args:
            gain: kp [1/s].
            integral: ki [1/s²].
            gravity: [m/s²]; specific forces of very different magnitude are not used.
        """
        self.gain, self.integral, self.gravity = gain, integral, gravity
        self.bias: Three = (0.0, 0.0, 0.0)
        """Estimated bias of the gyroscope [rad/s]; without headings its vertical component stays about 0."""
        self._q: tuple[float, float, float, float] | None = None

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """Return the quaternion from IMU frame to level world, xyzw; identity before the first sample."""
        w, x, y, z = self._q or (1.0, 0.0, 0.0, 0.0)
        return x, y, z, w

    def update(self, gyro: Three, accel: Three, dt: float) -> None:
        """Update the estimate with one sample.

        Args:
            gyro: Angular velocity, IMU frame [rad/s].
            accel: Specific force, IMU frame [m/s²].
            dt: Time since the last sample [s].
        """
        if self._q is None:
            self._q = _level(accel)
            return
        w, x, y, z = self._q
        p, q, r = (rate - bias for rate, bias in zip(gyro, self.bias, strict=True))
        length = math.sqrt(accel[0] ** 2 + accel[1] ** 2 + accel[2] ** 2)
        if 0.7 * self.gravity < length < 1.3 * self.gravity:
            ax, ay, az = accel[0] / length, accel[1] / length, accel[2] / length
            ux, uy, uz = 2.0 * (x * z - w * y), 2.0 * (w * x + y * z), w * w - x * x - y * y + z * z
            ex, ey, ez = ay * uz - az * uy, az * ux - ax * uz, ax * uy - ay * ux
            k = self.integral * dt
            self.bias = (self.bias[0] - k * ex, self.bias[1] - k * ey, self.bias[2] - k * ez)
            p, q, r = p + self.gain * ex, q + self.gain * ey, r + self.gain * ez
        h = 0.5 * dt
        w, x, y, z = (
            w + h * (-x * p - y * q - z * r),
            x + h * (w * p + y * r - z * q),
            y + h * (w * q - x * r + z * p),
            z + h * (w * r + x * q - y * p),
        )
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        self._q = (w / norm, x / norm, y / norm, z / norm)

    def turn(self, heading: float, share: float, learned: float = 0.0) -> None:
        """Turn the estimate about the vertical towards a heading.

        Args:
            heading: Heading of the filter's x axis, left positive from world x [rad].
            share: Fraction of the difference that is corrected [-].
            learned: Integral gain from the difference to the vertical bias [1/s].
        """
        if self._q is None:
            return
        w, x, y, z = self._q
        yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        missing = math.remainder(heading - yaw, math.tau)
        up = 2.0 * (x * z - w * y), 2.0 * (w * x + y * z), w * w - x * x - y * y + z * z
        a, b, c = (bias - learned * missing * u for bias, u in zip(self.bias, up, strict=True))
        self.bias = a, b, c
        half = 0.5 * share * missing
        c, s = math.cos(half), math.sin(half)
        self._q = (c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w)


def _level(accel: Three) -> tuple[float, float, float, float]:
    """Return the attitude at yaw 0 in which a specific force points upwards, wxyz."""
    roll = math.atan2(accel[1], accel[2])
    pitch = math.atan2(-accel[0], math.hypot(accel[1], accel[2]))
    cr, sr, cp, sp = math.cos(roll / 2), math.sin(roll / 2), math.cos(pitch / 2), math.sin(pitch / 2)
    return cr * cp, sr * cp, cr * sp, -sr * sp


Array = NDArray[np.float64]

TURNING = 0.85
"""Fraction of the file's slowest speed below which a target counts as 0 [-]."""

# Plain integers, because the arithmetic of IntFlag is too slow for a hundred snapshots per second.
ALWAYS = int(StatusFlag.DIAGNOSTICS | StatusFlag.RPM_CONTROL | StatusFlag.MOTOR_HANDLER)
RECEIVED = int(StatusFlag.COMMAND_RECEIVED)
ECHO_ON = int(StatusFlag.ECHO_ON)
DRIVING = int(StatusFlag.DIRECT_THRUSTERS)
AIMING = int(StatusFlag.TARGET_RPM)
THROTTLED = int(StatusFlag.THROTTLE)


class Firmware:
    """One run of the program from power-on; its speed loops run inside the plant, together with the motors.

    Attributes:
        target: Target shaft speeds of the loops, canonical order [rad/s], (n,).
        setpoints: Target values of the other actuators [rad, m³ or m], (m,).
        commands: Number of received commands.
        ordered: True if frames cannot overtake each other on the link.
    """

    ordered = False

    def __init__(self, vehicle: Vehicle, spec: PlantSpec, *, now: float = 0.0) -> None:
        """Power on.

        Args:
            vehicle: Vehicle file with which the program was configured.
            spec: Clock and filter.
            now: Time of power-on [s].
        """
        mcu = vehicle.mcu
        self._timeout, self._outputs = mcu.command_timeout, mcu.outputs
        self._full = mcu.rpm_full_scale * RPM
        thrusters = list(vehicle.thrusters.values())
        self._output = np.array(
            [i if t.motor_index is None else t.motor_index for i, t in enumerate(thrusters)]
        )
        self._sign = np.array([t.motor_sign or 1 for t in thrusters], dtype=float)
        others = list(vehicle.actuators.values())
        self._rest = np.array([math.nan if a.off is None else a.off for a in others])
        self._travel = np.array([a.minimum for a in others]), np.array([a.maximum for a in others])
        self._values = np.zeros(len(others))
        self._slow_plus = TURNING * RPM * np.array([t.dead_rpm_plus for t in thrusters])
        self._slow_minus = TURNING * RPM * np.array([-t.dead_rpm_minus for t in thrusters])
        self._spec, self._gravity = spec.firmware, vehicle.water.gravity
        self._clock_start = spec.firmware.clock_start
        self._start(now)

    def _start(self, now: float) -> None:
        """Set the state after power-on: all memory is cleared, motors are off."""
        self._boot = now
        self._decoder = Decoder(MCU, self._outputs, len(self._values))
        self._filter = AttitudeFilter(self._spec.attitude_gain, self._spec.attitude_integral, self._gravity)
        self._sampled = now
        self._last_command: float | None = None
        self._bad_frames = self._sequence = self._debug_mask = self._unechoed = 0
        self._decimation = 1
        self._enabled = self._timed_out = self._aiming = False
        self._rpm_outputs = np.zeros(self._outputs)
        self.target: Array = np.zeros(len(self._sign))
        self._stop_others()
        self.commands = 0

    def reboot(self, now: float) -> None:
        """Stop the motors, send nothing for the plant's `reboot_time`, then restart clock, counters and attitude."""
        self._clock_start = 0
        self._start(now + self._spec.reboot_time)

    def running(self, now: float) -> bool:
        """Return whether the program has finished starting. `now` is the time [s]."""
        return now >= self._boot

    def clock(self, now: float) -> int:
        """Return the time of its own clock, modulo 2³² [ms]."""
        rate = 1000.0 * (1.0 + 1e-6 * self._spec.crystal_ppm)
        return (self._clock_start + int(rate * (now - self._boot))) & 0xFFFFFFFF

    def receive(self, now: float, data: bytes) -> list[bytes]:
        """Process bytes from the link, and return the resulting echoes. `now` is the time [s]."""
        if not self.running(now):
            return []
        replies = []
        for message in self._decoder.feed(data):
            if isinstance(message, DebugConfig):
                self._debug_mask, self._decimation = message.mask, max(message.decimation, 1)
                self._unechoed = 0
            elif isinstance(message, ThrusterCommand):
                replies += self._command(now, message)
        return replies

    def _command(self, now: float, command: ThrusterCommand) -> list[bytes]:
        """Execute or refuse one command; return the echo, if one is due."""
        refused = RejectFlag(0)
        counts = self._decoder.refused
        bad = counts["bad_crc"] + counts["not_finite"]
        if bad > self._bad_frames:
            refused |= RejectFlag.BAD_FRAME
        self._bad_frames = bad
        if self._timed_out:
            refused |= RejectFlag.TIMEOUT
        in_range = _within(command) and len(command.setpoints) == len(self._values)
        self.commands += 1
        if not in_range:
            refused |= RejectFlag.BAD_FRAME
        else:
            self._last_command, self._timed_out, self._enabled = now, False, command.enable
            self._aim(np.array(command.normalised) if command.enable else np.zeros(self._outputs))
            if command.enable:
                self.setpoints = np.clip(command.setpoints, *self._travel)
            else:
                self._stop_others()
        if not command.enable:
            refused |= RejectFlag.DISABLED
        self._unechoed += 1
        if not self._debug_mask & DEBUG_ECHO or self._unechoed < self._decimation:
            return []
        self._unechoed = 0
        return [self._echo(now, command, in_range and command.enable, int(refused))]

    def _aim(self, normalised: Array) -> None:
        """Set the target speeds of a command, by motor output and with the motors' signs."""
        speeds = self._sign * normalised[self._output] * self._full
        self.target = np.where((speeds < self._slow_plus) & (speeds > -self._slow_minus), 0.0, speeds)
        self._aiming = bool(self.target.any())

    def _stop_others(self) -> None:
        """Set the other actuators to their `off`; those without one keep their values."""
        self.setpoints: Array = np.where(np.isnan(self._rest), self._values, self._rest)

    def _echo(self, now: float, command: ThrusterCommand, accepted: bool, refused: int) -> bytes:
        applied = np.zeros(self._outputs)
        applied[self._output] = self._sign * self.target / self._full
        # The CRC as received, from the same values in the same layout.
        within = slice(2, -2) if command.setpoints else slice(1, -3)
        crc = crc16_modbus(encode_command(command)[within]) if _within(command) else 0
        echo = CommandEcho(
            sequence=self._next(),
            mcu_ms=self.clock(now),
            command_count=self.commands & 0xFFFFFFFF,
            receive_ms=self.clock(now),
            command_crc=crc,
            enabled=command.enable,
            accepted=accepted,
            reject_flags=refused,
            received=command.normalised,
            applied=tuple(applied.tolist()),
            debug_mask=self._debug_mask,
            decimation=self._decimation,
        )
        return encode_echo(echo)

    def watch(self, now: float) -> None:
        """Stop the motors if no more commands arrive. `now` is the time [s]."""
        if self._last_command is not None and now - self._last_command > self._timeout:
            self._last_command, self._timed_out, self._enabled = None, True, False
            self._aim(np.zeros(self._outputs))
            self._stop_others()

    def frames(
        self, now: float, sample: FirmwareSample, aids: Sequence[NavigationAid], plant: Plant, faults: Faults
    ) -> list[bytes]:
        """Return the frames at a sample of the IMU: a snapshot and the navigation aids; none during start-up.

        Args:
            now: Time of sending [s].
            sample: Readings of the instruments.
            aids: New readings at this sample, with their present ages.
            plant: Plant with the motors.
            faults: Active faults.
        """
        self._values = plant.measured_values
        telemetry = self.telemetry(now, sample, plant.measured_speed, plant.throttle)
        if telemetry is None:
            return []
        return [faults.encode(telemetry), *[encode_navigation(aid) for aid in aids]]

    def telemetry(
        self, now: float, sample: FirmwareSample, speed: Array, throttle: Array
    ) -> Telemetry | None:
        """Return a snapshot for the link; None during start-up.

        Args:
            now: Time of sending [s].
            sample: Readings of the instruments.
            speed: Measured shaft speeds, canonical [rad/s], (n,).
            throttle: Newest throttles [-1, 1], canonical, (n,).
        """
        if not self.running(now):
            return None
        self._filter.update(sample.gyro, sample.accel, now - self._sampled)
        self._sampled = now
        # Adding 0 turns the -0 of a mirrored motor at rest into 0.
        self._rpm_outputs[self._output] = self._sign * speed / RPM + 0.0
        return Telemetry(
            sequence=self._next(),
            mcu_ms=self.clock(now),
            quaternion=self._filter.quaternion,
            gyro=sample.gyro,
            accel=sample.accel,
            depth=sample.depth,
            pressure=sample.pressure,
            flags=self._flags(bool(throttle.any())),
            motor_rpm=tuple(self._rpm_outputs.tolist()),
            actuators=tuple(self._values.tolist()),
        )

    @property
    def driving(self) -> bool:
        """Return whether the newest command enables the thrusters."""
        return self._enabled

    def _flags(self, throttled: bool) -> int:
        flags = ALWAYS | (self.commands & 0xFF) << 16
        flags |= RECEIVED if self.commands else 0
        flags |= ECHO_ON if self._debug_mask & DEBUG_ECHO else 0
        flags |= DRIVING if self._enabled else 0
        flags |= AIMING if self._aiming else 0
        return flags | (THROTTLED if throttled else 0)

    def _next(self) -> int:
        self._sequence = (self._sequence + 1) & 0xFFFF
        return self._sequence


def _within(command: ThrusterCommand) -> bool:
    return all(abs(value) <= 1.0 for value in command.normalised)
