"""`finssim experiment ablation` and `all`: what each module is worth, and every table of the paper beside ours."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from html import escape
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console

from finssim.experiments import localization_experiment as localization
from finssim.experiments import replay_experiment as replay
from finssim.experiments.campaign import ResultError, Say, write_json
from finssim.experiments.tables import Shown, figure_text, html_of, html_row, markdown_of, print_shown
from finssim.experiments.transfer import MEASURES, T1, T2, Spec, played_in, transfer_experiment
from finssim.files import atomic_write
from finssim.page import html_page, html_picture, html_table
from finssim.provenance import provenance
from finssim.yaml_file import read_json

__all__ = ["ablation", "everything", "print_ablation", "print_everything"]

SPECS: Mapping[str, Spec] = {"t1": T1, "t2": T2}
"""The experiments that an ablation is made of, in its order."""

NOTE = (
    "Each figure is the mean of row less reference, over pairs of trials with the same pool, seed and target; in "
    "brackets 95 % from a bootstrap of plants and seeds. paper: the difference of its rows, on hardware, single runs."
)
LEAD = (
    "Rows in gray are the paper's own, measured on its real vehicle in its pool. All others are measured here: "
    "localization and replay by simulation, station keeping and tracking in a virtual pool whose vehicle, water and "
    "camera differ from everything that was trained or calibrated with. One is never passed for the other."
)
FIGURES = {
    "Error map of localization": "localization/error_map.png",
    "Replay: measured and replayed responses": "replay/envelope.png",
    "Station keeping: error against time": "t1/t1_envelopes.png",
    "Trajectory tracking: paths from above": "t2/t2_paths.png",
}
"""Words -> picture in the folder; one that an experiment did not draw is left out."""
REPORT_FILE = "report.html"


def ablation(
    *,
    out: Path,
    plants: Annotated[int, (1, 1000)] = 3,
    seeds: Annotated[int, (1, 1000)] = 3,
    seed: int = 1,
    severity: str = "realistic",
    camera: str = "corners",
    vehicle: str = "finsrov",
    steps: Annotated[int | None, (1, None)] = None,
    processes: Annotated[int | None, (1, None)] = None,
    say: Say = lambda part, what: None,
) -> dict[str, Any]:
    """What each module is worth: differences of paired trials with intervals, and a sentence that they support.

    Example: finssim experiment ablation --seeds 3 --out ablation

    Args:
        out (DIR): Directory for JSON, Markdown, figures, policies and trials; one that was interrupted goes on.
        plants: Virtual pools, each with its own vehicle, water and camera.
        seeds: Trainings of each policy, each tried with its own noise.
        seed: Seed of every random number; equal seeds give equal results.
        severity (WORD): How far the pools are from the vehicle file: nominal, realistic or hard.
        camera (MODE): corners (projected through the rippling water, with noise), or pictures (drawn, and searched for
            tags: several times slower).
        vehicle (NAME|FILE): Vehicle of the catalogue, or the path of a vehicle file.
        steps: Control steps to learn from, all worlds together; what the task needs if not given.
        processes: Trials at once; as many as processors if not given.
        say: Told the share that is done and what comes next.

    Returns:
        Experiment -> its result, without the single trials.
    """
    options = {name: value for name, value in locals().items() if name not in ("out", "say")}
    results = {}
    for k, (name, spec) in enumerate(SPECS.items()):
        result = transfer_experiment(
            spec,
            out=Path(out) / name,
            say=lambda part, what, k=k, name=name: say((k + part) / len(SPECS), f"{name}: {what}"),
            **options,
        )
        results[name] = {key: value for key, value in result.items() if key != "trials"}
    page = "\n".join(map(markdown_of, ablation_tables(results)))
    write_json(Path(out) / "ablation.json", results, page)
    return results


def print_ablation(results: Mapping[str, Any], console: Console) -> None:
    """Print its tables."""
    for shown in ablation_tables(results):
        print_shown(shown, console)


def ablation_tables(results: Mapping[str, Any]) -> list[Shown]:
    """One table of differences for each experiment."""
    return [_table(SPECS[name], result) for name, result in results.items() if name in SPECS]


def _table(spec: Spec, result: Mapping[str, Any]) -> Shown:
    rows = []
    units = {key: MEASURES[key] for key in spec.differences}
    for name, differences in result["differences"].items():
        row = spec.rows[name]
        rows.append(
            [row.title, *(figure_text(differences[key], f"+{u[4]}", u[2]) for key, u in units.items())]
        )
        theirs = spec.paper_differences(row)
        if theirs is not None:
            rows.append(["  paper", *(f"{u[2] * theirs[key]:+{u[4]}}" for key, u in units.items())])
    return Shown(
        title=f"Ablation, {spec.name.upper()}: differences from {spec.rows[spec.base].title}",
        headline=f"{spec.name.upper()} {played_in(result, 'targets')}",
        heads=["", *(heading for _, heading, *_ in units.values())],
        rows=rows,
        note=NOTE,
        sentences=result["sentences"],
    )


def everything(
    *,
    out: Path,
    seeds: Annotated[int, (1, 1000)] = 3,
    seed: int = 1,
    vehicle: Annotated[str, "python"] = "finsrov",
    say: Say = lambda part, what: None,
    **options: Any,
) -> dict[str, Any]:
    """Run localization, replay, t1, t2 and ablation, and write one report with the paper's figures beside ours.

    Example: finssim experiment all --seeds 1 --plants 1 --out everything

    Args:
        out (DIR): Directory for JSON, Markdown, figures, policies and trials; one that was interrupted goes on.
        seeds: Trainings of each policy, each tried with its own noise.
        seed: Seed of every random number; equal seeds give equal results.
        vehicle: Of station keeping and tracking: the other two are of the published one.
        say: Told the share that is done and what comes next.
        options: As of `experiments.ablation.ablation`.

    Returns:
        Experiment -> what its JSON file holds, without single trials; `report`: its path.
    """
    options |= {"seeds": seeds, "seed": seed, "vehicle": vehicle}
    out = Path(out)

    def once(name: str, file: str, work: Callable[..., Any], begun: float) -> dict[str, Any]:
        """What a file holds; where it is not there yet, the work is done that writes it."""
        folder = out / name
        if not (folder / file).is_file():
            work(
                seeds=seeds,
                out=folder,
                seed=seed,
                say=lambda part, what: say(begun + 0.1 * part, f"{name}: {what}"),
            )
        return read_json(folder / file, ResultError, such_as="provenance")

    results = {
        "localization": once(
            "localization", localization.RESULT_FILE, localization.localization_experiment, 0.0
        ),
        "replay": once("replay", replay.RESULT_FILE, replay.replay_experiment, 0.1),
        **ablation(out=out, say=lambda part, what: say(0.2 + 0.8 * part, what), **options),
    }
    with atomic_write(out / REPORT_FILE) as temporary:
        temporary.write_text(_report(results, out), encoding="utf-8")
    return {**results, "report": str(out / REPORT_FILE)}


def print_everything(results: Mapping[str, Any], console: Console) -> None:
    """Print the tables of both experiments."""
    for name, spec in SPECS.items():
        print_shown(spec.shown(results[name]), console)
    console.print(f"report: {results['report']}", highlight=False, soft_wrap=True)


def _report(results: Mapping[str, Any], out: Path) -> str:
    sections = ["<h1>FinsSim beside the paper</h1>", f'<p class="lead">{escape(LEAD)}</p>']
    for title, tables in (
        ("Localization", localization.tables_of(results["localization"])),
        ("Replay", replay.tables_of(results["replay"])),
    ):
        for words, (heads, rows) in tables.items():
            sections += [f"<h2>{title}. {escape(words)}</h2>", html_table(heads, list(map(html_row, rows)))]
    sections += [html_of(spec.shown(results[name])) for name, spec in SPECS.items()]
    sections += [html_of(shown) for shown in ablation_tables(results)]
    for words, name in FIGURES.items():
        if (out / name).is_file():
            sections += [f"<h2>{escape(words)}</h2>", html_picture((out / name).read_bytes(), words)]
    sections += ["<h2>Provenance</h2>", f"<pre>{escape(json.dumps(provenance(), indent=2))}</pre>"]
    return html_page("FinsSim beside the paper", sections)
