"""Domain randomisation: parameters drawn for every episode, inside the batch."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.engine.distributions import bounds_of
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
from finssim.engine.draw_table import DrawTable, draw_entry, draw_table, widened
from finssim.engine.launch import Pipeline
from finssim.engine.measured import SENSORS, Measurement
from finssim.engine.packed import Packed
from finssim.engine.plant_arrays import build_plant, twist_shift, vehicle_parameters
from finssim.engine.ranges_file import MAX_WAVES, Ranges, load_ranges
from finssim.engine.ranges_table import ENTRIES, INDEX, TETHER, WORLD, WORLD_END, added_entry, drawn_entries
from finssim.engine.state import State
from finssim.engine.surroundings import TetherLine
from finssim.physics.plant import VehicleParameters
from finssim.physics.terms.composed import layout
from finssim.physics.tether import Tether
from finssim.physics.types import mat66
from finssim.physics.water import WaterArrays

if TYPE_CHECKING:
    from finssim.engine.simulator import Simulator


# The kernels that draw: an episode's vehicle, water and sensors, and when each command arrives.

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
def draw_values(t: DrawTable, d: DrawnArrays, w: int, v: int, vehicle_key: int, shared: int):
    """Every entry that varies."""
    for i in range(t.count):
        k = t.drawn[i]
        key = vehicle_key
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
        for i in range(MAX_WAVES):
            if float(i) >= count:
                x[w, v, wp.static(COLUMN["waves.0.amplitude"]) + 4 * i] = 0.0


@wp.func
def write_privileged(d: DrawnArrays, w: int, v: int):
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
    measurement: wp.array2d(dtype=Measurement),
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
        write_sensors(measurement, d.values, w, v)
    if d.water != 0 and v == 0:
        write_water(water, nominal, d.values, w, d.drift)
    if v < d.agents:
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
    """The delay of the coming step's command: the episode's, and a part of the jitter drawn for this step."""
    i, v = wp.tid()
    w = world_offset + i
    rng = wp.rand_init(stream(seed + 86028121 * state.episode[w] + VEHICLE * v, w), state.steps[w])
    late = wp.randf(rng) * values[w, v, wp.static(COLUMN["command_jitter"])]
    plant[w, v].delay = drawn_delay(values, w, v, nominal.plant[0, v].delay) + late


# What a simulation is given to draw with.


class Randomization:
    """Draws a new vehicle and new water for every episode."""

    def __init__(self, ranges: Ranges | str | Path) -> None:
        """Take ranges, or the name or file of ranges."""
        self.ranges = ranges if isinstance(ranges, Ranges) else load_ranges(ranges)
        self.drawn = drawn_entries(self.ranges)
        """Entry of the table -> its distribution, of those that vary."""

    def at_full_width(self) -> "Randomization":
        """The same ranges without a schedule, for an evaluation: from the whole width at once."""
        return Randomization(self.ranges.model_copy(update={"curriculum": None}))

    def _draws(self, *beginnings: str) -> bool:
        return any(name.startswith(beginnings) for name in self.drawn)

    @property
    def moves_water(self) -> bool:
        """Whether currents or waves are drawn."""
        return self._draws("current", "vertical_current", "waves.")

    @property
    def changes_sensors(self) -> bool:
        """Whether what the controller sees is drawn."""
        return self._draws("sensors.")

    @property
    def changes_velocities(self) -> bool:
        """Whether errors of the velocities that the controller sees are drawn."""
        return self._draws("sensors.velocity_", "sensors.rate_")

    def simulator_arguments(self, vehicle_delay: float, tether: TetherLine | None = None) -> dict[str, Any]:
        """What a simulator must make room for.

        Args:
            vehicle_delay: Longest command delay of the vehicles [s].
            tether: The line that is given; where lines are drawn and none is, each vehicle gets the usual one.
        """
        r = self.ranges
        factor, added, jitter = (bounds_of(x)[1] for x in (r.delay, r.added_delay, r.command_jitter))
        return {
            "max_delay": vehicle_delay * max(factor, 1.0) + added + jitter,
            "max_waves": r.waves.count[1] if r.waves else 0,
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
        """What is drawn in the worlds of one simulator, which was made with `simulator_arguments`.

        Args:
            simulator: The worlds.
            measurement: What the controllers see of the vehicles, by (world, vehicle), as it is without randomisation.
            agents: The first vehicles, which are told what was drawn.
            privileged: Where they are told it, and where that of the episode before is kept: (worlds, agents * P) with
                P = `len(told(...))`.
        """
        return Draws(self, simulator, measurement, agents, privileged)

    def told(self, thrusters: int) -> list[str]:
        """Names of the privileged numbers of an agent: the entries that vary, without directions and phases.

        Args:
            thrusters: Of the vehicle that has most.
        """
        names = set(drawn_entries(self.ranges, thrusters))
        names |= {"current.x", "current.y"} if "current" in names else set()
        return [e.name for e in ENTRIES if e.told and e.name in names]


class Draws:
    """What a randomisation draws in the worlds of one simulator.

    Attributes:
        names: Entries that vary, in the order of the table.
        values: All entries, Warp array (worlds, vehicles, len(ENTRIES)); those that never vary are nominal.
        nominal: Of all entries, (len(ENTRIES),).
    """

    def __init__(
        self,
        randomization: Randomization,
        simulator: "Simulator",
        measurement: Packed | None,
        agents: int,
        privileged: tuple[wp.array, wp.array] | None,
    ) -> None:
        """See `Randomization.draws`."""
        self.randomization, self.simulator = randomization, simulator
        thrusters = max(len(vehicle.thrusters) for vehicle in simulator.vehicles)
        self.distributions = drawn_entries(randomization.ranges, thrusters)
        self.names = list(self.distributions)
        device, shape = simulator.device, (simulator.worlds, len(simulator.vehicles))
        self.nominal = _nominal_values(simulator, measurement)
        self.table = draw_table(self.distributions, self.nominal, randomization.ranges, device)
        full = np.broadcast_to(self.nominal.astype(np.float32), (*shape, len(ENTRIES)))
        self.values = wp.array(np.ascontiguousarray(full), dtype=wp.float32, device=device)
        self._seen = measurement.array if measurement else wp.zeros((1, 1), dtype=Measurement, device=device)
        self._nominal = _nominal_vehicles(simulator)
        self._arrays = self._drawn_arrays(agents, privileged)

    def _drawn_arrays(self, agents: int, privileged: tuple[wp.array, wp.array] | None) -> DrawnArrays:
        randomization, device = self.randomization, self.simulator.device
        d = DrawnArrays()
        d.values = self.values
        d.volume_with_mass = int(randomization.ranges.volume == "with_mass")
        d.water, d.sensors = int(randomization.moves_water), int(randomization.changes_sensors)
        d.drift, d.tether = (int(randomization._draws(f"{name}.")) for name in ("current_drift", "tether"))
        d.agents = agents if privileged else 0
        names = self.told if privileged else []
        columns = [INDEX[name] for name in names]
        d.told = wp.array(np.array(columns, np.int32), dtype=wp.int32, device=device)
        for field, values in (
            ("told_nominal", self.nominal[columns]),
            ("told_scale", [self._scale(n) for n in names]),
        ):
            setattr(d, field, wp.array(np.asarray(values, np.float32), dtype=wp.float32, device=device))
        none = wp.zeros((self.simulator.worlds, 0), dtype=wp.float32, device=device)
        d.privileged, d.final_privileged = privileged or (none, none)
        return d

    @property
    def told(self) -> list[str]:
        """Names of the privileged numbers of an agent."""
        return self.randomization.told(max(len(v.thrusters) for v in self.simulator.vehicles))

    def _scale(self, name: str) -> float:
        """One over the farthest that an entry may be from its nominal number."""
        distribution = self.distributions["current" if name in ("current.x", "current.y") else name]
        nominal = float(self.nominal[INDEX[name]])
        return 1.0 / (max(abs(end - nominal) for end in distribution.bounds()) or 1.0)

    def set_width(self, part: float, names: Sequence[str]) -> None:
        """Draw entries from a part of their full ranges from now on, in [0, 1]."""
        ends, probability = self.table.ends.numpy().copy(), self.table.probability.numpy().copy()
        for name in names:
            k = INDEX[name]
            ends[k], probability[k] = widened(self.distributions[name], float(self.nominal[k]), part)
        self.table.ends.assign(ends)
        self.table.probability.assign(probability)

    def add(self, pipeline: Pipeline, mask: wp.array, seed: int) -> None:
        """Append the draw for the worlds where mask (by world, int32) is not 0; refresh the plant afterwards."""
        s = self.simulator
        places = [s.plant.array, s.plant.extra, s.tether.array, self._seen, s.water]
        inputs = [*places, self._nominal, self.table, self._arrays, s.state, seed, mask]
        pipeline.add(draw_episode, inputs, vehicles=len(s.vehicles))

    def add_step(self, pipeline: Pipeline, seed: int) -> None:
        """Append what is drawn for every control step, before the simulator's step: when the command arrives."""
        if "command_jitter" in self.distributions:
            s = self.simulator
            inputs = [s.plant.array, self._nominal, self.values, s.state, seed]
            pipeline.add(jitter_commands, inputs, vehicles=len(s.vehicles))

    def numpy(self, names: Sequence[str] | None = None) -> NDArray[np.float32]:
        """What the running episodes have of some entries, of those that vary if None: (worlds, vehicles, n), a copy."""
        columns = [INDEX[name] for name in (self.names if names is None else names)]
        return np.asarray(self.values.numpy()[..., columns])


def _nominal_values(simulator: "Simulator", measurement: Packed | None) -> NDArray[np.float64]:
    """Every entry where nothing is drawn: the given tether's and sensors' numbers among them."""
    out = np.array([entry.nominal for entry in ENTRIES])
    line = simulator.surroundings[2]
    for name in TETHER if line else ():
        out[INDEX[f"tether.{name}"]] = getattr(line, name)
    for name in SENSORS if measurement else ():
        out[INDEX[f"sensors.{name}"]] = measurement.fields[name].numpy()[0, 0]  # type: ignore[union-attr]
    return out


def _nominal_vehicles(simulator: "Simulator") -> Nominal:
    device, vehicles = simulator.device, simulator.vehicles
    out = Nominal()
    plant = build_plant(vehicles, simulator.hydrodynamics, 1, [0] * len(vehicles), device)
    out.plant, out.extra = plant.array, plant.extra
    slots = layout(plant.terms)
    for field, name_of in (("factor", str), ("added", added_entry)):
        columns = [INDEX.get(name_of(slot.path), -1) for slot in slots for _ in range(slot.size)]
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
    out.current, out.waves = wp.vec3(*nominal.current), len(nominal.waves)
    return out
