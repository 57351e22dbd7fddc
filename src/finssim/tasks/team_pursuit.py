"""3-v-1 pursuit: a herder drives a prey into the net that two netters hold between them."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.tasks.arrays import TaskArrays
from finssim.tasks.communication import Communication, message_table
from finssim.tasks.given import EnvironmentSetupError
from finssim.tasks.pursuit import OpenWater, capture_metrics
from finssim.tasks.pursuit_drive import DriveNumbers
from finssim.tasks.pursuit_observation import CHASE, MATE
from finssim.tasks.pursuit_prey import Prey, prey_speed
from finssim.tasks.task import ObservationPart
from finssim.tasks.team_pursuit_kernels import (
    TeamParameters,
    evaluate_team,
    observe_team,
    script_team,
    spawn_team,
)
from finssim.vehicles import Vehicle

CAPTURE_MODES = ("net", "touch", "proximity", "either")
"""Published modes 0 to 3.

net: the prey is within `net_reach` of the net for `hold` seconds. touch: its hull touches the net. proximity: a vehicle
is within `proximity` of it. either: net or proximity.
"""


@dataclass(frozen=True, kw_only=True)
class Level:
    """One step of the published curriculum. Speeds were 0.25, 0.30 and 0.40 m/s, where a pursuer reaches 0.5 m/s."""

    capture: str
    """One of `CAPTURE_MODES`."""
    proximity: float
    """[m]"""
    net_reach: float
    """[m]"""
    hold: float
    """[s]"""
    prey_speed: float
    """Part of the speed that the slowest agent can hold."""
    stake: float
    """Reward for a capture, and what an agent out of bounds costs everybody."""
    from_step: int
    """Agent-steps of training after which it was taken up."""


LEVELS = (
    Level(
        capture="proximity", proximity=1.5, net_reach=1.0, hold=0.10, prey_speed=0.5, stake=25.0, from_step=0
    ),
    Level(
        capture="net",
        proximity=1.0,
        net_reach=1.0,
        hold=0.10,
        prey_speed=0.6,
        stake=25.0,
        from_step=1_500_000,
    ),
    Level(
        capture="net",
        proximity=1.0,
        net_reach=0.8,
        hold=0.25,
        prey_speed=0.8,
        stake=30.0,
        from_step=4_000_000,
    ),
    Level(
        capture="touch",
        proximity=1.0,
        net_reach=0.8,
        hold=0.25,
        prey_speed=0.8,
        stake=30.0,
        from_step=7_000_000,
    ),
)
"""The published curriculum in three levels, all of which the formation baseline masters, and the task: one more."""


@dataclass(frozen=True, kw_only=True)
class TeamReward:
    """Weights of the reward besides the level's stake; each term has one reason.

    team: progress · (way gained towards a capture)       by the rule of the level; over an episode it adds up to the
                                                          whole way [m]; a small weight is lost beside the stake
        - distance · min(gap / 8 m, 1) - step             a slope everywhere, and sooner is better
    herder: + drive · cos(angle between the way to the prey and the way on to the net)     it stands behind the prey
            - stray · min(d / 8 m, 1)                     near the prey: one far away drives nothing, and gets lost
    netters: - spread · | span - 0.7 net_length |         an open net, which is not torn
    each: - bump, nearer than `collision` to another      - action · mean(a²) - change · mean(Δa²)
    """

    progress: float = 4.0
    distance: float = 0.05
    step: float = 0.005
    drive: float = 0.01
    stray: float = 0.05
    spread: float = 0.005
    bump: float = 0.05
    action: float = 0.001
    change: float = 0.0015


@dataclass(frozen=True, kw_only=True)
class TeamPursuit(OpenWater):
    """3-v-1 pursuit. What counts as a capture, the prey's speed and the stake are the level's, unless given here."""

    agents: ClassVar[tuple[str, ...]] = ("herder", "left_netter", "right_netter")
    others: ClassVar[tuple[str, ...]] = ("prey",)
    totals: ClassVar[tuple[str, ...]] = (
        *("captured", "left", "closest", "closest_to_net", "gap", "to_net", "to_agent"),
    )

    levels: ClassVar[int] = len(LEVELS)
    moving: ClassVar[bool] = True
    title: ClassVar[str] = "drive a prey into a net, three against one"
    name: str = "team-pursuit"
    observation: tuple[ObservationPart, ...] = field(default=(*CHASE, *MATE, *MATE), repr=False)
    spawn_radius: float = 1.5
    time_limit: float = 60.0
    level: int = 3
    """Which of `LEVELS`."""
    capture: str | None = None
    """One of `CAPTURE_MODES`; the level's if None. So are the next five."""
    proximity: float | None = None
    net_reach: float | None = None
    hold: float | None = None
    prey_speed: float | None = None
    stake: float | None = None
    touch: float = 0.02
    """Mode touch: the net touches a hull that is within this [m]."""
    net_length: float = 4.0
    """A net stretched farther than this does not catch [m]."""
    net_height: float = 1.0
    """[m]"""
    collision: float = 0.6
    """Agents nearer to each other than this bump [m]; nothing stops them."""
    prey: Prey = field(default_factory=lambda: Prey(mode="hybrid"))
    """What the prey does; it sees all three."""
    nearest: float = 3.5
    """The prey starts this far from the middle of the team ..."""
    farthest: float = 5.0
    """... to this far."""
    communication: Communication | None = None
    """How agents know of each other; None: everybody sees everybody."""
    reward: TeamReward = field(default_factory=TeamReward)
    speed: float = 0.0
    """Speed of the prey [m/s]: follows from the vehicles."""
    prey_radius: float = 0.0
    """Of its hull, level [m]: follows from its vehicle."""
    prey_drive: DriveNumbers | None = field(default=None, repr=False)
    """What its thrusters do: follows from its vehicle."""

    evaluate = staticmethod(evaluate_team)
    spawn = staticmethod(spawn_team)
    observe = staticmethod(observe_team)
    script = staticmethod(script_team)

    def __post_init__(self) -> None:
        if not 0 <= self.level < len(LEVELS):
            raise EnvironmentSetupError(f"level is {self.level}, expected 0 to {len(LEVELS) - 1}")
        if self.rules.capture not in CAPTURE_MODES:
            raise EnvironmentSetupError(
                f"unknown capture mode '{self.rules.capture}'; available: {', '.join(CAPTURE_MODES)}"
            )

    @property
    def rules(self) -> Level:
        """The level's rules, with what this task says otherwise."""
        given = {one.name: getattr(self, one.name, None) for one in fields(Level)}
        return replace(
            LEVELS[self.level], **{name: value for name, value in given.items() if value is not None}
        )

    def fitted(self, vehicles: Sequence[Vehicle]) -> "TeamPursuit":
        """The prey's speed, size and thrust from the vehicles: herder, netters, prey."""
        prey = vehicles[-1]
        speed = prey_speed(self.rules.prey_speed, vehicles[:-1], prey)
        radius = 0.25 * (prey.body.size[0] + prey.body.size[1])
        return replace(self, speed=speed, prey_radius=float(radius), prey_drive=DriveNumbers.of(prey))

    def allocate(self, arrays: TaskArrays, worlds: int, device: wp.Device) -> None:
        """Room for the messages, if there are any."""
        arrays.messages = message_table(
            self.communication, worlds, len(self.agents), self.control_step, 2.0 * self.bounds, device
        )

    def success_rule(self) -> str:
        """See `Task`."""
        rules = self.rules
        net = f"the prey within {rules.net_reach:g} m of the net for {rules.hold:g} s"
        near = f"a vehicle within {rules.proximity:g} m of the prey"
        return {
            "net": net,
            "touch": f"the net touches the prey, to {self.touch:g} m",
            "proximity": near,
            "either": f"{net}, or {near}",
        }[rules.capture]

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
        p, rules = TeamParameters(), self.rules
        p.prey = self.prey.struct(self.prey_drive, self.speed, self.control_step)
        p.arena = self.arena_struct(self.nearest, self.farthest)
        p.mode = CAPTURE_MODES.index(rules.capture)
        p.proximity, p.reach, p.hold, p.stake = rules.proximity, rules.net_reach, rules.hold, rules.stake
        for name in ("touch", "net_length", "net_height", "collision", "prey_radius"):
            setattr(p, name, getattr(self, name))
        for one in fields(self.reward):
            setattr(p, one.name, getattr(self.reward, one.name))
        return p
