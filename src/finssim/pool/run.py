"""`finssim pool`: create a plant, a camera and a motor controller, and serve a robot until a signal stops the pool."""

from __future__ import annotations

import logging
import math
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from finssim.control.guidance import Station
from finssim.core.rotations import quat_from_yaw, quat_yaw
from finssim.localization.overhead_camera import Pool, write_pool
from finssim.pool.camera import PoolCamera, camera_of
from finssim.pool.drawn_plant import draw_plant, positioning_of, site_of
from finssim.pool.fleet import Fleet
from finssim.pool.pictures import PictureProcess, PictureSourcePlan, UdpSender
from finssim.pool.plan import PoolPlan, make_plan
from finssim.pool.plant_spec import Basin, PlantSpec, PlantSpecError, Severity
from finssim.pool.real_time import PoolTiming, SiteWires, serve_realtime
from finssim.pool.servers import GroundLinks, LockstepServer, MediumServer
from finssim.pool.task_site import PositionSources, TaskSite
from finssim.pool.virtual_pool import VirtualPool
from finssim.robot.goals import station_of
from finssim.robot.interrupt import interruptible, interrupting
from finssim.robot.links.frames import LinkError
from finssim.robot.links.transports import UdpTransport, host_port
from finssim.sim.site import described_world
from finssim.sim.water import load_water
from finssim.tasks.observer import fitted_task
from finssim.vehicles import Vehicle, load_vehicle
from finssim.vehicles.defaults import numbered, vehicle_at

__all__ = ["MCU_PORT", "Ends", "PoolFiles", "SiteChoice", "run", "swimming"]

MCU_PORT = 58766
"""Port of the motor controller; pictures come from the next port, lock-step uses the one after."""
MESSAGES = 5
"""Offset of the port for messages of a team from the first port."""
ROOM = 2.0
"""Distance between the starts of a team's vehicles, in lengths of the longest vehicle."""


@dataclass(frozen=True, kw_only=True)
class SiteChoice:
    """Site, and plant of its vehicle."""

    vehicle: str = "finsrov"
    """(NAME|FILE) Vehicle in the catalogue, or path of a vehicle file."""
    plant: str = "1"
    """(SEED|FILE) Plant: a seed to draw it from, or a plant file."""
    severity: Severity = "realistic"
    """(NAME) How much a drawn plant and its camera differ from the files: nominal, realistic or hard."""
    site: str | None = None
    """(NAME) Site: pool (default), tank or open-water (current, waves, 20 m deep); for a world the default is its
    basin, or open water down to its seabed."""
    world: str | None = None
    """(SITE|FILE) World for the vehicle's own cameras, sonars and altimeters, drawn from --seed: a site of finssim
    worlds, or a world file. Readings are sent like images."""
    water: Path | None = None
    """(FILE) Water file (.yaml): currents, a profile over depth and time, waves or a sea state, which add to the site's
    own."""
    start: str | None = None
    """(X,Y,Z,YAW) Start of the vehicle, world frame: x,y,z [m], yaw [deg]; the centre, or the viewpoint of a world, if
    not given."""
    camera: Literal["pictures", "corners", "none"] | None = None
    """(KIND) Output of the camera: pictures, corners (of the tags) or none. Default: pictures; corners for a team or a
    tank; none in open water, with a world or a task, and with ardusub."""
    positioning: str = "none"
    """(NAME) Position fixes on the robot's link: none, motion-capture or usbl."""
    firmware: Literal["mcu", "ardusub"] = "mcu"
    """(NAME) Firmware: mcu, the motor controller of `finssim run`, or ardusub, an autopilot that behaves like ArduSub
    over MAVLink, with a compass and a Doppler log."""
    version: Literal["4.1", "4.5", "4.7"] = "4.5"
    """(VERSION) ArduSub version, with ardusub: 4.5 is as recorded; 4.1 has no pitch and roll axes, 4.7 has other
    parameter names and SURFACE_MAX_THR."""
    seed: int = 1
    """Seed of every random number; equal seeds give equal results."""

    def wet(self, spec: PlantSpec) -> PlantSpec:
        """Return the plant with the water of the water file.

        Raises:
            SurroundingsError: The file is refused.
        """
        if self.water is None:
            return spec
        water = load_water(self.water)
        if water.drifting or any(water.shear):
            raise PlantSpecError(
                f"{self.water}: shear and drift_std are not for the pool: give the table of a current"
            )
        circulation = spec.circulation.model_copy(update={"water": water})
        return spec.model_copy(update={"circulation": circulation})

    def plan(self) -> tuple[PoolPlan, Station]:
        """Return the pool of one vehicle, and the start of the vehicle.

        Raises:
            PlantSpecError: The plant cannot be created, or the start is outside the pool.
        """
        usual: Any = {"pool": "pictures", "tank": "corners"}.get(
            self.site or ("pool" if self.world is None else ""), "none"
        )
        plan = make_plan(
            self.vehicle,
            self.plant,
            self.severity,
            camera=self.camera or ("none" if self.firmware == "ardusub" else usual),
            seed=self.seed,
            site=self.site,
            firmware=self.firmware,
            world=self.world,
        )
        if self.version != "4.5" and self.firmware != "ardusub":
            raise PlantSpecError(f"--version {self.version} is ArduSub's: give --firmware ardusub")
        firmware = plan.spec.firmware.model_copy(update={"version": self.version})
        plan = replace(plan, spec=self.wet(plan.spec.model_copy(update={"firmware": firmware})))
        start = self.start
        if start is None and self.world is not None and self.site is None:
            view = described_world(self.world).viewpoint
            start = ",".join(f"{x:g}" for x in (*view.position, math.degrees(view.yaw)))
        start = start or f"0,0,{-0.5 * plan.spec.basin.depth:g},0"
        begin = station_of(start)
        _check_start(begin, plan.spec.basin, start)
        return replace(plan, positioning=self.positioning), begin


