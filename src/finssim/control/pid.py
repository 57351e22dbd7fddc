"""The baseline controller: a full-wrench PID whose gains follow from the vehicle's identified model."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from finssim.control.allocator import Allocator
from finssim.control.errors import ControlError
from finssim.control.pole_placement import AxisModel, Gains, axis_model, place_poles
from finssim.control.tracking import Goal, Measured, tracking_error, velocity_at
from finssim.geometry.rotations import cross, quat_inverse_rotate, quat_rotate
from finssim.vehicles import Vehicle

__all__ = ["Pid", "PidMemory"]

Array = npt.NDArray[np.float64]

CRUISE = 0.7
"""Speed at which a far goal is approached, as a part of the terminal speed at the wrench limit."""

LEAST_LAG = 0.15
"""Of a loop of place or heading, however quick the thrusters [s]: what is seen lags by exposure, wire and filter."""

INTEGRAL_SHARE = 0.5
"""Largest integral, as a part of the wrench limit."""


@dataclass(frozen=True)
class PidMemory:
    """What the controller remembers between two commands."""

    force: Array
    """Integral part of the force, WORLD frame [N], (..., 3): a current pushes the same way whatever the heading."""
    moment: Array
    """Integral part of the moment, body frame [N m], (..., 3)."""


@dataclass(frozen=True, kw_only=True)
class Pid:
    """Position and attitude PID with weight and buoyancy fed forward.

        tau = tau_goal + M a_goal + C(nu) nu + D nu_goal + kp clip(e) - kd (nu - nu_goal) + integral

    about the vehicle's wrench reference. tau_goal holds the goal at rest against weight and buoyancy; e is clipped
    where it would ask for more than the cruise speed; the derivative acts on the measured velocity. The integral
    collects the force that the identified model cannot explain, with what the thrusters could not deliver taken out
    of it (back-calculation), and is bounded (clamping): neither a long way nor saturation winds it up.
    """

    model: AxisModel
    """Inertia, damping and stiffness at `reference`."""
    gains: Gains
    """Per axis, zero on axes without authority."""
    error_limit: Array
    """Largest error that is acted on, (6,) [m, rad]."""
    wrench_limits: Array
    """Largest wrench asked for, per axis, body frame [N, N m], (6,)."""
    reference: Array
    """Body point about which the wrench acts [m], (3,)."""
    weight: float
    """[N]"""
    buoyancy: float
    """Fully submerged [N]."""
    center_of_gravity: Array
    """Body frame [m], (3,)."""
    center_of_buoyancy: Array
    """Body frame [m], (3,)."""
    allocator: Allocator = field(repr=False)
    """Tells what the thrusters can deliver."""
    period: float
    """Time between two commands [s]."""

    @classmethod
    def from_vehicle(
        cls,
        vehicle: Vehicle,
        hydrodynamics: str = "calibrated",
        period: float = 0.05,
        speed: npt.ArrayLike = 0.0,
        least_lag: float = LEAST_LAG,
    ) -> Pid:
        """Controller of a vehicle, gains by pole placement.

        Args:
            vehicle: Its thrusters' lag, limits, weight and buoyancy are used too.
            hydrodynamics: Set whose coefficients are the model.
            period: Time between two commands [s].
            speed: Operating speed about which damping is linearised, body frame [m/s, rad/s], (6,).
            least_lag: Of the loops of place and heading [s]; 0 where nothing delays what is seen.

        Raises:
            ControlError: The set has no coefficients, or the period is not positive.
        """
        if not period > 0.0:
            raise ControlError(f"period is {period}, expected a positive time in seconds")
        model = axis_model(vehicle, hydrodynamics)
        thrusters = vehicle.thrusters.values()
        own = float(np.mean([t.time_constant + t.delay for t in thrusters]))
        lag = np.full(6, max(own, least_lag))
        lag[3:5] = own  # roll and pitch come straight from the IMU
        lag += 0.5 * period
        placed = place_poles(model, lag, speed)
        limits = np.asarray(vehicle.wrench_limits, float)
        able = limits > 0.0
        if np.any(able & (model.linear_damping + model.quadratic_damping <= 0.0)):
            raise ControlError(
                f"hydrodynamic set '{hydrodynamics}' of {vehicle.name} has no damping on a driven axis"
            )
        gains = Gains(*(np.where(able, gain, 0.0) for gain in (placed.kp, placed.kd, placed.rate)))

        cruise = CRUISE * _terminal_speed(model.linear_damping, model.quadratic_damping, limits)
        braking = gains.kd - model.inertia * gains.rate + model.damping(cruise)
        reach = np.divide(braking * cruise, gains.kp, out=np.full(6, np.inf), where=gains.kp > 0.0)
        return cls(
            model=model,
            gains=gains,
            error_limit=reach,
            wrench_limits=limits,
            reference=np.asarray(vehicle.wrench_reference, float),
            weight=vehicle.weight,
            buoyancy=vehicle.buoyancy,
            center_of_gravity=np.asarray(vehicle.body.center_of_gravity, float),
            center_of_buoyancy=np.asarray(vehicle.body.center_of_buoyancy, float),
            allocator=Allocator.from_vehicle(vehicle),
            period=period,
        )

    def reset(self, n: int | None = None) -> PidMemory:
        """Memory without any integral, for one vehicle or for a batch of n."""
        shape = (3,) if n is None else (n, 3)
        return PidMemory(np.zeros(shape), np.zeros(shape))

    def command(self, memory: PidMemory, measured: Measured, goal: Goal) -> tuple[Array, PidMemory]:
        """Wanted wrench about `reference`, body frame [N, N m], (..., 6), and the memory for the next command."""
        q = np.asarray(measured.quaternion, float)
        error = tracking_error(measured, goal, self.reference)
        clipped = np.clip(error.pose, -self.error_limit, self.error_limit)
        nu = velocity_at(measured.nu, self.reference)
        slip = nu - error.velocity
        damping = self.model.damping(nu)
        integral = np.concatenate([quat_inverse_rotate(q, memory.force), memory.moment], axis=-1)
        steady = self.holding_wrench(q, goal.quaternion) + damping * error.velocity + self.model.coriolis(nu)
        wanted = (
            steady
            + self.accelerating_wrench(q, goal)
            + self.gains.kp * clipped
            - self.gains.kd * slip
            + integral
        )
        tau = np.clip(wanted, -self.wrench_limits, self.wrench_limits)

        thrusts, _ = self.allocator.allocate(tau)
        undelivered = self.allocator.achieved(thrusts) - wanted
        braking = self.gains.kd - self.model.inertia * self.gains.rate + damping
        left_over = (self.gains.kp + self.model.stiffness) * clipped - braking * slip + undelivered
        bound = INTEGRAL_SHARE * self.wrench_limits
        integral = np.clip(integral + self.period * self.gains.rate * left_over, -bound, bound)
        return tau, PidMemory(quat_rotate(q, integral[..., :3]), integral[..., 3:])

    def accelerating_wrench(self, quaternion: Array, goal: Goal) -> Array:
        """Force that accelerates the vehicle as the goal is, body frame [N, N m], (..., 6); the moment is zero.

        The inertia, water included, differs from axis to axis: what is left over on turning is for the feedback.
        """
        force = self.model.inertia[:3] * quat_inverse_rotate(quaternion, np.asarray(goal.acceleration, float))
        return np.concatenate([force, np.zeros_like(force)], axis=-1)

    def holding_wrench(self, quaternion: npt.ArrayLike, goal: npt.ArrayLike) -> Array:
        """Wrench that holds the goal attitude at rest against weight and buoyancy, body frame [N, N m], (..., 6).

        The moment is that of the goal attitude, not of the measured one: the pendulum's own righting moment stays in
        the loop, where it acts without delay.

        Args:
            quaternion: Measured attitude, xyzw, (..., 4): the force is vertical in it.
            goal: Wanted attitude, xyzw, (..., 4).

        Note:
            Assumes that the vehicle is submerged.
        """
        up, up_goal = (quat_inverse_rotate(q, [0.0, 0.0, 1.0]) for q in (quaternion, goal))
        lever = self.buoyancy * (self.center_of_buoyancy - self.reference)
        lever = lever - self.weight * (self.center_of_gravity - self.reference)
        force, moment = np.broadcast_arrays((self.weight - self.buoyancy) * up, -cross(lever, up_goal))
        return np.concatenate([force, moment], axis=-1)


def _terminal_speed(d1: Array, d2: Array, tau: Array) -> Array:
    """Positive root of d1 v + d2 v^2 = tau, infinite without damping, (6,)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(d1 + d2 > 0.0, 2.0 * tau / (d1 + np.sqrt(d1**2 + 4.0 * d2 * tau)), np.inf))
