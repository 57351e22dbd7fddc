"""Run ROS 2 nodes, with or without a ROS 2 installation.

Example: finssim ros2 up pool
"""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import Field, dataclass, fields
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp
from typing import TYPE_CHECKING, Annotated, Any, Literal

import yaml

from finssim.control.ardusub import Mixer
from finssim.core.system import PARENT, SEPARATE, interrupt
from finssim.extensions.ros2 import Ros2Error
from finssim.extensions.ros2.backend import activate
from finssim.extensions.ros2.topics import TOPICS, Topic
from finssim.robot.goals import check_reachable, guide_of, place_of
from finssim.robot.interrupt import interruptible
from finssim.robot.links.transports import DEFAULT_BIND
from finssim.vehicles import load_vehicle
from finssim.vehicles.defaults import vehicle_at

if TYPE_CHECKING:
    from finssim.extensions.ros2.nodes.remote import Watcher
    from finssim.vehicles import Vehicle

__all__ = [
    "GRAPHS",
    "MCU_PORT",
    "NODES",
    "NODE_PARAMETERS",
    "Options",
    "GraphNode",
    "GraphPlan",
    "launch_arguments",
    "launched",
    "plan_of",
    "run_node",
    "topics_of",
]


PATIENCE = 10.0
"""Time for a node to end before it is killed [s]."""


@dataclass
class Child:
    """Process of one node."""

    what: GraphNode
    name: str
    """Name in messages."""
    process: subprocess.Popen[bytes]
    dead: bool = False


class Supervisor:
    """Runs the nodes of a plan. As a context manager, it ends all processes."""

    def __init__(self, plan: GraphPlan, parameters: Path, notify: Callable[[str], None]) -> None:
        """
        Args:
            plan: Nodes and namespaces.
            parameters: File that `plan.write` wrote.
            notify: Receives messages for the user.
        """
        self._plan, self._parameters, self._notify = plan, parameters, notify
        self.children: list[Child] = []

    def __enter__(self) -> Supervisor:
        return self

    def __exit__(self, *error: object) -> None:
        self.end()

    def start(self, one: GraphNode) -> Child:
        """Start a node; it ends with this process, even if that is killed."""
        name = one.node if len(self._plan.namespaces) == 1 else one.full_name.strip("/")
        ros = ["--ros-args", "-r", f"__ns:=/{one.namespace}", "--params-file", str(self._parameters)]
        command = [sys.executable, "-m", "finssim", "ros2", "node", one.node, *ros]
        environment = {**os.environ, PARENT: str(os.getpid())}
        # In a separate session: Ctrl-C reaches only this process, and the nodes end in the planned order.
        process = subprocess.Popen(
            command,
            env=environment,
            stdin=subprocess.DEVNULL if one.node != "teleop" else None,
            **SEPARATE,
        )
        child = Child(one, name, process)
        self.children.append(child)
        self._notify(f"{name}: process {process.pid}")
        return child

    def look(self) -> list[Child]:
        """Return the nodes that have died since the last call."""
        died = [c for c in self.children if not c.dead and c.process.poll() is not None]
        for child in died:
            child.dead = True
            self._notify(
                f"{child.name} has died: process {child.process.pid}, {_status(child.process.returncode)}"
            )
        return died

    def end(self) -> None:
        """End all nodes, in the reverse order of their start."""
        for child in reversed(self.children):
            if child.process.poll() is None:
                interrupt(child.process)
        limit = time.monotonic() + PATIENCE
        for child in reversed(self.children):
            try:
                child.process.wait(max(limit - time.monotonic(), 0.1))
            except subprocess.TimeoutExpired:
                self._notify(f"{child.name} does not end: killed")
                child.process.kill()
                child.process.wait()
            child.dead = True


def _status(code: int) -> str:
    """Return a description of a return code."""
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"status {code}"


# `finssim ros2 up`: a complete graph of nodes as processes, without a ROS installation.


