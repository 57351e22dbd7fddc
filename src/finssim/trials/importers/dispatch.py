"""Import of logs: selection of readers, grouping of files to trials, and writing of folders."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from finssim.core.files import plain_name
from finssim.core.importer import importers
from finssim.trials.agreement import unit_findings
from finssim.trials.findings import CalibrationError, finding
from finssim.trials.importers.assemble import merge, moved_in_time, split_table, trial_of
from finssim.trials.importers.column_map import ColumnMap, SourceMap, SplitRule, read_map, split_rule
from finssim.trials.importers.log import Request, TrialStreams, importer_of
from finssim.trials.importers.table import SUFFIXES, read_stream
from finssim.trials.trial import Trial
from finssim.trials.trial_files import load_trial, write_trial
from finssim.vehicles import load_vehicle


def print_folders(folders: Sequence[Path], as_json: bool) -> None:
    """Print the folders of the trials, one per line or as one JSON object."""
    names = [str(folder) for folder in folders]
    print(json.dumps({"trials": names}) if as_json else "\n".join(names))


def import_trials(
    logs: Sequence[Path],
    *,
    out: Path,
    column_map: Annotated[Path | None, "--map"] = None,
    format: str = "auto",
    vehicle: str | None = None,
    split: str | None = None,
    as_json: bool = False,
) -> list[Path]:
    """Convert logs to trial folders, in SI units and the body frame x forward, y left, z up.

    Example: finssim trials import dive.BIN --vehicle bluerov2 --split arming --out trials

    Args:
        logs (LOG): Logs of any format that `finssim doctor` lists as an importer of trials: tables, bags,
            logs of autopilots, ground stations and Doppler logs. Tables that a map combines form one trial.
        out (DIR): Folder for the trial folders.
        column_map (FILE): Map of the log's columns or topics, with units and frames (.yaml).
        format (FORMAT): auto (by content), or the name of an importer: csv, ardupilot, rosbag, ulog, ...
        vehicle (NAME|FILE): Vehicle of the logs; overrides the map's.
        split (RULE): Split a log into trials: by phase, gaps, gaps=SECONDS, arming or column; overrides the map's.
        as_json: Print one JSON object instead of one line per trial.

    Returns:
        The folders, in the order of their trials; repairs and omissions are reported on standard error.

    Raises:
        CalibrationError: A log or map cannot be used; nothing is written.
        OutputError: A folder contains other files, or cannot be written.
    """
    folders = []
    for trial in read_trials(logs, column_map=column_map, format=format, vehicle=vehicle, split=split):
        folders.append(Path(out) / trial.name)
        differs = _differs(folders[-1], trial)
        write_trial(trial, folders[-1])
        if differs:
            print(
                f"{trial.name}: replaced an earlier trial with other data in {folders[-1]}", file=sys.stderr
            )
        for item in (*trial.findings, *unit_findings(trial)):
            print(item.about(trial.name), file=sys.stderr)
    print_folders(folders, as_json)
    return folders


def _differs(folder: Path, trial: Trial) -> bool:
    """Return whether a folder contains another trial with other data."""
    try:
        return folder.is_dir() and load_trial(folder).sha256 != trial.sha256
    except CalibrationError:
        return False


def read_trials(
    paths: Sequence[Path],
    *,
    column_map: Path | None = None,
    format: str = "auto",
    vehicle: str | None = None,
    split: str | SplitRule | None = None,
) -> list[Trial]:
    """Return the trials in logs; see `import_trials`."""
    mapped = read_map(Path(column_map)) if column_map is not None else ColumnMap.model_validate({})
    for name in (
        vehicle or mapped.header.get("vehicle"),
        *(keys.get("vehicle") for keys in mapped.trials.values()),
    ):
        if name is not None:
            load_vehicle(name)  # refuse an unknown vehicle before any log is read
    rule = split_rule(split) if isinstance(split, str) else split or mapped.split
    trials: list[Trial] = []
    named = vehicle or mapped.header.get("vehicle")
    request = Request(mapped, load_vehicle(named) if named else None)
    for name, log in _logs([Path(path) for path in paths], request, format, column_map is not None):
        for piece, table in split_table(
            name, merge(moved_in_time(log.streams, mapped.time_offsets)), rule
        ).items():
            header = mapped.header_of(piece if piece in mapped.trials else name, vehicle, log.header)
            trials.append(trial_of(piece, table, header, mapped))
    unknown = [name for name in mapped.trials if name not in {trial.name for trial in trials}]
    if unknown and not any(trial.name.startswith(tuple(unknown)) for trial in trials):
        names = ", ".join(trial.name for trial in trials)
        raise CalibrationError(f"{column_map}: trials.{unknown[0]}: no such trial; the logs contain {names}")
    _check_names(trials)
    return trials


def _logs(paths: list[Path], request: Request, format: str, has_map: bool) -> list[tuple[str, TrialStreams]]:
    """Return the trial and content of each log or set of tables."""
    if not paths:
        raise CalibrationError("no logs given: give at least one file")
    logs: list[tuple[str, TrialStreams]] = []
    tables = []
    for path in paths:
        name = importer_of(path, format)
        mapped = any(_trial_name(pattern, path) is not None for pattern in request.mapped.files)
        if name == "csv" or (mapped and path.suffix.lower() in SUFFIXES):
            tables.append(path)
        else:
            logs.append((path.stem, importers("trial")[name].read(path, request)))
    return logs + _table_logs(tables, request.mapped, has_map)


def _table_logs(paths: list[Path], mapped: ColumnMap, has_map: bool) -> list[tuple[str, TrialStreams]]:
    """Return tables by trial: those for which `{trial}` or the first `*` of their patterns matches the same text."""
    if paths and has_map and not mapped.files:
        raise CalibrationError(
            f"the map has no entry for files such as {paths[0].name}: give 'files:' or 'columns:'"
        )
    by_trial: dict[str, list[tuple[str, Path, SourceMap | None]]] = {}
    unread = []
    for path in paths:
        hits = [
            (pattern, trial) for pattern in mapped.files if (trial := _trial_name(pattern, path)) is not None
        ]
        if not hits and mapped.files:
            unread.append(path.name)
        elif len(hits) > 1:
            raise CalibrationError(
                f"{path.name} fits {hits[0][0]} and {hits[1][0]} of the map: make the patterns distinct"
            )
        else:
            pattern, trial = hits[0] if hits else ("", path.stem)
            by_trial.setdefault(trial, []).append((pattern, path, mapped.files.get(pattern)))
    if not by_trial and unread:
        raise CalibrationError(f"{unread[0]} fits none of the files of the map: {', '.join(mapped.files)}")
    logs: list[tuple[str, TrialStreams]] = []
    for trial, sources in by_trial.items():
        if len(paths) == 1 and sources[0][0] in mapped.files and not set("*{") & set(sources[0][0]):
            trial = paths[0].stem  # a single file gives its name
        patterns = [pattern for pattern, _, _ in sources]
        for pattern in patterns:
            if patterns.count(pattern) > 1:
                same = [path for p, path, _ in sources if p == pattern]
                if not pattern:
                    raise CalibrationError(
                        f"{', '.join(map(str, same))} have the same name, '{trial}', which names the trial: rename "
                        "one, or import them to different folders"
                    )
                twice = ", ".join(path.name for path in same)
                raise CalibrationError(
                    f"{twice} all fit {pattern} of the map for one trial: use {{trial}} in it"
                )
        missing = [pattern for pattern in mapped.files if pattern not in patterns]
        streams = [read_stream(path, source) for _, path, source in sources]
        streams[0] = streams[0].noting(*(finding("file_missing", pattern=p) for p in missing))
        excluded = [name for name in unread if len(by_trial) == 1 or name.startswith(trial)]
        streams[0] = streams[0].noting(*(finding("file_left_out", file=name) for name in excluded))
        logs.append((trial, TrialStreams(streams)))
    return logs


def _trial_name(pattern: str, path: Path) -> str | None:
    """Return the trial that a file belongs to, or None if the pattern does not match."""
    # Without {trial} the first * is the trial's name; without either, the folder is.
    before, mark, after = pattern.partition("{trial}" if "{trial}" in pattern else "*")
    hit = re.fullmatch(
        _expression(before) + ("(?P<trial>.+?)" if mark else "") + _expression(after), path.name
    )
    if hit is None:
        return None
    return hit["trial"].removesuffix(path.suffix).strip() if mark else path.parent.resolve().name


def _expression(pattern: str) -> str:
    """Convert a pattern with * and ? to a regular expression."""
    return "".join(".*" if c == "*" else "." if c == "?" else re.escape(c) for c in pattern)


def _check_names(trials: list[Trial]) -> None:
    """Refuse names that are not valid folder names or occur twice; they may come from maps, patterns or log names."""
    names = set()
    for trial in trials:
        plain_name(trial.name, "trial", CalibrationError)
        if trial.name in names:
            raise CalibrationError(
                f"two logs result in a trial '{trial.name}': import them one by one, or rename a file"
            )
        names.add(trial.name)
