"""Drag of a taut tether compared with the integral along it."""

import numpy as np
import pytest
import warp as wp
from scipy.integrate import quad_vec

from finssim.physics.tether import tether_wrench
from finssim.physics.types import vec6
from finssim.sim import SurroundingsError, TetherLine
from reference.body import rotation
from reference.cases import random_attitudes

LINE = TetherLine(
    anchor=(0.5, -0.3, 0.0),
    attachment=(-0.2, 0.0, 0.1),
    diameter=0.0076,
    drag_coefficient=1.2,
    wet_weight=0.3,
)
RHO = 1000.0


def wide(x):
    return np.array([float(a) for a in x])


def test_the_vehicle_carries_its_share_of_the_integral():
    """In random states F at the attachment, from moments about the anchor, is the integral of drag and weight.

    F = -∫ ½ ρ C d |v_n s| v_n s · s L ds - ½ w L k.
    """
    rng = np.random.default_rng(8)
    for q in random_attitudes(rng, 40):
        position, nu = rng.uniform([-3, -3, -5], [3, 3, -1]), rng.normal(size=6)
        water = np.array([0.3, 0.1, 0.0])
        state = wp.vec3(*position), wp.quat(*q), vec6(*nu)
        found = wide(tether_wrench(LINE.struct(), RHO, *state, wp.vec3(*water)))
        R = rotation(q)
        r = np.array(LINE.attachment)
        along = position + R @ r - np.array(LINE.anchor)
        L = np.linalg.norm(along)
        v = R @ (nu[:3] + np.cross(nu[3:], r)) - water
        v_n = v - (v @ along) / L**2 * along

        def drag(s, v_n=v_n, L=L):
            v_s = s * v_n
            return -0.5 * RHO * LINE.drag_coefficient * LINE.diameter * np.linalg.norm(v_s) * v_s * s * L

        force = R.T @ (quad_vec(drag, 0.0, 1.0)[0] - [0.0, 0.0, 0.5 * LINE.wet_weight * L])
        assert found == pytest.approx(np.r_[force, np.cross(r, force)], rel=1e-4, abs=1e-5)


def test_motion_along_a_tether_is_not_hindered():
    """For v parallel to the line there is no cross-flow and no drag."""
    line, below, still = TetherLine().struct(), wp.vec3(0.0, 0.0, -4.0), wp.vec3(0.0, 0.0, 0.0)
    rising = vec6(0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    found = tether_wrench(line, RHO, below, wp.quat(0.0, 0.0, 0.0, 1.0), rising, still)
    assert wide(found).tolist() == [0.0] * 6


def test_tethers_that_cannot_be_are_refused():
    """A tether without thickness and a drag that adds energy are refused."""
    with pytest.raises(SurroundingsError, match="tether: diameter is 0.0, expected more than 0 m"):
        TetherLine(diameter=0.0)
    with pytest.raises(SurroundingsError, match="tether: drag_coefficient must not be negative"):
        TetherLine(drag_coefficient=-1.0)