DIED, FAULT = 1, 3
"""Exit status if a node died, and if the bridge ended in a fault."""
STARTING = 180.0
"""Longest wait for the first message of a bridge [s]; the first rendering on a machine compiles."""
APART = 10
"""Distance of the ports of two successive vehicles of a team, as in a virtual pool."""


@dataclass(frozen=True, kw_only=True)
class SimulatedWorld:
    """Simulated vehicle, or virtual pool: its world, water, plant, firmware, camera and ports."""

    world: str | None = None
    """(SITE|FILE) World for the vehicle's own cameras, sonars and altimeters in a virtual pool; in open water
    also its water. The node camera publishes their measurements."""
    water: Path | None = None
    """(FILE) Water file of a virtual pool (.yaml): currents and waves, which are added to those of the site."""
    positioning: str = "none"
    """(NAME) Position fixes of a virtual pool: none, motion-capture or usbl."""
    plant: str = "1"
    """(SEED|FILE) Plant of a virtual pool: a seed or a file."""
    firmware: Literal["mcu", "ardusub"] = "mcu"
    """(NAME) Firmware of a virtual pool's vehicle: mcu, or ardusub, an autopilot with DVL and compass,
    without a camera. Ground stations connect by TCP to the port after --port; the DVL uses the port after
    that."""
    severity: str = "realistic"
    """(NAME) Severity of a drawn plant: nominal, realistic or hard."""
    camera: str | None = None
    """(KIND) Output of a virtual pool's camera: pictures, corners (of the tags) or none, which applies also
    to a robot.
    Default: pictures; in a tank, corners."""
    port: int = 58766
    """UDP port of a virtual pool; pictures use the next port."""
    truth: Path | None = None
    """(FILE) Truth file of a virtual pool, which is written."""
    start: str | None = None
    """(X,Y,Z,YAW) Start pose of the vehicle in sim and pool: x,y,z [m], yaw [deg]."""
    hydrodynamics: str | None = None
    """(MODEL) Hydrodynamic model of sim: calibrated, mesh or simplified."""


@dataclass(frozen=True, kw_only=True)
class GraphWiring:
    """Connection of a robot and its camera."""

    robot: str = "pool"
    """(ADDRESS) Motor controller of a robot: udp://HOST:PORT, serial:DEVICE, or pool for a finssim pool on
    this machine; or its autopilot: mavlink or mavlink://KIND:ADDRESS, as in finssim run."""
    bind: str = "127.0.0.1:54321"
    """(ADDRESS:PORT) Local address and port for UDP; pictures are received on the next port."""
    pictures: str | None = None
    """(ADDRESS) Overhead camera of a robot: udp://HOST:PORT or none; with --robot pool that of the pool."""
    pool_file: Path | None = None
    """(FILE|none) Pool file (.yaml): a robot reads it, a virtual pool writes it; none without an overhead camera."""


@dataclass(frozen=True, kw_only=True)
class GraphPace:
    """Rate and lock-step of the graph's time."""

    lockstep: bool = False
    """Let /clock advance only when every node has finished its work of the last step, however long it takes;
    for a slow machine or CI. As fast as possible, unless --real-time-factor limits it."""
    real_time_factor: Annotated[float | None, (0.0, None)] = None
    """Time of /clock per real time [-]; 0: without limit, for sim and in lock-step. A virtual pool publishes /clock
    if this or --lockstep is given; otherwise it runs in real time."""


@dataclass(frozen=True, kw_only=True)
class TeamMessages:
    """Loss and delay of the messages between the vehicles of a team."""

    message_loss: Annotated[float | None, (0.0, 1.0)] = None
    """Probability that a vehicle of a team misses a message of another; if not given, 0.1 as in training."""
    message_delay: Annotated[float | None, (0.0, None)] = None
    """Time to process such a message, in addition to its travel time at the speed of sound [s]; 0.1 if not given."""


