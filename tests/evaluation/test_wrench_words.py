"""A wrench in words is read as written, or is refused in a sentence."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from finssim.cli.simulate import CommandError, parse_wrench
from finssim.vehicles import AXES

numbers = st.floats(allow_nan=False, allow_infinity=False)


@given(st.dictionaries(st.sampled_from(AXES), numbers, min_size=1), st.sampled_from([" ", ", ", "  "]))
def test_words_give_the_wrench_they_say(wanted, separator):
    """Any axes in any order and form are read as numbers; the others are zero."""
    text = separator.join(f"{axis}={value!r}" for axis, value in wanted.items())
    np.testing.assert_array_equal(parse_wrench(text), [wanted.get(axis, 0.0) for axis in AXES])


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", 'command is empty: give axis=number, such as "surge=10 yaw=1" [N, N m]'),
        (
            "surg=1",
            "command: unknown axis 'surg'; available: surge, sway, heave, roll, pitch, yaw; did you mean 'surge'?",
        ),
        ("thrust=1", "command: unknown axis 'thrust'; available: surge, sway, heave, roll, pitch, yaw"),
        ("surge", "command: surge is '', expected a number: surge=1.5 [N]"),
        ("yaw=fast", "command: yaw is 'fast', expected a number: yaw=1.5 [N m]"),
        ("surge=nan", "command: surge is nan, expected a finite number [N]"),
        ("surge=-inf", "command: surge is -inf, expected a finite number [N]"),
        ("surge=1 surge=2", "command: 'surge' is given twice"),
    ],
)
def test_what_is_no_wrench_is_refused(text, sentence):
    """The sentence names the word and the expected form."""
    with pytest.raises(CommandError) as refused:
        parse_wrench(text)
    assert str(refused.value) == sentence
