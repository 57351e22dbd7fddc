"""`finssim pool`: make a plant, a camera and a motor controller, and serve a robot until a signal stops it."""

from __future__ import annotations

import logging
import math
import select
import socket
import sys
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

import numpy as np

from finssim.control.guidance import Station
from finssim.core import realtime
from finssim.core.rotations import quat_from_yaw, quat_yaw
from finssim.localization.overhead_camera import Pool, write_pool
from finssim.pool.camera import PoolCamera, camera_of
from finssim.pool.drawn_plant import draw_plant, positioning_of, site_of, site_of_world
from finssim.pool.fleet import Fleet, Medium, one_picture
from finssim.pool.pictures import CameraPlan, Cameras, PictureProcess, PictureSourcePlan, UdpSender
from finssim.pool.plant_spec import Basin, PlantSpec, PlantSpecError, Severity, load_plant_spec
from finssim.pool.task_site import PositionSources, TaskSite
from finssim.pool.virtual_pool import PoolClockError, VirtualPool
from finssim.robot.goals import station_of
from finssim.robot.interrupt import interruptible, interrupting
from finssim.robot.links.frames import LinkError
from finssim.robot.links.transports import (
    Address,
    TcpServer,
    Transport,
    UdpTransport,
    bound_socket,
    host_port,
    resolved,
)
from finssim.robot.links.water_linked import DvlServer, serve_about
from finssim.robot.lockstep import LockstepError, decode_request, encode_delivery, encode_refusal, receive
from finssim.robot.messages import Picture
from finssim.robot.team import decode_track
from finssim.sim.site import described_world
from finssim.sim.water import load_water
from finssim.tasks.observer import fitted_task
from finssim.vehicles import Vehicle, load_vehicle
from finssim.vehicles.defaults import numbered, vehicle_at

__all__ = [
    "Ends", "GroundLinks", "LockstepServer", "MCU_PORT", "MediumServer", "Pace", "PoolPlan", "SiteChoice", "PoolTiming",
    "make_plan", "run", "serve_realtime", "swimming",
]  # fmt: skip


# A virtual pool for robots in other processes: in real time, a port for each, or in lock-step over TCP.

TICK = 0.003
"""Between looks at the wire [s]."""
MOST_BEHIND = 0.2
"""Delay beyond which a pool gives up that time [s]: its clock stops instead, as on a stopped computer."""


MOST_CALLERS = 8
"""Ground stations that are answered over UDP, and guests of a pool in lock-step: those that called last."""
GUEST_PATIENCE = 2.0
"""Time within which a robot's first request must arrive completely [s]."""


class Clocked(Protocol):
    """A camera that must know when the pool's clock began."""

    start: float
    """Time at which the pool's clock began, on the clock of the process [s]."""


@dataclass
class Pace:
    """Measure of a pool's real-time performance."""

    duration: float = 0.0
    """Duration by the pool's clock [s]."""
    late: float = 0.0
    """The most that the pool was behind at a tick [s]."""
    given_up: float = 0.0
    """Time that the pool stood still because it was too far behind [s]."""
    received: int = 0
    """Frames from the robot."""
    sent: int = 0
    """Frames to it."""
    pictures: int = 0
    """Number of pictures that were sent from this process."""

    @property
    def sentence(self) -> str:
        """Return the summary for a person."""
        pace_text = f"gave up {self.given_up:.2f} s" if self.given_up else "kept real time"
        return (
            f"{self.duration:.1f} s, {pace_text}, at most {1e3 * self.late:.0f} ms late; "
            f"{self.received} frames in, {self.sent} out"
        )


class LockstepServer:
    """A pool whose clock advances as far as its one robot asks, and ends when the robot leaves."""

    def __init__(self, address: tuple[str, int]) -> None:
        """Listen.

        Args:
            address: Host and port; port 0 takes a free one (see `address`).

        Raises:
            LinkError: It cannot be bound.
        """
        self._listener = bound_socket(socket.SOCK_STREAM, address)
        self._listener.listen(1)
        self.address: tuple[str, int] = self._listener.getsockname()

    def serve(self, world: VirtualPool, *, duration: float = math.inf) -> str:
        """Wait for a robot and serve it; no other one is accepted.

        The robot is the first that sends a request. Whoever connects and leaves again, is silent or sends something
        else is not, and the pool continues to listen.

        Args:
            world: The pool.
            duration: Longest time of the pool's clock [s]; a request beyond it is refused.

        Returns:
            Why it ended, in a few words.
        """
        connection, request = self._first_request()
        self.close()
        with connection:
            robot = connection.getpeername()
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            try:
                message: tuple[int, bytes] | None = request
                while message is not None:
                    until, sent = decode_request(*message)
                    if until > duration + 1e-9:
                        connection.sendall(encode_refusal(f"the pool ends at {duration:g} s, as it was told"))
                        return "the time is over"
                    connection.sendall(encode_delivery(world.exchange(until, sent)))
                    message = receive(connection)
            except (LockstepError, PoolClockError) as problem:
                with suppress(OSError):  # it may not wait for the answer
                    connection.sendall(encode_refusal(str(problem)))
                return f"{robot[0]}:{robot[1]} was refused: {problem}"
            except OSError as problem:
                return f"the robot has gone: {problem.strerror or problem}"
        return "the robot has left"

    def _first_request(self) -> tuple[socket.socket, tuple[int, bytes]]:
        """Wait for a request among all that connect; the others are closed."""
        guests: list[socket.socket] = []
        robot: socket.socket | None = None
        try:
            while True:
                ready, _, _ = select.select([self._listener, *guests], [], [])
                if self._listener in ready:
                    guests.append(self._listener.accept()[0])
                    guests[-1].settimeout(GUEST_PATIENCE)
                    if len(guests) > MOST_CALLERS:
                        guests.pop(0).close()
                for guest in [guest for guest in guests if guest in ready]:
                    try:
                        if (message := receive(guest)) is not None:
                            decode_request(*message)
                            robot = guest
                            robot.settimeout(None)
                            return robot, message
                    except LockstepError as problem:
                        with suppress(OSError):  # it may not wait for the answer
                            guest.sendall(encode_refusal(str(problem)))
                    except OSError:
                        pass
                    guests.remove(guest)
                    guest.close()
        finally:
            for guest in guests:
                if guest is not robot:
                    guest.close()

    def close(self) -> None:
        """Stop listening."""
        self._listener.close()


