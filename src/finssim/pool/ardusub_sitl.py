"""`finssim ardusub-sitl`: physics for ArduPilot's own ArduSub in SITL, over its JSON interface (UDP).

SITL sends pulse widths and waits. Each new frame advances the simulation by 1 / frame_rate, and the answer contains the
state of the vehicle in ArduPilot's frames (body forward-right-down, world north-east-down; north is world x).
"""

from __future__ import annotations

import json
import logging
import math
import select
import shlex
import socket
import struct
import subprocess
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.control.ardusub import Mixer, motors_of
from finssim.control.guidance import Station
from finssim.core import realtime
from finssim.core.frames import TO_FOSSEN, wxyz_from_xyzw
from finssim.core.rotations import cross, matrix_to_quat, quat_from_yaw, quat_to_euler, quat_to_matrix
from finssim.pool.plant_spec import HOME, Battery, PlantSpecError
from finssim.robot.goals import station_of
from finssim.robot.interrupt import interrupting
from finssim.robot.links.frames import LinkError
from finssim.robot.links.transports import TcpTransport, host_port
from finssim.robot.links.water_linked import DeadReckoning, DvlServer, encode_velocity, serve_about
from finssim.robot.reading import Reading
from finssim.robot.recorder import Recorder, recording
from finssim.sim import RectangularPool, Simulator, Water, Wave
from finssim.vehicles import Vehicle, load_vehicle
from finssim.vehicles.defaults import POOL, SITES, with_navigation

__all__ = ["Forwarder", "Pulses", "SitlServer", "SitlWorld", "decode_pulses", "run"]

Array = NDArray[np.float64]

_LOG = logging.getLogger("finssim.ardusub_sitl")


class Pulses(NamedTuple):
    """Packet from SITL."""

    frame_rate: int
    """Frames per second of its clock [Hz]."""
    frame_count: int
    """Number of answers that SITL has received."""
    pulses: tuple[int, ...]
    """Pulse widths by output channel from 1, 16 or 32 [µs]; 0 without a signal."""


_LAYOUTS = {18458: struct.Struct("<HHI16H"), 29569: struct.Struct("<HHI32H")}
"""Magic number -> layout of the packet."""
SLOWEST, FASTEST = 20, 2000
"""Lowest and highest supported frame rate [Hz]."""


def decode_pulses(data: bytes) -> Pulses | str:
    """Return the content of a packet of SITL, or a short reason why it is invalid.

    Args:
        data: A datagram.
    """
    layout = _LAYOUTS.get(int.from_bytes(data[:2], "little"))
    if layout is None:
        return "wrong magic"
    if len(data) != layout.size:
        return "wrong length"
    _, rate, count, *pulses = layout.unpack(data)
    return Pulses(rate, count, tuple(pulses)) if SLOWEST <= rate <= FASTEST else "wrong rate"


GRAVITY = 9.80665
"""Gravity that ArduPilot subtracts from a specific force [m/s²]; its use makes accelerations and velocities of an
answer consistent."""
_FLIP = TO_FOSSEN.A
_LONGEST_STEP = 0.005
"""Longest physics step [s]."""
_LONGEST_PULSE = 2500
_RANGE = 100.0
"""Range of the rangefinder, and smallest cosine of its tilt [m, -]."""
_LEAST_COSINE = 0.5
TRUTH_PERIOD = 0.02
"""Shortest time between two recorded true states [s]."""


