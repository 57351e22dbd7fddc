"""The batched simulator and the surroundings of its vehicles."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.sim.free_motion import linear_model
    from finssim.sim.plant_arrays import SimulatorError
    from finssim.sim.randomize import Randomization
    from finssim.sim.recorder import StateRecorder, read_run
    from finssim.sim.sensors.batch import SensorBatch
    from finssim.sim.sensors.sampling import WHITE, SampledState, normal, parameters_of, sampling_kernel
    from finssim.sim.sensors.suite import SensorSuite, add_sensor
    from finssim.sim.simulator import Simulator
    from finssim.sim.site import Dock, RectangularPool, SurroundingsError, TetherLine
    from finssim.sim.state import State
    from finssim.sim.water import CurrentProfile, SeaState, Water, Wave, load_water

__all__ = [
    "CurrentProfile",
    "Dock",
    "Randomization",
    "RectangularPool",
    "SeaState",
    "StateRecorder",
    "SensorBatch",
    "SensorSuite",
    "Simulator",
    "SimulatorError",
    "State",
    "SurroundingsError",
    "TetherLine",
    "SampledState",
    "WHITE",
    "Water",
    "Wave",
    "add_sensor",
    "linear_model",
    "load_water",
    "normal",
    "parameters_of",
    "read_run",
    "sampling_kernel",
]

__getattr__, __dir__ = exports(__name__)
