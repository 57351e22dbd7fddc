"""Linear-quadratic regulator with a disturbance observer on the feedback-linearised axes: controller `lqr`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from finssim.agents.pid import CRUISE, INTEGRAL_SHARE, Pid
from finssim.control.allocation import Allocator
from finssim.control.guidance import Goal, Measured, tracking_error, velocity_at
from finssim.core.rotations import quat_inverse_rotate, quat_rotate
from finssim.vehicles import Vehicle

Array = npt.NDArray[np.float64]

POSITION_SCALE, ANGLE_SCALE = 0.25, math.radians(25.0)
"""Errors with the same cost as the full wrench limit of their axis [m, rad]."""
OBSERVER_TIME = 1.0
"""Time constant of the observer for an unknown wrench [s]."""
SLOWEST_LAG = 0.02
"""Time constant of thrusters without one in the file [s]."""


class LqrMemory(NamedTuple):
    """Memory of the controller between two commands, for one vehicle or a batch."""

    force: Array
    """Observed force, WORLD frame [N], (..., 3): the force of a current does not depend on the heading."""
    moment: Array
    """Observed moment, body frame [N m], (..., 3)."""
    nu: Array
    """Velocity at the reference point at the last command, body frame [m/s, rad/s], (..., 6); NaN before the
    first."""
    modelled: Array
    """Mean wrench since then according to the model, thrusters included, body frame [N, N m], (..., 6)."""
    delivered: Array
    """Wrench after the thrusters' lag, body frame [N, N m], (..., 6)."""
    queue: Array
    """Commanded wrenches that have not reached the thrusters, oldest first, body frame [N, N m], (..., delays, 6)."""


