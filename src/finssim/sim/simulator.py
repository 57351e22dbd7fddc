"""The batched simulator: worlds × vehicles, stepped together by one kernel."""

import difflib
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from finssim.control.allocation import Allocator
from finssim.core.files import atomic_write
from finssim.core.page import notebook_html
from finssim.core.quiet import start_warp
from finssim.physics.contact import PoolWalls
from finssim.physics.funnel import Funnel
from finssim.physics.hydrodynamics import HYDRODYNAMICS
from finssim.physics.hydrodynamics.mesh import HullMesh, hull_mesh
from finssim.physics.lanes import GROUP
from finssim.physics.plant import VehicleCommand, refresh_plant
from finssim.physics.solids import Solids
from finssim.physics.terms.composed import composed
from finssim.physics.tether import Tether
from finssim.physics.types import MAX_THRUSTERS
from finssim.physics.water import advance_drift
from finssim.sim.launch import KernelSequence
from finssim.sim.midpoint import WALL_STEP
from finssim.sim.packed import Packed
from finssim.sim.plant_arrays import SimulatorError, build_plant
from finssim.sim.site import Dock, RectangularPool, TetherLine
from finssim.sim.solids import WorldSolids, layout_of, pool_of, refresh_clearing
from finssim.sim.state import HISTORY, State, VehicleState, clear_actuators, new_state
from finssim.sim.step import MOST_PARTS, Features, SimSurroundings, Vehicles, physics_kernel, tick
from finssim.sim.water import Water
from finssim.vehicles import Vehicle, load_vehicle
from finssim.vehicles.vehicle import ReferenceWater as Fluid

INTEGRATORS = ("midpoint", "rk4")


