"""Domain randomisation: parameters drawn for every episode, inside the batch."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.core.page import notebook_html
from finssim.physics.plant import VehicleParameters
from finssim.physics.terms.composed import layout
from finssim.physics.tether import Tether
from finssim.physics.types import MAX_THRUSTERS, mat66, vec6, vec8
from finssim.physics.water import WaterArrays
from finssim.sim.distributions import KINDS, Distribution, bounds_of
from finssim.sim.launch import KernelSequence
from finssim.sim.measured import SENSORS, MeasurementErrors
from finssim.sim.packed import Packed
from finssim.sim.plant_arrays import build_plant, twist_shift, vehicle_parameters
from finssim.sim.ranges_file import MAX_WAVES, Ranges, RangesError, SeaRanges, WaveRanges, load_ranges
from finssim.sim.ranges_table import ENTRIES, INDEX, TETHER, WORLD, WORLD_END, added_entry, drawn_entries
from finssim.sim.site import TetherLine
from finssim.sim.state import State
from finssim.sim.water import sea_bands

# The table of distributions that the kernel draws from, and one draw.


UNIFORM, LOG_UNIFORM, NORMAL, CHOICE = range(len(KINDS))


@wp.struct
class DrawTable:
    """Distributions of all entries of the table; rows of entries that never vary are not read."""

    count: int
    drawn: wp.array(dtype=int)  # indices of the entries that vary
    kind: wp.array(dtype=int)
    ends: wp.array(dtype=wp.vec4)  # low, high, mean, standard deviation, in the unit of the entry
    probability: wp.array(dtype=float)  # probability that the entry is drawn
    nominal: wp.array(dtype=float)  # value where nothing is drawn, in the unit of the entry
    stream: wp.array(dtype=int)
    first_choice: wp.array(dtype=int)
    choices: wp.array(dtype=int)
    choice: wp.array(dtype=float)  # values to choose from, in the unit of the entry
    cumulative: wp.array(dtype=float)  # cumulative probability of each choice
    first_tie: wp.array(dtype=int)
    ties: wp.array(dtype=int)  # number of normal numbers in the entry's weighted sum; 0: independent
    tied: wp.array(dtype=int)  # entries of these normal numbers
    tie_weight: wp.array(dtype=float)  # weight of each normal number in the sum


@wp.func
def normal_part(x: float) -> float:
    """Return the fraction of a standard normal distribution below x."""
    return 0.5 + 0.5 * wp.erf(0.70710678 * x)


@wp.func
def quantile(t: DrawTable, k: int, u: float) -> float:
    """Return the u-quantile of entry k, with u in [0, 1)."""
    e = t.ends[k]
    kind = t.kind[k]
    x = e[0] + u * (e[1] - e[0])
    if kind == LOG_UNIFORM:
        x = e[0] * wp.exp(u * wp.log(e[1] / e[0]))
    if kind == NORMAL:
        x = e[2]
        if e[3] > 0.0:
            a = normal_part((e[0] - e[2]) / e[3])
            b = normal_part((e[1] - e[2]) / e[3])
            p = wp.clamp(a + u * (b - a), 3.0e-7, 1.0 - 3.0e-7)
            x = wp.clamp(e[2] + e[3] * 1.41421356 * wp.erfinv(2.0 * p - 1.0), e[0], e[1])
    if kind == CHOICE:
        i = t.first_choice[k]
        last = i + t.choices[k] - 1
        while i < last and u >= t.cumulative[i]:
            i += 1
        x = t.choice[i]
    return x


@wp.func
def draw_entry(t: DrawTable, k: int, key: int) -> float:
    """Return a draw of entry k in its unit, from the entry's own random stream, which is independent of other
    entries."""
    rng = wp.rand_init(key, 2 * t.stream[k])
    u = wp.randf(rng)
    gate = wp.randf(rng)
    if t.ties[k] > 0:
        z = float(0.0)
        for i in range(t.first_tie[k], t.first_tie[k] + t.ties[k]):
            other = wp.rand_init(key, 2 * t.stream[t.tied[i]] + 1)
            z += t.tie_weight[i] * wp.randn(other)
        u = normal_part(z)
    x = quantile(t, k, u)
    if gate >= t.probability[k]:
        x = t.nominal[k]
    return x


def widened(distribution: Distribution, nominal: float, part: float) -> tuple[list[float], float]:
    """Return ends [low, high, mean, standard deviation] and probability of a distribution at a fraction of its width.

    Widths grow from the value of the range closest to the nominal one. Discrete choices, and distributions with a
    probability below 1, keep their values; their probability grows instead.

    Args:
        distribution: Distribution at its full width.
        nominal: Value if nothing is drawn, in the unit of the distribution.
        part: Fraction of the distance to both ends, of the standard deviation and of probabilities, in [0, 1].
    """
    low, high = distribution.bounds()
    mean, std = distribution.normal or (0.0, 0.0)
    if distribution.choice is not None or distribution.probability < 1.0:
        return [low, high, mean, std], distribution.probability * part
    anchor = min(max(nominal, low), high)
    if distribution.log_uniform is not None:
        down, up = (math.log(end / anchor) for end in (low, high))
        return [anchor * math.exp(part * down), anchor * math.exp(part * up), 0.0, 0.0], 1.0
    ends = [anchor + part * (low - anchor), anchor + part * (high - anchor)]
    if distribution.normal is None:
        return [*ends, 0.0, 0.0], 1.0
    return [*ends, anchor + part * (mean - anchor), part * std], 1.0


def ties_of(ranges: Ranges) -> dict[int, list[tuple[int, float]]]:
    """Return entry -> entries whose normal numbers are summed for its draw, with weights: rows of a square root of
    R."""
    rows = {}
    for group in ranges.correlated:
        values, vectors = np.linalg.eigh(np.array(group.correlation))
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        members = [INDEX[name] for name in group.entries]
        for k, row in zip(members, root, strict=True):
            rows[k] = list(zip(members, (row / np.linalg.norm(row)).tolist(), strict=True))
    return rows


def draw_table(
    drawn: Mapping[str, Distribution], nominal: NDArray[np.float64], ranges: Ranges, device: wp.Device
) -> DrawTable:
    """Return the table at full width.

    Args:
        drawn: Entry -> distribution, of the entries that vary.
        nominal: Value of every entry if nothing is drawn, in its unit, (len(ENTRIES),).
        ranges: Ranges with the correlations.
        device: Warp device of the table.
    """
    n = len(ENTRIES)
    kind, first, choices = np.zeros((3, n), np.int32)
    ends, probability = np.zeros((n, 4)), np.ones(n)
    choice, cumulative = list[float](), list[float]()
    for name, distribution in drawn.items():
        k = INDEX[name]
        kind[k] = KINDS.index(distribution.kind)
        ends[k], probability[k] = widened(distribution, float(nominal[k]), 1.0)
        first[k], choices[k] = len(choice), len(distribution.choice or ())
        choice += distribution.choice or ()
        cumulative += distribution.cumulative()
    first_tie, ties, tied, weights = _flat(ties_of(ranges), n)
    t = DrawTable()
    t.count = len(drawn)
    integer = {"drawn": [INDEX[name] for name in drawn], "kind": kind, "first_choice": first, "choices": choices,
             "stream": [e.stream for e in ENTRIES],
             "first_tie": first_tie, "ties": ties, "tied": tied}  # fmt: skip
    real = {"probability": probability, "nominal": nominal, "choice": choice, "cumulative": cumulative,
            "tie_weight": weights}  # fmt: skip
    for fields, dtype, plain in ((integer, wp.int32, np.int32), (real, wp.float32, np.float32)):
        for name, values in fields.items():
            # No kernel reads beyond the counts; one element keeps empty columns valid.
            column = np.asarray(values if len(values) else [0], dtype=plain)
            setattr(t, name, wp.array(column, dtype=dtype, device=device))
    t.ends = wp.array(ends.astype(np.float32), dtype=wp.vec4, device=device)
    return t


def _flat(rows: Mapping[int, list[tuple[int, float]]], n: int) -> tuple[Any, Any, list[int], list[float]]:
    first, count = np.zeros((2, n), np.int32)
    tied, weights = list[int](), list[float]()
    for k, row in rows.items():
        first[k], count[k] = len(tied), len(row)
        tied += [other for other, _ in row]
        weights += [weight for _, weight in row]
    return first, count, tied, weights


# Application of drawn numbers: body, thrusters, water, tether and sensors.


COLUMN = INDEX
"""Entry -> column of the drawn values."""


@wp.struct
class Nominal:
    """Nominal vehicles from their files, by vehicle, and the nominal water."""

    plant: wp.array2d(dtype=VehicleParameters)  # one world
    M_A: wp.array(dtype=mat66)  # added mass about the reference point of its coefficients [kg, kg m²]
    H: wp.array(dtype=mat66)  # twist at that point from the twist at the body origin [-, m]
    current: wp.vec3  # current of the nominal water, to which draws are added [m/s]
    waves: int  # number of nominal waves, which stay in the first slots
    sea_ratio: wp.array(
        dtype=float
    )  # frequencies of a drawn sea's waves over the peak's [-]; empty without one
    sea_turn: wp.array(dtype=float)  # directions of these waves relative to the sea's [rad]
    extra: wp.array3d(dtype=float)  # parameters of the vehicles' terms in their units, one world
    factor: wp.array(dtype=int)  # entry that multiplies each parameter, -1 for none
    added: wp.array(dtype=int)  # entry that is added to each parameter, -1 for none


@wp.func
def scaled_matrix(M: mat66, factor: vec6) -> mat66:
    """Return S M S with S = diag(sqrt(factor)): the diagonal scaled by the factors; stays symmetric and definite."""
    out = mat66()
    for i in range(6):
        for j in range(6):
            out[i, j] = M[i, j] * wp.sqrt(factor[i] * factor[j])
    return out


@wp.func
def factors(x: wp.array3d(dtype=float), w: int, v: int, column: int) -> vec6:
    """Return the common factor in `column` times the factors of the axes in the following columns."""
    out = vec6()
    for i in range(6):
        out[i] = x[w, v, column] * x[w, v, column + 1 + i]
    return out


@wp.func
def offset(x: wp.array3d(dtype=float), w: int, v: int, column: int) -> wp.vec3:
    """Return three consecutive numbers as a vector, in their unit."""
    return wp.vec3(x[w, v, column], x[w, v, column + 1], x[w, v, column + 2])


@wp.func
def drawn_delay(x: wp.array3d(dtype=float), w: int, v: int, nominal: float) -> float:
    """Return the command delay of the episode, without jitter [s]."""
    return nominal * x[w, v, wp.static(COLUMN["delay"])] + x[w, v, wp.static(COLUMN["added_delay"])]


@wp.func
def write_body(
    plant: wp.array2d(dtype=VehicleParameters), n: Nominal, x: wp.array3d(dtype=float), w: int, v: int
):
    """Write mass, centres, inertia, added mass and damping from the drawn entries x, each in its unit."""
    mass = x[w, v, wp.static(COLUMN["mass"])] * n.plant[0, v].mass
    r_n = n.plant[0, v].r_g
    r_g = r_n + offset(x, w, v, wp.static(COLUMN["center_of_gravity.x"]))
    # The factor scales the inertia about the centre of gravity; the Steiner term follows mass and centre.
    I_n = n.plant[0, v].inertia - n.plant[0, v].mass * (
        wp.dot(r_n, r_n) * wp.identity(3, dtype=float) - wp.outer(r_n, r_n)
    )
    steiner = wp.dot(r_g, r_g) * wp.identity(3, dtype=float) - wp.outer(r_g, r_g)
    plant[w, v].mass = mass
    plant[w, v].volume = (
        x[w, v, wp.static(COLUMN["volume"])] * x[w, v, wp.static(COLUMN["buoyancy"])] * n.plant[0, v].volume
    )
    plant[w, v].r_g = r_g
    plant[w, v].r_b = n.plant[0, v].r_b + offset(x, w, v, wp.static(COLUMN["center_of_buoyancy.x"]))
    plant[w, v].inertia = x[w, v, wp.static(COLUMN["inertia"])] * I_n + mass * steiner
    H = n.H[v]
    M_A = scaled_matrix(n.M_A[v], factors(x, w, v, wp.static(COLUMN["added_mass.all"])))
    plant[w, v].M_A = wp.transpose(H) * M_A * H
    plant[w, v].D1 = scaled_matrix(
        n.plant[0, v].D1, factors(x, w, v, wp.static(COLUMN["linear_damping.all"]))
    )
    plant[w, v].D2 = scaled_matrix(
        n.plant[0, v].D2, factors(x, w, v, wp.static(COLUMN["quadratic_damping.all"]))
    )
    drag = x[w, v, wp.static(COLUMN["mesh_drag"])]
    plant[w, v].form_drag = drag * n.plant[0, v].form_drag
    plant[w, v].skin_drag = drag * n.plant[0, v].skin_drag


@wp.func
def write_terms(extra: wp.array3d(dtype=float), n: Nominal, x: wp.array3d(dtype=float), w: int, v: int):
    """Write the parameters of the vehicle's terms from the drawn entries x, each in its unit, into `extra`."""
    for i in range(n.factor.shape[0]):
        y = n.extra[0, v, i]
        if n.factor[i] >= 0:
            y = y * x[w, v, n.factor[i]]
        if n.added[i] >= 0:
            y = y + x[w, v, n.added[i]]
        extra[w, v, i] = y