@dataclass(frozen=True, kw_only=True)
class GraphMission:
    """Controller and its goal."""

    policy: str = "pid"
    """(DIR|pid|pid-paper|none) Directory of a policy, or pid, or pid-paper; none for your own controller."""
    task: str | None = None
    """Task that the policy must have been trained for; if not given, the policy's task."""
    let_in: str | None = None
    """(X,Y) Position at the start, in the map [m], for dead reckoning by DVL and compass, without camera and
    position fixes."""
    goal: str | None = None
    """(X,Y,Z,YAW|FILE) Pose to keep: x,y,z [m] in the map (z = 0 at the surface) and heading [deg], or a file;
    if not given, the pose at arming. The topic goal changes it."""
    trajectory: str | None = None
    """(NAME|FILE) Trajectory to follow instead of a goal: a name or a file."""


@dataclass(frozen=True, kw_only=True)
class VehicleNames:
    """Vehicles of the graph, and the names of their topics and frames."""

    vehicle: str = "finsrov"
    """(NAME|FILE) Vehicle in the catalogue, or a vehicle file."""
    team: str | None = None
    """(NAME,NAME) Several vehicles of one virtual pool instead; their namespaces are robot_1 and so on. Give goal,
    trajectory and let-in for each, separated by semicolons; record and truth are folders."""
    namespace: str | None = None
    """(NAME) Namespace of the vehicle's topics and prefix of its frames, such as robot_1, if there are several
    vehicles. If not given, the vehicle's name, without a prefix."""
    frame_prefix: str | None = None
    """(PREFIX/) Prefix of the vehicle's frames in /tf, if it differs from the namespace's."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command `finssim ros2 up`."""

    mission: Annotated[GraphMission, "options"] = GraphMission()
    names: Annotated[VehicleNames, "options"] = VehicleNames()
    site: str = "pool"
    """(NAME) Site: pool, tank or open-water (DVL and compass instead of a camera)."""
    arm: bool = False
    """Arm once, as soon as the state is known; otherwise the topic arm does."""
    wiring: Annotated[GraphWiring, "options"] = GraphWiring()
    simulated: Annotated[SimulatedWorld, "options"] = SimulatedWorld()
    record: Path | None = None
    """(FILE) File to which all topics are recorded (.mcap)."""
    teleop: str | None = None
    """(DEVICE) Also drive manually: joy (topic), gamepad or keyboard. The bridge then arms without localization."""
    pace: Annotated[GraphPace, "options"] = GraphPace()
    messages: Annotated[TeamMessages, "options"] = TeamMessages()
    duration: Annotated[float | None, (0.0, None)] = None
    """Duration from the bridge's first message [s], in the time of /clock for nodes that use it; until Ctrl-C
    if not given."""
    seed: int = 1
    """Seed of all random numbers; equal seeds give equal results."""

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Options:
        """Return the options with the given values by name; missing ones have their defaults."""
        by_group: dict[str | None, dict[str, Any]] = {}
        for group, option in each_option():
            if option.name in values:
                by_group.setdefault(group, {})[option.name] = values[option.name]
        direct = by_group.pop(None, {})
        return cls(**direct, **{group: GROUPS[group](**own) for group, own in by_group.items() if group})

    def values(self) -> dict[str, Any]:
        """Return the value of each option by name."""
        return {
            option.name: getattr(getattr(self, group) if group else self, option.name)
            for group, option in each_option()
        }


GROUPS = {
    "mission": GraphMission,
    "names": VehicleNames,
    "wiring": GraphWiring,
    "simulated": SimulatedWorld,
    "pace": GraphPace,
    "messages": TeamMessages,
}
"""Field of `Options` -> group of options."""


