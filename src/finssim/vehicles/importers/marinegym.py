"""Importer of the parameters of MarineGym's vehicles (YAML); mass, inertia and thruster positions are in a USD file.

Equations of MarineGym (`underwaterVehicle.py` and `t200.py`), z down, n the speed of a rotor in rpm:

    force = -M_A nu_dot - C_A nu - (D1 + D2 |nu|) nu,   buoyancy = 997 9.8 volume at coBM above the centre of gravity
    thrust = K / 4.4e-7 9.81 (4.7368e-7 n² - 1.9275e-4 n + 0.084452)     n > 0
    thrust = K / 4.4e-7 9.81 (-3.8442e-7 n² - 1.6186e-4 n - 0.039139)    n < 0
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from finssim.core.importer import Importer
from finssim.core.yaml_file import read_mapping
from finssim.vehicles.importers.draft import Draft, put_envelope
from finssim.vehicles.part import VehicleError, did_you_mean

__all__ = ["MARINEGYM", "read_marinegym", "thrust"]

WORDS = ("name", "drag_coef", "volume", "coBM", "hydro_coef", "rotor_configuration")
MATRICES = ("added_mass", "linear_damping", "quadratic_damping")
ROTORS = (
    "directions", "time_constants", "force_constants", "max_rotation_velocities", "moment_constants", "num_rotors",
    "num_arms", "arm_lengths", "rotor_angles",
)  # fmt: skip


def thrust(constant: float, rpm: float) -> float:
    """Return the thrust of a rotor of MarineGym [N].

    Args:
        constant: K of `force_constants`, 4.4e-7 for a T200 [-].
        rpm: Signed speed [rpm].
    """
    curve = (4.7368e-7, -1.9275e-4, 8.4452e-2) if rpm > 0.0 else (-3.8442e-7, -1.6186e-4, -3.9139e-2)
    return constant / 4.4e-7 * 9.81 * float(np.polyval(curve, rpm))


def read_marinegym(path: Path) -> Draft:
    """Read a vehicle of MarineGym; the draft lacks the contents of its USD file.

    Raises:
        VehicleError: A key is unknown, or a number is missing or wrong.
    """
    tree = read_mapping(path, VehicleError, such_as="volume: 0.0113")
    if "fin_configuration" in tree:
        raise VehicleError(
            f"{path}: has fin_configuration: vehicles of MarineGym with fins, whose propeller has another law, are not "
            "read: write a vehicle file, such as that of the catalogue's torpedo"
        )
    coefficients, rotors = (dict(x) if isinstance(x := tree.get(key), dict) else {} for key in WORDS[4:])
    for known, part in ((WORDS, tree), (MATRICES, coefficients), (ROTORS, rotors)):
        for word in part:
            if word not in known:
                raise VehicleError(
                    f"{path}: unknown key '{word}'{did_you_mean(str(word), list(known))} correct it"
                )

    def numbers(part: Any, key: str, count: int) -> list[float]:
        value = part.get(key)
        flat = value if isinstance(value, list) else [value]
        if len(flat) != count or not all(
            type(x) in (int, float) and math.isfinite(x) and x >= 0.0 for x in flat
        ):
            raise VehicleError(f"{path}: {key} is {value!r}, expected {count} numbers of 0 or more")
        return [float(x) for x in flat]

    draft = Draft(str(path), f"{path.name} (MarineGym)")
    draft.values["title"] = f"{tree.get('name', path.stem)} (MarineGym)"
    draft.values["description"] = (
        f"Read by FinsSim from {path.name}, parameters of MarineGym, and completed by hand."
    )
    draft.put("water.density", 997.0, "published", "in underwaterVehicle.py")
    draft.put("water.gravity", 9.8, "published", "in underwaterVehicle.py")
    draft.put("body.displaced_volume", numbers(tree, "volume", 1)[0])
    draft.put("body.center_of_gravity", [0.0, 0.0, 0.0], "published", "origin of MarineGym's base_link")
    draft.put("body.center_of_buoyancy", [0.0, 0.0, numbers(tree, "coBM", 1)[0]], "published", "coBM")
    for key in MATRICES:
        draft.put(f"hydrodynamics.calibrated.{key}", numbers(coefficients, key, 6))
    count, given = int(numbers(rotors, "num_rotors", 1)[0]), tuple(rotors)
    lists = {key: numbers(rotors, key, count) for key in ROTORS[1:4]}
    for k, (lag, constant, rpm) in enumerate(zip(*lists.values(), strict=True)):
        for end, sign in (("max", 1.0), ("min", -1.0)):
            force = thrust(constant, sign * rpm)
            draft.put(
                f"thrusters.rotor_{k}.force_{end}", force, "derived", "thrust curve at the greatest speed"
            )
            draft.put(f"thrusters.rotor_{k}.rpm_{end}", sign * rpm)
            key = f"thrusters.rotor_{k}.c_{'plus' if sign > 0.0 else 'minus'}"
            draft.put(
                key, abs(force) / (rpm * math.pi / 30.0) ** 2, "derived", "thrust curve at the greatest speed"
            )
        draft.put(f"thrusters.rotor_{k}.time_constant", lag)
        draft.values["thrusters"][f"rotor_{k}"]["domain"] = "speed"
    draft.different.append(
        "between rest and its greatest speed, a rotor has c n|n| here and a full quadratic in MarineGym"
    )
    draft.different.append(
        "MarineGym takes the added mass from filtered accelerations; here it is part of the mass matrix"
    )
    for key in ("drag_coef", "directions", "moment_constants", *(key for key in ROTORS[6:] if key in given)):
        draft.not_read[f"{key} (MarineGym does not use it)"] += 1
    put_envelope(draft, [])
    rotors = {f"rotor_{k}": {"position": "[x, y, z]", "axis": "[x, y, z]"} for k in range(count)}
    body = {"mass": "KG", "inertia": "[KG M2, KG M2, KG M2]", "size": "[M, M, M]"}
    draft.missing = {"body": body, "thrusters": rotors}
    return draft


def _recognises(path: Path, head: bytes) -> bool:
    return path.suffix.lower() in (".yaml", ".yml") and b"rotor_configuration" in head and b"coBM" in head


MARINEGYM = Importer("vehicle", "parameters of MarineGym (.yaml)", _recognises, read_marinegym)
