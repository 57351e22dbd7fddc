"""How well a thruster's curve and speed controller describe the tables, also those they were not fitted to."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.actuators.table_signs import STANDING
from finssim.calibration.actuators.thrust_table import ThrustTable
from finssim.calibration.actuators.thruster_bench import SIDES, Bench
from finssim.calibration.fit import Curve
from finssim.vehicles.thruster import Thruster

__all__ = ["curves_of", "predicted_thrust", "quality_of"]

Array = NDArray[np.float64]

TO_RPM = 30.0 / math.pi


def predicted_thrust(result: Bench, before: Thruster, speed: Array) -> Array:
    """T = c± ω|ω| with the fitted c±, those of the vehicle file where there is none [N]."""
    c = {
        name: result.sides[name].c if name in result.sides else getattr(before, f"c_{name}")
        for name, _ in SIDES
    }
    return np.where(speed >= 0.0, c["plus"], c["minus"]) * speed * np.abs(speed)


def quality_of(name: str, result: Bench, before: Thruster) -> dict[str, dict[str, float]]:
    """Figures of the fitted tables, and `NAME at V V` for every voltage when there are several.

    `rmse` are in N or rad/s, `nrmse` are rmse over the largest magnitude in the rows compared.
    """
    rows = _stack(result.fitted)
    figures: dict[str, float] = {}
    if result.speeds_measured:
        error = predicted_thrust(result, before, rows.speed) - rows.force
        turning = rows.speed != 0.0
        figures |= {"r2": _r2(rows.force[turning], error[turning]), "rmse": _rms(error[turning])}
        figures["samples"] = float(np.count_nonzero(turning))
        figures["rejected"] = float(sum(side.rejected for side in result.sides.values()))
        for side, word in (("plus", "forward"), ("minus", "reverse")):
            if side in result.sides:
                figures[f"r2_{word}"] = result.sides[side].r2
    if result.esc is not None:
        figures["esc_rmse"] = result.esc.rmse
        figures["esc_nrmse"] = result.esc.rmse / result.esc.fastest
    found = {name: figures}
    volts = sorted({round(v, 1) for v, _ in result.levels if not math.isnan(v)})
    for volt in volts if len(volts) > 1 else []:
        level = _stack([table for v, table in result.levels if round(v, 1) == volt])
        found[f"{name} at {volt:g} V"] = _at_voltage(result, before, level)
    return found


def _at_voltage(result: Bench, before: Thruster, table: ThrustTable) -> dict[str, float]:
    """Errors of the thrust told from the speed, and of speed and thrust told from pulse and voltage."""
    figures: dict[str, float] = {}
    largest = float(np.max(np.abs(table.force)))
    if result.speeds_measured:
        error = predicted_thrust(result, before, table.speed) - table.force
        turning = np.abs(table.speed) > STANDING * np.max(np.abs(table.speed))
        figures |= {
            "r2_thrust_from_speed": _r2(table.force[turning], error[turning]),
            "rmse_thrust_from_speed": _rms(error[turning]),
            "nrmse_thrust_from_speed": _rms(error[turning]) / largest,
        }
    if result.esc is not None:
        speed = result.esc.esc.shaft_speed(table.pulse, table.voltage)
        error = predicted_thrust(result, before, speed) - table.force
        figures |= {"rmse_thrust_from_pulse": _rms(error), "nrmse_thrust_from_pulse": _rms(error) / largest}
        if result.speeds_measured:
            error = speed - table.speed
            fastest = float(np.max(np.abs(table.speed)))
            figures |= {"rmse_speed_from_pulse": _rms(error), "nrmse_speed_from_pulse": _rms(error) / fastest}
    return figures


def curves_of(name: str, result: Bench, before: Thruster) -> list[Curve]:
    """For the report: thrust and its residual against speed; speed and thrust against pulse at every voltage."""
    rows = _stack(result.fitted)
    order = np.argsort(rows.speed)
    rpm = rows.speed[order] * TO_RPM
    fitted = predicted_thrust(result, before, rows.speed[order])
    curves = []
    if result.speeds_measured:
        force = rows.force[order]
        curves += [
            _curve(f"{name}: thrust", "shaft speed [rpm]", "thrust [N]", rpm, force, fitted),
            _curve(
                f"{name}: residual",
                "shaft speed [rpm]",
                "measured - fitted [N]",
                rpm,
                force - fitted,
                0.0 * rpm,
            ),
        ]
    if result.esc is None:
        return curves
    for volt in sorted({round(v, 1) for v, _ in result.levels if not math.isnan(v)}) or [math.nan]:
        level = _stack([table for v, table in result.levels if math.isnan(volt) or round(v, 1) == volt])
        order = np.argsort(level.pulse)
        pulse, label = level.pulse[order], "" if math.isnan(volt) else f" at {volt:g} V"
        speed = result.esc.esc.shaft_speed(pulse, level.voltage[order] if label else None)
        thrust = predicted_thrust(result, before, speed)
        axes = ("pulse [µs]", "shaft speed [rpm]")
        if result.speeds_measured:
            measured = level.speed[order] * TO_RPM
            curves.append(_curve(f"{name}: speed from pulse{label}", *axes, pulse, measured, speed * TO_RPM))
        curves.append(
            _curve(
                f"{name}: thrust from pulse{label}", axes[0], "thrust [N]", pulse, level.force[order], thrust
            )
        )
    return curves


def _curve(title: str, x_label: str, y_label: str, x: Array, measured: Array, fitted: Array) -> Curve:
    return Curve(
        title=title, x_label=x_label, y_label=y_label, x=x, measured=measured, fitted=fitted, kind="scatter"
    )


def _stack(tables: list[ThrustTable] | tuple[ThrustTable, ...]) -> ThrustTable:
    """All rows of several tables as one."""
    return ThrustTable(
        name=tables[0].name,
        speed=np.concatenate([table.speed for table in tables]),
        force=np.concatenate([table.force for table in tables]),
        pulse=np.concatenate([table.pulse for table in tables]),
        voltage=np.concatenate([table.voltage for table in tables]),
    )


def _rms(error: Array) -> float:
    good = error[np.isfinite(error)]
    return float(np.sqrt(np.mean(good**2))) if good.size else math.nan


def _r2(measured: Array, error: Array) -> float:
    total = float(np.sum((measured - np.mean(measured)) ** 2))
    return 1.0 - float(error @ error) / total if total > 0.0 else math.nan