class SitlWorld:
    """One vehicle in water: input are pulse widths and a time step, output is the state in SITL's format.

    Attributes:
        time: Time since the start [s].
        simulator: Simulator of the single world.
        voltage: Battery voltage under load [V].
        current: Battery current [A].
    """

    def __init__(
        self,
        vehicle: Vehicle,
        *,
        start: Station,
        pool: RectangularPool | None = None,
        water: Water | None = None,
        battery: Battery | None = None,
        dvl: DvlServer | None = None,
        noise: bool = False,
        seed: int = 0,
    ) -> None:
        """Put the vehicle into the water, at rest and level.

        Args:
            vehicle: Vehicle whose thrusters have an `esc`; those without a `motor_index` use the outputs in their
                order.
            start: Pose of the body, world frame; yaw from world x, which is north, left positive [m, rad].
            pool: Walls and floor; None for open water without a floor.
            water: Current and waves; None for still water.
            battery: Battery of its motors; None for a constant 16 V.
            dvl: Server of its Doppler log; None for no log.
            noise: Whether rates and specific force have the noise of the vehicle file's IMU.
            seed: Seed of all random numbers.

        Raises:
            VehicleError, SimulatorError: The vehicle cannot be driven by pulse widths, or not simulated.
        """
        self.vehicle, self.battery = vehicle, battery or Battery(full_voltage=16.0)
        self._thrusters = list(vehicle.thrusters.values())
        self._output = motors_of(vehicle)
        self._start = tuple(start.position), quat_from_yaw(start.yaw)
        longest = max(t.delay for t in self._thrusters)
        self.simulator = Simulator(
            vehicle, control_step=1.0 / FASTEST, substeps=1, pool=pool, water=water, threads=1, seed=seed,
            max_delay=longest,
        )  # fmt: skip
        s, n = self.simulator, len(self._thrusters)
        self._thrust = s.command.fields["thrust"].numpy()[0, 0]
        names = ("position", "quaternion", "velocity", "acceleration")
        self._position, self._quaternion, self._nu, self._nu_dot = (s.numpy(name)[0, 0] for name in names)
        self._frozen, self._count = s.numpy("frozen"), n
        self._floor = pool.depth if pool is not None else math.inf
        self._forces = lru_cache(maxsize=512)(self._forces_at)
        self._fastest = np.array([max(t.rpm_max, -t.rpm_min) for t in self._thrusters]) * (math.tau / 60.0)
        self.truth: Recorder | None = None
        """Recorder of the true motion, on this machine's clock, as in a robot's record."""
        self._noted = -math.inf
        self.log = None if dvl is None else _DopplerLog(with_navigation(vehicle), dvl, self._floor, seed)
        imu, self._seed = vehicle.sensors.imu, seed
        self._noise = (
            np.array([imu.gyro_noise_density, imu.accel_noise_density])[:, None]
            if noise and imu is not None
            else None
        )
        self._rate = FASTEST
        self.restart()
        self.step((0,) * 32, self._rate)  # compiles the kernels before SITL waits for an answer
        self.restart()

    def restart(self) -> None:
        """Restore the initial state, at time 0."""
        self.time, self.voltage, self.current = 0.0, self.battery.full_voltage, self.battery.idle_current
        self._thrust[:] = 0.0
        self.simulator.restart_episodes()
        position, quaternion = self._start
        self.simulator.place(position, quaternion)
        self._random = np.random.default_rng([self._seed, 74])
        if self.log is not None:
            self.log.restart()

    def step(self, pulses: tuple[int, ...], rate: int) -> None:
        """Advance by 1 / rate.

        Args:
            pulses: Pulse widths by output channel [µs].
            rate: Frames per second [Hz].
        """
        if rate != self._rate:
            self._rate = rate
            substeps = math.ceil(1.0 / rate / _LONGEST_STEP - 1e-9)
            self.simulator.set_control_step(1.0 / rate, substeps, self.time)
        width = np.minimum([pulses[k] if k < len(pulses) else 0 for k in self._output], _LONGEST_PULSE)
        force, power = self._forces(round(20.0 * self.voltage))
        each = np.arange(self._count)
        self._thrust[: self._count] = force[each, width]
        self.current = self.battery.idle_current + float(power[each, width].sum()) / self.voltage
        self.simulator.step()
        self.time += 1.0 / rate
        faded = 1.0 - self.battery.fade * min(self.time / self.battery.fade_time, 1.0)
        self.voltage = max(self.battery.full_voltage * faded - self.battery.resistance * self.current, 1.0)
        if self.log is not None:
            self.log.look(self.time, self._position, quat_to_matrix(self._quaternion), self._nu)
        if self.truth is not None and (now := realtime.now()) - self._noted >= TRUTH_PERIOD:
            self._noted = now
            p, q, nu = (part.astype(float) for part in (self._position, self._quaternion, self._nu))
            self.truth.reading(now, Reading(now, p, q, nu, ready=True))

    def _forces_at(self, twentieths: int) -> tuple[Array, Array]:
        """Return steady thrust [N] and electric power [W] at every pulse width, (n, 2501), at a voltage in units of
        0.05 V."""
        width = np.arange(_LONGEST_PULSE + 1)
        omega = np.array([t.shaft_speed(width, 0.05 * twentieths) for t in self._thrusters])
        force = np.array([t.thrust(speed) for t, speed in zip(self._thrusters, omega, strict=True)])
        return force, self.battery.motor_power * np.abs(omega / self._fastest[:, None]) ** 3

    @property
    def frozen(self) -> bool:
        """Return whether the vehicle is frozen because its motion was no longer finite."""
        return bool(self._frozen[0])

    def answer(self) -> bytes:
        """Return the state in the format of SITL's parser, which searches for names and reads the values after
        them."""
        R = quat_to_matrix(self._quaternion)
        nu, nu_dot = self._nu.astype(float), self._nu_dot.astype(float)
        v, omega = nu[:3], nu[3:]
        felt = np.array([omega, nu_dot[:3] + cross(omega, v) + GRAVITY * R[2]])
        if self._noise is not None:
            felt += self._noise * math.sqrt(self._rate) * self._random.standard_normal((2, 3))
        gyro, accel, velocity, position = (np.array([*felt, R @ v, self._position]) @ _FLIP.T).tolist()
        q = TO_FOSSEN.quaternion(self._quaternion)
        state: dict[str, Any] = {
            "timestamp": round(self.time, 9),
            "imu": {"gyro": gyro, "accel_body": accel},
            "position": position,
            "attitude": [float(angle) + 0.0 for angle in quat_to_euler(q)],
            "quaternion": wxyz_from_xyzw(q).tolist(),
            "velocity": velocity,
            "battery": {"voltage": round(self.voltage, 3), "current": round(self.current, 3)},
        }
        distance = (self._floor + float(self._position[2])) / max(float(R[2, 2]), 1e-9)
        if R[2, 2] > _LEAST_COSINE and 0.0 <= distance <= _RANGE:
            state["rng_1"] = round(distance, 4)
        return b"\n" + json.dumps(state, separators=(",", ":")).encode() + b"\n"


