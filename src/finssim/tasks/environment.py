"""The batched environment: any task, any vehicle, thousands of worlds, with automatic reset."""

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from finssim.control import ControlError
from finssim.control.course import CourseData, Memory, course_data, reference_of, steer
from finssim.control.modes import MODES, ModeData, mode_data, thrusts_of, thrusts_of_shares
from finssim.physics.plant import VehicleCommand
from finssim.physics.types import vec8
from finssim.sim import RectangularPool, Simulator, SimulatorError, TetherLine, Water
from finssim.sim.free_motion import linear_model
from finssim.sim.launch import KernelSequence
from finssim.sim.randomize import Draws, Randomization
from finssim.sim.site import described_world
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.measurement import MeasurementNoise, connect_measured, measure, measurements
from finssim.tasks.schedule import Schedule
from finssim.tasks.sensing import Sensing, SensingBatch
from finssim.tasks.task import Batch, Task
from finssim.tasks.validation import EnvironmentSetupError, vehicles_of_task
from finssim.vehicles import Vehicle

GREATEST_SEED = 2**31 - 1
"""Greatest seed; kernels use 32-bit integers."""
GPU_FROZEN_CHECK = 100
"""Steps between checks for frozen worlds on a GPU."""


MOST_REPORTS = 3
"""Greatest number of frozen worlds whose last states are written; further ones are only counted."""


@dataclass(frozen=True)
class Step:
    """Result of one step; NumPy views of the environment's own arrays, valid until the next step."""

    observation: Any
    """(worlds, size), or (worlds, agents, size) of several agents; the first of the new episode where one ended. For a
    task with pictures it is a dictionary: `state`, as above, and by each picture's name uint8 (worlds, height, width,
    3), or for a sonar (worlds, beams, range cells, 1)."""
    reward: NDArray[np.float32]
    """Rewards, (worlds,), or (worlds, agents)."""
    terminated: NDArray[np.bool_]
    """True where the task ended the episode, (worlds,)."""
    truncated: NDArray[np.bool_]
    """True where the time limit ended the episode, (worlds,)."""
    final_observation: Any
    """Last observation of the episodes that ended in this step; other rows are outdated."""


@wp.func
def component(arrays: TaskArrays, w: int, v: int, k: int, agents: int, size: int) -> float:
    """Return component k of an agent's action, or of the task's action for one of the other vehicles."""
    if v < agents:
        return arrays.action[w, v * size + k]
    return arrays.scripted[w, (v - agents) * size + k]


@wp.kernel(enable_backward=False)
def act(
    arrays: TaskArrays,
    command: wp.array2d(dtype=VehicleCommand),
    data: ModeData,
    agents: int,
    world_offset: int,
):
    """Write the thrusts of every vehicle."""
    i, v = wp.tid()
    w = world_offset + i
    a = vec8()
    for k in range(data.columns.shape[1]):
        a[k] = component(arrays, w, v, k, agents, data.columns.shape[1])
    command[w, v].thrust = thrusts_of(a, v, data)


@wp.kernel(enable_backward=False)
def act_by_shares(
    arrays: TaskArrays,
    command: wp.array2d(dtype=VehicleCommand),
    data: ModeData,
    agents: int,
    world_offset: int,
):
    """Write the thrusts as `act` does, with less code, for modes with components as fractions of the thrusters'
    limits."""
    i, v = wp.tid()
    w = world_offset + i
    x = vec8()
    for k in range(data.columns.shape[1]):
        part = component(arrays, w, v, k, agents, data.columns.shape[1])
        x += wp.clamp(part, -1.0, 1.0) * data.columns[v, k]
    command[w, v].thrust = thrusts_of_shares(x, data.lower[v], data.upper[v])


@wp.kernel(enable_backward=False)
def act_by_course(
    arrays: TaskArrays,
    command: wp.array2d(dtype=VehicleCommand),
    data: CourseData,
    by_pitch: int,
    world_offset: int,
):
    """Write the channels of every vehicle by its autopilot, which uses the same measurements as the agent."""
    i, v = wp.tid()
    w = world_offset + i
    reference = reference_of(
        arrays.action[w, 3 * v], arrays.action[w, 3 * v + 1], arrays.action[w, 3 * v + 2], by_pitch, v, data
    )
    q = arrays.quaternion[w, v]
    steered = steer(reference, q, arrays.velocity[w, v], arrays.steering[w, v], v, data)
    command[w, v].thrust = steered.channels
    arrays.steering[w, v] = steered.memory


