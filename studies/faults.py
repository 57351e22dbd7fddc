"""Faults injected while a vehicle drives: `python -m studies.faults --out faults`.

Wire faults are injected in lock-step, process faults in real time, by kill -9.
"""

from __future__ import annotations

import json
import math
import os
import re
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.cli.command_line import run_script
from finssim.core.progress import Progress
from finssim.core.provenance import provenance
from finssim.core.quiet import start_warp
from finssim.core.system import SEPARATE, interrupt
from finssim.evaluation.campaign import check_choices, run_jobs, write_json
from finssim.evaluation.robot_trials import PoolJob, noise_seed
from finssim.evaluation.tables import Table
from finssim.pool import TruthError, VirtualPool, read_truth
from finssim.pool.firmware import Firmware
from finssim.pool.plan import PoolPlan
from finssim.robot.bridge import Bridge, BridgeSettings
from finssim.robot.goals import station_of
from finssim.robot.links.frames import MCU, Decoder, encode_telemetry
from finssim.robot.lockstep import run_lockstep
from finssim.robot.messages import Delivery, Picture, Telemetry, ThrusterCommand
from finssim.robot.perception import Perception
from finssim.robot.pilots import make_pilot
from finssim.robot.record_reader import Record, open_record
from finssim.robot.recorder import Recorder
from finssim.robot.runtime import Runtime
from finssim.robot.wiring import link_of
from finssim.vehicles import load_vehicle

__all__ = ["SCENARIOS", "Bench", "Fault", "Scenario", "fault_job", "faults_experiment", "tables_of"]

Array = NDArray[np.float64]


class Course(NamedTuple):
    """True motion and thrust of a trial, on the pool's clock."""

    time: Array
    """Times [s], (k,)."""
    position: Array
    """Body origin, world frame [m], (k, 3)."""
    thrust: Array
    """Delivered thrust, canonical order [N], (k, n)."""
    enabled: Array
    """Flag [-]: 1 where the robot sent a frame that enables the motors, else 0, (k,); NaN where it was not observed."""


class FaultyWire:
    """World in lock-step whose time advances by one period at each exchange, independent of the robot's clock.

    Attributes:
        pool: Pool at the other end.
        shift: Time by which the robot's clock is ahead of the pool's [s]; a change is a jump of the robot's clock.
        change: Function applied to each snapshot of the vehicle; None leaves the bytes unchanged.
        pictures: Function applied to the pictures of an exchange; None leaves them unchanged.
        others: Function of the time [s] that returns frames of other stations on an autopilot's wire; None: no other
            station.
    """

    def __init__(self, pool: VirtualPool, rate: float) -> None:
        """
        Args:
            pool: Pool at time 0.
            rate: Exchanges per second [Hz].
        """
        self.pool = pool
        self.shift = 0.0
        self.change: Callable[[Telemetry], Telemetry] | None = None
        self.pictures: Callable[[Sequence[Picture]], Sequence[Picture]] | None = None
        self.others: Callable[[float], list[bytes]] | None = None
        self._rate, self._turns = rate, 0
        self._decoder, mcu = Decoder(outputs=pool.vehicle.mcu.outputs), Decoder(MCU)
        self._drives: Callable[[bytes], bool] = lambda data: any(_enables(m) for m in mcu.feed(data))
        if not isinstance(pool.firmware, Firmware):
            self._drives = _axes_reader()
        self._rows: list[tuple[float, Array, Array, bool]] = []

    def exchange(self, until: float, sent: Sequence[bytes]) -> Delivery:
        """Advance the pool by one period; `until`, a time on the robot's clock, is ignored. Times are in [s]."""
        self._note(sent)
        self._turns += 1
        more = self.others(self.pool.time) if self.others is not None else ()
        delivery = self.pool.exchange(self._turns / self._rate, [*sent, *more])
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
        """Return the truth at each exchange."""
        time, position, thrust, enabled = zip(*self._rows, strict=True)
        return Course(np.array(time), np.array(position), np.array(thrust), np.array(enabled, float))

    def _note(self, sent: Sequence[bytes]) -> None:
        plant = self.pool.plant
        drives = any(self._drives(data) for data in sent)
        self._rows.append((self.pool.time, plant.position.astype(float), plant.thrust.astype(float), drives))

    def _changed(self, data: bytes) -> bytes:
        """Return a frame with its snapshot changed; other frames, and those that cannot be decoded, unchanged."""
        messages = self._decoder.feed(data)
        if self.change is None or len(messages) != 1 or not isinstance(messages[0], Telemetry):
            return data
        return encode_telemetry(self.change(messages[0]))


def _enables(message: object) -> bool:
    return isinstance(message, ThrusterCommand) and message.enable


def _axes_reader() -> Callable[[bytes], bool]:
    """Return a function that detects whether a frame to an autopilot moves an axis off its centre."""
    from pymavlink.dialects.v20 import ardupilotmega as mavlink

    mav = mavlink.MAVLink(None)
    return lambda data: any(
        (m.x, m.y, m.z, m.r, m.s, m.t) != (0, 0, 500, 0, 0, 0)
        for m in mav.parse_buffer(data) or ()
        if m.get_type() == "MANUAL_CONTROL"
    )


@dataclass
class Bench:
    """Parts of a trial that a fault can change."""

    pool: VirtualPool
    wire: FaultyWire
    runtime: Runtime
    recorder: Recorder
    undo: list[Callable[[], None]] = field(default_factory=list)
    """Functions called at the end of the trial."""


Touch = Callable[[Bench], None]
STOP_WITHIN = 0.5
"""Time after a fault within which thrust must be zero, unless the vehicle stays inside the workspace [s]."""


