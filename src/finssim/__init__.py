"""FinsSim: describe, identify, simulate, train and deploy underwater vehicles.

    import finssim as fs

    vehicle = fs.load_vehicle("bluerov2_heavy")
    fit = fs.identify(vehicle, [fs.Trial.from_frame(frame)])
    policy = fs.train("t1", vehicle=fit.vehicle)
    result = fs.evaluate(policy, "t1")

Names are imported when they are first used, so that each costs only what it needs.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from finssim.control.policy import Policy
    from finssim.identification.fit import Fit
    from finssim.sim.model import acceleration
    from finssim.sim.simulator import Simulator
    from finssim.tasks.environment import Environment
    from finssim.trials.trial import Trial
    from finssim.vehicles.loader import catalogue, load_vehicle
    from finssim.vehicles.vehicle import Vehicle
    from finssim.workflow import evaluate, identify, run_in_pool, train

__version__ = "0.1.0"

_HOMES = {
    "Fit": "finssim.identification.fit",
    "Policy": "finssim.control.policy",
    "Simulator": "finssim.sim.simulator",
    "Trial": "finssim.trials.trial",
    "Vehicle": "finssim.vehicles.vehicle",
    "acceleration": "finssim.sim.model",
    "catalogue": "finssim.vehicles.loader",
    "evaluate": "finssim.workflow",
    "identify": "finssim.workflow",
    "load_vehicle": "finssim.vehicles.loader",
    "run_in_pool": "finssim.workflow",
    "train": "finssim.workflow",
}
"""Name -> the module that it is imported from."""

__all__ = [
    "Fit",
    "Policy",
    "Simulator",
    "Trial",
    "Vehicle",
    "__version__",
    "acceleration",
    "catalogue",
    "evaluate",
    "identify",
    "load_vehicle",
    "make",
    "run_in_pool",
    "train",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'finssim' has no attribute '{name}'")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def make(task: Any = "t1", **options: Any) -> "Environment":
    """Return the batched environment of a task; see `finssim.tasks.make`, which is imported only now."""
    from finssim.tasks import make as made

    return made(task, **options)
