"""Linearised model of a vehicle about level motion at constant speed, and its open-loop stability."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finssim.control.course import LinearModel, course_speeds, top_speed
from finssim.sim.model import acceleration
from finssim.sim.plant_arrays import SimulatorError
from finssim.vehicles import Vehicle
from finssim.vehicles.capability import coefficients_of

__all__ = ["MOTIONS", "FreeMotion", "linear_model", "stability"]

Array = NDArray[np.float64]

MOTIONS = {"surge": (0,), "course": (1, 5), "roll": (3, 6), "pitch": (2, 4, 7)}
"""Motion -> its states: surge; sway and yaw rate; roll rate and angle; heave, pitch rate and angle."""
STEP, DEPTH = 1e-3, -100.0
"""Step of the finite differences [m/s, rad/s, rad], and depth [m]."""
SLOW = 5e-3
"""Rate below which a mode counts as neutral [1/s]; finite differences over a step of v|v| are smaller."""


class FreeMotion(NamedTuple):
    """One open-loop mode: the eigenvalue with the greatest real part at rest and at top speed [1/s]."""

    at_rest: complex
    at_top_speed: complex
    unstable_above: float | None
    """Lowest speed at which the mode is unstable [m/s]; None if it is stable up to top speed."""

    @staticmethod
    def words(rate: complex) -> str:
        """Return a description of the mode of an eigenvalue [1/s]."""
        swing = f", period {2.0 * math.pi / abs(rate.imag):.3g} s" if abs(rate.imag) > SLOW else ""
        if abs(rate.real) <= SLOW:
            return f"neutral{swing}"
        change = "dies out" if rate.real < 0.0 else "grows e-fold"
        return f"{change} in {1.0 / abs(rate.real):.3g} s{swing}"


def linear_model(
    vehicle: Vehicle, speeds: ArrayLike | None = None, hydrodynamics: str | None = None
) -> LinearModel:
    """Return the model of a vehicle linearised about level motion over a range of speeds, by central differences.

    The trim uses the least thrusts that hold each speed, with every other actuator at 0; the remaining loads in level
    motion are left to the integrators of a controller. A fin's range ends at its stall angle, beyond which lift drops.

    Args:
        vehicle: The vehicle.
        speeds: Surge speeds in equal steps [m/s], (n,); those of `course_speeds` if None.
        hydrodynamics: Hydrodynamic model; the one with coefficients if None.

    Raises:
        SimulatorError: No thruster drives the vehicle forward.
    """
    model = hydrodynamics or coefficients_of(vehicle)
    stall = [getattr(part, "stall", math.inf) for part in vehicle.actuators.values()]
    most = np.array([math.inf] * len(vehicle.thrusters) + stall)
    lower, upper = (np.clip(limit, -most, most) for limit in vehicle.channel_limits)
    surge = course_speeds(vehicle) if speeds is None else np.asarray(speeds, float)
    eta, nu = np.zeros((len(surge), 6)), np.zeros((len(surge), 6))
    eta[:, 2], nu[:, 0] = DEPTH, surge
    trim = _trim(vehicle, eta, nu, model)
    A = _system_matrices(vehicle, surge, model, trim)
    B = np.zeros((len(surge), 8, trim.shape[1]))
    for k in range(trim.shape[1]):
        step = 1e-2 * (upper[k] - lower[k])
        ends = []
        for sign in (1.0, -1.0):
            moved = trim.copy()
            moved[:, k] += sign * step
            ends.append(acceleration(vehicle, eta, nu, hydrodynamics=model, actuators=moved))
        B[:, :6, k] = (ends[0] - ends[1]) / (2.0 * step)
    lag = [part.time_constant for part in (*vehicle.thrusters.values(), *vehicle.actuators.values())]
    inertia = vehicle.mass_matrix(model)
    rest = acceleration(vehicle, eta, nu, hydrodynamics=model, actuators=trim)
    return LinearModel(surge, A, B, trim, rest, inertia, lower, upper, np.asarray(lag, float))


def _trim(vehicle: Vehicle, eta: Array, nu: Array, model: str) -> Array:
    """Return the channel values that hold each surge speed: the least thrusts, by the secant method, (n,
    channels)."""
    thrusters = len(vehicle.thrusters)
    ahead = np.asarray(vehicle.thruster_matrix())[0]
    if not (ahead @ ahead > 0.0):
        raise SimulatorError(f"{vehicle.name}: no thruster drives it ahead, so it holds no speed")
    mass = vehicle.mass_matrix(model)

    def surplus(force: Array) -> tuple[Array, Array]:
        channels = np.zeros((len(force), len(vehicle.channel_names)))
        channels[:, :thrusters] = force[:, None] * ahead / (ahead @ ahead)
        nu_dot = acceleration(vehicle, eta, nu, hydrodynamics=model, actuators=channels)
        return (nu_dot @ mass.T)[:, 0], channels

    before = np.zeros(len(nu))
    left, _ = surplus(before)
    force = -left
    for _ in range(8):
        now, channels = surplus(force)
        change = now - left
        step = np.where(
            np.abs(change) > 1e-9, -now * (force - before) / np.where(change == 0.0, 1.0, change), 0.0
        )
        before, left, force = force, now, force + step
    return surplus(force)[1]


def _system_matrices(
    vehicle: Vehicle, speeds: Array, hydrodynamics: str, channels: Array | None = None
) -> Array:
    """Return A of x_dot = A x about level motion, for the state (nu, roll, pitch), in SI units, (n, 8, 8).

    The wrench that holds the motion, besides that of the channels, is kept constant.

    Args:
        vehicle: The vehicle.
        speeds: Surge speeds [m/s], (n,).
        hydrodynamics: Hydrodynamic model.
        channels: Steady actuator values, (n, channels); all 0 if None.
    """
    eta, nu = np.zeros((len(speeds), 6)), np.zeros((len(speeds), 6))
    eta[:, 2], nu[:, 0] = DEPTH, speeds

    def rates(place: Array, velocity: Array, hold: Array | float = 0.0) -> Array:
        wrench = np.broadcast_to(hold, velocity.shape)
        return acceleration(vehicle, place, velocity, wrench, hydrodynamics=hydrodynamics, actuators=channels)

    hold = -rates(eta, nu) @ vehicle.mass_matrix(hydrodynamics).T
    A = np.zeros((len(speeds), 8, 8))
    for k in range(8):
        state = np.concatenate([nu, eta[:, 3:5]], axis=1)
        ends = []
        for sign in (1.0, -1.0):
            moved = state.copy()
            moved[:, k] += sign * STEP
            place = np.concatenate([eta[:, :3], moved[:, 6:], eta[:, 5:]], axis=1)
            ends.append(rates(place, moved[:, :6], hold))
        A[:, :6, k] = (ends[0] - ends[1]) / (2.0 * STEP)
    A[:, 6, 3] = A[:, 7, 4] = 1.0
    return A


def stability(vehicle: Vehicle, hydrodynamics: str = "calibrated") -> tuple[float, dict[str, FreeMotion]]:
    """Return the top speed [m/s] and the open-loop stability of each motion of `MOTIONS` up to that speed.

    An eigenvalue is assigned to the motion whose states have the largest participation factor.

    Args:
        vehicle: The vehicle.
        hydrodynamics: Hydrodynamic model.
    """
    top = top_speed(vehicle, hydrodynamics)
    speeds = np.linspace(0.0, top, 101)
    values, vectors = np.linalg.eig(_system_matrices(vehicle, speeds, hydrodynamics))
    # Participation factors of states in modes [-].
    part = np.abs(vectors * np.swapaxes(np.linalg.pinv(vectors), 1, 2))
    share = np.stack([part[:, states].sum(axis=1) for states in MOTIONS.values()])
    motions = {}
    for k, name in enumerate(MOTIONS):
        own = np.where(share.argmax(axis=0) == k, values.real, -math.inf)
        first = np.take_along_axis(values, own.argmax(axis=1)[:, None], axis=1)[:, 0]
        growing = np.flatnonzero((first.real > SLOW) & np.isfinite(own.max(axis=1)))
        above = float(speeds[growing[0]]) if len(growing) else None
        motions[name] = FreeMotion(complex(first[0]), complex(first[-1]), above)
    return top, motions
