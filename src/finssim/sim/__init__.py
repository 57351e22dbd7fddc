"""The batched simulator and what surrounds its vehicles."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.sim.plant_arrays import SimulatorError
    from finssim.sim.recorder import Recorder, read_run
    from finssim.sim.simulator import Simulator
    from finssim.sim.site import Dock, Pool, SurroundingsError, TetherLine, Water, Wave

__all__ = [
    "Dock",
    "Pool",
    "Recorder",
    "Simulator",
    "SimulatorError",
    "SurroundingsError",
    "TetherLine",
    "Water",
    "Wave",
    "read_run",
]

__getattr__, __dir__ = exports(__name__)
