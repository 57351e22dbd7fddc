"""The scene backend: in open water it is the simulator, and contacts obey mechanics with the water's inertia."""

import sys
from pathlib import Path

import numpy as np
import pytest

from finssim.engine import PictureError, Pool, Simulator, SimulatorError, Water, Wave
from finssim.engine.scene import Scene
from finssim.geometry.rotations import quat_rotate
from finssim.worlds import WorldLayout
from reference.body import rotation
from reference.cases import EVERY_VEHICLE_AND_MODEL, disturb, load, neutral, random_states, weightless

pytest.importorskip("mujoco")

FINSROV = load("finsrov")
CRATE = """<body name='crate' pos='0.6 0 -0.9' gravcomp='0.667'>
  <freejoint/><geom type='box' size='.1 .1 .1' density='1500'/></body>"""
"""A box of 20 cm, half as heavy again as the water that carries two thirds of its weight."""
EPS = float(np.finfo(np.float32).eps)


def together(*names):
    """Vehicles of the catalogue in fresh water, for each file has its own."""
    return [load(name).replace({"water.density": 1000.0, "water.gravity": 9.81}) for name in names]


def run(simulation, thrusts, seconds_each):
    """Hold each thrust command for a while; pose and twist at the end, (V, 13)."""
    simulation.place([[[0.3, -0.2 + 5.0 * i, -3.0] for i in range(len(simulation.vehicles))]])
    for thrust in thrusts:
        simulation.set_thrust(thrust)
        for _ in range(round(seconds_each / simulation.control_step)):
            simulation.step()
    return np.concatenate([simulation.numpy(n)[0] for n in ("position", "quaternion", "velocity")], axis=-1)


def inertia(scene):
    """M_RB + M_A of each vehicle from its file, (V, 6, 6)."""
    every = []
    for vehicle in scene.vehicles:
        hydro = vehicle.hydrodynamics[scene.hydrodynamics]
        x, y, z = hydro.reference_point
        H = np.eye(6)
        H[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
        every.append(vehicle.rigid_body_mass_matrix() + H.T @ np.asarray(hydro.added_mass) @ H)
    return np.stack(every)


def momentum(scene, M):
    """Linear momentum of each body with inertia M, world frame, (V, 3) [kg m/s]."""
    nu = scene.numpy("velocity")[0].astype(float)
    return quat_rotate(scene.numpy("quaternion")[0], np.einsum("vij,vj->vi", M, nu)[:, :3])


def kinetic_energy(scene, M):
    nu = scene.numpy("velocity")[0].astype(float)
    return 0.5 * np.einsum("vi,vij,vj->", nu, M, nu)


@EVERY_VEHICLE_AND_MODEL
def test_one_step_accelerates_as_the_simulator_does(name, model):
    """From a random state, with thrust and a wrench: nu_dot and thrust equal the simulator's.

    nu_dot turns into the world and back with a quaternion whose length is 1 to a rounding: a few of the largest number.
    """
    rng = np.random.default_rng(3)
    vehicle = load(name)
    position, q, nu = random_states(rng, 1)
    lower, upper = vehicle.force_limits
    thrust, tau = rng.uniform(lower, upper), rng.normal(size=6)
    got = []
    for kind in (Scene, Simulator):
        one = kind(vehicle, hydrodynamics=model, control_step=0.01, substeps=1)
        disturb(one, tau)
        one.set_thrust(thrust)
        one.place(position, q, nu)
        one.step()
        got.append((one.numpy("acceleration").copy(), one.numpy("thrust").copy()))
    scale = np.abs(got[1][0]).max()
    np.testing.assert_allclose(got[0][0], got[1][0], rtol=EPS, atol=4.0 * EPS * scale)
    np.testing.assert_array_equal(got[0][1], got[1][1])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("names", "model", "water"),
    [
        (["finsrov"], "calibrated", None),
        (["finsrov"], "mesh", None),
        (["finsrov"], "simplified", None),
        (["rexrov"], "calibrated", None),
        (
            ["finsrov", "bluerov2_heavy"],
            "calibrated",
            Water(current=(0.2, -0.1, 0.0), waves=[Wave(amplitude=0.1, wavelength=6.0)], depth=20.0),
        ),
    ],
    ids=["finsrov-calibrated", "finsrov-mesh", "finsrov-simplified", "rexrov", "two-in-waves"],
)
def test_in_open_water_it_is_the_simulator_to_integrator_order(names, model, water):
    """Three seconds of random thrusts: the difference of the two backends halves with the step."""
    vehicles = together(*names)
    rng = np.random.default_rng(1)
    lower, upper = vehicles[0].force_limits
    thrusts = [rng.uniform(0.7 * lower, 0.7 * upper) for _ in range(3)]

    def difference(substeps):
        options = {"hydrodynamics": model, "substeps": substeps, "water": water}
        ends = [run(kind(vehicles, **options), thrusts, 1.0) for kind in (Scene, Simulator)]
        return np.abs(ends[0] - ends[1]).max(axis=0)

    coarse, fine = difference(10), difference(20)
    speed = 2.0 if "rexrov" in names else 0.5
    assert coarse.max() < 0.02 * speed
    assert 1.8 < np.linalg.norm(coarse) / np.linalg.norm(fine) < 2.2


