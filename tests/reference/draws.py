"""Draws without a task: a simulator, ranges, and one run of the draw."""

from __future__ import annotations

import numpy as np
import warp as wp

from finssim.sim import Simulator
from finssim.sim.packed import Packed
from finssim.sim.randomize import Draws, Randomization
from finssim.sim.ranges_file import Ranges


def draw(
    parts: dict, *, worlds: int = 200, vehicles: str | list[str] = "finsrov", seed: int = 7, seen: Packed | None = None,
    hydrodynamics: str = "calibrated", threads: int = 1, **options,
) -> tuple[Simulator, Draws]:  # fmt: skip
    """A simulator in which an episode was drawn everywhere from ranges with these parts."""
    randomization = Randomization(Ranges.model_validate({"name": "test", **parts}))
    tether = options.pop("tether", None)
    arguments = randomization.simulator_arguments(0.05, tether)
    simulator = Simulator(
        vehicles,
        worlds=worlds,
        hydrodynamics=hydrodynamics,
        threads=threads,
        seed=seed,
        **arguments,
        **options,
    )
    draws = randomization.draws(simulator, seen)
    again(simulator, draws, seed)
    return simulator, draws


def again(simulator: Simulator, draws: Draws, seed: int = 7) -> None:
    """Draw again in every world."""
    pipeline = simulator.pipeline()
    everywhere = wp.ones(simulator.worlds, dtype=wp.int32, device="cpu")
    draws.add(pipeline, everywhere, seed)
    simulator.add_refresh(pipeline, everywhere)
    pipeline.run()


def column(draws: Draws, name: str, vehicle: int = 0) -> np.ndarray:
    """Return the draws of one entry, (worlds,)."""
    return draws.numpy([name])[:, vehicle, 0].astype(float)
