"""A vehicle as the tree of its file: plain values with diagonal matrices as one row, and the origin of every number."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from finssim.vehicles import Provenance, Vehicle

__all__ = ["file_tree", "folded", "leaves", "number_origins", "numbers"]

Path = tuple[str, ...]


def file_tree(vehicle: Vehicle) -> dict[str, Any]:
    """The values that the vehicle's file gives, with diagonal matrices by their diagonals."""
    tree: dict[str, Any] = _shortened(vehicle.values())
    return tree


def leaves(node: Any, path: Path = ()) -> Iterator[tuple[Path, float]]:
    """Path and value of every number below a node of plain values."""
    if isinstance(node, Mapping):
        for key, value in node.items():
            yield from leaves(value, (*path, str(key)))
    elif isinstance(node, list):
        for i, value in enumerate(node):
            yield from leaves(value, (*path, str(i)))
    elif isinstance(node, (int, float)) and not isinstance(node, bool):
        yield path, node


def number_origins(vehicle: Vehicle) -> dict[Path, Provenance]:
    """Origin of every number of `file_tree(vehicle)`, by path; calibration records are not numbers of the vehicle."""
    return {path: vehicle.origin_of(".".join(whole)) for path, whole, _ in numbers(vehicle)}


def numbers(vehicle: Vehicle) -> Iterator[tuple[Path, Path, float]]:
    """Every number of `file_tree(vehicle)`: its path there, its path in `vehicle.values()`, and its value.

    The two paths differ in a diagonal matrix, where the tree has one row; calibration records are left out.
    """
    tree, whole = file_tree(vehicle), vehicle.values()
    tree.pop("calibrations", None)
    for path, value in leaves(tree):
        yield path, (*path, path[-1]) if isinstance(_at(whole, path), list) else path, value


def folded(tree: Any, origins: Mapping[Path, Provenance]) -> dict[str, Provenance]:
    """Origins by dotted path, as reading the file gives them: one entry for a list whose numbers share theirs."""
    found: dict[str, Provenance] = {}
    _fold(tree, (), origins, found)
    return found


def _fold(
    node: Any, path: Path, origins: Mapping[Path, Provenance], found: dict[str, Provenance]
) -> Provenance | None:
    """Record what lies below; returns the common origin of a number or list, which the caller records."""
    if isinstance(node, Mapping):
        for key, value in node.items():
            common = _fold(value, (*path, str(key)), origins, found)
            if common is not None:
                found[".".join((*path, str(key)))] = common
        return None
    if isinstance(node, list):
        parts = [_fold(value, (*path, str(i)), origins, found) for i, value in enumerate(node)]
        if parts and parts[0] is not None and all(part == parts[0] for part in parts):
            return parts[0]
        for i, part in enumerate(parts):
            if part is not None:
                found[".".join((*path, str(i)))] = part
        return None
    return origins.get(path)


def _shortened(node: Any) -> Any:
    if isinstance(node, dict):
        return {key: value if key == "calibrations" else _shortened(value) for key, value in node.items()}
    if (
        _is_list(node)
        and len(node) in (3, 6)
        and all(_is_list(row) and len(row) == len(node) for row in node)
    ):
        matrix = np.array(node)
        if not np.any(matrix - np.diag(np.diag(matrix))):
            return np.diag(matrix).tolist()
    return list(node) if isinstance(node, tuple) else node


def _at(tree: Any, path: Path) -> Any:
    for key in path:
        tree = tree[int(key)] if _is_list(tree) else tree[key if key in tree else int(key)]
    return tree


def _is_list(node: Any) -> bool:
    return isinstance(node, list)
