"""Formation keeping: three vehicles hold a triangular net between them, catch a drifting target, and carry it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import warp as wp

from finssim.extensions.teams.pursuit import (
    PI,
    VELOCITY_CLIP,
    TeamTask,
    any_outside,
    bumps,
    gap_to,
    has_held,
    mate,
    motion_of,
    slowest,
)
from finssim.sim.state import State
from finssim.tasks.arrays import NetTable, TaskArrays, allocated
from finssim.tasks.communication import (
    exchange_messages,
    key_messages,
    mate_position,
    open_messages,
)
from finssim.tasks.terms import (
    End,
    ObservationPart,
    RewardTerm,
    Terms,
    Total,
    action_costs,
    each_step,
    goal_offset,
    level_direction,
    measured_depth,
    measured_velocity,
    own_velocity,
    place_at_rest,
    uniform3,
    world_velocity,
)
from finssim.tasks.validation import EnvironmentSetupError
from finssim.vehicles import Vehicle

AGENTS = 3
NEAR = 3.0
"""Distances to target, goal and net are divided by this in the observation [m]."""
REACH = 4.0
"""Limit of scaled distances [-]."""
SETTLE = 0.5
"""Rate at which a held target moves to the centre of the net [1/s]."""
DEPTH_SCALE = 5.0
"""The depth is divided by this [m]."""

ROOM = 2.1
"""Smallest side of the net in lengths of a vehicle: 1.2 m for FinsROV."""


@wp.func
def triangle_distance(x: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3) -> float:
    """Return the distance from a point to a triangle [m].

    The nearest point is determined by the region of the triangle in front of which the point lies: a corner,
    an edge or the interior (Ericson, Real-Time Collision Detection, section 5.1.5).
    """
    ab = b - a
    ac = c - a
    d1 = wp.dot(ab, x - a)
    d2 = wp.dot(ac, x - a)
    d3 = wp.dot(ab, x - b)
    d4 = wp.dot(ac, x - b)
    d5 = wp.dot(ab, x - c)
    d6 = wp.dot(ac, x - c)
    va = d3 * d6 - d5 * d4
    vb = d5 * d2 - d1 * d6
    vc = d1 * d4 - d3 * d2
    if d1 <= 0.0 and d2 <= 0.0:
        return wp.length(x - a)
    if d3 >= 0.0 and d4 <= d3:
        return wp.length(x - b)
    if d6 >= 0.0 and d5 <= d6:
        return wp.length(x - c)
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return wp.length(x - a - (d1 / (d1 - d3)) * ab)
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return wp.length(x - a - (d2 / (d2 - d6)) * ac)
    if va <= 0.0 and d4 >= d3 and d5 >= d6:
        return wp.length(x - b - ((d4 - d3) / ((d4 - d3) + (d5 - d6))) * (c - b))
    total = va + vb + vc
    return wp.length(x - a - (vb / total) * ab - (vc / total) * ac)


@wp.func
def sorted_edges(a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.vec3:
    """Return the lengths of a triangle's edges, the shortest first [m]."""
    ab = wp.length(b - a)
    bc = wp.length(c - b)
    ca = wp.length(a - c)
    least = wp.min(ab, wp.min(bc, ca))
    longest = wp.max(ab, wp.max(bc, ca))
    return wp.vec3(least, ab + bc + ca - least - longest, longest)