LARGEST = 2048
"""Bytes taken of a datagram."""
MOST_FRAMES = 1024
"""Taken of UDP by one call, so that a flood cannot hold the loop up."""


def whole_frames(data: bytearray) -> list[bytes]:
    """Cut the MAVLink frames that are complete off a stream, and what is before the first one."""
    frames: list[bytes] = []
    while True:
        starts = [i for i in (data.find(b"\xfd"), data.find(b"\xfe")) if i >= 0]
        del data[: min(starts, default=len(data))]
        if len(data) < 3:
            return frames
        length = 12 + data[1] + 13 * (data[2] & 1) if data[0] == 0xFD else 8 + data[1]
        if len(data) < length:
            return frames
        frames.append(bytes(data[:length]))
        del data[:length]


class GroundLinks:
    """The router of an autopilot: its frames go to all ground stations, theirs to it and to each other.

    Over UDP stations are those told of and whoever sends, over TCP whoever connects; lines of the Doppler log go to its
    own clients. A `Transport`: no call waits.

    Attributes:
        address: UDP, of this end.
        tcp: Where stations connect.
        dvl: The log's server.
    """

    def __init__(
        self,
        bind: Address,
        stations: Sequence[Address],
        tcp: Address,
        dvl: Address,
        page: Address | None = None,
    ) -> None:
        """Open all; port 0 takes a free one.

        Args:
            bind: UDP, of this end.
            stations: UDP, that frames go to before they have sent anything.
            tcp: To listen at.
            dvl: For the Doppler log.
            page: For the log's web page; none if None.

        Raises:
            LinkError: One cannot be bound or found.
        """
        self._fixed = [resolved(station) for station in stations]
        self._callers: deque[Address] = deque(maxlen=MOST_CALLERS)
        with ExitStack() as stack:
            self._socket = stack.enter_context(bound_socket(socket.SOCK_DGRAM, bind))
            self._socket.setblocking(False)
            self._streams = stack.enter_context(closing(TcpServer(tcp, bytearray)))
            self.dvl = stack.enter_context(closing(DvlServer(dvl)))
            if page is not None:
                server = serve_about(page)
                stack.callback(server.server_close)
                stack.callback(server.shutdown)
            self._stack = stack.pop_all()
        self.address: Address = self._socket.getsockname()
        self.tcp = self._streams.address

    def receive(self) -> list[bytes]:
        """Return complete frames of all stations, which the other stations receive too."""
        self.dvl.poll()
        frames: list[bytes] = []
        with suppress(BlockingIOError, ConnectionError):
            while len(frames) < MOST_FRAMES:
                data, sender = self._socket.recvfrom(LARGEST)
                if sender not in (*self._fixed, *self._callers):
                    self._callers.append(sender)  # and forget the one that came first, if they are too many
                frames += self._pass_on(bytearray(data), sender)
        for station, stream, data in self._streams.receive():
            stream += data
            frames += self._pass_on(stream, station)
        return frames

    def send(self, data: bytes) -> None:
        """Send a frame to every station, or a line to the log's clients."""
        if data[:1] == b"{":
            self.dvl.send(data)
        else:
            self._broadcast(data)

    def close(self) -> None:
        """Let everyone go."""
        self._stack.close()

    def describe(self) -> str:
        """Return the connected stations."""
        return f"{len(self._callers)} stations over UDP, {len(self._streams.clients)} over TCP"

    def _pass_on(self, stream: bytearray, source: object) -> list[bytes]:
        frames = whole_frames(stream)
        for frame in frames:
            self._broadcast(frame, source)
        return frames

    def _broadcast(self, frame: bytes, source: object = None) -> None:
        """To all stations but the source."""
        for address in [*self._fixed, *self._callers]:
            if address != source:
                with suppress(OSError):  # no receiver there yet
                    self._socket.sendto(frame, address)
        for station in list(self._streams.clients):
            if station is not source:
                self._streams.send(frame, station)


