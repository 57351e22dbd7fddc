"""`finssim pool`: make a plant, a camera and a motor controller, and serve a robot until it is told to stop."""

from __future__ import annotations

import logging
import math
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from finssim.control.guidance import Station
from finssim.geometry.rotations import quat_from_yaw, quat_yaw
from finssim.localization.pool import Pool, write_pool
from finssim.pool.camera import PoolCamera, camera_of
from finssim.pool.draw_plant import draw_plant, positioning_of, site_of
from finssim.pool.fleet import Fleet
from finssim.pool.onboard import Cameras, OnboardPlan, site_of_world
from finssim.pool.pictures import CameraPlan, PictureProcess, Plan, UdpSender
from finssim.pool.plant_spec import Basin, PlantSpec, PlantSpecError, Severity, load_plant_spec
from finssim.pool.server import GroundLinks, LockstepServer, MediumServer, serve_realtime
from finssim.pool.task_site import TaskSite
from finssim.pool.virtual_pool import VirtualPool
from finssim.robot.goals import station_of
from finssim.robot.link.frames import LinkError
from finssim.robot.link.transports import UdpTransport, host_port
from finssim.tasks.observer import fitted_task
from finssim.vehicles import Vehicle, load_vehicle
from finssim.vehicles.defaults import numbered, vehicle_at
from finssim.worlds import load_world

__all__ = ["MCU_PORT", "PoolPlan", "make_plan", "run", "swimming"]

MCU_PORT = 58766
"""Of the motor controller; pictures come from the next port, lock-step is the one after."""
MESSAGES = 5
"""The messages of a team are this far from the first port."""
ROOM = 2.0
"""Vehicles of a team start so many lengths of the longest apart."""


@dataclass(frozen=True, kw_only=True)
class PoolPlan:
    """A virtual pool before it lives."""

    vehicle: Vehicle
    spec: PlantSpec
    camera: CameraPlan | None
    calibrated: Pool | None
    """What a robot may know of the camera."""
    positioning: str = "none"
    """Name of the positioning system."""
    firmware: Literal["mcu", "ardusub"] = "mcu"
    """Of the vehicle."""
    onboard: OnboardPlan | None = None
    """The vehicle's own cameras, sonars and altimeters, in the world that they see; None: there is none."""

    def eye(self) -> Any:
        """All cameras as one, made here; None where there are none."""
        cameras = [plan.camera() for plan in (self.camera, self.onboard) if plan is not None]
        return Cameras(*cameras) if len(cameras) > 1 else cameras[0] if cameras else None

    def world(self, camera: Any, *, start: Station, seed: int, truth: Path | None) -> VirtualPool:
        """The living pool.

        Args:
            camera: Of the pool; None for none.
            start: Where the vehicle begins, at rest and level.
            seed: Of instruments and wire.
            truth: File that is written.
        """
        pose = np.asarray(start.position), quat_from_yaw(start.yaw)
        return VirtualPool(
            self.vehicle,
            self.spec,
            camera=camera,
            positioning=positioning_of(self.positioning, seed),
            start=pose,
            seed=seed,
            truth=truth,
            firmware=self.firmware,
            world=None if self.onboard is None else self.onboard.layout(),
        )

    def standing(self, start: Station, *, seed: int, truth: Path | None = None) -> VirtualPool:
        """The living pool with its own camera, for lock-step; arguments as of `world`."""
        return self.world(self.eye(), start=start, seed=seed, truth=truth)


