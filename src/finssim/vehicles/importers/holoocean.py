"""Importer of HoloOcean scenarios whose agent is Fossen's torpedo (`fossen_dynamics/torpedo.py` of HoloOcean 2).

The hull is a spheroid with Lamb's added mass, and hull drag and propeller as in `torpedo`; x forward, y
right, z down.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from finssim.core.importer import Importer
from finssim.core.yaml_file import read_mapping
from finssim.vehicles.importers import torpedo
from finssim.vehicles.importers.assignments import Assignments, read_assignments
from finssim.vehicles.importers.coefficients import draft_of
from finssim.vehicles.importers.draft import Draft
from finssim.vehicles.importers.rigid import plain
from finssim.vehicles.part import VehicleError, did_you_mean

__all__ = ["HOLOOCEAN", "read_holoocean"]

TORPEDO: dict[str, Any] = {
    "rho": 1026.0, "mass": 31.03, "length": 1.6, "diam": 0.19, "r_bg": [0, 0, 0.02], "r_bb": [0, 0, 0],
    "area_fraction": 0.7, "T_surge": 20.0, "T_sway": 20.0, "zeta_roll": 0.3, "zeta_pitch": 0.8, "T_yaw": 1.0,
    "r44": 0.3, "Cd": 0.42, "e": 0.7, "nMax": 1525.0, "T_n": 1.0, "D_prop": 0.14, "t_prop": 0.1, "KT_0": 0.4566,
    "KT_max": 0.1798, "Ja_max": 0.6632, "w": 0.056,
}  # fmt: skip
"""Key of `dynamics` or `actuator` -> HoloOcean's default."""
FINS: dict[str, Any] = {
    "fin_count": 4, "fin_offset_deg": 0.0, "fin_center": 0.1, "fin_area": 0.00697, "CL_delta": 0.5,
    "deltaMax_fin_deg": 15.0, "fin_speed_max": 0.5, "T_delta": 0.1,
}  # fmt: skip
"""Defaults of the fins, which are identical and evenly spaced around the axis at the stern."""
CONTROL = "K_nomoto sampleTime KQ_0 KQ_max x_fin CL_delta_r CL_delta_s".split()
"""Keys of torque and control, and of fins that HoloOcean's torpedo does not use; they are not read."""

USUAL = TORPEDO | FINS


def _scenarios(tree: Any) -> Iterator[Mapping[str, Any]]:
    """Yield the mappings with `agents` in a tree."""
    if isinstance(tree, Mapping):
        if "agents" in tree:
            yield tree
        for item in tree.values():
            yield from _scenarios(item)


def read_holoocean(path: Path) -> Draft:
    """Read the main agent of a scenario.

    Args:
        path: JSON, YAML, or a Python program that contains the scenario as a mapping and is not executed.

    Raises:
        VehicleError: There is no scenario, or the numbers of its agent are not in the file.
    """
    python = path.suffix.lower() == ".py"
    tree = (
        read_assignments(path).mappings if python else read_mapping(path, VehicleError, such_as="agents: []")
    )
    scenario: Mapping[str, Any] = next(_scenarios(tree), {"agents": {}})
    agents = scenario["agents"]
    agents = (
        list(agents.values()) if isinstance(agents, Mapping) else agents if isinstance(agents, list) else []
    )
    agents = [agent for agent in agents if isinstance(agent, Mapping)]
    agent = next(
        (x for x in agents if x.get("agent_name") == scenario.get("main_agent")), (agents or [{}])[0]
    )
    if agent.get("fossen_model", "torpedo" if "dynamics" in agent else None) != "torpedo":
        raise VehicleError(
            f"{path}: the numbers of the main agent, a {agent.get('agent_type')}, are in HoloOcean's engine and not in "
            "the file, expected an agent with fossen_model torpedo"
        )
    words: dict[str, Any] = {}
    sections = [section for section in ("dynamics", "actuator") if isinstance(agent.get(section), Mapping)]
    for key, value in ((key, value) for section in sections for key, value in agent[section].items()):
        if key not in USUAL and key not in CONTROL:
            raise VehicleError(f"{path}: unknown key '{key}'{did_you_mean(str(key), list(USUAL))} correct it")
        count = 3 if key in ("r_bg", "r_bb") else 1
        least = (
            -np.inf
            if count == 3 or key in (*CONTROL, "fin_offset_deg")
            else -1e-12
            if key in ("w", "t_prop")
            else 0.0
        )
        plain = np.size(value) == count and np.array(value).dtype.kind in "if" and np.all(np.isfinite(value))
        if not plain or np.min(value) <= least:
            raise VehicleError(
                f"{path}: {key} is {value!r}, expected {'3 numbers' if count == 3 else 'a number > 0'}"
            )
        words[key] = value
    length, diam = (float(words.get(key, TORPEDO[key])) for key in ("length", "diam"))
    if not length > diam:
        raise VehicleError(
            f"{path}: length is {length:g} and diam is {diam:g}, expected a body longer than it is wide"
        )
    numbers = USUAL | words
    draft = draft_of(_torpedo(numbers), path, f"{agent.get('agent_type')} of HoloOcean")
    del draft.not_read["fins, which turn the vehicle"]
    _put_fins(numbers, draft)
    if defaults := sorted(USUAL.keys() - words.keys()):
        draft.different.append(f"HoloOcean's torpedo gives what the scenario lacks: {', '.join(defaults)}")
    draft.different.append("linear damping of surge and sway, which vanishes as exp(-3 U), is left out")
    for key in (
        *(words.keys() & set(CONTROL)),
        *(agent.keys() - {"agent_name", "agent_type", "dynamics", "actuator"}),
    ):
        draft.not_read[f"agent: {key}"] += 1
    return draft