@wp.func
def write_thrusters(
    plant: wp.array2d(dtype=VehicleParameters), n: Nominal, x: wp.array3d(dtype=float), w: int, v: int
):
    """Write gain, lag, delay, slew and dead zone from the drawn entries x, each in its unit."""
    gain = vec8()
    lag = vec8()
    added = vec8()
    nominal_lag = n.plant[0, v].time_constant
    c_plus = n.plant[0, v].c_plus
    for k in range(MAX_THRUSTERS):
        drawn_gain = (
            x[w, v, wp.static(COLUMN["thrust.all"])]
            * x[w, v, wp.static(COLUMN["thrust.each.0"]) + k]
            * x[w, v, wp.static(COLUMN["thrust.failure.0"]) + k]
        )
        thrusts = c_plus[k] > 0.0  # not a fin or another actuator
        gain[k] = wp.where(thrusts, drawn_gain, 1.0)
        each = (
            x[w, v, wp.static(COLUMN["time_constant.all"])]
            * x[w, v, wp.static(COLUMN["time_constant.each.0"]) + k]
        )
        lag[k] = nominal_lag[k] * each + x[w, v, wp.static(COLUMN["added_time_constant"])]
        added[k] = wp.where(thrusts, x[w, v, wp.static(COLUMN["added_dead_zone"])], 0.0)
    plant[w, v].gain = gain
    plant[w, v].time_constant = lag
    plant[w, v].delay = drawn_delay(x, w, v, n.plant[0, v].delay)
    plant[w, v].slew = x[w, v, wp.static(COLUMN["slew"])] * n.plant[0, v].slew
    wider = x[w, v, wp.static(COLUMN["dead_zone"])]
    plant[w, v].dead_minus = wider * n.plant[0, v].dead_minus - added
    plant[w, v].dead_plus = wider * n.plant[0, v].dead_plus + added


