"""The faults that a robot must survive, as data: what is done to its wires and its pool, when, and for how long."""

from __future__ import annotations

import math
import os
import resource
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.pool import VirtualPool
from finssim.robot.link.decoder import MCU, Decoder
from finssim.robot.link.frames import encode_telemetry
from finssim.robot.messages import Delivery, Picture, Telemetry
from finssim.robot.recorder import Recorder
from finssim.robot.runtime import Runtime

__all__ = ["Bench", "Course", "Fault", "FaultyWire", "SCENARIOS"]

Array = NDArray[np.float64]


class Course(NamedTuple):
    """What truly happened, by the pool's clock."""

    time: Array
    """[s], (k,)"""
    position: Array
    """Body origin, world frame [m], (k, 3)."""
    thrust: Array
    """Delivered, canonical order [N], (k, n)."""
    enabled: Array
    """Whether a frame that enables the motors left the robot at this time, (k,); NaN where nobody noted."""


class FaultyWire:
    """A world in lock-step whose time goes on by one period at each exchange, whatever the robot's clock says.

    Attributes:
        pool: Behind it.
        shift: By how much the robot's clock is ahead of the pool's [s]; a change is a jump of the robot's clock.
        change: Applied to each snapshot of the vehicle; None leaves the bytes alone.
        pictures: Applied to the pictures of an exchange; None leaves them alone.
    """

    def __init__(self, pool: VirtualPool, rate: float) -> None:
        """
        Args:
            pool: At time 0.
            rate: Exchanges a second [Hz].
        """
        self.pool = pool
        self.shift = 0.0
        self.change: Callable[[Telemetry], Telemetry] | None = None
        self.pictures: Callable[[Sequence[Picture]], Sequence[Picture]] | None = None
        self._rate, self._turns = rate, 0
        self._decoder, self._mcu = Decoder(outputs=pool.vehicle.mcu.outputs), Decoder(MCU)
        self._rows: list[tuple[float, Array, Array, bool]] = []

    def exchange(self, until: float, sent: Sequence[bytes]) -> Delivery:
        """Let the pool go on by one period; `until` is the robot's belief and does not count."""
        self._note(sent)
        self._turns += 1
        delivery = self.pool.exchange(self._turns / self._rate, sent)
        frames = delivery.frames
        if self.change is not None:
            frames = tuple((time, self._changed(data)) for time, data in frames)
        pictures = delivery.pictures if self.pictures is None else tuple(self.pictures(delivery.pictures))
        return Delivery(
            delivery.time + self.shift,
            tuple((time + self.shift, data) for time, data in frames),
            tuple(replace(picture, time=picture.time + self.shift) for picture in pictures),
        )

    def course(self) -> Course:
        """The truth at each exchange."""
        time, position, thrust, enabled = zip(*self._rows, strict=True)
        return Course(np.array(time), np.array(position), np.array(thrust), np.array(enabled, float))

    def _note(self, sent: Sequence[bytes]) -> None:
        plant = self.pool.plant
        drives = any(command.enable for data in sent for command in self._mcu.feed(data))
        self._rows.append((self.pool.time, plant.position.astype(float), plant.thrust.astype(float), drives))

    def _changed(self, data: bytes) -> bytes:
        """The frame with its snapshot changed; other frames, and those that no longer decode, as they are."""
        messages = self._decoder.feed(data)
        if self.change is None or len(messages) != 1 or not isinstance(messages[0], Telemetry):
            return data
        return encode_telemetry(self.change(messages[0]))


@dataclass
class Bench:
    """All that a fault can lay hands on."""

    pool: VirtualPool
    wire: FaultyWire
    runtime: Runtime
    recorder: Recorder
    undo: list[Callable[[], None]] = field(default_factory=list)
    """Called when the trial is over."""


Touch = Callable[[Bench], None]


@dataclass(frozen=True, kw_only=True)
class Fault:
    """One way in which something breaks."""

    begin: Touch
    during: Touch | None = None
    """Called after every step while it lasts."""
    end: Touch | None = None
    lasts: float = math.inf
    """[s]"""
    cuts_record: bool = False
    """Whether the record cannot go on."""


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """A row of the table: faults of one kind; its figures are those of the worst."""

    title: str
    faults: Mapping[str, Fault]
    """By the name of the variant."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Fields of `BridgeSettings` that differ from the vehicle's."""
    motions: tuple[str, ...] = ("station", "moving")
    """What the vehicle is doing."""
    must_fail: bool = False
    """A control: with its watchdogs off, the vehicle has to be seen to fail."""


RECORDER_TURN = 0.3
"""Longer than the recorder's thread takes to put on disk what waits; lock-step time runs faster than it [s]."""


def pool_fault(pictures: float = 0.0, **fields: Any) -> Touch:
    """Sets fields of `pool.faults`; pictures are lost with a probability of their own."""

    def begin(bench: Bench) -> None:
        for name, value in fields.items():
            setattr(bench.pool.faults, name, value)
        if pictures:
            random = np.random.default_rng([bench.pool.faults.seed, 0xB11D])
            bench.wire.pictures = lambda found: [p for p in found if random.random() >= pictures]

    return begin


def stuck_sensors(*names: str) -> Touch:
    """These fields of the telemetry keep their values, while sequence and clock go on."""

    def begin(bench: Bench) -> None:
        held: dict[str, Any] = {}

        def change(telemetry: Telemetry) -> Telemetry:
            if not held:
                held.update({name: getattr(telemetry, name) for name in names})
            return replace(telemetry, **held)

        bench.wire.change = change

    return begin


