"""A torpedo with every kind of actuator: REMUS 100's hull with rudder, elevator, buoyancy engine and moving mass."""

import json
from pathlib import Path

import yaml

from finssim.vehicles import Vehicle, load_vehicle

FIN = {
    "kind": "fin", "position": [-0.638, 0.0, 0.0], "area": 0.0133, "lift_slope": 3.12, "stall": 0.6,
    "drag": [0.01, 0.0, 1.0], "minimum": -0.35, "maximum": 0.35, "time_constant": 0.1, "rate_limit": 1.0,
}  # fmt: skip
ACTUATORS = {
    "rudder": {**FIN, "span": [0.0, 0.0, 1.0], "play": 0.004},
    "elevator": {**FIN, "span": [0.0, 1.0, 0.0]},
    "engine": {
        "kind": "buoyancy", "position": [0.1, 0.0, 0.0], "minimum": -1e-3, "maximum": 1e-3, "rate_limit": 2e-4,
    },
    "battery": {
        "kind": "moving_mass", "mass": 5.0, "position": [0.0, 0.0, -0.03], "axis": [1.0, 0.0, 0.0],
        "minimum": -0.05, "maximum": 0.05, "rate_limit": 0.02,
    },
}  # fmt: skip


def torpedo(**actuators: dict) -> Vehicle:
    """Return the torpedo, with these actuators in place of all; its propeller loses thrust in the flow."""
    values = {**load_vehicle("remus100").values(), "actuators": actuators or ACTUATORS}
    values["thrusters"]["propeller"] |= {"diameter": 0.14, "inflow": {"thrust_loss": 0.03}}
    return Vehicle(**values, name="torpedo")


def torpedo_file(folder: Path) -> Path:
    """Write the torpedo as a vehicle file into a folder; return its path."""
    file = folder / "torpedo.yaml"
    values = {**torpedo().values(), "origin": "guessed"}
    file.write_text(yaml.safe_dump(json.loads(json.dumps(values)), sort_keys=False), encoding="utf-8")
    return file
