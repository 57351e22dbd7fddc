"""Sweep files: every combination with every seed, and one sentence for an unusable file."""

import math

import pytest
import yaml

from finssim.evaluation.plants import PlantError
from finssim.studies.sweep import SweepError, load_sweep

PLAIN = {"task": "t1", "seeds": 2, "train": {"steps": 1000}}


def written(folder, **changes):
    path = folder / "sweep.yaml"
    path.write_text(yaml.safe_dump({**PLAIN, **changes}), encoding="utf-8")
    return path


def test_grid_times_seeds(tmp_path):
    """Seeds vary slowest, so that every combination has an early result; the grid overrides the common options."""
    file = written(
        tmp_path,
        seeds=[5, 7],
        train={"steps": 10, "action": "thruster8", "settings": {"epochs": 4, "discount": 0.9}},
        grid={
            "action": ["wrench6", "wrench4"],
            "randomize": [None, "pool"],
            "settings.learning_rate": [1e-4, 3e-4],
        },
    )
    trainings = load_sweep(file).trainings()
    assert len(trainings) == 2 * 8 and [one.seed for one in trainings] == [5] * 8 + [7] * 8
    name = "action-wrench4_randomize-pool_learning_rate-0.0003"
    settings = {"epochs": 4, "discount": 0.9, "learning_rate": 3e-4}
    assert [one.options for one in trainings if one.setting == name] == [
        {"steps": 10, "action": "wrench4", "randomize": "pool", "settings": settings}
    ] * 2
    assert len({one.run for one in trainings}) == len(trainings)
    assert all(one.run.startswith(f"{one.setting}-") for one in trainings)
    assert len({one.run.removesuffix(f"-seed{one.seed}") for one in trainings}) == len(trainings) // 2


def test_a_number_of_seeds_counts_from_one(tmp_path):
    assert [one.seed for one in load_sweep(written(tmp_path, seeds=3)).trainings()] == [1, 2, 3]


def test_files_are_relative_to_the_sweep(tmp_path):
    """Paths of vehicle, ranges and plants are relative to the sweep; workers receive the full paths."""
    for name in ("mine.yaml", "water.yaml"):
        (tmp_path / name).write_text("{}", encoding="utf-8")
    changes = {
        "vehicle": "mine.yaml",
        "train": {"randomize": "mine.yaml"},
        "evaluate": {"plants": ["water.yaml"]},
    }
    plan = load_sweep(written(tmp_path, **changes))
    assert plan.vehicle == plan.train["randomize"] == str(tmp_path / "mine.yaml")
    assert plan.evaluate.plants == (str(tmp_path / "water.yaml"),)


@pytest.mark.parametrize("key", ["vehicle", "randomize"])
def test_a_changed_file_is_another_training(tmp_path, key):
    """The content of vehicle and ranges files affects the policy, so it is part of the directory's name."""
    runs = []
    for name in ("finsrov", "bluerov2"):
        (tmp_path / "mine.yaml").write_text(f"extends: {name}\n", encoding="utf-8")
        changes = {"vehicle": "mine.yaml"} if key == "vehicle" else {"train": {"randomize": "mine.yaml"}}
        runs.append(load_sweep(written(tmp_path, **changes)).trainings()[0].run)
    assert runs[0] != runs[1]


def test_a_plant_that_is_not_there_is_told_before_any_training(tmp_path):
    with pytest.raises(PlantError, match="no plant 'currant'.*did you mean 'current'"):
        load_sweep(written(tmp_path, evaluate={"plants": ["nominal", "currant"]}))


@pytest.mark.parametrize(
    "changes, sentence",
    [
        ({"task": "t9"}, "task is 't9', expected one of t1"),
        ({"train": {"stepz": 1}}, "'stepz' is not an option of a training; available: learner"),
        ({"train": {"worlds": math.nan}}, "worlds is nan, expected a finite number"),
        ({"grid": {"out": ["x"]}}, "'out' is not an option"),
        ({"grid": {"a.b": [1]}}, "'a.b' is not an option of a training; .*settings.NAME"),
        ({"train": {"settings.epochs": 1}}, "'settings.epochs' is not an option"),
        ({"seeds": []}, "expected at least one, each once"),
        ({"seeds": [1, 1]}, "expected at least one, each once"),
        ({"evaluate": {"trials": 0}}, "evaluate.trials: Input should be greater than or equal to 1"),
        ({"evaluate": {"plants": []}}, "evaluate.plants: Tuple should have at least 1 item"),
        ({"tusk": "t1"}, "tusk: unknown key, did you mean 'task'"),
        ({"search": {"trials": 3}}, "search: unknown key; known keys: task"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path, changes, sentence):
    with pytest.raises(SweepError, match=sentence):
        load_sweep(written(tmp_path, **changes))


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(SweepError, match="cannot be read"):
        load_sweep(tmp_path / "nothing.yaml")


@pytest.mark.parametrize("value", ["../../mine\\x", "a\\b", "a" * 300], ids=range(3))
def test_a_combination_names_a_directory_of_the_sweep(tmp_path, value):
    """Each training has a directory whose name begins with the options of the grid."""
    with pytest.raises(SweepError, match="^setting '.*expected the plain name of a file or folder"):
        load_sweep(written(tmp_path, grid={"action": [value]})).trainings()
