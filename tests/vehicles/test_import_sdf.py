"""Vehicles of gz-sim move by gz-sim's equations, and nothing in their files is lost silently."""

import json
import math
from xml.etree.ElementTree import tostring

import numpy as np
import pytest

from finssim import acceleration
from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.core import mesh
from finssim.core.importer import check_registered
from finssim.core.registry import IMPORTERS, RegistryError
from finssim.core.rotations import matrix_to_quat
from finssim.vehicles import VehicleError, load_vehicle
from finssim.vehicles.importers import sdf
from finssim.vehicles.importers.draft import read_foreign
from finssim.vehicles.importers.model import pose_of, shape_volume
from finssim.vehicles.importers.rigid import LinkPose
from reference import gz_sim
from reference.gz_sim import BASE, EXPLICIT, HEAVY, TETHYS, Origin, element, euler, tree, write
from reference.imported import adding, assert_moves_alike, setting, simulated, unnoticed


def imported(folder, model):
    return read_foreign(write(folder / f"{model.name}.sdf", model)).vehicle(folder)


def changed(folder, change, model=HEAVY):
    """Return the draft of a model whose `sdf` element was changed."""
    root, _ = tree(model)
    change(root)
    path = folder / "model.sdf"
    path.write_bytes(tostring(root))
    return read_foreign(path)


def refusal(folder, change, model=HEAVY):
    with pytest.raises(VehicleError) as error:
        changed(folder, change, model)
    return str(error.value)


# Motion


@pytest.mark.slow
@pytest.mark.parametrize("model", [HEAVY, BASE, TETHYS], ids=lambda m: m.name)
def test_it_moves_as_the_equations_of_gz_sim(tmp_path, model):
    """They agree within 0.2 % at all times."""
    force = (
        [20.0, 20.0, -20.0, 2.0, 2.0, 4.0] if model is not TETHYS else [20.0, 60.0, -60.0, 0.05, 100.0, 100.0]
    )
    assert_moves_alike(imported(tmp_path, model), Origin(model), force)


@pytest.mark.slow
def test_terminal_speeds_of_bluerov2_heavy(tmp_path):
    """The published figures: 0.5851, 0.6023, 0.3881 m/s, 1.000 rad/s, and 0.0982 m/s of floating up."""
    tau = np.zeros((5, 6))
    tau[0, 0], tau[1, 1], tau[2, 2], tau[3, 5] = 20.0, 20.0, -20.0, 4.0
    rest = np.repeat(np.eye(3)[None], 5, axis=0)
    end = simulated(imported(tmp_path, HEAVY), rest, np.zeros((5, 6)), tau, 20.0)[-1]
    speeds = [end[0, 0], end[1, 1], -end[2, 2], end[3, 5], end[4, 2]]
    assert speeds == pytest.approx([0.5851, 0.6023, 0.3881, 1.0, 0.0982], rel=1e-3)


def test_added_mass_of_the_plugin_is_that_of_the_link_and_its_sign_of_coriolis_is_named(tmp_path):
    """Both sources give the same matrix; gz-sim's opposite sign of the Coriolis wrench is not adopted."""
    explicit, implicit = (read_foreign(write(tmp_path / f"{m.name}.sdf", m)) for m in (EXPLICIT, TETHYS))
    a, b = (x.vehicle(tmp_path).hydrodynamics["calibrated"] for x in (explicit, implicit))
    assert np.array_equal(a.added_mass, b.added_mass) and a.added_mass[1, 1] == 126.324739
    assert any("other sign" in sentence for sentence in explicit.different)
    assert not any("Coriolis" in sentence for sentence in implicit.different)
    nu = np.array([[0.6, 0.2, 0.0, 0.0, 0.0, 0.0]])
    one, two = (Origin(m).rate(np.eye(3)[None], nu, np.zeros((1, 6))) for m in (EXPLICIT, TETHYS))
    assert one[0, 5] > 0.0 > two[0, 5]  # the Munk moment turns the bow away from the flow