def make_plan(
    vehicle: str | Vehicle,
    plant: str,
    severity: Severity,
    *,
    camera: Literal["pictures", "corners", "none"] = "pictures",
    seed: int = 0,
    site: str | None = None,
    firmware: Literal["mcu", "ardusub"] = "mcu",
    world: str | None = None,
) -> PoolPlan:
    """Draw a plant and its camera, or read the plant from its file.

    Args:
        vehicle: A vehicle, its name or file.
        plant: Seed, or a plant file, whose own severity and seed then also make the camera.
        severity: Of a drawn plant.
        camera: What it sends.
        seed: Of ripples, noise, jitter and losses.
        site: pool, tank or open-water; a camera hangs over the pool and the tank alone. If None the pool, or the
            water of the world.
        firmware: mcu, or ardusub, with which the vehicle has a compass and a Doppler log.
        world: What the vehicle's own sensors see: a site of the catalogue of worlds, or a path; None: nothing.

    Raises:
        PlantSpecError: The plant cannot be made, or there is no such severity or camera.
    """
    ours = vehicle if isinstance(vehicle, Vehicle) else load_vehicle(vehicle)
    spec = draw_plant(ours, int(plant), severity) if plant.isdecimal() else load_plant_spec(plant)
    own = world is not None and site is None
    spec = site_of_world(world, spec) if own and world is not None else site_of(site or "pool", spec)
    site = site or ("pool" if world is None else "open-water")
    ours = vehicle_at(site, ours, navigation=firmware == "ardusub")
    if site == "open-water" and camera != "none":
        raise PlantSpecError(
            "no camera hangs over open water: give --camera none, and a positioning if there is one"
        )
    if firmware not in ("mcu", "ardusub"):
        raise PlantSpecError(f"unknown firmware '{firmware}'; available: mcu, ardusub")
    if camera not in ("pictures", "corners", "none"):
        raise PlantSpecError(f"unknown camera '{camera}'; available: pictures, corners, none")
    onboard = None if world is None else OnboardPlan(vehicle=ours, world=world, seed=seed, solid=own)
    plan = PoolPlan(vehicle=ours, spec=spec, camera=None, calibrated=None, firmware=firmware, onboard=onboard)
    if camera == "none":
        return plan
    hung, calibrated, settings = camera_of(ours, spec.seed, spec.severity, basin=spec.basin)
    eye = CameraPlan(vehicle=ours, site=hung, settings=settings, basin=spec.basin, mode=camera, seed=seed)
    return replace(plan, camera=eye, calibrated=calibrated)


