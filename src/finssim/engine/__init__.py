"""The batched simulator and what surrounds its vehicles."""

from finssim.engine.plant_arrays import SimulatorError
from finssim.engine.recorder import Recorder, read_run
from finssim.engine.scene import Contact, Scene
from finssim.engine.scene_picture import PictureError
from finssim.engine.simulator import Simulator
from finssim.engine.surroundings import Dock, Pool, SurroundingsError, TetherLine, Water, Wave

__all__ = [
    "Contact",
    "Dock",
    "PictureError",
    "Pool",
    "Recorder",
    "Scene",
    "Simulator",
    "SimulatorError",
    "SurroundingsError",
    "TetherLine",
    "Water",
    "Wave",
    "read_run",
]
