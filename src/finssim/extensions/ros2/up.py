"""Run ROS 2 nodes, with or without a ROS 2 installation.

Example: finssim ros2 up pool
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import yaml

from finssim.core.system import PARENT, SEPARATE, interrupt
from finssim.extensions.ros2 import Ros2Error
from finssim.extensions.ros2.backend import activate
from finssim.extensions.ros2.topics import TOPICS, Topic
from finssim.robot.goals import check_reachable, guide_of, place_of
from finssim.robot.interrupt import interruptible
from finssim.vehicles import load_vehicle
from finssim.vehicles.defaults import vehicle_at

if TYPE_CHECKING:
    from finssim.extensions.ros2.nodes.remote import Watcher

__all__ = [
    "GRAPHS",
    "MCU_PORT",
    "NODES",
    "Options",
    "GraphPlan",
    "launch_arguments",
    "launched",
    "plan_of",
    "run_node",
    "topics_of",
]


PATIENCE = 10.0
"""Time that a node has to end before it is killed [s]."""


@dataclass
class Child:
    """One node's process."""

    name: str
    process: subprocess.Popen[bytes]
    dead: bool = False


class Supervisor:
    """Runs the nodes of a plan. Use it as a context: whatever happens, no process is left."""

    def __init__(self, plan: GraphPlan, parameters: Path, notify: Callable[[str], None]) -> None:
        """
        Args:
            plan: Nodes and namespace.
            parameters: File that `plan.write` wrote.
            notify: Takes a sentence for the person who watches.
        """
        self._plan, self._parameters, self._say = plan, parameters, notify
        self.children: list[Child] = []

    def __enter__(self) -> Supervisor:
        return self

    def __exit__(self, *error: object) -> None:
        self.end()

    def start(self, name: str) -> Child:
        """Start a node; it ends with this process even if that is killed."""
        ros = ["--ros-args", "-r", f"__ns:=/{self._plan.namespace}", "--params-file", str(self._parameters)]
        command = [sys.executable, "-m", "finssim", "ros2", "node", name, *ros]
        environment = {**os.environ, PARENT: str(os.getpid())}
        # In a separate session: Ctrl-C reaches this process alone, and the nodes end in our order.
        process = subprocess.Popen(
            command,
            env=environment,
            stdin=subprocess.DEVNULL if name != "teleop" else None,
            **SEPARATE,
        )
        child = Child(name, process)
        self.children.append(child)
        self._say(f"{name}: process {process.pid}")
        return child

    def look(self) -> list[Child]:
        """Return the nodes that have died since the last call, each once."""
        died = [c for c in self.children if not c.dead and c.process.poll() is not None]
        for child in died:
            child.dead = True
            self._say(
                f"{child.name} has died: process {child.process.pid}, {_status(child.process.returncode)}"
            )
        return died

    def end(self) -> None:
        """End all, those first that were started last."""
        for child in reversed(self.children):
            if child.process.poll() is None:
                interrupt(child.process)
        limit = time.monotonic() + PATIENCE
        for child in reversed(self.children):
            try:
                child.process.wait(max(limit - time.monotonic(), 0.1))
            except subprocess.TimeoutExpired:
                self._say(f"{child.name} does not end: killed")
                child.process.kill()
                child.process.wait()
            child.dead = True


def _status(code: int) -> str:
    """A return code in words."""
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"status {code}"


# `finssim ros2 up`: a complete graph of nodes as processes, without ROS installed.


