"""A fault as data: what is done to a robot and its pool, when, and for how long."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from finssim.experiments.reliability.wire import FaultyWire
from finssim.pool.virtual_pool import VirtualPool
from finssim.robot.recorder import Recorder
from finssim.robot.runtime import Runtime

__all__ = ["Bench", "Fault", "Scenario", "Touch"]


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
