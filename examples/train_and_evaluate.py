"""Train for some ten seconds, then try the policy in water and on motors it has not seen, beside a PID.

A full training takes twice as long and holds closer: `python train_and_evaluate.py 1300000`.
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from finssim.evaluation.evaluate import evaluate_controller
from finssim.evaluation.plants import load_plant
from finssim.learning.train import train

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 600_000

with TemporaryDirectory() as folder:
    policy = train("t1", out=Path(folder) / "hold", steps=steps, seed=1)
    for plant in ("nominal", "current", "waves"):
        for controller in (policy, "pid"):
            result = evaluate_controller(controller, load_plant(plant), trials=8).result
            name, error = result["controller"]["name"], 100.0 * result["e_p_m"]
            print(
                f"{plant:8} {name:5} held {result['success']}/{result['trials']}, {error:.1f} cm off in the end"
            )