DIED, FAULT = 1, 3
"""Exit status where a node died, and where the bridge ended in a fault."""
STARTING = 180.0
"""Time for the virtual pool to write its pool file [s]; the first rendering on a machine compiles."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command."""

    policy: str = "pid"
    """(DIR|pid|pid-paper) A policy's directory, or pid, or pid-paper."""
    task: str | None = None
    """Task that the policy must have been trained for; its own if not given."""
    vehicle: str = "finsrov"
    """(NAME|FILE) Vehicle in the catalogue, or path of a vehicle file."""
    namespace: str | None = None
    """(NAME) Namespace of the vehicle's topics and prefix of its frames, such as robot_1, if there are several
    vehicles. The vehicle's name, without prefix, if not given."""
    frame_prefix: str | None = None
    """(PREFIX/) Prefix of the vehicle's frames in /tf, if not the namespace's."""
    site: str = "pool"
    """(NAME) Site: pool, tank or open-water (DVL and compass instead of a camera)."""
    world: str | None = None
    """(SITE|FILE) World for the own cameras, sonars and altimeters of a vehicle in a virtual pool; in open water
    also its water. The node camera publishes them."""
    positioning: str = "none"
    """(NAME) Position fixes of a virtual pool: none, motion-capture or usbl."""
    let_in: str | None = None
    """(X,Y) Position at the start, in the map [m], for dead reckoning by DVL and compass, without camera and
    position fixes."""
    goal: str | None = None
    """(X,Y,Z,YAW|FILE) Station to keep: x,y,z [m] in the map (z = 0 at the surface) and heading [deg], or a file;
    the
    position at arming if not given. The topic goal changes it."""
    trajectory: str | None = None
    """(NAME|FILE) Trajectory to follow instead of a goal: a name or a file."""
    arm: bool = False
    """Arm once, as soon as the state is known; otherwise the topic arm does."""
    robot: str = "pool"
    """(ADDRESS) Motor controller of a robot: udp://HOST:PORT, serial:DEVICE, or pool for a finssim pool on
    this machine; or its autopilot: mavlink or mavlink://KIND:ADDRESS, as in finssim run."""
    bind: str = "127.0.0.1:54321"
    """(ADDRESS:PORT) Local address and port for udp; images arrive at the next port."""
    pictures: str | None = None
    """(ADDRESS) Overhead camera of a robot: udp://HOST:PORT or none; the pool's with --robot pool."""
    pool_file: Path | None = None
    """(FILE|none) Pool file: read by a robot, written by a virtual pool (.yaml); none without an overhead camera."""
    plant: str = "1"
    """(SEED|FILE) Plant of a virtual pool: a seed, or a file."""
    severity: str = "realistic"
    """(NAME) Of a drawn plant: nominal, realistic or hard."""
    camera: str | None = None
    """(KIND) Output of a virtual pool's camera: pictures, corners (of the tags) or none, which is none for a robot
    too. Default: pictures, in a tank corners."""
    port: int = 58766
    """UDP port of a virtual pool; images use the next port."""
    truth: Path | None = None
    """(FILE) Truth file of a virtual pool."""
    start: str | None = None
    """(X,Y,Z,YAW) Where the vehicle starts in sim and pool: x,y,z [m], yaw [deg]."""
    hydrodynamics: str | None = None
    """(MODEL) Model of sim: calibrated, mesh or simplified."""
    record: Path | None = None
    """(FILE) Record all topics to this file (.mcap)."""
    teleop: str | None = None
    """(DEVICE) Also drive by hand: joy (topic), gamepad or keyboard. The bridge then arms without localization."""
    duration: Annotated[float | None, (0.0, None)] = None
    """Duration [s]; until Ctrl-C if not given."""
    seed: int = 1
    """Seed of every random number; equal seeds give equal results."""


LAUNCHED = {
    "sim": "policy task goal trajectory start hydrodynamics seed record teleop",
    "robot": "robot bind port pictures camera pool_file let_in policy task goal trajectory record teleop",
    "pool": "bind port plant severity camera pool_file positioning world start truth seed",
}
"""Graph -> options that its launch file takes besides those of every vehicle; arming needs a message there."""


def launch_arguments(graph: str) -> list[str]:
    """Return the options that a graph's launch file takes as arguments."""
    return f"vehicle namespace frame_prefix site {LAUNCHED[graph]}".split()


