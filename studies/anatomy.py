"""Largest error of one parameter that a controller tolerates: `python -m studies.anatomy --out anatomy`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from finssim.cli.command_line import run_script
from finssim.core.palette import COLORS
from finssim.core.progress import Progress
from finssim.core.provenance import provenance
from finssim.evaluation.campaign import check_choices, run_jobs, write_json
from finssim.evaluation.evaluate import ControllerTrials, play
from finssim.evaluation.figures import clean, legend_below, new_figure, save_figure
from finssim.evaluation.plants import PlantChanges, load_plant
from finssim.evaluation.statistics import with_interval
from finssim.evaluation.tables import Columns, Table, cells
from finssim.learning.train import TrainingSettings
from finssim.studies.transfer import T1, controllers_of
from finssim.vehicles import load_vehicle

TRAINING_SHARE = 0.3
"""Fraction of the progress bar for training."""
HELD = 0.9
"""Fraction of its trials that a row must hold at an amount, and at all smaller ones, to tolerate the error [-]."""
FIGURES: Columns = {
    "success": ("held", ".3f"),
    "e_p_m": ("e_p, median [mm]", ".2f", 1000.0),
    "t_s_s": ("t_s, mean [s]", ".2f"),
}
LEAST = 0.1
"""Smallest error in the figure [mm]; smaller ones are drawn at this value."""


@dataclass(frozen=True)
class Cause:
    """Error of one parameter, in increasing amounts."""

    title: str
    unit: str
    amounts: tuple[float, ...]
    """Amounts in the unit of the parameter, the first of which is zero."""
    plant: Callable[[float], Mapping[str, Any]]
    """Function of an amount that returns keys of the plant."""


def _ranges(**entries: Any) -> dict[str, Any]:
    return {"ranges": {"name": "anatomy", **entries}}


def _fixed(value: float) -> list[float]:
    return [value, value]


def _drag(a: float) -> dict[str, Any]:
    return _ranges(linear_damping={"all": _fixed(1.0 + a)}, quadratic_damping={"all": _fixed(1.0 + a)})


CAUSES: Mapping[str, Cause] = {
    "lag": Cause("motors slower by", "s", (0.0, 0.1, 0.2, 0.4, 0.6, 0.8), lambda a: {"extra_time_constant": a}),
    "delay": Cause("commands later by", "s", (0.0, 0.1, 0.2, 0.3, 0.4, 0.6), lambda a: {"extra_delay": a}),
    "weak": Cause("thrust less by", "%", (0.0, 15.0, 30.0, 45.0, 60.0, 75.0),
                  lambda a: _ranges(thrust={"all": _fixed(1.0 - a / 100.0)})),
    "strong": Cause("thrust more by", "%", (0.0, 25.0, 50.0, 100.0, 150.0, 200.0),
                    lambda a: _ranges(thrust={"all": _fixed(1.0 + a / 100.0)})),
    "asymmetry": Cause("each thruster off by up to", "%", (0.0, 10.0, 20.0, 30.0, 40.0, 60.0),
                       lambda a: _ranges(thrust={"each": [1.0 - a / 100.0, 1.0 + a / 100.0]})),
    "drag": Cause("drag more by", "%", (0.0, 50.0, 100.0, 200.0, 300.0, 400.0), lambda a: _drag(a / 100.0)),
    "slippery": Cause("drag less by", "%", (0.0, 20.0, 40.0, 60.0, 80.0, 95.0), lambda a: _drag(-a / 100.0)),
    "added-mass": Cause("added mass more by", "%", (0.0, 25.0, 50.0, 100.0, 150.0, 200.0),
                        lambda a: _ranges(added_mass={"all": _fixed(1.0 + a / 100.0)})),
    "mass": Cause("heavier, in trim, by", "%", (0.0, 15.0, 30.0, 60.0, 100.0, 150.0),
                  lambda a: _ranges(mass=_fixed(1.0 + a / 100.0), volume="with_mass")),
    "ballast": Cause("too much ballast, of its weight", "%", (0.0, 2.0, 4.0, 8.0, 12.0, 16.0),
                     lambda a: _ranges(buoyancy=_fixed(1.0 - a / 100.0))),
    "current": Cause("current of", "m/s", (0.0, 0.05, 0.1, 0.15, 0.2, 0.3), lambda a: _ranges(current=_fixed(a))),
    "noise": Cause("position noise of", "cm", (0.0, 2.0, 5.0, 10.0, 15.0, 20.0),
                   lambda a: {"noise": {"position_std": a / 100.0}} if a else {}),
    "latency": Cause("state known late by", "s", (0.0, 0.1, 0.2, 0.3, 0.4, 0.6),
                     lambda a: {"noise": {"delay": a}} if a else {}),
}  # fmt: skip
"""Name -> cause."""
ROWS = (
    "calibrated", "calibrated-dr", "no-lag", "mesh", "simplified", "calibrated-integral", "calibrated-pool",
    "pid-paper", "pid",
)  # fmt: skip
"""Rows of station keeping with different controllers."""
FOREIGN = "foreign"
"""Plant with errors of all parameters, drawn for each trial."""


def anatomy(
    *,
    out: Path,
    causes: Annotated[Sequence[str] | None, ","] = None,
    rows: Annotated[Sequence[str] | None, ","] = None,
    seeds: Annotated[int, (1, 1000)] = 3,
    seed: int = 1,
    trials: Annotated[int, (1, None)] = 16,
    vehicle: str = "finsrov",
    steps: Annotated[int | None, (1, None)] = None,
    processes: Annotated[int | None, (1, None)] = None,
    address: str | None = None,
    progress: Progress = lambda part, text: None,
) -> dict[str, Any]:
    """Test controllers of T1 in plants with one parameter wrong by increasing amounts, and with all of them wrong.

    Example: python -m studies.anatomy --causes lag,current --rows calibrated,pid --seeds 1 --out anatomy

    Args:
        out (DIR): Directory for JSON, Markdown, figure, policies and trials; an interrupted one is continued.
        causes (NAMES): Wrong parameters, separated by commas; default all.
        rows (NAMES): Rows of experiment t1 with different controllers, separated by commas; default all.
        seeds: Number of trainings of each policy.
        seed: Seed of every random number; equal seeds give equal results.
        trials: Trials of each policy in each plant, over the published setpoints; ten times as many in the last
            plant.
        vehicle (NAME|FILE): Vehicle in the catalogue, or path of a vehicle file.
        steps: Control steps of the training, summed over all worlds; default that of the task.
        processes: Parallel plants; default one per processor.
        address (ADDRESS): Ray cluster to use instead, HOST:PORT or auto.
        progress: Receives the completed fraction and the next trial.

    Returns:
        `causes`: cause -> row -> figures at every amount; `foreign`: row -> figures; the jobs are in the directory.
    """
    chosen, names = list(causes or CAUSES), list(rows or ROWS)
    check_choices(chosen, CAUSES, "cause", ValueError)
    check_choices(names, ROWS, "row", ValueError)
    folder, run_seeds = Path(out), range(seed, seed + seeds)
    controllers = controllers_of(
        "t1", {name: T1.rows[name] for name in names}, run_seeds, folder,
        TrainingSettings(vehicle=vehicle, steps=steps), lambda part, text: progress(TRAINING_SHARE * part, text),
        processes=processes, address=address,
    )  # fmt: skip
    plants = {
        (name, k): PlantChanges(name=f"{name}-{k}", **CAUSES[name].plant(amount))
        for name in chosen
        for k, amount in enumerate(CAUSES[name].amounts)
    }
    plants[FOREIGN, 0] = load_plant(FOREIGN)
    jobs = [
        ControllerTrials(
            row=row, target=name, plant=k, seed=s, noise=s, controller=controllers[row, s], vehicle=vehicle,
            water=water, trials=trials * (10 if name == FOREIGN else 1),
        )
        for (name, k), water in plants.items() for row in names for s in run_seeds
    ]  # fmt: skip
    results = run_jobs(
        jobs, folder / "trials", play, processes=processes, address=address,
        progress=lambda part, text: progress(TRAINING_SHARE + (1.0 - TRAINING_SHARE) * part, text),
    )  # fmt: skip

    def figures(row: str, name: str, k: int) -> dict[str, Any]:
        pairs = zip(jobs, results, strict=True)
        return _figures([trial for job, trial in pairs if (job.row, job.target, job.plant) == (row, name, k)])

    body = load_vehicle(vehicle)
    result = {
        "experiment": "anatomy", "vehicle": {"name": body.name, "sha256": body.sha256}, "trials": trials,
        "seeds": list(run_seeds), "rows": {name: T1.rows[name].title for name in names},
        "causes": {
            name: {
                "title": CAUSES[name].title, "unit": CAUSES[name].unit, "amounts": list(CAUSES[name].amounts),
                "rows": {
                    row: [figures(row, name, k) for k in range(len(CAUSES[name].amounts))] for row in names
                },
            }
            for name in chosen
        },
        FOREIGN: {row: figures(row, FOREIGN, 0) for row in names},
        "provenance": provenance(),
    }  # fmt: skip
    write_json(folder / "anatomy.json", result, tables_of(result))
    draw(result, folder / "anatomy.png")
    return result


def _figures(results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return success, median error and mean settling time over all trials, with intervals from redrawn trials."""
    out: dict[str, Any] = {}
    for key, statistic in (("success", np.mean), ("e_p_m", np.median), ("t_s_s", np.mean)):
        values = (trial[key] for result in results for trial in result["per_trial"] if trial[key] is not None)
        out[key] = with_interval({i: [float(x)] for i, x in enumerate(values)}, statistic)
    return out


