"""What is left of a world in which a number stopped being finite."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from finssim.engine.state import HISTORY
from finssim.files import atomic_write

if TYPE_CHECKING:
    from finssim.engine.simulator import Simulator

COLUMNS = "vehicle step t x y z qx qy qz qw u v w p q r".split()


def write_post_mortem(simulator: "Simulator", world: int, directory: Path) -> Path:
    """Write the last control steps of one world, the last row being the one that broke.

    Args:
        simulator: The simulator that holds the world.
        world: Its index.
        directory: Where the file goes; made if missing.

    Returns:
        Path of a CSV file with one row per vehicle and step, columns `COLUMNS` (SI, world and body frames).
    """
    last = int(simulator.state.steps.numpy()[world])  # steps counted, the broken one included
    episode = int(simulator.state.episode.numpy()[world])
    history = simulator.state.history.numpy()[:, world]
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / f"frozen-world{world}-episode{episode}.csv"
    again = 2
    while path.exists():  # an earlier run's
        path = directory / f"frozen-world{world}-episode{episode}-{again}.csv"
        again += 1
    with atomic_write(path) as temporary, open(temporary, "w") as file:
        file.write(",".join(COLUMNS) + "\n")
        for v in range(history.shape[1]):
            for step in range(max(0, last - HISTORY), last):
                row = np.concatenate(
                    [[v, step, (step + 1) * simulator.control_step], history[step % HISTORY, v]]
                )
                file.write(",".join(f"{x:.9g}" for x in row) + "\n")
    return path