def launched(graph: str, given: Mapping[str, str]) -> tuple[str, dict[str, dict[str, Any]]]:
    """Plan a launch file: as `up` does, but what is not given is left to parameter files and nodes.

    The launch file `pool` starts the virtual pool alone, and `robot` the robot in it.

    Args:
        graph: sim, pool or robot.
        given: Launch argument -> text, of those that a person gave.

    Returns:
        Namespace, and node -> parameters.

    Raises:
        Ros2Error, VehicleError, GoalError, ControlError: As of `plan_of`, or a number that is none.
    """
    values: dict[str, Any] = {**given}
    for name in {"port", "seed"} & given.keys():
        if not given[name].isdecimal():
            raise Ros2Error(f"{name}:={given[name]}: expected an integer")
        values[name] = int(given[name])
    nothing = dict.fromkeys((option.name for option in fields(Options)), None)
    pool_file = given.get("pool_file", "pool.yaml" if graph == "pool" else None)
    plan = plan_of(graph, Options(**{**nothing, **values}), pool_file)
    nodes = [node for node in plan.nodes if graph != "pool" or node not in ROBOT]
    shared = plan.parameters["/**"]
    return plan.namespace, {node: {**shared, **plan.parameters.get(node, {})} for node in nodes}


def plan_of(graph: str, options: Options, pool_file: Path | str | None) -> GraphPlan:
    """Return nodes and parameters; an option that is None leaves a parameter to the node.

    Args:
        graph: sim, pool or robot.
        options: As the person chose.
        pool_file: That robot's nodes read, and the virtual pool writes; None: the nodes' own.

    Raises:
        Ros2Error: There is no such graph.
        VehicleError, GoalError, ControlError: A vehicle, goal or trajectory that cannot be used.
    """
    o, vehicle = options, vehicle_at(options.site or "pool", load_vehicle(options.vehicle or "finsrov"))
    blind = o.site == "open-water" or "none" in (str(o.pool_file), o.camera)
    if o.vehicle is not None and (o.goal is not None or o.trajectory is not None):
        check_reachable(guide_of(o.goal, o.trajectory), vehicle)
    extra = (*(("recorder",) if o.record else ()), *(("teleop",) if o.teleop else ()))
    namespace = o.namespace or vehicle.name.replace("-", "_")
    sees = o.world is not None or o.pictures not in (None, "none")
    plan = GraphPlan(graph, o.vehicle, namespace, extra=extra, blind=blind, sees=sees)
    if (
        graph == "robot" and not blind and o.pool_file is None and pool_file is not None
    ):  # our own, still unwritten
        raise Ros2Error("a robot needs its pool file: give --pool-file, or none without a camera")
    prefix = o.frame_prefix or (f"{o.namespace}/" if o.namespace else None)
    plan.set("/**", site=o.site, frame_prefix=prefix)
    plan.set("controller", policy=o.policy, task=o.task, goal=o.goal, trajectory=o.trajectory)
    plan.set("sim", start=o.start, hydrodynamics=o.hydrodynamics, seed=o.seed)
    if graph != "sim":
        _wire(plan, o)
    located = None if pool_file is None else str(pool_file)
    for node in ("camera", "localizer", "state_estimation"):
        plan.set(node, pool_file="none" if blind else located)
    if o.let_in is not None:
        place_of(o.let_in)  # refuses what is none
        plan.set("state_estimation", let_in=o.let_in, mode="error-state")
    if o.record is not None:
        plan.set("recorder", record=str(o.record), pool_file=None if graph == "sim" or blind else located)
    named = o.policy is None or o.policy.startswith("pid")
    plan.set("teleop", device=o.teleop, other=o.policy if named else "policy")
    camera = o.camera or (None if o.site is None else "corners" if o.site == "tank" else "pictures")
    if graph == "pool":
        plan.set(
            "virtual_pool",
            plant=o.plant,
            severity=o.severity,
            camera="none" if blind else camera,
            port=o.port,
            seed=o.seed,
            positioning=o.positioning,
            world=o.world,
            bind=o.bind,
            pool_file=None if blind else located,
            start=o.start,
            truth=None if o.truth is None else str(o.truth),
        )
    return plan


def _wire(plan: GraphPlan, o: Options) -> None:
    """Addresses: pictures come from the port after the motor controller's, to the port after our own end's."""
    if o.bind is not None:
        host, _, port = o.bind.rpartition(":")
        if not port.isdecimal():
            raise Ros2Error(f"--bind {o.bind}: expected ADDRESS:PORT")
        plan.set("camera", pictures_bind=f"{host}:{int(port) + 1}")
    pool = plan.graph == "pool" or o.robot in (None, "pool")
    here = f"udp://127.0.0.1:{o.port}" if pool and o.port is not None else None
    eye = f"udp://127.0.0.1:{o.port + 1}" if here else None if pool else "none"
    plan.set("/**", robot=here or o.robot)
    plan.set("hardware_bridge", bind=o.bind, need_reading=False if o.teleop else None)
    plan.set("camera", pictures=o.pictures or eye)


