"""Networks of the learners that are not Stable-Baselines3's, with the same first weights as its."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import nn

from finssim.tasks import Environment

__all__ = ["privileged_rows", "stack"]


def stack(inputs: int, hidden: Sequence[int], outputs: int, last_gain: float) -> nn.Sequential:
    """Linear layers with ELU between them: orthogonal weights of gain √2, `last_gain` in the last, and no bias.

    A small last gain lets a policy begin at action 0 whatever it sees.
    """
    layers: list[nn.Module] = []
    sizes = [inputs, *hidden, outputs]
    for i, (a, b) in enumerate(zip(sizes, sizes[1:], strict=False)):
        linear, last = nn.Linear(a, b), i == len(hidden)
        nn.init.orthogonal_(linear.weight, gain=last_gain if last else math.sqrt(2.0))
        nn.init.zeros_(linear.bias)
        layers += [linear] if last else [linear, nn.ELU()]
    return nn.Sequential(*layers)


def privileged_rows(environment: Environment, name: str = "privileged") -> torch.Tensor | None:
    """What only a critic may see, one row per agent: a view of the environment's own memory; None if there is nothing.

    Args:
        environment: The worlds.
        name: `privileged`, or `final_privileged` of the episode before, where one ended in this step.
    """
    import warp as wp

    array = getattr(environment.arrays, name, None)
    if array is None or not array.size:
        return None
    tensor: torch.Tensor = wp.to_torch(array)
    return tensor.view(environment.worlds * environment.agents, -1)
