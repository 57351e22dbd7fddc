"""`finssim train`: a directory that runs, is repeatable by seed, survives Ctrl-C, and holds station once trained."""

import csv
import hashlib
import multiprocessing
import os
import shutil
import signal
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml

from finssim.agents.agent import AgentError
from finssim.control.modes import action_mode
from finssim.control.policy import Policy
from finssim.core.files import OutputError
from finssim.evaluation.evaluate import evaluate_controller
from finssim.evaluation.plants import load_plant
from finssim.evaluation.trials import TrialSettings
from finssim.learning import episodes
from finssim.learning.export import onnx_bytes
from finssim.learning.learners import LEARNERS, LearningError
from finssim.learning.resume import ResumeError, read_state, write_state
from finssim.learning.train import TrainingError, TrainingSettings, train
from finssim.learning.training_loop import TrainingLoop
from finssim.sim.ranges_file import RangesError
from finssim.tasks import EnvironmentSetupError, StationKeeping, Task, TrajectoryTracking
from finssim.vehicles import VehicleError, load_vehicle
from reference.guess import Guess

TINY = {"worlds": 16, "steps": 8192}


@dataclass(frozen=True, kw_only=True)
class Unmeasured(Guess):
    """Task whose episodes neither succeed nor fail."""

    name: str = "unmeasured"

    def metrics(self, arrays):
        return Task.metrics(self, arrays)


