"""Formation keeping: three vehicles hold a triangular net between them, catch something that drifts, and carry it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.tasks.arrays import NetTable, TaskArrays
from finssim.tasks.communication import Communication, message_table
from finssim.tasks.formation_kernels import (
    DEPTH_SCALE,
    NEAR,
    REACH,
    FormationParameters,
    evaluate_formation,
    observe_formation,
    spawn_formation,
)
from finssim.tasks.given import EnvironmentSetupError
from finssim.tasks.pursuit import OpenWater
from finssim.tasks.pursuit_drive import slowest
from finssim.tasks.pursuit_observation import MATE, PI, VELOCITY_CLIP
from finssim.tasks.task import ObservationPart
from finssim.vehicles import Vehicle

OBSERVATION = (
    ObservationPart("linear velocity, body frame", 3, "m/s", clip=VELOCITY_CLIP),
    ObservationPart("angular velocity, body frame", 3, "rad/s", clip=VELOCITY_CLIP),
    ObservationPart("target from here, body frame", 3, "m", scale=NEAR, clip=REACH),
    ObservationPart("target's velocity less one's own, body frame", 3, "m/s", clip=REACH),
    ObservationPart("depth", 1, "m", scale=DEPTH_SCALE, clip=REACH),
    ObservationPart("bearing of the way out from the net's middle", 1, "rad", scale=PI, clip=1.0),
    *MATE[1:],
    *MATE[1:],
    ObservationPart("goal from here, body frame", 3, "m", scale=NEAR, clip=REACH),
    ObservationPart("lengths of the edges less the side, in sides, the shortest first", 3, "1", clip=REACH),
    ObservationPart("distance from the target to the net", 1, "m", scale=NEAR, clip=REACH),
    ObservationPart("what the longest edge may still stretch, in sides", 1, "1", clip=REACH),
)
"""34 numbers of each agent. Team-mates follow in the order of the triangle: each sees its next one first."""


ROOM = 2.1
"""The net's side is at least this many lengths of a vehicle: with that of FinsROV, 1.2 m."""


@dataclass(frozen=True, kw_only=True)
class FormationReward:
    """Weights of the reward; each term has one reason.

    team: net · (way of the net to the target) + goal · (way of the target to the goal)     adds up to the whole way [m]
                                                          small weights are lost beside what success is worth
        - shape · (mean error of an edge, in sides)       a triangle with equal sides
        - step                                            sooner is better
        + success, once                                   more than all the rest
        - loss, once                                      for a net that tears, or a vehicle out of bounds
    each: - bump, nearer than `collision` to another      - action · mean(a²) - change · mean(Δa²)

    Published are bonuses for holding and for the shape in every step; with them it pays to hold for ever.
    """

    net: float = 4.0
    goal: float = 4.0
    shape: float = 0.05
    step: float = 0.005
    bump: float = 0.02
    action: float = 0.001
    change: float = 0.0015
    success: float = 20.0
    loss: float = 20.0


@dataclass(frozen=True, kw_only=True)
class Formation(OpenWater):
    """Carry a virtual net. It is a triangle between the three vehicles, without weight or drag, and it can tear.

    The target is held while the net's surface is within `reach` of it, no edge is longer than `stretch` sides and none
    shorter than `slack`; then it moves along and slides to the net's middle. Success: held within `goal_radius` of the
    goal for `hold` seconds. An edge that stays too long for more than `grace` seconds tears.
    """

    agents: ClassVar[tuple[str, ...]] = ("corner_1", "corner_2", "corner_3")
    totals: ClassVar[tuple[str, ...]] = (
        *("success", "torn", "left", "held_time", "shape_error", "to_net", "to_goal", "stretched"),
    )

    title: ClassVar[str] = "catch what drifts in a net and carry it, three together"
    name: str = "formation"
    observation: tuple[ObservationPart, ...] = field(default=OBSERVATION, repr=False)
    time_limit: float = 60.0
    spawn_radius: float = 1.0
    bounds: float = 8.0
    side: float = 1.2
    """Of the triangle, between vehicles [m] (published: 0.6 m); longer vehicles make it longer: see `ROOM`."""
    stretch: float = 1.215
    """[sides]: the published net of 0.6 m has 0.7288 m when it is pulled taut."""
    slack: float = 0.5
    """[sides]"""
    reach: float = 0.10
    """[m]"""
    goal_radius: float = 0.30
    """[m]"""
    hold: float = 1.0
    """[s]"""
    grace: float = 1.0
    """[s]"""
    drift: float = 0.05
    """Speed of a target that nobody holds, as a part of the speed that the slowest vehicle can hold."""
    collision: float = 0.6
    """Vehicles nearer to each other than this bump [m]; nothing stops them."""
    jitter: float = 0.05
    """Largest shift of a vehicle from its corner at the start, per axis [m]."""
    nearest: float = 1.0
    """The target starts this far from the net's middle, and the goal from the target ..."""
    farthest: float = 2.0
    """... to this far [m]."""
    communication: Communication | None = None
    """How vehicles know of each other; None: everybody sees everybody."""
    reward: FormationReward = field(default_factory=FormationReward)
    speed: float = 0.0
    """Of the drift [m/s]: follows from the vehicles."""

    evaluate = staticmethod(evaluate_formation)
    spawn = staticmethod(spawn_formation)
    observe = staticmethod(observe_formation)

    def __post_init__(self) -> None:
        if not 0.0 < self.slack < 1.0 < self.stretch or self.side <= 0.0:
            raise EnvironmentSetupError(
                f"net: side is {self.side} m, slack {self.slack}, stretch {self.stretch}; expected a side above 0 and "
                "0 < slack < 1 < stretch"
            )

    def fitted(self, vehicles: Sequence[Vehicle]) -> "Formation":
        """The net's side and the drift's speed from the vehicles."""
        longest = max(float(max(vehicle.body.size[:2])) for vehicle in vehicles)
        return replace(self, side=max(self.side, ROOM * longest), speed=self.drift * slowest(vehicles))

    def allocate(self, arrays: TaskArrays, worlds: int, device: wp.Device) -> None:
        """Room for the target and for messages, if there are any."""
        net = NetTable()
        net.side, net.stretch = self.side, self.stretch
        for name in ("target", "drift", "motion"):
            setattr(net, name, wp.zeros(worlds, dtype=wp.vec3, device=device))
        arrays.net = net
        arrays.messages = message_table(
            self.communication, worlds, len(self.agents), self.control_step, 2.0 * self.bounds, device
        )

    def success_rule(self) -> str:
        """See `Task`."""
        return f"the target held within {self.goal_radius:g} m of the goal for {self.hold:g} s"

    def metrics(self, arrays: TaskArrays) -> dict[str, NDArray[np.float64]]:
        """As every task's, and the time until it was delivered [s], nan where it was not."""
        measured = super().metrics(arrays)
        took = np.where(measured["success"] > 0.0, self.control_step * measured["length"], np.nan)
        return {**measured, "success_time": took}

    def parameters(self) -> Any:
        """The struct that the kernels take."""
        p = FormationParameters()
        p.arena, p.drift = self.arena_struct(self.nearest, self.farthest), self.speed
        for name in (
            "side",
            "stretch",
            "slack",
            "reach",
            "goal_radius",
            "hold",
            "grace",
            "collision",
            "jitter",
        ):
            setattr(p, name, getattr(self, name))
        for one in fields(self.reward):
            setattr(p, one.name, getattr(self.reward, one.name))
        return p
