"""Torch networks: initial ones for learners, one for pictures, and conversion to a plain `Network`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import torch
from torch import nn

from finssim.learning.network import Activation, Linear, Network

ACTIVATIONS = {nn.Tanh: "Tanh", nn.ReLU: "Relu", nn.ELU: "Elu", nn.Identity: "Identity"}
"""Activations with an equivalent ONNX operator."""


class SeeingNetwork(nn.Module):
    """A convolutional encoder for each picture, and layers from their outputs and the numbers to the mean action.

    The numbers are scaled first: minus `mean`, times `scale`, 0 and 1 until a learner sets them.
    """

    mean: torch.Tensor
    scale: torch.Tensor

    def __init__(
        self,
        inputs: int,
        shapes: Mapping[str, Sequence[int]],
        outputs: int,
        *,
        channels: Sequence[int] = (16, 32, 32),
        features: int = 96,
        hidden: Sequence[int] = (128, 64),
    ) -> None:
        """Draw the initial weights.

        Args:
            inputs: Size of the observation's numbers.
            shapes: Shapes of the pictures by name: height, width, channels.
            outputs: Size of the action.
            channels: Channels of the convolutions, 3x3 with stride 2 and ELU.
            features: Size of an encoder's output.
            hidden: Units of the layers behind the encoders.
        """
        super().__init__()
        self.shapes = {name: tuple(shape) for name, shape in shapes.items()}
        self.register_buffer("mean", torch.zeros(inputs))
        self.register_buffer("scale", torch.ones(inputs))
        self.encoders = nn.ModuleDict()
        for name, (rows, columns, depth) in self.shapes.items():
            layers: list[nn.Module] = [
                nn.InstanceNorm2d(depth)
            ]  # removes the overall effect of the water on a picture
            for a, b in zip([depth, *channels], channels, strict=False):
                layers += [nn.Conv2d(a, b, 3, stride=2, padding=1), nn.ELU()]
                rows, columns = (rows + 1) // 2, (columns + 1) // 2
            layers += [nn.Flatten(), nn.Linear(channels[-1] * rows * columns, features), nn.ELU()]
            self.encoders[name] = nn.Sequential(*layers).to(memory_format=torch.channels_last)
        self.layers = stack(inputs + len(self.shapes) * features, hidden, outputs, 0.01)

    def encode(self, pictures: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Return the features of pictures, 0 to 255, (N, height, width, channels), concatenated in the order of
        `shapes`."""
        kind = self.layers[0].weight.dtype
        scaled = {name: pictures[name].to(kind) / 255.0 for name in self.shapes}
        return torch.cat([self.encoders[name](x.permute(0, 3, 1, 2)) for name, x in scaled.items()], dim=1)

    def act(self, observation: torch.Tensor, features: torch.Tensor) -> torch.Tensor:
        """Return the action (N, m) for rows (N, n) and the features of their pictures."""
        answer: torch.Tensor = self.layers(torch.cat([(observation - self.mean) * self.scale, features], 1))
        return answer

    def forward(self, observation: torch.Tensor, **pictures: torch.Tensor) -> torch.Tensor:
        """Return the action (N, m) for rows (N, n) and pictures."""
        return self.act(observation, self.encode(pictures))


def plain_network(network: nn.Module) -> Network | None:
    """Return the network as plain arrays; None unless it consists of linear layers and these activations."""
    layers: list[Linear | Activation] = []
    for layer in _layers(network):
        if isinstance(layer, nn.Linear):
            bias = None if layer.bias is None else layer.bias.detach()
            layers.append(Linear(layer.weight.detach().T, bias))
        elif type(layer) in ACTIVATIONS:
            layers.append(Activation(ACTIVATIONS[type(layer)], float(getattr(layer, "alpha", 1.0))))
        else:
            return None
    return Network(tuple(layers))


def _layers(module: nn.Module) -> Iterable[nn.Module]:
    """Yield the layers of nested `nn.Sequential`s, in order."""
    if isinstance(module, nn.Sequential):
        for child in module:
            yield from _layers(child)
    else:
        yield module


def stack(inputs: int, hidden: Sequence[int], outputs: int, last_gain: float) -> nn.Sequential:
    """Return linear layers with ELU between them: orthogonal weights of gain √2, `last_gain` in the last, and zero
    biases.

    With a small last gain a policy begins at action 0 for any observation.
    """
    layers: list[nn.Module] = []
    sizes = [inputs, *hidden, outputs]
    for i, (a, b) in enumerate(zip(sizes, sizes[1:], strict=False)):
        linear, last = nn.Linear(a, b), i == len(hidden)
        nn.init.orthogonal_(linear.weight, gain=last_gain if last else math.sqrt(2.0))
        nn.init.zeros_(linear.bias)
        layers += [linear] if last else [linear, nn.ELU()]
    return nn.Sequential(*layers)
