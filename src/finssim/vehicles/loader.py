"""Reader of vehicle files: a name or a path is loaded as a validated `Vehicle`."""

from __future__ import annotations

import copy
import math
import os
import re
import warnings
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from pydantic import ValidationError

from finssim.core.files import plain_name
from finssim.core.importer import Importer, first_bytes, importers, recognised
from finssim.core.registry import VEHICLES, RegistryError
from finssim.core.yaml_file import read_mapping
from finssim.vehicles.importers.rigid import combined
from finssim.vehicles.part import VehicleError, VehicleWarning, did_you_mean, sentence_of
from finssim.vehicles.tag_layout import with_layout
from finssim.vehicles.vehicle import ORIGINS, Origin, Provenance, Vehicle

GREATEST = 1e12
"""Largest magnitude of a number in a vehicle file; squares and products of larger ones exceed double precision."""
OWN = re.compile(rb"(?m)^(title|extends|origin|body|thrusters)\s*:")
"""Start of a line that identifies a vehicle file of FinsSim."""

Tree = dict[str, Any]
Origins = dict[str, Provenance]


def catalogue() -> list[str]:
    """Return the names of the vehicles of FinsSim and of installed packages."""
    return sorted(VEHICLES)


def load_vehicle(name_or_path: Vehicle | str | os.PathLike[str]) -> Vehicle:
    """Read and check a vehicle.

    Args:
        name_or_path: A catalogue name such as `finsrov`, or the path of a vehicle file or of another program's model,
            whose guessed numbers are listed in a `VehicleWarning`; a `Vehicle` is returned unchanged.

    Raises:
        VehicleError: Unknown name, or an invalid file; the message states location, error and remedy.
    """
    if isinstance(name_or_path, Vehicle):
        return name_or_path
    path, label = _locate(name_or_path)
    values, origins = _with_parents(path, label, ())
    for noun in ("thruster", "actuator"):
        values, origins = _expand_groups(values, origins, label, noun)
    vehicle = _with_payloads(checked(values, origins, path.stem, path, label), label)
    if vehicle.hull is not None and vehicle.hull.file is not None:
        try:
            vehicle.hull_mesh()
        except VehicleError as error:
            raise VehicleError(f"{label}: hull: {error}") from None
    return vehicle


def catalogue_vehicle(name: str, source: str) -> Vehicle:
    """Return the catalogue's vehicle of a name from data, which is never interpreted as a path.

    Args:
        name: Name from a record or another file.
        source: Source of the name, for messages.

    Raises:
        VehicleError: The name is not a plain name, or is not in the catalogue.
    """
    if plain_name(name, f"{source}: vehicle", VehicleError) not in catalogue():
        raise VehicleError(f"{source}: {_unknown(name)}")
    return load_vehicle(name)


def with_changes(vehicle: Vehicle, changes: Mapping[str, Any], provenance: Provenance) -> Vehicle:
    """Implement `Vehicle.replace`."""
    values, origins = vehicle.values(), dict(vehicle.provenance)
    for path, value in changes.items():
        section, inner, _ = path.partition(".")
        if inner and section in vehicle.defaults:  # a partly changed section is stored completely
            part = getattr(vehicle, section)
            plain = (
                {name: entry.values() for name, entry in part.items()}
                if isinstance(part, dict)
                else part.values()
            )
            values.setdefault(section, plain)
        for full in _set(values, path.split("."), value, vehicle.name):
            for key in [key for key in origins if key == full or key.startswith(full + ".")]:
                del origins[key]
            origins[full] = provenance
    values["payloads"] = vehicle.payloads
    return checked(values, origins, vehicle.name, vehicle.path, vehicle.name)


