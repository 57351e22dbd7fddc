"""Robots of uuv_simulator move by its equations; xacro is harmless, and nothing is lost silently."""

import json
import math
from copy import deepcopy
from xml.etree.ElementTree import fromstring

import numpy as np
import pytest

from finssim import acceleration
from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.core import mesh
from finssim.vehicles import VehicleError, load_vehicle
from finssim.vehicles.importers import uuv
from finssim.vehicles.importers.draft import read_foreign
from finssim.vehicles.importers.urdf import read_urdf
from finssim.vehicles.importers.xacro_file import evaluate, expanded, packages_near
from reference import gz_sim
from reference.imported import assert_moves_alike, imported, simulated, unnoticed
from reference.uuv import LAUV, REXROV, SAGA, Origin, euler, text


def write(folder, content, name="robot.xacro"):
    path = folder / name
    path.write_text(content)
    return path


def refusal(folder, content):
    with pytest.raises(VehicleError) as error:
        read_foreign(write(folder, content))
    assert str(error.value).startswith(str(folder)) and "\n" not in str(error.value)
    return str(error.value)


# Motion


@pytest.mark.slow
@pytest.mark.parametrize(
    ("robot", "force", "ahead"),
    [
        (REXROV, [800.0, 800.0, -1500.0, 200.0, 200.0, 200.0], (0.0, 0.0)),
        (LAUV, [10.0, 10.0, -10.0, 0.05, 2.0, 2.0], (20.0, 1.2)),
        (SAGA, [10.0, 10.0, -10.0, 1.0, 2.0, 1.0], (0.0, 0.0)),
    ],
    ids=lambda x: getattr(x, "name", ""),
)
def test_it_moves_as_the_equations_of_uuv_simulator(tmp_path, robot, force, ahead):
    """Within 1 % at all times, with coupled added mass, full damping and a centre of gravity off the origin.

    The torpedo moves ahead, because astern uuv_simulator changes the sign of the damping by forward speed.
    """
    path = write(tmp_path, text(robot))
    assert_moves_alike(imported(path), Origin(robot), force, tolerance=0.01, ahead=ahead)


@pytest.mark.slow
def test_terminal_speeds_and_the_speed_of_floating_up(tmp_path):
    """Along each axis the linear drag balances the force."""
    still = {"sensor": (0.001, (0.0, 0.0, 0.0)), "prop": 1e-9}
    light, neutral = (imported(write(tmp_path, text(SAGA, neutral=n, **still))) for n in (False, True))
    tau, rest = np.zeros((4, 6)), np.repeat(np.eye(3)[None], 4, axis=0)
    tau[0, 0], tau[1, 1], tau[2, 2], tau[3, 5] = 10.0, 10.0, -20.0, 1.0
    end = simulated(neutral, rest, np.zeros((4, 6)), tau, 20.0)[-1]
    expected = [10.0 / 11.7391, 10.0 / 20.0, -20.0 / 31.8678, 1.0 / 5.0]
    assert [end[0, 0], end[1, 1], end[2, 2], end[3, 5]] == pytest.approx(expected, rel=2e-3)
    up = simulated(light, rest[:1], np.zeros((1, 6)), np.zeros((1, 6)), 20.0)[-1, 0, 2]
    assert up == pytest.approx(9.8 * (1028.0 * SAGA.volume - 10.001) / 31.8678, rel=2e-3)


