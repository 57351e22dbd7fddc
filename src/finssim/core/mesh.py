"""Closed triangle meshes: reading, checking, volume integrals, and a simple hull defined by a few numbers.

A mesh is a pair `(vertices (n, 3) float64 [m], faces (m, 3) int)`; seen from outside, the vertices of a face
run counter-clockwise.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finssim.core.budget import read_bytes

# Hull shapes in the cube [-1, 1]³: ellipsoid, tube, rounded box, and the open frame of a small ROV.

_ROUND = 0.5  # reciprocal exponent of a circle


def unit_hull(fill: float) -> tuple[Vertices, Faces]:
    """Return a rounded box, tube or open frame that touches all sides of the cube and fills a fraction of its volume.

    Args:
        fill: The fraction, above 0 and up to 1.

    Returns:
        Vertices in a cube of unit size, (n, 3), and outward faces (m, 3).
    """
    from scipy.optimize import brentq  # imported late: a robot that needs no hull starts without it

    cells = (8, 4, 4)

    def excess(along: float, across: float) -> float:
        return _volume(*_superellipsoid(cells, along, across)) / 8.0 - fill

    if excess(_ROUND, _ROUND) > 0.0:
        return _open_frame(fill)
    if excess(0.0, _ROUND) > 0.0:
        return _superellipsoid(cells, brentq(lambda s: excess(s, _ROUND), 0.0, _ROUND, xtol=1e-15), _ROUND)
    if excess(0.0, 0.0) <= 0.0:
        return _superellipsoid(cells, 0.0, 0.0)
    s = brentq(lambda s: excess(s, s), 0.0, _ROUND, xtol=1e-15)
    return _superellipsoid(cells, s, s)


def _open_frame(fill: float, gap: float = 0.02) -> tuple[Vertices, Faces]:
    """Return two floats and the deck between them in [-1, 1]³.

    At thickness t a float takes t/3 of the width and the deck t of the height, with `gap`, a fraction of the width,
    open on either side: fill / k = 2t/3 + t (1 - 2t/3 - 2 gap), where k is the fill of one body in its own box.
    """
    body, faces = _superellipsoid((4, 2, 2), 0.15, 0.15)
    k = _volume(body, faces) / 8.0
    b = 5.0 / 3.0 - 2.0 * gap
    t = (b - math.sqrt(b * b - 8.0 / 3.0 * fill / k)) * 0.75
    side = body * [1.0, t / 3.0, 1.0]
    aside = np.array([0.0, 1.0 - t / 3.0, 0.0])
    deck = body * [1.0, 1.0 - 2.0 * t / 3.0 - 2.0 * gap, t]
    vertices = np.concatenate([side - aside, deck, side + aside])
    return vertices, np.concatenate([faces + i * len(body) for i in range(3)])


def _superellipsoid(cells: tuple[int, int, int], along: float, across: float) -> tuple[Vertices, Faces]:
    """Return the surface in [-1, 1]³: |x|ⁿ + rⁿ = 1 with rᵐ = |y|ᵐ + |z|ᵐ.

    Args:
        cells: Even numbers of cells along x, y and z of the cube whose grid is projected onto the surface.
        along: 1/n, from 0 (flat ends) to 0.5 (elliptic).
        across: 1/m, from 0 (a rectangular section) to 0.5 (a round one).

    Returns:
        Vertices (n, 3) and faces (m, 3), two for each cell, mirrored on the three planes.
    """
    points, faces = _cube(cells)
    square = np.abs(points[:, 1:]).max(axis=1)
    section = _norm(points[:, 1:], across)
    points[:, 1:] *= np.divide(square, section, out=np.ones_like(square), where=section > 0)[:, None]
    return points / _norm(np.stack([points[:, 0], square], axis=1), along)[:, None], faces


def _norm(x: NDArray[np.float64], s: float) -> NDArray[np.float64]:
    """Return the norm (sum of |x|^(1/s))^s over the last axis, the greatest |x| for s = 0."""
    greatest = np.abs(x).max(axis=-1)
    if s == 0.0:
        return np.asarray(greatest)
    scaled = np.divide(np.abs(x), greatest[..., None], out=np.zeros_like(x), where=greatest[..., None] > 0)
    return np.asarray(greatest * (scaled ** (1.0 / s)).sum(axis=-1) ** s)


def _cube(cells: tuple[int, int, int]) -> tuple[Vertices, Faces]:
    """Return the surface of the cube [-1, 1]³ with even numbers of `cells` along x, y, z, two triangles per
    cell."""
    corners = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for i in range(cells[u]):
            for j in range(cells[v]):
                quad = np.ones((4, 3))
                quad[:, u] = np.array([i, i + 1, i + 1, i]) * 2.0 / cells[u] - 1.0
                quad[:, v] = np.array([j, j, j + 1, j + 1]) * 2.0 / cells[v] - 1.0
                # The diagonal that does not point to the centre of the side keeps the rounded body convex.
                first = 1 if (2 * i < cells[u]) == (2 * j < cells[v]) else 0
                a, b, c, d = np.roll(quad, -first, axis=0)
                front = np.stack([[a, b, c], [a, c, d]])
                back = front[:, ::-1].copy()
                back[..., axis] = -1.0
                corners += [front, back]
    points, index = np.unique(np.concatenate(corners).reshape(-1, 3), axis=0, return_inverse=True)
    return points, index.reshape(-1, 3).astype(np.int64)


def _volume(points: Vertices, faces: Faces) -> float:
    return float(np.linalg.det(points[faces]).sum() / 6.0)


Vertices = NDArray[np.float64]
Faces = NDArray[np.int64]


class MeshError(ValueError):
    """Error in a mesh file, or in a surface that cannot be used as a hull."""


FARTHEST = 1e5
"""Largest plausible coordinate in a file, also for a hull in millimetres; a larger one is an error [m]."""


def load_stl(path: str | Path) -> tuple[Vertices, Faces]:
    """Read a binary or ASCII STL file.

    Args:
        path: The file; its lengths are assumed to be in metres.

    Returns:
        Vertices (n, 3) [m], equal corners merged into one, and faces (m, 3).

    Raises:
        MeshError: The file is not an STL file, is truncated, contains no triangle, or contains an implausible number.
    """
    data = read_bytes(Path(path), MeshError)
    triangles = int.from_bytes(data[80:84], "little") if len(data) >= 84 else -1
    # A binary file may begin with "solid" too, so its length decides, not its first word.
    if len(data) == 84 + 50 * triangles:
        record = np.dtype([("floats", "<f4", 12), ("attribute", "<u2")])
        corners = np.frombuffer(data, record, offset=84)["floats"][:, 3:].reshape(-1, 3).astype(np.float64)
    elif data.lstrip()[:5].lower() == b"solid":
        lines = (line.split() for line in data.decode("ascii", "replace").splitlines())
        try:
            corners = np.array([[float(x) for x in line[1:4]] for line in lines if line[:1] == ["vertex"]])
        except ValueError as error:
            raise MeshError(f"{path}: unreadable vertex ({error}): save the mesh again") from error
    else:
        raise MeshError(
            f"{path}: {len(data)} bytes are not an STL file (binary: 84 + 50 per triangle, ASCII: begins "
            "with 'solid'): it may be cut short or of another format; export it as binary STL"
        )
    if corners.size == 0 or corners.shape[0] % 3 or corners.shape[-1] != 3:
        raise MeshError(
            f"{path}: {len(corners)} vertices, expected three per triangle, at least one triangle"
        )
    if not np.isfinite(corners).all():
        raise MeshError(f"{path}: holds coordinates that are not finite numbers: save the mesh again")
    if (farthest := float(np.abs(corners).max())) > FARTHEST:
        raise MeshError(
            f"{path}: a coordinate is {farthest:.3g}, expected up to {FARTHEST:g} m: save the mesh again, in metres"
        )
    vertices, index = np.unique(corners, axis=0, return_inverse=True)
    return vertices, index.reshape(-1, 3).astype(np.int64)


def load_obj(path: str | Path) -> tuple[Vertices, Faces]:
    """Read the polygons of a Wavefront OBJ file, with all its objects combined.

    Args:
        path: The file; its lengths are assumed to be in metres.

    Returns:
        Vertices (n, 3) [m] and faces (m, 3): a polygon is split into a fan of triangles.

    Raises:
        MeshError: The file contains no polygon, a polygon with missing vertices, or an implausible number.
    """
    corners: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    try:
        for line in read_bytes(Path(path), MeshError).decode("utf-8", "replace").splitlines():
            words = line.split()
            if words[:1] == ["v"]:
                corners.append([float(word) for word in words[1:4]])
            elif words[:1] == ["f"]:
                numbers = [int(word.partition("/")[0]) for word in words[1:]]
                corner = [number - 1 if number > 0 else len(corners) + number for number in numbers]
                faces += [(corner[0], b, c) for b, c in zip(corner[1:-1], corner[2:], strict=True)]
        vertices, index = (
            np.array(corners, np.float64).reshape(-1, 3),
            np.array(faces, np.int64).reshape(-1, 3),
        )
    except ValueError as error:
        raise MeshError(f"{path}: cannot be read as OBJ: {error}") from None
    if index.size == 0 or index.min() < 0 or index.max() >= len(vertices):
        raise MeshError(f"{path}: contains no polygon, or a polygon with missing vertices: export it again")
    if not np.abs(vertices).max() <= FARTHEST:
        raise MeshError(
            f"{path}: a coordinate is not a number up to {FARTHEST:g} m: save the mesh again, in metres"
        )
    return vertices, index


def write_stl(path: str | Path, vertices: ArrayLike, faces: ArrayLike) -> None:
    """Write a binary STL file (float32).

    Args:
        path: The file to write.
        vertices: Vertices (n, 3) [m].
        faces: Faces (m, 3).
    """
    corners = np.asarray(vertices, np.float64)[np.asarray(faces)]
    normal, _, _ = face_geometry(vertices, faces)
    record = np.zeros(len(corners), np.dtype([("floats", "<f4", 12), ("attribute", "<u2")]))
    record["floats"] = np.concatenate([normal, corners.reshape(-1, 9)], axis=1)
    Path(path).write_bytes(b"closed hull [m]".ljust(80) + struct.pack("<I", len(corners)) + record.tobytes())


def face_geometry(vertices: ArrayLike, faces: ArrayLike) -> tuple[Vertices, NDArray[np.float64], Vertices]:
    """Return the normals, areas and centroids of the faces.

    Args:
        vertices: Vertices (n, 3) [m].
        faces: Faces (m, 3).

    Returns:
        Outward unit normals (m, 3) (zero where the area is), areas (m,) [m²] and centroids (m, 3) [m].
    """
    a, b, c = np.moveaxis(np.asarray(vertices, np.float64)[np.asarray(faces)], 1, 0)
    twice = np.cross(b - a, c - a)
    length = np.linalg.norm(twice, axis=1)
    normal = np.divide(twice, length[:, None], out=np.zeros_like(twice), where=length[:, None] > 0)
    return normal, 0.5 * length, np.asarray((a + b + c) / 3.0)


def mesh_volume(vertices: ArrayLike, faces: ArrayLike) -> float:
    """Return the enclosed volume [m³], by the divergence theorem; negative if the faces point inward."""
    return float(_tetrahedra(vertices, faces)[0].sum())


def mesh_centroid(vertices: ArrayLike, faces: ArrayLike) -> NDArray[np.float64]:
    """Return the centroid (3,) [m] of the enclosed volume, in the mesh's own frame."""
    volume, corners, origin = _tetrahedra(vertices, faces)
    # Tetrahedron (origin, a, b, c): its centroid is a quarter of a + b + c away from the origin.
    return np.asarray(origin + (volume @ corners.sum(axis=1)) / (4.0 * volume.sum()))


