"""A bridge with healthy surroundings, each of which a test can disturb."""

import numpy as np

from finssim.robot.bridge import Bridge, BridgeSettings
from finssim.robot.messages import CommandEcho, Telemetry
from finssim.robot.reading import Reading

DT = 1.0 / 60.0
LEVEL = (0.0, 0.0, 0.0, 1.0)


def telemetry(count, outputs=8, **changes):
    """Return message number `count` of a healthy motor controller, with slight noise on every sensor."""
    values = {
        "sequence": count % 65536,
        "mcu_ms": 10 * count,
        "quaternion": LEVEL,
        "gyro": (1e-3 * np.sin(count), 0.0, 0.0),
        "accel": (0.0, 0.0, 9.81 + 1e-3 * np.cos(count)),
        "depth": 0.5,
        "pressure": 106e3,
        "flags": 0,
        "motor_rpm": (0.0,) * outputs,
    }
    return Telemetry(**{**values, **changes})


def reading(now, position=(0.0, 0.0, -0.5), quaternion=LEVEL, ready=True, **changes):
    """Return the reading of a healthy estimator."""
    return Reading(now, np.array(position), np.array(quaternion), np.zeros(6), ready, **changes)


def echo(count, accepted=True, mcu_ms=None, flags=0):
    """Return the motor controller's echo of command number `count`."""
    ms = 10 * count if mcu_ms is None else mcu_ms
    zeros = (0.0,) * 8
    return CommandEcho(count % 65536, ms, count, ms, 0, accepted, accepted, flags, zeros, zeros, 1, 1)


class Rig:
    """A loop at 60 Hz around a bridge; inputs that are None are not sent."""

    def __init__(self, vehicle, **changes):
        self.bridge = Bridge(vehicle, BridgeSettings.of(vehicle, **changes))
        self.n, self.values = len(vehicle.thrusters), (0.0,) * len(vehicle.actuators)
        self.now, self.count = 100.0, 5000
        self.frame = None

    def step(self, command=None, *, telemetry_=telemetry, reading_=reading, source="pid"):
        """Make one turn of the loop and return the frame that is sent."""
        self.now, self.count = self.now + DT, self.count + 1
        if telemetry_ is telemetry:
            message = telemetry(self.count, self.bridge.motors.outputs, actuators=self.values)
            self.bridge.telemetry(self.now, message)
        elif telemetry_ is not None:
            self.bridge.telemetry(self.now, telemetry_(self.count, self.bridge.motors.outputs))
        if reading_ is not None:
            self.bridge.reading(self.now, reading_(self.now))
        if command is not None:
            self.bridge.command(self.now, np.broadcast_to(command, self.n), source)
        self.frame = self.bridge.tick(self.now)
        return self.frame

    def run(self, seconds, command=None, **spoiled):
        """Make turns of the loop and return the frames."""
        return [self.step(command, **spoiled) for _ in range(round(seconds / DT))]

    def armed(self, command=2.0):
        """Return the rig itself, armed and in motion."""
        self.run(0.2)
        assert self.bridge.arm(self.now, "operator") == ""
        self.run(0.5, command)
        assert self.bridge.state == "armed" and moves(self.frame)
        return self


def moves(frame):
    """Return whether a frame could turn a motor."""
    return frame.enable and any(frame.normalised)


def quiet(frame):
    """Return whether a frame is disabled and all its commands are zero."""
    return not frame.enable and not any(frame.normalised)