@wp.func
def number_of(omega: float, depth: float, gravity: float) -> float:
    """Return the wave number [rad/m] of an angular frequency [rad/s] at a depth [m]; see `finssim.physics.water`."""
    deep = omega * omega / gravity
    k = deep / wp.sqrt(wp.tanh(deep * depth))
    for _ in range(5):
        t = wp.tanh(k * depth)
        k = k - (gravity * k * t - omega * omega) / (gravity * t + gravity * k * depth * (1.0 - t * t))
    return k


@wp.func
def write_water(water: WaterArrays, n: Nominal, x: wp.array3d(dtype=float), w: int, drift: int):
    """Write current, drift and waves of a world from the drawn entries x, each in its unit."""
    water.current[w] = n.current + wp.vec3(
        x[w, 0, wp.static(COLUMN["current.x"])],
        x[w, 0, wp.static(COLUMN["current.y"])],
        x[w, 0, wp.static(COLUMN["vertical_current"])],
    )
    if drift != 0:
        deviation = x[w, 0, wp.static(COLUMN["current_drift.deviation"])]
        water.drift_std[w] = wp.vec3(deviation, deviation, 0.0)
        water.drift_time[w] = x[w, 0, wp.static(COLUMN["current_drift.time"])]
        water.drift[w] = wp.vec3()
        water.drift_rate[w] = wp.vec3()
    scale = x[w, 0, wp.static(COLUMN["current_profile.scale"])]
    turn = x[w, 0, wp.static(COLUMN["current_profile.turn"])]
    water.profile_turn[w] = wp.vec2(scale * wp.cos(turn), scale * wp.sin(turn))
    for i in range(n.waves, water.n_waves):
        column = wp.static(COLUMN["waves.0.amplitude"]) + 4 * (i - n.waves)
        k = 6.2831853 / wp.max(x[w, 0, column + 1], 0.1)
        amplitude = x[w, 0, column]
        heading = x[w, 0, column + 2]
        if n.sea_ratio.shape[0] > 0:
            period = x[w, 0, wp.static(COLUMN["sea.period"])]
            k = number_of(n.sea_ratio[i - n.waves] * 6.2831853 / period, water.depth, water.gravity)
            amplitude = x[w, 0, wp.static(COLUMN["sea.height"])] / wp.sqrt(8.0 * float(n.sea_ratio.shape[0]))
            heading = x[w, 0, wp.static(COLUMN["sea.heading"])] + n.sea_turn[i - n.waves]
        water.wave_amplitude[w, i] = amplitude
        water.wave_number[w, i] = k
        water.wave_frequency[w, i] = wp.sqrt(water.gravity * k * wp.tanh(k * water.depth))
        water.wave_heading[w, i] = heading
        water.wave_phase[w, i] = x[w, 0, column + 3]


