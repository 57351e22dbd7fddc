"""Simulate a thousand worlds together, each with its own damping, in a current, and compare their dives."""

import numpy as np

from finssim.sim import Simulator, Water

WORLDS = 1000
rng = np.random.default_rng(seed=1)

simulator = Simulator("finsrov", worlds=WORLDS, water=Water(current=(0.1, 0.0, 0.0), depth=5.0))
simulator.place(position=(0.0, 0.0, -1.0))

# Parameters are arrays indexed by world and vehicle; to randomise one, write to its array.
damping = simulator.plant.D1.numpy()
damping[:, 0] *= rng.uniform(0.8, 1.2, size=(WORLDS, 1, 1))
simulator.plant.D1.assign(damping)
simulator.refresh()

simulator.set_thrust(
    [-3.0, -3.0, -3.0, -3.0, 0.0, 0.0, 0.0, 0.0]
)  # the four vertical thrusters, downwards [N]
for _ in range(50):
    simulator.step()

depth = -simulator.numpy("position")[:, 0, 2]
low, middle, high = np.quantile(depth, [0.05, 0.5, 0.95])
print(f"depth after 5 s: median {middle:.2f} m, 5 to 95 %: {low:.2f} to {high:.2f} m")
