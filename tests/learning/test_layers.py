"""Hand-written gradients equal torch's, with NumPy and torch; a policy as plain arrays equals its onnxruntime
output."""

import numpy as np
import pytest
import torch
from torch import nn

from finssim.learning.export import write_graph
from finssim.learning.layers import Adam, Arrays, FreeRow, Gru, NetworkParameters, TanhLayers
from finssim.learning.network import (
    INTEGRAL_LIMIT,
    INTEGRAL_RATE,
    Activation,
    Cell,
    Linear,
    Network,
    first_memory,
    with_integrals,
)
from finssim.learning.torch_networks import plain_network

LIBRARIES = pytest.mark.parametrize("device", [None, "cpu"], ids=["numpy", "torch"])


@LIBRARIES
def test_a_stacks_gradient_is_torchs(device):
    """Gradients of weights, biases and inputs agree in two calls of different size, without leftovers of the first."""
    arrays, rng = Arrays(1, device), np.random.default_rng(2)
    stack = TanhLayers(arrays, [5, 7, 6, 3])
    NetworkParameters(arrays, stack)
    stack.initialize(1.0)
    linear = [nn.Linear(a, b) for a, b in ((5, 7), (7, 6), (6, 3))]
    with torch.no_grad():
        for i, layer in enumerate(linear):
            layer.weight.copy_(torch.from_numpy(arrays.numpy(stack.weights[2 * i]).T))
            stack.weights[2 * i + 1][:] = arrays.array(rng.normal(size=layer.out_features))
            layer.bias.copy_(torch.from_numpy(arrays.numpy(stack.weights[2 * i + 1])))
    module = nn.Sequential(linear[0], nn.Tanh(), linear[1], nn.Tanh(), linear[2])
    for rows in (11, 4, 11):
        x, dy = (rng.normal(size=(rows, k)).astype(np.float32) for k in (5, 3))
        inputs = torch.from_numpy(x).requires_grad_()
        module.zero_grad()
        expected = module(inputs)
        expected.backward(torch.from_numpy(dy))
        y = stack(arrays.array(x))
        np.testing.assert_allclose(arrays.numpy(y), expected.detach().numpy(), rtol=0, atol=2e-6)
        dx = stack.backward(arrays.array(dy), inputs=True)
        np.testing.assert_allclose(arrays.numpy(dx), inputs.grad.numpy(), rtol=0, atol=5e-6)
        for i, layer in enumerate(linear):
            for found, parameter in zip(stack._gradients[2 * i : 2 * i + 2], layer.parameters(), strict=True):
                np.testing.assert_allclose(
                    arrays.numpy(found).T, parameter.grad.numpy(), rtol=1e-5, atol=1e-5
                )


@LIBRARIES
def test_a_grus_gradient_is_torchs_through_time(device):
    """Gradients through time agree, with episodes that start within the time segment in some rows."""
    arrays, rng = Arrays(1, device), np.random.default_rng(3)
    n, k, T, rows = 4, 5, 6, 3
    gru = Gru(arrays, n, k)
    NetworkParameters(arrays, gru)
    gru.initialize()
    for bias in (gru.weights[1], gru.weights[3]):
        bias[:] = arrays.array(rng.normal(size=3 * k))
    module = nn.GRU(n, k)
    with torch.no_grad():
        for name, ours in zip(("weight_ih", "bias_ih", "weight_hh", "bias_hh"), gru.weights, strict=True):
            getattr(module, f"{name}_l0").copy_(torch.from_numpy(arrays.numpy(ours).T))
    x, dy = rng.normal(size=(T, rows, n)).astype(np.float32), rng.normal(size=(T, rows, k)).astype(np.float32)
    h0 = rng.normal(size=(rows, k)).astype(np.float32)
    keep = np.ones((T, rows), np.float32)
    keep[2, 0] = keep[4, 2] = keep[0, 1] = 0.0
    h, outputs = torch.from_numpy(h0), []
    for t in range(T):
        h = module(torch.from_numpy(x[t : t + 1]), (h * torch.from_numpy(keep[t])[:, None])[None])[1][0]
        outputs.append(h)
    expected = torch.stack(outputs)
    expected.backward(torch.from_numpy(dy))
    y = gru(arrays.array(x), arrays.array(h0), arrays.array(keep))
    np.testing.assert_allclose(arrays.numpy(y), expected.detach().numpy(), rtol=0, atol=2e-6)
    gru.backward(arrays.array(dy))
    for name, found in zip(("weight_ih", "bias_ih", "weight_hh", "bias_hh"), gru._gradients, strict=True):
        wanted = getattr(module, f"{name}_l0").grad.numpy().T
        np.testing.assert_allclose(arrays.numpy(found), wanted, rtol=1e-5, atol=1e-5)


