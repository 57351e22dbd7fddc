"""A study of your own: the precision of a catalogue controller in currents, over seeds, with an interval."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

import finssim as fs

SEEDS, PLANTS = (1, 2, 3), ("nominal", "current")


def study(out: Path, trials: int = 8) -> dict[str, dict[str, Any]]:
    """Evaluate, store the result of every seed as soon as it is computed, and continue an interrupted call.

    Args:
        out: Directory of one JSON file for each plant and seed.
        trials: Number of trials in each plant.

    Returns:
        Plant -> mean position error and its 95 % interval over the seeds [m].
    """
    out.mkdir(parents=True, exist_ok=True)
    errors: dict[str, list[float]] = {}
    for plant in PLANTS:
        for seed in SEEDS:
            file = out / f"{plant}_{seed}.json"
            if not file.is_file():
                metrics = fs.evaluate("pid", "t1", plant=plant, trials=trials, seed=seed).metrics
                file.write_text(json.dumps({"e_p_m": metrics["e_p_m"]}), encoding="utf-8")
            errors.setdefault(plant, []).append(json.loads(file.read_text(encoding="utf-8"))["e_p_m"])
    rng = np.random.default_rng(1)
    result = {}
    for plant, values in errors.items():
        means = rng.choice(values, (2000, len(values))).mean(axis=1)
        result[plant] = {"mean": float(np.mean(values)), "ci95": np.quantile(means, (0.025, 0.975)).tolist()}
    return result


if __name__ == "__main__":
    for plant, error in study(Path(sys.argv[1] if len(sys.argv) > 1 else "study")).items():
        low, high = error["ci95"]
        print(f"{plant:8} {100.0 * error['mean']:.2f} cm [{100.0 * low:.2f}, {100.0 * high:.2f}]")
