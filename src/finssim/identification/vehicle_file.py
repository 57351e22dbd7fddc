"""Calibration results as files: the vehicle with a fit's changes, origins and comments, and ranges for
randomisation."""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
import textwrap
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from finssim.core.files import atomic_write
from finssim.core.provenance import provenance
from finssim.core.registry import ACTUATORS, TERMS
from finssim.core.yaml_file import read_mapping, yaml_text
from finssim.identification.fit import Estimate, Fit
from finssim.identification.plant_terms import matrices
from finssim.trials.findings import CalibrationError, Finding, finding, plain
from finssim.vehicles import (
    AXES,
    CalibrationRecord,
    HydrodynamicSet,
    Provenance,
    Vehicle,
    VehicleError,
    check_vehicle,
    load_vehicle,
)

__all__ = [
    "all_findings", "calibrated", "estimate_at", "file_tree", "folded", "retained_values", "leaves",
    "number_in", "number_origins", "scaled_thrust", "write_vehicle",
]  # fmt: skip

Key = tuple[str, ...]


def file_tree(vehicle: Vehicle) -> dict[str, Any]:
    """Return the values in the vehicle's file, with diagonal matrices represented by their diagonals."""
    return dict(_shortened(vehicle.values()))


def leaves(node: Any, path: Key = ()) -> Iterator[tuple[Key, float]]:
    """Yield path and value of every number below a node of plain values. Values have the units of the file."""
    if isinstance(node, Mapping):
        for key, value in node.items():
            yield from leaves(value, (*path, str(key)))
    elif isinstance(node, list):
        for i, value in enumerate(node):
            yield from leaves(value, (*path, str(i)))
    elif isinstance(node, (int, float)) and not isinstance(node, bool):
        yield path, node


def number_origins(vehicle: Vehicle) -> dict[Key, Provenance]:
    """Return the origin of every number of `file_tree(vehicle)`, by path; calibration records are not included."""
    return {path: vehicle.origin_of(".".join(full_path)) for path, full_path, _ in numbers(vehicle)}


def numbers(vehicle: Vehicle) -> Iterator[tuple[Key, Key, float]]:
    """Yield every number of `file_tree(vehicle)`: its path there, its path in `vehicle.values()`, and its value.

    The two paths differ in a diagonal matrix, where the tree has one row; calibration records are omitted.
    """
    tree, values = file_tree(vehicle), vehicle.values()
    tree.pop("calibrations", None)
    for path, value in leaves(tree):
        yield path, (*path, path[-1]) if isinstance(_at(values, path), list) else path, value


def folded(tree: Any, origins: Mapping[Key, Provenance]) -> dict[str, Provenance]:
    """Return origins by dotted path, as on reading the file: one entry for a list whose numbers share their
    origin."""
    folded_origins: dict[str, Provenance] = {}
    _fold(tree, (), origins, folded_origins)
    return folded_origins


def _fold(
    node: Any, path: Key, origins: Mapping[Key, Provenance], result: dict[str, Provenance]
) -> Provenance | None:
    """Record the origins below a node; return the common origin of a number or list, which the caller records."""
    if isinstance(node, Mapping):
        for key, value in node.items():
            common = _fold(value, (*path, str(key)), origins, result)
            if common is not None:
                result[".".join((*path, str(key)))] = common
        return None
    if isinstance(node, list):
        parts = [_fold(value, (*path, str(i)), origins, result) for i, value in enumerate(node)]
        if parts and parts[0] is not None and all(part == parts[0] for part in parts):
            return parts[0]
        for i, part in enumerate(parts):
            if part is not None:
                result[".".join((*path, str(i)))] = part
        return None
    return origins.get(path)


def _shortened(node: Any) -> Any:
    if isinstance(node, dict):
        return {key: value if key == "calibrations" else _shortened(value) for key, value in node.items()}
    square = isinstance(node, list) and len(node) in (3, 6)
    if square and all(isinstance(row, list) and len(row) == len(node) for row in node):
        matrix = np.array(node)
        if not np.any(matrix - np.diag(np.diag(matrix))):
            return np.diag(matrix).tolist()
    return list(node) if isinstance(node, tuple) else node


def _at(tree: Any, path: Key) -> Any:
    for key in path:
        tree = tree[int(key)] if isinstance(tree, list) else tree[key if key in tree else int(key)]
    return tree


