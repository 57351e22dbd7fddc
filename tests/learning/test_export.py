"""A written policy computes the network's output, and is written completely or not at all."""

from __future__ import annotations

import csv
import hashlib
import json
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml
from torch import nn

import finssim
from finssim.agents.agent import agent_for
from finssim.control.policy import (
    ObservationEntry,
    ObservationSchema,
    Policy,
    PolicyDescription,
    PolicyError,
    VehicleIdentity,
)
from finssim.core.files import OutputError
from finssim.learning.export import ExportError, export_policy, save_policy
from finssim.learning.torch_networks import ACTIVATIONS
from finssim.tasks import task_named
from finssim.vehicles import load_vehicle


def description(n: int = 16, m: int = 6) -> PolicyDescription:
    entry = ObservationEntry(name="everything", indices=tuple(range(n)), unit="1")
    return PolicyDescription(
        task="t1",
        observation=ObservationSchema(size=n, entries=(entry,)),
        action={"mode": "wrench6", "size": m, "limits": np.ones(m), "scale": (1.0,) * m},
        control_period=0.1,
        vehicle=VehicleIdentity(name="minnow", sha256=hashlib.sha256(b"minnow").hexdigest()),
        hydrodynamics="calibrated",
        seed=1,
    )


def perceptron(activation: type[nn.Module], n: int = 16, m: int = 6, width: int = 64) -> nn.Sequential:
    torch.manual_seed(0)
    hidden = nn.Sequential(nn.Linear(n, width), activation(), nn.Linear(width, width), activation())
    return nn.Sequential(nn.Identity(), hidden, nn.Linear(width, m, bias=False))


class Gated(nn.Module):
    """Network that is not a plain stack of layers, so that torch's exporter has to write it."""

    def __init__(self) -> None:
        super().__init__()
        self.gate, self.action = nn.Linear(16, 6), nn.Linear(16, 6)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return torch.sigmoid(self.gate(observation)) * self.action(observation)


NETWORKS = {
    "tanh": perceptron(nn.Tanh),
    "relu": perceptron(nn.ReLU),
    "elu": perceptron(nn.ELU),
    "traced": Gated(),
}


@pytest.mark.slow
@pytest.mark.parametrize("network", NETWORKS.values(), ids=NETWORKS)
def test_onnxruntime_computes_what_torch_does(tmp_path, network):
    """The two agree to 1e-6 over one observation and many, at the clipping limits too."""
    last = [layer for layer in network.modules() if isinstance(layer, nn.Linear)][-1]
    with torch.no_grad():
        last.weight *= 3.0  # so that some actions reach the limits
    policy = Policy.load(export_policy(network, tmp_path / "run", description()))
    observation = np.random.default_rng(1).normal(size=(7, 300, 16))
    with torch.no_grad():
        expected = network(torch.as_tensor(observation, dtype=torch.float32)).clamp(-1, 1).numpy()
    action = policy.act(observation)
    assert action.shape == (7, 300, 6)
    assert np.any(np.abs(expected) == 1.0)
    np.testing.assert_allclose(action, expected, rtol=0, atol=1e-6)
    np.testing.assert_allclose(policy.act(observation[3, 4]), expected[3, 4], rtol=0, atol=1e-6)


def test_a_plain_perceptron_is_exported_in_half_a_second(tmp_path):
    """The export is fast, as a training may take 40 s in all; torch's own exporter would take several of them."""
    network = perceptron(nn.Tanh, width=256)
    export_policy(network, tmp_path / "first", description())
    start = time.process_time()
    export_policy(network, tmp_path / "second", description())
    assert time.process_time() - start < 0.5


def test_the_directory_holds_all_that_was_said_and_where_it_came_from(tmp_path):
    rows = [{"steps": 100, "reward": -1.5}, {"steps": 200, "reward": -0.25}]
    network, evaluation = perceptron(nn.Tanh), {"success": 8}
    folder = export_policy(network, tmp_path / "run", description(), curves=rows, evaluation=evaluation)
    said = yaml.safe_load((folder / "policy.yaml").read_text())
    assert said["action"]["limits"] == [1.0] * 6
    assert said["observation"]["entries"][0]["indices"] == list(range(16))
    assert said["files"]["policy.onnx"] == hashlib.sha256((folder / "policy.onnx").read_bytes()).hexdigest()
    assert "torch" in said["provenance"]["packages"]
    filled_in = {"files", "provenance", "created"}
    assert Policy.load(folder).description.model_dump(exclude=filled_in) == description().model_dump(
        exclude=filled_in
    )
    with (folder / "curves.csv").open() as file:
        assert [float(row["reward"]) for row in csv.DictReader(file)] == [-1.5, -0.25]
    assert json.loads((folder / "evaluation.json").read_text()) == {"success": 8}


def test_a_network_of_other_sizes_is_refused_and_leaves_nothing(tmp_path):
    for network in (perceptron(nn.Tanh), Gated()):
        with pytest.raises(
            ExportError, match=r"maps \(2, 16\) to \(2, 6\), but the description has \(2, 8\)"
        ):
            export_policy(network, tmp_path / "run", description(m=8))
        with pytest.raises(ExportError, match="does not take observations of 20 elements"):
            export_policy(network, tmp_path / "run", description(n=20))
    assert list(tmp_path.iterdir()) == []


def test_a_trained_network_with_large_gains_is_exported(tmp_path):
    """A network with large gains is exported, although float32 alone rounds its actions by more than 1e-6."""
    network = perceptron(nn.ELU, width=256)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter *= 4.0
    export_policy(network, tmp_path / "run", description())


