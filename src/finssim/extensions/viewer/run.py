"""`finssim view`: open a source, serve its page, and end with Ctrl-C."""

from __future__ import annotations

import math
import time
import webbrowser
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from finssim.extensions.viewer.frame import Placeholder, Source, ViewError
from finssim.robot.interrupt import interruptible, interrupting
from finssim.vehicles import load_vehicle

_DRIVEN = {"policy", "task", "goal", "trajectory", "seed"}
USED_OPTIONS = {
    "pool": _DRIVEN | {"plant", "severity", "camera", "world"},
    "sim": _DRIVEN | {"hydrodynamics"},
    "record": {"truth", "truth_offset", "basin", "world", "seed"},
    "folder": {"world"},
}
"""Kind of source -> options that it uses, besides the vehicle."""


@dataclass(frozen=True, kw_only=True)
class SourceChoice:
    """Source that the user wants to view."""

    source: Annotated[str, "argument"] = "pool"
    """(pool|sim|FILE|FOLDER) Source: pool (the virtual pool with a robot in it), sim (the simulator), a record
    (.mcap), or a folder written by the engine's recorder."""
    vehicle: str | None = None
    """(NAME|FILE) Vehicle in the catalogue, or a vehicle file; if not given, finsrov, or the vehicle of the record."""
    policy: str = "pid"
    """(DIR|pid|pid-paper) Controller in pool and sim: a policy's directory, pid or pid-paper."""
    task: str | None = None
    """(TASK) Task that the policy must have been trained for: t1 or t2; without a trajectory, t2 follows a
    default one."""
    goal: str | None = None
    """(X,Y,Z,YAW|FILE) Pose to keep in pool and sim: x,y,z [m] in the world frame and heading [deg], or a file."""
    trajectory: str | None = None
    """(NAME|FILE) Trajectory to follow instead of a goal: a name or a file."""
    plant: str = "1"
    """(SEED|FILE) Plant in the pool: a seed to draw it from, or a plant file."""
    severity: str = "realistic"
    """(NAME) Severity of a drawn plant: nominal, realistic or hard."""
    camera: str = "corners"
    """(KIND) Output of the pool's camera: pictures, or corners (of the tags)."""
    hydrodynamics: str = "calibrated"
    """(MODEL) Hydrodynamic model: calibrated, simplified or mesh."""
    truth: Path | None = None
    """(FILE) Truth file of the pool, to show with a record."""
    truth_offset: float | None = None
    """Time of the robot's clock when the pool's clock is 0 [s]; if not given, estimated from both motions."""
    basin: str | None = None
    """(L,W,D) Pool to show around a record: length,width,depth [m]; if not given, the vehicle's workspace."""
    world: str | None = None
    """(SITE|FILE|NUMBER) For pool, the world of the vehicle's own cameras and sonars (a site of finssim
    worlds or a file), with motion capture for localization; for a record, the world to show, drawn from
    --seed; for a folder, the index of the run's world, by default the first."""
    seed: int = 1
    """Seed of all random numbers; equal seeds give equal results."""


def open_source(choice: SourceChoice) -> Source:
    """Return the source that a choice describes.

    Raises:
        ViewError: There is no such source.
        ValueError: Its content is invalid; the message is one sentence.
    """
    kind, path = _check(choice), Path(choice.source)
    if kind == "pool":
        return _pool(choice)
    if kind == "sim":
        return _simulator(choice)
    if kind == "folder":
        from finssim.extensions.viewer.sources import RunSource

        if choice.world is not None and not choice.world.isdecimal():
            raise ViewError(f"--world {choice.world}: expected the number of a world of the folder's run")
        number = None if choice.world is None else int(choice.world)
        return RunSource(path, world=number, vehicle=choice.vehicle)
    from finssim.extensions.viewer.sources import RecordSource

    return RecordSource(
        path,
        truth=choice.truth,
        offset=choice.truth_offset,
        basin=None if choice.basin is None else _size(choice.basin),
        vehicle=choice.vehicle,
        world=choice.world,
        seed=choice.seed,
    )


def run(
    choice: Annotated[SourceChoice, "options"],
    *,
    speed: Annotated[float, (0.01, 100.0)] = 1.0,
    port: Annotated[int, (1, 65535)] = 8080,
    bind: str = "127.0.0.1",
    no_browser: bool = False,
    duration: Annotated[float | None, (0.0, None)] = None,
) -> None:
    """Show a vehicle in the browser, live or recorded: poses, goal, forces, camera, health, errors [m, deg].

    Example: finssim view run.mcap --truth truth.fst --basin 4,2,1

    Example: finssim view pool --policy pid --trajectory ellipse --severity hard --camera pictures

    Args:
        choice: Source to view.
        speed: Speed factor relative to real time [-].
        port: Port of the page; the next free one if it is in use.
        bind (ADDRESS): Address to serve at; only this machine if not given.
        no_browser: Print the page's address without opening it.
        duration: Duration [s]; until Ctrl-C if not given.
    """
    from finssim.extensions.viewer.app import View

    placeholder = _placeholder(choice, _check(choice))
    view = View(bind=bind, port=port, speed=speed)
    print(f"view: {view.url}   (Ctrl-C ends)", flush=True)
    if not no_browser:
        webbrowser.open(view.url)
    try:
        with interruptible() as interrupted:
            view.show(placeholder)
            view.turn(0.0)
            source = None if interrupted() else _ready(choice)
            if source is None:
                return
            view.show(source)
            print(source.stage.title, flush=True)
            end = time.monotonic() + (math.inf if duration is None else duration)
            view.run(lambda: interrupted() or time.monotonic() >= end)
    finally:
        view.close()


FIRST = 0.2
"""Time to which a live source runs before it is shown [s]; its kernels are compiled while the placeholder is shown."""


def _ready(choice: SourceChoice) -> Source | None:
    """Return the source once its kernels are compiled, while a thread serves the page; None if interrupted."""
    with interrupting(), suppress(KeyboardInterrupt):
        source = open_source(choice)
        source.frame(FIRST)
        return source
    return None


def _placeholder(choice: SourceChoice, kind: str) -> Source:
    """Return the first content of a view: the vehicle, if it is known before a record has been read."""
    name = choice.vehicle or "finsrov"
    if kind in ("pool", "sim"):
        return Placeholder(load_vehicle(name), f"{kind}: {name}", "compiling kernels …")
    named = choice.vehicle is not None
    return Placeholder(load_vehicle(name), Path(choice.source).name, f"reading the {kind} …", placed=named)


def _check(choice: SourceChoice) -> str:
    """Return the kind of the source; raise if it does not exist, and for options that it would not use."""
    path = Path(choice.source)
    kind = choice.source if choice.source in ("pool", "sim") else "folder" if path.is_dir() else "record"
    if kind == "record" and not path.is_file():
        raise ViewError(
            f"{choice.source}: no such file or folder; give pool, sim, a record (.mcap) or a run's folder"
        )
    usual = SourceChoice()
    for name in sorted(set().union(*USED_OPTIONS.values()) - USED_OPTIONS[kind]):
        if getattr(choice, name) != getattr(usual, name):
            takers = " and ".join(other for other in USED_OPTIONS if name in USED_OPTIONS[other])
            raise ViewError(f"--{name.replace('_', '-')} is for {takers}, not for a {kind}: omit it")
    return kind


def _pool(choice: SourceChoice) -> Source:
    from finssim.extensions.perception import load_world
    from finssim.extensions.viewer.sources import PoolSource, guide_for
    from finssim.pool.plan import make_plan
    from finssim.pool.plant_spec import PlantSpecError
    from finssim.vehicles.defaults import vehicle_at

    name = choice.vehicle or "finsrov"
    goal = choice.goal
    if choice.world is not None and goal is None and choice.trajectory is None:
        view = load_world(choice.world).viewpoint
        goal = ",".join(f"{x:g}" for x in (*view.position, math.degrees(view.yaw)))
    room = load_vehicle(name) if choice.world is None else vehicle_at("open-water", load_vehicle(name))
    guide = guide_for(goal, choice.trajectory, choice.task, room)
    severity: Any = choice.severity  # checked where it is used, as is the camera
    camera: Any = "none" if choice.world else choice.camera
    plan = make_plan(name, choice.plant, severity, camera=camera, seed=choice.seed, world=choice.world)
    if choice.world is not None:
        plan = replace(plan, positioning="motion-capture")
    elif plan.camera is None or plan.calibrated is None:
        raise PlantSpecError("a robot in the pool needs a camera: give corners or pictures")
    return PoolSource(guide, plan, policy=choice.policy, task=choice.task, seed=choice.seed)


def _simulator(choice: SourceChoice) -> Source:
    from finssim.extensions.viewer.sources import SimulatorSource, guide_for

    vehicle = load_vehicle(choice.vehicle or "finsrov")
    return SimulatorSource(
        vehicle,
        guide_for(choice.goal, choice.trajectory, choice.task, vehicle),
        policy=choice.policy,
        task=choice.task,
        hydrodynamics=choice.hydrodynamics,
        seed=choice.seed,
    )


def _size(text: str) -> tuple[float, float, float]:
    try:
        length, width, depth = (float(part) for part in text.split(","))
    except ValueError:
        length = width = depth = math.nan
    if not (min(length, width, depth) > 0.0 and math.isfinite(length + width + depth)):
        raise ViewError(f"basin '{text}': expected length,width,depth [m], such as 4,2,1")
    return length, width, depth