def stuck_pictures(bench: Bench) -> None:
    """The camera sends its last picture again and again, each with a new number and time."""
    last: list[Picture] = []

    def change(found: Sequence[Picture]) -> Sequence[Picture]:
        if not last:
            last.extend(found[-1:])
        return [replace(p, image=last[0].image, tags=last[0].tags) for p in found] if last else found

    bench.wire.pictures = change


def blind(bench: Bench) -> None:
    """No picture arrives."""
    bench.wire.pictures = lambda found: ()


def see_again(bench: Bench) -> None:
    """Pictures arrive again."""
    bench.wire.pictures = None


def two_publishers(bench: Bench) -> None:
    """Somebody else commands full thrust, at every step."""
    bridge, now = bench.runtime.bridge, bench.pool.time + bench.wire.shift
    bridge.command(now, np.full_like(bridge.force, 5.0), "intruder", stamp=now)


def jump_robot_clock(step: float) -> Touch:
    """The robot's clock jumps by so much [s]."""

    def begin(bench: Bench) -> None:
        bench.wire.shift += step

    return begin


def jump_mcu_clock(step: float) -> Touch:
    """The motor controller's clock jumps by so much [s]; its sequence goes on."""
    moved = round(1000.0 * step)

    def begin(bench: Bench) -> None:
        bench.wire.change = lambda telemetry: replace(
            telemetry, mcu_ms=(telemetry.mcu_ms + moved) % (1 << 32)
        )

    return begin


def full_disk(bench: Bench) -> None:
    """The system takes no more bytes of any file that is as long as the record is now."""
    time.sleep(RECORDER_TURN)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    bench.undo.append(lambda: resource.setrlimit(resource.RLIMIT_FSIZE, before))
    resource.setrlimit(resource.RLIMIT_FSIZE, (os.path.getsize(bench.recorder.path), before[1]))


VALUES = {"quaternion": 4, "gyro": 3, "accel": 3, "depth": 0, "pressure": 0, "motor_rpm": 8}
"""Numbers in the fields of the telemetry; 0: one, without an index."""

TIMES = ("command", "telemetry", "state")
UNWATCHED: Mapping[str, Any] = {
    **{f"{name}_timeout": math.inf for name in TIMES},
    **{f"{name}_limit": math.inf for name in ("frozen", "hold", "reject")},
    "max_tilt": math.inf,
    "clock_step": math.inf,
    "need_reading": False,
}
"""Bridge settings without watchdogs: the control that shows that they are needed, and that the table can tell."""


def _one(title: str, begin: Touch, **more: Any) -> Scenario:
    """A fault of one kind only."""
    return Scenario(title=title, faults={"": Fault(begin=begin, **more)})


def _lost(title: str, share: float) -> Scenario:
    """So much of what passes upwards, downwards, or both and of the pictures."""
    touches = {
        "up": pool_fault(drop=share),
        "down": pool_fault(drop_commands=share),
        "all": pool_fault(share, drop=share, drop_commands=share),
    }
    return Scenario(title=title, faults={name: Fault(begin=touch) for name, touch in touches.items()})


def _nan(field: str) -> Scenario:
    names = [field, *(f"{field}.{i}" for i in range(VALUES[field]))]
    faults = {name: Fault(begin=pool_fault(nan_field=name)) for name in names}
    return Scenario(title=f"NaN in {field}", faults=faults, motions=("moving",))


def _jumps(title: str, touch: Callable[[float], Touch], *steps: float) -> Scenario:
    return Scenario(title=title, faults={f"{step:+g} s": Fault(begin=touch(step)) for step in steps})


def _blind(lasts: float) -> Scenario:
    return _one(f"{lasts:g} s without vision", blind, end=see_again, lasts=lasts)


SCENARIOS: Mapping[str, Scenario] = {
    "loss-0": _one("no fault", pool_fault()),
    **{f"loss-{percent}": _lost(f"packet loss {percent} %", percent / 100) for percent in (10, 30, 50)},
    "link-cut": _lost("link cut", 1.0),
    "reordering": _one("reordering, half of the frames", pool_fault(reorder=0.5)),
    "duplicates": _one("duplicates, half of the frames", pool_fault(duplicate=0.5)),
    "corrupt": Scenario(
        title="corrupt frames",
        faults={
            "half": Fault(begin=pool_fault(corrupt=0.5)),
            "all": Fault(begin=pool_fault(corrupt=1.0)),
        },
    ),
    "frozen-imu": _one("frozen IMU", stuck_sensors("quaternion", "gyro", "accel")),
    "frozen-depth": _one("frozen depth", stuck_sensors("depth", "pressure")),
    "frozen-sensors": _one("all sensors frozen", pool_fault(freeze_sensors=True)),
    "frozen-picture": _one("frozen picture", stuck_pictures),
    **{f"nan-{field}": _nan(field) for field in VALUES},
    "blind-3": _blind(3.0),
    "blind-10": _blind(10.0),
    "second-publisher": _one("second publisher", two_publishers, during=two_publishers),
    "mcu-reboot": _one("MCU reboot", lambda bench: bench.pool.reboot()),
    "robot-clock": _jumps("robot's clock jumps", jump_robot_clock, -3600.0, -2.0, -0.2, 0.5, 2.0, 3600.0),
    "mcu-clock": _jumps("MCU's clock jumps", jump_mcu_clock, -100.0, -2.0, -0.2, 0.5, 2.0, 100.0),
    "full-disk": _one("full disk", full_disk, cuts_record=True),
    "control": Scenario(
        title="control: no watchdogs, link cut up",
        faults={"": Fault(begin=pool_fault(drop=1.0))},
        settings=UNWATCHED,
        motions=("moving",),
        must_fail=True,
    ),
}
"""Name -> scenario, in the order of the table; those with processes of their own are `faults.KILLS`."""