RATE = 60.0
"""Steps a second of the software of vehicles that the task commands [Hz]."""


class MessageEnd(Protocol):
    """The medium's end for robots in other processes."""

    def poll(self, now: float) -> None:
        """Take what was sent and deliver what has arrived, at the site's clock [s]."""


class PoolTiming:
    """Clock of a pool, and the medium of a team: those of this machine. A program that has its own derives a class."""

    paced = False
    """True if time waits for the pool, so that its cameras draw within a step."""

    def now(self) -> float:
        """Return the time [s]."""
        return realtime.now()

    def wait(self, duration: float, until: Callable[[], bool]) -> None:
        """Wait for a duration [s], or until a function returns true."""
        realtime.wait(duration)

    def messages(self, fleet: Fleet) -> MessageEnd | None:
        """Return the medium's end for the robots of a team; None: they exchange nothing."""
        return None


class MediumServer:
    """A medium's end for robots in other processes: who sends under a name is answered under it."""

    def __init__(self, address: tuple[str, int], medium: Medium, names: tuple[str, ...]) -> None:
        """Listen.

        Args:
            address: Host and port; port 0 takes a free one (see `address`).
            medium: That carries the messages.
            names: Who may send.

        Raises:
            LinkError: It cannot be bound.
        """
        self._medium, self._names = medium, frozenset(names)
        self._robots: dict[str, tuple[str, int]] = {}
        self._socket = bound_socket(socket.SOCK_DGRAM, address)
        self._socket.setblocking(False)
        self.address: tuple[str, int] = self._socket.getsockname()

    def poll(self, now: float) -> None:
        """Take what has come and send what has arrived, at the site's clock [s]."""
        with suppress(BlockingIOError, ConnectionError):
            while True:
                data, sender = self._socket.recvfrom(LARGEST)
                heard = decode_track(data, now)
                if heard is not None and heard[0] in self._names:
                    self._robots[heard[0]] = sender
                    self._medium.send(now, heard[0], data)
        for name in self._names:  # what reaches a robot that has not spoken yet is lost
            for data in self._medium.receive(now, name):
                if name in self._robots:
                    with suppress(OSError):
                        self._socket.sendto(data, self._robots[name])

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()


@dataclass(frozen=True)
class SiteWires:
    """Open wires of a site, to robots in other processes."""

    transports: Mapping[str, Transport]
    """Vehicle -> wire to its robot, from the motor controller's end."""
    messages: MessageEnd | None = None
    """Messages between the robots; None: they tell each other nothing."""
    sinks: Sequence[UdpSender] = ()
    """Take the one camera's pictures, one for each robot."""
    camera: Clocked | None = None
    """Camera that sends its pictures itself."""


def serve_realtime(
    site: Fleet,
    wires: SiteWires,
    *,
    duration: float = math.inf,
    until: Callable[[], bool] = lambda: False,
    over: Callable[[], None] = lambda: None,
    clock: Callable[[], float] = realtime.now,
    wait: Callable[[float], None] = realtime.wait,
) -> Pace:
    """Run a site in real time until the time is over or `until` returns true.

    Args:
        site: With robots in other processes, at time 0.
        wires: Its open wires.
        duration: How long [s].
        until: Ends it where it says so; asked at every tick.
        over: Called once, when the site says that it is over; it lives on.
        clock: This machine's clock [s].
        wait: Waits so long [s].
    """
    pace, start, now = Pace(), clock(), 0.0
    sent: dict[str, list[bytes]] = {name: [] for name in site.runtimes}
    frames: dict[str, list[tuple[float, bytes]]] = {name: [] for name in site.runtimes}
    steps, announced = 0, False
    while now < duration and not until():
        behind = clock() - start - now
        if behind > MOST_BEHIND:
            pace.given_up += behind - TICK
            start += behind - TICK
        if wires.camera is not None:
            wires.camera.start = start
        now = min(max(clock() - start, now), duration)
        pictures: list[Picture] = []
        for name, transport in wires.transports.items():
            received = transport.receive()
            delivery = site.worlds[name].exchange(now, received)
            pictures += delivery.pictures
            for _, frame in delivery.frames:
                transport.send(frame)
            pace.received, pace.sent = pace.received + len(received), pace.sent + len(delivery.frames)
        for picture in one_picture(pictures):
            for sink in wires.sinks:
                sink.send(replace(picture, time=start + picture.time), clock())
                pace.pictures += 1
        due = now * RATE >= steps + 1
        for name, runtime in site.runtimes.items():
            delivery = site.worlds[name].exchange(now, sent[name])
            sent[name], frames[name] = [], frames[name] + list(delivery.frames)
            if due and site.medium is not None:
                sent[name] = runtime.step(now, frames[name], (), site.medium.receive(now, name))
                frames[name] = []
                for datagram in runtime.told:
                    site.medium.send(now, name, datagram)
        steps = math.floor(now * RATE)
        if wires.messages is not None:
            wires.messages.poll(now)
        site.turn(now, due)
        if site.over and not announced:
            announced = True
            over()
        pace.duration, done = now, clock() - start
        pace.late = max(pace.late, done - now) if now > 1.0 else pace.late
        wait(max(TICK - (done - now), 0.0))
    return pace