class Environment:
    """Batched environment of a task: its agents are the first vehicles of every world; the task commands the others.

    Attributes:
        task: The task, scaled to the vehicles.
        agents: Number of agents in a world.
        nominal: The vehicles as modelled by their controllers.
        simulator: The worlds.
        arrays: Actions, observations, rewards and goals, as Warp arrays by world.
        draws: Draws of the randomisation; None without it.
        schedule: Schedule that widens its ranges; None for constant ranges.
        privileged_names: Names of the privileged numbers of an agent, in order; empty unless requested.
    """

    def __init__(
        self,
        task: Task,
        vehicle: Vehicle | str | Sequence[Vehicle | str] = "finsrov",
        *,
        nominal: Vehicle | str | Sequence[Vehicle | str] | None = None,
        worlds: int = 1,
        hydrodynamics: str = "calibrated",
        action: str | None = None,
        wrench_scale: ArrayLike = 1.0,
        randomization: Randomization | None = None,
        noise: MeasurementNoise | Sensing | None = None,
        water: Water | None = None,
        pool: RectangularPool | None = None,
        tether: TetherLine | None = None,
        integrator: str = "midpoint",
        device: str = "cpu",
        threads: int | None = None,
        seed: int = 0,
        crash_directory: Path = Path("finssim-frozen"),
        auto_reset: bool = True,
        privileged: bool = False,
    ) -> None:
        """Set up the worlds and start an episode in each.

        Args:
            task: The task.
            vehicle: A vehicle, a catalogue name or a file; or one for each of the task's vehicles.
            nominal: The same vehicles as modelled by their controllers: their limits scale the actions, their
                allocation maps wrenches to thruster forces, and the task is scaled to them; `vehicle` then only
                delivers the forces. `vehicle` if None.
            worlds: Number of worlds.
            hydrodynamics: calibrated, mesh or simplified.
            action: thruster8, wrench6, wrench4, pilot6 (ArduSub's axes), surfaces, course or course_pitch; the task's
                own if None.
            wrench_scale: Fraction of each wrench limit that an agent's action of 1 commands, one number or (6,).
            randomization: Randomisation of every episode; none if None.
            noise: Noise of the controller's observations, or its sensors; none if None.
            water: Currents and waves.
            pool: Walls and floor; the task's own if None.
            tether: Tether of the vehicle.
            integrator: midpoint or rk4.
            device: cpu or cuda.
            threads: Threads on a CPU.
            seed: Seed of goals, starts, randomisation and noise; 0 to 2³¹ - 1.
            crash_directory: Folder for the last states of frozen worlds.
            auto_reset: Start a new episode where one ended, in the same step.
            privileged: Write the drawn parameters to `arrays.privileged`, for privileged critics; see
                `privileged_names`.

        Raises:
            EnvironmentSetupError: The action mode is unknown, vehicles do not fit the task, or a seed is out of range.
        """
        self.action_mode, self.seed = action or task.action, checked_seed(seed)
        self.crash_directory, self.auto_reset = crash_directory, auto_reset
        if self.action_mode not in MODES:
            raise EnvironmentSetupError(
                f"unknown action mode '{self.action_mode}'; available: {', '.join(MODES)}"
            )
        vehicles = vehicles_of_task(vehicle, task, self.action_mode)
        self.nominal = vehicles if nominal is None else vehicles_of_task(nominal, task, self.action_mode)
        refuse_other_thrusters(vehicles, self.nominal)
        self.task = task = task.fitted(self.nominal)
        longest = max(
            (t.delay for vehicle_of_world in vehicles for t in vehicle_of_world.thrusters.values()),
            default=0.0,
        )
        extra = randomization.simulator_arguments(longest, tether) if randomization else {"tether": tether}
        self.simulator = Simulator(
            vehicles, worlds=worlds, hydrodynamics=hydrodynamics, control_step=task.control_step,
            substeps=task.substeps, integrator=integrator, water=water, pool=pool or task.arena(),
            dock=task.dock(), device=device, threads=threads, seed=self.seed, **extra,
        )  # fmt: skip
        self.worlds, self.agents, self.device = worlds, len(task.agents), self.simulator.device
        self.action_size = len(MODES[self.action_mode].labels(vehicles[0]))
        """Numbers in the action of an agent."""
        self.arrays = task.arrays(worlds, self.action_size, self.device)
        self.arrays.current = self.simulator.water.current
        if self.simulator.dock is not None:
            # The dock is the goal: the same memory.
            self.arrays.funnel = funnel = self.simulator.funnel
            self.arrays.goal_position, self.arrays.goal_quaternion = funnel.position, funnel.quaternion
        if MODES[self.action_mode].course:
            self.arrays.steering = wp.zeros((worlds, len(vehicles)), dtype=Memory, device=self.device)
            self._steering = self._autopilots()
        self.wrench_scale = np.broadcast_to(np.asarray(wrench_scale, dtype=float), (6,))
        self.noise = noise or MeasurementNoise()
        self.randomization = randomization
        self._mask = wp.zeros(worlds, dtype=wp.int32, device=self.device)
        self._steps = self._reported = 0
        self._views: dict[int, NDArray[Any]] = {}
        self._arena = pool or task.arena()
        self._measure()
        self._draw(randomization, privileged)
        self.sight = self._sight() if task.pictures else None
        """Rendered world and its pictures; None for a task without pictures."""
        self._build()
        self.reset(seed=self.seed)

    def _autopilots(self) -> CourseData:
        """Return the autopilots of the nominal vehicles, which execute the commands of a course mode."""
        try:
            names, models = [one.name for one in self.nominal], [linear_model(one) for one in self.nominal]
            return course_data(models, names, self.task.control_step, self.device)
        except (ControlError, SimulatorError) as error:
            raise EnvironmentSetupError(f"action mode '{self.action_mode}': {error}") from error

    def _sight(self) -> Any:
        """Return the rendered world, with the sensors that the task observes."""
        return described_world(self.task.world).sight(self.task, self.simulator, self.arrays, self.seed)

    def _measure(self) -> None:
        """Set up what the controller observes: the state, the state with noise, or sensors and their filter."""
        noise, randomization = self.noise, self.randomization
        drawn = bool(randomization and randomization.changes_sensors)
        fixes = noise.fixes if isinstance(noise, Sensing) else noise
        self._seen = measurements(fixes, (self.worlds, len(self.simulator.vehicles)), self.device)
        self._measured = isinstance(noise, Sensing) or fixes.present or drawn
        connect_measured(self._measured, self.simulator.state, self.arrays)
        self.sensing: SensingBatch | None = None
        """Instruments and filters, if the controller observes their estimates; otherwise None."""
        if not isinstance(noise, Sensing):
            return
        if randomization and randomization.changes_velocities:
            raise EnvironmentSetupError(
                "the ranges draw errors of velocities or rates, and these come from the vehicle's sensors: leave "
                "sensors.velocity_... and sensors.rate_... out of the ranges, or observe otherwise"
            )
        floor = self._arena.depth if self._arena else None
        self.sensing = SensingBatch(noise, self.simulator, self.arrays, self._seen, floor, self.seed, drawn)

    def _draw(self, randomization: Randomization | None, privileged: bool) -> None:
        """Set up the randomisation, and the arrays of the privileged numbers."""
        self.draws: Draws | None = None
        self.schedule: Schedule | None = None
        self.privileged_names: list[str] = []
        if privileged and randomization is None:
            raise EnvironmentSetupError(
                "privileged numbers are what is drawn: give randomization, or leave privileged out"
            )
        if privileged and randomization is not None:
            max_thrusters = max(len(vehicle.thrusters) for vehicle in self.simulator.vehicles)
            self.privileged_names = randomization.privileged_names(max_thrusters)
        shape, arrays = (self.worlds, self.agents * len(self.privileged_names)), self.arrays
        for name in ("privileged", "final_privileged"):
            setattr(arrays, name, wp.zeros(shape, dtype=wp.float32, device=self.device))
        if randomization is None:
            return
        outputs = (arrays.privileged, arrays.final_privileged) if privileged else None
        self.draws = randomization.draws(self.simulator, self._seen, agents=self.agents, privileged=outputs)
        if randomization.ranges.curriculum is not None:
            self.schedule = Schedule(randomization.ranges.curriculum, self.draws, self.task)

    @property
    def observation_size(self) -> int:
        """Numbers in the observation of an agent."""
        return self.task.observation_size

    def _build(self) -> None:
        self._step = self.simulator.pipeline()
        self._batch = batch = Batch(self.simulator.state, self.arrays, self.seed)
        if self.task.others:
            self.task.add_command(self._step, batch)
        # Controllers know the nominal limits and allocation; the simulated thrusters may deliver something else.
        # Commands of the task itself refer to the full limits, even if the agents' limits are reduced.
        agent_scale = self.wrench_scale if MODES[self.action_mode].wrench else 1.0
        scales = [agent_scale if v < self.agents else 1.0 for v in range(len(self.nominal))]
        command, kind = self.simulator.command.array, MODES[self.action_mode]
        if kind.course:
            inputs = [self.arrays, command, self._steering, int(kind.course == "pitch")]
            self._step.add(act_by_course, inputs, vehicles=len(self.nominal))
        else:
            modes = mode_data(self.action_mode, self.nominal, scales, self.device)
            kernel = act if kind.wrench or kind.pilot else act_by_shares
            self._step.add(kernel, [self.arrays, command, modes, self.agents], vehicles=len(self.nominal))
        if self.draws is not None:
            self.draws.add_step(self._step, self.seed)
        self.simulator.add_step(self._step)
        self._add_measure(self._step)
        self.task.add_evaluate(self._step, batch)
        if self.schedule is not None:
            self.schedule.add(self._step, self.arrays)
        if self.auto_reset and self.sight is None:
            self._add_start(self._step, self.arrays.done)
        self._restart = self.simulator.pipeline()
        if self.auto_reset and self.sight is not None:
            self._add_start(self._restart, self.arrays.done)
        self._start = self.simulator.pipeline()
        self._add_start(self._start, self._mask)
        self._look = self.simulator.pipeline()
        """Pipeline of a task whose observation contains ranges, which are measured after the step."""
        if self.task.ranges and self.sight is not None:
            everywhere = wp.ones(self.worlds, dtype=wp.int32, device=self.device)
            self.task.add_observe(self._look, batch, everywhere)

    def _add_measure(self, pipeline: Any, mask: wp.array | None = None) -> None:
        """Append the measurements: after a step, or at the start of an episode where mask is not 0."""
        if self.sensing is not None:
            self.sensing.add(pipeline, self.seed, mask)
        elif self._measured:
            inputs = [self.simulator.state, self.arrays, self._seen.array, self.task.control_step, self.seed]
            pipeline.add(measure, inputs, vehicles=len(self.simulator.vehicles))

    def _add_start(self, pipeline: Any, mask: wp.array) -> None:
        self.simulator.add_reset(pipeline, mask)
        if self.draws is not None:
            self.draws.add(pipeline, mask, self.seed)
            self.simulator.add_refresh(pipeline, mask)
        self.task.add_spawn(pipeline, self._batch, mask)
        self._add_measure(pipeline, mask)
        self.task.add_observe(pipeline, self._batch, mask)

    def __repr__(self) -> str:
        names = ", ".join(vehicle.name for vehicle in self.nominal)
        return f"<Environment of {self.task.name}: {self.worlds} worlds of {names}, {self.simulator.device}>"

    def _repr_html_(self) -> str:
        return f"<p>{escape(repr(self))}</p>{self.task._repr_html_()}"

    def reset(self, mask: ArrayLike | None = None, seed: int | None = None) -> Any:
        """Start new episodes.

        Args:
            mask: Worlds to reset, bool by world; all if None.
            seed: Restart the random streams with this seed, as in a new environment.

        Returns:
            Observations, in the form of `Step.observation`.

        Raises:
            EnvironmentSetupError: The seed is out of range.
        """
        if seed is not None:
            if checked_seed(seed) != self.seed:
                self.seed = self.simulator.seed = int(seed)
                self._build()
            self.simulator.restart_episodes(mask)
            if self.sight is not None:
                self.sight.restart(self.seed, None if mask is None else np.asarray(mask, dtype=bool))
            if mask is None and self.schedule is not None:
                self.schedule.restart()
        starts = np.ones(self.worlds, np.int32) if mask is None else np.asarray(mask, dtype=np.int32)
        self._mask.assign(starts)
        self._begin(self._start, starts != 0)
        self._check_starts(starts != 0)
        return self._observed("")

    def _check_starts(self, mask: NDArray[np.bool_]) -> None:
        """Refuse starts outside the arena, from which walls would eject a vehicle.

        Raises:
            EnvironmentSetupError: A start is outside; the message has the coordinates of the first.
        """
        if self._arena is None:
            return
        half = np.array([0.5 * self._arena.length, 0.5 * self._arena.width, np.inf])
        low, high = -half, half
        low[2] = -self._arena.depth
        positions = self.simulator.state.position.numpy()
        outside = ~((positions >= low - 1e-6) & (positions <= high + 1e-6)).all(2) & mask[:, None]
        if outside.any():
            world, vehicle = np.argwhere(outside)[0]
            place = ", ".join(f"{x:.3g}" for x in positions[world, vehicle])
            raise EnvironmentSetupError(
                f"task '{self.task.name}' starts {self.task.vehicles[vehicle]} in world {world} at ({place}) m, "
                f"outside its arena: expected x within ±{half[0]:g}, y within ±{half[1]:g} and z above {low[2]:g} m"
            )

    def _begin(self, pipeline: KernelSequence, mask: NDArray[np.bool_]) -> None:
        """Start episodes in the worlds of the pipeline's mask."""
        if self.sight is not None:
            self.sight.draw(mask)
        pipeline.run()
        if self.sight is not None:
            self.sight.begin(mask)
            self._look.run()

    def _numpy(self, array: wp.array) -> NDArray[Any]:
        """Return a NumPy array of an array of this environment: on a CPU a view, which is created once."""
        if not self.device.is_cpu:
            return array.numpy()
        if array.ptr not in self._views:
            self._views[array.ptr] = array.numpy()
        return self._views[array.ptr]

    def _observed(self, which: str) -> Any:
        """Return observations as views; with which = `final_`, the last ones of the latest finished episodes."""
        rows = self._numpy(getattr(self.arrays, f"{which}observation"))
        rows = rows if self.agents == 1 else rows.reshape(self.worlds, self.agents, -1)
        if self.sight is None:
            return rows
        pictures: dict[str, wp.array] = getattr(self.sight, f"{which}pictures")
        return {"state": rows, **{name: picture.numpy() for name, picture in pictures.items()}}

    def start(
        self, position: ArrayLike, quaternion: ArrayLike, goal_position: ArrayLike, goal_quaternion: ArrayLike
    ) -> NDArray[np.float32]:
        """Start an episode in every world with vehicle 0 at rest at given poses, with given goals.

        Args:
            position: World frame [m], broadcastable to (worlds, 3).
            quaternion: Body to world, xyzw, broadcastable to (worlds, 4).
            goal_position: World frame [m], broadcastable to (worlds, 3).
            goal_quaternion: Body to world, broadcastable to (worlds, 4).

        Returns:
            Observations, (worlds, size).
        """
        self.reset()
        state, arrays = self.simulator.state, self.arrays
        for array, value in ((state.position, position), (state.quaternion, quaternion)):
            rows = array.numpy().copy()
            rows[:, 0] = value
            array.assign(rows)
        state.velocity.zero_()
        for goal, value in ((arrays.goal_position, goal_position), (arrays.goal_quaternion, goal_quaternion)):
            row = np.asarray(value, dtype=np.float32)
            goal.assign(np.ascontiguousarray(np.broadcast_to(row, goal.numpy().shape)))
        again = self.simulator.pipeline()
        self._add_measure(again, self._mask)
        self.task.add_observe(again, self._batch, self._mask)
        again.run()
        return self.arrays.observation.numpy()

    def step(self, action: ArrayLike) -> Step:
        """Simulate one control step with the given actions.

        Args:
            action: (worlds, size), or (worlds, agents, size) of several agents, each clipped to [-1, 1].

        Raises:
            EnvironmentSetupError: The shape is wrong or a number is not finite.
        """
        checked = checked_action(action, self.worlds, self.agents, self.action_size)
        if self.device.is_cpu:
            self._numpy(self.arrays.action)[:] = checked
        else:
            self.arrays.action.assign(checked)
        self.advance()
        return self.outcome()

    def advance(self) -> None:
        """Simulate one control step with the actions already in `arrays.action` (no check, no copy)."""
        self._step.run()
        self._steps += 1
        if self.schedule is not None:
            self.schedule.after_step()
        if self.sight is not None:
            self.sight.take()
            self._look.run()
            ended = self.arrays.done.numpy() != 0
            if ended.any():
                self.sight.keep(ended)
                if self.auto_reset:
                    self._begin(self._restart, ended)
        # On a GPU the check costs a copy, so frozen worlds wait for the next check, reported as terminated meanwhile.
        inspect = self.device.is_cpu or self._steps % GPU_FROZEN_CHECK == 0
        if inspect and self._numpy(self.simulator.state.frozen).any():
            self._revive()

    def set_progress(self, done: float) -> None:
        """Set the completed fraction of the training, in [0, 1], with which ranges may grow."""
        if self.schedule is not None:
            self.schedule.progress(done)

    def _revive(self) -> None:
        """Report frozen worlds, then start new episodes in them; their step counts as terminated."""
        frozen = self.simulator.state.frozen.numpy() != 0
        before, self._reported = self._reported, self._reported + int(frozen.sum())
        try:
            paths = self.simulator.report_frozen(self.crash_directory, most=max(0, MOST_REPORTS - before))
            notes = [f"last states in {path}" for path in paths]
            if before <= MOST_REPORTS < self._reported:
                notes.append(f"more worlds than {MOST_REPORTS}: the states of the others are not written")
        except OSError as error:  # a report that cannot be written must not abort a long training
            notes = [f"its last states could not be written: {error}"]
        for note in notes:
            print(f"finssim: a number stopped being finite; {note}", file=sys.stderr, flush=True)
        self.reset(mask=frozen)

    def outcome(self) -> Step:
        """Return the result of the last step."""
        a = self.arrays
        reward = a.reward if self.agents == 1 else a.agent_reward
        return Step(
            self._observed(""), self._numpy(reward), self._numpy(a.terminated) != 0, self._numpy(a.truncated) != 0,
            self._observed("final_"),
        )  # fmt: skip

    # The complete state, as NumPy arrays: a run restored from it continues identically.

    def state(self) -> dict[str, NDArray[Any]]:
        """Return copies of vehicle states, delay lines, water, the task's arrays and all counters; see `load_state`.

        Returns:
            Arrays by name, such as `state.position` or `plant.mass`; the counters under `counters.`.
        """
        saved = {name: np.array(array.numpy()) for name, array in self._members()}
        saved["counters.seed"], saved["counters.steps"] = np.array(self.seed), np.array(self._steps)
        if self.schedule is not None:
            saved["counters.schedule"] = np.array(self.schedule._steps)
        if self.sight is not None:
            saved |= {f"counters.sight.{name}": value for name, value in self.sight.counters().items()}
        reported = np.array(sorted(self.simulator._reported), dtype=np.int64)
        return {**saved, "counters.reported": reported.reshape(-1, 2)}

    def load_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Restore the `state()` of an environment created with the same arguments, bit for bit.

        Each array has the unit of its attribute.

        Raises:
            EnvironmentSetupError: That environment had other arguments: a name or shape does not fit.
        """
        refused, remedy = "saved state does not fit: ", "make the environment with the same arguments"
        if int(state["counters.seed"]) != self.seed:
            self.reset(seed=int(state["counters.seed"]))
        arrays = dict(self._members())
        for name in sorted(arrays.keys() ^ {name for name in state if not name.startswith("counters.")}):
            reason = "is not in the saved state" if name in arrays else "is in the saved state alone"
            raise EnvironmentSetupError(f"{refused}'{name}' {reason}: {remedy}")
        for name, array in arrays.items():
            shape = array.numpy().shape
            if state[name].shape != shape:
                raise EnvironmentSetupError(
                    f"{refused}'{name}' has shape {state[name].shape}, expected {shape}: {remedy}"
                )
        for name, array in arrays.items():
            array.assign(np.ascontiguousarray(state[name]))
        self.simulator.compare_worlds()
        self._steps = int(state["counters.steps"])
        if self.schedule is not None:
            self.schedule._steps = int(state["counters.schedule"])
        if self.sight is not None:
            mine = {name.removeprefix("counters.sight."): value for name, value in state.items()}
            self.sight.load_counters(mine)
        self.simulator._reported = {(int(w), int(e)) for w, e in state["counters.reported"]}

    def _members(self) -> Iterator[tuple[str, wp.array]]:
        """Yield every array that persists between steps and resets, by name."""
        simulator = self.simulator
        for name, packed in (("plant", simulator.plant), ("command", simulator.command)):
            yield from ((f"{name}.{field}", array) for field, array in packed.fields.items())
        if self.draws is not None:
            yield "drawing.values", self.draws.values
            for name, packed in (("seen", self._seen), ("tether", simulator.tether)):
                yield from ((f"drawing.{name}.{field}", array) for field, array in packed.fields.items())
        if self.schedule is not None:
            yield from ((f"drawing.schedule.{name}", array) for name, array in self.schedule.arrays())
        if self.sight is not None:
            yield from self.sight.arrays()
        structs = {"state": simulator.state, "water": simulator.water, "task": self.arrays}
        for name, struct in {**structs, **(self.sensing.structs() if self.sensing else {})}.items():
            yield from _members(name, struct)


def refuse_other_thrusters(vehicles: Sequence[Vehicle], nominal: Sequence[Vehicle]) -> None:
    """Refuse vehicles whose thrusters differ from those that their controllers command.

    Raises:
        EnvironmentSetupError: They differ in number, name or order.
    """
    for vehicle, expected in zip(vehicles, nominal, strict=True):
        if vehicle.channel_names != expected.channel_names:
            kind = "actuators" if vehicle.thruster_names == expected.thruster_names else "thrusters"
            raise EnvironmentSetupError(
                f"{vehicle.name} has {kind} {', '.join(vehicle.channel_names)}, "
                f"expected those that its controller commands: {', '.join(expected.channel_names)}"
            )


def checked_seed(seed: int) -> int:
    """Return the seed if it is within the range of the kernels.

    Raises:
        EnvironmentSetupError: It is out of range.
    """
    if not 0 <= seed <= GREATEST_SEED:
        raise EnvironmentSetupError(f"seed is {seed}, expected 0 to {GREATEST_SEED}")
    return int(seed)


def checked_action(action: ArrayLike, worlds: int, agents: int, size: int) -> NDArray[np.float32]:
    """Return actions as rows of worlds, (worlds, agents * size).

    Raises:
        EnvironmentSetupError: The shape is wrong or a number is not finite.
    """
    a = np.asarray(action, dtype=np.float32)
    expected = (worlds, size) if agents == 1 else (worlds, agents, size)
    if a.shape != expected:
        row_of = "world" if agents == 1 else "agent"
        raise EnvironmentSetupError(f"action has shape {a.shape}, expected {expected}: one row per {row_of}")
    a = a.reshape(worlds, -1)
    # A sum of squares is finite if all numbers are, and faster; if it overflows, the numbers are checked one by one.
    if not np.isfinite(np.vdot(a, a)) and not np.isfinite(a).all():
        world = int(np.flatnonzero(~np.isfinite(a).all(axis=1))[0])
        raise EnvironmentSetupError(
            f"action of world {world} has a number that is not finite: {a[world].tolist()}"
        )
    return a


def _members(prefix: str, struct: Any) -> Iterator[tuple[str, wp.array]]:
    """Yield the arrays of a Warp struct and of nested structs; arrays of structs are covered by the views of their
    fields."""
    for name in struct._cls.vars:
        value = getattr(struct, name)
        if isinstance(value, wp.array):
            if value.size and not hasattr(value.dtype, "numpy_dtype"):
                yield f"{prefix}.{name}", value
        elif hasattr(value, "_cls"):
            yield from _members(f"{prefix}.{name}", value)
