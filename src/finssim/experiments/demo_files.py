"""What `finssim demo` leaves beside trials and vehicle: results, report, and the commands that repeat it by hand."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from finssim.experiments.evaluate import Evaluation
from finssim.experiments.identify import TRIALS, Identification, commands, vehicle_files
from finssim.experiments.on_robot.session import OnRobot
from finssim.vehicles import load_vehicle

__all__ = ["PLANT_FILE", "TRIALS_FOLDER", "command_lines", "write_demo"]

PLANT_FILE = "pool.yaml"
"""The plant, for `finssim pool --plant`."""
TRIALS_FOLDER = "deployed"
"""A result and a series for every trial of a controller."""


def command_lines(
    out: Path,
    vehicle: str,
    plant: int,
    severity: str,
    ranges: str,
    training: Mapping[str, Any],
    robot: OnRobot | None = None,
) -> list[str]:
    """Command lines that repeat the demonstration's steps by hand.

    Args:
        out: Its folder.
        vehicle: Name or file.
        plant: Seed of the pool.
        severity: Of the pool.
        ranges: That the policy was trained in.
        training: `seed` and `steps`.
        robot: On which it was done; in the pool if None.
    """
    rough, identified = (out / file for file in vehicle_files(load_vehicle(vehicle).name))
    seed, steps = training["seed"], training["steps"]
    if robot is not None:
        place = f"{robot.options} --arm"
        return [
            f"finssim excite all --vehicle {rough} {place} --coast 4 --out more-trials",
            *commands(out, load_vehicle(vehicle).name, seed),
            f"finssim train t1 --vehicle {identified} --randomize {ranges} --seed {seed} --steps {steps} --out policy",
            f"finssim run --policy policy --vehicle {identified} --goal 1,0.3,-0.5,90 {place} --record run.mcap",
            f"finssim evaluate run.mcap --task t1 --vehicle {identified}",
        ]
    return [
        f"finssim trials import {out / TRIALS / 'fit' / 'records'}/*.mcap --split phase --out trials",
        f"finssim excite all --vehicle {rough} --pool {plant} --severity {severity} --pool-vehicle {vehicle} --coast 4 "
        "--out more-trials",
        *commands(out, load_vehicle(vehicle).name, seed),
        f"finssim train t1 --vehicle {identified} --randomize {ranges} --seed {seed} --steps {steps} --out policy",
        f"finssim pool --vehicle {vehicle} --plant {out / PLANT_FILE} --pool-file site.yaml --truth truth.fst",
        f"finssim run --policy policy --vehicle {identified} --goal 1,0.3,-0.5,90 --robot pool --pool-file site.yaml "
        "--arm",
    ]


def write_demo(
    folder: Path,
    found: Identification,
    evaluations: Sequence[Evaluation],
    policy: Path,
    training: Mapping[str, Any],
    commands: Sequence[str],
    picture: bytes | None,
) -> None:
    """Write NAME.json of every controller, `steps.json`, `camera.png` and `report.html`.

    Args:
        folder: The demonstration's.
        found: What the trials told.
        evaluations: The policy's first.
        policy: Its directory, with `curves.csv`.
        training: `seconds`, `seed` and `steps`.
        commands: That repeat it.
        picture: PNG of the camera's view; none if None.
    """
    from finssim.experiments.identification_report import identification_section
    from finssim.experiments.report import report_html

    for evaluation in evaluations:
        name = evaluation.result["controller"]["name"]
        text = json.dumps(evaluation.result, indent=2, allow_nan=False) + "\n"
        (folder / f"{name}.json").write_text(text, encoding="utf-8")
    (folder / "steps.json").write_text(json.dumps(found.steps, indent=2) + "\n", encoding="utf-8")
    if picture is not None:
        (folder / "camera.png").write_bytes(picture)
    with (policy / "curves.csv").open(encoding="utf-8", newline="") as file:
        curves = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
    html = report_html(evaluations, curves, training, commands, identification_section(found), picture)
    (folder / "report.html").write_text(html, encoding="utf-8")
