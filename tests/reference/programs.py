"""Studies as programs, run in this process."""

import runpy
import sys
import warnings
from unittest import mock

from pytest import raises


def study(name, *words):
    """Return the exit status of `python -m studies.NAME WORD...`."""
    with mock.patch.object(sys, "argv", [name, *map(str, words)]), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # tests import the module too
        with raises(SystemExit) as end:
            runpy.run_module(f"studies.{name}", run_name="__main__")
    return end.value.code