@dataclass(frozen=True, kw_only=True)
class Fault:
    """One failure: functions that begin and end it."""

    begin: Touch
    during: Touch | None = None
    """Called after every step during the fault."""
    end: Touch | None = None
    lasts: float = math.inf
    """Duration [s]."""
    cuts_record: bool = False
    """True if the record ends with the fault."""


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """Row of the table: faults of one kind, of which the worst figures are shown."""

    title: str
    faults: Mapping[str, Fault]
    """Name of the variant -> fault."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Fields of `BridgeSettings` that differ from the vehicle's."""
    motions: tuple[str, ...] = ("station", "moving")
    """Motions of the vehicle."""
    must_fail: bool = False
    """True for the control: with its watchdogs off, the vehicle has to fail."""
    firmware: Literal["mcu", "ardusub", "ardusub-own"] = "mcu"
    """Firmware that drives the motors."""
    plant: Mapping[str, Any] = field(default_factory=dict)
    """Fields of the plant's firmware that differ."""
    watched: float = 0.0
    """Least time of observation after the fault [s]; 0: that of all trials."""
    off: float = math.inf
    """Greatest true distance from the goal at the end, horizontal [m]."""
    ends: str = ""
    """Pattern of the reason with which an autopilot's run must end; empty: it must continue."""
    limit: float = STOP_WITHIN
    """Longest time from the fault until its thrusters stop [s]."""
    handed_over: bool = False
    """True if another pilot takes over, so that only our axis commands must end, not all thrust."""


RECORDER_TURN = 0.3
"""Time that the recorder's thread needs at most to write its queue [s]; lock-step time runs faster."""


def pool_fault(pictures: float = 0.0, **fields: Any) -> Touch:
    """Return a fault that sets fields of `pool.faults`, and loses pictures with a probability."""

    def begin(bench: Bench) -> None:
        _set(bench.pool.faults, fields)
        if pictures:
            random = np.random.default_rng([bench.pool.faults.seed, 0xB11D])
            bench.wire.pictures = lambda pictures_taken: [
                p for p in pictures_taken if random.random() >= pictures
            ]

    return begin


def autopilot_fault(**fields: Any) -> Touch:
    """Return a fault that sets fields of `pool.faults.autopilot`."""
    return lambda bench: _set(bench.pool.faults.autopilot, fields)


def _set(faults: Any, fields: Mapping[str, Any]) -> None:
    """Set existing fields."""
    for name, value in fields.items():
        getattr(faults, name)
        setattr(faults, name, value)


def stuck_sensors(*names: str) -> Touch:
    """Return a fault in which fields of the telemetry keep their values, while sequence and clock advance."""

    def begin(bench: Bench) -> None:
        held: dict[str, Any] = {}

        def change(telemetry: Telemetry) -> Telemetry:
            if not held:
                held.update({name: getattr(telemetry, name) for name in names})
            return replace(telemetry, **held)

        bench.wire.change = change

    return begin


def stuck_pictures(bench: Bench) -> None:
    """Make the camera repeat its last picture, each time with a new number and time."""
    last: list[Picture] = []

    def change(pictures: Sequence[Picture]) -> Sequence[Picture]:
        if not last:
            last.extend(pictures[-1:])
        return [replace(p, image=last[0].image, tags=last[0].tags) for p in pictures] if last else pictures

    bench.wire.pictures = change


def two_publishers(bench: Bench) -> None:
    """Make a second publisher command full thrust at every step."""
    bridge, now = bench.runtime.bridge, bench.pool.time + bench.wire.shift
    bridge.command(now, np.full_like(bridge.force, 5.0), "intruder", stamp=now)


def on_wire(**fields: Any) -> Touch:
    """Return a fault that sets fields of the wire."""
    return lambda bench: _set(bench.wire, fields)


def jump_mcu_clock(step: float) -> Touch:
    """Return a fault in which the motor controller's clock jumps by a step [s]; its sequence continues."""
    moved = round(1000.0 * step)
    return on_wire(change=lambda telemetry: replace(telemetry, mcu_ms=(telemetry.mcu_ms + moved) % (1 << 32)))


def full_disk(bench: Bench) -> None:
    """Make the system refuse to let files grow beyond the present size of the record."""
    import resource

    time.sleep(RECORDER_TURN)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    bench.undo.append(lambda: resource.setrlimit(resource.RLIMIT_FSIZE, before))
    resource.setrlimit(resource.RLIMIT_FSIZE, (os.path.getsize(bench.recorder.path), before[1]))


VALUES = {"quaternion": 4, "gyro": 3, "accel": 3, "depth": 0, "pressure": 0, "motor_rpm": 8}
"""Number of values in the fields of the telemetry; 0: one, without an index."""

TIMES = ("command", "telemetry", "state")
UNWATCHED: Mapping[str, Any] = {
    **{f"{name}_timeout": math.inf for name in TIMES},
    **{f"{name}_limit": math.inf for name in ("frozen", "hold", "reject")},
    "max_tilt": math.inf,
    "clock_step": math.inf,
    "need_reading": False,
}
"""Bridge settings without watchdogs, for the control that shows that they are needed and that the table detects it."""


def _scenario(title: str, faults: Touch | Fault | Mapping[str, Touch], **more: Any) -> Scenario:
    """Return a scenario of one fault, or of variants by name; a permanent fault is only a function that begins it."""
    variants = faults if isinstance(faults, Mapping) else {"": faults}
    by_name = {name: x if isinstance(x, Fault) else Fault(begin=x) for name, x in variants.items()}
    return Scenario(title=title, faults=by_name, **more)


def _lost(title: str, share: float) -> Scenario:
    """Return a scenario in which a fraction of the frames up, down, or both and of the pictures is lost."""
    everything = pool_fault(share, drop=share, drop_commands=share)
    up, down = pool_fault(drop=share), pool_fault(drop_commands=share)
    return _scenario(title, {"up": up, "down": down, "all": everything})


def _nan(field: str) -> Scenario:
    names = [field, *(f"{field}.{i}" for i in range(VALUES[field]))]
    return _scenario(
        f"NaN in {field}", {name: pool_fault(nan_field=name) for name in names}, motions=("moving",)
    )


def _jumps(title: str, touch: Callable[[float], Touch], *steps: float) -> Scenario:
    return _scenario(title, {f"{step:+g} s": touch(step) for step in steps})


def _blind(lasts: float) -> Scenario:
    blind, sighted = on_wire(pictures=lambda pictures: ()), on_wire(pictures=None)
    return _scenario(f"{lasts:g} s without vision", Fault(begin=blind, end=sighted, lasts=lasts))


def reboot(bench: Bench) -> None:
    """Restart the motor controller or the autopilot."""
    bench.pool.reboot()


