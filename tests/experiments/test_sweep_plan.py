"""Sweep files: every setting with every seed, and one sentence for what cannot be."""

import math

import pytest
import yaml

from finssim.experiments.plants import PlantError
from finssim.experiments.sweep import SweepError, load_sweep

PLAIN = {"task": "t1", "seeds": 2, "train": {"steps": 1000}}
SEARCH = {"trials": 3, "minimise": "e_p_m", "options": {"steps": {"low": 10, "high": 99}}}


def written(folder, **changes):
    path = folder / "sweep.yaml"
    path.write_text(yaml.safe_dump({**PLAIN, **changes}), encoding="utf-8")
    return path


def test_settings_times_grid_times_seeds(tmp_path):
    """Seeds outermost, so that every setting has a result early; what is more special wins."""
    file = written(
        tmp_path,
        seeds=[5, 7],
        settings={"plain": {}, "small": {"worlds": 64, "steps": 10}},
        grid={"action": ["wrench6", "wrench4"], "randomize": [None, "pool"]},
    )
    jobs = load_sweep(file).jobs()
    assert len(jobs) == 2 * 2 * 4 and [job.seed for job in jobs] == [5] * 8 + [7] * 8
    small = [job for job in jobs if job.name == "small_action-wrench4_randomize-pool"]
    assert [job.options for job in small] == [
        {"steps": 10, "worlds": 64, "action": "wrench4", "randomize": "pool"}
    ] * 2
    assert len({job.key for job in jobs}) == len(jobs)
    settings = {job.key.removesuffix(str(job.seed)) for job in jobs}
    assert len(settings) == len(jobs) // 2


def test_a_number_of_seeds_counts_from_one(tmp_path):
    assert [job.seed for job in load_sweep(written(tmp_path, seeds=3)).jobs()] == [1, 2, 3]


def test_files_are_looked_for_beside_the_sweep(tmp_path):
    """And their whole paths go to the workers."""
    (tmp_path / "mine.yaml").write_text("{}", encoding="utf-8")
    job = load_sweep(written(tmp_path, vehicle="mine.yaml", train={"randomize": "mine.yaml"})).jobs()[0]
    assert job.vehicle == str(tmp_path / "mine.yaml") == job.options["randomize"]


def test_a_changed_file_is_another_job(tmp_path):
    """A plant is looked for beside the sweep too; what it says decides what comes of a job, so it is in the name."""
    keys = []
    for model in ("mesh", "simplified"):
        (tmp_path / "mine.yaml").write_text(f"hydrodynamics: {model}", encoding="utf-8")
        job = load_sweep(written(tmp_path, evaluate={"plants": ["mine.yaml"]})).jobs()[0]
        assert job.plants == (str(tmp_path / "mine.yaml"),)
        keys.append(job.key)
    assert keys[0] != keys[1]


def test_a_plant_that_is_not_there_is_told_before_any_training(tmp_path):
    with pytest.raises(PlantError, match="no plant 'currant'.*did you mean 'current'"):
        load_sweep(written(tmp_path, evaluate={"plants": ["nominal", "currant"]}))


@pytest.mark.parametrize(
    "changes, sentence",
    [
        ({"task": "t9"}, "task is 't9', expected one of t1"),
        ({"train": {"stepz": 1}}, "'stepz' is no option of a training; available: learner"),
        ({"train": {"worlds": math.nan}}, "worlds is nan, expected a finite number"),
        ({"settings": {"a": {"out": "x"}}}, "'out' is no option"),
        ({"seeds": []}, "expected at least one, each once"),
        ({"seeds": [1, 1]}, "expected at least one, each once"),
        ({"evaluate": {"trials": 0}}, "evaluate.trials: Input should be greater than or equal to 1"),
        ({"evaluate": {"plants": []}}, "evaluate.plants: Tuple should have at least 1 item"),
        ({"tusk": "t1"}, "tusk: Extra inputs are not permitted"),
        ({"search": SEARCH | {"maximise": "success"}}, "expected either 'minimise' or 'maximise'"),
        ({"search": SEARCH, "grid": {"action": ["wrench6"]}}, "leave 'settings' and 'grid' out"),
        ({"search": SEARCH | {"options": {"stepz": {"choice": [1]}}}}, "'stepz' is no option of a training"),
        ({"search": SEARCH | {"options": {"a.b": {"choice": [1]}}}}, "one with a dot is settings.NAME"),
        (
            {"search": SEARCH | {"options": {"steps": {"low": 1, "choice": [1]}}}},
            "expected either 'low' and 'high', or",
        ),
        (
            {"search": SEARCH | {"options": {"steps": {"low": 1}}}},
            "expected either 'low' and 'high', or 'choice'",
        ),
        (
            {"search": SEARCH | {"options": {"steps": {"low": 2, "high": 1}}}},
            "low is 2, expected less than high",
        ),
        (
            {"search": SEARCH | {"options": {"steps": {"low": 0, "high": 1, "log": True}}}},
            "'log' needs a 'low' above 0",
        ),
    ],
)
def test_what_cannot_be_is_refused(tmp_path, changes, sentence):
    with pytest.raises(SweepError, match=sentence):
        load_sweep(written(tmp_path, **changes))


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(SweepError, match="cannot be read"):
        load_sweep(tmp_path / "nothing.yaml")


@pytest.mark.parametrize(
    "changes",
    [
        {"settings": {"../../mine": {}}},
        {"settings": {"/tmp/mine": {}}},
        {"settings": {"a\\b": {}}},
        {"settings": {"a" * 300: {}}},
        {"grid": {"action": ["a\\b"]}},
        {"settings": {"C:x": {}}, "grid": {"action": ["wrench6"]}},
    ],
    ids=range(6),
)
def test_a_setting_names_a_folder_of_the_sweep(tmp_path, changes):
    """Each job has one, whose name begins with that of its setting and what the grid sets."""
    with pytest.raises(SweepError, match="^setting '.*expected the plain name of a file or folder"):
        load_sweep(written(tmp_path, **changes)).jobs()
