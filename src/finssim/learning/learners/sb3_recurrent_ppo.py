"""Recurrent PPO of SB3-Contrib on the batched environment: policy and value each remember with an LSTM of their own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sb3_contrib import RecurrentPPO
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from torch import nn

from finssim.learning.learners.base import OnPolicySettings
from finssim.learning.learners.sb3 import Sb3Ppo
from finssim.learning.recurrent import RecurrentNetwork


@dataclass(frozen=True, kw_only=True)
class RecurrentSettings(OnPolicySettings):
    """As PPO's."""

    lstm: int = 64
    """Numbers that the LSTM says and remembers, in front of the hidden layers, of the policy and of the value each."""
    hidden: tuple[int, ...] = (64,)
    """Units of the hidden layers behind the LSTM, ELU."""


class Sb3RecurrentPpo(Sb3Ppo):
    """PPO that remembers; several agents of a world are rows of their own, share the network, and remember each."""

    Settings = RecurrentSettings
    settings: RecurrentSettings
    algorithm = RecurrentPPO
    policy = "MlpLstmPolicy"

    def policy_arguments(self) -> dict[str, Any]:
        """As PPO's, and the LSTM."""
        return {**super().policy_arguments(), "lstm_hidden_size": self.settings.lstm}

    def network(self) -> nn.Module:
        """Observation and memory to mean action and the memory after."""
        policy: Any = self.model.policy
        return RecurrentNetwork(policy.lstm_actor, super().network())

    def learned(self) -> dict[str, Any]:
        """And what policy and value remember of the running episodes."""
        return {**super().learned(), "remembered": [list(part) for part in self.model._last_lstm_states]}

    def load_learned(self, state: dict[str, Any]) -> None:
        """Take what `learned` gave."""
        super().load_learned(state)
        device = self.model.device
        parts = [tuple(tensor.to(device) for tensor in part) for part in state["remembered"]]
        self.model._last_lstm_states = RNNStates(*parts)
