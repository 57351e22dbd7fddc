"""Doppler velocity log: velocity of its mount over the floor or through the water."""
# mypy: disable-error-code="valid-type,misc,index,return-value,no-any-return,no-untyped-def,untyped-decorator"

import math
from typing import Any

import warp as wp

from finssim.physics.types import angular, linear, vec6
from finssim.sensors.batch import SensorBatch
from finssim.sensors.sampling import (
    TURN_ON,
    TURN_ON_2,
    WALK,
    WHITE,
    Sampling,
    SensedState,
    arrival,
    begin_update,
    digitised3,
    lost,
    normal,
    normal3,
    restart,
    root_of_wait,
    sample_due,
    sample_key,
    slot_of,
)

DVL = 3
"""Number of this kind of sensor in the random key."""


@wp.struct
class DvlParameters:
    """Mount and errors of one DVL. Standard deviations are per sample, the walk per square root of a second."""

    dropout: float  # probability that a sample never arrives
    r: wp.vec3  # sensor from the body origin, body frame [m]
    q_bs: wp.quat  # sensor to body, xyzw
    noise: float  # [m/s]
    walk: float  # [m/s/√s]
    turn_on: float  # [m/s]
    scale: float  # standard deviation of the scale error drawn at each reset
    quantum: float  # [m/s]
    range: float  # largest speed on each axis [m/s]
    tilt_cosine: float  # of the largest tilt with an echo
    altitude_min: float  # [m]
    altitude_max: float  # [m]


@wp.struct
class DvlArrays:
    """Readings and memory of all DVLs, by (world, vehicle); the ring has one more index."""

    velocity: wp.array2d(dtype=wp.vec3)  # sensor frame [m/s]
    bias: wp.array2d(dtype=wp.vec3)  # true bias, sensor frame [m/s]
    scale_error: wp.array2d(dtype=float)  # true scale error
    ring: wp.array3d(dtype=wp.vec3)  # samples on their way


@wp.func
def sensed_velocity(nu: vec6, q_wb: wp.quat, water: wp.vec3, r: wp.vec3, q_bs: wp.quat) -> wp.vec3:
    """What an ideal DVL reads: velocity of its point relative to the floor or to the water.

    v = R_bsᵀ [ v + ω × r - R_wbᵀ v_w ]

    Args:
        nu: Velocity of the body origin, body frame [m/s, rad/s].
        q_wb: Attitude, body to world, xyzw.
        water: Velocity v_w of the water for water track, zero for bottom track; world frame [m/s].
        r: Sensor from the body origin, body frame [m].
        q_bs: Orientation, sensor to body, xyzw.

    Returns:
        Velocity, sensor frame [m/s].
    """
    over_floor = linear(nu) + wp.cross(angular(nu), r)
    return wp.quat_rotate_inv(q_bs, over_floor - wp.quat_rotate_inv(q_wb, water))


@wp.func
def has_echo(
    position: wp.vec3,
    q_wb: wp.quat,
    r: wp.vec3,
    floor_depth: float,
    tilt_cosine: float,
    altitude_min: float,
    altitude_max: float,
) -> bool:
    """Whether the beams find the floor: the vehicle is not tilted too far, nor too close, nor too high.

    Args:
        position: Body origin, world frame [m].
        q_wb: Attitude, body to world, xyzw.
        r: Sensor from the body origin, body frame [m].
        floor_depth: Depth of the flat floor [m].
        tilt_cosine: Least cosine between the body's z axis and the vertical [-].
        altitude_min: Least height of the sensor above the floor [m].
        altitude_max: Greatest height of the sensor above the floor [m].
    """
    up = wp.quat_rotate(q_wb, wp.vec3(0.0, 0.0, 1.0))
    point = position + wp.quat_rotate(q_wb, r)
    altitude = floor_depth + point[2]
    return up[2] >= tilt_cosine and altitude >= altitude_min and altitude <= altitude_max


