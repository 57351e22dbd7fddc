"""Damping dissipates power, whatever the reference point of its coefficients."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from finssim.physics.damping import damping_wrench, twist_at, wrench_from
from finssim.physics.terms.surge_damping import surge_coupled_wrench
from finssim.physics.types import mat66, vec6
from reference.body import transformation
from reference.cases import PAIRS, load

vectors = arrays(np.float32, 6, elements=st.floats(-4.0, 4.0, width=32))
COEFFICIENTS = [(name, model) for name, model in PAIRS if model != "mesh"]
EPS = float(np.finfo(np.float32).eps)


def wide(x):
    return np.array([float(a) for a in x])


def matrices(name, model):
    chosen = load(name).hydrodynamics[model]
    return [
        mat66(*np.asarray(x, np.float32).ravel().tolist())
        for x in (chosen.linear_damping, chosen.quadratic_damping, chosen.surge_damping)
    ]


def total_damping(nu_r, D1, D2, Du):
    """Return the damping wrench of eq. 2 of the paper."""
    return damping_wrench(nu_r, D1, D2) + surge_coupled_wrench(nu_r, Du)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "model"), COEFFICIENTS, ids=[f"{n}-{m}" for n, m in COEFFICIENTS])
@settings(max_examples=50)
@given(nu_r=vectors)
def test_damping_never_adds_energy(name, model, nu_r):
    """nu_r · tau_D <= 0 for every velocity relative to the water."""
    assert nu_r.astype(float) @ wide(total_damping(vec6(*nu_r), *matrices(name, model))) <= 0.0


def test_linear_quadratic_and_surge_coupled_parts():
    """-(d1 + d2 |w| + du |u|) w with d1 = 2, d2 = 3, du = 5, u = -0.5, w = -2: 2·2 + 3·4 + 5·0.5·2 = 21 N up."""
    parts = [mat66(*np.diag([0.0, 0.0, d, 0.0, 0.0, 0.0]).ravel().tolist()) for d in (2.0, 3.0, 5.0)]
    assert float(total_damping(vec6(-0.5, 0.0, -2.0, 0.0, 0.0, 0.0), *parts)[2]) == pytest.approx(21.0)


@given(nu=vectors, wrench=vectors, r=arrays(np.float32, 3, elements=st.floats(-1.0, 1.0, width=32)))
def test_power_is_the_same_at_every_point(nu, wrench, r):
    """(H nu) · tau = nu · (Hᵀ tau): the change of point is that of the textbook and loses no power."""
    H = transformation(r)
    at_r, at_origin = wide(twist_at(vec6(*nu), wp.vec3(*r))), wide(wrench_from(vec6(*wrench), wp.vec3(*r)))
    assert at_r == pytest.approx(H @ nu, abs=40.0 * EPS)
    assert at_origin == pytest.approx(H.T @ wrench, abs=40.0 * EPS)