def _locate(name_or_path: str | os.PathLike[str], beside: Path | None = None) -> tuple[Path, str]:
    """Return the file of a vehicle and its name in messages; the folder `beside` is searched before the catalogue."""
    text = os.fspath(name_or_path)
    path = Path(text)
    foreign = path.suffix != "" and text not in VEHICLES and (beside or Path()).joinpath(path).is_file()
    if path.suffix in (".yaml", ".yml") or path.name != text or foreign:
        path = path if beside is None or path.is_absolute() else beside / path
        if not path.is_file():
            raise VehicleError(_no_file(text))
        return path, text
    if beside is not None and (beside / f"{text}.yaml").is_file():
        return beside / f"{text}.yaml", f"{text}.yaml"
    if text not in VEHICLES:
        raise VehicleError(_no_file(text) if path.suffix else _unknown(text))
    try:
        return VEHICLES[text], f"catalogue/{text}.yaml"
    except RegistryError as error:
        raise VehicleError(str(error)) from error


def importer_of(path: Path) -> Importer | None:
    """Return the importer that recognises a file; None for a vehicle file of FinsSim or an unknown format."""
    if path.suffix in (".yaml", ".yml") and OWN.search(first_bytes(path)):
        return None
    name = recognised("vehicle", path)
    return None if name is None else importers("vehicle")[name]


@cache
def _meshes() -> TemporaryDirectory[str]:
    """Return the folder for the hulls of vehicles that are imported in this process."""
    return TemporaryDirectory(prefix="finssim-")


def _read_foreign(path: Path, extended: bool) -> tuple[Tree, Origins]:
    """Return values and origins of another program's model, with a warning that lists its guesses.

    If another file extends the model, it may lack the values that the file adds.
    """
    importer = importer_of(path)
    assert importer is not None
    draft = importer.read(path)
    incomplete = extended and draft.missing
    vehicle = None if incomplete else draft.vehicle(Path(_meshes().name))
    guessed = "; ".join(draft.guesses()) or "nothing"
    warnings.warn(
        f"{path}: guessed {guessed}. 'finssim vehicles import {path} --out {path.stem}.yaml' writes a file in which "
        f"you can correct these, and lists {len(draft.different)} differences and {sum(draft.not_read.values())} "
        "contents that are not read",
        VehicleWarning,
        stacklevel=2,
    )
    if vehicle is None:
        return dict(draft.values), dict(draft.origins)
    groups: Tree = {thruster.group: {} for thruster in vehicle.thrusters.values() if thruster.group}
    return vehicle.values() | {"thruster_groups": groups}, dict(vehicle.provenance)


def check_registered(name: str, path: Any) -> None:
    """Refuse an object that is not the path of a vehicle file.

    Args:
        name: Name of the vehicle.
        path: Object that is registered under the name.

    Raises:
        VehicleError: It is not a `pathlib.Path` of a file `NAME.yaml`.
    """
    if not isinstance(path, Path) or not path.is_file() or path.name != f"{name}.yaml":
        raise VehicleError(f"{name} is {str(path)!r}, expected the pathlib.Path of a file {name}.yaml")


def _no_file(name: str) -> str:
    return f"{name}: no such file: give the path of a vehicle file, or one of {_available()}"


def _unknown(name: str) -> str:
    return f"unknown vehicle '{name}'{did_you_mean(name, catalogue())} available: {_available()}"


def _available() -> str:
    return ", ".join(catalogue())


