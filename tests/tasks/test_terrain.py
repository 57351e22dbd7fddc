"""The terrain task: the drawn seabed, the beams' ranges, and the baseline."""

import math

import numpy as np
import pytest

from finssim.agents import baseline, restarted
from finssim.core.rotations import quat_from_euler, quat_rotate
from finssim.sim import Water
from finssim.tasks import make
from finssim.tasks.terrain import TerrainFollowing
from finssim.vehicles.device_files import load_device
from reference.tails import tailed

VEHICLE = tailed("cruciform")
AHEAD_BEAM = math.radians(30.0)
BARE = VEHICLE.model_copy(update={"perception": {}})
"""Vehicle whose altimeters are single rays from the body origin."""


def heights(seabed, floor, x, y):
    """Return the height of a seabed of waves (height, number, direction, phase) at points [m]."""
    a, k, direction, phase = np.moveaxis(np.asarray(seabed, float), -1, 0)
    way = np.multiply.outer(x, np.cos(direction)) + np.multiply.outer(y, np.sin(direction))
    return floor + (a * np.sin(k * way + phase)).sum(axis=-1)


def seen(env, position, q):
    """Return the ranges that a level or tilted vehicle at rest measures [m], (2,)."""
    env.simulator.state.position.assign(np.asarray(position, np.float32)[None, None])
    env.simulator.state.quaternion.assign(np.asarray(q, np.float32)[None, None])
    env.simulator.state.velocity.zero_()
    o = env.step(np.zeros((1, 3))).observation[0].astype(float)
    at = env.simulator.state.position.numpy()[0, 0].astype(float)
    turned = env.simulator.state.quaternion.numpy()[0, 0].astype(float)
    return 5.0 * env.task.fit.size * o[:2], at, turned


def echo(beta, height):
    """Return the range by which a tenth of a Ping's echo from a plane has arrived, by quadrature [m]."""
    width = load_device("ping").beam_width
    u, v = np.meshgrid(*[np.linspace(-width, width, 401)] * 2)
    angle = np.hypot(u, v)
    facing = np.cos(angle) * math.cos(beta) + np.sin(angle) * math.sin(beta) * u / np.maximum(angle, 1e-12)
    share = np.exp(-8.0 * math.log(2.0) * (angle / width) ** 2) * facing**3 * (angle <= width)
    order = np.argsort(-facing, axis=None)
    sums = np.cumsum(share.ravel()[order])
    return height / facing.ravel()[order][np.searchsorted(sums, 0.1 * sums[-1])]


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (0.2, -0.15, 1.0), (0.0, -0.4, 2.0)])
@pytest.mark.parametrize(
    ("vehicle", "range_of", "tolerance"),
    [(BARE, lambda beta, height: height / math.cos(beta), 2e-3), (VEHICLE, echo, 5e-3)],
    ids=["rays", "ping"],
)
def test_beams_over_a_flat_seabed(vehicle, range_of, tolerance, pose):
    """Rays give height over the cosine of the angle from the vertical, which a raised bow increases; beams
    give less."""
    env = make("terrain", worlds=1, vehicle=vehicle, seed=1, auto_reset=False)
    env.arrays.seabed.zero_()
    floor = env.task.fit.size * env.task.floor
    ranges, at, q = seen(env, [0, 0, floor + 6.0], quat_from_euler(*pose))
    height = at[2] + quat_rotate(q, env.task.below.position)[2] - floor
    down = [2 * (q[0] * q[2] - q[3] * q[1]), 1 - 2 * (q[0] ** 2 + q[1] ** 2)]  # z of the body's x and z axes
    cosines = [down[1], math.cos(AHEAD_BEAM) * down[1] - math.sin(AHEAD_BEAM) * down[0]]
    assert ranges == pytest.approx([range_of(math.acos(c), height) for c in cosines], rel=tolerance)


def test_beams_end_on_the_seabed_that_is_drawn():
    env = make("terrain", worlds=1, vehicle=BARE, seed=4, auto_reset=False)
    floor = env.task.fit.size * env.task.floor
    seabed = env.arrays.seabed.numpy()[0]
    for yaw in (0.0, 2.0, -1.0):
        ranges, at, _ = seen(env, [20.0, -5.0, floor + 7.0], quat_from_euler(0.0, 0.0, yaw))
        for far, angle in zip(ranges, (0.0, AHEAD_BEAM), strict=True):
            x, y, z = (
                at[0] + far * math.sin(angle) * math.cos(yaw),
                at[1] + far * math.sin(angle) * math.sin(yaw),
                at[2] - far * math.cos(angle),
            )
            assert z == pytest.approx(float(heights(seabed, floor, x, y)), abs=0.1)


def test_drawn_seabeds_keep_their_slopes_and_starts_are_over_them():
    env = make("terrain", worlds=200, vehicle=VEHICLE, seed=2)
    task, seabed = env.task, env.arrays.seabed.numpy()
    steep = seabed[..., 0] * seabed[..., 1]
    assert 0.0 < steep.min() and 0.9 * task.steepness < steep.max() <= task.steepness + 1e-6
    length = 2.0 * math.pi / seabed[..., 1] / task.fit.size
    assert task.wave[0] <= length.min() < length.max() <= task.wave[1] + 1e-3
    x = env.simulator.state.position.numpy()[:, 0]
    floor = task.fit.size * task.floor
    below = np.array([heights(seabed[w], floor, x[w, 0], x[w, 1]) for w in range(200)])
    off = (x[:, 2] - below) / task.fit.size - task.altitude
    assert np.abs(off).max() < 1.6 and len(set(np.round(below, 3))) > 150


@pytest.mark.slow
@pytest.mark.parametrize("current", [0.0, 0.4])
def test_the_baseline_keeps_the_altitude(current):
    n, task = 64, TerrainFollowing()
    env = make(task, worlds=n, vehicle=VEHICLE, seed=1, water=Water(current=(current, 0.0, 0.0), depth=80.0))
    player = baseline(task, "altimeter", VEHICLE)
    memory, observation = player.reset(n), env.reset()
    found = {name: np.full(n, np.nan) for name in ("success", "error", "grounded")}
    for _ in range(round(task.time_limit / task.control_step)):
        action, memory = player.act(memory, observation)
        step = env.step(action)
        ended = step.terminated | step.truncated
        measured = env.task.metrics(env.arrays)
        for name, values in found.items():
            first = ended & np.isnan(values)
            values[first] = measured[name][first]
        memory, observation = restarted(memory, player.reset(n), ended), step.observation
    assert found["success"].min() == 1.0 and found["grounded"].max() == 0.0
    assert found["error"].mean() < 0.35


def test_the_baseline_takes_ranges_as_the_beams_of_training_give_them():
    """Its closed form for the echo of a level seabed agrees with the kernel's, for a pitched and rolled
    vehicle."""
    env = make("terrain", worlds=1, vehicle=VEHICLE, seed=1, auto_reset=False)
    env.arrays.seabed.zero_()
    floor = env.task.fit.size * env.task.floor
    for pose in ((0.05, 0.0, 0.0), (0.3, 0.2, 1.0), (-0.1, -0.5, 2.0)):
        ranges, at, q = seen(env, [0, 0, floor + 6.0], quat_from_euler(*pose))
        beam = env.task.below
        height = at[2] + quat_rotate(q, beam.position)[2] - floor
        beta = np.arccos(-quat_rotate(q, beam.direction)[2])
        assert ranges[0] * math.cos(beam.echo_angle(beta)) == pytest.approx(height, rel=1e-3)
