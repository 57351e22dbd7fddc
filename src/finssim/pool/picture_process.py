"""Drawing pictures in a process of its own, so that telemetry never waits for one."""

from __future__ import annotations

import multiprocessing
import os
import queue
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from finssim.localization.pool import Pool
from finssim.pool.camera import PoolCamera
from finssim.pool.exposures import Exposure, PoseAt, Shutter
from finssim.pool.picture_wire import PictureSink, SharedMemorySender, UdpSender
from finssim.pool.plant_spec import Basin
from finssim.pool.site import CameraSettings
from finssim.quiet import start_warp
from finssim.robot.link.frames import LinkError
from finssim.robot.messages import Picture
from finssim.vehicles import Vehicle

__all__ = ["CameraPlan", "PictureProcess", "PictureWire"]

UNDRAWN = 4
"""Exposures that wait to be drawn; more are dropped, as a camera does whose computer is too slow."""
STARTING = 120.0
"""Time for the process to start and to compile the renderer, the first time on a machine [s]."""
ORPHANED = 1.0
"""Between looks whether the parent is still there [s]."""


@dataclass(frozen=True, kw_only=True)
class CameraPlan:
    """All that `PoolCamera` is made of, so that another process can make it."""

    vehicle: Vehicle
    site: Pool
    settings: CameraSettings
    basin: Basin
    mode: Literal["pictures", "corners"]
    seed: int

    def camera(self) -> PoolCamera:
        """Make it."""
        return PoolCamera(
            self.vehicle, self.site, mode=self.mode, settings=self.settings, basin=self.basin, seed=self.seed
        )

    def shutter(self) -> Shutter:
        """Its shutter alone."""
        return Shutter(
            rate=self.settings.rate,
            exposure=self.settings.exposure,
            latency=self.settings.latency,
            jitter=self.settings.jitter,
            dropout=self.settings.dropout,
            seed=self.seed,
        )


@dataclass(frozen=True)
class PictureWire:
    """Where pictures go."""

    bind: tuple[str, int]
    peer: tuple[str, int]
    memory: str = ""
    """Name of shared memory; empty: over UDP."""

    def open(self) -> PictureSink:
        """Begin to send.

        Raises:
            LinkError: The address or the memory cannot be had.
        """
        return SharedMemorySender(self.memory) if self.memory else UdpSender(self.bind, self.peer)


class PictureProcess:
    """The camera of a `VirtualPool` in real time: exposes here, draws and sends elsewhere; `advance` gives nothing."""

    def __init__(self, plan: CameraPlan, wire: PictureWire) -> None:
        """Start the process and wait until it can draw.

        Raises:
            LinkError: The wire cannot be opened, or the process did not start.
        """
        self.dropped = 0
        self.start = 0.0
        """When the pool's clock was 0, on `time.monotonic` [s]."""
        self._shutter = plan.shutter()
        context = multiprocessing.get_context("spawn")
        self._undrawn: Any = context.Queue(UNDRAWN)
        ready, theirs = context.Pipe(duplex=False)
        self._process = context.Process(
            target=_draw,
            args=(plan, wire, self._undrawn, theirs, os.getpid()),
            name="pool camera",
            daemon=True,
        )
        with _deaf():
            self._process.start()
        theirs.close()
        self._await(ready)

    def advance(self, t0: float, t1: float, pose_at: PoseAt) -> Sequence[Picture]:
        """Expose; pictures go their own way."""
        for exposure in self._shutter.advance(t0, t1, pose_at):
            try:
                self._undrawn.put_nowait((exposure, self.start + exposure.arrival))
            except queue.Full:
                self.dropped += 1
        return ()

    @property
    def complaint(self) -> str:
        """Why pictures are missing, and what helps."""
        if self._process.exitcode is not None:
            return f"the process that draws ended (status {self._process.exitcode}): start the pool again"
        return f"{self.dropped} pictures could not be drawn in time: --camera corners needs no drawing"

    def close(self) -> None:
        """End the process and let go of the wire."""
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
    """A process started meanwhile ignores Ctrl-C, which goes to all of a terminal, from its first moment on."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _draw(plan: CameraPlan, wire: PictureWire, undrawn: Any, ready: Any, parent: int) -> None:
    """The process: draw each exposure, wait until it is to arrive, send it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to all; the parent says when to end
    start_warp()
    try:
        sink, camera = wire.open(), plan.camera()
        camera.develop(_first(plan))  # draws the background, and compiles the renderer where it is not
    except ValueError as problem:
        ready.send(str(problem))
        return
    ready.send("")
    try:
        while True:
            try:
                item = undrawn.get(timeout=ORPHANED)
            except queue.Empty:
                if os.getppid() != parent:
                    return
                continue
            if item is None:
                return
            _send(camera, sink, *item)
    finally:
        sink.close()


def _first(plan: CameraPlan) -> Exposure:
    """A vehicle in the middle of the pool."""
    pose = np.array([0.0, 0.0, -0.5 * plan.basin.depth]), np.array([0.0, 0.0, 0.0, 1.0])
    return Exposure(0, 0.0, 0.0, pose, pose)


def _send(camera: PoolCamera, sink: PictureSink, exposure: Exposure, arrival: float) -> None:
    picture = replace(camera.develop(exposure), time=arrival)
    time.sleep(max(arrival - time.monotonic(), 0.0))
    sink.send(picture, time.monotonic())