def each_option() -> Iterator[tuple[str | None, Field[Any]]]:
    """Yield all options, each with the name of its group, or None."""
    for field in fields(Options):
        if field.name in GROUPS:
            yield from ((field.name, option) for option in fields(GROUPS[field.name]))
        else:
            yield None, field


NOT_LAUNCHED = ("arm", "duration")
"""Options that launch files lack: there, arming needs a message, and Ctrl-C ends them."""


def launch_arguments() -> list[str]:
    """Return the options that every launch file has as arguments."""
    return [option.name for _, option in each_option() if option.name not in NOT_LAUNCHED]


def launched(graph: str, given: Mapping[str, str]) -> GraphPlan:
    """Plan the nodes of a launch file as `up` does, but leave options that are not given to parameter files
    and nodes.

    Args:
        graph: sim, pool or robot.
        given: Launch argument -> text, of the arguments that the user gave.

    Raises:
        Ros2Error, VehicleError, GoalError, ControlError: As of `plan_of`, or a text that is no number or no flag.
    """
    values: dict[str, Any] = {**given}
    for _, option in each_option():
        name, kind = option.name, str(option.type)
        if name in given and any(word in kind for word in LAUNCH_CONVERTERS):
            convert, expected = LAUNCH_CONVERTERS[next(word for word in LAUNCH_CONVERTERS if word in kind)]
            try:
                values[name] = convert(given[name])
            except (KeyError, ValueError):
                raise Ros2Error(f"{name}:={given[name]}: expected {expected}") from None
    nothing = dict.fromkeys(option.name for _, option in each_option())
    pool_file = given.get("pool_file")
    if graph == "pool" and pool_file is None:
        pool_file = str(Path(mkdtemp(prefix="finssim-ros2-")) / "pool.yaml")
    return plan_of(graph, Options.of({**nothing, **values}), pool_file, since=time.time())


LAUNCH_CONVERTERS: dict[str, tuple[Callable[[str], Any], str]] = {
    "bool": (lambda word: {"true": True, "false": False}[word.lower()], "true or false"),
    "float": (float, "a number"),
    "int": (int, "an integer"),
}
"""Type name in an option's type -> converter of a launch argument's text, and description of its values."""


def plan_of(
    graph: str, options: Options, pool_file: Path | str | None, *, since: float | None = None
) -> GraphPlan:
    """Return nodes and parameters; an option that is None leaves a parameter to the node.

    Args:
        graph: sim, pool or robot.
        options: Options that the user chose.
        pool_file: Pool file that the robot's nodes read and the virtual pool writes; None leaves it to the nodes.
        since: Time of day at which the graph starts [s]; a pool file of a virtual pool that is older is not used.

    Raises:
        Ros2Error: There is no such graph, or an option that has no effect there.
        VehicleError, GoalError, ControlError: A vehicle, goal or trajectory that cannot be used.
    """
    if graph not in GRAPHS:
        raise Ros2Error(f"unknown graph '{graph}'; available: {', '.join(GRAPHS)}")
    o, several, stated = options, options.names.team is not None, options.values()
    names: list[str | None] = [o.names.vehicle]
    if o.names.team is not None:
        names = [name.strip() for name in o.names.team.split(",")]
    _check(graph, o)
    blind = _blind(o)
    if graph == "robot" and not blind and o.wiring.pool_file is None and pool_file is not None:
        raise Ros2Error("a robot needs its pool file: give --pool-file, or none without a camera")
    file = "none" if blind else None if pool_file is None else str(pool_file)
    common = {**stated, **_common(graph, o, since), "pool_file": file}
    shares = {name: _share(name, stated[name], len(names)) for name in SHARED}
    nodes: list[GraphNode] = []
    namespaces: list[str] = []
    for i, name in enumerate(names):
        vehicle = vehicle_at(o.site or "pool", load_vehicle(name or "finsrov"))
        own = {key: texts[i] for key, texts in shares.items()}
        _check_vehicle(o, vehicle, own if name is not None else {"let_in": own["let_in"]})
        namespace = f"robot_{i + 1}" if several else o.names.namespace or vehicle.name.replace("-", "_")
        namespaces.append(namespace)
        prefix = f"{namespace}/" if several or o.names.namespace else None
        values = {
            **common,
            **own,
            **_wire(graph, o, APART * i),
            "vehicle": name,
            "number": i or None,
            "frame_prefix": o.names.frame_prefix or prefix,
            "record": o.record and str(Path(o.record) / f"{namespace}.mcap" if several else o.record),
            "mode": "error-state" if own["let_in"] is not None else None,
        }
        for node in _members(graph, o, blind):
            given, below = values, namespace
            if node in WORLDS:
                if i:
                    continue  # one for all vehicles
                given = {
                    **values,
                    **_world_values(o, blind, file),
                    "frame_prefix": None if several else prefix,
                }
                below = "team" if several else namespace
            elif node == "recorder" and (graph == "sim" or blind):
                given = {**values, "pool_file": None}
            takes = f"{COMMON_PARAMETERS} {NODE_PARAMETERS[node]}".split()
            nodes.append(
                GraphNode(node, below, {key: given[key] for key in takes if given.get(key) is not None})
            )
    if o.pace.lockstep:
        waits = " ".join(one.full_name for one in nodes if one.node not in WORLDS)
        for one in nodes:
            one.parameters.update({"waits_for": waits} if one.node in WORLDS else {})
    return GraphPlan(graph, tuple(nodes), tuple(namespaces))


