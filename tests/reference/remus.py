"""The REMUS 100 of PythonVehicleSimulator with fins, propeller and autopilots, in float64, x forward, y right, z down.

Written from the equations (Fossen 2021; commit c717e07 of cybergalactic/PythonVehicleSimulator), without its code.
"""

import math
from dataclasses import dataclass

import numpy as np

from reference.fossen import F, Torpedo

STEP = 0.02
"""Time step of its explicit integration [s]."""
FASTEST, LARGEST = 1525.0, math.radians(15.0)
"""Limits of the propeller [rpm] and of the fins [rad]."""
AREA, SLOPES = 2 * 0.00665, (0.5, 0.7)
"""Area of both fins of a pair [m²], and lift coefficients of rudder and stern plane [1/rad]."""


def wrapped(angle):
    return (angle + math.pi) % (2 * math.pi) - math.pi


class Remus(Torpedo):
    """Hull of the base; actuators are rudder [rad], stern plane [rad] and shaft [rpm], which lag behind commands.

    Args:
        shaft_lag: Time constant of the propeller [s]: 1 of `remus100`, 0.1 of `torpedo`.
        fin_drag: Whether a deflected fin has drag, as in `remus100` but not in `torpedo`.
    """

    def __init__(self, shaft_lag=1.0, fin_drag=True):
        super().__init__()
        self.lags, self.fin_drag = np.array([0.1, 0.1, shaft_lag]), fin_drag
        self.M = self.M_RB + self.M_A

    def propulsion(self, U):
        """Return thrust less its deduction, and a tenth of the torque, by K_T and K_Q that are linear in J."""
        n, D = self.rpm / 60, 0.14
        out = np.zeros(6)
        for i, power, at_rest, at_top, share in ((0, 4, 0.4566, 0.1798, 0.9), (3, 5, 0.0700, 0.0312, 0.1)):
            fall = (at_top - at_rest) / 0.6632 * 0.944 * U / D if n > 0 else 0.0
            out[i] = share * self.rho * D**power * abs(n) * (at_rest * n + fall)
        return out

    def fins(self, nu, rudder, plane):
        """Return lift by the deflection alone, at the stern, in the plane in which a pair of fins is turned."""
        out = np.zeros(6)
        for i, j, angle, slope, sign in ((1, 5, rudder, SLOPES[0], 1), (2, 4, plane, SLOPES[1], -1)):
            q = 0.5 * self.rho * AREA * slope * (nu[0] ** 2 + nu[i] ** 2)
            out[i] = -q * angle
            out[j] = -sign * self.L / 2 * out[i]
            out[0] -= q * angle**2 * self.fin_drag
        return out

    def acceleration(self, eta, nu, actuators):
        """Return d nu/dt from pose (6,), velocity (6,) and actuators (3,)."""
        rudder, plane = np.clip(actuators[:2], -LARGEST, LARGEST)
        self.rpm = float(np.clip(actuators[2], -FASTEST, FASTEST))
        roll, pitch = eta[3:5]
        turn = np.zeros((1, 3, 3))  # `rate` reads from it the world's z axis, upwards, in axes with z up
        turn[0, 2] = math.sin(pitch), math.cos(pitch) * math.sin(roll), math.cos(pitch) * math.cos(roll)
        return self.rate(turn, (nu * F)[None], (self.fins(nu, rudder, plane) * F)[None])[0] * F


@dataclass
class Autopilot:
    """Depth by pitch with cascaded PID, heading by a sliding mode with reference model and integral.

    Attributes:
        depth: Target depth [m].
        heading: Target heading, positive to the right [rad].
    """

    depth: float = 0.0
    heading: float = 0.0

    def __post_init__(self):
        self.smooth = self.sum_depth = self.sum_pitch = 0.0
        self.angle = self.rate = self.growth = self.sum_heading = 0.0

    def command(self, depth, pitch, heading, w, q, r, h):
        """Return rudder and stern plane [rad] from the state, z down, every h seconds."""
        keep = math.exp(-0.02 * h)
        self.smooth = keep * self.smooth + (1 - keep) * self.depth
        low = depth - self.smooth
        wrong = wrapped(pitch - 0.1 * (low + self.sum_depth / 100.0))
        plane = 5.0 * wrong + 2.0 * q + 0.3 * self.sum_pitch + 5.0 * w
        self.sum_depth += h * low
        self.sum_pitch += h * wrong

        off, turning, slope, gain = wrapped(heading - self.angle), r - self.rate, 0.1, 0.25
        surface = turning + 2 * slope * off + slope**2 * self.sum_heading
        wanted = self.rate - 2 * slope * off - slope**2 * self.sum_heading
        change = self.growth - 2 * slope * turning - slope**2 * off
        rudder = (1.0 * change + wanted - 0.5 * surface - 0.05 * float(np.clip(surface / 0.1, -1, 1))) / gain
        self.sum_heading += h * off
        jerk = 0.1**3 * (self.heading - self.angle) - 3 * 0.1**2 * self.rate - 3 * 0.1 * self.growth
        self.angle += h * self.rate
        self.rate = float(np.clip(self.rate + h * self.growth, -math.radians(5.0), math.radians(5.0)))
        self.growth += h * jerk
        return rudder, plane


def run(vehicle, duration, command):
    """Return motion from rest at the surface by explicit steps: times (n,), poses (n, 6), velocities (n, 6).

    Args:
        vehicle: A `Remus`.
        duration: Duration of the motion [s].
        command: Function of pose (6,) and velocity (6,) that returns rudder, stern plane [rad] and shaft [rpm].
    """
    eta, nu, actuators, rows = np.zeros(6), np.zeros(6), np.zeros(3), []
    for _ in range(round(duration / STEP) + 1):
        wanted = np.array(command(eta, nu), float)
        rows.append((eta.copy(), nu.copy()))
        nu = nu + STEP * vehicle.acceleration(eta, nu, actuators)
        actuators = actuators + STEP * (wanted - actuators) / vehicle.lags
        (sr, sp, sy), (cr, cp, cy) = np.sin(eta[3:]), np.cos(eta[3:])
        R = np.array([[cy * cp, cy * sp * sr - sy * cr, sy * sr + cy * cr * sp],
                      [sy * cp, cy * cr + sr * sp * sy, sp * sy * cr - cy * sr], [-sp, cp * sr, cp * cr]])  # fmt: skip
        T = np.array([[1, sr * sp / cp, cr * sp / cp], [0, cr, -sr], [0, sr / cp, cr / cp]])
        eta = eta + STEP * np.concatenate([R @ nu[:3], T @ nu[3:]])
    return STEP * np.arange(len(rows)), np.array([r[0] for r in rows]), np.array([r[1] for r in rows])


def step_response(times, values, target, band=0.02):
    """Return overshoot [share of the step] and settling time of a step from 0 into a band of its target [s]."""
    away = np.flatnonzero(np.abs(values / target - 1.0) > band)
    return max(float(np.max(values / target)) - 1.0, 0.0), float(times[away[-1] + 1])
