"""Terrain following, a task for vehicles that steer by moving: a constant altitude above a seabed along a line."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import NormalDist
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.control.guidance import Reference
from finssim.core.rotations import quat_rotate
from finssim.sim.site import described_world
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
from finssim.tasks.validation import EnvironmentSetupError
from finssim.vehicles import Vehicle
from finssim.vehicles.device_files import RangeDevice, device_of

RIPPLES = 4
"""Number of waves that are summed to a seabed."""
FARTHEST_RANGE = 60.0
"""Greatest range of a beam, also reported without an echo [m]."""
SPACING = 1.0
"""Grid spacing of the seabed as a described world [m]."""


@wp.func
def seabed_height(arrays: TaskArrays, p: Any, w: int, x: wp.vec3) -> float:
    """Return the height of the seabed at a horizontal position, world frame [m]."""
    height = float(p.fit.size * p.floor)
    for i in range(arrays.seabed.shape[1]):
        ripple = arrays.seabed[w, i]
        way = x[0] * wp.cos(ripple[2]) + x[1] * wp.sin(ripple[2])
        height += ripple[0] * wp.sin(ripple[1] * way + ripple[3])
    return height


@wp.func
def seabed_normal(arrays: TaskArrays, w: int, x: wp.vec3) -> wp.vec3:
    """Return the upward unit normal of the seabed at a horizontal position, world frame [-]."""
    slope = wp.vec3(0.0, 0.0, 1.0)
    for i in range(arrays.seabed.shape[1]):
        ripple = arrays.seabed[w, i]
        course = wp.vec3(wp.cos(ripple[2]), wp.sin(ripple[2]), 0.0)
        steepness = ripple[0] * ripple[1] * wp.cos(ripple[1] * wp.dot(x, course) + ripple[3])
        slope -= steepness * course
    return wp.normalize(slope)


@wp.func
def echo_angle(beta: float, beam: Any) -> float:
    """Return the angle from a plane's normal at which the echo of a beam is detected [rad].

    At the angle ψ from its normal and the range h / cos ψ, a plane reflects a fraction cos³ ψ exp(-u²/2σ²), u = β - ψ.
    To first order that is a Gaussian of variance s² = σ² / (1 + 3σ²), shifted towards the normal by 3s² tan ψ; for a
    beam along the normal, the quantile q of the angle is at sqrt(-2s² ln(1 - q)).

    Args:
        beta: Angle of the beam's axis from the normal [rad].
        beam: The beam.
    """
    aside = wp.max(beta - beam.lead, 0.0)
    aside = wp.max(aside - 3.0 * beam.variance * wp.tan(wp.min(aside, 1.2)), 0.0)
    return wp.sqrt(aside * aside + beam.least * beam.least)


@wp.func
def beam_range(arrays: TaskArrays, p: Any, w: int, x: wp.vec3, direction: wp.vec3) -> float:
    """Return the range of the seabed along a ray [m], by fixed-point iteration.

    Args:
        arrays: Arrays with the seabed.
        p: Settings of the task.
        w: Number of the world.
        x: Start of the beam, world frame [m].
        direction: Direction of the beam, world frame [-].
    """
    far = float(0.0)
    for _i in range(10):
        at = x + far * direction
        gap = at[2] - seabed_height(arrays, p, w, at)
        far = wp.clamp(far + gap / wp.max(-direction[2], 0.3), 0.0, wp.static(FARTHEST_RANGE))
    return far


@wp.func
def sounded(state: State, arrays: TaskArrays, p: Any, w: int, beam: Any) -> float:
    """Return the range that an altimeter measures [m]."""
    x, q = state.position[w, 0], state.quaternion[w, 0]
    start, direction = x + wp.quat_rotate(q, beam.position), wp.quat_rotate(q, beam.direction)
    far = beam_range(arrays, p, w, start, direction)
    # The echo of a wide beam begins with the rays that are closest to the normal of the seabed.
    facing = wp.clamp(-wp.dot(seabed_normal(arrays, w, start + far * direction), direction), 0.1, 1.0)
    return far * facing / wp.cos(echo_angle(wp.acos(facing), beam))


@wp.func
def sound(state: State, arrays: TaskArrays, p: Any, w: int):
    """Measure the ranges of both altimeters."""
    arrays.ranges[w, 0] = sounded(state, arrays, p, w, p.below)
    arrays.ranges[w, 1] = sounded(state, arrays, p, w, p.before)


@wp.func
def advance_terrain(state: State, arrays: TaskArrays, p: Any, w: int):
    """Switch legs, and measure the ranges."""
    change_legs(state, arrays, p, w)
    sound(state, arrays, p, w)


@wp.func
def seen_range(arrays: TaskArrays, p: Any, w: int, k: int) -> float:
    """Return a measured range [m], scaled to the vehicle's speed: 0 is the altimeter below, 1 the one ahead."""
    return wp.min(arrays.ranges[w, k], wp.static(FARTHEST_RANGE)) / p.fit.size


