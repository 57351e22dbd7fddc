"""`finssim train` and `finssim evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from finssim.cli_options import Device, Hydrodynamics, Json, Observe, Seed, Steps, Vehicle
from finssim.quiet import start_warp

__all__ = ["evaluate", "train"]


def train(
    task: Annotated[
        str,
        typer.Argument(
            help="Task to learn: t1 (station keeping), t2 (trajectory tracking), t3 (moving target), docking, pursuit, "
            "team-pursuit or formation; or one's own, FILE.py:CLASS.",
            metavar="TASK",
        ),
    ],
    out: Annotated[
        Path, typer.Option(help="Directory of the policy; an earlier policy there is replaced when done.")
    ],
    learner: Annotated[
        str,
        typer.Option(
            help="Who learns: ppo (FinsSim's own), sb3-ppo, sb3-sac, sb3-recurrent-ppo or rsl-rl; one agent also "
            "torchrl-ppo, several torchrl-ippo or torchrl-mappo; from demonstrations bc, dagger or gail.",
            metavar="NAME",
        ),
    ] = "ppo",
    vehicle: Vehicle = "finsrov",
    hydrodynamics: Hydrodynamics = "calibrated",
    action: Annotated[
        str | None,
        typer.Option(
            help="What the policy commands: wrench6, wrench4 or thruster8; the task's own if not given.",
            metavar="MODE",
        ),
    ] = None,
    randomize: Annotated[
        str | None,
        typer.Option(
            help="Ranges that vehicle and water are drawn from: "
            "hold_for_position, fossen_learn_to_swim, equivalent_box, pool, no_thruster_dynamics, or a file.",
            metavar="FILE",
        ),
    ] = None,
    observe: Observe = "training",
    seed: Seed = 42,
    worlds: Annotated[int | None, typer.Option(help="Worlds simulated at once.", min=1)] = None,
    steps: Steps = None,
    until: Annotated[
        float | None,
        typer.Option(
            help="Share of successes, such as 0.95, at which the training is done before its steps are: of the held "
            "episodes, in two evaluations one after the other.",
            metavar="SHARE",
        ),
    ] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="Change of a setting of the learner, such as learning_rate=1e-3 or hidden=128,128. May be given "
            "several times.",
            metavar="NAME=VALUE",
        ),
    ] = None,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Go on from the last checkpoint of a training that was killed."),
    ] = False,
    device: Device = "cpu",
) -> None:
    """Train a policy and write it to a directory that runs without the learner.

    Example: finssim train t1 --vehicle finsrov --seed 1 --out runs/hold

    Example: finssim train docking --until 0.95 --out runs/dock

    Example: finssim train t2 --learner rsl-rl --randomize hold_for_position --set epochs=8 --out runs/track
    """
    start_warp()
    from finssim.learning.train import settings_of_words
    from finssim.learning.train import train as run

    run(
        task,
        learner=learner,
        settings=settings_of_words(changes or ()),
        resume=resume,
        vehicle=vehicle,
        hydrodynamics=hydrodynamics,
        action=action,
        randomize=randomize,
        observe=observe,
        seed=seed,
        worlds=worlds,
        steps=steps,
        until=until,
        device=device,
        out=out,
    )


def evaluate(
    controller: Annotated[
        list[str],
        typer.Argument(
            help="A policy's directory, or pid, or pid-paper; or records of one controller on a robot (.mcap).",
            metavar="DIR|pid|pid-paper|RECORD",
        ),
    ],
    task: Annotated[
        str,
        typer.Option(
            help="Task to be tried on; finssim tasks lists them. One's own: FILE.py:CLASS. Of records a task "
            "of one vehicle.",
            metavar="TASK",
        ),
    ] = "t1",
    vehicle: Vehicle = "finsrov",
    hydrodynamics: Hydrodynamics = "calibrated",
    plant: Annotated[
        list[str] | None,
        typer.Option(
            help="What differs from the vehicle file: nominal (nothing), current, lag, mesh, noise, "
            "randomised, sensors, simplified, waves, or a file. May be given several times.",
            metavar="FILE|NAME",
        ),
    ] = None,
    observe: Annotated[
        str | None,
        typer.Option(
            help="What is seen in every plant: truth, estimator, sensors or a file of fixes; what the plant says if "
            "not given.",
            metavar="FILE|NAME",
        ),
    ] = None,
    trajectory: Annotated[
        list[str] | None,
        typer.Option(
            help="What t2 follows: straight, broken, ellipse, lemniscate (all four if not given), circle, "
            "figure_eight, helix, or a YAML or CSV file. May be given several times.",
            metavar="FILE|NAME",
        ),
    ] = None,
    trials: Annotated[
        int | None,
        typer.Option(
            help="Trials in each plant; if not given, t1's eight setpoints for 60 s, or each trajectory, once.",
            min=1,
        ),
    ] = None,
    trim: Annotated[
        bool,
        typer.Option("--trim", help="Put the integral of the position error in front of a policy."),
    ] = False,
    truth: Annotated[
        Path | None,
        typer.Option(
            help="By which records are measured, in place of the robot's own estimate: a table (.csv, .parquet) of "
            "motion capture, t [s], x, y, z [m] and qx, qy, qz, qw or yaw [rad], or the truth file of finssim pool.",
            metavar="TABLE",
        ),
    ] = None,
    seed: Seed = 42,
    out: Annotated[
        Path | None, typer.Option(help="Directory for evaluation.json, the figure and trajectories.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Try a controller: success, errors [m, deg], time to settle [s]; or errors along trajectories [m].

    Example: finssim evaluate runs/hold --plant current --trials 64 --out runs/hold-current

    Example: finssim evaluate runs/hold --observe sensors

    Example: finssim evaluate runs/track --task t2 --trajectory ellipse --trajectory my-way.csv

    Example: finssim evaluate run.mcap --task t1 --truth mocap.csv
    """
    start_warp()
    from finssim.experiments.evaluate import evaluate as run

    records = [Path(word) for word in controller if word.endswith(".mcap")]
    if len(controller) > 1 and len(records) < len(controller):
        raise typer.BadParameter(
            "one controller at a time, or records of one: give a single name, or .mcap files"
        )
    simulated = {"--plant": plant, "--observe": observe, "--trials": trials, "--trim": trim or None}
    unheeded = [name for name, value in simulated.items() if value is not None]
    if records and unheeded:
        raise typer.BadParameter(f"a record was made once and for all: leave {', '.join(unheeded)} out")
    if truth is not None and not records:
        raise typer.BadParameter("--truth tells of records: a simulation knows its own")
    run(
        records or controller[0],
        task=task,
        vehicle=vehicle,
        hydrodynamics=hydrodynamics,
        plant=plant or "nominal",
        observe=observe,
        trajectories=trajectory or (),
        trials=trials,
        trim=trim,
        truth=truth,
        seed=seed,
        out=out,
        json=as_json,
    )
