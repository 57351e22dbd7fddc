"""Laws that are valid for all parameters: energy, momentum, invariance, symmetry, rest."""

import numpy as np
import pytest

from finssim.sim import Simulator, Water, Wave
from reference.body import rotation
from reference.cases import (
    EVERY_VEHICLE_AND_MODEL,
    ONE_VEHICLE_PER_MODEL,
    PAIRS,
    for_each,
    load,
    neutral,
    random_attitudes,
    random_states,
    undamped,
    weightless,
)
from reference.motion import energy, numbers
from reference.water import flow

RELATIVE = [x for x in PAIRS if x[1] != "simplified"]
"""Models in which the water's motion acts."""
EPS = float(np.finfo(np.float32).eps)


def history(simulator, steps):
    """Return positions, attitudes and twists before the first and after each control step, float64 (steps +
    1, worlds, n)."""
    rows = []
    for k in range(steps + 1):
        if k:
            simulator.step()
        fields = ("position", "quaternion", "velocity")
        rows.append([simulator.numpy(name)[:, 0].astype(float) for name in fields])
    return [np.array(x) for x in zip(*rows, strict=True)]


def exactly(name):
    """Return integrator and substeps of a nearly exact motion: RK4, or the midpoint rule with ten times as many.

    These three have a compiled RK4 kernel for other tests; ECA A9 and REMUS 100 have fins too.
    """
    if name in ("lauv", "slocum", "torpedo"):
        return {"integrator": "midpoint", "substeps": 40}
    return {"integrator": "rk4", "substeps": 4}


