"""`finssim experiment ablation`: what each module is worth, by trials that differ in it alone."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from finssim.experiments.running import Say, run_experiment
from finssim.experiments.transfer.experiment import transfer_experiment
from finssim.experiments.transfer.spec import Spec
from finssim.experiments.transfer.t1 import T1
from finssim.experiments.transfer.t2 import T2
from finssim.experiments.transfer.table import OURS, THEIRS, Shown, markdown_of, print_shown, where, with_ci
from finssim.files import atomic_write

__all__ = ["SPECS", "ablation", "ablation_tables", "run"]

SPECS: Mapping[str, Spec] = {"t1": T1, "t2": T2}
"""The experiments that an ablation is made of, in its order."""

UNITS = {
    "success_rate": ("held [points]", ".0f", 100.0),
    "e_p_m": ("e_p [cm]", ".1f", 100.0),
    "e_psi_deg": ("e_psi [°]", ".1f", 1.0),
    "horizontal_rmse_m": ("horizontal [cm]", ".1f", 100.0),
    "vertical_rmse_m": ("vertical [cm]", ".1f", 100.0),
    "p95_m": ("P95 [cm]", ".1f", 100.0),
}
"""Key of a difference -> heading, format, factor."""

NOTE = (
    "Each figure is the mean of row less reference, over pairs of trials with the same pool, seed and target; in "
    "brackets 95 % from a bootstrap of plants and seeds. paper: the difference of its rows, on hardware, single runs."
)


def run(
    *, out: Path, as_json: bool = False, console: Console | None = None, **options: Any
) -> dict[str, Any]:
    """Run the ablation with a progress bar, print its tables (or one JSON object) and write the directory.

    Arguments as `ablation`; console is where the tables go, standard output if None.
    """

    def show(result: Mapping[str, Any], screen: Console) -> None:
        for shown in ablation_tables(result):
            print_shown(shown, screen)

    return run_experiment(
        "experiment ablation",
        lambda say: ablation(out=out, say=say, **options),
        show,
        out=out,
        as_json=as_json,
        console=console,
    )


def ablation(*, out: Path, say: Say = lambda part, what: None, **options: Any) -> dict[str, Any]:
    """Play both experiments, or go on with them where their folders lie in `out`, and compare their rows.

    Args:
        out: Directory for `ablation.json`, `ablation.md` and the folders `t1` and `t2`.
        say: Told the share that is done and what comes next.
        options: As of `transfer_experiment`.

    Returns:
        Experiment -> its result, without the single trials.
    """
    found = {}
    for k, (name, spec) in enumerate(SPECS.items()):
        result = transfer_experiment(
            spec,
            out=Path(out) / name,
            say=lambda part, what, k=k, name=name: say((k + part) / len(SPECS), f"{name}: {what}"),
            **options,
        )
        found[name] = {key: value for key, value in result.items() if key != "trials"}
    with atomic_write(Path(out) / "ablation.json") as temporary:
        temporary.write_text(json.dumps(found, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    with atomic_write(Path(out) / "ablation.md") as temporary:
        temporary.write_text("\n".join(map(markdown_of, ablation_tables(found))), encoding="utf-8")
    return found


def ablation_tables(found: Mapping[str, Any]) -> list[Shown]:
    """One table of differences for each experiment."""
    return [_table(SPECS[name], result) for name, result in found.items()]


def _table(spec: Spec, result: Mapping[str, Any]) -> Shown:
    rows: list[tuple[list[str], str]] = []
    for name, differences in result["differences"].items():
        cells = [_difference(differences[key], key) for key in spec.differences]
        rows.append(([spec.rows[name].title, *cells], OURS))
        theirs = spec.paper_differences(spec.rows[name].paper, spec.rows[spec.base].paper)
        if theirs is not None:
            cells = [f"{UNITS[key][2] * theirs[key]:+{UNITS[key][1]}}" for key in spec.differences]
            rows.append((["  paper", *cells], THEIRS))
    return Shown(
        title=f"Ablation, {spec.name.upper()}: differences from {spec.rows[spec.base].title}",
        headline=f"{spec.name.upper()} {where(result, 'targets')}",
        heads=["", *(UNITS[key][0] for key in spec.differences)],
        rows=rows,
        note=NOTE,
        sentences=result["sentences"],
    )


def _difference(figure: Mapping[str, Any] | None, key: str) -> str:
    _, form, factor = UNITS[key]
    return with_ci(figure, f"+{form}", factor)