# Fins

POSE = (-0.97, 0.02, 0.1, 0.3, -0.02, 0.05)
SURFACE = {
    "air_density": 1000.0, "cla": 4.13, "cla_stall": -1.1, "cda": 0.2, "cda_stall": 0.03, "alpha_stall": 0.4, "a0": 0.0,
    "area": 0.0244, "upward": "0 1 0", "forward": "1 0 0", "link_name": "fin", "cp": "0.01 0 0.05",
}  # fmt: skip


def with_fin(axis="0 0 1", kind="revolute", **words):
    """Return a change that adds a link with a joint, and a LiftDrag plugin unless words is None."""

    def change(root):
        model = root.find("world/model")
        link = element(model, "link", name="fin")
        element(link, "pose", POSE)
        element(element(link, "inertial"), "mass", "0.01")
        joint = element(model, "joint", name="rudder", type=kind)
        element(joint, "parent", "base_link")
        element(joint, "child", "fin")
        turn = element(joint, "axis")
        element(turn, "xyz", axis)
        limit = element(turn, "limit")
        element(limit, "lower", -0.26)
        element(limit, "upper", 0.3)
        if words:
            gz_sim.plugin(model, "LiftDrag", **words)

    return change


def lift_drag(nu, angle):
    """Return the wrench about the base link by gz-sim's LiftDrag.cc, of a link that its joint turned about z."""
    c, s = math.cos(angle), math.sin(angle)
    turn = euler(*POSE[3:]) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    cp = np.array(POSE[:3]) + turn @ [0.01, 0.0, 0.05]
    forward, upward = turn[:, 0], turn[:, 1]
    span = np.cross(forward, upward)
    v = nu[:3] + np.cross(nu[3:], cp)
    plane = v - (v @ span) * span
    lift = np.cross(span, plane) / np.linalg.norm(plane)
    alpha = math.copysign(math.acos(np.clip(lift @ upward, -1.0, 1.0)), lift @ forward)
    sweep = 1.0 - (span @ v / np.linalg.norm(v)) ** 2
    q = 0.5 * 1000.0 * (plane @ plane) * 0.0244 * sweep
    force = q * (4.13 * alpha * lift - 0.2 * abs(alpha) * plane / np.linalg.norm(plane))
    return np.concatenate([force, np.cross(cp, force)])


def test_a_surface_that_a_joint_turns_is_a_fin_with_the_forces_of_gz_sim(tmp_path):
    """Upright against the axis and along it, at random velocities and angles, except for the effect of sweep
    in gz-sim."""
    bare = changed(tmp_path, with_fin(), TETHYS).vehicle(tmp_path)
    rng, eta = np.random.default_rng(3), [0.0, 0.0, -50.0, 0.0, 0.0, 0.0]
    for axis, sign in (("0 0 1", 1.0), ("0 0 -2", -1.0)):
        draft = changed(tmp_path, with_fin(axis, **SURFACE), TETHYS)
        vehicle = draft.vehicle(tmp_path)
        fin = vehicle.actuators["rudder"]
        assert (fin.minimum, fin.maximum) == (-0.26, 0.3) and "LiftDrag" not in " | ".join(draft.not_read)
        for _ in range(10):
            nu = np.array([1.2, 0, 0, 0, 0, 0]) + 0.03 * rng.normal(size=6)
            angle = rng.uniform(0.1, 0.25) * rng.choice([-1.0, 1.0])
            found = acceleration(vehicle, eta, nu, actuators=[0.0, angle]) - acceleration(bare, eta, nu)
            found, expected = vehicle.mass_matrix() @ found, lift_drag(nu, sign * angle)
            assert np.abs(found - expected).max() < 0.02 * np.abs(expected).max()