@pytest.mark.parametrize("collision", ["envelope", "hull"])
def test_a_heavy_vehicle_comes_to_rest_on_the_floor(collision):
    """It loses energy all the way, and at rest the floor carries its weight less its buoyancy."""
    heavy = FINSROV.replace({"body.mass": 13.0})
    scene = Scene(heavy, pool=Pool(), collision=collision)
    weight = 9.81 * (13.0 - 1027.0 * 0.0118)
    M = inertia(scene)
    scene.place((0.0, 0.0, -0.5))
    energies = []
    for _ in range(60):
        scene.step()
        # The contact's depth is a fraction of a millimetre: a tenth stands for the energy it may hold.
        energies.append(kinetic_energy(scene, M) + weight * scene.numpy("position")[0, 0, 2])
    assert np.diff(energies).max() < weight * 1e-4
    assert np.abs(scene.numpy("velocity")).max() < 1e-6
    assert np.abs(scene.numpy("acceleration")).max() < 1e-6
    np.testing.assert_allclose(scene.contact_wrench()[0, 0], [0.0, 0.0, weight, 0.0, 0.0, 0.0], atol=1e-4)
    total = sum(c.force for c in scene.contacts())
    np.testing.assert_allclose(total, [0.0, 0.0, weight], atol=1e-4)
    assert {c.bodies for c in scene.contacts()} == {("world", "vehicle0")}


