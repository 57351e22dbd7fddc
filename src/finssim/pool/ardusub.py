"""Emulated autopilot for tests: behaviour of ArduSub 4.5 on a BlueROV2, with MAVLink 2 in and out.

The messages, their units and rates, the rules of pilot input, arming and failsafes, and the answers to commands are
those recorded from ArduSub 4.5.0 (`tests/data/ardusub_4_5_0`); docs/reference/ardusub_sitl.md lists the exceptions. It
has one link, which a router shares among ground stations, as on the vehicle itself. Its axes are forward, right, down
in north, east, down; north is world x.
"""

from __future__ import annotations

import csv
import math
import struct
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from finssim.control.ardusub import Mixer
from finssim.core.frames import TO_FOSSEN
from finssim.core.rotations import quat_multiply, quat_rotate, quat_to_euler, quat_to_matrix, quat_yaw
from finssim.pool.ardusub_loops import AttitudeLoop, DepthLoop, climb_rate, lean_angles, yaw_rate
from finssim.pool.firmware import AttitudeFilter, FirmwareSample
from finssim.pool.plant_spec import PlantSpec
from finssim.robot.links.water_linked import DeadReckoning, encode_velocity
from finssim.robot.messages import HEADING, VELOCITY, NavigationAid
from finssim.vehicles import Vehicle

if TYPE_CHECKING:
    from finssim.pool.plant import Plant
    from finssim.pool.virtual_pool import Faults

__all__ = ["ALT_HOLD", "MANUAL", "STABILIZE", "SURFACE", "ArduSub"]

Array = NDArray[np.float64]

STABILIZE, ACRO, ALT_HOLD, SURFACE, POSHOLD, MANUAL, MOTOR_DETECT, SURFTRAK = 0, 1, 2, 9, 16, 19, 20, 21
"""Modes, by their numbers in HEARTBEAT.custom_mode."""
BY_HAND = (MANUAL, STABILIZE, ACRO, MOTOR_DETECT)
"""Modes in which the pilot controls the throttle."""
DEPTH_MODES = (ALT_HOLD, SURFACE, SURFTRAK)
VERSIONS = {"4.1": (4, 1, 2), "4.5": (4, 5, 0), "4.7": (4, 7, 0)}
"""Emulated firmware versions. 4.5 is as recorded; 4.1 has neither pitch and roll axes nor SURFTRAK; 4.7 has
SURFACE_MAX_THR and other names for its own system id and that of the ground station."""
PARAMETERS = Path(__file__).with_name("ardusub_4_5_0.csv")
"""Name, value and type of every parameter of ArduSub 4.5.0 after its start."""
RENAMED = {"SYSID_THISMAV": "MAV_SYSID", "SYSID_MYGCS": "MAV_GCS_SYSID"}
"""Parameters of 4.5 -> their names in 4.7."""

ACCEPTED, REJECTED, DENIED, UNSUPPORTED, FAILED = range(5)
"""Results of commands."""
CRITICAL, WARNING, NOTICE, INFO = 2, 4, 5, 6
"""Severities of status texts."""
CAPABILITIES = 2 | 8192
"""Capability bits: parameters as floats, MAVLink 2."""
SENSORS = sum(
    getattr(mavlink, f"MAV_SYS_STATUS_{name}")
    for name in ("SENSOR_3D_GYRO", "SENSOR_3D_ACCEL", "SENSOR_ABSOLUTE_PRESSURE", "SENSOR_BATTERY",
                 "SENSOR_MOTOR_OUTPUTS", "AHRS", "PREARM_CHECK")
)  # fmt: skip
"""Bits of SYS_STATUS that every vehicle has."""
WITHOUT_SAMPLE = {
    "heartbeat",
    "autopilot_version",
    "rc_channels",
    "servo_output_raw",
    "system_time",
    "meminfo",
}
"""Messages that do not need any instrument."""
CONSTANT = {
    "power_status": (5000, 0, 0),
    "meminfo": (0, 65535, 100000),
    "mission_current": (0,),
    "gps_raw_int": (0, 0, 0, 0, 0, 65535, 65535, 65535, 65535, 0),  # none under water
}
"""Constant messages, with their fields."""
FRD = TO_FOSSEN.A
"""Rotation from forward, left, up to forward, right, down, (3, 3), by 180°; it also applies to rates and
quaternions."""
STANDARD_GRAVITY = 9.80665
"""[m/s^2]"""
STANDARD_ATMOSPHERE = 101325.0
"""Pressure at the surface [Pa]."""

SYSTEM = 1
NEUTRAL, HALF_RANGE = 1500, 400
"""Pulse width at no demand, and its difference at full demand [µs]."""
PITCH, ROLL, THROTTLE, YAW, FORWARD, LATERAL = range(6)
"""Input channels, from 0."""
BOOT_INPUTS = (NEUTRAL,) * 8 + (1100,) * 10
"""Pulse widths of the 18 inputs without an override: lights off, all others in the middle [µs]."""
SPECIFIC_WEIGHT = 9800.0
"""Pressure gradient of fresh water, as in ArduPilot [Pa/m]."""
METRES_PER_DEGREE = 111319.5
CALIBRATION, STILL = 1.0, 0.03
"""Time after the start in which the gyroscope is averaged [s], and rate above which the average is not used
[rad/s]."""
SPOOL_TIME = 0.5
"""Time after arming in which the limit of the throttle rises from 0 to 1 [s]."""
GROUND_LOST, WARN_AGAIN = 2.5, 30.0
"""Time without a heartbeat of the ground station that triggers the failsafe, and shortest time between two warnings
[s]."""
CALIBRATING = 3.0
"""Duration of the gyroscope calibration [s]."""
TEST_LASTS, COOL_DOWN, RETRY = 0.5, 10.0, 2.0
"""Longest time between two motor test commands, and shortest time from a test, and from a refused one, to the next
[s]."""
FIRST_RELAY = 9
"""First servo output that DO_SET_SERVO may drive: lower outputs are motors."""
DEPTH_LAG = 0.4
"""Time constant of the depth estimate [s]."""
COMPASS_SHARE = 0.05
"""Fraction of the heading difference that one reading of the compass corrects [-]."""
BIAS_SHARE, SETTLED = (0.02, 0.0005), 10.0
"""Integral gain from this difference to the gyroscope bias [1/s], before and after a time since the start [s]."""
LATE = 30
"""Number of samples for which attitudes are stored, which exceeds the latency of a Doppler log [-]."""
TURNING = 20.0
"""Time in which the heading changes from magnetic to true north, once there is an origin [s]."""
POSITION_LASTS, INERTIAL = 6.0, 0.5
"""Time after the last velocity for which a position is reported, and after which the accelerometer is integrated
[s]."""

FTP_NAK, FTP_UNKNOWN = 129, 7
"""Negative answer to a file transfer operation, and its reason."""

GROUPS = {
    "RAW_SENS": (1, "raw_imu scaled_imu2 scaled_imu3 scaled_pressure scaled_pressure2"),
    "EXT_STAT": (
        2,
        "sys_status power_status meminfo mission_current gps_raw_int nav_controller_output named_value_float",
    ),
    "RC_CHAN": (3, "servo_output_raw rc_channels"),
    "POSITION": (6, "global_position_int local_position_ned"),
    "EXTRA1": (10, "attitude ahrs2"),
    "EXTRA2": (11, "vfr_hud"),
    "EXTRA3": (12, "ahrs system_time battery_status ekf_status_report vibration"),
}
"""Stream groups: name in the parameter SR0_NAME -> number in REQUEST_DATA_STREAM, messages."""