# Text of a vehicle file: sections in the catalogue's order, origins at the highest possible level, units.

WIDTH = 118
"""Longest line of descriptive text."""
LONG = 180
"""Longest line of a section of `SINGLE_LINE`."""

UNITS = read_mapping(Path(__file__).with_name("units.yaml"), CalibrationError, such_as="mass: kg")
"""Key -> unit of its value, written after it as a comment."""

SINGLE_LINE = (("water",), ("hull",), ("thrusters", "*"), ("tags", "mounts", "*"), ("perception", "*"))
"""Sections that are written on one line if they fit."""


def vehicle_text(tree: Mapping[str, Any], origins: Mapping[Key, Provenance]) -> str:
    """Return the YAML text of a vehicle file.

    Args:
        tree: Plain values by section, including `title`, `description` and `calibrations`.
        origins: Origin of every number in it, by path.
    """
    prose = ("title", "description", "calibrations")
    body = {key: value for key, value in tree.items() if key not in prose}
    sections = Counter(_common(node, (key,), origins, None) for key, node in body.items())
    del sections[None]
    common = sections.most_common(1)[0][0] if sections else None
    lines = [f"title: {_word(tree['title'])}", *_prose(str(tree["description"]))]
    lines += [f"{key}: {_word(text)}" for key, text in _marks(common, None).items()]
    for key, node in body.items():
        lines += ["", *_lines(key, _annotated(node, (key,), common, origins), (key,), "")]
    text = "\n".join(lines) + "\n"
    if tree.get("calibrations"):
        text += "\n# Calibrations of the numbers above, oldest first: trial -> SHA-256 of its content.\n"
        text += yaml_text({"calibrations": tree["calibrations"]}, default_flow_style=False, width=math.inf)
    return text


def _annotated(node: Any, path: Key, inherited: Provenance | None, origins: Mapping[Key, Provenance]) -> Any:
    """Return a node with the marks that state the origins of its numbers relative to an inherited one."""
    if isinstance(node, Mapping):
        common = _common(node, path, origins, inherited)
        inner = {key: _annotated(v, (*path, str(key)), common, origins) for key, v in node.items()}
        return _marks(common, inherited) | inner
    origin, value = origins.get(path, inherited), node
    if isinstance(node, list):
        each = {origins.get(leaf) for leaf, _ in leaves(node, path)}
        origin = inherited if len(each) > 1 else next(iter(each), None)
        value = [_annotated(item, (*path, str(i)), origin, origins) for i, item in enumerate(node)]
    marks = _marks(origin, inherited)
    return {"value": value} | marks if marks else value


def _lines(key: Any, node: Any, path: Key, pad: str) -> Iterator[str]:
    """Yield the lines of `key: node`: sections as blocks, numbers and rows of numbers on one line each."""
    head = f"{pad}{_word(key)}:"
    flow = f"{head} {_word(node)}"
    unit = f"  # [{_unit(path)}]" if _unit(path) else ""
    short = not node or (_on_single_line(path) and len(flow) <= LONG)
    if isinstance(node, Mapping) and not short and not ("value" in node and not _rows(node["value"])):
        yield head + unit
        for inner, value in node.items():
            yield from _lines(inner, value, (*path, str(inner)), pad + "  ")
    elif _rows(node):
        yield head + unit
        yield from _items(node, pad + "  ")
    else:
        yield flow + unit


def _items(rows: list[Any], pad: str) -> Iterator[str]:
    """Yield the items of a list on one line each; a row whose entries have long notes on one line per entry."""
    for item in rows:
        flow = f"{pad}- {_word(item)}"
        if _rows(item) and len(flow) > LONG:
            yield f"{pad}-"
            yield from _items(item, pad + "  ")
        else:
            yield flow


def _rows(node: Any) -> bool:
    """Return whether a node is a list with nested lists or mappings."""
    return isinstance(node, list) and any(isinstance(item, (list, Mapping)) for item in node)


def _unit(path: Key) -> str:
    """Return the unit of the value at a path; empty if there is none to write."""
    term = TERMS.get(path[2]) if path[0] == "hydrodynamics" and len(path) > 2 else None
    return str((UNITS if term is None else term.units).get(path[-1], ""))