FIN = """<link name="lauv/fin{id}"/>
<joint name="lauv/fin{id}_joint" type="revolute"><limit effort="0" lower="-0.9" upper="0.8" velocity="0"/>
  <origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="0 0 1"/>
  <parent link="lauv/base_link"/><child link="lauv/fin{id}"/></joint>
<gazebo><plugin name="fin{id}" filename="libuuv_fin_ros_plugin.so">
  <dynamics><type>FirstOrder</type><timeConstant>0.2</timeConstant></dynamics><liftdrag>{law}</liftdrag>
  <current_velocity_topic>current_velocity</current_velocity_topic><fin_id>{id}</fin_id>
  <link_name>lauv/fin{id}</link_name><joint_name>lauv/fin{id}_joint</joint_name></plugin></gazebo>
"""
QUADRATIC = "<type>Quadratic</type><lift_constant>9.87</lift_constant><drag_constant>6.51</drag_constant>"
LINES = (
    "<type>TwoLines</type><area>0.04</area><fluid_density>1027</fluid_density><a0>0</a0><alpha_stall>0.6</alpha_stall>"
    "<cla>3.5</cla><cla_stall>0</cla_stall><cda>0.2</cda><cda_stall>0</cda_stall>"
)


def finned(*fins):
    parts = "".join(FIN.format(id=i, xyz=xyz, rpy=rpy, law=law) for i, (xyz, rpy, law) in enumerate(fins))
    return text(LAUV).replace("</robot>", f"{parts}</robot>")


def uuv_fin(place, turn, law, nu, deflection):
    """Return a fin's wrench about the base link by FinPlugin.cc and LiftDragModel.cc, in the xy plane of its
    link."""
    c, s = np.cos(deflection), np.sin(deflection)
    link = turn @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    v = link.T @ (nu[:3] + np.cross(nu[3:], place))
    v[2] = 0.0
    angle, square = np.arctan2(v[1], v[0]), v @ v
    if law is QUADRATIC:
        lift, drag = 9.87 * angle * square, 6.51 * angle**2 * square
    else:
        lift, drag = (0.5 * 1027 * 0.04 * x * angle * square for x in (3.5, 0.2))
    ahead = v / np.linalg.norm(v)
    force = link @ (lift * -np.cross([0.0, 0.0, 1.0], ahead) - drag * ahead)
    return np.concatenate([force, np.cross(place, force)])


def test_fins_act_as_in_uuv_simulator(tmp_path):
    """At random velocities and deflections below stall, forces and moments of each model agree to 0.1 %."""
    places = [("-0.4 0 0.04", "0 0 0", QUADRATIC), ("-0.7 0.08 0.07", "-0.79 -0.1 0.1", LINES)]
    vehicle = imported(write(tmp_path, finned(*places)))
    assert list(vehicle.actuators) == ["fin_0", "fin_1"] and vehicle.actuators["fin_0"].time_constant == 0.2
    assert (vehicle.actuators["fin_1"].minimum, vehicle.actuators["fin_1"].maximum) == (-0.9, 0.8)
    bare, rng = imported(write(tmp_path, text(LAUV), "bare.xacro")), np.random.default_rng(8)
    for _ in range(20):
        nu = np.array([1.5, 0, 0, 0, 0, 0]) + 0.05 * rng.normal(size=6)
        angles = rng.uniform(0.2, 0.4, 2)  # of one sign: drag of TwoLines has the sign of the angle
        eta = [0.0, 0.0, -50.0, 0.0, 0.0, 0.0]
        found = acceleration(vehicle, eta, nu, actuators=[0.0, *-angles]) - acceleration(bare, eta, nu)
        expected = np.zeros(6)
        for (xyz, rpy, law), angle in zip(places, angles, strict=True):
            place, turn = np.array(xyz.split(), float), euler(*map(float, rpy.split()))
            expected += uuv_fin(place, turn, law, nu, -angle)
        found = vehicle.mass_matrix() @ found
        assert np.abs(found - expected).max() < 2e-3 * np.abs(expected).max()


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("Quadratic", "Cubic", "liftdrag: type is 'Cubic', expected Quadratic or TwoLines"),
        ("<lift_constant>9.87", "<lift_constant>-9.87", "expected a lift_constant above 0"),
        ("<fin_id>0", "<fin_id>one", "expected fins of different integers"),
        ("<joint_name>lauv/fin0_joint", "<joint_name>none", "fin 0: no joint 'none'"),
    ],
)
def test_refusals_of_fins_are_sentences(tmp_path, old, new, sentence):
    content = finned(("-0.4 0 0.04", "0 0 0", QUADRATIC))
    assert old in content and sentence in refusal(tmp_path, content.replace(old, new, 1))


