"""3-v-1 pursuit: geometry of the net, every capture mode and level, rewards by agent, the formation baseline."""

import math
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from finssim.agents.catalogue import baseline
from finssim.agents.drive import DriveNumbers
from finssim.extensions.teams.pursuit import LEVELS, Prey, TeamPursuit, net_distance
from finssim.tasks import Environment, EnvironmentSetupError
from finssim.tasks.communication import Communication
from finssim.vehicles import load_vehicle


def environment(task, worlds=4, **options):
    return Environment(task, worlds=worlds, auto_reset=False, **options)


def place(env, herder, left, right, prey):
    """Place all four at rest in every world; the first step follows."""
    x = np.broadcast_to(np.float32([herder, left, right, prey]), (env.worlds, 4, 3))
    env.simulator.state.position.assign(np.ascontiguousarray(x))
    env.simulator.state.velocity.zero_()


def still(env):
    return env.step(np.zeros((env.worlds, 3, env.action_size)))


def test_distance_to_the_net_is_the_least_over_its_points():
    """The distance equals the least over a grid of 1 cm on the net, at any slope."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        left, right, x = rng.uniform(-1.0, 1.0, (3, 3))
        along = (right - left) / np.linalg.norm(right - left)
        up = np.array([0.0, 0.0, 1.0]) - along[2] * along
        up /= np.linalg.norm(up)
        s = np.linspace(0.0, np.linalg.norm(right - left), 200)[:, None, None]
        t = np.linspace(-0.5, 0.5, 101)[None, :, None]
        grid = left + s * along + t * up
        expected = np.linalg.norm(grid - x, axis=-1).min()
        found = net_distance(wp.vec3(*x), wp.vec3(*left), wp.vec3(*right), 1.0)
        assert found == pytest.approx(expected, abs=0.01)


NET = ((0.0, 0.0, -3.0), (3.0, 1.0, -3.0), (3.0, -1.0, -3.0))
"""Herder, and netters 2 m apart; the net's middle lies 3 m before the herder."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "x", "steps"),
    [
        ("net", 3.78, 3),  # 0.8 m before the net, held for 0.25 s
        ("net", 3.83, None),
        ("touch", 3.25, 1),  # the hull's mean half length and width is 0.245 m, and 0.02 m
        ("touch", 3.28, None),
        ("proximity", 0.98, 1),  # 1 m before the herder
        ("proximity", 1.03, None),
        ("either", 0.98, 1),
        ("either", 3.78, 3),
        ("either", 1.9, None),
    ],
)
def test_every_capture_mode(mode, x, steps):
    """A prey at rest is just within reach or just beyond it."""
    env = environment(TeamPursuit(capture=mode, prey_speed=0.0))
    place(env, *NET, (x, 0.0, -3.0))
    ended = [still(env).terminated.all() for _ in range(4)]
    assert ended.index(True) + 1 == steps if steps else not any(ended)
    if steps:
        assert (env.arrays.agent_reward.numpy() > 25.0).all() or steps < 4


def test_a_net_stretched_beyond_its_length_does_not_catch():
    env = environment(TeamPursuit(capture="touch", prey_speed=0.0, net_length=1.5))
    place(env, *NET, (3.0, 0.0, -3.0))
    assert not still(env).terminated.any()


def test_the_levels_are_the_published_ones():
    """Prey speeds are 0.25, 0.30, 0.40 of 0.5 m/s; rules and stakes are as published; explicit settings win."""
    top = DriveNumbers.of(load_vehicle("finsrov")).terminal[0]
    expected = [("proximity", 0.50, 25.0), ("net", 0.60, 25.0), ("net", 0.80, 30.0)]
    for level, (capture, part, stake) in enumerate(expected):
        env = environment(TeamPursuit(level=level), worlds=1)
        assert env.task.rules.capture == capture and env.task.rules.stake == stake
        assert env.task.speed == pytest.approx(part * top)
    assert [one.from_step for one in LEVELS[:3]] == [0, 1_500_000, 4_000_000]
    assert (LEVELS[0].proximity, LEVELS[1].net_reach, LEVELS[1].hold) == (1.5, 1.0, 0.10)
    assert (LEVELS[2].net_reach, LEVELS[2].hold) == (0.8, 0.25)
    own = TeamPursuit(level=1, hold=0.7, stake=3.0).rules
    assert (own.capture, own.hold, own.stake, own.net_reach) == ("net", 0.7, 3.0, 1.0)


