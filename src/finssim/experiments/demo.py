"""`finssim demo`: identify a vehicle from trials, train in what was identified, evaluate beside two PIDs, report."""

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
from finssim.experiments.identify import PLANT_FILE, Identification, commands, identify, vehicle_files
from finssim.experiments.results_table import print_comparison
from finssim.files import atomic_directory
from finssim.learning.train import train

__all__ = ["demo"]

REPORT_FILE = "report.html"
SEED = 1
TASK, VEHICLE = "t1", "finsrov"


def demo(out: Path, *, steps: int | None = None, seed: int = SEED, console: Console | None = None) -> Path:
    """Identify FinsROV from trials, train T1 in what was identified, try it in the plant that the trials came from.

    Beside the policy, `pid` and `pid-paper` try the eight setpoints, tuned from the identified vehicle too.

    Args:
        out: Directory for trials, vehicle, policy, results and `report.html`; an earlier one there is replaced.
        steps: Control steps to train; as `finssim train` if None.
        seed: Of the trials and of the training.
        console: Where progress is shown; standard error if None.

    Returns:
        Path of the report.

    Raises:
        KeyboardInterrupt: After Ctrl-C. The policy so far is then in `OUT-training/interrupted`, and `out` as it was.
    """
    console = console or Console(stderr=True)
    rescue = out.with_name(f"{out.name}-training") / "interrupted"
    with atomic_directory(out, replaces=REPORT_FILE) as folder:
        with console.status("identifying the vehicle from trials"):
            found = identify(folder, VEHICLE, seed=seed, shown=out)
        told = sum(e.identifiable for e in found.fit.estimates.values())
        console.print(
            f"identified from {len(found.fit.trials)} trials in {found.seconds:.0f} s: {told} of "
            f"{len(found.fit.estimates)} parameters told, NRMSE on {len(found.replay.pairs)} other trials "
            f"{found.replay.aggregate('calibrated').value:.3f}",
            highlight=False,
        )
        began = time.perf_counter()
        policy = train(
            TASK,
            out=folder / "policy",
            vehicle=found.vehicle,
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
            "vehicle": out / vehicle_files(VEHICLE)[1],
            "plant": out / PLANT_FILE,
            "before": commands(out, VEHICLE, seed),
        }
        with _rescued(policy, rescue, console):
            evaluations = [
                evaluate_controller(controller, found.plant, task=TASK, vehicle=found.vehicle)
                for controller in (policy, "pid", "pid-paper")
            ]
            _write(folder, found, evaluations, policy, training)
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


def _write(
    folder: Path,
    found: Identification,
    evaluations: list[Evaluation],
    policy: Path,
    training: dict[str, Any],
) -> None:
    from finssim.experiments.identification_report import identification_section
    from finssim.experiments.report import report_html

    for evaluation in evaluations:
        name = evaluation.result["controller"]["name"]
        text = json.dumps(evaluation.result, indent=2, allow_nan=False) + "\n"
        (folder / f"{name}.json").write_text(text, encoding="utf-8")
    with (policy / "curves.csv").open(encoding="utf-8", newline="") as file:
        curves = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
    (folder / REPORT_FILE).write_text(
        report_html(evaluations, curves, training, identification_section(found)), encoding="utf-8"
    )


def _has_display() -> bool:
    """Whether a person sits in front of a screen where a browser could open."""
    if not sys.stdout.isatty():
        return False
    return sys.platform in ("darwin", "win32") or bool(
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )
