"""The link to an autopilot: ArduSub's MAVLink 2 as the robot's own messages, thrusts as the axes of its mixer.

Outputs are the axes of MANUAL_CONTROL, or pulses of RC_CHANNELS_OVERRIDE if the firmware is older than 4.5 or its pilot
gain is less than the vehicle file's. The bridge stays in control: the vehicle is armed only if the bridge may arm, and
another pilot who arms, steers or changes the mode ends it; manual steering takes precedence at once.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from finssim.control.ardusub import FULL, NEUTRAL, Mixer
from finssim.control.motor_map import MotorMap
from finssim.core.frames import FROM_FOSSEN
from finssim.core.rotations import quat_from_euler, quat_inverse_rotate, quat_to_matrix
from finssim.robot.links.frames import LinkError, Message
from finssim.robot.links.water_linked import decode_line
from finssim.robot.messages import HEADING, POSITION, VELOCITY, NavigationAid, Telemetry, ThrusterCommand
from finssim.vehicles import Vehicle

__all__ = ["MODES", "MavlinkLink"]

MODES = {
    0: "STABILIZE", 1: "ACRO", 2: "ALT_HOLD", 3: "AUTO", 4: "GUIDED", 7: "CIRCLE", 9: "SURFACE", 16: "POSHOLD",
    19: "MANUAL", 20: "MOTOR_DETECT", 21: "SURFTRAK",
}  # fmt: skip
"""Names of ArduSub's modes by the number in HEARTBEAT.custom_mode."""
MANUAL = 19
VEHICLE, GROUND = (1, 1), 255
"""System and component of the autopilot, and system of a ground station that ArduSub accepts as pilot."""

INTERVALS = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: 0.2,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 0.02,
    mavlink.MAVLINK_MSG_ID_RAW_IMU: 0.02,
    mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE2: 0.05,
    mavlink.MAVLINK_MSG_ID_RC_CHANNELS: 0.035,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 0.05,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: 0.2,
}
"""Requested interval of each message [s]. That of the inputs is no multiple of the usual
period of axes: two pilots take turns, and a synchronous report would show only one of them."""
SURFACES = ("BARO1_GND_PRESS", "BARO2_GND_PRESS")
"""Parameters with the pressure at the surface, of the first and of the second barometer."""
PARAMETERS = ("JS_GAIN_DEFAULT", "JS_THR_GAIN", *SURFACES)

MANUAL_PERIOD, HEARTBEAT_PERIOD, ASK_AGAIN = 0.03, 1.0, 0.5
"""Time between two frames of axes, two heartbeats, and two attempts at the same request [s]."""
REQUEST_LASTS = 3.0
"""Time after a request to arm before the autopilot is disarmed again, with neutral axes meanwhile [s]: an operator
presses a key twice, and `ros2 service call` takes some time."""
SELDOM, SMOOTH = 2.0, 0.2
"""Ratio of the mean to the requested interval above which a message is too rare, and weight of the newest interval in
the mean."""
PATIENCE = 3.0
"""Longest wait for version and parameters before arming [s]; without them, axes are sent as overrides."""
HEARTBEAT_LOST = 3.0
"""Longest silence of the autopilot's heartbeat [s]."""
REMEMBERED = 1.0
"""Age up to which sent inputs may still be reported as received [s]."""
STRANGE, STRANGERS, OF = 12.0, 2, 4
"""Difference from every sent input above which an input is another pilot's [µs], and how many of how many last reports
confirm it: two pilots take turns."""
OTHERS = (
    "manual control from elsewhere, or our frames are lost: the autopilot receives other inputs than ours"
)
HEADING_PERIOD = 0.2
"""Time between two headings from the autopilot's attitude [s]."""
DVL_FRESH = 1.0
"""Age of a DVL report up to which the autopilot's own velocity is not used [s]."""
CRITICAL = 5
"""HEARTBEAT.system_status from which the autopilot is in failsafe."""
AIDED, PLACED, NOT_AIDED = 2, 8 | 16, 128
"""EKF_STATUS_REPORT.flags: horizontal velocity is known; position is known, relative or absolute; a constant position
is assumed."""
AIDED_LASTS = 1.0
"""Age up to which the newest EKF_STATUS_REPORT is valid [s]."""
PLACE_STD, SPEED_STD = 0.05, 0.03
"""Standard deviations of the autopilot's position [m] and velocity [m/s], per axis: its filter lags by 0.1 to 0.2 s, at
up to 0.3 m/s²."""
LEAP = 0.1
"""Step of the autopilot's position, beyond its velocity, that indicates a reset of its filter [m]."""
TURN_WINDOW, TURN_LIMIT, TURN_OVER = 10.0, math.radians(4.0), math.radians(1.0)
"""Time span over which heading and gyroscope are compared [s], difference from which the autopilot is rotating its
north, and difference below which it has finished [rad]. Setting an origin rotates it by the declination in 20 s; a
vehicle that accelerates and turns shows up to 3 degrees."""
SCALE_ERROR = 0.05
"""Fraction of a turn that the gyroscope may miss [-]: 3 % at 25 °C and 2 % by temperature (MPU-6000; newer ones 1 and
2 %); the autopilot's filter estimates its bias, not its scale."""
ALIGNED = math.radians(1.0)
"""Largest step of the heading between two messages before the vehicle is armed by us, due to its motion [rad]."""
SLOW_WINDOW, SLOWEST = 3.0, 0.8
"""Time span over which the autopilot's clock is compared with ours [s], and its least rate [-]."""
ORIGIN_ASKED, ORIGIN_PERIODS = 0.5, (0.15, 1.0)
"""Time of asking for the autopilot's origin before it is taken to have none, and interval of requests before and after
that [s]."""
CALIBRATION_LASTS = 5.0
"""Longest wait for the result of a barometer calibration [s]."""
DEEPEST = 1e6
"""Greatest plausible surface pressure [Pa]."""
SHALLOW = 3000.0
"""Difference of the surface pressure from the standard atmosphere that weather can explain [Pa]."""
ACCELEROMETER_RANGE = 16000
"""Greatest acceleration in the range of the autopilots' instruments [mg]: one in 65 536 damaged frames passes the
checksum, and the estimator would use it."""
STANDARD_ATMOSPHERE = 101325.0
"""Pressure at the surface until the autopilot reports its own [Pa]."""
G = 9.80665


