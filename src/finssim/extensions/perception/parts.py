"""Rigid models of other programs as shapes of a world: MJCF and URDF, read by MuJoCo."""
# mypy: ignore-errors

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from finssim.core.budget import DEPTH, FILE, NODES, in_child, read_bytes
from finssim.core.mesh import FARTHEST
from finssim.core.rotations import matrix_to_quat

SUFFIXES = (".xml", ".mjcf", ".urdf")


class PartsError(ValueError):
    """Model file that cannot be used; the message is one sentence without the file's name."""


@dataclass(frozen=True, kw_only=True)
class ModelPart:
    """One shape of a model, in the model's axes, z up."""

    kind: str
    """box, sphere, capsule, cylinder, plane or mesh."""
    position: np.ndarray
    """Position of the shape [m], (3,)."""
    quaternion: np.ndarray
    """Attitude of the shape relative to the model, xyzw, (4,)."""
    size: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Half extents of a box; radius and half length of spheres, capsules and cylinders [m]."""
    vertices: np.ndarray | None = None
    """Vertices of a mesh, shape axes [m], (n, 3)."""
    faces: np.ndarray | None = None
    """Vertex indices of each face, (m, 3)."""
    colour: np.ndarray | None = None
    """Diffuse reflectance of red, green and blue, (3,); None if the file specifies none."""


def parts_of(path: Path) -> list[ModelPart]:
    """Return the shapes of a model file at rest, with all joints at zero.

    Args:
        path: MJCF (`.xml`, `.mjcf`) or URDF (`.urdf`), which need `finssim[mujoco]`. Files that it names must be in
            its folder or below.

    Raises:
        PartsError: The file cannot be read, or has a shape that worlds do not support.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise PartsError(f"ends in '{path.suffix}', expected one of {', '.join(SUFFIXES)}")
    parts = [ModelPart(**part) for part in in_child(_shapes, (path.name, _files_of(path)), PartsError)]
    if not parts:
        raise PartsError("has no shapes")
    for part in parts:
        numbers = np.concatenate(
            [part.position, part.size, np.ravel(0.0 if part.vertices is None else part.vertices)]
        )
        if not np.abs(numbers).max() < FARTHEST:
            raise PartsError(
                f"has a {part.kind} at or of {np.abs(numbers).max():.3g} m, expected less than {FARTHEST:g}"
            )
    return parts


def _shapes(model: tuple[str, dict[str, bytes]]) -> list[dict[str, Any]]:
    """Return the shapes of a model as plain data, in the child process, from its name and MuJoCo's files."""
    return [dict(vars(part)) for part in _mujoco(*model)]


def _mujoco(name: str, files: dict[str, bytes]) -> Iterator[ModelPart]:
    try:
        import mujoco
    except ImportError:
        raise PartsError("needs mujoco: pip install 'finssim[mujoco]'") from None
    try:
        text = files.pop(name).decode("utf-8", "replace")
        model = mujoco.MjModel.from_xml_string(text, assets=files)  # a file system with only these files
    except ValueError as error:
        raise PartsError(f"is not a model: {' '.join(str(error).split())[:160]}") from None
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    kinds = {int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")): kind for kind in
             ("box", "sphere", "capsule", "cylinder", "plane", "mesh")}  # fmt: skip
    for g in range(model.ngeom):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, g) or f"{g}"
        kind = kinds.get(int(model.geom_type[g]))
        if kind is None:
            raise PartsError(f"geom '{name}' is neither {', '.join(kinds.values())}: replace it")
        mesh = {}
        if kind == "mesh":
            m = model.geom_dataid[g]
            v, f = model.mesh_vertadr[m], model.mesh_faceadr[m]
            mesh["vertices"] = model.mesh_vert[v : v + model.mesh_vertnum[m]].astype(float)
            mesh["faces"] = model.mesh_face[f : f + model.mesh_facenum[m]].astype(int)
        size = (0.0, 0.0, 0.0) if kind in ("plane", "mesh") else tuple(map(float, model.geom_size[g]))
        material = model.geom_matid[g]
        rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[g]
        yield ModelPart(
            kind=kind, position=data.geom_xpos[g].copy(), size=size, colour=rgba[:3].astype(float),
            quaternion=matrix_to_quat(data.geom_xmat[g].reshape(3, 3)), **mesh,
        )  # fmt: skip


def _files_of(path: Path) -> dict[str, bytes]:
    """Return the model and the files of its folder that it may name, by their paths relative to that folder.

    Raises:
        PartsError: A file outside the folder is named, or too much is included.
    """
    folder, files, sizes = path.parent, dict[str, bytes](), dict[str, int]()

    def add(name: str) -> bool:
        if name in files or not (folder / name).is_file():
            return name in files
        if name != path.name and not (folder / name).resolve().is_relative_to(folder.resolve()):
            raise PartsError(
                f"names the file '{name}', which is a link: put it into the model's folder or below"
            )
        files[name] = read_bytes(folder / name, PartsError, "has a file that")
        if sum(map(len, files.values())) > FILE:
            raise PartsError(f"has files of more than {FILE >> 20} MiB: make them smaller")
        return True

    def elements_of(name: str, including: tuple[str, ...]) -> int:
        """Count the elements of a model file and the files that it includes; 0 if it is not a model."""
        if name in including or len(including) > DEPTH:
            raise PartsError(f"includes '{name}' in itself or more than {DEPTH} deep: include each file once")
        if name in sizes:
            return sizes[name]
        try:
            tree = ElementTree.fromstring(files[name])
        except ElementTree.ParseError as error:
            if including:
                return 0
            raise PartsError(f"cannot be read: {error}") from None
        elements = list(tree.iter())
        if len(elements) > NODES:
            raise PartsError(f"has more than {NODES} elements: make it smaller")
        named = [(element, key, value) for element in elements for key, value in element.items()
                 if key.startswith("file") or key.endswith("dir")]  # fmt: skip
        for _, _, value in named:
            if value.startswith(("/", "\\", "~")) or re.search(r"^[A-Za-z]:|(^|[/\\])\.\.([/\\]|$)", value):
                raise PartsError(f"names the file '{value}': put it into the model's folder or below")
        places = ["", *(value for _, key, value in named if key.endswith("dir")), str(Path(name).parent)]
        count = len(elements)
        for _, key, value in named:
            for place in () if key.endswith("dir") else dict.fromkeys(places):
                for below in dict.fromkeys((value.removeprefix("package://"), Path(value).name)):
                    found = (Path(place) / below).as_posix()
                    if add(found) and _is_model(files[found]):
                        count += elements_of(found, (*including, name))
                        if count > NODES:
                            raise PartsError(f"includes more than {NODES} elements: include each file once")
        sizes[name] = count
        return count

    if not add(path.name):
        raise PartsError("cannot be read: no such file")
    elements_of(path.name, ())
    return files


def _is_model(data: bytes) -> bool:
    """Return whether a file may be XML rather than a mesh or a picture."""
    return data[:64].lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<")
