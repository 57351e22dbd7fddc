"""Foreign logs to trial folders: tables, ArduSub logs, ROS 2 bags."""

from finssim.trials.importers.dispatch import FORMATS, import_trials

__all__ = ["FORMATS", "import_trials"]
