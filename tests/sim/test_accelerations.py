"""Accelerations of the engine against an independent float64 reference and against another rigid-body engine.

A step of 0.1 ns hardly leaves the state it starts from: what it changes is below the rounding of the sum.
"""

import dartpy as dart
import numpy as np
import pytest

from finssim.physics.types import vec8
from finssim.sim import Simulator, Water, Wave
from reference.cases import EVERY_VEHICLE_AND_MODEL, disturb, load, plain, random_states, weightless
from reference.motion import acceleration, coriolis_size, numbers


def moving_water(size):
    """Return a sheared current and two waves in water a few vehicle lengths deep."""
    return Water(
        current=(0.3, -0.2, 0.05),
        shear=(0.05, 0.1, 0.0),
        waves=(
            Wave(amplitude=0.1 * size, wavelength=4.0 * size, heading=0.4, phase=1.0),
            Wave(amplitude=0.08 * size, wavelength=2.0 * size, heading=-2.0, phase=-0.3),
        ),
        depth=6.5 * size,
    )


ANGULAR_FIRST = np.r_[3:6, 0:3]
EPS = float(np.finfo(np.float32).eps)


def accelerations(vehicle, model, states, tau, thrust, water):
    """Return nu_dot (n, 6) of the engine and the thrust that each thruster then delivers (n, thrusters)."""
    position, q, nu = (x[:, None] for x in states)
    simulator = Simulator(
        vehicle.replace({"thrusters.*.delay": 0.0}),
        worlds=len(nu),
        hydrodynamics=model,
        control_step=1e-10,
        substeps=1,
        water=water,
    )
    simulator.plant.time_constant.fill_(vec8(*[1e-20] * 8))  # motors that follow at once
    simulator.plant.slew.fill_(vec8(*[np.inf] * 8))
    simulator.refresh()
    simulator.place(position, q, nu)
    disturb(simulator, tau[:, None])
    simulator.set_thrust(thrust[:, None])
    simulator.step()
    return simulator.numpy("acceleration")[:, 0].astype(float), simulator.numpy("thrust")[
        :, 0, : thrust.shape[1]
    ]


@pytest.mark.slow
@pytest.mark.parametrize("moving", [False, True], ids=["still", "moving"])
@EVERY_VEHICLE_AND_MODEL
def test_accelerations_agree_with_the_reference(name, model, moving):
    """nu_dot equals the reference's in random states, a quarter of them at the surface, to float32 rounding.

    10⁴ states of FinsROV, 10³ of its mesh and of other vehicles, 300 of their meshes. The unit is eps times the
    magnitudes of what is summed, through |M⁻¹| |M| |M⁻¹|: a dozen roundings of a matrix product, a few more where faces
    are cut.
    """
    vehicle = plain(load(name))
    few, many = (1_000, 10_000) if name == "finsrov" else (300, 1_000)
    n = few if model == "mesh" else many
    rng = np.random.default_rng(5)
    length = max(vehicle.body.size)
    water = moving_water(length) if moving else None
    states = random_states(rng, n, depth=(-6.0 * length, 0.0))
    states[0][: n // 4, 2] = rng.uniform(-length, length, n // 4)
    tau = (rng.normal(size=(n, 6)) * np.diag(vehicle.mass_matrix(model))).astype(np.float32)
    lower, upper = vehicle.force_limits
    thrust = rng.uniform(lower, upper, (n, len(lower)))
    found, delivered = accelerations(vehicle, model, states, tau, thrust, water)

    pushed = delivered @ vehicle.thruster_matrix().T
    wide = [x.astype(float) for x in (*states, tau)]
    parts = [slice(i, i + 500) for i in range(0, n, 500)]  # a mesh takes memory for every face of every state
    given = numbers(vehicle, model)
    results = [
        acceleration(given, model, *(x[part] for x in wide), water, thrust=pushed[part]) for part in parts
    ]
    expected, size = (np.concatenate(x) for x in zip(*results, strict=True))
    error = (np.abs(found - expected) / (EPS * size)).max()
    assert error < (60.0 if model == "mesh" else 20.0), f"largest error {error:.3g} roundings of the sum"


def dart_body(M):
    """Return a free body in DART whose 6x6 spatial inertia is M; DART puts the angular part first."""
    skeleton = dart.dynamics.Skeleton()
    _, body = skeleton.createFreeJointAndBodyNodePair()
    body.setInertia(dart.dynamics.Inertia(M[np.ix_(ANGULAR_FIRST, ANGULAR_FIRST)]))
    skeleton.setGravity(np.zeros(3))
    return skeleton, body


@EVERY_VEHICLE_AND_MODEL
def test_accelerations_agree_with_dart(name, model):
    """M⁻¹ (tau - C(nu) nu) with the full 6x6 inertia equals DART's forward dynamics within 1e-5 of what is summed.

    DART knows no water: buoyancy equals weight at one point and there is no damping, so that only inertia is left.
    """
    vehicle = plain(load(name))
    n = 200
    rng = np.random.default_rng(6)
    position, q, nu = random_states(rng, n, depth=(-50.0, -40.0))
    q[:] = [0.0, 0.0, 0.0, 1.0]
    M = vehicle.rigid_body_mass_matrix() if model == "simplified" else vehicle.mass_matrix(model)
    tau = (rng.normal(size=(n, 6)) * np.diag(M)).astype(np.float32)
    thrust = np.zeros((n, len(vehicle.thrusters)))
    found, _ = accelerations(weightless(vehicle, model), model, (position, q, nu), tau, thrust, None)

    skeleton, body = dart_body(M)
    expected = np.empty((n, 6))
    for i in range(n):
        skeleton.setVelocities(nu[i, ANGULAR_FIRST].astype(float))
        skeleton.setForces(tau[i, ANGULAR_FIRST].astype(float))
        skeleton.computeForwardDynamics()
        expected[i] = body.getSpatialAcceleration()[ANGULAR_FIRST]
    size = (np.abs(tau) + coriolis_size(M, nu)) @ np.abs(np.linalg.inv(M)).T
    error = (np.abs(found - expected) / size).max()
    assert error < 1e-5