def test_a_lift_that_an_angle_adds_to_is_a_fin(tmp_path):
    """control_joint_rad_to_cl is the slope by angle; the flow angle counts less by the ratio of cla to it."""
    words = SURFACE | {
        "link_name": "base_link",
        "control_joint_name": "rudder",
        "control_joint_rad_to_cl": 8.26,
    }
    fin = changed(tmp_path, with_fin(**words), TETHYS).vehicle(tmp_path).actuators["rudder"]
    assert fin.lift_slope == pytest.approx(8.26 * 1000.0 / TETHYS.density) and fin.incidence == pytest.approx(
        0.5
    )
    assert fin.span.tolist() == [0.0, 0.0, 1.0] and fin.position == pytest.approx([0.01, 0.0, 0.05])


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ({"forward": "0 1 0"}, "forward and upward of 'fin' are not perpendicular"),
        ({"cla": -1.0}, "cla of 'fin' is -1, expected above 0"),
        ({"area": 0.0}, "with an area above 0"),
        ({"chord": 1.0}, "LiftDrag: unknown element 'chord'"),
    ],
)
def test_refusals_of_fins_are_sentences(tmp_path, words, sentence):
    with pytest.raises(VehicleError, match=sentence):
        changed(tmp_path, with_fin(**(SURFACE | words)), TETHYS)


@pytest.mark.parametrize("words", [{"axis": "1 0 0"}, {"kind": "fixed"}, {"radial_symmetry": "true"}])
def test_wings_that_nothing_turns_are_named(tmp_path, words):
    draft = changed(tmp_path, with_fin(**(SURFACE | words)), TETHYS)
    assert draft.not_read[sdf.LEFT_OUT] == 1 and "actuators" not in draft.values


# Conversions, one by one


def test_added_mass_changes_sign_and_keeps_couplings():
    found = sdf.added_mass({"xDotU": -4.0, "yDotR": -2.0, "nDotV": -2.0, "xU": -9.0}, "m")
    assert found[0, 0] == 4.0 and found[1, 5] == found[5, 1] == 2.0 and np.count_nonzero(found) == 3
    with pytest.raises(VehicleError, match="xDotU is 4, expected 0 or less"):
        sdf.added_mass({"xDotU": 4.0}, "m")
    with pytest.raises(VehicleError, match="not symmetric"):
        sdf.added_mass({"yDotR": -2.0}, "m")


def test_damping_changes_sign_and_refuses_what_a_vehicle_file_cannot_hold():
    D1, D2 = sdf.damping(
        {"xU": -3.0, "yR": 0.5, "nRabsR": -7.0, "yRabsR": 0.2, "xVabsR": 0.0, "mQQ": 0.0}, "m"
    )
    assert D1[0, 0] == 3.0 and D1[1, 5] == -0.5 and np.count_nonzero(D1) == 2
    assert D2[5, 5] == 7.0 and D2[1, 5] == -0.2 and np.count_nonzero(D2) == 2
    for word, value, sentence in (
        ("kP", 1.0, "kP is 1, expected 0 or less"),
        ("kPabsP", 1.0, "kPabsP is 1, expected 0 or less"),
        ("yVabsR", -1.0, "yVabsR couples two velocities"),
        ("xUU", -1.0, "use xUabsU if it is drag"),
    ):
        with pytest.raises(VehicleError, match=sentence):
            sdf.damping({word: value}, "m")


def test_thrust_is_of_radians_per_second(tmp_path):
    """T = k ρ d⁴ n|n|; a negative coefficient reverses the rotation and keeps the direction of thrust."""
    assert sdf.thrust_factor(-0.02, 1000.0, 0.1) == pytest.approx(0.002)
    thrusters = imported(tmp_path, HEAVY).thrusters
    assert thrusters["t2"].thrust(100.0) == pytest.approx(20.0)
    assert thrusters["t0"].force_max == 50.0 and thrusters["t0"].rpm_max == pytest.approx(1509.88, abs=0.01)