def another_station(
    message: str, *fields: float, every: float = 0.04, times: float = math.inf, system: int = 255
) -> Touch:
    """Return a fault in which another ground station on an autopilot's wire sends a message.

    Args:
        message: Name of the MAVLink message, in lower case.
        fields: Fields of the message, in MAVLink's order.
        every: Interval [s].
        times: Number of messages [-].
        system: System number of that station.
    """

    def begin(bench: Bench) -> None:
        from pymavlink.dialects.v20 import ardupilotmega as mavlink

        mav = mavlink.MAVLink(None, system, 190)
        message_of_station = getattr(mavlink, f"MAVLink_{message}_message")(*fields)
        due, remaining = bench.pool.time, times

        def others(now: float) -> list[bytes]:
            nonlocal due, remaining
            if now < due or remaining <= 0:
                return []
            due, remaining = now + every, remaining - 1
            mav.seq = (mav.seq + 1) % 256
            return [bytes(message_of_station.pack(mav))]

        bench.wire.others = others

    return begin


def _command(number: int, *values: float) -> Touch:
    """Return a fault in which another ground station sends one command."""
    return another_station("command_long", 1, 1, number, 0, *values, *[0] * (7 - len(values)), times=1)


def _autopilot(title: str, ends: str, limit: float, faults: Any, **more: Any) -> Scenario:
    return _scenario(title, faults, **{"firmware": "ardusub", "ends": ends, "limit": limit, **more})


def leap(bench: Bench) -> None:
    """Make the autopilot's filter reset its position by 0.7 m."""
    autopilot: Any = bench.pool.firmware
    autopilot.leap(0.5, -0.5)


def turning_north(bench: Bench) -> None:
    """Rotate the autopilot's north further, by one step of 15° in 20 s."""
    bench.pool.faults.autopilot.north += math.radians(15.0) / 20.0 / RATE


def lagging_leap(bench: Bench) -> None:
    """Make the autopilot's position late, and then reset it."""
    bench.pool.faults.autopilot.position_lag = 0.25
    leap(bench)


TURNED: Mapping[str, Any] = {"watched": 55.0, "off": 0.25, "settings": {"workspace_upper": (4.6, 2.6, 0.0)}}
"""Settings for a vehicle that floats up while its thrust pauses, and returns to its goal."""
TURN_SEEN = (4.0 + 0.05 * 30.0 + 1.0) / 0.75
"""Time until the link detects a rotation of 0.75 °/s [s]: 4°, 5 % of the 30° that the vehicle turns itself,
and 1° by which the autopilot's heading lags."""
DECLINATION = math.radians(11.4)
"""Magnetic declination at the location where the real autopilot was recorded [rad]."""
OWN: Mapping[str, Any] = {"firmware": "ardusub-own", "watched": 20.0, "off": 0.15}
"""Settings for an autopilot that locates itself and holds its position."""


def low_battery(bench: Bench) -> None:
    """Make the battery voltage fall below the value at which the autopilot, with its user's settings, disarms."""
    autopilot: Any = bench.pool.firmware
    autopilot.parameters |= {"BATT_LOW_VOLT": 12.8, "BATT_FS_LOW_ACT": 2.0}
    bench.pool.faults.autopilot.battery_voltage = 9.0


SILENT, WAITS = "no fresh telemetry", "held longer than"
UNARMED = "failsafe|was disarmed"
AUTOPILOT: Mapping[str, Scenario] = {
    "ap-none": _autopilot("no fault", "", math.inf, pool_fault()),
    "ap-heartbeat": _autopilot(
        "its heartbeat is lost", "no heartbeat from the autopilot", 3.5, autopilot_fault(no_heartbeat=True)
    ),
    "ap-our-heartbeat": _autopilot("ours is lost", "", math.inf, autopilot_fault(no_ground_heartbeat=True)),
    "ap-silence": _autopilot("telemetry is lost", SILENT, 1.0, pool_fault(drop=1.0)),
    "ap-deaf": _autopilot(
        "what is sent is lost", "our frames are lost|was disarmed|in failsafe", 3.5, pool_fault(drop_commands=1.0)
    ),
    "ap-joystick": _autopilot(
        "a joystick steers", "manual control", 0.5, another_station("manual_control", 1, 0, 0, 500, 400, 0),
        handed_over=True,
    ),
    "ap-mode": _autopilot("the mode is changed", "changed to ALT_HOLD", 0.5, _command(176, 1, 2), handed_over=True),
    "ap-disarm": _autopilot("disarmed from outside", "was disarmed", 0.5, _command(400, 0)),
    "ap-station": _autopilot("a second ground station, which listens", "", math.inf, {
        "1": another_station("heartbeat", 6, 8, 0, 0, 0, 3, every=1.0, system=254),
        "2": another_station("request_data_stream", 1, 1, 0, 2, 1, every=2.0),
    }),
    "ap-dvl": _autopilot(
        "Doppler log lost for 10 s", WAITS, 4.0,
        Fault(begin=autopilot_fault(dvl_silent=True), end=autopilot_fault(dvl_silent=False), lasts=10.0),
    ),
    "ap-origin": _autopilot(
        "an origin is set, its north turns by 11.4°", "", 0.5,
        Fault(begin=another_station("set_gps_global_origin", 1, 338103130, -1183938670, 0, times=1), lasts=20.0),
        plant={"declination": DECLINATION}, **TURNED,
    ),
    "ap-north": _autopilot(
        "its north turns by 15° in 20 s without a word", "", TURN_SEEN,
        Fault(begin=turning_north, during=turning_north, lasts=20.0), **TURNED,
    ),
    "ap-leap": _autopilot("its own position is reset by 0.7 m", "", math.inf, leap, **OWN),
    "ap-lag": _autopilot("its own position lags by 0.25 s", "", math.inf, autopilot_fault(position_lag=0.25), **OWN),
    "ap-lag-leap": _autopilot("it lags and is reset", "", math.inf, lagging_leap, **OWN),
    "ap-own-dvl": _autopilot(
        "its Doppler log is lost, by its own position", WAITS, 7.5, autopilot_fault(dvl_silent=True),
        firmware="ardusub-own", watched=15.0,
    ),
    "ap-depth": _autopilot("depth frozen", WAITS, 4.0, pool_fault(freeze_depth=True)),
    "ap-battery": _autopilot(
        "battery low, with its failsafe set to disarm", UNARMED, 10.5, low_battery,
    ),
    "ap-leak": _autopilot("leak", "autopilot reports: Leak", 1.0, autopilot_fault(leak=True)),
    "ap-spoiled": _autopilot(
        "a tenth lost and spoiled", "", math.inf, pool_fault(drop=0.1, corrupt=0.1, drop_commands=0.1)
    ),
    "ap-corrupt": _autopilot("all frames spoiled", SILENT, 1.0, pool_fault(corrupt=1.0)),
    "ap-reboot": _autopilot("it restarts", f"restarted|{SILENT}", 0.5, reboot),
}  # fmt: skip
"""Scenarios of an emulated ArduSub; docs/bluerov2.md lists how each must end."""

