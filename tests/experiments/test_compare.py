"""`finssim compare`: which runs belong together, the same trials for all, one figure and one table."""

import json
import math

import numpy as np
import pytest
import torch
from torch import nn

from finssim.control.modes import action_mode
from finssim.control.policy import PolicyDescription, VehicleIdentity
from finssim.experiments.compare import (
    CompareError,
    comparison,
    curve_of,
    groups_of,
    measures_of,
    scores_of,
    tables_of,
)
from finssim.experiments.tables import markdown_of
from finssim.learning.export import export_policy
from finssim.tasks import task_named
from finssim.vehicles import load_vehicle

FINSROV = load_vehicle("finsrov")


def policy(folder, seed, gain=6.0, task="t1", **training):
    """Thrust towards the goal and against the velocity, as one layer; its training curve is a straight line."""
    the_task = task_named(task)
    layer = nn.Linear(the_task.observation_size, 6)
    with torch.no_grad():
        layer.weight.zero_()
        layer.bias.zero_()
        if task == "t1":
            for axis in range(3):
                layer.weight[axis, axis], layer.weight[axis, 9 + axis] = gain, -3.0
            layer.weight[5, 4], layer.weight[5, 14] = 0.3, -0.3
    description = PolicyDescription(
        task=task,
        observation=the_task.schema,
        action=action_mode("wrench6", FINSROV).describe(),
        control_period=the_task.control_step,
        vehicle=VehicleIdentity(name=FINSROV.name, sha256=FINSROV.sha256),
        hydrodynamics="calibrated",
        seed=seed,
        training={"steps": 1000, "gain": gain, **training},
    )
    rows = [
        {"steps": 100 * k, "seconds": 0.5 * k, "mean_return": float(k * seed), "held": 0.1 * k}
        for k in (1, 5, 10)
    ]
    return export_policy(nn.Sequential(layer), folder, description, curves=rows)


def test_runs_of_a_name_are_a_group(tmp_path):
    """By the folder's name less its number, or by a name that is given; sorted by seed."""
    words = [str(policy(tmp_path / f"hold-seed{seed}", seed)) for seed in (2, 1)]
    words.append(f"mild={policy(tmp_path / 'x', 1, gain=3.0)}")
    groups = groups_of(words)
    assert {g.name: [run.seed for run in g.runs] for g in groups} == {"hold": [1, 2], "mild": [1]}
    assert groups[0].runs[0].seconds == 5.0


def test_what_cannot_be_compared_is_refused(tmp_path):
    """Another setting, a seed twice, another task, nothing."""
    a, b = policy(tmp_path / "run1", 1), policy(tmp_path / "run2", 2, gain=3.0)
    with pytest.raises(CompareError, match="differ in gain: give different names"):
        groups_of([str(a), str(b)])
    with pytest.raises(CompareError, match="two runs with seed 1"):
        groups_of([f"a={a}", f"a={policy(tmp_path / 'again', 1)}"])
    with pytest.raises(CompareError, match="trained for t1, t2: compare those of one task"):
        groups_of([str(a), f"other={policy(tmp_path / 't2', 1, task='t2')}"])
    with pytest.raises(CompareError, match="no run is given"):
        groups_of([])


def test_a_policy_names_no_code_to_run(tmp_path):
    """FILE.py:CLASS in a policy.yaml is a path from data: the file is not run."""
    (tmp_path / "evil.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n", encoding="utf-8")
    one = policy(tmp_path / "a1", 1)
    told = (one / "policy.yaml").read_text(encoding="utf-8")
    evil = told.replace("task: t1", f"task: {tmp_path / 'evil.py'}:Task")
    assert evil != told
    (one / "policy.yaml").write_text(evil, encoding="utf-8")
    with pytest.raises(CompareError, match="evil.py:Task', expected one of t1, t2"):
        groups_of([str(one)])
    assert not (tmp_path / "ran").exists()


def test_scores_are_by_target_and_failures_infinitely_bad():
    """A mean over the trials of a setpoint; an error that was never reached is worse than any."""
    one = [
        {"setpoint": "P01", "e_p_m": 0.1, "success": True},
        {"setpoint": "P01", "e_p_m": 0.3, "success": False},
        {"setpoint": "P02", "e_p_m": None, "success": False},
    ]
    assert np.array_equal(scores_of([one, one[:1] + one[2:]], "e_p_m"), [[0.2, math.inf], [0.1, math.inf]])
    assert np.array_equal(scores_of([one], "success"), [[0.5, 0.0]])
    assert measures_of("t1", one) == ("success", "e_p_m")
    with pytest.raises(CompareError, match="no measure 'speed' of task 't1'; available: e_p_m, success"):
        measures_of("t1", one, ["speed"])