# Conversions, one by one


def hydrodynamic_model(**words):
    inner = "".join(f"<{word}>{value}</{word}>" for word, value in words.items())
    return fromstring(f"<hydrodynamic_model>{inner}</hydrodynamic_model>")


def test_models_of_shapes():
    """These are the shapes of HydrodynamicModel.cc, with its 1028 kg/m³ and its disc without length."""
    sphere = uuv.coefficients(hydrodynamic_model(type="sphere", radius=0.1), None, "m")
    assert sphere["added_mass"][0, 0] == pytest.approx(2.0 / 3.0 * 1028.0 * math.pi * 1e-3)
    assert sphere["quadratic_damping"][2, 2] == pytest.approx(0.25 * 1028.0 * math.pi * 0.01)
    smallest = uuv.coefficients(hydrodynamic_model(type="sphere"), [0.3, 0.1, 0.2], "m")
    assert all(np.array_equal(smallest[word], sphere[word]) for word in sphere)
    cylinder = uuv.coefficients(
        hydrodynamic_model(type="cylinder", radius=0.1, length=0.5, axis="j"), None, "m"
    )
    disc = 1028.0 * math.pi * 0.01
    assert np.diag(cylinder["added_mass"]) == pytest.approx(
        [0.5 * disc, disc, 0.5 * disc, disc * 0.125 / 12.0, 0.0, disc * 0.125 / 12.0]
    )
    assert np.diag(cylinder["quadratic_damping"])[:3] == pytest.approx(
        [0.5 * 0.74 * 0.05 * 1028.0, 0.5 * 0.87 * disc, 0.5 * 0.74 * 0.05 * 1028.0]
    )
    for words, sentence in (
        ({"type": "cube"}, "type is 'cube'"),
        ({"type": "box"}, "leaves unfinished"),
        ({"type": "cylinder", "radius": 1, "length": 2}, "axis is ''"),
        (
            {"type": "fossen", "linear_damping": "1 0 0 0 0 0"},
            "linear_damping has a diagonal number of the wrong sign",
        ),
        ({"type": "fossen", "added_mass": "1 2 3"}, "expected 36 numbers"),
        ({"type": "fossen", "added_mass": " ".join(map(str, range(36)))}, "not symmetric"),
    ):
        with pytest.raises(VehicleError, match=sentence):
            uuv.coefficients(hydrodynamic_model(**words), None, "m")


@pytest.mark.parametrize(
    ("content", "points"),
    [
        ("<type>Basic</type><rotorConstant>-0.002</rotorConstant>", {100.0: 20.0, -50.0: -5.0}),
        (
            "<type>Bessa</type><rotorConstantL>0.001</rotorConstantL><rotorConstantR>0.002</rotorConstantR>"
            "<deltaL>-400</deltaL><deltaR>100</deltaR>",
            {100.0: 19.8, 10.0: 0.0, -30.0: -0.5},
        ),
        (
            "<type>LinearInterp</type><inputValues>-100 0 50 100</inputValues><outputValues>-10 0 2 12</outputValues>",
            {75.0: 7.0, -50.0: -5.0, 200.0: 12.0},
        ),
    ],
)
def test_thrust_curves(content, points):
    curve = uuv.conversion(fromstring(f"<conversion>{content}</conversion>"), "m")
    for speed, thrust in points.items():
        assert curve.thrust(speed) == pytest.approx(thrust)
        if thrust and speed < 200.0:
            assert curve.speed(thrust) == pytest.approx(speed)
    with pytest.raises(VehicleError, match="expected|unknown"):
        uuv.conversion(
            fromstring(f"<conversion>{content.replace('>-1', '>1').replace('rotorC', 'C')}</conversion>"), "m"
        )


