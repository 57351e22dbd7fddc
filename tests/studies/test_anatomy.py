"""`python -m studies.anatomy`: plants with one wrong parameter, tolerated amounts, table and figure."""

import json
from dataclasses import replace

import numpy as np
import pytest

from finssim.agents.agent import agent_for
from finssim.evaluation import evaluate
from finssim.evaluation.plants import PlantChanges
from finssim.tasks.catalogue import task_named
from finssim.vehicles import load_vehicle
from studies import anatomy as module
from studies.anatomy import CAUSES, anatomy, tables_of, tolerated

FINSROV = load_vehicle("finsrov")


def test_every_cause_begins_with_nothing_and_changes_something():
    """At its first amount the plant is that of the file, at its last one it differs."""
    task = task_named("t1")
    agent = agent_for("pid", FINSROV, task)

    def plant_of(cause, amount):
        made = PlantChanges(name="x", **cause.plant(amount))
        environment = made.environment(agent, task, FINSROV, worlds=2, seed=1)
        fields = {name: field.numpy() for name, field in environment.simulator.plant.fields.items()}
        water = environment.simulator.water.current.numpy()
        return {**fields, "current": water, "seen": environment._seen.array.numpy().view(np.float32)}

    nothing = plant_of(CAUSES["lag"], 0.0)
    for cause in CAUSES.values():
        assert cause.amounts[0] == 0.0 and list(cause.amounts) == sorted(set(cause.amounts))
        none, most = (plant_of(cause, cause.amounts[k]) for k in (0, -1))
        for name, values in none.items():
            np.testing.assert_allclose(values, nothing[name], rtol=1e-6, atol=1e-9, err_msg=name)
        assert any(not np.array_equal(most[name], none[name]) for name in none), cause.title


def test_a_table_and_a_figure_that_a_later_call_does_not_play_again(tmp_path, monkeypatch):
    """With ballast the tuned PID holds, the published gains do not; a second call reads the results of the
    first."""
    monkeypatch.setitem(module.CAUSES, "ballast", replace(CAUSES["ballast"], amounts=(0.0, 16.0)))
    options = {"causes": ("ballast",), "rows": ("pid", "pid-paper"), "seeds": 1, "trials": 2, "processes": 1}
    result = anatomy(out=tmp_path, **options)
    assert result["causes"]["ballast"]["rows"]["pid"][0]["e_p_m"]["value"] < 0.001
    assert result["foreign"]["pid"]["success"] == {"value": 1.0, "ci95": [1.0, 1.0], "count": 20}
    assert json.loads((tmp_path / "anatomy.json").read_text()) == result
    assert (tmp_path / "anatomy.png").stat().st_size > 10_000
    what, everything = tables_of(result)
    assert what.rows == [["too much ballast, of its weight [%]", "16+", "0"]]
    assert [row[0] for row in everything.rows] == ["PID, tuned from the model", "PID, published gains"]
    monkeypatch.setattr(evaluate, "evaluate_controller", None)
    again = anatomy(out=tmp_path, **options)
    assert again["causes"] == result["causes"]


def test_what_is_tolerated_ends_where_too_few_hold_first():
    """Amounts that hold beyond that point do not count."""
    shares = {"a": [1.0, 0.95, 0.5, 1.0], "b": [0.8, 1.0, 1.0, 1.0], "c": [1.0, 1.0, 0.9, 0.9]}
    cause = {
        "amounts": [0.0, 1.0, 2.0, 3.0],
        "rows": {row: [{"success": {"value": x}} for x in values] for row, values in shares.items()},
    }
    assert [tolerated(cause, row) for row in shares] == [1.0, None, 3.0]


def test_an_unknown_cause_or_row_is_refused(tmp_path):
    """The refusal lists the known ones."""
    with pytest.raises(ValueError, match="unknown cause 'wind'; available: lag, delay"):
        anatomy(out=tmp_path, causes=("wind",))
    with pytest.raises(ValueError, match="unknown row 'noise'; available: calibrated"):
        anatomy(out=tmp_path, rows=("noise",))