def up(graph: str, *, options: Annotated[Options, "options"], notify: Callable[[str], None] = print) -> int:
    """Start a graph of nodes as processes, print its topics and events, and stop it with Ctrl-C.

    Exit status 1: a node died. 3: the bridge ended in a fault.

    Example: finssim ros2 up pool --policy pid --goal 0.5,0,-0.5,90 --arm --duration 60

    Args:
        graph (sim|pool|robot): sim (a simulated vehicle), pool (the virtual pool and a robot in it) or robot.
        options: As the person chose.
        notify: Takes a sentence.

    Returns:
        Exit status: 0, `DIED` or `FAULT`.

    Raises:
        TwinError: Another graph of the same namespace is on the wire.
    """
    activate()
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from finssim.extensions.ros2.nodes.remote import Watcher

    with TemporaryDirectory(prefix="finssim-ros2-") as folder:
        pool_file = (options.pool_file or Path(folder) / "pool.yaml").resolve()
        plan, parameters = plan_of(graph, options, pool_file), Path(folder) / "parameters.yaml"
        plan.write(parameters)
        for name, topic in topics_of(plan):
            notify(f"  {name}  {topic.type}  {topic.meaning}")
        with interruptible() as interrupted:
            shared = plan.parameters["/**"]
            settings = (
                f"{name}:='{shared[name]}'" for name in ("vehicle", "site", "frame_prefix") if name in shared
            )
            arguments = [word for setting in settings for word in ("-p", setting)]
            words = ["--ros-args", "-r", f"__ns:=/{plan.namespace}", *arguments]
            rclpy.init(args=words, signal_handler_options=SignalHandlerOptions.NO)  # `interruptible` has them
            try:
                watcher = Watcher(plan.nodes, arm=options.arm)
                with Supervisor(plan, parameters, notify) as nodes:
                    if graph == "pool":
                        nodes.start("virtual_pool")
                        if not plan.blind:
                            _await(pool_file, nodes, interrupted)
                    for name in plan.nodes:
                        if name != "virtual_pool":
                            nodes.start(name)
                    return _watch(watcher, options, nodes, interrupted, notify)
            finally:
                rclpy.try_shutdown()


def _await(pool_file: Path, nodes: Supervisor, interrupted: Callable[[], bool]) -> None:
    """Wait for the pool file of a virtual pool that has just been started."""
    begun, end = time.time() - 1.0, time.monotonic() + STARTING
    while not (pool_file.exists() and pool_file.stat().st_mtime >= begun - 1.0):
        if interrupted():
            raise KeyboardInterrupt
        if nodes.look() or time.monotonic() > end:
            raise Ros2Error("the virtual pool did not start: see its output above")
        time.sleep(0.05)


def _watch(
    watcher: Watcher,
    options: Options,
    nodes: Supervisor,
    interrupted: Callable[[], bool],
    notify: Callable[[str], None],
) -> int:
    died = False
    if not options.arm:
        notify("disarmed: thrusters turn only after true on the topic arm, or with --arm")
    end = time.monotonic() + (float("inf") if options.duration is None else options.duration)
    while not interrupted() and time.monotonic() < end:
        watcher.turn(0.2)
        died = bool(nodes.look()) or died
        if all(child.dead for child in nodes.children):
            break
    watcher.bridge.disarm(watcher.now())
    watcher.turn(0.1)
    sys.stdout.flush()
    return DIED if died else FAULT if watcher.state == "fault" else 0


# Which nodes make up a robot, its virtual pool or a simulated vehicle, and with which parameters.

NODES = {
    "camera": "finssim.extensions.ros2.nodes.camera:CameraNode",
    "controller": "finssim.extensions.ros2.nodes.controller:ControllerNode",
    "hardware_bridge": "finssim.extensions.ros2.nodes.hardware_bridge:HardwareBridge",
    "localizer": "finssim.extensions.ros2.nodes.localizer:Localizer",
    "recorder": "finssim.extensions.ros2.nodes.recorder:RecorderNode",
    "sim": "finssim.extensions.ros2.worlds.sim:Sim",
    "state_estimation": "finssim.extensions.ros2.nodes.state_estimation:StateEstimation",
    "teleop": "finssim.extensions.ros2.nodes.teleop:Teleop",
    "virtual_pool": "finssim.extensions.ros2.worlds.virtual_pool:VirtualPoolNode",
}
"""Node -> module and class."""

