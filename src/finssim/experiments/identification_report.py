"""The first section of the demonstration's report: what the trials told, and how the result replays others."""

from __future__ import annotations

from html import escape

from finssim.calibration.output.calibrate import number_in
from finssim.calibration.output.fit_output import interval_text, number_text, state_text
from finssim.experiments.identify import Identification
from finssim.page import html_picture, html_table

__all__ = ["identification_section"]

HEADS = ("parameter", "estimate", "95 % interval", "catalogue", "unit", "state")
STEPS = ("axis", "push", "identified", "in the plant", "ratio", "time constant", "in the plant")

UNSURE = (
    "unsure: told together with another number and not alone, as a part of the drag. file kept: the trials do not "
    "determine the number, and the vehicle keeps its guess."
)
POOL = (
    " The catalogue's vehicle is the one around which the pool drew its own: the plant's coefficients are known to the "
    "pool alone. Its propellers push up to 15 % more or less than the bench said, so what is found are effective "
    "masses and dampings: those of the thrust that the vehicle file promises."
)


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
        f'<p class="note">{UNSURE}{POOL if found.steps else ""}</p>',
        *_steps(found),
        *(f'<p class="note">{escape(warning)}</p>' for warning in found.warnings),
        html_picture(found.picture, "Held-out trials: measured and replayed by the identified vehicle"),
    ]


def _lead(found: Identification) -> str:
    score = found.replay.aggregate(found.replay.models[0])
    value = "unknown" if score.value is None else f"{score.value:.3f}"
    source, same = (
        ("the virtual pool", "in the same pool") if found.steps else ("a robot", "on the same robot")
    )
    return (
        f"Identified in {found.seconds:.0f} s from {len(found.fit.trials)} trials of {source}, beginning with "
        "guessed hydrodynamics: the robot's own software played each programme, and its record became a trial. "
        f"{len(found.replay.pairs)} other trials, at levels that the fit has not seen, are replayed with an NRMSE of "
        f"{value}. What follows was trained and tuned in the identified vehicle, and tried {same}."
    )


def _steps(found: Identification) -> list[str]:
    """How fast the identified vehicle gets, beside the plant."""
    if not found.steps:
        return []
    rows = []
    for step in found.steps:
        linear = step["axis"] in ("surge", "sway", "heave")
        unit, push = ("m/s", "N") if linear else ("rad/s", "N m")
        model, plant = float(step["model_speed"]), float(step["plant_speed"])
        cells = [
            str(step["axis"]),
            f"{step['level']:g} {push}",
            f"{model:.3f} {unit}",
            f"{plant:.3f} {unit}",
            f"{model / plant:.2f}" if plant else "–",
            f"{step['model_time_constant']:.2f} s",
            f"{step['plant_time_constant']:.2f} s",
        ]
        rows.append("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>")
    return [
        "<h3>Terminal speeds</h3>",
        html_table(STEPS, rows),
        '<p class="note">On rails, in water at rest, mean of both directions: what the coefficients come to. Only this '
        "comparison opens the plant.</p>",
    ]
