"""Draft of a vehicle, which an importer fills, and the selection of an importer by content.

An importer is one file with an `Importer`, registered as `vehicle.FORMAT` in the family `IMPORTERS`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.core.importer import importers
from finssim.core.mesh import Faces, MeshError, Vertices, write_stl
from finssim.core.yaml_file import read_mapping, yaml_text
from finssim.vehicles.importers.elements import Element
from finssim.vehicles.importers.rigid import plain
from finssim.vehicles.loader import checked, importer_of
from finssim.vehicles.part import VehicleError
from finssim.vehicles.vehicle import AXES, Origin, Provenance, Vehicle

__all__ = [
    "Draft", "put_controlled_axes", "put_envelope", "read_foreign", "unread",
]  # fmt: skip

GRAVITY = 9.8
"""Gravity of Gazebo if a file defines none [m/s²]."""
SHARE = 0.3
"""Guessed limit of a thruster, as a fraction of the weight of the vehicle."""
LAG = 0.05
"""Guessed time constant of a thruster without lag in the file [s]."""


@dataclass
class Draft:
    """Vehicle that an importer has read: its numbers with their origins, the guesses, and contents that were
    not read."""

    label: str
    """Name of the file in messages."""
    source: str
    """Source of the numbers, used in their origins."""
    values: dict[str, Any] = field(default_factory=dict)
    """Content of the vehicle file, without origins."""
    origins: dict[str, Provenance] = field(default_factory=dict)
    """Origin of each number or list by dotted path."""
    guessed: dict[str, str] = field(default_factory=dict)
    """Dotted path of each number that is missing in the file -> how it was guessed."""
    not_read: Counter[str] = field(default_factory=Counter)
    """Contents of the file that the vehicle does not represent -> their number."""
    different: list[str] = field(default_factory=list)
    """Sentences about differences between the other program's model and FinsSim's."""
    hull: tuple[Vertices, Faces] | None = None
    """Closed mesh in body axes, vertices (n, 3) [m] and faces (m, 3), that is written to the hull's file."""
    missing: dict[str, Any] = field(default_factory=dict)
    """Lines of a vehicle file, with placeholders for numbers, that are required to complete the vehicle."""

    def put(self, path: str, value: Any, origin: Origin = "published", note: str = "") -> None:
        """Set a value from the file or derived from it, in the unit of the vehicle file."""
        node = self.values
        *sections, key = path.split(".")
        for section in sections:
            node = node.setdefault(section, {})
        node[key] = np.asarray(value).tolist() if isinstance(value, np.ndarray) else value
        self.origins[path] = Provenance(origin, self.source, note)

    def guess(self, path: str, value: Any, how: str) -> None:
        """Set a value that is missing in the file, in the unit of the vehicle file."""
        self.put(path, value)
        self.origins[path] = Provenance("guessed", "", how)
        self.guessed[path] = how

    def guesses(self) -> list[str]:
        """Return a sentence for each guess; equal guesses for several thrusters share one sentence."""
        grouped: dict[tuple[str, str, str], list[str]] = {}
        for path, how in self.guessed.items():
            section, _, rest = path.partition(".")
            name, _, key = rest.rpartition(".")
            value: Any = self.values
            for step in path.split("."):
                value = value[step]
            number = f"{value:.6g}" if isinstance(value, float) else str(np.round(value, 6).tolist())
            grouped.setdefault((f"{section}.*.{key}" if name else path, number, how), []).append(name)
        return [
            f"{path} = {number}{f' ({len(names)} times)' if len(names) > 1 else ''}: {how}"
            for (path, number, how), names in grouped.items()
        ]

    def vehicle(self, folder: Path) -> Vehicle:
        """Return the vehicle, with the checks of a vehicle file.

        Args:
            folder: Existing folder for the mesh of the hull; `write_vehicle` copies it.

        Raises:
            VehicleError: The numbers are invalid; the message names the file.
        """
        if self.missing:
            lines = {"extends": Path(self.label).name, "origin": "measured"} | self.missing
            text = yaml_text(lines, default_flow_style=True, width=10**6).strip().replace("'", "")
            raise VehicleError(
                f"{self.label}: {', '.join(self.missing)} cannot be read from it: write a file beside it with these "
                f"lines and your numbers, and use that as the vehicle: {text}"
            )
        values = dict(self.values)
        if self.hull is not None:
            file = folder / f"{Path(self.label).stem}.stl"
            write_stl(file, *self.hull)
            return checked(values | {"hull": {"file": file}}, self.origins, file.stem, None, self.label)
        try:
            parametric = values | {"hull": {"parametric": True}}
            vehicle = checked(parametric, self.origins, Path(self.label).stem, None, self.label)
            vehicle.hull_mesh()
        except (VehicleError, MeshError):  # the volume fits no hull of this size
            return checked(values, self.origins, Path(self.label).stem, None, self.label)
        return vehicle


