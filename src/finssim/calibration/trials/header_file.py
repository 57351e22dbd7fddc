"""Reading and writing `trial.yaml`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from finssim.calibration.errors import CalibrationError
from finssim.calibration.trials.header import Conversion, Header, TrialWater
from finssim.vehicles.part import did_you_mean
from finssim.yaml_file import read_mapping

__all__ = ["header_text", "read_header"]

_POINT = "3 numbers [x, y, z] in m"
_MAP = "a map such as"

EXPECTED = {
    "vehicle": "the name or file of a vehicle",
    "axis": "a list drawn from surge, sway, heave, roll, pitch, yaw",
    "role": "fit or held-out",
    "description": "words",
    "inputs": "applied or commanded",
    "inputs_between": "held or linear",
    "passive": "true or false",
    "wrench_at": f"{_POINT}, center_of_gravity or origin",
    "velocity_at": _POINT,
    "position_at": _POINT,
    "acceleration_at": _POINT,
    "depth_at": _POINT,
    "acceleration": "specific_force, kinematic or auto",
    "velocity": "ground or water",
    "voltage": "a voltage > 0 in V",
    "water": f"{_MAP} {{density: 1025.0}}",
    "water.density": "a density > 0 in kg/m³",
    "water.depth": "a depth > 0 in m",
    "water.current": "3 numbers [x, y, z] in m/s, world frame",
    "convert": f"{_MAP} {{body: FRD}}",
    "convert.rename": f"{_MAP} {{vx_mps: u}}",
    "convert.scale": f"{_MAP} {{yaw: 0.0174533}}, with factors that are not 0",
    "convert.offset": f"{_MAP} {{depth: 0.05}}",
    "convert.body": "FLU or FRD",
    "convert.world": "z_up or NED",
    "convert.time_offset": f"{_MAP} {{attitude: -0.08}}, in s",
}
"""Key -> what may stand there."""

SECTIONS: dict[str, type[BaseModel]] = {"": Header, "water": TrialWater, "convert": Conversion}


def read_header(path: Path) -> Header:
    """The header in a `trial.yaml`; an empty file is an empty header.

    Raises:
        CalibrationError: Unreadable, or a key or value that is refused; one sentence per key.
    """
    if path.is_file() and path.stat().st_size < 65536 and not _content(path):
        return Header()
    tree = read_mapping(path, CalibrationError, such_as="vehicle: finsrov")
    if isinstance(tree.get("axis"), str):
        tree["axis"] = [tree["axis"]]
    try:
        header = Header.model_validate(tree)
    except ValidationError as error:
        sentences = dict.fromkeys(_sentence(detail, tree) for detail in error.errors())
        raise CalibrationError("\n".join(f"{path}: {sentence}" for sentence in sentences)) from None
    zero = [name for name, factor in header.convert.scale.items() if factor == 0.0]
    if zero:
        raise CalibrationError(f"{path}: convert.scale: {zero[0]} is 0, expected a factor that is not 0")
    return header


def header_text(header: Header) -> str:
    """`trial.yaml` of a header: what differs from the defaults, without the conversions that have been done."""
    tree = header.model_dump(mode="json", exclude_defaults=True, exclude={"convert"})
    return yaml.safe_dump(tree, sort_keys=False, allow_unicode=True) if tree else "{}\n"


def _content(path: Path) -> str:
    """What a file holds besides comments and blank lines."""
    lines = path.read_bytes().decode("utf-8", errors="replace").splitlines()
    return "".join(line for line in lines if line.strip() and not line.lstrip().startswith("#"))


def _sentence(detail: Any, tree: dict[Any, Any]) -> str:
    """One pydantic complaint as `key is value, expected ...`."""
    where = [str(part) for part in detail["loc"]]
    section = where[0] if where[0] in SECTIONS and len(where) > 1 else ""
    name = ".".join(where[: 2 if section else 1])
    if detail["type"] == "extra_forbidden":
        known = list(SECTIONS[section].model_fields)
        return f"unknown key '{name}'{did_you_mean(where[-1], known)} known keys: {', '.join(known)}"
    value: Any = tree
    for part in name.split("."):
        value = value.get(part) if isinstance(value, dict) else value
    if detail["type"] == "finite_number" and isinstance(value, float):
        return f"{name} is {value}, expected a finite number"
    return f"{name} is {value!r}, expected {EXPECTED.get(name, detail['msg'])}"