# A virtual pool before it lives, and the command that makes it and serves it.

MCU_PORT = 58766
"""Port of the motor controller; pictures come from the next port, lock-step uses the one after."""
MESSAGES = 5
"""The messages of a team are this far from the first port."""
ROOM = 2.0
"""Distance between the starts of a team's vehicles, in lengths of the longest."""


@dataclass(frozen=True, kw_only=True)
class PoolPlan:
    """A virtual pool before it lives."""

    vehicle: Vehicle
    spec: PlantSpec
    camera: CameraPlan | None
    calibrated: Pool | None
    """Calibration of the camera that a robot may know."""
    positioning: str = "none"
    """Name of the positioning system."""
    firmware: Literal["mcu", "ardusub"] = "mcu"
    """Firmware of the vehicle."""
    onboard: Any = None
    """The vehicle's own cameras, sonars and altimeters, in the world that they see; None: there is none."""

    def eye(self) -> Any:
        """All cameras as one, made here; None where there are none."""
        cameras = [plan.camera() for plan in (self.camera, self.onboard) if plan is not None]
        return Cameras(*cameras) if len(cameras) > 1 else cameras[0] if cameras else None

    def world(self, camera: Any, *, start: Station, seed: int, truth: Path | None) -> VirtualPool:
        """The living pool.

        Args:
            camera: Of the pool; None for none.
            start: Where the vehicle begins, at rest and level.
            seed: Of instruments and wire.
            truth: File that is written.
        """
        pose = np.asarray(start.position), quat_from_yaw(start.yaw)
        return VirtualPool(
            self.vehicle,
            self.spec,
            camera=camera,
            positioning=positioning_of(self.positioning, seed),
            start=pose,
            seed=seed,
            truth=truth,
            firmware=self.firmware,
            world=None if self.onboard is None else self.onboard.layout(),
        )

    def standing(self, start: Station, *, seed: int, truth: Path | None = None) -> VirtualPool:
        """The living pool with its own camera, for lock-step; arguments as of `world`."""
        return self.world(self.eye(), start=start, seed=seed, truth=truth)


def make_plan(
    vehicle: str | Vehicle,
    plant: str,
    severity: Severity,
    *,
    camera: Literal["pictures", "corners", "none"] = "pictures",
    seed: int = 0,
    site: str | None = None,
    firmware: Literal["mcu", "ardusub"] = "mcu",
    world: str | None = None,
) -> PoolPlan:
    """Draw a plant and its camera, or read the plant from its file.

    Args:
        vehicle: A vehicle, its name or file.
        plant: Seed, or a plant file, whose own severity and seed then also make the camera.
        severity: Of a drawn plant.
        camera: What it sends.
        seed: Of ripples, noise, jitter and losses.
        site: pool, tank or open-water; a camera hangs over the pool and the tank alone. If None the pool, or the
            water of the world.
        firmware: mcu, or ardusub, with which the vehicle has a compass and a Doppler log.
        world: What the vehicle's own sensors see: a site of the catalogue of worlds, or a path; None: nothing.

    Raises:
        PlantSpecError: The plant cannot be made, or there is no such severity or camera.
    """
    ours = load_vehicle(vehicle)
    spec = draw_plant(ours, int(plant), severity) if plant.isdecimal() else load_plant_spec(plant)
    seen = None if world is None else described_world(world)
    world_is_site = seen is not None and site is None
    spec = site_of_world(seen, spec) if world_is_site else site_of(site or "pool", spec)
    site = site or ("pool" if world is None else "open-water")
    ours = vehicle_at(site, ours, navigation=firmware == "ardusub")
    if site == "open-water" and camera != "none":
        raise PlantSpecError(
            "no camera hangs over open water: give --camera none, and a positioning if there is one"
        )
    if firmware not in ("mcu", "ardusub"):
        raise PlantSpecError(f"unknown firmware '{firmware}'; available: mcu, ardusub")
    if camera not in ("pictures", "corners", "none"):
        raise PlantSpecError(f"unknown camera '{camera}'; available: pictures, corners, none")
    onboard = None if seen is None else seen.onboard(ours, seed, solid=world_is_site)
    plan = PoolPlan(vehicle=ours, spec=spec, camera=None, calibrated=None, firmware=firmware, onboard=onboard)
    if camera == "none":
        return plan
    hung, calibrated, settings = camera_of(ours, spec.seed, spec.severity, basin=spec.basin)
    eye = CameraPlan(vehicle=ours, site=hung, settings=settings, basin=spec.basin, mode=camera, seed=seed)
    return replace(plan, camera=eye, calibrated=calibrated)