def _with_parents(path: Path, label: str, children: tuple[Path, ...]) -> tuple[Tree, Origins]:
    """Return values and origins of a file merged onto those of the file it extends."""
    if path.resolve() in children:
        raise VehicleError(f"{label}: extends itself through {' -> '.join(child.stem for child in children)}")
    values, origins = (
        read_file(path, label) if importer_of(path) is None else _read_foreign(path, bool(children))
    )
    hull = values.get("hull")
    if isinstance(hull, dict) and isinstance(hull.get("file"), str | Path):
        hull["file"] = path.parent.resolve() / hull["file"]
    tags = values.get("tags")
    if isinstance(tags, dict) and isinstance(tags.get("layout"), str):
        values["tags"] = _Replacing(with_layout(tags, path.parent, label))
    perception = values.get("perception")
    for name, entry in perception.items() if isinstance(perception, dict) else ():
        device = entry.get("device") if isinstance(entry, dict) else None
        if isinstance(device, str) and device.endswith((".yaml", ".yml")):
            file = path.parent.resolve() / device
            if not file.is_file():
                raise VehicleError(
                    f"{label}: perception.{name}: no file {device} next to it: give a sensor's file, or a name of "
                    "'finssim worlds'"
                )
            entry["device"] = str(file)
    parent = values.pop("extends", None)
    if parent is None:
        return values, origins
    try:
        parent_path, parent_label = _locate(parent, beside=path.parent)
    except VehicleError as error:
        raise VehicleError(f"{label}: extends: {error}") from None
    base_values, base_origins = _with_parents(parent_path, parent_label, (*children, path.resolve()))
    return _merged(base_values, values, (), base_origins), base_origins | origins


class _Replacing(dict[str, Any]):
    """A section that replaces the inherited one instead of changing some of its keys."""


def _merged(base: Any, change: Any, path: tuple[str, ...], origins: Origins) -> Any:
    """Return `base` overridden by `change`: sections merge, other values are replaced, null removes."""
    if isinstance(base, dict) and isinstance(change, dict) and not isinstance(change, _Replacing):
        result = dict(base)
        for key in _replaced_hull(change) if path == ("hull",) else ():
            result.pop(key, None)
            _forget((*path, key), origins)
        for key, value in change.items():
            inner = (*path, key)
            if value is None:
                result.pop(key, None)
                _forget(inner, origins)
                if inner == ("tags",):
                    # A vehicle may have no tags; every other omitted section has its default.
                    result[key] = None
            else:
                result[key] = _merged(base.get(key), value, inner, origins)
        return result
    _forget(path, origins)
    return change


def _replaced_hull(change: Tree) -> tuple[str, ...]:
    """Return the inherited keys of a hull that a new one replaces: it is parametric or from a file, never both."""
    if change.get("file") is not None:
        return ("parametric",)
    return ("file", "scale") if change.get("parametric") is True else ()


def _forget(path: tuple[str, ...], origins: Origins) -> None:
    prefix = ".".join(path)
    for key in [key for key in origins if key == prefix or key.startswith(prefix + ".")]:
        del origins[key]


def _expand_groups(values: Tree, origins: Origins, label: str, noun: str) -> tuple[Tree, Origins]:
    """Add the values of its group to every thruster or actuator (`noun`); its own values take precedence.

    A thruster keeps the name of its group, which fits use to change the group's parameters.
    """
    groups = values.pop(f"{noun}_groups", {})
    members = values.get(f"{noun}s")
    for group, numbers in groups.items() if isinstance(groups, dict) else [("", groups)]:
        if not isinstance(numbers, dict):
            raise VehicleError(f"{label}: {noun}_groups: {group} is {numbers!r}, expected a section of keys")
    if not isinstance(members, dict):
        return values, origins
    sources: dict[str, list[str]] = {}
    for name, member in members.items():
        if not isinstance(member, dict) or "group" not in member:
            continue
        group = str(member["group"])
        if group not in groups:
            raise VehicleError(
                f"{label}: {noun}s.{name}: group is '{group}'{did_you_mean(group, list(groups))} "
                f"expected one of {', '.join(groups) or f'{noun}_groups, which the file does not contain'}"
            )
        for key in groups[group]:
            if key not in member:
                start = f"{noun}_groups.{group}.{key}."
                if start not in sources:
                    sources[start] = [o for o in origins if (o + ".").startswith(start)]
                for source in sources[start]:
                    origins[source.replace(f"{noun}_groups.{group}", f"{noun}s.{name}", 1)] = origins[source]
        members[name] = {**groups[group], **member}
        if noun == "actuator":
            del members[name]["group"]
    return values, {key: value for key, value in origins.items() if not key.startswith(f"{noun}_groups.")}


