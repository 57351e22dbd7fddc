"""A virtual pool in lock-step behind a port, like `finssim pool --lockstep`, and a simulated operator."""

import math
import threading
from contextlib import contextmanager
from dataclasses import replace

from finssim.core.quiet import start_warp
from finssim.core.rotations import quat_from_yaw
from finssim.localization.overhead_camera import write_pool
from finssim.pool.camera import PoolCamera, camera_of
from finssim.pool.drawn_plant import draw_plant, positioning_of, site_of
from finssim.pool.servers import LockstepServer
from finssim.pool.virtual_pool import VirtualPool
from finssim.robot.wiring import Wiring
from finssim.vehicles.defaults import vehicle_at


class Silent(VirtualPool):
    """Pool whose motor controller is silent from a time on [s]."""

    silent_from = math.inf

    def exchange(self, until, sent):
        delivery = super().exchange(until, sent)
        return replace(delivery, frames=()) if delivery.time >= self.silent_from else delivery


@contextmanager
def lockstep_pool(
    vehicle,
    pool_file,
    *,
    position=(0.0, 0.0, -0.5),
    yaw=0.0,
    plant=1,
    severity="nominal",
    truth=None,
    silent_from=math.inf,
    sessions=1,
    site="pool",
    positioning="none",
):
    """Write the pool file, and yield the wiring to a pool that lives as long as the block.

    Without a pool file there is no camera. A pool ends when its robot leaves: with several `sessions` another one then
    begins on the same port.
    """
    start_warp()
    vehicle, spec = vehicle_at(site, vehicle), site_of(site, draw_plant(vehicle, plant, severity))
    if pool_file is not None:
        true_site, known_site, settings = camera_of(vehicle, plant, severity, basin=spec.basin)
        write_pool(known_site, pool_file)

    def world():
        seen = pool_file is not None
        made = Silent(
            vehicle,
            spec,
            camera=PoolCamera(vehicle, true_site, mode="corners", settings=settings, seed=1)
            if seen
            else None,
            positioning=positioning_of(positioning, 1),
            start=(position, quat_from_yaw(yaw)),
            seed=1,
            truth=truth,
        )
        made.silent_from = silent_from
        return made

    first = LockstepServer(("127.0.0.1", 0))
    pools = [world()]  # made here: while one thread captures launches, another may not copy arrays

    def serve():
        server = first
        for number in range(sessions):
            pool = pools.pop() if pools else world()
            server.serve(pool)
            pool.close()
            if number + 1 < sessions:
                server = LockstepServer(first.address)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        yield Wiring(robot="{}:{}".format(*first.address), lockstep=True)
    finally:
        thread.join(20.0)
        first.close()


class Person:
    """Operator who presses keys, each at the first line with its text, and after the last one enter at each
    request."""

    def __init__(self, *presses, then="\r"):
        self._presses, self._then, self.read, self._key = list(presses), then, [], ""

    def line(self, text):
        if not self.read or self.read[-1] != text:
            self.read.append(text)
        if self._presses and self._presses[0][0] in text:
            self._key = self._presses.pop(0)[1]
        elif not self._presses and text.startswith("enter:"):
            self._key = self._then

    def keys(self):
        key, self._key = self._key, ""
        return [key] if key else []
