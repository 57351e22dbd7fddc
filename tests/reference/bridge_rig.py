"""A bridge with healthy surroundings, each of which a test can spoil."""

import numpy as np

from finssim.robot.bridge import Bridge, BridgeSettings
from finssim.robot.messages import CommandEcho, Telemetry
from finssim.robot.reading import Reading

DT = 1.0 / 60.0
LEVEL = (0.0, 0.0, 0.0, 1.0)


def telemetry(count, outputs=8, **changes):
    """What a healthy motor controller sends as its message of that number: every sensor is a little noisy."""
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
    """What a healthy estimator says."""
    return Reading(now, np.array(position), np.array(quaternion), np.zeros(6), ready, **changes)


def echo(count, accepted=True, mcu_ms=None, flags=0):
    """What the motor controller made of its command of that number."""
    ms = 10 * count if mcu_ms is None else mcu_ms
    zeros = (0.0,) * 8
    return CommandEcho(count % 65536, ms, count, ms, 0, accepted, accepted, flags, zeros, zeros, 1, 1)


class Rig:
    """A loop at 60 Hz around a bridge; what is None is not sent."""

    def __init__(self, vehicle, **changes):
        self.bridge = Bridge(vehicle, BridgeSettings.of(vehicle, **changes))
        self.n, self.values = len(vehicle.thrusters), (0.0,) * len(vehicle.actuators)
        self.now, self.count = 100.0, 5000
        self.frame = None

    def step(self, command=None, *, telemetry_=telemetry, reading_=reading, source="pid"):
        """One turn of the loop; returns the frame that is sent."""
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
        """Turns of the loop; returns the frames."""
        return [self.step(command, **spoiled) for _ in range(round(seconds / DT))]

    def armed(self, command=2.0):
        """Itself, armed and under way."""
        self.run(0.2)
        assert self.bridge.arm(self.now, "operator") == ""
        self.run(0.5, command)
        assert self.bridge.state == "armed" and moves(self.frame)
        return self


def moves(frame):
    """Whether a frame could turn a motor."""
    return frame.enable and any(frame.normalised)


def quiet(frame):
    """Whether a frame says off in every way."""
    return not frame.enable and not any(frame.normalised)