@dataclass(frozen=True, kw_only=True)
class Ends:
    """Addresses of a pool."""

    port: int = MCU_PORT
    """UDP port of the motor controller; images use the next port, lock-step (TCP) the one after. With ardusub, 0
    selects a free one."""
    bind: str = "127.0.0.1"
    """(ADDRESS) Local address; only this machine if not given."""
    robot: str = "127.0.0.1:54321"
    """(HOST:PORT) The only robot that may send commands in real time; images are sent to the next port."""
    ground: str = "127.0.0.1:14550"
    """(HOST:PORT,...) With ardusub: UDP ground stations to send to; every sender to --port also receives frames."""
    tcp: str = "127.0.0.1:5760"
    """(HOST:PORT) With ardusub: TCP address for ground stations; port 0 selects a free one."""
    dvl: str = "127.0.0.1:16171"
    """(HOST:PORT) With ardusub: TCP address of the Water Linked DVL; port 0 selects a free one."""
    dvl_page: str | None = None
    """(HOST:PORT) With ardusub: TCP address of the DVL's web page, by which BlueOS finds it; none if not given."""

    @property
    def ours(self) -> tuple[str, int]:
        """First address of the pool."""
        return self.bind, self.port

    @property
    def theirs(self) -> tuple[str, int]:
        """First address of the robot."""
        return host_port(self.robot, "--robot")

    def ground_links(self) -> Callable[[], GroundLinks]:
        """Return a function that opens the links of an autopilot, which replace the motor controller's link."""
        texts = [] if self.ground == "none" else self.ground.split(",")
        stations = [host_port(text.strip(), "--ground") for text in texts]
        page = None if self.dvl_page is None else host_port(self.dvl_page, "--dvl-page")
        tcp, dvl = host_port(self.tcp, "--tcp"), host_port(self.dvl, "--dvl")
        return partial(GroundLinks, self.ours, stations, tcp, dvl, page)


@dataclass(frozen=True, kw_only=True)
class PoolFiles:
    """Files that a pool writes."""

    pool_file: Path | None = None
    """(FILE) Pool file to write, with the calibrated camera (.yaml)."""
    truth: Path | None = None
    """(FILE) File for the true states, for scoring; for a team a folder."""


