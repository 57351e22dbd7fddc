"""Actuator dynamics: command delay, dead zone, first-order lag, slew limit; steady thrust curve T = c± ω|ω|."""

# mypy: disable-error-code="no-any-return"

import warp as wp

from finssim.physics.types import MAX_THRUSTERS, vec8


@wp.func
def thrust_of_speed(omega: float, c_plus: float, c_minus: float) -> float:
    """Return the steady thrust T = c± ω|ω| [N] of a propeller that turns at omega [rad/s] (paper, eq. 16)."""
    c = wp.where(omega >= 0.0, c_plus, c_minus)
    return c * omega * wp.abs(omega)


@wp.func
def speed_of_thrust(thrust: float, c_plus: float, c_minus: float) -> float:
    """Return the propeller speed [rad/s] at a steady thrust [N]: the inverse of `thrust_of_speed`; 0 where c is 0."""
    c = wp.where(thrust >= 0.0, c_plus, c_minus)
    return wp.where(c > 0.0, wp.sign(thrust) * wp.sqrt(wp.abs(thrust) / wp.max(c, 1.0e-20)), 0.0)


@wp.func
def admissible(command: vec8, lower: vec8, upper: vec8, dead_minus: vec8, dead_plus: vec8) -> vec8:
    """Limit a force command to [lower, upper], and set it to zero inside (dead_minus, dead_plus) [N]."""
    f = wp.min(wp.max(command, lower), upper)
    for i in range(MAX_THRUSTERS):
        f[i] = wp.where(f[i] > dead_minus[i], wp.where(f[i] < dead_plus[i], 0.0, f[i]), f[i])
    return f


@wp.func
def beyond_play(target: vec8, x: vec8, play: vec8) -> vec8:
    """Return the point nearest to x within `play` of the target, at which a drive with play comes to rest.

    Args:
        target: Commanded values [N, rad, m³ or m].
        x: Current values, in the same units.
        play: Half width of the dead band or backlash, in the same units.

    Returns:
        Values in the same units.
    """
    return wp.min(wp.max(x, target - play), target + play)


@wp.func
def steps_ago(age: float, rate: float) -> int:
    """Return the number of control steps at `rate` [1/s] since a command was issued `age` [s] ago."""
    return wp.max(int(wp.ceil(age * rate - 1.0e-4)), 0)


@wp.func
def first_order(x: vec8, target: vec8, alpha: vec8, max_change: vec8) -> vec8:
    """Return the state after one step of the motors' first-order lag, exact for a constant target, then the slew limit.

    x <- x + clip(alpha (target - x), ±max_change),   alpha = 1 - exp(-h / time_constant)

    Args:
        x: Current thrusts [N] or speeds [rad/s].
        target: Commanded thrusts [N] or speeds [rad/s], in the unit of x.
        alpha: Fraction of the difference that one step removes, in (0, 1].
        max_change: Slew limit times the step, in the unit of x.

    Returns:
        Thrusts [N] or speeds [rad/s] after the step. With `VehicleParameters.beta` instead of alpha and half of
        max_change, the result is the mean over the step: exact for the lag alone and for the slew limit alone.
    """
    return x + wp.max(wp.min(wp.cw_mul(alpha, target - x), max_change), -max_change)
