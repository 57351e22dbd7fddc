"""The commands, as a person types them."""

import json
import re

import pytest
from typer.main import get_command

from finssim import __version__, boundary
from finssim.cli import app

COMMANDS = [
    "demo",
    "train",
    "evaluate",
    "simulate",
    "vehicles",
    "vehicles show",
    "validate",
    "bench",
    "doctor",
]


def finssim(*words):
    """Run a command here and now; returns its exit status."""
    return boundary.run(app, [str(word) for word in words])


def refusal(capsys, *words):
    """The one sentence with which a command refuses its input."""
    assert finssim(*words) == 2
    out, err = capsys.readouterr()
    assert err.startswith("finssim: ") and err.count("\n") == 1
    return err.removeprefix("finssim: ").strip()


def test_commands_are_those_of_the_contract():
    """No command is missing or left over."""
    assert set(get_command(app).commands) == {name for name in COMMANDS if " " not in name}


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_an_example_that_the_parser_takes(capsys, command):
    """Every command's help ends with an example of itself, whose options it has."""
    assert finssim(*command.split(), "--help") == 0
    help_text = " ".join(capsys.readouterr().out.split())
    example = re.search(rf"Example: (finssim {command}.*?)(?= Arguments:| Options:)", help_text)[1]
    assert set(re.findall(r"--[a-z-]+", example)) <= set(
        re.findall(r"--[a-z-]+", help_text.replace(example, ""))
    )


def test_version(capsys):
    """The version is the package's."""
    assert finssim("--version") == 0
    assert capsys.readouterr().out == f"finssim {__version__}\n"


def test_no_command_shows_the_help(capsys):
    """`finssim` alone shows what there is."""
    assert finssim() == 0
    assert "Commands:" in capsys.readouterr().out


def test_vehicles_lists_the_catalogue(capsys):
    """Every vehicle of the catalogue is listed by its name."""
    from finssim.vehicles import catalogue

    assert finssim("vehicles") == 0
    out = capsys.readouterr().out
    assert all(name[:12] in out for name in catalogue())


def test_a_vehicle_is_shown_and_drawn(capsys, tmp_path):
    """`vehicles show` prints the vehicle and writes the picture whole."""
    assert finssim("vehicles", "show", "finsrov", "--picture", tmp_path / "finsrov.png") == 0
    assert "12.11" in capsys.readouterr().out
    assert (tmp_path / "finsrov.png").read_bytes().startswith(b"\x89PNG")
    assert [file.name for file in tmp_path.iterdir()] == ["finsrov.png"]


def test_a_picture_needs_a_known_format(capsys, tmp_path):
    """A format that cannot be drawn is refused before anything is printed."""
    assert "expected one of .png .svg .pdf" in refusal(
        capsys, "vehicles", "show", "finsrov", "--picture", tmp_path / "x.doc"
    )


def test_a_mistyped_vehicle_gets_its_name(capsys):
    """An unknown vehicle names the nearest and all there are."""
    sentence = refusal(capsys, "vehicles", "show", "finrov")
    assert "did you mean 'finsrov'?" in sentence and "rexrov" in sentence


def test_doctor_as_json(capsys):
    """`doctor --json` prints one object."""
    assert finssim("doctor", "--json") == 0
    assert json.loads(capsys.readouterr().out)["healthy"] is True


def test_simulate_writes_what_it_says(capfd, tmp_path):
    """The example of the README: a table, where it was written, and nothing on standard error."""
    words = ["simulate", "--vehicle", "finsrov", "--command", "surge=10 yaw=1", "--duration", "1"]
    assert finssim(*words, "--out", tmp_path / "run.csv") == 0
    out, err = capfd.readouterr()
    assert err == "" and "wrench given" in out and "run.csv" in out.replace("\n", "")
    assert (tmp_path / "run.csv").exists()


def test_simulate_refuses_in_a_sentence(capsys, tmp_path):
    """A wrong word in the command, and a place that takes no files."""
    words = ["simulate", "--vehicle", "finsrov", "--duration", "1", "--out"]
    assert "did you mean 'surge'?" in refusal(capsys, *words, tmp_path / "run.csv", "--command", "surg=10")
    assert "write elsewhere" in refusal(capsys, *words, "/proc/x/run.csv", "--command", "surge=10")
