"""A recurrent policy: exported as learnt, with memory carried from action to action and reset in every episode."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from torch import nn

import finssim
from finssim.agents.agent import NOWHERE, agent_for, expert_for, known_in
from finssim.agents.memory import restarted
from finssim.control.guidance import Known, Station
from finssim.control.modes import action_mode
from finssim.control.policy import Policy, PolicyError
from finssim.learning.episodes import HeldEvaluation
from finssim.learning.export import ExportError
from finssim.learning.network import Cell, Linear
from finssim.learning.torch_networks import plain_network
from finssim.robot.pilots import make_pilot
from finssim.robot.reading import Reading
from finssim.tasks import StationKeeping
from finssim.tasks.observer import Observer
from reference.policies import FINSROV, written

STATION = Station((1.0, -0.3, -0.5), 0.6)
READING = Reading(5.0, np.array([0.2, 0.1, -0.4]), np.array([0.0, 0.0, 0.1, 0.995]), np.full(6, 0.05), True)


def parts():
    """Return a torch GRU and layers behind it, with weights as large as a trained network's."""
    gru, layers = nn.GRU(16, 16), nn.Sequential(nn.Linear(16, 8), nn.ELU(), nn.Linear(8, 6))
    with torch.no_grad():
        for i, parameter in enumerate(nn.ModuleList([gru, layers]).parameters()):
            parameter.copy_(torch.randn(parameter.shape, generator=torch.Generator().manual_seed(i)) * 0.4)
    return gru, layers


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """A policy for station keeping with random weights."""
    gru, layers = parts()
    weights = {name: parameter.detach() for name, parameter in gru.named_parameters()}
    cell = Cell(*(Linear(weights[f"weight_{x}_l0"].T, weights[f"bias_{x}_l0"]) for x in ("ih", "hh")))
    network = replace(plain_network(layers), cell=cell)
    return written(network, tmp_path_factory.mktemp("policies") / "remembers", StationKeeping(), 6)


def test_it_acts_as_torch_steps_its_gru(policy):
    """Policy and torch agree step by step, each row with its own memory, and through episode starts in some rows."""
    gru, layers = parts()
    run = Policy.load(policy)
    rng, state, memory = np.random.default_rng(2), torch.zeros(1, 5, 16), run.reset(5)
    distinct = set()
    for k in range(12):
        starts = np.array([k == 0, k == 0, k in (0, 4), k in (0, 4, 5), k in (0, 11)])
        observation = rng.uniform(-1.0, 1.0, (5, 16)).astype(np.float32)
        with torch.no_grad():
            state = state * torch.from_numpy(~starts)[None, :, None]
            answer, state = gru(torch.from_numpy(observation)[None], state)
            expected = layers(answer[0]).clamp(-1.0, 1.0).numpy()
        action, memory = run.step(restarted(memory, run.reset(5), starts), observation)
        np.testing.assert_allclose(action, expected, rtol=0, atol=2e-6)
        np.testing.assert_allclose(memory, state[0].numpy(), rtol=0, atol=2e-6)
        distinct |= {round(float(value), 4) for value in action[:, 0]}
    assert len(distinct) > 30


def test_a_memory_that_is_not_the_policys_is_refused(policy, tmp_path):
    """Refused: no memory, other rows, one for a policy without memory, and a network whose memory differs
    from its file."""
    run, seen = Policy.load(policy), np.zeros((2, 16))
    with pytest.raises(
        PolicyError,
        match=r"received no memory, expected one of shape \(2, 16\): start with the result of reset",
    ):
        run.act(seen)
    with pytest.raises(
        PolicyError, match=r"received one of shape \(3, 16\), expected one of shape \(2, 16\)"
    ):
        run.step(run.reset(3), seen)
    plain = Policy.load(written(nn.Sequential(nn.Linear(16, 6)), tmp_path / "plain", StationKeeping(), 6))
    with pytest.raises(PolicyError, match=r"received one of shape \(2, 16\), expected no memory"):
        plain.step(run.reset(2), seen)
    told = yaml.safe_load((policy / "policy.yaml").read_text())
    assert told["memory"] == 16 and plain.description.memory == 0
    other = tmp_path / "other"
    other.mkdir()
    content = (policy / "policy.onnx").read_bytes()
    (other / "policy.onnx").write_bytes(content)
    told |= {"memory": 4, "files": {"policy.onnx": hashlib.sha256(content).hexdigest()}}
    (other / "policy.yaml").write_text(yaml.safe_dump(told))
    with pytest.raises(
        PolicyError, match="maps 16 and 16 values to 6 and 16, but policy.yaml describes 16 and 4 to 6 and 4"
    ):
        Policy.load(other)


def test_a_module_that_remembers_is_not_exported(tmp_path):
    """A module with memory is refused, since torch's exporter does not support memories."""
    with pytest.raises(ExportError, match="a torch module with memory cannot be written"):
        written(Counting(), tmp_path / "p", StationKeeping(), 6)
    size = StationKeeping().schema.size
    with pytest.raises(ExportError, match="a torch module with memory cannot be written"):
        written(torch.nn.LSTM(size, 6), tmp_path / "p", StationKeeping(), 6)


def test_a_pilot_remembers_until_it_is_reset(policy):
    """The pilot's thrusts are those of the policy's own steps; after `reset` the first ones come again."""
    pilot, run = make_pilot(policy, FINSROV), Policy.load(policy)
    mode, seen = action_mode("wrench6", FINSROV), Observer("t1", FINSROV).observe(READING, STATION, 0.0)
    memory, given = run.reset(1), []
    for _ in range(3):
        action, memory = run.step(memory, seen)
        given.append(pilot.act(READING, STATION, 0.0))
        np.testing.assert_allclose(given[-1], mode.to_thrusters(action), atol=1e-9)
    assert np.abs(given[2] - given[0]).max() > 0.1
    pilot.reset()
    np.testing.assert_array_equal(pilot.act(READING, STATION, 0.0), given[0])


def test_an_agent_remembers_and_begins_anew_where_an_episode_does(policy):
    """The agent's actions are those of the policy's own steps, row by row, in evaluation and imitation."""
    environment, task = finssim.make("t1", worlds=3, seed=4), StationKeeping()
    agent, run = agent_for(policy, FINSROV, task), Policy.load(policy)
    expert = expert_for(policy, FINSROV, task, "wrench6")
    played, shown, memory = agent.reset(3), expert.reset(3), run.reset(3)
    anew = np.array([False, True, False])
    for k in range(3):
        seen = environment.arrays.observation.numpy().copy()
        expected, memory = run.step(memory, seen)
        action, played = agent.act(played, known_in(environment), NOWHERE)
        np.testing.assert_array_equal(action, expected)
        if k == 2:
            expected[1] = run.step(run.reset(3), seen)[0][1]
            shown = restarted(shown, expert.reset(3), anew)
        wanted, shown = expert.act(shown, Known(seen), NOWHERE)
        np.testing.assert_array_equal(wanted, expected)
        environment.step(action)


class Counting(nn.Module):
    """Module that counts its calls."""

    memory_size = 1

    def __init__(self):
        super().__init__()
        self.seen = []

    def forward(self, observation, memory):
        self.seen.append(memory[0].item())
        return torch.zeros(len(observation), 6), memory + 1.0


def test_a_held_evaluation_begins_without_memory():
    """A held evaluation starts without memory and carries it from step to step."""
    held = HeldEvaluation(finssim.make(replace(StationKeeping(), time_limit=1.0), worlds=2, seed=5))
    network = Counting()
    for _ in range(2):
        held(network)
    assert network.seen == [*range(10), *range(10)]
