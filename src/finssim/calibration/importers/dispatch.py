"""The importer: which reader a file needs, which files make one trial, and the folders that are written."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

from finssim.calibration.errors import CalibrationError
from finssim.calibration.importers.assemble import trial_of
from finssim.calibration.importers.column_map import ColumnMap, SplitRule, read_map, split_rule
from finssim.calibration.importers.finssim_record import recorded_header
from finssim.calibration.importers.rosbag import BAGS, bag_files, read_bag
from finssim.calibration.importers.source_map import SourceMap
from finssim.calibration.importers.split import split_table
from finssim.calibration.importers.streams import Stream, merge
from finssim.calibration.importers.tables import TABLES, read_table
from finssim.calibration.trials.trial import Trial
from finssim.files import plain_name
from finssim.vehicles import load_vehicle

__all__ = ["FORMATS", "Format", "import_trials", "read_trials"]

Format = Literal["auto", "csv", "ardupilot", "rosbag"]
FORMATS: tuple[Format, ...] = get_args(Format)

Group = tuple[str, list[Stream], dict[str, Any]]

ARDUPILOT = (".bin", ".tlog")


def import_trials(
    paths: Sequence[Path],
    *,
    out: Path,
    column_map: Path | None = None,
    format: Format = "auto",
    vehicle: str | None = None,
    split: str | SplitRule | None = None,
    say: Callable[[str], None] | None = None,
) -> list[Path]:
    """Make trial folders of logs.

    Args:
        paths: Tables, ArduSub logs, bags. Tables and bags that belong together make one trial.
        out: Folder in which the trial folders are made.
        column_map: Map file; not needed for ArduSub logs, nor where names and types tell enough.
        format: Kind of the logs; by their suffix if `auto`.
        vehicle: Name or file of the vehicle; before the map's.
        split: What makes several trials of one log; before the map's.
        say: Told each note about what was repaired or left out.

    Returns:
        The folders, in the order of their trials.

    Raises:
        CalibrationError: A log or map that cannot be used; nothing is written then.
        OutputError: A folder that holds other files, or cannot be written.
    """
    from finssim.calibration.trials.trial_files import write_trial

    trials = read_trials(paths, column_map=column_map, format=format, vehicle=vehicle, split=split)
    folders = []
    for trial in trials:
        folder = Path(out) / trial.name
        write_trial(trial, folder)
        folders.append(folder)
        if say is not None:
            for note in trial.notes:
                say(f"{trial.name}: {note}")
    return folders


def read_trials(
    paths: Sequence[Path],
    *,
    column_map: Path | None = None,
    format: Format = "auto",
    vehicle: str | None = None,
    split: str | SplitRule | None = None,
) -> list[Trial]:
    """The trials that logs hold; see `import_trials`."""
    if format not in FORMATS:
        raise CalibrationError(f"format is '{format}', expected one of {', '.join(FORMATS)}")
    mapped = read_map(Path(column_map)) if column_map is not None else ColumnMap.model_validate({})
    for name in (
        vehicle or mapped.header.get("vehicle"),
        *(keys.get("vehicle") for keys in mapped.trials.values()),
    ):
        if name is not None:
            load_vehicle(name)  # an unknown one is refused before any log is read
    rule = split_rule(split) if isinstance(split, str) else split or mapped.split
    trials: list[Trial] = []
    for name, streams, recorded in _groups(
        [Path(path) for path in paths], mapped, format, vehicle, column_map is not None
    ):
        for piece, table in split_table(name, merge(streams), rule).items():
            header = mapped.header_of(piece if piece in mapped.trials else name, vehicle, recorded)
            trials.append(trial_of(piece, table, header, mapped))
    unknown = [name for name in mapped.trials if name not in {trial.name for trial in trials}]
    if unknown and not any(trial.name.startswith(tuple(unknown)) for trial in trials):
        names = ", ".join(trial.name for trial in trials)
        raise CalibrationError(f"{column_map}: trials.{unknown[0]}: no such trial; the logs make {names}")
    _check_names(trials)
    return trials


def _groups(
    paths: list[Path], mapped: ColumnMap, format: Format, vehicle: str | None, has_map: bool
) -> list[Group]:
    """Trial, streams and what the log says for the header, for each log or set of tables."""
    if not paths:
        raise CalibrationError("no logs given: give at least one file")
    groups: list[Group] = []
    tables = []
    for path in paths:
        if not path.exists():
            raise CalibrationError(f"{path}: no such file")
        kind = _kind(path) if format == "auto" else format
        if kind == "ardupilot":
            from finssim.calibration.importers.ardusub import read_ardusub

            name = vehicle or mapped.header.get("vehicle")
            pulses = not mapped.header.get("passive", False)
            body = load_vehicle(name) if name else None
            groups.append((path.stem, read_ardusub(path, mapped.ardusub, body, pulses=pulses), {}))
        elif kind == "rosbag":
            recorded, notes = recorded_header(path)
            notes = [] if vehicle or mapped.header.get("vehicle") else notes
            first, *others = read_bag(path, mapped.topics)
            groups.append((path.stem, [first.noting(*notes), *others], recorded))
        else:
            tables.append(path)
    return groups + _table_groups(tables, mapped, has_map)


def _kind(path: Path) -> Format:
    suffix = path.suffix.lower()
    if suffix in ARDUPILOT:
        return "ardupilot"
    if bag_files(path):
        return "rosbag"
    if suffix in TABLES:
        return "csv"
    raise CalibrationError(
        f"{path}: unknown kind of log: expected {', '.join((*TABLES, *ARDUPILOT, *BAGS))} or the folder of a ROS 2 "
        "bag, or give --format"
    )


def _table_groups(paths: list[Path], mapped: ColumnMap, has_map: bool) -> list[Group]:
    """Tables by trial: those for which `{trial}` or the first `*` of their patterns stands for the same text."""
    if paths and has_map and not mapped.files:
        raise CalibrationError(
            f"the map says nothing about files such as {paths[0].name}: give 'files:' or 'columns:'"
        )
    found: dict[str, list[tuple[str, Path, SourceMap | None]]] = {}
    unread = []
    for path in paths:
        hits = [
            (pattern, trial) for pattern in mapped.files if (trial := _trial_name(pattern, path)) is not None
        ]
        if not hits and mapped.files:
            unread.append(path.name)
        elif len(hits) > 1:
            raise CalibrationError(
                f"{path.name} fits {hits[0][0]} and {hits[1][0]} of the map: make them differ"
            )
        else:
            pattern, trial = hits[0] if hits else ("", path.stem)
            found.setdefault(trial, []).append((pattern, path, mapped.files.get(pattern)))
    if not found and unread:
        raise CalibrationError(f"{unread[0]} fits none of the files of the map: {', '.join(mapped.files)}")
    groups: list[Group] = []
    for trial, sources in found.items():
        if len(paths) == 1 and sources[0][0] in mapped.files and not set("*{") & set(sources[0][0]):
            trial = paths[0].stem  # a single file has a name of its own
        patterns = [pattern for pattern, _, _ in sources]
        for pattern in patterns:
            if patterns.count(pattern) > 1:
                twice = ", ".join(path.name for p, path, _ in sources if p == pattern)
                raise CalibrationError(
                    f"{twice} all fit {pattern} of the map for one trial: use {{trial}} in it"
                )
        missing = [pattern for pattern in mapped.files if pattern not in patterns]
        streams = [read_table(path, source) for _, path, source in sources]
        streams[0] = streams[0].noting(*(f"no file fits {pattern} of the map" for pattern in missing))
        left_out = [name for name in unread if len(found) == 1 or name.startswith(trial)]
        streams[0] = streams[0].noting(
            *(f"{name} is in no pattern of the map and is left out" for name in left_out)
        )
        groups.append((trial, streams, {}))
    return groups


def _trial_name(pattern: str, path: Path) -> str | None:
    """The trial that a file belongs to, or None where the pattern does not fit."""
    # Without {trial} the first * stands for the trial; without either, the folder does.
    before, mark, after = pattern.partition("{trial}" if "{trial}" in pattern else "*")
    hit = re.fullmatch(
        _expression(before) + ("(?P<trial>.+?)" if mark else "") + _expression(after), path.name
    )
    if hit is None:
        return None
    return hit["trial"].removesuffix(path.suffix) if mark else path.parent.resolve().name


def _expression(pattern: str) -> str:
    """A pattern with * and ? as a regular expression."""
    return "".join(".*" if c == "*" else "." if c == "?" else re.escape(c) for c in pattern)


def _check_names(trials: list[Trial]) -> None:
    """Each name is a folder's, and no other trial's: maps and patterns make them as well as names of logs."""
    seen = set()
    for trial in trials:
        plain_name(trial.name, "trial", CalibrationError)
        if trial.name in seen:
            raise CalibrationError(
                f"two logs make a trial '{trial.name}': import them one by one, or rename a file"
            )
        seen.add(trial.name)
