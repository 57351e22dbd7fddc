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
    """Make a kind of sensor known to this program: vehicle files may then have it under its `kind`.

    An installed package registers it by an entry point instead; see `finssim.core.registry`.

    Args:
        batch: Class with `kind`, the `schema` of its section in a vehicle file, a kernel and `readings`.

    Raises:
        RegistryError: There is another sensor of that kind.
        SensorError: It is no `SensorBatch`, or has no schema.
    """
    SENSORS[batch.kind] = batch
    return batch


class SensorSuite:
    """The sensors that the vehicle files list, for W worlds of V vehicles.

    Call `reset` after worlds were reset and `update` after every control step, or record their stages. Sensors sample
    at the ends of control steps, each at its own rate: a slower sensor holds its last reading, a faster one gives the
    newest of the samples that fell into the step. All randomness is keyed on (seed, sensor, world, vehicle, episode,
    step), so it does not depend on how many worlds there are or how they are sliced over launches.
    """

    imu: ImuBatch | None
    """None where no vehicle has one, and so for the others."""
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
        """Lay out the memory of all sensors.

        Args:
            vehicles: The V vehicles of every world.
            worlds: Number of worlds W.
            control_step: Time between updates [s].
            seed: Of all noise; 0 to 2³¹ - 1.
            device: Warp device of the state arrays.
            gravity: [m/s²]; each vehicle file's own if not given.
            density: Of the water [kg/m³]; each vehicle file's own if not given.
            floor_depth: Depth of the flat floor, for the reach of a DVL [m]; if not given the floor is always in reach.

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

        Each stage is a kernel over (worlds of a slice, vehicles) and all its arguments but the last, `world_offset`.
        Slices share nothing that is written, so threads may each run their own.

        Args:
            state: What to measure, at the end of a control step, with `steps` already counted up. Its arrays are
                recorded: keep them in place.
            water_velocity: Velocity of the water at each vehicle, world frame [m/s], vec3 (W, V): DVLs then track the
                water. If not given they track the floor.
        """
        return [(b.kernel, b.inputs(state, water_velocity, self._everywhere, False)) for b in self.batches]

    def reset_stages(self, state: SensedState, mask: Any = None, water_velocity: Any = None) -> list[Stage]:
        """Return the launches of `reset`, in the same form.

        Args:
            state: The state that the episode starts from, with `episode` already counted up.
            mask: Worlds to reset, those where it is not 0, int (W,); all if not given.
            water_velocity: As for `update_stages`.
        """
        mask = self._everywhere if mask is None else mask
        return [(b.kernel, b.inputs(state, water_velocity, mask, True)) for b in self.batches]

    def launches(
        self, state: SensedState, world_offset: int = 0, count: int | None = None, water_velocity: Any = None
    ) -> list[Any]:
        """Recorded Warp launches of `update_stages` for `count` worlds from `world_offset` on (all by default)."""
        dim = (self.worlds - world_offset if count is None else count, self.vehicles)
        return [
            wp.launch(kernel, dim=dim, inputs=[*inputs, world_offset], device=self.device, record_cmd=True)
            for kernel, inputs in self.update_stages(state, water_velocity)
        ]

    def update(self, state: SensedState, water_velocity: Any = None) -> None:
        """Sample whatever fell due in the control step that just ended; arguments as for `update_stages`.

        A world whose `steps` have not moved on keeps its readings, and they are no longer fresh.
        """
        self._run(self.update_stages(state, water_velocity))

    def reset(self, state: SensedState, mask: Any = None, water_velocity: Any = None) -> None:
        """Start an episode: draw the turn-on errors and read every sensor once; arguments as for `reset_stages`.

        This first reading arrives at once, whatever the latency, and is never dropped: the sensors were running before.
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
    """Return the place of a sensor: those of FinsSim come first, in their order."""
    return ([*OWN_KINDS].index(name) if name in OWN_KINDS else len(OWN_KINDS), name)