def test_thrusters_have_places_axes_curves_and_limits(tmp_path):
    """They include a dead zone and efficiencies; reversed clamps are ignored, as in uuv_simulator."""
    more = (
        "</conversion><gain>2</gain><clampMin>-100</clampMin><clampMax>100</clampMax><thrustMax>5</thrustMax>"
        "<thrust_efficiency>0.5</thrust_efficiency><propeller_efficiency>0.8</propeller_efficiency>"
    )
    draft = read_foreign(write(tmp_path, text(SAGA, rotor=0.001).replace("</conversion>", more)))
    thruster = draft.vehicle(tmp_path).thrusters["thruster_2"]
    assert thruster.position.tolist() == [0.067, 0.0, 0.1258172] and thruster.axis == pytest.approx(
        [0.0, 0.0, 1.0]
    )
    assert thruster.c_plus == pytest.approx(0.5 * 0.001 * 0.64) and thruster.time_constant == 0.05
    assert thruster.force_max == 5.0 and thruster.force_min == pytest.approx(
        -0.5 * 0.001 * (0.8 * 200.0) ** 2
    )
    reversed_clamps = more.replace(">-100<", ">100<").replace("Max>100<", "Max>-100<")
    draft = read_foreign(write(tmp_path, text(SAGA, rotor=0.001).replace("</conversion>", reversed_clamps)))
    assert (
        "thrusters.thruster_0.force_min" in draft.guessed
        and "thrusters.thruster_0.force_max" not in draft.guessed
    )


def test_the_thruster_manager_of_the_robot_limits_its_thrusters(tmp_path):
    """The manager's file is in a package near the description, and names the robot."""
    for package, file, content in (
        ("saga_description", "robots/saga.xacro", text(SAGA)),
        (
            "saga_control",
            "config/thruster_manager.yaml",
            "thruster_manager: {tf_prefix: saga, max_thrust: 20}",
        ),
        ("a_control", "config/thruster_manager.yaml", "thruster_manager: {tf_prefix: other, max_thrust: 9}"),
    ):
        path = tmp_path / "stack" / package / file
        path.parent.mkdir(parents=True)
        path.write_text(content)
        (tmp_path / "stack" / package / "package.xml").write_text(
            f"<package><name>{package}</name></package>"
        )
    file = tmp_path / "stack/saga_description/robots/saga.xacro"
    assert set(packages_near(file)) == {"saga_description", "saga_control", "a_control"}
    thrusters = read_foreign(file).vehicle(tmp_path).thrusters
    assert (thrusters["thruster_0"].force_min, thrusters["thruster_0"].force_max) == (-20.0, 20.0)


def test_moments_that_no_body_has_are_kept_in_the_added_mass(tmp_path):
    """A public robot has 0.6, 30 and 35 kg m²; the sum of inertia and added mass is that of the file."""
    draft = read_foreign(write(tmp_path, text(LAUV, inertia=(0.6, 0, 0, 30.0, 0, 35.0))))
    vehicle = draft.vehicle(tmp_path)
    total = vehicle.mass_matrix()[5, 5]
    assert total == pytest.approx(35.0 + 1.3, rel=1e-3)
    assert any("no body has the inertia" in sentence for sentence in draft.different)


# Plain URDF with gz-sim's plugins


