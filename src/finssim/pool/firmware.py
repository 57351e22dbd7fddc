"""The motor controller's program: commands in, target speeds out, telemetry and echoes on the wire."""

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


# The instruments aboard: the simulator's IMU and pressure gauge, sampled on the motor controller's clock.


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
    """IMU frame [rad/s]."""
    accel: tuple[float, float, float]
    """Specific force, IMU frame [m/s²]."""
    depth: float
    """Depth of the pressure port, positive down [m]."""
    pressure: float
    """Absolute [Pa]."""


class PoolSensors:
    """IMU and pressure gauge of one plant; `sample` reads both once per period of the IMU."""

    def __init__(self, plant: Plant, seed: int) -> None:
        """Switch them on: turn-on biases are drawn.

        Args:
            plant: What they measure.
            seed: Of their errors.
        """
        self.period = 1.0 / plant.vehicle.sensors.imu.rate  # type: ignore[union-attr]
        """Between samples [s]."""
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
        """Read both; the gauge gives its newest sample that has arrived."""
        self._count[0] += 1
        self._update()
        return FirmwareSample(
            tuple(self._gyro.tolist()),
            tuple(self._accel.tolist()),
            float(self._depth[0]),
            float(self._pressure[0]),
        )

    def aids(self, delay: float) -> list[NavigationAid]:
        """Return what Doppler log and compass have delivered at the newest `sample`, sent a delay [s] later."""
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
    """The vehicle with the errors that its instruments have in this plant.

    The IMU's latency is left out: it is the time between a sample and its frame, which the firmware takes.
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


# The attitude filter: gyroscope integrated, tilt from the accelerometer, yaw from a compass or left to drift.


Three = tuple[float, float, float]


class AttitudeFilter:
    """Complementary filter on the rotation group (Mahony, Hamel and Pflimlin 2008, explicit form).

    Without a compass its yaw drifts; `turn` takes a compass's headings.

    With up the accelerometer's direction and R the estimate: e = up × Rᵀ z, b_dot = -ki e, q_dot = ½ q (ω - b + kp e).
    Plain floats: at this size NumPy would cost ten times as much.
    """

    def __init__(self, gain: float, integral: float, gravity: float) -> None:
        """Start without a sample.

        Args:
            gain: kp [1/s].
            integral: ki [1/s²].
            gravity: [m/s²]; specific forces far from it are not used.
        """
        self.gain, self.integral, self.gravity = gain, integral, gravity
        self.bias: Three = (0.0, 0.0, 0.0)
        """Of the gyroscope, as estimated [rad/s]; without headings its vertical part stays about 0."""
        self._q: tuple[float, float, float, float] | None = None

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """Return the quaternion from IMU frame to level world, xyzw; identity before the first sample."""
        w, x, y, z = self._q or (1.0, 0.0, 0.0, 0.0)
        return x, y, z, w

    def update(self, gyro: Three, accel: Three, dt: float) -> None:
        """Take one sample.

        Args:
            gyro: IMU frame [rad/s].
            accel: Specific force, IMU frame [m/s²].
            dt: Since the last [s].
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
            heading: Of the filter's x axis, left positive from world x [rad].
            share: Part of the difference that is taken away [-].
            learned: Part of the difference that the bias about the vertical takes [1/s].
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
    """Attitude at yaw 0 in which a specific force points upwards, wxyz."""
    roll = math.atan2(accel[1], accel[2])
    pitch = math.atan2(-accel[0], math.hypot(accel[1], accel[2]))
    cr, sr, cp, sp = math.cos(roll / 2), math.sin(roll / 2), math.cos(pitch / 2), math.sin(pitch / 2)
    return cr * cp, sr * cp, cr * sp, -sr * sp


Array = NDArray[np.float64]

TURNING = 0.85
"""Part of the file's slowest speed below which a target is taken as standing still [-]."""

