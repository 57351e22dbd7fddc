"""Reading one vehicle file: YAML, and the origin of every number in it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from finssim.vehicles.errors import VehicleError
from finssim.vehicles.part import did_you_mean
from finssim.vehicles.vehicle import ORIGINS, Provenance
from finssim.yaml_file import read_mapping

_MARKS = ("origin", "source", "note")


def read_file(path: Path, shown: str) -> tuple[dict[str, Any], dict[str, Provenance]]:
    """Plain values of a vehicle file, and the origin of its numbers by dotted path.

    Args:
        path: The file.
        shown: How messages call it.

    Raises:
        VehicleError: Unreadable, malformed, or a number without an origin.
    """
    tree = read_mapping(path, VehicleError, such_as="body: {mass: 11.2}", shown=shown)
    if not isinstance(tree.get("extends"), str | None):
        raise VehicleError(
            f"{shown}: extends is {tree['extends']!r}, expected the name or path of a vehicle, such as finsrov"
        )
    records = tree.pop(
        "calibrations", None
    )  # what a fit did, not numbers of the vehicle: they need no origin
    provenance: dict[str, Provenance] = {}
    values = _plain(tree, (), None, provenance, shown)
    if records is not None:
        values["calibrations"] = records
    return values, provenance


def _plain(
    node: Any, path: tuple[str, ...], inherited: Provenance | None, found: dict[str, Provenance], shown: str
) -> Any:
    """Strip the origin marks from a tree, recording what they say about the numbers below them."""
    if isinstance(node, dict):
        here = _marked(node, path, inherited, shown)
        if "value" in node:
            for key in node:
                if key not in ("value", *_MARKS):
                    raise VehicleError(f"{shown}: {_where(path)}: unknown key '{key}' beside 'value'")
            return _plain(node["value"], path, here, found, shown)
        return {
            str(key): _plain(value, (*path, str(key)), here, found, shown)
            for key, value in node.items()
            if key not in _MARKS
        }
    if isinstance(node, list):
        items = [_plain(item, (*path, str(i)), inherited, found, shown) for i, item in enumerate(node)]
        _fold(path, len(items), found)
        return items
    if isinstance(node, (int, float)) and not isinstance(node, bool):
        if inherited is None:
            if not math.isfinite(node):
                raise VehicleError(
                    f"{shown}: {_where(path[:-1])}: {path[-1]} is {node}, expected a finite number"
                )
            raise VehicleError(
                f"{shown}: {_where(path[:-1])}: {path[-1]} has no origin: write "
                f"{{value: {node}, origin: measured, source: ...}} or give 'origin:' to its section or to the file"
            )
        found[".".join(path)] = inherited
    return node


def _marked(
    node: dict[Any, Any], path: tuple[str, ...], inherited: Provenance | None, shown: str
) -> Provenance | None:
    """Origin in force inside a mapping: a new `origin` starts afresh, a new `source` or `note` refines."""
    for mark in _MARKS:
        if mark in node and not isinstance(node[mark], str):
            raise VehicleError(f"{shown}: {_where(path)}: {mark} is {node[mark]!r}, expected words")
    source, note = node.get("source", ""), node.get("note", "")
    if "origin" in node:
        origin = node["origin"]
        if origin not in ORIGINS:
            raise VehicleError(
                f"{shown}: {_where(path)}: origin is '{origin}'{did_you_mean(origin, list(ORIGINS))} "
                f"expected one of {', '.join(ORIGINS)}"
            )
        return Provenance(origin, source, note)
    if inherited is None or not (source or note):
        return inherited
    return Provenance(
        inherited.origin, source or inherited.source, note or ("" if source else inherited.note)
    )


def _fold(path: tuple[str, ...], length: int, found: dict[str, Provenance]) -> None:
    """One entry for a list whose elements share their origin."""
    keys = [".".join((*path, str(i))) for i in range(length)]
    if keys and all(key in found for key in keys) and len({found[key] for key in keys}) == 1:
        found[".".join(path)] = found[keys[0]]
        for key in keys:
            del found[key]


def _where(path: tuple[str, ...]) -> str:
    return ".".join(path) or "top level"
