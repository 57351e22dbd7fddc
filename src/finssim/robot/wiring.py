"""Connections of a robot: to a motor controller and a camera in real time, or to a virtual pool in lock-step."""

from __future__ import annotations

import gc
import math
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from finssim.core import realtime
from finssim.localization.overhead_camera import Pool
from finssim.robot.interrupt import interruptible
from finssim.robot.links.frames import LinkError, McuLink
from finssim.robot.links.transports import (
    DEFAULT_BIND,
    MavlinkAddress,
    Transport,
    UdpTransport,
    host_port,
    open_transport,
)
from finssim.robot.lockstep import DEFAULT_PORT, LockstepClient, run_lockstep
from finssim.robot.pictures import DEFAULT_CAMERA, NoPictures, PictureSource, TagFinder, open_pictures
from finssim.robot.runtime import Link, Runtime
from finssim.vehicles import Vehicle

__all__ = [
    "POOL_ADDRESS",
    "RobotDriver",
    "Wires",
    "Wiring",
    "connected",
    "link_of",
    "open_camera",
    "run_realtime",
]


# The outermost loop of a robot in real time: only here a clock is read and time is waited for.


LAST_FRAMES = 3
"""Number of frames without thrust at the end of a run."""
COLLECT_EVERY = 1.0
"""Time between two rounds of the garbage collector, which run only when there is slack [s]."""
ENOUGH_SLACK = 0.004
"""Slack required for a round [s]."""
SWITCH = 0.001
"""Longest time for which another thread may hold the interpreter [s]."""


class Wires(NamedTuple):
    """Open connections of a robot."""

    transport: Transport
    """Transport to the motor controller."""
    pictures: PictureSource | None = None
    """Pictures of the camera; None: there is none."""
    mates: Transport | None = None
    """Transport of messages between vehicles; None: there are no others."""


def run_realtime(
    runtime: Runtime,
    wires: Wires,
    *,
    rate: float = 60.0,
    duration: float = math.inf,
    until: Callable[[Runtime], bool] = lambda runtime: False,
    show: Callable[[Runtime], None] = lambda runtime: None,
    clock: Callable[[], float] = realtime.now,
    wait: Callable[[float], None] = realtime.wait,
) -> float:
    """Run a robot on its connections until the time is over, `until` returns True, or Ctrl-C; then stop its thrusters.

    Deadlines are multiples of the period since the start, so that they do not drift. A late step is counted as an
    overrun; the deadlines that it missed are skipped.

    Args:
        runtime: The robot.
        wires: Its open connections.
        rate: Steps per second [Hz].
        duration: Duration [s].
        until: Called after every step; the run ends if it returns True.
        show: Called after every step.
        clock: The robot's clock [s].
        wait: Function that waits for a time [s].

    Returns:
        Duration of the run [s].
    """
    transport, pictures, mates = wires
    period, turn = 1.0 / rate, 0
    with _calm(), interruptible() as interrupted:
        now = start = collected = clock()  # after garbage collection, which takes time
        try:
            while not interrupted() and (now := clock()) - start < duration:
                frames = [(now, data) for data in transport.receive()]
                heard = mates.receive() if mates is not None else ()
                outgoing = runtime.step(now, frames, pictures.receive(now) if pictures else (), heard)
                # If the process was suspended within the step, its decision is outdated; the next step detects that.
                if clock() - now < runtime.bridge.settings.command_timeout:
                    for data in outgoing:
                        transport.send(data)
                for data in runtime.team_datagrams if mates is not None else ():
                    mates.send(data)
                runtime.sent(clock())
                show(runtime)
                if until(runtime):
                    break
                turn += 1
                slack = start + turn * period - clock()
                if slack > ENOUGH_SLACK and now - collected > COLLECT_EVERY:
                    gc.collect(1)
                    collected, slack = now, start + turn * period - clock()
                if slack < 0.0:
                    runtime.counters.overruns += 1
                    turn += math.floor(-slack / period)
                else:
                    wait(slack)
        finally:
            for data in runtime.stop(clock(), LAST_FRAMES):
                transport.send(data)
                wait(period)
        return now - start


@contextmanager
def _calm() -> Iterator[None]:
    """Keep the garbage collector and other threads from delaying the loop; objects that were frozen before remain
    frozen."""
    enabled, frozen, interval = gc.isenabled(), gc.get_freeze_count(), sys.getswitchinterval()
    gc.collect()
    gc.freeze()
    gc.disable()
    sys.setswitchinterval(SWITCH)
    try:
        yield
    finally:
        sys.setswitchinterval(interval)
        if not frozen:
            gc.unfreeze()
        if enabled:
            gc.enable()


POOL_ADDRESS = "udp://127.0.0.1:58766"
"""Address of the motor controller of a virtual pool on this machine."""


@dataclass(frozen=True, kw_only=True)
class Wiring:
    """Connection of the robot."""

    robot: str = "pool"
    """(ADDRESS) Motor controller: udp://HOST:PORT, serial:DEVICE, or pool for the virtual pool on this machine; or
    autopilot: mavlink://udpin:HOST:PORT, udpout:, tcp: or serial:, with ?dvl=HOST for a Water Linked DVL, or mavlink
    for the virtual pool. With --lockstep: pool, or HOST:PORT."""
    bind: str = "127.0.0.1:54321"
    """(ADDRESS:PORT) Local address and port for udp; images arrive at the next port. Loopback if not given."""
    pictures: str | None = None
    """(ADDRESS) Overhead camera: udp://HOST:PORT or none; the virtual pool's with --robot pool, otherwise none, if not
    given."""
    lockstep: bool = False
    """Run in lock-step with finssim pool --lockstep, as fast as possible."""
    calibrate_depth: bool = False
    """Calibrate an autopilot's barometer as soon as it is connected, with the vehicle at the surface: depth is then
    measured from there."""
    messages: str = ""
    """(ADDRESS) Relay of messages between vehicles, such as finssim pool --task: HOST:PORT. With --team the default is
    the port of --robot plus five."""


