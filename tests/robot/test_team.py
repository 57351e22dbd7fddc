"""Team messages arrive whole or are refused, the newest counts, and decisions wait until all vehicles have
been heard."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from finssim.control.guidance import Track
from finssim.core.rotations import quat_from_euler
from finssim.robot.reading import Reading
from finssim.robot.team import Team, decode_track, encode_track

HERE = Track(np.array([1.0, -2.0, -3.0]), quat_from_euler(0.1, -0.2, 2.0), np.arange(6.0) / 10.0, 4.0)


def reading(now, ready=True):
    return Reading(now, HERE.position, HERE.quaternion, HERE.nu, ready)


def test_a_track_comes_back_with_its_age():
    """The track was sent 0.3 s after its measurement, and the receiver's clock differs."""
    name, track = decode_track(encode_track("left_netter", HERE, 4.3), 100.0)
    assert name == "left_netter" and track.time == pytest.approx(99.7)
    for part in ("position", "quaternion", "nu"):
        np.testing.assert_allclose(getattr(track, part), getattr(HERE, part), atol=1e-15)


@given(st.binary(max_size=200))
def test_what_is_no_track_is_refused(data):
    assert decode_track(data, 0.0) is None


@settings(max_examples=200)
@given(st.integers(0, 1199))
def test_a_turned_bit_is_refused(bit):
    data = bytearray(encode_track("herder", HERE, 4.0))
    data[bit // 8 % len(data)] ^= 1 << bit % 8
    assert decode_track(bytes(data), 4.0) is None


@pytest.mark.parametrize(
    "track",
    [
        Track(np.array([math.nan, 0.0, 0.0]), HERE.quaternion, HERE.nu, 4.0),
        Track(HERE.position, np.array([0.0, 0.0, 0.0, 2.0]), HERE.nu, 4.0),
        Track(HERE.position, HERE.quaternion, np.full(6, 1e9), 4.0),
        Track(HERE.position, HERE.quaternion, HERE.nu, 5.0),
        Track(HERE.position, HERE.quaternion, HERE.nu, -1e6),
    ],
    ids=["nan", "no rotation", "too fast", "from the future", "too old"],
)
def test_what_cannot_be_is_refused(track):
    assert decode_track(encode_track("herder", track, 4.0), 4.0) is None


def test_a_name_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="takes 33 bytes, expected 1 to 32"):
        encode_track("x" * 33, HERE, 4.0)


def test_the_newest_counts_and_strangers_are_not_listened_to():
    team = Team("herder", ("prey",))
    older = Track(HERE.position + 1.0, HERE.quaternion, HERE.nu, 3.0)
    team.hear(
        4.0,
        [encode_track("prey", HERE, 4.0), encode_track("prey", older, 4.0), encode_track("eel", HERE, 4.0)],
    )
    np.testing.assert_array_equal(team.tracks["prey"].position, HERE.position)
    assert team.refused == 1 and set(team.tracks) == {"prey"}


def test_nothing_is_decided_before_all_have_been_heard():
    team = Team("herder", ("prey", "left"))
    team.hear(4.0, [encode_track("prey", HERE, 4.0)])
    waiting = team.known(reading(4.0))
    assert not waiting.ready and waiting.reason == "nothing heard of left"
    team.hear(4.1, [encode_track("left", HERE, 4.1)])
    assert team.known(reading(4.1)).ready and set(team.known(reading(4.1)).tracks) == {
        "prey",
        "left",
    }


def test_everybody_has_a_turn_and_tells_nothing_of_an_unknown_place():
    """Each of three sends every second, a third of a second apart; a position of NaN is not sent."""
    team = Team("herder", (), period=1.0, turn=1.0 / 3.0)
    times = [k / 60 for k in range(180) if team.datagrams_to_send(k / 60, reading(k / 60))]
    np.testing.assert_allclose(times, [1 / 3, 4 / 3, 7 / 3], atol=1 / 60)
    lost = Reading(5.0, np.full(3, np.nan), HERE.quaternion, HERE.nu, False)
    assert team.datagrams_to_send(5.0, lost) == []
