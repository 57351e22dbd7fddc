"""Robots of Stonefish move by its equations, and nothing in their scenarios is lost silently."""

import json
import math
from copy import deepcopy
from xml.etree.ElementTree import fromstring, tostring

import numpy as np
import pytest

from finssim import acceleration
from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.core.mesh import MeshError, load_obj, load_stl, mesh_volume, write_stl
from finssim.vehicles import VehicleError, load_vehicle
from finssim.vehicles.importers import stonefish
from finssim.vehicles.importers.draft import read_foreign
from reference.gz_sim import element, euler
from reference.imported import imported, simulated, unnoticed
from reference.stonefish import DEAD, FLUID, RHO, TABLE, Origin, thruster, write


def changed(folder, old, new):
    """Return the scenario with a text of its robot replaced."""
    path = write(folder)
    robot = folder / "data/robot.scn"
    text = robot.read_text()
    assert old in text
    robot.write_text(text.replace(old, new))
    return path


def thruster_of(folder, text):
    return read_foreign(write(folder, text)).vehicle(folder).thrusters["t"]


# Motion


@pytest.mark.slow
def test_terminal_speeds_are_those_of_the_equations(tmp_path):
    """Forces through the centre of gravity, along and about each axis, and floating up agree within 1 %."""
    (tmp_path / "light").mkdir()
    vehicle, light = imported(write(tmp_path)), imported(write(tmp_path / "light", weight=20.0))
    origin, risen = Origin(), Origin(20.0)
    tau = np.diag([20.0, 20.0, -60.0, 0.3, 0.3, 4.0])[[0, 1, 2, 5]]
    tau[:, 3:] += np.cross(origin.centre, tau[:, :3])
    rest = np.repeat(np.eye(3)[None], 4, axis=0)
    found = simulated(vehicle, rest, np.zeros((4, 6)), tau, 8.0)[-1]
    expected = origin.run(rest, np.zeros((4, 6)), tau, 8.0, step=0.1)[1][-1]
    for row, axis in enumerate((0, 1, 2, 5)):
        assert found[row, axis] == pytest.approx(expected[row, axis], rel=0.01)
        assert abs(found[row, axis]) > 0.1
    one = np.zeros((1, 6))
    up = simulated(light, rest[:1], one, one, 8.0)[-1, 0, 2]
    assert up == pytest.approx(risen.run(rest[:1], one, one, 8.0, step=0.1)[1][-1, 0, 2], rel=0.01)
    net = 9.81 * (origin.mass - risen.mass)
    drag = np.abs(risen.water(np.array([0.0, 0.0, up, 0.0, 0.0, 0.0]))[2])
    assert drag == pytest.approx(net, rel=0.02)


@pytest.mark.slow
def test_steps_and_decays_are_those_of_the_equations(tmp_path):
    """At all times, decaying tilts and spins agree within 1 %; force steps, which also tilt it, within 2 %."""
    vehicle, origin = imported(write(tmp_path)), Origin()
    tau, nu, R = np.zeros((6, 6)), np.zeros((6, 6)), np.repeat(np.eye(3)[None], 6, axis=0)
    tau[0, 0], tau[1, 1] = 10.0, 10.0
    tau[:, 3:] += np.cross(origin.centre, tau[:, :3])
    R[2], R[3] = euler(0.3, 0.0, 0.0), euler(0.0, 0.3, 0.0)
    nu[4, 5], nu[5, 2] = 1.0, -0.5
    found = simulated(vehicle, R, nu, tau, 2.0)
    _, expected = origin.run(R, nu, tau, 2.0, step=0.025)
    for row, axis in enumerate((0, 1, 3, 4, 5, 2)):
        greatest = np.abs(expected[:, row, axis]).max()
        share = 0.02 if row < 2 else 0.01
        assert np.abs(found - expected[::2])[:, row, axis].max() < share * greatest and greatest > 0.05


# Conversions, one by one