class Simulator:
    """Many equal worlds, each with the same vehicles, in one batch.

    Attributes:
        state: Warp arrays by (world, vehicle); see `State`.
        command: Commands of thrusters [N] and other actuators, and disturbance wrenches; write them before `step`.
        plant: Parameters by (world, vehicle); call `refresh` after writing any of them.
        water: Water by world.
        funnel: Poses of the docks, and the contact forces on them, by world.
        world: The described world, whose `draw` moves its solids; None without one.
        solids: Solids of that world; `solids.force` is the greatest force on each vehicle in the last control step [N],
            float (worlds, vehicles).
        tether: Tethers by (world, vehicle).
    """

    def __init__(
        self,
        vehicles: Vehicle | str | Sequence[Vehicle | str],
        *,
        worlds: int = 1,
        hydrodynamics: str = "calibrated",
        control_step: float = 0.1,
        substeps: int = 4,
        integrator: str = "midpoint",
        water: Water | None = None,
        pool: RectangularPool | None = None,
        tether: TetherLine | None = None,
        dock: Dock | None = None,
        world: Any = None,
        device: str = "cpu",
        threads: int | None = None,
        seed: int = 0,
        max_delay: float | None = None,
        max_waves: int = 0,
        water_moves: bool = False,
        water_drifts: bool = False,
    ) -> None:
        """Set up the worlds.

        Set up the worlds.

        Args:
            vehicles: One vehicle or several, each a `Vehicle`, a catalogue name or a file.
            worlds: Number of worlds.
            hydrodynamics: Key of `HYDRODYNAMICS`: calibrated, mesh or simplified.
            control_step: Time between commands [s].
            substeps: Physics steps in a control step.
            integrator: `midpoint` or `rk4`; both are of order 2 for vehicles whose thrusters lag.
            water: Currents and waves; still water if None.
            pool: Walls and floor; open water if None.
            tether: Tether of every vehicle; none if None.
            dock: One in every world, in contact with any vehicle; none if None.
            world: Site that vehicles start in and collide with: a name of `finssim worlds`, a path, or a `World`,
                `WorldLayout` or `WorldBatch` (of as many worlds) of `finssim.extensions.perception`. Its basin is the
                pool.
            device: Warp device, `cpu` or `cuda`.
            threads: Threads on a CPU; all processors if None.
            seed: Seed of all random numbers in the worlds.
            max_delay: Longest thruster delay that randomisation may set [s]; twice the vehicles' own if None.
            max_waves: Number of randomised waves to reserve memory for, besides those of `water`.
            water_moves: Simulate moving water even if `water` is still, for a caller that writes currents or waves.
            water_drifts: Let currents drift by world even if those of `water` do not, for a caller that writes the
                drift.

        Raises:
            SimulatorError: A name is unknown or a number out of range; the message states which.
        """
        vehicles_or_names = [vehicles] if isinstance(vehicles, Vehicle | str) else list(vehicles)
        self.vehicles = [load_vehicle(v) for v in vehicles_or_names]
        self.hydrodynamics = checked_choice(hydrodynamics, tuple(HYDRODYNAMICS), "hydrodynamic model")
        self.integrator = checked_choice(integrator, INTEGRATORS, "integrator")
        for name, count in (("worlds", worlds), ("substeps", substeps), ("vehicles", len(self.vehicles))):
            if count < 1:
                raise SimulatorError(f"{name} is {count}, expected at least 1")
        if not (math.isfinite(control_step) and control_step > 0.0):
            raise SimulatorError(f"control_step is {control_step} s, expected a finite time above 0 s")
        if threads is not None and threads < 1:
            raise SimulatorError(f"threads is {threads}, expected at least 1")
        self.worlds, self.control_step, self.substeps, self.seed = worlds, control_step, substeps, seed
        self.device = find_device(device)
        self._drifts = water_drifts or (water is not None and water.drifting)
        self.world = None if world is None else layout_of(world, worlds, self.device)
        if self.world is not None:
            if pool is not None:
                raise SimulatorError(
                    "pool and world are given: leave pool out, the world's basin is the pool"
                )
            pool = pool_of(self.world.world)
        self._surround(water or Water(), pool, tether, max_waves, water_moves or water_drifts)
        self._hulls()
        n = len(self.vehicles)
        self.dock = dock
        self.funnel = dock.struct(worlds, n, self.device) if dock else Funnel()
        self.plant = build_plant(self.vehicles, hydrodynamics, worlds, self._hull_index, self.device)
        self._solids = None
        if self.world is not None:
            lightest = min(float(np.diag(v.mass_matrix(hydrodynamics))[:3].min()) for v in self.vehicles)
            solids = WorldSolids(self.world, n, lightest)
            self._solids = solids if solids.count else None
        self.solids = self._solids.struct if self._solids is not None else Solids()
        self.command = Packed(VehicleCommand, (worlds, n), self.device)
        longest = 2.0 * float(self.plant.delay.numpy().max()) if max_delay is None else max_delay
        slots = math.ceil(longest / control_step) + 2
        self.state = new_state(Packed(VehicleState, (worlds, n), self.device), slots)
        self._shared = wp.zeros(1, dtype=wp.int32, device=self.device)
        self._drawn = False
        self._all = wp.ones(worlds, dtype=wp.int32, device=self.device)
        self._mask = wp.zeros(worlds, dtype=wp.int32, device=self.device)
        self._threads = threads
        self._reset_all = self.pipeline()
        self.add_reset(self._reset_all, self._all)
        self._reset_some = self.pipeline()
        self.add_reset(self._reset_some, self._mask)
        self._step = self.pipeline()
        self.add_step(self._step)
        self._reported: set[tuple[int, int]] = set()
        self._allocators: list[Allocator] = []
        self.refresh()
        start: Any = (0.0, 0.0, -0.5 * (pool.depth if pool else 1.0))
        self.place(position=start if self.world is None else self.world.world.viewpoint.position)

    def _surround(
        self,
        water: Water,
        pool: RectangularPool | None,
        tether: TetherLine | None,
        max_waves: int,
        moves: bool,
    ) -> None:
        fluid = shared_water(self.vehicles)
        if pool is not None and water.depth is None:
            water = replace(water, depth=pool.depth)
        self.surroundings = (water, pool, tether)
        self.water = water.arrays(self.worlds, fluid.density, fluid.gravity, self.device, max_waves)
        self.water.moving = int(moves or bool(self.water.moving))
        self.walls = pool.walls() if pool else PoolWalls()
        self.tether = Packed(Tether, (self.worlds, len(self.vehicles)), self.device)
        self.tether.array.fill_(tether.struct() if tether else Tether())

    def _hulls(self) -> None:
        meshes: list[tuple[NDArray[Any], NDArray[Any]]] = []
        self._hull_index = [0] * len(self.vehicles)
        if self.hydrodynamics == "mesh":
            for i, vehicle in enumerate(self.vehicles):
                self._hull_index[i] = i
                meshes.append(vehicle.hull_mesh())
        self.hull = hull_mesh(meshes, self.device) if meshes else HullMesh()

    def pipeline(self) -> KernelSequence:
        """Return an empty pipeline over the simulator's worlds, for a caller that adds kernels before or after the
        step."""
        return KernelSequence(self.worlds, self.device, self._threads)

    def add_step(self, pipeline: KernelSequence) -> None:
        """Append the kernels of one control step."""
        if self._drifts:
            s = self.state
            pipeline.add(advance_drift, [self.water, s.steps, self.control_step, self.seed, s.episode])
        if self._solids is not None:
            inputs = [self.state, self.solids, self.plant.array, self.control_step]
            pipeline.add(refresh_clearing, inputs, len(self.vehicles))
        # One world at a time on a processor: absent features cost less than compiling another kernel.
        general = self.device.is_cpu and not self.in_lanes
        walls = general or self.surroundings[1] is not None
        parts = math.ceil(self.control_step / self.substeps / WALL_STEP - 1e-4)
        features = Features(
            self.hydrodynamics,
            self.integrator,
            water_moving=general or bool(self.water.moving),
            walls=walls,
            tether=general or self.surroundings[2] is not None,
            speed_lag=general or bool(self.plant.speed_lag.numpy().any()),
            terms=self.plant.terms,
            funnel=self.dock is not None,
            solids=self._solids is not None,
            play=bool(self.plant.play.numpy().any()),
            lanes=self.in_lanes,
            # More parts would make a kernel that compiles slowly: a world near a wall is then stepped separately.
            parts=parts if self.in_lanes and walls and parts <= MOST_PARTS else 1,
        )
        machines, around = Vehicles(), SimSurroundings()
        machines.command, machines.plant = self.command.array, self.plant.array
        machines.extra, machines.shared = self.plant.extra, self._shared
        machines.branch_bits = self.branch_bits = wp.zeros(
            self.plant.array.shape, dtype=wp.int32, device=self.device
        )
        around.hull, around.water, around.tether = self.hull, self.water, self.tether.array
        for name in ("walls", "funnel", "solids"):
            setattr(around.obstacles, name, getattr(self, name))
        inputs = [self.state, machines, around, self.control_step, self.substeps]
        pipeline.add(physics_kernel(features), inputs, len(self.vehicles), GROUP if self.in_lanes else None)
        pipeline.add(tick, [self.state])

    @property
    def in_lanes(self) -> bool:
        """True if blocks of worlds are stepped together: on a CPU, with features that the traced code supports."""
        traceable = self.integrator == "midpoint"
        # A moving mass changes the mass matrix, whose inversion needs double precision: one world at a time.
        traceable = traceable and composed(self.plant.terms, "shift") is None
        return self.device.is_cpu and traceable and not self.water.moving and self.dock is None

    def add_reset(self, pipeline: KernelSequence, mask: wp.array) -> None:
        """Append the kernels that reset motors and clocks, where mask (by world, int32) is not 0."""
        pipeline.add(clear_actuators, [self.state, mask])

    def add_refresh(self, pipeline: KernelSequence, mask: wp.array) -> None:
        """Append the kernel that recomputes derived parameters of randomised worlds, where mask is not 0."""
        self._drawn = True
        self._shared.zero_()
        self._add_refresh(pipeline, mask)

    def _add_refresh(self, pipeline: KernelSequence, mask: wp.array) -> None:
        h = self.control_step / self.substeps
        pipeline.add(refresh_plant, [self.plant.array, h, mask], vehicles=len(self.vehicles))

    def __repr__(self) -> str:
        names = ", ".join(vehicle.name for vehicle in self.vehicles)
        return (
            f"<Simulator: {self.worlds} worlds of {names} ({self.hydrodynamics}), {self.control_step:g} s in "
            f"{self.substeps} substeps, {self.device}>"
        )

    def _repr_html_(self) -> str:
        water, pool, _ = self.surroundings
        steps = self.state.steps.numpy()
        rows = [
            ("hydrodynamics", f"{self.hydrodynamics}, {self.integrator}"),
            ("step", f"{self.control_step:g} s in {self.substeps} substeps, on {self.device}"),
            ("current", " ".join(f"{speed:g}" for speed in water.current) + " m/s"),
            (
                "basin",
                f"{pool.length:g} by {pool.width:g} m, {pool.depth:g} m deep" if pool else "open water",
            ),
            ("time", f"{steps.min() * self.control_step:g} to {steps.max() * self.control_step:g} s"),
        ]
        for vehicle, position, nu in zip(
            self.vehicles, self.numpy("position")[0], self.numpy("velocity")[0], strict=True
        ):
            where = " ".join(f"{x:.3f}" for x in position)
            speed = float(np.linalg.norm(nu[:3]))
            rows.append((f"{vehicle.name} of world 0", f"at {where} m, {speed:.3f} m/s"))
        return notebook_html(f"{self.worlds} worlds", ("", ""), rows)

    def step(self) -> None:
        """Advance every world by one control step under `command`."""
        self._step.run()

    def set_control_step(self, control_step: float, substeps: int, elapsed: float) -> None:
        """Change the time between commands during a run; poses and motors are kept.

        Args:
            control_step: New time between commands [s].
            substeps: Physics steps in a control step.
            elapsed: Time since the reset [s]; clocks, and with them the waves, are set to it.

        Raises:
            SimulatorError: The delay line is too short for the smaller step (see `max_delay`).
        """
        self.control_step, self.substeps = control_step, substeps
        self.state.steps.fill_(round(elapsed / control_step))
        self._step = self.pipeline()
        self.add_step(self._step)
        self.refresh()

    def refresh(self) -> None:
        """Recompute what depends on `plant` (mass matrix inverses, lag coefficients) after writing to it.

        Raises:
            SimulatorError: A delay is longer than the delay line.
        """
        longest = float(self.plant.delay.numpy().max())
        if longest > (self.state.commands.shape[2] - 2) * self.control_step + 1e-6:
            raise SimulatorError(
                f"thruster delay {longest:.6g} s exceeds the delay line; give max_delay={longest:.6g}"
            )
        pipeline = self.pipeline()
        self._add_refresh(pipeline, self._all)
        pipeline.run()
        self.compare_worlds()

    def compare_worlds(self) -> None:
        """Check whether all worlds have equal parameters, which are then read once; never the case if some are
        randomised."""
        if self.in_lanes:
            arrays = [self.plant.array] + [self.plant.extra] * bool(self.plant.terms)
            rows = [array.numpy().view(np.uint8).reshape(self.worlds, -1) for array in arrays]
            self._shared.fill_(int(not self._drawn and all(bool((r == r[0]).all()) for r in rows)))

    def reset(self, mask: ArrayLike | None = None) -> None:
        """Stop the motors, empty the delay lines and set the clocks to zero; pose and velocity stay.

        Args:
            mask: Worlds to reset, bool by world; all if None. A frozen world moves again after its pose is set.
        """
        if mask is None:
            self._reset_all.run()
            return
        self._mask.assign(np.asarray(mask, dtype=np.int32))
        self._reset_some.run()

    def place(
        self,
        position: ArrayLike = (0.0, 0.0, 0.0),
        quaternion: ArrayLike = (0.0, 0.0, 0.0, 1.0),
        velocity: ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    ) -> None:
        """Set the pose and velocity of every vehicle and reset all worlds.

        Args:
            position: Position of the body origin, world frame [m], shape broadcastable to (worlds, vehicles, 3).
            quaternion: Body to world, xyzw, broadcastable to (..., 4).
            velocity: nu, body frame [m/s, rad/s], broadcastable to (..., 6).

        Raises:
            SimulatorError: A number is not finite, a quaternion has length 0, or a shape does not fit.
        """
        shape = (self.worlds, len(self.vehicles))
        values = {"position": position, "quaternion": quaternion, "velocity": velocity}
        for name, value in values.items():
            getattr(self.state, name).assign(placed_at(name, value, shape))
        self.reset()

    def numpy(self, name: str) -> NDArray[Any]:
        """Return a field of `state` as NumPy; on a CPU a view that shares memory, on a GPU a copy."""
        return self._field(name).numpy()

    def torch(self, name: str) -> Any:
        """Return a field of `state` as a torch tensor that shares memory on its device."""
        return wp.to_torch(self._field(name), requires_grad=False)

    def _field(self, name: str) -> Any:
        """Return the array of a field of `state`."""
        return getattr(self.state, checked_choice(name, tuple(State.vars), "field of the state"))

    def set_thrust(self, force: ArrayLike) -> None:
        """Command thruster forces.

        Args:
            force: Forces along the thrusters' axes [N], shape broadcastable to (worlds, vehicles, n), n thrusters in
                the vehicle's order; for vehicles with fewer thrusters, the last numbers are ignored.

        Raises:
            SimulatorError: The shape is wrong or a number is not finite.
        """
        table = thrust_table(force, self.vehicles, self.worlds)
        for i, vehicle in enumerate(self.vehicles):
            if vehicle.actuators:  # other actuators keep their commands
                table[:, i, len(vehicle.thrusters) :] = self.numpy_command()[:, i, len(vehicle.thrusters) :]
        self.command.thrust.assign(table)

    def numpy_command(self) -> NDArray[np.float32]:
        """Return a copy of the commands by channel, (worlds, vehicles, 8): thrusts [N], others in their unit."""
        return np.array(self.command.thrust.numpy())

    def set_actuators(self, values: ArrayLike) -> None:
        """Command every actuator: thrusters and others.

        Args:
            values: One number per channel, in the order of `Vehicle.channel_names`: static thrust [N] of a thruster,
                angle [rad], volume [m³] or position [m] of another; shape broadcastable to (worlds, vehicles, n), n
                channels of the vehicle with the most. For vehicles with fewer, the last numbers are ignored.

        Raises:
            SimulatorError: The shape is wrong or a number is not finite.
        """
        n = max(len(vehicle.channel_names) for vehicle in self.vehicles)
        table = np.zeros((self.worlds, len(self.vehicles), MAX_THRUSTERS), dtype=np.float32)
        table[..., :n] = self._by_vehicle(values, n, "actuator command")
        self.command.thrust.assign(table)

    def set_wrench(self, wrench: ArrayLike) -> None:
        """Command the thruster forces closest to a wrench within the thrusters' limits (paper, eq. 18).

        Args:
            wrench: Body frame, about each vehicle's `wrench_reference` [N, N m], shape broadcastable to
                (worlds, vehicles, 6).

        Raises:
            SimulatorError: The shape is wrong or a number is not finite.
        """
        wanted = self._by_vehicle(wrench, 6, "wrench command")
        forces = np.zeros((*wanted.shape[:2], self._most_thrusters), dtype=np.float32)
        if not self._allocators:
            self._allocators = [Allocator.from_vehicle(vehicle) for vehicle in self.vehicles]
        for i, allocator in enumerate(self._allocators):
            forces[:, i, : allocator.thrusters] = allocator.allocate(wanted[:, i])
        self.set_thrust(forces)

    def set_pwm(self, pulse: ArrayLike, voltage: float | None = None) -> None:
        """Command the steady-state thruster forces of pulse widths, by the characteristic of the speed controllers.

        Args:
            pulse: Pulse widths [µs], shape broadcastable to (worlds, vehicles, n), n thrusters in the vehicle's order;
                0 is no signal and stops a motor. For vehicles with fewer thrusters, the last numbers are ignored.
            voltage: Voltage of the battery [V]; the nominal voltage of the speed controller if None.

        Raises:
            SimulatorError: The shape is wrong or a number is not finite.
            VehicleError: A thruster in the vehicle file has no speed controller (`esc`).
        """
        pulses = self._by_vehicle(pulse, self._most_thrusters, "pulse command")
        forces = np.zeros(pulses.shape, dtype=np.float32)
        for i, vehicle in enumerate(self.vehicles):
            for k, thruster in enumerate(vehicle.thrusters.values()):
                forces[:, i, k] = thruster.thrust(thruster.shaft_speed(pulses[:, i, k], voltage))
        self.set_thrust(forces)

    @property
    def _most_thrusters(self) -> int:
        return max(len(vehicle.thrusters) for vehicle in self.vehicles)

    def _by_vehicle(self, values: ArrayLike, n: int, label: str) -> NDArray[np.float64]:
        """Return n finite numbers for every world and vehicle."""
        array = np.asarray(values, dtype=np.float64)
        if not np.isfinite(array).all():
            raise SimulatorError(f"{label} has a number that is not finite")
        return np.array(broadcast(array, (self.worlds, len(self.vehicles), n), label))

    def restart_episodes(self, mask: ArrayLike | None = None) -> None:
        """Restart the episode count, so that the random streams repeat: where mask is true, everywhere if None."""
        if mask is None:
            self.state.episode.zero_()
        else:
            self.state.episode.assign(
                np.where(np.asarray(mask), 0, self.state.episode.numpy()).astype(np.int32)
            )
        self._reported.clear()

    def frozen_worlds(self) -> NDArray[np.int64]:
        """Return the worlds that are frozen because a number stopped being finite."""
        return np.flatnonzero(self.state.frozen.numpy())

    def report_frozen(self, directory: Path, most: int | None = None) -> list[Path]:
        """Write the last 50 states of every newly frozen world to a CSV file.

        Args:
            directory: Folder of the files; created if missing.
            most: Greatest number of files to write; all if None.

        Returns:
            Paths of the files.
        """
        episode = self.state.episode.numpy()
        new = [w for w in self.frozen_worlds() if (int(w), int(episode[w])) not in self._reported]
        self._reported |= {(int(w), int(episode[w])) for w in new}
        return [write_post_mortem(self, int(w), directory) for w in new[:most]]


