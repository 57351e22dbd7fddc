"""The ray through a stack of layers: Fermat's principle, Snell's law, the slab, and the range of geometries."""

import numpy as np
import pytest
from scipy.optimize import minimize, minimize_scalar

from finssim.core.optics.rays import solve_stack

STACKS = {
    "air, water": [1.0003, 1.333],
    "water, air": [1.333, 1.0003],
    "air, glass, water": [1.0003, 1.49, 1.333],
    "water, gap of air, glass, water": [1.333, 1.0, 1.49, 1.333],
    "nearly equal": [1.333, 1.333 * (1 + 1e-9)],
    "far apart": [1.0, 4.0],
}
every_stack = pytest.mark.parametrize("index", STACKS.values(), ids=STACKS.keys())


def moves(r, thickness, index):
    """Return the sideways distances t_i tan(theta_i) of the solved ray, and n_i sin(theta_i), of every layer."""
    r2 = np.asarray(r, float) ** 2
    found = solve_stack(r2, thickness, index)
    u = found.g * np.sqrt(r2)
    sine = min(index) * u / np.sqrt(1.0 + u * u)  # the ray parameter n_i sin(theta_i)
    least = min(index)
    a2 = [(n / least) ** 2 for n in index]
    tangents = [u / np.sqrt(x + (x - 1.0) * u * u) for x in a2]
    return [t * tangent for t, tangent in zip(found.thickness, tangents, strict=True)], sine


@every_stack
def test_no_path_is_shorter(index):
    """By Fermat's principle, the solved ray has the least optical path of all broken lines between the two points."""
    rng = np.random.default_rng(3)
    for _ in range(5):
        thickness = list(rng.uniform(0.05, 2.0, len(index)))
        r = rng.uniform(0.1, 3.0)

        def path(inner, thickness=thickness, r=r):
            steps = np.diff(np.concatenate([[0.0], np.atleast_1d(inner), [r]]))
            return sum(n * np.hypot(t, x) for n, t, x in zip(index, thickness, steps, strict=True))

        ours = np.cumsum([float(x) for x in moves(r, thickness, index)[0]])
        assert ours[-1] == pytest.approx(r, abs=1e-13)
        if len(index) == 2:
            best = minimize_scalar(path, bounds=(0.0, r), method="bounded", options={"xatol": 1e-12})
            brute, least = np.array([best.x]), best.fun
        else:
            best = minimize(
                path, np.linspace(0, r, len(index) + 1)[1:-1], method="BFGS", options={"gtol": 1e-10}
            )
            brute, least = best.x, best.fun
        assert path(ours[:-1]) <= least + 1e-14
        # A minimum is flat: the root of the rounding error of the path.
        np.testing.assert_allclose(ours[:-1], brute, atol=3e-7)
        shifted = [path(ours[:-1] + d) - path(ours[:-1]) for d in (1e-4, -1e-4)]
        assert min(shifted) > 0.0


@every_stack
@pytest.mark.parametrize("near", [0.0, 1e-12, 1e-6, 0.01, 1.0, 30.0])
@pytest.mark.parametrize("far", [0.0, 1e-12, 1e-6, 0.01, 1.0, 30.0])
def test_finds_the_ray_from_anywhere(index, near, far):
    """From straight down to a thousand times wider than deep, and on either face, the sideways distances sum to r."""
    if near == far == 0.0:
        return  # both points lie in the plane, so there is nothing to cross
    r = np.concatenate([[0.0], np.logspace(-12, 3, 200)])
    thickness = [near, *[0.01] * (len(index) - 2), far]
    moved, _ = moves(r, thickness, index)
    np.testing.assert_allclose(sum(moved), r, rtol=1e-9, atol=1e-15)


def test_small_angles_give_the_apparent_depth():
    """To first order in the angle, water of depth d seen from above appears d n_air/n_water deep."""
    r = np.array([1e-3, 1e-4, 1e-5])
    found = solve_stack(r * r, [1.2, np.full(3, 0.8)], [1.0, 1.333])
    apparent = 1.0 / found.near_slope - 1.2
    np.testing.assert_allclose(apparent, 0.8 / 1.333, atol=r[0] ** 2)
    assert abs(apparent[2] - 0.8 / 1.333) < 1e-9


def test_a_slab_shifts_a_ray_parallel_to_itself():
    """For glass in air, the ray leaves at its angle a, shifted by t sin(a) (1 - cos(a)/sqrt(n² - sin²(a)))."""
    t, n, a = 0.05, 1.49, np.radians([1.0, 20.0, 45.0, 70.0, 85.0])
    inside = np.arcsin(np.sin(a) / n)
    r = 1.5 * np.tan(a) + t * np.tan(inside)  # 0.8 m before, 0.7 m behind the glass
    moved, sine = moves(r, [0.8, t, np.full(5, 0.7)], [1.0, n, 1.0])
    np.testing.assert_allclose(sine, np.sin(a), rtol=1e-12)
    np.testing.assert_allclose(moved[2] / 0.7, np.tan(a), rtol=1e-12)
    sideways = t * np.tan(a) - moved[1]  # relative to the ray without glass
    expected = t * np.sin(a) * (1 - np.cos(a) / np.sqrt(n**2 - np.sin(a) ** 2))
    np.testing.assert_allclose(sideways * np.cos(a), expected, rtol=1e-12)
