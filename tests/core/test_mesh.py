"""Closed meshes: integrals against closed forms, properties of hulls, and refusals."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from finssim.core.mesh import (
    MeshError,
    check_closed,
    face_geometry,
    load_stl,
    mesh_centroid,
    mesh_volume,
    outward,
    parametric_hull,
    write_stl,
)

FINSROV = parametric_hull((0.56, 0.42, 0.25), 0.0118)


def box(size, center=(0.0, 0.0, 0.0)):
    """Return a box: the hull whose volume is that of its envelope."""
    return parametric_hull(size, float(np.prod(size)), center)


def test_box_has_volume_and_centroid_of_a_box():
    """V = abc, and the centre is at the given position."""
    a, b, c = 0.5, 0.4, 0.3
    vertices, faces = box((a, b, c), center=(1.0, -2.0, 3.0))
    assert mesh_volume(vertices, faces) == pytest.approx(a * b * c, rel=1e-12)
    assert mesh_centroid(vertices, faces) == pytest.approx([1.0, -2.0, 3.0], rel=1e-12)


@pytest.mark.parametrize("offset", [0.0, 1e4])
def test_tetrahedron_volume_and_centroid_wherever_it_lies(offset):
    """V = |det|/6 and the centroid is the mean of the corners, also far from the origin."""
    vertices = np.array([[0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 4]], float) + offset
    faces = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]
    assert mesh_volume(vertices, faces) == pytest.approx(4.0, rel=1e-9)
    assert mesh_centroid(vertices, faces) == pytest.approx(vertices.mean(axis=0), rel=1e-12)


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    size=st.tuples(*[st.floats(0.05, 5.0)] * 3),
    fill=st.floats(0.001, 1.0),
    center=st.tuples(*[st.floats(-1.0, 1.0)] * 3),
)
def test_hull_has_the_envelope_the_volume_and_the_center_asked_for(size, fill, center):
    """Whatever fraction of its envelope the hull fills, it is closed and has exactly the requested properties."""
    volume = fill * np.prod(size)
    vertices, faces = parametric_hull(size, volume, center)
    check_closed(vertices, faces)
    assert len(faces) in (240, 320)
    assert mesh_volume(vertices, faces) == pytest.approx(volume, rel=1e-9)
    assert mesh_centroid(vertices, faces) == pytest.approx(center, abs=1e-9 * max(size))
    assert vertices.max(axis=0) - vertices.min(axis=0) == pytest.approx(size, rel=1e-9)
    assert (vertices.max(axis=0) + vertices.min(axis=0)) / 2 == pytest.approx(center, abs=1e-9 * max(size))


@pytest.mark.parametrize("fill", [0.2, 0.6, 0.9])
def test_hull_mirrors_on_its_three_planes(fill):
    """Mirroring leaves the set of triangles unchanged: the choice of diagonals breaks no plane of symmetry."""
    vertices, faces = parametric_hull((1.0, 0.8, 0.6), fill * 0.48)
    normal, area, centroid = face_geometry(vertices, faces)
    table = np.column_stack([centroid, normal, area])
    for axis in range(3):
        mirrored = table.copy()
        mirrored[:, [axis, axis + 3]] *= -1.0
        distance = np.abs(table[:, None] - mirrored[None]).max(axis=2)
        assert distance.min(axis=1).max() < 1e-12


def test_slender_hull_is_round_across():
    """A tube's section is a circle: every vertex satisfies |x|^n + r^n = 1, so r depends on |x| alone."""
    vertices, _ = parametric_hull((1.6, 0.19, 0.19), 0.0306)
    middle = np.isclose(vertices[:, 0], 0.0)
    assert np.linalg.norm(vertices[middle, 1:], axis=1) == pytest.approx(0.095, rel=1e-9)


def test_face_areas_close_the_surface():
    """The area vectors of a closed surface sum to zero."""
    normal, area, _ = face_geometry(*FINSROV)
    assert area @ normal == pytest.approx(np.zeros(3), abs=1e-15)
    assert np.linalg.norm(normal, axis=1) == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize(
    ("size", "volume", "message"),
    [
        ((1, 1, 1), 1.1, "does not fit"),
        ((1, 0, 1), 0.1, "positive"),
        ((1, 1, 1), 0.0, "positive"),
        ((1, 1), 0.1, "three"),
    ],
)
def test_impossible_hull_is_refused(size, volume, message):
    with pytest.raises(MeshError, match=message):
        parametric_hull(size, volume)