def run(
    *,
    vehicle: str = "finsrov",
    plant: str = "1",
    severity: Severity = "realistic",
    lockstep: bool = False,
    camera: Literal["pictures", "corners", "none"] | None = None,
    port: int = MCU_PORT,
    bind: str = "127.0.0.1",
    robot: str = "127.0.0.1:54321",
    pool_file: Path | None = None,
    truth: Path | None = None,
    start: str | None = None,
    task: str | None = None,
    team: str | None = None,
    site: str | None = None,
    world: str | None = None,
    positioning: str = "none",
    firmware: Literal["mcu", "ardusub"] = "mcu",
    ground: str = "127.0.0.1:14550",
    tcp: str = "127.0.0.1:5760",
    dvl: str = "127.0.0.1:16171",
    duration: Annotated[float | None, (0.0, None)] = None,
    seed: int = 0,
) -> None:
    """Be the vehicle and its pool for a robot on this machine, until Ctrl-C.

    Example: finssim pool --plant 1 --severity realistic --pool-file pool.yaml --truth truth.fst

    Args:
        vehicle (NAME|FILE): Vehicle of the catalogue, or the path of a vehicle file.
        plant (SEED|FILE): Plant in the water: a seed to draw it from, or a plant file.
        severity (NAME): How far a drawn plant and its camera are from what is known: nominal, realistic or hard.
        lockstep: Time goes as fast as one robot asks, instead of in real time.
        camera (KIND): What the camera sends: pictures, corners (of the tags) or none. If not given: pictures, over a
            team or a tank corners, in open water, the water of a world, of a task and with ardusub none.
        port: UDP port of the motor controller; pictures leave from the next, lock-step (TCP) is the one after. With
            ardusub 0 takes a free one.
        bind (ADDRESS): Address of this end: this machine alone unless given.
        robot (HOST:PORT): The only robot that may command in real time; its pictures go to the port after this.
        pool_file (FILE): Pool file to write: the camera as its calibration has it (.yaml).
        truth (FILE): File to write what truly happened into, for scoring; of a team a folder.
        start (X,Y,Z,YAW): Where the vehicle starts, world frame: x,y,z [m], yaw [deg]; in the middle, or at the
            viewpoint of a world, if not given.
        task (TASK): The site of a task in open water, in real time, with ports as of --team; messages between the
            robots go to the port five after --port. What the task commands is commanded here; the task scores what is
            true.
        team (NAME,NAME): Several vehicles in one water, in real time: names or files with commas between, the agents of
            --task, or side by side without. Each has a motor controller, at --port, ten ports on, and so on, for a
            robot at --robot, ten ports on, and so on. A camera sees them all; each has tags of its own ids.
        site (NAME): Where: pool, tank or open-water (current, waves, 20 m of water). If not given: pool; of a world its
            basin, or open water as deep as its seabed.
        world (SITE|FILE): What the vehicle's own cameras, sonars and altimeters see, drawn from --seed: a site of
            finssim worlds list, or a world file. Their readings go the way of the pictures.
        positioning (NAME): Fixes on the robot's wire: none, motion-capture or usbl.
        firmware (NAME): What steers the motors: mcu, the motor controller of `finssim run`, or ardusub, an autopilot
            that answers as ArduSub 4.5 does, over MAVLink, with a compass and a Doppler log.
        ground (HOST:PORT,...): UDP, with ardusub: ground stations that are sent to; it answers whoever sends to --port.
        tcp (HOST:PORT): With ardusub: where ground stations connect; port 0 takes a free one.
        dvl (HOST:PORT): With ardusub: TCP server of the Water Linked Doppler log; port 0 takes a free one.
        duration: When to end, pool's clock [s]; never if not given.
        seed: Seed of every random number; equal seeds give equal results.

    Raises:
        PlantSpecError, LinkError, GoalError, VehicleError, OutputError: What cannot be used.
    """
    logging.basicConfig(level=logging.WARNING, format="finssim: %(message)s", stream=sys.stderr)
    positioning_of(positioning, seed)  # refuses what is none
    ardusub = firmware == "ardusub"
    if task is not None or team is not None:
        if ardusub:
            raise PlantSpecError("--firmware ardusub is for one vehicle: leave --team and --task out")
        files = task is not None and (pool_file is not None or truth is not None)
        if not plant.isdecimal() or lockstep or start is not None or files or world is not None:
            raise PlantSpecError(
                "--team and --task draw their plants, their time is real and their starts are their own: give a seed "
                "for --plant, leave --lockstep, --start and --world out, and of a task --pool-file and --truth"
            )
        site = site or "pool"
        bodies = [load_vehicle(name.strip()) for name in (team or vehicle).split(",")]
        calibrated = None
        if task is None:
            made, calibrated = swimming(
                bodies, int(plant), severity, camera or ("none" if site == "open-water" else "corners"), site,
                positioning, truth=truth, seed=seed,
            )  # fmt: skip
        else:
            made = _playing(task, bodies, int(plant), severity, positioning, seed)
        _serve_team(made, calibrated, (bind, port), host_port(robot, "--robot"), pool_file, duration)
        return
    usual: Any = {"pool": "pictures", "tank": "corners"}.get(
        site or ("pool" if world is None else ""), "none"
    )
    camera = camera or ("none" if ardusub else usual)
    plan = make_plan(
        vehicle, plant, severity, camera=camera, seed=seed, site=site, firmware=firmware, world=world
    )
    plan = replace(plan, positioning=positioning)
    if start is None and world is not None and site is None:
        view = load_world(world).viewpoint
        start = ",".join(f"{x:g}" for x in (*view.position, math.degrees(view.yaw)))
    start = start or f"0,0,{-0.5 * plan.spec.basin.depth:g},0"
    begin = station_of(start)
    _check_start(begin, plan.spec.basin, start)
    if not (0 < port or (ardusub and not lockstep and camera == "none")) or port > 65533:
        raise LinkError(f"port {port}: expected 1 to 65533, as the two after it are taken too")
    if pool_file is not None and plan.calibrated is None:
        raise PlantSpecError("--pool-file tells of the camera, and --camera none has none: leave one out")

    def make_world(eye: Any) -> VirtualPool:
        """Begins to write files: only when every wire is open, lest those of a pool that is running are replaced."""
        world = plan.world(eye, start=begin, seed=seed, truth=truth)
        if pool_file is not None and plan.calibrated is not None:
            write_pool(plan.calibrated, pool_file)
        _tell_plant(plan, pool_file, truth)
        return world

    longest = math.inf if duration is None else duration
    if lockstep:
        _lockstep(plan, make_world, (bind, port + 2), longest)
    else:
        links = None
        if ardusub:
            stations = (
                []
                if ground == "none"
                else [host_port(text.strip(), "--ground") for text in ground.split(",")]
            )
            links = partial(
                GroundLinks, (bind, port), stations, host_port(tcp, "--tcp"), host_port(dvl, "--dvl")
            )
        _realtime(plan, make_world, (bind, port), host_port(robot, "--robot"), longest, links)