@wp.func
def write_tether(tether: wp.array2d(dtype=Tether), x: wp.array3d(dtype=float), w: int, v: int):
    """Write the tether of a vehicle from the drawn entries x, each in its unit."""
    tether[w, v].diameter = x[w, v, wp.static(COLUMN["tether.diameter"])]
    tether[w, v].drag_coefficient = x[w, v, wp.static(COLUMN["tether.drag_coefficient"])]
    tether[w, v].wet_weight = x[w, v, wp.static(COLUMN["tether.wet_weight"])]


@wp.func
def write_sensors(
    measurement: wp.array2d(dtype=MeasurementErrors), x: wp.array3d(dtype=float), w: int, v: int
):
    """Write noise, delay and dropouts of a controller's observations of a vehicle from entries x, each in its unit."""
    measurement[w, v].position_std = x[w, v, wp.static(COLUMN["sensors.position_std"])]
    measurement[w, v].yaw_std = x[w, v, wp.static(COLUMN["sensors.yaw_std"])]
    measurement[w, v].velocity_std = x[w, v, wp.static(COLUMN["sensors.velocity_std"])]
    measurement[w, v].rate_std = x[w, v, wp.static(COLUMN["sensors.rate_std"])]
    measurement[w, v].position_bias = x[w, v, wp.static(COLUMN["sensors.position_bias"])]
    measurement[w, v].yaw_bias = x[w, v, wp.static(COLUMN["sensors.yaw_bias"])]
    measurement[w, v].velocity_bias = x[w, v, wp.static(COLUMN["sensors.velocity_bias"])]
    measurement[w, v].rate_bias = x[w, v, wp.static(COLUMN["sensors.rate_bias"])]
    measurement[w, v].dropout = x[w, v, wp.static(COLUMN["sensors.dropout"])]
    measurement[w, v].delay = x[w, v, wp.static(COLUMN["sensors.delay"])]