@dataclass(frozen=True, kw_only=True)
class Lqr:
    """Optimal state feedback with the actuators' lag and delay in the model, and compensation of the unknown wrench.

    The model of each axis is m x'' + d x' + k x = f + w, lag f' + f = u(t - delay). In discrete time the state is (e,
    e', f, pending commands u); the gains minimise the sum of (e / scale)² + (u / limit)² (Anderson and Moore, Optimal
    Control: Linear Quadratic Methods, 1990, section 2.4). Coriolis, weight and buoyancy are fed forward as in `Pid`.
    The observer compares the change of momentum with that of the model,

        w' = (m (nu - nu_before) / period - wrench of the model - w) / OBSERVER_TIME,

    so that effects outside the model (current, ballast, weak thrusters) are compensated.
    """

    body: Pid = field(repr=False)
    """Model, limits, allocation and feed-forward."""
    gains: Array
    """Gains of e [m, rad], e' [m/s, rad/s], f [N, N m] and the delayed commands [N, N m], per axis, (6, 3 +
    delays)."""
    error_limit: Array
    """Bound on the error, (6,) [m, rad]."""
    lag: float
    """Time constant of the thrusters [s]."""
    delays: int
    """Number of pending commands."""
    period: float
    """Time between two commands [s]."""

    @classmethod
    def from_vehicle(cls, vehicle: Vehicle, hydrodynamics: str = "calibrated", period: float = 0.05) -> Lqr:
        """Return the controller of a vehicle.

        Args:
            vehicle: Vehicle; its inertia, damping, limits and its thrusters' lag and delay are used.
            hydrodynamics: Hydrodynamic set whose coefficients are the model.
            period: Time between two commands [s].

        Raises:
            ControlError: The set has no coefficients, or the period is not positive.
        """
        body = Pid.from_vehicle(vehicle, hydrodynamics, period)
        thrusters = vehicle.thrusters.values()
        lag = max(float(np.mean([t.time_constant for t in thrusters])), SLOWEST_LAG)
        delay = float(np.mean([t.delay for t in thrusters]))
        delays = max(1, round(delay / period) + 1)  # the state is one period old when its command arrives
        scale = np.repeat([POSITION_SCALE, ANGLE_SCALE], 3)
        gains = np.stack([_gains(body, i, float(scale[i]), lag, delays, period) for i in range(6)])
        model = body.model
        driven = gains[:, 0] > 0.0
        cruise = CRUISE * np.where(driven, model.terminal_speed(body.wrench_limits), 0.0)
        braking = gains[:, 1] + model.damping(cruise)
        reach = np.divide(braking * cruise, gains[:, 0], out=np.full(6, np.inf), where=driven)
        return cls(body=body, gains=gains, error_limit=reach, lag=lag, delays=delays, period=period)

    @property
    def allocator(self) -> Allocator:
        """Allocator for the wrench that the thrusters can deliver."""
        return self.body.allocator

    def reset(self, n: int | None = None) -> LqrMemory:
        """Return the memory of a vehicle at rest without unknown wrench, for one vehicle or for a batch of n."""
        shape = () if n is None else (n,)
        three, six = np.zeros((*shape, 3)), np.zeros((*shape, 6))
        return LqrMemory(
            three, three, np.full((*shape, 6), np.nan), six, six, np.zeros((*shape, self.delays, 6))
        )

    def command(self, memory: LqrMemory, measured: Measured, goal: Goal) -> tuple[Array, LqrMemory]:
        """Return the wrench about `body.reference`, body frame [N, N m], (..., 6), and the next memory."""
        body, model = self.body, self.body.model
        q = np.asarray(measured.quaternion, float)
        error = tracking_error(measured, goal, body.reference)
        nu = velocity_at(measured.nu, body.reference)
        observed = self._observed(memory, q, nu)

        slip = nu - error.velocity
        hold = body.holding_wrench(q, goal.quaternion)
        model_wrench = model.damping(nu) * nu + model.coriolis(nu)
        steady = hold + model.damping(nu) * error.velocity + model.coriolis(nu) - observed
        clipped = np.clip(error.pose, -self.error_limit, self.error_limit)
        under_way = memory.queue - steady[..., None, :]
        feedback = (
            self.gains[:, 0] * clipped
            - self.gains[:, 1] * slip
            - self.gains[:, 2] * (memory.delivered - steady)
            - np.einsum("ik,...ki->...i", self.gains[:, 3:], under_way)
        )
        tau = np.clip(
            steady + body.accelerating_wrench(q, goal) + feedback, -body.wrench_limits, body.wrench_limits
        )
        achieved = self.allocator.achieved(self.allocator.allocate(tau))

        queue = np.concatenate([memory.queue[..., 1:, :], achieved[..., None, :]], axis=-2)
        arriving = memory.queue[..., 0, :]
        through = 1.0 - math.exp(-self.period / self.lag)
        mean = arriving + (memory.delivered - arriving) * self.lag / self.period * through
        # Mean wrench until the next command, according to the model; the thrusters' part is its mean over the period.
        modelled = mean - model_wrench - body.holding_wrench(q, q)
        delivered = memory.delivered + through * (arriving - memory.delivered)
        return tau, LqrMemory(
            quat_rotate(q, observed[..., :3]), observed[..., 3:], nu, modelled, delivered, queue
        )

    def _observed(self, memory: LqrMemory, q: Array, nu: Array) -> Array:
        """Return the unknown wrench, updated by the change of momentum in the last period, body frame [N, N
        m], (..., 6)."""
        before = np.concatenate([quat_inverse_rotate(q, memory.force), memory.moment], axis=-1)
        change = self.body.model.inertia * (nu - memory.nu) / self.period
        unmodelled = np.where(np.isnan(change), before, change - memory.modelled)
        share = 1.0 - math.exp(-self.period / OBSERVER_TIME)
        bound = INTEGRAL_SHARE * self.body.wrench_limits
        return np.asarray(np.clip(before + share * (unmodelled - before), -bound, bound))


def _gains(body: Pid, axis: int, scale: float, lag: float, delays: int, period: float) -> Array:
    """Return one axis' feedback gains of e, e', f and the pending commands, (3 + delays,); zero without a
    wrench limit."""
    from scipy.linalg import expm, solve_discrete_are

    model, limit = body.model, float(body.wrench_limits[axis])
    n = 3 + delays
    if not limit > 0.0:
        return np.zeros(n)
    m, d, k = (float(x[axis]) for x in (model.inertia, model.linear_damping, model.stiffness))
    continuous = np.zeros((4, 4))  # x, x', f, and the input, which is constant over a period
    continuous[0, 1] = 1.0
    continuous[1] = [-k / m, -d / m, 1.0 / m, 0.0]
    continuous[2, 2:] = [-1.0 / lag, 1.0 / lag]
    step = expm(continuous * period)
    A, b = np.zeros((n, n)), np.zeros((n, 1))
    A[:3, :3], A[:3, 3] = step[:3, :3], step[:3, 3]
    A[3:-1, 4:] = np.eye(delays - 1)
    b[-1] = 1.0
    Q = np.zeros((n, n))
    Q[0, 0] = 1.0 / scale**2
    R = np.array([[1.0 / limit**2]])
    P = solve_discrete_are(A, b, Q + 1e-9 * np.eye(n) / limit**2, R)
    gains: Array = np.linalg.solve(R + b.T @ P @ b, b.T @ P @ A)[0]
    return gains
