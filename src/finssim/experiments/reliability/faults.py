"""`finssim experiment faults`: break one thing after another while a vehicle drives, and see what it does."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from finssim.experiments.reliability.catalogue import SCENARIOS
from finssim.experiments.reliability.faults_table import faults_table
from finssim.experiments.reliability.job import FaultJob
from finssim.experiments.reliability.lockstep_trial import play
from finssim.experiments.reliability.process_trial import KILLS, play_kill
from finssim.experiments.reliability.processes import ReliabilityError
from finssim.experiments.running import Say, run_experiment
from finssim.experiments.transfer.campaign import run_jobs
from finssim.experiments.transfer.table import markdown_of, print_shown
from finssim.files import atomic_write
from finssim.provenance import provenance
from finssim.vehicles import load_vehicle

__all__ = ["faults_experiment", "run"]

MOTIONS = ("station", "moving")


def run(
    *, out: Path, as_json: bool = False, console: Console | None = None, **options: Any
) -> dict[str, Any]:
    """Run with a progress bar, print the table (or one JSON object) and write the directory.

    Arguments as `faults_experiment`; console is where the table goes, standard output if None.
    """
    return run_experiment(
        "experiment faults",
        lambda say: faults_experiment(out=out, say=say, **options),
        lambda result, screen: print_shown(faults_table(result), screen),
        out=out,
        as_json=as_json,
        console=console,
    )


def faults_experiment(
    *,
    out: Path,
    seeds: int = 1,
    seed: int = 1,
    scenarios: Sequence[str] | None = None,
    severity: str = "realistic",
    vehicle: str = "finsrov",
    processes: int | None = None,
    say: Say = lambda part, what: None,
) -> dict[str, Any]:
    """Play every fault in every motion and pool; a run that was interrupted goes on where it was.

    Args:
        out: Directory for `faults.json`, `faults.md` and `trials/`.
        seeds: How many pools, each with its own vehicle, camera, water and noise.
        seed: The first.
        scenarios: Names; all if None.
        severity: Of the pools: nominal, realistic or hard.
        vehicle: Name or file.
        processes: Trials at once; as many as processors if None.
        say: Told the share that is done and what comes next.

    Returns:
        What `faults.json` holds; `ok`: every trial passed, and every control failed.

    Raises:
        ReliabilityError: An unknown scenario.
    """
    known = [*KILLS, *SCENARIOS]
    names = list(scenarios or known)
    for name in names:
        if name not in known:
            raise ReliabilityError(f"unknown scenario '{name}'; available: {', '.join(known)}")
    ours = load_vehicle(vehicle)
    kills, jobs = _jobs(names, range(seed, seed + seeds), severity, vehicle)
    share, folder = len(kills) * KILL_WEIGHT / (len(kills) * KILL_WEIGHT + len(jobs)), Path(out)
    results = [_kill(job, folder / "trials", k, len(kills), share, say) for k, job in enumerate(kills)]
    results += run_jobs(
        jobs,  # type: ignore[arg-type]  # all that is asked of a job is in ours too
        folder / "trials",
        play,  # type: ignore[arg-type]
        processes=processes,
        say=lambda part, what: say(share + (1.0 - share) * part, what),
    )
    told = {"experiment": "faults", "severity": severity, "seeds": list(range(seed, seed + seeds))}
    rows = {name: [r for r in results if r["job"]["row"] == name] for name in names}
    result = {
        **told,
        "vehicle": {"name": ours.name, "sha256": ours.sha256},
        "ok": all(row_ok(name, rows[name]) for name in names),
        "trials": results,
        "provenance": provenance(),
    }
    with atomic_write(folder / "faults.json") as temporary:
        temporary.write_text(json.dumps(result, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    with atomic_write(folder / "faults.md") as temporary:
        temporary.write_text(markdown_of(faults_table(result)), encoding="utf-8")
    return result


KILL_WEIGHT = 5.0
"""Trials in lock-step that take as long as one in real time."""


def _jobs(
    names: Sequence[str], seeds: Sequence[int], severity: str, vehicle: str
) -> tuple[list[FaultJob], list[FaultJob]]:
    """Jobs with processes of their own, and those in lock-step."""
    common = {"severity": severity, "vehicle": vehicle}
    kills = [
        FaultJob(scenario=name, motion=motion, plant=s, seed=s, **common)
        for name in names if name in KILLS for motion in MOTIONS for s in seeds
    ]  # fmt: skip
    jobs = [
        FaultJob(scenario=name, variant=variant, motion=motion, plant=s, seed=s, **common)
        for name in names if name in SCENARIOS
        for variant in SCENARIOS[name].faults for motion in SCENARIOS[name].motions for s in seeds
    ]  # fmt: skip
    return kills, jobs


def _kill(job: FaultJob, folder: Path, k: int, of: int, share: float, say: Say) -> dict[str, Any]:
    """One trial with processes of its own, alone on the machine; read back if it is there."""
    say(share * k / of, f"{job.scenario}, {job.target}")
    path = folder / f"{job.key()}.json"
    if not path.is_file():
        told = {"key": job.key(), "job": {**job.described(), "row": job.row, "target": job.target}}
        with atomic_write(path) as temporary:
            temporary.write_text(json.dumps({**told, **play_kill(job)}, indent=1, allow_nan=False) + "\n")
    result: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return result


def row_ok(name: str, trials: Sequence[Mapping[str, Any]]) -> bool:
    """Whether the trials of a scenario came out as they must: a control has to fail."""
    must_fail = name in SCENARIOS and SCENARIOS[name].must_fail
    return bool(trials) and all(bool(trial["ok"]) is not must_fail for trial in trials)