def link_of(robot: str, vehicle: Vehicle) -> Link:
    """Return the link of an address: to an autopilot for `mavlink`, otherwise to the vehicle's motor controller.

    Raises:
        LinkError, ControlError: pymavlink is missing, or the vehicle has no autopilot.
    """
    if not robot.startswith("mavlink"):
        return McuLink(vehicle.mcu.outputs, len(vehicle.actuators))
    if vehicle.actuators:
        raise LinkError(
            f"--robot mavlink moves only thrusters, but {vehicle.name} has {', '.join(vehicle.actuators)}: connect "
            "its motor controller"
        )
    try:
        from finssim.robot.links.mavlink import MavlinkLink
    except ModuleNotFoundError:
        raise LinkError(
            "mavlink needs pymavlink, which is not installed: pip install 'finssim[hardware]'"
        ) from None
    return MavlinkLink(vehicle, key=MavlinkAddress.of(robot).key)


class RobotDriver(Protocol):
    """Function that runs a robot on its connection until the time is over or `until` returns True, and returns the
    duration [s]."""

    def __call__(
        self,
        runtime: Runtime,
        *,
        duration: float,
        show: Callable[[Runtime], None],
        until: Callable[[Runtime], bool],
        rate: float = 60.0,
    ) -> float: ...


@contextmanager
def connected(wiring: Wiring, vehicle: Vehicle, pool: Pool | None) -> Iterator[RobotDriver]:
    """Open all connections for one run, or for several consecutive runs, and yield the driver of a run.

    A later run continues at the clock of the end of the previous one, and receives nothing that arrived between them.

    Args:
        wiring: Connections to open.
        vehicle: Vehicle with the tags to detect.
        pool: Pool with the camera's image size; None: there is no camera.

    Raises:
        LinkError, LockstepError: A connection cannot be opened.
    """
    with ExitStack() as stack:
        if wiring.lockstep and wiring.messages:
            raise LinkError(
                "a team runs in lock-step within one process: use python -m studies.stack, or omit --lockstep"
            )
        if not wiring.lockstep:
            _check_clock(wiring.robot)
        link = link_of(wiring.robot, vehicle)
        if wiring.calibrate_depth:
            if not wiring.robot.startswith("mavlink"):
                raise LinkError("--calibrate-depth is for an autopilot: connect with --robot mavlink://...")
            link.calibrate_depth = True
        if wiring.lockstep:
            world = stack.enter_context(LockstepClient(_lockstep_address(wiring)))
            clock = 0.0

            def take_turns(runtime: Runtime, **options: Any) -> float:
                nonlocal clock
                runtime.attach(link)
                began, clock = clock, run_lockstep(runtime, world, start=clock, gentle=True, **options)
                return clock - began

            yield take_turns
            return
        transport = open_transport(POOL_ADDRESS if wiring.robot == "pool" else wiring.robot, wiring.bind)
        stack.callback(transport.close)
        camera = open_camera(wiring, vehicle, pool)
        stack.callback(camera.close)
        mates = None
        if wiring.messages:
            mates = UdpTransport(
                (host_port(wiring.bind, "--bind")[0], 0), host_port(wiring.messages, "--messages")
            )
            stack.callback(mates.close)

        def run(runtime: Runtime, **options: Any) -> float:
            while transport.receive():
                pass
            camera.receive(realtime.now())
            runtime.attach(link)
            return run_realtime(runtime, Wires(transport, camera, mates), **options)

        yield run


def _check_clock(robot: str) -> None:
    """Refuse a slowed clock except for a virtual pool on this machine, whose process uses the same clock."""
    rate = realtime.clock_rate()
    hosts = re.findall(r"(?:udp://|udpin:|udpout:|tcp:|dvl=)([^:?&]+)", robot)
    remote = [host for host in hosts if host != "localhost" and not host.startswith("127.")]
    if rate != 1.0 and (remote or "serial:" in robot):
        raise LinkError(
            f"--robot {robot}: {realtime.RATE}={rate:g} slows the clock, and only a virtual pool on this machine "
            f"shares it: unset {realtime.RATE} for a vehicle"
        )


def open_camera(wiring: Wiring, vehicle: Vehicle, pool: Pool | None) -> PictureSource:
    """Return the source of pictures, with detection of tags in a separate thread if there is an overhead camera.

    Raises:
        LinkError: The address is invalid, or the source cannot be opened.
    """
    default = f"udp://{DEFAULT_CAMERA}" if wiring.robot == "pool" else "none"
    host, port = host_port(wiring.bind, "--bind")
    source = open_pictures(wiring.pictures or default, f"{host}:{port + 1 if port else 0}")
    if isinstance(source, NoPictures) or pool is None:
        return source
    lens = pool.camera.lens
    return TagFinder(source, vehicle, size=(lens.height, lens.width))


def _lockstep_address(wiring: Wiring) -> str:
    """Return HOST:PORT of the pool."""
    if wiring.bind != DEFAULT_BIND or wiring.pictures is not None:
        raise LinkError("in lock-step all comes over one connection: leave --bind and --pictures out")
    if wiring.robot in ("pool", "mavlink"):
        return f"127.0.0.1:{DEFAULT_PORT}"
    address = wiring.robot.removeprefix("mavlink://tcp:").removeprefix("tcp://")
    if "/" in address or address.startswith("serial:"):
        raise LinkError(
            f"--robot {wiring.robot} is no world in lock-step: give HOST:PORT of finssim pool --lockstep, "
            "or leave --lockstep out"
        )
    return address
