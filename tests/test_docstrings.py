"""Requirements of `make check` on public docstrings."""

import ast
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

import check_docstrings

ALIASES = "finssim.localization.poses"
"""A module in which `Array` is an array of real numbers."""


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
        ("x: float", "Anything.", ["x: unit"]),
        ("x: float | None", "A share, or None.", []),
        ("x: Mapping[str, tuple[float, ...]]", "By name.", ["x: unit"]),
        ("x: NDArray[np.bool_]", "Which are valid, (n,).", []),
        ("x: 'wp.array(dtype=wp.vec3)'", "Anything.", ["x: unit"]),
        ("x: wp.array(dtype=int)", "Which worlds.", []),
        ("x: Callable[[float], float]", "Anything.", []),
        ("x: Array", "In the unit of y, (n,).", []),
        ("x: Array", "As of `other`.", []),
        ("worlds: int", "How many.", []),
    ],
)
def test_what_a_docstring_lacks_is_named(signature, entry, lacking):
    """A missing unit of real numbers, shape of an array or frame of a direction is named by argument and type."""
    name = signature.split(":")[0]
    text = f'def f({signature}):\n    """Do it.\n\n    Args:\n        {name}: {entry}\n    """\n'
    (function,) = ast.parse(text).body
    assert list(check_docstrings.missing(function, ALIASES)) == lacking


@pytest.mark.parametrize(
    ("returned", "text", "lacking"),
    [
        ("float", "Return the speed.", True),
        ("float", "Return the speed [m/s].", False),
        ("tuple[Array, int]", "Do it.\n\n    Returns:\n        Both, (n,).\n    ", True),
        ("tuple[Array, int]", "Do it.\n\n    Returns:\n        Both, (n,) [m].\n    ", False),
        ("float", "Do it.\n\n    Args:\n        _: Anything [m].\n    ", True),
        ("bool", "Return whether it moves.", False),
    ],
)
def test_returned_numbers_have_a_unit(returned, text, lacking):
    """The unit is in the section `Returns:`, or in the text above the arguments where that section is absent."""
    (function,) = ast.parse(f'def f() -> {returned}:\n    """{text}"""\n').body
    assert list(check_docstrings.missing(function, ALIASES)) == ["what it returns: unit"] * lacking


def test_fields_have_a_unit_in_their_own_docstring_or_in_that_of_the_class():
    """A field without a docstring is looked up in that of the class, in its own entry if it has one."""
    source = '''class C:
    """A thing.{about}"""
    speed: float
    """Speed{own}."""
    mass: float = 1.0
    names: list[str]
'''
    for about, own, lacking in (
        ("", "", ["speed: unit", "mass: unit"]),
        ("", " [m/s]", ["mass: unit"]),
        (" Masses in [kg].", "", ["speed: unit"]),
        ("\n\n    Attributes:\n        mass: Its mass [kg].\n    ", " [m/s]", []),
    ):
        (kind,) = ast.parse(source.format(about=about, own=own)).body
        assert list(check_docstrings.missing_of_fields(kind)) == lacking
