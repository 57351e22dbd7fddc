"""Train for about ten seconds, then evaluate the policy beside a PID in water that it was not trained in.

A full training takes twice as long and is more precise: `python train_and_evaluate.py 1300000`.
"""

import sys

import finssim as fs

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 600_000

policy = fs.train("t1", steps=steps, seed=1)
for plant in ("nominal", "current", "waves"):
    for name, controller in (("hold", policy), ("pid", "pid")):
        metrics = fs.evaluate(controller, "t1", plant=plant, trials=8).metrics
        error = 100.0 * metrics["e_p_m"]
        print(
            f"{plant:8} {name:5} held {metrics['success']}/{metrics['trials']}, {error:.1f} cm off in the end"
        )
