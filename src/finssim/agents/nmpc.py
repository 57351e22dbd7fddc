"""Nonlinear model predictive control with the thrusters' lag, delay and limits in the model: controller `nmpc`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import numpy.typing as npt

from finssim.agents.lqr import ANGLE_SCALE, OBSERVER_TIME, POSITION_SCALE, SLOWEST_LAG
from finssim.agents.pid import INTEGRAL_SHARE, Pid
from finssim.control import ControlError
from finssim.control.allocation import Allocator
from finssim.control.guidance import Goal, Measured
from finssim.core.rotations import quat_inverse_rotate, quat_rotate
from finssim.vehicles import HydrodynamicSet, Vehicle
from finssim.vehicles.vehicle import moved_to_origin, skew

Array = npt.NDArray[np.float64]

HORIZON = 20
"""Number of control periods in the horizon."""
SPEED_SCALE = 4.0
"""Ratio of the scales of velocity and position errors in the cost [1/s]."""
FINAL = 5.0
"""Weight of the state at the end of the horizon, relative to that of one step."""
ITERATIONS = 30
"""Largest number of iterations; a solution is usable long before."""


class NmpcMemory(NamedTuple):
    """Memory of the controller between two commands, for one vehicle or a batch."""

    force: Array
    """Observed force, WORLD frame [N], (..., 3)."""
    moment: Array
    """Observed moment about the body origin, body frame [N m], (..., 3)."""
    predicted: Array
    """Velocity of the body origin that the model predicted for the present, body frame [m/s, rad/s], (...,
    6); NaN at first."""
    thrust: Array
    """Thrust after the thrusters' lag [N], (..., n)."""
    queue: Array
    """Commanded thrusts that have not reached the thrusters, oldest first [N], (..., delays, n)."""
    plan: Array
    """Solution of the previous problem in the units of its variables, (..., variables), the start of the
    next; NaN at first."""


