"""`finssim run`: a policy or a PID on a vehicle, or in the virtual pool."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from finssim.cli_options import Arm, Bind, Json, Lockstep, Pictures, Vehicle

if TYPE_CHECKING:
    from finssim.experiments.on_robot import OnRobot

__all__ = ["robot_or_none", "run"]


def run(
    policy: Annotated[
        str | None,
        typer.Option(
            help="A policy's directory, or pid, or pid-paper, or with --task one of the task's baselines.",
            metavar="DIR|NAME",
        ),
    ] = None,
    task: Annotated[
        str | None,
        typer.Option(
            help="Task that the policy must have been trained for, by name (see finssim tasks) or as FILE.py:CLASS of "
            "one's own; the policy's if not given.",
            metavar="TASK",
        ),
    ] = None,
    agent: Annotated[
        str | None,
        typer.Option(
            help="This vehicle's place in a task of several; its first if not given.", metavar="NAME"
        ),
    ] = None,
    goal: Annotated[
        str | None,
        typer.Option(
            help="Station to keep: x,y,z [m] in the world frame (z = 0 on the water, negative below) and heading "
            "[deg], or a file with goal: [x, y, z, yaw_deg].",
            metavar="X,Y,Z,YAW|FILE",
        ),
    ] = None,
    trajectory: Annotated[
        str | None,
        typer.Option(
            help="Trajectory to follow in place of a goal: straight, broken, ellipse, lemniscate, circle, helix, "
            "or a file.",
            metavar="NAME|FILE",
        ),
    ] = None,
    robot: Annotated[
        str,
        typer.Option(
            help="Motor controller: udp://HOST:PORT, serial:DEVICE, or pool for the virtual pool on this machine. "
            "With --lockstep: pool, or HOST:PORT.",
            metavar="ADDRESS",
        ),
    ] = "pool",
    bind: Bind = "127.0.0.1:54321",
    pictures: Pictures = None,
    pool_file: Annotated[
        str | None,
        typer.Option(
            help="Pool file: camera, water plane and frames (.yaml); none where no camera looks. If not given: "
            "pool.yaml, of --team none.",
            metavar="FILE|none",
        ),
    ] = None,
    site: Annotated[
        str | None,
        typer.Option(
            help="Where: pool, tank or open-water. The workspace, and in open water Doppler log and compass, are then "
            "those of finssim pool --site. If not given: pool, of --team open-water.",
            metavar="NAME",
        ),
    ] = None,
    team: Annotated[
        str | None,
        typer.Option(
            help="In place of --policy: who steers all agents of a task, each with a stack in a process of its own. "
            "Their motor controllers and own ends are those of --robot and --bind, ten ports on, and so on. An address "
            "is taken for that of --messages.",
            metavar="DIR|NAME",
        ),
    ] = None,
    messages: Annotated[
        str,
        typer.Option(
            help="What carries messages between vehicles, such as finssim pool --task: HOST:PORT. Of --team the port "
            "five after --robot if not given.",
            metavar="ADDRESS",
        ),
    ] = "",
    number: Annotated[
        int,
        typer.Option(
            help="This vehicle's number among several under one camera: its tags' ids go on after those of the one "
            "before.",
            min=0,
        ),
    ] = 0,
    vehicle: Vehicle = "finsrov",
    trim: Annotated[
        bool,
        typer.Option(
            "--trim", help="Put an integral in front of a policy, against a steady current or weight."
        ),
    ] = False,
    let_in: Annotated[
        str | None,
        typer.Option(
            help="Where the vehicle begins, world frame [m], known to 5 cm: for dead reckoning by Doppler log and "
            "compass, where no camera and no position fix tells.",
            metavar="X,Y",
        ),
    ] = None,
    mode: Annotated[
        str | None,
        typer.Option(
            help="Estimator: constant-velocity or error-state. If not given: with --let-in error-state, else "
            "constant-velocity.",
            metavar="MODE",
        ),
    ] = None,
    record: Annotated[
        Path | None,
        typer.Option(
            help="Record everything into this file (.mcap); of --team a folder with a file for each.",
            metavar="FILE",
        ),
    ] = None,
    duration: Annotated[
        float | None,
        typer.Option(
            help="End after this time [s]; at the end of the trajectory, or with Ctrl-C, if not given.",
            min=0.0,
        ),
    ] = None,
    lockstep: Lockstep = False,
    arm: Arm = False,
    as_json: Json = False,
) -> None:
    """Run a controller on a vehicle: estimate, decide, command; print how it went. Ctrl-C stops the thrusters.

    Exit status 3: the run ended in a fault of the vehicle; 4: the vehicle said nothing.

    Example: finssim run --policy runs/hold --goal 0.5,0,-0.5,90 --pool-file pool.yaml --duration 60 --arm

    Example: finssim run --team runs/team --duration 60 --arm
    """
    from finssim.quiet import start_warp
    from finssim.robot.interrupt import follow_parent

    follow_parent()
    start_warp()
    if team is not None and _is_address(team):
        team, messages = None, team
    if (policy is None) == (team is None):
        raise typer.BadParameter("who steers? give --policy for this vehicle, or --team for all of a task")
    if team is not None:
        if agent is not None or trajectory is not None or lockstep or number or let_in is not None:
            raise typer.BadParameter(
                "--team has every agent in its place: leave --agent, --trajectory, --lockstep, --number and --let-in "
                "out"
            )
        from finssim.robot.team_run import run_team

        where = {"--site": site or "open-water", "--pool-file": pool_file or "none", "--goal": goal}
        options = {**where, "--mode": mode or "constant-velocity", "--duration": duration}
        given = [word for name, x in options.items() if x is not None for word in (name, str(x))]
        flags = [name for name, on in (("--trim", trim), ("--arm", arm)) if on]
        ends = {"robot": robot, "bind": bind, "messages": messages}
        kept = {"record": record, "as_json": as_json}
        status = run_team(team, [*given, *flags], task=task, vehicle=vehicle, **ends, **kept)  # type: ignore[arg-type]
        if status:
            raise typer.Exit(status)
        return
    assert policy is not None
    from finssim.robot.goals import place_of
    from finssim.robot.run import Wiring
    from finssim.robot.run import run as drive

    status = drive(
        policy,
        task=task,
        agent=agent,
        goal=goal,
        trajectory=trajectory,
        pool_file=None if pool_file == "none" else Path(pool_file or "pool.yaml"),
        vehicle=vehicle,
        site=site or "pool",
        number=number,
        let_in=None if let_in is None else place_of(let_in),
        wiring=Wiring(robot=robot, bind=bind, pictures=pictures, lockstep=lockstep, team=messages),
        record=record,
        duration=duration,
        mode=mode or ("constant-velocity" if let_in is None else "error-state"),
        trim=trim,
        arm=arm,
        as_json=as_json,
    )
    if status:
        raise typer.Exit(status)


def _is_address(text: str) -> bool:
    """Whether that is HOST:PORT."""
    host, _, port = text.rpartition(":")
    return bool(host) and port.isdecimal()


def robot_or_none(
    robot: str | None,
    *,
    bind: str,
    pictures: str | None,
    lockstep: bool,
    pool_file: Path | None,
    site: str | None,
    arm: bool,
    by_hand: bool,
    unattended: bool,
) -> OnRobot | None:
    """The robot that options name; none where they name none, and nothing tells of one."""
    if robot is None:
        told = (arm, by_hand, unattended, lockstep, pool_file, pictures, site)
        if any(x is not None and x is not False for x in told):
            raise typer.BadParameter(
                "--arm, --by-hand, --unattended, --lockstep, --pool-file, --site and --pictures tell of a robot: name "
                "one with --robot"
            )
        return None
    if pool_file is None:
        raise typer.BadParameter(
            "a robot knows where it is by its pool file: give --pool-file, or none where position fixes come by wire"
        )
    from finssim.experiments.on_robot import OnRobot
    from finssim.robot.wiring import Wiring

    return OnRobot(
        wiring=Wiring(robot=robot, bind=bind, pictures=pictures, lockstep=lockstep),
        pool_file=None if str(pool_file) == "none" else pool_file,
        site=site or "pool",
        arm=arm,
        by_hand=by_hand,
        unattended=unattended,
    )