def test_the_observation():
    """The observation of every agent equals SciPy's: the prey, then both team-mates in order."""
    env = environment(TeamPursuit())
    rng = np.random.default_rng(0)
    for _ in range(20):
        observation = env.step(rng.uniform(-1.0, 1.0, (4, 3, 4))).observation
    state = env.simulator.state
    x, nu = state.position.numpy().astype(float), state.velocity.numpy().astype(float)
    q = state.quaternion.numpy()
    v = np.stack([Rotation.from_quat(q[:, i]).apply(nu[:, i, :3]) for i in range(4)], axis=1)
    for a in range(3):
        body = Rotation.from_quat(q[:, a]).inv()

        def seen(b, a=a, body=body):
            return body.apply(x[:, b] - x[:, a]), body.apply(v[:, b] - v[:, a])

        gap, relative = seen(3)
        parts = [nu[:, a], gap / 6.0, relative, np.linalg.norm(gap, axis=1)[:, None] / 6.0]
        parts.append(np.arctan2(gap[:, 1], gap[:, 0])[:, None] / math.pi)
        for b in sorted({0, 1, 2} - {a}):
            role = [1.0, 0.0] if b == 0 else [0.0, 1.0]
            gap, relative = seen(b)
            parts += [np.tile(role, (4, 1)), gap / 6.0, relative]
        np.testing.assert_allclose(observation[:, a], np.hstack(parts), atol=3e-5)


def test_the_worlds_reward_is_the_mean_of_its_agents():
    env = environment(TeamPursuit(), worlds=16)
    total = np.zeros(16)
    for _ in range(20):
        step = env.step(np.random.default_rng(0).uniform(-1.0, 1.0, (16, 3, 4)))
        assert step.reward.shape == (16, 3)
        np.testing.assert_allclose(env.arrays.reward.numpy(), step.reward.mean(axis=1), atol=1e-6)
        total += step.reward.mean(axis=1)
    np.testing.assert_allclose(env.arrays.episode_return.numpy(), total, atol=1e-4)
    assert (step.reward.std(axis=1) > 0.0).all()


def test_progress_adds_up_to_the_way():
    """The sum of the progress terms is the decrease of the gap."""
    weights = dict.fromkeys(("distance", "step", "drive", "stray", "spread", "bump", "action", "change"), 0.0)
    task = TeamPursuit()
    env = environment(TeamPursuit(reward=type(task.reward)(progress=1.0, **weights)), worlds=8)
    gap = env.task.totals.index("gap")
    before, total = env.arrays.totals.numpy()[:, gap].copy(), 0.0
    for _ in range(30):
        total = total + env.step(np.full((8, 3, 4), 0.5)).reward[:, 0]
    np.testing.assert_allclose(total, before - env.arrays.totals.numpy()[:, gap], atol=1e-4)


def test_a_herder_that_strays_loses_by_its_distance_to_the_prey():
    """The penalty is d / 8 m up to one, and applies to the herder only."""
    reward = TeamPursuit().reward
    near, far = (environment(TeamPursuit(reward=replace(reward, stray=x))) for x in (0.0, 0.8))
    for x, part in (((2.0, 0.0, -3.0), 0.5), ((-5.0, 0.0, -3.0), 1.0)):
        rows = []
        for env in (near, far):
            place(env, x, (3.0, 1.0, -3.0), (3.0, -1.0, -3.0), (6.0, 0.0, -3.0))
            rows.append(still(env).reward[0])
        np.testing.assert_allclose(rows[0] - rows[1], [0.8 * part, 0.0, 0.0], atol=5e-3)


def test_one_agent_out_of_bounds_costs_everybody():
    env = environment(TeamPursuit())
    place(env, (0.0, 0.0, -3.0), (12.5, 1.0, -3.0), (3.0, -1.0, -3.0), (6.0, 0.0, -3.0))
    step = still(env)
    assert step.terminated.all() and (step.reward < -25.0).all()
    assert (env.task.metrics(env.arrays)["left"] == 1.0).all()