@wp.func
def depth_by_size(arrays: TaskArrays, p: Any, w: int, a: int) -> float:
    """Return the measured depth [m], scaled to the vehicle's speed."""
    return measured_depth(arrays, w, a) / p.fit.size


@wp.func
def seen_across(arrays: TaskArrays, p: Any, w: int) -> float:
    """Return the distance to the left of the line [m], scaled to the vehicle's speed."""
    return beside_leg(arrays.path, w, arrays.position[w, 0])[1] / p.fit.size


@wp.func
def altitude_error(state: State, arrays: TaskArrays, p: Any, w: int) -> float:
    """Return the magnitude of the altitude error above the seabed [m]."""
    x = state.position[w, 0]
    return wp.abs(x[2] - seabed_height(arrays, p, w, x) - p.fit.size * p.altitude)


@wp.func
def beside_line(state: State, arrays: TaskArrays, p: Any, w: int) -> float:
    """Return the horizontal distance from the line [m]."""
    return wp.abs(beside_leg(arrays.path, w, state.position[w, 0])[1])


@wp.func
def is_grounded(state: State, arrays: TaskArrays, p: Any, w: int) -> bool:
    """Return True if the seabed is closer than `clearance` [m], scaled to the vehicle's speed."""
    x = state.position[w, 0]
    return x[2] - seabed_height(arrays, p, w, x) < p.fit.size * p.clearance


@wp.func
def is_off(e: float, across: float, p: Any) -> bool:
    """Return True if the altitude error exceeds `corridor` [m], or the distance from the line exceeds `width` [m]."""
    return e > p.fit.size * p.corridor or across > p.fit.size * p.width


@wp.func
def start_over(state: State, arrays: TaskArrays, p: Any, key: int, w: int):
    """Start an episode with a random seabed, a line above it, and a vehicle near the altitude at its first point."""
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
    sound(state, arrays, p, w)


OBSERVATION = (
    ObservationPart("range of the altimeter", 1, "m", 5.0, 6.0, seen_range, errors=()),
    ObservationPart("range of the altimeter ahead", 1, "m", 5.0, 6.0, seen_range, index=1),
    ObservationPart("depth", 1, "m", 10.0, 6.0, depth_by_size),
    ObservationPart("distance to the left of the line", 1, "m", ERROR_SCALE, 3.0, seen_across, errors=(0,)),
    ObservationPart("direction of the line, body frame", 3, "1", term=path_direction),
    ObservationPart(
        "velocity over ground by cruising speed, body frame", 3, "1", clip=3.0, term=ground_velocity
    ),
    ObservationPart("angular velocity, body frame", 3, "rad/s", clip=2.0, term=turn_rates),
    ObservationPart("world up, body frame", 3, "1", term=world_up),
)


