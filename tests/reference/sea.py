"""One vehicle in open water, as seen through its motor controller's wire."""

import time

from finssim.pool.drawn_plant import draw_plant, positioning_of, site_of
from finssim.pool.virtual_pool import VirtualPool
from finssim.robot.links.transports import UdpTransport
from finssim.vehicles import load_vehicle
from finssim.vehicles.defaults import vehicle_at

FINSROV = vehicle_at("open-water", load_vehicle("finsrov"))


class Sea:
    """FinsROV in open water, in real time on a UDP wire, with fixes of motion capture."""

    def __init__(self, place, robot=("127.0.0.1", 9), seed=1):
        """Connect to a robot at an address, which `know` may change later."""
        plant = site_of("open-water", draw_plant(FINSROV, 0, "nominal"))
        self.world = VirtualPool(
            FINSROV,
            plant,
            positioning=positioning_of("motion-capture", seed),
            start=(place, (0.0, 0.0, 0.0, 1.0)),
        )
        self.end = UdpTransport(("127.0.0.1", 0), robot)
        self.began, self.now = time.monotonic(), 0.0

    def know(self, robot):
        """Talk to a robot at another address."""
        self.end.close()
        self.end = UdpTransport(self.end.address, robot)

    def turn(self, now=None):
        """Advance the world to the present, or to a time since its start [s]."""
        self.now = max(time.monotonic() - self.began, self.now) if now is None else now
        for _, frame in self.world.exchange(self.now, self.end.receive()).frames:
            self.end.send(frame)

    def close(self):
        self.world.close()
        self.end.close()
