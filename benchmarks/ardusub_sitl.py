"""Speed of the physics server for ArduSub's SITL with a client without physics: `python benchmarks/ardusub_sitl.py`.

Lock-step: frames as fast as both processes allow. Real time: 400 frames per second, and the processor time that the
server needs. The server is a separate process; its time is counted from its first frame.
"""

import argparse
import multiprocessing
import socket
import struct
import time

from finssim.control.guidance import Station
from finssim.pool.ardusub_sitl import SitlServer, SitlWorld
from finssim.robot.links.water_linked import DvlServer
from finssim.sim import RectangularPool
from finssim.vehicles import load_vehicle

RATE = 400
PULSES = (1400, 1400, 1600, 1600, 1550, 1550, 1550, 1550, *[1500] * 8)


def serve(wire, dvl: bool, duration: float) -> None:
    """Run in the server's process: send the address, serve, then send the processor time and the number of
    frames."""
    log = DvlServer(("127.0.0.1", 0)) if dvl else None
    tank = RectangularPool(length=2000.0, width=2000.0, depth=20.0)
    world = SitlWorld(
        load_vehicle("bluerov2_heavy"), pool=tank, start=Station((0.0, 0.0, -10.0), 0.0), dvl=log
    )
    server = SitlServer(world, ("127.0.0.1", 0))
    wire.send(server.address)
    before = time.process_time()
    server.serve(duration)
    wire.send((time.process_time() - before, dict(server.counts)))


def measure(duration: float, *, paced: bool, dvl: bool) -> tuple[float, float, dict[str, int]]:
    """Measure wall time and the server's processor time for a simulated duration [s], and return its
    counters."""
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.Process(target=serve, args=(theirs, dvl, duration))
    process.start()
    address = ours.recv()
    client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client.settimeout(5.0)
    began = time.perf_counter()
    for frame in range(round(duration * RATE)):
        if paced:
            time.sleep(max(0.0, began + frame / RATE - time.perf_counter()))
        client.sendto(struct.pack("<HHI16H", 18458, RATE, frame, *PULSES), address)
        client.recv(65536)
    wall = time.perf_counter() - began
    spent, counts = ours.recv()
    process.join()
    return wall, spent, counts


def main() -> None:
    """Print both figures, each with and without a Doppler log."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--duration", type=float, default=20.0, help="simulated seconds of each run")
    duration = parser.parse_args().duration
    for dvl in (False, True):
        beside = "with DVL" if dvl else "alone"
        wall, spent, counts = measure(duration, paced=False, dvl=dvl)
        each = 1e6 * spent / duration / RATE
        print(f"lock-step, {beside}: {duration / wall:.1f} x real time, server {each:.0f} us/frame")
        wall, spent, counts = measure(duration, paced=True, dvl=dvl)
        idle = 100.0 * (1.0 - spent / wall)
        print(f"real time, {beside}: {duration / wall:.3f} x, server idle {idle:.0f} %, {counts}")


if __name__ == "__main__":
    main()
