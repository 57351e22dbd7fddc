"""Trials: recorded motion on disk and in memory, and the forces that drove the vehicle."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.trials.trial import Header, Trial
    from finssim.trials.trial_files import load_trial, write_trial

__all__ = ["Header", "Trial", "load_trial", "write_trial"]

__getattr__, __dir__ = exports(__name__)