SCENARIOS: Mapping[str, Scenario] = {
    "loss-0": _scenario("no fault", pool_fault()),
    **{f"loss-{percent}": _lost(f"packet loss {percent} %", percent / 100) for percent in (10, 30, 50)},
    "link-cut": _lost("link cut", 1.0),
    "reordering": _scenario("reordering, half of the frames", pool_fault(reorder=0.5)),
    "duplicates": _scenario("duplicates, half of the frames", pool_fault(duplicate=0.5)),
    "corrupt": _scenario("corrupt frames", {"half": pool_fault(corrupt=0.5), "all": pool_fault(corrupt=1.0)}),
    "frozen-imu": _scenario("frozen IMU", stuck_sensors("quaternion", "gyro", "accel")),
    "frozen-depth": _scenario("frozen depth", stuck_sensors("depth", "pressure")),
    "frozen-sensors": _scenario("all sensors frozen", pool_fault(freeze_sensors=True)),
    "frozen-picture": _scenario("frozen picture", stuck_pictures),
    **{f"nan-{field}": _nan(field) for field in VALUES},
    "blind-3": _blind(3.0),
    "blind-10": _blind(10.0),
    "second-publisher": _scenario("second publisher", Fault(begin=two_publishers, during=two_publishers)),
    "mcu-reboot": _scenario("MCU reboot", reboot),
    "robot-clock": _jumps(
        "robot's clock jumps", lambda step: on_wire(shift=step), -3600.0, -2.0, -0.2, 0.5, 2.0, 3600.0
    ),
    "mcu-clock": _jumps("MCU's clock jumps", jump_mcu_clock, -100.0, -2.0, -0.2, 0.5, 2.0, 100.0),
    "full-disk": _scenario("full disk", Fault(begin=full_disk, cuts_record=True)),
    "control": _scenario(
        "control: no watchdogs, link cut up",
        pool_fault(drop=1.0),
        settings=UNWATCHED,
        motions=("moving",),
        must_fail=True,
    ),  # fmt: skip
    **AUTOPILOT,
}
"""Name -> scenario, in the order of the table; scenarios with separate processes are in `KILLS`."""


RATE = 60.0
"""Rate of the robot's loop [Hz]."""
MOTIONS = {
    "station": ("0,0,-0.5,0", "0,0,-0.5,0", 8.0, 4.0),
    "moving": ("-1.2,-0.3,-0.5,0", "1.2,0.3,-0.5,60", 3.0, 1.5),
}
"""Name -> start, goal, time of the fault after arming, and of the kill after the first thrust [s]."""
TANK_MOTIONS = {
    "station": ("0,0,-2,0", "0,0,-2,0", 8.0, math.nan),
    "moving": ("-1.2,-0.3,-2,0", "1.2,0.3,-2,30", 5.0, math.nan),
}
"""Motions in the tank, of vehicles with an autopilot."""
WATCHED = 10.0
"""Time of observation after a permanent fault, and shortest one after a temporary fault [s]."""
AFTERWARDS = 4.0
"""Time of observation after the end of a temporary fault [s]."""
LONGEST = 90.0
"""Longest trial: time until the estimator has a position, and the longest fault [s]."""
ATTEMPTS = 3
WATCHED_ALIVE = 8.0
"""Time of observation of the surviving process after a kill [s]."""
KILL_WEIGHT = 5.0
"""Number of trials in lock-step that take as long as one in real time."""
STILL = 0.05
"""Thrust below which a thruster counts as stopped [N]."""
QUIET = 1.0
"""Time without thrust at the end of a fault after which thrusters count as stopped [s]; a shorter time is a
gap between pulses."""
LONGEST_LOSS = 1.0
"""Longest duration that may be missing at the end of a record [s]."""
INSET = np.array([0.4, 0.4, 0.2])
"""Distance by which the workspace of these trials is smaller than the vehicle file's on every side, x, y, z [m]: a
vehicle cannot leave a workspace that ends at the pool's walls."""


def inset(lower: Any, upper: Any) -> tuple[Array, Array]:
    """Return lower and upper corner of the workspace in which faults are tried, world frame [m], each (3,)."""
    return np.asarray(lower, float) + INSET, np.asarray(upper, float) - INSET


def measured(course: Course, began: float, ended: float, box: tuple[Array, Array] | None) -> dict[str, Any]:
    """Return the measures of a trial.

    Args:
        course: The truth, to the end of the trial.
        began: Start of the fault, pool's clock [s].
        ended: End of the fault or the trial [s].
        box: Lower and upper corner of the workspace; None: the vehicle's position does not count.

    Returns:
        `thrust_gone_s`, `frames_off_s`: from the fault to the last thrust, and to the last frame that enables
        motors; None if they did not end. `margin_m`: least distance to the workspace's faces after the fault,
        negative outside. `speed_m_s` and `thrust_n` (sum of magnitudes, mean over a second) before it.
    """
    t, fault = course.time, (course.time >= began) & (course.time <= ended)
    pushes = np.abs(course.thrust).max(axis=1) > STILL
    before = (t >= began - 1.0) & (t <= began)
    after = course.position[t >= began]
    margin = None if box is None else float(np.min([after - box[0], box[1] - after]))
    travelled = np.linalg.norm(np.diff(course.position[before], axis=0), axis=1).sum()
    return {
        "thrust_gone_s": _last_activity(t[fault], pushes[fault], began),
        "frames_off_s": _last_activity(t[fault], course.enabled[fault] > 0.0, began),
        "margin_m": margin,
        "speed_m_s": float(travelled / max(np.ptp(t[before]), 1e-9)),
        "thrust_n": float(np.abs(course.thrust[before]).sum(axis=1).mean()),
    }


def passed(result: Mapping[str, Any]) -> bool:
    """Return whether a trial passed: stopped in time or inside, nothing raised, the record readable."""
    stopped_after, margin = result["thrust_gone_s"], result["margin_m"]
    stopped = stopped_after is not None and stopped_after <= STOP_WITHIN
    inside = margin is not None and margin >= 0.0
    lost = result["record_lost_s"]
    recorded = not result["record_problem"] and lost is not None and lost <= LONGEST_LOSS
    return bool((stopped or inside) and not result["raised"] and recorded)