class Forwarder:
    """Companion computer of ArduSub: it sets the origin and forwards velocities of the Doppler log over MAVLink.

    Velocities are sent as VISION_POSITION_DELTA, which ArduSub 4.5.0 accepted in this form, the origin as
    SET_GPS_GLOBAL_ORIGIN until ArduSub reports it.

    Attributes:
        counts: Number of `velocities` that were sent, and of `origins` that ArduSub reported.
    """

    def __init__(self, address: Address) -> None:
        """Connect as soon as ArduSub listens.

        Args:
            address: TCP server of one of its serial ports.

        Raises:
            LinkError: The host does not exist, or pymavlink is not installed.
        """
        try:
            from pymavlink.dialects.v20 import ardupilotmega
        except ModuleNotFoundError:
            raise LinkError(
                "--mavlink needs pymavlink, which is not installed: pip install 'finssim[hardware]', or give "
                "--mavlink none and set ArduSub's origin yourself"
            ) from None
        self._dialect, self._wire = ardupilotmega, TcpTransport(address)
        self._mav = ardupilotmega.MAVLink(None, COMPANION, ardupilotmega.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY)
        self._mav.robust_parsing = True
        self.counts = Counter[str]()
        self.restart()

    def restart(self) -> None:
        """Reset the state for an ArduSub that has restarted, without an origin."""
        self._has_origin, self._asked, self._last = False, -math.inf, math.nan

    def poll(self) -> None:
        """Read ArduSub's messages, and send it an origin until it reports one."""
        for data in self._wire.receive():
            for message in self._mav.parse_buffer(data) or ():
                if message.get_type() == "GPS_GLOBAL_ORIGIN" and not self._has_origin:
                    self._has_origin = True
                    self.counts["origins"] += 1
        if not self._has_origin and self._wire.connected and (now := time.monotonic()) - self._asked > 1.0:
            self._asked = now
            latitude, longitude = (round(1e7 * angle) for angle in HOME)
            self._send(self._dialect.MAVLink_set_gps_global_origin_message(1, latitude, longitude, 0))
            number = self._dialect.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN
            command = 1, 1, self._dialect.MAV_CMD_REQUEST_MESSAGE, 0, float(number), *[0.0] * 6
            self._send(self._dialect.MAVLink_command_long_message(*command))

    def velocity(self, measured: float, velocity: Array, std: float) -> None:
        """Forward a velocity over ground.

        Args:
            measured: Time of the measurement, on the world's clock [s].
            velocity: Vehicle's axes, forward, left, up [m/s], (3,).
            std: Its standard deviation [m/s].
        """
        dt = measured - self._last
        if dt < SHORTEST:
            return
        self._last = measured
        if not dt <= LONGEST:  # after a gap the displacement is unknown
            return
        delta = (dt * TO_FOSSEN.vector(velocity)).tolist()
        confidence = 100.0 * (1.0 - min(std, WORST) / WORST)
        times = round(1e6 * measured), round(1e6 * dt)
        self._send(
            self._dialect.MAVLink_vision_position_delta_message(*times, [0.0, 0.0, 0.0], delta, confidence)
        )
        self.counts["velocities"] += self._wire.connected

    def _send(self, message: Any) -> None:
        self._wire.send(bytes(message.pack(self._mav)))
        self._mav.seq = (self._mav.seq + 1) % 256

    def close(self) -> None:
        """Close the connection."""
        self._wire.close()