def test_a_urdf_with_the_plugins_of_gz_sim_is_the_vehicle_of_its_sdf(tmp_path):
    """URDF gives links, joints and shapes by attributes; the plugins are the same."""
    root, model = gz_sim.tree(gz_sim.HEAVY)
    parts = []
    for link in model.findall("link"):
        inertial, pose = link.find("inertial"), link.findtext("pose")
        tensor = " ".join(f'{x.tag}="{x.text}"' for x in inertial.find("inertia"))
        xyz = " ".join(inertial.findtext("pose").split()[:3])
        box = link.findtext("collision/geometry/box/size")
        at = " ".join((link.findtext("collision/pose") or "").split()[:3])
        shape = (
            f'<collision><origin xyz="{at}"/><geometry><box size="{box}"/></geometry></collision>'
            if box
            else ""
        )
        mass = f'<origin xyz="{xyz}"/><mass value="{inertial.findtext("mass")}"/><inertia {tensor}/>'
        parts.append(f'<link name="{link.get("name")}"><inertial>{mass}</inertial>{shape}</link>')
        joint = next((j for j in model.findall("joint") if j.findtext("child") == link.get("name")), None)
        if joint is not None:
            words = pose.split()
            parts.append(
                f'<joint name="{joint.get("name")}" type="continuous"><parent link="base_link"/>'
                f'<child link="{link.get("name")}"/><axis xyz="{joint.findtext("axis/xyz")}"/>'
                f'<origin xyz="{" ".join(words[:3])}" rpy="{" ".join(words[3:])}"/></joint>'
            )
    for plugin in model.findall("plugin"):
        inner = "".join(f"<{x.tag}>{x.text}</{x.tag}>" for x in plugin)
        parts.append(f'<gazebo><plugin name="{plugin.get("name")}" filename="x">{inner}</plugin></gazebo>')
    draft = read_foreign(write(tmp_path, f'<robot name="heavy">{"".join(parts)}</robot>', "heavy.urdf"))
    expected = read_foreign(gz_sim.write(tmp_path / "heavy.sdf", gz_sim.HEAVY))
    for section in ("body", "thrusters", "hydrodynamics"):
        assert draft.values[section] == expected.values[section]


# xacro


def test_expressions_have_numbers_and_no_code():
    assert evaluate("2*pi if wide else -x[1]", {"pi": math.pi, "wide": False, "x": [1.0, 3.0]}) == -3.0
    assert evaluate("'a' + str(1 <= 2 and 3)", {}) == "a3" and evaluate("math.cos(0) + max(1, 2)", {}) == 3.0
    for text_of, reason in (
        ("().__class__", "known namespace"),
        ("(lambda: ().__class__)()", "Call"),
        ("[x for x in (1,)]", "ListComp"),
        ("open('/etc/passwd')", "the function 'open'"),
        ("__import__('os')", "the function '__import__'"),
        ("'{0.__class__}'.format(1)", "Call"),
        ("10**10**10", "exponent"),
        ("(10**64)**5", "too large"),
        ("'a' * 10**9", "only numbers"),
        ("[0] * 10**9", "only numbers"),
        ("'a' % 3", "only numbers"),
        ("f'{1}'", "JoinedStr"),
        ("1" + "+1" * 600, "longer than 1000"),
        ("1/0", "division"),
        ("nothing", "nothing"),
        ("1 +", "invalid syntax"),
    ):
        with pytest.raises(VehicleError, match=reason):
            evaluate(text_of, {})


BODY = '<robot name="x" xmlns:xacro="http://www.ros.org/wiki/xacro">{}</robot>'


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ('<xacro:property name="a" value="${(lambda: ().__class__)()}"/><a>${a}</a>', "has no value"),
        ("<a>${xacro.load_yaml('/etc/passwd')}</a>", "Call is not read in an expression"),
        ("<a>$(eval ().__class__)</a>", "has no value"),
        ("<a>$(env HOME)</a>", "$(env HOME) is not read"),
        ("<a>$(cwd)</a>", "$(cwd) is not read"),
        ("<a>$(arg none)</a>", "argument 'none' has no default"),
        ("<a>$(find none)</a>", "$(find none): this package is not near the file"),
        ('<xacro:include filename="/etc/passwd"/>', "in no package near the file"),
        ('<xacro:include filename="../outside.xacro"/>', "in no package near the file"),
        ('<xacro:include filename="none.xacro"/>', "which is not there"),
        ('<xacro:include filename="robot.xacro"/>', "too often"),
        ('<xacro:macro name="m" params=""><xacro:m/></xacro:macro><xacro:m/>', "too often"),
        ("<a>${x}</a>", "the expression 'x' has no value"),
        ("<xacro:none/>", "unknown macro name: xacro:none"),
    ],
)  # fmt: skip
def test_xacro_runs_no_code_reads_no_other_file_and_ends(tmp_path, content, sentence, capsys):
    (tmp_path / "outside.xacro").write_text(BODY.format(""))
    folder = tmp_path / "package"
    folder.mkdir()
    assert sentence in refusal(folder, BODY.format(content))
    assert capsys.readouterr() == ("", "")


