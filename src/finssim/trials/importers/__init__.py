"""Importers of logs from other programs to trial folders: one file per format."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.trials.importers.dispatch import import_trials

__all__ = ["import_trials"]

__getattr__, __dir__ = exports(__name__)