class _DopplerLog:
    """Doppler log of the vehicle, sampled once per frame; its reports are sent after their latency."""

    def __init__(self, vehicle: Vehicle, server: DvlServer, floor: float, seed: int) -> None:
        self.forwarder: Forwarder | None = None
        log = vehicle.sensors.dvl
        assert log is not None  # with_navigation adds one
        self.entry, self.server, self._floor = log, server, floor
        self._R_bs, self._random = quat_to_matrix(log.orientation), np.random.default_rng([seed, 73])
        self.restart()

    def restart(self) -> None:
        """Restart at time 0, which corresponds to the present time."""
        self._next, self._sent = 0.0, 0.0
        self._waiting: deque[tuple[float, Array | None, float]] = deque()
        self._reckoning = DeadReckoning()
        self._epoch = time.time()

    def look(self, now: float, position: Array, R: Array, nu: Array) -> None:
        """Measure if a sample is due, and send the reports whose latency is over.

        Args:
            now: Time since the start [s].
            position: Position of the body origin, world frame [m], (3,).
            R: Rotation, body to world, (3, 3).
            nu: Twist, body frame [m/s, rad/s], (6,).
        """
        log = self.entry
        if now >= self._next - 1e-9:
            self._next += 1.0 / log.rate
            up, r = R[2], np.asarray(log.position)
            v = self._R_bs.T @ (nu[:3] + cross(nu[3:], r)) + log.noise_std * self._random.standard_normal(3)
            altitude = (self._floor + float(position[2]) + float(up @ r)) / max(float(up[2]), 1e-9)
            lock = (
                up[2] > math.cos(min(log.max_tilt, 0.5 * math.pi)) and np.abs(v).max() <= log.velocity_range
            )
            lock = lock and log.altitude_min <= altitude <= log.altitude_max
            self._waiting.append((now, v if lock else None, altitude))
            q = matrix_to_quat(R @ self._R_bs)
            for report in self._reckoning.take(now, v if lock else None, q, self._epoch + now):
                self.server.send(report)
        while self._waiting and now >= self._waiting[0][0] + log.latency - 1e-9:
            at, velocity, altitude = self._waiting.popleft()
            if velocity is not None and self.forwarder is not None:
                self.forwarder.velocity(at, self._R_bs @ velocity, log.noise_std)
            self.server.send(
                encode_velocity(
                    velocity,
                    altitude=altitude,
                    measured=self._epoch + at,
                    sent=self._epoch + now,
                    interval=now - self._sent,
                    std=(log.noise_std,) * 3,
                )
            )
            self._sent = now


Address = tuple[str, int]

_POLL = 0.1
"""Longest wait for a packet before other connections are polled [s]."""
_PACKETS_AT_ONCE = 1024
_AWAY = 1.5
"""Time without packets after which another SITL is accepted [s]."""


