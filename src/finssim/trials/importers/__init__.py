"""Foreign logs to trial folders: tables, ArduSub logs, ROS 2 bags."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.trials.importers.dispatch import FORMATS, import_trials

__all__ = ["FORMATS", "import_trials"]

__getattr__, __dir__ = exports(__name__)