@dataclass(frozen=True, kw_only=True)
class SiteChoice:
    """A site, and the plant of its vehicle."""

    vehicle: str = "finsrov"
    """(NAME|FILE) Vehicle in the catalogue, or path of a vehicle file."""
    plant: str = "1"
    """(SEED|FILE) Plant: a seed to draw it from, or a plant file."""
    severity: Severity = "realistic"
    """(NAME) How much a drawn plant and its camera differ from the files: nominal, realistic or hard."""
    site: str | None = None
    """(NAME) Site: pool (default), tank or open-water (current, waves, 20 m deep); for a world the default is its
    basin, or open water down to its seabed."""
    world: str | None = None
    """(SITE|FILE) World for the vehicle's own cameras, sonars and altimeters, drawn from --seed: a site of finssim
    worlds, or a world file. Readings are sent like images."""
    water: Path | None = None
    """(FILE) Water file (.yaml): currents, a profile over depth and time, waves or a sea state, which add to the site's
    own."""
    start: str | None = None
    """(X,Y,Z,YAW) Where the vehicle starts, world frame: x,y,z [m], yaw [deg]; the centre, or the viewpoint of a world,
    if not given."""
    camera: Literal["pictures", "corners", "none"] | None = None
    """(KIND) Output of the camera: pictures, corners (of the tags) or none. Default: pictures; corners for a team or a
    tank; none in open water, with a world or a task, and with ardusub."""
    positioning: str = "none"
    """(NAME) Position fixes on the robot's link: none, motion-capture or usbl."""
    firmware: Literal["mcu", "ardusub"] = "mcu"
    """(NAME) What steers the motors: mcu, the motor controller of `finssim run`, or ardusub, an autopilot that answers
    as ArduSub does, over MAVLink, with a compass and a Doppler log."""
    version: Literal["4.1", "4.5", "4.7"] = "4.5"
    """(VERSION) Of ArduSub, with ardusub: 4.5 is as recorded; 4.1 has no axes of pitch and roll, 4.7 other names of
    parameters and SURFACE_MAX_THR."""
    seed: int = 1
    """Seed of every random number; equal seeds give equal results."""

    def wet(self, spec: PlantSpec) -> PlantSpec:
        """Return a plant in the water of the water file.

        Raises:
            SurroundingsError: The file is refused.
        """
        if self.water is None:
            return spec
        water = load_water(self.water)
        if water.drifting or any(water.shear):
            raise PlantSpecError(
                f"{self.water}: shear and drift_std are not for the pool: give the table of a current"
            )
        circulation = spec.circulation.model_copy(update={"water": water})
        return spec.model_copy(update={"circulation": circulation})

    def plan(self) -> tuple[PoolPlan, Station]:
        """Return the pool of one vehicle, and where the vehicle starts.

        Raises:
            PlantSpecError: The plant cannot be made, or the start is outside.
        """
        usual: Any = {"pool": "pictures", "tank": "corners"}.get(
            self.site or ("pool" if self.world is None else ""), "none"
        )
        plan = make_plan(
            self.vehicle,
            self.plant,
            self.severity,
            camera=self.camera or ("none" if self.firmware == "ardusub" else usual),
            seed=self.seed,
            site=self.site,
            firmware=self.firmware,
            world=self.world,
        )
        if self.version != "4.5" and self.firmware != "ardusub":
            raise PlantSpecError(f"--version {self.version} is ArduSub's: give --firmware ardusub")
        firmware = plan.spec.firmware.model_copy(update={"version": self.version})
        plan = replace(plan, spec=self.wet(plan.spec.model_copy(update={"firmware": firmware})))
        start = self.start
        if start is None and self.world is not None and self.site is None:
            view = described_world(self.world).viewpoint
            start = ",".join(f"{x:g}" for x in (*view.position, math.degrees(view.yaw)))
        start = start or f"0,0,{-0.5 * plan.spec.basin.depth:g},0"
        begin = station_of(start)
        _check_start(begin, plan.spec.basin, start)
        return replace(plan, positioning=self.positioning), begin


@dataclass(frozen=True, kw_only=True)
class Ends:
    """Addresses of a pool."""

    port: int = MCU_PORT
    """UDP port of the motor controller; images use the next port, lock-step (TCP) the one after. With ardusub, 0
    selects a free one."""
    bind: str = "127.0.0.1"
    """(ADDRESS) Local address; only this machine if not given."""
    robot: str = "127.0.0.1:54321"
    """(HOST:PORT) The only robot that may send commands in real time; images are sent to the next port."""
    ground: str = "127.0.0.1:14550"
    """(HOST:PORT,...) With ardusub: UDP ground stations to send to; every sender to --port is answered, too."""
    tcp: str = "127.0.0.1:5760"
    """(HOST:PORT) With ardusub: TCP address for ground stations; port 0 selects a free one."""
    dvl: str = "127.0.0.1:16171"
    """(HOST:PORT) With ardusub: TCP address of the Water Linked DVL; port 0 selects a free one."""
    dvl_page: str | None = None
    """(HOST:PORT) With ardusub: TCP address of the DVL's web page, by which BlueOS finds it; none if not given."""

    @property
    def ours(self) -> tuple[str, int]:
        """First address of the pool."""
        return self.bind, self.port

    @property
    def theirs(self) -> tuple[str, int]:
        """First address of the robot."""
        return host_port(self.robot, "--robot")

    def ground_links(self) -> Callable[[], GroundLinks]:
        """Return a function that opens what an autopilot has instead of the motor controller's wire."""
        texts = [] if self.ground == "none" else self.ground.split(",")
        stations = [host_port(text.strip(), "--ground") for text in texts]
        page = None if self.dvl_page is None else host_port(self.dvl_page, "--dvl-page")
        tcp, dvl = host_port(self.tcp, "--tcp"), host_port(self.dvl, "--dvl")
        return partial(GroundLinks, self.ours, stations, tcp, dvl, page)


