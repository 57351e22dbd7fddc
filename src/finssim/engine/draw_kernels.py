"""The kernels that draw: an episode's vehicle, water and sensors, and when each command arrives."""

import warp as wp

from finssim.engine.draw_places import (
    COLUMN,
    Nominal,
    drawn_delay,
    write_body,
    write_sensors,
    write_terms,
    write_tether,
    write_thrusters,
    write_water,
)
from finssim.engine.draw_table import DrawTable, draw_entry
from finssim.engine.measured import Measurement
from finssim.engine.ranges_file import MOST_WAVES
from finssim.engine.ranges_table import WORLD, WORLD_END
from finssim.engine.state import State
from finssim.physics.plant import VehicleParameters
from finssim.physics.tether import Tether
from finssim.physics.water import WaterArrays

VEHICLE = wp.constant(122949823)
"""Between the streams of two vehicles of a world: no seeds that people give are so far apart, so none meet there."""


@wp.struct
class DrawnArrays:
    """What was drawn, and where it goes."""

    values: wp.array3d(dtype=float)  # (worlds, vehicles, entries)
    volume_with_mass: int
    water: int  # 1: write the water's numbers
    drift: int
    tether: int
    sensors: int
    agents: int  # vehicles whose privileged numbers are told
    told: wp.array(dtype=int)  # columns of these numbers
    told_nominal: wp.array(dtype=float)
    told_scale: wp.array(dtype=float)
    privileged: wp.array2d(dtype=float)  # (worlds, agents * told), (value - nominal) * scale
    final_privileged: wp.array2d(dtype=float)  # the same of the episode before


@wp.func
def stream(seed: int, w: int) -> int:
    """The seed of a world's or vehicle's own streams."""
    rng = wp.rand_init(seed, w)
    return wp.randi(rng)


@wp.func
def draw_values(t: DrawTable, d: DrawnArrays, w: int, v: int, own: int, shared: int):
    """Every entry that varies."""
    for i in range(t.count):
        k = t.drawn[i]
        key = own
        if k >= WORLD and k < WORLD_END:
            key = shared
        d.values[w, v, k] = draw_entry(t, k, key)


@wp.func
def finish_values(d: DrawnArrays, w: int, v: int):
    """What follows from other entries: a volume that keeps the trim, the current's parts, waves beyond the count."""
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
        for i in range(MOST_WAVES):
            if float(i) >= count:
                x[w, v, wp.static(COLUMN["waves.0.amplitude"]) + 4 * i] = 0.0


@wp.func
def tell(d: DrawnArrays, w: int, v: int):
    """The privileged numbers of an agent; those of the episode that ended move aside."""
    size = d.told.shape[0]
    for i in range(size):
        column = v * size + i
        d.final_privileged[w, column] = d.privileged[w, column]
        d.privileged[w, column] = (d.values[w, v, d.told[i]] - d.told_nominal[i]) * d.told_scale[i]


@wp.kernel(enable_backward=False)
def draw_episode(
    plant: wp.array2d(dtype=VehicleParameters),
    extra: wp.array3d(dtype=float),
    tether: wp.array2d(dtype=Tether),
    seen: wp.array2d(dtype=Measurement),
    water: WaterArrays,
    nominal: Nominal,
    table: DrawTable,
    d: DrawnArrays,
    state: State,
    seed: int,
    mask: wp.array(dtype=int),
    world_offset: int,
):
    """Draw what the episode that starts has, where mask is not 0; refresh the plant afterwards.

    The draw depends on seed, world, vehicle, episode and entry alone.
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
    write_body(plant, nominal, d.values, w, v)
    write_terms(extra, nominal, d.values, w, v)
    write_thrusters(plant, nominal, d.values, w, v)
    if d.tether != 0:
        write_tether(tether, d.values, w, v)
    if d.sensors != 0:
        write_sensors(seen, d.values, w, v)
    if d.water != 0 and v == 0:
        write_water(water, nominal, d.values, w, d.drift)
    if v < d.agents:
        tell(d, w, v)


@wp.kernel(enable_backward=False)
def jitter_commands(
    plant: wp.array2d(dtype=VehicleParameters),
    nominal: Nominal,
    values: wp.array3d(dtype=float),
    state: State,
    seed: int,
    world_offset: int,
):
    """The delay of the coming step's command: the episode's, and a part of the jitter drawn for this step."""
    i, v = wp.tid()
    w = world_offset + i
    rng = wp.rand_init(stream(seed + 86028121 * state.episode[w] + VEHICLE * v, w), state.steps[w])
    late = wp.randf(rng) * values[w, v, wp.static(COLUMN["command_jitter"])]
    plant[w, v].delay = drawn_delay(values, w, v, nominal.plant[0, v].delay) + late