def _tetrahedra(vertices: ArrayLike, faces: ArrayLike) -> tuple[NDArray[np.float64], Vertices, Vertices]:
    """Return the signed volumes (m,) of tetrahedra on the faces, corners (m, 3, 3) relative to their apex, and the apex
    (3,)."""
    points = np.asarray(vertices, np.float64)
    # Apex in the middle of the vertices: a hull far from its origin would otherwise lose digits by cancellation.
    origin = points.mean(axis=0)
    corners = (points - origin)[np.asarray(faces)]
    return np.linalg.det(corners) / 6.0, corners, origin


def check_closed(vertices: ArrayLike, faces: ArrayLike) -> None:
    """Refuse a surface that does not enclose volumes with its faces pointing outward.

    Each edge must be traversed equally often in both directions, no face may be degenerate, and every
    connected part must have a positive volume (a cavity is refused: water does not reach its walls).

    Args:
        vertices: Vertices (n, 3) [m], shared between neighbouring faces.
        faces: Faces (m, 3).

    Raises:
        MeshError: The surface is invalid; the message states the error, the number of occurrences and the remedy.
    """
    points, triangles = np.asarray(vertices, np.float64), np.asarray(faces)
    if points.shape[1:] != (3,) or triangles.shape[1:] != (3,) or not len(triangles):
        raise MeshError(
            f"vertices {points.shape}, faces {triangles.shape}, expected (n, 3), (m, 3) with m > 0"
        )
    if triangles.min() < 0 or triangles.max() >= len(points):
        raise MeshError(
            f"faces name vertex {triangles.min()} to {triangles.max()}, expected 0 to {len(points) - 1}"
        )

    extent = np.ptp(points, axis=0).max()
    flat = int((face_geometry(points, triangles)[1] <= 1e-12 * extent**2).sum())
    if flat:
        raise MeshError(
            f"{flat} of {len(triangles)} faces are degenerate (no area): remove them and merge their vertices"
        )

    from scipy.sparse import coo_matrix

    start, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    n = len(points)
    edge = (np.minimum(start, end), np.maximum(start, end))
    # +1 along the edge, -1 against it: balanced if closed, doubled where a neighbour has the opposite orientation.
    balance = coo_matrix((np.where(start < end, 1, -1), edge), (n, n)).tocsr()
    uses = coo_matrix((np.ones(len(start), int), edge), (n, n)).tocsr()
    opened = int((uses.data % 2 == 1).sum())
    if opened:
        raise MeshError(
            f"{opened} of {uses.nnz} edges are open (an odd number of faces at them): close the holes, or "
            "merge vertices that coincide"
        )
    turned = int((balance.data != 0).sum())
    if turned:
        raise MeshError(
            f"{turned} of {uses.nnz} edges join faces of opposite orientation: make the normals consistent"
        )

    volume = _parts(points, triangles)[1]
    inverted = int((volume <= 0.0).sum())
    if inverted:
        raise MeshError(
            f"{inverted} of {len(volume)} parts are inverted (volume {volume.min():.3g} m³, expected > 0): "
            "remove them if they are cavities, otherwise turn them with finssim.core.mesh.outward"
        )