@pytest.mark.parametrize(
    ("wall", "position", "q"),
    [
        ("x+", (1.70, 0.0, -0.5), (0.0, 0.0, 0.0, 1.0)),
        ("x-", (-1.70, 0.0, -0.5), (0.0, 0.0, 1.0, 0.0)),
        ("y+", (0.0, 0.70, -0.5), (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))),
        ("y-", (0.0, -0.70, -0.5), (0.0, 0.0, -np.sqrt(0.5), np.sqrt(0.5))),
    ],
)
def test_a_push_against_a_wall_is_a_push_on_the_wall(wall, position, q):
    """5 N forward, through water that doubles the vehicle's inertia: the wall answers with 5 N."""
    scene = Scene(neutral(FINSROV, 0.05), pool=Pool())
    disturb(scene, [5.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    scene.place(position, q)
    for _ in range(50):
        scene.step()
    np.testing.assert_allclose(scene.contact_wrench()[0, 0, :3], [-5.0, 0.0, 0.0], atol=1e-3)
    x, y, _ = scene.numpy("position")[0, 0]
    reached = {"x+": x - 2.0, "x-": -x - 2.0, "y+": y - 1.0, "y-": -y - 1.0}[wall]
    assert reached == pytest.approx(-0.28, abs=1e-3)


def test_a_wall_holds_up_to_its_friction():
    """Pressed with 10 N against a wall of friction 0.2, a vehicle withstands 1 N along it, and slides at 4 N."""
    speeds = {}
    for along in (1.0, 4.0):
        scene = Scene(neutral(FINSROV, 0.05), pool=Pool(friction=0.2))
        disturb(scene, [10.0, 0.0, along, 0.0, 0.0, 0.0])
        scene.place((1.71, 0.0, -0.6))
        touched = 0
        for _ in range(30):
            scene.step()
            force = sum((contact.force for contact in scene.contacts()), np.zeros(3))
            touched += force[0] != 0.0  # sliding, it touches and leaves the wall in turn
            assert abs(force[2]) <= 0.2 * abs(force[0]) * (1.0 + 1e-6)
        assert touched > 10
        speeds[along] = scene.numpy("velocity")[0, 0, 2]
    assert abs(speeds[1.0]) < 1e-3
    assert speeds[4.0] > 0.01


def colliding(control_step):
    """Two unlike vehicles, neither heavy nor damped, on their way to hit each other off centre."""
    pair = [weightless(vehicle, "calibrated") for vehicle in together("finsrov", "bluerov2")]
    scene = Scene(pair, control_step=control_step, substeps=1)
    scene.place(
        position=[[[-0.4, 0.1, -5.0], [0.3, 0.0, -5.05]]],
        quaternion=[[[0.0, 0.0, 0.3, 0.95], [0.1, 0.2, 0.0, 0.97]]],
        velocity=[[[0.5, -0.3, 0.0, 0.0, 0.0, 0.0], [-0.3, 0.0, 0.1, 0.3, 0.0, 0.0]]],
    )
    return scene


def through_collision(control_step):
    """Change of the total momentum, of the hulls' alone, exchanged impulse [N s], and loss of energy [J]."""
    scene = colliding(control_step)
    M = inertia(scene)
    dry = np.stack([v.rigid_body_mass_matrix() for v in scene.vehicles])
    before, dry_before = momentum(scene, M).sum(axis=0), momentum(scene, dry).sum(axis=0)
    energy, impulse = kinetic_energy(scene, M), np.zeros(3)
    for _ in range(round(1.2 / control_step)):
        q = scene.numpy("quaternion")[0].astype(float)
        scene.step()
        forces = quat_rotate(q, scene.contact_wrench()[0, :, :3])
        # Newton's third law, in every step; torques balance too, which the momentum cannot show
        np.testing.assert_allclose(forces[0], -forces[1], atol=1e-5 * (1.0 + np.abs(forces).max()))
        impulse += control_step * forces[0]
    assert np.abs(scene.contact_wrench()).max() < 1e-6
    return (
        np.linalg.norm(momentum(scene, M).sum(axis=0) - before),
        np.linalg.norm(momentum(scene, dry).sum(axis=0) - dry_before),
        np.linalg.norm(impulse),
        energy - kinetic_energy(scene, M),
    )


def test_a_collision_exchanges_momentum_of_hull_and_water():
    """The momentum of hulls and moved water is conserved to integrator order; that of the hulls alone is not."""
    coarse, fine = through_collision(0.01), through_collision(0.0025)
    assert fine[2] > 3.0
    assert fine[0] < 0.01 * fine[2]
    assert fine[0] < 0.4 * coarse[0]
    assert fine[1] > 0.1 * fine[2]
    assert fine[3] > 0.0


def test_an_impact_stops_hull_and_water():
    """Impulse of a wall on a vehicle that runs into it: the momentum of (m + m_A), four times that of the hull.

    A weightless, undamped vehicle with all its centres at the origin, so that the impact is central.
    """
    vehicle = weightless(FINSROV, "calibrated").replace(
        {
            "body.center_of_gravity": [0.0, 0.0, 0.0],
            "body.center_of_buoyancy": [0.0, 0.0, 0.0],
            "hydrodynamics.calibrated.reference_point": [0.0, 0.0, 0.0],
            "hydrodynamics.calibrated.added_mass": [36.33, 30.0, 20.0, 0.1, 0.1, 0.5],
        }
    )
    scene = Scene(vehicle, pool=Pool())
    scene.place((1.6, 0.0, -0.5), velocity=(0.4, 0.0, 0.0, 0.0, 0.0, 0.0))
    impulse = 0.0
    for _ in range(10):
        scene.step()
        impulse += scene.control_step * scene.contact_wrench()[0, 0, 0]
    after = scene.numpy("velocity")[0, 0, 0]
    assert impulse == pytest.approx((12.11 + 36.33) * (after - 0.4), rel=1e-5)
    assert -0.1 < after <= 0.0


def test_equal_scenes_give_equal_runs():
    """Bitwise, in drifting water and through contacts with walls and a loose crate; and placing anew starts anew."""
    thrust = np.random.default_rng(2).uniform(-2.0, 5.0, 8)

    def trajectory(scene):
        ends = []
        scene.place((0.0, 0.0, -0.8))
        scene.set_thrust(thrust)
        for _ in range(20):
            scene.step()
            ends.append(np.concatenate([scene.numpy("position")[0, 0], *scene.pose("crate")]))
        return np.stack(ends)

    water = Water(drift_std=(0.05, 0.05, 0.0))
    first, second = (Scene("finsrov", pool=Pool(), objects=CRATE, water=water, seed=4) for _ in range(2))
    once = trajectory(first)
    np.testing.assert_array_equal(once, trajectory(second))
    still = Scene("finsrov", pool=Pool(), objects=CRATE)
    np.testing.assert_array_equal(trajectory(still), trajectory(still))


def thing(text):
    """A world's object of that kind."""
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
    """A closed block whose top falls by 0.3 to its middle line, as an STL of text: its convex hull would be level."""
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
def test_a_vehicle_rests_where_it_rests_in_the_batch(floor, tmp_path):
    """Heavy by 5 %, let go above each solid of a drawn world: pose as in the simulator, whose contacts give in.

    The spheres of its hull lie a tenth of the least half extent inside the faces, and its penalties a few millimetres.
    """
    head = (
        "about: A site.\nwater: {attenuation: [0, 0, 0], veil: [0, 0, 0], daylight_attenuation: [0, 0, 0]}\n"
    )
    tail = "\ncontact: {friction: 2.0}\nviewpoint: {position: [0, 0, -5]}\n"
    (tmp_path / "site.yaml").write_text(head + FLOORS[floor] + tail, encoding="utf-8")
    write_hollow(tmp_path / "hollow.stl")
    vehicle = FINSROV.replace({"body.displaced_volume": 0.95 * FINSROV.body.mass / FINSROV.water.density})
    layout, poses = WorldLayout(str(tmp_path / "site.yaml")), []
    for one in (Scene(vehicle, world=layout), Simulator(vehicle, world=layout, threads=1)):
        layout.draw(5)
        one.place((1.4, 0.6, -5.6) if floor == "seabed" else (0.0, 0.0, -5.6))  # within one triangle
        for _ in range(80):
            one.step()
        poses.append((one.numpy("position")[0, 0].copy(), rotation(one.numpy("quaternion")[0, 0])))
    (x, R), (batch_x, batch_R) = poses
    half = 0.5 * np.array(FINSROV.body.size)
    assert np.abs(x - batch_x).max() < 0.1 * half.min() + 0.006
    assert np.abs(R - batch_R).max() < (0.1 * half.min() + 0.006) / half[1]


def test_a_vehicle_pushes_a_crate_along_the_floor():
    """A loose crate rests until the vehicle reaches it, then goes ahead of the bow."""
    scene = Scene(neutral(FINSROV, 0.05), pool=Pool(), objects=CRATE)
    disturb(scene, [15.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    scene.place((0.0, 0.0, -0.85))
    for _ in range(5):
        scene.step()
    assert scene.pose("crate")[0][0] == pytest.approx(0.6, abs=1e-6)
    for _ in range(45):
        scene.step()
    bow = scene.numpy("position")[0, 0, 0] + 0.28
    assert bow > 0.7
    assert scene.pose("crate")[0][0] - 0.1 == pytest.approx(bow, abs=0.02)


def test_a_tied_load_hangs_with_its_weight():
    """A 0.3 kg load on a joint below the vehicle: sinking steadily, the joint carries 2.943 N."""
    load_below = """<mujoco><worldbody>
      <body name='load' pos='0 0 -1.3'><freejoint/><geom type='sphere' size='.05' mass='0.3'/></body></worldbody>
      <equality><connect body1='vehicle0' body2='load' anchor='0 0 -.3'/></equality></mujoco>"""
    scene = Scene(neutral(FINSROV, 0.05), objects=load_below)
    scene.place((0.0, 0.0, -1.0))
    for _ in range(150):
        scene.step()
    np.testing.assert_allclose(scene.contact_wrench()[0, 0, :3], [0.0, 0.0, -0.3 * 9.81], atol=1e-3)


def test_changed_parameters_take_effect():
    """After `plant` is written to and refreshed, the scene moves, and touches, as one of a file with these numbers."""
    added = 2.0 * np.asarray(FINSROV.hydrodynamics["calibrated"].added_mass)
    built = Scene(FINSROV.replace({"body.mass": 13.0, "hydrodynamics.calibrated.added_mass": added.tolist()}))
    changed = Scene("finsrov")
    for name in ("mass", "inertia", "M_A"):
        changed.plant.fields[name].assign(built.plant.fields[name].numpy())
    changed.refresh()
    for scene in (changed, built):
        scene.place((0.0, 0.0, -3.0))
        scene.set_thrust(np.full(8, 2.0))
        for _ in range(5):
            scene.step()
        np.testing.assert_allclose(scene._inertia, inertia(built), rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(changed.numpy("velocity"), built.numpy("velocity"))


def test_vehicles_begin_side_by_side():
    """The first to the left, none touching another."""
    scene = Scene(together("finsrov", "rexrov", "finsrov"))
    scene.step()
    assert scene.contacts() == []
    assert np.all(np.diff(scene.numpy("position")[0, :, 1]) < 0.0)


def picture(scene, *args, **kwargs):
    """A picture, or the reason why this machine draws none."""
    try:
        return scene.render(*args, **kwargs).astype(int)
    except PictureError as error:
        pytest.skip(str(error))


def test_the_overhead_picture_shows_the_vehicle_where_it_is():
    """World x to the right, y up: the yellow of a vehicle at (1, 0.4) is right of the middle and above it."""
    scene = Scene("finsrov", pool=Pool())
    scene.place((1.0, 0.4, -0.3))
    seen = picture(scene, "overhead", 400, 300)
    assert seen.shape == (300, 400, 3)
    rows, columns = np.nonzero(seen[..., 0] > seen[..., 2] + 30)
    assert len(rows) > 200
    # half the picture's height is 1.65 m at the surface, 4 m below the camera; the vehicle is 4.3 m below it
    scale = 150.0 / 1.65 * 4.0 / 4.3
    assert columns.mean() - 199.5 == pytest.approx(1.0 * scale, abs=6.0)
    assert 149.5 - rows.mean() == pytest.approx(0.4 * scale, abs=6.0)


def test_every_camera_sees_something():
    """Cameras of the scene and of the objects, in pictures larger than MuJoCo's default and of one pixel."""
    scene = Scene(together("finsrov", "rexrov"), objects="<camera name='mine' pos='0 0 2'/>")
    for camera in ("overhead", "corner", "vehicle0_bow", "vehicle1_bow", "mine"):
        assert picture(scene, camera, 120, 90).std() > 1.0, camera
    assert picture(scene, "corner", 1280, 1100).shape == (1100, 1280, 3)
    assert picture(scene, "corner", 1, 1).shape == (1, 1, 3)
    with pytest.raises(
        PictureError, match="unknown camera 'side'; available: corner, mine, overhead, vehicle0_bow"
    ):
        scene.render("side")
    with pytest.raises(PictureError, match="0 x 90 pixels"):
        scene.render(width=0, height=90)


@pytest.mark.slow
def test_pictures_of_two_scenes_do_not_disturb_each_other():
    """A scene that is thrown away takes nothing of another's pictures along."""
    kept = Scene("finsrov", pool=Pool())
    first = picture(kept, "corner")
    for _ in range(3):
        picture(Scene("rexrov"), "corner")
    np.testing.assert_array_equal(picture(kept, "corner"), first)
    kept.close()
    np.testing.assert_array_equal(picture(kept, "corner"), first)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"objects": "<geom type='bx'/>"}, r"objects of the scene: .*'bx'"),
        ({"objects": "<body name='vehicle0'/>"}, r"objects of the scene: .*repeated name 'vehicle0'"),
        ({"objects": Path("nowhere.xml")}, r"objects of the scene: .*nowhere\.xml"),
        ({"collision": "sphere"}, "unknown collision shape 'sphere'; available: envelope, hull"),
        ({"substeps": 0}, "substeps=0"),
        ({"control_step": -1.0}, "control_step"),
        ({"hydrodynamics": "fosen"}, "unknown hydrodynamic model 'fosen'"),
    ],
)
def test_what_cannot_be_is_refused_in_a_sentence(options, sentence):
    with pytest.raises(SimulatorError, match=sentence):
        Scene("finsrov", **options)


def test_without_mujoco_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(SimulatorError, match=r"pip install 'finssim\[mujoco\]'"):
        Scene("finsrov")


def test_a_number_that_is_not_finite_stops_the_scene(tmp_path, monkeypatch):
    """It stands still, says so at every step, and moves again when it is placed anew."""
    monkeypatch.chdir(tmp_path)
    scene = Scene("finsrov", pool=Pool())
    disturb(scene, np.full(6, 1e38))
    for _ in range(2):
        with pytest.raises(SimulatorError, match="stopped being finite"):
            scene.step()
    disturb(scene, np.zeros(6))
    scene.place((0.0, 0.0, -0.5))
    scene.step()
    assert np.isfinite(scene.numpy("velocity")).all()
    assert scene.time == pytest.approx(0.1)
    with pytest.raises(SimulatorError, match="unknown body 'crate'; available: world, vehicle0"):
        scene.pose("crate")
    assert list(tmp_path.iterdir()) == []