def _last_activity(time: Array, active: NDArray[np.bool_], began: float) -> float | None:
    """Return the end of the last activity, relative to `began` [s]; None if it had not ended for `QUIET`."""
    last = float(time[active][-1]) if active.any() else began
    return None if time[-1] - last < QUIET else last - began


@dataclass(frozen=True, kw_only=True)
class FaultJob(PoolJob):
    """Job of one fault in a motion and a pool with a given vehicle; the row is the name of the scenario."""

    variant: str
    motion: str
    """Motion of the vehicle: station or moving."""
    camera: str = "corners"

    def plan(self, seed: int) -> PoolPlan:
        """Return the plan of its pool, with a seed for noise; an autopilot has an origin if it locates itself."""
        plan, scenario = super().plan(seed), SCENARIOS[self.row]
        absent = {"origin": None} if self.firmware == "ardusub" else {}
        firmware = plan.spec.firmware.model_copy(update={**absent, **scenario.plant})
        return replace(plan, spec=plan.spec.model_copy(update={"firmware": firmware}))


def fault_job(
    scenario: str, variant: str = "", motion: str = "station", vehicle: str = "finsrov", **settings: Any
) -> FaultJob:
    """Return the job of a variant of a scenario; settings are further fields."""
    if scenario in SCENARIOS and SCENARIOS[scenario].firmware != "mcu":
        settings |= {"firmware": SCENARIOS[scenario].firmware, "site": "tank"}
    return FaultJob(
        row=scenario, target=f"{variant} {motion}".strip(), variant=variant, motion=motion, vehicle=vehicle,
        pool_vehicle=vehicle, **settings,
    )  # fmt: skip


def play(job: FaultJob, path: Path) -> dict[str, Any]:
    """Run a job in lock-step.

    Args:
        job: Fault, motion and pool.
        path: Not used: the record is read and removed before this ends.

    Returns:
        The measures of `measured`; `state` and `reason` of the bridge at the end; `raised`, the exceptions, or empty;
        `record_lost_s` and `record_problem`; `ok`.
    """
    start_warp()
    scenario, aided = SCENARIOS[job.row], job.aided
    vehicle = job.equipped()
    start, goal, when, _ = (TANK_MOTIONS if aided else MOTIONS)[job.motion]
    box = inset(vehicle.safety.workspace_lower, vehicle.safety.workspace_upper)
    workspace = {"workspace_lower": box[0], "workspace_upper": box[1]}
    seed = noise_seed(job.seed, job.target)
    plan = job.plan(seed)
    pool = plan.standing(station_of(start), seed=seed)
    with tempfile.TemporaryDirectory() as folder:
        record = Path(folder) / "run.mcap"
        with Recorder(record, vehicle, {"command": "python -m studies.faults"}) as recorder:
            bridge = Bridge(vehicle, BridgeSettings.of(vehicle, **{**workspace, **scenario.settings}))
            let_in = station_of(start).position[:2]
            perception = (
                Perception(vehicle, None, mode="error-state", let_in=let_in)
                if aided
                else Perception(vehicle, plan.calibrated)
            )
            runtime = Runtime(
                vehicle, perception, make_pilot("pid", vehicle), station_of(goal), arm=True, bridge=bridge,
                recorder=recorder,
            )  # fmt: skip
            if aided:
                runtime.attach(link_of("mavlink", vehicle))
            bench = Bench(pool, FaultyWire(pool, RATE), runtime, recorder)
            limit = scenario.limit if math.isfinite(scenario.limit) else 0.0
            watched = max(WATCHED, limit + AFTERWARDS, scenario.watched)
            script = _Script(bench, scenario.faults[job.variant], when, watched)
            raised = script.run()
        if math.isnan(script.began):
            raise RuntimeError(f"{job.key()}: the vehicle was never armed: {runtime.refusal}")
        course = bench.wire.course()
        ended = min(script.began + script.fault.lasts, float(course.time[-1]))
        steps = script.steps if script.fault.cuts_record else runtime.counters.steps
        # Each step of a run in lock-step leaves one state in the record.
        lost = _record_lost(
            record, lambda log: (steps - sum(1 for _ in log.messages(("estimator_status",)))) / RATE
        )
    result = {
        **measured(course, script.began, ended, box),
        "off_m": float(np.linalg.norm(course.position[-1, :2] - station_of(goal).position[:2])),
        "state": script.state,
        "reason": script.reason,
        "raised": raised,
        **lost,
        "provenance": provenance(),
    }
    return {**result, "ok": passed(result) and (not aided or ended_as_named(scenario, result))}


def ended_as_named(scenario: Scenario, result: Mapping[str, Any]) -> bool:
    """Return whether an autopilot's trial ended for the reason and within the time of its scenario, or continued."""
    ended_after = result["frames_off_s" if scenario.handed_over else "thrust_gone_s"]
    stopped = ended_after is not None and ended_after <= scenario.limit
    if not scenario.ends:
        paused = stopped or math.isinf(scenario.limit)
        return bool(result["state"] == "armed" and paused and result["off_m"] <= scenario.off)
    return stopped and re.search(scenario.ends, result["reason"]) is not None