def network(folder: Path) -> str:
    return hashlib.sha256((folder / "policy.onnx").read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A tiny training."""
    return train("t1", TrainingSettings(seed=5, **TINY), out=tmp_path_factory.mktemp("runs") / "tiny")


def test_the_policy_loads_for_what_it_was_trained_with(trained):
    """Vehicle, task, action mode and rate are those of the training, and the policy computes actions."""
    vehicle, task = load_vehicle("finsrov"), StationKeeping()
    schema = task.schema.model_dump(mode="json")
    policy = Policy.load(
        trained,
        vehicle=vehicle,
        task={"name": "t1", "observation": schema},
        mode=action_mode("wrench6", vehicle).describe(),
    )
    action = policy.step(policy.reset(3), np.zeros((3, 16)))[0]
    assert action.shape == (3, 6) and np.abs(action).max() <= 1.0


def test_the_description_is_enough_to_repeat_the_training(trained):
    """The file contains the seed, settings of learner and task, the vehicle's hash, completed steps, and the
    revision."""
    told = yaml.safe_load((trained / "policy.yaml").read_text(encoding="utf-8"))
    training = told["training"]
    assert told["seed"] == 5 and told["vehicle"]["sha256"] == load_vehicle("finsrov").sha256
    assert training["worlds"] == 16 and training["steps"] == 8192 and training["steps_done"] == 8192
    assert training["observe"]["name"] == "training" and training["observe"]["position_std"] == 0.01
    assert training["complete"] is True and training["randomization"] is None
    assert training["task"]["reward"]["position"] == StationKeeping().reward.position
    assert "revision" in told["provenance"]


def test_curves_and_log_are_written(trained):
    """There is a row for every update; TensorBoard's file is beside the policy."""
    with (trained / "curves.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["steps"]) for row in rows] == [4096, 8192]
    assert {"seconds", "steps_per_s", "mean_return", "held", "action_std"} <= rows[0].keys()
    assert 0.0 <= float(rows[0]["evaluation_success"]) <= 1.0 and float(rows[0]["evaluation_return"]) < 0.0
    assert list((trained.parent / "tiny-training" / "tensorboard").glob("events.out.tfevents*"))
    assert sorted(p.name for p in trained.iterdir()) == ["curves.csv", "policy.onnx", "policy.yaml"]


@pytest.mark.slow
def test_equal_seeds_are_equal_policies(trained, tmp_path):
    """Policies of equal seeds are bit-identical; another seed gives another, in the same directory if wanted."""
    assert network(train("t1", TrainingSettings(seed=6, **TINY), out=tmp_path / "p")) != network(trained)
    assert network(train("t1", TrainingSettings(seed=5, **TINY), out=tmp_path / "p")) == network(trained)


def test_options_reach_the_policy(tmp_path):
    """Action mode, model, ranges and observations are recorded as used."""
    out = train(
        "t1",
        TrainingSettings(
            action="thruster8",
            hydrodynamics="simplified",
            randomize="fossen_learn_to_swim",
            observe="sensors",
            **TINY,
        ),
        out=tmp_path / "p",
    )
    told = Policy.load(out).description
    assert told.action["mode"] == "thruster8" and told.action_size == 8
    assert told.hydrodynamics == "simplified" and told.training["randomization"]["mass"] == [0.98, 1.02]
    seen = told.training["observe"]
    assert seen["name"] == "sensors" and seen["fixes"]["rate"] == 30.0 and seen["depth"]["noise_std"] == 0.005


def interrupt_after(updates, monkeypatch):
    """Raise Ctrl-C in the update after a number of updates."""
    update = TrainingLoop._update

    def interrupt(self, total):
        if len(self.curves) == updates:
            raise KeyboardInterrupt
        return update(self, total)

    monkeypatch.setattr(TrainingLoop, "_update", interrupt)


@pytest.mark.slow
def test_an_interrupted_training_writes_the_policy_so_far(tmp_path, monkeypatch):
    """Ctrl-C in the fourth update gives a complete directory, marked as interrupted, and the interrupt is
    raised again."""
    interrupt_after(3, monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        train("t1", TrainingSettings(worlds=16, steps=100_000), out=tmp_path / "p")
    told = Policy.load(tmp_path / "p").description.training
    assert told["complete"] is False and told["steps_done"] == 3 * 4096


@pytest.mark.slow
def test_an_interrupted_training_leaves_an_earlier_policy_alone(trained, tmp_path, monkeypatch, capsys):
    """The policy so far is written beside the earlier one, which is reported; a finished training replaces it."""
    out = tmp_path / "p"
    shutil.copytree(trained, out)
    interrupt_after(2, monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        train("t1", TrainingSettings(worlds=16, steps=100_000), out=out)
    kept = tmp_path / "p-training" / "interrupted"
    assert network(out) == network(trained) and Policy.load(out).description.training["complete"] is True
    assert Policy.load(kept).description.training["complete"] is False
    assert f"policy so far: {kept}" in capsys.readouterr().err


def test_a_training_interrupted_before_it_learned_writes_no_policy(trained, tmp_path, monkeypatch, capsys):
    """No policy is written, nor an earlier one replaced: the network would be the random initial one."""
    interrupt_after(0, monkeypatch)
    shutil.copytree(trained, tmp_path / "earlier")
    for name in ("new", "earlier"):
        with pytest.raises(KeyboardInterrupt):
            train("t1", TrainingSettings(worlds=16, steps=100_000), out=tmp_path / name)
        assert "no policy: interrupted before anything was learned" in capsys.readouterr().err
        assert not list((tmp_path / f"{name}-training").rglob("policy.yaml"))
    assert not (tmp_path / "new").exists() and network(tmp_path / "earlier") == network(trained)


SMALL = {"worlds": 16, "steps": 4096, "seed": 5, "settings": {"rollout": 32, "batch": 128, "epochs": 2}}
"""Options of a training of eight updates, with a checkpoint after every second one."""


@pytest.mark.slow
def test_the_last_two_checkpoints_are_kept_and_are_policies(tmp_path):
    """Each checkpoint is beside the policy, named by its steps, and loads.

    Those of an earlier and longer training are removed: they would count as newer, and this one's would be removed.
    """
    for steps, names in ((4096, ("000003072", "000004096")), (2048, ("000001536", "000002048"))):
        train("t1", TrainingSettings(**{**SMALL, "steps": steps}), out=tmp_path / "p")
        folders = sorted((tmp_path / "p-training").glob("checkpoint-*"))
        assert [folder.name for folder in folders] == [f"checkpoint-{name}" for name in names]
        assert Policy.load(folders[0]).description.training["steps_done"] == int(names[0])


def die_in_the_sixth_update(out, learner, options):
    """Run a training and end it by kill -9."""
    update = TrainingLoop._update

    def dying(self, total):
        if len(self.curves) == 5:
            os.kill(os.getpid(), signal.SIGKILL)
        return update(self, total)

    TrainingLoop._update = dying
    train("t1", TrainingSettings(learner=learner, **options), out=out)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.parametrize("learner", ["ppo", "ppo from pid", "sb3-ppo"])
def test_a_killed_training_goes_on_to_the_same_policy(tmp_path, learner):
    """After kill -9 in the sixth of eight updates and --resume, network and curves are as without interruption."""
    options = dict(SMALL)
    if learner == "ppo from pid":
        learner, options["init"] = "ppo", "pid"
        options["settings"] = {**SMALL["settings"], "taught": 0.9}
    whole = train("t1", TrainingSettings(learner=learner, **options), out=tmp_path / "whole")
    # A forked child has already imported everything.
    run = multiprocessing.get_context("fork").Process(
        target=die_in_the_sixth_update, args=(tmp_path / "p", learner, options)
    )
    run.start()
    run.join()
    assert run.exitcode == -signal.SIGKILL
    assert not (tmp_path / "p").exists() and (tmp_path / "p-training" / "checkpoint-000002048").is_dir()
    resumed = train("t1", TrainingSettings(learner=learner, **options), out=tmp_path / "p", resume=True)
    assert network(resumed) == network(whole)
    clock = {"seconds", "steps_per_s"}
    rows = [
        [
            {k: v for k, v in row.items() if k not in clock}
            for row in csv.DictReader((folder / "curves.csv").open())
        ]
        for folder in (whole, resumed)
    ]
    assert rows[0] == rows[1] and len(rows[0]) == 8


@pytest.mark.slow
def test_only_the_same_training_is_resumed(tmp_path, capsys):
    """Other arguments are named; a missing training is reported; before the first checkpoint it starts afresh."""
    with pytest.raises(ResumeError, match="nothing to resume: there is no folder .*leave out --resume"):
        train("t1", TrainingSettings(**SMALL), out=tmp_path / "p", resume=True)
    first = network(train("t1", TrainingSettings(**SMALL), out=tmp_path / "p"))
    with pytest.raises(ResumeError, match="seed was 5 and is 6 now: give the original settings"):
        train("t1", TrainingSettings(**{**SMALL, "seed": 6}), out=tmp_path / "p", resume=True)
    side = tmp_path / "p-training"
    for path in side.glob("checkpoint-*/resume.npz"):
        state = read_state(path)
        del state["best"]
        write_state(state, path)
    with pytest.raises(ResumeError, match="the checkpoint is of an earlier version: leave out --resume"):
        train("t1", TrainingSettings(**SMALL), out=tmp_path / "p", resume=True)
    for state in side.glob("checkpoint-*/resume.npz"):
        state.write_bytes(state.read_bytes()[:1000])
    with pytest.raises(ResumeError, match="checkpoint-000003072/resume.npz: cannot be resumed from"):
        train("t1", TrainingSettings(**SMALL), out=tmp_path / "p", resume=True)
    for folder in side.glob("checkpoint-*"):
        shutil.rmtree(folder)
    assert network(train("t1", TrainingSettings(**SMALL), out=tmp_path / "p", resume=True)) == first
    assert "yet: starting from the beginning" in capsys.readouterr().err.replace("\n", " ")


@pytest.mark.parametrize("learner", ["ppo", pytest.param("torchrl-ppo", marks=pytest.mark.slow)])
def test_a_learner_whose_numbers_run_away_is_stopped(tmp_path, learner):
    """A diverging learner is stopped with one sentence, and no policy is written."""
    options = {**SMALL, "settings": {**SMALL["settings"], "learning_rate": 1e30}}
    with pytest.raises((LearningError, EnvironmentSetupError), match="diverged"):
        train("t1", TrainingSettings(learner=learner, **options), out=tmp_path / "p")
    assert not (tmp_path / "p").exists()


@pytest.mark.parametrize(
    ("options", "error", "sentence"),
    [
        ({"task": "t9"}, EnvironmentSetupError, "unknown task 't9'; available: t1"),
        ({"vehicle": "finsro"}, VehicleError, "did you mean 'finsrov'"),
        (
            {"observe": "eyes"},
            EnvironmentSetupError,
            "observe is 'eyes', expected truth, estimator, sensors, training",
        ),
        ({"randomize": "hold"}, RangesError, "no ranges 'hold'"),
        ({"action": "wrench5"}, ValueError, "unknown action mode 'wrench5'"),
        ({"hydrodynamics": "fosen"}, ValueError, "unknown hydrodynamic model 'fosen'"),
        ({"worlds": 0}, TrainingError, "worlds is 0, expected 1 or more"),
        ({"steps": -5}, TrainingError, "steps is -5, expected 1 or more"),
        ({"learner": "sb3"}, LearningError, "unknown learner 'sb3'; available: ppo"),
        (
            {"learner": "torchrl-mappo"},
            LearningError,
            "task 't1' has one agent, and this learner trains several",
        ),
        ({"settings": {"gamma": 0.9}}, LearningError, "unknown setting 'gamma'; available: worlds"),
        (
            {"init": "pid", "learner": "rsl-rl"},
            TrainingError,
            "learner 'rsl-rl' has no initial imitation",
        ),
        (
            {"init": "pdi"},
            AgentError,
            "expert 'pdi' is neither a policy directory nor a baseline of task 't1'",
        ),
        ({"device": "tpu"}, ValueError, "device 'tpu' is not available"),
    ],
)
def test_what_cannot_be_trained_is_refused_at_once(tmp_path, options, error, sentence):
    """An impossible training is refused in one sentence, and no files are left."""
    task = options.pop("task", "t1")
    with pytest.raises(error, match=sentence):
        train(task, TrainingSettings(**{**TINY, **options}), out=tmp_path / "p")
    assert list(tmp_path.iterdir()) == []


def test_somebodys_files_are_not_replaced(tmp_path):
    """A folder that contains anything but a policy is refused before the training."""
    (tmp_path / "thesis.tex").write_text("years", encoding="utf-8")
    with pytest.raises(OutputError, match="already holds files"):
        train("t1", TrainingSettings(**TINY), out=tmp_path)


@pytest.mark.slow
def test_a_policy_trained_from_nothing_holds_the_published_setpoints(tmp_path):
    """All eight setpoints are held in the nominal plant, within 2 cm and 1.5° once settled: seed 1, default
    settings."""
    result = evaluate_controller(
        train("t1", TrainingSettings(seed=1), out=tmp_path / "p"), load_plant("nominal")
    ).result
    assert (result["success"], result["trials"]) == (8, 8)
    assert result["e_p_m"] <= 0.02 and result["e_psi_deg"] <= 1.5


def test_a_training_ends_where_the_held_episodes_succeed(tmp_path):
    """Two successes in a row end the training early; the curves end there, and the policy is complete."""
    settings = {"learning_rate": 1e-2, "discount": 0.5, "rollout": 16, "batch": 64, "hidden": [16, 16]}
    folder = train(
        Guess(),
        TrainingSettings(worlds=32, steps=100_000, until=0.95, settings=settings, seed=1),
        out=tmp_path / "p",
    )
    with (folder / "curves.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    told = Policy.load(folder).description.training
    assert told["complete"] is True and told["until"] == 0.95
    assert told["steps_done"] == int(rows[-1]["steps"]) < 50_000 < told["steps"]
    shares = [float(row["evaluation_success"]) for row in rows]
    changes = [
        k
        for k in range(1, len(rows))
        if int(rows[k]["steps"]) // 10_000 > int(rows[k - 1]["steps"]) // 10_000
    ]
    assert [shares[k] >= 0.95 for k in changes[-2:]] == [True, True]
    assert not any(
        shares[a] >= 0.95 and shares[b] >= 0.95 for a, b in zip(changes, changes[1:-1], strict=False)
    )


def test_the_network_that_did_best_is_left(tmp_path, monkeypatch):
    """The network with the most successes in held evaluations is kept; ties go to the return, then to the later one."""
    scores = iter(
        [(0.1, 5.0), (0.9, 1.0), (0.9, 2.0), (0.9, 2.0), (0.5, 9.0), (0.9, 1.9), (0.0, 0.0), (0.8, 8.0)]
    )
    networks = []

    def scored(self, network):
        success, total = next(scores)
        networks.append(network)
        return {"evaluation_return": total, "evaluation_success": success}

    monkeypatch.setattr(episodes.HeldEvaluation, "__call__", scored)
    folder = train("t1", TrainingSettings(**SMALL), out=tmp_path / "p")
    description = Policy.load(folder).description
    assert (folder / "policy.onnx").read_bytes() == onnx_bytes(networks[3], description)
    told = description.training
    assert (told["best_after"], told["steps_done"], told["complete"]) == (2048, 4096, True)


def test_a_policy_that_begins_from_a_pid_holds_sooner(tmp_path):
    """After 50,000 steps, an eighth of the default, the policy holds all setpoints; trained from scratch, none."""
    folder = train("t1", TrainingSettings(seed=1, steps=50_000, init="pid"), out=tmp_path / "p")
    result = evaluate_controller(folder, load_plant("nominal")).result
    assert (result["success"], result["trials"]) == (8, 8) and result["e_p_m"] < 0.005
    again = train(
        "t1", TrainingSettings(seed=2, steps=50_000, init=folder, randomize="pool"), out=tmp_path / "again"
    )
    assert evaluate_controller(again, load_plant("nominal")).result["success"] == 8


def test_team_pursuit_begins_from_its_baseline_where_that_can_act(tmp_path):
    """Training starts from the baseline in the task's own action mode, unless another teacher or none is requested."""
    tiny = {"worlds": 8, "steps": 4096, "settings": {"hidden": [16]}}
    for options, teacher in (({}, "formation"), ({"action": "wrench6"}, ""), ({"init": "none"}, "")):
        folder = train("team-pursuit", TrainingSettings(**tiny, **options), out=tmp_path / "p")
        assert Policy.load(folder).description.training["teacher"] == teacher


@pytest.mark.parametrize(
    ("task", "until", "sentence"),
    [
        ("t1", 1.5, "until is 1.5, expected a share of successes above 0, at most 1"),
        (Unmeasured(), 0.9, "until is 0.9, but task 'unmeasured' has no metric 'success'"),
    ],
)
def test_an_end_that_cannot_come_is_refused(tmp_path, task, until, sentence):
    with pytest.raises(TrainingError, match=sentence):
        train(task, TrainingSettings(until=until, **TINY), out=tmp_path / "p")
    assert not (tmp_path / "p").exists()


def test_trajectory_tracking_is_trained_too(tmp_path):
    """The policy has T2's own settings and noise, and fits the robot's observation."""
    folder = train("t2", TrainingSettings(seed=1, randomize="hold_for_position", **TINY), out=tmp_path / "t2")
    policy = Policy.load(
        folder, task={"name": "t2", "observation": TrajectoryTracking().schema.model_dump(mode="json")}
    )
    assert policy.step(policy.reset(2), np.zeros((2, 30)))[0].shape == (2, 6)
    training = yaml.safe_load((folder / "policy.yaml").read_text(encoding="utf-8"))["training"]
    assert training["discount"] == 0.9 and training["learner"] == "ppo"
    assert training["task"]["training_noise"]["position_std"] == 0.01
    kind, task = LEARNERS["ppo"], StationKeeping()
    assert kind.settings(task, randomized=True).steps > kind.settings(task).steps


@pytest.mark.slow
def test_a_short_training_follows_the_straight_line(tmp_path):
    """After half of the usual steps the error is within 3 cm, several times below the paper's best on hardware."""
    folder = train("t2", TrainingSettings(seed=1, steps=300_000), out=tmp_path / "t2")
    result = evaluate_controller(folder, load_plant("nominal"), TrialSettings(trials=1), task="t2").result
    assert result["horizontal_rmse_m"] < 0.03 and result["vertical_rmse_m"] < 0.03
