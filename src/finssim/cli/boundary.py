"""Error handling of the command line: expected errors become one sentence instead of a traceback."""

from __future__ import annotations

import os
import re
import sys
import warnings
from collections.abc import Sequence
from types import TracebackType
from typing import TextIO

import typer

from finssim.cli.doctor import EXTRA_OF_MODULE
from finssim.core.system import caused_by_interrupt, lost_interrupts_repeated

REFUSED = 2
INTERRUPTED = 130


def run(app: typer.Typer, arguments: Sequence[str], *, script: str | None = None) -> int:
    """Run a command, and print a refusal as one sentence on standard error.

    A refusal is a usage error, an error of the system (OSError), too little memory, an extra that is not
    installed, or an exception raised by FinsSim's own code to refuse an input (ValueError, with its
    families). Any other exception is a bug of FinsSim and keeps its traceback. With FINSSIM_DEBUG=1 in the
    environment, every error keeps its traceback.

    Args:
        app: The commands.
        arguments: Arguments after the program's name; without any, `finssim` prints its help.
        script: Module of a program other than `finssim`, whose ValueErrors are refusals too.

    Returns:
        Exit status: 0 success, 2 refused, 130 interrupted, or that of the command.
    """
    show = warnings.showwarning

    def show_warning(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if _is_ours(category.__module__, script or "finssim"):
            _report_on_stderr(f"warning: {message}")
        else:
            show(message, category, filename, lineno, file, line)

    with warnings.catch_warnings(), lost_interrupts_repeated():
        warnings.showwarning = show_warning
        status = _run(app, arguments, script)
        # If the last `exec` of a string was interrupted, `python -m` kills itself at exit, even if the
        # interrupt was handled.
        exec("")
        return status


def _run(app: typer.Typer, arguments: Sequence[str], script: str | None) -> int:
    try:
        if script is None:
            status = app(list(arguments) or ["--help"], prog_name="finssim", standalone_mode=False)
        else:
            status = app(list(arguments), standalone_mode=False)
        sys.stdout.flush()
    except BrokenPipeError:  # the reader of our output has exited, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        status = INTERRUPTED
    except Exception as error:
        sentence = refusal(error, script or "finssim")
        if caused_by_interrupt(error):
            status = INTERRUPTED
        elif sentence is None or os.environ.get("FINSSIM_DEBUG") == "1":
            raise
        else:
            _report_on_stderr(sentence)
            return REFUSED
    if status == INTERRUPTED:
        _report_on_stderr("interrupted: no incomplete file is left")
    return status if isinstance(status, int) else 0


def refusal(error: Exception, script: str = "finssim") -> str | None:
    """Return the sentence for an error of the input or the system, or None for a bug of FinsSim.

    Args:
        error: The error.
        script: Module of the program that runs.
    """
    if hasattr(error, "format_message"):  # a usage error of the command line
        return str(error.format_message())
    if isinstance(error, ModuleNotFoundError):
        return _missing_extra(error)
    if isinstance(error, OSError):
        return _system_error(error)
    if isinstance(error, MemoryError):
        return f"not enough memory: {error or 'a requested size is too large'}: ask for less"
    if isinstance(error, ValueError) and (
        _is_ours(type(error).__module__, script) or _raised_by_us(error.__traceback__, script)
    ):
        cause = error.__cause__  # such as a user's file that imports a missing package
        missing = _missing_extra(cause) if isinstance(cause, ModuleNotFoundError) else None
        return f"{error}; {missing}" if missing and "pip install" not in str(error) else str(error)
    return None


def _missing_extra(error: ModuleNotFoundError) -> str | None:
    module = (error.name or "").partition(".")[0]
    extra = EXTRA_OF_MODULE.get(module)
    return extra and f"{module} is not installed: pip install 'finssim[{extra}]'"


def _system_error(error: OSError) -> str:
    if error.strerror and error.filename is not None:
        return f"{os.fsdecode(error.filename)}: {error.strerror}"
    return error.strerror or str(error)


def _raised_by_us(traceback: TracebackType | None, script: str) -> bool:
    """Return whether the innermost frame is a `raise` of FinsSim or the script, rather than a failure in a library."""
    while traceback is not None and traceback.tb_next is not None:
        traceback = traceback.tb_next
    return traceback is not None and _is_ours(traceback.tb_frame.f_globals.get("__name__", ""), script)


def _is_ours(module: str, script: str) -> bool:
    return module.partition(".")[0] in ("finssim", script.partition(".")[0])


def _report_on_stderr(sentence: str) -> None:
    sentence = re.sub(r"\n(?=\S)", "; ", sentence.strip())  # a line that is not indented is a further fault
    print(f"finssim: {' '.join(sentence.split())}", file=sys.stderr)
