"""The shapes that T2 trains on, drawn anew for every episode inside the kernels: line, circle, lemniscate, helix."""

import warp as wp

from finssim.tasks.arrays import ReferenceTable

SHAPE_NAMES = ("line", "circle", "lemniscate", "helix")
"""By the number that the kernels use."""

SPEED_SAMPLES = 96
"""Phases at which the greatest slope of a shape is looked for, as published."""


@wp.func
def shape_point(kind: int, phase: float, lift: float) -> wp.vec3:
    """Point of a shape of unit scale at a phase; `lift` is the height of its tilt [1]."""
    s = wp.sin(phase)
    c = wp.cos(phase)
    d = 1.0 + s * s
    if kind == 0:
        return wp.vec3(s, 0.0, lift * s)
    if kind == 1:
        return wp.vec3(c, s, lift * s)
    if kind == 2:  # Bernoulli's
        return wp.vec3(c / d, s * c / d, lift * s)
    return wp.vec3(c, s, phase / 6.2831853)


@wp.func
def shape_slope(kind: int, phase: float, lift: float) -> wp.vec3:
    """Derivative of `shape_point` by the phase."""
    s = wp.sin(phase)
    c = wp.cos(phase)
    d = 1.0 + s * s
    if kind == 0:
        return wp.vec3(c, 0.0, lift * c)
    if kind == 1:
        return wp.vec3(-s, c, lift * c)
    if kind == 2:
        return wp.vec3(-s * (3.0 - s * s) / (d * d), (1.0 - 3.0 * s * s) / (d * d), lift * c)
    return wp.vec3(-s, c, 1.0 / 6.2831853)


@wp.func
def greatest_rate(kind: int, lift: float, scale: wp.vec3, limit: wp.vec3) -> float:
    """Phase rate at which the first axis reaches its speed limit [rad/s]."""
    steepest = wp.vec3()
    for i in range(SPEED_SAMPLES):
        slope = shape_slope(kind, 6.2831853 * float(i) / float(SPEED_SAMPLES), lift)
        steepest = wp.max(
            steepest, wp.cw_mul(scale, wp.vec3(wp.abs(slope[0]), wp.abs(slope[1]), wp.abs(slope[2])))
        )
    rate = float(1.0e6)
    for axis in range(3):
        if steepest[axis] > 0.0:
            rate = wp.min(rate, limit[axis] / steepest[axis])
    return rate


@wp.func
def fill_reference(
    r: ReferenceTable,
    w: int,
    kind: int,
    lift: float,
    scale: wp.vec3,
    origin: wp.vec3,
    phase: float,
    rate: float,
):
    """Write the knots of a shape that is run through at a constant phase rate [rad/s] from `phase` [rad] on."""
    for k in range(r.position.shape[1]):
        angle = rate * r.spacing * float(k)
        if kind == 3:  # its height counts from the start
            lifted = shape_point(kind, phase + angle, lift)
            lifted[2] = angle / 6.2831853
            r.position[w, k] = origin + wp.cw_mul(scale, lifted)
        else:
            r.position[w, k] = origin + wp.cw_mul(scale, shape_point(kind, phase + angle, lift))
        r.velocity[w, k] = rate * wp.cw_mul(scale, shape_slope(kind, phase + angle, lift))
    r.duration[w] = 6.2831853 / wp.abs(rate)
    r.offset[w] = phase / 6.2831853
    r.given[w] = 0
