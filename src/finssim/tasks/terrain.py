"""A task over a seabed, for vehicles that must move to steer: a constant altitude along a line."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import warp as wp

from finssim.sim.state import State
from finssim.tasks.arrays import PathTable, TaskArrays, allocated
from finssim.tasks.path import (
    ERROR_SCALE,
    PathFollowing,
    beside_leg,
    change_legs,
    ground_velocity,
    has_finished,
    mean_square,
    on_path,
    path_advance,
    path_direction,
    start_beside,
)
from finssim.tasks.terms import (
    End,
    ObservationPart,
    RewardTerm,
    Terms,
    Total,
    action_costs,
    measured_depth,
    turn_rates,
    world_up,
)

RIPPLES = 4
"""Number of waves that a seabed is made of."""
FARTHEST_RANGE = 60.0
"""Range beyond which a beam sees nothing: it is shown as this far [m]."""
AHEAD_BEAM = math.radians(30.0)
"""Angle between the beam ahead and that straight down, as of a Doppler log [rad]."""


@wp.func
def seabed_height(arrays: TaskArrays, p: Any, w: int, x: wp.vec3) -> float:
    """Return the height of the seabed below or above a point, world frame [m]."""
    height = float(p.fit.size * p.floor)
    for i in range(arrays.seabed.shape[1]):
        ripple = arrays.seabed[w, i]
        way = x[0] * wp.cos(ripple[2]) + x[1] * wp.sin(ripple[2])
        height += ripple[0] * wp.sin(ripple[1] * way + ripple[3])
    return height


@wp.func
def beam_range(arrays: TaskArrays, p: Any, w: int, x: wp.vec3, direction: wp.vec3) -> float:
    """Return the range of the seabed along a beam [m], by fixed-point steps.

    Args:
        arrays: With the seabed.
        p: Settings of the task.
        w: Number of the world.
        x: Start of the beam, world frame [m].
        direction: Of the beam, world frame [-].
    """
    far = float(0.0)
    for _i in range(10):
        at = x + far * direction
        gap = at[2] - seabed_height(arrays, p, w, at)
        far = wp.clamp(far + gap / wp.max(-direction[2], 0.3), 0.0, wp.static(FARTHEST_RANGE))
    return far


@wp.func
def seen_range(arrays: TaskArrays, p: Any, w: int, k: int) -> float:
    """Range of a beam [m] in proportion to the vehicle's speed: 0 is straight down in the body, 1 that ahead."""
    angle = wp.where(k == 0, 0.0, wp.static(AHEAD_BEAM))
    beam = wp.vec3(wp.sin(angle), 0.0, -wp.cos(angle))
    x = arrays.position[w, 0]
    return beam_range(arrays, p, w, x, wp.quat_rotate(arrays.quaternion[w, 0], beam)) / p.fit.size


@wp.func
def depth_by_size(arrays: TaskArrays, p: Any, w: int, a: int) -> float:
    """Measured depth [m] in proportion to the vehicle's speed."""
    return measured_depth(arrays, w, a) / p.fit.size


@wp.func
def seen_across(arrays: TaskArrays, p: Any, w: int) -> float:
    """Distance to the left of the line [m] in proportion to the vehicle's speed."""
    return beside_leg(arrays.path, w, arrays.position[w, 0])[1] / p.fit.size


@wp.func
def altitude_error(state: State, arrays: TaskArrays, p: Any, w: int) -> float:
    """Altitude above the seabed less the wanted one, as a size [m]."""
    x = state.position[w, 0]
    return wp.abs(x[2] - seabed_height(arrays, p, w, x) - p.fit.size * p.altitude)


@wp.func
def beside_line(state: State, arrays: TaskArrays, p: Any, w: int) -> float:
    """Distance beside the line [m]."""
    return wp.abs(beside_leg(arrays.path, w, state.position[w, 0])[1])


@wp.func
def is_grounded(state: State, arrays: TaskArrays, p: Any, w: int) -> bool:
    """Closer to the seabed than `clearance` [m], in proportion to the vehicle's speed."""
    x = state.position[w, 0]
    return x[2] - seabed_height(arrays, p, w, x) < p.fit.size * p.clearance


@wp.func
def is_off(e: float, across: float, p: Any) -> bool:
    """Farther than `corridor` from the altitude [m], or than `width` from the line [m]."""
    return e > p.fit.size * p.corridor or across > p.fit.size * p.width


