"""`finssim demo`: the whole loop at a small size, and a report that stands alone."""

import json
import re

import pytest

from finssim.control.policy import Policy
from finssim.experiments import demo as demo_module
from finssim.experiments.demo import demo
from finssim.files import OutputError
from finssim.learning import ppo


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A demonstration with a policy that had no time to learn."""
    out = tmp_path_factory.mktemp("demo") / "demo"
    assert demo(out, steps=8192) == out / "report.html"
    return out


def test_policy_results_and_report_are_there(folder):
    assert {p.name for p in folder.iterdir()} >= {
        "policy",
        "policy.json",
        "pid.json",
        "pid-paper.json",
        "report.html",
    }
    assert json.loads((folder / "pid.json").read_text(encoding="utf-8"))["success"] == 8


def test_the_report_loads_nothing(folder):
    """Pictures are inside; no script, no style sheet, no address."""
    html = (folder / "report.html").read_text(encoding="utf-8")
    sources = re.findall(r'(?:src|href)="([^"]{0,30})', html)
    assert len(sources) == 3 and all(source.startswith("data:image/png;base64,") for source in sources)
    assert "http" not in re.sub(r'"data:[^"]*"', "", html) and "<script" not in html


def test_the_report_has_every_controller_the_paper_and_the_provenance(folder):
    html = (folder / "report.html").read_text(encoding="utf-8")
    policy = json.loads((folder / "policy.json").read_text(encoding="utf-8"))
    for word in ("<td>policy</td>", "<td>pid</td>", "<td>pid-paper</td>", "paper: PID", "P08", "Provenance"):
        assert word in html
    assert "finssim train t1 --vehicle finsrov --seed 1 --steps 8192 --out policy" in html
    assert policy["vehicle"]["sha256"] in html and str(policy["provenance"]["revision"]) in html


def interrupt(*_, **__):
    raise KeyboardInterrupt


@pytest.mark.parametrize("when", ["training", "evaluation"])
def test_an_interrupted_demonstration_keeps_its_policy_where_it_says(tmp_path, monkeypatch, capsys, when):
    """Ctrl-C in the second rollout, or in the evaluation: a whole policy beside the demonstration, and nothing else."""
    record = ppo._Watch._on_rollout_end

    def stop(self):
        record(self)
        if len(self.curves) == 2:
            raise KeyboardInterrupt

    if when == "training":
        monkeypatch.setattr(ppo._Watch, "_on_rollout_end", stop)
    else:
        monkeypatch.setattr(demo_module, "evaluate_controller", interrupt)
    with pytest.raises(KeyboardInterrupt):
        demo(tmp_path / "demo", steps=100_000 if when == "training" else 8192)
    kept = tmp_path / "demo-training" / "interrupted"
    assert Policy.load(kept).description.training["complete"] is (when == "evaluation")
    assert f": {kept}" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["demo-training"]


def test_somebodys_files_are_not_replaced(tmp_path):
    (tmp_path / "thesis.tex").write_text("years", encoding="utf-8")
    with pytest.raises(OutputError, match="already holds files"):
        demo(tmp_path, steps=1)