class _Script:
    """Controller of a trial that begins and ends the fault, and stores the bridge's state before the run ends."""

    def __init__(self, bench: Bench, fault: Fault, when: float, watched: float) -> None:
        self.fault = fault
        self._bench, self._when, self._watched = bench, when, watched
        self._armed, self._ended = math.nan, False
        self.began = math.nan
        """Start of the fault on the pool's clock [s]; NaN before."""
        self.steps = 0
        """Number of the robot's steps before the fault."""
        self.state = self.reason = ""

    def _look(self, runtime: Runtime) -> None:
        """Begin, continue or end the fault after a step of the robot."""
        now, fault = self._bench.pool.time, self.fault
        self.state, self.reason = runtime.bridge.state, runtime.bridge.reason
        if math.isnan(self._armed) and not math.isnan(runtime.started):
            self._armed = now
        if math.isnan(self.began) and now >= self._armed + self._when:
            self.began, self.steps = now, runtime.counters.steps
            fault.begin(self._bench)
        elif now >= self.began + fault.lasts and not self._ended:
            self._ended = True
            if fault.end is not None:
                fault.end(self._bench)
        elif now >= self.began and not self._ended and fault.during is not None:
            fault.during(self._bench)

    def _over(self, runtime: Runtime) -> bool:
        """Return whether the fault and its consequences have been observed for long enough."""
        lasts = self.fault.lasts
        watched = 0.0 if math.isinf(lasts) else lasts + AFTERWARDS
        return self._bench.pool.time >= self.began + max(self._watched, watched)

    def run(self) -> str:
        """Run to the end, and return the exceptions raised in this thread or in another, or an empty text."""
        bench, raised, hook = self._bench, list[str](), threading.excepthook
        threading.excepthook = lambda args: raised.append(f"{args.exc_type.__name__}: {args.exc_value}")
        try:
            run_lockstep(bench.runtime, bench.wire, LONGEST, rate=RATE, show=self._look, until=self._over)
        except Exception as error:  # exceptions are a result of this study
            raised.append(f"{type(error).__name__}: {error}")
        finally:
            bench.recorder.close()
            for undo in bench.undo:
                undo()
            bench.pool.close()
            threading.excepthook = hook
        return "; ".join(raised)


def _record_lost(path: Path, lacks: Callable[[Record], float]) -> dict[str, Any]:
    """Return `record_lost_s`, the time missing in a record [s] or None, and `record_problem`, why it is unreadable."""
    try:
        with open_record(path) as record:
            return {"record_lost_s": max(lacks(record), 0.0), "record_problem": ""}
    except Exception as error:  # any error of a reader is a result
        return {"record_lost_s": None, "record_problem": f"{type(error).__name__}: {error}"}


def _record_cut(path: Path, at: float) -> dict[str, Any]:
    """Return these for a record that was truncated at a time of the robot's clock, which is this machine's [s]."""
    return _record_lost(path, lambda record: at - max(t for t, _, _ in record.sizes()) if record.cut else 0.0)


def _first_stop(path: Path, since: float) -> float | None:
    """Return the time at which the bridge first stopped enabling the motors after a time, from the record,
    robot's clock [s]."""
    with open_record(path) as record:
        for entry in record.messages(("events",)):
            kind = json.loads(entry.message.data)["kind"]
            if entry.time >= since and kind in ("hold", "fault", "disarmed"):
                return entry.time
    return None


# Processes of a robot and its virtual pool: started by their commands, observed, and killed.


STARTING = 120.0
"""Longest time that a process takes to start, or to reach an awaited state [s]."""
POLL = 0.005
"""Polling interval [s]."""


class ReliabilityError(ValueError):
    """Trial that could not run, since a process did not reach the required state."""


class Process:
    """Process that runs a `finssim` command, with its output in files."""

    def __init__(self, arguments: Sequence[str], folder: Path, name: str) -> None:
        """
        Args:
            arguments: Words of the command line after `finssim`.
            folder: Directory for NAME.out and NAME.err.
            name: Name of the files.
        """
        self.name = name
        self._out, self._err = folder / f"{name}.out", folder / f"{name}.err"
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        with self._out.open("wb") as out, self._err.open("wb") as err:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "finssim", *arguments],
                stdout=out,
                stderr=err,
                env=environment,
                **SEPARATE,
            )

    @property
    def output(self) -> str:
        """Standard output until now."""
        return self._out.read_text(encoding="utf-8", errors="replace")

    @property
    def complained(self) -> str:
        """Standard error until now."""
        return self._err.read_text(encoding="utf-8", errors="replace")

    @property
    def running(self) -> bool:
        """True while the process runs."""
        return self._process.poll() is None

    def kill(self) -> None:
        """End the process by `kill -9`."""
        self._process.kill()
        self._process.wait()

    def end(self) -> int:
        """End the process by Ctrl-C, or by a kill if it does not end, and return its exit status."""
        if self.running:
            interrupt(self._process)
        try:
            return self._process.wait(20.0)
        except subprocess.TimeoutExpired:
            self.kill()
            return self._process.returncode

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        """Kill the process at the end of its block if it still runs."""
        if self.running:
            self.kill()

    def broke(self) -> str:
        """Return the last line of a traceback, or an empty text if the process ended normally."""
        lines = self.complained.splitlines()
        if any(line.startswith("Traceback") for line in lines) or self._process.returncode == 1:
            return f"{self.name}: {lines[-1] if lines else 'exit status 1'}"
        return ""


@dataclass(frozen=True)
class Pair:
    """Processes of a robot and its pool, and the files that they write."""

    pool: Process
    robot: Process
    port: int
    """Port of the motor controller."""
    truth: Path
    record: Path

    def next_truth(self) -> float:
        """Wait until the truth file grows, and return the pool's clock then [s].

        The pool writes every half second, so that the last record is as old as one poll takes.
        """
        size = self.truth.stat().st_size
        _await(lambda: self.truth.stat().st_size > size, "the truth file does not grow", self.pool)
        return float(read_truth(self.truth).time[-1])

    def turning(self) -> bool:
        """Return whether the thrusters turn according to the truth file."""
        try:
            return bool(abs(read_truth(self.truth).thrust[-50:]).max(initial=0.0) > STILL)
        except TruthError:
            return False  # the file is still empty


