"""Camera end of the picture link: over UDP to one robot."""

from __future__ import annotations

import heapq
import multiprocessing
import os
import queue
import signal
import socket
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import count
from typing import Any, Literal, Protocol

import numpy as np

from finssim.core import realtime
from finssim.core.quiet import start_warp
from finssim.core.system import parent_runs
from finssim.localization.overhead_camera import Pool
from finssim.pool.camera import CameraSettings, PoolCamera
from finssim.pool.plant_spec import Basin
from finssim.pool.positioning import Exposure, PoseAt, Shutter
from finssim.robot.links.frames import LinkError
from finssim.robot.links.transports import bound_socket
from finssim.robot.messages import Picture
from finssim.robot.pictures import LONGEST_FRAGMENT, encode_picture, fragments
from finssim.vehicles import Vehicle

Address = tuple[str, int]

__all__ = [
    "CameraPlan",
    "PictureProcess",
    "UdpSender",
]


class UdpSender:
    """Sender of pictures to one robot by UDP: JPEG of quality 90, or only the tags, in one datagram."""

    def __init__(
        self, bind: tuple[str, int], peer: tuple[str, int], *, fragment: int = LONGEST_FRAGMENT
    ) -> None:
        """
        Args:
            bind: Address and port of this end; port 0 selects a free one (see `address`).
            peer: Address and port of the robot.
            fragment: Bytes of a picture in a datagram; 1400 for a network, larger only on this machine.

        Raises:
            LinkError: The address cannot be bound.
        """
        self.sent = self.lost = 0
        self._peer, self._fragment = peer, fragment
        self._socket = bound_socket(socket.SOCK_DGRAM, bind)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4 * 2**20)
        self.address: tuple[str, int] = self._socket.getsockname()

    def send(self, picture: Picture, now: float) -> None:
        """Send a picture; if it cannot be sent, it is counted as lost and dropped.

        Args:
            picture: Picture with its time on the clock of `finssim.core.realtime` [s].
            now: Time on the clock of `finssim.core.realtime` [s].
        """
        # Small pictures of the vehicle's own sensors, which policies use, are not compressed.
        compress = not picture.source or (
            picture.image is not None and picture.image.nbytes > LONGEST_FRAGMENT
        )
        data = encode_picture(picture, late=max(now - picture.time, 0.0), compress=compress)
        try:
            for datagram in fragments(data, self.sent + self.lost, self._fragment):
                self._socket.sendto(datagram, self._peer)
            self.sent += 1
        except OSError:
            self.lost += 1

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


# Rendering of pictures in a separate process, so that it never delays telemetry.


UNDRAWN = 8
"""Capacity of the queue of exposures before rendering; further ones are dropped, as in a camera with a slow
computer."""
STARTING = 120.0
"""Time limit for starting the process and, the first time on a machine, compiling the renderer [s]."""
ORPHANED = 1.0
"""Period at which the process checks that its parent still runs [s]."""


@dataclass(frozen=True, kw_only=True)
class CameraPlan:
    """Arguments of `PoolCamera`, so that another process can create it."""

    vehicle: Vehicle
    site: Pool
    settings: CameraSettings
    basin: Basin
    mode: Literal["pictures", "corners"]
    seed: int

    def camera(self) -> PoolCamera:
        """Return the camera."""
        return PoolCamera(
            self.vehicle, self.site, mode=self.mode, settings=self.settings, basin=self.basin, seed=self.seed
        )

    def shutter(self) -> Shutter:
        """Return the camera's shutter."""
        return self.settings.shutter(self.seed)


class PictureSourcePlan(Protocol):
    """Arguments of a camera, or of the vehicle's own sensors."""

    def camera(self) -> Any:
        """Return the camera, whose `develop` returns the picture of an exposure."""

    def shutter(self) -> Any:
        """Return its shutter, whose `advance` returns exposures."""


