"""Weight, buoyancy and the smooth free surface."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from finssim.physics.hydrostatics import hydrostatic_wrench, submerged_fraction, submersion_rate

coordinates = arrays(np.float32, 3, elements=st.floats(-0.5, 0.5, width=32))
attitudes = arrays(np.float64, 3, elements=st.floats(-1.0, 1.0)).filter(lambda a: np.linalg.norm(a) > 0.1)


@given(r_g=coordinates, r_b=coordinates, up=attitudes)
def test_the_wrench_is_that_of_two_vertical_forces(r_g, r_b, up):
    """-W k at r_g and +B k at r_b: forces add, moments are r × F."""
    k = (up / np.linalg.norm(up)).astype(np.float32).astype(float)
    found = [float(x) for x in hydrostatic_wrench(120.0, 130.0, wp.vec3(*r_g), wp.vec3(*r_b), wp.vec3(*k))]
    moment = np.cross(r_g.astype(float), -120.0 * k) + np.cross(r_b.astype(float), 130.0 * k)
    assert found == pytest.approx([*(10.0 * k), *moment], abs=1e-4)


def test_a_heeled_body_with_buoyancy_above_its_weight_comes_upright():
    """Rolled to starboard (+φ: port side up), the moment about x is negative."""
    up = wp.vec3(0.0, np.sin(0.1), np.cos(0.1))
    wrench = hydrostatic_wrench(100.0, 100.0, wp.vec3(0.0, 0.0, -0.05), wp.vec3(0.0, 0.0, 0.05), up)
    assert float(wrench[3]) == pytest.approx(-100.0 * 0.1 * np.sin(0.1), rel=1e-5)


@pytest.mark.parametrize(
    ("height", "fraction"), [(-1.0, 1.0), (-0.1, 1.0), (0.0, 0.5), (0.1, 0.0), (1.0, 0.0)]
)
def test_the_volume_emerges_over_its_height(height, fraction):
    """Half of it is wet when the centre of buoyancy lies in the surface."""
    assert float(submerged_fraction(height, 0.1)) == pytest.approx(fraction, abs=1e-6)


@given(height=st.floats(-0.2, 0.2), half_height=st.floats(0.01, 0.5))
def test_buoyancy_changes_smoothly_and_never_grows_upward(height, half_height):
    """-3/(4 H) <= ds/dz <= 0: the steepest slope of the cubic step is at the surface."""
    d = 0.01 * half_height
    slope = (
        float(submerged_fraction(height + d, half_height))
        - float(submerged_fraction(height - d, half_height))
    ) / (2 * d)
    assert -0.75 / half_height * 1.001 <= slope <= 1e-4 / half_height


@given(share=st.floats(-1.5, 1.5), half_height=st.floats(0.05, 0.5), climb=st.floats(-2.0, 2.0))
def test_the_rate_is_the_slope_of_the_fraction_times_the_climb(share, half_height, climb):
    """Chain rule, d(fraction)/dt = d(fraction)/dh · climb, by central differences over a hundredth of the height."""
    d = 0.01 * half_height
    ends = [float(submerged_fraction(share * half_height + s * d, half_height)) for s in (1.0, -1.0)]
    rate = float(submersion_rate(share * half_height, half_height, climb))
    # At the kinks of the slope, share = ±1, the difference is off by d times half the jump of the curvature, 1.5/H².
    assert rate == pytest.approx(
        (ends[0] - ends[1]) / (2 * d) * climb, abs=0.03 * abs(climb) / half_height + 1e-6
    )
