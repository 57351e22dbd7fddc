"""Baseline controllers: a full-wrench PID with gains from the vehicle's identified model, and the published one."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from finssim.control import ControlError
from finssim.control.allocation import Allocator
from finssim.control.axis_model import AxisModel, axis_model
from finssim.control.guidance import Goal, Measured, tracking_error, velocity_at
from finssim.core.frames import FROM_CONTROLLER, TO_CONTROLLER
from finssim.core.rotations import cross, quat_inverse_rotate, quat_rotate, quat_yaw, wrap_angle
from finssim.vehicles import Vehicle

# PID gains by pole placement on an identified axis, with the actuators' lag.


Array = npt.NDArray[np.float64]

POLE_SHARE = 0.25
"""Each of the two working poles as a fraction of the sum of all four; a quarter each leaves enough for the fourth."""

INTEGRAL_RATIO = 0.2
"""Pole of the integral as a fraction of the working poles, slow enough for little overshoot."""


@dataclass(frozen=True)
class Gains:
    """Gains of tau = kp e + integral - kd x' per axis, with integral' = rate (force that the model does not
    explain)."""

    kp: Array
    """[N/m, N m/rad], (6,)."""
    kd: Array
    """[N s/m, N m s/rad], (6,)."""
    rate: Array
    """Rate at which the integral compensates an unknown force [1/s], (6,)."""


def place_poles(model: AxisModel, lag: float | Array, speed: npt.ArrayLike = 0.0) -> Gains:
    """Return the gains for poles at -w, -w, -w/5 and -b of each axis behind a first-order lag.

        lag m s^4 + (m + d lag) s^3 + (d + k lag + kd) s^2 + (k + Kp) s + Ki = lag m (s + w)^2 (s + w/5) (s + b)

    The lag determines the sum of the poles, 1/lag + d/m; w is a quarter of it. Kp and Ki are those of the textbook
    PID. Here the integral follows

        integral' = rate ((kp + k) e - (kd - m rate + d) x'),

    the sum of forces that would contain a disturbance, so that it stays zero in a manoeuvre that the model
    explains. Both laws are the same feedback if kp + k = Ki / rate and

        m rate^3 - (kd + d) rate^2 + (Kp + k) rate - Ki = 0.

    On an axis whose own stiffness k exceeds kp + k, a negative kp would reduce the stiffness, delayed by the lag, so
    such an axis gets only a slow integral.

    Args:
        model: Model of the axes.
        lag: Lag of the actuators: time constant, delay and half a control period [s], one or (6,).
        speed: Operating speed of the linearisation d = d1 + 2 d2 |speed|, body frame [m/s, rad/s], (6,).
    """
    m, k = model.inertia, model.stiffness
    d = model.linear_damping + 2.0 * model.quadratic_damping * np.abs(np.asarray(speed, float))
    total = 1.0 / lag + d / m
    w = POLE_SHARE * total
    a = INTEGRAL_RATIO * w
    b = total - 2.0 * w - a
    Kp = lag * m * (w**2 * (a + b) + 2.0 * w * a * b) - k
    Ki = lag * m * w**2 * a * b
    kd = lag * m * (w**2 + 2.0 * w * (a + b) + a * b) - d - k * lag
    rate = np.array([_slowest(*axis) for axis in zip(m, kd + d, Kp + k, Ki, strict=True)])

    kp = Ki / rate - k
    passive = kp <= 0.0
    # A tenth of the decay rate of the axis, so that the integral does not oscillate with the pendulum.
    return Gains(
        kp=np.where(passive, 0.0, kp),
        kd=np.where(passive, 0.0, kd),
        rate=np.where(passive, np.minimum(a, 0.1 * d / m), rate),
    )


def _slowest(m: float, damping: float, stiffness: float, integral: float) -> float:
    """Return the least root of m r^3 - damping r^2 + stiffness r - integral = 0 [1/s]: the slow pole without
    the lag."""
    roots = np.roots([m, -damping, stiffness, -integral])
    return float(np.min(roots.real[np.abs(roots.imag) < 1e-9 * np.abs(roots)]))


CRUISE = 0.7
"""Speed of the approach to a far goal, as a fraction of the terminal speed at the wrench limit."""

LEAST_LAG = 0.15
"""Least lag of a position or heading loop [s], since exposure, transmission and filter delay the measurement."""

INTEGRAL_SHARE = 0.5
"""Largest integral, as a fraction of the wrench limit."""


class PidMemory(NamedTuple):
    """Memory of the controller between two commands."""

    force: Array
    """Integral part of the force, WORLD frame [N], (..., 3): the force of a current does not depend on the
    heading."""
    moment: Array
    """Integral part of the moment, body frame [N m], (..., 3)."""


@dataclass(frozen=True, kw_only=True)
class Pid:
    """Position and attitude PID with feed-forward of weight and buoyancy.

        tau = tau_goal + M a_goal + C(nu) nu + D nu_goal + kp clip(e) - kd (nu - nu_goal) + integral

    about the vehicle's wrench reference. tau_goal holds the goal at rest against weight and buoyancy; e is clipped
    where it would request more than the cruise speed; the derivative uses the measured velocity. The integral
    contains the force that the identified model does not explain, without the undelivered part of the wrench
    (back-calculation), and is bounded (clamping), so that neither a long distance nor saturation causes windup.
    """

    model: AxisModel
    """Inertia, damping and stiffness at `reference`."""
    gains: Gains
    """Gains per axis, zero on axes without a wrench limit."""
    error_limit: Array
    """Bound on the error, (6,) [m, rad]."""
    wrench_limits: Array
    """Largest requested wrench, per axis, body frame [N, N m], (6,)."""
    reference: Array
    """Body point about which the wrench acts [m], (3,)."""
    weight: float
    """Weight [N]."""
    buoyancy: float
    """Buoyancy when fully submerged [N]."""
    center_of_gravity: Array
    """Body frame [m], (3,)."""
    center_of_buoyancy: Array
    """Body frame [m], (3,)."""
    allocator: Allocator = field(repr=False)
    """Allocator for the wrench that the thrusters can deliver."""
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
        """Return the controller of a vehicle, with gains by pole placement.

        Args:
            vehicle: Vehicle; its thrusters' lag, limits, weight and buoyancy are used too.
            hydrodynamics: Hydrodynamic set whose coefficients are the model.
            period: Time between two commands [s].
            speed: Operating speed at which damping is linearised, body frame [m/s, rad/s], (6,).
            least_lag: Least lag of the position and heading loops [s]; 0 if the measurements are not delayed.

        Raises:
            ControlError: The set has no coefficients, or the period is not positive.
        """
        if not period > 0.0:
            raise ControlError(f"period is {period}, expected a positive time in seconds")
        model = axis_model(vehicle, hydrodynamics)
        thrusters = vehicle.thrusters.values()
        thruster_lag = float(np.mean([t.time_constant + t.delay for t in thrusters]))
        lag = np.full(6, max(thruster_lag, least_lag))
        lag[3:5] = thruster_lag  # roll and pitch are measured directly by the IMU
        lag += 0.5 * period
        placed = place_poles(model, lag, speed)
        limits = np.asarray(vehicle.wrench_limits, float)
        able = limits > 0.0
        if np.any(able & (model.linear_damping + model.quadratic_damping <= 0.0)):
            raise ControlError(
                f"hydrodynamic set '{hydrodynamics}' of {vehicle.name} has no damping on a driven axis"
            )
        gains = Gains(*(np.where(able, gain, 0.0) for gain in (placed.kp, placed.kd, placed.rate)))

        cruise = CRUISE * np.where(able, model.terminal_speed(limits), 0.0)
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
        """Return the memory with zero integrals, for one vehicle or for a batch of n."""
        shape = (3,) if n is None else (n, 3)
        return PidMemory(np.zeros(shape), np.zeros(shape))

    def command(self, memory: PidMemory, measured: Measured, goal: Goal) -> tuple[Array, PidMemory]:
        """Return the wrench about `reference`, body frame [N, N m], (..., 6), and the next memory."""
        q = np.asarray(measured.quaternion, float)
        error = tracking_error(measured, goal, self.reference)
        clipped = np.clip(error.pose, -self.error_limit, self.error_limit)
        nu = velocity_at(measured.nu, self.reference)
        slip = nu - error.velocity
        damping = self.model.damping(nu)
        integral = np.concatenate([quat_inverse_rotate(q, memory.force), memory.moment], axis=-1)
        steady = self.holding_wrench(q, goal.quaternion) + damping * error.velocity + self.model.coriolis(nu)
        requested = (
            steady
            + self.accelerating_wrench(q, goal)
            + self.gains.kp * clipped
            - self.gains.kd * slip
            + integral
        )
        tau = np.clip(requested, -self.wrench_limits, self.wrench_limits)

        thrusts = self.allocator.allocate(tau)
        undelivered = self.allocator.achieved(thrusts) - requested
        braking = self.gains.kd - self.model.inertia * self.gains.rate + damping
        residual = (self.gains.kp + self.model.stiffness) * clipped - braking * slip + undelivered
        bound = INTEGRAL_SHARE * self.wrench_limits
        integral = np.clip(integral + self.period * self.gains.rate * residual, -bound, bound)
        return tau, PidMemory(quat_rotate(q, integral[..., :3]), integral[..., 3:])

    def accelerating_wrench(self, quaternion: Array, goal: Goal) -> Array:
        """Return the wrench for the goal's acceleration, body frame [N, N m], (..., 6); the moment is zero.

        The inertia, with added mass, differs between axes: the remaining terms during a turn are left to the
        feedback.
        """
        force = self.model.inertia[:3] * quat_inverse_rotate(quaternion, np.asarray(goal.acceleration, float))
        return np.concatenate([force, np.zeros_like(force)], axis=-1)

    def holding_wrench(self, quaternion: npt.ArrayLike, goal: npt.ArrayLike) -> Array:
        """Return the wrench that holds the goal attitude at rest against weight and buoyancy, body frame [N,
        N m], (..., 6).

        The moment is that of the goal attitude, not of the measured one: the pendulum's righting moment
        remains in the loop, where it acts without delay.

        Args:
            quaternion: Measured attitude, xyzw, (..., 4), in which the force is vertical.
            goal: Goal attitude, xyzw, (..., 4).

        Note:
            Assumes that the vehicle is submerged.
        """
        up, up_goal = (quat_inverse_rotate(q, [0.0, 0.0, 1.0]) for q in (quaternion, goal))
        lever = self.buoyancy * (self.center_of_buoyancy - self.reference)
        lever = lever - self.weight * (self.center_of_gravity - self.reference)
        force, moment = np.broadcast_arrays((self.weight - self.buoyancy) * up, -cross(lever, up_goal))
        return np.concatenate([force, moment], axis=-1)


# The published controller of the paper's vehicle, as in its configuration files: profile `pid-paper`.


class PaperProfile(NamedTuple):
    """Published parameters, in the order depth, surge, sway (all in m) and yaw (in degrees); mixed units."""

    kp: tuple[float, float, float, float]
    ki: tuple[float, float, float, float]
    kd: tuple[float, float, float, float]
    output_limit: tuple[float, float, float, float]
    """Bound of each PID's output, in the unit of `axis_range`."""
    axis_range: tuple[float, float, float, float]
    """Divisor that scales each output to an effort in [-1, 1]; a smaller one makes the control stronger."""
    integral_decay: float = 0.95
    """Factor on the integral per period."""
    integral_limit: float = 100.0
    """Bound of the integral of the error [m s, deg s]."""
    derivative_memory: float = math.exp(-4.0)
    """Factor on the filtered derivative per period."""
    yaw_dead_band: float = 5.0
    """Heading error that is ignored [deg]."""
    unit: float = 7.0
    """Force at an effort of one [N], and moment [N m]."""