def run(
    choice: Annotated[SiteChoice, "options"],
    ends: Annotated[Ends, "options"],
    *,
    task: str | None = None,
    team: str | None = None,
    lockstep: bool = False,
    files: Annotated[PoolFiles, "options"] = PoolFiles(),
    duration: Annotated[float | None, (0.0, None)] = None,
    timing: Annotated[PoolTiming | None, "python"] = None,
) -> None:
    """Simulate a vehicle and its pool for a robot on this machine, until Ctrl-C.

    Example: finssim pool --plant 1 --severity realistic --pool-file pool.yaml --truth truth.fst

    Args:
        choice: The site, and the plant of its vehicle.
        ends: Addresses.
        task (TASK): Run the site of a task in open water, in real time, with ports as for --team; messages between
            robots use the port of --port plus five. Other agents of the task are simulated, and the task scores the
            truth.
        team (NAME,NAME): Several vehicles at one site, in real time: names or files separated by commas, as agents
            of --task or without a task. The ports of each further motor controller and robot are higher by ten than
            --port and --robot. A camera sees all of them, with different tag ids.
        lockstep: Advance time as fast as one robot requests, instead of in real time.
        files: Files that are written.
        duration: Duration, pool's clock [s]; until Ctrl-C if not given.
        timing: Clock of the pool; that of this machine if not given.

    Raises:
        PlantSpecError, LinkError, GoalError, VehicleError, OutputError: What cannot be used.
    """
    logging.basicConfig(level=logging.WARNING, format="finssim: %(message)s", stream=sys.stderr)
    positioning_of(choice.positioning, choice.seed)  # refuses an unknown name
    longest = math.inf if duration is None else duration
    timing = timing or PoolTiming()
    if task is not None or team is not None:
        if choice.firmware == "ardusub":
            raise PlantSpecError("--firmware ardusub is for one vehicle: leave --team and --task out")
        written = task is not None and files != PoolFiles()
        single = lockstep or choice.start is not None or choice.world is not None
        if not choice.plant.isdecimal() or single or written:
            raise PlantSpecError(
                "--team and --task draw plants and starts, and run in real time: give a seed for --plant, leave "
                "--lockstep, --start and --world out, with --task also --pool-file and --truth"
            )
        bodies = [load_vehicle(name.strip()) for name in (team or choice.vehicle).split(",")]
        fleet, calibrated = (
            _playing(task, bodies, choice) if task is not None else swimming(bodies, choice, files.truth)
        )
        _serve_team(fleet, calibrated, ends, files.pool_file, longest, timing)
        return
    plan, begin = choice.plan()
    port, ardusub = ends.port, choice.firmware == "ardusub"
    if not (0 < port or (ardusub and not lockstep and plan.camera is None)) or port > 65533:
        raise LinkError(f"port {port}: expected 1 to 65533, as the pool also uses the next two ports")
    if files.pool_file is not None and plan.calibrated is None:
        raise PlantSpecError("--pool-file describes the camera, and --camera none has none: omit one")

    def make_world(eye: Any) -> VirtualPool:
        """Create the pool and its files; only called when every link is open, so that files of a running pool are
        not replaced."""
        world = plan.world(eye, start=begin, seed=choice.seed, truth=files.truth)
        if files.pool_file is not None and plan.calibrated is not None:
            write_pool(plan.calibrated, files.pool_file)
        _print_plant(plan, files)
        return world

    if lockstep:
        _lockstep(plan, make_world, (ends.bind, port + 2), longest)
    else:
        links = ends.ground_links() if ardusub else None
        _realtime(plan, make_world, ends.ours, ends.theirs, longest, links, timing)


def _serve_team(
    fleet: Fleet,
    calibrated: Pool | None,
    ends: Ends,
    pool_file: Path | None,
    duration: float,
    timing: PoolTiming,
) -> None:
    """Serve several vehicles, each to a separate robot; their ports are ten apart, from the first addresses on."""
    (bind, port), (host, first) = ends.ours, ends.theirs
    names = fleet.task.agents if isinstance(fleet, TaskSite) else tuple(fleet.worlds)
    if not 0 < port <= 65535 - 10 * len(names):
        raise LinkError(f"port {port}: expected room for ten ports to each of {len(names)} vehicles after it")
    with interruptible() as interrupted, ExitStack() as stack:
        stack.callback(fleet.close)
        messages = timing.messages(fleet)
        sinks: list[UdpSender] = []
        if isinstance(fleet, TaskSite):
            messages = server = MediumServer((bind, port + MESSAGES), fleet.carrier, names)
            stack.callback(server.close)
        transports = {}
        for i, name in enumerate(names):
            transports[name] = UdpTransport((bind, port + 10 * i), (host, first + 10 * i))
            stack.callback(transports[name].close)
            _print(f"{name}: {_name(transports[name].address)}, for {_name(transports[name].peer)} alone")
            if calibrated is not None:
                sinks.append(UdpSender((bind, port + 10 * i + 1), (host, first + 10 * i + 1)))
                stack.callback(sinks[-1].close)
        if calibrated is not None and pool_file is not None:
            write_pool(calibrated, pool_file)
            _print(f"pool file: {pool_file}")
        if isinstance(fleet, TaskSite):
            _print_goal(fleet)
            _print(f"messages: {_name(server.address)}")
        notify = partial(_print_episode, fleet)
        pace = serve_realtime(
            fleet,
            SiteWires(transports, messages, sinks),
            duration=duration,
            until=interrupted,
            over=notify,
            clock=timing.now,
            wait=lambda duration: timing.wait(duration, interrupted),
        )
    if not fleet.over:
        _print_episode(fleet)
    _print(f"ended after {pace.duration:.1f} s")


