"""The motor controller's program: commands in, target speeds out, telemetry and echoes on the wire."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from finssim.pool.attitude import AttitudeFilter
from finssim.pool.motors import RPM
from finssim.pool.plant_spec import PlantSpec
from finssim.pool.sensors import Sample
from finssim.robot.link.frames import (
    DEBUG_ECHO,
    MCU,
    DebugConfig,
    Decoder,
    RejectFlag,
    StatusFlag,
    crc16_modbus,
    encode_command,
    encode_echo,
)
from finssim.robot.messages import CommandEcho, Telemetry, ThrusterCommand
from finssim.vehicles import Vehicle

__all__ = ["Firmware"]

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
        commands: How many it has received.
    """

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
        self._slow_plus = TURNING * RPM * np.array([t.dead_rpm_plus for t in thrusters])
        self._slow_minus = TURNING * RPM * np.array([-t.dead_rpm_minus for t in thrusters])
        self._spec, self._gravity = spec.firmware, vehicle.water.gravity
        self._clock_start = spec.firmware.clock_start
        self._start(now)

    def _start(self, now: float) -> None:
        """State after power-on: nothing is remembered, motors are off."""
        self._boot = now
        self._decoder = Decoder(MCU, self._outputs)
        self._filter = AttitudeFilter(self._spec.attitude_gain, self._spec.attitude_integral, self._gravity)
        self._sampled = now
        self._last_command: float | None = None
        self._bad_frames = self._sequence = self._debug_mask = self._unechoed = 0
        self._decimation = 1
        self._enabled = self._timed_out = self._aiming = False
        self._rpm_outputs = np.zeros(self._outputs)
        self.target: Array = np.zeros(len(self._sign))
        self.commands = 0

    def reboot(self, now: float) -> None:
        """Motors off, silence for the plant's `reboot_time`, then everything anew: clock, counters, attitude."""
        self._clock_start = 0
        self._start(now + self._spec.reboot_time)

    def running(self, now: float) -> bool:
        """Whether it has finished starting."""
        return now >= self._boot

    def clock(self, now: float) -> int:
        """Its own clock, modulo 2³² [ms]."""
        rate = 1000.0 * (1.0 + 1e-6 * self._spec.crystal_ppm)
        return (self._clock_start + int(rate * (now - self._boot))) & 0xFFFFFFFF

    def receive(self, now: float, data: bytes) -> list[bytes]:
        """Take bytes from the wire; returns the echoes that they cause."""
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
        in_range = _within(command)
        self.commands += 1
        if not in_range:
            refused |= RejectFlag.BAD_FRAME
        else:
            self._last_command, self._timed_out, self._enabled = now, False, command.enable
            self._aim(np.array(command.normalised) if command.enable else np.zeros(self._outputs))
        if not command.enable:
            refused |= RejectFlag.DISABLED
        self._unechoed += 1
        if not self._debug_mask & DEBUG_ECHO or self._unechoed < self._decimation:
            return []
        self._unechoed = 0
        return [self._echo(now, command, in_range and command.enable, int(refused))]

    def _aim(self, normalised: Array) -> None:
        """Target speeds of a command, by motor output and with the motors' signs."""
        wanted = self._sign * normalised[self._output] * self._full
        self.target = np.where((wanted < self._slow_plus) & (wanted > -self._slow_minus), 0.0, wanted)
        self._aiming = bool(self.target.any())

    def _echo(self, now: float, command: ThrusterCommand, accepted: bool, refused: int) -> bytes:
        applied = np.zeros(self._outputs)
        applied[self._output] = self._sign * self.target / self._full
        # The CRC as it came: of the same values in the same layout.
        crc = crc16_modbus(encode_command(command)[1:-3]) if _within(command) else 0
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
        """Stop the motors if commands have stopped."""
        if self._last_command is not None and now - self._last_command > self._timeout:
            self._last_command, self._timed_out, self._enabled = None, True, False
            self._aim(np.zeros(self._outputs))

    def telemetry(self, now: float, sample: Sample, speed: Array, throttle: Array) -> Telemetry | None:
        """A snapshot for the wire; None while it starts.

        Args:
            now: When it is sent [s].
            sample: Of the instruments.
            speed: Measured shaft speeds, canonical [rad/s], (n,).
            throttle: Newest, canonical, (n,).
        """
        if not self.running(now):
            return None
        self._filter.update(sample.gyro, sample.accel, now - self._sampled)
        self._sampled = now
        # Adding 0 turns the -0 of a motor that stands the wrong way round into 0.
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
        )

    @property
    def driving(self) -> bool:
        """Whether the newest command lets thrusters turn."""
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
