"""The published setpoints are the same positions and headings in our frames."""

from __future__ import annotations

import math

import numpy as np
import pytest

from finssim.evaluation.metrics import T1_PUBLISHED, T1_SETPOINTS, T1_START, from_published

EXCHANGE_Y_Z = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
"""Controller axes (x forward, y up, z left) from ours (x forward, y left, z up)."""


def test_every_setpoint_lies_under_water_inside_the_pool():
    """The pool is 4 m x 2 m, about 1 m deep; half a metre of depth is z = -0.5."""
    assert list(T1_SETPOINTS) == [f"P{i:02d}" for i in range(1, 9)]
    for x, y, z, yaw in T1_SETPOINTS.values():
        assert abs(x) == 1.0 and abs(y) == 0.3 and z in (-0.5, -0.8)
        assert -math.pi < yaw <= math.pi
    np.testing.assert_allclose(T1_SETPOINTS["P01"], [1.0, 0.3, -0.5, 0.0])
    np.testing.assert_allclose(T1_SETPOINTS["P03"], [-1.0, -0.3, -0.5, -math.pi / 2])
    np.testing.assert_allclose(T1_START, [0.0, 0.0, -0.5, 0.0])


@pytest.mark.parametrize("name", T1_PUBLISHED)
def test_heading_is_the_same_direction_in_both_frames(name):
    """A positive yaw about y of the left-handed frame turns x towards -z: forward is (cos, 0, -sin) there."""
    published = math.radians(T1_PUBLISHED[name][3])
    yaw = T1_SETPOINTS[name][3]
    forward = np.array([math.cos(yaw), math.sin(yaw), 0.0])
    np.testing.assert_allclose(
        EXCHANGE_Y_Z @ forward, [math.cos(published), 0.0, -math.sin(published)], atol=1e-12
    )


def test_a_right_turn_is_positive_there_and_negative_here():
    """Since omega_c = det(B) B omega, 90 deg to the left is +pi/2 about our z and -90 about the controller's y."""
    omega = np.array([0.0, 0.0, math.pi / 2])
    omega_c = np.linalg.det(EXCHANGE_Y_Z) * EXCHANGE_Y_Z @ omega
    np.testing.assert_allclose(from_published((0.0, 0.0, 0.0, math.degrees(omega_c[1])))[3], omega[2])