def rate(task, who, worlds=32, vehicle="finsrov"):
    """Return the share of worlds in which the prey is captured."""
    env, team = environment(task, worlds=worlds, vehicle=vehicle), baseline("team-pursuit", "formation")
    observation, caught = env.arrays.observation.numpy().reshape(worlds, 3, 30), np.zeros(worlds, dtype=bool)
    for _ in range(600):
        a = team.act(None, observation.reshape(-1, 30))[0].reshape(worlds, 3, 4)
        step = env.step(a if who == "formation" else np.zeros_like(a))
        caught |= step.terminated & (env.task.metrics(env.arrays)["success"] > 0.0)
        observation = step.observation
    return caught.mean()


@pytest.mark.slow
@pytest.mark.parametrize("level", range(len(LEVELS)))
def test_the_formation_captures_and_a_still_team_does_not(level):
    assert rate(TeamPursuit(level=level), "formation") > 0.4
    assert rate(TeamPursuit(level=level), "still") < 0.1


def test_the_formation_captures_on_messages_alone():
    talk = Communication(period=2.0, loss=0.3, processing=0.5)
    task = TeamPursuit(level=2, communication=talk, prey=Prey(mode="line-of-sight"))
    assert rate(task, "formation") > 0.9


def test_vehicles_may_differ_in_type():
    """The prey's speed follows the slowest of the three, and its thickness is that of its own hull."""
    finsrov = load_vehicle("finsrov")
    heavy = load_vehicle("bluerov2_heavy").replace(
        {f"water.{k}": v for k, v in finsrov.water.model_dump().items()}
    )
    crew = [heavy, finsrov, finsrov, heavy]
    env = environment(TeamPursuit(), vehicle=crew)
    assert env.task.speed == pytest.approx(0.8 * DriveNumbers.of(heavy).top)
    assert DriveNumbers.of(heavy).top < DriveNumbers.of(finsrov).top
    assert env.task.prey_radius == pytest.approx(0.25 * (0.457 + 0.575), rel=1e-3)
    assert np.isfinite(still(env).observation).all()


def test_a_world_does_not_know_how_many_there_are():
    """World w of 5 and of 200 are identical over several episodes, messages included."""

    def one(worlds, seed=3):
        task = TeamPursuit(time_limit=1.5, communication=Communication(period=0.3, loss=0.3))
        env = Environment(task, worlds=worlds, seed=seed)
        rng = np.random.default_rng(1)
        rows = []
        for _ in range(40):
            step = env.step(rng.uniform(-1.0, 1.0, (200, 3, 4))[:worlds])
            rows.append(np.concatenate([step.observation, step.reward[..., None]], axis=-1)[:5])
        return np.stack(rows)

    assert np.array_equal(one(5), one(200))
    assert not np.array_equal(one(5), one(5, seed=4))


def test_a_world_that_breaks_is_terminated_and_rewards_nobody(tmp_path, capsys):
    env = Environment(TeamPursuit(), worlds=4, crash_directory=tmp_path)
    still(env)
    broken = env.simulator.state.velocity.numpy().copy()
    broken[1, 2, 0] = np.nan
    env.simulator.state.velocity.assign(broken)
    step = still(env)
    assert step.terminated.tolist() == [False, True, False, False]
    assert (step.reward[1] == 0.0).all() and (step.reward[0] != 0.0).all()
    assert np.isfinite(step.observation).all()
    assert "stopped being finite" in capsys.readouterr().err


def test_a_run_goes_on_from_a_saved_state():
    """It is bit-identical, with messages in transit."""

    def made():
        task = TeamPursuit(communication=Communication(period=0.3, loss=0.3, processing=0.7))
        return Environment(task, worlds=6, seed=2)

    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (40, 6, 3, 4))
    whole, other = made(), made()
    for a in actions[:20]:
        whole.step(a)
    other.load_state(whole.state())
    for a in actions[20:]:
        np.testing.assert_array_equal(whole.step(a).observation, other.step(a).observation)


def test_what_does_not_exist_is_refused():
    with pytest.raises(EnvironmentSetupError, match="level is 4"):
        TeamPursuit(level=4)
    with pytest.raises(EnvironmentSetupError, match="unknown capture mode 'bite'"):
        TeamPursuit(capture="bite")
