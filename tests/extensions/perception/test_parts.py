"""Models of other programs as parts of a world: position and scale of their shapes, and refusals."""

import numpy as np
import pytest

from finssim.core.mesh import write_stl
from finssim.core.rotations import quat_to_matrix
from finssim.extensions.perception import WorldError, WorldLayout
from finssim.extensions.perception.parts import PartsError, parts_of

WATER = "about: A site.\nwater: {attenuation: [0, 0, 0], veil: [0, 0, 0], daylight_attenuation: [0, 0, 0]}\n"
MJCF = """<mujoco><asset><mesh name="wedge" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/></asset><worldbody>
<body pos="0 0 0.5" euler="0 0 90"><joint type="hinge" axis="0 0 1"/>
<geom type="box" size="0.3 0.2 0.1" rgba="0.8 0.1 0.1 1"/>
<geom type="capsule" fromto="0 0 0  0 0 1" size="0.05"/></body>
<geom type="mesh" mesh="wedge" pos="2 0 0"/></worldbody></mujoco>"""
URDF = """<robot name="buoy"><link name="base">
<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><origin xyz="0 0 0.4" rpy="1.5708 0 0"/>
<geometry><cylinder radius="0.2" length="1.0"/></geometry></collision>
</link></robot>"""


def write(folder, name, text):
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


@pytest.mark.slow
def test_an_mjcf_is_its_geoms_at_rest(tmp_path):
    """A turned box, a capsule between two points and a mesh moved to its centre of mass are at their rest
    poses."""
    pytest.importorskip("mujoco")
    mesh, box, capsule = parts_of(write(tmp_path, "rack.xml", MJCF))
    assert [part.kind for part in (mesh, box, capsule)] == ["mesh", "box", "capsule"]
    np.testing.assert_allclose(box.position, [0, 0, 0.5], atol=1e-6)
    np.testing.assert_allclose(np.abs(quat_to_matrix(box.quaternion) @ box.size), [0.2, 0.3, 0.1], atol=1e-6)
    np.testing.assert_allclose(box.colour, [0.8, 0.1, 0.1], atol=1e-6)
    np.testing.assert_allclose(capsule.position, [0, 0, 1.0], atol=1e-6)
    np.testing.assert_allclose(capsule.size[:2], [0.05, 0.5], atol=1e-6)
    corners = mesh.position + mesh.vertices @ quat_to_matrix(mesh.quaternion).T
    expected = np.array([[2, 0, 0], [3, 0, 0], [2, 1, 0], [2, 0, 1]])
    assert all(np.abs(corners - corner).max(axis=1).min() < 1e-5 for corner in expected)


@pytest.mark.slow
def test_a_urdf_is_its_collision_shapes(tmp_path):
    """A cylinder lies along y, 0.4 m up."""
    pytest.importorskip("mujoco")
    (part,) = parts_of(write(tmp_path, "buoy.urdf", URDF))
    assert part.kind == "cylinder" and part.size[:2] == pytest.approx((0.2, 0.5))
    np.testing.assert_allclose(np.abs(quat_to_matrix(part.quaternion)[:, 2]), [0, 1, 0], atol=1e-4)
    np.testing.assert_allclose(part.position, [0, 0, 0.4], atol=1e-9)


@pytest.mark.slow
def test_a_model_stands_in_a_world_with_its_own_colours(tmp_path):
    """A model is scaled by two, moved and turned as its object; a colour of the world file overrides the
    model's."""
    pytest.importorskip("mujoco")
    write(tmp_path, "rack.xml", MJCF)
    text = WATER + (
        "objects:\n  rack: {shape: model, file: rack.xml, scale: 2.0, position: [1, 0, -3], yaw: 1.5707963}\n"
        "  grey: {shape: model, file: rack.xml, position: [5, 0, -3], colour: [0.5, 0.5, 0.5]}\n"
        "viewpoint: {position: [0, 0, -3]}\n"
    )
    layout = WorldLayout(str(write(tmp_path, "site.yaml", text)))
    shapes = [shape for shape in layout.shapes if shape.kind == "box"]
    places = layout.transforms.numpy()[0, [layout.shapes.index(shape) for shape in shapes]]
    np.testing.assert_allclose(places[0, :3], [1, 0, -2], atol=1e-5)
    assert shapes[0].size == pytest.approx((0.6, 0.4, 0.2)) and shapes[1].size == pytest.approx(
        (0.3, 0.2, 0.1)
    )
    np.testing.assert_allclose(
        [s.finish.colour for s in shapes], [[0.8, 0.1, 0.1], [0.5, 0.5, 0.5]], atol=1e-6
    )


def test_files_outside_the_folder_are_refused_however_they_are_named(tmp_path):
    """A file outside the folder is refused in a file that the model includes, too."""
    pytest.importorskip("mujoco")
    (tmp_path / "own").mkdir()
    write(tmp_path / "own", "more.xml", "<mujoco><asset><mesh file='../secret.stl'/></asset></mujoco>")
    with pytest.raises(PartsError, match="names the file '../secret.stl'"):
        parts_of(write(tmp_path / "own", "rack.xml", "<mujoco><include file='more.xml'/></mujoco>"))


SHAPE = "<worldbody><geom type='sphere' size='0.1'/></worldbody>"