def tolerated(cause: Mapping[str, Any], row: str) -> float | None:
    """Return the amount up to which a row holds `HELD` of its trials at every amount; None if not even at 0.

    It has the unit of the cause.
    """
    largest = None
    for amount, figures in zip(cause["amounts"], cause["rows"][row], strict=True):
        if figures["success"]["value"] < HELD:
            break
        largest = float(amount)
    return largest


def tables_of(result: Mapping[str, Any]) -> list[Table]:
    """Return a table of the amounts that each row tolerates, and one of the plant with all errors."""
    rows, vehicle = result["rows"], result["vehicle"]
    about = f"{vehicle['name']} {vehicle['sha256'][:12]}, seeds: {len(result['seeds'])}, setpoints in turn"
    lines = []
    for cause in result["causes"].values():
        limits = [tolerated(cause, row) for row in rows]
        amounts = ["none" if x is None else f"{x:g}{'+' * (x == cause['amounts'][-1])}" for x in limits]
        lines.append([f"{cause['title']} [{cause['unit']}]", *amounts])
    return [
        Table(
            title="Tolerated errors (T1)", headline=f"T1 with one wrong parameter, {about}",
            heads=["wrong", *rows], rows=lines,
            note=f"the largest amount at which {100.0 * HELD:.0f} % of the trials hold, there and at all smaller ones; "
            "+: the largest that was tested. All other parameters are those of the file, and the state is exact.",
        ),
        Table(
            title="All parameters wrong", headline=f"T1 in the plant '{FOREIGN}', another in each trial, {about}",
            heads=["", *(heading for heading, *_ in FIGURES.values())],
            rows=[[title, *cells(result[FOREIGN][row], FIGURES)] for row, title in rows.items()],
            note="in brackets 95 % from a bootstrap of the trials of these trainings; times to settle are of those "
            "that hold.",
        ),
    ]  # fmt: skip