ROBOT = ("hardware_bridge", "camera", "localizer", "state_estimation", "controller")

GRAPHS = {"sim": ("sim", "controller"), "robot": ROBOT, "pool": ("virtual_pool", *ROBOT)}
"""Graph -> nodes, in the order of their start; they end in the reverse order, the bridge after who commands it."""

MCU_PORT = 58766
"""Port of a virtual pool's motor controller by default; pictures are sent from the next port."""


@dataclass
class GraphPlan:
    """A graph before it lives."""

    graph: str
    vehicle: str | None
    namespace: str
    parameters: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Node, or `/**` for all -> parameters."""
    extra: tuple[str, ...] = ()
    """Nodes besides those of the graph: recorder, teleop."""
    blind: bool = False
    """True if no camera is used for localization."""
    sees: bool = False
    """True if pictures of the vehicle's own sensors are used nevertheless."""

    def __post_init__(self) -> None:
        if self.graph not in GRAPHS:
            raise Ros2Error(f"unknown graph '{self.graph}'; available: {', '.join(GRAPHS)}")
        everywhere: dict[str, Any] = {} if self.vehicle is None else {"vehicle": self.vehicle}
        if self.graph == "sim":
            everywhere["use_sim_time"] = True
            self.set("sim", use_sim_time=False)
        self.parameters["/**"] = {**everywhere, **self.parameters.get("/**", {})}

    @property
    def nodes(self) -> tuple[str, ...]:
        """Return the nodes in the order of their start."""
        excluded = (("localizer",) if self.sees else ("camera", "localizer")) if self.blind else ()
        return (*(name for name in GRAPHS[self.graph] if name not in excluded), *self.extra)

    def set(self, node: str, **values: Any) -> None:
        """Give parameters; None leaves a node's own default."""
        stated = {name: value for name, value in values.items() if value is not None}
        self.parameters.setdefault(node, {}).update(stated)

    def write(self, path: Path) -> None:
        """The parameters as a ROS 2 parameter file."""
        tree = {
            key if key == "/**" else f"/{self.namespace}/{key}": {"ros__parameters": values}
            for key, values in self.parameters.items()
            if values
        }
        path.write_text(yaml.dump(tree, Dumper=_Quoting, sort_keys=False), encoding="utf-8")


def run_node(name: str, *arguments: str) -> int:
    """Run one node in this process, until Ctrl-C; its parameters come after --ros-args, or from a file there.

    Example: finssim ros2 node state_estimation

    Args:
        name (NAME): camera, controller, hardware_bridge, localizer, recorder, sim, state_estimation, teleop or
            virtual_pool; after it --ros-args as for any ROS 2 node.
        arguments: What follows it on the command line; those of the process if none is given.

    Returns:
        The exit status.

    Raises:
        Ros2Error: There is no such node.
    """
    from finssim.core.quiet import start_warp

    if arguments:
        sys.argv = [name, *arguments]
    if name not in NODES:
        raise Ros2Error(f"unknown node '{name}'; available: {', '.join(NODES)}")
    start_warp()
    module, _, node = NODES[name].partition(":")
    return int(getattr(import_module(module), node).run())


class _Quoting(yaml.SafeDumper):
    """Puts words into quotes: rcl would read `1e3`, `inf` and `y` as numbers and true where YAML reads words."""


_Quoting.add_representer(
    str, lambda dumper, word: dumper.represent_scalar("tag:yaml.org,2002:str", word, style='"')
)


def topics_of(plan: GraphPlan) -> list[tuple[str, Topic]]:
    """Full names of what a graph's nodes publish, and of what they take from people."""
    senders = {*plan.nodes, "you", "every node"}
    return [
        (topic.under(plan.namespace), topic)
        for topic in TOPICS.values()
        if senders & {word.strip() for word in topic.sender.split(",")}
    ]
