"""The clock of a view."""

import math

import pytest

from finssim.extensions.viewer.app import LONGEST_TURN, Playback, event_marks


def test_a_recording_stops_at_its_end_and_starts_again_from_there():
    """A recording that is played at its end restarts from its beginning."""
    clock = Playback(1.0, speed=4.0)
    for _ in range(20):
        clock.advance(0.05)
    assert clock.time == 1.0 and not clock.playing
    clock.seek(0.99)
    clock.play(True)
    assert clock.advance(0.05) == pytest.approx(0.2)


def test_a_paused_clock_stands():
    """A paused clock can be set to a time within the recording."""
    clock = Playback(10.0, playing=False)
    clock.seek(99.0)
    assert clock.advance(0.05) == 10.0
    clock.seek(3.0)
    assert clock.advance(0.05) == 3.0


def test_a_live_source_knows_no_other_time():
    """The clock of a live source cannot be set, and a long turn does not make it jump."""
    clock = Playback(math.inf)
    clock.seek(5.0)
    assert clock.live and clock.advance(60.0) == LONGEST_TURN


def test_events_are_marked_on_the_slider_and_named_where_there_is_room():
    """Every event has a mark within the slider; a label that would overlap the previous one is left out."""
    events = [(-0.1, "armed: by pid"), (1.0, "vision: lost"), (6.0, "vision: lost"), (10.2, "fault: leak")]
    assert event_marks(events, 10.0) == ((0.0, "armed"), 1.0, (6.0, "lost"), (10.0, "fault"))
