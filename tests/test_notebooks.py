"""The notebooks run from their first cell to their last."""

import base64
import json
import runpy
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"
NOTEBOOKS = sorted((EXAMPLES / "notebooks").glob("*.ipynb"))
COURSE = sorted((EXAMPLES / "course").glob("*.ipynb"))


def cells(path: Path) -> list[dict]:
    """Return the code cells of a notebook, in order."""
    notebook = json.loads(path.read_text(encoding="utf-8"))
    assert notebook["nbformat"] == 4
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def code(path: Path) -> str:
    """Return the code of a notebook without IPython directives."""
    lines = [line for cell in cells(path) for line in [*cell["source"], "\n"]]
    return "".join(line for line in lines if not line.startswith("%"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_committed_without_outputs(path):
    """A notebook is committed without outputs, so that differences show only its author's changes."""
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in cells(path))


@pytest.mark.parametrize("path", COURSE, ids=lambda path: path.stem)
def test_the_course_is_committed_as_it_ran(path):
    """Learners read the course before they install anything: every cell ran once, in order, without a warning."""
    assert [cell["execution_count"] for cell in cells(path)] == list(range(1, len(cells(path)) + 1))
    outputs = [output for cell in cells(path) for output in cell["outputs"]]
    assert all(o["output_type"] != "error" and o.get("name") != "stderr" for o in outputs)
    pictures = [o["data"]["image/png"] for o in outputs if "image/png" in o.get("data", {})]
    assert pictures and max(len(base64.b64decode(picture)) for picture in pictures) < 100_000


SHORT = {
    "05_learning": ("steps=STEPS,", 'steps=50_000, init="pid",'),
    "train_and_look_inside": ("steps=300_000,", "steps=16_384,"),
}
"""Replacements that shorten a notebook's training; an agent that must hold its goal afterwards starts as a PID."""


@pytest.mark.slow
@pytest.mark.parametrize("path", [*NOTEBOOKS, *COURSE], ids=lambda path: path.stem)
def test_a_notebook_runs(path, tmp_path, monkeypatch, capsys):
    """Each notebook runs from first to last cell in its own folder, unchanged except for shortened trainings."""
    text = code(path)
    if path.stem in SHORT:
        words, fewer = SHORT[path.stem]
        assert words in text
        text = text.replace(words, fewer)
    (tmp_path / "notebook.py").write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    with matplotlib.rc_context({"backend": "Agg"}):
        runpy.run_path("notebook.py", run_name="__main__")
        plt.close("all")
    assert capsys.readouterr().out.strip()
