"""3-v-1 pursuit: a herder drives a prey into the net that two netters hold between them."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar

import warp as wp

from finssim.engine.state import State
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.communication import exchange_messages, key_messages, open_messages
from finssim.tasks.given import EnvironmentSetupError
from finssim.tasks.pursuit import (
    CHASE,
    Chase,
    Prey,
    Team,
    any_outside,
    bumps,
    command_prey,
    gap_to,
    mate,
    motion_of,
    nearest_pursuer,
    prey_gap,
    prey_start,
)
from finssim.tasks.terms import (
    End,
    ObservationPart,
    RewardTerm,
    Terms,
    Total,
    level_direction,
    place_at_rest,
)
from finssim.vehicles import Vehicle

AGENTS = 3
PREY = 3

CAPTURE_MODES = ("net", "touch", "proximity", "either")
"""Published modes 0 to 3.

net: the prey is within `net_reach` of the net for `hold` seconds. touch: its hull touches the net. proximity: a vehicle
is within `proximity` of it. either: net or proximity.
"""


@dataclass(frozen=True)
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

    @property
    def mode(self) -> int:
        """Number of the capture mode."""
        return CAPTURE_MODES.index(self.capture)


LEVELS = (
    Level("proximity", 1.5, net_reach=1.0, hold=0.10, prey_speed=0.5, stake=25.0, from_step=0),
    Level("net", 1.0, net_reach=1.0, hold=0.10, prey_speed=0.6, stake=25.0, from_step=1_500_000),
    Level("net", 1.0, net_reach=0.8, hold=0.25, prey_speed=0.8, stake=30.0, from_step=4_000_000),
    Level("touch", 1.0, net_reach=0.8, hold=0.25, prey_speed=0.8, stake=30.0, from_step=7_000_000),
)
"""The published curriculum in three levels, all of which the formation baseline masters, and the task: one more."""


@wp.func
def other(a: int, k: int) -> int:
    """Number of the k-th team-mate of agent a, the lowest number first."""
    return wp.where(k == 1, wp.where(a == 0, 1, 0), wp.where(a == 2, 1, 2))


@wp.func
def mate_role(a: int, k: int) -> wp.vec2:
    """(1, 0): the k-th team-mate is the herder; (0, 1): it is a netter."""
    herds = other(a, k) == 0
    return wp.vec2(wp.where(herds, 1.0, 0.0), wp.where(herds, 0.0, 1.0))


@wp.func
def mate_gap(arrays: TaskArrays, w: int, a: int, k: int) -> wp.vec3:
    """From the agent to its k-th team-mate, body frame [m]."""
    return gap_to(arrays, w, a, other(a, k))


@wp.func
def mate_motion(arrays: TaskArrays, w: int, a: int, k: int) -> wp.vec3:
    """Velocity of the k-th team-mate less one's own, body frame [m/s]."""
    return motion_of(arrays, w, a, other(a, k))


OBSERVATION = (
    *CHASE,
    *(
        part
        for k in (1, 2)
        for part in (
            ObservationPart("team-mate's role: herder, netter", 2, "1", term=mate_role, index=k),
            *mate(k, mate_gap, mate_motion),
        )
    ),
)
"""30 numbers of each agent."""


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


@wp.func
def net_distance(x: wp.vec3, left: wp.vec3, right: wp.vec3, height: float) -> float:
    """Distance from a point to the net's surface [m].

    The net reaches from one netter to the other; half its height lies above that line and half below, along the
    direction across the line that is nearest to upright; with the netters one above the other it shrinks to the line.

    Args:
        x: The point, world frame [m].
        left: One netter.
        right: The other.
        height: Of the net [m].
    """
    span = right - left
    length = wp.max(wp.length(span), 1.0e-6)
    along = span / length
    up = wp.vec3(0.0, 0.0, 1.0) - along[2] * along
    rise = wp.length(up)
    up = up / wp.max(rise, 1.0e-3)
    gap = x - left
    s = wp.clamp(wp.dot(gap, along), 0.0, length)
    t = wp.clamp(wp.dot(gap, up), -0.5 * height, 0.5 * height)
    return wp.length(gap - s * along - t * up)


@wp.func
def net_gap(state: State, p: Any, w: int) -> float:
    """Distance from the prey to the net [m]; a net stretched beyond its length does not catch: the excess is added."""
    left = state.position[w, 1]
    right = state.position[w, 2]
    excess = wp.max(wp.length(right - left) - p.net_length, 0.0)
    return net_distance(state.position[w, PREY], left, right, p.net_height) + 2.0 * excess


@wp.func
def missing(p: Any, net: float, near: float) -> float:
    """How much nearer the prey must come to be captured, by the mode's rule [m]; 0: it is near enough."""
    by_net = net - p.rules.net_reach
    by_vehicle = near - p.rules.proximity
    gap = by_net
    if p.rules.mode == 1:
        gap = net - p.prey_radius - p.touch
    if p.rules.mode == 2:
        gap = by_vehicle
    if p.rules.mode == 3:
        gap = wp.min(by_net, by_vehicle)
    return wp.max(gap, 0.0)


