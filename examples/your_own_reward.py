"""Change the settings of a task: gentler starts, and a reward with a higher weight on quiet motors."""

from dataclasses import replace

import numpy as np

from finssim.tasks import Environment, StationKeeping, station_keeping

quiet = replace(StationKeeping(), tilt=0.0, speed=0.0, rate=0.0, reward=station_keeping.Reward(change=0.5))

rng = np.random.default_rng(seed=2)
for name, task in (("default", StationKeeping()), ("quiet", quiet)):
    environment = Environment(task, worlds=64, seed=3)
    total = np.zeros(64)
    for _ in range(50):
        total += environment.step(rng.uniform(-1.0, 1.0, (64, 6))).reward
    print(f"{name:8} return of random actions over 5 s: {total.mean():.1f}")
