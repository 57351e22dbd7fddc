"""The log says of every episode what it had and how it went."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from finssim.engine.randomize import Randomization
from finssim.engine.ranges_file import Ranges
from finssim.tasks import Environment, EnvironmentSetupError, StationKeeping
from finssim.tasks.drawing import OUTCOME, LogError

RANGES = Ranges(name="test", mass=(0.9, 1.3), current=(0.0, 0.2))


@pytest.fixture(scope="module")
def logged():
    """Three episodes of four steps in five worlds, with what a look at the plant says of each."""
    env = Environment(StationKeeping(time_limit=0.4), worlds=5, randomization=Randomization(RANGES), seed=6)
    log, seen = env.drawing.start_log(), []
    for step in range(13):
        if step % 4 == 0:
            seen.append(env.simulator.plant.mass.numpy()[:, 0] / env.simulator.vehicles[0].body.mass)
        env.step(np.full((5, 6), 0.1))
        if step % 4 == 3:
            seen.append((env.arrays.final_return.numpy().copy(), env.arrays.final_held.numpy().copy()))
    return log, seen


def test_every_episode_that_ended_has_its_row(logged):
    log, seen = logged
    e = log.episodes()
    assert list(e) == [*OUTCOME, "mass", "current", "current.direction"] and len(e["mass"]) == 15
    np.testing.assert_array_equal(e["world"], np.tile(np.arange(5), 3))
    np.testing.assert_array_equal(e["episode"], np.repeat([1, 2, 3], 5))
    assert (e["length"] == 4).all()
    np.testing.assert_allclose(e["mass"], np.concatenate(seen[0:6:2]), rtol=1e-6)
    np.testing.assert_allclose(e["episode_return"], np.concatenate([x[0] for x in seen[1:6:2]]), rtol=1e-6)
    np.testing.assert_allclose(e["held"], np.concatenate([x[1] for x in seen[1:6:2]]), rtol=1e-6)


def test_the_table_has_a_row_for_each_episode_and_says_what_it_was_drawn_from(logged, tmp_path):
    """As `episodes` has them; ranges, units, vehicles and seed beside it."""
    log, _ = logged
    target = log.save(tmp_path / "draws.csv")
    with target.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    e = log.episodes()
    assert len(rows) == 15 and list(rows[0]) == list(e)
    for name, column in e.items():
        np.testing.assert_allclose([float(row[name]) for row in rows], column, rtol=1e-6)
    about = json.loads((tmp_path / "draws.csv.json").read_text(encoding="utf-8"))
    assert about["ranges"]["mass"] == [0.9, 1.3] and about["seed"] == 6 and about["units"]["current"] == "m/s"
    assert about["vehicles"][0]["name"] == "finsrov" and "revision" in about["provenance"]


def test_episodes_that_are_cut_off_are_left_out():
    env = Environment(StationKeeping(time_limit=0.4), worlds=3, randomization=Randomization(RANGES), seed=6)
    log = env.drawing.start_log()
    env.step(np.zeros((3, 6)))
    env.reset()
    mass = env.drawing.draws.numpy(["mass"])[:, 0, 0]
    assert len(log.episodes()["world"]) == 0
    for _ in range(4):
        env.step(np.zeros((3, 6)))
    np.testing.assert_array_equal(log.episodes()["mass"], mass)
    assert (log.episodes()["episode"] == 2).all()


def test_a_world_that_waits_for_its_reset_has_one_row():
    """Without automatic reset an episode stays done until somebody starts the next."""
    env = Environment(
        StationKeeping(time_limit=0.2),
        worlds=3,
        randomization=Randomization(RANGES),
        seed=6,
        auto_reset=False,
    )
    log = env.drawing.start_log()
    for _ in range(4):
        env.step(np.zeros((3, 6)))
    assert log.episodes()["world"].tolist() == [0, 1, 2]
    env.reset(mask=[True, False, False])
    for _ in range(3):
        env.step(np.zeros((3, 6)))
    assert log.episodes()["world"].tolist() == [0, 1, 2, 0] and log.episodes()["episode"].tolist() == [
        1,
        1,
        1,
        2,
    ]


def test_what_cannot_be_logged_is_refused(logged, tmp_path):
    log, _ = logged
    with pytest.raises(LogError, match="ends in '.txt', expected .csv"):
        log.save(tmp_path / "draws.txt")
    with pytest.raises(EnvironmentSetupError, match="nothing is drawn that could be logged"):
        Environment(StationKeeping()).drawing.start_log()