def _blind(o: Options) -> bool:
    """Return True if no camera locates the vehicles."""
    world = o.simulated
    without = "none" in (str(o.wiring.pool_file), world.camera)
    return without or o.site == "open-water" or world.firmware == "ardusub"


def _common(graph: str, o: Options, since: float | None) -> dict[str, Any]:
    """Return the parameters that all nodes of a graph share; `since` as in `plan_of`, time of day [s]."""
    pace, policy = o.pace, o.mission.policy
    own_gains = policy is None or policy.startswith("pid")
    simulated = graph == "sim" or pace.lockstep or pace.real_time_factor is not None
    return {
        "use_sim_time": simulated or None,
        "lockstep": pace.lockstep or None,
        "pool_since": since if graph == "pool" and not _blind(o) else None,
        "real_time_factor": 0.0 if pace.lockstep and pace.real_time_factor is None else pace.real_time_factor,
        "need_reading": False if o.teleop else None,
        "device": o.teleop,
        "other": policy if own_gains else "policy",
    }


def _world_values(o: Options, blind: bool, file: str | None) -> dict[str, Any]:
    """Return the parameters that only a simulated world has; `file` is the pool file that it writes."""
    world = o.simulated
    camera = world.camera or (None if o.site is None else "corners" if o.site == "tank" else "pictures")
    return {
        "use_sim_time": None,
        "bind": o.wiring.bind,
        "camera": "none" if blind else camera,
        "pool_file": None if blind else file,
        "truth": None if world.truth is None else str(world.truth),
        "water": None if world.water is None else str(world.water),
    }


def _check_vehicle(o: Options, vehicle: Vehicle, own: Mapping[str, str | None]) -> None:
    """Raise for a goal, a trajectory or an initial position that this vehicle cannot use.

    Args:
        o: Options of the graph.
        vehicle: Vehicle of the graph.
        own: Its `goal`, `trajectory` and `let_in`, where given.
    """
    if o.simulated.firmware == "ardusub":
        Mixer.of(vehicle)  # raises for a vehicle without an autopilot
    goal, trajectory, let_in = own.get("goal"), own.get("trajectory"), own.get("let_in")
    if goal is not None or trajectory is not None:
        check_reachable(guide_of(goal, trajectory), vehicle)
    if let_in is not None:
        place_of(let_in)


