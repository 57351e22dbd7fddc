"""What the commands of `finssim calibrate` share: where they write, what they show, and the line that repeats them."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console

from finssim.calibration.errors import CalibrationError
from finssim.files import atomic_directory, atomic_write, refuse_unwritable
from finssim.page import RECORD_FILE

__all__ = ["command_line", "progress_bar", "publish", "refuse_places"]


def refuse_places(out: Path, report: Path | None, kind: str) -> None:
    """Refuse a file that is no YAML, or a place that cannot be written, before anything is computed."""
    if Path(out).suffix not in (".yaml", ".yml"):
        raise CalibrationError(
            f"{out} ends in '{Path(out).suffix}', expected .yaml: name a {kind} file to write"
        )
    refuse_unwritable(atomic_write(out))
    if report is not None:
        refuse_unwritable(atomic_directory(report, replaces=RECORD_FILE))


def publish(
    record: Mapping[str, Any] | None, show: Callable[[Console], None], written: Iterable[Path | None]
) -> None:
    """Print one JSON object for programs; or, without one, for people, and which files were written."""
    if record is not None:
        print(json.dumps(record, allow_nan=False))
        return
    console = Console() if sys.stdout.isatty() else Console(width=100)
    show(console)
    for path in filter(None, written):
        console.print(f"written: {path}", highlight=False, markup=False, soft_wrap=True)


def command_line(kind: str, inputs: Iterable[Path], options: Mapping[str, Any]) -> str:
    """The command line that does this again; options that are None, False or empty are left out."""
    words = ["finssim", "calibrate", kind, *map(str, inputs)]
    for name, value in options.items():
        option = f"--{name.replace('_', '-')}"
        for item in value if isinstance(value, (list, tuple)) else [value]:
            if item is True:
                words.append(option)
            elif item is not None and item is not False:
                words += [option, str(item)]
    return shlex.join(words)


@contextmanager
def progress_bar() -> Iterator[Callable[..., None]]:
    """A bar on standard error, fed with the part done and a few words."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    screen = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=screen, transient=True, disable=not screen.is_terminal) as bars:
        bar = bars.add_task("fit", total=1.0)
        yield lambda part, words="fit": bars.update(bar, completed=part, description=words)