class MavlinkLink:
    """Link to one vehicle's autopilot. It uses no clock and no transport; received data never raise an exception.

    Attributes:
        counts: Numbers of messages by name, and `bad` for invalid ones.
        mode: Number of the autopilot's mode; None before its first heartbeat.
        armed: True if the autopilot is armed.
        says: Its newest text of at least warning severity.
        let_in: x, y of the vehicle when the autopilot first has a position, world frame [m]; None: its position is not
            used.
        calibrate_depth: True to calibrate the barometer, with the vehicle at the surface, before any telemetry.
        highest: Greatest z of the guide, world frame [m]; -inf if unknown.
        notes: Sentences for the user since they were last read.
    """

    peer = "autopilot"
    # Its accelerations are rounded to milli-g, so a quiet instrument repeats them; attitude and rates do not repeat.
    watched: tuple[tuple[str, ...], ...] = (("quaternion", "gyro"),)

    def __init__(self, vehicle: Vehicle, *, key: bytes = b"") -> None:
        """Set up the link.

        Args:
            vehicle: Vehicle with an `autopilot`; its IMU's axes are the autopilot's, forward, left, up.
            key: Signing key of 32 bytes: frames are signed, and unsigned ones refused. Empty: no signing.

        Raises:
            ControlError: The vehicle has no autopilot, or thrusters without `esc`.
            LinkError: The key has another length.
        """
        self._mixer, self._motors, self.vehicle = Mixer.of(vehicle), MotorMap.from_vehicle(vehicle), vehicle
        imu, log = vehicle.sensors.imu, vehicle.sensors.dvl
        # The autopilot's velocity is that of the body; ours is that of the vehicle's DVL.
        self._R_lb = quat_to_matrix(log.orientation).T if log else np.eye(3)
        self._lever = log.position if log else np.zeros(3)
        if imu is not None and abs(imu.orientation[3]) < 1.0 - 1e-6:
            raise LinkError(
                f"{vehicle.name}: sensors.imu.orientation is {imu.orientation.tolist()}, expected 0, 0, 0, 1: an "
                "autopilot reports attitude and rates in the vehicle's own axes (set AHRS_ORIENTATION there)"
            )
        self._wire: Any = mavlink.MAVLink(
            None, srcSystem=GROUND, srcComponent=mavlink.MAV_COMP_ID_MISSIONPLANNER
        )
        self._wire.robust_parsing = True
        if key:
            if len(key) != 32:
                raise LinkError(f"the signing key has {len(key)} bytes, expected 32")
            self._wire.signing.secret_key, self._wire.signing.sign_outgoing = key, True
            self._wire.signing.allow_unsigned_callback = None
        self.counts: Counter[str] = Counter()
        self.let_in: tuple[float, float] | None = None
        self.calibrate_depth, self.highest = False, -math.inf
        self.notes: list[str] = []
        self._handlers: dict[str, Callable[[float, Any], list[Message]]] = {
            "HEARTBEAT": self._heartbeat,
            "ATTITUDE": self._attitude,
            "RAW_IMU": self._raw_imu,
            "SCALED_PRESSURE2": self._pressure2,
            "RC_CHANNELS": self._inputs,
            "LOCAL_POSITION_NED": self._place,
            "EKF_STATUS_REPORT": self._filter,
            "GPS_GLOBAL_ORIGIN": self._global_origin,
            "PARAM_VALUE": self._parameter,
            "NAMED_VALUE_FLOAT": self._value,
            "AUTOPILOT_VERSION": self._software,
            "COMMAND_ACK": self._answered,
            "STATUSTEXT": self._said,
        }
        self._forget()

    def _forget(self) -> None:
        """Reset to the state before the autopilot's first message."""
        self.mode: int | None = None
        self.armed, self.says, self._failing = False, "", False
        self._alive = self._boot_ms = -math.inf
        self._accel: tuple[float, float, float] | None = None
        self._q, self._omega = np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3)
        self._pressure, self._surface = math.nan, STANDARD_ATMOSPHERE
        self._begun = False
        self._placed_at, self._shift = -math.inf, np.zeros(3)
        self._world: Any = None
        self._last_place: tuple[float, Any] | None = None
        self._origin, self._turn_began = "", -math.inf
        self._critical = ""
        # Rotation of the autopilot's north relative to that of the start, and data for the comparison.
        self._north = self._first_north = 0.0
        self._ahead = False  # world x is the heading of the start
        self._turns, self._turning, self._spun = deque[tuple[float, float, float]](), False, 0.0
        self._soonest = math.inf
        self._clocks: deque[tuple[float, float]] = deque()
        self._calibrated = ""
        self._sequence = self._aids = 0
        self._heading_at = self._dvl_at = self._aided_at = -math.inf
        self._parameters: dict[str, float] = {}
        self._version: tuple[int, int] | None = None
        self._gain = math.nan
        self._asked: dict[Any, float] = {}
        self._seen: dict[int, float] = {}
        self._gap: dict[int, float] = {}
        self._refused = ""
        self._ours = self._others = False
        self._wanted = self._released = -math.inf
        self._sent: deque[tuple[float, tuple[float, ...]]] = deque(maxlen=128)
        self._strange: deque[bool] = deque(maxlen=OF)
        self._manual_at = self._heartbeat_at = -math.inf

    # -- inputs -----------------------------------------------------------------------------------------------------

    def feed(self, now: float, data: bytes) -> list[Message]:
        """Return the messages completed by received bytes: MAVLink, or a line of a Water Linked DVL, which begins with
        a brace.

        Args:
            now: Time of arrival [s].
            data: A datagram, a piece of a stream, or a line.
        """
        if data[:1] == b"{":
            report = decode_line(data, self.counts)
            if report is None:
                return []
            self._dvl_at = now
            return [self._numbered(report.kind, report.age, report.values)]
        completed: list[Message] = []
        try:
            messages = self._wire.parse_buffer(data) or []
        except Exception:  # pymavlink raises various exceptions for invalid data
            self.counts["bad"] += 1
            return completed
        for message in messages:
            kind = message.get_type()
            if kind == "BAD_DATA" or kind.startswith("UNKNOWN"):
                self.counts["bad"] += 1
                continue
            self.counts[kind] += 1
            if (message.get_srcSystem(), message.get_srcComponent()) == VEHICLE and kind in self._handlers:
                number = message.get_msgId()
                gap = now - self._seen.get(number, -math.inf)
                before = self._gap.get(number, gap)
                self._gap[number] = gap if not math.isfinite(before) else before + SMOOTH * (gap - before)
                self._seen[number] = now
                completed += self._handlers[kind](now, message)
        return completed

    def _numbered(
        self, kind: int, age: float, values: Any, std: tuple[float, float] = (0.0, 0.0)
    ) -> NavigationAid:
        self._aids += 1
        return NavigationAid(self._aids & 0xFFFF, kind, age, values, std)

    def _heartbeat(self, now: float, m: Any) -> list[Message]:
        self._alive, self.mode = now, int(m.custom_mode)
        self.armed = bool(m.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        self._failing = m.system_status >= CRITICAL
        return []

    def _attitude(self, now: float, m: Any) -> list[Message]:
        """Return telemetry with the newest specific force and pressure, and at intervals the heading."""
        values = (m.roll, m.pitch, m.yaw, m.rollspeed, m.pitchspeed, m.yawspeed)
        if self._accel is None or not all(map(math.isfinite, (*values, self._pressure))):
            return []
        if m.time_boot_ms < self._boot_ms - 1000:  # it restarted: the state of its requests is discarded
            self._asked.clear()
            self._seen.clear()
            self._gap.clear()
            self._clocks.clear()
            self._turns.clear()
            self._boot_ms, self._soonest, self._last_place = -math.inf, math.inf, None
        if not self._begun and not all((self._knows_surface(now), self._knows_origin(now))):
            return []
        if not self._begun and self._origin == "none":
            # Its north is magnetic and may rotate: world x is the vehicle's initial heading instead.
            self._north = self._first_north = float(m.yaw)
            self._ahead = True
            self.notes.append("the autopilot has no origin: world x is where the vehicle points now")
        self._begun = True
        if m.time_boot_ms == self._boot_ms:  # a repeated sample is not new data
            return []
        step = 0.001 * (m.time_boot_ms - self._boot_ms)
        self._boot_ms = max(self._boot_ms, m.time_boot_ms)
        self._soonest = min(self._soonest, now - 0.001 * m.time_boot_ms)
        self._watch_clock(now, 0.001 * m.time_boot_ms)
        self._watch_north(m, step)
        q = self._q = quat_from_euler(m.roll, -m.pitch, -(m.yaw - self._north))
        gyro = self._omega = FROM_FOSSEN.vector([m.rollspeed, m.pitchspeed, m.yawspeed])
        x, y, z, w = q.tolist()
        self._sequence = self._sequence + 1 & 0xFFFF
        depth = (self._pressure - self._surface) / (self.vehicle.water.density * self.vehicle.water.gravity)
        p, r, s = gyro.tolist()
        messages: list[Message] = [
            Telemetry(
                sequence=self._sequence,
                mcu_ms=int(m.time_boot_ms),
                quaternion=(x, y, z, w),
                gyro=(p, r, s),
                accel=self._accel,
                depth=depth,
                pressure=self._pressure,
                flags=0,
                motor_rpm=None,
            )
        ]
        if self.vehicle.sensors.compass is not None and now - self._heading_at >= HEADING_PERIOD:
            self._heading_at = now
            age = self._age(now, m.time_boot_ms)
            messages.append(self._numbered(HEADING, age, (self._north - float(m.yaw), 0.0, 0.0)))
        return messages

    def _knows_surface(self, now: float) -> bool:
        """Return whether depth will have no further step: its surface pressure is known, or the autopilot does not
        answer."""
        if self.calibrate_depth and not self._calibrated:
            return False
        return set(SURFACES) <= self._parameters.keys() or now - self._first(now, "surface") > PATIENCE

    def _knows_origin(self, now: float) -> bool:
        """Return whether it is known if the autopilot has an origin."""
        if not self._origin and now - self._first(now, "origin") > ORIGIN_ASKED:
            self._origin = "none"
        return bool(self._origin)

    def _watch_clock(self, now: float, boot: float) -> None:
        """Store pairs of our time and the autopilot's [s] over `SLOW_WINDOW`."""
        self._clocks.append((now, boot))
        while now - self._clocks[0][0] > SLOW_WINDOW:
            self._clocks.popleft()

    def _turn_begins(self, time: float) -> None:
        self._turning, self._turn_began = True, time
        self.notes.append("the autopilot turns its north: an origin was set, or its heading was reset")

    def _global_origin(self, now: float, m: Any) -> list[Message]:
        """Process an origin; a new one rotates the heading from magnetic to true north."""
        if self._origin == "none" and math.isfinite(self._boot_ms):
            self._turn_begins(0.001 * self._boot_ms)
        self._origin = "set"
        return []

    @property
    def clock_rate(self) -> float:
        """Rate of the autopilot's clock relative to ours [-]; NaN while unknown."""
        if not self._clocks or self._clocks[-1][0] - self._clocks[0][0] < 0.5 * SLOW_WINDOW:
            return math.nan
        (a, x), (b, y) = self._clocks[0], self._clocks[-1]
        return (y - x) / (b - a)

    def _watch_north(self, m: Any, step: float) -> None:
        """Compare the heading with the integrated rates.

        A rotation of the autopilot's north is waited for before arming, and removed from the heading afterwards: the
        world frame is that of the arming, or that of the start if world x is the initial heading. For a vehicle that
        spins, a difference of `SCALE_ERROR` of its rotation does not count.
        """
        if not 0.0 < step < 0.5:
            self._turns.clear()
        else:
            # ψ̇ = (q sin φ + r cos φ) / cos θ (Fossen 2021, Eq. 2.29)
            up = m.pitchspeed * math.sin(m.roll) + m.yawspeed * math.cos(m.roll)
            self._spun += step * up / max(math.cos(m.pitch), 0.1)
        time, turn = 0.001 * m.time_boot_ms, m.yaw - self._spun
        if self._turns:
            turn = self._turns[-1][1] + math.remainder(turn - self._turns[-1][1], math.tau)
            if not self._ours and abs(turn - self._turns[-1][1]) > ALIGNED:
                self._north += (turn - self._turns[-1][1]) * self._ahead
                self._turns.clear()  # a compass that is read for the first time
        self._turns.append((time, turn, self._spun))
        while time - self._turns[0][0] > TURN_WINDOW:
            self._turns.popleft()
        if time - self._turns[0][0] < 0.9 * TURN_WINDOW:
            return
        kept = self._ours or self._ahead
        turned, missed = turn - self._turns[0][1], SCALE_ERROR * abs(self._spun - self._turns[0][2])
        if not self._turning and abs(turned) > TURN_LIMIT + missed:
            self._north += turned * kept
            self._turn_begins(time)
        elif self._turning:
            self._north += (turn - self._turns[-2][1]) * kept
            if abs(turned) < TURN_OVER + missed and time - self._turn_began > TURN_WINDOW:
                self._turning = False
                self.notes.append(
                    f"the autopilot's north has turned by {math.degrees(self._north - self._first_north):.1f} degrees"
                )

    def _raw_imu(self, now: float, m: Any) -> list[Message]:
        if max(abs(m.xacc), abs(m.yacc), abs(m.zacc)) > ACCELEROMETER_RANGE:
            self.counts["implausible"] += 1
            return []
        x, y, z = (0.001 * G * FROM_FOSSEN.vector([m.xacc, m.yacc, m.zacc])).tolist()
        self._accel = (x, y, z)
        return []

    def _pressure2(self, now: float, m: Any) -> list[Message]:
        self._pressure = 100.0 * m.press_abs
        return []

    def _age(self, now: float, boot_ms: float) -> float:
        """Return the time since the autopilot stamped a message, minus the least delay of the link [s]."""
        return (
            min(max(now - 0.001 * boot_ms - self._soonest, 0.0), 1.0) if math.isfinite(self._soonest) else 0.0
        )

    def _inputs(self, now: float, m: Any) -> list[Message]:
        """Compare the inputs that the autopilot received with the sent ones, to detect another pilot."""
        if not self._sent or now - self._sent[-1][0] > REMEMBERED:
            return []
        inputs = np.array([getattr(m, f"chan{i}_raw") for i in range(1, 7)], float)
        ours = [
            np.abs(inputs - pulses).max() < STRANGE for at, pulses in self._sent if now - at <= REMEMBERED
        ]
        self._strange.append(not any(ours))
        self._others = self._others or sum(self._strange) >= STRANGERS
        return []

    def _place(self, now: float, m: Any) -> list[Message]:
        """Return the autopilot's own velocity and position, if it has them and no DVL reports.

        The position is relative: it begins at `let_in`, and a reset of the autopilot's filter does not change it.
        """
        known = now - self._aided_at < AIDED_LASTS and all(
            map(math.isfinite, (m.vx, m.vy, m.vz, m.x, m.y, m.z))
        )
        if now - self._dvl_at < DVL_FRESH or not known or self._turning:
            self._last_place = None
            return []
        cos, sin = math.cos(self._north), math.sin(self._north)
        level = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        v = level @ FROM_FOSSEN.vector([m.vx, m.vy, m.vz])
        p, age = level @ FROM_FOSSEN.vector([m.x, m.y, m.z]), self._age(now, m.time_boot_ms)
        read = self._R_lb @ (quat_inverse_rotate(self._q, v) + np.cross(self._omega, self._lever))
        found: list[Message] = [self._numbered(VELOCITY, age, tuple(read.tolist()), (SPEED_STD, 0.0))]
        if self.let_in is None or now - self._placed_at > AIDED_LASTS:
            return found
        time = 0.001 * m.time_boot_ms
        if self._last_place is None:  # the first one after a gap continues from the last one
            self._shift = (np.array([*self.let_in, 0.0]) if self._world is None else self._world) - p
        else:
            before, old = self._last_place
            leap = p - old - (time - before) * v
            if np.linalg.norm(leap[:2]) > LEAP:
                self.counts["position reset"] += 1
                self.notes.append(
                    f"the autopilot moved its position by {np.linalg.norm(leap[:2]):.2f} m: ignored"
                )
                self._shift = self._shift - leap
        self._last_place = time, p
        self._world = p + self._shift
        x, y, z = self._world.tolist()
        return [*found, self._numbered(POSITION, age, (x, y, z), (PLACE_STD, 0.0))]

    def _filter(self, now: float, m: Any) -> list[Message]:
        if m.flags & AIDED and not m.flags & NOT_AIDED:
            self._aided_at = now
            self._placed_at = now if m.flags & PLACED else self._placed_at
        return []

    def _parameter(self, now: float, m: Any) -> list[Message]:
        if math.isfinite(m.param_value):
            self._parameters[m.param_id] = float(m.param_value)
        if m.param_id.endswith("_GND_PRESS") and 5e4 < m.param_value < DEEPEST:
            # If there are two barometers, the second is the Bar30; otherwise it is the first.
            first = "BARO2_GND_PRESS" not in self._parameters or m.param_id == "BARO2_GND_PRESS"
            self._surface = float(m.param_value) if first else self._surface
            if first and abs(self._surface - STANDARD_ATMOSPHERE) > SHALLOW:
                self.notes.append(
                    f"depth counts from {self._zero}, where the barometer was calibrated: bring the vehicle to the "
                    "surface and give --calibrate-depth"
                )
        return []

    @property
    def depth_offset(self) -> float:
        """Depth at which the barometer was calibrated, by the standard atmosphere [m]."""
        weight = self.vehicle.water.density * self.vehicle.water.gravity
        return (self._surface - STANDARD_ATMOSPHERE) / weight

    @property
    def _zero(self) -> str:
        side = "below" if self.depth_offset > 0.0 else "above"
        return f"{abs(self.depth_offset):.1f} m {side} the surface"

    def _value(self, now: float, m: Any) -> list[Message]:
        if m.name == "PilotGain" and 0.0 < m.value <= 1.0:
            self._gain = float(m.value)
        return []

    def _software(self, now: float, m: Any) -> list[Message]:
        self._version = (m.flight_sw_version >> 24 & 0xFF, m.flight_sw_version >> 16 & 0xFF)
        return []

    def _answered(self, now: float, m: Any) -> list[Message]:
        if m.command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM and m.result != mavlink.MAV_RESULT_ACCEPTED:
            self._refused = self.says or f"result {m.result}"
        if m.command == mavlink.MAV_CMD_PREFLIGHT_CALIBRATION and not self._calibrated:
            done = m.result == mavlink.MAV_RESULT_ACCEPTED
            self._calibrated = (
                "done" if done else f"the autopilot does not calibrate its barometer: result {m.result}"
            )
            for name in SURFACES:  # read again
                self._parameters.pop(name, None)
                self._asked.pop(("first", name), None)
        return []

    def _said(self, now: float, m: Any) -> list[Message]:
        if m.severity <= mavlink.MAV_SEVERITY_WARNING:
            self.says = " ".join(str(m.text).split())[:100]
            self._critical = self.says if m.severity <= mavlink.MAV_SEVERITY_CRITICAL else self._critical
        return []

    # -- arming and monitoring --------------------------------------------------------------------------------------

    def prepare(self, now: float) -> str:
        """Bring the autopilot to a state that accepts commands: mode MANUAL, armed. Call only when about to arm.

        `now` is the time [s].

        Returns:
            "" once it is ready; until then a sentence that states what is missing.
        """
        if now - self._alive > HEARTBEAT_LOST:
            return "the autopilot has sent no heartbeat yet"
        unknown = self._version is None or "JS_GAIN_DEFAULT" not in self._parameters
        if unknown and now - self._first(now, "known") < PATIENCE:
            return "waiting for the autopilot's version and parameters"
        if self.calibrate_depth and self._calibrated != "done":
            return self._calibrated
        above = self.highest - self.depth_offset
        if above > 0.0 and abs(self._surface - STANDARD_ATMOSPHERE) > SHALLOW and not self._calibrated:
            return (
                f"a depth of {-self.highest:.2f} m is {above:.2f} m above the surface, since the autopilot counts "
                f"depth from {self._zero}: bring the vehicle to the surface and give --calibrate-depth, or a goal "
                f"below {-self.depth_offset:.2f} m"
            )
        if self.let_in is not None and now - max(self._dvl_at, self._aided_at) > AIDED_LASTS:
            return (
                "waiting for the autopilot's velocity: it needs a Doppler log for half a minute, and an origin; or "
                "connect to the log with ?dvl=HOST"
            )
        if now - self._released < ASK_AGAIN:  # its heartbeats may be older than the request
            return "waiting for it to disarm first"
        if now - self._wanted > ASK_AGAIN:  # a new attempt: the result of the last one is discarded
            self._others, self._refused = False, ""
            self._strange.clear()
        self._wanted = now
        if self._others:
            return OTHERS
        if self.mode != MANUAL:
            return f"waiting for the autopilot to leave {_mode(self.mode)} for MANUAL"
        if not self.armed:
            return (
                f"the autopilot does not arm: {self._refused}" if self._refused else "waiting for it to arm"
            )
        self._wanted, self.says, self._critical = -math.inf, "", ""
        return ""

    def pause(self, now: float) -> str:
        """Return why thrust is temporarily not possible; "" otherwise. `now` is the time [s]."""
        if self.calibrate_depth and not self._calibrated:
            return "waiting for the calibration of the barometer, at the surface"
        if self._turning:
            return "the autopilot turns its north: the heading is not the one of the start"
        if self.clock_rate < SLOWEST:
            return (
                f"the autopilot's clock runs at {self.clock_rate:.2f} times ours: its simulation is too slow"
            )
        return ""

    def alarm(self, now: float) -> str:
        """Return in a sentence why the armed vehicle is no longer under our control; "" while it is.

        `now` is the time [s].
        """
        if now - self._alive > HEARTBEAT_LOST:
            return f"no heartbeat from the autopilot for {HEARTBEAT_LOST:g} s"
        if self._others:
            return OTHERS
        if self._failing:
            return f"the autopilot is in failsafe: {self.says or 'it gives no reason'}"
        if self._critical:
            return f"the autopilot reports: {self._critical}"
        if not self.armed:
            return f"the autopilot was disarmed: {self.says or 'it gives no reason'}"
        if self.mode != MANUAL:
            self._others = True
            return f"the autopilot's mode was changed to {_mode(self.mode)}"
        return ""

    # -- outputs ----------------------------------------------------------------------------------------------------

    def encode(self, now: float, command: ThrusterCommand, state: str) -> list[bytes]:
        """Return the frames to send now: axes while we are in control, and requests.

        Args:
            now: [s]
            command: Command of the bridge.
            state: State of the bridge; disarmed and fault disarm the autopilot if it was armed by us.
        """
        frames: list[bytes] = []
        if now - self._heartbeat_at >= HEARTBEAT_PERIOD - 1e-6:
            self._heartbeat_at = now
            frames.append(self._pack(_HEARTBEAT))
        if self._alive == -math.inf:
            return frames
        frames += self._questions(now)
        running, requested = state in ("armed", "hold"), now - self._wanted < REQUEST_LASTS
        if self._others or not (running or requested or self._ours):
            return frames  # another pilot controls the vehicle, or it was not requested
        if now - self._manual_at >= MANUAL_PERIOD - 1e-6 or not running:
            self._manual_at = now
            frames.append(self._axes(now, command))
        arming = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
        if running:
            self._ours = True
        elif requested and state == "disarmed":
            if self.mode != MANUAL:
                custom = float(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED)
                mode = self._command(mavlink.MAV_CMD_DO_SET_MODE, custom, float(MANUAL))
                frames += self._ask(now, "mode", ASK_AGAIN, mode)
            elif not self.armed:
                self._ours = True
                frames += self._ask(now, "arm", ASK_AGAIN, self._command(arming, 1.0))
        elif self.armed:
            self._released = now
            frames += self._ask(now, "disarm", 0.1, self._command(arming, 0.0))
        else:
            self._ours = False
        return frames

    def _axes(self, now: float, command: ThrusterCommand) -> bytes:
        """Return the frame of axes with the thrusts closest to those of a command."""
        demand = np.zeros(6)
        if command.enable:
            speeds = self._motors.canonical_rpm(np.array(command.normalised)) * self._motors.full_scale
            demand = self._mixer.demands(self._motors.force(speeds))
        gain = self._mixer.autopilot.gain
        roll, pitch, yaw, throttle, forward, lateral = np.clip(demand, -gain, gain).tolist()
        # In the order of the autopilot's inputs: pitch, roll, throttle, yaw, forward, lateral.
        current_gain = (
            self._gain if math.isfinite(self._gain) else self._parameters.get("JS_GAIN_DEFAULT", 0.0)
        )
        if self._version is not None and self._version >= (4, 5) and current_gain >= gain:
            lift = current_gain * self._parameters.get("JS_THR_GAIN", 1.0)
            x, y, r = (round(1000.0 * part / current_gain) for part in (forward, lateral, yaw))
            z, s, t = round(500.0 + 500.0 * throttle / lift), round(FULL * pitch), round(FULL * roll)
            z = min(max(z, 0), 1000)
            pulses = (
                NEUTRAL + s, NEUTRAL + t, NEUTRAL + 0.8 * lift * (z - 500), NEUTRAL + 0.4 * current_gain * r,
                NEUTRAL + 0.4 * current_gain * x, NEUTRAL + 0.4 * current_gain * y,
            )  # fmt: skip
            message = mavlink.MAVLink_manual_control_message(VEHICLE[0], x, y, z, r, 0, 0, 3, s, t)
        else:
            pulses = tuple(round(NEUTRAL + FULL * d) for d in (pitch, roll, throttle, yaw, forward, lateral))
            message = mavlink.MAVLink_rc_channels_override_message(*VEHICLE, *pulses, 65535, 65535)
        self._sent.append((now, tuple(map(float, pulses))))
        return self._pack(message)

    def _questions(self, now: float) -> list[bytes]:
        """Return repeated requests whose answers have not arrived."""
        frames: list[bytes] = []
        for message, interval in INTERVALS.items():
            # Another ground station may request its own rates: messages that are too rare are requested again.
            gap = max(self._gap.get(message, math.inf), now - self._seen.get(message, -math.inf))
            if gap > SELDOM * interval:
                ask = self._command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, float(message), 1e6 * interval)
                frames += self._ask(now, ("interval", message), 1.0, ask)
        if self.calibrate_depth and not self._calibrated:
            calibrate = self._command(mavlink.MAV_CMD_PREFLIGHT_CALIBRATION, 0.0, 0.0, 1.0)
            frames += self._ask(now, "calibrate", CALIBRATION_LASTS, calibrate)
        if self._version is None:
            version = float(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
            frames += self._ask(now, "version", 1.0, self._command(mavlink.MAV_CMD_REQUEST_MESSAGE, version))
        if self._origin != "set":
            origin = float(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)
            period = ORIGIN_PERIODS[bool(self._origin)]
            frames += self._ask(now, "origin", period, self._command(mavlink.MAV_CMD_REQUEST_MESSAGE, origin))
        for name in PARAMETERS:
            if name not in self._parameters and now - self._first(now, name) < 10.0:
                read = mavlink.MAVLink_param_request_read_message(*VEHICLE, name.encode(), -1)
                frames += self._ask(now, ("read", name), 1.0, read)
        return frames

    def _first(self, now: float, key: str) -> float:
        """Return the time of the first call with this key [s]."""
        return self._asked.setdefault(("first", key), now)

    def _ask(self, now: float, key: Any, period: float, message: Any) -> list[bytes]:
        if now - self._asked.get(key, -math.inf) < period - 1e-6:
            return []
        self._asked[key] = now
        return [self._pack(message)]

    def _command(self, command: int, *parameters: float) -> Any:
        values = [*parameters, *[0.0] * (7 - len(parameters))]
        return mavlink.MAVLink_command_long_message(*VEHICLE, command, 0, *values)

    def _pack(self, message: Any) -> bytes:
        packed = bytes(message.pack(self._wire))
        self._wire.seq = (self._wire.seq + 1) % 256
        return packed


_HEARTBEAT = mavlink.MAVLink_heartbeat_message(
    mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
)


def _mode(number: int | None) -> str:
    return "an unknown mode" if number is None else MODES.get(number, f"mode {number}")
