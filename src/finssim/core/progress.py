"""Progress of long work on standard error."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from rich.console import Console

Progress = Callable[..., None]
"""Function of the completed fraction, 0 to 1, and optionally the name of the next step."""
EVERY = 10.0
"""Time between two lines of progress without a terminal [s]."""


_SHOWN: ContextVar[bool] = ContextVar("progress_shown", default=True)


@contextmanager
def silent(silenced: bool = True) -> Iterator[None]:
    """Show no progress while the block runs, for functions that a script or a notebook calls."""
    token = _SHOWN.set(_SHOWN.get() and not silenced)
    try:
        yield
    finally:
        _SHOWN.reset(token)


@contextmanager
def progress_bar(name: str, *, visible: bool = True) -> Iterator[Progress]:
    """Show progress on standard error: a bar on a terminal, otherwise a line immediately and one every ten seconds.

    Args:
        name: Name of the work.
        visible: False to show nothing.

    Yields:
        A function of the completed fraction and, optionally, the name of the next step.
    """
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    screen = Console(stderr=True)
    if not (visible and _SHOWN.get()):
        yield lambda part, text="": None
        return
    if not screen.is_terminal:
        yield _lines(name, screen)
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Bar(*columns, console=screen, transient=True) as bars:
        bar = bars.add_task(name, total=1.0)
        yield lambda part, text=name: bars.update(bar, completed=part, description=text)


def _lines(name: str, screen: Console) -> Progress:
    """Return a progress function that prints its first call, and then a line every `EVERY` seconds."""
    began = time.monotonic()
    last = -EVERY

    def report(part: float, text: str = "") -> None:
        nonlocal last
        spent = time.monotonic() - began
        if spent < last + EVERY:
            return
        last = spent
        left = f", about {spent / part - spent:.0f} s left" if part > 0.02 and spent > EVERY else ""
        words = f"{name}: {text}" if text else name
        screen.print(f"{words} ({part:.0%}{left})", highlight=False, markup=False, soft_wrap=True)

    return report