def test_binary_stl_round_trip(tmp_path):
    """A written file reads back to float32, with the shared vertices merged."""
    write_stl(tmp_path / "hull.stl", *FINSROV)
    vertices, faces = load_stl(tmp_path / "hull.stl")
    check_closed(vertices, faces)
    assert (len(vertices), len(faces)) == (len(FINSROV[0]), len(FINSROV[1]))
    assert mesh_volume(vertices, faces) == pytest.approx(0.0118, rel=1e-6)
    assert vertices[faces] == pytest.approx(FINSROV[0][FINSROV[1]], rel=1e-6, abs=1e-8)


def test_ascii_and_binary_stl_agree(tmp_path):
    """Both forms give the same triangles, also where a binary header begins with the word "solid"."""
    vertices, faces = box((1.0, 2.0, 3.0))
    lines = ["solid box"]
    for corners in vertices[faces]:
        lines += ["facet normal 0 0 0", " outer loop"]
        lines += [f"  vertex {x:.9e} {y:.9e} {z:.9e}" for x, y, z in corners]
        lines += [" endloop", "endfacet"]
    (tmp_path / "ascii.stl").write_text("\n".join([*lines, "endsolid box"]))
    write_stl(tmp_path / "binary.stl", vertices, faces)
    data = bytearray((tmp_path / "binary.stl").read_bytes())
    data[:5] = b"solid"
    (tmp_path / "binary.stl").write_bytes(data)
    one, other = load_stl(tmp_path / "ascii.stl"), load_stl(tmp_path / "binary.stl")
    assert one[0][one[1]] == pytest.approx(other[0][other[1]], rel=1e-7)


def test_unreadable_stl_is_refused(tmp_path):
    """A file that is truncated, of another kind, without triangles or with an invalid number is named."""
    write_stl(tmp_path / "hull.stl", *FINSROV)
    whole = (tmp_path / "hull.stl").read_bytes()
    for content, message in [
        (whole[:-10], "cut short"),
        (b"ply\nformat ascii 1.0\n", "not an STL"),
        (b"", "not an STL"),
        (b"solid nothing\nendsolid nothing\n", "three per triangle"),
        (b"solid a\nvertex 0 0 zero\nendsolid a\n", "unreadable vertex"),
        (b"solid a\nvertex 0 0 nan\nvertex 0 1 0\nvertex 1 0 0\nendsolid a\n", "finite"),
        (
            b"solid a\nvertex 0 0 2e38\nvertex 0 1 0\nvertex 1 0 0\nendsolid a\n",
            "2e\\+38, expected up to 100000 m",
        ),
    ]:
        (tmp_path / "bad.stl").write_bytes(content)
        with pytest.raises(MeshError, match=f"bad.stl.*{message}"):
            load_stl(tmp_path / "bad.stl")


def test_open_turned_and_flat_surfaces_are_refused():
    """Each fault is named with its count."""
    vertices, faces = box((1.0, 1.0, 1.0))
    with pytest.raises(MeshError, match="3 of .* edges are open"):
        check_closed(vertices, faces[1:])
    with pytest.raises(MeshError, match="3 of .* opposite orientation"):
        check_closed(vertices, np.concatenate([faces[:1, ::-1], faces[1:]]))
    with pytest.raises(MeshError, match="1 of 1 parts are inverted"):
        check_closed(vertices, faces[:, ::-1])
    with pytest.raises(MeshError, match="1 of 321 faces are degenerate"):
        check_closed(vertices, np.concatenate([faces, [[0, 1, 1]]]))
    with pytest.raises(MeshError, match="expected 0 to"):
        check_closed(vertices[:-1], faces)
    with pytest.raises(MeshError, match="m > 0"):
        check_closed(vertices, faces[:0])


def test_one_inverted_part_is_found_and_turned():
    """A second body exported inside out would subtract from the volume; inverted, both add up."""
    near, faces = box((1.0, 1.0, 1.0))
    vertices = np.concatenate([near, near * 0.5 + [2.0, 0.0, 0.0]])
    both = np.concatenate([faces, faces[:, ::-1] + len(near)])
    with pytest.raises(MeshError, match=r"1 of 2 parts are inverted \(volume -0.125 m³"):
        check_closed(vertices, both)
    turned = outward(vertices, both)
    check_closed(vertices, turned)
    assert mesh_volume(vertices, turned) == pytest.approx(1.125, rel=1e-12)
