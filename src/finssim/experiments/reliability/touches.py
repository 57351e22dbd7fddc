"""What faults do: each function gives what begins one."""

from __future__ import annotations

import os
import resource
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from finssim.experiments.reliability.scenario import Bench, Touch
from finssim.robot.messages import Picture, Telemetry

__all__ = [
    "blind",
    "full_disk",
    "jump_mcu_clock",
    "jump_robot_clock",
    "pool_fault",
    "reboot",
    "see_again",
    "stuck_pictures",
    "stuck_sensors",
    "two_publishers",
]

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


def reboot(bench: Bench) -> None:
    """The motor controller restarts."""
    bench.pool.reboot()


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