def _playing(task: str, bodies: Sequence[Vehicle], choice: SiteChoice) -> tuple[TaskSite, None]:
    """Return the site of a task in open water, without a camera; its other vehicles are of the first type."""
    fitted = fitted_task(task, bodies[0])
    if len(bodies) not in (1, len(fitted.agents)):
        raise PlantSpecError(
            f"--team names {len(bodies)} vehicles, but task '{fitted.name}' has {len(fitted.agents)} agents: "
            f"{', '.join(fitted.agents)}"
        )
    agents = list(bodies) * (len(fitted.agents) // len(bodies))
    vehicles, positions = (
        [*agents, *[bodies[0]] * len(fitted.others)],
        PositionSources(positioning=choice.positioning),
    )
    plants = [
        (v, choice.wet(site_of("open-water", draw_plant(v, int(choice.plant), choice.severity))))
        for v in vehicles
    ]
    site = TaskSite(task, vehicles, plants, None, positions, seed=choice.seed)
    return site, None


def swimming(bodies: Sequence[Vehicle], choice: SiteChoice, truth: Path | None) -> tuple[Fleet, Pool | None]:
    """Return vehicles side by side, robot_1 and so on, and the calibration of the camera for their robots.

    Args:
        bodies: Vehicles as in their files.
        choice: The site; its plant is the seed of the first vehicle's plant and of the camera, the other seeds follow.
        truth: Folder for NAME.truth of each vehicle; None for no truth files.

    Raises:
        PlantSpecError: The vehicles do not fit into the site, or the site has no camera.
    """
    site, plant, severity, seed = choice.site or "pool", int(choice.plant), choice.severity, choice.seed
    camera = choice.camera or ("none" if site == "open-water" else "corners")
    if camera == "pictures" and site != "open-water":
        raise PlantSpecError("the camera over a team sends only corners: give --camera corners, or none")
    if site == "open-water" and camera != "none":
        raise PlantSpecError("open water has no overhead camera: give --camera none, and a positioning")
    ours = [numbered(vehicle_at(site, body), i) for i, body in enumerate(bodies)]
    specs = [choice.wet(site_of(site, draw_plant(v, plant + i, severity))) for i, v in enumerate(ours)]
    basin = specs[0].basin
    spacing = ROOM * max(max(v.body.size) for v in ours)
    if spacing * len(ours) > basin.length:
        raise PlantSpecError(
            f"{len(ours)} vehicles {spacing:.1f} m apart do not fit into {basin.length:g} m: give a larger --site"
        )
    eyes: list[PoolCamera | None] = [None] * len(ours)
    calibrated = None
    if camera == "corners":
        true, calibrated, settings = camera_of(ours[0], plant, severity, basin=basin)
        for i, v in enumerate(ours):
            robot_settings = camera_of(v, plant, severity, basin=basin)[2]
            eyes[i] = PoolCamera(
                v,
                true,
                mode="corners",
                settings=replace(settings, mounts=robot_settings.mounts),
                seed=seed,
                noise_seed=seed + 1000 * (i + 1),
            )
    worlds = {}
    for i, (v, spec, eye) in enumerate(zip(ours, specs, eyes, strict=True)):
        name = f"robot_{i + 1}"
        x = spacing * (i - 0.5 * (len(ours) - 1))
        worlds[name] = VirtualPool(
            v,
            spec,
            camera=eye,
            positioning=positioning_of(choice.positioning, seed + i),
            start=((x, 0.0, -0.5 * basin.depth), quat_from_yaw(0.0)),
            seed=seed + i,
            truth=None if truth is None else truth / f"{name}.truth",
        )
    return Fleet(worlds), calibrated


def _print_goal(site: TaskSite) -> None:
    """Print the pose of the task's goal, if it does not move."""
    if site.task.moving:
        return
    x, y, z = site.referee.arrays.goal_position.numpy()[0]
    yaw = math.degrees(float(quat_yaw(site.referee.arrays.goal_quaternion.numpy()[0].astype(float))))
    _print(f"goal: {x:.3f},{y:.3f},{z:.3f},{yaw:.1f}")


def _print_episode(site: Fleet) -> None:
    """Print the result of the episode in one line."""
    if not isinstance(site, TaskSite):
        return
    if site.referee.over:
        _print(
            "episode: " + ", ".join(f"{name} {value:.4g}" for name, value in site.referee.metrics().items())
        )
    else:
        _print(f"episode: not ended after {site.scored} control steps")


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
        reason = "stopped"
        with suppress(KeyboardInterrupt), interrupting():
            _print(f"lock-step: {_name(server.address)}")
            reason = server.serve(world, duration=duration)
    _print(f"{reason} at {world.time:.1f} s")


def _realtime(
    plan: PoolPlan,
    make_world: Callable[[Any], VirtualPool],
    bind: tuple[str, int],
    robot: tuple[str, int],
    duration: float,
    links: Callable[[], GroundLinks] | None,
    timing: PoolTiming,
) -> None:
    with interruptible() as interrupted, ExitStack() as stack:
        transport = UdpTransport(bind, robot) if links is None else links()
        stack.callback(transport.close)
        drawn, sink, eye = _camera(plan, _next(bind), _next(robot), paced=timing.paced)
        for end in (drawn, sink):
            if end is not None:
                stack.callback(end.close)
        world = make_world(eye)
        stack.callback(world.close)
        if isinstance(transport, GroundLinks):
            _print(f"autopilot: {_name(transport.address)} (UDP), {_name(transport.tcp)} (TCP)")
            _print(f"Doppler log: {_name(transport.dvl.address)}")
        else:
            _print(f"motor controller: {_name(transport.address)}, for {_name(transport.peer)} alone")
        if eye is not None:
            _print(f"pictures: {_name(_next(bind))}, for {_name(_next(robot))}")
        site, sinks = Fleet({plan.vehicle.name: world}), [] if sink is None else [sink]
        transports = {plan.vehicle.name: transport}
        pace = serve_realtime(
            site,
            SiteWires(transports, sinks=sinks, camera=drawn),
            duration=duration,
            until=interrupted,
            clock=timing.now,
            wait=lambda duration: timing.wait(duration, interrupted),
        )
        _print(f"ended after {pace.duration:.1f} s" if timing.paced else pace.sentence)
        if drawn is not None and drawn.dropped:
            _print(drawn.complaint)


def _camera(
    plan: PoolPlan, bind: tuple[str, int], peer: tuple[str, int], *, paced: bool
) -> tuple[PictureProcess | None, UdpSender | None, Any]:
    """Return the process that renders, or the sender for pictures of this process, and the camera of the pool."""
    plans: list[PictureSourcePlan] = [
        plan_or_none for plan_or_none in (plan.camera, plan.onboard) if plan_or_none is not None
    ]
    if not plans:
        return None, None, None
    if paced or (plan.onboard is None and plan.camera is not None and plan.camera.mode == "corners"):
        return None, UdpSender(bind, peer), plan.eye()
    drawn = PictureProcess(plans, bind, peer)
    return drawn, None, drawn


def _next(address: tuple[str, int]) -> tuple[str, int]:
    """Return the address for pictures: the port after that of the motor controller's link."""
    return address[0], address[1] + 1


def _print_plant(plan: PoolPlan, files: PoolFiles) -> None:
    spec = plan.spec
    _print(f"plant: {spec.title}, {spec.severity}, seed {spec.seed}")
    if plan.camera is not None:
        s = plan.camera.settings
        _print(
            f"camera: {plan.camera.mode}, {s.rate:g} Hz, {plan.camera.site.camera.lens.width} x "
            f"{plan.camera.site.camera.lens.height}, ripples of slope {s.ripples:g}"
        )
    if plan.onboard is not None:
        rates = (f"{name} {sensor.rate:g} Hz" for name, sensor in plan.vehicle.perception.items())
        _print(f"world: {plan.onboard.name}, seed {plan.onboard.seed}; {', '.join(rates)}")
    for name, path in (("pool file", files.pool_file), ("truth", files.truth)):
        if path is not None:
            _print(f"{name}: {path}")


def _name(address: tuple[str, int]) -> str:
    return f"{address[0]}:{address[1]}"


def _print(line: str) -> None:
    print(line, flush=True)
    sys.stdout.flush()
