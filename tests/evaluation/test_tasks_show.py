"""`finssim tasks`: each task in a line, or one in full with the numbers of its environment."""

import json
import re
from pathlib import Path

import pytest

from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.cli.tasks_show import attribute_docs, describe_task
from finssim.control.course import course_speeds
from finssim.tasks import TASKS, make, numeric_tasks
from finssim.tasks.station_keeping import StationKeeping

NUMERIC = numeric_tasks()

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "own/task/keep_depth.py"
WARP_EXAMPLE = EXAMPLE.parents[2] / "own_task.py"


def finssim(*words):
    return boundary.run(app, [str(word) for word in words])


def test_every_task_is_listed(capsys):
    """Each task is listed by name, with its goal and its baseline."""
    assert finssim("tasks") == 0
    out = capsys.readouterr().out
    assert all(name in out for name in TASKS.usable())
    assert all(words in out for words in ("align-insert", "docking", "pid", "[s]"))


@pytest.mark.slow
@pytest.mark.parametrize("name", (*TASKS, f"{EXAMPLE}:KeepDepth", f"{WARP_EXAMPLE}:KeepDepth"))
def test_rewards_ends_and_totals_are_told_in_words(name):
    """Rewards, ends and totals are each a sentence, without source code."""
    told = describe_task(name)
    for one in (*told["reward"]["terms"], *told["ends"], *told["totals"]):
        assert one["meaning"].endswith("."), one
        assert not re.search(r"\bp\.|\bw[,\]]|wp\.|\[0\]|>=| \* ", one["meaning"]), one


@pytest.mark.slow
@pytest.mark.parametrize("name", NUMERIC)
def test_what_is_told_is_what_the_environment_has(name):
    """Sizes, agents, others, action limits and times agree; no part of the observation is missing."""
    told, env = describe_task(name), make(name)
    assert told["observation"]["size"] == env.observation_size
    assert sum(part["size"] for part in told["observation"]["parts"]) == env.observation_size
    assert told["action"]["size"] == env.action_size and len(told["agents"]) == env.agents
    assert told["title"] and told["success"] != "as defined by metrics" and told["baselines"]
    assert len(told["reward"]["weights"]) > 4 and "\n" in told["reward"]["meaning"]
    first = told["action"]["components"][0]
    if told["action"]["mode"].startswith("course"):
        speeds = course_speeds(env.simulator.vehicles[0])
        assert first == {"name": "speed", "low": speeds[0], "high": speeds[-1], "unit": "m/s"}
        return
    surge = env.simulator.vehicles[0].wrench_limits[0]
    assert first == {"name": "surge", "low": -surge, "high": surge, "unit": "N"}


def test_a_task_is_shown_for_a_vehicle(capsys):
    """The text has units in brackets and the vehicle's own numbers; the data has the same content."""
    pytest.importorskip("finssim.extensions.teams")
    assert finssim("tasks", "show", "team-pursuit", "--vehicle", "bluerov2_heavy") == 0
    out = capsys.readouterr().out
    assert "measured with imu: rate 100" in out and "measured with fixes: rate 30" in out
    for words in ("prey (bluerov2_heavy)", "rad/s", "N m", "the net touches the prey"):
        assert words in out
    assert finssim("tasks", "show", "t1", "--action", "thruster8", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["action"]["size"] == 8 and told["action"]["components"][0]["unit"] == "N"
    settings = {one["name"]: one for one in told["settings"]}
    assert settings["tilt"]["meaning"] == "Largest roll and pitch at the start [rad]."
    assert finssim("tasks", "show", "pursuit", "--vehicle", "warpauv", "--json") == 0
    settings = {one["name"]: one["value"] for one in json.loads(capsys.readouterr().out)["settings"]}
    assert settings["prey_drive"]["level"] is None  # it never tips over


def test_a_task_of_ones_own_is_shown(capsys):
    """A user's task is given by file and class; its own words replace the weights."""
    assert finssim("tasks", "show", f"{EXAMPLE}:KeepDepth") == 0
    out = capsys.readouterr().out
    assert "keep-depth: Reach a depth" in out and "baselines: none" in out and "a slope near the depth" in out


def test_what_there_is_not_is_refused(capsys):
    """An unknown task is refused in one sentence."""
    assert finssim("tasks", "show", "t9") == 2
    assert "unknown task 't9'; available: t1" in capsys.readouterr().err
    assert finssim("tasks", "show", "t1", "--vehicle", "finrov") == 2
    assert "did you mean 'finsrov'" in capsys.readouterr().err


def test_sentences_under_fields_are_read_from_the_source():
    """The sentences of base classes are read too."""
    docs = attribute_docs(StationKeeping)
    assert docs["time_limit"] == "Length of an episode in training [s]." and docs["hold"].endswith("[s].")
