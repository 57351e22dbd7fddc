"""Orders of convergence, and stability of long steps with large added mass."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from finssim.sim import Simulator
from reference.body import rotation
from reference.cases import PAIRS, damped, disturb, for_each, load, plain
from reference.motion import acceleration, numbers

STARTS = np.array([[0.4, 0.3, -0.3, 0.5, 0.4, 0.6], [0.3, -0.4, 0.2, -0.4, 0.6, -0.5]])
Q = np.array([[0.1, -0.05, 0.2, 0.97], [-0.2, 0.1, 0.3, 0.9]])
Q /= np.linalg.norm(Q, axis=1, keepdims=True)
TAU = np.array([12.0, -8.0, 10.0, 1.0, -1.0, 1.5])


def smooth(model):
    """Return FinsROV without the kinks of |v| v and of faces that turn away from the flow, and with slow
    oscillations."""
    slow = {"body.center_of_buoyancy": [0.0, 0.0, -0.06]}
    if model == "mesh":
        changes = {"hydrodynamics.mesh.form_drag": 0.0, "hydrodynamics.mesh.skin_drag": 0.5}
    else:
        changes = {f"hydrodynamics.{model}.quadratic_damping": [0.0] * 6}
    return load("finsrov").replace(slow | changes)


def exact(vehicle, model, duration):
    """Integrate the float64 reference's equation of motion to 1e-10: state (2, 13) at the end."""
    given = numbers(vehicle, model)

    def rate(_, y):
        x, q, nu = (z.reshape(2, -1) for z in np.split(y, [6, 14]))
        spin = np.concatenate([nu[:, 3:], np.zeros((2, 1))], axis=1)
        v, w = q[:, :3], q[:, 3:]
        a, b = spin[:, :3], spin[:, 3:]
        q_dot = 0.5 * np.concatenate(
            [w * a + b * v + np.cross(v, a), w * b - (v * a).sum(1, keepdims=True)], axis=1
        )
        x_dot = np.einsum("nij,nj->ni", rotation(q), nu[:, :3])
        nu_dot, _ = acceleration(given, model, x, q, nu, np.broadcast_to(TAU, (2, 6)))
        return np.concatenate([x_dot.ravel(), q_dot.ravel(), nu_dot.ravel()])

    start = np.concatenate([[0.0, 0.0, -5.0] * 2, Q.ravel(), STARTS.ravel()])
    end = solve_ivp(rate, (0.0, duration), start, rtol=1e-10, atol=1e-10, method="DOP853").y[:, -1]
    return [z.reshape(2, -1) for z in np.split(end, [6, 14])]


def error_after(vehicle, model, integrator, steps, duration, end):
    """Return the largest error of position [m], attitude and twist [m/s, rad/s]."""
    simulator = Simulator(
        vehicle,
        worlds=2,
        hydrodynamics=model,
        integrator=integrator,
        control_step=duration / steps,
        substeps=1,
    )
    simulator.place((0.0, 0.0, -5.0), Q[:, None], STARTS[:, None])
    disturb(simulator, TAU)
    for _ in range(steps):
        simulator.step()
    x, q, nu = (simulator.numpy(name)[:, 0] for name in ("position", "quaternion", "velocity"))
    return max(
        np.abs(x - end[0]).max(), np.abs(rotation(q) - rotation(end[1])).max(), np.abs(nu - end[2]).max()
    )


@pytest.mark.slow
@pytest.mark.parametrize("model", ["calibrated", "mesh", "simplified"])
@pytest.mark.parametrize(
    ("integrator", "order", "steps"), [("midpoint", 2.0, (100, 200, 400)), ("rk4", 4.0, (28, 40, 56))]
)
def test_errors_fall_with_the_integrators_order(model, integrator, order, steps):
    """Errors after 2 s under a constant wrench are C h^p: p is measured between float32 and the asymptote.

    The order is exceeded by at most one: a term of the next order may still dominate where RK4's own is small.
    """
    vehicle = smooth(model)
    if model == "mesh":
        steps = tuple(2 * n for n in steps)  # with little damping, it oscillates faster
    end = exact(vehicle, model, 2.0)
    errors = [error_after(vehicle, model, integrator, n, 2.0, end) for n in steps]
    measured = np.polyfit(np.log(steps), -np.log(errors), 1)[0]
    assert 0.9 * order < measured < order + (1.0 if integrator == "rk4" else 0.1)


