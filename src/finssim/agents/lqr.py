"""A linear-quadratic regulator with a disturbance observer on the feedback-linearised axes: controller `lqr`."""

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
"""Errors whose cost equals that of the full wrench limit of their axis [m, rad]."""
OBSERVER_TIME = 1.0
"""Time constant with which the observer takes over an unknown wrench [s]."""
SLOWEST_LAG = 0.02
"""Time constant of thrusters that have none in the file [s]."""


class LqrMemory(NamedTuple):
    """Memory of the controller between two commands; n vehicles if they are a batch."""

    force: Array
    """Observed force, WORLD frame [N], (..., 3): a current pushes the same way whatever the heading."""
    moment: Array
    """Observed moment, body frame [N m], (..., 3)."""
    nu: Array
    """Velocity of the reference at the last command, body frame [m/s, rad/s], (..., 6); NaN before the first."""
    modelled: Array
    """Wrench since then by the model, thrusters included, body frame [N, N m], (..., 6)."""
    delivered: Array
    """Wrench that the thrusters' lag lets through, body frame [N, N m], (..., 6)."""
    queue: Array
    """Wrenches commanded and not yet at the thrusters, oldest first, body frame [N, N m], (..., delays, 6)."""


@dataclass(frozen=True, kw_only=True)
class Lqr:
    """Optimal state feedback behind the actuators' lag and delay, with the unknown wrench observed and taken out.

    On every axis the vehicle is m x'' + d x' + k x = f + w, lag f' + f = u(t - delay), in discrete time the state
    (e, e', f, u's under way); the gains minimise the sum of (e / scale)² + (u / limit)² (Anderson and Moore, Optimal
    Control: Linear Quadratic Methods, 1990, section 2.4). Coriolis, weight and buoyancy are fed forward as in `Pid`.
    The observer compares the change of momentum with the model's,

        w' = (m (nu - nu_before) / period - wrench of the model - w) / OBSERVER_TIME,

    so that what the model cannot explain (current, ballast, weak thrusters) is compensated.
    """

    body: Pid = field(repr=False)
    """Model, limits, allocation and feed-forward."""
    gains: Array
    """Gains of e [m, rad], e' [m/s, rad/s], f [N, N m] and the delayed commands [N, N m], per axis, (6, 3 + delays)."""
    error_limit: Array
    """Largest error that is acted on, (6,) [m, rad]."""
    lag: float
    """Time constant of the thrusters [s]."""
    delays: int
    """Commands under way."""
    period: float
    """Time between two commands [s]."""

    @classmethod
    def from_vehicle(cls, vehicle: Vehicle, hydrodynamics: str = "calibrated", period: float = 0.05) -> Lqr:
        """Controller of a vehicle.

        Args:
            vehicle: Its inertia, damping, limits and its thrusters' lag and delay are used.
            hydrodynamics: Set whose coefficients are the model.
            period: Time between two commands [s].

        Raises:
            ControlError: The set has no coefficients, or the period is not positive.
        """
        body = Pid.from_vehicle(vehicle, hydrodynamics, period)
        thrusters = vehicle.thrusters.values()
        lag = max(float(np.mean([t.time_constant for t in thrusters])), SLOWEST_LAG)
        delay = float(np.mean([t.delay for t in thrusters]))
        delays = max(1, round(delay / period) + 1)  # the state is as old as a period when its command arrives
        scale = np.repeat([POSITION_SCALE, ANGLE_SCALE], 3)
        gains = np.stack([_gains(body, i, float(scale[i]), lag, delays, period) for i in range(6)])
        model = body.model
        cruise = CRUISE * model.terminal_speed(body.wrench_limits)
        braking = gains[:, 1] + model.damping(cruise)
        reach = np.divide(braking * cruise, gains[:, 0], out=np.full(6, np.inf), where=gains[:, 0] > 0.0)
        return cls(body=body, gains=gains, error_limit=reach, lag=lag, delays=delays, period=period)

    @property
    def allocator(self) -> Allocator:
        """Determines what the thrusters can deliver."""
        return self.body.allocator

    def reset(self, n: int | None = None) -> LqrMemory:
        """Memory of a vehicle at rest that nothing pushes, for one vehicle or for a batch of n."""
        shape = () if n is None else (n,)
        three, six = np.zeros((*shape, 3)), np.zeros((*shape, 6))
        return LqrMemory(
            three, three, np.full((*shape, 6), np.nan), six, six, np.zeros((*shape, self.delays, 6))
        )

    def command(self, memory: LqrMemory, measured: Measured, goal: Goal) -> tuple[Array, LqrMemory]:
        """Wanted wrench about `body.reference`, body frame [N, N m], (..., 6), and the memory for the next command."""
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
        # Wrench until the next command by the model; the thrusters' part is its mean over the period.
        modelled = mean - model_wrench - body.holding_wrench(q, q)
        delivered = memory.delivered + through * (arriving - memory.delivered)
        return tau, LqrMemory(
            quat_rotate(q, observed[..., :3]), observed[..., 3:], nu, modelled, delivered, queue
        )

    def _observed(self, memory: LqrMemory, q: Array, nu: Array) -> Array:
        """The unknown wrench as the last period's change of momentum shows it, body frame [N, N m], (..., 6)."""
        before = np.concatenate([quat_inverse_rotate(q, memory.force), memory.moment], axis=-1)
        change = self.body.model.inertia * (nu - memory.nu) / self.period
        unmodelled = np.where(np.isnan(change), before, change - memory.modelled)
        share = 1.0 - math.exp(-self.period / OBSERVER_TIME)
        bound = INTEGRAL_SHARE * self.body.wrench_limits
        return np.asarray(np.clip(before + share * (unmodelled - before), -bound, bound))


def _gains(body: Pid, axis: int, scale: float, lag: float, delays: int, period: float) -> Array:
    """Feedback of one axis of e, e', f and the commands under way, (3 + delays,); zero without authority."""
    from scipy.linalg import expm, solve_discrete_are

    model, limit = body.model, float(body.wrench_limits[axis])
    n = 3 + delays
    if not limit > 0.0:
        return np.zeros(n)
    m, d, k = (float(x[axis]) for x in (model.inertia, model.linear_damping, model.stiffness))
    continuous = np.zeros((4, 4))  # x, x', f, and the input that is held over a period
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
