"""Moving water: uniform, sheared and drifting currents, linear waves at finite depth, and the free surface."""

# mypy: disable-error-code="assignment,no-untyped-def,operator,untyped-decorator,valid-type"

import math

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray


@wp.struct
class WaterArrays:
    """Water of every world; the arrays are indexed by world, the wave arrays by (world, component)."""

    density: float  # [kg/m³]
    gravity: float  # [m/s²]
    depth: float  # still water depth [m], for the wave dispersion
    n_waves: int
    moving: int  # 0: still water everywhere, nothing below is used
    current: wp.array(dtype=wp.vec3)  # at the still surface, world frame [m/s]
    shear: wp.array(dtype=wp.vec3)  # d(current)/dz, world frame [1/s]
    drift: wp.array(dtype=wp.vec3)  # slow random part of the current at the start of the step [m/s]
    drift_rate: wp.array(dtype=wp.vec3)  # its rate of change during the step [m/s²]
    drift_std: wp.array(dtype=wp.vec3)  # standard deviation of the drift, world frame [m/s]
    drift_time: wp.array(dtype=float)  # correlation time [s]
    profile_depth: wp.array(
        dtype=float
    )  # depths of the current profile, ascending [m]; none without a profile
    profile_time: wp.array(dtype=float)  # times of the current profile since the reset, ascending [s]
    profile: wp.array2d(dtype=wp.vec3)  # current by time and depth, world frame [m/s]
    profile_turn: wp.array(dtype=wp.vec2)  # scale and rotation of the profile, scale (cos, sin), by world [-]
    wave_amplitude: wp.array2d(dtype=float)  # [m]
    wave_number: wp.array2d(dtype=float)  # k [rad/m]
    wave_frequency: wp.array2d(dtype=float)  # omega [rad/s], from the dispersion relation
    wave_heading: wp.array2d(dtype=float)  # direction of travel from world x [rad]
    wave_phase: wp.array2d(dtype=float)  # [rad]


@wp.struct
class Flow:
    """Water at one vehicle: its motion and its surface."""

    velocity: wp.vec3  # world frame [m/s]
    acceleration: wp.vec3  # local acceleration, world frame [m/s²]
    elevation: float  # surface height above still water [m]
    gradient: wp.mat33  # d velocity_i / d x_j, world frame [1/s]
    normal: wp.vec3  # unit normal of the surface, upwards, world frame


def dispersion(wave_number: ArrayLike, depth: float, gravity: float = 9.81) -> NDArray[np.float64]:
    """Return the angular frequency of a linear wave, ω = sqrt(g k tanh(k h)).

    Args:
        wave_number: k = 2π / wavelength [rad/m], any shape.
        depth: Still water depth h [m]; `math.inf` for deep water.
        gravity: [m/s²].

    Returns:
        ω [rad/s], shape of `wave_number`.
    """
    k = np.asarray(wave_number, dtype=float)
    return np.sqrt(gravity * k * (np.tanh(k * depth) if math.isfinite(depth) else 1.0))


def wave_number(frequency: ArrayLike, depth: float, gravity: float = 9.81) -> NDArray[np.float64]:
    """Return the wave number that solves the dispersion relation ω² = g k tanh(k h), by Newton's method.

    Args:
        frequency: ω [rad/s], positive, of any shape (...,).
        depth: Still water depth h [m].
        gravity: [m/s²].

    Returns:
        k [rad/m], shape of `frequency`; relative error below 1e-12.
    """
    omega = np.asarray(frequency, dtype=float)
    deep = omega**2 / gravity
    k = deep / np.sqrt(np.tanh(deep * depth))  # Eckart's approximation starts within 10 %
    for _ in range(20):
        t = np.tanh(k * depth)
        k = k - (gravity * k * t - omega**2) / (gravity * t + gravity * k * depth * (1.0 - t * t))
    return k


@wp.struct
class ProfileFlow:
    """Current of a profile at a point."""

    velocity: wp.vec3  # world frame [m/s]
    slope: wp.vec3  # change with height [1/s]
    rate: wp.vec3  # change with time [m/s²]


@wp.func
def segment(grid: wp.array(dtype=float), x: float) -> int:
    """Return the index of the segment that contains x in an ascending grid of at least two points, in the grid's
    unit."""
    i = int(0)
    for r in range(1, grid.shape[0] - 1):
        if x >= grid[r]:
            i = r
    return i


@wp.func
def profile_at(water: WaterArrays, world: int, depth: float, t: float) -> ProfileFlow:
    """Return the current of the profile, linear between its depths [m] and times [s], and constant beyond them."""
    out = ProfileFlow()
    i = int(0)
    j = int(0)
    di = int(0)
    dj = int(0)
    f = float(0.0)
    g = float(0.0)
    height = float(1.0)
    span = float(1.0)
    if water.profile_depth.shape[0] > 1:
        i = segment(water.profile_depth, depth)
        di = 1
        height = water.profile_depth[i + 1] - water.profile_depth[i]
        f = (depth - water.profile_depth[i]) / height
    if water.profile_time.shape[0] > 1:
        j = segment(water.profile_time, t)
        dj = 1
        span = water.profile_time[j + 1] - water.profile_time[j]
        g = (t - water.profile_time[j]) / span
    u = wp.clamp(f, 0.0, 1.0)
    s = wp.clamp(g, 0.0, 1.0)
    a = water.profile[j, i]
    b = water.profile[j, i + di]
    c = water.profile[j + dj, i]
    d = water.profile[j + dj, i + di]
    turn = water.profile_turn[world]
    factor = wp.length(turn)
    R = wp.mat33(turn[0], -turn[1], 0.0, turn[1], turn[0], 0.0, 0.0, 0.0, factor)
    out.velocity = R * ((1.0 - s) * ((1.0 - u) * a + u * b) + s * ((1.0 - u) * c + u * d))
    if u == f:
        out.slope = -(R * ((1.0 - s) * (b - a) + s * (d - c))) / height
    if s == g:
        out.rate = R * ((1.0 - u) * (c - a) + u * (d - b)) / span
    return out


