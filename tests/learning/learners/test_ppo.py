"""Our own PPO: equal with NumPy and torch, without the host; memory, scaling, and values of randomised quantities."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
from torch.utils._python_dispatch import TorchDispatchMode

import finssim
from finssim.control.policy import Policy
from finssim.learning.episodes import HeldEvaluation
from finssim.learning.layers import Arrays
from finssim.learning.learners import learner_named
from finssim.learning.learners.ppo import Ppo
from finssim.learning.network import Network
from finssim.sim.state import State
from finssim.tasks import ObservationPart, StationKeeping
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.terms import End, RewardTerm, Terms
from reference.guess import BEST, Guess, Steady, SteadyTogether, draw, guessed
from reference.policies import written

KIND = learner_named("ppo")
FEW = {"worlds": 8, "rollout": 8, "batch": 32, "epochs": 2, "hidden": (16, 16), "steps": 5000}


class Torch(Arrays):
    """Torch on the CPU with NumPy's random numbers."""

    def __init__(self, seed):
        super().__init__(seed, "cpu")

    def noise(self, out):
        return out.copy_(torch.from_numpy(self._rng.standard_normal(out.shape, dtype=np.float32)))

    def order(self, n):
        return torch.from_numpy(self._rng.permutation(n))


def made(task, arrays=None, seed=3, ranges="fossen_learn_to_swim", **changes):
    settings = replace(KIND.settings(task), **{**FEW, **changes})
    environment = finssim.make(
        task,
        worlds=settings.worlds,
        seed=seed,
        observe="training",
        randomize=ranges,
        privileged=ranges is not None,
    )
    return Ppo(environment, settings, seed=seed, arrays=arrays)


STILL = np.array([0.0, 1.0], np.float32)
"""A step of Adam that changes nothing."""

VARIANTS = [
    {},
    {"normalize": True, "history": 2, "last_action": True},
    {"memory": 8, "asymmetric": False},
    {"memory": 8, "history": 1, "normalize": True},
    {"integral": False},
]