if TYPE_CHECKING:
    from finssim.sim.simulator import Simulator


# Kernels that draw an episode's vehicle, water and sensors, and the delay of each command.

VEHICLE = wp.constant(122949823)
"""Offset between the random streams of two vehicles of a world, larger than any difference between two seeds."""


@wp.struct
class PrivilegedNumbers:
    """Scaled drawn numbers that agents, the first vehicles, observe as privileged information."""

    agents: int  # number of agents that observe them; 0: none
    columns: wp.array(dtype=int)  # columns of these numbers
    nominal: wp.array(dtype=float)  # nominal value in the unit of the entry
    scale: wp.array(dtype=float)  # reciprocal of the unit of scaling
    now: wp.array2d(dtype=float)  # (worlds, agents * columns), (value - nominal) * scale
    before: wp.array2d(dtype=float)  # the same numbers in the previous episode [-]


@wp.struct
class DrawnArrays:
    """Drawn numbers, and the arrays that they are written to; those of the water are separate."""

    plant: wp.array2d(dtype=VehicleParameters)
    extra: wp.array3d(dtype=float)  # parameters of the vehicles' terms in their units
    lines: wp.array2d(dtype=Tether)
    measurement: wp.array2d(dtype=MeasurementErrors)
    values: wp.array3d(dtype=float)  # in the unit of each entry, (worlds, vehicles, entries)
    volume_with_mass: int
    water: int  # 1: write the water's numbers
    drift: int
    tether: int
    sensors: int
    privileged: PrivilegedNumbers


@wp.func
def stream(seed: int, w: int) -> int:
    """Return the seed of a world's or vehicle's own random streams."""
    rng = wp.rand_init(seed, w)
    return wp.randi(rng)


@wp.func
def draw_values(t: DrawTable, d: DrawnArrays, w: int, v: int, vehicle_key: int, shared: int):
    """Draw every entry that varies."""
    for i in range(t.count):
        k = t.drawn[i]
        key = vehicle_key
        if k >= WORLD and k < WORLD_END:
            key = shared
        d.values[w, v, k] = draw_entry(t, k, key)


@wp.func
def finish_values(d: DrawnArrays, w: int, v: int):
    """Compute entries that follow from others: a volume that preserves the trim, the current's components, active
    waves."""
    x = d.values
    if d.volume_with_mass != 0:
        x[w, v, wp.static(COLUMN["volume"])] = x[w, v, wp.static(COLUMN["mass"])]
    speed = x[w, v, wp.static(COLUMN["current"])]
    direction = x[w, v, wp.static(COLUMN["current.direction"])]
    x[w, v, wp.static(COLUMN["current.x"])] = speed * wp.cos(direction)
    x[w, v, wp.static(COLUMN["current.y"])] = speed * wp.sin(direction)
    if d.water != 0:
        count = wp.floor(x[w, v, wp.static(COLUMN["waves.count"])])
        x[w, v, wp.static(COLUMN["waves.count"])] = count
        for i in range(MAX_WAVES):
            if float(i) >= count:
                x[w, v, wp.static(COLUMN["waves.0.amplitude"]) + 4 * i] = 0.0


