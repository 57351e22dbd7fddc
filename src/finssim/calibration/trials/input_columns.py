"""Which columns of a trial tell what drove the vehicle."""

from __future__ import annotations

from finssim.calibration.errors import CalibrationError
from finssim.calibration.trials.columns import INPUT_PREFIXES, TAU
from finssim.calibration.trials.trial import Trial
from finssim.vehicles import Vehicle
from finssim.vehicles.part import did_you_mean

__all__ = ["ORDER", "first_complete", "input_columns"]

ORDER = ("rpm_", "force_", "tau", "pwm_", "command_")
"""Inputs from the one that tells most of what acted to the one that tells least."""


def input_columns(trial: Trial, vehicle: Vehicle) -> dict[str, list[str]]:
    """Input columns that hold numbers, by kind, in canonical order.

    Raises:
        CalibrationError: One names a thruster that the vehicle has not.
    """
    return {kind: _columns(trial, vehicle, kind) for kind in ORDER}


def first_complete(present: dict[str, list[str]], trial: Trial, vehicle: Vehicle) -> str:
    """The kind of input that tells most of what acted, of those that are there for every thruster.

    Of a wrench any axis will do.

    Raises:
        CalibrationError: None is.
    """
    for kind in ORDER:
        if present[kind] and (kind == "tau" or len(present[kind]) == len(vehicle.thrusters)):
            return kind
    raise CalibrationError(f"{trial.name}: {_what_is_missing(present, trial, vehicle)}")


def _columns(trial: Trial, vehicle: Vehicle, kind: str) -> list[str]:
    if kind == "tau":
        return [name for name in TAU if trial.has(name)]
    names = {c.removeprefix(kind): c for c in trial.channels if c.startswith(kind)}
    for name, column in names.items():
        if name not in vehicle.thrusters:
            meant = next((own for own in vehicle.thrusters if own.lower() == name.lower()), name)
            raise CalibrationError(
                f"{trial.name}: {column}: {vehicle.name} has no thruster '{name}'"
                f"{did_you_mean(meant, list(vehicle.thrusters))} it has {', '.join(vehicle.thrusters)}"
            )
    return [names[name] for name in vehicle.thrusters if name in names and trial.has(names[name])]


def _what_is_missing(present: dict[str, list[str]], trial: Trial, vehicle: Vehicle) -> str:
    for kind in ORDER:
        if present[kind]:
            missing = [f"{kind}{n}" for n in vehicle.thrusters if f"{kind}{n}" not in present[kind]]
            return (
                f"{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing, expected a column for each of "
                f"the {len(vehicle.thrusters)} thrusters of {vehicle.name}: give zeros for a thruster that never ran"
            )
    prefixes = ", ".join(f"{prefix}NAME" for prefix in INPUT_PREFIXES)
    return (
        f"no input columns, expected tau_x ... tau_n or one of {prefixes} for each thruster: log what drove the "
        "vehicle, or write 'passive: true' in trial.yaml if the thrusters were off"
    )