def _serve_team(
    made: Fleet,
    calibrated: Pool | None,
    ours: tuple[str, int],
    theirs: tuple[str, int],
    pool_file: Path | None,
    duration: float | None,
) -> None:
    """Serve several vehicles, each to a robot of its own, from their first addresses on ten ports apart."""
    (bind, port), (host, first) = ours, theirs
    names = made.task.agents if isinstance(made, TaskSite) else tuple(made.worlds)
    if not 0 < port <= 65535 - 10 * len(names):
        raise LinkError(f"port {port}: expected room for ten ports to each of {len(names)} vehicles after it")
    with _stoppable() as asked, ExitStack() as stack:
        stack.callback(made.close)
        messages, sinks = None, []
        if isinstance(made, TaskSite):
            messages = MediumServer((bind, port + MESSAGES), made.carrier, names)
            stack.callback(messages.close)
        transports = {}
        for i, name in enumerate(names):
            transports[name] = UdpTransport((bind, port + 10 * i), (host, first + 10 * i))
            stack.callback(transports[name].close)
            _say(f"{name}: {_name(transports[name].address)}, for {_name(transports[name].peer)} alone")
            if calibrated is not None:
                sinks.append(UdpSender((bind, port + 10 * i + 1), (host, first + 10 * i + 1)))
                stack.callback(sinks[-1].close)
        if calibrated is not None and pool_file is not None:
            write_pool(calibrated, pool_file)
            _say(f"pool file: {pool_file}")
        if messages is not None and isinstance(made, TaskSite):
            _tell_goal(made)
            _say(f"messages: {_name(messages.address)}")
        longest = math.inf if duration is None else duration
        tell = partial(_tell_episode, made)
        pace = serve_realtime(
            made, transports, messages, sinks=sinks, duration=longest, until=asked, over=tell
        )
    if not made.over:
        _tell_episode(made)
    _say(f"ended after {pace.duration:.1f} s")