def test_mass_and_buoyancy_are_sums_of_the_parts(tmp_path):
    """Parts are solids, shells and a mesh; internal ones have weight, only buoyant ones lift. The axes turn
    about x."""
    draft, origin = read_foreign(write(tmp_path)), Origin()
    body = draft.values["body"]
    assert body["mass"] == pytest.approx(origin.mass, rel=1e-9)
    assert body["center_of_gravity"] == pytest.approx(origin.centre, abs=1e-9)
    assert body["center_of_gravity"][2] < 0.0 < body["center_of_buoyancy"][2] + 0.02
    lift = sum(force for force, _ in origin.lifts)
    assert body["displaced_volume"] * RHO * 9.81 == pytest.approx(lift, rel=1e-9)
    assert draft.vehicle(tmp_path).mass_matrix() == pytest.approx(origin.rigid, rel=1e-3, abs=0.02)


def test_a_link_at_a_joint_is_a_part_of_the_body(tmp_path):
    """Moving a lamp to its own link at the same position gives the same body; the joint is fixed."""
    for name in "ab":
        (tmp_path / name).mkdir()
    usual = read_foreign(write(tmp_path / "a"))
    path = write(tmp_path / "b")
    file = tmp_path / "b/data/robot.scn"
    root = fromstring(file.read_text())
    robot, lamp = root.find("robot"), root.find(".//external_part[@name='lamp']")
    place = lamp.find("compound_transform").attrib
    root.find(".//base_link").remove(lamp)
    lamp.remove(lamp.find("compound_transform"))
    lamp.tag = "link"
    joint = element(robot, "joint", name="hinge", type="revolute")
    for tag, words in (("parent", {"name": "base"}), ("child", {"name": "lamp"}), ("origin", place)):
        element(joint, tag, **words)
    robot.append(lamp)
    file.write_bytes(tostring(root))
    draft = read_foreign(path)
    assert any("'hinge' (revolute)" in sentence for sentence in draft.different)
    for key, value in usual.values["body"].items():
        assert np.asarray(draft.values["body"][key]) == pytest.approx(np.asarray(value), abs=1e-9)
    found, expected = (x.vehicle(tmp_path).mass_matrix() for x in (draft, usual))
    assert found == pytest.approx(
        expected, rel=0.01, abs=0.1
    )  # the added mass acts on the centre of each link
    joint.find("parent").set("name", "nothing")
    file.write_bytes(tostring(root))
    with pytest.raises(VehicleError, match="holds to no link of the robot"):
        read_foreign(path)


def test_added_mass_of_shapes():
    """These are closed forms of SolidEntity.cpp; an ellipsoid has no moment about its length."""
    mass, turning = stonefish.added_mass("sphere", np.array([0.1]), 1000.0)
    assert mass.tolist() == pytest.approx([2.0 / 3.0 * math.pi] * 3) and not turning.any()
    mass, turning = stonefish.added_mass("cylinder", np.array([0.1, 2.0]), 1000.0)
    assert mass == pytest.approx(np.array([20.0, 20.0, 10.0]) * math.pi)
    assert turning == pytest.approx(np.array([1.0, 1.0, 0.0]) * 4.0 / 12.0 * math.pi)
    mass, turning = stonefish.added_mass("ellipsoid", np.array([0.5, 0.2, 0.1]), 1000.0)
    e = 1.0 - 0.15**2 / 0.5
    alpha = 2.0 * (1.0 - e**2) / e**2 * (0.5 * math.log((1.0 + e) / (1.0 - e)) - e)
    ball = 4.0 / 3.0 * math.pi * 1000.0 * 0.5
    assert mass == pytest.approx([alpha / (2.0 - alpha) * ball * 0.15**2, ball * 0.01, ball * 0.04])
    assert turning == pytest.approx(np.array([0.0, 0.04, 0.01]) * math.pi * 1000.0 * 0.125 / 12.0)


def test_the_ellipsoid_around_points_is_that_of_the_algorithm():
    """The algorithm's steps, written out point by point, agree on random points, nearly all of which are
    enclosed."""
    rng = np.random.default_rng(1)
    points = rng.normal(size=(60, 3)) * [1.0, 0.5, 0.2]
    weights = {}
    for k in range(3):
        for end in (min(range(60), key=lambda i: points[i][k]), max(range(60), key=lambda i: points[i][k])):
            weights[end] = 1.0 / 6.0
    sigma = [weights.get(i, 0.0) for i in range(60)]
    for step in range(11):
        mean = [sum(s * p[k] for s, p in zip(sigma, points, strict=True)) for k in range(3)]
        square = [sum(s * p[k] ** 2 for s, p in zip(sigma, points, strict=True)) for k in range(3)]
        spread = [square[k] - mean[k] ** 2 for k in range(3)]
        reach = [sum((p[k] - mean[k]) ** 2 / (3.0 * spread[k]) for k in range(3)) for p in points]
        worst = max(range(60), key=lambda i: reach[i])
        excess = reach[worst] - 1.0
        if excess <= 1.2 ** (2.0 / 3.0) - 1.0 or step == 10:
            break
        share = excess / (4.0 * (1.0 + excess))
        sigma = [(1.0 - share) * s for s in sigma]
        sigma[worst] += share
    assert step > 0
    assert stonefish.enclosing_ellipsoid(points) == pytest.approx([math.sqrt(3.0 * x) for x in spread])


