"""A user's task by file and class is found, loaded once, or refused in a sentence."""

from pathlib import Path

import pytest

from finssim.tasks import EnvironmentSetupError, task_named

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "own/task/keep_depth.py"


def test_a_class_of_a_file_or_module_is_a_task():
    """It has its own settings; a file is read once, so that two tasks from it share their class."""
    task = task_named(f"{EXAMPLE}:KeepDepth", deepest=0.6)
    assert task.name == "keep-depth" and task.deepest == 0.6
    assert type(task) is type(task_named(f"{EXAMPLE}:KeepDepth"))
    assert task_named("finssim.tasks.docking:Docking").name == "docking"


@pytest.mark.parametrize(
    ("text", "words", "sentence"),
    [
        (None, "task.py:Mine", "there is no file .*task.py"),
        ("x = 1 +\n", "task.py:Mine", "task.py fails: SyntaxError"),
        ("import nowhere\n", "task.py:Mine", "fails: ModuleNotFoundError: No module named 'nowhere'"),
        (
            "from finssim.tasks import Task\nclass Near(Task): pass\n",
            "task.py:Mine",
            "no task 'Mine'; tasks there: Near",
        ),
        (
            "from finssim.tasks import Task\nclass Near(Task): pass\n",
            "task.py",
            "give task.py:CLASS; tasks there: Near",
        ),
        ("def Mine(): return 3\n", "task.py:Mine", "makes a int, expected a Task"),
        ("def Mine(x): return 3\n", "task.py:Mine", "cannot be made: .*missing 1 required"),
        ("", "no.where:Mine", "module 'no.where' cannot be imported"),
    ],
)
def test_what_is_no_task_is_refused(tmp_path, monkeypatch, text, words, sentence):
    """The refusal gives location, problem and what was expected."""
    monkeypatch.chdir(tmp_path)
    if text is not None:
        (tmp_path / "task.py").write_text(text)
    with pytest.raises(EnvironmentSetupError, match=sentence):
        task_named(words)
