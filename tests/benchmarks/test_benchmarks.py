"""Every benchmark can be imported and prints its help, so that a refactoring that breaks one is noticed."""

import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"

ASK_EACH = """
import contextlib, io, runpy, sys, traceback

for path in sys.argv[1:]:
    sys.argv = [path, "--help"]
    text, status = io.StringIO(), "it did not stop at --help"
    try:
        with contextlib.redirect_stdout(text):
            runpy.run_path(path, run_name="__main__")
    except SystemExit as stop:
        status = "" if stop.code == 0 and "usage:" in text.getvalue().lower() else f"--help ends with {stop.code}"
    except BaseException:
        status = traceback.format_exc()
    if status:
        print(f"{path}: {status}")
"""


@pytest.mark.slow
def test_every_benchmark_loads_and_answers_help():
    """Every benchmark prints its help, all in one process, since most of the time is spent on shared imports."""
    paths = sorted(map(str, BENCHMARKS.glob("*.py")))
    assert len(paths) > 20
    done = subprocess.run(
        [sys.executable, "-c", ASK_EACH, *paths], capture_output=True, text=True, timeout=300, cwd=BENCHMARKS
    )
    assert (done.returncode, done.stdout) == (0, ""), done.stdout + done.stderr