@LIBRARIES
def test_adam_is_torchs(device):
    """Steps equal those of torch, for gradients longer and shorter than the limit."""
    arrays, rng = Arrays(1, device), np.random.default_rng(4)
    row = FreeRow(9)
    parameters = NetworkParameters(arrays, row)
    row.values[:] = arrays.array(rng.normal(size=9))
    theirs = torch.from_numpy(arrays.numpy(row.values)).clone().requires_grad_()
    ours, torchs = Adam(parameters, arrays, 0.5), torch.optim.Adam([theirs], lr=0.01, eps=1e-5)
    for size in (0.01, 3.0, 0.1, 1.0, 0.02):
        gradient = (size * rng.normal(size=9)).astype(np.float32)
        row.gradient[:] = arrays.array(gradient)
        ours.step(ours.schedule(0.01, 1)[0])
        theirs.grad = torch.from_numpy(gradient)
        nn.utils.clip_grad_norm_([theirs], 0.5)
        torchs.step()
    np.testing.assert_allclose(arrays.numpy(row.values), theirs.detach().numpy(), rtol=0, atol=1e-6)


def network(rng, history, last_action, cell, scaled, errors=()):
    """Return a network of 4 observations and 3 actions, with random weights."""

    def linear(inputs, outputs):
        return Linear(*(rng.normal(size=s).astype(np.float32) for s in ((inputs, outputs), (outputs,))))

    inputs = 4 + 4 * history + (3 if last_action else 0)
    return Network(
        (linear(5 if cell else inputs, 6), Activation("Tanh"), linear(6, 3)),
        mean=rng.normal(size=4).astype(np.float32) if scaled else None,
        scale=rng.uniform(0.5, 2.0, 4).astype(np.float32) if scaled else None,
        history=history,
        last_action=3 if last_action else 0,
        observation_size=4,
        cell=Cell(linear(inputs, 15), linear(5, 15)) if cell else None,
        errors=errors,
    )


@pytest.mark.parametrize("scaled", [False, True])
@pytest.mark.parametrize("cell", [False, True])
@pytest.mark.parametrize(
    ("history", "last_action", "errors"),
    [
        (0, False, ()),
        (1, False, ()),
        (3, False, ()),
        (0, True, ()),
        (2, True, ()),
        (0, False, (2,)),
        (1, True, (3, 0)),
    ],
)
def test_onnxruntime_computes_what_the_arrays_do(history, last_action, errors, cell, scaled):
    """Outputs agree step by step, each with its own memory of the previous step; so does torch on the same arrays."""
    import onnxruntime

    rng = np.random.default_rng(5)
    ours = network(rng, history, last_action, cell, scaled, errors)
    session = onnxruntime.InferenceSession(write_graph(ours, 4, 3), providers=["CPUExecutionProvider"])
    memories = [first_memory(ours, 2), first_memory(ours, 2)]
    for _ in range(5):
        x = rng.normal(size=(2, 4), scale=0.05 if errors else 1.0).astype(np.float32)
        given = {"observation": x} | ({} if memories[1] is None else {"memory": memories[1]})
        action, memories[0] = ours.step(x, memories[0])
        answer = session.run(None, given)
        np.testing.assert_allclose(answer[0], np.clip(action, -1.0, 1.0), rtol=0, atol=5e-6)
        memories[1] = answer[1] if len(answer) > 1 else None
        if memories[0] is not None:
            np.testing.assert_allclose(memories[1], memories[0], rtol=0, atol=5e-6)