@pytest.mark.slow
@pytest.mark.parametrize(
    "key", ["model name='s'", "mesh name='s'", "texture type='cube' fileup='a.png' name='s'"]
)
def test_files_that_a_model_reaches_through_another_are_of_its_folder(tmp_path, key):
    """A nested model that names its own mesh folder outside, or a link that leads there, is refused."""
    pytest.importorskip("mujoco")
    (tmp_path / "own").mkdir()
    inner = (
        f"<mujoco><compiler meshdir='{tmp_path}'/><asset><mesh name='m' file='secret.stl'/></asset></mujoco>"
    )
    write(tmp_path / "own", "s.xml", inner)
    model = f"<mujoco><asset><{key} file='s.xml'/></asset>{SHAPE}</mujoco>"
    with pytest.raises(PartsError, match=f"names the file '{tmp_path}'"):
        parts_of(write(tmp_path / "own", "rack.xml", model))
    (tmp_path / "own" / "s.xml").unlink()
    (tmp_path / "own" / "s.xml").symlink_to(write(tmp_path, "secret.xml", "<mujoco/>"))
    with pytest.raises(PartsError, match="names the file 's.xml', which is a link"):
        parts_of(tmp_path / "own" / "rack.xml")


@pytest.mark.slow
def test_a_model_may_name_files_of_its_folder_and_below(tmp_path):
    """An included file and a mesh in a subfolder, which another model copies, are accepted."""
    pytest.importorskip("mujoco")
    (tmp_path / "meshes").mkdir()
    write_stl(tmp_path / "meshes" / "a.stl", np.eye(4, 3, k=-1), [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])
    mesh = "<compiler meshdir='meshes'/><asset><mesh name='m' file='a.stl'/></asset>"
    body = "<worldbody><body name='b'><geom type='mesh' mesh='m'/></body></worldbody>"
    write(tmp_path, "mesh.xml", f"<mujoco>{mesh}</mujoco>")
    write(tmp_path, "s.xml", f"<mujoco>{mesh}{body}</mujoco>")
    text = "<mujoco><include file='mesh.xml'/><asset><model name='s' file='s.xml'/></asset>" + body.replace(
        "</worldbody>", "<attach model='s' body='b' prefix='x_'/></worldbody>"
    )
    assert [part.kind for part in parts_of(write(tmp_path, "rack.xml", f"{text}</mujoco>"))] == [
        "mesh",
        "mesh",
    ]


@pytest.mark.parametrize(
    "times, deep, sentence", [(2, 25, "more than 100000 elements"), (1, 1500, "50 deep")]
)
def test_includes_of_includes_are_counted_before_any_is_followed(tmp_path, times, deep, sentence):
    """2^25 elements in 25 files and a chain of 1500 files are refused."""
    for i in range(deep):
        write(
            tmp_path,
            f"{i}.xml",
            f"<mujoco>{times * f'<include file={chr(34)}{i + 1}.xml{chr(34)}/>'}</mujoco>",
        )
    write(tmp_path, f"{deep}.xml", "<mujoco/>")
    with pytest.raises(PartsError, match=sentence):
        parts_of(tmp_path / "0.xml")
    write(tmp_path, "0.xml", "<mujoco><include file='0.xml'/></mujoco>")
    with pytest.raises(PartsError, match="includes '0.xml' in itself"):
        parts_of(tmp_path / "0.xml")


@pytest.mark.slow
@pytest.mark.parametrize(
    "text, sentence",
    [
        (
            "<asset><hfield name='h' nrow='30000' ncol='30000' size='1 1 1 1'/></asset>" + SHAPE,
            "memory|allocate",
        ),
        (
            "<worldbody><geom type='box' size='1e308 1 1'/></worldbody>",
            "is not a model|expected less than 100000",
        ),
        (
            "<worldbody><geom type='box' size='1 1 1' pos='1e200 0 0'/></worldbody>",
            "expected less than 100000",
        ),
    ],
)
def test_a_model_that_takes_too_much_is_refused(tmp_path, text, sentence):
    """A height field of 3.6 GB and unbounded numbers are refused."""
    pytest.importorskip("mujoco")
    with pytest.raises(PartsError, match=sentence):
        parts_of(write(tmp_path, "rack.xml", f"<mujoco>{text}</mujoco>"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("<mujoco><worldbody/></mujoco>", "has no shapes"),
        ("<mujoco>", "cannot be read"),
        ("<mujoco><worldbody><geom size='-1'/></worldbody></mujoco>", "is not a model"),
        (
            "<mujoco><worldbody><geom name='egg' type='ellipsoid' size='1 1 2'/></worldbody></mujoco>",
            "geom 'egg' is neither box",
        ),
        ("<mujoco><asset><mesh file='../secret.stl'/></asset></mujoco>", "names the file '../secret.stl'"),
        ("<mujoco><include file='/etc/passwd'/></mujoco>", "names the file '/etc/passwd'"),
    ],
)
def test_a_model_that_cannot_be_used_is_refused(tmp_path, text, sentence):
    """The message is one sentence with the object and the file."""
    pytest.importorskip("mujoco")
    write(tmp_path, "rack.xml", text)
    site = (
        WATER
        + "objects: {rack: {shape: model, file: rack.xml, position: [0, 0, -3]}}\nviewpoint: {position: [0, 0, -3]}"
    )
    with pytest.raises(WorldError, match=f"objects.rack: rack.xml {sentence}"):
        WorldLayout(str(write(tmp_path, "site.yaml", site)))