@contextmanager
def pair(job: FaultJob, folder: Path) -> Iterator[Pair]:
    """Start both processes on free ports, and yield when the robot is armed and the thrusters turn.

    Args:
        job: Vehicle and motion.
        folder: Directory for their files.

    Raises:
        ReliabilityError: The pool never started, or the vehicle never drove.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        # The five ports after it are used too: if one is in use, another attempt follows.
        port: int = free.getsockname()[1]
    start, goal, *_ = MOTIONS[job.motion]
    truth, record = folder / "truth", folder / "run.mcap"
    end = f"127.0.0.1:{port + 4}"
    both = {"vehicle": job.vehicle, "pool-file": folder / "pool.yaml"}
    world = _arguments(
        "pool", **both, port=port, robot=end, plant=job.plant, start=start, severity=job.severity, seed=job.seed,
        camera="corners", truth=truth,
    )  # fmt: skip
    ours = _arguments(
        "run", "--arm", "--json", **both, goal=goal, bind=end, policy="pid", record=record,
        robot=f"udp://127.0.0.1:{port}", pictures=f"udp://127.0.0.1:{port + 1}",
    )  # fmt: skip
    with Process(world, folder, "pool") as pool:
        _await(lambda: "pictures: " in pool.output, "the pool never printed 'pictures: '", pool)
        with Process(ours, folder, "robot") as robot:
            both_at_work = Pair(pool, robot, port, truth, record)
            _await(both_at_work.turning, "no thruster ever turned", robot, 20.0 * POLL)
            yield both_at_work


def _arguments(*arguments: str, **options: Any) -> list[str]:
    """Return a command line: words, then options with their values."""
    return [*arguments, *(word for name, value in options.items() for word in (f"--{name}", str(value)))]


def _await(ready: Callable[[], bool], failure: str, process: Process, poll: float = POLL) -> None:
    """Wait until a process reaches a state.

    Raises:
        ReliabilityError: The process ended, or takes too long.
    """
    deadline = time.monotonic() + STARTING
    while not ready():
        if not process.running or time.monotonic() > deadline:
            last = (process.complained + process.output).strip()[-300:] or "no output"
            raise ReliabilityError(f"{failure}: {process.name}: {last}")
        time.sleep(poll)


def play_kill(job: FaultJob, path: Path) -> dict[str, Any]:
    """Run a job whose scenario is one of `KILLS`, in real time, and return the result as `play` does.

    Args:
        job: Fault, motion and pool.
        path: Not used, as in `play`.

    Raises:
        ReliabilityError: The vehicle never drove in three attempts: a busy machine stops it before the kill.
    """
    for attempt in range(ATTEMPTS):
        try:
            with tempfile.TemporaryDirectory() as folder, pair(job, Path(folder)) as both:
                time.sleep(MOTIONS[job.motion][3])
                result = KILLS[job.row][1](job, both)
                break
        except ReliabilityError:
            if attempt == ATTEMPTS - 1:
                raise
    return {**result, "provenance": provenance(), "ok": passed(result)}


def _kill_robot(job: FaultJob, both: Pair) -> dict[str, Any]:
    """Kill the robot: the motor controller's own timeout has to stop the motors."""
    began, killed = both.next_truth(), time.monotonic()
    both.robot.kill()
    time.sleep(WATCHED_ALIVE)
    both.pool.end()
    truth, safety = read_truth(both.truth), load_vehicle(job.vehicle).safety
    course = Course(truth.time, truth.position, truth.thrust, np.full(len(truth.time), math.nan))
    box = inset(safety.workspace_lower, safety.workspace_upper)
    return {
        **measured(course, began, float(truth.time[-1]), box),
        "frames_off_s": 0.0,
        "state": "gone",
        "reason": "the motor controller stops by itself",
        "raised": both.pool.broke(),
        **_record_cut(both.record, killed),
    }


def _kill_pool(job: FaultJob, both: Pair) -> dict[str, Any]:
    """Kill the pool, so that vehicle and camera are silent: the robot has to stop commanding.

    Its frames are received on the pool's port as soon as the system has freed it, and its bridge has recorded
    the time at which it stopped: the later of the two counts.
    """
    began, killed = both.next_truth(), time.monotonic()
    both.pool.kill()
    heard = _last_enabled(both, killed)
    both.robot.end()
    ended, truth = time.monotonic(), read_truth(both.truth)
    stopped = _first_stop(both.record, killed)
    off = None if heard is None or stopped is None else max(heard, stopped - killed)
    summary = json.loads(both.robot.output or "{}")
    course = Course(truth.time, truth.position, truth.thrust, np.ones(len(truth.time)))
    return {
        **measured(course, began, began, None),
        # The vehicle is gone: instead of its thrust, the last frame that would turn a motor counts.
        "thrust_gone_s": off,
        "frames_off_s": off,
        "state": summary.get("state", "no answer"),
        "reason": summary.get("reason", ""),
        "raised": both.robot.broke(),
        **_record_cut(both.record, ended),
    }


def _last_enabled(both: Pair, killed: float) -> float | None:
    """Return the time of the last frame that enables motors after the kill [s]; None if they never ended."""
    decoder, last = Decoder(MCU), killed
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as end:
        end.bind(("127.0.0.1", both.port))
        end.settimeout(0.1)
        while both.robot.running and time.monotonic() < killed + WATCHED_ALIVE:
            try:
                data = end.recv(2048)
            except TimeoutError:
                continue
            if any(_enables(message) for message in decoder.feed(data)):
                last = time.monotonic()
    # A process that has ended sends nothing more.
    return last - killed if not both.robot.running or time.monotonic() - last > QUIET else None


KILLS: dict[str, tuple[str, Callable[..., dict[str, Any]]]] = {
    "kill-robot": ("kill -9 of the robot's process", _kill_robot),
    "kill-pool": ("kill -9 of the pool's process", _kill_pool),
}
"""Name -> title, and the function that runs it."""


HEADS = (
    "",
    "trials",
    "thrust gone [s]",
    "frames off [s]",
    "inside by [m]",
    "ended",
    "record lost [s]",
    "verdict",
)
NOTE = (
    f"Passed: no thrust above {STILL:g} N later than {STOP_WITHIN:g} s after the fault, or always inside the workspace "
    f"(the vehicle file's less {INSET[0]:g} m at the sides, {INSET[2]:g} m above and below); nothing raised; record "
    f"readable, lacking at most {LONGEST_LOSS:g} s. Thrust and position are true; thrust includes the motors' lag. "
    "Times and record: the longest of the trials; inside by: the least distance to a face. drives on: thrusters still "
    "worked when the fault ended or the trial was over."
)