@wp.kernel(enable_backward=False)
def sample_dvl(
    position: wp.array2d(dtype=wp.vec3),
    quaternion: wp.array2d(dtype=wp.quat),
    velocity: wp.array2d(dtype=vec6),
    water_velocity: wp.array2d(dtype=wp.vec3),
    floor_depth: float,
    steps: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    parameters: wp.array2d(dtype=DvlParameters),
    dvl: DvlArrays,
    sampling: Sampling,
    mask: wp.array(dtype=int),
    restarting: bool,
    seed: int,
    world_offset: int,
):
    """One update of every DVL.

    Args:
        position: Body origin, world frame [m], (W, V).
        quaternion: Attitude, body to world, xyzw, (W, V).
        velocity: nu at the body origin, body frame [m/s, rad/s], (W, V).
        water_velocity: Of the water, world frame [m/s], (W, V): water track; empty for bottom track.
        floor_depth: Depth of the flat floor [m].
        steps: Control steps since the world's reset, (W,).
        episode: Resets of the world so far, (W,).
        parameters: Mount and errors of each DVL, (W, V).
        dvl: Readings and memory.
        sampling: When each samples.
        mask: Worlds to look at, (W,).
        restarting: Whether these worlds have just been reset.
        seed: Of all random numbers.
        world_offset: World of the first thread.
    """
    i, v = wp.tid()
    w = world_offset + i
    if mask[w] == 0:
        return
    p = parameters[w, v]
    step = steps[w]
    key = sample_key(seed, DVL, w, v, episode[w], step)
    if restarting:
        restart(sampling, w, v, step)
        dvl.bias[w, v] = p.turn_on * normal3(key, TURN_ON)
        dvl.scale_error[w, v] = p.scale * normal(key, TURN_ON_2)
    if not begin_update(sampling, w, v, step):
        return
    if restarting or sample_due(sampling, w, v, step):
        x = position[w, v]
        q = quaternion[w, v]
        root = root_of_wait(sampling, w, v, step)
        bias = dvl.bias[w, v] + p.walk * root * normal3(key, WALK)
        water = wp.vec3()
        echo = True
        if water_velocity.shape[0] > 0:
            water = water_velocity[w, v]
        else:
            echo = has_echo(x, q, p.r, floor_depth, p.tilt_cosine, p.altitude_min, p.altitude_max)
        exact = sensed_velocity(velocity[w, v], q, water, p.r, p.q_bs)
        reading = (1.0 + dvl.scale_error[w, v]) * exact + bias + p.noise * normal3(key, WHITE)
        slot = slot_of(sampling, step)
        dvl.ring[w, v, slot] = digitised3(reading, p.quantum, p.range)
        dvl.bias[w, v] = bias
        sampling.sent[w, v, slot] = echo and (restarting or not lost(key, p.dropout))
        sampling.last[w, v] = step
    slot = arrival(sampling, w, v, step, restarting)
    if slot >= 0:
        dvl.velocity[w, v] = dvl.ring[w, v, slot]


class DvlBatch(SensorBatch):
    """The DVLs of all vehicles of all worlds."""

    kind = "dvl"
    kernel = sample_dvl
    parameter_struct = DvlParameters
    array_struct = DvlArrays
    readings = ("velocity",)

    velocity: "wp.array[Any]"
    """Over the floor, or through the water where the water's velocity was given; sensor frame [m/s]; vec3 (W, V)."""
    bias: "wp.array[Any]"
    """Truth: the bias in it, sensor frame [m/s]; vec3 (W, V)."""
    scale_error: "wp.array[Any]"
    """Truth: the scale error in it; float (W, V)."""
    floor_depth: float = math.inf
    """Depth of the flat floor [m]."""

    def state_arrays(self, state: SensedState, water_velocity: Any) -> list[Any]:
        """Pose, velocity and the water."""
        return [state.position, state.quaternion, state.velocity, water_velocity, self.floor_depth]

    def use(self, vehicle: int, entry: Any, *, gravity: float, density: float) -> None:
        """Take one vehicle's parameters from its file.

        Args:
            vehicle: Index.
            entry: `vehicle.sensors.dvl`.
            gravity: Not used [m/s²].
            density: Not used [kg/m³].
        """
        knows_floor = math.isfinite(self.floor_depth)
        self.set(
            vehicle,
            dropout=entry.dropout,
            r=entry.position,
            q_bs=entry.orientation,
            noise=entry.noise_std,
            walk=entry.bias_walk,
            turn_on=entry.bias_initial,
            scale=entry.scale_error,
            quantum=entry.quantisation,
            range=entry.velocity_range,
            tilt_cosine=math.cos(min(entry.max_tilt, math.pi)),
            altitude_min=entry.altitude_min if knows_floor else -math.inf,
            altitude_max=entry.altitude_max if knows_floor else math.inf,
        )