def _common(
    node: Any, path: Key, origins: Mapping[Key, Provenance], inherited: Provenance | None
) -> Provenance | None:
    """Return the origin to state for a section: that of most of its values, counting a list once.

    Values of one origin and source with different notes share the section's origin, with their own notes.
    """
    values = dict.fromkeys(
        (leaf[:-1] if leaf[-1].isdigit() else leaf, origins[leaf])
        for leaf, _ in leaves(node, path)
        if leaf in origins
    )
    counts = Counter(origin[:2] for _, origin in values)
    if not counts:
        return inherited
    best = max(counts, key=lambda pair: (counts[pair], inherited is not None and pair == inherited[:2]))
    notes = Counter(origin.note for _, origin in values if origin[:2] == best)
    if inherited is not None and inherited[:2] == best and inherited.note in notes:
        return inherited
    # A value without a note in a section with one would need its origin and source again.
    return Provenance(*best, "" if "" in notes else notes.most_common(1)[0][0])


def _marks(origin: Provenance | None, inherited: Provenance | None) -> dict[str, str]:
    """Return the marks by which the inherited origin is changed to another one."""
    if origin is None or origin == inherited:
        return {}
    if inherited is not None and origin.origin == inherited.origin:
        if origin.source == inherited.source and origin.note:
            return {"note": origin.note}
        if origin.source and origin.source != inherited.source:
            return {"source": origin.source} | ({"note": origin.note} if origin.note else {})
    marks = {"origin": str(origin.origin), "source": origin.source, "note": origin.note}
    return {mark: text for mark, text in marks.items() if text}


def _on_single_line(path: Key) -> bool:
    return any(
        len(path) == len(pattern) and all(p in ("*", q) for p, q in zip(pattern, path, strict=True))
        for pattern in SINGLE_LINE
    )


def _word(value: Any) -> str:
    """Return a value as YAML on one line, valid inside a list or mapping."""
    return yaml_text([value], default_flow_style=True, width=math.inf).strip()[1:-1]


def _prose(text: str) -> list[str]:
    """Return the description as a folded block, or in quotes if folding would change it."""
    body = text.rstrip("\n")
    lines = textwrap.wrap(body, WIDTH - 2, break_long_words=False, break_on_hyphens=False)
    if not lines or " ".join(lines) != body or len(text) - len(body) > 1 or not body.isprintable():
        return [f"description: {json.dumps(text, ensure_ascii=False)}"]
    return [f"description: {'>' if text.endswith(chr(10)) else '>-'}", *(f"  {line}" for line in lines)]


PER_THRUSTER = ("position", "axis", "group", "motor_index", "motor_sign")
"""Keys of a single thruster; the others are written for its group if all members agree."""


def write_vehicle(vehicle: Vehicle, path: str | os.PathLike[str]) -> None:
    """Write a self-contained vehicle file: every number with its origin, and the calibration records.

    Reading it yields the same `sha256` and the same origins. A hull mesh and device files are copied beside
    it, with a part of their digest in the name, unless they are already there; the licence notice of a mesh,
    `NAME.NOTICE`, is copied with it.

    Args:
        vehicle: Vehicle to write.
        path: File to write, .yaml; an earlier file is replaced.

    Raises:
        CalibrationError: The file has another suffix.
        OutputError: The file cannot be written.
    """
    target = yaml_path(path, "vehicle")
    tree, origins = file_tree(vehicle), number_origins(vehicle)
    tree, origins = _grouped(tree, origins)
    with atomic_write(target) as temporary:
        if vehicle.hull is not None and vehicle.hull.file is not None:
            tree["hull"]["file"] = _beside(vehicle.hull.file, target)
        for entry in tree.get("perception", {}).values():
            if Path(entry["device"]).is_absolute():
                entry["device"] = _beside(Path(entry["device"]), target)
        temporary.write_text(vehicle_text(tree, origins), encoding="utf-8")
        if load_vehicle(temporary).sha256 != vehicle.sha256:
            raise RuntimeError(f"{path}: the file would not contain the same vehicle; nothing was written")


def yaml_path(path: str | os.PathLike[str], kind: str) -> Path:
    """Return the path of a vehicle, ranges, pool or camera file to write.

    Raises:
        CalibrationError: The path does not end in .yaml or .yml.
    """
    target = Path(path)
    if target.suffix not in (".yaml", ".yml"):
        raise CalibrationError(
            f"{path} ends in '{target.suffix}', expected .yaml: name a {kind} file to write"
        )
    return target