# As plain integers: the arithmetic of IntFlag is slow, and there are a hundred snapshots a second.
ALWAYS = int(StatusFlag.DIAGNOSTICS | StatusFlag.RPM_CONTROL | StatusFlag.MOTOR_HANDLER)
RECEIVED = int(StatusFlag.COMMAND_RECEIVED)
ECHO_ON = int(StatusFlag.ECHO_ON)
DRIVING = int(StatusFlag.DIRECT_THRUSTERS)
AIMING = int(StatusFlag.TARGET_RPM)
THROTTLED = int(StatusFlag.THROTTLE)


class Firmware:
    """One run of the program, from power-on; its speed loops run inside the plant, where the motors are.

    Attributes:
        target: Shaft speeds that it asks of the loops, canonical order [rad/s], (n,).
        setpoints: Values that it asks of the other actuators [rad, m³ or m], (m,).
        commands: How many it has received.
        ordered: Whether its frames cannot overtake each other on the wire.
    """

    ordered = False

    def __init__(self, vehicle: Vehicle, spec: PlantSpec, *, now: float = 0.0) -> None:
        """Power on.

        Args:
            vehicle: Its file, which is what the program was configured with.
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
        """State after power-on: nothing is remembered, motors are off."""
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
        """Stop the motors, be silent for the plant's `reboot_time`, then restart clock, counters and attitude."""
        self._clock_start = 0
        self._start(now + self._spec.reboot_time)

    def running(self, now: float) -> bool:
        """Return whether it has finished starting. `now` is the time [s]."""
        return now >= self._boot

    def clock(self, now: float) -> int:
        """Its own clock, modulo 2³² [ms]."""
        rate = 1000.0 * (1.0 + 1e-6 * self._spec.crystal_ppm)
        return (self._clock_start + int(rate * (now - self._boot))) & 0xFFFFFFFF

    def receive(self, now: float, data: bytes) -> list[bytes]:
        """Take bytes from the wire; returns the echoes that they cause. `now` is the time [s]."""
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
        """Follow or refuse one command; the echo, if one is due."""
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
        """Target speeds of a command, by motor output and with the motors' signs."""
        speeds = self._sign * normalised[self._output] * self._full
        self.target = np.where((speeds < self._slow_plus) & (speeds > -self._slow_minus), 0.0, speeds)
        self._aiming = bool(self.target.any())

    def _stop_others(self) -> None:
        """Send the other actuators to their `off`; those that have none stay where they are."""
        self.setpoints: Array = np.where(np.isnan(self._rest), self._values, self._rest)

    def _echo(self, now: float, command: ThrusterCommand, accepted: bool, refused: int) -> bytes:
        applied = np.zeros(self._outputs)
        applied[self._output] = self._sign * self.target / self._full
        # The CRC as it came: of the same values in the same layout.
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
        """Stop the motors if commands have stopped. `now` is the time [s]."""
        if self._last_command is not None and now - self._last_command > self._timeout:
            self._last_command, self._timed_out, self._enabled = None, True, False
            self._aim(np.zeros(self._outputs))
            self._stop_others()

    def frames(
        self, now: float, sample: FirmwareSample, aids: Sequence[NavigationAid], plant: Plant, faults: Faults
    ) -> list[bytes]:
        """Return what is sent at a sample of the IMU: a snapshot and the navigation aids; nothing while it starts.

        Args:
            now: When it leaves [s].
            sample: Of the instruments.
            aids: New at this sample, with their ages now.
            plant: Its motors.
            faults: What is wrong.
        """
        self._values = plant.measured_values
        telemetry = self.telemetry(now, sample, plant.measured_speed, plant.throttle)
        if telemetry is None:
            return []
        return [faults.encode(telemetry), *[encode_navigation(aid) for aid in aids]]

    def telemetry(
        self, now: float, sample: FirmwareSample, speed: Array, throttle: Array
    ) -> Telemetry | None:
        """A snapshot for the wire; None while it starts.

        Args:
            now: When it is sent [s].
            sample: Of the instruments.
            speed: Measured shaft speeds, canonical [rad/s], (n,).
            throttle: Newest [-1, 1], canonical, (n,).
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
        """Return whether the newest command lets thrusters turn."""
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
