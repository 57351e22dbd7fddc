"""The pool's circulation satisfies the conditions of water in a box."""

import numpy as np
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from finssim.pool.plant import CirculationData, circulation_at, circulation_data
from finssim.pool.plant_spec import Basin, Circulation, Eddy

EDDIES = (
    Eddy(cells=1, speed=0.03, unsteadiness=0.3, period=60.0, phase=0.4),
    Eddy(cells=2, speed=0.02, unsteadiness=0.2, period=90.0, phase=2.0, sense=-1),
)
CIRCULATION = circulation_data(Circulation(eddies=EDDIES, floor_share=0.5), Basin())


@wp.kernel(enable_backward=False)
def evaluate(water: CirculationData, place: wp.array(dtype=wp.vec3), t: float, out: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    out[i] = circulation_at(water, place[i], t)


def at(places, t=0.0, water=CIRCULATION):
    """Return velocities at some points, (k, 3)."""
    place = wp.array(np.asarray(places, dtype=np.float32).reshape(-1, 3), dtype=wp.vec3, device="cpu")
    out = wp.zeros_like(place)
    wp.launch(evaluate, dim=len(place), inputs=[water, place, t, out], device="cpu")
    return out.numpy()


@settings(max_examples=50)
@given(s=st.floats(-1.0, 1.0), t=st.floats(0.0, 1000.0))
def test_it_stands_still_at_all_four_walls(s, t):
    """Both components are zero: water neither crosses a wall nor slides along it."""
    walls = [(2.0, s, -0.2), (-2.0, s, -0.2), (2.0 * s, 1.0, -0.2), (2.0 * s, -1.0, -0.2)]
    assert np.abs(at(walls, t)).max() < 1e-6


@settings(max_examples=50)
@given(x=st.floats(-1.8, 1.8), y=st.floats(-0.8, 0.8), t=st.floats(0.0, 1000.0))
def test_no_water_appears_or_vanishes(x, y, t):
    """The horizontal divergence is zero everywhere, by central differences in single precision."""
    h = 0.01
    v = at([(x + h, y, -0.2), (x - h, y, -0.2), (x, y + h, -0.2), (x, y - h, -0.2)], t)
    assert abs(v[0, 0] - v[1, 0] + v[2, 1] - v[3, 1]) / (2.0 * h) < 2e-4


def test_the_largest_speed_is_the_one_that_is_asked_for():
    """One cell of 0.05 m/s at the surface reaches this speed somewhere and never exceeds it; sense 1 is
    anticlockwise."""
    alone = Eddy(cells=1, speed=0.05, unsteadiness=0.0, period=1.0, phase=0.0)
    water = circulation_data(Circulation(eddies=(alone,)), Basin())
    grid = [(x, y, 0.0) for x in np.linspace(-2, 2, 41) for y in np.linspace(-1, 1, 41)]
    assert 0.049 < np.abs(at(grid, water=water)).max() < 0.05001
    right, top = at([(1.0, 0.0, 0.0), (0.0, 0.5, 0.0)], water=water)
    assert right[1] > 0.0 and top[0] < 0.0


def test_it_is_slower_at_the_floor_and_changes_with_time():
    """At a floor share of 0.5 the speed at the floor is half of that at the surface."""
    floor, surface = at([(0.7, 0.4, -1.0), (0.7, 0.4, 0.0)])
    np.testing.assert_allclose(floor, 0.5 * surface, rtol=1e-5)
    assert np.abs(at([(0.7, 0.4, 0.0)], 30.0) - surface).max() > 1e-3