def _beside(mesh: Path, target: Path) -> str:
    """Return the name of a mesh or device file beside the target, copied there if necessary; no other file is
    overwritten."""
    folder = Path(os.path.realpath(target)).parent
    if mesh.resolve().parent == folder:
        return mesh.name
    data = mesh.read_bytes()
    name = f"{mesh.stem}-{hashlib.sha256(data).hexdigest()[:8]}"
    copy = folder / f"{name}{mesh.suffix}"
    if not (copy.is_file() and copy.read_bytes() == data):
        with atomic_write(copy) as temporary:
            temporary.write_bytes(data)
    notice = mesh.with_suffix(".NOTICE")
    if notice.is_file():
        with atomic_write(folder / f"{name}.NOTICE") as temporary:
            shutil.copyfile(notice, temporary)
    return copy.name


def _grouped(
    tree: dict[str, Any], origins: dict[tuple[str, ...], Provenance]
) -> tuple[dict[str, Any], dict[tuple[str, ...], Provenance]]:
    """Move numbers that all thrusters of a group share, with one origin, to `thruster_groups`."""
    groups: dict[str, dict[str, Any]] = {}
    origins = dict(origins)
    thrusters = {name: dict(values) for name, values in tree["thrusters"].items()}
    for group in dict.fromkeys(t["group"] for t in thrusters.values() if t.get("group")):
        members = [name for name, values in thrusters.items() if values.get("group") == group]
        first = members[0]
        shared = [
            key
            for key in thrusters[first]
            if key not in PER_THRUSTER
            and all(_same(key, first, member, thrusters, origins) for member in members[1:])
        ]
        groups[group] = {key: thrusters[first][key] for key in shared}
        for key in shared:
            for path, _ in leaves(thrusters[first][key], ("thrusters", first, key)):
                origins[("thruster_groups", group, *path[2:])] = origins[path]
            for member in members:
                del thrusters[member][key]
    result: dict[str, Any] = {}
    for section, values in tree.items():
        if section == "thrusters":
            if groups:
                result["thruster_groups"] = groups
            first_keys = ("group", "position", "axis")  # in the usual order
            result["thrusters"] = {
                name: {key: own[key] for key in first_keys if key in own} | own
                for name, own in thrusters.items()
            }
        else:
            result[section] = dict(values) if isinstance(values, dict) else values
    return result, origins


def _same(
    key: str,
    first: str,
    member: str,
    thrusters: Mapping[str, Any],
    origins: Mapping[tuple[str, ...], Provenance],
) -> bool:
    """Return whether two thrusters have the same value and origin for a key."""
    if key not in thrusters[member] or thrusters[first][key] != thrusters[member][key]:
        return False
    paths = [path for path, _ in leaves(thrusters[first][key], (key,))]
    return all(origins[("thrusters", first, *p)] == origins[("thrusters", member, *p)] for p in paths)


# Conversion of a fit to a vehicle: the determined numbers, each with its origin and interval, and the record.


SCALED = ("c_plus", "c_minus", "force_min", "force_max")
"""Numbers of a thruster that are multiplied by `thrust_scale`."""


def scaled_thrust(vehicle: Vehicle, scale: float, gains: Sequence[float] = ()) -> dict[str, float]:
    """Return the changes of the vehicle file that multiply every thrust by a scale, and by individual gains
    if given [-]."""
    gains = gains or [1.0] * len(vehicle.thrusters)
    return {
        f"thrusters.{name}.{key}": scale * gain * float(getattr(thruster, key))
        for (name, thruster), gain in zip(vehicle.thrusters.items(), gains, strict=True)
        for key in SCALED
    }