def test_a_wrong_graph_is_refused_and_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setitem(ACTIVATIONS, nn.Tanh, "Sigmoid")
    with pytest.raises(ExportError, match="onnxruntime and the network differ by"):
        export_policy(perceptron(nn.Tanh), tmp_path / "run", description())
    assert list(tmp_path.iterdir()) == []


def test_a_network_with_a_nan_weight_is_refused_and_leaves_nothing(tmp_path):
    network = perceptron(nn.Tanh)
    with torch.no_grad():
        network[2].weight[0, 0] = torch.nan
    with pytest.raises(ExportError, match="differ by nan"):
        export_policy(network, tmp_path / "run", description())
    assert list(tmp_path.iterdir()) == []


def test_an_earlier_policy_is_replaced_but_other_files_are_not(tmp_path):
    export_policy(perceptron(nn.Tanh), tmp_path / "run", description(), evaluation={"success": 1})
    export_policy(perceptron(nn.ReLU), tmp_path / "run", description())
    assert not (tmp_path / "run" / "evaluation.json").exists()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").write_text("precious")
    with pytest.raises(OutputError, match="already holds files"):
        export_policy(perceptron(nn.Tanh), tmp_path / "other", description())
    assert (tmp_path / "other" / "thesis.tex").read_text() == "precious"


def test_an_interrupted_export_leaves_the_earlier_policy(tmp_path, monkeypatch):
    folder = export_policy(perceptron(nn.Tanh), tmp_path / "run", description())
    before = (folder / "policy.onnx").read_bytes()

    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("finssim.learning.export._write_curves", interrupt)
    with pytest.raises(KeyboardInterrupt):
        export_policy(perceptron(nn.ReLU), folder, description())
    assert (folder / "policy.onnx").read_bytes() == before
    assert list(tmp_path.iterdir()) == [folder]


def learned_elsewhere(library, worlds):
    """Return an untrained model of that library, and its output for observations (N, n)."""
    n, m = worlds.observation_size, worlds.action_size
    if library == "torch":
        model = nn.Sequential(nn.Linear(n, 8), nn.Tanh(), nn.Linear(8, m))
        return model, lambda x: model(torch.from_numpy(x)).detach().numpy()
    if library == "rsl-rl":
        pytest.importorskip("rsl_rl")
        from rsl_rl.models import MLPModel
        from tensordict import TensorDict

        distribution = {"class_name": "GaussianDistribution", "init_std": 0.4, "std_type": "log"}
        seen = TensorDict({"policy": torch.zeros(1, n)}, batch_size=[1])
        actor = MLPModel(
            seen, {"actor": ["policy"]}, "actor", m, [8, 8], "elu", distribution_cfg=distribution
        )
        runner = SimpleNamespace(alg=SimpleNamespace(actor=actor))
        rows = lambda x: TensorDict({"policy": torch.from_numpy(x)}, batch_size=[len(x)])  # noqa: E731
        return runner, lambda x: actor(rows(x)).detach().numpy()
    import stable_baselines3

    from finssim.learning.sb3 import Sb3VecEnv

    options = {"buffer_size": 100} if library == "SAC" else {"n_steps": 8, "batch_size": 16}
    model = getattr(stable_baselines3, library)(
        "MlpPolicy", Sb3VecEnv(worlds), seed=1, device="cpu", **options
    )
    return model, lambda x: model.predict(x, deterministic=True)[0]


@pytest.mark.parametrize("library", ["torch", "PPO", "SAC", "rsl-rl"])
def test_what_is_learned_elsewhere_runs_everywhere(library, tmp_path):
    """A policy has its environment's task, vehicle, limits and scale; the robot's agent acts like the model."""
    worlds = finssim.make("t1", worlds=2, vehicle="bluerov2_heavy", wrench_scale=0.5, seed=3)
    model, act = learned_elsewhere(library, worlds)
    folder = save_policy(model, worlds, tmp_path / "policy", steps=12)
    vehicle = load_vehicle("bluerov2_heavy")
    agent = agent_for(folder, vehicle, worlds.task)
    assert agent.action == "wrench6" and np.allclose(agent.wrench_scale, 0.5)
    x = np.random.default_rng(2).normal(size=(4, 16)).astype(np.float32)
    np.testing.assert_allclose(agent.policy.act(x), np.clip(act(x), -1.0, 1.0), rtol=0, atol=1e-5)
    training = agent.policy.description.training
    assert training["steps"] == 12 and training["task"]["time_limit"] == 20.0
    with pytest.raises(PolicyError, match="trained for vehicle bluerov2_heavy"):
        agent_for(folder, load_vehicle("finsrov"), task_named("t1"))


def test_what_cannot_be_written_is_refused(tmp_path):
    """Refused: a model that scales its own observations, one of another size, and an object that is no model."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecNormalize

    from finssim.learning.sb3 import Sb3VecEnv

    worlds = finssim.make("t1", worlds=2, seed=3)
    scaled = PPO("MlpPolicy", VecNormalize(Sb3VecEnv(worlds)), n_steps=8, batch_size=16, device="cpu")
    for model, message in (
        (scaled, "VecNormalize scales the observations: train without it"),
        (nn.Linear(15, 6), "does not take observations of 16 elements"),
        (nn.Linear(16, 4), r"maps \(2, 16\) to \(2, 4\)"),
        (print, "expected a torch module"),
    ):
        with pytest.raises(ExportError, match=message):
            save_policy(model, worlds, tmp_path / "policy")
    assert not list(tmp_path.iterdir())
