"""An agent in a batch of worlds, decision after decision."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path

import numpy as np

from finssim.control.tracking import Goal
from finssim.engine import Recorder
from finssim.tasks.agents import Agent, WorldReadings
from finssim.tasks.environment import Environment
from finssim.tasks.given import Step

__all__ = ["rollout"]


def rollout(
    agent: Agent,
    environment: Environment,
    steps: int,
    goal: Callable[[float], Goal],
    *,
    record: Path | None = None,
) -> Iterator[tuple[int, Step | None]]:
    """Let an agent act; whoever iterates looks at the worlds before each decision and after the last.

    Args:
        agent: Who acts; several agents of a world share it.
        environment: As it stands.
        steps: How many decisions, unless the iteration is ended before.
        goal: Where to go at a time since the start [s].
        record: New folder for every state, command and thrust; none if None.

    Yields:
        How many decisions were made, and what the environment said to the last one; None before the first.
    """
    worlds, agents = environment.worlds, environment.agents
    shape = (worlds, -1) if agents == 1 else (worlds, agents, -1)
    readings, memory = WorldReadings(environment.arrays, agents), agent.reset(worlds * agents)
    step: Step | None = None
    with nullcontext() if record is None else Recorder(environment.simulator, record) as recorder:
        for k in range(steps + 1):
            yield k, step
            if recorder is not None:
                recorder.record()
            if k < steps:
                action, memory = agent.act(memory, readings, goal(k * agent.period))
                step = environment.step(np.asarray(action, dtype=np.float32).reshape(shape))