def calibrated(fit: Fit) -> Vehicle:
    """Return the vehicle with the numbers that the fit determined; all others keep their values and origins.

    The origin of a changed number is `measured`, with its 95 % interval as the note. The record of the
    calibration, with the digests of its trials, is appended to those of the vehicle.

    Raises:
        CalibrationError: The estimates do not form a vehicle that can be simulated.
    """
    before = fit.before
    number = len(before.calibrations) + 1
    record = _calibration_record(fit)
    source = f"calibration {number}: {record.sentence()}"
    try:
        # Seven digits: far more than any interval requires, and a readable file.
        changes = plain(fit.changes, 7)
        after = before.replace(changes, Provenance("measured", source)) if changes else before
    except VehicleError as error:
        raise CalibrationError(
            f"the estimates do not form a valid vehicle: {error}: use fewer axes, or trials that excite them more"
        ) from None
    old_values = dict(leaves(before.values()))
    changed = [tuple(path.split(".")) for path in fit.changes]
    origins = {}
    for path, full_path, value in numbers(after):
        estimate = _estimate_of(path, fit.estimates, after)
        if estimate is None and path[0] == "thrusters" and path[-1] in SCALED:
            estimate = fit.estimates.get("thrust_scale")
        determined = estimate is not None and estimate.identifiable and _covers(changed, path, after)
        if old_values.get(full_path) == value and not determined:
            origins[path] = before.origin_of(".".join(full_path))
        else:
            origins[path] = Provenance("measured", source, _note(estimate, value))
    tree = file_tree(after)
    tree.pop("calibrations", None)
    return after.model_copy(
        update={"provenance": folded(tree, origins), "calibrations": (*before.calibrations, record)}
    )


def retained_values(fit: Fit, vehicle: Vehicle) -> dict[str, float]:
    """Return the parameters in the vehicle file that the fit did not change, with their values.

    Values have the units of the estimates.

    Args:
        fit: The fit.
        vehicle: `calibrated(fit)`.
    """
    retained = {}
    for name, estimate in fit.estimates.items():
        if estimate.path is None:
            continue
        before, after = number_in(fit.before, estimate.path), number_in(vehicle, estimate.path)
        if before is not None and before == after and not estimate.identifiable:
            retained[name] = float(file_number(estimate, fit.before) or 0.0)
    return retained


def file_number(estimate: Estimate, vehicle: Vehicle) -> float | None:
    """Return the vehicle's own number for an estimate, in its unit; None if it is not in the vehicle file."""
    if estimate.path is None:
        return None
    if estimate.name == "buoyancy_excess":
        return float(matrices(vehicle).excess)
    if estimate.name in ("roll.k", "pitch.k"):
        return float(matrices(vehicle).arm[2])
    return number_in(vehicle, estimate.path)


def all_findings(fit: Fit, vehicle: Vehicle) -> list[Finding]:
    """Return the findings of a fit, and those about its vehicle: checks that it fails but its predecessor
    passed, and a fit without results.

    Args:
        fit: The fit.
        vehicle: `calibrated(fit)`.
    """
    passed = {check.name for check in check_vehicle(fit.before) if check.passed}
    findings = [*fit.findings]
    findings += [
        finding("check_failed", check=check.name, sentence=check.sentence)
        for check in check_vehicle(vehicle)
        if not check.passed and check.name in passed
    ]
    for subject, figures in fit.quality.items():
        r2 = figures.get("r2", math.nan)
        if r2 < 0.0:
            findings.append(finding("further_than_mean", subject, r2=r2))
    return findings if fit.changes else [*findings, finding("nothing_determined")]


def number_in(vehicle: Vehicle, path: str) -> float | None:
    """Return the number at a dotted path of the vehicle file, for `*` and groups that of the first thruster;
    None if there is none.

    It has the unit of the file.
    """
    keys = tuple(path.split("."))
    for leaf, full_path, value in numbers(vehicle):
        if _same_number(keys, leaf, vehicle) or keys == full_path:
            return value
    # A coupling of a matrix that is given by its diagonal in the file.
    return dict(leaves(vehicle.values())).get(keys)


def estimate_at(path: str, fit: Fit, vehicle: Vehicle) -> Estimate | None:
    """Return the estimate of the number at a dotted path, or None; an entry of a matrix is given by row and
    column."""
    leaf = tuple(path.split("."))
    return _estimate_of(leaf, fit.estimates, vehicle) or (
        _estimate_of(leaf[:-1], fit.estimates, vehicle) if leaf[-1] == leaf[-2] else None
    )


def _calibration_record(fit: Fit) -> CalibrationRecord:
    origin = provenance()
    return CalibrationRecord(
        kind=fit.kind,  # type: ignore[arg-type]
        method=fit.method,
        trials=dict(fit.trials),
        settings=plain(fit.settings),
        start=fit.before.sha256,
        finssim=origin["finssim"],
        revision=origin["revision"],
        interrupted=fit.interrupted,
    )


def _covers(changes: Sequence[Key], leaf: Key, vehicle: Vehicle) -> bool:
    """Return whether one of the changes set this number, or a list or section that contains it."""
    return any(
        _same_number(change, leaf[: len(change)], vehicle) or _same_number(change, leaf, vehicle)
        for change in changes
    )