def read_foreign(path: Path, folders: Sequence[Path] = ()) -> Draft:
    """Read the vehicle of another program with the importer that recognises its file.

    Args:
        path: The file.
        folders: Folders that are searched for referenced files besides its own folder.

    Raises:
        VehicleError: The file cannot be read, or has an unknown format.
    """
    if not path.is_file():
        raise VehicleError(f"{path}: no such file: give the file of a vehicle")
    importer = importer_of(path)
    if importer is not None and folders and not importer.folders:
        raise VehicleError(
            f"{path}: {importer.title} names files below its own folder only: leave out --folder"
        )
    if importer is not None:
        return importer.read(path, folders) if importer.folders else importer.read(path)
    known = ", ".join(sorted(member.title for member in importers("vehicle").values()))
    hint = ""
    if path.suffix in (".yaml", ".yml"):
        keys = read_mapping(path, VehicleError, such_as="body: {mass: 11.2}").keys()
        hint = (
            "; a vehicle file of FinsSim needs no import: give it with --vehicle"
            if keys & {"body", "extends"}
            else ""
        )
    raise VehicleError(f"{path}: has an unknown format, expected one of {known}{hint}")


NO_FORCE = {"visual", "sensor", "light", "surface", "laser_retro", "max_contacts", "self_collide"}
"""Elements without effect on the motion in open water."""


def unread(element: Element, known: Collection[str], where: str, draft: Draft) -> None:
    """Note the children that are not read.

    Args:
        element: Parent element.
        known: Names of the children that are read.
        where: Name of the parent in the note.
        draft: Draft to which the notes are added.
    """
    for child in element:
        if child.tag not in known:
            kind = f" {child.get('type')}" if child.tag == "sensor" and child.get("type") else ""
            idle = " (no force)" if child.tag in NO_FORCE else ""
            draft.not_read[f"{where}: {child.tag}{kind}{idle}"] += 1


# Numbers that no format contains.


def put_envelope(draft: Draft, corners: Sequence[NDArray[np.float64]]) -> None:
    """Guess the size: the bounding box of shapes and thrusters, enlarged to the displaced volume if necessary.

    Args:
        draft: Draft with volume and thrusters.
        corners: Points of the shapes in the body frame [m], (n, 3) each.
    """
    thrusters = draft.values.get("thrusters", {}).values()
    positions = [np.array(thruster["position"])[None] for thruster in thrusters if "position" in thruster]
    points = np.concatenate([*corners, *positions] or [np.zeros((1, 3))])
    if not corners:
        points = np.concatenate([points, 2.0 * np.array(draft.values["body"]["center_of_gravity"]) - points])
    shortest = 0.5 * draft.values["body"]["displaced_volume"] ** (1.0 / 3.0)
    size = np.maximum(np.ptp(points, axis=0), shortest)
    size *= max(1.0, (1.01 * draft.values["body"]["displaced_volume"] / np.prod(size)) ** (1.0 / 3.0))
    draft.guess("body.size", plain(size), "box around the collision shapes and the thrusters")
    draft.guess("body.surface_half_height", float(size[2] / 2.0), "half of the height of the size")


def put_controlled_axes(draft: Draft) -> None:
    """Set the controlled axes: those along which the thrusters can push with little coupling to the others."""
    thrusters, centre = draft.values["thrusters"].values(), draft.values["body"]["center_of_gravity"]
    axes_of = np.array([thruster["axis"] for thruster in thrusters])
    arms = np.array([thruster["position"] for thruster in thrusters]) - centre
    B = np.vstack([axes_of.T, np.cross(arms, axes_of).T])
    B[3:] /= max(float(np.linalg.norm(draft.values["body"]["size"])) / 2.0, 1e-9)
    U, singular, _ = np.linalg.svd(B)
    reach = U[:, : int((singular > 0.1 * singular[0]).sum())]
    rest = np.linalg.norm(np.eye(6) - reach @ reach.T, axis=0)
    axes = [axis for axis, left in zip(AXES, rest, strict=True) if left < 0.3]
    if 0 < len(axes) < 6:
        draft.values["controlled_axes"] = axes
        missing = ", ".join(axis for axis in AXES if axis not in axes)
        draft.different.append(f"the thrusters do not control {missing}: it is not part of controlled_axes")
