"""The hidden plant of the replay experiment: coupled matrices, hull drag, thrusters in each other's flow, a tether."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from finssim.calibration.excitation.programmes import Programme
from finssim.calibration.excitation.recording import Recording, record
from finssim.calibration.excitation.synthetic import trials_of
from finssim.calibration.trials.trial import Trial
from finssim.engine import Simulator, TetherLine
from finssim.experiments.plants import PlantError
from finssim.pool.coupled import CoupledMatrix, Section, Three
from finssim.vehicles import Vehicle
from finssim.yaml_file import first_problem, read_mapping

__all__ = ["ReplayPlant", "load_replay_plant"]

Array = NDArray[np.float64]

PLANT_FILE = Path(__file__).with_suffix(".yaml")

SLOWEST = 3.0
"""Below this propeller speed the loss of thrust is taken as at it [1/s]: there is hardly any thrust to lose."""


class _Hull(Section):
    form_drag: float = Field(ge=0.0)
    skin_drag: float = Field(ge=0.0)


class _Motors(Section):
    time_constant: float = Field(gt=0.0)
    delay: float = Field(ge=0.0)


class _Propellers(Section):
    diameter: float = Field(gt=0.0)
    advance_at_zero_thrust: float = Field(gt=0.0)
    induced_share: float = Field(ge=0.0, le=1.0)
    induced_reach: float = Field(gt=0.0)


class _Tether(Section):
    diameter: float = Field(gt=0.0)
    drag_coefficient: float = Field(ge=0.0)
    attachment: Three


class ReplayPlant(Section):
    """What `replay_plant.yaml` says; the vehicle file gives inertia, buoyancy, thruster places and allocation."""

    title: str
    mass: float = Field(gt=0.0)
    depth: float = Field(gt=0.0)
    rpm_noise: float = Field(ge=0.0)
    hull: _Hull
    added_mass: CoupledMatrix
    linear_damping: CoupledMatrix
    motors: _Motors
    propellers: _Propellers
    tether: _Tether

    def record(self, programmes: Sequence[Programme], vehicle: Vehicle, seed: int) -> Recording:
        """The true motion under some programmes, commanded as the vehicle file has it; see `record`."""
        fields: dict[str, Any] = {
            "mass": self.mass,
            "M_A": self.added_mass.matrix(),
            "form_drag": self.hull.form_drag,
            "skin_drag": self.hull.skin_drag,
            "time_constant": self.motors.time_constant,
            "delay": self.motors.delay,
        }
        return record(
            programmes,
            vehicle,
            seed=seed,
            hydrodynamics="mesh",
            plant=fields,
            tether=TetherLine(**self.tether.model_dump()),
            depth=self.depth,
            each_step=self.forces(vehicle),
        )

    def trials(self, programmes: Sequence[Programme], vehicle: Vehicle, seed: int) -> list[Trial]:
        """Trials as sensors and telemetry log them: propeller speeds, velocity, IMU, attitude, position, depth."""
        recording = self.record(programmes, vehicle, seed)
        logged = trials_of(
            recording, programmes, vehicle, noise="sensors", seed=seed, inputs=("rpm",), sampling="instant"
        )
        random = np.random.default_rng([seed, 2])

        def noisy(name: str, values: Array) -> Array:
            if not name.startswith("rpm_"):
                return values
            turning = np.where(values != 0.0, 1.0, 0.0)
            return np.asarray(values + self.rpm_noise * turning * random.standard_normal(len(values)))

        return [replace(t, channels={k: noisy(k, v) for k, v in t.channels.items()}) for t in logged]

    def forces(self, vehicle: Vehicle) -> Callable[[Simulator], None]:
        """What acts besides the engine's own forces: coupled damping and the loss of thrust, from the present state."""
        D = self.linear_damping.matrix()
        p = self.propellers
        thrusters = list(vehicle.thrusters.values())
        axis = np.array([t.axis for t in thrusters])
        place = np.array([t.position for t in thrusters])
        distance = np.linalg.norm(place[:, None] - place, axis=-1)
        share = p.induced_share * np.exp(-distance / p.induced_reach) * (1.0 - np.eye(len(thrusters)))
        disc = 0.25 * math.pi * p.diameter**2
        c_plus = np.array([t.c_plus for t in thrusters])
        c_minus = np.array([t.c_minus for t in thrusters])
        n = len(thrusters)

        def act(simulator: Simulator) -> None:
            nu = simulator.numpy("velocity")[:, 0].astype(float)
            simulator.command.disturbance.numpy()[:, 0] = -nu @ D.T
            thrust = simulator.numpy("actuator")[:, 0, :n].astype(float)
            turns = np.sqrt(np.abs(thrust) / np.where(thrust >= 0.0, c_plus, c_minus)) / (2.0 * math.pi)
            induced = np.sqrt(np.abs(thrust) / (2.0 * vehicle.water.density * disc)) @ share.T
            own = nu[:, :3] @ axis.T + np.einsum("wi,ki->wk", nu[:, 3:], np.cross(place, axis))
            inflow = np.sign(thrust) * own + induced
            loss = inflow / (p.advance_at_zero_thrust * np.maximum(turns, SLOWEST) * p.diameter)
            simulator.plant.gain.numpy()[:, 0, :n] = 1.0 - loss

        return act


def load_replay_plant(path: Path = PLANT_FILE) -> ReplayPlant:
    """The plant in a file.

    Raises:
        PlantError: The file cannot be used; names file, key and expectation.
    """
    data = read_mapping(path, PlantError, such_as="mass: 12.13")
    try:
        return ReplayPlant.model_validate(data)
    except ValidationError as error:
        raise PlantError(f"{path}: {first_problem(error)}") from None