@pytest.mark.parametrize("changes", VARIANTS)
def test_torch_learns_what_numpy_learns(changes):
    """With equal random numbers, three updates give equal curves, and parameters within float32 rounding."""
    numpy, torchs = made(StationKeeping(), **changes), made(StationKeeping(), Torch(3), **changes)
    for _ in range(3):
        rows = [learner.update() for learner in (numpy, torchs)]
        for name, value in rows[0].items():
            assert rows[1][name] == pytest.approx(value, rel=1e-3, abs=1e-4)
    for ours, theirs in zip(numpy._numbers().values(), torchs._numbers().values(), strict=True):
        np.testing.assert_allclose(theirs.numpy(), ours, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("changes", VARIANTS)
def test_nothing_goes_through_the_host_between_two_rows(monkeypatch, changes):
    """On the CPU as on a GPU, torch reads nothing back; the environment's rare check for frozen worlds is excluded."""
    learner = made(StationKeeping(), Torch(3), **changes)
    held = HeldEvaluation(finssim.make(StationKeeping(time_limit=1.0), worlds=4, seed=1))
    touched = []

    def guard(owner, name):
        original = getattr(owner, name)

        def call(*arguments, **named):
            touched.append(name)
            return original(*arguments, **named)

        monkeypatch.setattr(owner, name, call)

    advance = learner.environment.advance

    def quiet():
        before = len(touched)
        advance()
        del touched[before:]

    monkeypatch.setattr(learner.environment, "advance", quiet)
    for name in ("numpy", "cpu", "item", "tolist", "__bool__", "__float__"):
        guard(torch.Tensor, name)
    guard(wp.array, "numpy")
    with learner.arrays.plain():
        learner._roll_out()
        learner._advantages()
        assert touched == []
        learner._learn(1e-3)
    assert len(touched) <= 6, "losses and noise, once for the row"
    network = learner.network()
    assert isinstance(network, Network)
    del touched[:]
    steps, own = 0, held.environment.advance

    def counted():
        nonlocal steps
        steps, before = steps + 1, len(touched)
        own()
        del touched[before:]

    monkeypatch.setattr(held.environment, "advance", counted)
    held(torch_module(network))
    looks = touched.count("__bool__")
    assert steps == looks == 10, "on a processor alone: whether all episodes have ended"
    assert len(touched) - looks <= 8, "the measures, once at the end"


class Tape(TorchDispatchMode):
    """CPU stand-in for a CUDA graph: the operations of a function, repeated with the same memory and scalars.

    Like a graph, it refuses to read a number back.
    """

    def __init__(self, function, arguments):
        super().__init__()
        self.operations = []
        with self:
            function(*arguments)

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        assert func is not torch.ops.aten._local_scalar_dense.default, "a number is read back"
        result = func(*args, **(kwargs or {}))
        self.operations.append((func, args, kwargs or {}, result))
        return result

    def replay(self):
        for func, args, kwargs, result in self.operations:
            again = func(*args, **kwargs)
            if isinstance(again, torch.Tensor) and again.data_ptr() != result.data_ptr():
                result.copy_(again)


class Taped(Torch):
    """Emulation of a GPU's recordings by tapes; the first call is recorded while it runs."""

    replays = 0

    def recorded(self, function):
        tapes = {}

        def call(*arguments):
            shapes = tuple(argument.shape for argument in arguments)
            if shapes not in tapes:
                own = [argument.clone() for argument in arguments]
                tapes[shapes] = Tape(function, own), own
                return
            tape, own = tapes[shapes]
            for target, argument in zip(own, arguments, strict=True):
                target.copy_(argument)
            tape.replay()
            self.replays += 1

        return call


@pytest.mark.parametrize("changes", VARIANTS)
def test_recorded_operations_learn_the_same_when_repeated(changes):
    """Each part of an update depends only on persistent memory, so that a CUDA graph can repeat it."""
    learners = [made(StationKeeping(time_limit=1.0), arrays, **changes) for arrays in (Torch(3), Taped(3))]
    for _ in range(4):
        rows = [learner.update() for learner in learners]
        assert rows[0] == rows[1]
    ours, theirs = (learner._numbers() for learner in learners)
    for name in ours:
        assert torch.equal(ours[name], theirs[name]), name
    assert learners[1].arrays.replays > 3 * (2 * 8 + 1)


def torch_module(network):
    """Return a network of arrays as a module: a held evaluation takes either where it runs with torch."""

    class Module(torch.nn.Module):
        memory_size = network.memory_size

        def forward(self, observation, memory=None):
            action, memory = network.step(observation, memory)
            return action if memory is None else (action, memory)

    return Module()


@wp.func
def shown_once(arrays: TaskArrays, w: int) -> float:
    """Return the sign, in the first of three steps."""
    return wp.where(arrays.time[w] < 0.05, arrays.goal_position[w][0], 0.0)


@wp.func
def recalled(state: State, arrays: TaskArrays, p: Any, w: int) -> float:
    """Return the reward, which only the third step pays."""
    return wp.where(state.steps[w] >= 3, guessed(arrays, p, w, 0), 0.0)


@wp.func
def third(state: State, w: int) -> bool:
    return state.steps[w] >= 3


@dataclass(frozen=True, kw_only=True)
class Recall(Guess):
    """Guess whose sign must be remembered over two steps."""

    name: str = "recall"
    time_limit: float = 0.3
    observation: tuple[ObservationPart, ...] = (ObservationPart("sign", 1, "1", clip=1.0, term=shown_once),)

    def terms(self) -> Terms:
        return Terms(start=draw, rewards=(RewardTerm("guess", recalled, 1.0),), ends=(End("over", third),))


LEARN = {
    "worlds": 64,
    "rollout": 12,
    "batch": 128,
    "epochs": 4,
    "learning_rate": 1e-2,
    "steps": 50_000,
    "discount": 0.9,
}


@pytest.mark.parametrize(
    ("changes", "remembers"),
    [({}, False), ({"history": 2}, True), ({"memory": 8}, True)],
    ids=["blind", "history", "gru"],
)
def test_what_was_seen_two_steps_ago_is_remembered(tmp_path, changes, remembers):
    """With a history or a GRU the held episodes pay 1, in onnxruntime too; without, at most 1 - c² on average."""
    learner = made(Recall(), ranges=None, **{**LEARN, **changes})
    while learner.steps < learner.settings.steps:
        learner.update()
    network = learner.network()
    held = HeldEvaluation(finssim.make(Recall(), worlds=32, seed=9))(network)
    if not remembers:
        assert held["evaluation_return"] < 1.0 - BEST**2 + 0.05 and network.memory_size == 0
        return
    assert held["evaluation_success"] == 1.0 and held["evaluation_return"] > 0.96
    policy = Policy.load(written(network, tmp_path / "p", Recall(), learner.environment.action_size))
    memory = policy.reset(2)
    for sign in ([1.0, -1.0], [0.0, 0.0], [0.0, 0.0]):
        action, memory = policy.step(memory, np.array(sign)[:, None])
    np.testing.assert_allclose(
        action, BEST * np.array([[1.0], [-1.0]]) * np.ones(action.shape), rtol=0, atol=0.15
    )


def test_observations_of_any_size_are_scaled():
    """The running mean and deviation are those of all past observations."""
    learner = made(StationKeeping(), normalize=True)
    seen = []
    for _ in range(3):
        mean, scale = learner._mean.copy(), learner._scale
        learner.update()
        seen.append(learner._x[:-1].reshape(-1, 16) / scale + mean)
    seen = np.concatenate(seen)
    np.testing.assert_allclose(learner._mean, seen.mean(0), rtol=0, atol=1e-4)
    np.testing.assert_allclose(1.0 / learner._scale, np.sqrt(seen.var(0) + 1e-6), rtol=1e-3)


@pytest.mark.parametrize("asymmetric", [True, False])
def test_the_critic_sees_what_was_drawn_and_the_policy_does_not(asymmetric):
    """Randomised quantities have their own columns, including those of the episode that ended."""
    learner = made(StationKeeping(), asymmetric=asymmetric)
    told = len(learner.environment.privileged_names)
    assert told > 0 and learner.actor.sizes[0] == 16 and learner.critic.sizes[0] == 16 + told * asymmetric
    learner.update()
    if asymmetric:
        np.testing.assert_array_equal(
            learner._c[-1, :, 16:], learner.environment.arrays.privileged.numpy().reshape(8, -1)
        )


@pytest.mark.parametrize("task", [Steady, SteadyTogether])
@pytest.mark.parametrize("changes", [{}, {"memory": 4}, {"history": 1, "normalize": True}])
def test_time_ends_no_value(task, changes):
    """If every step pays 1 and the critic returns 1 / (1 - γ), every return is that value, across ends by time."""
    learner = made(task(), ranges=None, rollout=12, discount=0.9, **changes)
    learner.critic.weights[-2][:], learner.critic.weights[-1][:] = 0.0, 10.0
    learner._roll_out()
    learner._advantages()
    np.testing.assert_allclose(learner._target, 10.0, rtol=1e-5)
    assert learner.environment.simulator.state.episode.numpy().min() >= 3


def test_an_end_by_the_task_ends_the_value():
    learner = made(Guess(), ranges=None)
    learner.critic.weights[-2][:], learner.critic.weights[-1][:] = 0.0, 10.0
    learner._roll_out()
    learner._advantages()
    assert learner._target.max() <= 1.0 + 1e-5


def test_advantages_are_the_discounted_sum_of_differences_up_to_the_end():
    """A_t = Σ (γ λ)^k δ_(t+k), summed forwards in each episode; the next episode does not contribute."""
    learner = made(Guess(), ranges=None, discount=0.9, gae_lambda=0.7)
    random = np.random.default_rng(0)
    for x in (learner._r, learner._c):
        x[:] = random.standard_normal(x.shape)
    learner._go[:] = random.random(learner._go.shape) < 0.7
    learner._advantages()
    found = learner._advantage
    rows = learner._c.shape[1]
    value = learner.critic(learner._c.reshape(-1, learner._c.shape[2])).reshape(-1, rows).copy()
    for t, w in np.ndindex(found.shape):
        expected, weight = 0.0, 1.0
        for k in range(t, len(found)):
            after = 0.9 * value[k + 1, w] if learner._go[k, w] else 0.0
            expected += weight * (learner._r[k, w] + after - value[k, w])
            if not learner._go[k, w]:
                break
            weight *= 0.9 * 0.7
        assert found[t, w] == pytest.approx(expected, abs=1e-5)


def test_the_noise_of_an_action_is_known_exactly():
    """The ratio of the new density to the old one is 1 before the first gradient step."""
    learner = made(StationKeeping(), memory=8)
    before = learner._memory[:, learner._window :].copy()
    learner._roll_out()
    h = learner.gru(learner._x[:-1], before, learner._keep())
    mean = learner.actor(h.reshape(-1, 8)).reshape(learner._u.shape)
    z = (learner._u - mean) / np.exp(learner.noise.values)
    np.testing.assert_allclose(-0.5 * (z * z).sum(2), learner._density, rtol=0, atol=1e-3)


@pytest.mark.parametrize(("clip", "entropy_weight"), [(0.2, 0.0), (0.1, 0.03)])
def test_the_policy_follows_the_gradient_of_the_clipped_objective(clip, entropy_weight):
    """L = -E[min(r A, clip(r, 1 - ε, 1 + ε) A)] - w H, A standardised (Schulman et al. 2017, eq. 7 and 9), by autograd.

    In units of the mean and of log σ; with ratios from 0.2 to 5 about two thirds of the batch are or would be clipped.
    """
    learner = made(StationKeeping(), clip=clip, entropy_weight=entropy_weight)
    rng, m = np.random.default_rng(5), learner.noise.values.size
    mean, u = rng.normal(size=(2, 64, m)).astype(np.float32)
    advantage = rng.normal(2.0, 3.0, 64).astype(np.float32)
    learner.noise.values[:] = rng.normal(0.0, 0.3, m)
    log_std = torch.tensor(learner.noise.values, dtype=torch.float64, requires_grad=True)
    center = torch.tensor(mean, dtype=torch.float64, requires_grad=True)
    policy = torch.distributions.Normal(center, log_std.exp())
    log_pi = policy.log_prob(torch.tensor(u, dtype=torch.float64)).sum(1)
    constant = -0.5 * m * np.log(2.0 * np.pi)
    old = log_pi.detach().numpy() - constant - rng.uniform(np.log(0.2), np.log(5.0), 64)
    ratio = (log_pi - constant - torch.tensor(old)).exp()
    A = torch.tensor(advantage, dtype=torch.float64)
    A = (A - A.mean()) / A.std(unbiased=False)
    surrogate = -torch.min(ratio * A, ratio.clamp(1.0 - clip, 1.0 + clip) * A).mean()
    (surrogate - entropy_weight * policy.entropy().sum(1).mean()).backward()

    slopes = []
    learner._step_policy = lambda slope, rate: slopes.append(slope.copy())
    loss, divergence, clipped = learner._improve_policy(mean, u, advantage, old.astype(np.float32), 1e-3)
    np.testing.assert_allclose(slopes[0], center.grad.numpy(), rtol=1e-3, atol=1e-6)  # float32, ratios of 5
    np.testing.assert_allclose(learner.noise.gradient, log_std.grad.numpy(), rtol=1e-3, atol=1e-5)
    ratio = ratio.detach()
    outside = ((ratio - 1.0) * A.sign() > clip).double().mean()
    assert loss == pytest.approx(surrogate.item(), rel=1e-4)
    assert divergence == pytest.approx((ratio - 1.0 - ratio.log()).mean().item(), rel=1e-3)
    assert clipped == pytest.approx(outside.item()) and 0.2 < clipped < 0.8


def test_the_value_follows_the_gradient_of_the_mean_squared_error():
    """L = E[(V - V_target)²] / 2 as a function of the parameters, by autograd through a copy of the critic."""
    learner = made(StationKeeping())
    rng = np.random.default_rng(6)
    seen = rng.normal(size=(32, learner._c.shape[2])).astype(np.float32)
    target = rng.normal(size=32).astype(np.float32)
    value = learner.critic(seen)[:, 0].copy()
    slopes, backward = [], learner.critic.backward

    def noted(slope):
        slopes.append(slope.copy())
        return backward(slope)

    learner.critic.backward = noted
    loss = learner._improve_value(seen, target, STILL)
    error = torch.tensor(value, requires_grad=True)
    expected = 0.5 * torch.nn.functional.mse_loss(error, torch.tensor(target))
    expected.backward()
    assert loss == pytest.approx(expected.item(), rel=1e-5)
    np.testing.assert_allclose(slopes[0][:, 0], error.grad.numpy(), rtol=1e-5, atol=1e-7)


def test_the_first_gradient_step_sees_the_policy_that_acted():
    """Before the first step all ratios are 1: no divergence and no clipping; later ones differ."""
    learner, numbers = made(StationKeeping(), learning_rate=0.1), []
    improve = learner._improve_policy

    def noted(*arguments):
        numbers.append(improve(*arguments))
        return numbers[-1]

    learner._improve_policy = noted
    learner.update()
    assert numbers[0][1] == pytest.approx(0.0, abs=1e-5) and numbers[0][2] == 0.0
    assert numbers[-1][1] > 1e-4


def test_imitation_is_half_the_mean_squared_distance_of_the_actions():
    """The reported loss is 1/2 E |mean - label|², summed over an action's components."""
    learner = made(StationKeeping())
    rng = np.random.default_rng(7)
    inputs = learner.actor.shapes()[0][0]
    mean = learner.actor(rng.normal(size=(32, inputs)).astype(np.float32)).copy()
    label = rng.normal(size=mean.shape).astype(np.float32)
    expected = 0.5 * np.mean(np.sum((mean - label) ** 2, axis=1))
    assert learner._imitate(mean, label, STILL) == pytest.approx(expected, rel=1e-5)