def _members(graph: str, o: Options, blind: bool) -> tuple[str, ...]:
    """Return the nodes of one vehicle in the order of their start."""
    sees = o.simulated.world is not None or o.wiring.pictures not in (None, "none")
    excluded = [*(["controller"] if o.mission.policy == "none" else [])]
    excluded += (["localizer"] if sees else ["camera", "localizer"]) if blind else []
    extra = (*(("recorder",) if o.record else ()), *(("teleop",) if o.teleop else ()))
    return (*(name for name in GRAPHS[graph] if name not in excluded), *extra)


def _check(graph: str, o: Options) -> None:
    """Raise for options that have no effect in a graph."""
    world, wiring, pace = o.simulated, o.wiring, o.pace
    single = (
        o.names.namespace or o.names.frame_prefix or o.teleop or world.start or world.firmware == "ardusub"
    )
    if o.names.team is not None and (graph != "pool" or single):
        raise Ros2Error(
            "--team is for the graph pool, which places and names its vehicles: leave --namespace, --frame-prefix, "
            "--start, --firmware and --teleop out"
        )
    if world.firmware == "ardusub" and world.camera not in (None, "none"):
        raise Ros2Error("--firmware ardusub has no camera, but DVL and compass: leave --camera out")
    if o.names.team is not None and o.names.vehicle not in (None, "finsrov"):
        raise Ros2Error("--team names its vehicles: leave --vehicle out")
    if o.names.team is None and (o.messages.message_loss is not None or o.messages.message_delay is not None):
        raise Ros2Error("--message-loss and --message-delay are for the messages of a team: give --team")
    if graph == "robot" and (pace.lockstep or pace.real_time_factor is not None):
        host = "" if wiring.robot is None else wiring.robot.rpartition("//")[2]
        if wiring.robot not in (None, "pool") and not host.startswith(("127.", "localhost")):
            raise Ros2Error(
                f"--robot {wiring.robot} runs in real time: leave --lockstep and --real-time-factor out"
            )
    if graph == "pool" and pace.real_time_factor == 0.0 and not pace.lockstep:
        raise Ros2Error(
            "--real-time-factor 0: expected more than 0, or --lockstep, in which 0 means without limit"
        )
    takes = {word for node in GRAPHS[graph] for word in NODE_PARAMETERS[node].split()} | set(
        COMMON_OPTIONS.split()
    )
    takes |= set(EXTRA_OPTIONS[graph].split())
    stated = o.values()
    for _, option in each_option():
        value = stated[option.name]
        if value not in (None, option.default) and option.name not in takes:
            raise Ros2Error(
                f"--{option.name.replace('_', '-')} has no effect in the graph {graph}: leave it out"
            )


def _share(name: str, text: str | None, n: int) -> list[str | None]:
    """Return the values of an option for each of `n` vehicles."""
    if text is None or n == 1:
        return [text] * n
    parts = [part.strip() for part in text.split(";")]
    if len(parts) != n:
        raise Ros2Error(
            f"--{name.replace('_', '-')} {text}: expected {n} separated by semicolons, one a vehicle"
        )
    return list(parts)


def _wire(graph: str, o: Options, further: int) -> dict[str, Any]:
    """Return addresses: pictures come from the port after the motor controller's, to the port after our own.

    Args:
        graph: sim, pool or robot.
        o: Options that the user chose.
        further: Distance of this vehicle's ports from those of the first.
    """
    if graph == "sim":
        return {"robot": None}
    if o.simulated.firmware == "ardusub":
        port = o.simulated.port or MCU_PORT
        return {"robot": f"mavlink://udpout:127.0.0.1:{port}?dvl=127.0.0.1:{port + DVL_AFTER}"}
    bind = camera_bind = None
    ours = DEFAULT_BIND if o.wiring.bind is None and further else o.wiring.bind
    if ours is not None:
        host, _, port = ours.rpartition(":")
        if not port.isdecimal():
            raise Ros2Error(f"--bind {ours}: expected ADDRESS:PORT")
        bind, camera_bind = f"{host}:{int(port) + further}", f"{host}:{int(port) + further + 1}"
    pool = graph == "pool" or o.wiring.robot in (None, "pool")
    first = MCU_PORT if o.simulated.port is None and further else o.simulated.port
    here = f"udp://127.0.0.1:{first + further}" if pool and first is not None else None
    eye = f"udp://127.0.0.1:{first + further + 1}" if here else None if pool else "none"
    return {
        "robot": here or o.wiring.robot,
        "bind": bind,
        "pictures": o.wiring.pictures or eye,
        "pictures_bind": camera_bind,
    }


