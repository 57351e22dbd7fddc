"""Coriolis and centripetal wrenches and the inverse of the mass matrix."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from finssim.physics.inertia import (
    coriolis_wrench,
    invert_spd,
    rigid_body_momentum,
    water_acceleration_wrench,
)
from finssim.physics.types import mat66, vec6
from reference.body import rigid_body_mass
from reference.cases import EVERY_VEHICLE_AND_MODEL, load

EPS = float(np.finfo(np.float32).eps)
vectors = arrays(np.float32, 6, elements=st.floats(-10.0, 10.0, width=32))


def wide(x):
    return np.array([float(a) for a in x])


@given(nu=vectors, momentum=vectors)
def test_coriolis_does_no_work(nu, momentum):
    """nu · C(nu) nu = 0 for any momentum: a turning frame neither gives nor takes power."""
    wrench = wide(coriolis_wrench(vec6(*momentum), vec6(*nu)))
    assert (
        abs(nu.astype(float) @ wrench) <= 20.0 * EPS * np.abs(nu).max() ** 2 * np.abs(momentum).max() + 1e-30
    )


def test_coriolis_of_a_point_mass_is_centrifugal():
    """A mass at r turning at ω needs m ω × (ω × r): 2 kg on 0.5 m at 3 rad/s pull 9 N outward."""
    momentum = rigid_body_momentum(
        2.0, wp.vec3(0.5, 0.0, 0.0), wp.mat33(0.0), vec6(0.0, 0.0, 0.0, 0.0, 0.0, 3.0)
    )
    wrench = wide(coriolis_wrench(momentum, vec6(0.0, 0.0, 0.0, 0.0, 0.0, 3.0)))
    assert wrench == pytest.approx([-9.0, 0.0, 0.0, 0.0, 0.0, 0.0], abs=1e-6)


@given(nu=vectors)
def test_rigid_body_momentum_is_the_mass_matrix_times_the_twist(nu):
    """M_RB nu with the 6x6 matrix built by transformation from the centre of gravity."""
    r_g, inertia_g = np.array([0.1, -0.2, 0.3]), np.diag([0.5, 0.7, 0.9])
    about_origin = inertia_g + 12.0 * (r_g @ r_g * np.eye(3) - np.outer(r_g, r_g))
    found = rigid_body_momentum(12.0, wp.vec3(*r_g), wp.mat33(*about_origin.ravel()), vec6(*nu))
    M = rigid_body_mass(12.0, r_g, inertia_g)
    assert wide(found) == pytest.approx(
        M @ nu.astype(float), abs=250.0 * EPS * float(np.abs(nu).max()) + 1e-30
    )


@EVERY_VEHICLE_AND_MODEL
def test_the_inverse_of_every_mass_matrix_is_exact_to_float32(name, model):
    """invert_spd(M) = M⁻¹, element by element, to the rounding of M itself."""
    M = load(name).mass_matrix(model).astype(np.float32)
    found = np.array([[float(x) for x in row] for row in invert_spd(mat66(*M.ravel().tolist()))])
    expected = np.linalg.inv(M.astype(float))
    assert found == pytest.approx(expected, rel=EPS, abs=EPS * np.abs(expected).max() * 1e-6)


@given(water=arrays(np.float32, 3, elements=st.floats(-2.0, 2.0, width=32)))
def test_accelerating_water_carries_a_neutral_body_along(water):
    """With m_w = m at one centre, the wrench M_A a_c + m_w a_c is what (M_RB + M_A) needs for the water's own a_c."""
    a_c = np.array([0.3, -0.2, 0.1])
    M_A = np.diag([5.0, 9.0, 14.0, 0.1, 0.2, 0.3])
    r = np.array([0.0, 0.02, -0.08])
    zero = wp.vec3(0.0, 0.0, 0.0)
    found = water_acceleration_wrench(
        mat66(*M_A.ravel().tolist()), wp.vec3(*r), wp.vec3(*water), wp.vec3(*a_c), wp.vec3(*a_c), zero, 12.0
    )
    M = rigid_body_mass(12.0, r, np.eye(3)) + M_A
    assert wide(found) == pytest.approx(M @ np.r_[a_c, 0.0, 0.0, 0.0], abs=1e-5)
