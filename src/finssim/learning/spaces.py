"""Gymnasium's spaces of an environment's observations and actions."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces

from finssim.tasks import Environment

__all__ = ["action_space", "observation_space"]


def observation_space(environment: Environment) -> spaces.Box:
    """Bounds of one world's observation: each part's clip, or none."""
    parts = environment.task.observation
    high = np.concatenate([np.full(part.size, np.inf if part.clip is None else part.clip) for part in parts])
    return spaces.Box(-high.astype(np.float32), high.astype(np.float32), dtype=np.float32)


def action_space(environment: Environment) -> spaces.Box:
    """One world's action: each component in [-1, 1]."""
    return spaces.Box(-1.0, 1.0, shape=(environment.action_size,), dtype=np.float32)