@dataclass(frozen=True, kw_only=True)
class Nmpc:
    """Nonlinear model-predictive control: the optimal thrusts of the next two seconds, of which the first is
    commanded.

        M nu_dot + C(nu) nu + D(nu) nu + g(q) = B f + w,    lag f_dot + f = u(t - delay),    lower <= u <= upper

    in all six degrees of freedom about the body origin (Fossen 2021, eq. 8.1). The unknown wrench w is observed as in
    `Lqr` and assumed constant. The cost of a step is that of `Lqr`, with position and attitude relative to their
    scales and thrust relative to its limits. The problem is solved by multiple shooting with Fatrop through CasADi,
    starting from the previous solution shifted by one period.
    """

    solve: Callable[..., Any] = field(repr=False)
    """Solver from CasADi."""
    advance: Callable[..., Any] = field(repr=False)
    """Function (state, arriving thrust, w) -> state one period later."""
    body: Pid = field(repr=False)
    """Limits, allocation and the wrench that holds the vehicle at rest."""
    mass: Array
    """M about the body origin [kg, kg m, kg m²], (6, 6)."""
    bounds: tuple[Array, Array]
    """Bounds of the constraints, in their units, (constraints,) each."""
    delays: int
    """Number of pending commands."""
    period: float
    """Time between two commands [s]."""

    @classmethod
    def from_vehicle(cls, vehicle: Vehicle, hydrodynamics: str = "calibrated", period: float = 0.1) -> Nmpc:
        """Return the controller of a vehicle.

        Args:
            vehicle: Vehicle; its inertia, damping, centres, limits and its thrusters' lag and delay are the model.
            hydrodynamics: Hydrodynamic set whose coefficients are used.
            period: Time between two commands [s].

        Raises:
            ControlError: The set has no coefficients, or the period is not positive.
        """
        body = Pid.from_vehicle(vehicle, hydrodynamics, period)
        thrusters = vehicle.thrusters.values()
        lag = max(float(np.mean([t.time_constant for t in thrusters])), SLOWEST_LAG)
        delays = round(float(np.mean([t.delay for t in thrusters])) / period)
        advance = _model(vehicle, hydrodynamics, lag, period)
        solve, bounds = _problem(vehicle, advance, body.wrench_limits, period)
        return cls(
            solve=solve, advance=advance, body=body, mass=vehicle.mass_matrix(hydrodynamics), bounds=bounds,
            delays=delays, period=period,
        )  # fmt: skip

    @property
    def allocator(self) -> Allocator:
        """Allocator for the wrench that the thrusters can deliver."""
        return self.body.allocator

    def reset(self, n: int | None = None) -> NmpcMemory:
        """Return the memory of a vehicle at rest without unknown wrench, for one vehicle or for a batch of n."""
        shape, thrusters = () if n is None else (n,), self.allocator.B.shape[1]
        three, still = np.zeros((*shape, 3)), np.zeros((*shape, thrusters))
        size = HORIZON * (13 + 2 * thrusters) + 13 + thrusters
        return NmpcMemory(
            three, three, np.full((*shape, 6), np.nan), still, np.zeros((*shape, self.delays, thrusters)),
            np.full((*shape, size), np.nan),
        )  # fmt: skip

    def command(self, memory: NmpcMemory, measured: Measured, goal: Goal) -> tuple[Array, NmpcMemory]:
        """Return the wrench about `body.reference`, body frame [N, N m], (..., 6), and the next memory.

        Raises:
            ControlError: An input is not finite.
        """
        position = np.asarray(measured.position, float)
        shape = position.shape[:-1]
        inputs = [position, measured.quaternion, measured.nu, goal.position, goal.quaternion, goal.velocity]
        sizes = (3, 4, 6, 3, 4, 3, 3)
        rows = [
            np.broadcast_to(np.asarray(x, float), (*shape, size)).reshape(-1, size)
            for x, size in zip([*inputs, goal.acceleration], sizes, strict=True)
        ]
        if not all(np.isfinite(x).all() for x in rows):
            raise ControlError("the state or the goal contains a non-finite number: check both inputs")
        memories = [x.reshape(len(rows[0]), *x.shape[len(shape) :]) for x in memory]
        results = [
            self._single(NmpcMemory(*(x[i] for x in memories)), *(x[i] for x in rows))
            for i in range(len(rows[0]))
        ]
        tau = np.reshape([wrench for wrench, _ in results], (*shape, 6))
        after = map(np.stack, zip(*(after_one for _, after_one in results), strict=True))
        return tau, NmpcMemory(*(x.reshape(*shape, *x.shape[1:]) for x in after))

    def _single(
        self, memory: NmpcMemory, p: Array, q: Array, nu: Array, p_goal: Array, q_goal: Array, v_goal: Array,
        a_goal: Array,
    ) -> tuple[Array, NmpcMemory]:  # fmt: skip
        """Return thrusts and memory for one vehicle; the goal moves with its velocity and acceleration."""
        # q and -q are the same attitude, but the previous plan only matches one of the signs.
        if memory.plan[3:7] @ q < 0.0:
            q = -q
        observed = np.concatenate([quat_inverse_rotate(q, memory.force), memory.moment])
        if not np.isnan(memory.predicted).any():
            unmodelled = self.mass @ (nu - memory.predicted) / self.period
            share = 1.0 - math.exp(-self.period / OBSERVER_TIME)
            bound = INTEGRAL_SHARE * self.body.wrench_limits
            observed = np.clip(observed + share * unmodelled, -bound, bound)
        force, moment = quat_rotate(q, observed[:3]), observed[3:]
        w = np.concatenate([force, moment])

        state = np.concatenate([p, q / np.linalg.norm(q), nu, memory.thrust])
        first = state
        # The pending commands act before the new one.
        for k, under_way in enumerate(memory.queue):
            state = np.asarray(self.advance(state, under_way, w)).ravel()
            first = state if k == 0 else first
        hold = self.body.holding_wrench(q_goal, q_goal)
        steady = self.allocator.allocate(hold - np.concatenate([quat_inverse_rotate(q_goal, force), moment]))
        ahead = self.delays * self.period
        target = p_goal + ahead * v_goal + 0.5 * ahead**2 * a_goal
        plan = np.tile(np.concatenate([state, steady]), HORIZON + 1)[: memory.plan.size]
        if not np.isnan(
            memory.plan
        ).any():  # previous solution shifted by one step, with the last step repeated
            stage = state.size + steady.size
            plan = np.concatenate([memory.plan[stage:], memory.plan[-stage:]])
        parameters = np.concatenate([state, w, target, q_goal, v_goal + ahead * a_goal, a_goal, steady])
        answer = self.solve(x0=plan, p=parameters, lbg=self.bounds[0], ubg=self.bounds[1])
        plan = np.asarray(answer["x"]).ravel()
        lower, upper = self.allocator.lower, self.allocator.upper
        thrust = np.clip(plan[state.size : state.size + steady.size], lower, upper)
        # If the solver fails, hold the goal with the steady thrust and discard the plan.
        if not np.isfinite(plan).all():
            thrust, plan = steady, np.full_like(plan, np.nan)
        queue = np.concatenate([memory.queue, thrust[None]])
        if not self.delays:
            first = np.asarray(self.advance(state, thrust, w)).ravel()
        after = NmpcMemory(
            force, moment, first[7:13], first[13:], queue[1:] if self.delays else memory.queue, plan
        )
        return self.allocator.achieved(thrust), after