class PictureProcess:
    """Cameras of a `VirtualPool` in real time: exposure here, rendering and sending in another process."""

    def __init__(self, plans: Sequence[PictureSourcePlan], bind: Address, peer: Address) -> None:
        """Start the process and wait until it is ready to render.

        Args:
            plans: Cameras to render.
            bind: Address and port of the sending end.
            peer: Address and port of the robot.

        Raises:
            LinkError: The link cannot be opened, or the process did not start.
        """
        self.dropped = 0
        self.start = 0.0
        """Time at which the pool's clock was 0, on the clock of `finssim.core.realtime` [s]."""
        self._shutters = [plan.shutter() for plan in plans]
        context = multiprocessing.get_context("spawn")
        self._undrawn: Any = context.Queue(UNDRAWN)
        ready, theirs = context.Pipe(duplex=False)
        self._process = context.Process(
            target=_draw,
            args=(plans, bind, peer, self._undrawn, theirs, os.getpid()),
            name="pool camera",
            daemon=True,
        )
        with _deaf():
            self._process.start()
        theirs.close()
        self._await(ready)

    def advance(self, t0: float, t1: float, pose_at: PoseAt) -> Sequence[Picture]:
        """Queue exposures for rendering; return no pictures, as the other process sends them."""
        for i, shutter in enumerate(self._shutters):
            for exposure in shutter.advance(t0, t1, pose_at):
                try:
                    self._undrawn.put_nowait((i, exposure, self.start + exposure.arrival))
                except queue.Full:
                    self.dropped += 1
        return ()

    @property
    def complaint(self) -> str:
        """Return why pictures are missing, and a remedy."""
        if self._process.exitcode is not None:
            return f"the process that draws ended (status {self._process.exitcode}): start the pool again"
        return f"{self.dropped} pictures could not be drawn in time: --camera corners needs no drawing"

    def close(self) -> None:
        """End the process and close the link."""
        if self._process.is_alive():
            try:
                self._undrawn.put(None, timeout=1.0)
            except queue.Full:
                self._process.terminate()
        self._process.join(timeout=5.0)
        if self._process.is_alive():
            self._process.kill()
        self._undrawn.cancel_join_thread()

    def _await(self, ready: Any) -> None:
        try:
            problem = ready.recv() if ready.poll(STARTING) else "it did not start in time"
        except EOFError:
            problem = "it ended while starting"
        if problem:
            self.close()
            raise LinkError(problem)


@contextmanager
def _deaf() -> Iterator[None]:
    """Make processes that are started in the context ignore Ctrl-C, which a terminal sends to all its processes."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _draw(
    plans: Sequence[PictureSourcePlan], bind: Address, peer: Address, undrawn: Any, ready: Any, parent: int
) -> None:
    """Run the process: render each exposure when it comes, and send the picture at its arrival time."""
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # Ctrl-C reaches all processes; the parent decides when to end
    start_warp()
    try:
        sink, cameras = UdpSender(bind, peer), [plan.camera() for plan in plans]
        for plan, camera in zip(plans, cameras, strict=True):
            if isinstance(plan, CameraPlan):
                camera.develop(_first(plan))  # renders the background, and compiles the renderer if necessary
    except ValueError as problem:
        ready.send(str(problem))
        return
    ready.send("")
    drawn: list[tuple[float, int, Picture]] = []
    try:
        for order in count():
            rest = drawn[0][0] - realtime.now() if drawn else ORPHANED
            try:
                item = undrawn.get(timeout=min(max(rest, 0.0), ORPHANED))
            except queue.Empty:
                if not parent_runs(parent):
                    return
            else:
                if item is None:
                    return
                i, exposure, arrival = item
                picture = replace(cameras[i].develop(exposure), time=arrival)
                heapq.heappush(drawn, (arrival, order, picture))
            while drawn and drawn[0][0] <= realtime.now():
                sink.send(heapq.heappop(drawn)[2], realtime.now())
    finally:
        sink.close()


def _first(plan: CameraPlan) -> Exposure:
    """Return an exposure of a vehicle in the middle of the pool."""
    pose = np.array([0.0, 0.0, -0.5 * plan.basin.depth]), np.array([0.0, 0.0, 0.0, 1.0])
    return Exposure(0, 0.0, 0.0, pose, pose)


class Cameras:
    """Several cameras with the interface of one."""

    def __init__(self, *cameras: Any) -> None:
        self._cameras = cameras

    def advance(self, t0: float, t1: float, pose_at: PoseAt) -> list[Picture]:
        """Return the pictures of all cameras, in the order of the cameras."""
        return [picture for camera in self._cameras for picture in camera.advance(t0, t1, pose_at)]
