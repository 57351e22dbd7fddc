"""Blocks of worlds compute the same as the kernel for one world, and worlds of a block are independent."""

import numpy as np
import pytest
import warp as wp

from finssim.physics.contact import PoolWalls
from finssim.physics.lanes import LANES, LaneError, StructArray, Trace, UniformStruct, lane_function
from finssim.sim import RectangularPool, Simulator, TetherLine
from reference.cases import PAIRS, random_states

CASES = [
    (name, model) for name, model in PAIRS if (model != "mesh" or name == "finsrov") and name != "slocum"
]
"""Vehicles with the models that can be traced, one of them with a mesh; a moving mass cannot be."""
STEPS = 25
FIELDS = ("position", "quaternion", "velocity", "acceleration", "actuator", "thrust")
"""The whole state of a world."""


def simulate(
    monkeypatch, vehicles, *, lanes=True, worlds=19, steps=STEPS, states=None, change=None, **options
):
    """Random commands from random states, in blocks or world by world; the simulator."""
    monkeypatch.setattr(Simulator, "in_lanes", property(lambda self: lanes))
    sim = Simulator(vehicles, worlds=worlds, threads=1, **options)
    rng, n = np.random.default_rng(4), len(sim.vehicles)
    states = states or random_states(rng, worlds * n, depth=(-6.0, -4.0), speed=0.5, turn=0.5)
    sim.place(*(x.reshape(worlds, n, -1) for x in states))
    if change is not None:
        change(sim)
        sim.refresh()
    most = max(len(v.thrusters) for v in sim.vehicles)
    size = np.array(
        [
            [t.force_max for t in v.thrusters.values()] + [0.0] * (most - len(v.thrusters))
            for v in sim.vehicles
        ]
    )
    for _ in range(steps):
        sim.set_thrust(0.7 * size * rng.uniform(-1.0, 1.0, (worlds, n, most)))
        sim.step()
    return sim


def numbers(sim, world=slice(None)):
    """Return the whole state, one row for each world."""
    return np.concatenate([sim.numpy(f)[world].reshape(len(sim.numpy(f)[world]), -1) for f in FIELDS], axis=1)


@pytest.mark.parametrize(("name", "model"), CASES)
def test_blocks_compute_what_single_worlds_do(monkeypatch, name, model):
    """To float32 rounding over 25 control steps: a micrometre, and as much of all other numbers' size.

    Accelerations are sums of forces that nearly cancel over a small inertia, such as that of a torpedo's roll: their
    rounding is several times larger, and differs between processors.
    """
    blocks, single = (
        simulate(monkeypatch, name, lanes=lanes, hydrodynamics=model) for lanes in (True, False)
    )
    for field in FIELDS:
        a, b = (sim.numpy(field) for sim in (blocks, single))
        atol = 1e-4 if field == "acceleration" else 2e-5
        np.testing.assert_allclose(a / (1.0 + np.abs(b)), b / (1.0 + np.abs(b)), rtol=0, atol=atol)
    np.testing.assert_allclose(blocks.numpy("position"), single.numpy("position"), rtol=0, atol=3e-6)
    np.testing.assert_allclose(blocks.state.history.numpy(), single.state.history.numpy(), rtol=0, atol=1e-4)
    assert np.array_equal(blocks.state.commands.numpy(), single.state.commands.numpy())


def test_several_vehicles_a_pool_and_tethers_go_in_blocks_too(monkeypatch):
    """Two vehicles in a world, walls that are not touched, and lines."""
    options = {"pool": RectangularPool(length=40.0, width=40.0, depth=12.0), "tether": TetherLine()}
    blocks, single = (
        simulate(monkeypatch, ["finsrov", "finsrov"], lanes=lanes, **options) for lanes in (True, False)
    )
    np.testing.assert_allclose(blocks.numpy("position"), single.numpy("position"), rtol=0, atol=3e-6)


def test_every_world_has_its_own_parameters(monkeypatch):
    """Parameters that differ are read by world."""

    def heavier(sim):
        sim.plant.mass.assign(sim.plant.mass.numpy() * np.linspace(0.9, 1.1, sim.worlds)[:, None])

    blocks, single = (
        simulate(monkeypatch, "finsrov", lanes=lanes, change=heavier) for lanes in (True, False)
    )
    np.testing.assert_allclose(blocks.numpy("position"), single.numpy("position"), rtol=0, atol=3e-6)
    alike = simulate(monkeypatch, "finsrov")
    assert np.abs(alike.numpy("position") - blocks.numpy("position")).max() > 0.01


ODD = {
    "in the air": ((0.0, 0.0, 0.5), (0.0,) * 6),
    "surfacing": ((0.0, 0.0, 0.0), (0.0,) * 6),
    "on the floor": ((0.0, 0.0, -9.95), (0.0, 0.0, -0.5, 0.0, 0.0, 0.0)),
    "spinning": ((0.0, 0.0, -5.0), (0.0, 0.0, 0.0, 0.0, 0.0, 300.0)),
}


