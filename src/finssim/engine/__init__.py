"""The batched simulator and what surrounds its vehicles."""

from finssim.engine.plant_arrays import SimulatorError
from finssim.engine.recorder import Recorder, read_run
from finssim.engine.simulator import Simulator
from finssim.engine.surroundings import Dock, Pool, SurroundingsError, TetherLine, Water, Wave

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
