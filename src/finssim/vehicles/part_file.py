"""Reader of files that contain one part, such as a world or a device: located by name or path, and validated."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from finssim.core.yaml_file import read_mapping
from finssim.vehicles.part import Part, did_you_mean, sentence_of

SMALLEST, GREATEST = 1e-9, 1e9
"""Limits of the magnitude of a nonzero number in a world or a device."""
P = TypeVar("P", bound=Part)


def names_in(catalogue: Path) -> list[str]:
    """Return the names of the files in a catalogue."""
    return sorted(path.stem for path in catalogue.glob("*.yaml"))


def locate(
    name_or_path: str | os.PathLike[str], catalogue: Path, kind: str, refuse: type[ValueError]
) -> tuple[Path, str]:
    """Find a file by its name in a catalogue, or by its path.

    Args:
        name_or_path: Name or path.
        catalogue: Directory of the named files.
        kind: Kind of the content, in messages.
        refuse: Class of the error.

    Returns:
        The path, and its name in messages.
    """
    text, names = os.fspath(name_or_path), names_in(catalogue)
    path = Path(text)
    if path.suffix in (".yaml", ".yml") or path.name != text:
        if not path.is_file():
            raise refuse(
                f"{text}: no such file: give the path of a {kind}'s file, or one of {', '.join(names)}"
            )
        return path, text
    if text not in names:
        raise refuse(f"unknown {kind} '{text}'{did_you_mean(text, names)} available: {', '.join(names)}")
    return catalogue / f"{text}.yaml", f"{catalogue.name}/{text}.yaml"


def read_tree(path: Path, label: str, such_as: str, refuse: type[ValueError]) -> dict[Any, Any]:
    """Read the mapping of a file, whose numbers are within the range of single precision.

    Args:
        path: File.
        label: Name of the file in messages.
        such_as: Example of its content, in messages.
        refuse: Class of the error.
    """
    tree = read_mapping(path, refuse, such_as=such_as, label=label)
    _refuse_unphysical(tree, label, refuse)
    for key in ("name", "path"):
        if key in tree:
            raise refuse(f"{label}: unknown key '{key}': the name is that of the file")
    return tree


def _refuse_unphysical(value: Any, label: str, refuse: type[ValueError]) -> None:
    """Refuse numbers outside the range of single precision, in which worlds are simulated."""
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            if key != "seed":
                _refuse_unphysical(item, f"{label}: {key}" if isinstance(value, dict) else label, refuse)
    elif type(value) in (int, float) and value and not SMALLEST <= abs(value) <= GREATEST:
        if math.isfinite(value):  # other values are refused elsewhere
            raise refuse(
                f"{label} contains {value:g}, expected 0 or a number from {SMALLEST:g} to {GREATEST:g}"
            )


def checked_part(kind: type[P], tree: dict[Any, Any], label: str, refuse: type[ValueError]) -> P:
    """Return a part from the mapping of its file, or raise `refuse` with a sentence for each problem."""
    try:
        return kind(**{str(key): value for key, value in tree.items()})
    except ValidationError as error:
        problems = [e for e in error.errors() if e["type"] != "default_factory_not_called"]
        raise refuse("\n".join(sentence_of(e, label, "add it") for e in problems)) from None