COMPANION = 1
"""System id of the companion computer, which is that of the vehicle."""
SHORTEST, LONGEST = 0.05, 1.0
"""Shortest and longest interval of forwarded velocities [s]: ArduSub's filter drops shorter ones; after a longer one,
the bottom lock was lost."""
WORST = 0.4
"""Standard deviation that corresponds to a confidence of 0 [m/s]."""
SETTLING = 0.5
"""Simulated time after a restart of SITL in which its counts may jump without a lost answer [s]."""


class SitlServer:
    """Server that answers SITL's packets by its lock-step rules; invalid packets are counted and not answered.

    Attributes:
        counts: Number of `frames`, `repeats`, `restarts` and `gaps`, and of refused packets: `wrong magic`,
            `wrong length`, `wrong rate`, `stranger`.
    """

    def __init__(
        self,
        world: SitlWorld,
        address: Address = ("127.0.0.1", 9002),
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Listen for packets.

        Args:
            world: The physics.
            address: Host and port of this end; port 0 selects a free one (see `address`).
            clock: Clock for the time without packets from SITL [s].

        Raises:
            LinkError: It cannot be bound.
        """
        self.world, self.counts = world, Counter[str]()
        self.forwarder: Forwarder | None = None
        self._clock, self._heard = clock, -math.inf
        self._peer: Address | None = None
        self._last, self._answer = -1, b""
        self._settling = False
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(address)
        except OSError as problem:
            self._socket.close()
            raise LinkError(
                f"cannot bind {address[0]}:{address[1]} for SITL ({problem.strerror}): end the program that has it, or "
                "give another port to both (SITL adds 10 per instance)"
            ) from None
        self._socket.setblocking(False)
        self.address: Address = self._socket.getsockname()

    def serve(self, duration: float = math.inf) -> None:
        """Answer until the world's clock reaches a time [s]."""
        while self.world.time < duration - 1e-9:
            self.serve_once()

    def serve_once(self) -> None:
        """Wait briefly for packets, and answer only the newest: SITL reads one answer per frame, so others would
        add lag."""
        newest = None
        select.select([self._socket], [], [], _POLL)
        with suppress(BlockingIOError, ConnectionError):
            for _ in range(_PACKETS_AT_ONCE):
                packet = self._accepted(*self._socket.recvfrom(256))
                if packet is not None and newest is not None:
                    self.counts["repeats"] += 1
                newest = packet or newest
        if newest is not None and self._peer is not None:
            with suppress(OSError):  # SITL has ended, as the system reports
                self._socket.sendto(self.answer(newest), self._peer)
        elif self.world.log is not None:
            self.world.log.server.poll()
        if self.forwarder is not None:
            self.forwarder.poll()

    def _accepted(self, data: bytes, sender: Address) -> Pulses | None:
        packet = decode_pulses(data)
        now = self._clock()
        if not isinstance(packet, str) and sender != self._peer:
            if now - self._heard > _AWAY:
                _LOG.info("SITL at %s:%d", *sender)
                self._peer = sender
            else:
                packet = "stranger"
        if isinstance(packet, str):
            self._note(packet, "refused a packet from %s:%d: %s", *sender, packet)
            return None
        self._heard = now
        return packet

    def answer(self, packet: Pulses) -> bytes:
        """Return the answer to a packet; a new frame advances the simulation, a smaller count restarts it."""
        count = packet.frame_count
        if count == self._last:
            self.counts["repeats"] += 1
            return self._answer
        if count < self._last:
            self._note("restarts", "SITL has started again: the world starts again too")
            self.world.restart()
            if self.forwarder is not None:
                self.forwarder.restart()
            self._settling = True
        elif (
            self._last >= 0 and count > self._last + 1 and not (self._settling and self.world.time < SETTLING)
        ):
            self._note("gaps", "SITL counts from frame %d to %d: answers were lost", self._last, count)
        self._last = count
        self.counts["frames"] += 1
        self.world.step(packet.pulses, packet.frame_rate)
        if self.world.frozen:
            self._note("frozen", "the motion stopped being finite at %.3f s: restart SITL", self.world.time)
        self._answer = self.world.answer()
        return self._answer

    def _note(self, kind: str, sentence: str, *values: Any) -> None:
        """Count an event, and log the first of its kind; the total is reported at the end."""
        self.counts[kind] += 1
        if self.counts[kind] == 1 or kind == "restarts":
            _LOG.warning(sentence, *values)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


MOTOR_POWER = 385.0
"""Power of a T200 at full speed with 16 V, from its table [W]."""


@dataclass(frozen=True, kw_only=True)
class SitlScene:
    """Site of the vehicle, its water, and the vehicle's start."""

    site: str = "tank"
    """(NAME) Walls and floor: pool, tank or open-water (no walls near, floor at 20 m)."""
    start: str | None = None
    """(X,Y,Z,YAW) Start of the vehicle, world frame: x (north), y, z [m], yaw left positive [deg]; at the surface if
    not given, since SITL calibrates its barometers at the start."""
    current: str = "0,0,0"
    """(X,Y,Z) Current, world frame [m/s]."""
    wave: str | None = None
    """(A,LENGTH,HEADING) One wave: amplitude [m], length [m], direction of travel [deg]; none if not given."""

    def pool(self) -> RectangularPool:
        """Return the walls and the floor.

        Raises:
            PlantSpecError: The site does not exist.
        """
        if self.site not in SITES:
            raise PlantSpecError(f"unknown site '{self.site}'; available: {', '.join(SITES)}")
        length, width, depth = SITES[self.site] or POOL
        return RectangularPool(length=length, width=width, depth=depth)

    def water(self, depth: float) -> Water:
        """Return current and wave, in water of a depth [m].

        Raises:
            PlantSpecError: One of them is not given as three numbers.
        """
        waves = []
        if self.wave is not None:
            amplitude, wavelength, heading = _three(self.wave, "wave")
            waves = [Wave(amplitude=amplitude, wavelength=wavelength, heading=math.radians(heading))]
        return Water(current=_three(self.current, "current"), waves=waves, depth=depth)


@dataclass(frozen=True, kw_only=True)
class Supply:
    """Electric supply of the thrusters."""

    voltage: Annotated[float, (5.0, 30.0)] = 16.0
    """Battery voltage without load [V]."""
    resistance: Annotated[float, (0.0, 1.0)] = 0.02
    """Resistance of battery and wiring [ohm]."""


@dataclass(frozen=True, kw_only=True)
class Addresses:
    """Addresses of SITL, of its serial port and of the DVL."""

    bind: str = "127.0.0.1:9002"
    """(HOST:PORT) Address to which SITL sends its packets; only this machine if not given."""
    dvl: str | None = None
    """(HOST:PORT) Address to serve a Water Linked DVL, for BlueOS' driver or a robot; its usual port is
    16171."""
    dvl_page: str | None = None
    """(HOST:PORT) Address of the DVL's web page, by which BlueOS' driver finds it; none if not given."""
    mavlink: str = "127.0.0.1:5762"
    """(HOST:PORT) TCP address of one of SITL's serial ports, through which it receives its origin and, with --dvl, the
    DVL's velocities; SITL's second port if not given; none: nothing is sent."""

    @contextmanager
    def dvl_server(self) -> Iterator[DvlServer | None]:
        """Serve the DVL and its web page, if they have an address."""
        with ExitStack() as stack:
            log = None
            if self.dvl is not None:
                log = DvlServer(host_port(self.dvl, "--dvl"))
                stack.callback(log.close)
            if self.dvl_page is not None:
                page = serve_about(host_port(self.dvl_page, "--dvl-page"))
                stack.callback(page.server_close)
                stack.callback(page.shutdown)
            yield log


@dataclass(frozen=True, kw_only=True)
class SitlProgram:
    """ArduSub's SITL program, and its parameters."""

    version: Literal["4.1", "4.5", "4.6", "4.7"] = "4.5"
    """(VERSION) ArduSub version, which determines the names of parameters."""
    parm: str = "finssim.parm"
    """(FILE) Parameters for SITL, written at the start: frame, rate, barometers, satellites and, with --dvl, the DVL. A
    file that was not written by this command is not replaced."""
    exec: str | None = None
    """(FILE) ArduSub's SITL program, started with these parameters in the folder of --parm and ended with this
    command; if not given, start it yourself."""


def run(
    *,
    vehicle: str = "bluerov2_heavy",
    scene: Annotated[SitlScene, "options"] = SitlScene(),
    supply: Annotated[Supply, "options"] = Supply(),
    addresses: Annotated[Addresses, "options"] = Addresses(),
    truth: Path | None = None,
    program: Annotated[SitlProgram, "options"] = SitlProgram(),
    duration: Annotated[float | None, (0.0, None)] = None,
    seed: int = 1,
) -> None:
    """Simulate the physics for ArduPilot's ArduSub SITL, started with `--model JSON:127.0.0.1`, until Ctrl-C.

    Example: finssim ardusub-sitl --vehicle bluerov2_heavy --site tank --dvl 127.0.0.1:16171

    Args:
        vehicle (NAME|FILE): Vehicle whose thrusters have an `esc`: in the catalogue, or a (calibrated) vehicle
            file.
        scene: Site, water and start.
        supply: Battery and wiring.
        addresses: Addresses of SITL, of its serial port and of the DVL.
        truth (FILE): MCAP file of the true motion, for finssim evaluate --truth; an existing one is refused.
        program: SITL and its parameters.
        duration: Simulated duration [s]; until Ctrl-C or SIGTERM if not given.
        seed: Seed of every random number; equal seeds give equal results.

    Raises:
        PlantSpecError, LinkError, GoalError, VehicleError: What cannot be used.
    """
    logging.basicConfig(level=logging.INFO, format="finssim: %(message)s", stream=sys.stderr)
    pool, start, known = scene.pool(), station_of(scene.start or "0,0,0,0"), load_vehicle(vehicle)
    parameters = sitl_parameters(known, program.version, dvl=addresses.dvl is not None)
    file = write_parameters(Path(program.parm), parameters)
    water = scene.water(pool.depth)
    battery = Battery(full_voltage=supply.voltage, resistance=supply.resistance, motor_power=MOTOR_POWER)
    with ExitStack() as stack:
        log = stack.enter_context(addresses.dvl_server())
        world = SitlWorld(
            known, pool=pool, water=water, start=start, battery=battery, dvl=log, noise=True, seed=seed
        )
        server = SitlServer(world, host_port(addresses.bind, "--bind"))
        stack.callback(server.close)
        world.truth = stack.enter_context(recording(truth, known, {"command": "finssim ardusub-sitl"}))
        if addresses.mavlink != "none":
            forwarder = server.forwarder = Forwarder(host_port(addresses.mavlink, "--mavlink"))
            stack.callback(forwarder.close)
            if world.log is not None:
                world.log.forwarder = forwarder
        print(
            f"{world.vehicle.title}: waiting for SITL on {server.address[0]}:{server.address[1]}", flush=True
        )
        if log is not None:
            print(f"DVL: {log.address[0]}:{log.address[1]}", flush=True)
        command = sitl_command(program.exec or "ardusub", file, server.address)
        print("SITL: " + shlex.join(command), flush=True)
        if program.exec is not None:
            stack.callback(_end, _started(command, file.parent))
        with suppress(KeyboardInterrupt), interrupting():
            server.serve(math.inf if duration is None else duration)
        counts = server.counts + (server.forwarder.counts if server.forwarder is not None else Counter())
        summary = ", ".join(f"{count} {kind}" for kind, count in sorted(counts.items()) if count)
        print(f"ended after {world.time:.1f} s: {summary or 'SITL sent nothing'}")


WRITTEN = "# written by finssim ardusub-sitl"


def sitl_parameters(vehicle: Vehicle, version: str, *, dvl: bool) -> dict[str, float]:
    """Return the parameters with which SITL controls a vehicle in this physics, by name [ArduPilot's units].

    Args:
        vehicle: Vehicle whose autopilot's frame and motor directions are used.
        version: ArduSub version: 4.1, 4.5, 4.6 or 4.7.
        dvl: Whether a Doppler log provides velocities.

    Note:
        The origin is not a parameter: ORIGIN_LAT would set it when arming, and change the heading at that moment.

    Raises:
        ControlError: The vehicle has no autopilot.
    """
    mixer, at_least = Mixer.of(vehicle), tuple(map(int, version.split(".")))
    values: dict[str, float] = {
        "FRAME_CONFIG": {"VECTORED": 1, "VECTORED_6DOF": 2}.get(mixer.autopilot.name, 7),
        "SIM_RATE_HZ": 400,
        "BARO_SPEC_GRAV": 1.024,
        "SIM_BARO_RND": 0.01,
        "SIM_BAR2_RND": 0.01,
        "BATT_MONITOR": 4,
    }
    # Offsets of its simulated compasses.
    values |= {
        f"COMPASS_OFS{n}_{axis}": x for n in ("", 2, 3) for axis, x in zip("XYZ", (5, 13, -18), strict=True)
    }
    values |= {f"MOT_{i}_DIRECTION": float(sign) for i, sign in enumerate(mixer.directions, 1)}
    values |= (
        {"SIM_GPS1_ENABLE": 0, "GPS1_TYPE": 0}
        if at_least >= (4, 6)
        else {"SIM_GPS_DISABLE": 1, "GPS_TYPE": 0}
    )
    if at_least >= (4, 7):
        values["SURFACE_MAX_THR"] = 1
    if dvl:
        values |= {"AHRS_EKF_TYPE": 3, "EK3_ENABLE": 1, "EK2_ENABLE": 0, "VISO_TYPE": 1}
        values |= {"EK3_SRC1_POSXY": 6, "EK3_SRC1_VELXY": 6, "EK3_SRC1_POSZ": 1, "EK3_SRC1_VELZ": 0}
        log: Any = with_navigation(vehicle).sensors.dvl
        values |= {"EK3_SRC1_YAW": 1, "VISO_DELAY_MS": round(1e3 * log.latency)}
        mounted = TO_FOSSEN.vector(log.position).tolist()
        values |= {f"VISO_POS_{axis}": x for axis, x in zip("XYZ", mounted, strict=True) if x}
    return values


def write_parameters(path: Path, values: dict[str, float]) -> Path:
    """Write a parameter file for SITL, by name [ArduPilot's units]; return its path.

    Raises:
        PlantSpecError: Another file has this path, or it cannot be written.
    """
    try:
        if path.exists() and not path.read_text(errors="replace").startswith(WRITTEN):
            raise PlantSpecError(f"{path} was not written by finssim: give another file with --parm")
        lines = [WRITTEN, *(f"{name} {value:.10g}" for name, value in values.items())]
        path.write_text("\n".join(lines) + "\n")
    except OSError as error:
        raise PlantSpecError(f"{path}: {error.strerror or error}") from None
    return path


def sitl_command(program: str, parameters: Path, address: Address) -> list[str]:
    """Return the command that starts SITL with this physics, which listens at `address`."""
    home = f"{HOME[0]},{HOME[1]},0,185"
    words = [
        "--model",
        f"JSON:{address[0]}",
        "--sim-port-out",
        str(address[1]),
        "--speedup",
        "1",
        "--home",
        home,
    ]
    return [program, *words, "--defaults", str(parameters.resolve())]


def _started(command: list[str], folder: Path) -> subprocess.Popen[bytes]:
    """Start SITL without output.

    Raises:
        PlantSpecError: It cannot be started.
    """
    try:
        program = str(Path(command[0]).resolve()) if Path(command[0]).exists() else command[0]
        return subprocess.Popen(
            [program, *command[1:]], cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL
        )
    except OSError as error:
        raise PlantSpecError(f"--exec {command[0]}: {error.strerror or error}") from None


def _end(process: subprocess.Popen[bytes]) -> None:
    """Terminate SITL, and wait for its end."""
    process.terminate()
    try:
        process.wait(5.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _three(text: str, option: str) -> tuple[float, float, float]:
    """Return three numbers from a text with commas."""
    try:
        a, b, c = map(float, text.split(","))
    except ValueError:
        a = b = c = math.nan
    if not all(map(math.isfinite, (a, b, c))):
        raise PlantSpecError(f"--{option}: {text!r}: expected three finite numbers with commas between")
    return a, b, c
