"""Walls, floor and tether in the engine."""

import numpy as np
import pytest

from finssim.sim import RectangularPool, Simulator, TetherLine
from reference.body import rotation
from reference.cases import ONE_VEHICLE_PER_MODEL, disturb, load, random_attitudes
from reference.motion import energy, numbers

POOL = RectangularPool(length=4.0, width=2.0, depth=1.0)


def sinking(name, model, net=0.05):
    """Return a vehicle 5 % heavier than its buoyancy."""
    vehicle = load(name)
    return vehicle.replace({"body.displaced_volume": (1.0 - net) * vehicle.body.mass / vehicle.water.density})


def corners(vehicle, position, q):
    """Return world heights and positions of the eight corners (..., 8, 3) of the envelope."""
    signs = np.array(np.meshgrid([1, -1], [1, -1], [1, -1])).T.reshape(-1, 3)
    return position[..., None, :] + np.einsum("...ij,cj->...ci", rotation(q), signs * 0.5 * vehicle.body.size)


@pytest.mark.slow
@ONE_VEHICLE_PER_MODEL
@pytest.mark.parametrize("integrator", ["midpoint", "rk4"])
def test_a_sinking_vehicle_comes_to_rest_on_the_floor(model, integrator):
    """From any attitude its energy, springs included, never grows, and the floor finally carries its net weight.

    The tolerance is 2 mm of its net weight: the floor's forces switch on and off within a step.
    """
    vehicle = sinking("finsrov", model)
    n = 40
    simulator = Simulator(
        vehicle, worlds=n, hydrodynamics=model, pool=POOL, integrator=integrator, substeps=20
    )
    q = random_attitudes(np.random.default_rng(1), n)
    simulator.place((0.0, 0.0, -0.5), q[:, None], (0.0, 0.0, 0.0, 0.3, 0.2, 0.1))
    given, total, largest = numbers(vehicle, model), [], 0.0
    for _ in range(150):
        simulator.step()
        x, a, nu = (simulator.numpy(f)[:, 0].astype(float) for f in ("position", "quaternion", "velocity"))
        depth = np.maximum(-1.0 - corners(vehicle, x, a)[..., 2], 0.0)
        total.append(sum(energy(given, model, x, a, nu)) + 0.5 * POOL.stiffness * (depth**2).sum(axis=1))
        largest = max(largest, depth.max())
    total = np.array(total)
    weight = 0.05 * vehicle.weight
    assert (np.diff(total, axis=0) <= 2e-3 * weight).all(), np.diff(total, axis=0).max() / weight
    assert np.abs(nu).max() < 0.01
    assert largest < 0.02
    assert POOL.stiffness * depth.sum(axis=1) == pytest.approx(np.full(n, weight), rel=0.1)


@pytest.mark.parametrize("way", [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, -1)])
def test_walls_hold_against_full_thrust(way):
    """Pushed with 20 N into each wall and the floor for 20 s, corners penetrate by less than force/stiffness."""
    vehicle = load("finsrov")
    simulator = Simulator(vehicle, worlds=1, pool=POOL)
    simulator.place((0.0, 0.0, -0.5))
    for _ in range(200):
        # The push stays along the wall's normal, at the centre of gravity, in any attitude.
        R = rotation(simulator.numpy("quaternion")[0, 0])
        force = 20.0 * R.T @ np.array(way, float)
        disturb(simulator, np.r_[force, np.cross(vehicle.body.center_of_gravity, force)])
        simulator.step()
    at = corners(vehicle, simulator.numpy("position")[0, 0], simulator.numpy("quaternion")[0, 0])
    limit = {0: 2.0, 1: 1.0, 2: 1.0}[int(np.flatnonzero(way)[0])]
    reach = (at @ np.array(way)).max()
    assert limit < reach < limit + 20.0 / POOL.stiffness
    assert np.abs(simulator.numpy("velocity")).max() < 0.02


@ONE_VEHICLE_PER_MODEL
def test_a_vehicle_stays_in_the_pool_at_full_random_thrust(model):
    """In a minute of full thrust, redrawn each second, no corner penetrates farther than the fastest hit can.

    This is ½ (m + m_a) v² = ½ k x², plus the depth at which the thrusters hold it.
    """
    vehicle = load("finsrov")
    simulator = Simulator(vehicle, worlds=20, hydrodynamics=model, pool=POOL)
    simulator.place((0.0, 0.0, -0.5))
    rng, (lower, upper) = np.random.default_rng(2), vehicle.force_limits
    furthest = fastest = 0.0
    for k in range(600):
        if k % 10 == 0:
            simulator.set_thrust(rng.uniform(lower, upper, (20, 1, 8)))
        simulator.step()
        at = corners(vehicle, simulator.numpy("position"), simulator.numpy("quaternion"))
        furthest = max(furthest, (np.abs(at[..., :2]) - [2.0, 1.0]).max(), (-1.0 - at[..., 2]).max())
        fastest = max(fastest, np.linalg.norm(simulator.numpy("velocity")[..., :3], axis=-1).max())
    assert simulator.frozen_worlds().tolist() == []
    heaviest = np.diag(vehicle.mass_matrix(model))[:3].max()
    assert 0.0 < furthest < fastest * np.sqrt(heaviest / POOL.stiffness) + upper.sum() / POOL.stiffness


def test_tether_drag_enters_the_equation_of_motion():
    """M Δnu_dot is the tether's wrench: with and without it, from the same state, in a step of 0.1 ns."""
    vehicle = load("finsrov")
    vehicle = vehicle.replace({"thrusters.*.delay": 0.0})  # a delay line of 0.1 ns steps would be too long
    line = TetherLine(anchor=(0.0, 0.0, 0.0), attachment=(-0.2, 0.0, 0.1), wet_weight=0.2)
    nu = np.array([0.3, 0.5, -0.2, 0.1, 0.0, 0.2])
    found = []
    for tether in (None, line):
        simulator = Simulator(vehicle, tether=tether, control_step=1e-10, substeps=1)
        simulator.place((3.0, 0.0, -4.0), velocity=nu)
        simulator.step()
        found.append(simulator.numpy("acceleration")[0, 0].astype(float))
    r = np.array(line.attachment)
    along = np.array([3.0, 0.0, -4.0]) + r
    length = np.linalg.norm(along)
    v = nu[:3] + np.cross(nu[3:], r)
    v_n = v - (v @ along) / length**2 * along
    drag = (
        -vehicle.water.density
        * line.drag_coefficient
        * line.diameter
        * length
        / 8
        * np.linalg.norm(v_n)
        * v_n
    )
    force = drag - [0.0, 0.0, 0.5 * line.wet_weight * length]
    assert vehicle.mass_matrix() @ (found[1] - found[0]) == pytest.approx(
        np.r_[force, np.cross(r, force)], abs=1e-4
    )