def test_axes_and_places_of_thrusters(tmp_path):
    """The front right thruster of BlueROV2 pushes back and to the right, the vertical ones down."""
    vehicle = imported(tmp_path, HEAVY)
    assert vehicle.thrusters["t0"].axis == pytest.approx([-math.sqrt(0.5), -math.sqrt(0.5), 0.0], abs=1e-3)
    assert vehicle.thrusters["t4"].axis.tolist() == [0.0, 0.0, -1.0]
    assert vehicle.thrusters["t4"].position.tolist() == [0.118, -0.215, 0.064]
    assert vehicle.controlled_axes == ("surge", "sway", "heave", "roll", "pitch", "yaw")
    assert "pitch" not in imported(tmp_path, BASE).controlled_axes
    turned = sdf.axis_of_joint(LinkPose(euler(0.0, 0.0, math.pi / 2), np.ones(3)), np.array([2.0, 0.0, 0.0]))
    assert turned == pytest.approx([0.0, 1.0, 0.0])


def test_limits_of_a_thruster_that_is_commanded_by_speed(tmp_path):
    """Its max_thrust_cmd is in rad/s, and its deadband is a thrust."""

    def change(root):
        thruster = root.findall("world/model/plugin")[1]
        thruster.find("max_thrust_cmd").text = "100"
        element(thruster, "use_angvel_cmd", "True")
        element(thruster, "deadband", 0.5)

    thruster = changed(tmp_path, change).vehicle(tmp_path).thrusters["t0"]
    assert thruster.force_max == pytest.approx(20.0) and thruster.force_min == pytest.approx(-5.0)
    assert thruster.thrust(thruster.dead_rpm_plus * math.pi / 30.0) == pytest.approx(0.5)


def test_the_autopilot_limits_a_thruster(tmp_path):
    """ArduPilotPlugin commands multiplier (x + offset) with x from 0 to 1."""

    def change(root):
        for plugin in root.findall("world/model/plugin")[1:]:
            plugin.remove(plugin.find("max_thrust_cmd"))
            plugin.remove(plugin.find("min_thrust_cmd"))
        pilot = element(root.find("world/model"), "plugin", name="ArduPilotPlugin")
        control = element(pilot, "control", channel="0")
        for word, text in (("jointName", "t0"), ("cmd_topic", "/model/heavy/joint/t0/cmd_thrust"),
                           ("multiplier", "80"), ("offset", "-0.5")):  # fmt: skip
            element(control, word, text)

    draft = changed(tmp_path, change)
    thrusters = draft.vehicle(tmp_path).thrusters
    assert (thrusters["t0"].force_min, thrusters["t0"].force_max) == (-40.0, 40.0)
    assert thrusters["t1"].force_max == pytest.approx(0.3 * 13.016 * 9.8)  # guessed
    assert "thrusters.t1.force_max" in draft.guessed and "thrusters.t0.force_max" not in draft.guessed


def test_the_pose_of_a_frame():
    """Roll, then pitch, then yaw about the axes of the parent; also in degrees and as quaternions."""
    root = tree(HEAVY)[0]
    pose = root.find("world/model/link/inertial/pose")
    for text, attributes in (
        ("1 2 3 0.1 0.2 0.3", {}),
        (f"1 2 3 {math.degrees(0.1)} {math.degrees(0.2)} {math.degrees(0.3)}", {"degrees": "true"}),
        (
            f"1 2 3 {' '.join(map(repr, matrix_to_quat(euler(0.1, 0.2, 0.3)).tolist()))}",
            {"rotation_format": "quat_xyzw"},
        ),
    ):
        pose.text, pose.attrib = text, attributes
        found = pose_of(pose, "m")
        assert found.turn == pytest.approx(euler(0.1, 0.2, 0.3)) and found.place.tolist() == [1.0, 2.0, 3.0]


