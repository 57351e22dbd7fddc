"""Domain randomisation: parameters drawn for every episode, inside the batch."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from finssim.engine.launch import Pipeline
from finssim.engine.plant_arrays import build_plant, twist_shift, vehicle_parameters
from finssim.engine.ranges_file import Ranges, load_ranges
from finssim.engine.state import State
from finssim.physics.plant import VehicleParameters
from finssim.physics.types import MAX_THRUSTERS, mat66, vec6, vec8
from finssim.physics.water import WaterArrays

if TYPE_CHECKING:
    from finssim.engine.simulator import Simulator


@wp.struct
class RangeArrays:
    """Low and high ends of everything drawn, for the kernel."""

    mass: wp.vec2
    volume: wp.vec2
    volume_with_mass: int
    inertia: wp.vec2
    center_of_gravity: wp.vec2
    center_of_buoyancy: wp.vec2
    added_mass: wp.vec2
    added_mass_low: vec6
    added_mass_high: vec6
    linear: wp.vec2
    linear_low: vec6
    linear_high: vec6
    quadratic: wp.vec2
    quadratic_low: vec6
    quadratic_high: vec6
    mesh_drag: wp.vec2
    thrust: wp.vec2
    each_thrust: wp.vec2
    time_constant: wp.vec2
    delay: wp.vec2
    slew: wp.vec2
    current: wp.vec2
    base_current: wp.vec3  # of the given water; what is drawn adds to it [m/s]
    given_waves: int  # waves of the given water stay in the first slots
    wave_count: wp.vec2
    amplitude: wp.vec2
    wavelength: wp.vec2


@wp.struct
class Nominal:
    """The vehicles as their files have them, by vehicle."""

    plant: wp.array2d(dtype=VehicleParameters)  # one world
    M_A: wp.array(dtype=mat66)  # added mass about the point where its coefficients hold
    H: wp.array(dtype=mat66)  # twist at that point from the twist at the body origin


@wp.func
def scaled_matrix(M: mat66, factor: vec6) -> mat66:
    """S M S with S = diag(sqrt(factor)): scales the diagonal by the factors and keeps symmetry and definiteness."""
    out = mat66()
    for i in range(6):
        for j in range(6):
            out[i, j] = M[i, j] * wp.sqrt(factor[i] * factor[j])
    return out


@wp.func
def between(x: float, ends: wp.vec2) -> float:
    """The value a part x in [0, 1] of the way between two ends."""
    return ends[0] + x * (ends[1] - ends[0])


@wp.func
def axis_factors(seed: int, stream: int, common: wp.vec2, low: vec6, high: vec6) -> vec6:
    """A common factor times one for each axis, uniform."""
    rng = wp.rand_init(seed, stream)
    every = between(wp.randf(rng), common)
    out = vec6()
    for i in range(6):
        out[i] = every * (low[i] + wp.randf(rng) * (high[i] - low[i]))
    return out


@wp.kernel(enable_backward=False)
def randomize_vehicles(
    plant: wp.array2d(dtype=VehicleParameters),
    nominal: Nominal,
    r: RangeArrays,
    state: State,
    seed: int,
    mask: wp.array(dtype=int),
    world_offset: int,
):
    """Draw the vehicles' parameters of the episode that starts, where mask is not 0; refresh the plant afterwards."""
    i, v = wp.tid()
    w = world_offset + i
    if mask[w] == 0:
        return
    n = nominal.plant
    key = seed + 32452843 * state.episode[w] + 17 * v
    rng = wp.rand_init(key, 8 * w)
    mass = between(wp.randf(rng), r.mass)
    volume = between(wp.randf(rng), r.volume)
    if r.volume_with_mass != 0:
        volume = mass
    inertia = between(wp.randf(rng), r.inertia)
    drag = between(wp.randf(rng), r.mesh_drag)
    plant[w, v].mass = mass * n[0, v].mass
    plant[w, v].volume = volume * n[0, v].volume
    plant[w, v].form_drag = drag * n[0, v].form_drag
    plant[w, v].skin_drag = drag * n[0, v].skin_drag
    plant[w, v].delay = between(wp.randf(rng), r.delay) * n[0, v].delay
    plant[w, v].slew = between(wp.randf(rng), r.slew) * n[0, v].slew
    plant[w, v].time_constant = between(wp.randf(rng), r.time_constant) * n[0, v].time_constant
    g = wp.vec3(wp.randf(rng), wp.randf(rng), wp.randf(rng))
    b = wp.vec3(wp.randf(rng), wp.randf(rng), wp.randf(rng))
    one = wp.vec3(1.0, 1.0, 1.0)
    r_g = n[0, v].r_g + r.center_of_gravity[0] * one + (r.center_of_gravity[1] - r.center_of_gravity[0]) * g
    plant[w, v].r_g = r_g
    plant[w, v].r_b = (
        n[0, v].r_b + r.center_of_buoyancy[0] * one + (r.center_of_buoyancy[1] - r.center_of_buoyancy[0]) * b
    )
    # The factor is on the inertia about the centre of gravity; Steiner's part follows mass and centre.
    r_n = n[0, v].r_g
    I_n = n[0, v].inertia - n[0, v].mass * (
        wp.dot(r_n, r_n) * wp.identity(3, dtype=float) - wp.outer(r_n, r_n)
    )
    steiner = wp.dot(r_g, r_g) * wp.identity(3, dtype=float) - wp.outer(r_g, r_g)
    plant[w, v].inertia = inertia * I_n + plant[w, v].mass * steiner

    H = nominal.H[v]
    M_A = scaled_matrix(
        nominal.M_A[v], axis_factors(key, 8 * w + 1, r.added_mass, r.added_mass_low, r.added_mass_high)
    )
    plant[w, v].M_A = wp.transpose(H) * M_A * H
    plant[w, v].D1 = scaled_matrix(
        n[0, v].D1, axis_factors(key, 8 * w + 2, r.linear, r.linear_low, r.linear_high)
    )
    plant[w, v].D2 = scaled_matrix(
        n[0, v].D2, axis_factors(key, 8 * w + 3, r.quadratic, r.quadratic_low, r.quadratic_high)
    )
    rng_t = wp.rand_init(key, 8 * w + 4)
    every = between(wp.randf(rng_t), r.thrust)
    gain = vec8()
    for k in range(MAX_THRUSTERS):
        gain[k] = every * between(wp.randf(rng_t), r.each_thrust)
    plant[w, v].gain = gain