@wp.func
def start_over(state: State, arrays: TaskArrays, p: Any, key: int, w: int):
    """A seabed, a line over it, and a start near the altitude above its first point."""
    pi = 3.14159265
    size = p.fit.size
    rng = wp.rand_init(key, 4 * w)
    for i in range(arrays.seabed.shape[1]):
        number = 2.0 * pi / (size * wp.randf(rng, p.wave[0], p.wave[1]))
        height = wp.randf(rng, 0.2, 1.0) * p.steepness / number
        arrays.seabed[w, i] = wp.vec4(height, number, wp.randf(rng, -pi, pi), wp.randf(rng, -pi, pi))
    course = wp.randf(rng, -pi, pi)
    x = wp.vec3()
    x[2] = seabed_height(arrays, p, w, x) + size * p.altitude
    arrays.path.points[w, 0] = x
    arrays.path.points[w, 1] = x + size * p.line * wp.vec3(wp.cos(course), wp.sin(course), 0.0)
    start_beside(state, arrays, p, wp.rand_init(key, 4 * w + 1), w)


OBSERVATION = (
    ObservationPart("range straight down in the body", 1, "m", 5.0, 6.0, seen_range, errors=()),
    ObservationPart("range ahead, 30° from straight down", 1, "m", 5.0, 6.0, seen_range, index=1),
    ObservationPart("depth", 1, "m", 10.0, 6.0, depth_by_size),
    ObservationPart("distance to the left of the line", 1, "m", ERROR_SCALE, 3.0, seen_across, errors=(0,)),
    ObservationPart("direction of the line, body frame", 3, "1", term=path_direction),
    ObservationPart(
        "velocity over ground by cruising speed, body frame", 3, "1", clip=3.0, term=ground_velocity
    ),
    ObservationPart("angular velocity, body frame", 3, "rad/s", clip=2.0, term=turn_rates),
    ObservationPart("world up, body frame", 3, "1", term=world_up),
)


@dataclass(frozen=True, kw_only=True)
class TerrainFollowing(PathFollowing):
    """Keep an altitude over a seabed that two beams see, along a straight line, by orders to the autopilot.

    Lengths in metres, angles in radians, times in seconds. Lengths as for `PathFollowing`.
    """

    title: ClassVar[str] = "keep an altitude over a seabed"
    baselines: ClassVar = {"altimeter": "finssim.agents.steering:TerrainPilot"}
    name: str = "terrain"
    observation: tuple[ObservationPart, ...] = OBSERVATION
    legs: int = 1
    line: float = 90.0
    """Length of the line [m]."""
    altitude: float = 4.0
    """To keep above the seabed [m]."""
    floor: float = -25.0
    """Mean height of the seabed [m]."""
    wave: tuple[float, float] = (20.0, 60.0)
    """Length of the waves of the seabed, drawn from this range [m]."""
    steepness: float = 0.12
    """Greatest slope of one wave [-]; a seabed has four."""
    clearance: float = 0.7
    """Closer to the seabed than this the episode ends [m]."""
    corridor: float = 3.0
    """So it does farther than this from the altitude [m] ..."""
    width: float = 5.0
    """... or from the line [m]."""

    def allocate(self, arrays: TaskArrays, worlds: int, device: wp.Device) -> None:
        """Room for every world's line and seabed."""
        arrays.path = allocated(PathTable, worlds, device, points=self.legs + 1)
        arrays.seabed = wp.zeros((worlds, RIPPLES), dtype=wp.vec4, device=device)

    def success_rule(self) -> str:
        """See `Task`."""
        lengths = (self.fit.size * length for length in (self.tolerance, self.corridor))
        return "the end of the line, {:.3g} m from the altitude (RMS), never more than {:.3g} m".format(
            *lengths
        )

    def terms(self) -> Terms:
        """See `PathReward`; the error is that of the altitude, and `beside` is the distance to the line."""
        r = self.reward
        return Terms(
            start=start_over,
            advance=change_legs,
            shared={"e": altitude_error, "across": beside_line},
            meanings={"track": f"1 at the altitude, 1/e at {self.fit.size * r.track_scale:.3g} m from it."},
            rewards=(
                RewardTerm("track", on_path, r.track),
                RewardTerm("distance", "e", -r.distance / self.fit.size),
                RewardTerm("beside", "across", -r.distance / self.fit.size),
                RewardTerm("advance", path_advance, r.advance),
                *action_costs(r.action, r.change),
            ),
            ends=(
                End("finished", has_finished, r.finish),
                End("grounded", is_grounded, -r.loss),
                End("left", is_off, -r.loss),
            ),
            totals=(Total("squared_error", mean_square),),
        )