def checked(values: Tree, origins: Origins, name: str, path: Path | None, label: str) -> Vehicle:
    """Return the vehicle from values and their origins by dotted path; every error is reported in one sentence.

    Args:
        values: Content of a vehicle file, without origins, in its units.
        origins: Origin of each number or list.
        name: Name of the vehicle.
        path: File that it was read from.
        label: Name of the file in messages.

    Raises:
        VehicleError: A value is invalid.
    """
    for key in ("name", "path", "provenance"):
        if key in values:
            raise VehicleError(f"{label}: unknown key '{key}': the name is that of the file")
    try:
        return Vehicle(**values, name=name, path=path, provenance=origins)
    except ValidationError as error:
        sentences = [
            sentence_of(detail, label)
            for detail in error.errors()
            if detail["type"] != "default_factory_not_called"
        ]
        raise VehicleError("\n".join(sentences)) from None


def _with_payloads(vehicle: Vehicle, label: str) -> Vehicle:
    """Return the vehicle of a file with its payloads added to the body; added mass and drag are unchanged."""
    if not vehicle.payloads:
        return vehicle
    body, loads = vehicle.body, list(vehicle.payloads.values())
    mass, center_of_gravity, inertia = combined(
        [body.mass, *(load.mass for load in loads)],
        [body.center_of_gravity, *(load.position for load in loads)],
        [body.inertia, *(load.inertia for load in loads)],
    )
    volumes = [body.displaced_volume, *(load.volume for load in loads)]
    places = [body.center_of_buoyancy, *(load.position for load in loads)]
    sums = {
        "mass": mass,
        "inertia": inertia.tolist(),
        "center_of_gravity": center_of_gravity.tolist(),
        "displaced_volume": math.fsum(volumes),
        "center_of_buoyancy": np.average(places, axis=0, weights=volumes).tolist(),
    }
    origins = dict(vehicle.provenance)
    for key in sums:
        full = f"body.{key}"
        parts = [
            p for o, p in origins.items() if (o + ".").startswith(f"{full}.") or o.startswith("payloads.")
        ]
        _forget(tuple(full.split(".")), origins)
        worst = max((p.origin for p in parts), key=ORIGINS.index)
        origin: Origin = "guessed" if worst == "guessed" else "derived"
        note = f"that of the file and the payloads {', '.join(vehicle.payloads)} together"
        origins[full] = Provenance(origin, parts[0].source, note)
    values = vehicle.values()
    values["body"] |= sums
    return checked(values | {"payloads": vehicle.payloads}, origins, vehicle.name, vehicle.path, label)


def _set(tree: Any, path: list[str], value: Any, label: str, done: tuple[str, ...] = ()) -> list[str]:
    """Assign a value at a dotted path in plain values; `*` matches every key. Return the full paths assigned."""
    key, rest = path[0], path[1:]
    if isinstance(tree, list):
        if not key.isdigit() or int(key) >= len(tree):
            raise VehicleError(f"{label}: {'.'.join(done)}: no element '{key}' in a list of {len(tree)}")
        index: Any = int(key)
    elif isinstance(tree, dict):
        if key == "*":
            return [full for name in tree for full in _set(tree, [str(name), *rest], value, label, done)]
        names = {str(name): name for name in tree}  # tag ids are numbers
        index = names.get(key, key)
        if rest and key not in names:
            raise VehicleError(
                f"{label}: {'.'.join(done) or 'top level'}: no '{key}'{did_you_mean(key, list(names))} "
                f"there are {', '.join(names)}"
            )
    else:
        raise VehicleError(f"{label}: {'.'.join(done)} is a value, it has no '{key}'")
    if rest:
        return _set(tree[index], rest, value, label, (*done, key))
    tree[index] = value.tolist() if isinstance(value, np.ndarray) else copy.deepcopy(value)
    return [".".join((*done, key))]


_MARKS = ("origin", "source", "note")