REAL32 = 9
BUTTON_MODES = {5: MANUAL, 6: STABILIZE, 7: ALT_HOLD, 8: POSHOLD, 12: ACRO, 13: SURFTRAK}
"""BTNn_FUNCTION -> mode."""
LIMITS = {2: 2**7 - 1, 4: 2**15 - 1, 6: 2**31 - 1}
"""Type of an integer parameter -> its largest value."""
ANSWERS = {
    mavlink.MAV_CMD_DO_SET_RELAY: ACCEPTED,
    mavlink.MAV_CMD_DO_FENCE_ENABLE: ACCEPTED,
    mavlink.MAV_CMD_DO_CHANGE_SPEED: ACCEPTED,
    mavlink.MAV_CMD_CONDITION_YAW: ACCEPTED,
    mavlink.MAV_CMD_RUN_PREARM_CHECKS: ACCEPTED,
    mavlink.MAV_CMD_SET_EKF_SOURCE_SET: ACCEPTED,
    mavlink.MAV_CMD_MISSION_START: FAILED,
    mavlink.MAV_CMD_DO_FLIGHTTERMINATION: FAILED,
}
"""Commands without an effect here -> result of the answer."""


class ArduSub:
    """One emulated autopilot, from power-on; like `Firmware`, it receives the time, and its motors run in the plant.

    Attributes:
        parameters: Values by name, which a reboot does not change.
        target: Shaft speeds that correspond to its pulses with a full battery, canonical order [rad/s], (n,).
        pulses: Pulse widths of motors 1, 2, ... [µs], (n,).
        mode: Its number in HEARTBEAT.custom_mode.
        armed: True if its motors are enabled.
        ordered: True if frames cannot overtake each other on the link.
    """

    ordered = True

    def __init__(self, vehicle: Vehicle, spec: PlantSpec, *, now: float = 0.0) -> None:
        """Power on at the surface, where the barometer is calibrated.

        Args:
            vehicle: Its file: mixer, speed controllers, mounts.
            spec: Version, clock, declination, attitude filter and battery.
            now: Time of power-on [s].

        Raises:
            ControlError: The vehicle has no `autopilot`, or thrusters without `esc`.
        """
        self._version = VERSIONS[spec.firmware.version]
        self._mixer, self._spec, self._gravity = Mixer.of(vehicle), spec.firmware, vehicle.water.gravity
        thrusters = list(vehicle.thrusters.values())
        self._motor = np.array(
            [k if t.motor_index is None else t.motor_index for k, t in enumerate(thrusters)]
        )
        widths = np.arange(NEUTRAL - HALF_RANGE, NEUTRAL + HALF_RANGE + 1)
        self._speeds = np.array([t.shaft_speed(widths, spec.battery.full_voltage) for t in thrusters])
        imu, self._dvl = vehicle.sensors.imu, vehicle.sensors.dvl
        assert imu is not None  # the pool refuses a vehicle without one
        self._body_from_imu = quat_to_matrix(imu.orientation)
        self._has_compass, self._key = vehicle.sensors.compass is not None, b""
        self._table = self._default_parameters(vehicle)
        self._index = {name: i for i, name in enumerate(self._table)}
        self.parameters = {name: value for name, (_, value) in self._table.items()}
        self._faults: Faults | None = None
        self._clock_start = spec.firmware.clock_start
        self._calibrate_at_start = False
        self._start(now)
        if spec.firmware.origin is not None:
            latitude, longitude = spec.firmware.origin
            self._origin, self._origin_at = (round(1e7 * latitude), round(1e7 * longitude)), -math.inf

    def _default_parameters(self, vehicle: Vehicle) -> dict[str, tuple[int, float]]:
        """Return types and values by name, sorted: the recorded ones, and those that a user sets for this vehicle.

        The vehicle determines the frame, the directions of its motors, the specific gravity of its water and, with a
        Doppler log, the source of the autopilot's position.
        """
        with PARAMETERS.open(newline="") as file:
            table = {r["name"]: (int(r["mavlink_type"]), float(r["value"])) for r in csv.DictReader(file)}
        own: dict[str, float] = {
            "FRAME_CONFIG": {"VECTORED": 1, "VECTORED_6DOF": 2}.get(self._mixer.autopilot.name, 7),
            "BARO_SPEC_GRAV": round(vehicle.water.density * vehicle.water.gravity / SPECIFIC_WEIGHT, 3),
            "BARO1_GND_PRESS": STANDARD_ATMOSPHERE,
            "BARO2_GND_PRESS": STANDARD_ATMOSPHERE,
        }
        if self._dvl is not None:
            own |= {"VISO_TYPE": 1, "EK3_SRC1_POSXY": 6, "EK3_SRC1_VELXY": 6}
        for i in range(12):
            known = i < len(self._mixer.directions)
            own[f"MOT_{i + 1}_DIRECTION"] = float(self._mixer.directions[i]) if known else 1.0
        for i in range(len(self._mixer.directions), 8):
            own[f"SERVO{i + 1}_FUNCTION"] = 0.0
        table |= {name: (table[name][0], value) for name, value in own.items()}
        if self._version >= (4, 7):
            table = {RENAMED.get(name, name): entry for name, entry in table.items()}
            table["SURFACE_MAX_THR"] = (REAL32, 0.1)
        return dict(sorted(table.items()))

    def _start(self, now: float) -> None:
        """Set the state after power-on: only parameters are kept."""
        self._boot = self._now = now
        self._out: list[bytes] = []
        self._mav = mavlink.MAVLink(SimpleNamespace(write=self._out.append), self._id, 1)
        self._mav.robust_parsing = True
        if self._key:
            self.sign(self._key)
        self.mode, self.armed = MANUAL, False
        self._held: tuple[float, float, float, float] | None = None
        self._attitude_loop, self._depth_loop = AttitudeLoop(), DepthLoop()
        self._armed_at = self._ground_warned = -math.inf
        self._testing, self._tested = False, -math.inf
        self._test_ended = self._test_refused = -math.inf
        self._servos: dict[int, int] = {}
        self._answer_later: list[tuple[float, int, tuple[int, int]]] = []
        self._driven: tuple[float, ...] | None = None
        self.pulses = np.full(len(self._motor), float(NEUTRAL))
        self.target: Array = np.zeros(len(self._motor))
        self._inputs, self._input_times = list(BOOT_INPUTS), [-math.inf] * 18
        self._pilot_seen, self._ground_seen = -math.inf, -math.inf
        self._failsafes: set[str] = set()
        self._low_since = math.inf
        self._gain, self._buttons = self._within("JS_GAIN_DEFAULT", 0.1, 1.0), 0
        self._filter = AttitudeFilter(self._spec.attitude_gain, self._spec.attitude_integral, self._gravity)
        self._rates_sum, self._rates_count, self._fastest = np.zeros(3), 0, 0.0
        self._sample: FirmwareSample | None = None
        self._sampled, self._headed = now, False
        self._attitude, self._quaternion = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
        self._rates, self._gyro, self._force = np.zeros(3), np.zeros(3), np.zeros(3)
        self._altitude = self._climb = self._lift = self._lift_offset = 0.0
        self._surfaced = False
        self._position, self._velocity, self._velocity_time = np.zeros(2), np.zeros(2), -math.inf
        self._aided_since = math.inf
        self._places: deque[tuple[float, Array, Array]] = deque()
        self._attitudes: deque[tuple[float, Array, Array]] = deque(maxlen=LATE)
        self._origin: tuple[int, int] | None = None
        self._origin_at = math.inf
        self._battery, self._used = (0.0, 0.0), 0.0
        self._dvl_time, self._reckoning = now, DeadReckoning()
        self._requested_parameters: deque[str] = deque()
        self._sender = (0, 0)
        self._rebooting = False
        self._interval: dict[str, float] = {}
        self._due: dict[str, float] = {}
        self._every("heartbeat", 1.0)
        for name in GROUPS:
            self._stream(name, self.parameters[f"SR0_{name}"])
        self._greet()

    # Functions that the pool calls.

    def reboot(self, now: float) -> None:
        """Stop the motors, send nothing for the plant's `reboot_time`, then reset everything except the parameters.

        The barometer is then calibrated at the present depth, which becomes the origin of depth. `now` is the time [s].
        """
        self._clock_start = 0
        self._start(now + self._spec.reboot_time)
        self._calibrate_at_start = True

    def running(self, now: float) -> bool:
        """Return whether the autopilot has finished starting. `now` is the time [s]."""
        return now >= self._boot

    @property
    def driving(self) -> bool:
        """Return whether the autopilot is armed."""
        return self.armed

    def receive(self, now: float, data: bytes) -> list[bytes]:
        """Process a datagram of complete MAVLink frames, and return the answers; it never raises an exception.

        `now` is the time [s].
        """
        if not self.running(now):
            return []
        self._now = max(self._now, now)
        for message in self._mav.parse_buffer(data) or ():
            handler = getattr(self, f"_on_{message.get_type().lower()}", None)
            self._sender = message.get_srcSystem(), message.get_srcComponent()
            for_us = getattr(message, "target_system", self._id) in (0, self._id)
            if handler is not None and for_us and getattr(message, "target_component", 1) in (0, 1):
                handler(message)
        # Incomplete data are dropped, so that they do not consume the next frame.
        self._mav.buf, self._mav.buf_index = bytearray(), 0
        self._mav.expected_length = mavlink.HEADER_LEN_V1 + 2
        out = self._drain()
        if self._rebooting:
            self.reboot(now)
        return out

    def watch(self, now: float) -> None:
        """Release expired overrides, check pilot and ground station, and set the motors.

        `now` is the time [s].
        """
        if not self.running(now):
            return
        self._now = now = max(self._now, now)
        lasts = self.parameters["RC_OVERRIDE_TIME"]
        for i, since in enumerate(self._input_times):
            if since > -math.inf and 0.0 <= lasts < now - since:
                self._release(i)
        self._check_pilot(now)
        self._check_ground(now)
        self._check_test(now)
        for entry in [entry for entry in self._answer_later if now >= entry[0]]:
            self._answer_later.remove(entry)
            self._send("command_ack", entry[1], ACCEPTED, 0, 0, *entry[2])
        self._drive()

    def frames(
        self, now: float, sample: FirmwareSample, aids: Sequence[NavigationAid], plant: Plant, faults: Faults
    ) -> list[bytes]:
        """Return the frames at a sample of the IMU: telemetry that is due, and the lines of the Doppler log.

        Args:
            now: Time of sending [s].
            sample: Readings of the instruments.
            aids: New readings of compass and Doppler log at this sample.
            plant: Plant with the battery and the distance to the floor.
            faults: Active faults.
        """
        aids = [aid for aid in aids if aid.kind != VELOCITY or not faults.autopilot.dvl_silent]
        silent = faults.autopilot.dvl_silent or self._dvl is None or not self._spec.log_shared
        lines = [] if silent else self._dvl_lines(now, aids, plant)
        if not self.running(now):
            return lines
        self._now, self._faults = max(self._now, now), faults
        self._battery = (
            faults.autopilot.battery_voltage or float(plant.electric[0]),
            float(plant.electric[1]),
        )
        before = self._sampled
        self._used += self._battery[1] * max(now - before, 0.0) / 3.6
        if not faults.freeze_sensors or self._sample is None:
            self._sense(now, sample, aids)
        self._check_battery(now)
        self._check_leak(faults.autopilot.leak)
        self._hold(now - before)
        for name, due in self._due.items():
            if now >= due - 1e-9:
                self._due[name] = max(due + self._interval[name], now - self._interval[name])
                self._report(name)
        for _ in range(min(4, len(self._requested_parameters))):
            self._send_parameter(self._requested_parameters.popleft())
        return self._drain() + lines

    def _drain(self) -> list[bytes]:
        out = list(self._out)
        self._out.clear()
        return out

    # Instruments and state estimation.

    def _sense(self, now: float, sample: FirmwareSample, aids: Sequence[NavigationAid]) -> None:
        dt, self._sampled, self._sample = now - self._sampled, now, sample
        if self._calibrate_at_start:
            self._calibrate_barometer()
        gyro, accel = (self._body_from_imu @ np.array(v) for v in (sample.gyro, sample.accel))
        if now - self._boot < CALIBRATION:
            self._rates_sum, self._rates_count = self._rates_sum + gyro, self._rates_count + 1
            self._fastest = max(self._fastest, float(np.abs(gyro).max()))
            x, y, z = (self._rates_sum / self._rates_count).tolist()
            # Motion during the average would be mistaken for a gyroscope offset.
            self._filter.bias = (x, y, z) if self._fastest < STILL else (0.0, 0.0, 0.0)
        self._filter.update(tuple(gyro.tolist()), tuple(accel.tolist()), dt)
        velocities = []
        for aid in aids:
            if aid.kind == HEADING and self.parameters["COMPASS_USE"]:
                # The filter's angles are left positive; the magnetic heading is the true one minus the declination.
                disturbed = self._faults.autopilot.north if self._faults else 0.0
                missing = self._spec.declination * (1.0 - self._true_north(now)) + disturbed
                # A change of the north direction is not a gyroscope offset.
                turning = disturbed or (self._spec.declination and 0.0 < self._true_north(now) < 1.0)
                settled = bool(turning) or now - self._boot > SETTLED
                share = COMPASS_SHARE if self._headed else 1.0
                learned = 0.0 if not self._headed else BIAS_SHARE[settled]
                turned = quat_yaw(self._filter.quaternion) + quat_yaw(self._attitude_at(now - aid.age)[0])
                self._filter.turn(aid.values[0] + float(turned) + missing, share, learned)
                self._headed = True
            elif aid.kind == VELOCITY:
                velocities.append(aid)
        q = np.array(self._filter.quaternion)
        self._quaternion = np.append(FRD @ q[:3], q[3])
        self._attitude = np.array(quat_to_euler(self._quaternion)).ravel()
        self._gyro = FRD @ gyro
        self._rates = FRD @ (gyro - self._filter.bias)
        self._attitudes.append((now, self._quaternion, self._rates))
        self._force = FRD @ accel
        self._climb_by(float(quat_rotate(q, accel)[2]) - self._gravity, dt)
        if self.parameters["VISO_TYPE"] and self._dvl is not None:
            if now - self._velocity_time > INERTIAL:
                self._velocity = self._velocity + dt * (FRD @ quat_rotate(q, accel))[:2]
            self._position += dt * self._velocity * (now - self._velocity_time < POSITION_LASTS)
            for aid in velocities:
                over_floor = FRD @ quat_to_matrix(self._dvl.orientation) @ aid.values
                if now - self._velocity_time > POSITION_LASTS:
                    self._aided_since = now
                then, rates = self._attitude_at(now - aid.age)
                of_body = over_floor - np.cross(rates, FRD @ self._dvl.position)
                self._velocity, self._velocity_time = quat_rotate(then, of_body)[:2], now
            self._places.append((now, self._position.copy(), self._velocity))
            while now - self._places[0][0] > POSITION_LASTS:
                self._places.popleft()

    def _attitude_at(self, time: float) -> tuple[Array, Array]:
        """Return the attitude at a time [s], x y z w, body to north, east, down, and the body rates [rad/s]: the real
        filter is as late as its slowest instrument."""
        then = ((q, rates) for at, q, rates in self._attitudes if at >= time)
        return next(then, (self._quaternion, self._rates))

    def _true_north(self, now: float) -> float:
        """Return the progress of the heading's change from magnetic to true north [0, 1]."""
        return min(max((now - self._origin_at) / TURNING, 0.0), 1.0)

    def _calibrate_barometer(self) -> None:
        """Set the present depth as the origin of depth."""
        assert self._sample is not None
        self._calibrate_at_start = False
        for name in ("BARO1_GND_PRESS", "BARO2_GND_PRESS"):
            if math.isfinite(self._sample.pressure):
                self._store(name, self._sample.pressure)

    def _climb_by(self, acceleration: float, dt: float) -> None:
        """Update height, climb rate and accelerometer offset from pressure and vertical acceleration [m/s^2], with an
        observer of three equal poles."""
        assert self._sample is not None
        weight = SPECIFIC_WEIGHT * self._within("BARO_SPEC_GRAV", 0.5, 2.0)
        measured = (self._within("BARO1_GND_PRESS", 5e4, 2e5) - self._sample.pressure) / weight
        if self._rates_count <= 1:
            self._altitude = measured
        error = measured - self._altitude
        self._lift = acceleration + self._lift_offset
        self._altitude += dt * (self._climb + 3.0 / DEPTH_LAG * error)
        self._climb += dt * (self._lift + 3.0 / DEPTH_LAG**2 * error)
        self._lift_offset += dt * error / DEPTH_LAG**3
        # True above SURFACE_DEPTH, and false again 5 cm below it.
        self._surfaced = (
            self.armed and measured > 0.01 * self.parameters["SURFACE_DEPTH"] - 0.05 * self._surfaced
        )

    def _dvl_lines(self, now: float, aids: Sequence[NavigationAid], plant: Plant) -> list[bytes]:
        """Return the reports of the Doppler log: its velocities, or an invalid report if more than one is missing."""
        assert self._dvl is not None
        interval = now - self._dvl_time
        velocities = [aid for aid in aids if aid.kind == VELOCITY]
        if not velocities and interval * self._dvl.rate < 1.5:
            return []
        self._dvl_time = now
        q = quat_multiply(plant.quaternion, self._dvl.orientation)
        place = self._reckoning.take(now, velocities[-1].values if velocities else None, q, now)
        if not velocities:
            return [encode_velocity(None, measured=now, sent=now, interval=interval), *place]
        height = plant.spec.basin.depth + float(plant.position[2])
        upright = float(quat_rotate(plant.quaternion, (0.0, 0.0, 1.0))[2])
        return [
            encode_velocity(
                velocities[-1].values,
                altitude=height / max(upright, 0.1),
                measured=now - velocities[-1].age,
                sent=now,
                interval=interval,
                std=(self._dvl.noise_std,) * 3,
            ),
            *place,
        ]

    # Motors.

    def _hold(self, dt: float) -> None:
        """Set the demands of roll, pitch, yaw and throttle that hold attitude and depth, in modes with these
        controllers.

        `dt` is the time since the last call [s].
        """
        if self.mode in (MANUAL, MOTOR_DETECT) or not self.armed:
            self._held = None
            self._attitude_loop, self._depth_loop = AttitudeLoop(), DepthLoop()
            return
        if self.mode == SURFACE and self._surfaced:
            self._set_mode(ALT_HOLD)
        p, widths = self.parameters, [float(width - NEUTRAL) for width in self._inputs[:6]]
        turn = yaw_rate(widths[YAW], self._gain, p)
        if self.mode == ACRO:
            tilt = np.array([widths[ROLL], widths[PITCH]]) / HALF_RANGE * math.radians(45.0 * p["ACRO_RP_P"])
            level = self._attitude[:2] * (p["ACRO_BAL_ROLL"], p["ACRO_BAL_PITCH"])
            turning = self._attitude_loop.turn_by(dt, np.append(tilt - level, turn), self._rates, p)
        else:
            lean = lean_angles(widths[ROLL], widths[PITCH], p)
            state = self._attitude, self._quaternion, self._rates
            turning = self._attitude_loop.step(dt, lean, turn, *state, p)
        roll, pitch, yaw = turning
        self._held = (
            roll,
            pitch,
            yaw,
            self._climbing(dt) if self.mode in DEPTH_MODES else widths[THROTTLE] / HALF_RANGE,
        )

    def _climbing(self, dt: float) -> float:
        """Return the throttle that climbs by the stick, rises to the surface, or holds the depth."""
        p = self.parameters
        climb = climb_rate(self._inputs[THROTTLE], self._gain, p)
        if self.mode == SURFACE:
            climb = 0.01 * min(p["WPNAV_SPEED_UP"], p["PILOT_SPEED_UP"])
        up = self._depth_loop.step(dt, climb, self._altitude, self._climb, self._lift, self._surfaced, p)
        if "SURFACE_MAX_THR" not in p:
            return up
        least, surface = self._within("SURFACE_MAX_THR", 0.0, 1.0), 0.01 * p["SURFACE_DEPTH"]
        return min(least + (1.0 - least) * max(0.0, min(1.0, surface - self._altitude)), up)

    def _drive(self) -> None:
        """Set the pulses of the mixer while armed, else 1500."""
        if self._testing:
            return
        demands = self._demands() if self.armed and self.mode != MOTOR_DETECT else None
        if demands == self._driven:
            return
        self._driven = demands
        pulses = np.full(len(self._motor), float(NEUTRAL))
        if demands is not None:
            # Truncated to microseconds; 1e-3 compensates for single precision.
            offsets = self._signs() * (self._mixer.pulses(np.array(demands)) - NEUTRAL)
            pulses = np.floor(NEUTRAL + offsets + 1e-3)
        self._output(pulses)

    def _output(self, pulses: Array) -> None:
        """Set pulse widths [µs] of motors 1, 2, ..., (n,), and the target speeds that follow from them."""
        self.pulses = pulses
        column = (pulses[self._motor] - (NEUTRAL - HALF_RANGE)).astype(int)
        self.target = self._speeds[np.arange(len(column)), column]

    def _demands(self) -> tuple[float, ...]:
        """Return the demands of the mixer: roll, pitch, yaw, throttle, forward, lateral."""
        pitch, roll, throttle, yaw, forward, lateral = self._sticks()
        yaw *= self.parameters["ACRO_YAW_P"] / 3.375
        roll, pitch, yaw, throttle = self._held or (roll, pitch, yaw, throttle)
        spool = min(max((self._now - self._armed_at) / SPOOL_TIME, 0.0), 1.0)
        return roll, pitch, yaw, max(-spool, min(spool, throttle)), forward, lateral

    def _signs(self) -> Array:
        """Return the signs of motors whose direction in the parameters differs from the vehicle file, (n,)."""
        n = len(self.pulses)
        now = np.array([self.parameters[f"MOT_{i + 1}_DIRECTION"] for i in range(n)])
        return np.asarray(np.where(now < 0.0, -1.0, 1.0) * self._mixer.directions)

    # Pilot.

    def _sticks(self) -> list[float]:
        """Return the first six inputs in [-1, 1]: pitch, roll, throttle, yaw, forward, lateral."""
        return [max(-1.0, min(1.0, (width - NEUTRAL) / HALF_RANGE)) for width in self._inputs[:6]]

    def _override(self, channel: int, width: float) -> None:
        self._inputs[channel], self._input_times[channel] = int(width), self._now

    def _release(self, channel: int) -> None:
        self._inputs[channel], self._input_times[channel] = BOOT_INPUTS[channel], -math.inf

    def _neutral_sticks(self) -> None:
        for channel in range(6):
            self._release(channel)

    def _from_ground(self) -> bool:
        """Return whether the newest message came from the ground station that has control."""
        return bool(self._sender[0] == self.parameters[self._named("SYSID_MYGCS")])

    def _named(self, name: str) -> str:
        """Return the name of a parameter of 4.5 in this version."""
        return RENAMED.get(name, name) if self._version >= (4, 7) else name

    def _on_heartbeat(self, message: Any) -> None:
        if self._from_ground() and not (self._faults and self._faults.autopilot.no_ground_heartbeat):
            self._ground_seen = self._now

    def _on_manual_control(self, message: Any) -> None:
        if not self._from_ground() or message.target != self._id:
            return
        self._pilot_seen = self._ground_seen = self._now
        held, self._buttons = self._buttons, message.buttons
        down = [i for i in range(16) if message.buttons >> i & 1]
        shifted = any(self.parameters[f"BTN{i}_FUNCTION"] == 1 for i in down)
        for i in down:
            function = int(self.parameters[f"BTN{i}_{'S' * shifted}FUNCTION"])
            self._press(function, bool(held >> i & 1))
        scale = 0.4 * self._gain
        lift = 2.0 * scale * self.parameters["JS_THR_GAIN"]
        pitch, roll = (message.s, message.t) if self._version >= (4, 5) else (0, 0)
        # The autopilot computes with 16-bit integers: pitch and roll can wrap.
        for channel, width in (
            (PITCH, _wrapped(NEUTRAL + pitch)),
            (ROLL, _wrapped(NEUTRAL + roll)),
            (THROTTLE, int(lift * message.z + (NEUTRAL - 500.0 * lift) + 1e-6)),
            (YAW, int(NEUTRAL + scale * message.r + 1e-6)),
            (FORWARD, int(NEUTRAL + scale * message.x + 1e-6)),
            (LATERAL, int(NEUTRAL + scale * message.y + 1e-6)),
        ):
            self._override(channel, max(NEUTRAL - HALF_RANGE, min(NEUTRAL + HALF_RANGE, width)))

    def _press(self, function: int, held: bool) -> None:
        """Perform the function of a button: arming and modes on every message, gain only when it is pressed.

        Functions of lights, camera, trim and relays have no effect.
        """
        if function in (2, 3, 4):
            arm = function == 3 or (function == 2 and not self.armed)
            self._arm() if arm else self._disarm()
        elif function in BUTTON_MODES:
            self._set_mode(BUTTON_MODES[function])
        elif function in (41, 42, 43) and not held:
            low, high = self._within("JS_GAIN_MIN", 0.1, 1.0), self._within("JS_GAIN_MAX", 0.1, 1.0)
            step = (high - low) / max(self.parameters["JS_GAIN_STEPS"] - 1.0, 1.0)
            toggled = high if self._gain < high else low
            self._gain = toggled if function == 41 else self._gain + (step if function == 42 else -step)
            self._gain = max(low, min(high, self._gain))
            self._statustext(INFO, f"#Gain is at {100.0 * self._gain:.0f}%")

    def _on_rc_channels_override(self, message: Any) -> None:
        if not self._from_ground():
            return
        self._pilot_seen = self._ground_seen = self._now
        for i in range(18):
            width = getattr(message, f"chan{i + 1}_raw")
            if width == (0 if i < 8 else 65534):
                self._release(i)
            elif width not in (0, 65535):
                self._override(i, width)

    # Arming, modes, failsafes.

    def _unfit(self) -> list[str]:
        """Return the reasons against arming; ARMING_CHECK selects the checks in addition to the button."""
        p, checks = self.parameters, int(self.parameters["ARMING_CHECK"])
        reasons = []
        if not any(p[f"BTN{i}_FUNCTION"] in (2, 4) for i in range(16)) and not (
            any(p[f"BTN{i}_FUNCTION"] == 1 for i in range(16))
            and any(p[f"BTN{i}_SFUNCTION"] in (2, 4) for i in range(16))
        ):
            reasons.append("No button disarms: assign one")
        if self._sample is None or self._now - self._boot < CALIBRATION:
            reasons.append("Gyros still settling")
        if checks & (1 | 2) and self._sample is not None and not math.isfinite(self._sample.pressure):
            reasons.append("Depth sensor not healthy")
        if checks & (1 | 128 | 256) and self._battery[0] < max(p["BATT_ARM_VOLT"], p["BATT_LOW_VOLT"]):
            reasons.append(f"Battery 1 low voltage {self._battery[0]:.1f}")
        return reasons

    def _arm(self) -> bool:
        """Arm if there is no reason against it, also with forced arming; return whether the command succeeds."""
        if self.armed:
            return True
        reasons = self._unfit()
        for reason in reasons:
            self._statustext(CRITICAL, f"Arm: {reason}")
        if reasons:
            return False
        self.armed, self._armed_at = True, self._now
        self._statustext(INFO, "Arming motors")
        self._heartbeat_now()
        if self._origin is None:
            self._statustext(WARNING, "No origin: the heading is magnetic")
            self._statustext(WARNING, "No origin: no world position")
            # As recorded from later versions and read in this one's source: it arms although the command fails.
            return not int(self.parameters["ARMING_CHECK"]) & (1 | 32)
        return True

    def _disarm(self) -> bool:
        if self.armed:
            self.armed = self._testing = False
            self._statustext(INFO, "Disarming motors")
            self._heartbeat_now()
        self._drive()
        return True

    def _set_mode(self, mode: int) -> bool:
        depth = self._sample is not None and math.isfinite(self._sample.pressure)
        modes = {STABILIZE, ACRO, MANUAL, MOTOR_DETECT}
        if depth:
            modes.add(ALT_HOLD)
            modes |= {SURFTRAK} if self._version >= (4, 5) else set()
            # SURFACE needs a position; so do the modes that are not emulated, which are always refused.
            modes |= {SURFACE} if self._has_position or self.mode == SURFACE else set()
        if mode not in modes:
            self._statustext(WARNING, "Mode change failed: no position, no depth, or not emulated")
            return False
        if mode != self.mode:
            if mode in (MANUAL, ACRO):
                self._neutral_sticks()
            if mode == SURFTRAK:
                self._statustext(INFO, "No rangefinder: depth is held")
            self.mode, self._held = mode, None
            self._attitude_loop, self._depth_loop = AttitudeLoop(), DepthLoop()
            self._heartbeat_now()
        return True

    def _heartbeat_now(self) -> None:
        if "heartbeat" in self._due:
            self._due["heartbeat"] = self._now

    def _failsafe(self, name: str, active: bool, severity: int, text: str) -> bool:
        """Store the state of a failsafe; when it sets in, send a text and return True."""
        sets_in = active and name not in self._failsafes
        self._failsafes = self._failsafes | {name} if active else self._failsafes - {name}
        if sets_in:
            self._statustext(severity, text)
        return sets_in

    def _check_pilot(self, now: float) -> None:
        """After FS_PILOT_TIMEOUT without input, set the sticks to neutral, and disarm if FS_PILOT_INPUT requires it;
        once per loss."""
        action = self.parameters["FS_PILOT_INPUT"]
        known = self._pilot_seen > -math.inf
        lost = known and action > 0 and now - self._pilot_seen > self.parameters["FS_PILOT_TIMEOUT"]
        if self._failsafe("pilot", lost, CRITICAL, "Lost manual control"):
            self._neutral_sticks()
            self._act({2: None}.get(int(action), self.mode))

    def _check_ground(self, now: float) -> None:
        """If the ground station's heartbeat is lost, send a warning, and act by FS_GCS_ENABLE while armed."""
        action, since = self.parameters["FS_GCS_ENABLE"], self._ground_seen
        timeout = self.parameters.get("FS_GCS_TIMEOUT", GROUND_LOST)
        lost = action > 0 and since > -math.inf and now - since > timeout
        if lost and now - self._ground_warned > WARN_AGAIN:
            self._ground_warned = now
            self._statustext(
                WARNING, f"Ground station {self.parameters[self._named('SYSID_MYGCS')]:.0f}: no heartbeat"
            )
        if not lost:
            self._failsafes.discard("ground")
        elif self.armed and "ground" not in self._failsafes:
            self._failsafes.add("ground")
            self._act({2: None, 3: ALT_HOLD, 4: SURFACE}.get(int(action), self.mode))

    def _check_battery(self, now: float) -> None:
        """Perform BATT_FS_LOW_ACT (2 disarm, 3 surface) after BATT_LOW_TIMER below BATT_LOW_VOLT; once per start."""
        p, voltage = self.parameters, self._battery[0]
        self._low_since = min(self._low_since, now) if voltage < p["BATT_LOW_VOLT"] else math.inf
        low = "battery" in self._failsafes or now - self._low_since >= p["BATT_LOW_TIMER"]
        if self._failsafe(
            "battery", low, WARNING, f"Battery 1 is low {voltage:.2f}V used {self._used:.0f} mAh"
        ):
            self._act({2: None, 3: SURFACE}.get(int(p["BATT_FS_LOW_ACT"]), self.mode), keep=True)

    def _check_leak(self, leaking: bool) -> None:
        """Act by FS_LEAK_ENABLE: 1 warns, 2 also surfaces; the heartbeat does not change."""
        action = self.parameters["FS_LEAK_ENABLE"]
        if self._failsafe("leak", leaking and action > 0, CRITICAL, "Leak Detected"):
            self._act({2: SURFACE}.get(int(action), self.mode), keep=True)

    def _check_test(self, now: float) -> None:
        """End a motor test whose command is not repeated, and disarm."""
        if self._testing and now - self._tested > TEST_LASTS:
            self._testing, self._test_ended, self._driven = False, now, ()
            self._statustext(INFO, "Motor test timed out")
            self._disarm()

    def _act(self, mode: int | None, *, keep: bool = False) -> None:
        """Set a mode; disarm if it is None, or if it is refused and `keep` is False."""
        if self.armed and (mode is None or not (self._set_mode(mode) or keep)):
            self._disarm()

    # Commands.

    def _on_command_long(self, message: Any) -> None:
        self._command(message.command, [getattr(message, f"param{i}") for i in range(1, 8)])

    def _on_command_int(self, message: Any) -> None:
        self._command(message.command, [getattr(message, f"param{i}") for i in range(1, 5)])

    def _on_set_mode(self, message: Any) -> None:
        result = self._do_set_mode([float(message.base_mode), float(message.custom_mode)])
        self._send("command_ack", mavlink.MAVLINK_MSG_ID_SET_MODE, result)

    def _command(self, command: int, values: list[float]) -> None:
        """Perform or refuse a command; an unknown command is answered as unsupported."""
        values = [
            value if abs(value) < 1e9 else -1.0 for value in values
        ]  # also NaN, which no command accepts
        do = COMMANDS.get(command)
        result = ANSWERS.get(command, UNSUPPORTED) if do is None else do(self, values)
        if result is None:  # answered after the calibration
            self._answer_later.append((self._now + CALIBRATING, command, self._sender))
        else:
            self._send("command_ack", command, result, 0, 0, *self._sender)

    def _do_arm(self, values: list[float]) -> int:
        if values[0] not in (0.0, 1.0):
            return UNSUPPORTED
        return _result(self._arm() if values[0] else self._disarm())

    def _do_set_mode(self, values: list[float]) -> int:
        if not int(values[0]) & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
            return DENIED
        return _result(self._set_mode(int(values[1])))

    def _do_set_interval(self, values: list[float]) -> int:
        name, interval = _name(values[0]), 1e-6 * values[1]
        if self._reporter(name) is None:
            self._statustext(INFO, f"No message {values[0]:.0f} here")
            return DENIED
        if interval == 0.0:
            rates = [
                self.parameters[f"SR0_{group}"]
                for group, (_, names) in GROUPS.items()
                if name in names.split()
            ]
            interval = 1.0 / rates[0] if rates and rates[0] > 0.0 else float(name == "heartbeat")
        self._every(name, interval)
        return ACCEPTED

    def _do_get_interval(self, values: list[float]) -> int:
        interval = self._interval.get(_name(values[0]), -1e-6)
        self._send("message_interval", int(values[0]) & 0xFFFF, round(1e6 * interval))
        return ACCEPTED

    def _do_request_protocol(self, values: list[float]) -> int:
        self._statustext(INFO, "The protocol's version is not sent")
        return UNSUPPORTED

    def _do_calibrate(self, values: list[float]) -> int | None:
        """Calibrate gyroscope (first value), ground pressure (third) or accelerometer (fifth, never here); refused
        while armed."""
        if self.armed or self._sample is None:
            if values[2] == 1.0:
                self._statustext(NOTICE, "Disarm before calibrating")
            return FAILED
        if values[2] == 1.0:
            self._calibrate_barometer()
            for i in (1, 2):
                self._statustext(INFO, f"Barometer {i}: calibrating")
                self._statustext(INFO, f"Barometer {i}: its depth counts from here")
            return ACCEPTED
        if values[0] == 1.0:
            return None
        return REJECTED if values[4] else UNSUPPORTED

    def _do_motor_test(self, values: list[float]) -> int:
        """Drive one motor (first value, from 0) by a pulse or a percentage, without the mixer, while the command is
        repeated."""
        motor, kind, width, order = int(values[0]), values[1], values[2], values[5]
        self._tested, refused = self._now, self._now - self._test_refused < RETRY
        if not self._testing:
            if refused:
                return FAILED
            cooling = self._now - self._test_ended < COOL_DOWN
            if cooling or not self.armed:
                self._statustext(
                    CRITICAL if cooling else WARNING, "Wait" if cooling else "Arm before a motor test"
                )
                self._statustext(WARNING, "No motor test")
                self._test_refused = self._now
                return FAILED
            self._testing = True
            self._output(np.full(len(self._motor), float(NEUTRAL)))
        if order != 2.0 or kind not in (0.0, 1.0) or not 0 <= motor < len(self._motor):
            self._statustext(WARNING, "Motor tests are by board order, in per cent or as pulses")
            return FAILED
        if kind == 0.0:
            low, high = self.parameters["RC3_MIN"], self.parameters["RC3_MAX"]
            width = low + 0.01 * min(max(width, 0.0), 100.0) * (high - low)
        pulses = self.pulses.copy()
        pulses[motor] = min(max(int(width), NEUTRAL - HALF_RANGE), NEUTRAL + HALF_RANGE)
        self._output(pulses)
        return ACCEPTED

    def _do_set_servo(self, values: list[float]) -> int:
        """Store the pulse of an output that is not a motor; it has no effect here."""
        if not FIRST_RELAY <= values[0] <= 16:
            self._statustext(INFO, f"Servo {values[0]:.0f} is a motor's")
            return FAILED
        self._servos[int(values[0])] = int(min(max(values[1], 0.0), 65535.0))
        return ACCEPTED

    def _do_reboot(self, values: list[float]) -> int:
        self._rebooting = not self.armed and values[0] in (1.0, 3.0)
        return _result(self._rebooting)

    # Parameters, streams and other requests of a ground station.

    @property
    def _id(self) -> int:
        return int(self._within(self._named("SYSID_THISMAV"), 1, 255))

    def _within(self, name: str, low: float, high: float) -> float:
        """Return a parameter, which any station may have set, limited to a valid range."""
        return max(low, min(high, self.parameters[name]))

    def _on_param_request_list(self, message: Any) -> None:
        self._greet()
        self._requested_parameters = deque(self._table)

    def _on_param_request_read(self, message: Any) -> None:
        names = dict(enumerate(self._table))
        name = message.param_id if message.param_index == -1 else names.get(message.param_index)
        if name in self._table:
            self._send_parameter(name)

    def _on_param_set(self, message: Any) -> None:
        if message.param_id in self._table and math.isfinite(message.param_value):
            self._store(message.param_id, message.param_value)
            self._send_parameter(message.param_id)

    def _store(self, name: str, value: float) -> None:
        kind = self._table[name][0]
        if kind != REAL32:
            value = float(int(max(-LIMITS[kind], min(LIMITS[kind], value))))
        self.parameters[name], self._driven = value, ()
        self._mav.srcSystem = self._id
        if name.removeprefix("SR0_") in GROUPS and name.startswith("SR0_"):
            self._stream(name.removeprefix("SR0_"), value)

    def _send_parameter(self, name: str) -> None:
        index, kind = self._index[name], self._table[name][0]
        self._send("param_value", name.encode(), self.parameters[name], kind, len(self._table), index)

    def _on_request_data_stream(self, message: Any) -> None:
        for group, (number, _) in GROUPS.items():
            if message.req_stream_id in (0, number):
                self._stream(group, message.req_message_rate * message.start_stop)

    def _stream(self, group: str, rate: float) -> None:
        for name in GROUPS[group][1].split():
            self._every(name, 1.0 / rate if rate > 0.0 else 0.0)

    def _every(self, name: str, interval: float) -> None:
        """Send a message at an interval [s]; 0 or a negative value stops it."""
        if interval > 0.0:
            self._interval[name] = max(interval, 0.0025)
            self._due.setdefault(name, self._now)
        else:
            self._interval.pop(name, None)
            self._due.pop(name, None)

    def _on_mission_request_list(self, message: Any) -> None:
        self._send("mission_count", *self._sender, 0, message.mission_type)

    def _on_mission_clear_all(self, message: Any) -> None:
        self._send("mission_ack", *self._sender, mavlink.MAV_MISSION_ACCEPTED, message.mission_type)

    def _on_file_transfer_protocol(self, message: Any) -> None:
        """Refuse, so that the client does not wait: parameters are sent on PARAM_REQUEST_LIST."""
        sequence, session, opcode = struct.unpack_from("<HBB", bytes(message.payload))
        fields = (sequence + 1) & 0xFFFF, session, FTP_NAK, 1, opcode, 0, 0, FTP_UNKNOWN
        payload = struct.pack("<HBBBBHIB", *fields).ljust(251, b"\0")
        self._send("file_transfer_protocol", 0, *self._sender, list(payload))

    def _on_timesync(self, message: Any) -> None:
        if message.tc1 == 0:
            self._send("timesync", round(1e9 * (self._now - self._boot)), message.ts1)

    def _on_setup_signing(self, message: Any) -> None:
        if not self.armed:
            self.sign(bytes(message.secret_key) if any(message.secret_key) else b"")

    def sign(self, key: bytes) -> None:
        """Sign all messages with a key of 32 bytes from now on, and refuse unsigned ones; an empty key ends both."""
        signing, self._key = self._mav.signing, key
        signing.secret_key, signing.sign_outgoing, signing.link_id = key or None, bool(key), 1

    def _on_set_gps_global_origin(self, message: Any) -> None:
        self._origin_at = self._now if self._origin is None else self._origin_at
        self._origin = (message.latitude, message.longitude)
        self._report("gps_global_origin")

    # Telemetry.

    def _send(self, name: str, *fields: Any) -> None:
        """Queue a message for sending, by its name in lower case and its fields in MAVLink's order."""
        self._mav.send(getattr(mavlink, f"MAVLink_{name}_message")(*fields))

    def _statustext(self, severity: int, text: str) -> None:
        self._send("statustext", severity, text.encode()[:50])

    def _greet(self) -> None:
        self._statustext(INFO, "ArduSub V{}.{}.{} (FinsSim)".format(*self._version))
        self._statustext(INFO, f"Frame: {self._mixer.autopilot.name}")

    def _reporter(self, name: str) -> Callable[[], tuple[Any, ...]] | None:
        """Return the function that computes the fields of one or several messages, by the name of the message."""
        constant = (lambda: CONSTANT[name]) if name in CONSTANT else None
        return getattr(self, f"_report_{name}", constant)

    def _report(self, name: str) -> bool:
        """Send a message with current values, if there are any; return False if the message does not exist."""
        reporter = self._reporter(name)
        if reporter is None:
            return False
        fields = reporter() if self._sample is not None or name in WITHOUT_SAMPLE else ()
        for message in fields if fields and isinstance(fields[0], tuple) else [fields]:
            if message:
                self._send(name, *message)
        return True

    @property
    def _milliseconds(self) -> int:
        """Return the time of its own clock, modulo 2^32 [ms]."""
        rate = 1000.0 * (1.0 + 1e-6 * self._spec.crystal_ppm)
        return (self._clock_start + int(rate * (self._now - self._boot))) & 0xFFFFFFFF

    def _spoiled(self, values: Any, *fields: str) -> list[float]:
        """Return the numbers, or NaN if a fault concerns one of these fields."""
        field = self._faults.nan_field.partition(".")[0] if self._faults else ""
        return [math.nan if field in fields else float(value) for value in values]

    def _report_heartbeat(self) -> tuple[Any, ...]:
        if self._faults and self._faults.autopilot.no_heartbeat:
            return ()
        state = mavlink.MAV_STATE_ACTIVE if self.armed else mavlink.MAV_STATE_STANDBY
        kind = mavlink.MAV_TYPE_SUBMARINE, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
        return (
            *kind,
            209 if self.armed else 81,
            self.mode,
            mavlink.MAV_STATE_CRITICAL if self._failsafes - {"leak"} else state,
            3,
        )

    def _report_autopilot_version(self) -> tuple[Any, ...]:
        major, minor, patch = self._version
        version = major << 24 | minor << 16 | patch << 8 | 255
        return CAPABILITIES, version, 0, 0, 0, list(b"FinsSim\0"), [0] * 8, [0] * 8, 0, 0, 0

    def _report_attitude(self) -> tuple[Any, ...]:
        rates = self._spoiled(self._rates, "gyro")
        return (self._milliseconds, *self._spoiled(self._attitude, "quaternion"), *rates)

    def _report_attitude_quaternion(self) -> tuple[Any, ...]:
        x, y, z, w = self._spoiled(self._quaternion, "quaternion")
        return (self._milliseconds, w, x, y, z, *self._spoiled(self._rates, "gyro"))

    def _imu(self) -> list[int]:
        """Return specific force [mg], rates with their bias [mrad/s], and no magnetic field."""
        values = [*(1000.0 / STANDARD_GRAVITY * self._force), *(1000.0 * self._gyro), 0.0, 0.0, 0.0]
        return [_int16(value) for value in values]

    def _report_raw_imu(self) -> tuple[Any, ...]:
        return (1000 * self._milliseconds, *self._imu())

    def _report_scaled_imu2(self) -> tuple[Any, ...]:
        return (self._milliseconds, *self._imu())

    _report_scaled_imu3 = _report_scaled_imu2

    def _report_scaled_pressure(self) -> tuple[Any, ...]:
        """Return the fields of the barometer inside the hull."""
        return self._milliseconds, 0.01 * STANDARD_ATMOSPHERE, 0.0, 3500

    def _report_scaled_pressure2(self) -> tuple[Any, ...]:
        assert self._sample is not None
        pressure = self._spoiled([0.01 * self._sample.pressure], "depth", "pressure")
        return (self._milliseconds, *pressure, 0.0, 2000)

    def _report_ahrs(self) -> tuple[Any, ...]:
        return (*(FRD @ np.array(self._filter.bias)).tolist(), 0.0, 0.0, 0.0, 0.0)

    def _report_ahrs2(self) -> tuple[Any, ...]:
        return (*self._spoiled(self._attitude, "quaternion"), self._altitude, *(self._origin or (0, 0)))

    def _report_nav_controller_output(self) -> tuple[Any, ...]:
        heading = 0.0 if self._attitude_loop.heading is None else math.degrees(self._attitude_loop.heading)
        height = self._altitude if self._depth_loop.height is None else self._depth_loop.height
        return 0.0, 0.0, round(heading), 0, 0, height - self._altitude, 0.0, 0.0

    def _report_vibration(self) -> tuple[Any, ...]:
        return 1000 * self._milliseconds, 0.0, 0.0, 0.0, 0, 0, 0

    def _report_gps_global_origin(self) -> tuple[Any, ...]:
        return () if self._origin is None else (*self._origin, 0)

    def _report_home_position(self) -> tuple[Any, ...]:
        if self._origin is None:
            return ()
        return (*self._origin, 0, 0.0, 0.0, 0.0, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0)

    def _report_vfr_hud(self) -> tuple[Any, ...]:
        throttle = int(50.0 + 50.0 * max(-1.0, min(1.0, self._demands()[3]))) if self.armed else 0
        speed = float(np.hypot(*self._velocity)) if self._has_position else 0.0
        altitude = self._spoiled([self._altitude], "depth", "pressure")
        return (0.0, speed, int(math.degrees(self._attitude[2])) % 360, throttle, *altitude, self._climb)

    @property
    def _has_position(self) -> bool:
        aided = self._now - self._aided_since >= self._spec.aiding_delay
        return self._origin is not None and aided and self._now - self._velocity_time < POSITION_LASTS

    def leap(self, north: float, east: float) -> None:
        """Shift the autopilot's own position, as a reset of its filter does; both are lengths [m]."""
        self._position = self._position + (north, east)

    def _report_local_position_ned(self) -> tuple[Any, ...]:
        if not self._has_position:
            return ()
        lag = self._faults.autopilot.position_lag if self._faults else 0.0
        _, position, velocity = next(
            place for place in self._places if place[0] >= self._sampled - lag - 1e-9
        )
        return (self._milliseconds, *position, -self._altitude, *velocity, -self._climb)

    def _report_global_position_int(self) -> tuple[Any, ...]:
        latitude, longitude = self._origin or (0, 0)
        narrow = max(math.cos(math.radians(1e-7 * latitude)), 0.01)
        north, east = 1e7 / METRES_PER_DEGREE * self._position / (1.0, narrow)
        height, heading = (
            round(1000.0 * self._altitude),
            round(100.0 * math.degrees(self._attitude[2])) % 36000,
        )
        position = _int32(latitude + north), _int32(longitude + east), height, height
        speed = [_int16(100.0 * v) for v in (*self._velocity, -self._climb)]
        return (self._milliseconds, *position, *speed, heading)

    def _report_ekf_status_report(self) -> tuple[Any, ...]:
        flags = mavlink.EKF_ATTITUDE | mavlink.EKF_VELOCITY_VERT | mavlink.EKF_POS_VERT_ABS
        horizontal = mavlink.EKF_VELOCITY_HORIZ | mavlink.EKF_POS_HORIZ_REL | mavlink.EKF_POS_HORIZ_ABS
        return (
            flags | (horizontal if self._has_position else mavlink.EKF_CONST_POS_MODE),
            0.1,
            0.1,
            0.1,
            0.1,
            0.0,
        )

    def _power(self) -> tuple[int, int, int]:
        """Return voltage [mV], current [cA] and remaining charge [%]."""
        voltage, current = self._battery
        remaining = max(0.0, 1.0 - self._used / max(self.parameters["BATT_CAPACITY"], 1.0))
        return round(1000.0 * voltage), _int16(100.0 * current), round(100.0 * remaining)

    def _report_sys_status(self) -> tuple[Any, ...]:
        present = SENSORS | (mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG if self._has_compass else 0)
        enabled = present if self.armed else present & ~mavlink.MAV_SYS_STATUS_SENSOR_MOTOR_OUTPUTS
        healthy = present | mavlink.MAV_SYS_STATUS_GEOFENCE
        healthy &= ~mavlink.MAV_SYS_STATUS_SENSOR_BATTERY if "battery" in self._failsafes else -1
        healthy &= ~mavlink.MAV_SYS_STATUS_PREARM_CHECK if self._unfit() else -1
        return (present, enabled, healthy, 100, *self._power(), *[0] * 6)

    def _report_battery_status(self) -> tuple[Any, ...]:
        voltage, current, remaining = self._power()
        return 0, 0, 0, 32767, [voltage, *[65535] * 9], current, round(self._used), -1, remaining

    def _report_system_time(self) -> tuple[Any, ...]:
        return 0, self._milliseconds

    def _report_named_value_float(self) -> tuple[Any, ...]:
        values = dict.fromkeys(("TetherTrn", "Lights1", "Lights2", "InputHold", "RollPitch", "RFTarget"), 0.0)
        values |= {"CamTilt": 0.5, "CamPan": 0.5, "PilotGain": self._gain}
        return tuple((self._milliseconds, name.encode(), value) for name, value in values.items())

    def _report_servo_output_raw(self) -> tuple[Any, ...]:
        pulses = [round(pulse) for pulse in self.pulses.tolist()]
        servos = [self._servos.get(i + 1, 0) for i in range(len(pulses), 16)]
        return (1000 * self._milliseconds & 0xFFFFFFFF, 0, *pulses, *servos)

    def _report_rc_channels(self) -> tuple[Any, ...]:
        return (self._milliseconds, 18, *self._inputs, 0)