def _put_fins(n: Mapping[str, Any], draft: Draft) -> None:
    """Set the fins: each rotates about its radius, and its lift depends on the deflection alone."""
    if n["fin_count"] != int(n["fin_count"]):
        raise VehicleError(f"fin_count is {n['fin_count']!r}, expected an integer")
    travel = math.radians(n["deltaMax_fin_deg"])
    for k in range(int(n["fin_count"])):
        angle = math.radians(n["fin_offset_deg"] + 360.0 * k / n["fin_count"])
        outwards = np.array([0.0, -math.cos(angle), -math.sin(angle)])
        place = [-n["length"] / 2.0, *(n["fin_center"] * outwards[1:])]
        given = {
            "kind": "fin", "position": plain(np.array(place)), "span": plain(outwards), "area": n["fin_area"],
            "lift_slope": n["CL_delta"], "drag": [0.0, 0.0, 0.0], "incidence": 0.0, "minimum": -travel,
            "maximum": travel, "rate_limit": n["fin_speed_max"], "time_constant": n["T_delta"],
        }  # fmt: skip
        for key, value in given.items():
            draft.put(f"actuators.fin_{k}.{key}", value, "derived", "equal fins around the axis at the stern")
        draft.guess(f"actuators.fin_{k}.stall", 0.7, "lift of the file has no end")


def _torpedo(n: Mapping[str, Any]) -> Assignments:
    """Return the numbers that `torpedo.py` computes from its parameters, under conventional names."""
    m, a, b, W = n["mass"], n["length"] / 2.0, n["diam"] / 2.0, n["mass"] * 9.81
    rg, rb = np.array(n["r_bg"], float), np.array(n["r_bb"], float)
    moments, added = torpedo.spheroid_moments(a, b, m), torpedo.spheroid_added_mass(a, b, m, n["r44"])
    values = {key: x for key, x in n.items() if key not in FINS} | {
        "g": 9.81,
        "W": W,
        "B": W,
        "I_g": moments,
        "MA": added,
        "r_bg": rg,
        "r_bb": rb,
    }
    M = added + np.concatenate([[m] * 3, moments + m * (rg @ rg - rg**2)])
    times, ratios = np.array([math.inf, n["T_sway"], n["T_yaw"]]), np.array([n["zeta_roll"], n["zeta_pitch"]])
    values["D"] = torpedo.slow_damping(M, times, ratios, W * (rg[2] - rb[2])) * [1, 0, 1, 1, 1, 1]
    area = n["area_fraction"] * 4.0 * a * b
    calls = {"forceLiftDrag": [2.0 * b, area, n["Cd"] * math.pi * b**2 / area, n["e"]],
             "crossFlowDrag": [2.0 * a, 2.0 * b, 2.0 * b]}  # fmt: skip
    return Assignments(values=values, calls=calls, cleared={"CA": {(4, 0), (4, 2), (5, 0), (5, 1)}})


def _recognises(path: Path, head: bytes) -> bool:
    return path.suffix.lower() in (".json", ".yaml", ".yml", ".py") and b"agent_type" in head


HOLOOCEAN = Importer("vehicle", "scenario of HoloOcean (.json, .yaml, .py)", _recognises, read_holoocean)
