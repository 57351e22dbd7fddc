"""Experiments: the paper's metrics, setpoints and figures."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.evaluation.evaluate import Evaluations, evaluate_controller
    from finssim.evaluation.plants import load_plant
    from finssim.evaluation.trials import TrialSettings

__all__ = [
    "Evaluations",
    "TrialSettings",
    "evaluate_controller",
    "load_plant",
]

__getattr__, __dir__ = exports(__name__)
