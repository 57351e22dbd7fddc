"""Networks that remember: what one hands on from an action to the next, and how any network is asked."""

from __future__ import annotations

import torch
from torch import nn

__all__ = ["RecurrentNetwork", "asked", "first_memory"]


class RecurrentNetwork(nn.Module):
    """An LSTM of one layer, and layers on what it says: observation and memory to mean action and the memory after."""

    def __init__(self, lstm: nn.LSTM, layers: nn.Sequential) -> None:
        """Take the LSTM, (n) to (k), and the layers, (k) to (m)."""
        super().__init__()
        self.lstm, self.layers = lstm, layers

    @property
    def memory_size(self) -> int:
        """Numbers of the memory: what the LSTM said last, and its cells."""
        return 2 * self.lstm.hidden_size

    def forward(self, observation: torch.Tensor, memory: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Action (N, m) and memory (N, 2 k) for observations (N, n) and memory (N, 2 k); 0 at an episode's start."""
        said, cells = (part.unsqueeze(0).contiguous() for part in memory.chunk(2, dim=1))
        answer, (said, cells) = self.lstm(observation.unsqueeze(0), (said, cells))
        return self.layers(answer[0]), torch.cat([said[0], cells[0]], dim=1)


def first_memory(network: nn.Module, rows: int, device: str = "cpu") -> torch.Tensor | None:
    """What a network remembers at the start of so many episodes, (rows, k); None if it never does."""
    size = getattr(network, "memory_size", 0)
    return torch.zeros(rows, size, device=device) if size else None


def asked(
    network: nn.Module, observation: torch.Tensor, memory: torch.Tensor | None
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """Action (N, m) and the memory after, of any network."""
    if memory is None:
        return network(observation), None
    action, memory = network(observation, memory)
    return action, memory