def test_integrals_grow_near_the_goal_up_to_a_limit():
    """Integrals grow by rate · e · exp(-(e / reach)²) a step and are added to the error; a distant goal adds
    nothing."""
    observation = np.array([[0.02, 5.0, -0.04], [1.0, 5.0, 0.0]])
    seen, z = with_integrals(np, observation, np.zeros((2, 2)), (0, 2))
    expected = INTEGRAL_RATE * np.array([[0.02 * np.exp(-0.25), -0.04 * np.exp(-1.0)], [0.0, 0.0]])
    np.testing.assert_allclose(z, expected, rtol=1e-12, atol=1e-30)
    np.testing.assert_allclose(seen[:, [0, 2]] - observation[:, [0, 2]], z, rtol=0, atol=1e-15)
    assert seen[:, 1].tolist() == [5.0, 5.0]
    for _ in range(20_000):
        _, z = with_integrals(np, observation, z, (0, 2))
    np.testing.assert_array_equal(z[0], [INTEGRAL_LIMIT, -INTEGRAL_LIMIT])


def test_a_history_is_of_the_last_observations_newest_first():
    """The history is scaled and padded with zeros at the start of an episode; the last action is the limited one."""
    weight = np.zeros((4, 1), np.float32)
    weight[0] = 10.0
    ours = Network(
        (Linear(weight, None),),
        mean=np.ones(1, np.float32),
        scale=np.full(1, 2.0, np.float32),
        history=2,
        last_action=1,
        observation_size=1,
    )
    memory = first_memory(ours, 1)
    seen = []
    for x in (2.0, 0.9, 1.5):
        _, memory = ours.step(np.array([[x]], np.float32), memory)
        seen.append(memory[0].tolist())
    np.testing.assert_allclose(
        seen, [[2.0, 0.0, 1.0], [-0.2, 2.0, -1.0], [1.0, -0.2, 1.0]], rtol=0, atol=1e-6
    )


def test_torchs_layers_are_the_same_network():
    """Torch's layers agree for the activations that both torch and ONNX have."""
    torch.manual_seed(6)
    module = nn.Sequential(
        nn.Linear(5, 6), nn.ELU(0.7), nn.Linear(6, 6), nn.ReLU(), nn.Linear(6, 2, bias=False)
    )
    x = torch.randn(4, 5)
    ours, _ = plain_network(module).as_type(np.float32).step(x.numpy(), None)
    np.testing.assert_allclose(ours, module(x).detach().numpy(), rtol=0, atol=2e-6)


def test_equal_seeds_are_equal_numbers():
    """Noise, orders and initial weights of equal seeds are equal; a saved state continues where it was saved."""
    draws = []
    for seed in (1, 1, 2):
        arrays = Arrays(seed)
        draws.append([arrays.noise(arrays.empty(3)).copy(), arrays.order(5), arrays.orthogonal(3, 2, 1.0)])
    assert all(np.array_equal(a, b) for a, b in zip(draws[0], draws[1], strict=True))
    assert not np.array_equal(draws[0][0], draws[2][0])
    for device in (None, "cpu"):
        arrays = Arrays(3, device)
        state = arrays.state()
        first = arrays.numpy(arrays.noise(arrays.empty(4))), arrays.numpy(arrays.order(9))
        arrays.load(state)
        again = arrays.numpy(arrays.noise(arrays.empty(4))), arrays.numpy(arrays.order(9))
        assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))


def test_first_weights_are_orthogonal():
    """Initial weights are orthogonal and scaled by the gain, whichever side is longer."""
    for rows, columns in ((4, 7), (7, 4)):
        w = Arrays(1).orthogonal(rows, columns, 2.0)
        square = w @ w.T if rows < columns else w.T @ w
        np.testing.assert_allclose(square, 4.0 * np.eye(4), rtol=0, atol=1e-5)