def up(graph: str, *, options: Annotated[Options, "options"], notify: Callable[[str], None] = print) -> int:
    """Start a graph of nodes as processes, print its topics and events, and stop it with Ctrl-C.

    Exit status 1: a node died. 3: the bridge ended in a fault.

    Example: finssim ros2 up pool --policy pid --goal 0.5,0,-0.5,90 --arm --duration 60

    Args:
        graph (sim|pool|robot): sim (a simulated vehicle), pool (the virtual pool and a robot in it) or robot.
        options: Options that the user chose.
        notify: Receives messages for the user.

    Returns:
        Exit status: 0, `DIED` or `FAULT`.

    Raises:
        TwinError: Another graph of the same namespace is running.
    """
    activate()
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from finssim.extensions.ros2.nodes.remote import Watcher

    with TemporaryDirectory(prefix="finssim-ros2-") as folder:
        pool_file = (options.wiring.pool_file or Path(folder) / "pool.yaml").resolve()
        plan, parameters = (
            plan_of(graph, options, pool_file, since=time.time()),
            Path(folder) / "parameters.yaml",
        )
        plan.write(parameters)
        for name, topic in topics_of(plan):
            notify(f"  {name}  {topic.type}  {topic.meaning}")
        with interruptible() as interrupted:
            # `interruptible` handles signals.
            rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
            try:
                watchers = [Watcher(plan, namespace, arm=options.arm) for namespace in plan.namespaces]
                with Supervisor(plan, parameters, notify) as nodes:
                    for one in plan.nodes:
                        nodes.start(one)
                    return _watch(watchers, options, nodes, interrupted, notify)
            finally:
                rclpy.try_shutdown()


def _watch(
    watchers: Sequence[Watcher],
    options: Options,
    nodes: Supervisor,
    interrupted: Callable[[], bool],
    notify: Callable[[str], None],
) -> int:
    died, first = False, watchers[0]
    begun, patient = float("nan"), time.monotonic() + STARTING
    if not options.arm:
        notify("disarmed: thrusters turn only after true on the topic arm, or with --arm")
    longest = float("inf") if options.duration is None else options.duration
    while not interrupted() and not first.now() - begun >= longest:
        if math.isnan(begun) and (not first.bridge.silent or time.monotonic() > patient):
            begun = first.now()  # the duration begins with the bridge's first message
        for watcher in watchers:
            watcher.turn(0.2 / len(watchers))
        gone = nodes.look()
        died = died or bool(gone)
        for child in gone:
            first.left(child.what.full_name)
        if any(child.what.node in WORLDS for child in gone) or all(child.dead for child in nodes.children):
            break
    for watcher in watchers:
        watcher.bridge.disarm(watcher.now())
        watcher.turn(0.1)
    sys.stdout.flush()
    fault = any(watcher.state == "fault" for watcher in watchers)
    return DIED if died else FAULT if fault else 0


# Nodes of a robot, of its virtual pool and of a simulated vehicle, and their parameters.

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
"""Graph -> nodes, in the order of their start; they end in reverse order, so the bridge ends after its commanders."""

WORLDS = ("sim", "virtual_pool")
"""Nodes that simulate a world and determine the time of their graph, which ends with them."""