def test_drag_of_a_plate_and_of_a_box():
    """The side facing the flow has form drag, all sides have skin friction; in rotation friction grows with
    radius."""
    box = stonefish.box_mesh(np.array([0.5, 1.0, 1.5]))
    form, skin = stonefish.drag(box, np.zeros(3), np.array([2.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert form[0] == pytest.approx([-6.0 * 4.0, 0.0, 0.0]) and form[1] == pytest.approx(
        np.zeros(3), abs=1e-9
    )
    assert skin[0] == pytest.approx([-2.0 * (2.0 * 3.0 + 2.0 * 2.0), 0.0, 0.0])
    _, skin = stonefish.drag(box, np.zeros(3), np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0]))
    sides = (
        2 * 1.0 * 3.0 * 1.0**2 + 2 * 2.0 * 3.0 * 0.5**2
    )  # at y = ±1 and x = ±0.5: v along the side is the distance
    ends = 2 * (1.0 * 2.0) * (1.0**2 + 2.0**2) / 12.0
    assert skin[1] == pytest.approx([0.0, 0.0, -(sides + ends)], rel=0.01)


def test_moments_of_a_mesh_are_those_of_its_solid():
    vertices, faces = stonefish.box_mesh(np.array([0.5, 1.0, 1.5]))
    found = stonefish.mesh_moments(vertices[faces], 2.0)
    assert found == pytest.approx(12.0 / 12.0 * np.diag([4.0 + 9.0, 1.0 + 9.0, 1.0 + 4.0]), abs=1e-12)


# Thrusters


def test_a_thruster_of_fluid_dynamics(tmp_path):
    """The thrust is ρ D⁴ k n², along x of its origin; z points down in Stonefish."""
    thrusters = imported(write(tmp_path)).thrusters
    surge, dive = thrusters["a"], thrusters["d"]
    assert surge.axis.tolist() == [1.0, 0.0, 0.0] and surge.position.tolist() == [-0.2, 0.2, 0.0]
    assert dive.axis == pytest.approx([0.0, 0.0, -1.0]) and dive.position.tolist() == [0.0, 0.0, -0.1]
    factor = RHO * 1e-4 / (4.0 * math.pi**2)
    assert surge.c_plus == pytest.approx(0.4 * factor) and surge.c_minus == pytest.approx(0.3 * factor)
    assert surge.rpm_max == pytest.approx(200.0 * 30.0 / math.pi) and surge.time_constant == 0.1
    assert surge.torque_constant == pytest.approx(0.02 * 0.1 * factor)  # a right propeller's, on the water


def test_a_left_propeller_pushes_back_with_its_forward_side(tmp_path):
    """Its thrust changes sign if the model has no handedness."""
    (tmp_path / "r").mkdir()
    (tmp_path / "l").mkdir()
    right = thruster_of(tmp_path / "r", thruster("t", "0 0 0", "0 0 0", DEAD))
    left = thruster_of(tmp_path / "l", thruster("t", "0 0 0", "0 0 0", DEAD, "false"))
    assert right.force_max == pytest.approx(0.002 * (40000.0 - 100.0))
    assert right.force_min == pytest.approx(-0.001 * (40000.0 - 400.0))
    assert (left.force_max, left.force_min) == (-right.force_min, -right.force_max)
    assert right.dead_rpm_plus == pytest.approx(10.0 * 30.0 / math.pi, rel=1e-3)


@pytest.mark.parametrize(
    ("dynamics", "speed", "lag"),
    [
        ('type="zero_order">', 200.0, None),
        ('type="mechanical_pi"><rotor_inertia value="0.2"/><kp value="4"/>', 200.0, 0.05),
        ('type="mechanical_pi"><kp value="4"/>', 200.0, None),
        ('type="yoerger"><alpha value="0.02"/><beta value="1"/>', 100.0, None),
        ('type="bessa"><kv1 value="1"/><kv2 value="0.01"/><kt value="2"/><rm value="2"/>', 100.0, None),
    ],
)  # fmt: skip
def test_dynamics_of_a_rotor(tmp_path, dynamics, speed, lag):
    text = thruster("t", "0 0 0", "0 0 0", FLUID, dynamics=dynamics)
    draft = read_foreign(write(tmp_path, text))
    found = draft.values["thrusters"]["t"]
    assert found["rpm_max"] == pytest.approx(speed * 30.0 / math.pi)
    assert ("thrusters.t.time_constant" in draft.guessed) == (lag is None)
    assert lag is None or found["time_constant"] == pytest.approx(lag)


def test_thrust_from_a_table_and_of_the_old_syntax(tmp_path):
    """Limits are the ends of the table; thrust_coeff and max_rpm in the specs are the syntax before version
    1.4."""
    for name in "ab":
        (tmp_path / name).mkdir()
    table = thruster_of(tmp_path / "a", thruster("t", "0 0 0", "0 0 0", TABLE))
    assert (table.force_min, table.force_max) == (-20.0, 30.0)
    old = """<actuator name="t" type="thruster"><link name="base"/><origin xyz="0 0 0" rpy="0 0 0"/>
      <specs thrust_coeff="0.5" max_rpm="600"/><propeller diameter="0.2" right="true"/></actuator>"""
    found = thruster_of(tmp_path / "b", old)
    assert found.force_max == pytest.approx(RHO * 0.2**4 * 0.5 * 100.0) and found.rpm_max == pytest.approx(
        600.0
    )
    assert found.time_constant == pytest.approx(0.125)


def test_a_simple_thruster_is_a_force(tmp_path):
    text = """<actuator name="t" type="simple_thruster"><link name="base"/><origin xyz="0 0 0" rpy="0 0 0"/>
      <specs lower_thrust_limit="-10" upper_thrust_limit="20"/><propeller right="true"/></actuator>"""
    draft = read_foreign(write(tmp_path, text))
    found = draft.vehicle(tmp_path).thrusters["t"]
    assert (found.domain, found.force_min, found.force_max) == ("force", -10.0, 20.0)
    assert "thrusters.t.rpm_max" in draft.guessed and "thrusters.t.force_max" not in draft.guessed


# Files, guesses, refusals


def test_the_robot_alone_needs_its_materials(tmp_path):
    """A file that the scenario includes lacks the densities."""
    write(tmp_path)
    with pytest.raises(VehicleError, match="material 'Foam' is in no file that was read: give the scenario"):
        read_foreign(tmp_path / "data/robot.scn")


def test_files_are_those_near_the_scenario(tmp_path):
    """Paths may not lead upwards, be absolute or pass through a link; files in a given folder are found."""
    path = write(tmp_path)
    robot = tmp_path / "data/robot.scn"
    (tmp_path / "scenarios/link.obj").symlink_to("/etc/passwd")
    for name in ("../data/keel.obj", "/etc/passwd", "none.obj", "link.obj", "$(find none)/keel.obj", ""):
        with pytest.raises(VehicleError, match="near the scenario: give its folder with --folder"):
            read_foreign(changed_name(robot, name, path))
    (tmp_path / "far").mkdir()
    (tmp_path / "data/keel.obj").rename(tmp_path / "far/keel.obj")
    assert (
        read_foreign(changed_name(robot, "keel.obj", path), [tmp_path / "far"]).values["body"]["mass"] > 70.0
    )


def changed_name(robot, name, path):
    root = fromstring(robot.read_text())
    root.find(".//physical/mesh").set("filename", name)
    robot.write_bytes(tostring(root))
    return path


def test_an_include_that_is_missing_is_named(tmp_path):
    path = write(tmp_path)
    path.write_text(path.read_text().replace("<include", '<include file="sea_floor.scn"/><include', 1))
    assert any("sea_floor.scn" in text for text in read_foreign(path).not_read)
    path.write_text(path.read_text().replace('file="robot.scn"', 'file="robt.scn"'))
    with pytest.raises(VehicleError, match="has no robot"):
        read_foreign(path)


def test_a_scenario_that_includes_itself_ends(tmp_path):
    path = write(tmp_path)
    path.write_text(path.read_text().replace("<include", '<include file="sea.scn"/><include', 1))
    with pytest.raises(VehicleError, match="includes more than 50 files"):
        read_foreign(path)


def test_a_robot_that_starts_upside_down_is_turned(tmp_path):
    """Its body axes are those in which it is level; then z of base_link is up."""
    path = changed(tmp_path, 'xyz="0 0 2" rpy="0 0 1.0"', 'xyz="0 0 2" rpy="0 3.141592653589793 1.0"')
    draft = read_foreign(path)
    assert any("upside down" in sentence for sentence in draft.different)
    (tmp_path / "other").mkdir()
    usual = read_foreign(write(tmp_path / "other")).values
    turned = draft.values
    assert turned["body"]["center_of_gravity"][2] == pytest.approx(-usual["body"]["center_of_gravity"][2])
    assert turned["thrusters"]["a"]["axis"] == pytest.approx([-1.0, 0.0, 0.0], abs=1e-9)
    assert turned["thrusters"]["a"]["position"][:2] == pytest.approx([0.2, 0.2])


def test_every_word_of_the_robot_is_read_refused_or_named(tmp_path):
    """Tested with an x appended to the name of each element in turn; in purely visual parts it changes
    nothing."""
    path = write(tmp_path)
    root = fromstring((tmp_path / "data/robot.scn").read_text())
    world = fromstring(path.read_text())
    world.remove(world.find("include"))
    world.extend(deepcopy(list(root)))
    for propeller in world.iter("propeller"):
        for child in list(propeller):
            propeller.remove(child)
    found = set(unnoticed(lambda: deepcopy(world), read_foreign, tmp_path / "scenarios/all.scn"))
    assert found <= {"nedx", "oceanx", "waterx", "materialx", "hydrodynamicsx", "massx"}


RUDDER = """<actuator name="Tail fin" type="rudder"><link name="base"/><origin xyz="-0.5 0.02 0.1" rpy="0.3 0 0.1"/>
<specs lift_coeff="2.5" drag_coeff="0.8" area="0.02" max_angle="0.4" max_angular_rate="0.9" inverted="{inverted}"/>
</actuator>
"""


def test_a_rudder_acts_as_in_stonefish(tmp_path):
    """Lift ½ρ A C_L a V² along -z × v and drag by C_D a² in its own frame, z down, at random speeds and
    angles."""
    first, second, third, fourth = (tmp_path / name for name in "abcd")
    for folder in (first, second, third, fourth):
        folder.mkdir()
    bare = read_foreign(write(first)).vehicle(first)
    path = changed(second, "<world_transform", RUDDER.format(inverted="false") + "<world_transform")
    vehicle = read_foreign(path).vehicle(tmp_path)
    fin, rho, rng = vehicle.actuators["Tail_fin"], vehicle.water.density, np.random.default_rng(2)
    assert (fin.maximum, fin.minimum, fin.rate_limit) == (0.4, -0.4, 0.9)
    place, turn = np.array([-0.5, 0.02, 0.1]), euler(0.3, 0.0, 0.1)
    flip = np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])
    for _ in range(10):
        nu = np.array([1.4, 0, 0, 0, 0, 0]) + 0.05 * rng.normal(size=6)  # z down
        angle = rng.uniform(-0.3, 0.3)
        c, s = np.cos(angle), np.sin(angle)
        own = turn @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        v = own.T @ (nu[:3] + np.cross(nu[3:], place))
        v[2] = 0.0  # of the flow along the rudder, which counts in Stonefish: one part in a thousand
        attack, q = np.arctan2(v[1], v[0]), 0.5 * rho * 0.02 * (v @ v)
        ahead = v / np.linalg.norm(v)
        force = own @ (2.5 * attack * q * np.cross([0.0, 0.0, -1.0], ahead) - 0.8 * attack**2 * q * ahead)
        expected = np.concatenate([force, np.cross(place, force)])
        channels = np.zeros(len(vehicle.channel_names))
        still, eta = channels[:-1].copy(), [0.0, 0.0, -50.0, 0.0, 0.0, 0.0]
        channels[-1] = angle
        found = acceleration(vehicle, eta, nu * flip, actuators=channels)
        found = vehicle.mass_matrix() @ (found - acceleration(bare, eta, nu * flip, actuators=still)) * flip
        assert np.abs(found - expected).max() < 5e-3 * np.abs(expected).max()
    path = changed(third, "<world_transform", RUDDER.format(inverted="true") + "<world_transform")
    assert any("inverted" in sentence for sentence in read_foreign(path).different)
    path = changed(fourth, "<world_transform", RUDDER.replace('0.02"', '0"') + "<world_transform")
    with pytest.raises(VehicleError, match="expected lift_coeff, area and max_angle above 0"):
        read_foreign(path)