def tables_of(result: Mapping[str, Any]) -> list[Table]:
    """Return a table with a row for each scenario, the worst of its trials, and a sentence about each failed trial."""
    trials: dict[str, list[Mapping[str, Any]]] = {}
    for trial in result["trials"]:
        trials.setdefault(trial["job"]["row"], []).append(trial)
    counted = [trial for name, of_row in trials.items() if not _control(name) for trial in of_row]
    rows = []
    for name, of_row in trials.items():
        margins = [t["margin_m"] for t in of_row if t["margin_m"] is not None]
        lost = [t["record_lost_s"] for t in of_row if t["record_lost_s"] is not None]
        ends = Counter(t["state"] + (f": {t['reason']}" if t["reason"] else "") for t in of_row)
        good = sum(bool(t["ok"]) for t in of_row)
        verdict = "passed" if good == len(of_row) else f"FAILED {len(of_row) - good}"
        if _control(name):
            verdict = "PASSED, which a control must not" if good else "fails, as it must"
        row = [
            KILLS[name][0] if name in KILLS else SCENARIOS[name].title,
            str(len(of_row)),
            _longest(of_row, "thrust_gone_s"),
            _longest(of_row, "frames_off_s"),
            f"{min(margins):.2f}" if margins else "–",
            "; ".join(f"{n} × {end}" if len(ends) > 1 else end for end, n in ends.most_common()),
            f"{max(lost):.2f}" if len(lost) == len(of_row) else "unreadable",
            verdict,
        ]
        rows.append(row)
    headline = (
        f"Faults in the virtual pool, severity {result['severity']}, pools: {len(result['seeds'])}; "
        f"{result['vehicle']['name']} {result['vehicle']['sha256'][:12]}; "
        f"passed: {sum(bool(t['ok']) for t in counted)} of {len(counted)}"
    )
    complaints = [_complaint(trial) for trial in counted if not trial["ok"]]
    return [Table(title="Faults", headline=headline, heads=HEADS, rows=rows, note=NOTE, sentences=complaints)]


def _longest(trials: Sequence[Mapping[str, Any]], key: str) -> str:
    """Return the longest time, and the number of trials that continued to drive."""
    times = [t[key] for t in trials if t[key] is not None]
    going = len(trials) - len(times)
    if not times:
        return "drives on" if going == 1 else f"{going} drive on"
    return f"{max(times):.2f}" + (f", {going} drive on" if going else "")


def _complaint(trial: Mapping[str, Any]) -> str:
    """Return a sentence about a failed trial."""
    job, ended_after, margin = trial["job"], trial["thrust_gone_s"], trial["margin_m"]
    went = "thrust never ended" if ended_after is None else f"thrust ended after {ended_after:.2f} s"
    margin_text = "" if margin is None else f", inside by {margin:.2f} m"
    lost = trial["record_lost_s"]
    record = trial["record_problem"] or ("" if lost is None else f"record lacks {lost:.2f} s")
    raised = f"; raised {trial['raised']}" if trial["raised"] else ""
    return f"{job['row']} {job['target']}, pool {job['plant']}: {went}{margin_text}; {record}{raised}"


def _control(name: str) -> bool:
    return name in SCENARIOS and SCENARIOS[name].must_fail


def faults_experiment(
    *,
    out: Path,
    seeds: Annotated[int, (1, 1000)] = 1,
    seed: int = 1,
    scenarios: Annotated[Sequence[str] | None, ","] = None,
    severity: str = "realistic",
    vehicle: str | None = None,
    firmware: Literal["mcu", "ardusub"] = "mcu",
    processes: Annotated[int | None, (1, None)] = None,
    address: str | None = None,
    progress: Progress = lambda part, text: None,
) -> dict[str, Any]:
    """Inject faults while a vehicle drives: time until the thrust is zero [s], distance to the workspace [m].

    Exit status 3: a trial failed.

    Example: python -m studies.faults --scenarios link-cut,blind-3 --out faults

    Args:
        out (DIR): Directory for JSON, Markdown, figures, policies and trials; an interrupted one is continued.
        seeds: Number of virtual pools, each with different vehicle, water and noise.
        seed: Seed of every random number; equal seeds give equal results.
        scenarios (NAMES): Faults, separated by commas; default all.
        severity (WORD): Deviation of the pools from the vehicle file: nominal, realistic or hard.
        vehicle (NAME|FILE): Vehicle in the catalogue, or path of a vehicle file; default finsrov, with ardusub
            bluerov2_heavy.
        firmware (NAME): Firmware of the vehicle: mcu (the motor controller of finssim run) or ardusub (an
            autopilot, in the tank, with a DVL instead of the camera).
        processes: Parallel trials; default one per processor.
        address (ADDRESS): Ray cluster to use instead, HOST:PORT or auto; kills run on this machine.
        progress: Receives the completed fraction and the next trial.

    Returns:
        Content of `faults.json`; `ok`: every trial passed, and every control failed.

    Raises:
        ReliabilityError: Unknown scenario.
    """
    vehicle = vehicle or {"mcu": "finsrov", "ardusub": "bluerov2_heavy"}[firmware]
    every = [name for name, scenario in SCENARIOS.items() if scenario.firmware.startswith(firmware)]
    every = [*KILLS, *every] if firmware == "mcu" else every
    names = list(scenarios or every)
    check_choices(names, every, "scenario", ReliabilityError)
    variants = {name: [""] if name in KILLS else list(SCENARIOS[name].faults) for name in names}
    jobs = [
        fault_job(name, variant, motion, plant=s, seed=s, severity=severity, vehicle=vehicle)
        for name in names
        for variant in variants[name]
        for motion in (MOTIONS if name in KILLS else SCENARIOS[name].motions)
        for s in range(seed, seed + seeds)
    ]
    kills = [job for job in jobs if job.row in KILLS]
    jobs = [job for job in jobs if job.row not in KILLS]
    weight = KILL_WEIGHT * len(kills)
    share, folder, body = weight / (weight + len(jobs)), Path(out), load_vehicle(vehicle)
    # Kills run one by one, without other trials on the machine.
    results = run_jobs(
        kills, folder / "trials", play_kill, processes=1,
        progress=lambda part, text: progress(share * part, f"kills in real time: {text}"),
    )  # fmt: skip
    results += run_jobs(
        jobs, folder / "trials", play, processes=processes, address=address,
        progress=lambda part, text: progress(share + (1.0 - share) * part, text),
    )  # fmt: skip
    rows = {name: [r for r in results if r["job"]["row"] == name] for name in names}
    result = {
        "experiment": "faults",
        "severity": severity,
        "seeds": list(range(seed, seed + seeds)),
        "vehicle": {"name": body.name, "sha256": body.sha256},
        "ok": all(row_ok(name, rows[name]) for name in names),
        "trials": results,
        "provenance": provenance(),
    }
    write_json(folder / "faults.json", result, tables_of(result))
    return result


def row_ok(name: str, trials: Sequence[Mapping[str, Any]]) -> bool:
    """Return whether all trials of a scenario have the required result: a control has to fail."""
    return bool(trials) and all(bool(trial["ok"]) is not _control(name) for trial in trials)


if __name__ == "__main__":
    run_script("studies.faults:faults_experiment")
