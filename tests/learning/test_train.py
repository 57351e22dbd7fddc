"""`finssim train`: a directory that runs, repeats by its seed, survives Ctrl-C, and holds station once trained."""

import csv
import hashlib
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from finssim.control.modes import action_mode
from finssim.control.observe_t2 import SCHEMA as SCHEMA_T2
from finssim.control.policy import Policy
from finssim.engine.ranges_file import RangesError
from finssim.experiments.evaluate import evaluate_controller
from finssim.experiments.plants import load_plant
from finssim.files import OutputError
from finssim.learning import ppo
from finssim.learning.description import observation_schema
from finssim.learning.train import TrainingError, train
from finssim.tasks import StationKeeping
from finssim.vehicles import VehicleError, load_vehicle

TINY = {"worlds": 16, "steps": 8192}


def network(folder: Path) -> str:
    return hashlib.sha256((folder / "policy.onnx").read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A tiny training."""
    return train("t1", out=tmp_path_factory.mktemp("runs") / "tiny", seed=5, **TINY)


def test_the_policy_loads_for_what_it_was_trained_with(trained):
    """Vehicle, task, action mode and rate are those of the training, and actions come out."""
    vehicle, task = load_vehicle("finsrov"), StationKeeping()
    schema = observation_schema(task).model_dump(mode="json")
    policy = Policy.load(
        trained,
        vehicle=vehicle,
        task={"name": "t1", "observation": schema},
        mode=action_mode("wrench6", vehicle).describe(),
        control_period=0.1,
    )
    action = policy.act(np.zeros((3, 16)))
    assert action.shape == (3, 6) and np.abs(action).max() <= 1.0


def test_the_description_is_enough_to_repeat_the_training(trained):
    """Seed, settings of learner and task, vehicle's hash, steps done, revision."""
    told = yaml.safe_load((trained / "policy.yaml").read_text(encoding="utf-8"))
    training = told["training"]
    assert told["seed"] == 5 and told["vehicle"]["sha256"] == load_vehicle("finsrov").sha256
    assert training["worlds"] == 16 and training["steps"] == 8192 and training["steps_done"] == 8192
    assert training["complete"] is True and training["randomization"] is None
    assert training["task"]["reward"]["position"] == StationKeeping().reward.position
    assert "revision" in told["provenance"]


def test_curves_and_log_are_written(trained):
    """A row for every update; TensorBoard's file stands beside the policy."""
    with (trained / "curves.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["steps"]) for row in rows] == [8192]
    assert {"seconds", "steps_per_s", "mean_return", "held", "action_std"} <= rows[0].keys()
    assert list((trained.parent / "tiny-training" / "tensorboard").glob("events.out.tfevents*"))
    assert sorted(p.name for p in trained.iterdir()) == ["curves.csv", "policy.onnx", "policy.yaml"]


def test_equal_seeds_are_equal_policies(trained, tmp_path):
    """Bit for bit; another seed is another policy."""
    assert network(train("t1", out=tmp_path / "again", seed=5, **TINY)) == network(trained)
    assert network(train("t1", out=tmp_path / "other", seed=6, **TINY)) != network(trained)


def test_options_reach_the_policy(tmp_path):
    """Action mode, model and ranges are recorded as they were used."""
    out = train(
        "t1",
        out=tmp_path / "p",
        action="thruster8",
        hydrodynamics="simplified",
        randomize="fossen_learn_to_swim",
        **TINY,
    )
    told = Policy.load(out).description
    assert told.action["mode"] == "thruster8" and told.action_size == 8
    assert told.hydrodynamics == "simplified" and told.training["randomization"]["mass"] == [0.98, 1.02]


def interrupt_after(rollouts, monkeypatch):
    """Ctrl-C at the end of that rollout, before the update that follows it."""
    record = ppo._Watch._on_rollout_end

    def interrupt(self):
        record(self)
        if len(self.curves) == rollouts:
            raise KeyboardInterrupt

    monkeypatch.setattr(ppo._Watch, "_on_rollout_end", interrupt)


def test_an_interrupted_training_writes_the_policy_so_far(tmp_path, monkeypatch):
    """Ctrl-C in the third update: a whole policy directory, that says so, then the interrupt goes on."""
    interrupt_after(3, monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        train("t1", out=tmp_path / "p", worlds=16, steps=100_000)
    told = Policy.load(tmp_path / "p").description.training
    assert told["complete"] is False and told["steps_done"] == 3 * 8192


def test_an_interrupted_training_leaves_an_earlier_policy_alone(trained, tmp_path, monkeypatch, capsys):
    """The policy so far goes beside it, which is said; a finished training replaces it as ever."""
    out = tmp_path / "p"
    shutil.copytree(trained, out)
    interrupt_after(2, monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        train("t1", out=out, worlds=16, steps=100_000)
    kept = tmp_path / "p-training" / "interrupted"
    assert network(out) == network(trained) and Policy.load(out).description.training["complete"] is True
    assert Policy.load(kept).description.training["complete"] is False
    assert f"policy so far: {kept}" in capsys.readouterr().err


def test_a_training_interrupted_before_it_learned_writes_no_policy(trained, tmp_path, monkeypatch, capsys):
    """Neither anew nor over an earlier one: the network would be the random one that it started as."""
    interrupt_after(1, monkeypatch)
    shutil.copytree(trained, tmp_path / "earlier")
    for name in ("new", "earlier"):
        with pytest.raises(KeyboardInterrupt):
            train("t1", out=tmp_path / name, worlds=16, steps=100_000)
        assert "no policy: interrupted before anything was learned" in capsys.readouterr().err
        assert not list((tmp_path / f"{name}-training").rglob("policy.yaml"))
    assert not (tmp_path / "new").exists() and network(tmp_path / "earlier") == network(trained)


def test_checkpoints_are_policies(tmp_path, monkeypatch):
    """Each stands beside the policy, under the steps it had seen, and loads."""
    monkeypatch.setattr(ppo, "CHECKPOINT_STEPS", 8192)
    train("t1", out=tmp_path / "p", worlds=16, steps=16_384)
    folders = sorted((tmp_path / "p-training").glob("checkpoint-*"))
    assert [folder.name for folder in folders] == ["checkpoint-000008192", "checkpoint-000016384"]
    assert Policy.load(folders[0]).description.training["steps_done"] == 8192


@pytest.mark.parametrize(
    ("options", "error", "sentence"),
    [
        ({"task": "t9"}, TrainingError, "unknown task 't9'; available: t1"),
        ({"vehicle": "finsro"}, VehicleError, "did you mean 'finsrov'"),
        ({"randomize": "hold"}, RangesError, "no ranges 'hold'"),
        ({"action": "wrench5"}, ValueError, "unknown action mode 'wrench5'"),
        ({"hydrodynamics": "fosen"}, ValueError, "unknown hydrodynamic model 'fosen'"),
        ({"worlds": 0}, TrainingError, "worlds is 0, expected 1 or more"),
        ({"steps": -5}, TrainingError, "steps is -5, expected 1 or more"),
        ({"device": "tpu"}, ValueError, "device 'tpu' is not available"),
    ],
)
def test_what_cannot_be_trained_is_refused_at_once(tmp_path, options, error, sentence):
    """One sentence, and nothing is left behind."""
    task = options.pop("task", "t1")
    with pytest.raises(error, match=sentence):
        train(task, out=tmp_path / "p", **{**TINY, **options})
    assert list(tmp_path.iterdir()) == []


def test_somebodys_files_are_not_replaced(tmp_path):
    """A folder that holds anything but a policy is refused before the training."""
    (tmp_path / "thesis.tex").write_text("years", encoding="utf-8")
    with pytest.raises(OutputError, match="already holds files"):
        train("t1", out=tmp_path, **TINY)


def test_an_earlier_policy_is_replaced(trained, tmp_path):
    """The same directory may be trained into again."""
    train("t1", out=tmp_path / "p", seed=6, **TINY)
    assert network(train("t1", out=tmp_path / "p", seed=5, **TINY)) == network(trained)


@pytest.mark.long
def test_a_policy_trained_from_nothing_holds_the_published_setpoints(tmp_path):
    """All eight in the nominal plant, within 2 cm and 1.5° once settled: seed 1, default settings."""
    result = evaluate_controller(train("t1", out=tmp_path / "p", seed=1), load_plant("nominal")).result
    assert (result["success"], result["trials"]) == (8, 8)
    assert result["e_p_m"] <= 0.02 and result["e_psi_deg"] <= 1.5


def test_trajectory_tracking_is_trained_too(tmp_path):
    """T2's own settings and noise, in a policy that the robot's observation fits."""
    folder = train("t2", out=tmp_path / "t2", seed=1, randomize="hold_for_position", **TINY)
    policy = Policy.load(folder, task={"name": "t2", "observation": SCHEMA_T2.model_dump(mode="json")})
    assert policy.act(np.zeros((2, 30))).shape == (2, 6)
    training = yaml.safe_load((folder / "policy.yaml").read_text(encoding="utf-8"))["training"]
    assert training["discount"] == ppo.SETTINGS["t2"].discount != ppo.SETTINGS["t1"].discount
    assert training["task"]["training_noise"]["position_std"] == 0.01
    assert ppo.settings_for("t2", randomized=True).steps > ppo.settings_for("t2").steps


@pytest.mark.long
def test_a_short_training_follows_the_straight_line(tmp_path):
    """After half of the usual steps: within 3 cm, several times better than the paper's best on hardware."""
    folder = train("t2", out=tmp_path / "t2", seed=1, steps=650_000)
    result = evaluate_controller(folder, load_plant("nominal"), task="t2", trials=1).result
    assert result["horizontal_rmse_m"] < 0.03 and result["vertical_rmse_m"] < 0.03