PAPER_PROFILE = PaperProfile(
    kp=(4.0, 8.0, 8.0, 0.0006),
    ki=(0.005, 0.004, 0.004, 0.0),
    kd=(0.1, 0.5, 0.5, 0.0),
    output_limit=(250.0, 30.0, 30.0, 0.10),
    axis_range=(10.0, 20.0, 20.0, 5.0),
)
"""'Position + yaw (hardware)' of the published configuration, with the published defaults for omitted values."""

TRAJECTORY_PROFILE = PaperProfile(
    kp=(12.0, 20.0, 20.0, 0.0),
    ki=(0.0, 0.1, 0.1, 0.0),
    kd=(1.0, 0.8, 0.8, 0.0),
    output_limit=(250.0, 30.0, 30.0, 0.10),
    axis_range=(20.0, 20.0, 20.0, 200.0),
    integral_decay=0.985,
    unit=19.8,
)
"""'Trajectory (hardware)' of the published configuration, used by the baseline of T2; it does not control the
heading.

An effort of one is interpreted as all four slanted thrusters at their limit, 4 * 7 N * cos 45°: the errors in the
simulator are then 0.12 to 0.19 m, near the published 0.17 to 0.21 m; with 7 N they would be twice as large.
"""


class PaperMemory(NamedTuple):
    """Memory of the controller, in the order depth, surge, sway, yaw [m, deg]."""

    integral: Array
    """Decaying integral of the error [m s, deg s], (..., 4)."""
    error: Array
    """Error at the last command [m, deg]; NaN before the first, (..., 4)."""
    derivative: Array
    """Filtered derivative of the error [m/s, deg/s], (..., 4)."""


