"""The localization experiment as a person reads it: its table beside the paper's, and its folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from finssim.experiments.localization_calibration import Calibrated, write_survey
from finssim.experiments.localization_campaign import Campaign
from finssim.experiments.localization_figure import draw_error_map, draw_sensitivity
from finssim.experiments.localization_scores import Scores
from finssim.files import atomic_directory
from finssim.localization.camera_file import write_camera
from finssim.localization.detection.detections import write_detections
from finssim.localization.pool import write_pool

__all__ = ["RESULT_FILE", "markdown", "print_table", "write_results"]

RESULT_FILE = "localization.json"

NOTE = (
    "ours: a virtual pool of the published geometry, calibrated on half of the places, measured at the others. paper: "
    "its camera over its pool, calibrated and measured on the same places, with the depth known. These are different "
    "experiments and stand side by side for orientation."
)
WORDS = {
    "published": "every error",
    "flat": "no ripples",
    "quiet": "noise of the pictures alone",
    "lifted": "every error, and the tag higher than the calibration saw it",
    "refractive": "refractive",
    "refractive-weighted": "refractive, weighted",
    "refractive-6dof": "refractive, 6 DOF",
    "pinhole-depth": "pinhole with depth",
    "pinhole": "pinhole PnP",
    "pinhole, refractive pose": "pinhole PnP, as paper",
}
HEADS = ["", "RMSE [cm]", "95 % of it", "P95 [cm]", "95 % of it", "located"]


def rows_of(result: Mapping[str, Any]) -> dict[str, list[list[str]]]:
    """Words about conditions -> rows of the table; the last is the paper's."""
    tables = {}
    for name, methods in result["results"].items():
        rows = []
        for method, m in methods.items():
            rows.append(
                [
                    WORDS[method],
                    _figure(m["rmse_cm"]),
                    _range(m["rmse_ci95_cm"]),
                    _figure(m["p95_cm"]),
                    _range(m["p95_ci95_cm"]),
                    f"{m['located']}/{m['pictures']}",
                ]
            )
        tables[f"ours, {name} conditions: {WORDS[name]}"] = rows
    tables["the paper: its camera over its pool"] = [
        [WORDS[m], f"{p['rmse_cm']:.2f}", "", f"{p['p95_cm']:.2f}", "", ""]
        for m, p in result["paper"].items()
    ]
    return tables


def print_table(result: Mapping[str, Any], console: Console) -> None:
    """Print it."""
    console.print(_headline(result), highlight=False)
    for words, rows in rows_of(result).items():
        table = Table(
            box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, title=words, title_justify="left",
            title_style="bold",
        )  # fmt: skip
        for k, head in enumerate(HEADS):
            table.add_column(
                Text(head), justify="right" if k else "left", no_wrap=True, min_width=0 if k else 20
            )
        for row in rows:
            table.add_row(*row, style="dim" if words.startswith("the paper") else None)
        console.print(table)
    console.print(_gain(result), highlight=False)
    console.print(NOTE, highlight=False)


def markdown(result: Mapping[str, Any]) -> str:
    """`localization.md`."""
    parts = ["# Horizontal localization through water", _headline(result), _gain(result)]
    for words, rows in rows_of(result).items():
        lines = [HEADS, ["---"] + ["--:"] * (len(HEADS) - 1), *rows]
        table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
        parts += [f"## {words[0].upper()}{words[1:]}", table]
    parts += [NOTE, "![Error map](error_map.png)"]
    if result["sensitivity"]:  # an interruption may come before it
        parts.append("![Sensitivity](sensitivity.png)")
    parts += ["## What the calibrations got wrong", _calibrations(result)]
    origin = result["provenance"]
    parts.append(f"FinsSim {origin['finssim']}, revision {origin['revision']}, seeds {result['seeds']}.")
    return "\n\n".join(parts) + "\n"


def write_results(
    result: Mapping[str, Any],
    out: Path,
    campaign: Campaign,
    found: Calibrated,
    scores: Mapping[str, Scores],
) -> None:
    """Write the directory: result, page, figures, and what a user needs to do the first seed by hand.

    Raises:
        OutputError: It cannot be written.
    """
    with atomic_directory(out, replaces=RESULT_FILE) as folder:
        (folder / "localization.md").write_text(markdown(result), encoding="utf-8")
        draw_error_map(campaign, scores["pinhole"], scores["refractive"], folder / "error_map.png")
        if result["sensitivity"]:
            draw_sensitivity(result["sensitivity"], folder / "sensitivity.png")
        write_camera(folder / "camera.yaml", campaign.lens, {})
        write_pool(found.refractive, folder / "pool.yaml")
        write_pool(found.pinhole, folder / "pool_pinhole.yaml")
        write_detections(found.frames, folder / "detections.csv")
        write_survey(found.survey, folder / "survey.csv")
        (folder / RESULT_FILE).write_text(
            json.dumps(result, indent=2, allow_nan=False) + "\n", encoding="utf-8"
        )


def _headline(result: Mapping[str, Any]) -> str:
    short = f" (interrupted, {result['seeds_asked_for']} asked for)" if result["interrupted"] else ""
    return (
        f"{len(result['seeds'])} seeds{short}, each {result['pictures_per_seed']} pictures at"
        f" {result['places']} places,"
        f" renderer {result['renderer']}"
    )


def _gain(result: Mapping[str, Any]) -> str:
    rivals = {
        "pinhole": "pinhole PnP calibrated on the same half",
        "pinhole, refractive pose": "pinhole PnP with the camera pose of the refractive calibration, as the paper's",
    }
    sentences = []
    for rival, words in rivals.items():
        m = result["results"]["published"]
        if not (m["refractive"]["located"] and m[rival]["located"]):
            continue
        less = [100.0 * (1.0 - m["refractive"][key] / m[rival][key]) for key in ("rmse_cm", "p95_cm")]
        sentences.append(f"Refractive below {words}: RMSE {less[0]:.1f} %, P95 {less[1]:.1f} %.")
    return " ".join(sentences)


def _calibrations(result: Mapping[str, Any]) -> str:
    head = ["seed", "camera height [mm]", "water [mm]", "camera over water [mm]", "tilt [°]", "index"]
    lines = [head, ["--:"] * len(head)]
    for c in result["calibration"]:
        lengths = [f"{c[k]:.2f}" for k in ("camera_height_mm", "water_height_mm", "camera_over_water_mm")]
        lines.append([str(c["seed"]), *lengths, f"{c['tilt_deg']:.3f}", f"{c['index']:+.4f}"])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _figure(value: float | None) -> str:
    return "none" if value is None else f"{value:.2f}"


def _range(interval: list[float | None]) -> str:
    low, high = interval
    return "" if low is None or high is None else f"[{low:.2f}, {high:.2f}]"