@wp.kernel(enable_backward=False)
def randomize_water(
    water: WaterArrays, r: RangeArrays, state: State, seed: int, mask: wp.array(dtype=int), world_offset: int
):
    """Draw current and waves of the episode that starts, on top of the given water, where mask is not 0."""
    w = world_offset + wp.tid()
    if mask[w] == 0:
        return
    rng = wp.rand_init(seed + 49979687 * state.episode[w], w)
    two_pi = 6.2831853
    speed = between(wp.randf(rng), r.current)
    direction = two_pi * wp.randf(rng)
    water.current[w] = r.base_current + speed * wp.vec3(wp.cos(direction), wp.sin(direction), 0.0)
    count = int(between(wp.randf(rng), wp.vec2(r.wave_count[0], r.wave_count[1] + 0.999)))
    for i in range(r.given_waves, water.n_waves):
        k = two_pi / wp.max(between(wp.randf(rng), r.wavelength), 0.1)
        amplitude = between(wp.randf(rng), r.amplitude)
        water.wave_amplitude[w, i] = wp.where(i - r.given_waves < count, amplitude, 0.0)
        water.wave_number[w, i] = k
        water.wave_frequency[w, i] = wp.sqrt(water.gravity * k * wp.tanh(k * water.depth))
        water.wave_heading[w, i] = two_pi * wp.randf(rng)
        water.wave_phase[w, i] = two_pi * wp.randf(rng)