@dataclass(frozen=True, kw_only=True)
class PoolFiles:
    """Files that a pool writes."""

    pool_file: Path | None = None
    """(FILE) Pool file to write, with the calibrated camera (.yaml)."""
    truth: Path | None = None
    """(FILE) File for the true states, for scoring; for a team a folder."""


def run(
    choice: Annotated[SiteChoice, "options"],
    ends: Annotated[Ends, "options"],
    *,
    task: str | None = None,
    team: str | None = None,
    lockstep: bool = False,
    files: Annotated[PoolFiles, "options"] = PoolFiles(),
    duration: Annotated[float | None, (0.0, None)] = None,
    timing: Annotated[PoolTiming | None, "python"] = None,
) -> None:
    """Simulate a vehicle and its pool for a robot on this machine, until Ctrl-C.

    Example: finssim pool --plant 1 --severity realistic --pool-file pool.yaml --truth truth.fst

    Args:
        choice: The site, and the plant of its vehicle.
        ends: Addresses.
        task (TASK): Run the site of a task in open water, in real time, with ports as for --team; messages between
            robots use the port of --port plus five. Other agents of the task are simulated, and the task scores the
            truth.
        team (NAME,NAME): Several vehicles at one site, in real time: names or files separated by commas, as agents
            of --task or without a task. The ports of each further motor controller and robot are higher by ten than
            --port and --robot. A camera sees all of them, with different tag ids.
        lockstep: Advance time as fast as one robot requests, instead of in real time.
        files: Files that are written.
        duration: Duration, pool's clock [s]; until Ctrl-C if not given.
        timing: Clock of the pool; that of this machine if not given.

    Raises:
        PlantSpecError, LinkError, GoalError, VehicleError, OutputError: What cannot be used.
    """
    logging.basicConfig(level=logging.WARNING, format="finssim: %(message)s", stream=sys.stderr)
    positioning_of(choice.positioning, choice.seed)  # refuses what is none
    longest = math.inf if duration is None else duration
    timing = timing or PoolTiming()
    if task is not None or team is not None:
        if choice.firmware == "ardusub":
            raise PlantSpecError("--firmware ardusub is for one vehicle: leave --team and --task out")
        written = task is not None and files != PoolFiles()
        single = lockstep or choice.start is not None or choice.world is not None
        if not choice.plant.isdecimal() or single or written:
            raise PlantSpecError(
                "--team and --task draw their plants, their time is real and their starts are their own: give a seed "
                "for --plant, leave --lockstep, --start and --world out, and of a task --pool-file and --truth"
            )
        bodies = [load_vehicle(name.strip()) for name in (team or choice.vehicle).split(",")]
        fleet, calibrated = (
            _playing(task, bodies, choice) if task is not None else swimming(bodies, choice, files.truth)
        )
        _serve_team(fleet, calibrated, ends, files.pool_file, longest, timing)
        return
    plan, begin = choice.plan()
    port, ardusub = ends.port, choice.firmware == "ardusub"
    if not (0 < port or (ardusub and not lockstep and plan.camera is None)) or port > 65533:
        raise LinkError(f"port {port}: expected 1 to 65533, as the two after it are taken too")
    if files.pool_file is not None and plan.calibrated is None:
        raise PlantSpecError("--pool-file describes the camera, and --camera none has none: omit one")

    def make_world(eye: Any) -> VirtualPool:
        """Begins to write files: only when every wire is open, lest those of a pool that is running are replaced."""
        world = plan.world(eye, start=begin, seed=choice.seed, truth=files.truth)
        if files.pool_file is not None and plan.calibrated is not None:
            write_pool(plan.calibrated, files.pool_file)
        _tell_plant(plan, files)
        return world

    if lockstep:
        _lockstep(plan, make_world, (ends.bind, port + 2), longest)
    else:
        links = ends.ground_links() if ardusub else None
        _realtime(plan, make_world, ends.ours, ends.theirs, longest, links, timing)


