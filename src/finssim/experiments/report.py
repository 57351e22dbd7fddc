"""The demonstration's report: one HTML file that holds its pictures and loads nothing."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from matplotlib.figure import Figure

from finssim.experiments.envelope import draw_envelopes, error_envelope
from finssim.experiments.evaluate import Evaluation
from finssim.experiments.figures import draw_paths, draw_training_curve
from finssim.experiments.metrics import summarize
from finssim.experiments.paper_results import PAPER_T1, paper_row
from finssim.experiments.results_table import CAPTION, COLUMNS, cells
from finssim.page import html_page, html_picture, html_table

__all__ = ["report_html"]

NOTE = (
    "e_y is the vertical error. Gray rows are the paper's own, on hardware: its real vehicle in its pool. The others "
    "are of "
)
POOL = (
    "the virtual pool: the robot's whole software, from the camera's tags to the motor controller's frames, "
    "against a plant that no training has seen. Errors are those of the true pose."
)
ROBOT = "hardware, too. Errors are those of the robot's own estimate, whose error is not in them."


def report_html(
    evaluations: Sequence[Evaluation],
    curves: Sequence[Mapping[str, Any]],
    training: Mapping[str, Any],
    commands: Sequence[str],
    first: Sequence[str] = (),
    picture: bytes | None = None,
) -> str:
    """The report.

    Args:
        evaluations: The policy first, then what it is compared with, all on the same trials.
        curves: Rows of the policy's `curves.csv`.
        training: `seconds` (of the training), `seed`, `steps`.
        commands: That repeat it by hand.
        first: HTML of what comes before the results.
        picture: PNG of what the camera saw; none if None.
    """
    policy = evaluations[0]
    result = policy.result
    compared = [e for e in evaluations if e.result["trials"] == result["trials"]]
    envelopes = {e.label: error_envelope(_series(e)) for e in compared}
    sections = [
        f"<h1>{escape(_title(result))}</h1>",
        f'<p class="lead">{_lead(compared, training)}</p>',
        *first,
        "<h2>Results</h2>",
        _comparison(evaluations),
        f'<p class="note">{escape(CAPTION)} {NOTE}{ROBOT if _hardware(result) else POOL}</p>',
        "<h2>Error against time</h2>",
        _picture(draw_envelopes(envelopes), "Position and yaw error against time, median and middle half"),
        "<h2>Paths of the policy</h2>",
        _picture(draw_paths(policy.trials), "Paths of the eight trials from above and from the side"),
        *_view(picture),
        "<h2>Training</h2>",
        _picture(draw_training_curve(curves), "Mean return and share of episodes held while training"),
        "<h2>Every setpoint</h2>",
        *(_per_setpoint(e) for e in evaluations),
        "<h2>How to repeat it</h2>",
        f"<pre>{escape(chr(10).join(commands))}</pre>",
        "<h2>Provenance</h2>",
        f"<pre>{escape(json.dumps(_provenance(result, training), indent=2))}</pre>",
    ]
    return html_page(_title(result), sections)


def _hardware(result: Mapping[str, Any]) -> bool:
    return bool(result["plant"]["name"] == "hardware")


def _title(result: Mapping[str, Any]) -> str:
    return f"Station keeping of {result['vehicle']['name']}"


def _lead(evaluations: Sequence[Evaluation], training: Mapping[str, Any]) -> str:
    r = evaluations[0].result
    errors = ""
    if r["e_p_m"] is not None:
        errors = f", with {100.0 * r['e_p_m']:.1f} cm and {r['e_psi_deg']:.1f}° of error once settled"
    place = "on hardware" if _hardware(r) else "in the virtual pool"
    others = " and ".join(f"{e.label} {e.result['success']}" for e in evaluations[1:])
    return escape(
        f"A policy trained here in {training['seconds']:.0f} s, from nothing to a file that runs on the vehicle, holds "
        f"{r['success']} of {r['trials']} published setpoints {place}{errors}. On the same trials, "
        f"successes: {others}."
    )


def _comparison(evaluations: Sequence[Evaluation]) -> str:
    rows = [_row(e.label, e.result) for e in evaluations]
    for i, name in enumerate(PAPER_T1):
        if name in ("calibrated", "calibrated + DR", "PID"):
            kind = "theirs first" if i == 0 else "theirs"
            rows.append(_row(f"paper: {name}", paper_row(name), kind))
    return _table("controller", rows)


def _per_setpoint(evaluation: Evaluation) -> str:
    trials = evaluation.result["per_trial"]
    names = sorted({trial["setpoint"] for trial in trials})
    rows = [_row(name, summarize([t for t in trials if t["setpoint"] == name])) for name in names]
    return _table(evaluation.label, rows)


def _table(first: str, rows: Sequence[str]) -> str:
    return html_table((first, *COLUMNS.values()), rows)


def _row(name: str, row: Mapping[str, Any], kind: str = "") -> str:
    return f'<tr class="{kind}">' + "".join(f"<td>{escape(c)}</td>" for c in (name, *cells(row))) + "</tr>"


def _series(evaluation: Evaluation) -> list[Any]:
    return [evaluation.trials.series(i) for i in range(len(evaluation.trials.setpoints))]


def _picture(figure: Figure, text: str) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150)
    return html_picture(buffer.getvalue(), text)


def _view(picture: bytes | None) -> list[str]:
    """What the camera saw."""
    if picture is None:
        return []
    note = "Drawn again from the true pose of a trial of the policy with pictures, by that trial's camera and water."
    return [
        "<h2>What the camera sees</h2>",
        html_picture(picture, "A picture of the overhead camera with the tags found in it"),
        f'<p class="note">{note}</p>',
    ]


def _provenance(result: Mapping[str, Any], training: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "vehicle": result["vehicle"],
        "hydrodynamics": result["hydrodynamics"],
        "training seed": training["seed"],
        "evaluation seed": result["seed"],
        "policy": result["controller"].get("files", {}),
        **result["provenance"],
    }