# Validation of a simulator's arguments: names, devices, vehicles of one world.


def checked_choice(value: str, available: Sequence[str], kind: str) -> str:
    """Return the value if it is available; otherwise raise an error that lists the available ones."""
    if value not in available:
        close = difflib.get_close_matches(value, available, n=1)
        hint = f"; did you mean '{close[0]}'?" if close else ""
        raise SimulatorError(f"unknown {kind} '{value}'; available: {', '.join(sorted(available))}{hint}")
    return value


def find_device(name: str) -> wp.Device:
    """Return the Warp device with a name."""
    start_warp()
    if name.startswith("cuda") and not wp.is_cuda_available():
        raise SimulatorError(f"device '{name}' is not available here; available: cpu")
    try:
        return wp.get_device(name)
    except (ValueError, RuntimeError):
        have = ", ".join(str(d) for d in wp.get_devices())
        raise SimulatorError(f"device '{name}' is not available here; available: {have}") from None


def shared_water(vehicles: Sequence[Vehicle]) -> Fluid:
    """Return density and gravity of the water of vehicles in one world, which must be equal in their files."""
    fluid = vehicles[0].water
    for other in vehicles[1:]:
        if other.water != fluid:
            raise SimulatorError(
                f"'{vehicles[0].name}' and '{other.name}' share a world but not their water "
                f"({fluid} and {other.water}): replace water.density and water.gravity of one"
            )
    return fluid


