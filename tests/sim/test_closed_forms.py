"""Motions with an analytical solution: terminal speeds, coast-down, pendulum.

`bare` keeps a vehicle's numbers on the diagonals and puts all its centres on one point, so that axes are decoupled.
"""

import numpy as np
import pytest

from finssim.sim import Simulator
from reference.body import transformation
from reference.cases import PAIRS, damped, disturb, for_each, load, neutral, plain, undamped
from reference.hull import drag

EPS = float(np.finfo(np.float32).eps)
FOSSEN = [(name, model) for name, model in PAIRS if model != "mesh" and damped(load(name), model)]
"""Vehicles whose damping is in matrices, not in terms."""
MESH = [(name, model) for name, model in PAIRS if model == "mesh" and name != "rexrov"]
"""Meshes except RexROV's, which is not symmetric, so that drag on one axis alone has a moment."""
AXES = np.vstack([np.eye(6), -np.eye(6)])


def diagonal(matrix):
    return np.diag(np.diag(matrix)).tolist()


def bare(name, model):
    """Diagonal matrices, and centre of gravity at the point where they hold; buoyancy there too, equal to weight.

    The hull alone, without fins.
    """
    vehicle = plain(load(name))
    chosen = vehicle.hydrodynamics[model]
    point = vehicle.body.center_of_buoyancy if model == "mesh" else chosen.reference_point
    changes = {"body.center_of_gravity": list(point), "body.inertia": diagonal(vehicle.body.inertia)}
    for field in ("added_mass", "linear_damping", "quadratic_damping", "surge_damping"):
        if np.any(getattr(chosen, field, 0.0)):  # a term of zeros would be a kernel more
            changes[f"hydrodynamics.{model}.{field}"] = diagonal(getattr(chosen, field))
    return neutral(vehicle.replace(changes))


def numbers_of_axes(vehicle, model):
    """Return mass, linear and quadratic damping of each axis (6,), and H of the point where they hold."""
    chosen, body = vehicle.hydrodynamics[model], vehicle.body
    added = np.diag(chosen.added_mass) * (model != "simplified")
    m = np.r_[[body.mass] * 3, np.diag(body.inertia)] + added
    d2 = np.diag(chosen.quadratic_damping) + np.diag(chosen.surge_damping) * np.eye(6)[0]
    return m, np.diag(chosen.linear_damping), d2, transformation(chosen.reference_point)


@for_each(FOSSEN)
def test_a_steady_wrench_leads_to_the_terminal_speed(name, model):
    """d1 v + d2 v|v| = tau on each axis, both ways, at the reference point: 12 worlds, 0.5 m/s or 1 rad/s.

    From half of it, 16 time constants of the axis leave exp(-16)/2; then a float32 step changes v only while h dv/dt
    exceeds half an ulp, and the error stays below eps T/h. The added mass, which terminal speeds do not depend on, is
    made the same along all axes: motion along the lighter one is truly unstable.
    """
    vehicle = bare(name, model)
    added = np.diag(vehicle.hydrodynamics[model].added_mass)
    alike = [float(added[:3].mean())] * 3 + [float(added[3:].mean())] * 3
    vehicle = vehicle.replace({f"hydrodynamics.{model}.added_mass": alike})
    m, d1, d2, H = numbers_of_axes(vehicle, model)
    speed = np.array([0.5] * 3 + [1.0] * 3)
    time_constant = m / (d1 + 2.0 * d2 * speed)
    h = float(time_constant.min() / 10.0)
    simulator = Simulator(vehicle, worlds=12, hydrodynamics=model, control_step=20 * h, substeps=20)
    start = 0.5 * AXES * speed @ np.linalg.inv(H).T
    simulator.place(position=(0.0, 0.0, -50.0), velocity=start[:, None])
    disturb(simulator, ((AXES * (d1 * speed + d2 * speed**2)) @ H)[:, None])
    control_steps = np.tile(np.ceil(16.0 * time_constant / (20 * h)), 2)
    found = np.zeros((12, 6))
    for k in range(1, int(control_steps.max()) + 1):
        simulator.step()
        now = control_steps == k
        found[now] = simulator.numpy("velocity")[now, 0] @ H.T
    error = np.abs(found - AXES * speed) / speed
    assert (error[AXES != 0] < 1e-6 + EPS * np.tile(time_constant, 2) / h).all()
    assert error[AXES == 0].max() < 1e-4


@for_each(MESH)
def test_a_mesh_reaches_the_speed_at_which_its_drag_balances(name, model):
    """k v² = F along each axis, both ways, with k of the float64 reference at 1 m/s: drag is quadratic in speed."""
    vehicle = bare(name, model)
    vertices, faces = vehicle.hull_mesh()
    chosen, speed = vehicle.hydrodynamics[model], 0.5
    ways, deep, none = AXES[[0, 1, 2, 6, 7, 8]], np.full(6, -1e3), np.zeros((6, 3))
    up = np.broadcast_to([0.0, 0.0, 1.0], (6, 3))
    fluid = vehicle.water.density, chosen.form_drag, chosen.skin_drag
    tau, _ = drag(vertices[faces], up, deep, ways, none, np.zeros((6, 3, 3)), *fluid)
    simulator = Simulator(vehicle, worlds=6, hydrodynamics=model, control_step=0.1, substeps=5)
    simulator.place(position=(0.0, 0.0, -50.0))
    disturb(simulator, -tau[:, None] * speed**2)
    for _ in range(400):
        simulator.step()
    assert simulator.numpy("velocity")[:, 0] == pytest.approx(ways * speed, abs=1e-3 * speed)