@wp.func
def flow_at(water: WaterArrays, world: int, position: wp.vec3, t: float, t_step: float) -> Flow:
    """Return velocity, acceleration, gradient and surface of the water at a point.

    Linear (Airy) waves of amplitude A, θ = k·x - ωt + φ, at depth h:
    η = A cos θ,  u = A ω cosh k(z+h) / sinh kh cos θ,  w = A ω sinh k(z+h) / sinh kh sin θ.
    Above the still surface the orbital motion is that of z = 0. The acceleration is the local one, ∂v/∂t, as in linear
    wave theory.

    Args:
        water: Water of all worlds.
        world: Index of the world.
        position: Point, world frame [m].
        t: Time since the world was reset [s].
        t_step: Time since the start of the control step [s]; the drifting current is linear within a step.

    Returns:
        The flow at the point, world frame.
    """
    flow = Flow()
    flow.normal = wp.vec3(0.0, 0.0, 1.0)
    if water.moving == 0:
        return flow
    depth_z = wp.min(position[2], 0.0)
    shear = water.shear[world]
    rate = water.drift_rate[world]
    v = water.current[world] + depth_z * shear + water.drift[world] + t_step * rate
    a = rate
    if water.profile_depth.shape[0] > 0:
        profile = profile_at(water, world, -depth_z, t)
        v += profile.velocity
        a += profile.rate
        shear += profile.slope
    eta = float(0.0)
    slope_x = float(0.0)
    slope_y = float(0.0)
    G = wp.mat33(0.0, 0.0, shear[0], 0.0, 0.0, shear[1], 0.0, 0.0, shear[2])
    for i in range(water.n_waves):
        A = water.wave_amplitude[world, i]
        k = water.wave_number[world, i]
        omega = water.wave_frequency[world, i]
        cx = wp.cos(water.wave_heading[world, i])
        cy = wp.sin(water.wave_heading[world, i])
        theta = k * (cx * position[0] + cy * position[1]) - omega * t + water.wave_phase[world, i]
        c = wp.cos(theta)
        s = wp.sin(theta)
        # cosh k(z+h) / sinh kh and sinh k(z+h) / sinh kh without overflow in deep water
        up = wp.exp(k * depth_z)
        down = wp.exp(-k * (depth_z + 2.0 * water.depth))
        scale = 1.0 / (1.0 - wp.exp(-2.0 * k * water.depth))
        ch = (up + down) * scale
        sh = (up - down) * scale
        aw = A * omega
        v += wp.vec3(aw * ch * c * cx, aw * ch * c * cy, aw * sh * s)
        a += aw * omega * wp.vec3(ch * s * cx, ch * s * cy, -sh * c)
        eta += A * c
        slope_x -= A * k * s * cx
        slope_y -= A * k * s * cy
        gh = -aw * k * ch * s
        gz = aw * k * sh * c
        G += wp.mat33(
            gh * cx * cx, gh * cx * cy, gz * cx,
            gh * cx * cy, gh * cy * cy, gz * cy,
            gz * cx, gz * cy, -gh,
        )  # fmt: skip
    flow.velocity = v
    flow.acceleration = a
    flow.elevation = eta
    flow.gradient = G
    flow.normal = wp.normalize(wp.vec3(-slope_x, -slope_y, 1.0))
    return flow


@wp.kernel(enable_backward=False)
def advance_drift(
    water: WaterArrays,
    steps: wp.array(dtype=int),
    control_step: float,
    seed: int,
    episode: wp.array(dtype=int),
    world_offset: int,
):
    """Draw the drifting current of the next control step: a Gauss-Markov process, discretized exactly.

    d(0) = σ N(0, 1),  d(t + T) = a d(t) + sqrt(1 - a²) σ N(0, 1),  a = exp(-T / time)

    `control_step` is the length of a control step [s].
    """
    w = world_offset + wp.tid()
    if water.drift_time[w] <= 0.0:
        return
    stream = wp.rand_init(seed + 7919 * episode[w], w)
    rng = wp.rand_init(wp.randi(stream), steps[w])
    a = wp.exp(-control_step / water.drift_time[w])
    noise = wp.vec3(wp.randn(rng), wp.randn(rng), wp.randn(rng))
    start = water.drift[w] + control_step * water.drift_rate[w]
    if steps[w] == 0:
        start = wp.cw_mul(water.drift_std[w], wp.vec3(wp.randn(rng), wp.randn(rng), wp.randn(rng)))
    new = a * start + wp.sqrt(1.0 - a * a) * wp.cw_mul(water.drift_std[w], noise)
    water.drift[w] = start
    water.drift_rate[w] = (new - start) / control_step
