"""Numbers, text and file references in the elements of a model."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from finssim.vehicles.loader import GREATEST
from finssim.vehicles.part import VehicleError, did_you_mean

__all__ = ["Element", "file_of_model", "flag", "number", "numbers", "refuse_unknown"]


def numbers(text: str | None, count: int, where: str) -> NDArray[np.float64]:
    """Return the finite numbers of a text, in its unit, (count,).

    Args:
        text: Numbers separated by spaces.
        count: Expected number of values.
        where: Name of the text in messages.

    Raises:
        VehicleError: The text contains anything else.
    """
    words = (text or "").split()
    plain = all(re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", word, re.ASCII) for word in words)
    if len(words) != count or not plain:
        expected = "a number" if count == 1 else f"{count} numbers"
        raise VehicleError(f"{where} is '{(text or '').strip()[:60]}', expected {expected}")
    values = np.array([float(word) for word in words])
    if not np.all(np.abs(values) <= GREATEST):
        raise VehicleError(f"{where} is '{(text or '').strip()[:60]}', expected numbers up to {GREATEST:g}")
    return values


def number(parent: Element, tag: str, where: str, default: float = math.nan) -> float:
    """Return the number in a child element, in its unit.

    Args:
        parent: Parent element.
        tag: Name of the child.
        where: Name of the parent in messages.
        default: Value if there is no such child, in its unit; NaN if the child is required.
    """
    child = parent.find(tag)
    if child is None:
        if math.isnan(default):
            raise VehicleError(f"{where}: {tag} is missing: add it")
        return default
    return float(numbers(child.text, 1, f"{where}: {tag}")[0])


def flag(parent: Element, tag: str, where: str, default: bool = False) -> bool:
    """Return whether a child element contains true or 1; the default if there is no such child."""
    child = parent.find(tag)
    text = str(default) if child is None else (child.text or "")
    word = text.strip().lower()
    if word not in ("true", "false", "1", "0"):
        raise VehicleError(f"{where}: {tag} is '{text.strip()[:60]}', expected true or false")
    return word in ("true", "1")


def refuse_unknown(element: Element, known: Collection[str], where: str) -> None:
    """Refuse children with unknown names.

    Args:
        element: Parent element.
        known: Known names.
        where: Name of the parent in messages.
    """
    for child in element:
        if child.tag not in known:
            raise VehicleError(
                f"{where}: unknown element '{child.tag}'{did_you_mean(child.tag, sorted(known))} "
                f"expected one of {', '.join(sorted(known))}"
            )


def file_of_model(folder: Path, uri: str, where: str, packages: Mapping[str, Path] | None = None) -> Path:
    """Return a file that a model refers to, inside the folder of the model or of a package.

    Args:
        folder: Folder of the model.
        uri: `model://NAME/PATH`, `package://NAME/PATH`, or a path relative to the folder; NAME is that of the
            model or of a
            package. Within a package, also `file://PATH`.
        where: Name of the element in messages.
        packages: Name -> folder of ROS packages.

    Raises:
        VehicleError: The file is outside these folders, or does not exist.
    """
    kind, scheme, below = uri.partition("://")
    package, _, rest = below.partition("/")
    name = rest if scheme else uri
    if kind == "package" and package in (packages or {}):
        folder = (packages or {})[package]
    elif kind == "file":
        for inside in (x for x in (packages or {}).values() if Path(below).is_relative_to(x)):
            folder, kind, name = inside, "package", str(Path(below).relative_to(inside))
    strange = re.search(r"^[A-Za-z]:|(^|[/\\])\.\.([/\\]|$)|[\0\n]", name)
    foreign = bool(scheme) and kind not in ("model", "package")
    outside = foreign or name.startswith(("/", "\\", "~")) or strange is not None
    file = folder if outside or not name.strip() else folder / name
    if outside or not file.resolve().is_relative_to(folder.resolve()):
        raise VehicleError(f"{where} names the file '{uri[:200]}': put it into the model's folder or below")
    if not file.is_file():
        raise VehicleError(
            f"{where} names the file '{uri[:200]}', which is not in the model's folder: add it"
        )
    return file