COMMANDS: dict[int, Callable[[ArduSub, list[float]], int | None]] = {
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM: ArduSub._do_arm,
    mavlink.MAV_CMD_DO_SET_MODE: ArduSub._do_set_mode,
    mavlink.MAV_CMD_NAV_LAND: lambda it, values: _result(it._set_mode(SURFACE)),
    mavlink.MAV_CMD_NAV_LOITER_UNLIM: lambda it, values: _result(it._set_mode(POSHOLD)),
    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: ArduSub._do_set_interval,
    mavlink.MAV_CMD_GET_MESSAGE_INTERVAL: ArduSub._do_get_interval,
    mavlink.MAV_CMD_REQUEST_MESSAGE: lambda it, values: _result(it._report(_name(values[0]))),
    mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: lambda it, values: _result(
        values[0] == 1.0 and it._report("autopilot_version")
    ),
    mavlink.MAV_CMD_REQUEST_PROTOCOL_VERSION: ArduSub._do_request_protocol,
    mavlink.MAV_CMD_GET_HOME_POSITION: lambda it, values: _result(
        it._origin is not None and it._report("home_position")
    ),
    mavlink.MAV_CMD_DO_SET_HOME: lambda it, values: _result(it._has_position),
    mavlink.MAV_CMD_PREFLIGHT_CALIBRATION: ArduSub._do_calibrate,
    mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: ArduSub._do_reboot,
    mavlink.MAV_CMD_DO_MOTOR_TEST: ArduSub._do_motor_test,
    mavlink.MAV_CMD_DO_SET_SERVO: ArduSub._do_set_servo,
}
"""Commands -> functions that perform them; others are answered by `ANSWERS`, or as unsupported."""


def _result(done: bool) -> int:
    return ACCEPTED if done else FAILED


def _name(number: float) -> str:
    """Return the name of a message by its number, in lower case; empty if there is none."""
    kind = mavlink.mavlink_map.get(int(number))
    return "" if kind is None else kind.msgname.lower()


def _wrapped(value: int) -> int:
    """Return an integer wrapped to 16 bits."""
    return (value + 2**15) % 2**16 - 2**15


def _int16(value: float) -> int:
    return max(-(2**15), min(2**15 - 1, round(value)))


def _int32(value: float) -> int:
    return max(-(2**31), min(2**31 - 1, round(value)))