@wp.func
def spanned(x: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.vec4:
    """Return a net's distance from a point [m], and the lengths of its edges, the shortest first [m]."""
    edges = sorted_edges(a, b, c)
    return wp.vec4(triangle_distance(x, a, b, c), edges[0], edges[1], edges[2])


@wp.func
def corner_gap(arrays: TaskArrays, w: int, a: int, k: int) -> wp.vec3:
    """Return the position of the k-th next corner relative to the agent, body frame [m]."""
    return gap_to(arrays, w, a, (a + k) % AGENTS)


@wp.func
def corner_motion(arrays: TaskArrays, w: int, a: int, k: int) -> wp.vec3:
    """Return the velocity of the k-th next corner relative to the agent's, body frame [m/s]."""
    return motion_of(arrays, w, a, (a + k) % AGENTS)


@wp.func
def target_slip(arrays: TaskArrays, w: int, a: int) -> wp.vec3:
    """Return the target's velocity relative to the agent's, body frame [m/s]."""
    slip = arrays.net.motion[w] - measured_velocity(arrays, w, a)
    return wp.quat_rotate_inv(arrays.quaternion[w, a], slip)


@wp.func
def next_place(arrays: TaskArrays, w: int, a: int) -> wp.vec3:
    """Return the position of the next corner that is known to the agent, world frame [m]."""
    return mate_position(arrays, w, a, (a + 1) % AGENTS)


@wp.func
def last_place(arrays: TaskArrays, w: int, a: int) -> wp.vec3:
    """Return the position of the corner after the next that is known to the agent, world frame [m]."""
    return mate_position(arrays, w, a, (a + 2) % AGENTS)


@wp.func
def outward(arrays: TaskArrays, w: int, a: int, left: wp.vec3, right: wp.vec3) -> float:
    """Return the bearing of the direction from the net's centre outwards, seen from the agent [rad]."""
    away = wp.quat_rotate_inv(arrays.quaternion[w, a], 2.0 * arrays.position[w, a] - left - right)
    return wp.atan2(away[1], away[0])


@wp.func
def seen_net(arrays: TaskArrays, w: int, a: int, left: wp.vec3, right: wp.vec3) -> wp.vec4:
    """Return `spanned` of the target, with the other corners at the positions known to the agent [m]."""
    return spanned(arrays.net.target[w], arrays.position[w, a], left, right)


@wp.func
def edge_errors(p: Any, net: wp.vec4) -> wp.vec3:
    """Return the relative errors of a net's edge lengths, the shortest first, as shares of the side; net as
    of `spanned`."""
    side = wp.vec3(p.side, p.side, p.side)
    return (wp.vec3(net[1], net[2], net[3]) - side) / p.side


@wp.func
def target_gap(arrays: TaskArrays, w: int, a: int) -> wp.vec3:
    """Return the position of the target relative to the agent, body frame [m]."""
    return wp.quat_rotate_inv(arrays.quaternion[w, a], arrays.net.target[w] - arrays.position[w, a])


@wp.func
def from_net(net: wp.vec4) -> float:
    """Return the distance from the target to the net [m].

    The net is as of `spanned`.
    """
    return net[0]


@wp.func
def stretch_left(p: Any, net: wp.vec4) -> float:
    """Return by how much the longest edge may still be stretched, as a share of the side.

    The net is as of `spanned`.
    """
    return p.stretch - net[3] / p.side


OBSERVATION = (
    *own_velocity(clip=VELOCITY_CLIP),
    ObservationPart("target from here, body frame", 3, "m", NEAR, REACH, target_gap),
    ObservationPart("target's velocity less one's own, body frame", 3, "m/s", clip=REACH, term=target_slip),
    ObservationPart("depth", 1, "m", DEPTH_SCALE, REACH, measured_depth),
    ObservationPart("bearing of the way out from the net's middle", 1, "rad", PI, 1.0, outward),
    *mate(1, corner_gap, corner_motion),
    *mate(2, corner_gap, corner_motion),
    ObservationPart("goal from here, body frame", 3, "m", NEAR, REACH, goal_offset),
    ObservationPart(
        "lengths of the edges less the side, in sides, the shortest first",
        3,
        "1",
        clip=REACH,
        term=edge_errors,
    ),
    ObservationPart("distance from the target to the net", 1, "m", NEAR, REACH, from_net),
    ObservationPart(
        "what the longest edge may still stretch, in sides",
        1,
        "1",
        clip=REACH,
        term=stretch_left,
    ),
)
"""34 numbers of each agent. Team-mates follow in the order of the triangle, beginning with the agent's next corner."""


@dataclass(frozen=True, kw_only=True)
class FormationReward:
    """Weights of the reward.

    team: net · (decrease of the distance from net to target) + goal · (decrease of the distance from target to goal)
                                                          sums to the whole distance [m]; small weights would be
                                                          negligible beside the reward of success
        - shape · (mean error of an edge, in sides)       for a triangle with equal sides
        - step                                            for success as early as possible
        + success, once                                   more than the sum of all others
        - loss, once                                      for a net that tears, or a vehicle out of bounds
    each: - bump, nearer than `collision` to another      - action · mean(a²) - change · mean(Δa²)

    Published rewards have bonuses for holding and for the shape in every step; with these, holding without delivery
    is rewarded most.
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


@wp.func
def true_net(state: State, arrays: TaskArrays, w: int) -> wp.vec4:
    """Return the target's distance from the net and the lengths of the edges, as of `spanned`."""
    return spanned(arrays.net.target[w], state.position[w, 0], state.position[w, 1], state.position[w, 2])


@wp.func
def holds(p: Any, net: wp.vec4) -> bool:
    """Return whether the net holds the target: near enough, and no edge too long or too short.

    The net is as of `spanned`.
    """
    return net[0] <= p.reach and net[1] >= p.slack * p.side and net[3] <= p.stretch * p.side


@wp.func
def move_target(state: State, arrays: TaskArrays, p: Any, w: int):
    """Exchange messages; then move the target with the net and to its centre while it is held, otherwise with
    its drift."""
    exchange_messages(state, arrays, w)
    v = arrays.net.drift[w]
    if holds(p, true_net(state, arrays, w)):
        middle = (state.position[w, 0] + state.position[w, 1] + state.position[w, 2]) / 3.0
        v = (world_velocity(state, w, 0) + world_velocity(state, w, 1) + world_velocity(state, w, 2)) / 3.0
        v += SETTLE * (middle - arrays.net.target[w])
    arrays.net.motion[w] = v
    arrays.net.target[w] = arrays.net.target[w] + p.control_step * v


@wp.func
def misshape(p: Any, net: wp.vec4) -> float:
    """Return the mean relative error of the edges of a net, as a share of the side; net as of `spanned`."""
    error = float(0.0)
    for i in range(3):
        error += wp.abs(net[i + 1] - p.side) / (3.0 * p.side)
    return error


@wp.func
def shape_error(state: State, p: Any, w: int, net: wp.vec4, was: float) -> float:
    """Return the mean edge error over the episode, as a share of the side, of a net as of `spanned`; `was`:
    the mean before."""
    return was + (misshape(p, net) - was) / float(state.steps[w])


@wp.func
def net_gained(net: wp.vec4, to_net: float) -> float:
    """Return by how much the net approached the target in the step [m].

    The net is as of `spanned`.
    """
    return to_net - net[0]


@wp.func
def goal_gained(away: float, to_goal: float) -> float:
    """Return by how much the target approached the goal in the step [m]."""
    return to_goal - away


@wp.func
def from_goal(arrays: TaskArrays, w: int) -> float:
    """Return the distance from the target to the goal [m]."""
    return wp.length(arrays.goal_position[w] - arrays.net.target[w])


@wp.func
def held_time(p: Any, was: float, holding: bool) -> float:
    """Return for how long the net has held the target [s]."""
    return was + wp.where(holding, p.control_step, 0.0)


@wp.func
def stretched_time(p: Any, net: wp.vec4, stretched: float) -> float:
    """Return for how long an edge has been too long [s].

    The net is as of `spanned`.
    """
    return wp.where(net[3] > p.stretch * p.side, stretched + p.control_step, 0.0)


@wp.func
def tears(p: Any, net: wp.vec4, stretched: float) -> bool:
    """Return whether an edge of a net as of `spanned` has been too long for more than `grace` [s]."""
    return stretched_time(p, net, stretched) > p.grace + 0.1 * p.control_step


@wp.func
def at_goal(p: Any, holding: bool, away: float) -> bool:
    """Return whether the net holds the target within `goal_radius` of the goal [m]."""
    return holding and away <= p.goal_radius


@wp.func
def away_from(p: Any, rng: wp.uint32, x: wp.vec3) -> wp.vec3:
    """Return a random position at a horizontal distance from x, up to 0.5 m higher or lower. Both in [m]."""
    level = x + wp.randf(rng, p.nearest, p.farthest) * level_direction(wp.randf(rng, -PI, PI))
    return wp.vec3(level[0], level[1], wp.clamp(x[2] + wp.randf(rng, -0.5, 0.5), p.low, p.high))


@wp.func
def start(state: State, arrays: TaskArrays, p: Any, key: int, w: int):
    """Start an episode: the team in its triangle, the target at a random distance, the goal at one from the target."""
    rng = wp.rand_init(key, 4 * w)
    turn = wp.randf(rng, -PI, PI)
    away = p.spawn_radius * wp.sqrt(wp.randf(rng)) * level_direction(wp.randf(rng, -PI, PI))
    middle = wp.vec3(away[0], away[1], wp.randf(rng, p.low, p.high))
    bound = wp.vec3(p.jitter, p.jitter, p.jitter)
    for a in range(AGENTS):
        angle = turn + float(a) * 2.0 * PI / 3.0
        shift = uniform3(wp.rand_init(wp.randi(rng)), -bound, bound)
        x = middle + p.side / wp.sqrt(3.0) * level_direction(angle) + shift
        place_at_rest(state, w, a, x, angle + wp.randf(rng, -0.5, 0.5))
    target = away_from(p, wp.rand_init(wp.randi(rng)), middle)
    arrays.goal_position[w] = away_from(p, wp.rand_init(wp.randi(rng)), target)
    arrays.net.target[w] = target
    arrays.net.drift[w] = p.speed * level_direction(wp.randf(rng, -PI, PI))
    arrays.net.motion[w] = arrays.net.drift[w]
    key_messages(arrays, key, w)


@dataclass(frozen=True, kw_only=True)
class Formation(TeamTask):
    """Carry a virtual net, which is a triangle between three vehicles, without weight or drag, and can tear.

    The target is held while the net's surface is within `reach` of it, no edge is longer than `stretch` sides
    and none is shorter than `slack` sides; it then moves with the net and to the net's centre. Success: held
    within `goal_radius` of the goal for `hold` seconds. The net tears if an edge is too long for more than
    `grace` seconds.
    """

    agents: ClassVar[tuple[str, ...]] = ("corner_1", "corner_2", "corner_3")
    succeeds: ClassVar[str] = "delivered"
    title: ClassVar[str] = "catch what drifts in a net and carry it, three together"
    baselines: ClassVar = {"consensus": "finssim.extensions.teams.baselines:ConsensusFormation"}
    name: str = "formation"
    observation: tuple[ObservationPart, ...] = field(default=OBSERVATION, repr=False)
    spawn_radius: float = 1.0
    bounds: float = 8.0
    side: float = 1.2
    """Side of the triangle between vehicles [m] (published: 0.6 m); at least `ROOM` vehicle lengths."""
    stretch: float = 1.215
    """Largest length of an edge that holds the target [sides]; the published net of 0.6 m has 0.7288 m when taut."""
    slack: float = 0.5
    """Smallest length of an edge that holds the target [sides]."""
    reach: float = 0.10
    """Distance from the net within which it holds the target [m]."""
    goal_radius: float = 0.30
    """Distance from the goal within which a held target counts as delivered [m]."""
    hold: float = 1.0
    """Time for which the target must be held at the goal [s]."""
    grace: float = 1.0
    """Time for which an edge may be too long before the net tears [s]."""
    drift: float = 0.05
    """Speed of a target that is not held, as a share of the steady speed of the slowest vehicle."""
    jitter: float = 0.05
    """Largest displacement of a vehicle from its corner at the start, per axis [m]."""
    nearest: float = 1.0
    """Smallest distance at the start of the target from the net's centre, and of the goal from the target [m]."""
    farthest: float = 2.0
    """Largest of these distances [m]."""
    reward: FormationReward = field(default_factory=FormationReward)

    def __post_init__(self) -> None:
        if not 0.0 < self.slack < 1.0 < self.stretch or self.side <= 0.0:
            raise EnvironmentSetupError(
                f"net: side is {self.side} m, slack {self.slack}, stretch {self.stretch}; expected a side above 0 and "
                "0 < slack < 1 < stretch"
            )

    def fitted(self, vehicles: Sequence[Vehicle]) -> "Formation":
        """Return the task with the net's side and the drift speed adapted to the vehicles."""
        longest = max(float(max(vehicle.body.size[:2])) for vehicle in vehicles)
        return replace(self, side=max(self.side, ROOM * longest), speed=self.drift * slowest(vehicles))

    def allocate(self, arrays: TaskArrays, worlds: int, device: wp.Device) -> None:
        """Allocate the target and the messages, if there are any."""
        super().allocate(arrays, worlds, device)
        arrays.net = allocated(NetTable, worlds, device)

    def success_rule(self) -> str:
        """See `Task`."""
        return f"the target held within {self.goal_radius:g} m of the goal for {self.hold:g} s"

    def terms(self) -> Terms:
        """See `FormationReward`."""
        r = self.reward
        return Terms(
            start=start,
            begin=open_messages,
            advance=move_target,
            shared={
                "net": true_net,
                "away": from_goal,
                "holding": holds,
            },
            seen={"left": next_place, "right": last_place, "net": seen_net},
            meanings={
                "delivered": f"Success: {self.success_rule()}.",
                "torn": f"An edge longer than {self.stretch:g} sides for more than {self.grace:g} s.",
            },
            rewards=(
                RewardTerm("net", net_gained, r.net),
                RewardTerm("goal", goal_gained, r.goal),
                RewardTerm("shape", misshape, -r.shape),
                RewardTerm("step", each_step, -r.step),
                RewardTerm("bump", bumps, -r.bump),
                *action_costs(r.action, r.change),
            ),
            ends=(
                End("delivered", has_held, r.success),
                End("torn", tears, -r.loss),
                End("left", any_outside, -r.loss),
            ),
            inside=at_goal,
            totals=(
                Total("held_time", held_time),
                Total("shape_error", shape_error),
                Total("to_net", from_net, first=from_net),
                Total("to_goal", "away", first="away"),
                Total("stretched", stretched_time),
            ),
        )