def test_poses_relative_to_frames_lead_to_the_same_vehicle(tmp_path):
    """A thruster is given in a frame of the model, and the base link is turned and moved with everything
    else."""

    def change(root):
        model = root.find("world/model")
        frame = element(model, "frame", name="stern")
        element(frame, "pose", (0.1, 0, 0, 0, 0, math.pi / 2))
        pose = model.findall("link")[5].find("pose")  # of prop4
        R, r = euler(0.0, 0.0, math.pi / 2), np.array([0.118, -0.215, 0.064]) - [0.1, 0.0, 0.0]
        pose.text = " ".join(map(repr, [*(R.T @ r).tolist(), 0.0, 0.0, -math.pi / 2]))
        pose.set("relative_to", "stern")

    first, second = imported(tmp_path, HEAVY), changed(tmp_path, change).vehicle(tmp_path)
    assert second.thrusters["t4"].position == pytest.approx(first.thrusters["t4"].position)
    assert second.thrusters["t4"].axis == pytest.approx(first.thrusters["t4"].axis)
    assert second.body.inertia == pytest.approx(first.body.inertia)


def test_the_body_frame_is_that_of_the_link_with_hydrodynamics(tmp_path):
    """When the link is moved and turned in the model, its propellers' centre of gravity moves the other way."""

    def change(root):
        element(root.find("world/model/link"), "pose", (0, 0, 1.0, 0, 0, math.pi / 2))

    thruster = changed(tmp_path, change).vehicle(tmp_path).thrusters["t4"]
    assert thruster.position == pytest.approx([-0.215, -0.118, 0.064 - 1.0])


@pytest.mark.parametrize(
    ("shape", "words", "volume"),
    [
        ("sphere", {"radius": 0.3}, 4 / 3 * math.pi * 0.027),
        ("cylinder", {"radius": 0.1, "length": 2.0}, 0.02 * math.pi),
        ("capsule", {"radius": 0.1, "length": 2.0}, 0.02 * math.pi + 4e-3 / 3 * math.pi),
        ("cone", {"radius": 0.1, "length": 3.0}, 0.01 * math.pi),
        ("ellipsoid", {"radii": (0.1, 0.2, 0.3)}, 8e-3 * math.pi),
        ("box", {"size": (1.0, 2.0, 3.0)}, 6.0),
    ],
)
def test_volumes_of_shapes(shape, words, volume):
    found = element(tree(HEAVY)[0], shape)
    for word, value in words.items():
        element(found, word, value)
    assert shape_volume(found, "m") == pytest.approx(volume)


def test_the_density_is_that_of_buoyancy(tmp_path):
    """It may be uniform or graded with air above 0; without the plugin it is that of the others, or guessed."""

    def graded(root):
        plugin = root.find("world/plugin")
        plugin.remove(plugin.find("uniform_fluid_density"))
        inner = element(plugin, "graded_buoyancy")
        element(inner, "default_density", 1025.0)
        change = element(inner, "density_change")
        element(change, "above_depth", 0.0)
        element(change, "density", 1.0)

    def absent(root):
        root.find("world").remove(root.find("world/plugin"))
        for thruster in root.findall("world/model/plugin")[1:]:
            thruster.remove(thruster.find("fluid_density"))

    draft = changed(tmp_path, graded)
    assert draft.values["water"]["density"] == 1025.0 and any(
        "densities differ" in x for x in draft.different
    )
    draft = changed(tmp_path, absent)
    assert draft.values["water"]["density"] == 1000.0
    assert {"water.density", "thrusters.t0.c_plus", "thrusters.t0.c_minus"} <= draft.guessed.keys()
    assert any("no plugin Buoyancy" in x for x in draft.different)
    assert "the density changes under water" in refusal(
        tmp_path, lambda root: (graded(root), setting(".//above_depth", "-5")(root))
    )


# Guesses, refusals and findings


def test_every_word_is_read_refused_or_named(tmp_path):
    """Tested with an x appended to the name of each element in turn."""
    assert unnoticed(lambda: tree(HEAVY)[0], read_foreign, tmp_path / "model.sdf") == []