def _playing(
    task: str, bodies: Sequence[Vehicle], plant: int, severity: Severity, positioning: str, seed: int
) -> TaskSite:
    """The site of a task in open water; its own vehicles are of the first type."""
    fitted = fitted_task(task, bodies[0])
    if len(bodies) not in (1, len(fitted.agents)):
        raise PlantSpecError(
            f"--team names {len(bodies)} vehicles, but task '{fitted.name}' has {len(fitted.agents)} agents: "
            f"{', '.join(fitted.agents)}"
        )
    agents = list(bodies) * (len(fitted.agents) // len(bodies))
    return TaskSite(
        task,
        [*agents, *[bodies[0]] * len(fitted.others)],
        lambda v: site_of("open-water", draw_plant(v, plant, severity)),
        None,
        None,
        seed=seed,
        communication=getattr(fitted, "communication", None),
        positioning=positioning,
    )


def swimming(
    bodies: Sequence[Vehicle],
    plant: int,
    severity: Severity,
    camera: str,
    site: str,
    positioning: str,
    *,
    truth: Path | None,
    seed: int,
) -> tuple[Fleet, Pool | None]:
    """Vehicles side by side, robot_1 and so on, and what their robots may know of the one camera.

    Args:
        bodies: As their files have them.
        plant: Seed of the first plant and of the camera; the others' follow.
        severity: Of plants and camera.
        camera: corners or none.
        site: Where, a name of `SITES`.
        positioning: On every robot's wire: none, motion-capture or usbl.
        truth: Folder that takes NAME.truth of each; none if None.
        seed: Of instruments and noise.

    Raises:
        PlantSpecError: They have no room, or the camera cannot be there.
    """
    if camera == "pictures" and site != "open-water":
        raise PlantSpecError("the one camera over a team sends corners: give --camera corners, or none")
    if site == "open-water" and camera != "none":
        raise PlantSpecError("no camera hangs over open water: give --camera none, and a positioning")
    ours = [numbered(vehicle_at(site, body), i) for i, body in enumerate(bodies)]
    specs = [site_of(site, draw_plant(v, plant + i, severity)) for i, v in enumerate(ours)]
    basin = specs[0].basin
    apart = ROOM * max(max(v.body.size) for v in ours)
    if apart * len(ours) > basin.length:
        raise PlantSpecError(
            f"{len(ours)} vehicles {apart:.1f} m apart have no room in {basin.length:g} m: take a larger --site"
        )
    eyes: list[PoolCamera | None] = [None] * len(ours)
    calibrated = None
    if camera == "corners":
        true, calibrated, settings = camera_of(ours[0], plant, severity, basin=basin)
        for i, v in enumerate(ours):
            own = camera_of(v, plant, severity, basin=basin)[2]
            eyes[i] = PoolCamera(
                v,
                true,
                mode="corners",
                settings=replace(settings, mounts=own.mounts),
                seed=seed,
                noise_seed=seed + 1000 * (i + 1),
            )
    worlds = {}
    for i, (v, spec, eye) in enumerate(zip(ours, specs, eyes, strict=True)):
        name = f"robot_{i + 1}"
        x = apart * (i - 0.5 * (len(ours) - 1))
        worlds[name] = VirtualPool(
            v,
            spec,
            camera=eye,
            positioning=positioning_of(positioning, seed + i),
            start=((x, 0.0, -0.5 * basin.depth), quat_from_yaw(0.0)),
            seed=seed + i,
            truth=None if truth is None else truth / f"{name}.truth",
        )
    return Fleet(worlds), calibrated


def _tell_goal(site: TaskSite) -> None:
    """Where the task's goal is, of one that stands still."""
    if site.task.moving:
        return
    x, y, z = site.referee.arrays.goal_position.numpy()[0]
    yaw = math.degrees(float(quat_yaw(site.referee.arrays.goal_quaternion.numpy()[0].astype(float))))
    _say(f"goal: {x:.3f},{y:.3f},{z:.3f},{yaw:.1f}")


def _tell_episode(site: Fleet) -> None:
    """How the episode went, in a line."""
    if not isinstance(site, TaskSite):
        return
    if site.referee.over:
        _say("episode: " + ", ".join(f"{name} {value:.4g}" for name, value in site.referee.metrics().items()))
    else:
        _say(f"episode: not ended after {site.scored} control steps")


def _check_start(start: Station, basin: Basin, text: str) -> None:
    x, y, z = start.position
    if abs(x) > 0.5 * basin.length or abs(y) > 0.5 * basin.width or not -basin.depth <= z <= 0.0:
        raise PlantSpecError(
            f"--start {text} is outside the pool: expected x within ±{0.5 * basin.length:g} m, "
            f"y within ±{0.5 * basin.width:g} m and z from {-basin.depth:g} to 0 m"
        )


def _lockstep(
    plan: PoolPlan, make_world: Callable[[Any], VirtualPool], address: tuple[str, int], duration: float
) -> None:
    with ExitStack() as stack:
        server = LockstepServer(address)
        stack.callback(server.close)
        world = make_world(plan.eye())
        stack.callback(world.close)
        why = "stopped"
        _say(f"lock-step: {_name(server.address)}")
        with suppress(KeyboardInterrupt), _stoppable(at_once=True):
            why = server.serve(world, duration=duration)
    _say(f"{why} at {world.time:.1f} s")


def _realtime(
    plan: PoolPlan,
    make_world: Callable[[Any], VirtualPool],
    bind: tuple[str, int],
    robot: tuple[str, int],
    duration: float,
    links: Callable[[], GroundLinks] | None,
) -> None:
    with _stoppable() as asked, ExitStack() as stack:
        transport = UdpTransport(bind, robot) if links is None else links()
        stack.callback(transport.close)
        drawn, sink, eye = _camera(plan, _next(bind), _next(robot))
        for end in (drawn, sink):
            if end is not None:
                stack.callback(end.close)
        world = make_world(eye)
        stack.callback(world.close)
        if isinstance(transport, GroundLinks):
            _say(f"autopilot: {_name(transport.address)} (UDP), {_name(transport.tcp)} (TCP)")
            _say(f"Doppler log: {_name(transport.dvl.address)}")
        else:
            _say(f"motor controller: {_name(transport.address)}, for {_name(transport.peer)} alone")
        if eye is not None:
            _say(f"pictures: {_name(_next(bind))}, for {_name(_next(robot))}")
        site, sinks = Fleet({plan.vehicle.name: world}), [] if sink is None else [sink]
        transports = {plan.vehicle.name: transport}
        pace = serve_realtime(site, transports, sinks=sinks, camera=drawn, duration=duration, until=asked)
        _say(pace.sentence)
        if drawn is not None and drawn.dropped:
            _say(drawn.complaint)


def _camera(
    plan: PoolPlan, bind: tuple[str, int], peer: tuple[str, int]
) -> tuple[PictureProcess | None, UdpSender | None, Any]:
    """The process that draws, or the sink for what is computed here, and the camera for the world."""
    plans: list[Plan] = [one for one in (plan.camera, plan.onboard) if one is not None]
    if not plans:
        return None, None, None
    if plan.onboard is None and plan.camera is not None and plan.camera.mode == "corners":
        return None, UdpSender(bind, peer), plan.camera.camera()
    drawn = PictureProcess(plans, bind, peer)
    return drawn, None, drawn


@contextmanager
def _stoppable(*, at_once: bool = False) -> Iterator[Callable[..., bool]]:
    """Let Ctrl-C and SIGTERM ask for the end, or end a wait at once; gives whether they did. The second ends all."""
    asked = False
    before: dict[int, Any] = {}

    def stop(number: int, frame: object) -> None:
        nonlocal asked
        if asked or at_once:
            raise KeyboardInterrupt
        asked = True

    for number in (signal.SIGINT, signal.SIGTERM):
        before[number] = signal.signal(number, stop)
    try:
        yield lambda *_: asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _next(address: tuple[str, int]) -> tuple[str, int]:
    """Pictures leave and arrive at the port after that of the motor controller's wire."""
    return address[0], address[1] + 1


def _tell_plant(plan: PoolPlan, pool_file: Path | None, truth: Path | None) -> None:
    spec = plan.spec
    _say(f"plant: {spec.title}, {spec.severity}, seed {spec.seed}")
    if plan.camera is not None:
        s = plan.camera.settings
        _say(
            f"camera: {plan.camera.mode}, {s.rate:g} Hz, {plan.camera.site.camera.lens.width} x "
            f"{plan.camera.site.camera.lens.height}, ripples of slope {s.ripples:g}"
        )
    if plan.onboard is not None:
        rates = (f"{name} {sensor.rate:g} Hz" for name, sensor in plan.vehicle.perception.items())
        _say(f"world: {plan.onboard.world}, seed {plan.onboard.seed}; {', '.join(rates)}")
    for name, path in (("pool file", pool_file), ("truth", truth)):
        if path is not None:
            _say(f"{name}: {path}")


def _name(address: tuple[str, int]) -> str:
    return f"{address[0]}:{address[1]}"


def _say(line: str) -> None:
    print(line, flush=True)
    sys.stdout.flush()