def driven(name, integrator, substeps, worlds=64):
    """Return positions, twists and accelerations after 2 s of random commands at 70 % of the limits, as
    float64 copies."""
    vehicle = load(name)
    lower, upper = vehicle.force_limits
    rng = np.random.default_rng(0)
    simulator = Simulator(name, worlds=worlds, integrator=integrator, control_step=0.1, substeps=substeps)
    simulator.place((0.0, 0.0, -5.0), velocity=rng.normal(size=(worlds, 1, 6)) * 0.2)
    for _ in range(20):
        simulator.set_thrust(0.7 * rng.uniform(lower, upper, (worlds, 1, len(lower))))
        simulator.step()
    names = ("position", "velocity", "acceleration")
    return [simulator.numpy(x)[:, 0].astype(float) for x in names]


@pytest.mark.parametrize("integrator", ["midpoint", "rk4"])
@pytest.mark.parametrize("name", ["finsrov", "bluerov2"])
def test_a_driven_vehicle_is_integrated_to_second_order(name, integrator):
    """With thruster lag, quadratic drag and a command every 0.1 s, errors fall by four when the step is halved.

    This applies to RK4 too, which uses the mean thrust of a step in all its stages. The reference has steps of 1.25 ms,
    so that its error is 1/16 or less of the finer error; FinsROV's slow motors leave RK4's error near float32's.
    """
    exact = driven(name, "rk4", 80)
    coarse, fine = (driven(name, integrator, n) for n in ((8, 16) if name == "bluerov2" else (4, 8)))
    errors = [
        [np.sqrt(((x - y) ** 2).mean()) for x, y in zip(run, exact, strict=True)] for run in (coarse, fine)
    ]
    ratio = np.array(errors[0]) / np.array(errors[1])
    if (name, integrator) != ("finsrov", "rk4"):
        assert (ratio[:2] > 3.2).all() and (ratio[:2] < 5.5).all(), ratio
        assert ratio[2] > 2.8, ratio
    assert errors[0][0] < 0.005


def test_the_acceleration_is_that_of_its_state():
    """`acceleration` equals the reference's in the state it is stored with, to second order in the step.

    FinsROV's motors still change after 0.5 s of steady commands: the error is 1 % at 12.5 ms, a quarter of it at half.
    """
    vehicle, errors = load("finsrov"), []
    given = numbers(vehicle, "calibrated")
    thrust = np.linspace(-3.0, 3.0, 8)
    for substeps in (8, 16, 32):
        simulator = Simulator(vehicle, worlds=2, control_step=0.1, substeps=substeps)
        simulator.place((0.0, 0.0, -5.0), Q[:, None], STARTS[:, None])
        simulator.set_thrust(thrust)
        for _ in range(3):
            simulator.step()
        state = [simulator.numpy(x)[:, 0].astype(float) for x in ("position", "quaternion", "velocity")]
        pushed = simulator.numpy("thrust")[:, 0].astype(float) @ vehicle.thruster_matrix().T
        expected, _ = acceleration(given, "calibrated", *state, np.zeros((2, 6)), thrust=pushed)
        errors.append(np.abs(simulator.numpy("acceleration")[:, 0] - expected).max() / np.abs(expected).max())
    assert errors[0] < 0.01
    assert 1.7 < np.polyfit(np.log([8, 16, 32]), -np.log(errors), 1)[0] < 2.4


@pytest.mark.parametrize("name", ["finsrov", "bluerov2", "bluerov2_heavy"])
def test_four_steps_of_the_midpoint_rule_do_better_than_ten_of_eulers(name):
    """After 2 s of random commands the default has less than half the error of ten semi-implicit Euler steps.

    The latter's errors, with this file's commands and starts, were 3.3, 10.7 and 6.8 mm (RMS) when last measured.
    """
    euler = {"finsrov": 3.3e-3, "bluerov2": 10.7e-3, "bluerov2_heavy": 6.8e-3}[name]
    away = driven(name, "midpoint", 4)[0] - driven(name, "rk4", 80)[0]
    assert np.sqrt((away**2).sum(axis=1).mean()) < 0.5 * euler