def trials(error, success=True):
    return [{"setpoint": f"P{k}", "e_p_m": error * (1.0 + 0.1 * k), "success": success} for k in range(4)]


@pytest.mark.slow
def test_a_difference_in_every_seed_is_told_and_two_seeds_tell_nothing(tmp_path):
    """Errors of 1 cm against 2 cm over four seeds; the same over two stays open."""
    words = [
        f"{n}={policy(tmp_path / f'{n}{s}', s, gain=g)}"
        for n, g in (("a", 6.0), ("b", 3.0))
        for s in range(1, 5)
    ]
    groups = groups_of(words)
    found = {(g.name, r.seed): trials(0.01 if g.name == "a" else 0.02) for g in groups for r in g.runs}
    result = comparison(groups, found) | {"plant": "nominal"}
    pair = next(p for p in result["pairs"] if p["measure"] == "e_p_m")
    assert pair["verdict"] == "better" and pair["probability"] == 1.0
    assert next(p for p in result["pairs"] if p["measure"] == "success")["verdict"] == "open"
    assert result["groups"]["a"]["measures"]["e_p_m"]["value"] == pytest.approx(0.0115)
    assert (
        "a is better than b in e_p_m (chance that a is better: 1.00 [1.00, 1.00])"
        in tables_of(result)[0].sentences
    )
    assert "| a | 4 | 1,000 | 5 | 1 [1, 1] | 0.0115 [0.0115, 0.0115] |" in markdown_of(tables_of(result))
    few = groups_of([word for word in words if word.endswith(("1", "2"))])
    assert all(p["verdict"] == "open" for p in comparison(few, found)["pairs"])


def test_a_curve_is_the_middle_of_its_runs(tmp_path):
    """Returns k, 2k and 3k against steps 100 k: the middle half of three is around 2k."""
    group = groups_of([str(policy(tmp_path / f"run{seed}", seed)) for seed in (1, 2, 3)])[0]
    steps, (low, middle, high) = curve_of(group, "mean_return")
    assert steps[-1] == 1000.0 and middle[-1] == pytest.approx(20.0) and low[-1] < 20.0 < high[-1]


def test_a_row_of_a_curve_without_a_number_is_left_out(tmp_path):
    """As before the first episode ended: the curve goes on as a straight line between its neighbours."""
    folder = policy(tmp_path / "run1", 1)
    curves = folder / "curves.csv"
    head, first, second, third = curves.read_text(encoding="utf-8").splitlines()
    gap = ",".join(
        "" if name == "mean_return" else x for name, x in zip(head.split(","), second.split(","), strict=True)
    )
    curves.write_text("\n".join([head, first, gap, third]) + "\n", encoding="utf-8")
    steps, (_, middle, _) = curve_of(groups_of([str(folder)])[0], "mean_return")
    np.testing.assert_allclose(middle, np.maximum(steps, 100.0) / 100.0, rtol=1e-9)


@pytest.mark.slow
def test_the_command_evaluates_once_and_writes(tmp_path, capsys):
    """Table, JSON, Markdown and figure; a second call takes the trials that are there, and gives the same."""
    from finssim import boundary
    from finssim.cli import app

    words = [str(policy(tmp_path / "strong-1", 1)), str(policy(tmp_path / "weak-1", 1, gain=0.5))]
    out = tmp_path / "out"
    call = ["compare", *words, "--measure", "e_p_m", "--out", str(out), "--json"]
    assert boundary.run(app, call) == 0
    first = json.loads(capsys.readouterr().out)
    assert {p.name for p in out.iterdir()} == {"evaluations", "compare.json", "compare.md", "compare.png"}
    e = {name: group["measures"]["e_p_m"]["value"] for name, group in first["groups"].items()}
    assert e["strong"] < e["weak"] and list(first["measures"]) == ["e_p_m"]
    kept = {path: path.stat().st_mtime_ns for path in (out / "evaluations").iterdir()}
    assert boundary.run(app, call) == 0
    assert json.loads(capsys.readouterr().out)["groups"] == first["groups"]
    assert kept == {path: path.stat().st_mtime_ns for path in (out / "evaluations").iterdir()}
    assert boundary.run(app, ["compare", str(tmp_path / "nothing"), "--out", str(out)]) == 2