def _serve_team(
    fleet: Fleet,
    calibrated: Pool | None,
    ends: Ends,
    pool_file: Path | None,
    duration: float,
    timing: PoolTiming,
) -> None:
    """Serve several vehicles, each to a separate robot, from their first addresses on ten ports apart."""
    (bind, port), (host, first) = ends.ours, ends.theirs
    names = fleet.task.agents if isinstance(fleet, TaskSite) else tuple(fleet.worlds)
    if not 0 < port <= 65535 - 10 * len(names):
        raise LinkError(f"port {port}: expected room for ten ports to each of {len(names)} vehicles after it")
    with interruptible() as interrupted, ExitStack() as stack:
        stack.callback(fleet.close)
        messages = timing.messages(fleet)
        sinks: list[UdpSender] = []
        if isinstance(fleet, TaskSite):
            messages = server = MediumServer((bind, port + MESSAGES), fleet.carrier, names)
            stack.callback(server.close)
        transports = {}
        for i, name in enumerate(names):
            transports[name] = UdpTransport((bind, port + 10 * i), (host, first + 10 * i))
            stack.callback(transports[name].close)
            _say(f"{name}: {_name(transports[name].address)}, for {_name(transports[name].peer)} alone")
            if calibrated is not None:
                sinks.append(UdpSender((bind, port + 10 * i + 1), (host, first + 10 * i + 1)))
                stack.callback(sinks[-1].close)
        if calibrated is not None and pool_file is not None:
            write_pool(calibrated, pool_file)
            _say(f"pool file: {pool_file}")
        if isinstance(fleet, TaskSite):
            _tell_goal(fleet)
            _say(f"messages: {_name(server.address)}")
        notify = partial(_tell_episode, fleet)
        pace = serve_realtime(
            fleet,
            SiteWires(transports, messages, sinks),
            duration=duration,
            until=interrupted,
            over=notify,
            clock=timing.now,
            wait=lambda duration: timing.wait(duration, interrupted),
        )
    if not fleet.over:
        _tell_episode(fleet)
    _say(f"ended after {pace.duration:.1f} s")