def test_the_command_imports_and_lists(tmp_path, capsys):
    """Listed guesses are those of the file; sensors, servos and ROS messages are named."""
    more = '<sensor name="imu"/><ros_subscriber thrusters="/x"/><actuator name="r" type="servo"/><world_transform'
    path, out = changed(tmp_path, "<world_transform", more), tmp_path / "rov.yaml"
    assert boundary.run(app, ["vehicles", "import", str(path), "--out", str(out), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    guessed = {p for p, provenance in load_vehicle(out).provenance.items() if provenance.origin == "guessed"}
    assert guessed == {"water.gravity", "body.size", "body.surface_half_height"}
    rest = " | ".join(report["not read"])
    for word in ("sensor of the robot", "robot: ros_subscriber", "actuator servo"):
        assert word in rest


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('type="box"', 'type="torus"', "type is 'torus'"),
        ('physics="floating" buoyant', 'physics="foo" buoyant', "physics is 'foo'"),
        ('type="compound" physics="submerged"', 'type="compound" physics="surface"', "physics is 'surface'"),
        ('radius="0.06"', 'radius="nan"', "radius is 'nan'"),
        ('radius="0.06"', 'radius="-1"', "expected more than 0"),
        ('<material name="Foam"/>', "", "material: name is missing"),
        ("<dimensions xyz", "<dimension xyz", "unknown element 'dimension'"),
        ('type="fluid_dynamics"', 'type="magic"', "thrust_model is 'magic'"),
        ('type="first_order"', 'type="second_order"', "rotor_dynamics is 'second_order'"),
        ("${100.0*2.0}", "${().__class__}", "has no value"),
        ("${100.0*2.0}", "$(arg speed)", "is '$(arg speed)', expected a number"),
        ('<link name="base"/>', '<link name="bse"/>', "its link 'bse' is not of the robot"),
        ('name="b" type="thruster"', 'name="a" type="thruster"', "is there twice"),
        ('type="thruster"', 'type="warp"', "unknown type 'warp'"),
        ("base_link", "base_lnk", "unknown element 'base_lnk'"),
        ('<base_link name="base" type="compound"', '<base_link name="base" type="box"', "origin is missing"),
    ],
)  # fmt: skip
def test_refusals_are_sentences(tmp_path, old, new, sentence):
    path = changed(tmp_path, old, new)
    with pytest.raises(VehicleError) as error:
        read_foreign(path)
    assert sentence in str(error.value) and str(error.value).startswith(str(tmp_path))


