"""`finssim demo`: train, evaluate beside two PIDs, report."""

from __future__ import annotations

import csv
import json
import os
import shutil
import sys
import time
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console

from finssim.control.policy import Policy
from finssim.control.policy_description import DESCRIPTION_FILE
from finssim.experiments.evaluate import Evaluation, evaluate_controller
from finssim.experiments.plants import load_plant
from finssim.experiments.results_table import print_comparison
from finssim.files import atomic_directory
from finssim.learning.train import train

__all__ = ["demo"]

REPORT_FILE = "report.html"
SEED = 1
TASK, VEHICLE = "t1", "finsrov"


def demo(out: Path, *, steps: int | None = None, seed: int = SEED, console: Console | None = None) -> Path:
    """Train T1 for the calibrated FinsROV, try it beside `pid` and `pid-paper` on the eight setpoints, write a report.

    Args:
        out: Directory for the policy, the results and `report.html`; an earlier demonstration there is replaced.
        steps: Control steps to train; as `finssim train` if None.
        seed: Of the training.
        console: Where progress is shown; standard error if None.

    Returns:
        Path of the report.

    Raises:
        KeyboardInterrupt: After Ctrl-C. The policy so far is then in `OUT-training/interrupted`, and `out` as it was.
    """
    began = time.perf_counter()
    console = console or Console(stderr=True)
    rescue = out.with_name(f"{out.name}-training") / "interrupted"
    with atomic_directory(out, replaces=REPORT_FILE) as folder:
        policy = train(
            TASK,
            out=folder / "policy",
            vehicle=VEHICLE,
            seed=seed,
            steps=steps,
            console=console,
            shown=out / "policy",
            interrupted=rescue,
        )
        training = {
            "seconds": time.perf_counter() - began,
            "seed": seed,
            "steps": Policy.load(policy).description.training["steps"],
            "task": TASK,
            "vehicle": VEHICLE,
        }
        plant = load_plant("nominal")
        with _rescued(policy, rescue, console):
            evaluations = [
                evaluate_controller(controller, plant, task=TASK, vehicle=VEHICLE)
                for controller in (policy, "pid", "pid-paper")
            ]
            _write(folder, evaluations, policy, training)
    print_comparison([e.result for e in evaluations], Console())
    report = Path(out) / REPORT_FILE
    print(f"report: {report}")
    if _has_display():
        webbrowser.open(report.resolve().as_uri())
    return report


@contextmanager
def _rescued(policy: Path, rescue: Path, console: Console) -> Iterator[None]:
    """Keep a trained policy when what follows its training is interrupted, and `folder` goes."""
    try:
        yield
    except KeyboardInterrupt:
        with atomic_directory(rescue, replaces=DESCRIPTION_FILE) as copy:
            shutil.copytree(policy, copy, dirs_exist_ok=True)
        console.print(f"policy kept: {rescue}", highlight=False, soft_wrap=True)
        raise


def _write(folder: Path, evaluations: list[Evaluation], policy: Path, training: dict[str, Any]) -> None:
    from finssim.experiments.report import report_html

    for evaluation in evaluations:
        name = evaluation.result["controller"]["name"]
        text = json.dumps(evaluation.result, indent=2, allow_nan=False) + "\n"
        (folder / f"{name}.json").write_text(text, encoding="utf-8")
    with (policy / "curves.csv").open(encoding="utf-8", newline="") as file:
        curves = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
    (folder / REPORT_FILE).write_text(report_html(evaluations, curves, training), encoding="utf-8")


def _has_display() -> bool:
    """Whether a person sits in front of a screen where a browser could open."""
    if not sys.stdout.isatty():
        return False
    return sys.platform in ("darwin", "win32") or bool(
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )
