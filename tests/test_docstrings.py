"""What `make check` demands of the docstrings of public functions."""

import ast
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

import check_docstrings


@pytest.mark.parametrize(
    ("signature", "entry", "lacking"),
    [
        ("position: Array", "Body origin, world frame [m], (n, 3).", []),
        ("position: Array", "Where it is.", ["position: unit", "position: shape", "position: frame"]),
        ("position: Array", "Body origin, world frame [m].", ["position: shape"]),
        ("start_position: wp.vec3", "Body origin, world frame [m].", []),
        ("start_position: wp.vec3", "Where it is [m].", ["start_position: frame"]),
        ("duration: float", "How long.", ["duration: unit"]),
        ("duration: float", "How long [s].", []),
        ("quaternion: Array", "Body to world, xyzw, (4,).", []),
        ("name: str", "Anything.", []),
        ("_: float, color: float", "Anything.", []),
    ],
)
def test_what_a_docstring_lacks_is_named(signature, entry, lacking):
    """By argument: a unit of numbers, a shape of arrays, a frame of what has a direction."""
    name = signature.split(":")[0]
    text = f'def f({signature}):\n    """Do it.\n\n    Args:\n        {name}: {entry}\n    """\n'
    (function,) = ast.parse(text).body
    assert check_docstrings.missing(function) == lacking


def test_our_own_lack_nothing():
    """As `make check` says it."""
    assert check_docstrings.found() == {}