def test_obj_is_read_as_polygons(tmp_path):
    """Faces by numbers, also negative ones, with normals and textures, give the same solid as the STL."""
    write(tmp_path)
    vertices, faces = load_obj(tmp_path / "data/keel.obj")
    assert mesh_volume(vertices, faces) == pytest.approx(1000.0 * 0.3 * 0.04 * 0.1) and len(faces) == 12
    write_stl(tmp_path / "keel.stl", vertices, faces)
    assert mesh_volume(*load_stl(tmp_path / "keel.stl")) == pytest.approx(mesh_volume(vertices, faces))
    file = tmp_path / "a.obj"
    file.write_text("o a\nv 0 0 0\nv 1 0 0\nvn 0 0 1\nv 0 1 0\nf -3//1 2/1 3/1/1\n")
    assert load_obj(file)[1].tolist() == [[0, 1, 2]]
    for text, sentence in (("v 0 0\nf 1 1 1", "OBJ"), ("v 0 0 0", "no polygon"), ("v 0 0 0\nf 1 2 3", "no polygon"),
                           ("v 0 0 nan\nf 1 1 1", "not a number"), ("v 0 0 x\nf 1 1 1", "OBJ")):  # fmt: skip
        file.write_text(text)
        with pytest.raises(MeshError, match=sentence):
            load_obj(file)