@pytest.mark.slow
@pytest.mark.parametrize("substeps", [1, 4])
@for_each([x for x in PAIRS if x[1] == "calibrated" and damped(load(x[0]), x[1])])
def test_long_steps_are_stable_with_ten_times_the_mass_added(name, model, substeps):
    """In 20 ms control steps with M_A = 10 M_RB, every axis reaches its terminal speed and none diverges.

    As a force that is fed back, added mass beyond M_RB would diverge at once. 12 worlds, 0.5 m/s or 0.5 rad/s.
    """
    vehicle = plain(load(name))
    body = vehicle.body
    mass = np.r_[[body.mass] * 3, np.diag(body.inertia)]
    fields = ("linear_damping", "quadratic_damping", "surge_damping")
    d1, d2, du = (np.diag(getattr(vehicle.hydrodynamics[model], x)) for x in fields)
    origin = [0.0, 0.0, 0.0]
    vehicle = vehicle.replace(
        {
            f"hydrodynamics.{model}.linear_damping": d1.tolist(),
            f"hydrodynamics.{model}.quadratic_damping": d2.tolist(),
            f"hydrodynamics.{model}.added_mass": (10.0 * mass).tolist(),
            f"hydrodynamics.{model}.reference_point": origin,
            "body.center_of_gravity": origin,
            "body.center_of_buoyancy": origin,
            "body.inertia": np.diag(np.diag(body.inertia)).tolist(),
            "body.displaced_volume": body.mass / vehicle.water.density,
        }
    )
    d2 = d2 + np.r_[du[0], [0.0] * 5]
    speed, axes = 0.5, np.vstack([np.eye(6), -np.eye(6)])
    time_constant = 11.0 * mass / (d1 + 2.0 * d2 * speed)
    simulator = Simulator(vehicle, worlds=12, hydrodynamics=model, control_step=0.02, substeps=substeps)
    simulator.place((0.0, 0.0, -50.0), velocity=0.5 * speed * axes[:, None])
    disturb(simulator, (axes * (d1 * speed + d2 * speed**2))[:, None])
    # After 6 time constants half of exp(-6) remains.
    steps = np.tile(np.ceil(6.0 * time_constant / 0.02), 2).astype(int)
    for k in range(1, int(steps.max()) + 1):
        simulator.step()
        for i in np.flatnonzero(steps == k):
            assert simulator.numpy("velocity")[i, 0] == pytest.approx(speed * axes[i], abs=0.01 * speed)
    assert np.abs(simulator.numpy("velocity")).max() <= 1.01 * speed


@pytest.mark.parametrize("substeps", [1, 4])
def test_long_steps_are_stable_from_any_start_at_the_surface(substeps):
    """FinsROV with M_A = 10 M_RB, 200 random starts at and below the surface, 60 s: all come to rest afloat."""
    vehicle = load("finsrov")
    M_RB = np.r_[[vehicle.body.mass] * 3, np.diag(vehicle.body.inertia)]
    vehicle = vehicle.replace({"hydrodynamics.calibrated.added_mass": (10.0 * M_RB).tolist()})
    rng = np.random.default_rng(3)
    simulator = Simulator(vehicle, worlds=200, control_step=0.02, substeps=substeps)
    q = rng.normal(size=(200, 1, 4))
    simulator.place(rng.uniform([-1, -1, -1], [1, 1, 0], (200, 1, 3)), q, rng.normal(size=(200, 1, 6)))
    for _ in range(3000):
        simulator.step()
    assert np.abs(simulator.numpy("velocity")).max() < 0.01


@pytest.mark.parametrize("integrator", ["midpoint", "rk4"])
def test_slow_motion_far_away_is_not_lost_in_rounding(integrator):
    """A substep's displacement, 16 µm, is less than half the float spacing at 1 km; a control step's is not."""
    moved = []
    for x in (0.0, 1000.0):
        simulator = Simulator("finsrov", control_step=0.08, substeps=50, integrator=integrator)
        simulator.place(position=(x, 0.0, -2.0), velocity=(0.01, 0.0, 0.0, 0.0, 0.0, 0.0))
        for _ in range(10):
            simulator.step()
        moved.append(float(simulator.numpy("position")[0, 0, 0]) - x)
    assert moved[0] > 0.004
    assert moved[1] == pytest.approx(moved[0], abs=10 * 3.1e-5)
