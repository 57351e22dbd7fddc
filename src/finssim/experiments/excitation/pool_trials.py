"""Many programmes in one virtual pool, over several processes: records, and the trials that are made of them."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from finssim.calibration.errors import CalibrationError
from finssim.calibration.excitation.programmes import Programme
from finssim.calibration.trials.trial import Trial
from finssim.calibration.trials.trial_files import load_trial
from finssim.experiments.excitation.places import box_of, place_of
from finssim.experiments.excitation.pool_run import PoolRun, play_programme
from finssim.experiments.running import Say
from finssim.experiments.transfer.campaign import Show, run_jobs
from finssim.pool.draw_plant import draw_plant
from finssim.vehicles import load_vehicle

__all__ = ["RECORDS", "pool_trials"]

RECORDS = "records"
"""Folder of the MCAPs beside the trials."""


def pool_trials(
    plans: Mapping[str, Sequence[Programme]],
    folder: Path,
    *,
    vehicle: str,
    pool_vehicle: str,
    plant: int = 1,
    severity: str = "realistic",
    seed: int = 1,
    hold: str | None = "pid",
    leave_out: bool = False,
    processes: int | None = None,
    say: Say = lambda part, what: None,
    show: Show = lambda job, result: None,
) -> dict[str, list[Trial]]:
    """Play programmes in a pool; the robot's whole software does, at the start that `places` gives each.

    Args:
        plans: Role of the trials (fit, held-out) -> programmes.
        folder: Takes ROLE/NAME, the trials, and ROLE/records/NAME.mcap.
        vehicle: Name or file of the vehicle as the robot knows it: it allocates, holds and localizes by it.
        pool_vehicle: Name or file of the vehicle around which the pool's own is drawn.
        plant: Seed of the pool.
        severity: nominal, realistic or hard.
        seed: Of noise.
        hold: PID that keeps the axes that a programme does not excite; None leaves them alone.
        leave_out: Leave out the trials that the bridge stopped, instead of refusing all; `show` is given their fault.
        processes: As many as there are processors if None.
        say: Told the share that is done and what is left.
        show: Given each run and its result, of `play_programme`, as soon as there is one.

    Returns:
        The trials by role, in the order of the programmes; a trial is complete.

    Raises:
        CalibrationError: A programme that the pool has no room for, or that the bridge stopped.
        PlantSpecError: A vehicle that cannot be put into a pool.
    """
    runs = [
        PoolRun(
            row=role,
            programme=programme,
            vehicle=vehicle,
            pool_vehicle=pool_vehicle,
            plant=plant,
            severity=severity,
            seed=seed,
            hold=hold,
        )
        for role, plan in plans.items()
        for programme in plan
    ]
    body, standing = load_vehicle(vehicle), load_vehicle(pool_vehicle)
    box = box_of(draw_plant(standing, plant, severity).basin)  # type: ignore[arg-type]
    for run in runs:  # what cannot be is refused before anything is played
        place_of(run.programme, body, box)
    with tempfile.TemporaryDirectory() as scratch:
        results = run_jobs(
            runs,  # type: ignore[arg-type]
            Path(scratch),
            play_programme,  # type: ignore[arg-type]
            processes=processes,
            say=say,
            show=show,
        )
        for run, result in zip(runs, results, strict=True):
            if result["fault"] and leave_out:
                continue
            if result["fault"]:
                raise CalibrationError(
                    f"{run.target} in the virtual pool: {result['fault']}: give lower levels, or fewer axes at once"
                )
            _keep(Path(scratch) / run.key(), folder / run.row, run.target)
    done = {(run.row, run.target) for run, result in zip(runs, results, strict=True) if not result["fault"]}
    found = {
        role: [load_trial(folder / role / p.name) for p in plan if (role, p.name) in done]
        for role, plan in plans.items()
    }
    for role, trials in found.items():
        if not trials:
            raise CalibrationError(
                f"the bridge stopped every {role} trial in the virtual pool: {results[0]['fault']}: give lower levels"
            )
    return found


def _keep(made: Path, folder: Path, name: str) -> None:
    """Move a trial and its record to where people look for them."""
    (folder / RECORDS).mkdir(parents=True, exist_ok=True)
    shutil.move(made, folder / name)
    shutil.move(made.with_name(f"{made.name}.mcap"), folder / RECORDS / f"{name}.mcap")
