"""What every fit asks of the trials and axes that it is given."""

from __future__ import annotations

from collections.abc import Sequence

from finssim.calibration.errors import CalibrationError
from finssim.calibration.trials.trial import Trial
from finssim.vehicles import AXES

__all__ = ["require_axes", "require_fittable"]


def require_fittable(trials: Sequence[Trial]) -> None:
    """Refuse trials that no fit may use.

    Raises:
        CalibrationError: There are none, two share a name, or one is held out.
    """
    if not trials:
        raise CalibrationError("no trials were given, expected at least one to fit")
    names = [trial.name for trial in trials]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise CalibrationError(f"two trials are called '{min(twice)}', expected a name for each: rename one")
    for trial in trials:
        if trial.header.role == "held-out":
            raise CalibrationError(
                f"{trial.name}: its header says that it is held out: fit on other trials and replay this one"
            )


def require_axes(axes: Sequence[str] | None) -> None:
    """Refuse words that name no axis.

    Raises:
        CalibrationError: It says which there are.
    """
    for axis in axes or ():
        if axis not in AXES:
            raise CalibrationError(f"unknown axis '{axis}'; available: {', '.join(AXES)}")
