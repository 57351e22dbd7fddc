"""Objects that a user displays in a terminal or a notebook: one line each, and a table in HTML."""

from html.parser import HTMLParser
from importlib.resources import files

import numpy as np
import pytest

from finssim import make
from finssim.evaluation.evaluate import evaluation
from finssim.identification import programmes, replay, simulate_programme
from finssim.identification.fit import Estimate, Fit
from finssim.sim import Randomization, Simulator, Water
from finssim.sim.ranges_file import Ranges
from finssim.trials.trial import Trial
from finssim.vehicles import catalogue, load_vehicle

FINSROV = load_vehicle("finsrov")


def cells(html):
    """Return the texts of the cells of a table, after checking that every tag is closed."""
    texts, depth = [], []

    class Reader(HTMLParser):
        def handle_starttag(self, tag, attributes):
            depth.append(tag)

        def handle_endtag(self, tag):
            assert depth.pop() == tag

        def handle_data(self, data):
            if depth and depth[-1] in ("td", "th"):
                texts.append(data)

    reader = Reader()
    reader.feed(html)
    reader.close()
    assert not depth
    return texts


def trial():
    t = np.linspace(0.0, 2.0, 21)
    return Trial(name="surge_050", t=t, channels={"u": 0.1 * t, "depth": np.where(t < 1.0, np.nan, 0.5)})


def fit():
    estimate = Estimate.within("surge.d1", 12.0, 1.5, "N s/m", True)
    return Fit(
        kind="hydrodynamics",
        method="simulation",
        before=FINSROV,
        estimates={"surge.d1": estimate},
        changes={},
    )


@pytest.mark.parametrize("name", catalogue())
def test_a_vehicle_is_one_line(name):
    """The line names mass, thrusters and hydrodynamic sets; for the catalogue it fits two terminal lines."""
    vehicle = load_vehicle(name)
    assert repr(vehicle) == str(vehicle)
    assert (
        repr(vehicle).startswith(f"<Vehicle {name}: {vehicle.body.mass:g} kg, ") and len(repr(vehicle)) < 160
    )


def test_every_object_is_one_line():
    """The line contains no address and no arrays."""
    simulator = Simulator("finsrov", worlds=3)
    assert repr(simulator) == "<Simulator: 3 worlds of finsrov (calibrated), 0.1 s in 4 substeps, cpu>"
    assert repr(trial()) == "<Trial surge_050: 2.0 s, 21 rows, u depth>"
    (first, *_) = programmes("yaw", FINSROV)
    assert repr(first) == f"<Programme {first.name}: 14.0 s at 50 Hz, yaw>"
    assert repr(Randomization("cruise")).startswith("<Randomization cruise: draws ")
    assert repr(make("t1", worlds=2)) == "<Environment of t1: 2 worlds of finsrov, cpu>"
    assert repr(fit()) == "<Fit hydrodynamics (simulation) of finsrov: 1 estimates, 0 changes, 0 findings>"


def test_notebooks_show_tables():
    """Vehicle, trial and fit give well-formed HTML that contains their numbers, escaped."""
    assert "11.2 kg" in cells(FINSROV.replace({"body.mass": 11.2})._repr_html_())
    assert cells(trial()._repr_html_())[5:] == [
        "u",
        "m/s",
        "21",
        "0",
        "0.2",
        "depth",
        "m",
        "11",
        "0.5",
        "0.5",
    ]
    assert "10.5 to 13.5" in cells(fit()._repr_html_())
    assert "<script>" not in FINSROV.replace({"title": "<script>"})._repr_html_()
    water = FINSROV.water
    assert cells(water._repr_html_()) == ["density", str(water.density), "gravity", str(water.gravity)]


def test_notebooks_show_what_is_simulated_and_drawn():
    """A simulator shows its surroundings and state, a task its observations, ranges their ends."""
    simulator = Simulator("finsrov", worlds=3, water=Water(current=(0.1, 0.0, 0.0)))
    simulator.place(position=(1.0, 2.0, -0.5))
    simulator.step()
    shown = cells(simulator._repr_html_())
    assert {"0.1 0 0 m/s", "open water", "0.1 to 0.1 s"} <= set(shown)
    assert shown[-1].startswith("at 1.00")
    assert {"goal offset, body frame", "m"} <= set(cells(make("t1")._repr_html_()))
    drawn = Randomization(
        Ranges(name="mine", mass=(0.9, 1.1), current={"normal": (0.1, 0.02), "probability": 0.5})
    )
    rows = cells(drawn._repr_html_())
    assert rows[3:9] == [
        "mass",
        "uniform 0.9, 1.1",
        "1",
        "current",
        "normal 0.1, 0.02, in 50% of the episodes",
        "m/s",
    ]


def test_a_replay_shows_its_scores():
    """A replay shows the tables that `finssim replay` prints."""
    trials = simulate_programme(programmes("yaw", FINSROV, levels=[2.0]), FINSROV, seed=1)
    result = replay(trials[:1], FINSROV)
    assert repr(result) == "<Replay of finsrov (calibrated): 1 trials>"
    assert {"yaw", "aggregate", trials[0].name} <= set(cells(result._repr_html_()))


def test_an_evaluation_shows_its_table():
    """An evaluation shows the table that `finssim evaluate` prints."""
    measures = [{"episode": 0, "success": 1.0, "return": 2.0, "time": 3.0, "energy": 4.0}]
    plant = {"name": "nominal", "title": ""}
    shown = evaluation({"name": "pid"}, "docking", FINSROV, plant, measures)
    assert repr(shown) == "<Evaluation of pid in docking: 1 trials>"
    assert any("pid" in cell or "nominal" in cell for cell in cells(shown._repr_html_()))


def test_type_checkers_read_the_package():
    """The package contains the marker of PEP 561."""
    assert files("finssim").joinpath("py.typed").is_file()
