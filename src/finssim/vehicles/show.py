"""Printing vehicles: the catalogue, and one vehicle in full."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from finssim.core.registry import TERMS, VEHICLES
from finssim.vehicles.capability import restoring, terminal_speeds, time_constants, wrench_capability
from finssim.vehicles.check import check_vehicle
from finssim.vehicles.defaults import DEFAULTS
from finssim.vehicles.hydrodynamics import HydrodynamicSet, MeshSet
from finssim.vehicles.loader import load_vehicle
from finssim.vehicles.vehicle import AXES, ORIGINS, Vehicle

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from rich.console import Console

__all__ = ["draw_vehicle", "print_catalogue", "print_motions", "print_vehicle", "vehicle_data"]


_MARK = {"measured": "", "published": "", "derived": " ·", "guessed": " ?"}
_LEGEND = "no mark: measured or published    · derived    ? guessed"


WIDE = 110
"""Terminal width from which the hydrodynamic sets have a separate column in the catalogue [columns]."""


def print_catalogue(console: Console) -> None:
    """Print one line for each vehicle of FinsSim and of installed packages."""
    table = Table(title="Vehicles", title_justify="left", box=None, pad_edge=False)
    for column in ("name", "mass\n[kg]", "thrusters", "axes"):
        table.add_column(Text(column), justify="left" if column == "name" else "right", no_wrap=True)
    wide = console.width >= WIDE
    for column in ("hydrodynamics", "description") if wide else ("description",):
        table.add_column(column)
    for name in sorted(VEHICLES.usable()):
        vehicle = load_vehicle(name)
        numbers = (f"{vehicle.body.mass:g}", len(vehicle.thrusters), len(vehicle.controlled_axes))
        words = (" ".join(vehicle.hydrodynamics), vehicle.title) if wide else (vehicle.title,)
        table.add_row(f"[bold]{name}[/bold]", *map(str, numbers), *map(escape, words))
    console.print(table)


def print_vehicle(vehicle: Vehicle, console: Console) -> None:
    """Print everything about one vehicle: numbers with their origin, its capability, and the results of its checks.

    Args:
        vehicle: Vehicle of the catalogue or of a user's file.
        console: Console to print on.
    """
    console.print(f"[bold]{escape(vehicle.title)}[/bold]")
    console.print(escape(vehicle.description.strip()))
    counts = Counter(provenance.origin for provenance in vehicle.provenance.values())
    console.print(
        f"\n{vehicle.name}  {vehicle.path or ''}\nsha256 {vehicle.sha256}\n"
        f"numbers: {', '.join(f'{count} {origin}' for origin, count in counts.most_common())}    {_LEGEND}\n",
        highlight=False,
        markup=False,
    )
    for record in vehicle.calibrations:
        console.print(f"calibrated: {record.sentence()}", highlight=False, markup=False)
    for table in _tables(vehicle):
        console.print(table)


def print_motions(top: float, motions: Mapping[str, tuple[str, str, float | None]], console: Console) -> None:
    """Print the uncontrolled motion of a vehicle.

    Args:
        top: Top speed [m/s].
        motions: Motion -> behaviour at rest and at top speed, and the speed above which it is unstable [m/s].
        console: Console to print on.
    """
    heads = ("", "at rest", f"at {top:.2f} m/s", "unstable above [m/s]")
    items = motions.items()
    rows = ((n, rest, fast, "-" if above is None else f"{above:.2f}") for n, (rest, fast, above) in items)
    console.print(_table("Without control (level, actuators and fins held)", heads, rows, words=True))


def vehicle_data(vehicle: Vehicle) -> dict[str, Any]:
    """Return a vehicle as plain data: its values and the capability of each axis, in the order of `AXES`.

    Wrenches are in N and N m, terminal speeds in m/s and rad/s, time constants in s; None if undefined.
    """
    capability = wrench_capability(vehicle)
    sets = [name for name, chosen in vehicle.hydrodynamics.items() if isinstance(chosen, HydrodynamicSet)]

    def by_set(function: Any) -> dict[str, list[float | None]]:
        return {s: [x if math.isfinite(x) else None for x in function(vehicle, s).tolist()] for s in sets}

    return {
        "name": vehicle.name,
        "file": None if vehicle.path is None else str(vehicle.path),
        "sha256": vehicle.sha256,
        "values": json.loads(json.dumps(vehicle.values(), default=str)),
        "payloads": {name: load.values() for name, load in vehicle.payloads.items()},
        "wrench_positive": capability.positive.tolist(),
        "wrench_negative": capability.negative.tolist(),
        "terminal_speeds": by_set(terminal_speeds),
        "time_constants": by_set(time_constants),
        "checks": [
            {"name": f.name, "passed": f.passed, "remark": f.remark, "text": f.sentence}
            for f in check_vehicle(vehicle)
        ],
    }


def _tables(vehicle: Vehicle) -> Iterator[Table]:
    yield _table("Body", ("", "value", "unit"), _body(vehicle))
    if vehicle.payloads:
        rho, g = vehicle.water.density, vehicle.water.gravity
        heads = ("", "mass [kg]", "volume [m³]", "position [m]", "weight in water [N]")
        loads = (
            (escape(n), f"{x.mass:g}", f"{x.volume:g}", _rounded(x.position), f"{g * (x.mass - rho * x.volume):.2f}")
            for n, x in vehicle.payloads.items()
        )  # fmt: skip
        yield _table("Payloads (contained in the body above)", heads, loads)
    for name, chosen in vehicle.hydrodynamics.items():
        if isinstance(chosen, MeshSet):
            path = f"hydrodynamics.{name}"
            numbers = (f"{getattr(chosen, key):g}{_mark(vehicle, f'{path}.{key}')}" for key in DRAG)
            yield _table(
                f"Hydrodynamics: {name}", ("", "form drag", "skin drag"), [("coefficient", *numbers)]
            )
            continue
        yield _table(f"Hydrodynamics: {name} (diagonals)", ("", *AXES), _matrices(vehicle, name, chosen))
        if chosen.terms:
            yield _table(f"Terms: {name}", ("", "value", "unit"), _terms(vehicle, name, chosen))
    heads = ("", "position [m]", "axis", "force [N]", "rpm", "lag [s]", "acts on", "motor")
    yield _table("Thrusters", heads, _thrusters(vehicle))
    if vehicle.actuators:
        heads = ("", "kind", "position [m]", "travel", "rate [1/s]", "lag [s]", "play")
        yield _table("Other actuators (angles in rad, volumes in m³, lengths in m)", heads, _others(vehicle))
    if "sensors" not in vehicle.defaults:
        heads = ("", "kind", "position [m]", "rate [Hz]", "latency [s]", "lost")
        aboard = (
            (n, vehicle.sensors.kind_of(n), _rounded(s.position), f"{s.rate:g}", f"{s.latency:g}", f"{s.dropout:.1%}")
            for n, s in vehicle.sensors.by_name.items()
        )  # fmt: skip
        yield _table("Sensors", heads, aboard)
    if "perception" not in vehicle.defaults:
        heads = ("", "device", "position [m]", "rate [Hz]", "latency [s]", "lost")
        sensors = (
            (n, escape(Path(s.device).name), _rounded(s.position), f"{s.rate:g}", f"{s.latency:g}", f"{s.dropout:.1%}")
            for n, s in vehicle.perception.items()
        )  # fmt: skip
        yield _table("Cameras, sonars, altimeters", heads, sensors)
    title = "Capability (each axis alone, about the wrench reference)"
    yield _table(title, ("", *AXES), _performance(vehicle))
    heads = ("numbers", "origin", "source and note")
    yield _table("Sources of the numbers", heads, _sources(vehicle), words=True)
    if vehicle.defaults:
        title = "Defaults (missing in the file: for simulation only; measure your own)"
        rows = ((name, escape(DEFAULTS[name])) for name in vehicle.defaults)
        yield _table(title, ("", "default"), rows, words=True)
    marks = {(True, False): "[green]pass[/green]", (True, True): "[yellow]note[/yellow]"}
    found = (
        (marks.get((f.passed, f.remark), "[red]fail[/red]"), f.name, escape(f.sentence))
        for f in check_vehicle(vehicle)
    )
    yield _table("Checks", ("", "check", "finding"), found, words=True)


DRAG = ("form_drag", "skin_drag")


def _table(title: str, heads: Sequence[str], rows: Iterable[Sequence[str]], *, words: bool = False) -> Table:
    """Return a table of right-aligned numbers with their names, or of text."""
    table = Table(title=Text(title, "bold"), title_justify="left", box=None, pad_edge=False)
    for k, head in enumerate(heads):
        table.add_column(Text(head), justify="left" if words or k == 0 else "right", overflow="fold")
    for row in rows:
        table.add_row(*row)
    return table


def _mark(vehicle: Vehicle, path: str) -> str:
    """Return the mark of a number, or of the least reliable entry of a list whose entries differ in origin."""
    entries = [p.origin for key, p in vehicle.provenance.items() if key.startswith(f"{path}.")]
    if not entries:
        return _MARK[vehicle.origin_of(path).origin]
    return _MARK[max(entries, key=ORIGINS.index)]


def _numbers(values: Any) -> str:
    return " ".join(f"{value:g}" for value in values)


def _rounded(vector: Any) -> str:
    return " ".join(f"{value:6.3f}" for value in vector)


def _body(vehicle: Vehicle) -> Iterator[Sequence[str]]:
    body = vehicle.body
    for label, path, value, unit in (
        ("mass", "body.mass", f"{body.mass:g}", "kg"),
        ("inertia, roll pitch yaw", "body.inertia", _numbers(np.diag(body.inertia)), "kg m²"),
        ("displaced volume", "body.displaced_volume", f"{body.displaced_volume:g}", "m³"),
        ("centre of gravity", "body.center_of_gravity", _numbers(body.center_of_gravity), "m"),
        ("centre of buoyancy", "body.center_of_buoyancy", _numbers(body.center_of_buoyancy), "m"),
        ("size", "body.size", _numbers(body.size), "m"),
        ("water density", "water.density", f"{vehicle.water.density:g}", "kg/m³"),
    ):
        yield label, value + _mark(vehicle, path), unit
    yield "weight, buoyancy", f"{vehicle.weight:.2f} {vehicle.buoyancy:.2f}", "N"


def _matrices(vehicle: Vehicle, name: str, chosen: HydrodynamicSet) -> Iterator[Sequence[str]]:
    for label, key in (("M_A", "added_mass"), ("D1", "linear_damping"), ("D2", "quadratic_damping")):
        matrix = getattr(chosen, key)
        if np.any(matrix):
            full = bool(np.any(matrix - np.diag(np.diag(matrix))))
            paths = (f"hydrodynamics.{name}.{key}.{i}" + (f".{i}" if full else "") for i in range(6))
            cells = (f"{x:.6g}{_mark(vehicle, path)}" for x, path in zip(np.diag(matrix), paths, strict=True))
            yield label + (" (full)" if full else ""), *cells


def _terms(vehicle: Vehicle, name: str, chosen: HydrodynamicSet) -> Iterator[Sequence[str]]:
    for key, value in chosen.terms.items():
        units = iter(TERMS[key].units.values())
        for path, number in TERMS[key].numbers(value).items():
            full = f"hydrodynamics.{name}.{path}"
            rows = np.atleast_2d(number)
            for i, row in enumerate(rows):
                stated = any(
                    f"{full}.".startswith(f"{other}.") or other.startswith(f"{full}.")
                    for other in vehicle.provenance
                )
                marks = _mark(vehicle, f"{full}.{i}" if len(rows) > 1 else full) if stated else ""
                yield path if i == 0 else "", _numbers(row) + marks, next(units) if i == 0 else ""


def _thrusters(vehicle: Vehicle) -> Iterator[Sequence[str]]:
    for name, t in vehicle.thrusters.items():
        path = f"thrusters.{name}"
        yield (
            escape(name),
            _rounded(t.position),
            _rounded(t.axis),
            f"{t.force_min:.2f} {t.force_max:+.2f}{_mark(vehicle, f'{path}.force_max')}",
            f"{t.rpm_min:.0f} {t.rpm_max:+.0f}",
            f"{t.delay:g} + {t.time_constant:g}{_mark(vehicle, f'{path}.time_constant')}",
            t.domain,
            "" if t.motor_index is None else f"M{t.motor_index + 1} {t.motor_sign:+d}",
        )


def _others(vehicle: Vehicle) -> Iterator[Sequence[str]]:
    for name, actuator in vehicle.actuators.items():
        path, place = f"actuators.{name}", getattr(actuator, "position", None)
        yield (
            escape(name),
            actuator.kind,
            "" if place is None else _rounded(place),
            f"{actuator.minimum:g} {actuator.maximum:+g}{_mark(vehicle, f'{path}.maximum')}",
            "" if math.isinf(actuator.rate_limit) else f"{actuator.rate_limit:g}",
            f"{actuator.time_constant:g}",
            f"{actuator.play:g}",
        )


def _performance(vehicle: Vehicle) -> Iterator[Sequence[str]]:
    def cells(values: Any) -> Iterator[str]:
        return (f"{value:.3f}" if math.isfinite(value) else "-" for value in values)

    capability = wrench_capability(vehicle)
    yield "wrench + [N, N m]", *cells(capability.positive)
    yield "wrench - [N, N m]", *cells(capability.negative)
    for name, chosen in vehicle.hydrodynamics.items():
        if isinstance(chosen, HydrodynamicSet):
            swing, of = restoring(vehicle, name), escape(f"({name})")
            yield f"{escape('speed [m/s, rad/s]')} {of}", *cells(terminal_speeds(vehicle, name))
            yield f"{escape('time constant [s]')} {of}", *cells(time_constants(vehicle, name))
            yield f"{escape('natural frequency [Hz]')} {of}", "", "", "", *cells(swing.natural_frequency), ""
            yield f"damping ratio {of}", "", "", "", *cells(swing.damping_ratio), ""


def _sources(vehicle: Vehicle) -> Iterator[Sequence[str]]:
    entries: dict[tuple[str, str, str], list[str]] = {}
    for path, provenance in vehicle.provenance.items():
        entries.setdefault((provenance.origin, provenance.source, provenance.note), []).append(path)
    for (origin, source, note), paths in entries.items():
        text = paths[0] if len(paths) == 1 else f"{paths[0]} and {len(paths) - 1} more"
        yield escape(text), origin, escape("; ".join(filter(None, [source, note])))


# Picture of a vehicle's thruster layout.

ARROW = 0.16
"""Length of a thrust arrow, relative to the vehicle's length."""