def period(vehicle):
    """Return the time in which a vehicle moves about a tenth of its length [s], for steps that suit all
    sizes."""
    return 0.04 * float(np.sqrt(max(vehicle.body.size)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "model", "integrator"),
    [(*pair, "midpoint") for pair in PAIRS]
    + [(*pair, "rk4") for pair in PAIRS if pair[0] in ("finsrov", "remus100")],
)
def test_energy_never_grows_without_thrust(name, model, integrator):
    """T + V falls in every control step in still water, submerged and at the surface, from 40 random states.

    RK4 meets this to the rounding of T, V and the substeps' increments; the midpoint rule to its own error, h² aᵀ M a
    per step.
    """
    vehicle = load(name)
    given = numbers(vehicle, model)
    worlds, substeps, steps = 40, 10, 40
    length = max(vehicle.body.size)
    states = random_states(np.random.default_rng(1), worlds, depth=(-2.0 * length, 0.0), speed=0.5, turn=0.5)
    # At the surface, RexROV's hull and its file's centre of buoyancy are 15 mm apart and have no common potential.
    states[0][: worlds // 2, 2] = -10.0 * length if (name, model) == ("rexrov", "mesh") else 0.0
    simulator = Simulator(
        vehicle,
        worlds=worlds,
        hydrodynamics=model,
        integrator=integrator,
        control_step=period(vehicle),
        substeps=substeps,
    )
    simulator.place(*(x[:, None] for x in states))
    position, q, nu = history(simulator, steps)
    parts = np.array([energy(given, model, *x) for x in zip(position, q, nu, strict=True)])
    growth = np.diff(parts.sum(axis=1), axis=0)
    tolerance = 4.0 * EPS * substeps * np.abs(parts).sum(axis=1)[1:]
    if integrator == "midpoint":
        h = simulator.control_step / substeps
        a = np.diff(nu, axis=0) / simulator.control_step
        M = given.M_RB + given.M_A
        strongest = np.einsum("kni,ij,knj->kn", a, M, a).max(axis=0)
        tolerance = tolerance + substeps * h**2 * strongest
    assert (growth <= tolerance).all(), (
        f"grows {np.max(growth / tolerance):.3g} times more than the tolerance"
    )


@EVERY_VEHICLE_AND_MODEL
def test_momentum_of_body_and_added_mass_is_conserved(name, model):
    """R p and x × R p + R h are constant for a neutral undamped body in still water, [p; h] = (M_RB + M_A) nu.

    RK4, 200 steps; tolerance for rounding of the state per step, and of weight less buoyancy at one ten-thousandth of
    gravity.
    """
    vehicle = weightless(load(name).replace({"water.gravity": 1e-3}), model)
    M = numbers(vehicle, model).M_RB + numbers(vehicle, model).M_A
    states = random_states(np.random.default_rng(2), 20, depth=(-40.0, -30.0), speed=0.5, turn=0.5)
    states[0][:, 2] = -12.0
    simulator = Simulator(
        vehicle,
        worlds=20,
        hydrodynamics=model,
        integrator="rk4",
        control_step=period(vehicle),
        substeps=4,
    )
    simulator.place(*(x[:, None] for x in states))
    position, q, nu = history(simulator, 50)
    momentum = nu @ M.T
    R = rotation(q)
    p = (R @ momentum[..., :3, None])[..., 0]
    angular = np.cross(position, p) + (R @ momentum[..., 3:, None])[..., 0]
    size = np.abs(nu).max(axis=(0, 2)) * np.abs(M[:3]).max()
    assert (np.abs(p - p[0]).max(axis=(0, 2)) < 100 * EPS * size).all()
    reach = np.abs(position).max() + max(vehicle.body.size)
    assert (np.abs(angular - angular[0]).max(axis=(0, 2)) < 100 * EPS * size * reach).all()


CURRENT = np.array([0.3, -0.2, 0.1])


def with_and_without_current(name, model, carried):
    """Run the same 20 random starts in still water and in a steady current, moving with it if `carried`."""
    vehicle = load(name)
    position, q, nu = random_states(np.random.default_rng(3), 20, depth=(-40.0, -30.0), speed=0.3, turn=0.3)
    runs = []
    for water in (None, Water(current=tuple(CURRENT))):
        start = nu.copy()
        if water is not None and carried:
            start[:, :3] += CURRENT @ rotation(q)
        simulator = Simulator(
            vehicle,
            worlds=20,
            hydrodynamics=model,
            control_step=period(vehicle),
            water=water,
            water_moves=True,
            **exactly(name),
        )
        simulator.place(position[:, None], q[:, None], start[:, None])
        runs.append(history(simulator, 30))
    return runs, 30 * period(vehicle), max(vehicle.body.size)


@pytest.mark.slow
@for_each(RELATIVE)
def test_a_steady_current_is_a_change_of_frame(name, model):
    """In water that moves with U, motion is as in still water, displaced by U t (Galilean invariance)."""
    (still, moving), duration, length = with_and_without_current(name, model, carried=True)
    t = np.linspace(0.0, duration, len(still[0]))[:, None, None]
    assert moving[0] - t * CURRENT == pytest.approx(still[0], abs=1e-4 * length + 40.0 * 60 * EPS)
    assert rotation(moving[1]) == pytest.approx(rotation(still[1]), abs=1e-4)
    relative = moving[2].copy()
    relative[..., :3] -= np.einsum("i,knij->knj", CURRENT, rotation(moving[1]))
    assert relative == pytest.approx(still[2], abs=1e-4)


@for_each([x for x in PAIRS if x[1] == "simplified"])
def test_the_simplified_model_knows_no_current(name, model):
    """By definition (paper, eq. 5) its damping depends on nu: runs with and without the current are the same."""
    (still, moving), _, _ = with_and_without_current(name, model, carried=False)
    for a, b in zip(still, moving, strict=True):
        assert a == pytest.approx(b, abs=1e-5)


@for_each(RELATIVE)
def test_a_neutral_body_moves_with_accelerating_water(name, model):
    """At rest in drifting water, with r_b = r_g, it keeps the water's velocity in any attitude."""
    vehicle = neutral(load(name).replace({"water.gravity": 1e-3}))
    simulator = Simulator(
        vehicle,
        worlds=20,
        hydrodynamics=model,
        control_step=0.1,
        substeps=4,
        integrator="rk4",
        water=Water(drift_std=(0.2, 0.1, 0.05), drift_time=1.0),
    )
    q = random_attitudes(np.random.default_rng(5), 20)
    simulator.place(position=(0.0, 0.0, -20.0), quaternion=q[:, None])

    def drift():
        return simulator.water.drift.numpy() + 0.1 * simulator.water.drift_rate.numpy()

    simulator.step()  # the drift has its own initial value: start with it
    nu = np.zeros((20, 1, 6), np.float32)
    nu[:, 0, :3] = (np.swapaxes(rotation(simulator.numpy("quaternion")[:, 0]), -1, -2) @ drift()[..., None])[
        ..., 0
    ]
    simulator.state.velocity.assign(nu)
    for _ in range(50):
        simulator.step()
    water = drift()
    velocity = (rotation(simulator.numpy("quaternion")[:, 0]) @ simulator.numpy("velocity")[:, 0, :3, None])[
        ..., 0
    ]
    assert np.abs(water).max() > 0.1
    assert velocity == pytest.approx(water, abs=2e-5)
    assert simulator.numpy("velocity")[:, 0, 3:] == pytest.approx(0.0, abs=2e-5)


@pytest.mark.parametrize("climb", [0.3, -0.2])
def test_a_body_that_crosses_a_shear_feels_the_water_change(climb):
    """Rising at w through dU/dz = S with the water's speed gives (m + A) u_dot = A w S, initially without drag.

    At 0.5 /s and 0.3 m/s FinsROV's A/(m + A) makes this about 0.08 m/s².
    """
    vehicle = neutral(undamped(load("finsrov"), "calibrated"))
    origin = {"body.center_of_gravity": [0.0] * 3, "body.center_of_buoyancy": [0.0] * 3}
    added = np.diag(np.diag(vehicle.hydrodynamics["calibrated"].added_mass)).tolist()
    fixed = {
        "hydrodynamics.calibrated.added_mass": added,
        "hydrodynamics.calibrated.reference_point": [0.0] * 3,
    }
    vehicle = vehicle.replace(origin | fixed)
    shear, depth = 0.5, 4.0
    simulator = Simulator(
        vehicle, control_step=1e-4, substeps=1, water=Water(current=(0.1, 0.0, 0.0), shear=(shear, 0.0, 0.0))
    )
    simulator.place((0.0, 0.0, -depth), velocity=(0.1 - shear * depth, 0.0, climb, 0.0, 0.0, 0.0))
    simulator.step()
    A = added[0][0]
    expected = A / (vehicle.body.mass + A) * climb * shear
    assert simulator.numpy("acceleration")[0, 0, 0] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("model", ["calibrated", "mesh"])
def test_a_small_body_follows_the_orbits_of_a_long_wave(model):
    """Its velocity stays the water's, up to the term omitted by linear theory: (v·∇)v <= k |v|² since the
    start."""
    wave = Wave(amplitude=0.1, wavelength=30.0)
    vehicle = neutral(load("finsrov"))
    water = Water(waves=(wave,), depth=10.0)
    simulator = Simulator(
        vehicle, hydrodynamics=model, control_step=0.05, substeps=4, integrator="rk4", water=water
    )
    start = np.array([[0.0, 0.0, -2.0]])
    at_start = flow(water, vehicle.water.gravity, start, 0.0).velocity[0]
    simulator.place(position=start[0], velocity=[*at_start, 0.0, 0.0, 0.0])
    position, q, nu = history(simulator, 200)
    velocity = (rotation(q) @ nu[..., :3, None])[:, 0, :, 0]
    times = 0.05 * np.arange(201)
    moments = zip(position, times, strict=True)
    around = np.array([flow(water, vehicle.water.gravity, x, t).velocity[0] for x, t in moments])
    k = 2 * np.pi / wave.wavelength
    bound = k * np.linalg.norm(around, axis=1).max() ** 2 * (times + 1.0 / np.sqrt(9.81 * k))
    assert (np.linalg.norm(velocity - around, axis=1) <= bound).all()


@EVERY_VEHICLE_AND_MODEL
def test_a_neutrally_trimmed_vehicle_stays_put(name, model):
    """Level, with W = B and buoyancy above weight, it moves in a minute no more than the rounding of W
    allows."""
    vehicle = neutral(load(name), 0.02)
    simulator = Simulator(vehicle, hydrodynamics=model, control_step=0.1, substeps=4)
    simulator.place(position=(1.0, 2.0, -10.0))
    position, q, nu = history(simulator, 600)
    unbalanced = 4.0 * EPS * vehicle.water.gravity
    assert np.abs(position[-1] - [1.0, 2.0, -10.0]).max() < 0.5 * unbalanced * 60.0**2
    assert np.abs(nu).max() < unbalanced * 60.0
    assert np.abs(q[-1, 0, :3]).max() < 1e-5


MIRROR = np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])


