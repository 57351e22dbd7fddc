"""Vehicles in contact with a described world: presses, bounces, and no penetration."""

import numpy as np
import pytest
import warp as wp

pytest.importorskip("finssim.extensions.perception")

from finssim.extensions.perception import WorldLayout, load_world
from finssim.sim import RectangularPool, Simulator, SimulatorError
from finssim.sim.step import Features, physics_kernel
from reference.body import rotation
from reference.cases import disturb, load, neutral, plain, undamped

FINSROV = load("finsrov")
HALF = 0.5 * np.array(FINSROV.body.size)
HEAD = "about: A site.\nwater: {attenuation: [0, 0, 0], veil: [0, 0, 0], daylight_attenuation: [0, 0, 0]}\n"
TAIL = "\nviewpoint: {position: [0, 0, -5]}\n"
BLOCK = "objects:\n  block: {shape: box, position: [1.0, 0, -5], size: [0.4, 3, 3]}"
LEVEL = (0.0, 0.0, 0.0, 1.0)


@pytest.fixture
def world(tmp_path):
    """World of a few lines."""

    def make(text, name="site"):
        path = tmp_path / f"{name}.yaml"
        path.write_text(HEAD + text + TAIL, encoding="utf-8")
        return load_world(path)

    return make


def centred(vehicle=FINSROV, above=0.0):
    """Return a neutral vehicle, its centre of gravity on its origin and that of buoyancy on or above it [m]."""
    return neutral(vehicle.replace({"body.center_of_gravity": [0.0] * 3}), above)


def ball():
    """Return a vehicle that has no damping either, so that all its energy is kinetic."""
    return centred(undamped(FINSROV, "calibrated"))


def kinetic(simulator, vehicle):
    nu = simulator.numpy("velocity")[:, 0].astype(float)
    return 0.5 * np.einsum("ni,ij,nj->n", nu, vehicle.mass_matrix("calibrated"), nu)


@pytest.mark.parametrize(
    "floor",
    ["seabed: {depth: 6}", "seabed: {depth: 6, size: [20, 20]}",
     "objects: {floor: {shape: box, position: [0, 0, -6.5], size: [8, 8, 1]}}"],
)  # fmt: skip
def test_a_heavy_vehicle_rests_on_the_floor_at_weight_over_stiffness(world, floor):
    """On plane, heightfield and box, four corners each carry a quarter of the weight in water, k depth."""
    net = 0.05
    vehicle = FINSROV.replace(
        {"body.displaced_volume": (1.0 - net) * FINSROV.body.mass / FINSROV.water.density}
    )
    simulator = Simulator(vehicle, worlds=2, world=world(floor), threads=1)
    simulator.place((0.0, 0.0, -6.0 + HALF[2] + 0.05))
    for _ in range(150):
        simulator.step()
    depth = -6.0 + HALF[2] - simulator.numpy("position")[:, 0, 2]
    # Offsets of the centres of gravity and buoyancy tilt it: the mean of the corners is at the middle.
    expected = net * vehicle.weight / (4.0 * 4000.0)
    assert depth == pytest.approx(np.full(2, expected), rel=0.02)
    assert simulator.solids.force.numpy()[:, 0] == pytest.approx(np.full(2, net * vehicle.weight), rel=1e-3)


def thing(text):
    """Return the only object of a world."""
    return f"objects: {{thing: {{{text}}}}}"


FLOORS = {
    "seabed": "seabed: {depth: 6, size: [12, 12], spacing: 2.0, roughness: {rms: 0.2, wavelength: 8.0}}",
    "slope": "seabed: {depth: 6, slope: [0.1, -0.05]}",
    "box": thing("shape: box, position: [0, 0, -6.2], size: [4, 4, 0.4], vary: {position: [0, 0, 0.3], yaw: 3}"),
    "disc": thing("shape: cylinder, position: [0, 0, -6.2], radius: 2, length: 0.4"),
    "rails": thing("shape: capsule, position: [0, -0.1, -6.2], radius: 0.2, length: 4, axis: [1, 0, 0],"
                   "repeat: {count: 2, step: [0, 0.2, 0]}"),
    "domes": thing("shape: sphere, position: [0, -0.15, -6.2], radius: 0.2, repeat: {count: 2, step: [0, 0.3, 0]}}, "
                   "m: {shape: sphere, position: [-0.2, 0, -6.2], radius: 0.2, repeat: {count: 2, step: [0.4, 0, 0]}"),
    "hollow": thing("shape: mesh, file: hollow.stl, position: [0, 0, -6], yaw: 0.3"),
}  # fmt: skip


