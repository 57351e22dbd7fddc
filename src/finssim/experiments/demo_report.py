"""The demonstration's report: one HTML file that holds its pictures and loads nothing."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from finssim.calibration.output.calibrate import number_in
from finssim.calibration.output.fit_output import interval_text, number_text, state_text
from finssim.engine import Pool
from finssim.experiments.evaluate import CAPTION, T1_COLUMNS, Evaluation, by_setpoint, cells
from finssim.experiments.figures import (
    COLORS,
    clean,
    draw_envelopes,
    error_envelope,
    legend_below,
    new_figure,
    png,
)
from finssim.experiments.identify import Identification
from finssim.experiments.paper import paper_row
from finssim.experiments.pool_trial import Job, read_series
from finssim.experiments.tables import html_row
from finssim.experiments.trials import Trials
from finssim.localization.detection.detector import detector
from finssim.page import html_page, html_picture, html_table
from finssim.pool.camera import PoolCamera
from finssim.pool.exposures import Exposure
from finssim.pool.site import camera_of
from finssim.vehicles import load_vehicle

__all__ = ["camera_view", "report_html"]

ZOOM = 110
"""Half the width of the part of a picture that is shown larger [px]."""
BLUE, ORANGE = COLORS[:2]
ARROW = 0.18
"""Length of an arrow that shows a heading [m]."""

HEADS = ("parameter", "estimate", "95 % interval", "catalogue", "unit", "state")
STEPS = ("axis", "push", "identified", "in the plant", "ratio", "time constant", "in the plant")
UNSURE = (
    "unsure: told together with another number and not alone, as a part of the drag. file kept: the trials do not "
    "determine the number, and the vehicle keeps its guess."
)
POOL_VEHICLE = (
    " The catalogue's vehicle is the one around which the pool drew its own: the plant's coefficients are known to the "
    "pool alone. Its propellers push up to 15 % more or less than the bench said, so what is found are effective "
    "masses and dampings: those of the thrust that the vehicle file promises."
)
RAILS = (
    "On rails, in water at rest, mean of both directions: what the coefficients come to. Only this comparison opens "
    "the plant."
)
VIEW = (
    "Drawn again from the true pose of a trial of the policy with pictures, by that trial's camera and water."
)
PAPER = (
    "e_y is the vertical error. Gray rows are the paper's own, on hardware: its real vehicle in its pool. The others "
    "are of "
)
POOL = (
    "the virtual pool: the robot's whole software, from the camera's tags to the motor controller's frames, "
    "against a plant that no training has seen. Errors are those of the true pose."
)
ROBOT = "hardware, too. Errors are those of the robot's own estimate, whose error is not in them."


def camera_view(job: Job, series: Path, at: float, seed: int) -> bytes:
    """What the camera of a pool saw at one moment, drawn anew from the pose that the vehicle truly had.

    Args:
        job: The trial.
        series: As `run_jobs` left it, without its suffix.
        at: Time since its start [s].
        seed: Of ripples and noise.

    Returns:
        PNG: the whole picture, and the vehicle in it with the outlines of the tags that were found.
    """
    standing = load_vehicle(job.pool_vehicle)
    site, _, settings = camera_of(standing, job.plant, job.severity)  # type: ignore[arg-type]
    camera = PoolCamera(standing, site, mode="pictures", settings=settings, seed=seed)
    motion = read_series(series)
    k = int(np.argmin(np.abs(motion["t"] - at)))
    pose = motion["position"][k], motion["quaternion"][k]
    picture = camera.develop(Exposure(0, at, at + settings.latency, pose, pose))
    assert picture.image is not None and standing.tags is not None
    found = [d for d in detector(standing.tags.family).detect(picture.image) if d.tag in standing.tags.mounts]
    return _drawn(picture.image, found)


def _drawn(image: Any, detections: Sequence[Any]) -> bytes:
    figure = new_figure(9.0, 3.4, layout="compressed")
    whole, close = figure.subplots(1, 2, width_ratios=(16, 9))
    corners = [np.asarray(d.corners, float) for d in detections]
    for axes in (whole, close):
        axes.imshow(image, cmap="gray", vmin=0, vmax=255)
        axes.set_axis_off()
        for tag in corners:
            axes.plot(*np.vstack([tag, tag[:1]]).T, color=ORANGE, linewidth=1.4)
    whole.set_title("the overhead camera's picture", fontsize=9)
    close.set_title(f"tags found: {', '.join(str(d.tag) for d in detections) or 'none'}", fontsize=9)
    if corners:
        x, y = np.concatenate(corners).mean(axis=0)
        close.set(xlim=(x - ZOOM, x + ZOOM), ylim=(y + ZOOM, y - ZOOM))
    return png(figure)


def _training_curve(curves: Sequence[Mapping[str, Any]]) -> bytes:
    """Mean return and share of episodes held, against control steps and wall time, of rows of `curves.csv`."""
    figure = new_figure(7.2, 3.0)
    axes = figure.subplots()
    # Episodes last as long as several updates: before the first ends there is no return to show.
    rows = [row for row in curves if row["mean_length"] > 0.0]
    steps = np.array([row["steps"] for row in rows]) / 1e6
    share = axes.twinx()
    axes.plot(steps, [row["mean_return"] for row in rows], color=BLUE, linewidth=1.6)
    share.plot(steps, [100.0 * row["held"] for row in rows], color=ORANGE, linewidth=1.6)
    clean(axes)
    axes.set_xlabel("control steps, all worlds [million]")
    axes.set_ylabel("mean return of an episode", color=BLUE)
    share.set_ylabel("episodes held [%]", color=ORANGE)
    share.set_ylim(-3.0, 103.0)
    share.spines[["top"]].set_visible(False)
    if rows:
        last = rows[-1]
        axes.set_title(f"{last['steps'] / 1e6:.1f} million steps in {last['seconds']:.0f} s", fontsize=10)
    return png(figure)


def _paths(trials: Trials) -> bytes:
    """The paths of all trials from above and from the side, in the pool; start and goals with their headings."""
    pool = Pool()
    figure = new_figure(7.2, 6.0, layout="compressed")
    panels = figure.subplots(2, 1, sharex=True, height_ratios=(pool.width, pool.depth))
    spans = ((1, -pool.width / 2, pool.width), (2, -pool.depth, pool.depth))
    for axes, (vertical, low, height) in zip(panels, spans, strict=True):
        axes.fill_between([-pool.length / 2, pool.length / 2], low, low + height, color="#eaf3f8")
        axes.plot(trials.position[..., 0], trials.position[..., vertical], color=BLUE, linewidth=1.2)
        goals = trials.goals[:, [0, vertical]].T
        axes.plot(*goals, "o", mfc="none", mec=ORANGE, ms=9, label="goal")
        axes.plot(*trials.position[0, 0, [0, vertical]], "s", color="0.2", ms=5, label="start")
        axes.set(aspect="equal", ylim=(low - 0.05, low + height + 0.05))
        axes.spines[["top", "right"]].set_visible(False)
    above, side = panels
    for x, y, _, yaw in trials.goals:
        tip = (x + ARROW * np.cos(yaw), y + ARROW * np.sin(yaw))
        above.annotate("", tip, (x, y), arrowprops={"arrowstyle": "->", "color": ORANGE})
    above.set_ylabel("y, left [m]")
    side.set(ylabel="z, up [m]", xlabel="x, forward [m]")
    legend_below(figure, above, 2)
    return png(figure)


def _identification(found: Identification) -> list[str]:
    """What the trials told, and how the result replays others."""
    score = found.replay.aggregate(found.replay.models[0]).value
    source, same = (
        ("the virtual pool", "in the same pool") if found.steps else ("a robot", "on the same robot")
    )
    lead = (
        f"Identified in {found.seconds:.0f} s from {len(found.fit.trials)} trials of {source}, beginning with "
        "guessed hydrodynamics: the robot's own software played each programme, and its record became a trial. "
        f"{len(found.replay.pairs)} other trials, at levels that the fit has not seen, are replayed with an NRMSE of "
        f"{'unknown' if score is None else f'{score:.3f}'}. What follows was trained and tuned in the identified "
        f"vehicle, and tried {same}."
    )
    rows = [
        html_row(
            [
                name,
                number_text(e.estimate),
                interval_text(e),
                number_text(number_in(found.truth, e.path)),
                e.unit,
                state_text(e, found.fit, found.vehicle),
            ],
            "" if e.identifiable else "doubt",
        )
        for name, e in found.fit.estimates.items()
        if e.path is not None and e.path.startswith("hydrodynamics.")
    ]
    return [
        "<h2>Identification</h2>",
        f"<p>{escape(lead)}</p>",
        html_table(HEADS, rows),
        _note(UNSURE + (POOL_VEHICLE if found.steps else "")),
        *_terminal_speeds(found),
        *map(_note, found.warnings),
        html_picture(found.picture, "Held-out trials: measured and replayed by the identified vehicle"),
    ]


def _terminal_speeds(found: Identification) -> list[str]:
    """How fast the identified vehicle gets, beside the plant."""
    rows = []
    for step in found.steps:
        unit, push = ("m/s", "N") if step["axis"] in ("surge", "sway", "heave") else ("rad/s", "N m")
        model, plant = float(step["model_speed"]), float(step["plant_speed"])
        rows.append(
            html_row(
                [
                    str(step["axis"]),
                    f"{step['level']:g} {push}",
                    f"{model:.3f} {unit}",
                    f"{plant:.3f} {unit}",
                    f"{model / plant:.2f}" if plant else "–",
                    f"{step['model_time_constant']:.2f} s",
                    f"{step['plant_time_constant']:.2f} s",
                ]
            )
        )
    return ["<h3>Terminal speeds</h3>", html_table(STEPS, rows), _note(RAILS)] if rows else []


def report_html(
    evaluations: Sequence[Evaluation],
    curves: Sequence[Mapping[str, Any]],
    training: Mapping[str, Any],
    commands: Sequence[str],
    found: Identification,
    picture: bytes | None = None,
) -> str:
    """The report.

    Args:
        evaluations: The policy first, then what it is compared with, all on the same trials.
        curves: Rows of the policy's `curves.csv`.
        training: `seconds` (of the training), `seed`, `steps`.
        commands: That repeat it by hand.
        found: What the trials told.
        picture: PNG of what the camera saw; none if None.
    """
    policy = evaluations[0]
    result = policy.result
    hardware = result["plant"]["name"] == "hardware"
    compared = [e for e in evaluations if e.result["trials"] == result["trials"]]
    envelopes = {e.label: error_envelope(e.trials.all_series()) for e in compared}
    title = f"Station keeping of {result['vehicle']['name']}"
    rows = [html_row([e.label, *cells(e.result)]) for e in evaluations]
    for i, name in enumerate(("calibrated", "calibrated + DR", "PID")):
        rows.append(html_row([f"paper: {name}", *cells(paper_row(name))], "theirs" if i else "theirs first"))
    origin = {
        "vehicle": result["vehicle"],
        "hydrodynamics": result["hydrodynamics"],
        "training seed": training["seed"],
        "evaluation seed": result["seed"],
        "policy": result["controller"].get("files", {}),
        **result["provenance"],
    }
    sections = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="lead">{_lead(compared, training, hardware)}</p>',
        *_identification(found),
        "<h2>Results</h2>",
        _results("controller", rows),
        _note(f"{CAPTION} {PAPER}{ROBOT if hardware else POOL}"),
        "<h2>Error against time</h2>",
        html_picture(
            png(draw_envelopes(envelopes)), "Position and yaw error against time, median and middle half"
        ),
        "<h2>Paths of the policy</h2>",
        html_picture(_paths(policy.trials), "Paths of the eight trials from above and from the side"),
    ]
    if picture is not None:
        view = html_picture(picture, "A picture of the overhead camera with the tags found in it")
        sections += ["<h2>What the camera sees</h2>", view, _note(VIEW)]
    sections += [
        "<h2>Training</h2>",
        html_picture(_training_curve(curves), "Mean return and share of episodes held while training"),
        "<h2>Every setpoint</h2>",
    ]
    for e in evaluations:
        each = by_setpoint(e.result["per_trial"])
        sections.append(_results(e.label, [html_row([name, *cells(row)]) for name, row in each.items()]))
    sections += [
        "<h2>How to repeat it</h2>",
        f"<pre>{escape(chr(10).join(commands))}</pre>",
        "<h2>Provenance</h2>",
        f"<pre>{escape(json.dumps(origin, indent=2))}</pre>",
    ]
    return html_page(title, sections)


def _lead(evaluations: Sequence[Evaluation], training: Mapping[str, Any], hardware: bool) -> str:
    r = evaluations[0].result
    errors = ""
    if r["e_p_m"] is not None:
        errors = f", with {100.0 * r['e_p_m']:.1f} cm and {r['e_psi_deg']:.1f}° of error once settled"
    place = "on hardware" if hardware else "in the virtual pool"
    others = " and ".join(f"{e.label} {e.result['success']}" for e in evaluations[1:])
    return escape(
        f"A policy trained here in {training['seconds']:.0f} s, from nothing to a file that runs on the vehicle, holds "
        f"{r['success']} of {r['trials']} published setpoints {place}{errors}. On the same trials, "
        f"successes: {others}."
    )


def _results(first: str, rows: Sequence[str]) -> str:
    return html_table((first, *(heading for heading, _ in T1_COLUMNS.values())), rows)


def _note(text: str) -> str:
    return f'<p class="note">{escape(text)}</p>'