def read_file(path: Path, label: str) -> tuple[dict[str, Any], dict[str, Provenance]]:
    """Return plain values of a vehicle file, and the origin of its numbers by dotted path.

    Args:
        path: The file.
        label: Name of the file in messages.

    Raises:
        VehicleError: The file is unreadable or malformed, or a number has no origin.
    """
    tree = read_mapping(path, VehicleError, such_as="body: {mass: 11.2}", label=label)
    if not isinstance(tree.get("extends"), str | None):
        raise VehicleError(
            f"{label}: extends is {tree['extends']!r}, expected the name or path of a vehicle, such as finsrov"
        )
    # Records of fits, not parameters of the vehicle: they need no origin.
    records = tree.pop("calibrations", None)
    provenance: dict[str, Provenance] = {}
    values = _plain(tree, (), None, provenance, label)
    if records is not None:
        values["calibrations"] = records
    return values, provenance


def _plain(
    node: Any, path: tuple[str, ...], inherited: Provenance | None, origins: dict[str, Provenance], label: str
) -> Any:
    """Strip the origin keys from a tree, recording the origins of the numbers below them."""
    if isinstance(node, dict):
        here = _marked(node, path, inherited, label)
        if "value" in node:
            for key in node:
                if key not in ("value", *_MARKS):
                    raise VehicleError(f"{label}: {_where(path)}: unknown key '{key}' beside 'value'")
            return _plain(node["value"], path, here, origins, label)
        return {
            str(key): _plain(value, (*path, str(key)), here, origins, label)
            for key, value in node.items()
            if key not in _MARKS
        }
    if isinstance(node, list):
        items = [_plain(item, (*path, str(i)), inherited, origins, label) for i, item in enumerate(node)]
        _fold(path, len(items), origins)
        return items
    if isinstance(node, (int, float)) and not isinstance(node, bool):
        if inherited is None:
            if not math.isfinite(node):
                raise VehicleError(
                    f"{label}: {_where(path[:-1])}: {path[-1]} is {node}, expected a finite number"
                )
            raise VehicleError(
                f"{label}: {_where(path[:-1])}: {path[-1]} has no origin: write "
                f"{{value: {node}, origin: measured, source: ...}} or give 'origin:' to its section or to the file"
            )
        if math.isfinite(node) and abs(node) > GREATEST:
            raise VehicleError(
                f"{label}: {_where(path[:-1])}: {path[-1]} is {node:g}, expected numbers up to {GREATEST:g}"
            )
        origins[".".join(path)] = inherited
    return node


def _marked(
    node: dict[Any, Any], path: tuple[str, ...], inherited: Provenance | None, label: str
) -> Provenance | None:
    """Return the origin inside a mapping: a new `origin` replaces it, a new `source` or `note` refines it."""
    for mark in _MARKS:
        if mark in node and not isinstance(node[mark], str):
            raise VehicleError(f"{label}: {_where(path)}: {mark} is {node[mark]!r}, expected text")
    source, note = node.get("source", ""), node.get("note", "")
    if "origin" in node:
        origin = node["origin"]
        if origin not in ORIGINS:
            raise VehicleError(
                f"{label}: {_where(path)}: origin is '{origin}'{did_you_mean(origin, list(ORIGINS))} "
                f"expected one of {', '.join(ORIGINS)}"
            )
        return Provenance(origin, source, note)
    if inherited is None or not (source or note):
        return inherited
    return Provenance(
        inherited.origin, source or inherited.source, note or ("" if source else inherited.note)
    )


def _fold(path: tuple[str, ...], length: int, origins: dict[str, Provenance]) -> None:
    """Merge the origins of a list's elements into one entry if they are equal."""
    keys = [".".join((*path, str(i))) for i in range(length)]
    if keys and all(key in origins for key in keys) and len({origins[key] for key in keys}) == 1:
        origins[".".join(path)] = origins[keys[0]]
        for key in keys:
            del origins[key]


def _where(path: tuple[str, ...]) -> str:
    return ".".join(path) or "top level"