@wp.func
def write_privileged(d: DrawnArrays, w: int, v: int):
    """Write the privileged numbers of an agent, and save those of the previous episode."""
    p = d.privileged
    size = p.columns.shape[0]
    for i in range(size):
        column = v * size + i
        p.before[w, column] = p.now[w, column]
        p.now[w, column] = (d.values[w, v, p.columns[i]] - p.nominal[i]) * p.scale[i]


@wp.kernel(enable_backward=False)
def draw_episode(
    water: WaterArrays,
    nominal: Nominal,
    table: DrawTable,
    d: DrawnArrays,
    state: State,
    seed: int,
    mask: wp.array(dtype=int),
    world_offset: int,
):
    """Draw the parameters of the episodes that start, where mask is not 0; refresh the plant afterwards.

    The draw depends only on seed, world, vehicle, episode and entry.
    """
    i, v = wp.tid()
    w = world_offset + i
    if mask[w] == 0:
        return
    episode = state.episode[w]
    draw_values(
        table,
        d,
        w,
        v,
        stream(seed + 32452843 * episode + VEHICLE * v, w),
        stream(seed + 49979687 * episode - 1, w),
    )
    finish_values(d, w, v)
    write_body(d.plant, nominal, d.values, w, v)
    write_terms(d.extra, nominal, d.values, w, v)
    write_thrusters(d.plant, nominal, d.values, w, v)
    if d.tether != 0:
        write_tether(d.lines, d.values, w, v)
    if d.sensors != 0:
        write_sensors(d.measurement, d.values, w, v)
    if d.water != 0 and v == 0:
        write_water(water, nominal, d.values, w, d.drift)
    if v < d.privileged.agents:
        write_privileged(d, w, v)


@wp.kernel(enable_backward=False)
def jitter_commands(
    plant: wp.array2d(dtype=VehicleParameters),
    nominal: Nominal,
    values: wp.array3d(dtype=float),
    state: State,
    seed: int,
    world_offset: int,
):
    """Set the delay of the next step's command: that of the episode plus a drawn fraction of the jitter."""
    i, v = wp.tid()
    w = world_offset + i
    rng = wp.rand_init(stream(seed + 86028121 * state.episode[w] + VEHICLE * v, w), state.steps[w])
    late = wp.randf(rng) * values[w, v, wp.static(COLUMN["command_jitter"])]
    plant[w, v].delay = drawn_delay(values, w, v, nominal.plant[0, v].delay) + late


# Interface of a simulation to randomisation.


class Randomization:
    """Draws a new vehicle and new water for every episode."""

    def __init__(self, ranges: Ranges | str | Path) -> None:
        """Store ranges, or load them by name or file."""
        self.ranges = ranges if isinstance(ranges, Ranges) else load_ranges(ranges)
        self.drawn = drawn_entries(self.ranges)
        """Entry of the table -> distribution, of the entries that vary."""

    def __repr__(self) -> str:
        return f"<Randomization {self.ranges.name}: draws {len(self.drawn)} numbers>"

    def _repr_html_(self) -> str:
        rows = []
        for name, distribution in self.drawn.items():
            ((kind, numbers),) = distribution.model_dump(include=set(KINDS), exclude_none=True).items()
            share = (
                f", in {distribution.probability:.0%} of the episodes"
                if distribution.probability < 1.0
                else ""
            )
            unit = ENTRIES[INDEX[name]].unit
            rows.append((name, f"{kind} {', '.join(f'{x:.4g}' for x in numbers)}{share}", unit))
        return notebook_html(f"Ranges {self.ranges.name}", ("entry", "drawn", "unit; 1: a factor"), rows)

    def at_full_width(self) -> "Randomization":
        """Return the same ranges without a schedule, at their full width, for an evaluation."""
        return Randomization(self.ranges.model_copy(update={"curriculum": None}))

    def _draws(self, *beginnings: str) -> bool:
        return any(name.startswith(beginnings) for name in self.drawn)

    @property
    def moves_water(self) -> bool:
        """True if currents or waves are drawn."""
        return self._draws("current", "vertical_current", "waves.", "sea.")

    @property
    def changes_sensors(self) -> bool:
        """True if the noise of what the controller observes is drawn."""
        return self._draws("sensors.")

    @property
    def changes_velocities(self) -> bool:
        """True if errors of the velocities that the controller observes are drawn."""
        return self._draws("sensors.velocity_", "sensors.rate_")

    def simulator_arguments(self, vehicle_delay: float, tether: TetherLine | None = None) -> dict[str, Any]:
        """Return the simulator arguments that reserve memory for everything that is drawn.

        Args:
            vehicle_delay: Longest command delay of the vehicles [s].
            tether: The given tether; if None and tethers are drawn, each vehicle has the default one.
        """
        r = self.ranges
        factor, added, jitter = (bounds_of(x)[1] for x in (r.delay, r.added_delay, r.command_jitter))
        return {
            "max_delay": vehicle_delay * max(factor, 1.0) + added + jitter,
            "max_waves": r.most_waves,
            "water_moves": self.moves_water,
            "water_drifts": self._draws("current_drift."),
            "tether": TetherLine() if tether is None and self._draws("tether.") else tether,
        }

    def draws(
        self,
        simulator: "Simulator",
        measurement: Packed | None = None,
        *,
        agents: int = 0,
        privileged: tuple[wp.array, wp.array] | None = None,
    ) -> "Draws":
        """Return the draws in the worlds of one simulator, which was created with `simulator_arguments`.

        Args:
            simulator: The worlds.
            measurement: Errors of the controllers' observations without randomisation, by (world, vehicle).
            agents: Number of agents, the first vehicles, which observe the privileged numbers.
            privileged: Arrays of the scaled privileged numbers [-] of this and of the previous episode, each (worlds,
                agents * P) with P = `len(privileged_names(...))`.
        """
        return Draws(self, simulator, measurement, agents, privileged)

    def privileged_names(self, thrusters: int) -> list[str]:
        """Return the names of the privileged numbers of an agent: the entries that vary, without directions and phases.

        Args:
            thrusters: Number of thrusters of the vehicle with the most.
        """
        names = set(drawn_entries(self.ranges, thrusters))
        names |= {"current.x", "current.y"} if "current" in names else set()
        return [e.name for e in ENTRIES if e.privileged and e.name in names]