def _playing(task: str, bodies: Sequence[Vehicle], choice: SiteChoice) -> tuple[TaskSite, None]:
    """Return the site of a task in open water, without a camera; its own vehicles are of the first type."""
    fitted = fitted_task(task, bodies[0])
    if len(bodies) not in (1, len(fitted.agents)):
        raise PlantSpecError(
            f"--team names {len(bodies)} vehicles, but task '{fitted.name}' has {len(fitted.agents)} agents: "
            f"{', '.join(fitted.agents)}"
        )
    agents = list(bodies) * (len(fitted.agents) // len(bodies))
    vehicles, positions = (
        [*agents, *[bodies[0]] * len(fitted.others)],
        PositionSources(positioning=choice.positioning),
    )
    plants = [
        (v, choice.wet(site_of("open-water", draw_plant(v, int(choice.plant), choice.severity))))
        for v in vehicles
    ]
    site = TaskSite(task, vehicles, plants, None, positions, seed=choice.seed)
    return site, None


def swimming(bodies: Sequence[Vehicle], choice: SiteChoice, truth: Path | None) -> tuple[Fleet, Pool | None]:
    """Return vehicles side by side, robot_1 and so on, and what their robots may know of the one camera.

    Args:
        bodies: As their files have them.
        choice: The site; its plant is the seed of the first vehicle's plant and of the camera, the others' follow.
        truth: Folder that takes NAME.truth of each; none if None.

    Raises:
        PlantSpecError: They have no room, or the camera cannot be there.
    """
    site, plant, severity, seed = choice.site or "pool", int(choice.plant), choice.severity, choice.seed
    camera = choice.camera or ("none" if site == "open-water" else "corners")
    if camera == "pictures" and site != "open-water":
        raise PlantSpecError("the one camera over a team sends corners: give --camera corners, or none")
    if site == "open-water" and camera != "none":
        raise PlantSpecError("no camera hangs over open water: give --camera none, and a positioning")
    ours = [numbered(vehicle_at(site, body), i) for i, body in enumerate(bodies)]
    specs = [choice.wet(site_of(site, draw_plant(v, plant + i, severity))) for i, v in enumerate(ours)]
    basin = specs[0].basin
    spacing = ROOM * max(max(v.body.size) for v in ours)
    if spacing * len(ours) > basin.length:
        raise PlantSpecError(
            f"{len(ours)} vehicles {spacing:.1f} m apart do not fit into {basin.length:g} m: give a larger --site"
        )
    eyes: list[PoolCamera | None] = [None] * len(ours)
    calibrated = None
    if camera == "corners":
        true, calibrated, settings = camera_of(ours[0], plant, severity, basin=basin)
        for i, v in enumerate(ours):
            robot_settings = camera_of(v, plant, severity, basin=basin)[2]
            eyes[i] = PoolCamera(
                v,
                true,
                mode="corners",
                settings=replace(settings, mounts=robot_settings.mounts),
                seed=seed,
                noise_seed=seed + 1000 * (i + 1),
            )
    worlds = {}
    for i, (v, spec, eye) in enumerate(zip(ours, specs, eyes, strict=True)):
        name = f"robot_{i + 1}"
        x = spacing * (i - 0.5 * (len(ours) - 1))
        worlds[name] = VirtualPool(
            v,
            spec,
            camera=eye,
            positioning=positioning_of(choice.positioning, seed + i),
            start=((x, 0.0, -0.5 * basin.depth), quat_from_yaw(0.0)),
            seed=seed + i,
            truth=None if truth is None else truth / f"{name}.truth",
        )
    return Fleet(worlds), calibrated


def _tell_goal(site: TaskSite) -> None:
    """Print the place of the task's goal, if it does not move."""
    if site.task.moving:
        return
    x, y, z = site.referee.arrays.goal_position.numpy()[0]
    yaw = math.degrees(float(quat_yaw(site.referee.arrays.goal_quaternion.numpy()[0].astype(float))))
    _say(f"goal: {x:.3f},{y:.3f},{z:.3f},{yaw:.1f}")


def _tell_episode(site: Fleet) -> None:
    """Print the result of the episode, in a line."""
    if not isinstance(site, TaskSite):
        return
    if site.referee.over:
        _say("episode: " + ", ".join(f"{name} {value:.4g}" for name, value in site.referee.metrics().items()))
    else:
        _say(f"episode: not ended after {site.scored} control steps")


def _check_start(start: Station, basin: Basin, text: str) -> None:
    x, y, z = start.position
    if abs(x) > 0.5 * basin.length or abs(y) > 0.5 * basin.width or not -basin.depth <= z <= 0.0:
        raise PlantSpecError(
            f"--start {text} is outside the pool: expected x within ±{0.5 * basin.length:g} m, "
            f"y within ±{0.5 * basin.width:g} m and z from {-basin.depth:g} to 0 m"
        )


def _lockstep(
    plan: PoolPlan, make_world: Callable[[Any], VirtualPool], address: tuple[str, int], duration: float
) -> None:
    with ExitStack() as stack:
        server = LockstepServer(address)
        stack.callback(server.close)
        world = make_world(plan.eye())
        stack.callback(world.close)
        reason = "stopped"
        with suppress(KeyboardInterrupt), interrupting():
            _say(f"lock-step: {_name(server.address)}")
            reason = server.serve(world, duration=duration)
    _say(f"{reason} at {world.time:.1f} s")


def _realtime(
    plan: PoolPlan,
    make_world: Callable[[Any], VirtualPool],
    bind: tuple[str, int],
    robot: tuple[str, int],
    duration: float,
    links: Callable[[], GroundLinks] | None,
    timing: PoolTiming,
) -> None:
    with interruptible() as interrupted, ExitStack() as stack:
        transport = UdpTransport(bind, robot) if links is None else links()
        stack.callback(transport.close)
        drawn, sink, eye = _camera(plan, _next(bind), _next(robot), paced=timing.paced)
        for end in (drawn, sink):
            if end is not None:
                stack.callback(end.close)
        world = make_world(eye)
        stack.callback(world.close)
        if isinstance(transport, GroundLinks):
            _say(f"autopilot: {_name(transport.address)} (UDP), {_name(transport.tcp)} (TCP)")
            _say(f"Doppler log: {_name(transport.dvl.address)}")
        else:
            _say(f"motor controller: {_name(transport.address)}, for {_name(transport.peer)} alone")
        if eye is not None:
            _say(f"pictures: {_name(_next(bind))}, for {_name(_next(robot))}")
        site, sinks = Fleet({plan.vehicle.name: world}), [] if sink is None else [sink]
        transports = {plan.vehicle.name: transport}
        pace = serve_realtime(
            site,
            SiteWires(transports, sinks=sinks, camera=drawn),
            duration=duration,
            until=interrupted,
            clock=timing.now,
            wait=lambda duration: timing.wait(duration, interrupted),
        )
        _say(f"ended after {pace.duration:.1f} s" if timing.paced else pace.sentence)
        if drawn is not None and drawn.dropped:
            _say(drawn.complaint)


def _camera(
    plan: PoolPlan, bind: tuple[str, int], peer: tuple[str, int], *, paced: bool
) -> tuple[PictureProcess | None, UdpSender | None, Any]:
    """The process that draws, or the sink for what is computed here, and the camera for the world."""
    plans: list[PictureSourcePlan] = [
        plan_or_none for plan_or_none in (plan.camera, plan.onboard) if plan_or_none is not None
    ]
    if not plans:
        return None, None, None
    if paced or (plan.onboard is None and plan.camera is not None and plan.camera.mode == "corners"):
        return None, UdpSender(bind, peer), plan.eye()
    drawn = PictureProcess(plans, bind, peer)
    return drawn, None, drawn


def _next(address: tuple[str, int]) -> tuple[str, int]:
    """Pictures leave and arrive at the port after that of the motor controller's wire."""
    return address[0], address[1] + 1


def _tell_plant(plan: PoolPlan, files: PoolFiles) -> None:
    spec = plan.spec
    _say(f"plant: {spec.title}, {spec.severity}, seed {spec.seed}")
    if plan.camera is not None:
        s = plan.camera.settings
        _say(
            f"camera: {plan.camera.mode}, {s.rate:g} Hz, {plan.camera.site.camera.lens.width} x "
            f"{plan.camera.site.camera.lens.height}, ripples of slope {s.ripples:g}"
        )
    if plan.onboard is not None:
        rates = (f"{name} {sensor.rate:g} Hz" for name, sensor in plan.vehicle.perception.items())
        _say(f"world: {plan.onboard.name}, seed {plan.onboard.seed}; {', '.join(rates)}")
    for name, path in (("pool file", files.pool_file), ("truth", files.truth)):
        if path is not None:
            _say(f"{name}: {path}")


def _name(address: tuple[str, int]) -> str:
    return f"{address[0]}:{address[1]}"


def _say(line: str) -> None:
    print(line, flush=True)
    sys.stdout.flush()
