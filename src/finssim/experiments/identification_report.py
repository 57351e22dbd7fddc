"""The first section of the demonstration's report: what the trials told, and how the result replays others."""

from __future__ import annotations

from html import escape

from finssim.calibration.output.calibrate import number_in
from finssim.calibration.output.fit_output import interval_text, number_text, state_text
from finssim.experiments.identify import Identification
from finssim.page import html_picture, html_table

__all__ = ["identification_section"]

HEADS = ("parameter", "estimate", "95 % interval", "in the plant", "unit", "state")


def identification_section(found: Identification) -> list[str]:
    """HTML of the section."""
    fit = found.fit
    rows = [
        f'<tr class="{"" if e.identifiable else "doubt"}">'
        + "".join(
            f"<td>{escape(cell)}</td>"
            for cell in (
                name,
                number_text(e.estimate),
                interval_text(e),
                number_text(number_in(found.truth, e.path)),
                e.unit,
                state_text(e, fit, found.vehicle),
            )
        )
        + "</tr>"
        for name, e in fit.estimates.items()
        if e.path is not None and e.path.startswith("hydrodynamics.")
    ]
    return [
        "<h2>Identification</h2>",
        f"<p>{escape(_lead(found))}</p>",
        html_table(HEADS, rows),
        '<p class="note">'
        "unsure: told together with another number and not alone, as a part of the drag. file kept: the trials do not "
        "determine the number, and the vehicle keeps its guess. The plant is the vehicle "
        "of the catalogue, with sensor noise on everything measured; a real pool would not tell its numbers."
        "</p>",
        *(f'<p class="note">{escape(warning)}</p>' for warning in found.warnings),
        html_picture(found.picture, "Held-out trials: measured and replayed by the identified vehicle"),
    ]


def _lead(found: Identification) -> str:
    score = found.replay.aggregate(found.replay.models[0])
    value = "unknown" if score.value is None else f"{score.value:.3f}"
    return (
        f"Identified in {found.seconds:.0f} s from {len(found.fit.trials)} trials, beginning with guessed "
        f"hydrodynamics. {len(found.replay.pairs)} other trials, at levels that the fit has not seen, are replayed "
        f"with an NRMSE of {value}. What follows was trained and tuned in the identified vehicle, and tried in the "
        "plant that the trials came from."
    )
