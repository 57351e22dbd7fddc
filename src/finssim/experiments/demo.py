"""`finssim demo`: the whole loop on one machine, from a vehicle nobody measured to a policy in a pool."""

from __future__ import annotations

import csv
import json
import math
import shutil
import sys
import time
import webbrowser
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from html import escape
from os import environ
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from finssim.calibration.excitation.programmes import RATE, Programme, programmes, which_axes
from finssim.calibration.findings import sentences
from finssim.calibration.output.calibrate import number_in
from finssim.calibration.output.fit_output import interval_text, number_text, state_text
from finssim.calibration.trials.trial import Trial
from finssim.control.allocation import Allocator
from finssim.control.pid import AxisModel, axis_model
from finssim.control.policy import DESCRIPTION_FILE, Policy
from finssim.engine import Pool
from finssim.experiments.campaign import Say, run_jobs, write_json
from finssim.experiments.evaluate import CAPTION, T1_COLUMNS, Evaluation, by_setpoint, cells, print_comparison
from finssim.experiments.excitation import pool_trials, trials_on_robot
from finssim.experiments.figures import (
    COLORS,
    clean,
    draw_envelopes,
    error_envelope,
    legend_below,
    new_figure,
    png,
)
from finssim.experiments.identify import (
    HELD_OUT,
    TRIALS,
    Identification,
    commands,
    identify,
    vehicle_files,
)
from finssim.experiments.metrics import T1_SETPOINTS, paper_row
from finssim.experiments.on_robot import Attendant, OnRobot, kept_folder
from finssim.experiments.pool_trial import (
    HARDWARE,
    Job,
    play,
    pool_evaluation,
    pool_jobs,
    read_series,
    run_on_robot,
)
from finssim.experiments.tables import html_row
from finssim.experiments.transfer import finished
from finssim.experiments.trials import Trials
from finssim.files import atomic_directory
from finssim.learning.train import train
from finssim.localization.detection.detector import detector
from finssim.page import html_page, html_picture, html_table
from finssim.pool import PlantSpec, draw_plant
from finssim.pool.camera import PoolCamera, camera_of
from finssim.pool.plant import Plant
from finssim.pool.plant_spec import Basin, BuoyancyDrift, Circulation
from finssim.pool.positioning import Exposure
from finssim.quiet import start_warp
from finssim.vehicles import AXES, Vehicle, load_vehicle
from finssim.vehicles.capability import level_speed, terminal_speed
from finssim.vehicles.defaults import room

__all__ = ["camera_view", "demo", "report_html"]

SHARE = 0.9
"""Largest level, part of the wrench limit: the rest is for the controller that holds the other axes."""
BALLASTED = 0.25
"""Weight less buoyancy of a vehicle that floats well enough by itself [N]."""
STEADY = 0.8
"""Fastest surge and sway, part of `level_speed` [-]."""


def matched(levels: Mapping[str, Sequence[float]], vehicle: Vehicle) -> dict[str, list[float]]:
    """Levels that take a vehicle as fast as given ones take FinsROV, in its own lengths, and tilt it as far.

    A linear axis comes to FinsROV's terminal speed times the vehicle's `room`, yaw to FinsROV's rate, roll and pitch to
    FinsROV's angle at rest. Surge and sway stay slower where the vehicle's own righting moment would not hold it: see
    `level_speed`. Programmes then last as long and go as far, in a pool that is `room` times as large.

    Args:
        levels: Axis -> levels for FinsROV [N, N m].
        vehicle: Whose file gives damping, stiffness and limits; axes that it does not control are left out.

    Returns:
        Axis -> levels, to three digits and at most `SHARE` of the limit; FinsROV's own as they are.
    """
    published = load_vehicle("finsrov")
    if vehicle.name == published.name:
        return {axis: list(values) for axis, values in levels.items()}
    ours, theirs, size = axis_model(vehicle), axis_model(published), room(vehicle.body.size)
    found = {}
    for axis, values in levels.items():
        i = AXES.index(axis)  # type: ignore[arg-type]
        if axis not in vehicle.controlled_axes or not vehicle.wrench_limits[i] > 0.0:
            continue
        scale = size if i < 3 else 1.0
        if i < 2:  # all levels of the axis alike, so that those of different trials stay different
            fastest = size * _speed(theirs, i, float(published.wrench_limits[i]))
            scale *= min(1.0, STEADY * level_speed(vehicle, axis=i) / fastest)
        wanted = [_level(ours, theirs, i, scale, value) for value in values]
        most = SHARE * float(vehicle.wrench_limits[i])
        found[axis] = list(dict.fromkeys(float(f"{min(x, most):.3g}") for x in wanted))
    return found


def trimmed(programme: Programme, vehicle: Vehicle) -> Programme:
    """The programme with the vehicle's weight less its buoyancy carried by the thrusters, where it is not ballasted.

    A BlueROV2 that rises with 2 N is out of a shallow pool before its first step; the fit takes what acted.

    Args:
        programme: On any axis.
        vehicle: Whose weight and displaced volume are known.
    """
    net = vehicle.weight - vehicle.buoyancy
    if abs(net) < BALLASTED:
        return programme
    tau = programme.tau_desired.copy()
    tau[:, 2] += net
    return replace(programme, tau_desired=tau)


def _speed(model: AxisModel, i: int, level: float) -> float:
    return terminal_speed(float(model.linear_damping[i]), float(model.quadratic_damping[i]), level)


def _level(ours: AxisModel, theirs: AxisModel, i: int, scale: float, level: float) -> float:
    stiffness = float(ours.stiffness[i]), float(theirs.stiffness[i])
    if min(stiffness) > 0.0:
        return level * stiffness[0] / stiffness[1]
    v = scale * _speed(theirs, i, level)
    return float(ours.linear_damping[i] * v + ours.quadratic_damping[i] * v * v)


PERIODS = {"surge": 4.0, "sway": 4.0, "heave": 2.4, "roll": 2.0, "pitch": 2.0, "yaw": 4.0}
"""Of the wave, some five time constants of a small vehicle [s]."""
WAVES = 2.5
"""The first and the last half of a half wave, so that the middle of the way is where it began."""


def shuttles(levels: Mapping[str, Sequence[float]], vehicle: Vehicle) -> list[Programme]:
    """Square waves, two and a half periods each, which begin with half of a push.

    Steps tell the drag, for most of a step is steady; mass is told by what is not, and the propellers of the two
    directions, which differ, average out within a trial.

    Args:
        levels: Axis -> magnitudes [N, N m].
        vehicle: Must control the axes.

    Raises:
        CalibrationError: An axis that the vehicle does not control.
    """
    return [
        _shuttle(axis, level, PERIODS[axis])
        for axis in which_axes(list(levels), vehicle)
        for level in levels[axis]
    ]


def _shuttle(axis: str, level: float, period: float) -> Programme:
    counts = [round(s * RATE) for s in (1.0, 1.0, WAVES * period, 2.0, 1.0)]
    phase = np.repeat(np.array(["rest", "baseline", "excitation", "coast", "rest"]), counts)
    t = np.arange(counts[2]) / RATE
    tau = np.zeros((len(phase), 6))
    # A cosine's sign: a quarter of the period forward, half of it back, and so on.
    tau[phase == "excitation", AXES.index(axis)] = level * np.sign(
        np.cos(2.0 * math.pi * (t + 1e-6) / period)
    )
    return Programme(
        name=f"{axis}_shuttle_{level:.4g}",
        axes=(axis,),  # type: ignore[arg-type]
        rate=RATE,
        tau_desired=tau,
        phase=phase,
    )


Array = NDArray[np.float64]

PUSH, REST = 6.0, 1.0
"""Lengths of a step and of the pause before the next one [s]."""
OPEN = Basin(length=60.0, width=60.0, depth=60.0)


@dataclass(frozen=True)
class StepResponse:
    """Of one axis to one level, the mean of both directions."""

    speed: float
    """Terminal [m/s, rad/s]."""
    time_constant: float
    """Until 63 % of it, motors included [s]."""


def step_responses(
    vehicle: Vehicle, spec: PlantSpec, levels: Mapping[str, Sequence[float]]
) -> dict[tuple[str, float], StepResponse]:
    """Steps of a plant on rails: it can move along one axis alone, in water at rest, far from everything.

    Args:
        vehicle: By whose file the wrench is allocated and becomes shaft speeds.
        spec: The plant; current, tether and drift of the buoyancy are left out.
        levels: Axis -> wrenches [N, N m].

    Returns:
        (axis, level) -> response.
    """
    start_warp()
    still = {"basin": OPEN, "circulation": Circulation(), "tether": None, "buoyancy": BuoyancyDrift()}
    plant = Plant(vehicle, spec.model_copy(update=still), position=(0.0, 0.0, -30.0))
    found = {}
    for axis, values in levels.items():
        for level in values:
            both = [_step(plant, vehicle, AXES.index(axis), sign * level) for sign in (1.0, -1.0)]
            speed, time = np.mean(both, axis=0)
            found[axis, level] = StepResponse(float(speed), float(time))
    return found


def compare_steps(
    identified: Vehicle, standing: Vehicle, spec: PlantSpec, levels: Mapping[str, Sequence[float]]
) -> list[dict[str, float | str]]:
    """Terminal speeds and time constants of an identified vehicle beside those of the plant that it was identified in.

    Args:
        identified: The vehicle; its plant is its file to the letter.
        standing: Around which the plant was drawn.
        spec: The plant.
        levels: Axis -> wrenches, by the file that robots have [N, N m].

    Returns:
        A row for each axis and level: axis, level, speed and time constant of `model` and `plant`.
    """
    model = step_responses(identified, draw_plant(identified, 0, "nominal"), levels)
    real = step_responses(standing, spec, levels)
    return [
        {
            "axis": axis,
            "level": level,
            "model_speed": model[axis, level].speed,
            "plant_speed": response.speed,
            "model_time_constant": model[axis, level].time_constant,
            "plant_time_constant": response.time_constant,
        }
        for (axis, level), response in real.items()
    ]


def _step(plant: Plant, vehicle: Vehicle, axis: int, level: float) -> tuple[float, float]:
    """Terminal speed and time constant."""
    tau = np.zeros(6)
    tau[axis] = level
    force = Allocator.from_vehicle(vehicle).allocate(tau)
    speeds = [t.speed(f) for t, f in zip(vehicle.thrusters.values(), force, strict=True)]
    _ride(plant, axis, np.zeros(len(speeds)), REST)
    plant.nu[:] = 0.0
    nu = np.abs(_ride(plant, axis, np.array(speeds), PUSH))
    speed = float(nu[-round(0.5 / plant.step) :].mean())
    return speed, float(np.argmax(nu >= 0.632 * speed) * plant.step)


def _ride(plant: Plant, axis: int, target: Array, duration: float) -> Array:
    """Speed along the rail at every physics step."""
    out = np.empty(round(duration / plant.step))
    plant.target[:] = target
    for k in range(len(out)):
        plant.advance()
        out[k] = plant.nu[axis]
        plant.nu[:] = np.where(np.arange(6) == axis, plant.nu, 0.0)
        plant.position[:] = (0.0, 0.0, -30.0)
        plant.quaternion[:] = (0.0, 0.0, 0.0, 1.0)
    return out


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
        *map(_note, sentences(found.findings)),
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


PLANT_FILE = "pool.yaml"
"""The plant, for `finssim pool --plant`."""
TRIALS_FOLDER = "deployed"
"""A result and a series for every trial of a controller."""


REPORT_FILE = "report.html"
SEED = 1
PLANT, SEVERITY, RANGES = 1, "realistic", "pool"
CONTROLLERS = ("policy", "pid", "pid-paper")
VIEW_AT = 12.0
"""Time of a trial from which the report shows a picture [s]."""
COAST = 4.0
"""Longest, after a dive [s]: the pool is shallow, and this vehicle hardly rises."""


@dataclass(frozen=True, kw_only=True)
class Scope:
    """How much of everything a demonstration does."""

    levels: dict[str, list[float]]
    """Axis -> levels of the steps and pulses that the fit is made from, for FinsROV [N, N m]."""
    shuttles: dict[str, list[float]]
    """The same of the square waves."""
    held_out: dict[str, list[float]]
    """The same of those that are replayed."""
    setpoints: tuple[str, ...]
    """Tried by every controller, with the tags' corners computed."""
    pictures: tuple[str, ...]
    """Tried by the policy with pictures drawn and searched."""
    duration: float = 60.0
    """Of a trial [s]."""

    def of(self, vehicle: Vehicle) -> Scope:
        """The same for a vehicle: levels that move it as FinsROV's move FinsROV, on the axes that it controls.

        See `programmes.matched`.
        """
        return replace(
            self,
            **{name: matched(getattr(self, name), vehicle) for name in ("levels", "shuttles", "held_out")},
        )


FULL = Scope(
    levels={
        "surge": [6.0, 18.0],
        "sway": [4.5, 13.5],
        "heave": [4.5, 13.5],
        "roll": [0.5, 1.0],
        "pitch": [0.5, 1.0],
        "yaw": [0.6, 1.8],
    },
    shuttles={"surge": [12.0, 18.0], "sway": [9.0, 13.5], "heave": [9.0, 13.5]},
    held_out=HELD_OUT,
    setpoints=tuple(T1_SETPOINTS),
    pictures=("P02",),
)
"""What `finssim demo` does."""


def demo(
    out: Annotated[Path, "--out"] = Path("demo"),
    *,
    vehicle: str = "finsrov",
    seed: int = 1,
    steps: Annotated[int | None, (1, None)] = None,
    console: Console | None = None,
    scope: Scope | None = None,
    processes: Annotated[int | None, "python"] = None,
    robot: OnRobot | None = None,
    attendant: Attendant | None = None,
) -> Path:
    """Identify a vehicle in the virtual pool or on a robot, train in it, deploy there beside two PIDs, write a report.

    Trials are recorded and controllers deployed through the robot's whole software: camera, localization, fusion,
    controller, allocation, bridge and the motor controller's protocol. Beside the policy, `pid` and `pid-paper` try the
    same setpoints in the same pool, `pid` tuned from the identified vehicle.

    Example: finssim demo --vehicle bluerov2_heavy --out demo

    Example: finssim demo --robot udp://10.0.0.2:58766 --pool-file pool.yaml --arm --out demo

    Args:
        out: Directory of trials, vehicle, policy, results and report.
        vehicle (NAME|FILE): Vehicle of the catalogue, or the path of a vehicle file.
        seed: Seed of every random number; equal seeds give equal results.
        steps: Control steps to learn from, all worlds together; what the task needs if not given.
        console: Where progress is shown; standard error if None.
        scope: How much of it; `FULL` if None.
        processes: As many as there are processors if None.
        robot: Where trials are made and setpoints held, in place of the virtual pool. What is done stays in `out`, and
            the next call goes on.
        attendant: The person beside that robot, instead of the terminal's keyboard.

    Returns:
        Path of the report.

    Raises:
        KeyboardInterrupt: After Ctrl-C. A policy so far is then in `OUT-training/interrupted`, and, but for a robot's,
            `out` as it was.
    """
    console, standing = console or Console(stderr=True), load_vehicle(vehicle)
    scope = (scope or FULL).of(standing)
    start_warp()
    rescue = out.with_name(f"{out.name}-training") / "interrupted"
    place = _Place(vehicle, robot, attendant, processes, console)
    with atomic_directory(out, replaces=REPORT_FILE) if robot is None else kept_folder(out) as folder:
        found = _identified(folder, out, seed, scope, place)
        began = time.perf_counter()
        policy = folder / "policy"
        if robot is None or not finished(policy, found.vehicle):
            train(
                "t1",
                out=policy,
                vehicle=found.vehicle,
                randomize=RANGES,
                seed=seed,
                steps=steps,
                console=console,
                shown=out / "policy",
                interrupted=rescue,
            )
        training = {
            "seconds": time.perf_counter() - began,
            "seed": seed,
            "steps": Policy.load(policy).description.training["steps"],
        }
        with _rescued(policy, rescue, console):
            evaluations, picture = _deployed(folder, policy, seed, scope, place)
            _write(folder, found, evaluations, training, _commands(out, place, training), picture)
    print_comparison([e.result for e in evaluations if e.result["camera"] != "pictures"], Console())
    report = Path(out) / REPORT_FILE
    print(f"report: {report}")
    if _has_display():
        webbrowser.open(report.resolve().as_uri())
    return report


@dataclass(frozen=True)
class _Place:
    """With what and where it is done."""

    vehicle: str
    """Name or file, as the catalogue has it."""
    robot: OnRobot | None
    attendant: Attendant | None
    processes: int | None
    console: Console


def _identified(folder: Path, out: Path, seed: int, scope: Scope, place: _Place) -> Identification:
    """Trials, the vehicle they tell of, and in a pool how its speeds compare with the plant's."""
    standing, console = load_vehicle(place.vehicle), place.console
    plans = _plans(standing, scope)
    if place.robot is not None:
        robot = place.robot
        console.print("recording trials on the robot", highlight=False)

        def record(folder: Path, rough: Path, seed: int) -> dict[str, list[Trial]]:
            return trials_on_robot(
                plans, folder, load_vehicle(rough), robot, attendant=place.attendant, console=console
            )

        return _told(identify(folder, place.vehicle, seed=seed, shown=out, record=record), console)
    spec = draw_plant(standing, PLANT, SEVERITY)
    spec.write(folder / PLANT_FILE)
    console.print("recording trials in the virtual pool", highlight=False)
    with console.status("recording trials in the virtual pool") as status:

        def say(part: float, what: str) -> None:
            fitting = f"fitting {standing.name} to the trials, replaying others"
            status.update(f"recording trials in the virtual pool: {what}" if part < 1.0 else fitting)

        def show(run: Any, result: Mapping[str, Any]) -> None:
            unit = "m/s" if run.programme.axes[0] in AXES[:3] else "rad/s"
            text = f"up to {result['fastest']:.2f} {unit} in {result['duration']:.0f} s"
            text = f"left out: {result['fault']}" if result["fault"] else text
            console.print(f"  {run.target}: {text}", highlight=False)

        def simulated(folder: Path, rough: Path, seed: int) -> dict[str, list[Trial]]:
            return pool_trials(
                plans, folder, vehicle=str(rough), pool_vehicle=place.vehicle, plant=PLANT, severity=SEVERITY,
                seed=seed, leave_out=True, processes=place.processes, say=say, show=show,
            )  # fmt: skip

        found = identify(folder, place.vehicle, seed=seed, shown=out, record=simulated)
        linear = {axis: levels for axis, levels in scope.levels.items() if axis not in ("roll", "pitch")}
        found = replace(found, steps=tuple(compare_steps(found.vehicle, standing, spec, linear)))
    return _told(found, console)


def _told(found: Identification, console: Console) -> Identification:
    """Say what was identified."""
    off = [abs(float(s["model_speed"]) / float(s["plant_speed"]) - 1.0) for s in found.steps]
    speeds = f", terminal speeds within {100.0 * max(off):.0f} % of the pool's own vehicle" if off else ""
    identifiable = sum(e.identifiable for e in found.fit.estimates.values())
    console.print(
        f"identified from {len(found.fit.trials)} trials in {found.seconds:.0f} s: {identifiable} of "
        f"{len(found.fit.estimates)} parameters told, NRMSE on {len(found.replay.pairs)} other trials "
        f"{found.replay.aggregate('calibrated').value:.3f}{speeds}",
        highlight=False,
    )
    return found


def _plans(standing: Vehicle, scope: Scope) -> dict[str, list[Programme]]:
    """Programmes by role."""
    plans = {
        role: programmes(tuple(levels), standing, levels=levels, coast=COAST)
        for role, levels in (("fit", scope.levels), ("held-out", scope.held_out))
    }
    plans["fit"] += shuttles(scope.shuttles, standing) if scope.shuttles else []
    return {role: [trimmed(programme, standing) for programme in plan] for role, plan in plans.items()}


def _deployed(
    folder: Path, policy: Path, seed: int, scope: Scope, where: _Place
) -> tuple[list[Evaluation], bytes | None]:
    """All controllers in the pool, the policy with pictures too, and one of those pictures; or all on the robot."""
    console = where.console
    common: dict[str, Any] = {
        "vehicle": str(folder / vehicle_files(load_vehicle(where.vehicle).name)[1]),
        "pool_vehicle": where.vehicle,
        "plant": PLANT,
        "severity": SEVERITY,
        "seed": seed,
        "duration": scope.duration,
    }
    names = {name: str(policy) if name == "policy" else name for name in CONTROLLERS}
    if where.robot is not None:
        common |= {"pool_vehicle": common["vehicle"], "plant": 0, "severity": HARDWARE}
        jobs = pool_jobs(names, scope.setpoints, camera=HARDWARE, **common)
        results = run_on_robot(
            jobs, folder / TRIALS_FOLDER, where.robot, attendant=where.attendant, console=console
        )
        played = {result["key"]: result for result in results}
        jobs = [job for job in jobs if job.key() in played]
        return _by_row(jobs, [played[job.key()] for job in jobs], folder / TRIALS_FOLDER), None
    # Pictures first: they take longest, and the other processor has time for the rest.
    jobs = pool_jobs({"policy-with-pictures": str(policy)}, scope.pictures, camera="pictures", **common)
    seen = jobs[:1]
    jobs += pool_jobs(names, scope.setpoints, camera="corners", **common)
    place = folder / TRIALS_FOLDER
    console.print("holding setpoints in the virtual pool", highlight=False)
    with console.status("holding setpoints in the virtual pool") as status:
        say: Say = lambda part, what: status.update(f"holding setpoints in the virtual pool: {what}")  # noqa: E731

        def show(job: Job, result: Mapping[str, Any]) -> None:
            held = "held" if result["success"] else result["fault"] or "not held"
            if result["e_p_m"] is not None:
                held += f", {result['e_p_m']:.3f} m and {result['e_psi_deg']:.1f}° off"
            console.print(f"  {job.row} at {job.target}: {held}", highlight=False)

        results = run_jobs(jobs, place, play, processes=where.processes, say=say, show=show)
        evaluations = _by_row(jobs, results, place)
        picture = camera_view(seen[0], place / seen[0].key(), VIEW_AT, seed) if seen else None
    return evaluations, picture


def _by_row(jobs: Sequence[Job], results: Sequence[dict[str, Any]], place: Path) -> list[Evaluation]:
    """One evaluation for each row, the policy's first."""
    rows = sorted({job.row for job in jobs}, key=lambda row: [*CONTROLLERS, row].index(row))
    chosen = [[i for i, job in enumerate(jobs) if job.row == row] for row in rows]
    return [pool_evaluation([jobs[i] for i in those], [results[i] for i in those], place) for those in chosen]


def _write(
    folder: Path,
    found: Identification,
    evaluations: Sequence[Evaluation],
    training: Mapping[str, Any],
    commands: Sequence[str],
    picture: bytes | None,
) -> None:
    """Write NAME.json of every controller, `steps.json`, `camera.png` and `report.html`."""
    for evaluation in evaluations:
        write_json(folder / f"{evaluation.result['controller']['name']}.json", evaluation.result)
    (folder / "steps.json").write_text(json.dumps(found.steps, indent=2) + "\n", encoding="utf-8")
    if picture is not None:
        (folder / "camera.png").write_bytes(picture)
    with (folder / "policy" / "curves.csv").open(encoding="utf-8", newline="") as file:
        curves = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
    html = report_html(evaluations, curves, training, commands, found, picture)
    (folder / REPORT_FILE).write_text(html, encoding="utf-8")


def _commands(out: Path, place: _Place, training: Mapping[str, Any]) -> list[str]:
    """Command lines that repeat the demonstration's steps by hand."""
    name = load_vehicle(place.vehicle).name
    rough, identified = (out / file for file in vehicle_files(name))
    seed, steps = training["seed"], training["steps"]
    goal = f"finssim run --policy policy --vehicle {identified} --goal 1,0.3,-0.5,90"
    excite = f"finssim excite all --vehicle {rough}"
    middle = [
        *commands(out, name, seed),
        f"finssim train t1 --vehicle {identified} --randomize {RANGES} --seed {seed} --steps {steps} --out policy",
    ]
    if place.robot is not None:
        robot = f"{place.robot.options} --arm"
        return [
            f"{excite} {robot} --coast {COAST:g} --out more-trials",
            *middle,
            f"{goal} {robot} --record run.mcap",
            f"finssim evaluate run.mcap --task t1 --vehicle {identified}",
        ]
    return [
        f"finssim trials import {out / TRIALS / 'fit' / 'records'}/*.mcap --split phase --out trials",
        f"{excite} --pool {PLANT} --severity {SEVERITY} --pool-vehicle {place.vehicle} --coast {COAST:g} "
        "--out more-trials",
        *middle,
        f"finssim pool --vehicle {place.vehicle} --plant {out / PLANT_FILE} --pool-file site.yaml --truth truth.fst",
        f"{goal} --robot pool --pool-file site.yaml --arm",
    ]


@contextmanager
def _rescued(policy: Path, rescue: Path, console: Console) -> Iterator[None]:
    """Keep a trained policy when what follows its training is interrupted, and `folder` goes."""
    try:
        yield
    except KeyboardInterrupt:
        with atomic_directory(rescue, replaces=DESCRIPTION_FILE) as copy:
            shutil.copytree(policy, copy, dirs_exist_ok=True)
        console.print(f"policy kept: {rescue}", highlight=False, soft_wrap=True)
        raise


def _has_display() -> bool:
    """Whether a person sits in front of a screen where a browser could open."""
    if not sys.stdout.isatty():
        return False
    return sys.platform in ("darwin", "win32") or bool(
        environ.get("DISPLAY") or environ.get("WAYLAND_DISPLAY")
    )