def draw_vehicle(vehicle: Vehicle, picture: Path) -> None:
    """Save a picture of the thruster layout, from above and from the left, with arrows along positive thrust.

    Args:
        vehicle: Vehicle to draw.
        picture: File to write; its suffix determines the format.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 5.2), layout="constrained")
    above, side = figure.subplots(1, 2)
    # Forward points up in the top view and left in the side view: both horizontal axes are reversed.
    _draw_view(above, vehicle, across=1, up=0)
    above.set(title="from above", xlabel="y, left [m]", ylabel="x, forward [m]")
    _draw_view(side, vehicle, across=0, up=2)
    side.set(title="from the left", xlabel="x, forward [m]", ylabel="z, up [m]")
    handles, labels = above.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    figure.suptitle(vehicle.title)
    figure.savefig(picture, dpi=130)


def _envelope(vehicle: Vehicle) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lower and upper corner of the hull's mesh, or of the envelope placed about the centre of
    buoyancy."""
    if vehicle.hull is not None:
        vertices, _ = vehicle.hull_mesh()
        return vertices.min(axis=0), vertices.max(axis=0)
    half = vehicle.body.size / 2.0
    return vehicle.body.center_of_buoyancy - half, vehicle.body.center_of_buoyancy + half


def _draw_view(axes: Axes, vehicle: Vehicle, across: int, up: int) -> None:
    """Draw one projection, seen along the axis that is neither `across` nor `up`; `across` increases to the left."""
    from matplotlib.patches import Rectangle
    from matplotlib.ticker import MaxNLocator

    lower, upper = _envelope(vehicle)
    size = upper - lower
    axes.add_patch(
        Rectangle((lower[across], lower[up]), size[across], size[up], fc="0.95", ec="0.6", label="envelope")
    )
    length = ARROW * float(max(size[across], size[up]))
    named: Counter[tuple[int, int]] = Counter()
    for name, thruster in vehicle.thrusters.items():
        x, y = float(thruster.position[across]), float(thruster.position[up])
        dx, dy = float(thruster.axis[across]), float(thruster.axis[up])
        axes.plot(x, y, "o", ms=4, color="C0")
        if np.hypot(dx, dy) > 0.1:
            arrow = {"arrowstyle": "-|>", "color": "C0", "lw": 1.6, "shrinkA": 0, "shrinkB": 0}
            axes.annotate("", xy=(x + length * dx, y + length * dy), xytext=(x, y), arrowprops=arrow)
        else:  # towards or away from the viewer
            axes.plot(
                x, y, "o" if thruster.axis[3 - across - up] > 0.0 else "x", ms=11, mfc="none", color="C0"
            )
        cell = (round(x / length), round(y / length))
        below = dy >= 0.0
        offset = (0.0, -15.0 - 10.0 * named[cell] if below else 8.0 + 10.0 * named[cell])
        axes.annotate(
            name, (x, y), xytext=offset, textcoords="offset points", ha="center", fontsize=8, color="0.2"
        )
        named[cell] += 1
    axes.plot(*vehicle.body.center_of_gravity[[across, up]], "k+", ms=11, mew=2, label="centre of gravity")
    axes.plot(
        *vehicle.body.center_of_buoyancy[[across, up]], "r^", ms=7, mfc="none", label="centre of buoyancy"
    )
    axes.plot(0.0, 0.0, "s", color="0.3", ms=4, mfc="none", label="body origin")
    pad = 0.15 * float(max(size[across], size[up]))
    axes.set(
        xlim=(upper[across] + pad, lower[across] - pad),
        ylim=(lower[up] - pad, upper[up] + pad),
        aspect="equal",
    )
    axes.xaxis.set_major_locator(MaxNLocator(3 if size[across] < 0.5 * size[up] else 6))
    axes.yaxis.set_major_locator(MaxNLocator(3 if size[up] < 0.5 * size[across] else 6))
    axes.grid(True, color="0.9", lw=0.5)
    axes.set_axisbelow(True)