COMMON_PARAMETERS = "vehicle robot site frame_prefix number use_sim_time lockstep pool_since"
"""Parameters of every node."""

NODE_PARAMETERS = {
    "camera": "pictures pictures_bind pool_file",
    "controller": "policy task goal trajectory",
    "hardware_bridge": "bind need_reading",
    "localizer": "pool_file",
    "recorder": "record pool_file",
    "sim": "start hydrodynamics seed real_time_factor",
    "state_estimation": "pool_file let_in mode",
    "teleop": "device other",
    "virtual_pool": "plant firmware severity camera port bind pool_file truth start positioning world water seed team "
    "message_loss message_delay real_time_factor",
}
"""Node -> its parameters that options set, by the names of the options if these are equal."""

COMMON_OPTIONS = "vehicle namespace frame_prefix site arm record teleop duration lockstep"
"""Options of every graph."""
EXTRA_OPTIONS = {"sim": "", "robot": "robot port camera real_time_factor", "pool": ""}
"""Graph -> further options."""
SHARED = ("goal", "trajectory", "let_in")
"""Options that have a value for each vehicle of a team."""

MCU_PORT = 58766
"""Port of a virtual pool's motor controller by default; pictures are sent from the next port."""
STATIONS_AFTER, DVL_AFTER = 1, 2
"""Distances of an autopilot's TCP ports from its port: for ground stations, and for the DVL."""


@dataclass(frozen=True)
class GraphNode:
    """One node of a graph: `up` makes it a process, a launch file makes it a `launch_ros` node."""

    node: str
    """Name of the node and of its executable."""
    namespace: str
    """Namespace, without a leading slash."""
    parameters: dict[str, Any]
    """Parameters that the graph sets; all others keep the default of the node or of a parameter file."""

    @property
    def full_name(self) -> str:
        """Return namespace and name."""
        return f"/{self.namespace}/{self.node}"


@dataclass(frozen=True)
class GraphPlan:
    """Plan of a graph: nodes and namespaces."""

    graph: str
    nodes: tuple[GraphNode, ...]
    """Nodes in the order of their start; they end in reverse order, so the bridge ends after its commanders."""
    namespaces: tuple[str, ...]
    """Namespaces of the vehicles."""

    def write(self, path: Path) -> None:
        """Write the parameters as a ROS 2 parameter file."""
        tree = {one.full_name: {"ros__parameters": one.parameters} for one in self.nodes if one.parameters}
        path.write_text(yaml.dump(tree, Dumper=_Quoting, sort_keys=False), encoding="utf-8")


def run_node(name: str, *arguments: str) -> int:
    """Run one node in this process, until Ctrl-C; its parameters follow after --ros-args, or are in a file
    given there.

    Example: finssim ros2 node state_estimation

    Args:
        name (NAME): camera, controller, hardware_bridge, localizer, recorder, sim, state_estimation, teleop or
            virtual_pool; then --ros-args as for any ROS 2 node.
        arguments: Further command-line arguments; if none is given, those of the process.

    Returns:
        Exit status.

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
    """Dumper that quotes strings: rcl would read `1e3`, `inf` and `y` as numbers and true, unlike YAML."""


_Quoting.add_representer(
    str, lambda dumper, word: dumper.represent_scalar("tag:yaml.org,2002:str", word, style='"')
)


def topics_of(plan: GraphPlan) -> list[tuple[str, Topic]]:
    """Return the full names of topics that a graph's nodes publish or receive from users, each with its topic."""
    senders = {"you", "every node", *(one.node for one in plan.nodes)}
    return list(
        {
            topic.under(namespace): topic
            for namespace in plan.namespaces
            for key, topic in TOPICS.items()
            if senders & {word.strip() for word in topic.sender.split(",")}
            and (len(plan.namespaces) > 1 or key not in ("sent", "received"))
        }.items()
    )