def symmetric(name, model):
    """Return the vehicle, made symmetric to port and starboard where its parameters are not."""
    vehicle = load(name)
    chosen, body = vehicle.hydrodynamics[model], vehicle.body

    def symmetrised(matrix):
        return (0.5 * (np.asarray(matrix) + np.outer(MIRROR, MIRROR) * np.asarray(matrix))).tolist()

    centers = ("center_of_gravity", "center_of_buoyancy")
    changes = {f"body.{x}": (np.array(getattr(body, x)) * [1, 0, 1]).tolist() for x in centers}
    inertia = np.asarray(body.inertia)
    changes["body.inertia"] = (0.5 * (inertia + np.outer(MIRROR[3:], MIRROR[3:]) * inertia)).tolist()
    for field in ("added_mass", "linear_damping", "quadratic_damping", "surge_damping"):
        if np.any(getattr(chosen, field, 0.0)):  # a term of zeros would compile another kernel
            changes[f"hydrodynamics.{model}.{field}"] = symmetrised(getattr(chosen, field))
    return vehicle.replace(changes)


@pytest.mark.slow
@for_each([x for x in PAIRS if x != ("rexrov", "mesh")])
def test_port_and_starboard_are_mirror_images(name, model):
    """Mirrored start, current and waves mirror the motion: y, v, p, r change sign. RexROV's hull is not
    symmetric."""
    vehicle = symmetric(name, model)
    position, q, nu = random_states(np.random.default_rng(6), 20, depth=(-1.0, 0.1), speed=0.3, turn=0.3)
    runs = []
    for side in (1.0, -1.0):
        wave = Wave(amplitude=0.02, wavelength=3.0, heading=0.5 * side)
        simulator = Simulator(
            vehicle,
            worlds=20,
            hydrodynamics=model,
            control_step=period(vehicle),
            **exactly(name),
            water=Water(current=(0.1, 0.05 * side, 0.0), waves=(wave,)),
        )
        flip = MIRROR if side < 0 else np.ones(6)
        turned = q * ([-1, 1, -1, 1] if side < 0 else [1, 1, 1, 1])
        simulator.place((position * flip[:3])[:, None], turned[:, None], (nu * flip)[:, None])
        runs.append(history(simulator, 30))
    (x, a, v), (x_m, a_m, v_m) = runs
    assert x_m * MIRROR[:3] == pytest.approx(x, abs=1e-5)
    assert a_m * [-1, 1, -1, 1] == pytest.approx(a, abs=1e-5)
    assert v_m * MIRROR == pytest.approx(v, abs=2e-5)


@ONE_VEHICLE_PER_MODEL
def test_attitudes_keep_unit_length(model):
    """|q| = 1 to float32 after 20 000 substeps of tumbling."""
    vehicle = weightless(load("finsrov").replace({"water.gravity": 1e-3}), model)
    simulator = Simulator(vehicle, worlds=10, hydrodynamics=model, control_step=0.1, substeps=10)
    simulator.place(
        *(x[:, None] for x in random_states(np.random.default_rng(4), 10, depth=(-900.0, -800.0)))
    )
    for _ in range(2000):
        simulator.step()
    length = np.linalg.norm(simulator.numpy("quaternion").astype(float), axis=-1)
    assert length == pytest.approx(1.0, abs=20 * EPS)
