"""All sensors of all vehicles of all worlds, sampled together after every control step."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import warp as wp

from finssim.core.registry import SENSORS
from finssim.sim.sensors.batch import SensorBatch, SensorError, Surroundings
from finssim.sim.sensors.sampling import SensedState
from finssim.vehicles import Vehicle
from finssim.vehicles.equipment import OWN_KINDS

if TYPE_CHECKING:
    from finssim.sim.sensors.compass import CompassBatch
    from finssim.sim.sensors.depth import DepthBatch
    from finssim.sim.sensors.dvl import DvlBatch
    from finssim.sim.sensors.imu import ImuBatch

Stage = tuple[Any, list[Any]]


def add_sensor(batch: type[SensorBatch]) -> type[SensorBatch]:
    """Register a kind of sensor in this process, so that vehicle files can use its `kind` as a key.

    An installed package registers it by an entry point instead; see `finssim.core.registry`.

    Args:
        batch: Class with `kind`, the `schema` of its section in a vehicle file, a kernel and `readings`.

    Raises:
        RegistryError: Another sensor of that kind exists.
        SensorError: The class is not a `SensorBatch`, or has no schema.
    """
    SENSORS[batch.kind] = batch
    return batch


class SensorSuite:
    """The sensors that the vehicle files list, for W worlds of V vehicles.

    Call `reset` after a reset of worlds and `update` after every control step, or record their stages. Sensors sample
    at the ends of control steps, each at its own rate: a slower sensor holds its last reading, a faster one returns the
    newest of the samples within the step. All random numbers are keyed on (seed, sensor, world, vehicle, episode,
    step), so they depend neither on the number of worlds nor on the slicing of launches.
    """

    imu: ImuBatch | None
    """IMUs; None if no vehicle has one. The same applies to the other sensors."""
    depth: DepthBatch | None
    dvl: DvlBatch | None
    compass: CompassBatch | None

    def __init__(
        self,
        vehicles: Vehicle | Sequence[Vehicle],
        *,
        worlds: int,
        control_step: float,
        seed: int = 0,
        device: Any = "cpu",
        gravity: float | None = None,
        density: float | None = None,
        floor_depth: float | None = None,
    ) -> None:
        """Allocate the memory of all sensors.

        Args:
            vehicles: The V vehicles of every world.
            worlds: Number of worlds W.
            control_step: Time between updates [s].
            seed: Seed of all noise; 0 to 2³¹ - 1.
            device: Warp device of the state arrays.
            gravity: [m/s²]; each vehicle file's own if not given.
            density: Density of the water [kg/m³]; each vehicle file's own if not given.
            floor_depth: Depth of the flat floor, for the range of a DVL [m]; if not given the floor is always in range.

        Raises:
            SensorError: A number is out of range, or vehicles have sensors of one name and different kinds.
        """
        if worlds < 1:
            raise SensorError(f"worlds is {worlds}, expected at least 1")
        if not 0.0 < control_step < math.inf:
            raise SensorError(f"control_step is {control_step}, expected a positive time in seconds")
        if not 0 <= seed < 2**31:
            raise SensorError(f"seed is {seed}, expected 0 to 2147483647")
        vehicles = (vehicles,) if isinstance(vehicles, Vehicle) else tuple(vehicles)
        self.worlds, self.vehicles = worlds, len(vehicles)
        self.device = device
        self._everywhere = wp.full(worlds, 1, dtype=int, device=device)

        self.by_name: dict[str, SensorBatch] = {
            name: SENSORS[kind](
                name,
                [vehicle.sensors.by_name.get(name) for vehicle in vehicles],
                worlds,
                control_step,
                seed,
                device,
            )
            for name, kind in _kinds(vehicles).items()
        }
        """Sensors that at least one vehicle carries, by their names in the vehicle files."""
        for name in OWN_KINDS:
            setattr(self, name, self.by_name.get(name))
        for v, vehicle in enumerate(vehicles):
            site = Surroundings(
                gravity=vehicle.water.gravity if gravity is None else gravity,
                density=vehicle.water.density if density is None else density,
                floor_depth=math.inf if floor_depth is None else floor_depth,
            )
            for name, entry in vehicle.sensors.by_name.items():
                self.by_name[name].use(v, entry, site)

    @property
    def batches(self) -> tuple[SensorBatch, ...]:
        """Sensors that at least one vehicle carries."""
        return tuple(self.by_name.values())

    def update_stages(self, state: SensedState, water_velocity: Any = None) -> list[Stage]:
        """Return the launches of `update`, for a program that records its launches.

        Each stage is a kernel over (worlds of a slice, vehicles) and all its arguments except the last, `world_offset`.
        Slices write to disjoint memory, so each thread may run its own.

        Args:
            state: State to measure, at the end of a control step, with `steps` already incremented. Its arrays are
                recorded: keep them in place.
            water_velocity: Velocity of the water at each vehicle, world frame [m/s], vec3 (W, V), for DVLs in water
                track; if not given they are in bottom track.
        """
        return [(b.kernel, b.inputs(state, water_velocity, self._everywhere, False)) for b in self.batches]

    def reset_stages(self, state: SensedState, mask: Any = None, water_velocity: Any = None) -> list[Stage]:
        """Return the launches of `reset`, in the same form.

        Args:
            state: Initial state of the episode, with `episode` already incremented.
            mask: Nonzero for the worlds to reset, int (W,); all if not given.
            water_velocity: As for `update_stages`.
        """
        mask = self._everywhere if mask is None else mask
        return [(b.kernel, b.inputs(state, water_velocity, mask, True)) for b in self.batches]

    def launches(
        self, state: SensedState, world_offset: int = 0, count: int | None = None, water_velocity: Any = None
    ) -> list[Any]:
        """Return recorded Warp launches of `update_stages` for `count` worlds from `world_offset` on (all by
        default)."""
        dim = (self.worlds - world_offset if count is None else count, self.vehicles)
        return [
            wp.launch(kernel, dim=dim, inputs=[*inputs, world_offset], device=self.device, record_cmd=True)
            for kernel, inputs in self.update_stages(state, water_velocity)
        ]

    def update(self, state: SensedState, water_velocity: Any = None) -> None:
        """Take all samples that were due in the last control step; arguments as for `update_stages`.

        In a world whose `steps` have not increased, readings are unchanged and no longer fresh.
        """
        self._run(self.update_stages(state, water_velocity))

    def reset(self, state: SensedState, mask: Any = None, water_velocity: Any = None) -> None:
        """Start an episode: draw the turn-on errors and sample every sensor once; arguments as for `reset_stages`.

        This first reading has no latency and is never dropped, as if the sensors had been running before.
        """
        self._run(self.reset_stages(state, mask, water_velocity))

    def _run(self, stages: list[Stage]) -> None:
        for kernel, inputs in stages:
            wp.launch(kernel, dim=(self.worlds, self.vehicles), inputs=[*inputs, 0], device=self.device)


def _kinds(vehicles: Sequence[Vehicle]) -> dict[str, str]:
    """Return name -> kind of all sensors of some vehicles."""
    kinds: dict[str, str] = {}
    for vehicle in vehicles:
        for name in vehicle.sensors.by_name:
            kind = vehicle.sensors.kind_of(name)
            if kinds.setdefault(name, kind) != kind:
                raise SensorError(
                    f"sensor '{name}' of {vehicle.name} is of the kind {kind}, that of another vehicle "
                    f"{kinds[name]}: give them different names"
                )
    return dict(sorted(kinds.items(), key=lambda item: _order(item[0])))


def _order(name: str) -> tuple[int, str]:
    """Return the sort key of a sensor: FinsSim's own sensors first, in their order."""
    return ([*OWN_KINDS].index(name) if name in OWN_KINDS else len(OWN_KINDS), name)