def test_guesses_are_marked_in_the_file_and_listed(tmp_path, capsys):
    """The command lists as guessed what the file marks as guessed."""
    source, out = write(tmp_path / "rov.sdf", HEAVY), tmp_path / "rov.yaml"
    assert boundary.run(app, ["vehicles", "import", str(source), "--out", str(out), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    vehicle = load_vehicle(out)
    guessed = {path for path, provenance in vehicle.provenance.items() if provenance.origin == "guessed"}
    assert guessed == {"body.size", "body.surface_half_height"} | {
        f"thrusters.t{i}.time_constant" for i in range(8)
    }
    assert len(report["guessed"]) == 3 and any(
        "time_constant = 0.05 (8 times)" in line for line in report["guessed"]
    )
    assert vehicle.sha256 == read_foreign(source).vehicle(tmp_path).sha256


def test_what_is_not_read_is_named(tmp_path, capsys):
    """Fins, sensors, visual meshes and an autopilot are listed by name and count."""

    def change(root):
        model = root.find("world/model")
        element(model, "plugin", name="gz::sim::systems::LiftDrag")
        element(model.find("link"), "sensor", name="imu", type="imu")
        element(model.find("link"), "velocity_decay", "")
        element(model.find("plugin"), "default_current", "1 0 0")
        model.find("joint").set("type", "prismatic")

    draft = changed(tmp_path, change, TETHYS)
    text = " | ".join(draft.not_read)
    for word in (
        "plugin LiftDrag (its forces are left out)",
        "sensor imu",
        "velocity_decay",
        "default_current",
    ):
        assert word in text
    assert "joints held where the file puts them: 'part0_joint' (prismatic)" in draft.different


def test_a_file_without_shapes_or_masses_is_guessed_and_says_so(tmp_path):
    """The guesses are neutral buoyancy and SDF's 1 kg."""

    def change(root):
        for link in root.findall("world/model/link"):
            for tag in ("collision", "inertial"):
                if link.find(tag) is not None:
                    link.remove(link.find(tag))

    draft = changed(tmp_path, change)
    assert draft.values["body"]["mass"] == 9.0
    assert {
        "body.mass",
        "body.inertia",
        "body.displaced_volume",
        "body.center_of_buoyancy",
    } <= draft.guessed.keys()
    assert draft.vehicle(tmp_path).buoyancy == pytest.approx(9.0 * 9.8)


def test_a_moment_that_is_missing_is_that_of_sdf_and_says_so(tmp_path):
    """A public model writes its moments as text; gz-sim then uses 1 kg m²."""

    def change(root):
        inertia = root.find("world/model/link[2]/inertial/inertia")
        inertia.remove(inertia.find("ixx"))

    draft = changed(tmp_path, change)
    assert "lacks numbers of link 'prop0': 1 kg, 1 kg m²" in draft.guessed["body.inertia"]
    assert "body.mass" not in draft.guessed
    added = draft.values["hydrodynamics"]["calibrated"]["added_mass"]  # no body can have these moments alone
    assert np.trace(draft.values["body"]["inertia"]) + np.trace(added) == pytest.approx(
        np.trace(imported(tmp_path, HEAVY).body.inertia) + 0.999
    )


LINK, PLUGIN = "world/model/link", "world/model/plugin"


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (setting(f"{PLUGIN}/link_name", "hull"), "no link 'hull'"),
        (setting(f"{LINK}/inertial/mass", "nan"), "mass is 'nan', expected a number"),
        (setting(f"{LINK}/inertial/mass", "1e400"), "expected numbers up to"),
        (setting(f"{LINK}/inertial/mass", "1_0"), "mass is '1_0'"),
        (setting(f"{LINK}/inertial/mass", "-13"), "expected more than 0"),
        (adding(f"{LINK}/inertial", "density", "1", auto="true"), None),
        (lambda root: root.find(f"{LINK}/inertial").set("auto", "true"), "computed from its shapes"),
        (adding(PLUGIN, "xUabsX", "1"), "unknown element 'xUabsX'"),
        (adding(PLUGIN, "water_densty", "1"), "did you mean 'water_density'"),
        (adding("world/model", "include"), "has a include inside"),
        (adding("world/model", "model", name="x"), "has a model inside"),
        (adding("world/model", "static", "true"), "is static"),
        (adding(LINK, "gravity", "false"), "has no weight"),
        (adding("world/model", "link", name="loose"), "'loose' is not joined to 'base_link'"),
        (adding("world/model", "link", name="prop0"), "there twice"),
        (lambda root: element(root.find(f"{LINK}[2]"), "pose", None), None),
        (lambda root: root.find(f"{LINK}[2]/pose").set("relative_to", "prop0"), "depends on itself"),
        (lambda root: root.find(f"{LINK}[2]/pose").set("relative_to", "nowhere"), "no link, joint or frame 'nowhere'"),
        (lambda root: root.find("world/model/joint/axis/xyz").set("expected", "x"), None),
        (lambda root: root.find("world/model/joint/axis/xyz").set("expressed_in", "__model__"), "another frame"),
        (setting("world/model/joint/axis/xyz", "0 0 0"), "expected a direction"),
        (setting("world/gravity", "0 0 9.8"), "expected it along -z"),
        (setting(f"{PLUGIN}[2]/joint_name", "t1"), "there twice"),
        (setting(f"{PLUGIN}[2]/max_thrust_cmd", "-60"), "expected at least min_thrust_cmd"),
        (setting(f"{PLUGIN}[2]/min_thrust_cmd", "0"), "expected one that reverses"),
        (setting(f"{PLUGIN}[2]/propeller_diameter", "0"), "is 0, expected another"),
        (setting(f"{LINK}/collision/geometry/box/size", "1 1"), "expected 3 numbers"),
        (setting(f"{LINK}/collision/geometry/box/size", "1 1 -1"), "3 numbers of 0 or more"),
    ],
)  # fmt: skip
def test_refusals_are_sentences(tmp_path, change, sentence):
    """Each names the file and the element; None marks an element that changes nothing."""
    if sentence is None:
        changed(tmp_path, change)
    else:
        found = refusal(tmp_path, change)
        assert sentence in found and found.startswith(str(tmp_path)) and "\n" not in found


