"""Vehicles in contact with a dock press, bounce, and never pass through."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.sim import Simulator
from finssim.tasks import TASKS
from finssim.vehicles import load_vehicle
from reference.cases import disturb, load, neutral, undamped
from reference.dock import deepest

FINSROV = load("finsrov")


def dock_of(vehicle):
    """Return the dock of the docking task."""
    return TASKS["docking"]().fitted([vehicle]).dock()


def ball(vehicle):
    """Return a neutral vehicle without damping whose centres are at its origin, so that it has only kinetic
    energy."""
    changes = {"body.center_of_gravity": [0.0] * 3, "body.center_of_buoyancy": [0.0] * 3}
    return neutral(undamped(vehicle, "calibrated").replace(changes))


def simulator(vehicle, dock, worlds=1, **options):
    made = Simulator(
        vehicle, worlds=worlds, dock=dock, control_step=0.1, substeps=options.pop("substeps", 4), **options
    )
    made.funnel.position.fill_((0.0, 0.0, -5.0))
    return made


@pytest.mark.parametrize(("integrator", "substeps"), [("midpoint", 4), ("midpoint", 20), ("rk4", 20)])
def test_a_press_sinks_in_by_force_over_stiffness(integrator, substeps):
    """At rest against the tube's end, nose and four corners each carry k depth: depth = F / 5k."""
    vehicle, force = neutral(FINSROV), 12.0
    dock = dock_of(vehicle)
    worlds = simulator(vehicle, dock, integrator=integrator, substeps=substeps)
    nose = 0.5 * vehicle.body.size[0]
    worlds.place(position=(dock.tube_length - nose, 0.0, -5.0))
    disturb(worlds, [force, 0.0, 0.0, 0.0, 0.0, 0.0])
    for _ in range(60):
        worlds.step()
    depth = worlds.numpy("position")[0, 0, 0] + nose - dock.tube_length
    assert depth == pytest.approx(force / (5.0 * dock.stiffness), rel=1e-3)
    assert worlds.funnel.force.numpy()[0, 0] == pytest.approx(force, rel=1e-3)
    assert worlds.funnel.impulse.numpy()[0, 0] == pytest.approx(force * 0.1, rel=1e-3)


def shots(rng, worlds, dock, half, speed):
    """Return poses before the dock and body velocities towards its front, bore or edge: headings up to 45°
    off."""
    position = np.zeros((worlds, 3))
    position[:, 0] = -dock.cone_length - 0.1 - np.linalg.norm(half)
    reach = dock.mouth_radius + dock.rim
    position[:, 1:] = rng.uniform(-reach, reach, (worlds, 2))
    yaw = rng.uniform(-0.8, 0.8, worlds)
    q = np.stack([np.zeros(worlds), np.zeros(worlds), np.sin(0.5 * yaw), np.cos(0.5 * yaw)], axis=-1)
    nu = np.zeros((worlds, 6))
    nu[:, 0], nu[:, 1] = speed * np.cos(yaw), -speed * np.sin(yaw)
    return position + [0.0, 0.0, -5.0], q, nu


def kinetic(worlds, vehicle):
    nu = worlds.numpy("velocity")[:, 0].astype(float)
    return 0.5 * np.einsum("ni,ij,nj->n", nu, vehicle.mass_matrix("calibrated"), nu)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["midpoint", "rk4"])
def test_a_bounce_gives_back_the_energy_and_no_more(integrator):
    """With a spring alone the energy is the same before and after, to the integrator's error; with a damper
    it is less."""
    vehicle = ball(FINSROV)
    half = 0.5 * np.array(vehicle.body.size)
    elastic = replace(dock_of(vehicle), damping=0.0, friction=0.0)
    start = shots(np.random.default_rng(0), 64, elastic, half, 0.3)
    # Where a point slides over an edge, the depth's gradient jumps, which no step size resolves.
    for dock, least, most in (
        (elastic, 0.97, 1.03),
        (replace(elastic, damping=150.0, friction=0.2), 0.0, 1.0),
    ):
        worlds = simulator(vehicle, dock, 64, integrator=integrator, substeps=100)
        worlds.place(*(a[:, None] for a in start))
        before, touched = kinetic(worlds, vehicle), np.zeros(64, bool)
        for _ in range(60):
            worlds.step()
            touched |= worlds.funnel.impulse.numpy()[:, 0] > 0.0
        free = touched & (worlds.funnel.force.numpy()[:, 0] == 0.0)
        ratio = kinetic(worlds, vehicle)[free] / before[free]
        assert free.sum() > 20
        assert least <= ratio.min() and ratio.max() <= most + 1e-6, (ratio.min(), ratio.max())


@pytest.mark.parametrize("name", ["finsrov", "lauv", "rexrov"])
def test_nothing_goes_through_at_the_speed_the_dock_is_built_for(name):
    """No hull point penetrates deeper than the rim's thickness, and no vehicle passes from the front to
    behind the dock."""
    vehicle = neutral(load_vehicle(name))
    task = TASKS["docking"]().fitted([vehicle])
    dock, half = task.dock(), 0.5 * np.array(vehicle.body.size)
    worlds = simulator(vehicle, dock, 128)
    start = shots(np.random.default_rng(1), 128, dock, half, task.hull.speed)
    worlds.place(*(a[:, None] for a in start))
    # Pushed throughout with the wrench that maintains its speed.
    push = vehicle.wrench_limits[0] * np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    disturb(worlds, push)
    worst = 0.0
    for _ in range(50):
        worlds.step()
        position = worlds.numpy("position")[:, 0] + [0.0, 0.0, 5.0]
        worst = max(worst, deepest(dock, position, worlds.numpy("quaternion")[:, 0], half).max())
    assert 0.0 < worst < 0.5 * dock.rim
    # The end of the bore stops any vehicle inside it.
    inside = np.hypot(position[:, 1], position[:, 2]) < dock.throat_radius
    assert position[inside, 0].max() < dock.tube_length


def test_touching_leaves_no_trace_where_nothing_is_touched():
    """Far from the dock a vehicle moves as without one, to the rounding differences between the two kernels."""
    runs = []
    for dock in (dock_of(FINSROV), None):
        worlds = Simulator("finsrov", worlds=2, dock=dock, control_step=0.1, substeps=20)
        worlds.place(position=(6.0, 1.0, -3.0), velocity=(0.2, 0.1, 0.0, 0.0, 0.1, 0.2))
        worlds.set_thrust([3.0, 2.0, 1.0, 0.5, -1.0, -2.0, 3.0, 1.0])
        for _ in range(10):
            worlds.step()
        runs.append([worlds.numpy(x).copy() for x in ("position", "quaternion", "velocity")])
    for near, far in zip(*runs, strict=True):
        np.testing.assert_allclose(near, far, atol=1e-6)
