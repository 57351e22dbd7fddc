"""Real-to-sim: calibration of a vehicle from logs of trials, with uncertainty."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.identification.fit import Curve, Estimate, Fit
    from finssim.identification.prediction import Replay, replay
    from finssim.identification.programme import Programme, programmes
    from finssim.identification.synthetic import simulate_programme
    from finssim.identification.vehicle_file import calibrated, write_vehicle

__all__ = [
    "Curve",
    "Estimate",
    "Fit",
    "Programme",
    "Replay",
    "calibrated",
    "programmes",
    "replay",
    "simulate_programme",
    "write_vehicle",
]

__getattr__, __dir__ = exports(__name__)
