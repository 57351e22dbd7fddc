"""The experiments run from command to table, resume after an interruption, and refuse unknown names."""

import json
from pathlib import Path

import pytest

from finssim.evaluation.tables import html_of, markdown_of
from finssim.learning.train import TrainingSettings
from finssim.studies.transfer import (
    T1,
    T2,
    TransferSettings,
    controllers_of,
    row_figures,
    scores,
    transfer_experiment,
)

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("brief_t1")]

SMALL = {"plants": 1, "seeds": 1, "rows": ("pid",), "processes": 1}


def experiment(out, targets=("P01",), **changes):
    return transfer_experiment(
        T1, out=out, targets=targets, settings=TransferSettings(**{**SMALL, **changes})
    )


@pytest.fixture(scope="module")
def small(brief_t1, tmp_path_factory):
    """Folder and result of one trial of the tuned PID, of the length in `brief_t1`."""
    out = tmp_path_factory.mktemp("t1")
    return out, experiment(out)


def test_the_tuned_pid_holds_a_setpoint_of_the_pool(small):
    """The setpoint is held, and the row shows it with an interval of its single cluster."""
    out, result = small
    row = result["rows"]["pid"]
    assert (row["success"], row["trials"], row["stopped"], row["worst_success"]) == (1, 1, 0, 1)
    assert row["e_p_m"]["value"] < 0.05 and row["e_p_m"]["ci95"] == [row["e_p_m"]["value"]] * 2
    assert row["energy"]["value"] > 0.0
    assert json.loads((out / "t1.json").read_text())["rows"] == result["rows"]
    assert (out / "t1_envelopes.png").stat().st_size > 10_000


def test_a_second_call_plays_nothing_again(small):
    """Results in the folder are reused; a new target is added."""
    out, result = small
    before = {path: path.stat().st_mtime_ns for path in (out / "trials").iterdir()}
    again = experiment(out)
    assert {path: path.stat().st_mtime_ns for path in (out / "trials").iterdir()} == before
    assert again["rows"] == result["rows"]


def test_the_table_stands_beside_the_papers(small):
    """The paper's rows are marked in every form, and the page contains the figure."""
    out, result = small
    (table,) = T1.tables({**result, "rows": {"pid-paper": result["rows"]["pid"]}})
    assert [row[0] for row in table.rows][1:] == ["  paper: PID"]
    assert "paper: PID" in markdown_of([table])
    html = "".join(html_of([table], out))
    assert 'class="theirs"' in html and "data:image/png" in html


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"rows": ("mess",)}, "unknown row 'mess'; available: calibrated"),
        ({"targets": ("P09",)}, "unknown target 'P09'; available: P01"),
        ({"severity": "awful"}, "unknown severity 'awful'; available: nominal"),
        ({"camera": "none"}, "unknown camera 'none'; available: corners"),
        ({"plants": 0}, "plants is 0"),
        ({"seeds": 0}, "seeds 0"),
    ],
)
def test_what_is_unknown_is_refused_before_anything_is_trained(tmp_path, wrong, words):
    """An unknown name is refused in one sentence that lists the known ones."""
    with pytest.raises(ValueError, match=words):
        experiment(tmp_path, **wrong)
    assert not list(tmp_path.iterdir())


def test_a_finished_policy_is_not_trained_again(tmp_path):
    """A finished policy is kept; an unfinished one is trained."""
    rows = {name: T1.rows[name] for name in ("pid", "calibrated-pool")}
    controllers = controllers_of("t1", rows, [5], tmp_path, TrainingSettings(steps=4096))
    network = Path(controllers["calibrated-pool", 5]) / "policy.onnx"
    assert controllers["pid", 5] == "pid" and network.parent.parent == tmp_path / "policies"
    first = network.stat().st_mtime_ns
    controllers_of("t1", rows, [5], tmp_path, TrainingSettings(steps=4096))
    assert network.stat().st_mtime_ns == first
    network.write_bytes(b"cut short")
    controllers_of("t1", rows, [5], tmp_path, TrainingSettings(steps=4096))
    assert network.stat().st_size > 1000


@pytest.mark.parametrize("spec", [T1, T2], ids=lambda spec: spec.name)
def test_every_row_can_be_played(spec):
    """Each row names an existing PID or training, and its paper row exists."""
    for row in spec.rows.values():
        assert bool(row.controller) != (row.training is not None)
        if row.paper is not None:
            theirs = set(spec.paper_differences(row, spec.bases[0]))
            assert theirs and theirs <= set(spec.differences)
    assert set(spec.targets) <= set(spec.allowed_targets)


def made(row, plant, success, error):
    """Return a result in the form that `play` writes."""
    job = {"row": row, "plant": plant, "seed": 1, "target": "P01"}
    figures = dict.fromkeys(("e_y_m", "e_psi_deg", "t_s_s", "J_p_m", "J_psi_deg"), 1.0)
    return {"job": job, "success": success, "fault": "" if success else "tilt", "e_p_m": error, **figures}


def test_figures_count_stops_and_the_worst_pool():
    """A stopped trial has no error and still counts."""
    row = row_figures([made("x", 1, True, 0.02), made("x", 2, False, None)], T1.figures)
    assert (row["success"], row["trials"], row["stopped"], row["worst_success"]) == (1, 2, 1, 0)
    assert row["e_p_m"]["value"] == 0.02 and row["e_p_m"]["count"] == 1


def test_differences_are_means_over_pairs():
    """Pairs are trials with the same plant, seed and target."""
    by_row = {
        name: [made(name, plant, True, error + 0.001 * plant) for plant in range(3)]
        for name, error in (("calibrated", 0.02), ("mesh", 0.05), ("pid", 0.01))
    }
    differences = scores(T1, by_row)["differences"]
    assert differences["calibrated"]["mesh"]["e_p_m"]["value"] == pytest.approx(0.03)
    assert differences["pid"]["mesh"]["e_p_m"]["value"] == pytest.approx(0.04)
    assert differences["pid"]["mesh"]["energy"] is None


def test_the_differences_say_which_way_each_row_moves(small):
    """The paper's difference is shown beside each row's, where the paper has one."""
    _, result = small
    d = {"value": 0.03, "ci95": [0.02, 0.04], "count": 9}
    differences = {"calibrated": {"no-fusion": {"success_rate": None, "e_p_m": d, "e_psi_deg": d}}}
    _, shown = T1.tables({**result, "differences": differences})
    assert shown.rows[0] == [
        T1.rows["no-fusion"].title,
        "–",
        "+3.0 [+2.0, +4.0]",
        "+0.0 [+0.0, +0.0]",
        "–",
        "–",
    ]
    assert shown.rows[1] == ["  paper", "+0", "-0.8", "+6.9", "+9.4", "–"]
    assert T2.rows["pid"].paper is None