@pytest.mark.parametrize("where", ODD)
def test_a_world_that_goes_another_way_than_its_block_disturbs_nobody(monkeypatch, where):
    """Its neighbours are bit-identical to those beside a quiet world; it equals the run without blocks, to
    rounding."""
    position, twist = ODD[where]
    quiet = random_states(np.random.default_rng(5), LANES, depth=(-6.0, -4.0), speed=0.3, turn=0.3)
    odd = [x.copy() for x in quiet]
    odd[0][3], odd[1][3], odd[2][3] = position, (0.0, 0.0, 0.0, 1.0), twist
    pool = RectangularPool(length=40.0, width=40.0, depth=10.0)
    first, beside, single = (
        simulate(monkeypatch, "finsrov", worlds=LANES, states=states, pool=pool, lanes=lanes, steps=2)
        for states, lanes in ((quiet, True), (odd, True), (odd, False))
    )
    others = np.arange(LANES) != 3
    assert np.array_equal(numbers(first)[others], numbers(beside)[others])
    np.testing.assert_allclose(numbers(beside)[3], numbers(single)[3], rtol=1e-6, atol=1e-6)
    assert not np.array_equal(numbers(first)[3], numbers(beside)[3])


def test_blocks_touch_walls_and_come_to_the_surface_as_single_worlds_do(monkeypatch):
    """Random commands in a pool where many do one or the other: no world goes alone, and all agree.

    Accelerations are left out: a wall makes 0.001 rad/s² of the last digit of a position.
    """
    rng, worlds = np.random.default_rng(6), 256
    position, q, nu = random_states(rng, worlds, depth=(-0.85, -0.05), speed=0.5, turn=0.5)
    position[:, :2] = rng.uniform((-1.8, -0.8), (1.8, 0.8), (worlds, 2))
    blocks, single = (
        simulate(
            monkeypatch, "finsrov", lanes=lanes, worlds=worlds, steps=4, states=(position, q, nu),
            pool=RectangularPool(),
        )
        for lanes in (True, False)
    )  # fmt: skip
    for field, atol in {"position": 3e-6, "quaternion": 3e-6, "velocity": 2e-5}.items():
        np.testing.assert_allclose(blocks.numpy(field), single.numpy(field), rtol=0, atol=atol)
    bits, touching = blocks.branch_bits.numpy(), np.abs(single.numpy("pressed")).max(axis=(1, 2)) > 0.0
    assert bits.min() == 0 and len(np.unique(bits)) > 3 and touching.mean() > 0.1


def test_a_world_does_not_depend_on_its_place_in_a_block(monkeypatch):
    """Results are bit-identical for 1, 5 and 19 worlds, and for any cut into slices."""
    runs = [simulate(monkeypatch, "finsrov", worlds=19)]
    states = [
        x.copy() for x in random_states(np.random.default_rng(4), 19, depth=(-6.0, -4.0), speed=0.5, turn=0.5)
    ]
    monkeypatch.setattr(Simulator, "in_lanes", property(lambda self: True))
    sim = Simulator("finsrov", worlds=5, threads=1)
    sim.place(*(x[7:12].reshape(5, 1, -1) for x in states))
    rng = np.random.default_rng(4)
    random_states(rng, 19, depth=(-6.0, -4.0), speed=0.5, turn=0.5)
    size = np.array([t.force_max for t in sim.vehicles[0].thrusters.values()])
    for _ in range(STEPS):
        sim.set_thrust((0.7 * size * rng.uniform(-1.0, 1.0, (19, 1, len(size))))[7:12])
        sim.step()
    assert np.array_equal(numbers(sim), numbers(runs[0])[7:12])


def test_what_cannot_be_followed_is_said():
    with pytest.raises(LaneError, match="field offset of shape is not a number"):

        @wp.struct
        class Shape:
            offset: wp.vec3

        _ = UniformStruct(Trace(), "shape", Shape, {}).offset
    assert UniformStruct(Trace(), "walls", PoolWalls, {}).depth.example == 1
    with pytest.raises(LaneError, match="shape has 3 numbers, expected at least 8"):
        StructArray(Trace(), "shape", Shape, {})


@wp.func
def branching(x: float) -> float:
    if x > 2.0:
        return x * x
    return -x


def test_a_branch_is_the_examples_and_leaves_the_others_out():
    """The condition is noted the way that the example has it."""
    for example, sign, expected in ((3.0, "", 9.0), (1.0, "~", -1.0)):
        trace = Trace()
        y = lane_function(branching)(trace.symbol("F", "x", example))
        assert y.example == expected
        assert [line for line in trace.sections[0] if line.startswith("ok")] == [f"ok &= {sign}n0;"]
