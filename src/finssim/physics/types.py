"""Warp vector and matrix types of the physics: twists and wrenches, eight thrusters, 6x6 and 6x8 matrices."""

# mypy: disable-error-code="index,no-any-return,operator,valid-type"

import warp as wp

MAX_THRUSTERS = 8
"""Largest number of thrusters of a vehicle; unused columns are zero."""

vec6 = wp.types.vector(length=6, dtype=wp.float32)
vec6d = wp.types.vector(length=6, dtype=wp.float64)
vec8 = wp.types.vector(length=MAX_THRUSTERS, dtype=wp.float32)
vec9 = wp.types.vector(length=9, dtype=wp.float32)
mat66 = wp.types.matrix(shape=(6, 6), dtype=wp.float32)
mat66d = wp.types.matrix(shape=(6, 6), dtype=wp.float64)
mat68 = wp.types.matrix(shape=(6, MAX_THRUSTERS), dtype=wp.float32)


@wp.func
def linear(x: vec6) -> wp.vec3:
    """Return the first three components: linear velocity or force, in the unit of x."""
    return wp.vec3(x[0], x[1], x[2])


@wp.func
def angular(x: vec6) -> wp.vec3:
    """Return the last three components: angular velocity or moment, in the unit of x."""
    return wp.vec3(x[3], x[4], x[5])


@wp.func
def join(a: wp.vec3, b: wp.vec3) -> vec6:
    """Return a twist or wrench from its linear and angular parts, in their units."""
    return vec6(a[0], a[1], a[2], b[0], b[1], b[2])


@wp.func
def symmetric_times(M: mat66, x: vec6) -> vec6:
    """Return M x for a symmetric M, as xᵀ M: a sum of rows, which compiles to vector instructions.

    Its unit is the product of the units of M and x.
    """
    return x * M
