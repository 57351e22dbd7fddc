"""`finssim experiment localization`: the paper's Table II, calibrated on half of the places, measured on the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from rich.console import Console

from finssim.experiments.localization_calibration import Calibrated, calibrate
from finssim.experiments.localization_campaign import CONDITIONS, Campaign, draw_campaign, lifted
from finssim.experiments.localization_pictures import RENDERERS, Picture, pictures
from finssim.experiments.localization_scores import Scores, locate, pooled, rmse_cm, sensitivity
from finssim.experiments.localization_table import RESULT_FILE, print_table, write_results
from finssim.experiments.running import Say, run_experiment
from finssim.files import atomic_directory, refuse_unwritable
from finssim.provenance import provenance

__all__ = ["METHODS_SHOWN", "PAPER_TABLE_2", "SeedResult", "localization_experiment", "run"]

PAPER_TABLE_2 = MappingProxyType({"pinhole": (5.74, 11.41), "refractive": (0.73, 1.45)})
"""Method -> RMSE and 95th percentile in the paper [cm]: its camera over its pool, calibrated on the same places."""

METHODS_SHOWN = MappingProxyType(
    {
        "refractive": ("refractive", "refractive"),
        "refractive-weighted": ("refractive-weighted", "refractive"),
        "refractive-6dof": ("refractive-6dof", "refractive"),
        "pinhole-depth": ("pinhole-depth", "pinhole"),
        "pinhole": ("pinhole", "pinhole"),
        "pinhole, refractive pose": ("pinhole", "refractive"),
    }
)
"""Row of the table -> method and the calibration it uses. The last is as the paper has it, with the camera pose of the
refractive calibration."""

LIFT = 0.4
"""How much higher than the places of the calibration the tag is shown once more [m]."""
RIPPLES = (0.0, 0.005, 0.01, 0.02, 0.04)
RIPPLE_VISITS = 40
RIPPLE_IMAGES = 4


@dataclass(frozen=True)
class SeedResult:
    """One drawing of the test under one set of conditions."""

    campaign: Campaign
    seen: list[Picture]
    found: Calibrated
    scores: Mapping[str, Scores]
    """By method."""


def run(
    *,
    renderer: str = "own",
    seeds: int = 3,
    out: Path,
    seed: int = 1,
    as_json: bool = False,
    console: Console | None = None,
) -> dict[str, Any]:
    """Run the experiment with a progress bar, print the table (or one JSON object) and write the directory.

    Arguments as for `localization_experiment`; console is where the table goes, standard output if None.
    """
    return run_experiment(
        "localization experiment",
        lambda say: localization_experiment(renderer=renderer, seeds=seeds, out=out, seed=seed, progress=say),
        print_table,
        out=out,
        as_json=as_json,
        console=console,
    )


def localization_experiment(
    *,
    renderer: str = "own",
    seeds: int = 3,
    out: Path,
    seed: int = 1,
    locations: tuple[int, int] | None = None,
    images: int | None = None,
    progress: Say | None = None,
) -> dict[str, Any]:
    """Draw the published test, calibrate on one half of its places, locate the tag at the other half.

    Every seed draws the places' survey errors, readings, camera file, plumb line, ripples and noise anew. Ctrl-C keeps
    the seeds that are finished, or of the first what there is.

    Args:
        renderer: `own`, `mitsuba`, or `geometry` (corners by exact projection and white noise, without pictures).
        seeds: How many drawings.
        out: Directory for `localization.json`, `.md`, figures, and of the first seed survey, detections and pool files.
        seed: The first.
        locations: Places along and across the pool; the published 170 if None.
        images: Pictures in all; the published 720 if None.
        progress: Told the share that is done and what comes next.

    Returns:
        What `localization.json` holds.

    Raises:
        ValueError: No seeds, or an unknown renderer.
    """
    if seeds < 1:
        raise ValueError(f"seeds is {seeds}, expected at least 1")
    if renderer not in RENDERERS:
        raise ValueError(f"unknown renderer '{renderer}'; available: {', '.join(RENDERERS)}")
    refuse_unwritable(atomic_directory(out, replaces=RESULT_FILE))
    size: dict[str, Any] = {}
    if locations is not None:
        size["locations"] = locations
    if images is not None:
        size["images"] = images
    found = _drawn(seeds, seed, renderer, size, progress or (lambda part, what: None))
    first = found.done["published"][0]
    result = {
        "experiment": "localization",
        "renderer": renderer,
        "seeds": [one.campaign.seed for one in found.done["published"]],
        "seeds_asked_for": seeds,
        "interrupted": found.interrupted,
        "places": len(first.campaign.visits),
        "pictures_per_seed": sum(visit.images for visit in first.campaign.visits),
        "conditions": {name: vars(CONDITIONS[name]) for name in CONDITIONS},
        "results": found.results(),
        "lift_m": LIFT,
        "pixel_std_px": [one.found.pixel_std for one in found.done["published"]],
        "calibration": [_errors(one) for one in found.done["published"]],
        "sensitivity": found.swept,
        "paper": {m: {"rmse_cm": r, "p95_cm": p} for m, (r, p) in PAPER_TABLE_2.items()},
        "provenance": provenance(),
    }
    write_results(result, out, first.campaign, first.found, first.scores)
    return result


@dataclass(frozen=True)
class _Findings:
    done: Mapping[str, list[SeedResult]]
    """By conditions."""
    higher: list[dict[str, Scores]]
    """The tag lifted, by seed and method."""
    swept: Mapping[str, Any]
    interrupted: bool

    def results(self) -> dict[str, Any]:
        """Conditions -> method -> figures over all seeds."""
        scores = {name: [one.scores for one in runs] for name, runs in self.done.items()}
        return {
            name: {method: pooled([one[method] for one in runs]) for method in METHODS_SHOWN}
            for name, runs in (scores | {"lifted": self.higher}).items()
            if runs
        }


def _drawn(seeds: int, seed: int, renderer: str, size: Mapping[str, Any], say: Say) -> _Findings:
    """All seeds, or after Ctrl-C those that are finished, of the first what there is."""
    done: dict[str, list[SeedResult]] = {name: [] for name in CONDITIONS}
    higher: list[dict[str, Scores]] = []
    swept: dict[str, Any] = {}
    try:
        for k in range(seeds):
            for j, name in enumerate(CONDITIONS):
                say((k + j / len(CONDITIONS)) / seeds, f"seed {seed + k}, {name} conditions")
                done[name].append(_one(name, seed + k, renderer, size))
            say((k + 0.8) / seeds, f"seed {seed + k}, another depth")
            higher.append(_lifted(done["published"][k], renderer))
            if not swept:
                say((k + 0.9) / seeds, "sensitivity")
                swept = _swept(done["published"][0], renderer, size)
    except KeyboardInterrupt:
        if not done["published"]:
            raise
        finished = max(len(higher), 1)
        return _Findings({name: runs[:finished] for name, runs in done.items()}, higher, swept, True)
    return _Findings(done, higher, swept, False)


def _one(name: str, seed: int, renderer: str, size: Mapping[str, Any]) -> SeedResult:
    campaign = draw_campaign(CONDITIONS[name], seed, **size)
    seen = list(pictures(campaign, renderer))
    found = calibrate(campaign, seen)
    return SeedResult(campaign, seen, found, _scored(campaign, seen, found))


def _scored(campaign: Campaign, seen: Sequence[Picture], found: Calibrated) -> dict[str, Scores]:
    pools = {"refractive": found.refractive, "pinhole": found.pinhole}
    return {
        row: locate(campaign, seen, pools[kind], method, pixel_std=found.pixel_std)
        for row, (method, kind) in METHODS_SHOWN.items()
    }


def _lifted(one: SeedResult, renderer: str) -> dict[str, Scores]:
    """The same calibration, the tag at another depth."""
    campaign = lifted(one.campaign, LIFT)
    return _scored(campaign, list(pictures(campaign, renderer)), one.found)


def _swept(one: SeedResult, renderer: str, size: Mapping[str, Any]) -> dict[str, Any]:
    """Sensitivities: to depth, tilt and index on the same pictures, to ripples on new ones."""
    swept: dict[str, Any] = dict(
        sensitivity(one.campaign, one.seen, one.found.refractive, one.found.pixel_std)
    )
    if renderer == "geometry":  # it has no ripples
        return swept
    held_out = np.flatnonzero(~one.campaign.calibrates)
    some = held_out[:: max(1, len(held_out) // RIPPLE_VISITS)]
    visits = tuple(replace(one.campaign.visits[k], images=RIPPLE_IMAGES) for k in some)
    swept["ripples"] = []
    for slope in RIPPLES:
        campaign = replace(
            one.campaign,
            conditions=replace(one.campaign.conditions, ripples=slope),
            visits=visits,
            calibrates=np.zeros(len(visits), bool),
        )
        scores = locate(
            campaign,
            list(pictures(campaign, renderer)),
            one.found.refractive,
            "refractive",
            pixel_std=one.found.pixel_std,
        )
        swept["ripples"].append([slope, rmse_cm(scores)])
    return swept


def _errors(one: SeedResult) -> dict[str, Any]:
    """What the calibration of one seed got wrong, the truth being known here."""
    true, found = one.campaign.truth, one.found.refractive
    x, y = true.camera.position[:2]
    above = [
        float(pool.camera.position[2] - pool.interface.height(*pool.camera.position[:2]))
        for pool in (true, found)
    ]
    lean = float(np.clip(true.interface.normal @ found.interface.normal, -1.0, 1.0))
    return {
        "seed": one.campaign.seed,
        "camera_height_mm": 1000.0 * float(found.camera.position[2] - true.camera.position[2]),
        "water_height_mm": 1000.0 * float(found.interface.height(x, y) - true.interface.height(x, y)),
        "camera_over_water_mm": 1000.0 * (above[1] - above[0]),
        "tilt_deg": float(np.degrees(np.arccos(lean))),
        "index": float(found.interface.index_far - true.interface.index_far),
    }