@wp.func
def driving(state: State, w: int, a: int) -> float:
    """Herder: cosine of the angle between the way to the prey and the way on to the net's middle."""
    prey = state.position[w, PREY]
    middle = 0.5 * (state.position[w, 1] + state.position[w, 2])
    ahead = wp.normalize(prey - state.position[w, a])
    return wp.where(a == 0, wp.dot(ahead, wp.normalize(middle - prey)), 0.0)


@wp.func
def straying(state: State, w: int, a: int) -> float:
    """Herder: min(d / 8 m, 1), d its distance to the prey."""
    away = wp.length(state.position[w, PREY] - state.position[w, a])
    return wp.where(a == 0, wp.min(away / 8.0, 1.0), 0.0)


@wp.func
def misfit(state: State, p: Any, w: int, a: int) -> float:
    """Netters: |span - 0.7 net_length|, up to the net's length [m]."""
    span = wp.length(state.position[w, 2] - state.position[w, 1])
    return wp.where(a == 0, 0.0, wp.min(wp.abs(span - 0.7 * p.net_length), p.net_length))


@wp.func
def is_captured(p: Any, net: float, near: float, held: float) -> bool:
    """By the mode's rule; the net of modes net and either must have it for `hold`, without a break."""
    netted = held > 0.0 and held >= p.rules.hold - 0.1 * p.control_step
    caught = netted and (p.rules.mode == 0 or p.rules.mode == 3)
    if p.rules.mode == 1:
        caught = net - p.prey_radius <= p.touch
    if p.rules.mode >= 2 and near <= p.rules.proximity:
        caught = True
    return caught


@wp.func
def start(state: State, arrays: TaskArrays, p: Any, key: int, w: int):
    """The team around the origin, the prey some way off."""
    pi = 3.14159265
    rng = wp.rand_init(key, 4 * w)
    turn = wp.randf(rng, -pi, pi)
    height = wp.randf(rng, p.low, p.high)
    for a in range(AGENTS):
        angle = turn + (float(a) + wp.randf(rng, -0.2, 0.2)) * 2.0 * pi / 3.0
        away = wp.randf(rng, 0.5, 1.0) * p.spawn_radius
        x = away * level_direction(angle) + wp.vec3(0.0, 0.0, height + wp.randf(rng, -0.3, 0.3))
        place_at_rest(state, w, a, x, wp.randf(rng, -pi, pi))
    heading = wp.randf(rng, -pi, pi)
    prey = prey_start(p, wp.rand_init(wp.randi(rng)), wp.vec3(0.0, 0.0, height))
    place_at_rest(state, w, PREY, prey, heading)
    key_messages(arrays, key, w)


@dataclass(frozen=True, kw_only=True)
class TeamPursuit(Team, Chase):
    """3-v-1 pursuit. What counts as a capture, the prey's speed and the stake are the level's, unless given here."""

    agents: ClassVar[tuple[str, ...]] = ("herder", "left_netter", "right_netter")
    title: ClassVar[str] = "drive a prey into a net, three against one"
    name: str = "team-pursuit"
    observation: tuple[ObservationPart, ...] = field(default=OBSERVATION, repr=False)
    spawn_radius: float = 1.5
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
    prey: Prey = field(default_factory=lambda: Prey(mode="hybrid"))
    nearest: float = 3.5
    reward: TeamReward = field(default_factory=TeamReward)
    prey_radius: float = 0.0
    """Of its hull, level [m]: follows from its vehicle."""

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
        size = vehicles[-1].body.size
        return self.chased(self.rules.prey_speed, vehicles, prey_radius=float(0.25 * (size[0] + size[1])))

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

    def terms(self) -> Terms:
        """See `TeamReward`."""
        r, stake = self.reward, self.rules.stake
        return Terms(
            start=start,
            begin=open_messages,
            advance=exchange_messages,
            command=command_prey,
            seen={"gap": prey_gap},
            shared={"net": net_gap, "near": nearest_pursuer, "gap_now": missing},
            meanings={
                "progress": "By how much the step shortened the distance left to a capture [m].",
                "distance": "Distance left to a capture over 8 m, at most 1.",
                "step": "1 in every step: sooner is better.",
                "closest": "Least distance of an agent to the prey so far [m].",
                "closest_to_net": "Least distance of the prey to the net so far [m].",
            },
            rewards=(
                RewardTerm("progress", "gap - gap_now", r.progress),
                RewardTerm("distance", "wp.min(gap_now / 8.0, 1.0)", -r.distance),
                RewardTerm("step", "1.0", -r.step),
                RewardTerm("drive", driving, r.drive),
                RewardTerm("stray", straying, -r.stray),
                RewardTerm("spread", misfit, -r.spread),
                RewardTerm("bump", bumps, -r.bump),
                RewardTerm("action", "action_effort", -r.action),
                RewardTerm("change", "action_change", -r.change),
            ),
            ends=(End("captured", is_captured, stake), End("left", any_outside, -stake)),
            inside="net <= p.rules.net_reach",
            totals=(
                Total("closest", "wp.min(was, near)", first="near"),
                Total("closest_to_net", "wp.min(was, net)", first="net"),
                Total("gap", "gap_now", first="gap_now"),
            ),
        )