def _same_number(pattern: Key, leaf: Key, vehicle: Vehicle) -> bool:
    """Return whether a path of an estimate or change refers to a number of the file's tree.

    `*` matches any name; `thruster_groups.G.x` is x of every thruster of G; an entry of a diagonal matrix may
    be given by row and column or by row alone.
    """
    if pattern[0] == "thruster_groups" and leaf[0] == "thrusters" and len(leaf) > 1:
        thruster = vehicle.thrusters.get(leaf[1])
        if thruster is None or thruster.group != pattern[1]:
            return False
        pattern = ("thrusters", leaf[1], *pattern[2:])
    shapes = [leaf]
    if leaf[-1].isdigit():
        shapes.append((*leaf, leaf[-1]))
    return any(
        len(pattern) == len(shape) and all(p in ("*", q) for p, q in zip(pattern, shape, strict=True))
        for shape in shapes
    )


def _estimate_of(leaf: Key, estimates: Mapping[str, Estimate], vehicle: Vehicle) -> Estimate | None:
    for estimate in estimates.values():
        if estimate.path is not None and _same_number(tuple(estimate.path.split(".")), leaf, vehicle):
            return estimate
    return None


def _note(estimate: Estimate | None, value: float) -> str:
    """Return a text such as `95 % interval 37.9 to 40.2`, with the estimate itself if the file contains a
    derived number."""
    if estimate is None:
        return ""
    low, high = estimate.ci95
    text = f"95 % interval {low:.4g} to {high:.4g}" if math.isfinite(low) and math.isfinite(high) else ""
    if text and not math.isclose(estimate.estimate, value, rel_tol=1e-6):
        text = f"from {estimate.name} {estimate.estimate:.4g} {estimate.unit}, {text}"
    return "; ".join(filter(None, [text, estimate.note]))


# Ranges for domain randomisation from the intervals of a calibration.

NARROWEST = 0.02
"""Least variation of a determined parameter in both directions: intervals include noise, but no model errors."""
WIDEST = (0.0, 5.0)
"""Limits of the factors."""
UNDETERMINED_RANGE = (0.5, 2.0)
"""Range of parameters that the trials could not determine, or that are guesses in the vehicle file."""
OTHER = (0.9, 1.1)
"""Range of parameters that were not estimated, and are not guesses in the vehicle file."""

FAMILIES = ("added_mass", "linear_damping", "quadratic_damping")


class Factor(NamedTuple):
    """Range of a factor, and the reason for it."""

    low: float
    high: float
    why: str


def write_ranges(fit: Fit, path: str | os.PathLike[str], vehicle: Vehicle | None = None) -> None:
    """Write a ranges file for `finssim train --randomize`, around the calibrated vehicle.

    A factor on a number of the vehicle file is drawn uniformly between

    - the ends of its 95 % interval over the estimate, if the trials determine it, with at least 2 % in both
      directions;
    - 0.5 and 2, if they do not, or if it is a guess in the vehicle file;
    - 0.9 and 1.1, if it was not estimated and has another origin in the file.

    The numbers are drawn independently, although the errors of linear and quadratic damping are negatively
    correlated: the drag varies by more than the data allow, never by less.

    Args:
        fit: The fit.
        path: File to write, .yaml.
        vehicle: `calibrated(fit)`, if it is already computed.

    Raises:
        CalibrationError: The file has another suffix, or the vehicle has no calibrated set.
        OutputError: The file cannot be written.
    """
    from finssim.sim.ranges_file import load_ranges  # imports Warp, which other fits do not need

    target = yaml_path(path, "ranges")
    vehicle = calibrated(fit) if vehicle is None else vehicle
    tree = dict[str, Any]()
    for entry, factor in range_factors(fit, vehicle).items():
        _insert(tree, entry, factor)
    lines = [
        "# Factors on the numbers of the calibrated vehicle. determined: 95 % interval over the estimate, at",
        "# least 2 % to either side; undetermined by the trials, or guessed: half to double; not fitted: 0.9 to 1.1.",
        f'source: "95 % intervals, {vehicle.calibrations[-1].sentence()}; vehicle {vehicle.sha256[:16]}"',
        *_factor_lines(tree),
    ]
    with atomic_write(target) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
        load_ranges(temporary)