@pytest.mark.slow
def test_an_expansion_that_grows_without_end_is_refused(tmp_path):
    """Tested with ten macros that each call the next one ten times, and with texts that double."""
    tens = "".join(
        f'<xacro:macro name="m{i}" params="">{f"<xacro:m{i + 1}/>" * 10}</xacro:macro>' for i in range(9)
    )
    assert "expand to too much text" in refusal(
        tmp_path, BODY.format(f'{tens}<xacro:macro name="m9" params=""><a/></xacro:macro><xacro:m0/>')
    )
    doubles = "".join(f'<xacro:property name="p{i + 1}" value="${{p{i}}}${{p{i}}}"/>' for i in range(40))
    assert "expand to too much text" in refusal(
        tmp_path, BODY.format(f'<xacro:property name="p0" value="abcd"/>{doubles}<a>${{p40}}</a>')
    )


def test_includes_are_found_in_packages_and_in_given_folders(tmp_path):
    """They are found by package.xml around the file, or below a given folder."""
    far = tmp_path / "elsewhere/shapes"
    (far / "urdf").mkdir(parents=True)
    (far / "package.xml").write_text("<package><name>shapes</name></package>")
    (far / "urdf/box.xacro").write_text(BODY.format('<xacro:property name="a" value="${1 + 1}"/>'))
    own = tmp_path / "own"
    own.mkdir()
    file = write(own, BODY.format('<xacro:include filename="$(find shapes)/urdf/box.xacro"/><b>${a}</b>'))
    with pytest.raises(VehicleError, match="give its folder with --folder"):
        read_urdf(file)
    assert expanded(file, packages_near(file, [tmp_path / "elsewhere"])).findtext("b") == "2"


# Guesses, refusals and findings


def test_every_word_is_read_refused_or_named(tmp_path):
    """Tested with an x appended to the name of each element of the expanded file in turn."""
    path = write(tmp_path, text(SAGA))
    read = expanded(path, {})
    assert unnoticed(lambda: deepcopy(read), read_foreign, tmp_path / "robot.urdf") == []