@dataclass(frozen=True, kw_only=True)
class PaperPid:
    """Three position loops in the body's axes and one heading loop, in the paper's controller frame.

    effort = clip((kp e + ki int(e) + kd de/dt) / axis range, +-1),   wrench = effort * unit

    The published mixer is the pseudo-inverse of an idealised thruster matrix and acts on efforts; an effort
    of one on a thruster is its full thrust. One unit of effort is therefore interpreted as the limit of one
    thruster as a force (7 N), or as a moment at one metre; the publications do not state it explicitly.

    Note:
        The heading gain is per degree and the heading output is bounded by 0.10, a fiftieth of full effort,
        so the published controller turns the vehicle very slowly.
    """

    reference: Array
    """Body point about which the wrench acts [m], (3,)."""
    profile: PaperProfile = PAPER_PROFILE
    unit: float = 7.0
    """Thrust at an effort of one [N]."""
    period: float = 1.0 / 60.0
    """Time between two commands [s]."""

    @classmethod
    def from_vehicle(
        cls,
        vehicle: Vehicle,
        hydrodynamics: str = "calibrated",
        period: float = 1.0 / 60.0,
        profile: PaperProfile = PAPER_PROFILE,
    ) -> PaperPid:
        """Return the controller of a vehicle; the published gains do not depend on its hydrodynamics.

        Args:
            vehicle: Vehicle.
            hydrodynamics: Not used.
            period: Time between two commands [s].
            profile: Published parameters.

        Raises:
            ControlError: The period is not positive.
        """
        if not period > 0.0:
            raise ControlError(f"period is {period}, expected a positive time in seconds")
        reference = np.asarray(vehicle.wrench_reference, float)
        return cls(reference=reference, period=period, profile=profile, unit=profile.unit)

    def reset(self, n: int | None = None) -> PaperMemory:
        """Return the memory before the first command, for one vehicle or for a batch of n."""
        shape = (4,) if n is None else (n, 4)
        return PaperMemory(np.zeros(shape), np.full(shape, np.nan), np.zeros(shape))

    def command(self, memory: PaperMemory, measured: Measured, goal: Goal) -> tuple[Array, PaperMemory]:
        """Return the wrench about `reference`, body frame [N, N m], (..., 6), and the next memory."""
        profile = self.profile
        error = self._error(measured, goal)
        integral = profile.integral_decay * memory.integral + self.period * error
        integral = np.clip(integral, -profile.integral_limit, profile.integral_limit)
        slope = np.where(np.isnan(memory.error), 0.0, (error - memory.error) / self.period)
        slope = profile.derivative_memory * memory.derivative + (1.0 - profile.derivative_memory) * slope

        output = np.array(profile.kp) * error + np.array(profile.ki) * integral + np.array(profile.kd) * slope
        output = np.clip(output, -np.array(profile.output_limit), profile.output_limit)
        depth, surge, sway, yaw = np.moveaxis(
            np.clip(output / np.array(profile.axis_range), -1.0, 1.0), -1, 0
        )
        zero = np.zeros_like(depth)
        # Controller axes: surge x, depth y (up), sway z (left); heading about y, positive to the right.
        effort = np.stack([surge, depth, sway, zero, yaw, zero], axis=-1)
        return FROM_CONTROLLER.twist(self.unit * effort), PaperMemory(integral, error, slope)

    def _error(self, measured: Measured, goal: Goal) -> Array:
        """Return depth, surge and sway errors [m] and the heading error [deg] in the controller frame, (..., 4)."""
        q = np.asarray(measured.quaternion, float)
        away = np.asarray(goal.position, float) - np.asarray(measured.position, float)
        x, y, z = np.moveaxis(TO_CONTROLLER.vector(quat_inverse_rotate(q, away)), -1, 0)
        heading = TO_CONTROLLER.yaw(wrap_angle(quat_yaw(goal.quaternion) - quat_yaw(q)))
        heading_deg = np.degrees(heading)
        heading_deg = np.where(np.abs(heading_deg) < self.profile.yaw_dead_band, 0.0, heading_deg)
        return np.stack(np.broadcast_arrays(y, x, z, heading_deg), axis=-1)