def test_other_files_are_refused(tmp_path):
    file = tmp_path / "a.sdf"
    for text, sentence in (
        ("<sdf><model", "cannot be read as XML"),
        ("", "cannot be read as XML"),
        ("<!DOCTYPE sdf [<!ENTITY a 'b'>]><sdf/>", "has a DOCTYPE"),
        ("<robot name='x'/>", "its root is 'robot', expected sdf"),
        ("<sdf><model name='x'/></sdf>", "are none, expected one"),
    ):
        file.write_text(text)
        with pytest.raises(VehicleError, match=sentence):
            read_foreign(file)
    (tmp_path / "a.txt").write_text("nothing")
    with pytest.raises(VehicleError, match="has an unknown format, expected one of SDF of gz-sim"):
        read_foreign(tmp_path / "a.txt")
    (tmp_path / "rov.yaml").write_text("extends: finsrov\n")
    with pytest.raises(VehicleError, match="needs no import: give it with --vehicle"):
        read_foreign(tmp_path / "rov.yaml")
    with pytest.raises(VehicleError, match="no such file"):
        read_foreign(tmp_path / "b.sdf")


def test_a_prefix_needs_no_namespace(tmp_path):
    """As in gz-sim, elements are named as written. UTF-16 is read, and its DOCTYPE is detected."""
    text = tostring(tree(HEAVY)[0], encoding="unicode").replace(
        '<link name="base_link">', '<link name="base_link"><gz:note/>'
    )
    (tmp_path / "a.sdf").write_text(text)
    assert read_foreign(tmp_path / "a.sdf").not_read["link: gz:note"] == 1
    (tmp_path / "b.sdf").write_text(f'<?xml version="1.0" encoding="utf-16"?>{text}', encoding="utf-16")
    assert read_foreign(tmp_path / "b.sdf").values["body"] == read_foreign(tmp_path / "a.sdf").values["body"]
    (tmp_path / "c.sdf").write_text(
        f'<?xml version="1.0" encoding="utf-16"?><!DOCTYPE sdf>{text}', encoding="utf-16"
    )
    with pytest.raises(VehicleError, match="has a DOCTYPE"):
        read_foreign(tmp_path / "c.sdf")


