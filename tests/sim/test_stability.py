"""No catalogue vehicle diverges at steps of 25 ms, turning fast under water, through the surface or in the
air."""

import numpy as np
import pytest

from finssim.sim import RectangularPool, Simulator
from reference.body import rotation
from reference.cases import EVERY_VEHICLE_AND_MODEL, load, random_attitudes
from reference.motion import energy, numbers

WORLDS = 96


def fast_starts(vehicle, rng):
    """Return starts deep under water, at the surface and in the air, a third each; 3 m/s and 10 rad/s, any
    directions."""
    length = max(vehicle.body.size)
    position = np.zeros((WORLDS, 3), np.float32)
    position[:, 2] = np.repeat([-20.0 * length, -0.2 * length, 2.0 * length], WORLDS // 3)
    nu = rng.normal(size=(WORLDS, 2, 3))
    nu *= np.array([3.0, 10.0])[:, None] / np.linalg.norm(nu, axis=-1, keepdims=True)
    return position, random_attitudes(rng, WORLDS), nu.reshape(WORLDS, 6).astype(np.float32)


@pytest.mark.slow
@EVERY_VEHICLE_AND_MODEL
def test_nothing_runs_away_from_a_fast_turn(name, model):
    """From 3 m/s and 10 rad/s, 5 s in steps of 25 ms, all worlds run, with energy that weight and thrust can supply.

    In the undriven half of the worlds, errors never add as much energy as the greatest kinetic energy at the start:
    h |ω| is 1/4, and damping would slow the stiffest axis fifty times in a substep. In the others, driven at 70 %
    of the limits, speeds stay below 20 m/s plus the fall. A hull more than eight times as long as it is wide falls
    through the surface within 25 ms, and is rolled by it: it has steps half as long.
    """
    vehicle = load(name)
    slim = max(vehicle.body.size) > 8.0 * min(vehicle.body.size)
    rng = np.random.default_rng(0)
    lower, upper = vehicle.force_limits
    simulator = Simulator(
        vehicle, worlds=WORLDS, hydrodynamics=model, control_step=0.1, substeps=8 if slim else 4
    )
    simulator.place(*(x[:, None] for x in fast_starts(vehicle, rng)))
    given = numbers(vehicle, model)

    def parts():
        names = ("position", "quaternion", "velocity")
        return np.array(energy(given, model, *(simulator.numpy(x)[:, 0].astype(float) for x in names)))

    start = parts()
    fastest, growth = 0.0, 0.0
    for _ in range(50):
        thrust = 0.7 * rng.uniform(lower, upper, (WORLDS, 1, len(lower)))
        thrust[::2] = 0.0
        simulator.set_thrust(thrust)
        simulator.step()
        fastest = max(fastest, float(np.abs(simulator.numpy("velocity")).max()))
        growth = max(growth, float((parts() - start).sum(axis=0)[::2].max()))
    assert simulator.frozen_worlds().tolist() == []
    assert fastest < 20.0 + np.sqrt(3.0**2 + 2.0 * 9.81 * 2.0 * max(vehicle.body.size))
    assert growth < start[0].max()


def test_a_body_in_the_air_keeps_its_momentum():
    """Out of the water no added mass acts: the velocity falls by g t, and the angular momentum R I ω is constant.

    3 rad/s about any axis for 1 s in steps of 25 ms. In body axes both turn at |ω|, and the midpoint rule's angle
    error is 5/12 (h |ω|)² |ω| t.
    """
    vehicle, rate = load("finsrov"), 3.0
    rng = np.random.default_rng(1)
    q, omega = random_attitudes(rng, 50), rng.normal(size=(50, 3))
    omega *= rate / np.linalg.norm(omega, axis=1, keepdims=True)
    simulator = Simulator(vehicle, worlds=50, control_step=0.1, substeps=4)
    simulator.place((0.0, 0.0, 30.0), q[:, None], np.concatenate([np.zeros((50, 3)), omega], 1)[:, None])
    M, r_g = vehicle.rigid_body_mass_matrix(), np.array(vehicle.body.center_of_gravity)

    def about_gravity():
        R = rotation(simulator.numpy("quaternion")[:, 0].astype(float))
        nu = simulator.numpy("velocity")[:, 0].astype(float)
        momentum = nu @ M.T
        h = momentum[:, 3:] - np.cross(r_g, momentum[:, :3])
        v_g = nu[:, :3] + np.cross(nu[:, 3:], r_g)
        return np.einsum("nij,nj->ni", R, v_g), np.einsum("nij,nj->ni", R, h)

    v_0, h_0 = about_gravity()
    for _ in range(10):
        simulator.step()
    v_1, h_1 = about_gravity()
    angle = 5.0 / 12.0 * (0.025 * rate) ** 2 * rate
    assert np.abs(v_1 - v_0 - [0.0, 0.0, -9.81]).max() < angle * (9.81 + np.abs(v_0).max())
    assert np.abs(h_1 - h_0).max() < angle * np.linalg.norm(h_0, axis=1).max()


def test_a_vehicle_put_half_into_a_wall_comes_out():
    """Its energy is at most that of the springs that it lay in: four corners of 4000 N/m half a length deep.

    In the air it would leave with sqrt(2 E / m); the water reduces this.
    """
    vehicle = load("finsrov")
    pool, rng = RectangularPool(), np.random.default_rng(2)
    simulator = Simulator(vehicle, worlds=64, pool=pool)
    side = rng.choice([-1.0, 1.0], 64)
    position = np.stack([side * pool.length / 2, rng.uniform(-0.5, 0.5, 64), np.full(64, -0.5)], axis=1)
    simulator.place(position[:, None], random_attitudes(rng, 64)[:, None])
    reach = np.linalg.norm(vehicle.body.size) / 2.0
    fastest = np.sqrt(8 * pool.stiffness * reach**2 / vehicle.body.mass)
    for _ in range(30):
        simulator.step()
        assert np.linalg.norm(simulator.numpy("velocity")[:, 0, :3], axis=1).max() < fastest
    assert simulator.frozen_worlds().tolist() == []
    assert np.abs(simulator.numpy("position")[:, 0, 0]).max() < pool.length / 2