def draw(result: Mapping[str, Any], path: Path) -> None:
    """Draw error over amount, a panel for each cause and a line for each row; hollow where too few trials hold."""
    causes, rows = result["causes"], result["rows"]
    across = min(4, len(causes))
    down = math.ceil(len(causes) / across)
    heading = (
        f"median error with one wrong parameter; hollow: fewer than {100.0 * HELD:.0f} % of the trials hold"
    )
    figure = new_figure(3.0 * across, 2.3 * down + 0.9, heading)
    panels = figure.subplots(down, across, squeeze=False, sharey=True).ravel()
    for axes, cause in zip(panels, causes.values(), strict=False):
        for i, (row, title) in enumerate(rows.items()):
            figures, color = cause["rows"][row], COLORS[i % len(COLORS)]
            errors = [
                max(1000.0 * figure_["e_p_m"]["value"], LEAST) if figure_["e_p_m"] else math.nan
                for figure_ in figures
            ]
            dash = "-" if i < len(COLORS) else "--"
            axes.plot(cause["amounts"], errors, dash, linewidth=1.3, color=color, label=title)
            for amount, error, figure_ in zip(cause["amounts"], errors, figures, strict=True):
                inside = color if figure_["success"]["value"] >= HELD else "white"
                axes.plot(amount, error, "o", markersize=4, color=color, markerfacecolor=inside)
        axes.set_xlabel(f"{cause['title']} [{cause['unit']}]", fontsize=8)
        axes.set_yscale("log")
        clean(axes)
    for axes in panels[len(causes) :]:
        axes.set_axis_off()
    for axes in panels[::across]:
        axes.set_ylabel("e_p [mm]", fontsize=8)
    legend_below(figure, panels[0], 4)
    save_figure(figure, path)


if __name__ == "__main__":
    run_script("studies.anatomy:anatomy")