def test_importers_have_names_of_what_they_import():
    assert "vehicle.sdf" in IMPORTERS and IMPORTERS["vehicle.sdf"] is sdf.SDF
    for name, member in (("trial.ulg", sdf.SDF), ("vehicle.sdf", object())):
        with pytest.raises(RegistryError, match="expected an Importer of kind '"):
            check_registered(name, member)


# Meshes


def with_mesh(uri, scale="1 1 1"):
    def change(root):
        geometry = root.find(f"{LINK}/collision/geometry")
        geometry.remove(geometry.find("box"))
        shape = element(geometry, "mesh")
        element(shape, "uri", uri)
        element(shape, "scale", scale)

    return change


@pytest.mark.parametrize(
    "uri", ["model://heavy/meshes/hull.stl", "meshes/hull.stl", "package://heavy/meshes/hull.stl"]
)
def test_a_collision_mesh_becomes_the_hull_and_comes_along(tmp_path, uri):
    """The hull has the mesh's volume, centred at the collision; the file is copied beside the vehicle's."""
    folder = tmp_path / "model"
    (folder / "meshes").mkdir(parents=True)
    vertices, faces = mesh.parametric_hull([0.4, 0.3, 0.2], 0.0135)
    mesh.write_stl(folder / "meshes/hull.stl", 1000.0 * vertices, faces)
    root, _ = tree(HEAVY)
    with_mesh(uri, "0.001 0.001 0.001")(root)
    (folder / "model.sdf").write_bytes(tostring(root))
    out = tmp_path / "out/rov.yaml"
    assert boundary.run(app, ["vehicles", "import", str(folder / "model.sdf"), "--out", str(out)]) == 0
    vehicle = load_vehicle(out)
    assert vehicle.body.displaced_volume == pytest.approx(0.0135, rel=1e-5)
    assert vehicle.body.center_of_buoyancy == pytest.approx([0.0, 0.0, 0.06])
    assert vehicle.hull.file.parent == out.parent.resolve()
    assert mesh.mesh_centroid(*vehicle.hull_mesh()) == pytest.approx([0.0, 0.0, 0.06], abs=1e-6)


def test_a_mesh_outside_the_folder_of_the_model_is_refused(tmp_path):
    """File names in data may not lead upwards, be absolute or pass through a link."""
    folder = tmp_path / "model"
    folder.mkdir()
    mesh.write_stl(tmp_path / "outside.stl", *mesh.parametric_hull([0.4, 0.3, 0.2], 0.0135))
    (folder / "link.stl").symlink_to(tmp_path / "outside.stl")
    (folder / "hull.dae").write_text("<COLLADA/>")
    for uri in ("../outside.stl", str(tmp_path / "outside.stl"), f"file://{tmp_path}/outside.stl", "link.stl",
                "model://heavy/../outside.stl", "C:\\outside.stl", "..\\outside.stl"):  # fmt: skip
        assert "into the model's folder or below" in refusal(folder, with_mesh(uri))
    for uri in ("model://heavy/none.stl", "model://heavy", ""):
        assert "is not in the model's folder" in refusal(folder, with_mesh(uri))
    assert "is a .dae, expected .stl" in refusal(folder, with_mesh("hull.dae"))
    assert "3 numbers > 0" in refusal(tmp_path, with_mesh("outside.stl", "1 1 -1"))
