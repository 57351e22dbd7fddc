"""Base class of the sensors of all vehicles of all worlds."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import warp as wp
from numpy.typing import NDArray

from finssim.sim.sensors.sampling import SensedArrays, SensedState, new_sampling
from finssim.vehicles.equipment import Sensor


class SensorError(ValueError):
    """A sensor's arguments are invalid; the message states what to change."""


class Surroundings(NamedTuple):
    """Properties of the site that a sensor's parameters may depend on, besides the vehicle's file."""

    gravity: float
    """[m/s²]"""
    density: float
    """Density of the water [kg/m³]."""
    floor_depth: float
    """Depth of the flat floor [m]; infinite if unknown."""


NUMBERS = {"imu": 1, "depth": 2, "dvl": 3, "compass": 4}
"""Number of a sensor in the key of its random numbers; for other names it is a checksum of the name."""


class SensorBatch:
    """One sensor, identified by its name in the vehicle files, for every vehicle of every world.

    Its readings are Warp arrays (W, V) at fixed addresses; `stamp` and `fresh` give their age. For a vehicle without
    the sensor they are zero, never fresh, with the stamp -1.
    """

    kind: ClassVar[str]
    """Its key under `sensors` in a vehicle file."""
    schema: ClassVar[Any] = None
    """Schema of its section in a vehicle file, derived from `vehicles.equipment.Sensor`; None for FinsSim's own
    sensors."""
    kernel: ClassVar[Any]
    """Kernel made by `sampling.sampling_kernel`."""
    readings: ClassVar[tuple[str, ...]]
    """Names of the arrays that `numpy` returns beside `stamp` and `fresh`."""

    def __init__(
        self, name: str, entries: Sequence[Any], worlds: int, control_step: float, seed: int, device: Any
    ) -> None:
        """Allocate the memory.

        Args:
            name: Name of the sensor under `sensors` in the vehicle files.
            entries: Section of this sensor in each vehicle's file, or None; only rate and latency are read here.
            worlds: Number of worlds W.
            control_step: [s]
            seed: Seed of all random numbers.
            device: Warp device.
        """
        self.name = name
        # The kernel's own structs: if a class is defined again with the same code, Warp reuses the earlier kernel.
        arguments = {argument.label: argument.type for argument in self.kernel.adj.args}
        self.parameter_struct: Any = arguments["errors"].dtype
        """Struct made by `sampling.parameters_of`."""
        self.array_struct: Any = arguments["sensor"]
        """Struct of readings, by (world, vehicle), and of rings, which have one more index."""
        self.device = device
        self.seed = seed
        self.shape = (worlds, len(entries))
        self.sampling = new_sampling(
            [0.0 if entry is None else entry.rate for entry in entries],
            [0.0 if entry is None else entry.latency for entry in entries],
            worlds,
            control_step,
            device,
        )
        self.sampling.number = NUMBERS.get(name) or zlib.crc32(name.encode()) >> 1
        self.stamp: wp.array[Any] = self.sampling.stamp
        """Time since reset at which the current reading was sampled [s], -1 before the first; float (W, V)."""
        self.fresh: wp.array[Any] = self.sampling.fresh
        """True if that reading arrived in the last update; bool (W, V)."""
        self.arrays = self._new_arrays()
        self.parameters: wp.array[Any] = wp.zeros(self.shape, dtype=self.parameter_struct, device=device)
        """Parameter structs (W, V); change them with `set`."""

    def _new_arrays(self) -> Any:
        """Allocate zeroed readings and ring buffers, each also an attribute of this object."""
        arrays = self.array_struct()
        for name, variable in self.array_struct.vars.items():
            shape = self.shape if variable.type.ndim == 2 else self.sampling.sent.shape
            array = wp.zeros(shape, dtype=variable.type.dtype, device=self.device)
            setattr(arrays, name, array)
            setattr(self, name, array)
        return arrays

    def inputs(self, state: SensedState, water_velocity: Any, mask: Any, restarting: bool) -> list[Any]:
        """Return all arguments of the kernel except the last, `world_offset`.

        Args:
            state: State to measure.
            water_velocity: World frame [m/s], vec3 (W, V), or None.
            mask: Worlds to update, int (W,).
            restarting: True if these worlds have just been reset.
        """
        truth = SensedArrays()
        for name in ("position", "quaternion", "velocity", "acceleration", "steps", "episode"):
            setattr(truth, name, getattr(state, name))
        if water_velocity is not None:
            truth.water_velocity = water_velocity
        return [truth, self.parameters, self.arrays, self.sampling, mask, restarting, self.seed]

    def use(self, vehicle: int, entry: Any, site: Surroundings) -> None:
        """Read one vehicle's parameters from its file.

        Args:
            vehicle: Index.
            entry: The sensor's section in the vehicle file, of `vehicle.sensors.by_name`.
            site: Properties of the site that parameters may depend on.
        """
        names = self.parameter_struct.vars
        values = {name: getattr(entry, name) for name in names if hasattr(entry, name)}
        self.set(vehicle, **{**values, **self.derived(entry, site)})

    def derived(self, entry: Any, site: Surroundings) -> dict[str, float]:
        """Return parameters that are not in the file or that replace those of the file; none by default.

        Each is in the unit of the kernel's parameter.
        """
        return {}

    def numpy(self) -> dict[str, NDArray[Any]]:
        """Return copies of the readings with `stamp` and `fresh`, each (W, V, ...).

        Units are those of the readings; stamps are in [s].
        """
        return {name: getattr(self, name).numpy().copy() for name in (*self.readings, "stamp", "fresh")}

    def set(self, vehicle: int | slice = slice(None), **values: Any) -> None:
        """Change parameters, for example to give each world a different sensor.

        Args:
            vehicle: Index of the vehicle; all of them by default.
            values: Values by field of the parameter struct, each broadcast over (W, V) or, for one vehicle, (W,); a
                vector has its components last. Rate and latency cannot change, since they determine the memory layout.

        Raises:
            SensorError: There is no such field.
        """
        table = self.parameters.numpy()  # type: ignore[no-untyped-call]
        for name, value in values.items():
            if name not in table.dtype.names:
                available = ", ".join(table.dtype.names)
                raise SensorError(f"no {self.kind} parameter '{name}'; available: {available}")
            table[name][:, vehicle] = value
        self.parameters.assign(table)  # type: ignore[no-untyped-call]


def check_registered(kind: str, batch: Any) -> None:
    """Refuse a registered object that is not a kind of sensor.

    Args:
        kind: Key in a vehicle file under which the object is registered.
        batch: The registered object.

    Raises:
        SensorError: It is not a `SensorBatch`, has another kind, or has no schema.
    """
    if (
        not (isinstance(batch, type) and issubclass(batch, SensorBatch))
        or getattr(batch, "kind", None) != kind
    ):
        raise SensorError(
            f"{kind} is {batch!r:.80}, expected a class derived from finssim.sim.sensors.SensorBatch "
            f"with kind = '{kind}'"
        )
    if not (isinstance(batch.schema, type) and issubclass(batch.schema, Sensor)):
        raise SensorError(
            f"sensor '{kind}' has no schema of its section in a vehicle file: derive one from "
            "finssim.vehicles.equipment.Sensor"
        )