def _model(vehicle: Vehicle, hydrodynamics: str, lag: float, period: float) -> Any:
    """Return the CasADi function (state, arriving thrust, unknown wrench) -> state one period later.

    The state is position and quaternion (xyzw) in the world, velocity of the body origin in the body frame, and
    thrusts. The lag is solved exactly, and its mean thrust acts over the period; the rest is integrated by the
    midpoint method.
    """
    chosen = vehicle.hydrodynamic_set(hydrodynamics)
    if not isinstance(chosen, HydrodynamicSet):
        raise ControlError(
            f"hydrodynamic set '{hydrodynamics}' of {vehicle.name} has no damping coefficients for the prediction: "
            "name one with coefficients"
        )
    n, point = len(vehicle.thrusters), np.asarray(chosen.reference_point, float)
    M, B = vehicle.mass_matrix(hydrodynamics), vehicle.thruster_matrix()
    D1 = moved_to_origin(np.asarray(chosen.linear_damping, float), point)
    # From the twist of the body origin to that of the reference point of the quadratic damping.
    to_point = np.eye(6)
    to_point[:3, 3:] = -skew(point)
    D2 = np.asarray(chosen.quadratic_damping, float)
    r_g, r_b = (
        np.asarray(x, float) for x in (vehicle.body.center_of_gravity, vehicle.body.center_of_buoyancy)
    )
    weight, buoyancy = vehicle.weight, vehicle.buoyancy
    inverse = np.linalg.inv(M)

    x, u, w = ca.SX.sym("x", 13 + n), ca.SX.sym("u", n), ca.SX.sym("w", 6)
    retained = math.exp(-period / lag)
    mean = u + (x[13:] - u) * (lag / period * (1.0 - retained))

    def rate(y: Any) -> Any:
        q, nu = y[3:7], y[7:13]
        v, omega = nu[:3], nu[3:]
        at_point = to_point @ nu
        damping = D1 @ nu + to_point.T @ (D2 @ (ca.sqrt(at_point**2 + 1e-8) * at_point))
        momentum = M @ nu
        coriolis = ca.vertcat(
            ca.cross(omega, momentum[:3]), ca.cross(omega, momentum[3:]) + ca.cross(v, momentum[:3])
        )
        up = _rotate(ca.vertcat(-q[:3], q[3]), ca.DM([0.0, 0.0, 1.0]))
        restoring = ca.vertcat((buoyancy - weight) * up, ca.cross(buoyancy * r_b - weight * r_g, up))
        unknown = ca.vertcat(_rotate(ca.vertcat(-q[:3], q[3]), w[:3]), w[3:])
        nu_dot = inverse @ (B @ mean + unknown + restoring - damping - coriolis)
        spin = ca.vertcat(q[3] * omega + ca.cross(q[:3], omega), -ca.dot(q[:3], omega))
        return ca.vertcat(_rotate(q, v), 0.5 * spin, nu_dot)

    y = x[:13]
    y = y + period * rate(y + 0.5 * period * rate(y))
    y = ca.vertcat(y[:3], y[3:7] / ca.norm_2(y[3:7]), y[7:])
    return ca.Function("advance", [x, u, w], [ca.vertcat(y, u + retained * (x[13:] - u))])


