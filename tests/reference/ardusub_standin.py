"""Stand-in for ArduSub's SITL: `python ardusub_standin.py PORT --model JSON:HOST --sim-port-out N ...`.

It speaks SITL's JSON interface at the real rate of 400 frames a second, lets the emulated autopilot fly by the
answers, and serves MAVLink at TCP PORT and PORT + 2, as SITL does at 5760 and 5762. Its restart is like the real one:
frames count from 0 again, from another port.
"""

import json
import math
import socket
import struct
import sys
from types import SimpleNamespace

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from finssim.core import realtime
from finssim.core.frames import FROM_FOSSEN
from finssim.pool import draw_plant
from finssim.pool.ardusub import ArduSub
from finssim.pool.firmware import FirmwareSample
from finssim.pool.virtual_pool import Faults
from finssim.robot.links.transports import TcpServer
from finssim.robot.messages import HEADING, VELOCITY, NavigationAid
from finssim.vehicles import load_vehicle
from finssim.vehicles.defaults import vehicle_at, with_navigation

RATE = 400
SEA = 1024.0 * 9.80665
"""Pressure by depth, always that of sea water [Pa/m]."""


class StandIn:
    """A succession of SITL processes on one physics."""

    def __init__(self, port, physics, parameters):
        vehicle = with_navigation(vehicle_at("tank", load_vehicle("bluerov2_heavy")))
        spec = draw_plant(vehicle, 0, "nominal")
        quick = spec.firmware.model_copy(update={"log_shared": False, "aiding_delay": 2.0, "clock_start": 0})
        self.firmware = ArduSub(vehicle, spec.model_copy(update={"firmware": quick}))
        for line in parameters:
            name, value = line.split()
            if name in self.firmware.parameters:
                self.firmware._store(name, float(value))
        self.servers = [TcpServer(("127.0.0.1", port + more), bytearray) for more in (0, 2)]
        self.physics, self.mav = physics, mavlink.MAVLink(None)
        self.mav.robust_parsing = True
        self.aids, self.now, self.deltas = [], 0.0, 0
        self.start()

    def start(self):
        """Start as a new process does: frames from 0, from its own port."""
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.settimeout(0.1)
        self.frame, self.stamp = 0, 0.0

    def exchange(self):
        """Send one frame, again after a second without an answer, and return the answer without surrounding
        newlines."""
        pulses = [*self.firmware.pulses.astype(int).tolist(), *[1500] * (16 - len(self.firmware.pulses))]
        packet = struct.pack("<HHI16H", 18458, RATE, self.frame, *pulses)
        while True:
            self.socket.sendto(packet, self.physics)
            for _ in range(10):
                try:
                    answer = json.loads(self.socket.recv(65536))
                except TimeoutError:
                    continue
                self.frame += 1
                return answer

    def step(self):
        """Exchange one frame and step the autopilot with it."""
        state = self.exchange()
        self.now += max(state["timestamp"] - self.stamp, 0.0)
        self.stamp = state["timestamp"]
        for server in self.servers:
            for client, _, data in server.receive():
                for message in self.mav.parse_buffer(data) or ():
                    if message.get_type() == "VISION_POSITION_DELTA":
                        self.deltas += 1
                        v = FROM_FOSSEN.vector(message.position_delta) / (1e-6 * message.time_delta_usec)
                        self.aids.append(NavigationAid(0, VELOCITY, 0.06, tuple(v), (0.0, 0.0)))
                for frame in self.firmware.receive(self.now, data):
                    server.send(frame, client)
        self.firmware.watch(self.now)
        if self.frame % 4 == 0:
            self.sense(state)

    def sense(self, state):
        """Pass the instruments to the autopilot, and send its messages."""
        gyro, accel = (FROM_FOSSEN.vector(state["imu"][name]) for name in ("gyro", "accel_body"))
        depth = state["position"][2]
        sample = FirmwareSample(tuple(gyro), tuple(accel), depth, 101325.0 + SEA * depth)
        heading = NavigationAid(0, HEADING, 0.0, (-state["attitude"][2], 0.0, 0.0), (0.0, 0.0))
        aids, self.aids = [heading, *self.aids], []
        plant = SimpleNamespace(electric=(state["battery"]["voltage"], state["battery"]["current"]))
        for frame in self.firmware.frames(self.now, sample, aids, plant, Faults()):
            for server in self.servers:
                for client in list(server.clients):
                    server.send(frame, client)


def main():
    port, words = int(sys.argv[1]), dict(zip(sys.argv[2::2], sys.argv[3::2], strict=True))
    host = words["--model"].removeprefix("JSON:")
    assert float(words["--home"].split(",")[2]) == 0.0 and math.isfinite(float(words["--speedup"]))
    lines = [line for line in open(words["--defaults"]).read().splitlines() if not line.startswith("#")]
    sitl = StandIn(port, (host, int(words["--sim-port-out"])), lines)
    began = realtime.now()
    while True:
        sitl.step()
        realtime.wait(sitl.now - (realtime.now() - began))


if __name__ == "__main__":
    np.seterr(all="raise")
    main()
