"""The numbers that a bench gives a vehicle file, with their intervals and what they rest on."""

from __future__ import annotations

import math

from finssim.calibration.actuators.thruster_bench import SIDES, Bench
from finssim.calibration.actuators.thruster_target import Target
from finssim.calibration.fit import Estimate
from finssim.vehicles import Vehicle

__all__ = ["estimates_of"]

TO_RPM = 30.0 / math.pi
CHOSEN_LIMIT = 0.02
"""A force limit this far below the curve at the speed limit was chosen, not measured: it stays."""


def estimates_of(target: Target, result: Bench, vehicle: Vehicle) -> list[Estimate]:
    """Everything found about a target, named `TARGET.c_plus` and so on."""
    return [*_curve(target, result), *_limits(target, result, vehicle), *_controller(target, result)]


def _path(target: Target, key: str) -> str:
    """Where the number stands in the vehicle file; that of a group in `thruster_groups`."""
    if target.name in target.thrusters:
        return f"thrusters.{target.name}.{key}"
    return f"thrusters.*.{key}" if target.name == "all" else f"thruster_groups.{target.name}.{key}"


def _curve(target: Target, result: Bench) -> list[Estimate]:
    """c±, their ratio and the dead zone."""
    estimates = []
    for name, sign in SIDES:
        side = result.sides.get(name)
        if side is None:
            continue
        sure = math.isfinite(side.half_width) and side.c > side.half_width
        rows = f"{side.samples} rows, R² {side.r2:.4f}, rms {side.rmse:.2g} N"
        if math.isfinite(result.voltage):
            rows += f", {result.voltage:g} V"
        note = rows if sure else f"{rows}: too few or too scattered to tell"
        estimates.append(
            _estimate(target, f"c_{name}", side.c, side.half_width, "N s²/rad²", sure=sure, note=note)
        )
        zone = result.dead.get(name)
        if zone is not None:
            ends = sorted(sign * TO_RPM * end for end in zone.interval)
            estimates.append(
                Estimate(
                    name=f"{target.name}.dead_rpm_{name}",
                    estimate=sign * TO_RPM * zone.speed + 0.0,
                    ci95=(ends[0], ends[1]),
                    unit="rpm",
                    identifiable=zone.known,
                    note=zone.note or f"slowest speed that turns; {side.c * zone.speed**2:.2g} N there",
                    path=_path(target, f"dead_rpm_{name}"),
                )
            )
    if len(result.sides) == 2:
        plus, minus = result.sides["plus"], result.sides["minus"]
        ratio = minus.c / plus.c
        half = ratio * math.hypot(plus.half_width / plus.c, minus.half_width / minus.c)
        estimates.append(
            _estimate(target, "reverse_ratio", ratio, half, "-", sure=math.isfinite(half), path=False)
        )
    return estimates


def _limits(target: Target, result: Bench, vehicle: Vehicle) -> list[Estimate]:
    """Fastest speeds and the thrusts there.

    A speed limit moves where the table reached the end of the pulse, or went beyond the limit of the vehicle file. The
    force limit is the curve at the speed limit, unless the vehicle file chose a lower one.
    """
    estimates = []
    before = vehicle.thrusters[target.thrusters[0]]
    for name, sign in SIDES:
        end = "max" if sign > 0.0 else "min"
        side = result.sides.get(name)
        c = side.c if side else getattr(before, f"c_{name}")
        relative = side.half_width / side.c if side else 0.0
        old_speed = sign * getattr(before, f"rpm_{end}") / TO_RPM
        old_force = sign * getattr(before, f"force_{end}")
        speed, at_end, scatter = result.fastest[name]
        if speed <= 0.0:
            continue
        moves = at_end or speed > old_speed
        if not at_end:
            note = "beyond the vehicle file's" if moves else "the table ends here; the vehicle file's stays"
        else:
            note = f"full pulse{f' at {result.voltage:g} V' if math.isfinite(result.voltage) else ''}"
        estimates.append(
            _estimate(
                target, f"rpm_{end}", sign * speed * TO_RPM, scatter * TO_RPM, "rpm", sure=moves, note=note
            )
        )
        force = c * (speed if moves else old_speed) ** 2
        chosen = (
            old_force < (1.0 - CHOSEN_LIMIT) * getattr(before, f"c_{name}") * old_speed**2
            and old_force < force
        )
        note = "the vehicle file's own, below the curve" if chosen else f"c_{name} at the speed limit"
        value, half = (old_force, 0.0) if chosen else (force, relative * force)
        sure = not chosen and math.isfinite(half)
        estimates.append(_estimate(target, f"force_{end}", sign * value, half, "N", sure=sure, note=note))
    return estimates


def _controller(target: Target, result: Bench) -> list[Estimate]:
    """The numbers of the pulse's law."""
    if result.esc is None:
        return []
    units = {"dead": "µs", "zero": "µs", "emf": "V s/rad", "load": "V s²/rad²"}
    together = "zero, emf and load of a direction vary together: the speed they give is surer than each"
    return [
        Estimate(
            name=f"{target.name}.esc.{key}",
            estimate=float(getattr(result.esc.esc, key)),
            ci95=interval,
            unit=units[key.partition("_")[0]],
            identifiable=key not in result.esc.unsure,
            note=result.esc.unsure.get(key, "" if key.startswith("dead") else together),
            path=_path(target, f"esc.{key}"),
        )
        for key, interval in result.esc.intervals.items()
    ]


def _estimate(
    target: Target,
    key: str,
    value: float,
    half: float,
    unit: str,
    *,
    sure: bool,
    note: str = "",
    path: bool = True,
) -> Estimate:
    return Estimate(
        name=f"{target.name}.{key}",
        estimate=float(value),
        ci95=(float(value - half), float(value + half)),
        unit=unit,
        identifiable=sure,
        note=note,
        path=_path(target, key) if path else None,
    )
