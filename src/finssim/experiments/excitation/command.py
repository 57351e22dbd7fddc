"""`finssim excite --pool`: excitation programmes played in a virtual pool, and the trials that they make."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import yaml
from rich.console import Console
from rich.progress import Progress

from finssim.calibration.excitation.programmes import programmes
from finssim.experiments.excitation.pool_trials import pool_trials
from finssim.files import atomic_directory
from finssim.quiet import start_warp
from finssim.vehicles import load_vehicle

__all__ = ["excite_in_pool"]


def excite_in_pool(
    axes: str,
    *,
    vehicle: str,
    out: Path,
    plant: int,
    pool_vehicle: str | None = None,
    severity: str = "realistic",
    kind: str = "published",
    levels: Mapping[str, Sequence[float]] | Sequence[float] | None = None,
    repeats: int = 1,
    coast: float = 30.0,
    duration: float = 60.0,
    seed: int = 0,
    processes: int | None = None,
) -> list[Path]:
    """Play programmes in a virtual pool, over several processes.

    Args:
        axes: As for `programmes`; so are kind, levels, repeats, coast, duration and seed.
        vehicle: Name or file of the vehicle as the robot knows it.
        out: Folder to make: a trial for each programme, `records/NAME.mcap`, and `programmes.yaml`.
        plant: Seed of the pool.
        pool_vehicle: Name or file of the vehicle around which the pool's own is drawn; `vehicle` if None.
        severity: nominal, realistic or hard.
        processes: As many as there are processors if None.

    Returns:
        The folders of the trials.

    Raises:
        CalibrationError, PlantSpecError, VehicleError, OutputError: As they say.
    """
    start_warp()
    known, standing = load_vehicle(vehicle), load_vehicle(pool_vehicle or vehicle)
    plan = programmes(
        axes,
        known,
        kind=kind,
        levels=levels,
        repeats=repeats,
        coast=coast,
        duration=duration,
        seed=seed,
    )
    screen = Console(stderr=True)
    with (
        atomic_directory(out, replaces="programmes.yaml") as folder,
        Progress(console=screen, transient=True, disable=not screen.is_terminal) as progress,
    ):
        bar = progress.add_task("playing programmes", total=1.0)
        pool_trials(
            {"fit": plan},
            folder,
            vehicle=vehicle,
            pool_vehicle=pool_vehicle or vehicle,
            plant=plant,
            severity=severity,
            seed=seed,
            processes=processes,
            say=lambda part, what: progress.update(bar, completed=part, description=what),
        )
        for made in (folder / "fit").iterdir():
            made.rename(folder / made.name)
        (folder / "fit").rmdir()
        about = {
            "vehicle": {"name": known.name, "sha256": known.sha256},
            "kind": kind,
            "pool": {"vehicle": standing.name, "plant": plant, "severity": severity},
            "seed": seed,
            "programmes": [programme.name for programme in plan],
        }
        (folder / "programmes.yaml").write_text(yaml.safe_dump(about, sort_keys=False), encoding="utf-8")
    return [Path(out) / programme.name for programme in plan]
