"""FinsSim: describe, identify, simulate, train and deploy underwater vehicles.

    import finssim as fs

    vehicle = fs.load_vehicle("bluerov2_heavy")
    fit = fs.identify(vehicle, [fs.Trial.from_frame(frame)])
    policy = fs.train("t1", vehicle=fit.vehicle)
    result = fs.evaluate(policy, "t1")

Names are imported when they are first used, so that a program loads only the packages that it needs.
"""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.control.policy import Policy
    from finssim.identification.fit import Fit
    from finssim.sim.model import acceleration
    from finssim.sim.simulator import Simulator
    from finssim.tasks.catalogue import make
    from finssim.trials.trial import Trial
    from finssim.vehicles.loader import catalogue, load_vehicle
    from finssim.vehicles.vehicle import Vehicle
    from finssim.workflow import evaluate, identify, run_in_pool, train

__version__ = "0.1.0"

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

__getattr__, __dir__ = exports(__name__)