def _rotate(q: Any, v: Any) -> Any:
    """Return a vector rotated by a unit quaternion (xyzw)."""
    t = 2.0 * ca.cross(q[:3], v)
    return v + q[3] * t + ca.cross(q[:3], t)


def _problem(vehicle: Vehicle, advance: Any, limits: Array, period: float) -> tuple[Any, tuple[Array, Array]]:
    """Return the solver of the problem and the bounds of its constraints.

    Variables: state and thrust of each step in turn, then the last state. Constraints of each step: the next state
    equals the model's prediction; in the first step the state equals the given one; thrusts are within their limits.
    """
    n = len(vehicle.thrusters)
    lower, upper = vehicle.force_limits
    symbols = [ca.SX.sym(name, size) for name, size in
             (("x", 13 + n), ("w", 6), ("p", 3), ("q", 4), ("v", 3), ("a", 3), ("steady", n))]  # fmt: skip
    start, w, position, attitude, velocity, acceleration, steady = symbols
    reach = np.maximum(upper, -lower)
    # Axes without thrusters are not controlled.
    driven = (limits > 0.0).astype(float)
    turning = np.array([driven[3], driven[4], driven[5]]) / ANGLE_SCALE**2

    def cost(x: Any, t: Any) -> Any:
        moved = position + t * velocity + 0.5 * t**2 * acceleration
        speed = velocity + t * acceleration
        q = x[3:7]
        rotation_error = ca.vertcat(
            q[3] * attitude[:3] - attitude[3] * q[:3] - ca.cross(q[:3], attitude[:3]),
            q[3] * attitude[3] + ca.dot(q[:3], attitude[:3]),
        )
        slip = _rotate(q, x[7:10]) - speed
        # The vector part is the sine of half the angle; its sign is chosen for the shorter rotation.
        turn = 2.0 * ca.if_else(rotation_error[3] < 0.0, -1.0, 1.0) * rotation_error[:3]
        return (
            ca.sumsqr(x[:3] - moved) / POSITION_SCALE**2
            + ca.sumsqr(slip) / (SPEED_SCALE * POSITION_SCALE) ** 2
            + ca.dot(turning, turn**2)
            + ca.dot(turning, x[10:13] ** 2) / SPEED_SCALE**2
        )

    variables, constraints, low, high, total = [], [], [], [], ca.SX(0.0)
    states = [ca.SX.sym(f"x{k}", 13 + n) for k in range(HORIZON + 1)]
    thrusts = [ca.SX.sym(f"u{k}", n) for k in range(HORIZON)]
    zero = np.zeros(13 + n)
    for k in range(HORIZON):
        variables += [states[k], thrusts[k]]
        constraints.append(states[k + 1] - advance(states[k], thrusts[k], w))
        equal = [zero]
        if k == 0:
            constraints.append(states[0] - start)
            equal = [zero, zero]
        constraints.append(thrusts[k])
        low += [*equal, lower]
        high += [*equal, upper]
        total += cost(states[k], k * period) + ca.sumsqr((thrusts[k] - steady) / reach)
    variables.append(states[-1])
    total += FINAL * cost(states[-1], HORIZON * period)
    lbg, ubg = np.concatenate(low), np.concatenate(high)
    options = {
        "structure_detection": "auto",
        "equality": (lbg == ubg).tolist(),
        "expand": True,
        "print_time": False,
        "error_on_fail": False,
        "fatrop": {"max_iter": ITERATIONS, "tol": 1e-4, "print_level": 0, "mu_init": 1e-1},
    }
    problem = {
        "x": ca.vertcat(*variables),
        "p": ca.vertcat(*symbols),
        "f": total,
        "g": ca.vertcat(*constraints),
    }
    return ca.nlpsol("nmpc", "fatrop", problem, options), (lbg, ubg)