def write_hollow(path):
    """Write a closed block whose top falls by 0.3 m to its middle line, as text STL; its convex hull would be
    level."""
    corners = {(a, y, b): np.array([2.0 * a, y, 0.6 * abs(a) * b - 0.3 * (1 - b)])
               for a in (-1, 0, 1) for y in (-2, 2) for b in (0, 1)}  # fmt: skip
    quads = [
        [(a, -2, b), (a + 1, -2, b), (a + 1, 2, b), (a, 2, b)][:: 2 * b - 1] for a in (-1, 0) for b in (0, 1)
    ]
    for a in (-1, 0):
        quads += [[(a, y, 0), (a + 1, y, 0), (a + 1, y, 1), (a, y, 1)][:: -y // 2] for y in (-2, 2)]
    quads += [[(x, -2, 0), (x, 2, 0), (x, 2, 1), (x, -2, 1)][::x] for x in (-1, 1)]
    lines = ["solid hollow"]
    for quad in quads:
        for triangle in ((0, 1, 2), (0, 2, 3)):
            points = ["vertex {} {} {}".format(*corners[quad[k]]) for k in triangle]
            lines += ["facet normal 0 0 0", "outer loop", *points, "endloop", "endfacet"]
    path.write_text("\n".join([*lines, "endsolid hollow"]), encoding="utf-8")


@pytest.mark.parametrize("floor", FLOORS)
def test_a_vehicle_rests_where_a_rigid_body_rests(floor, world, tmp_path):
    """Released 5 % heavy above each solid of a drawn world, it reaches the pose of MuJoCo, whose contacts are hard.

    The spheres of the hull lie a tenth of the least half extent inside the faces, and penalties are a few millimetres.
    """
    pytest.importorskip("mujoco")
    from reference.rigid import rest_pose

    write_hollow(tmp_path / "hollow.stl")
    vehicle = FINSROV.replace({"body.displaced_volume": 0.95 * FINSROV.body.mass / FINSROV.water.density})
    layout = WorldLayout(world(FLOORS[floor] + "\ncontact: {friction: 2.0}"))
    layout.draw(5)
    start = (1.4, 0.6, -5.6) if floor == "seabed" else (0.0, 0.0, -5.6)  # within one triangle
    simulator = Simulator(vehicle, world=layout, threads=1)
    simulator.place(start)
    for _ in range(80):
        simulator.step()
    position, R = rest_pose(vehicle, layout, start)
    near = 0.1 * HALF.min() + 0.006
    assert np.abs(simulator.numpy("position")[0, 0] - position).max() < near
    assert np.abs(rotation(simulator.numpy("quaternion")[0, 0]) - R).max() < near / HALF[1]


SHAPES = {
    "box": "{shape: box, position: [1.2, 0, -5], size: [0.8, 0.8, 0.8], yaw: 0.4}",
    "plane": "{shape: plane, position: [0.9, 0, -5], axis: [-1, 0.2, 0.1]}",
    "sphere": "{shape: sphere, position: [1.2, 0, -5], radius: 0.4}",
    "post": "{shape: cylinder, position: [1.0, 0, -5], radius: 0.05, length: 3, axis: [0, 1, 0]}",
    "disc": "{shape: cylinder, position: [1.0, 0, -5], radius: 0.6, length: 0.1, axis: [1, 0, 0.3]}",
    "rail": "{shape: capsule, position: [1.0, 0, -5], radius: 0.1, length: 3, axis: [0, 0.3, 1]}",
    "wreck": "{shape: mesh, file: cube.stl, position: [1.2, 0, -5], yaw: 0.4}",
}


def write_cube(path, half=0.4):
    """Write a closed cube as text STL."""
    lines = ["solid cube"]
    for axis in range(3):
        for side in (-1.0, 1.0):
            corners = []
            for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                point = np.zeros(3)
                point[axis], point[(axis + 1) % 3], point[(axis + 2) % 3] = side, a, b
                corners.append(half * point)
            corners = corners if side > 0 else corners[::-1]
            for triangle in ((0, 1, 2), (0, 2, 3)):
                lines += ["facet normal 0 0 0", "outer loop"]
                lines += ["vertex {} {} {}".format(*corners[k]) for k in triangle]
                lines += ["endloop", "endfacet"]
    path.write_text("\n".join([*lines, "endsolid cube"]), encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize("shape", [*SHAPES, "seabed"])
def test_an_undamped_bounce_gives_back_the_energy_and_no_more(world, shape, tmp_path):
    """32 vehicles at other attitudes meet a solid at 0.3 m/s: those that leave it have their initial energy.

    The tolerance is 1 % in the median and 4 % at most: where a point slides over an edge the gradient jumps, which no
    step resolves.
    """
    write_cube(tmp_path / "cube.stl")
    text = f"objects: {{thing: {SHAPES[shape]}}}" if shape in SHAPES else (
        "seabed: {depth: 6, size: [8, 8], roughness: {rms: 0.15, wavelength: 3.0}}"
    )  # fmt: skip
    vehicle, rng, n = ball(), np.random.default_rng(0), 32
    simulator = Simulator(
        vehicle,
        worlds=n,
        world=world(f"contact: {{damping: 0, friction: 0}}\n{text}"),
        substeps=100,
        threads=1,
    )
    yaw = rng.uniform(-1.0, 1.0, n)
    q = np.stack([0.0 * yaw, 0.0 * yaw, np.sin(0.5 * yaw), np.cos(0.5 * yaw)], axis=-1)
    heading = np.array([0.0, 0.0, -0.3]) if shape == "seabed" else np.array([0.3, 0.0, 0.0])
    nu = np.zeros((n, 6))
    nu[:, :3] = np.einsum("nji,j->ni", rotation(q), heading)
    start = np.array([0.0, 0.0, -5.2]) if shape == "seabed" else np.array([0.2, 0.0, -5.0])
    spread = [1.0, 1.0, 0.0] if shape == "seabed" else [0.0, 0.15, 0.15]
    simulator.place((start + rng.uniform(-1.0, 1.0, (n, 3)) * spread)[:, None], q[:, None], nu[:, None])
    before, touched = kinetic(simulator, vehicle), np.zeros(n, bool)
    for _ in range(60):
        simulator.step()
        touched |= simulator.solids.force.numpy()[:, 0] > 0.0
    free = touched & (simulator.solids.force.numpy()[:, 0] == 0.0)
    ratio = kinetic(simulator, vehicle)[free] / before[free]
    assert free.sum() > 20, (touched.sum(), free.sum())
    assert abs(np.median(ratio) - 1.0) < 0.01 and np.abs(ratio - 1.0).max() < 0.04, (ratio.min(), ratio.max())


def test_a_press_on_a_ball_sinks_in_by_force_over_stiffness(world):
    """A ball before the middle of the bow touches one sphere of the hull: centres are R + r - F/k apart."""
    vehicle, force = centred(above=0.05), 8.0
    simulator = Simulator(
        vehicle, worlds=1, world=world("objects: {ball: {shape: sphere, position: [1, 0, -5], radius: 0.3}}")
    )
    least = HALF.min()
    simulator.place((1.0 - 0.3 - HALF[0], 0.0, -5.0))
    disturb(simulator, [force, 0.0, 0.0, 0.0, 0.0, 0.0])
    for _ in range(80):
        simulator.step()
    R = rotation(simulator.numpy("quaternion")[0, 0].astype(float))
    centre = simulator.numpy("position")[0, 0] + R @ [HALF[0] - least, 0.0, 0.0]
    assert np.linalg.norm(centre - [1.0, 0.0, -5.0]) == pytest.approx(
        0.3 + 0.9 * least - force / 4000.0, abs=2e-4
    )
    assert simulator.solids.force.numpy()[0, 0] == pytest.approx(force, rel=2e-2)


def test_every_world_has_its_own_solids_and_a_draw_moves_them(world):
    """Vehicles pushed along x stop at the faces of their own blocks and, after a redraw, at the new ones."""
    layout = WorldLayout(world(BLOCK[:-1] + ", vary: {position: [0.3, 0, 0]}}"), worlds=4)
    layout.draw(2)
    simulator = Simulator(centred(above=0.05), worlds=4, world=layout, threads=1)
    disturb(simulator, [16.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    stops = []
    for seed in (2, 3):
        layout.draw(seed)
        simulator.place((0.2, 0.0, -5.0))
        for _ in range(150):
            simulator.step()
        stops.append(simulator.numpy("position")[:, 0, 0] + HALF[0])
        face = layout.poses("block")[:, 0] - 0.2
        assert np.ptp(face) > 0.1
        np.testing.assert_allclose(stops[-1], face + 16.0 / (4.0 * 4000.0), atol=1e-3)
    assert np.abs(stops[0] - stops[1]).max() > 0.05
    # A solid that is placed on a vehicle pushes it out at once.
    layout._drawn[:] = 0.0
    layout._place(np.arange(4))
    simulator.place((0.75, 0.0, -5.0))
    layout._drawn[:, 1] = -0.5
    layout._place(np.arange(4))
    simulator.step()
    assert (simulator.solids.force.numpy()[:, 0] > 10.0).all()


def test_a_basin_is_a_pool(world):
    """A world that contains only a basin is bit-identical to the pool of its size."""
    site = world("basin: {size: [4, 2, 1]}\ncontact: {stiffness: 3000, damping: 80, friction: 0.1}")
    pool = RectangularPool(length=4.0, width=2.0, depth=1.0, stiffness=3000.0, damping=80.0, friction=0.1)
    runs = []
    for options in ({"world": site}, {"pool": pool}):
        simulator = Simulator("finsrov", worlds=3, threads=1, **options)
        simulator.place((1.5, 0.6, -0.5), velocity=(0.5, 0.2, -0.4, 0.1, 0.2, 0.3))
        simulator.set_thrust([8.0, 2.0, -3.0, 4.0, 5.0, -2.0, 1.0, 3.0])
        for _ in range(40):
            simulator.step()
        runs.append([simulator.numpy(x).copy() for x in ("position", "quaternion", "velocity")])
    for one, other in zip(*runs, strict=True):
        np.testing.assert_array_equal(one, other)
    with pytest.raises(SimulatorError, match="pool and world are given"):
        Simulator("finsrov", world=site, pool=pool)
    with pytest.raises(SimulatorError, match="the world has 2 copies on cpu, expected 3 on cpu"):
        Simulator("finsrov", worlds=3, world=WorldLayout(site, worlds=2))


def test_boxes_around_a_vehicle_are_the_walls_of_a_pool(world):
    """Slabs instead of a basin give the same forces on the same corners: equal motion to the rounding of
    poses."""
    slabs = "objects:\n" + "\n".join(
        f"  {name}: {{shape: box, position: {position}, size: {size}}}"
        for name, position, size in (
            ("floor", [0, 0, -1.5], [6, 4, 1]), ("east", [2.5, 0, 0], [1, 4, 4]), ("west", [-2.5, 0, 0], [1, 4, 4]),
            ("north", [0, 1.5, 0], [6, 1, 4]), ("south", [0, -1.5, 0], [6, 1, 4]),
        )
    )  # fmt: skip
    runs = []
    for options in ({"world": world(slabs)}, {"pool": RectangularPool(length=4.0, width=2.0, depth=1.0)}):
        simulator = Simulator("finsrov", worlds=1, threads=1, substeps=20, **options)
        simulator.place((1.6, 0.0, -0.6), velocity=(0.2, 0.0, -0.1, 0.0, 0.0, 0.0))
        for _ in range(8):
            simulator.step()
        runs.append([simulator.numpy(x).copy() for x in ("position", "velocity")])
    assert runs[0][0][0, 0, 0] > 1.6 and runs[0][1][0, 0, 0] < 0.15
    np.testing.assert_allclose(runs[0][0], runs[1][0], atol=1e-5)
    np.testing.assert_allclose(runs[0][1], runs[1][1], atol=1e-4)


@pytest.mark.parametrize("name", ["finsrov", "lauv"])
@pytest.mark.slow
def test_thin_solids_hold(world, name):
    """A plate of 4 cm and, for a wide vehicle, struts of 3 cm stop vehicles at 1 m/s under full thrust.

    A torpedo passes between two struts: at 4 kN/m the spring there absorbs 12 J, less than its energy. Its fins are
    omitted.
    """
    text = (
        "objects:\n  plate: {shape: box, position: [2.5, -20, -5], size: [0.04, 39, 7]}\n"
        "  struts: {shape: cylinder, position: [2.5, 1, -5], radius: 0.015, length: 8,"
        " repeat: {count: 56, step: [0, 0.1, 0]}}"
    )
    vehicle, n = neutral(plain(load(name))).replace({"thrusters.*.domain": "force"}), 32
    simulator = Simulator(vehicle, worlds=n, world=world(text), threads=1)
    rng = np.random.default_rng(3)
    y = np.where((np.arange(n) < n // 2) | (name == "lauv"), -20.0, 4.0) + rng.uniform(-1.0, 1.0, n)
    yaw = rng.uniform(-0.5, 0.5, n)
    q = np.stack([0.0 * yaw, 0.0 * yaw, np.sin(0.5 * yaw), np.cos(0.5 * yaw)], axis=-1)
    simulator.place(
        np.stack([0.0 * y + 2.2 - vehicle.body.size[0], y, 0.0 * y - 5.0], axis=-1)[:, None],
        q[:, None],
        (1.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    )
    disturb(simulator, vehicle.wrench_limits[0] * np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    touched = np.zeros(n, bool)
    for _ in range(60):
        simulator.step()
        touched |= simulator.solids.force.numpy()[:, 0] > 0.0
        assert simulator.numpy("position")[:, 0, 0].max() < 2.5
    assert touched.mean() > 0.7 and not len(simulator.frozen_worlds())


def test_worlds_that_touch_nothing_go_in_blocks_and_move_as_without_solids(world, monkeypatch):
    """Far from a block, motion is as in open water, to rounding; beside one, contact of another world changes
    no bit."""
    site = world(BLOCK)

    def run(start, **options):
        simulator = Simulator(neutral(FINSROV), worlds=8, threads=1, **options)
        assert simulator.in_lanes
        position = np.tile([0.0, 0.0, -5.0], (8, 1, 1))
        position[3] = start
        simulator.place(position, velocity=(0.05, 0.1, 0.0, 0.0, 0.0, 0.1))
        for _ in range(20):
            simulator.step()
        return np.concatenate(
            [simulator.numpy(x)[:, 0] for x in ("position", "quaternion", "velocity")], axis=1
        )

    quiet, beside, open_water = (
        run((-3.0, 0, -5.0), world=site), run((0.6, 0, -5.0), world=site), run((-3.0, 0, -5.0)),
    )  # fmt: skip
    others = np.arange(8) != 3
    np.testing.assert_array_equal(quiet[others], beside[others])
    np.testing.assert_allclose(quiet, open_water, atol=2e-6)


def test_what_is_not_solid_is_not_there(world):
    """Vehicles pass through fish and lines on the floor."""
    site = world(BLOCK[:-1] + ", solid: false}")
    simulator = Simulator(neutral(FINSROV), worlds=1, world=site)
    simulator.place((0.9, 0.0, -5.0))
    simulator.step()
    assert np.abs(simulator.numpy("velocity")).max() < 1e-3


@pytest.mark.slow
def test_the_step_with_solids_compiles_for_cuda(tmp_path):
    """NVRTC, which needs no device, compiles the step to PTX for compute capability 7.5."""
    wp.init()
    if wp.get_cuda_toolkit_version() is None:
        pytest.skip("this Warp has no CUDA compiler")
    from finssim.sim import solids

    kernel = physics_kernel(Features("calibrated", solids=True, funnel=True))
    for module in (kernel.module, wp.get_module(solids.__name__)):
        wp.compile_aot_module(module, arch=75, module_dir=tmp_path, use_ptx=True)
    assert len(list(tmp_path.glob("*.ptx"))) == 2