def broadcast(array: NDArray[Any], shape: tuple[int, int, int], label: str) -> NDArray[Any]:
    """Return the array, of any unit, broadcast to every world and vehicle."""
    try:
        return np.broadcast_to(array, shape)
    except ValueError:
        raise SimulatorError(
            f"{label} has shape {array.shape}, expected (worlds, vehicles, numbers) = {shape} or the last of these "
            "alone"
        ) from None


def placed_at(name: str, value: ArrayLike, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return a position, quaternion or velocity for every world and vehicle, as `Simulator.place`; quaternions
    normalised."""
    array = np.asarray(value, dtype=np.float32)
    if not np.isfinite(array).all():
        raise SimulatorError(f"{name} to place a vehicle at has a number that is not finite")
    if name == "quaternion":
        length = np.linalg.norm(array, axis=-1, keepdims=True)
        if not (length > 0.0).all():
            raise SimulatorError("quaternion to place a vehicle at has length 0, expected 1 (xyzw)")
        array = array / length
    full = broadcast(array, (*shape, {"position": 3, "quaternion": 4, "velocity": 6}[name]), name)
    return np.ascontiguousarray(full, dtype=np.float32)


def thrust_table(force: ArrayLike, vehicles: Sequence[Vehicle], worlds: int) -> NDArray[np.float32]:
    """Return thruster forces for every world and vehicle, zero for thrusters that a vehicle does not have.

    Args:
        force: Forces along the thrusters' axes [N], shape broadcastable to (worlds, vehicles, n), n thrusters of the
            vehicle with the most.
        vehicles: Vehicles in their order.
        worlds: Number of worlds.

    Returns:
        Forces [N], (worlds, vehicles, `MAX_THRUSTERS`).

    Raises:
        SimulatorError: The shape is wrong or a number is not finite.
    """
    f = np.asarray(force, dtype=np.float32)
    n = max(len(v.thrusters) for v in vehicles)
    if f.ndim == 0 or f.shape[-1] != n:
        got = f.shape[-1] if f.ndim else 0
        whose = " of the vehicle that has most" if len(vehicles) > 1 else ""
        raise SimulatorError(f"thrust command has {got} numbers, expected {n}: one per thruster{whose}")
    if not np.isfinite(f).all():
        raise SimulatorError(
            "thrust command has a number that is not finite: send a force in N for every thruster"
        )
    full = np.zeros((worlds, len(vehicles), MAX_THRUSTERS), dtype=np.float32)
    full[..., :n] = broadcast(f, (*full.shape[:2], n), "thrust command")
    return full


# Record of a world in which a number stopped being finite.

COLUMNS = "vehicle step t x y z qx qy qz qw u v w p q r".split()


def write_post_mortem(simulator: "Simulator", world: int, directory: Path) -> Path:
    """Write the last control steps of one world to a CSV file; the last row is the step that failed.

    Args:
        simulator: The simulator of the world.
        world: Its index.
        directory: Folder of the file; created if missing.

    Returns:
        Path of a CSV file with one row per vehicle and step, columns `COLUMNS` (SI, world and body frames).
    """
    last = int(simulator.state.steps.numpy()[world])  # number of steps, including the failed one
    episode = int(simulator.state.episode.numpy()[world])
    history = simulator.state.history.numpy()[:, world]
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / f"frozen-world{world}-episode{episode}.csv"
    again = 2
    while path.exists():  # file of an earlier run
        path = directory / f"frozen-world{world}-episode{episode}-{again}.csv"
        again += 1
    with atomic_write(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
        file.write(",".join(COLUMNS) + "\n")
        for v in range(history.shape[1]):
            for step in range(max(0, last - HISTORY), last):
                row = np.concatenate(
                    [[v, step, (step + 1) * simulator.control_step], history[step % HISTORY, v]]
                )
                file.write(",".join(f"{x:.9g}" for x in row) + "\n")
    return path