@dataclass(frozen=True)
class Beam:
    """Origin, direction and width of the beam of an altimeter, body frame."""

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """[m]"""
    direction: tuple[float, float, float] = (0.0, 0.0, -1.0)
    """Unit vector."""
    lead: float = 0.0
    """Angle towards the normal of a surface at which the echo is detected [rad], see `echo_angle`; 0 for a ray."""
    least: float = 0.0
    """Angle from the normal at which the echo of a beam along the normal is detected [rad]."""
    variance: float = 0.0
    """Variance s² of the echo over the angle, see `echo_angle` [rad²]."""

    def echo_angle(self, beta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return `echo_angle` of this beam for angles of its axis from a plane's normal [rad], of the same shape."""
        aside = np.maximum(beta - self.lead, 0.0)
        aside = np.maximum(aside - 3.0 * self.variance * np.tan(np.minimum(aside, 1.2)), 0.0)
        return np.hypot(aside, self.least)

    def on(self, vehicle: Vehicle, name: str) -> "Beam":
        """Return the beam of an altimeter in the vehicle's `perception`; this one if there is none with that name."""
        if name not in vehicle.perception:
            return self
        device = device_of(vehicle, name)
        if not isinstance(device, RangeDevice) or device.beams != 1:
            raise EnvironmentSetupError(
                f"{vehicle.name}: perception.{name} is no altimeter of one beam, as task 'terrain' expects"
            )
        along = quat_rotate(device.mount.quaternion, [1.0, 0.0, 0.0])
        # Two-way, a pattern with half power at half the width is exp(-8 ln 2 (angle / width)²); rays end at the width.
        width = device.beam_width if device.rays > 1 else 0.0
        pattern = width**2 / (16.0 * math.log(2.0))
        variance = pattern / (1.0 + 3.0 * pattern)
        share = min(max(device.quantile, 1e-9), 1.0 - 1e-9)
        lead = -math.sqrt(variance) * NormalDist().inv_cdf(share)
        return Beam(
            tuple(device.mount.position.tolist()),
            tuple(along.tolist()),
            lead=max(min(lead, width), -width),
            least=min(math.sqrt(-2.0 * variance * math.log(1.0 - share)), width),
            variance=variance,
        )


@dataclass(frozen=True, kw_only=True)
class TerrainFollowing(PathFollowing):
    """Keep an altitude above a seabed measured by two altimeters, along a straight line, by autopilot commands.

    Lengths in metres, angles in radians, times in seconds. Lengths scale as for `PathFollowing`.
    """

    title: ClassVar[str] = "keep an altitude over a seabed"
    baselines: ClassVar = {"altimeter": "finssim.agents.steering:TerrainPilot"}
    ranges: ClassVar[tuple[str, ...]] = ("altimeter", "altimeter_ahead")
    name: str = "terrain"
    observation: tuple[ObservationPart, ...] = OBSERVATION
    legs: int = 1
    line: float = 90.0
    """Length of the line [m]."""
    altitude: float = 4.0
    """Commanded altitude above the seabed [m]."""
    floor: float = -25.0
    """Mean height of the seabed [m]."""
    wave: tuple[float, float] = (20.0, 60.0)
    """Range of the wavelengths of the seabed [m]."""
    steepness: float = 0.12
    """Greatest slope of one wave [-]; a seabed has four."""
    clearance: float = 0.7
    """Distance to the seabed below which the episode ends [m]."""
    corridor: float = 3.0
    """Altitude error above which the episode ends [m]."""
    width: float = 5.0
    """Distance from the line beyond which the episode ends [m]."""
    below: Beam = Beam()
    """Beam of the altimeter, vertical unless the vehicle has another one; the environment sets it."""
    before: Beam = Beam(direction=(0.5, 0.0, -math.sqrt(0.75)))
    """Beam of the altimeter ahead, 30° from the vertical unless the vehicle has another one; the environment sets
    it."""

    def fitted(self, vehicles: Sequence[Vehicle]) -> "TerrainFollowing":
        """Return the task for the speed and the altimeters of the vehicle."""
        one, two = self.ranges
        below, before = self.below.on(vehicles[0], one), self.before.on(vehicles[0], two)
        return replace(super().fitted(vehicles), below=below, before=before)

    def allocate(self, arrays: TaskArrays, worlds: int, device: wp.Device) -> None:
        """Allocate the line and the seabed of every world."""
        arrays.path = allocated(PathTable, worlds, device, points=self.legs + 1)
        arrays.seabed = wp.zeros((worlds, RIPPLES), dtype=wp.vec4, device=device)

    def straight(self, here: NDArray[np.float64], goal: Reference) -> NDArray[np.float64]:
        """Return the level line from a position to the horizontal position of a goal [m], (2, 3)."""
        end = np.asarray(goal.position, float)
        return np.stack([here, [end[0], end[1], here[2]]])

    def site(self, arrays: TaskArrays, seed: int) -> Any:
        """Return the seabed of the first world as a described world; see `Task`.

        Raises:
            SurroundingsError: The perception extension, whose sensors measure in it, is not installed.
        """
        depth, half = -self.fit.size * self.floor, self.fit.size * (self.line + 30.0)
        x = np.linspace(-half, half, math.ceil(2.0 * half / SPACING) + 1)
        height, number, course, phase = np.moveaxis(arrays.seabed.numpy()[0].astype(float), 1, 0)[
            :, :, None, None
        ]
        along = x * np.cos(course) + x[:, None] * np.sin(course)
        with TemporaryDirectory() as folder:
            np.savetxt(
                Path(folder) / "heights.csv", (height * np.sin(number * along + phase)).sum(0), "%.4f", ","
            )
            file = Path(folder) / "seabed.yaml"
            file.write_text(
                f"about: seabed of task {self.name}\nwater: {{jerlov: II, veil: [0.0, 0.1, 0.1]}}\n"
                f"seabed: {{depth: {depth}, size: [{2 * half}, {2 * half}], spacing: {SPACING}, "
                "heights: heights.csv}\n"
                f"viewpoint: {{position: [0, 0, {0.5 * -depth}]}}\n"
            )
            return described_world(file).drawn_for(self, arrays, seed)

    def success_rule(self) -> str:
        """Return the rule of success; see `Task`."""
        lengths = (self.fit.size * length for length in (self.tolerance, self.corridor))
        return "the end of the line, {:.3g} m from the altitude (RMS), never more than {:.3g} m".format(
            *lengths
        )

    def terms(self) -> Terms:
        """Return the terms; see `PathReward`. The error is that of the altitude, and `beside` is the distance to
        the line."""
        r = self.reward
        return Terms(
            start=start_over,
            advance=advance_terrain,
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
