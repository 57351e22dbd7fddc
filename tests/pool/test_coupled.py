"""Matrices that couple all axes remain physical."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from finssim.pool.plant_spec import CoupledMatrix, PrincipalAxes

small = st.floats(-0.3, 0.3)
positive = st.floats(0.01, 100.0)


@given(
    diagonal=st.tuples(*[positive] * 6),
    center=st.tuples(small, small, small),
    tilt=st.tuples(*[st.floats(-45.0, 45.0)] * 3),
)
def test_any_coupled_matrix_is_symmetric_and_positive(diagonal, center, tilt):
    M = CoupledMatrix(diagonal=diagonal, center=center, tilt_deg=tilt).matrix()
    np.testing.assert_allclose(M, M.T, atol=1e-9 * np.abs(M).max())
    assert np.linalg.eigvalsh(M)[0] > -1e-9 * np.abs(M).max()


def test_a_matrix_about_the_origin_in_body_axes_is_its_diagonal():
    M = CoupledMatrix(diagonal=(1, 2, 3, 4, 5, 6), center=(0, 0, 0), tilt_deg=(0, 0, 0)).matrix()
    np.testing.assert_allclose(M, np.diag([1, 2, 3, 4, 5, 6]), atol=1e-12)


def test_axes_shift_and_turn_a_twist():
    """A pure yaw rate moves a point ahead of the origin sideways; in axes turned by 90° this is surge."""
    yaw = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 2.0])
    ahead = PrincipalAxes(center=(0.5, 0.0, 0.0), tilt_deg=(0.0, 0.0, 0.0)).to_axes() @ yaw
    np.testing.assert_allclose(ahead, [0.0, 1.0, 0.0, 0.0, 0.0, 2.0], atol=1e-12)
    turned = PrincipalAxes(center=(0.5, 0.0, 0.0), tilt_deg=(0.0, 0.0, 90.0)).to_axes() @ yaw
    np.testing.assert_allclose(turned, [1.0, 0.0, 0.0, 0.0, 0.0, 2.0], atol=1e-12)
