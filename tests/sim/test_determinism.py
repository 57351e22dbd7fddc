"""The same seed gives the same bits, however the worlds are cut into threads and however many there are."""

import numpy as np
import pytest

from finssim.sim import RectangularPool, Simulator, TetherLine, Water, Wave
from reference.cases import random_attitudes

FIELDS = ("position", "quaternion", "velocity", "acceleration", "thrust", "actuator")
WATER = Water(
    current=(0.1, 0.0, 0.0),
    drift_std=(0.05, 0.05, 0.02),
    drift_time=2.0,
    waves=(Wave(amplitude=0.02, wavelength=3.0), Wave(amplitude=0.01, wavelength=1.0, heading=1.0)),
)
CASES = [
    ("calibrated", "midpoint", {}),
    ("calibrated", "rk4", {}),
    ("mesh", "midpoint", {}),
    ("simplified", "midpoint", {}),
    ("calibrated", "midpoint", {"pool": RectangularPool(), "tether": TetherLine(wet_weight=0.1)}),
]
EVERY_CASE = pytest.mark.parametrize(
    ("model", "integrator", "surroundings"),
    CASES,
    ids=lambda x: x if isinstance(x, str) else "-".join(x) or "open",
)


def final_state(model, integrator, surroundings, *, worlds=1000, threads=1, seed=11, steps=15):
    """Return the state after random starts and commands; fewer worlds get the first of the same ones."""
    simulator = Simulator(
        "finsrov",
        worlds=worlds,
        hydrodynamics=model,
        integrator=integrator,
        substeps=4,
        water=WATER,
        threads=threads,
        seed=seed,
        **surroundings,
    )
    rng = np.random.default_rng(3)
    position = rng.uniform([-1, -0.5, -0.8], [1, 0.5, -0.1], (1000, 3))[:worlds]
    q = random_attitudes(rng, 1000)[:worlds]
    velocity = 0.2 * rng.normal(size=(1000, 6))[:worlds]
    simulator.place(position[:, None], q[:, None], velocity[:, None])
    for command in rng.uniform(-8, 8, (steps, 1000, 8)):
        simulator.set_thrust(command[:worlds, None])
        simulator.step()
    return {name: simulator.numpy(name).copy() for name in FIELDS}


def same(a, b):
    return all(np.array_equal(a[name], b[name][: len(a[name])]) for name in FIELDS)


@pytest.mark.slow
@EVERY_CASE
def test_equal_seeds_give_equal_bits_for_any_threads_and_worlds(model, integrator, surroundings):
    """Two runs, 1, 2 and 3 threads, and the first 64 of 64 or 1000 worlds: every number bitwise equal."""
    first = final_state(model, integrator, surroundings)
    assert np.isfinite(first["position"]).all()
    assert same(first, final_state(model, integrator, surroundings))
    for threads in (2, 3):
        assert same(first, final_state(model, integrator, surroundings, threads=threads))
    for worlds in (64, 1):
        assert same(final_state(model, integrator, surroundings, worlds=worlds), first)


def test_another_seed_is_another_drift():
    """The seed matters: the drifting current, and with it the motion, differs in every world."""
    a, b = (final_state(*CASES[0], worlds=64, seed=seed)["velocity"] for seed in (1, 2))
    assert (a != b).any(axis=(1, 2)).all()


def test_worlds_drift_independently():
    """Equal vehicles in the same pool have different currents."""
    simulator = Simulator(
        "finsrov", worlds=500, water=Water(drift_std=(0.1, 0.1, 0.1), drift_time=0.5), seed=5
    )
    for _ in range(20):
        simulator.step()
    drift = simulator.water.drift.numpy()
    assert len(np.unique(drift[:, 0])) == 500
    neighbours = np.corrcoef(drift[:-1, 0], drift[1:, 0])[0, 1]
    assert abs(neighbours) < 4.0 / np.sqrt(500)
