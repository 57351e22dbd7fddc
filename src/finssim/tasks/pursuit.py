"""1-v-1 pursuit: come up to a prey that flees with a vehicle like one's own, and stay with it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from finssim.tasks.arrays import TaskArrays
from finssim.tasks.given import EnvironmentSetupError
from finssim.tasks.pursuit_drive import DriveNumbers
from finssim.tasks.pursuit_kernels import (
    Arena,
    PursuitParameters,
    evaluate_pursuit,
    observe_pursuit,
    script_pursuit,
    spawn_pursuit,
)
from finssim.tasks.pursuit_observation import CHASE
from finssim.tasks.pursuit_prey import Prey, prey_speed
from finssim.tasks.task import ObservationPart, Task
from finssim.vehicles import Vehicle


@dataclass(frozen=True, kw_only=True)
class PursuitReward:
    """Weights of the reward; each term has one reason.

    r = progress · (closing speed) · dt          nearer is better; over an episode it adds up to the way gained [m]
      - distance · min(d / 8 m, 1)               a slope everywhere, also behind a prey that keeps its distance
      + heading · cos(angle to the prey)         the bow, where thrust and camera are best, points at the prey
      + near, within near_radius                 staying with it is worth something before it counts as captured
      - spin · r²                                no turning on the spot
      - action · mean(a²) - change · mean(Δa²)   the cheapest thrusts that do it; commands that a motor can follow
      - step                                     sooner is better
      + capture                                  once; more than all the rest of an episode (published: 50)
      - loss                                     once, on leaving the bounds (published: 1, cheaper than going on)

    Time running out costs nothing (published: 5): the time is not observed, so that nothing could be learnt from it.
    """

    progress: float = 0.9
    distance: float = 0.08
    heading: float = 0.01
    near: float = 0.03
    near_radius: float = 1.2
    spin: float = 0.002
    action: float = 0.001
    change: float = 0.0015
    step: float = 0.0005
    capture: float = 20.0
    loss: float = 20.0


@dataclass(frozen=True, kw_only=True)
class OpenWater(Task):
    """Base of the tasks in open water: where episodes start and end. Lengths in metres, world frame with z up."""

    action: ClassVar[str] = "wrench4"
    pool: ClassVar[None] = None

    spawn_radius: float = 2.5
    """Agents start this near to the origin."""
    low: float = -4.0
    """Everybody starts between this height ..."""
    high: float = -2.0
    """... and this one."""
    bounds: float = 12.0
    """Going farther from the origin than this ends the episode."""
    ceiling: float = 0.3
    """So does rising above this height."""
    depth: float = 8.0
    """And sinking below this depth."""

    def arena_struct(self, nearest: float = 0.0, farthest: float = 0.0) -> Arena:
        """The struct that kernels take, for a prey that starts `nearest` to `farthest` metres from the agents."""
        a = Arena()
        a.spawn, a.nearest, a.farthest = self.spawn_radius, nearest, farthest
        for name in ("low", "high", "bounds", "ceiling", "depth", "time_limit", "control_step"):
            setattr(a, name, getattr(self, name))
        return a


@dataclass(frozen=True, kw_only=True)
class Pursuit(OpenWater):
    """1-v-1 pursuit. Captured: within `radius` at a relative speed of at most `relative_speed`, for `hold` seconds."""

    agents: ClassVar[tuple[str, ...]] = ("pursuer",)
    others: ClassVar[tuple[str, ...]] = ("prey",)
    totals: ClassVar[tuple[str, ...]] = ("captured", "left", "closest")

    moving: ClassVar[bool] = True
    title: ClassVar[str] = "catch a prey, one against one"
    name: str = "pursuit"
    observation: tuple[ObservationPart, ...] = field(default=CHASE, repr=False)
    time_limit: float = 60.0
    prey: Prey = field(default_factory=Prey)
    """What the prey does."""
    prey_speed: float = 0.6
    """Its speed, as a part of what the pursuer can hold (published: 2 m/s, four times that speed)."""
    nearest: float = 2.0
    """The prey starts this far from the pursuer ..."""
    farthest: float = 5.0
    """... to this far."""
    radius: float = 0.8
    relative_speed: float = 0.35
    """[m/s]"""
    hold: float = 0.5
    """[s]"""
    reward: PursuitReward = field(default_factory=PursuitReward)
    speed: float = 0.0
    """Speed of the prey [m/s]: follows from the vehicles."""
    prey_drive: DriveNumbers | None = field(default=None, repr=False)
    """What the prey's thrusters do: follows from its vehicle."""

    evaluate = staticmethod(evaluate_pursuit)
    spawn = staticmethod(spawn_pursuit)
    observe = staticmethod(observe_pursuit)
    script = staticmethod(script_pursuit)

    def fitted(self, vehicles: Sequence[Vehicle]) -> "Pursuit":
        """The prey's speed and thrust from the vehicles: pursuer, prey."""
        speed = prey_speed(self.prey_speed, vehicles[:1], vehicles[1])
        return replace(self, speed=speed, prey_drive=DriveNumbers.of(vehicles[1]))

    def success_rule(self) -> str:
        """See `Task`."""
        return f"within {self.radius:g} m at no more than {self.relative_speed:g} m/s for {self.hold:g} s"

    def metrics(self, arrays: TaskArrays) -> dict[str, NDArray[np.float64]]:
        """As every task's; success: captured; capture_time [s], nan where it was not."""
        measured = super().metrics(arrays)
        return {**measured, **capture_metrics(measured, self.control_step)}

    def parameters(self) -> Any:
        """The struct that the kernels take."""
        if self.prey_drive is None:
            raise EnvironmentSetupError(
                f"task '{self.name}' is not fitted to vehicles: call fitted([...]) first"
            )
        p, r = PursuitParameters(), self.reward
        p.prey = self.prey.struct(self.prey_drive, self.speed, self.control_step)
        p.arena = self.arena_struct(self.nearest, self.farthest)
        p.radius, p.relative_speed, p.hold = self.radius, self.relative_speed, self.hold
        p.near, p.close = r.near_radius, r.near
        for one in fields(r):
            if one.name not in ("near", "near_radius"):
                setattr(p, one.name, getattr(r, one.name))
        return p


def capture_metrics(
    measured: dict[str, NDArray[np.float64]], control_step: float
) -> dict[str, NDArray[np.float64]]:
    """Success and capture time [s] from what was counted; the time is nan where nothing was captured."""
    captured = measured["captured"] > 0.0
    return {
        "success": np.where(captured, 1.0, 0.0),
        "capture_time": np.where(captured, control_step * measured["length"], np.nan),
    }
