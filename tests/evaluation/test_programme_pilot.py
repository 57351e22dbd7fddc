"""A pilot that plays a programme: its own axes open-loop, the others held."""

from types import SimpleNamespace

import numpy as np
import pytest

from finssim.control import ControlError
from finssim.control.allocation import Allocator
from finssim.control.guidance import Station
from finssim.evaluation.excitation import ProgrammePilot
from finssim.identification.programme import Programme
from finssim.vehicles import load_vehicle

VEHICLE = load_vehicle("finsrov")
ALLOCATOR = Allocator.from_vehicle(VEHICLE)
STATION = Station((0.0, 0.0, -0.5), 0.0)
WORDS = ["baseline"] * 10 + ["excitation"] * 50 + ["coast"] * 30 + ["rest"] * 10


def surge(phase=WORDS, **ascent):
    """Return 6 N of surge in rows 10 to 60 at 50 Hz."""
    tau = np.zeros((100, 6))
    tau[10:60, 0] = 6.0
    phases = np.array(phase)
    return Programme(name="surge", axes=("surge",), rate=50.0, tau_desired=tau, phase=phases, **ascent)


def reading(x=0.0, y=0.0, z=-0.5, nu=(0.0,) * 6):
    return SimpleNamespace(
        time=0.0,
        position=np.array([x, y, z]),
        quaternion=np.array([0.0, 0.0, 0.0, 1.0]),
        nu=np.array(nu, float),
    )


def wrench(pilot, t, **state):
    return ALLOCATOR.achieved(pilot.act(reading(**state), STATION, t))


def test_the_excited_axis_gets_the_programme_and_nothing_else():
    """6 N of surge act from row 10 at 50 Hz on, however far the vehicle has moved along surge."""
    pilot = ProgrammePilot(surge(), VEHICLE)
    assert abs(wrench(pilot, 0.1, x=0.3)[0]) < 0.02 and pilot.phase == "baseline"
    assert wrench(pilot, 0.5, x=0.3)[0] == pytest.approx(6.0, abs=0.05) and pilot.phase == "excitation"
    assert not pilot.finished


def test_other_axes_are_pushed_back_to_where_they_were_or_left_alone():
    """0.1 m to the left of its station, the vehicle is pushed to the right; without a PID it is not."""
    held = ProgrammePilot(surge(), VEHICLE)
    alone = ProgrammePilot(surge(), VEHICLE, hold=None)
    assert wrench(held, 0.5, y=0.1)[1] < -1.0
    assert abs(wrench(alone, 0.5, y=0.1)[1]) < 0.02


def test_an_excitation_ends_where_its_room_does():
    """With 0.5 m of room, the coast begins at 0.51 m from the start, and the rows after it follow."""
    pilot = ProgrammePilot(surge(), VEHICLE, room=0.5)
    wrench(pilot, 0.0)
    assert wrench(pilot, 0.4, x=0.49)[0] > 5.0
    assert abs(wrench(pilot, 0.45, x=0.51)[0]) < 0.02 and pilot.phase == "coast"
    wrench(pilot, 0.45 + 0.6, x=0.6)
    assert pilot.phase == "rest"
    pilot.reset()
    wrench(pilot, 0.5, x=0.6)
    assert pilot.phase == "excitation"  # a new start has a new origin


def test_a_coast_ends_after_a_steady_rise():
    """0.02 m/s for 0.2 s ends the coast, at thresholds of 0.01 m/s and 0.2 s; an interrupted rise counts anew."""
    pilot = ProgrammePilot(surge(ascent_speed=0.01, ascent_time=0.2), VEHICLE, hold=None)
    for t, w, phase in (
        (1.2, 0.02, "coast"),
        (1.3, 0.0, "coast"),
        (1.35, 0.02, "coast"),
        (1.5, 0.02, "coast"),
    ):
        wrench(pilot, t, nu=(0, 0, w, 0, 0, 0))
        assert pilot.phase == phase
    wrench(pilot, 1.56, nu=(0, 0, 0.02, 0, 0, 0))
    assert pilot.phase == "rest"


def test_after_its_end_nothing_is_asked_for():
    pilot = ProgrammePilot(surge(), VEHICLE)
    np.testing.assert_array_equal(pilot.act(reading(y=0.2), STATION, 2.0), 0.0)
    assert pilot.finished and pilot.phase == ""


def test_a_programme_of_another_length_than_its_phases_is_refused():
    with pytest.raises(ControlError, match="a wrench and a phase for every row"):
        ProgrammePilot(surge(WORDS[:-1]), VEHICLE)