class Draws:
    """Draws of a randomisation in the worlds of one simulator.

    Attributes:
        names: Entries that vary, in the order of the table.
        values: All entries, Warp array (worlds, vehicles, len(ENTRIES)); those that never vary are nominal.
        nominal: Nominal values of all entries, each in its unit, (len(ENTRIES),).
    """

    def __init__(
        self,
        randomization: Randomization,
        simulator: "Simulator",
        measurement: Packed | None,
        agents: int,
        privileged: tuple[wp.array, wp.array] | None,
    ) -> None:
        """Build the draws; see `Randomization.draws`."""
        self.randomization, self.simulator = randomization, simulator
        thrusters = max(len(vehicle.thrusters) for vehicle in simulator.vehicles)
        self.distributions = drawn_entries(randomization.ranges, thrusters)
        self.names = list(self.distributions)
        device, shape = simulator.device, (simulator.worlds, len(simulator.vehicles))
        self.nominal = _nominal_values(simulator, measurement)
        self.table = draw_table(self.distributions, self.nominal, randomization.ranges, device)
        full = np.broadcast_to(self.nominal.astype(np.float32), (*shape, len(ENTRIES)))
        self.values = wp.array(np.ascontiguousarray(full), dtype=wp.float32, device=device)
        self._seen = (
            measurement.array if measurement else wp.zeros((1, 1), dtype=MeasurementErrors, device=device)
        )
        profile = simulator.surroundings[0].profile
        if profile is None and any(name.startswith("current_profile.") for name in self.names):
            raise RangesError(
                "the ranges draw current_profile, and the water has none: give water with a profile"
            )
        self._nominal = _nominal_vehicles(simulator, randomization.ranges.waves)
        self._arrays = self._drawn_arrays(agents, privileged)

    def _drawn_arrays(self, agents: int, privileged: tuple[wp.array, wp.array] | None) -> DrawnArrays:
        randomization, device = self.randomization, self.simulator.device
        d, s = DrawnArrays(), self.simulator
        d.plant, d.extra, d.lines, d.measurement = s.plant.array, s.plant.extra, s.tether.array, self._seen
        d.values = self.values
        d.volume_with_mass = int(randomization.ranges.volume == "with_mass")
        d.water, d.sensors = int(randomization.moves_water), int(randomization.changes_sensors)
        d.drift, d.tether = (int(randomization._draws(f"{name}.")) for name in ("current_drift", "tether"))
        names = self.privileged_names if privileged else []
        columns = [INDEX[name] for name in names]
        p = PrivilegedNumbers()
        p.agents = agents if privileged else 0
        p.columns = wp.array(np.array(columns, np.int32), dtype=wp.int32, device=device)
        for field, values in (
            ("nominal", self.nominal[columns]),
            ("scale", [self._scale(n) for n in names]),
        ):
            setattr(p, field, wp.array(np.asarray(values, np.float32), dtype=wp.float32, device=device))
        none = wp.zeros((self.simulator.worlds, 0), dtype=wp.float32, device=device)
        p.now, p.before = privileged or (none, none)
        d.privileged = p
        return d

    @property
    def privileged_names(self) -> list[str]:
        """Names of the privileged numbers of an agent."""
        return self.randomization.privileged_names(max(len(v.thrusters) for v in self.simulator.vehicles))

    def _scale(self, name: str) -> float:
        """Return the reciprocal of the greatest deviation of an entry from its nominal value."""
        distribution = self.distributions["current" if name in ("current.x", "current.y") else name]
        nominal = float(self.nominal[INDEX[name]])
        return 1.0 / (max(abs(end - nominal) for end in distribution.bounds()) or 1.0)

    def set_width(self, part: float, names: Sequence[str]) -> None:
        """Draw entries from a fraction of their full ranges from now on, in [0, 1]."""
        ends, probability = self.table.ends.numpy().copy(), self.table.probability.numpy().copy()
        for name in names:
            k = INDEX[name]
            ends[k], probability[k] = widened(self.distributions[name], float(self.nominal[k]), part)
        self.table.ends.assign(ends)
        self.table.probability.assign(probability)

    def add(self, pipeline: KernelSequence, mask: wp.array, seed: int) -> None:
        """Append the draw for the worlds where mask (by world, int32) is not 0; refresh the plant afterwards."""
        s = self.simulator
        inputs = [s.water, self._nominal, self.table, self._arrays, s.state, seed, mask]
        pipeline.add(draw_episode, inputs, vehicles=len(s.vehicles))

    def add_step(self, pipeline: KernelSequence, seed: int) -> None:
        """Append the draw of every control step, the delay of the command, before the simulator's step."""
        if "command_jitter" in self.distributions:
            s = self.simulator
            inputs = [s.plant.array, self._nominal, self.values, s.state, seed]
            pipeline.add(jitter_commands, inputs, vehicles=len(s.vehicles))

    def numpy(self, names: Sequence[str] | None = None) -> NDArray[np.float32]:
        """Return a copy of some entries of the current episodes, or of all that vary if None: (worlds, vehicles, n).

        Each entry has its own unit.
        """
        columns = [INDEX[name] for name in (self.names if names is None else names)]
        return np.asarray(self.values.numpy()[..., columns])


