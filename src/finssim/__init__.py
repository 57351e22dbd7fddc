"""FinsSim: calibrate, simulate, train and deploy underwater robots through one set of interfaces.

The parts are imported by name, so that each costs only what it needs:

    from finssim.vehicles import load_vehicle
    from finssim.engine import Simulator
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from finssim.tasks.environment import Environment

__all__ = ["__version__", "make"]

__version__ = "0.1.0"


def make(task: Any = "t1", **options: Any) -> "Environment":
    """The batched environment of a task: see `finssim.tasks.make`, which is imported only now."""
    from finssim.tasks import make as made

    return made(task, **options)
