"""A command is a function: its signature gives the options, its docstring the help."""

import gc
import inspect
import re
import sys
from importlib import import_module
from pathlib import Path

import pytest
import typer
from typer.main import get_command

from finssim.cli import boundary, command_line
from finssim.cli.command_line import Definition, command_app, read, run_script
from finssim.cli.commands import SECTIONS, app
from reference.commands import EVERY

SOURCE = '''
from __future__ import annotations

from pathlib import Path

CALLS = []
RATE = 5.0  # [Hz]


def work(
    names: Sequence[Path],
    *,
    rate: Annotated[float, (0.0, 9.0)] = RATE,
    axes: Annotated[Sequence[str], ","] = ("surge", "yaw"),
    changes: Annotated[Sequence[str], "--set"] = (),
    deep: bool = False,
    out: Path | None = None,
    quiet: Annotated[bool, "python"] = True,
    console: Console | None = None,
    seed: int = 3,
) -> dict[str, object]:
    """Do a thing.

    Example: work a.csv --rate 2

    Args:
        names (TABLE): Tables.
        rate: Of the work [Hz], which is
            a number.
        axes (AXES): Which.
    """
    CALLS.append(locals())
    return {"ok": deep}
'''


@pytest.fixture
def work(tmp_path, monkeypatch):
    """A command made from the source above, and the arguments of its function."""
    (tmp_path / "thing.py").write_text(SOURCE)
    monkeypatch.setattr(command_line, "ROOT", tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    app = command_app({"Commands": {"work": "thing:work", "other": "thing:work"}}, {})
    import thing

    yield lambda *words: boundary.run(app, ["work", *words]), thing.CALLS
    del sys.modules["thing"]
    read.cache_clear()


def test_a_function_is_called_with_what_was_typed(work):
    """Positions, numbers, lists and flags reach the function with their types; other parameters keep their defaults."""
    run, calls = work
    words = [
        "a.csv",
        "b.csv",
        "--rate",
        "2",
        "--axes",
        "heave, roll",
        "--set",
        "x=1",
        "--set",
        "y=2",
        "--deep",
    ]
    assert run(*words, "--deep") == 0
    (given,) = calls
    assert given["names"] == [Path("a.csv"), Path("b.csv")] and given["rate"] == 2.0
    assert given["axes"] == ("heave", "roll") and given["changes"] == ["x=1", "y=2"]
    assert given["deep"] is True and given["out"] is None and given["quiet"] is True
    assert given["console"] is None and given["seed"] == 3


def test_defaults_are_those_of_the_function(work):
    """Omitted options are as in a call from Python; a result that is not ok gives status 3."""
    run, calls = work
    assert run("a.csv") == 3
    assert calls[0]["rate"] == 5.0 and calls[0]["axes"] == ("surge", "yaw") and calls[0]["changes"] == ()


@pytest.mark.parametrize(
    "words", [["--rate", "10"], ["--rate", "x"], ["--seed", "-1"], ["--quiet"], ["--changes", "x"]]
)
def test_what_is_not_of_the_signature_is_refused(work, capsys, words):
    """A number out of bounds, a word for a number and an unknown option are refused."""
    run, calls = work
    assert run("a.csv", *words) == 2 and not calls
    assert words[0] in capsys.readouterr().err


def test_help_is_the_docstring(work, capsys):
    """The help contains the text, and each argument with its unit, metavar, bounds and default."""
    run, _ = work
    assert run("--help") == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "Do a thing. Example: work a.csv --rate 2" in text
    assert "Of the work [Hz], which is a number. [default: 5.0; 0.0<=x<=9.0]" in text
    assert "TABLE" in text and "--axes AXES Which. [default: surge,yaw]" in text


@pytest.mark.parametrize(
    ("words", "status"), [(["a.csv", "--deep"], 0), (["a.csv"], 3), ([], 2), (["a.csv", "--rate", "10"], 2)]
)
def test_a_script_is_a_command_of_its_own(work, monkeypatch, words, status):
    """A script has the words, exit statuses and refusals of a `finssim` command; missing words are refused."""
    _, calls = work
    monkeypatch.setattr(sys, "argv", ["thing.py", *words])
    with pytest.raises(SystemExit) as end:
        run_script("thing:work")
    assert end.value.code == status and len(calls) == (status != 2)


@pytest.mark.slow
@pytest.mark.parametrize("words", EVERY)
def test_what_the_source_says_is_what_python_has(words):
    """Each command's options, as read from its source, are parameters of its function with the same defaults."""
    definition = read(EVERY[words])
    module, _, name = definition.path.partition(":")
    found = inspect.signature(getattr(import_module(module), name)).parameters
    extra = any(p.kind is p.VAR_KEYWORD for p in found.values())
    for name, argument in definition.arguments.items():
        assert name in found or extra
        if name in found and not isinstance(argument, Definition):
            assert found[name].default == argument.default


def test_every_option_has_help():
    """Every option of every command is described in its docstring."""

    def walk(command, words):
        for parameter in command.params:
            if parameter.name not in ("help", "context"):
                assert parameter.help, f"finssim {' '.join(words)}: {parameter.name}"
        for name in command.list_commands(None) if hasattr(command, "list_commands") else ():
            walk(command.get_command(None, name), [*words, name])

    from finssim.cli.commands import app

    assert isinstance(app, typer.Typer)
    walk(get_command(app), [])


@pytest.mark.parametrize("number", ["nan", "inf", "-inf", "1e300", "1e10"])
def test_a_number_without_bounds_is_a_quantity(capsys, tmp_path, number):
    """A number that is infinite or too large for any quantity is refused, and nothing is written."""
    words = ["simulate", "--vehicle", "finsrov", "--command", "surge=5", "--out", str(tmp_path / "run.csv")]
    assert boundary.run(app, [*words, "--duration", number]) == 2
    assert f"'--duration': {float(number):g} is not a number from -1e+09 to 1e+09" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


SERVING = {"pool", "teleop", "view", "play", "ros2 up", "ros2 node", "ardusub-sitl"}
"""Commands that serve, or already print lines of JSON."""


@pytest.mark.parametrize("words", [words for words in EVERY if words not in SERVING])
def test_every_command_with_a_result_prints_json(words, capsys):
    """Every command with a result has the option --json."""
    assert boundary.run(app, [*words.split(), "--help"]) == 0
    assert "--json" in capsys.readouterr().out


@pytest.mark.parametrize("words", EVERY)
def test_an_option_means_the_same_in_every_command(words, capsys):
    """--seed defaults to 1 wherever it has a default; the estimator is never called a mode."""
    assert boundary.run(app, [*words.split(), "--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    seed = re.search(r"--seed (?:<int range>|INTEGER RANGE) (?:(?! --).)*", text)
    assert seed is None or "[default: 1;" in seed[0] or words == "worlds show"
    assert "--mode" not in text.replace("--model", "")


def test_the_help_lists_commands_by_section_in_the_order_of_use(capsys):
    """Every command is listed once, below its section, and no line is wider than 80 columns."""
    assert boundary.run(app, ["--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    first = dict.fromkeys(words.partition(" ")[0] for words in EVERY)
    sections = [*SECTIONS, "Extensions"]
    assert [line.rstrip(":") for line in lines if line.rstrip(":") in sections] == sections
    listed = [line.split()[0] for line in lines if line.startswith("  ") and line.split()[0] in first]
    assert listed == list(first)


def test_garbage_is_searched_again_once_a_command_is_imported():
    """`main` disables garbage collection until the command is imported."""
    gc.disable()
    try:
        assert command_line.loaded("math:sqrt")(4.0) == 2.0 and gc.isenabled()
    finally:
        gc.enable()
