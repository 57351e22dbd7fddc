"""The URDF describes the vehicle of the file, as a tree that URDF readers accept."""

from xml.etree import ElementTree

import numpy as np
import pytest

from finssim.core.rotations import quat_from_euler, quat_to_matrix
from finssim.extensions.ros2.nodes.frames import mounts, urdf_of
from finssim.vehicles import load_vehicle
from finssim.vehicles.loader import catalogue
from reference.finned import torpedo


def numbers(element, name):
    return np.array([float(v) for v in element.get(name).split()])


@pytest.mark.parametrize("name", catalogue())
def test_every_vehicle_is_a_tree_of_fixed_joints(name):
    """There is one root, every joint connects existing links, and poses are those of the file."""
    vehicle = load_vehicle(name)
    robot = ElementTree.fromstring(urdf_of(vehicle))
    links = [link.get("name") for link in robot.findall("link")]
    joints = {joint.find("child").get("link"): joint for joint in robot.findall("joint")}
    assert len(set(links)) == len(links) and set(links) - set(joints) == {"base_link"}
    assert {joint.find("parent").get("link") for joint in joints.values()} == {"base_link"}
    for frame, position, orientation in mounts(vehicle):
        origin = joints[frame].find("origin")
        R = quat_to_matrix(quat_from_euler(*numbers(origin, "rpy")))
        assert numbers(origin, "xyz") == pytest.approx(position) and R == pytest.approx(
            quat_to_matrix(orientation), abs=1e-7
        )
    for thruster, part in vehicle.thrusters.items():
        R = quat_to_matrix(quat_from_euler(*numbers(joints[f"{thruster}_link"].find("origin"), "rpy")))
        assert R[:, 0] == pytest.approx(part.axis, abs=1e-6)
    hull = robot.find("link/visual/geometry")[0]
    if vehicle.hull is not None and vehicle.hull.file is not None:
        assert hull.get("filename") == f"file://{vehicle.hull.file.resolve()}"
    else:
        assert numbers(hull, "size") == pytest.approx(vehicle.body.size)


def test_fins_turn_about_their_span():
    """Each fin has a revolute joint of its name and range; the angle is the deflection."""
    vehicle = torpedo()
    robot = ElementTree.fromstring(urdf_of(vehicle))
    joint = robot.find("joint[@name='elevator']")
    assert joint.get("type") == "revolute" and joint.find("child").get("link") == "elevator_fin"
    assert numbers(joint.find("axis"), "xyz") == pytest.approx([0.0, 1.0, 0.0])
    assert numbers(joint.find("origin"), "xyz") == pytest.approx([-0.638, 0.0, 0.0])
    limit = joint.find("limit")
    assert [float(limit.get(k)) for k in ("lower", "upper", "velocity")] == [-0.35, 0.35, 1.0]
    length, width, _ = numbers(robot.find("link[@name='elevator_fin']/visual/geometry/box"), "size")
    assert length * width == pytest.approx(0.0133)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["finsrov", "bluerov2_heavy"])
def test_mujoco_reads_the_same_body(name):
    """MuJoCo's URDF reader gives the same mass, centre of gravity and principal inertia."""
    mujoco = pytest.importorskip("mujoco")
    vehicle = load_vehicle(name)
    robot = ElementTree.fromstring(urdf_of(vehicle))
    ElementTree.SubElement(ElementTree.SubElement(robot, "mujoco"), "compiler", fusestatic="false")
    for shape in [*robot.findall("link/visual"), *robot.findall("link/collision")]:
        robot.find("link").remove(shape)
    world = ElementTree.SubElement(robot, "link", name="world_link")
    joint = ElementTree.SubElement(robot, "joint", name="hinge", type="continuous")
    ElementTree.SubElement(joint, "parent", link=world.get("name"))
    ElementTree.SubElement(joint, "child", link="base_link")
    model = mujoco.MjModel.from_xml_string(ElementTree.tostring(robot, encoding="unicode"))
    base = model.body("base_link")
    assert base.mass[0] == pytest.approx(vehicle.body.mass)
    assert base.ipos == pytest.approx(vehicle.body.center_of_gravity)
    expected = np.sort(np.linalg.eigvalsh(vehicle.body.inertia))
    assert np.sort(base.inertia) == pytest.approx(expected, rel=1e-4)
