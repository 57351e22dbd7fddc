"""An expert's memory is saved with a state on disk and restored unchanged."""

import numpy as np
import pytest

from finssim.agents.catalogue import baseline, baselines_of
from finssim.agents.memory import memory_from, memory_leaves
from finssim.learning.resume import read_state, write_state
from finssim.tasks import make, numeric_tasks


@pytest.mark.slow
@pytest.mark.parametrize("task", [task for task in numeric_tasks() if baselines_of(task)])
def test_every_baselines_memory_survives(task, tmp_path):
    """After one action of three rows, the memory from disk gives the same second action."""
    who = baseline(task, next(iter(baselines_of(task))))
    environment = make(task, worlds=3, seed=1)
    seen = environment.arrays.observation.numpy().reshape(3 * environment.agents, -1)
    fresh = who.reset(len(seen))
    _, memory = who.act(fresh, seen)
    write_state({"memory": memory_leaves(memory)}, tmp_path / "state")
    again = memory_from(read_state(tmp_path / "state")["memory"], fresh)
    assert np.array_equal(who.act(again, seen)[0], who.act(memory, seen)[0])
