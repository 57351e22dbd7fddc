"""All that decides what an environment does next, as NumPy arrays: a run that goes on from them is the same run."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.tasks.given import EnvironmentSetupError

if TYPE_CHECKING:
    from finssim.tasks.environment import Environment


def save_state(environment: "Environment") -> dict[str, NDArray[Any]]:
    """Copies of the vehicles' states, delay lines, water, the task's arrays and all counters.

    Returns:
        Arrays by name, such as `state.position` or `plant.mass`; the counters under `counters.`.
    """
    simulator = environment.simulator
    saved = {name: np.array(array.numpy()) for name, array in _arrays(environment)}
    saved["counters.seed"] = np.array(environment.seed)
    saved["counters.steps"] = np.array(environment._steps)
    reported = sorted(simulator._reported)
    if environment.drawing.schedule is not None:
        saved["counters.schedule"] = np.array(environment.drawing.schedule._steps)
    if environment.levels is not None:
        saved.update(environment.levels.state())
    saved["counters.reported"] = np.array(reported, dtype=np.int64).reshape(-1, 2)
    return saved


def load_state(environment: "Environment", saved: Mapping[str, NDArray[Any]]) -> None:
    """Bring an environment that was made alike to where `save_state` left another; arrays keep their memory.

    Raises:
        EnvironmentSetupError: The environment was made with other arguments: a name or shape does not fit.
    """
    if (environment.levels is None) == ("counters.level" in saved):
        where = "has levels and the saved state has none" if environment.levels else "has no levels"
        raise EnvironmentSetupError(
            f"saved state does not fit: the environment {where}: make it with the same arguments"
        )
    _set_seed(environment, int(saved["counters.seed"]))
    if environment.levels is not None:
        environment.levels.load(saved)
    arrays = dict(_arrays(environment))
    wanted = {name for name in saved if not name.startswith("counters.")}
    if arrays.keys() != wanted:
        name = min(arrays.keys() ^ wanted)
        where = "is not in the saved state" if name in arrays else "is in the saved state alone"
        raise EnvironmentSetupError(
            f"saved state does not fit: '{name}' {where}: make the environment with the same arguments"
        )
    for name, array in arrays.items():
        shape = array.numpy().shape
        if saved[name].shape != shape:
            raise EnvironmentSetupError(
                f"saved state does not fit: '{name}' has shape {saved[name].shape}, expected {shape}: "
                "make the environment with the same arguments"
            )
    for name, array in arrays.items():
        array.assign(np.ascontiguousarray(saved[name]))
    environment.simulator.compare_worlds()
    environment._steps = int(saved["counters.steps"])
    if environment.drawing.schedule is not None:
        environment.drawing.schedule._steps = int(saved["counters.schedule"])
    environment.simulator._reported = {(int(w), int(e)) for w, e in saved["counters.reported"]}


def _set_seed(environment: "Environment", seed: int) -> None:
    if seed != environment.seed:
        environment.reset(seed=seed)


def _arrays(environment: "Environment") -> Iterator[tuple[str, wp.array]]:
    """Every array that a step or a reset reads from an earlier one, by name."""
    simulator = environment.simulator
    for name, packed in (("plant", simulator.plant), ("command", simulator.command)):
        yield from ((f"{name}.{field}", array) for field, array in packed.fields.items())
    yield from ((f"drawing.{name}", array) for name, array in environment.drawing.arrays())
    for name, struct in (
        ("state", simulator.state),
        ("water", simulator.water),
        ("task", environment.arrays),
    ):
        yield from _members(name, struct)
    if environment.sensing is not None:
        for name, struct in environment.sensing.arrays():
            yield from _members(name, struct)


def _members(prefix: str, struct: Any) -> Iterator[tuple[str, wp.array]]:
    """The arrays of a Warp struct and of the structs in it; those of structs are left to the views of their fields."""
    for name in struct._cls.vars:
        value = getattr(struct, name)
        if isinstance(value, wp.array):
            if value.size and not hasattr(value.dtype, "numpy_dtype"):
                yield f"{prefix}.{name}", value
        elif hasattr(value, "_cls"):
            yield from _members(f"{prefix}.{name}", value)