def _nominal_values(simulator: "Simulator", measurement: Packed | None) -> NDArray[np.float64]:
    """Return every entry if nothing is drawn, including the values of the given tether and sensors."""
    out = np.array([entry.nominal for entry in ENTRIES])
    line = simulator.surroundings[2]
    for name in TETHER if line else ():
        out[INDEX[f"tether.{name}"]] = getattr(line, name)
    for name in SENSORS if measurement else ():
        out[INDEX[f"sensors.{name}"]] = measurement.fields[name].numpy()[0, 0]  # type: ignore[union-attr]
    return out


def _nominal_vehicles(simulator: "Simulator", waves: WaveRanges | SeaRanges | None) -> Nominal:
    device, vehicles = simulator.device, simulator.vehicles
    out = Nominal()
    plant = build_plant(vehicles, simulator.hydrodynamics, 1, [0] * len(vehicles), device)
    out.plant, out.extra = plant.array, plant.extra
    slots = layout(plant.terms)
    for field, name_of in (("factor", str), ("added", added_entry)):
        columns = [INDEX.get(name_of(slot.entry), -1) for slot in slots for _ in range(slot.size)]
        setattr(out, field, wp.array(np.array(columns, np.int32), dtype=wp.int32, device=device))
    H, M_A = [], []
    for vehicle in vehicles:
        values = vehicle_parameters(vehicle, simulator.hydrodynamics)
        shift = twist_shift(values["r_h"])
        back = np.linalg.inv(shift)
        H.append(shift)
        M_A.append(back.T @ values["M_A"] @ back)
    out.H = wp.array(np.array(H), dtype=mat66, device=device)
    out.M_A = wp.array(np.array(M_A), dtype=mat66, device=device)
    nominal = simulator.surroundings[0]
    out.current, out.waves = wp.vec3(*nominal.uniform), len(nominal.components)
    ratios, turns = np.zeros(0), np.zeros(0)
    if isinstance(waves, SeaRanges):
        ratios, turns = sea_bands(waves.spectrum, waves.peak, waves.spread, waves.components)
        turns = np.random.default_rng(1).permutation(turns)
    out.sea_ratio = wp.array(ratios, dtype=float, device=device)
    out.sea_turn = wp.array(turns, dtype=float, device=device)
    return out