def outward(vertices: ArrayLike, faces: ArrayLike) -> Faces:
    """Flip the faces of connected parts that enclose a negative volume, which some modelling tools export.

    Args:
        vertices: Vertices (n, 3) [m], shared between neighbouring faces.
        faces: Faces (m, 3), consistent within each part.

    Returns:
        Faces (m, 3), those of every part pointing outward. A cavity becomes a body: remove it first.
    """
    triangles = np.array(faces, np.int64)
    part, volume = _parts(vertices, triangles)
    turned = volume[part] < 0.0
    triangles[turned] = triangles[turned, ::-1]
    return triangles


def _parts(vertices: ArrayLike, faces: Faces) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the index of the connected part of each face (m,), and the volume (parts,) [m³] of each part."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n = int(faces.max()) + 1
    edges = coo_matrix((np.ones(faces.size), (faces.ravel(), np.roll(faces, -1, axis=1).ravel())), (n, n))
    part = connected_components(edges, directed=False)[1][faces[:, 0]]
    part = np.unique(part, return_inverse=True)[1].astype(np.int64)
    return part, np.bincount(part, _tetrahedra(vertices, faces)[0]).astype(np.float64)


def parametric_hull(
    size: ArrayLike, volume: float, center: ArrayLike = (0.0, 0.0, 0.0)
) -> tuple[Vertices, Faces]:
    """Return a simple closed hull with a given envelope, volume and centroid, of 240 or 320 triangles.

    With f = volume / envelope volume:

    - f above about 0.77: a rounded box, the superellipsoid |x|ⁿ + |y|ⁿ + |z|ⁿ = 1;
    - f from about 0.5, an ellipsoid, up to that value: a tube along x with a round section and rounded ends,
      |x|ⁿ + rⁿ = 1 with r = |(y, z)|;
    - below: the open frame of a small ROV: two upright floats and, a gap away from each, a level deck between
      them; three bodies of full length with rounded corners.

    The exponent n, or the thickness of floats and deck, is solved for the exact volume. The hull, including
    its triangles, is symmetric about all three planes through its centre.

    Args:
        size: Envelope along x, y, z (3,) [m].
        volume: Enclosed volume [m³].
        center: Centre of the envelope, which is also the volume's centroid (3,) [m].

    Returns:
        Vertices (n, 3) [m] and faces (m, 3), closed and outward.

    Raises:
        MeshError: A length or the volume is not positive, or the volume exceeds that of the envelope.
    """
    extent, middle = np.asarray(size, np.float64), np.asarray(center, np.float64)
    if extent.shape != (3,) or not np.all(extent > 0.0) or not volume > 0.0:
        raise MeshError(
            f"size {extent.tolist()} and volume {volume}, expected three positive lengths and volume > 0"
        )
    fill = volume / float(extent.prod())
    if fill > 1.0 + 1e-9:
        raise MeshError(
            f"volume {volume:.6g} m³ does not fit in the envelope {extent.tolist()} m, which holds "
            f"{extent.prod():.6g} m³: lower the volume or enlarge the size"
        )
    unit, faces = unit_hull(fill)
    return middle + 0.5 * extent * unit, faces
