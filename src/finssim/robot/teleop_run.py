"""`finssim teleop`: a person drives, over the same bridge and with the same record as a controller."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

from finssim.control.guidance import Guide, Station
from finssim.localization.pool import Pool, load_pool
from finssim.robot.bridge import Bridge, BridgeSettings
from finssim.robot.goals import check_reachable, station_of
from finssim.robot.link.transports import Transport, open_transport
from finssim.robot.perception import Perception, Unlocated
from finssim.robot.pictures import PictureSource
from finssim.robot.pilots import ModeSwitch, Pilot, WrenchPilot, make_pilot
from finssim.robot.recorder import Recorder, recording
from finssim.robot.runtime import Runtime
from finssim.robot.teleop import Device, Operator, TeleopError
from finssim.robot.teleop_devices import GAMEPAD_HELP, KEYBOARD_HELP, Gamepad, Keyboard
from finssim.robot.wiring import POOL_ADDRESS, Wiring, open_camera, run_realtime
from finssim.vehicles import Vehicle, load_vehicle

__all__ = ["drive", "run"]

SHOWN_EVERY = 0.2
"""[s]"""


def drive(
    vehicle: Vehicle,
    device: Device,
    transport: Transport,
    *,
    pool: Pool | None = None,
    pictures: PictureSource | None = None,
    recorder: Recorder | None = None,
    other: Pilot | None = None,
    guide: Guide | None = None,
    rate: float = 60.0,
    duration: float = math.inf,
    show: Callable[[Runtime, Operator], None] | None = None,
    clock: Callable[[], float] = time.monotonic,
    wait: Callable[[float], None] = time.sleep,
) -> Runtime:
    """Drive until the time is over or Ctrl-C; the vehicle starts disarmed, and ends with frames without thrust.

    Args:
        vehicle: As its file has it.
        device: In the person's hands.
        transport: To the motor controller.
        pool: Camera, water and frames; None: the vehicle is driven, and armed, without localization.
        pictures: From the camera.
        recorder: Takes down everything.
        other: Whom the mode button hands over to; None: nobody.
        guide: Where `other` steers to.
        rate: Turns of the loop a second [Hz].
        duration: [s]
        show: Called at every turn.
        clock: [s]
        wait: Waits so long [s].
    """

    def swap() -> None:
        if other is not None:
            switch.select("other" if switch.mode == "person" else "person")

    operator = Operator(device, swap=swap)
    person = WrenchPilot(operator.wrench, vehicle, period=1.0 / rate)
    switch = ModeSwitch({"person": person, **({} if other is None else {"other": other})})
    runtime = Runtime(
        vehicle,
        pool,
        switch,
        guide or Station((0.0, 0.0, 0.0), 0.0),
        perception=Unlocated(vehicle) if pool is None else Perception(vehicle, pool),
        bridge=Bridge(vehicle, BridgeSettings.of(vehicle, need_reading=False)),
        recorder=recorder,
    )

    def turn(running: Runtime) -> bool:
        if running.reading is not None:
            before = switch.mode
            operator.turn(running.reading.time, running.bridge)
            if recorder is not None and switch.mode != before:
                recorder.event(running.reading.time, "mode", switch.mode)
        if show is not None:
            show(running, operator)
        return False

    run_realtime(
        runtime, transport, pictures, rate=rate, duration=duration, until=turn, clock=clock, wait=wait
    )
    return runtime


def run(
    *,
    vehicle: str = "finsrov",
    device: str = "gamepad",
    robot: str = "pool",
    bind: str = "127.0.0.1:54321",
    pool_file: Path | None = None,
    pictures: str | None = None,
    policy: str | None = None,
    goal: str | None = None,
    record: Path | None = None,
    key_hold: float = 0.6,
    rate: Annotated[float, (20.0, 200.0)] = 60.0,
    duration: Annotated[float | None, (0.0, None)] = None,
) -> None:
    """Drive by hand. Starts disarmed; START or enter arms; without a hand on LB or the keys there is no thrust.

    Example: finssim teleop --device keyboard --robot pool --record drive.mcap

    Args:
        vehicle (NAME|FILE): Vehicle of the catalogue, or the path of a vehicle file.
        device (NAME): What is in the hands: gamepad or keyboard.
        robot (WIRE): Wire to the motor controller: udp://HOST:PORT, serial:DEVICE, dry-run, or pool (the virtual pool
            on this machine).
        bind (ADDRESS:PORT): This end of the wire, for UDP.
        pool_file (FILE): Pool file: camera, water plane and frames (.yaml); without it nobody knows the position.
        pictures (ADDRESS): Overhead camera: udp://HOST:PORT or none; the virtual pool's with --robot pool,
            otherwise none, if not given. Needs --pool-file.
        policy (DIR|pid): Whom SELECT or m hands over to: pid, or a policy's directory. Needs --pool-file and --goal.
        goal (X,Y,Z,YAW): Where the policy steers to, in m and deg.
        record (FILE): Record of the run to write (.mcap).
        key_hold (S): A key counts as held so long after its last press [s].
        rate: Turns of the loop a second [Hz].
        duration: End after so long [s]; with Ctrl-C if not given.

    Raises:
        TeleopError, LinkError, VehicleError, LocalizationError, PolicyError, OutputError: What cannot be used.
    """
    body = load_vehicle(vehicle)
    pool = load_pool(pool_file) if pool_file is not None else None
    other, guide = _controller(policy, goal, body, pool)
    if pictures is not None and pool is None:
        raise TeleopError("--pictures says nothing without the camera's place: give --pool-file, too")
    wiring = Wiring(robot=robot, bind=bind, pictures=pictures)
    with ExitStack() as stack:
        hands, keys = _open_device(device, key_hold, stack)
        transport = open_transport(POOL_ADDRESS if robot == "pool" else robot, bind)
        stack.callback(transport.close)
        source = None if pool is None else open_camera(wiring, body, pool)
        if source is not None:
            stack.callback(source.close)
        meta = {"command": "finssim teleop", "robot": robot}
        recorder = stack.enter_context(recording(record, body, meta, pool_file=pool_file))
        print(keys, file=sys.stderr)
        longest = math.inf if duration is None else duration
        told = {"recorder": recorder, "other": other, "guide": guide, "show": _Line()}
        drive(body, hands, transport, pool=pool, pictures=source, rate=rate, duration=longest, **told)
        print(f"\n{transport.describe()}", file=sys.stderr)


def _controller(
    policy: str | None, goal: str | None, vehicle: Vehicle, pool: Pool | None
) -> tuple[Pilot | None, Station | None]:
    """Whom the person hands over to, and where it steers to."""
    if policy is None:
        if goal is not None:
            raise TeleopError("--goal is where a controller steers to: give --policy, too, or leave it out")
        return None, None
    if pool is None or goal is None:
        raise TeleopError(
            "a controller to hand over to needs a state and a goal: give --pool-file and --goal"
        )
    station = station_of(goal)
    check_reachable(station, vehicle)
    return make_pilot(policy, vehicle), station


def _open_device(name: str, key_hold: float, stack: ExitStack) -> tuple[Device, str]:
    """The device and what its keys do."""
    if name == "keyboard":
        return stack.enter_context(Keyboard(hold=key_hold)), KEYBOARD_HELP
    if name == "gamepad":
        return stack.enter_context(Gamepad()), GAMEPAD_HELP
    raise TeleopError(f"unknown device '{name}': expected gamepad or keyboard")


class _Line:
    """One line on the terminal: state, gear, wrench, and what there is to say."""

    def __init__(self) -> None:
        self._at = -math.inf

    def __call__(self, runtime: Runtime, operator: Operator) -> None:
        now = runtime.reading.time if runtime.reading is not None else -math.inf
        if now - self._at < SHOWN_EVERY:
            return
        self._at = now
        x, y, z, _, _, n = operator.command.wrench
        said = runtime.bridge.reason or operator.said
        if runtime.recorder is not None:
            said = runtime.recorder.problem or said
        line = f"{runtime.bridge.state:8} {operator.command.gear:9} surge {x:5.1f} sway {y:5.1f} heave {z:5.1f} N "
        print(f"\r{line}yaw {n:5.2f} N m  {said}\x1b[K", end="", file=sys.stderr, flush=True)