def range_factors(fit: Fit, vehicle: Vehicle) -> dict[str, Factor]:
    """Return every factor by its path in the ranges file, such as `linear_damping.surge` or `delay`.

    Args:
        fit: The fit.
        vehicle: `calibrated(fit)`.
    """
    chosen = vehicle.hydrodynamics.get("calibrated")
    if not isinstance(chosen, HydrodynamicSet):
        raise CalibrationError(f"{vehicle.name} has no hydrodynamic set 'calibrated' to vary")
    factors = {}
    for family in FAMILIES:
        matrix = getattr(chosen, family)
        for i, axis in enumerate(AXES):
            if matrix[i, i] != 0.0:  # a factor on zero has no effect
                path = f"hydrodynamics.calibrated.{family}.{i}.{i}"
                factors[f"{family}.{axis}"] = _factor(path, fit, vehicle)
    for path in chosen.term_scalars:
        if chosen.term_parameters[path] != 0.0:
            factors[path] = _factor(f"hydrodynamics.calibrated.{path}", fit, vehicle)
    excess = fit.estimates.get("buoyancy_excess")
    if excess is not None and excess.identifiable:
        low, high = ((vehicle.weight + x) / (vehicle.weight + excess.estimate) for x in excess.ci95)
        factors["volume"] = Factor(low, high, "determined")
    for kind, key in (name.split(".", 1) for name in fit.estimates if name.partition(".")[0] in ACTUATORS):
        factors[f"{kind}.{key}"] = _of_estimate(fit.estimates[f"{kind}.{key}"])
    scale = fit.estimates.get("thrust_scale")
    if scale is not None:
        factors["thrust.all"] = _of_estimate(scale)
    names = list(vehicle.thrusters)
    factors["thrust.each"] = _around(
        _factor(f"thrusters.{name}.{key}", fit, vehicle) for name in names for key in ("c_plus", "c_minus")
    )
    for key in ("time_constant", "delay"):
        paths = [f"thrusters.{name}.{key}" for name in names if getattr(vehicle.thrusters[name], key) > 0.0]
        if paths and all(_stated(vehicle, path) for path in paths):
            factors[key] = _around(_factor(path, fit, vehicle) for path in paths)
    return factors


def _factor(path: str, fit: Fit, vehicle: Vehicle) -> Factor:
    estimate = estimate_at(path, fit, vehicle)
    if estimate is not None:
        return _of_estimate(estimate)
    if vehicle.origin_of(path).origin == "guessed":
        return Factor(*UNDETERMINED_RANGE, "guessed")
    return Factor(*OTHER, "not fitted")


def _of_estimate(estimate: Estimate) -> Factor:
    """Return the range for an estimate."""
    low, high = estimate.ci95
    if not (
        estimate.identifiable and math.isfinite(low) and math.isfinite(high) and estimate.estimate != 0.0
    ):
        return Factor(*UNDETERMINED_RANGE, "undetermined")
    low, high = sorted((low / estimate.estimate, high / estimate.estimate))
    low, high = min(low, 1.0 - NARROWEST), max(high, 1.0 + NARROWEST)
    return Factor(max(low, WIDEST[0]), min(high, WIDEST[1]), "determined")


def _around(factors: Iterable[Factor]) -> Factor:
    """Return the range that contains all factors."""
    every = list(factors)
    reason = ", ".join(dict.fromkeys(factor.why for factor in every))
    return Factor(min(f.low for f in every), max(f.high for f in every), reason)


def _stated(vehicle: Vehicle, path: str) -> bool:
    return any(path == stated or stated.startswith(f"{path}.") for stated in vehicle.provenance)


def _factor_lines(tree: Mapping[str, Any], pad: str = "") -> Iterator[str]:
    """Yield the YAML lines of factors, each with its reason."""
    for key, node in tree.items():
        if isinstance(node, Factor):
            yield f"{pad}{key}: [{node.low:.4g}, {node.high:.4g}]  # {node.why}"
        else:
            yield f"{pad}{key}:"
            yield from _factor_lines(node, pad + "  ")


def _insert(tree: dict[str, Any], entry: str, drawn: Any) -> None:
    """Insert a factor at its path in a ranges file: `linear_damping.surge` under `axes` of its family."""
    *above, key = entry.split(".")
    for name in [*above, "axes"] if key in AXES else above:
        tree = tree.setdefault(name, {})
    tree[key] = drawn