def test_the_command_imports_and_lists(tmp_path, capsys):
    """Listed guesses are those of the file, factors are named, and the vehicle loads with its fin."""
    fin = FIN.format(id=0, xyz="-0.2 0 0", rpy="0 0 0", law=QUADRATIC).replace("lauv/", "saga/")
    content = text(SAGA).replace("</robot>", f"{fin}</robot>")
    content = content.replace(
        "<type>fossen</type>", "<type>fossen</type><scaling_damping>2</scaling_damping>"
    )
    path, out = write(tmp_path, content), tmp_path / "rov.yaml"
    assert boundary.run(app, ["vehicles", "import", str(path), "--out", str(out), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    vehicle = load_vehicle(out)
    guessed = {path for path, provenance in vehicle.provenance.items() if provenance.origin == "guessed"}
    assert guessed == {"water.gravity", "actuators.fin_0.area", "actuators.fin_0.lift_slope"} | {
        f"thrusters.thruster_{i}.{key}_{end}"
        for i in range(3)
        for key in ("force", "rpm")
        for end in ("min", "max")
    }
    rest = " | ".join(report["not read"])
    assert "scaling_damping (uuv_simulator" in rest and "fin" not in rest
    assert vehicle.actuators["fin_0"].maximum == 0.8
    assert vehicle.title == "saga (uuv_simulator)"
    assert vehicle.body.size.tolist() == [0.448, 0.2384, 0.28066] and vehicle.controlled_axes == (
        "surge",
        "heave",
        "yaw",
    )


def test_a_collision_mesh_of_the_displaced_volume_is_the_hull(tmp_path):
    """It may be given by file:// in the folder, and scaled; with another volume it is rejected with a
    sentence."""
    vertices, faces = mesh.parametric_hull([0.4, 0.3, 0.2], 0.011054)
    mesh.write_stl(tmp_path / "hull.stl", 1000.0 * vertices, faces)
    shape = f'<mesh filename="file://{tmp_path}/hull.stl" scale="0.001 0.001 0.001"/>'
    content = text(SAGA, neutral=False).replace('<box size="1 0.5 0.2"/>', shape)
    draft = read_foreign(write(tmp_path, content))
    assert draft.hull is not None and mesh.mesh_centroid(*draft.hull) == pytest.approx([0, 0, 0.1], abs=1e-6)
    draft = read_foreign(write(tmp_path, content.replace("0.001 0.001 0.001", "0.001 0.001 0.002")))
    assert draft.hull is None and any("is no hull" in sentence for sentence in draft.different)
    draft = read_foreign(write(tmp_path, content.replace(f"{tmp_path}/hull.stl", "/etc/passwd")))
    assert draft.hull is None and any("collision shapes" in text_of for text_of in draft.not_read)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("libuuv_underwater_object_ros", "libother", "0 plugins of underwater objects"),
        ("<volume>", "<metacentric_width>1</metacentric_width><volume>", "is a surface vessel"),
        ("<volume>", "<volme>1</volme><volume>", "unknown element 'volme'"),
        ("<type>fossen</type>", "", "type is ''"),
        ("<thrusterID>${id}</thrusterID>", "<thrusterID>1</thrusterID>", "expected different integers"),
        ("FirstOrder", "Second", "type is 'Second'"),
        ("<type>Basic</type>", "<type>Cubic</type>", "type is 'Cubic'"),
        ('<axis xyz="1 0 0"/>', '<axis xyz="0 0 0"/>', "expected a direction"),
        ('<child link="sensor"/>', '<child link="senor"/>', "no link 'senor'"),
        ('<child link="sensor"/>', '<child link="$(arg ns)/thruster_0"/>', "the child of two joints"),
        ('mass value="10.0"', 'mass value="nan"', "mass is 'nan'"),
        ("<robot ", "<robots ", "cannot be read as XML"),
    ],
)  # fmt: skip
def test_refusals_are_sentences(tmp_path, old, new, sentence):
    content = text(SAGA)
    assert old in content
    assert sentence in refusal(tmp_path, content.replace(old, new))


def test_older_names_of_the_plugins_are_read(tmp_path):
    """The older names lack uuv_ and ros."""
    old = text(SAGA).replace("libuuv_", "lib").replace("_ros_plugin", "_plugin")
    usual = read_foreign(write(tmp_path, text(SAGA)))
    assert read_foreign(write(tmp_path, old, "old.xacro")).values["thrusters"] == usual.values["thrusters"]


def test_other_dynamics_of_a_thruster(tmp_path):
    """Yoerger's and Bessa's shafts have a steady speed and no time constant; a clamp limits through it."""
    old = "<type>FirstOrder</type><timeConstant>${half / 10}</timeConstant>"
    for new, speed in (
        ("<type>Yoerger</type><alpha>0.02</alpha><beta>2</beta>", 100.0),
        ("<type>Bessa</type><Jmsp>2</Jmsp><Kv1>1</Kv1><Kv2>0.02</Kv2><Kt>6</Kt><Rm>2</Rm>", 100.0),
        ("<type>ZeroOrder</type>", 100.0),
    ):
        content = (
            text(SAGA)
            .replace(old, new)
            .replace("</conversion>", "</conversion><clampMax>100</clampMax><clampMin>-100</clampMin>")
        )
        draft = read_foreign(write(tmp_path, content))
        assert draft.values["thrusters"]["thruster_0"]["rpm_max"] == pytest.approx(speed * 30.0 / math.pi)
        assert "thrusters.thruster_0.time_constant" in draft.guessed
