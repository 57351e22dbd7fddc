"""Plants: differences of an evaluation from the vehicle file and from still water, one YAML file each."""

from __future__ import annotations

import difflib
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from finssim.agents.agent import Agent
from finssim.core.yaml_file import first_problem, read_mapping
from finssim.sim import Water
from finssim.sim.randomize import Randomization
from finssim.sim.ranges_file import Ranges, load_ranges
from finssim.sim.water import beside
from finssim.tasks import Environment, MeasurementNoise, Task
from finssim.tasks.catalogue import observed
from finssim.tasks.sensing import seen_with
from finssim.vehicles import Vehicle

SHIPPED = Path(__file__).parent / "plants"

LONGEST_LAG = 5.0
"""Largest additional lag or delay of a thruster [s]: far above that of any motor; a delay requires memory."""


class PlantError(ValueError):
    """Unknown plant, or plant whose file cannot be used."""


class PlantChanges(BaseModel):
    """Differences of a plant; omitted keys mean the vehicle file's values, still water, and no noise."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    title: str = ""
    hydrodynamics: str | None = None
    """Hydrodynamic model: calibrated, mesh or simplified."""
    ranges: Ranges | None = None
    """Ranges from which every trial draws: a mapping, or the name or file of ranges."""
    water: Water | None = None
    """Current (or the table of a profile, beside the file), shear, drift_std, drift_time, depth, waves (or those of a
    spectrum); still if None."""
    noise: MeasurementNoise | None = None
    """Errors of what the controller observes [m, rad, m/s, rad/s]."""
    observe: str | None = None
    """Observation instead of `noise`: truth, estimator, or sensors (those of the vehicle file, with position
    fixes); or a file of fixes."""
    extra_time_constant: float = Field(default=0.0, ge=0.0, le=LONGEST_LAG, allow_inf_nan=False)
    """Time constant that is added to that of every thruster [s]."""
    extra_delay: float = Field(default=0.0, ge=0.0, le=LONGEST_LAG, allow_inf_nan=False)
    """Delay that is added to that of every thruster [s]."""
    held_out: bool = False
    """True for the appearances of a site that are held out of training."""
    vehicle: dict[str, Any] = Field(default_factory=dict)
    """Dotted path in the vehicle file -> replacement value, such as body.mass: 12.5."""

    @field_validator("ranges", mode="before")
    @classmethod
    def _named_ranges(cls, value: Any) -> Any:
        return load_ranges(value) if isinstance(value, str) else value

    @model_validator(mode="after")
    def _single_view(self) -> PlantChanges:
        if self.observe is not None:
            observed(self.observe)  # refuses an unknown observation
        if self.observe and self.noise:
            raise ValueError(f"noise and observe: {self.observe} are both given, expected one of them")
        return self

    def with_observation(self, observe: str) -> PlantChanges:
        """Return the same plant with another observation.

        Raises:
            PlantError: The observation is unknown.
        """
        title = f"{self.title}; observation: {observe}".removeprefix("; ")
        try:
            return PlantChanges.model_validate(
                {**dict(self), "noise": None, "observe": observe, "title": title}
            )
        except ValidationError as error:
            raise PlantError(error.errors()[0]["msg"].removeprefix("Value error, ")) from None

    def observe_record(self, vehicle: Vehicle) -> dict[str, Any]:
        """Return the description of `observe` in a result, with its numbers, as in a policy's description;
        empty if it is None."""
        if self.observe is None:
            return {}
        return {"observe": {"name": self.observe, **seen_with(observed(self.observe), self.changed(vehicle))}}

    def changed(self, vehicle: Vehicle) -> Vehicle:
        """Return the vehicle with this plant's numbers.

        Raises:
            VehicleError: A path is not in the vehicle file, or a value is invalid.
        """
        new = dict(self.vehicle)
        for name, thruster in vehicle.thrusters.items():
            if self.extra_time_constant:
                new[f"thrusters.{name}.time_constant"] = thruster.time_constant + self.extra_time_constant
            if self.extra_delay:
                new[f"thrusters.{name}.delay"] = thruster.delay + self.extra_delay
        return vehicle.replace(new) if new else vehicle

    def environment_arguments(self) -> dict[str, Any]:
        """Return the arguments of `finssim.tasks.Environment`: water, noise, randomization."""
        return {
            "water": self.water,
            "noise": observed(self.observe) if self.observe else self.noise,
            "randomization": Randomization(self.ranges).at_full_width() if self.ranges else None,
        }

    def environment(
        self, agent: Agent, task: Task, vehicle: Vehicle, *, hydrodynamics: str = "calibrated", **options: Any
    ) -> Environment:
        """Return worlds in which an agent acts in this plant.

        Args:
            agent: Agent with its action mode and the fraction of the limits that action 1 represents.
            task: Task of the agent.
            vehicle: Vehicle as in its file and in the agent's model; the plant modifies the simulated one.
            hydrodynamics: Hydrodynamic model, unless the plant names one.
            options: Options of the `Environment`: worlds, seed, ...
        """
        if self.held_out and not task.world:
            raise PlantError(
                f"plant '{self.name}' changes the appearance of a site, which task '{task.name}' lacks: use another"
            )
        return Environment(
            replace(task, held_out=True) if self.held_out else task,
            self.changed(vehicle),
            nominal=vehicle,
            hydrodynamics=self.hydrodynamics or hydrodynamics,
            action=agent.action,
            wrench_scale=agent.wrench_scale,
            **self.environment_arguments(),
            **options,
        )


def available_plants() -> list[str]:
    """Return the names of the plants that ship with FinsSim."""
    return sorted(path.stem for path in SHIPPED.glob("*.yaml"))


def load_plant(name_or_path: str | Path) -> PlantChanges:
    """Return a plant by name or from a file.

    Raises:
        PlantError: There is no such plant, or its file is invalid; the message names file, key and expected value.
    """
    path = Path(name_or_path)
    if not path.is_file() and str(name_or_path) in available_plants():
        path = SHIPPED / f"{name_or_path}.yaml"
    if not path.is_file():
        close = difflib.get_close_matches(str(name_or_path), available_plants(), n=1)
        hint = f"; did you mean '{close[0]}'?" if close else ""
        available = ", ".join(available_plants())
        raise PlantError(f"no plant '{name_or_path}': give a YAML file or one of {available}{hint}")
    data = read_mapping(path, PlantError, such_as="hydrodynamics: mesh")
    data["water"] = beside(data.get("water"), path.parent)
    try:
        return PlantChanges.model_validate({"name": path.stem, **data})
    except ValidationError as error:
        raise PlantError(f"{path}: {first_problem(error, PlantChanges)}") from None
