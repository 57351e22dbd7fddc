"""What randomisation does in one environment: the draws, how their ranges grow, what agents and logs are told."""

from collections.abc import Iterator

import warp as wp

from finssim.engine import Simulator
from finssim.engine.launch import Pipeline
from finssim.engine.packed import Packed
from finssim.engine.randomize import Draws, Randomization
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.curriculum import Schedule
from finssim.tasks.draw_log import DrawLog
from finssim.tasks.given import EnvironmentSetupError
from finssim.tasks.task import Task

__all__ = ["Drawing"]


class Drawing:
    """The randomisation of one environment; without one, nothing happens.

    Attributes:
        draws: What is drawn; None without randomisation.
        schedule: How the ranges grow; None where they do not.
        names: Of the privileged numbers of an agent; empty unless they are asked for.
        log: What was drawn for the episodes that ended; None until `start_log`.
    """

    def __init__(
        self,
        randomization: Randomization | None,
        simulator: Simulator,
        arrays: TaskArrays,
        seen: Packed,
        task: Task,
        privileged: bool,
    ) -> None:
        """Set up what the randomisation needs, and the arrays of the privileged numbers.

        Raises:
            EnvironmentSetupError: Privileged numbers without randomisation, or a schedule that cannot be.
        """
        self._simulator, self._arrays, self._seen = simulator, arrays, seen
        self.draws: Draws | None = None
        self.schedule: Schedule | None = None
        self.log: DrawLog | None = None
        self.names: list[str] = []
        if privileged and randomization is None:
            raise EnvironmentSetupError(
                "privileged numbers are what is drawn: give randomization, or leave privileged out"
            )
        if privileged and randomization is not None:
            self.names = randomization.told(max(len(vehicle.thrusters) for vehicle in simulator.vehicles))
        shape = (simulator.worlds, len(task.agents) * len(self.names))
        for name in ("privileged", "final_privileged"):
            setattr(arrays, name, wp.zeros(shape, dtype=wp.float32, device=simulator.device))
        if randomization is None:
            return
        told = (arrays.privileged, arrays.final_privileged) if privileged else None
        self.draws = randomization.draws(simulator, seen, agents=len(task.agents), privileged=told)
        plan = randomization.ranges.curriculum or randomization.ranges.automatic
        if plan is not None:
            self.schedule = Schedule(plan, self.draws, task)

    def add_step(self, pipeline: Pipeline, seed: int) -> None:
        """Append what comes before the simulator's step."""
        if self.draws is not None:
            self.draws.add_step(pipeline, seed)

    def add_end(self, pipeline: Pipeline) -> None:
        """Append what comes after the task's evaluation."""
        if self.schedule is not None:
            self.schedule.add(pipeline, self._arrays)

    def add_start(self, pipeline: Pipeline, mask: wp.array, seed: int) -> None:
        """Append the draw for the worlds where an episode starts."""
        if self.draws is not None:
            self.draws.add(pipeline, mask, seed)
            self._simulator.add_refresh(pipeline, mask)

    def start_log(self) -> DrawLog:
        """Keep what is drawn from now on.

        Raises:
            EnvironmentSetupError: Nothing is drawn.
        """
        if self.draws is None:
            raise EnvironmentSetupError("nothing is drawn that could be logged: give randomization")
        self.log = DrawLog(self.draws, self._arrays)
        return self.log

    def after_step(self) -> None:
        """Called after every step of the pipeline."""
        if self.schedule is not None:
            self.schedule.after_step()
        if self.log is not None:
            self.log.after_step()

    def after_reset(self) -> None:
        """Called after episodes were started from outside."""
        if self.log is not None:
            self.log.look()

    def restart(self) -> None:
        """Called before all random streams start over."""
        if self.schedule is not None:
            self.schedule.restart()

    def arrays(self) -> Iterator[tuple[str, wp.array]]:
        """All of it that decides what comes next, by name."""
        if self.draws is None:
            return
        yield "values", self.draws.values
        yield "probe", self.draws.probe
        for part, drawn in (("seen", self._seen), ("tether", self._simulator.tether)):
            yield from ((f"{part}.{name}", array) for name, array in drawn.fields.items())
        if self.schedule is not None:
            yield from ((f"schedule.{name}", array) for name, array in self.schedule.arrays())
