"""Closed forms of the terms of slender hulls: cross-flow drag, lift and drag, and the relief of C_A by the
wake."""

import numpy as np
import pytest

from finssim.core.registry import TERMS
from finssim.physics.terms.composed import parameter_row, term_wrenches
from finssim.sim import Simulator
from finssim.vehicles import load_vehicle
from reference.fossen import coriolis

RNG = np.random.default_rng(3)
NU = RNG.normal(size=(200, 6)) * [1.5, 0.5, 0.5, 1.0, 1.0, 1.0]
HULL = {"length": 1.7, "center": -0.2, "sway": 118.0, "heave": 90.0}
WING = {"drag": 6.1, "lift": 29.0, "induced": 21.0}


def wrenches(name, numbers, nu=NU):
    """Return the wrench of one term at velocities, (n, 6)."""
    term = TERMS[name]
    row = parameter_row((term,), {f"{name}.{k}" if k else name: x for k, x in numbers.items()})
    return term_wrenches((term,), [row], nu, [[0.0, 0.0, 1.0]] * len(nu), 5.0, 1000.0)[:, 0]


def test_cross_flow_drag_is_the_integral_over_strips():
    """Against 20,000 strips, with the flow from one side and from both along the hull, to 1e-5 of the largest."""
    x = HULL["center"] + HULL["length"] * ((np.arange(20000) + 0.5) / 20000 - 0.5)
    side, up = NU[:, 1:2] + x * NU[:, 5:6], NU[:, 2:3] - x * NU[:, 4:5]
    dx, expected = HULL["length"] / 20000, np.zeros_like(NU)
    assert ((side.min(axis=1) < 0) & (side.max(axis=1) > 0)).sum() > 50
    Y, Z = (-HULL[c] * s * np.abs(s) * dx for c, s in (("sway", side), ("heave", up)))
    expected[:, 1], expected[:, 5] = Y.sum(1), (x * Y).sum(1)
    expected[:, 2], expected[:, 4] = Z.sum(1), -(x * Z).sum(1)
    found = wrenches("cross_flow_drag", HULL)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * np.abs(expected).max())


def test_drag_is_against_the_flow_and_lift_across_it():
    """In surge and heave both follow the angle of attack, at all angles; in sway alone there is neither."""
    found = wrenches("lift_drag", WING)
    alpha, speed = np.arctan2(NU[:, 2], NU[:, 0]), np.linalg.norm(NU[:, :3], axis=1)
    flow = np.stack([np.cos(alpha), np.sin(alpha)], axis=1)
    q = speed * np.hypot(NU[:, 0], NU[:, 2])
    drag = -np.einsum("ni,ni->n", found[:, [0, 2]], flow) / q
    lift = (found[:, 0] * flow[:, 1] - found[:, 2] * flow[:, 0]) / q
    np.testing.assert_allclose(drag, WING["drag"] + WING["induced"] * np.sin(alpha) ** 2, rtol=1e-4)
    expected = WING["lift"] * np.sin(alpha) * np.abs(np.cos(alpha)) * np.sign(np.cos(alpha))
    np.testing.assert_allclose(lift, expected, rtol=0, atol=1e-4 * WING["lift"])
    assert not found[:, [1, 3, 4, 5]].any()
    small = wrenches("lift_drag", WING, np.array([[2.0, 0, 0.02, 0, 0, 0]]))[0]
    assert small[2] == pytest.approx(-4.0 * (WING["lift"] + WING["drag"]) * 0.01, rel=1e-3)


def test_relief_cancels_the_products_that_fossens_torpedo_leaves_out():
    """With it -C_A nu is that of a C_A with some entries set to 0, and its power is zero."""
    A = np.array([1.0, 30.0, 28.0])
    found = wrenches("munk_relief", {"": A})
    for nu, tau in zip(NU, found, strict=True):
        C = coriolis(np.diag([*A, 0.0, 0.0, 0.0]), nu)
        left = C.copy()
        for i, j in ((4, 0), (4, 2), (5, 0), (5, 1)):
            left[i, j] = left[j, i] = 0.0
        np.testing.assert_allclose(tau, (C - left) @ nu, atol=2e-5)
        assert abs(nu @ tau) < 2e-4
    straight = np.array([[2.0, 0.1, 0, 0, 0, 0]])
    assert wrenches("munk_relief", {"": A}, straight)[0, 5] == pytest.approx((30.0 - 1.0) * 2.0 * 0.1)


def hulled():
    base = "hydrodynamics.calibrated"
    return load_vehicle("bluerov2").replace(
        {f"{base}.cross_flow_drag": HULL, f"{base}.lift_drag": WING, f"{base}.munk_relief": [1.0, 30.0, 28.0]}
    )


@pytest.mark.slow
def test_blocks_of_worlds_compute_them_as_single_worlds_do(monkeypatch):
    """The three terms together, traced for eight worlds at once, to float32 rounding over 25 steps."""
    runs = []
    for lanes in (True, False):
        monkeypatch.setattr(Simulator, "in_lanes", property(lambda self, lanes=lanes: lanes))
        sim = Simulator(hulled(), worlds=11, threads=1, control_step=0.05)
        sim.place(position=(0.0, 0.0, -20.0), velocity=NU[:11, None])
        for _ in range(25):
            sim.step()
        runs.append(np.concatenate([sim.numpy("position"), sim.numpy("velocity")], axis=-1))
    np.testing.assert_allclose(runs[0], runs[1], rtol=0, atol=2e-5)
    assert np.abs(runs[0][:, 0, 3:] - NU[:11]).max() > 0.5
