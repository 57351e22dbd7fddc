"""The pool's own circulation: eddies in a box, still at the walls, that come and go slowly."""
# mypy: disable-error-code="valid-type,misc,index,no-any-return,no-untyped-def,untyped-decorator,attr-defined"

import math
from typing import Any

import warp as wp

from finssim.pool.plant_spec import Basin
from finssim.pool.water_spec import Circulation


@wp.struct
class Gyre:
    """The circulation, by mode."""

    count: int
    length: float  # [m]
    width: float  # [m]
    depth: float  # [m]
    floor_share: float
    stream: wp.vec3  # the same everywhere [m/s]
    cells: wp.array(dtype=float)
    speed: wp.array(dtype=float)  # signed by the sense of rotation [m/s]
    unsteadiness: wp.array(dtype=float)
    rate: wp.array(dtype=float)  # [rad/s]
    phase: wp.array(dtype=float)


@wp.func
def circulation_at(gyre: Gyre, position: wp.vec3, t: float) -> wp.vec3:
    """Velocity of the water, world frame [m/s].

    From the stream function psi = A sin(πX) sin(cπX) sin²(πY), with X and Y from wall to wall and c cells:
    (u, v) = (∂psi/∂y, -∂psi/∂x) is free of divergence, and both components vanish at all four walls. The speed along y
    is largest for c = 1 at A π / length, that along x at A π / width.

    Args:
        gyre: The circulation.
        position: World frame [m].
        t: Time [s].

    Returns:
        The stream, and horizontally what the eddies add to it within the walls.
    """
    X = position[0] / gyre.length + 0.5
    Y = position[1] / gyre.width + 0.5
    if X <= 0.0 or X >= 1.0 or Y <= 0.0 or Y >= 1.0:
        return gyre.stream
    sx = wp.sin(wp.pi * X)
    cx = wp.cos(wp.pi * X)
    sy = wp.sin(wp.pi * Y)
    cy = wp.cos(wp.pi * Y)
    height = wp.clamp(1.0 + position[2] / gyre.depth, 0.0, 1.0)
    share = gyre.floor_share + (1.0 - gyre.floor_share) * height
    u = float(0.0)
    v = float(0.0)
    for i in range(gyre.count):
        c = gyre.cells[i]
        sc = wp.sin(c * wp.pi * X)
        cc = wp.cos(c * wp.pi * X)
        now = gyre.speed[i] * (1.0 + gyre.unsteadiness[i] * wp.sin(gyre.rate[i] * t + gyre.phase[i]))
        # A is chosen so that the larger of the two components has the mode's speed.
        A = now * wp.min(gyre.width, gyre.length / c) / wp.pi
        u += A * sx * sc * (2.0 * wp.pi / gyre.width) * sy * cy
        v -= A * (wp.pi / gyre.length) * (cx * sc + c * sx * cc) * sy * sy
    return gyre.stream + share * wp.vec3(u, v, 0.0)


def gyre(circulation: Circulation, basin: Basin, device: Any = "cpu") -> Gyre:
    """The struct that kernels take."""
    out = Gyre()
    modes = circulation.eddies
    out.count = len(modes)
    out.length, out.width, out.depth = basin.length, basin.width, basin.depth
    out.floor_share, out.stream = circulation.floor_share, wp.vec3(*circulation.stream)
    columns = {
        "cells": [float(m.cells) for m in modes],
        "speed": [m.sense * m.speed for m in modes],
        "unsteadiness": [m.unsteadiness for m in modes],
        "rate": [2.0 * math.pi / m.period for m in modes],
        "phase": [m.phase for m in modes],
    }
    for name, values in columns.items():
        setattr(out, name, wp.array(values or [0.0], dtype=float, device=device))
    return out