@for_each(FOSSEN)
@pytest.mark.parametrize("net", [0.03, -0.03], ids=["rises", "sinks"])
def test_a_light_or_heavy_vehicle_rises_or_sinks_at_its_terminal_speed(name, model, net):
    """d1 w + d2 w² = (ρ V - m) g: buoyancy 3 % more or less than weight, above the centre of gravity."""
    vehicle = neutral(bare(name, model), 0.05)
    vehicle = vehicle.replace({"body.displaced_volume": (1.0 + net) * vehicle.body.displaced_volume})
    m, d1, d2, _ = (x[2] if np.ndim(x) == 1 else x for x in numbers_of_axes(vehicle, model))
    force = net * vehicle.weight
    w = np.sign(net) * 2.0 * abs(force) / (d1 + np.sqrt(d1**2 + 4.0 * d2 * abs(force)))
    time_constant = m / (d1 + 2.0 * d2 * abs(w))
    simulator = Simulator(vehicle, hydrodynamics=model, control_step=time_constant, substeps=40)
    simulator.place(position=(0.0, 0.0, -1e3 if net > 0 else -50.0))
    for _ in range(20):
        simulator.step()
    tolerance = (
        2e-5 + EPS * 40 + 2 * EPS / abs(net)
    )  # the step at which float32 stalls, and a difference of weights
    assert simulator.numpy("velocity")[0, 0, 2] == pytest.approx(w, rel=tolerance)


@for_each(FOSSEN)
@pytest.mark.parametrize("integrator", ["midpoint", "rk4"])
def test_each_axis_coasts_down_as_the_closed_solution(name, model, integrator):
    """m dv/dt = -(d1 + d2 |v|) v from v0 gives v = d1 v0 E / (d1 + d2 |v0| (1 - E)) with E = exp(-d1 t/m).

    Without d1, v = v0 / (1 + d2 |v0| t/m). RK4 is exact to float32 rounding; Euler to h/2 of the rate of change.
    """
    vehicle = bare(name, model)
    m, d1, d2, H = numbers_of_axes(vehicle, model)
    v0 = np.array([0.8] * 3 + [1.2] * 3)
    rate = (d1 + 2.0 * d2 * v0) / m
    h = float(0.02 / rate.max())
    simulator = Simulator(
        vehicle, worlds=12, hydrodynamics=model, control_step=10 * h, substeps=10, integrator=integrator
    )
    start = AXES * v0 @ np.linalg.inv(H).T
    simulator.place(position=(0.0, 0.0, -50.0), velocity=start[:, None])
    for k in range(1, 31):
        simulator.step()
        t = k * 10 * h
        with np.errstate(divide="ignore", invalid="ignore"):
            damped = d1 * v0 * np.exp(-d1 * t / m) / (d1 - d2 * v0 * np.expm1(-d1 * t / m))
        expected = np.where(d1 > 0.0, damped, v0 / (1.0 + d2 * v0 * t / m))
        found = simulator.numpy("velocity")[:, 0] @ H.T
        tolerance = 4e-6 if integrator == "rk4" else 4e-6 + 0.5 * h * rate.max()
        assert found == pytest.approx(AXES * expected, abs=tolerance * v0.max())


@for_each(FOSSEN + MESH)
def test_roll_and_pitch_swing_as_a_damped_pendulum(name, model):
    """I θ'' + d1 θ' + W h θ = 0 from rest at 0.01 rad: it swings and decays as the roots of I s² + d1 s + W h say.

    RK4, three periods; sin θ = θ to θ²/6 = 2e-5 of the swing. Without quadratic damping, and a mesh without drag.
    """
    vehicle, h, angle = bare(name, model), 0.05, 0.01
    if model == "mesh":
        vehicle = undamped(vehicle, model)
        d1 = np.zeros(6)
    else:
        vehicle = vehicle.replace({f"hydrodynamics.{model}.quadratic_damping": [0.0] * 6})
        d1 = np.diag(vehicle.hydrodynamics[model].linear_damping)
    added = np.diag(vehicle.hydrodynamics[model].added_mass) * (model != "simplified")
    inertia = (np.diag(vehicle.body.inertia) + added[3:])[:2]
    roots = np.array([np.roots([i, d, h * vehicle.weight]) for i, d in zip(inertia, d1[3:5], strict=True)])
    period = 2 * np.pi / np.sqrt(h * vehicle.weight / inertia)
    simulator = Simulator(
        neutral(vehicle, h),
        worlds=2,
        hydrodynamics=model,
        control_step=float(period.min() / 20),
        substeps=min(10, int(np.ceil(np.abs(roots).max() * period.min() / 20 / 0.05))),
        integrator="rk4",
    )
    half = np.sin(0.5 * angle)
    attitude = np.array([[half, 0.0, 0.0, np.cos(0.5 * angle)], [0.0, half, 0.0, np.cos(0.5 * angle)]])
    simulator.place(position=(0.0, 0.0, -50.0), quaternion=attitude[:, None])
    for k in range(1, 61):
        simulator.step()
        t = k * simulator.control_step
        a, b = roots[:, 0], roots[:, 1]
        expected = angle * np.real((a * np.exp(b * t) - b * np.exp(a * t)) / (a - b))
        found = 2.0 * simulator.numpy("quaternion")[[0, 1], 0, [0, 1]]
        assert found == pytest.approx(expected, abs=5e-4 * angle)