class Randomization:
    """Draws a new vehicle and new water for every episode."""

    def __init__(self, ranges: Ranges | str | Path) -> None:
        """Take ranges, or the name or file of ranges."""
        self.ranges = ranges if isinstance(ranges, Ranges) else load_ranges(ranges)

    @property
    def moves_water(self) -> bool:
        """Whether currents or waves are drawn."""
        return self.ranges.current[1] > 0.0 or self.ranges.waves is not None

    def simulator_arguments(self, vehicle_delay: float) -> dict[str, Any]:
        """What a simulator must make room for: the longest delay [s] and the most waves."""
        waves = self.ranges.waves.count[1] if self.ranges.waves else 0
        return {
            "max_delay": vehicle_delay * max(self.ranges.delay[1], 1.0),
            "max_waves": waves,
            "water_moves": self.moves_water,
        }

    def add(self, pipeline: Pipeline, simulator: "Simulator", mask: wp.array, seed: int) -> None:
        """Append the draw for the worlds where mask (by world, int32) is not 0; refresh the plant afterwards."""
        arrays = range_arrays(self.ranges)
        given = simulator.surroundings[0]
        arrays.base_current, arrays.given_waves = wp.vec3(*given.current), len(given.waves)
        nominal = _nominal(simulator)
        inputs = [simulator.plant.array, nominal, arrays, simulator.state, seed, mask]
        pipeline.add(randomize_vehicles, inputs, vehicles=len(simulator.vehicles))
        if self.moves_water:
            pipeline.add(randomize_water, [simulator.water, arrays, simulator.state, seed, mask])


def _nominal(simulator: "Simulator") -> Nominal:
    device, vehicles = simulator.device, simulator.vehicles
    out = Nominal()
    out.plant = build_plant(vehicles, simulator.hydrodynamics, 1, [0] * len(vehicles), device).array
    H, M_A = [], []
    for vehicle in vehicles:
        values = vehicle_parameters(vehicle, simulator.hydrodynamics)
        shift = twist_shift(values["r_h"])
        back = np.linalg.inv(shift)
        H.append(shift)
        M_A.append(back.T @ values["M_A"] @ back)
    out.H = wp.array(np.array(H), dtype=mat66, device=device)
    out.M_A = wp.array(np.array(M_A), dtype=mat66, device=device)
    return out


def range_arrays(ranges: Ranges) -> RangeArrays:
    """The struct that the kernels take."""
    out = RangeArrays()
    for name in (
        "mass",
        "inertia",
        "center_of_gravity",
        "center_of_buoyancy",
        "mesh_drag",
        "time_constant",
        "delay",
        "slew",
        "current",
    ):
        setattr(out, name, wp.vec2(*getattr(ranges, name)))
    out.volume_with_mass = int(ranges.volume == "with_mass")
    out.volume = wp.vec2(1.0, 1.0) if ranges.volume == "with_mass" else wp.vec2(*ranges.volume)
    for ours, part in (
        ("added_mass", ranges.added_mass),
        ("linear", ranges.linear_damping),
        ("quadratic", ranges.quadratic_damping),
    ):
        low, high = part.bounds()
        setattr(out, ours, wp.vec2(*part.all))
        setattr(out, f"{ours}_low", vec6(*low))
        setattr(out, f"{ours}_high", vec6(*high))
    out.thrust, out.each_thrust = wp.vec2(*ranges.thrust.all), wp.vec2(*ranges.thrust.each)
    if ranges.waves is not None:
        out.wave_count = wp.vec2(*map(float, ranges.waves.count))
        out.amplitude, out.wavelength = wp.vec2(*ranges.waves.amplitude), wp.vec2(*ranges.waves.wavelength)
    else:
        out.wavelength = wp.vec2(1.0, 1.0)
    return out
