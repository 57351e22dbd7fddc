"""1-v-1 pursuit: observations, speed and course of the prey, and capture."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from finssim.agents.catalogue import baseline
from finssim.agents.drive import DriveNumbers
from finssim.extensions.teams.pursuit import PREY_MODES, Prey, Pursuit
from finssim.tasks import Environment, EnvironmentSetupError
from finssim.vehicles import load_vehicle

STILL = Pursuit(prey_speed=0.0)


def environment(task, worlds=8, **options):
    return Environment(task, worlds=worlds, auto_reset=False, **options)


def hunted(mode, **changes):
    return replace(Pursuit(prey=Prey(mode=mode)), **changes)


def place(env, pursuer, prey):
    """Place both vehicles, level and at rest, in every world."""
    x = np.zeros((env.worlds, 2, 3), dtype=np.float32)
    x[:, 0], x[:, 1] = pursuer, prey
    env.simulator.state.position.assign(x)
    env.simulator.state.velocity.zero_()


def world_velocity(env, v):
    state = env.simulator.state
    q, nu = state.quaternion.numpy()[:, v], state.velocity.numpy()[:, v, :3]
    return Rotation.from_quat(q).apply(nu)


def test_the_observation():
    """The observation equals one computed with SciPy, during motion."""
    env = environment(Pursuit())
    rng = np.random.default_rng(0)
    for _ in range(30):
        observation = env.step(rng.uniform(-1.0, 1.0, (8, 4))).observation
    state = env.simulator.state
    x, nu = state.position.numpy().astype(float), state.velocity.numpy().astype(float)
    body = Rotation.from_quat(state.quaternion.numpy()[:, 0]).inv()
    gap = body.apply(x[:, 1] - x[:, 0])
    relative = body.apply(world_velocity(env, 1) - world_velocity(env, 0))
    bearing = np.arctan2(gap[:, 1], gap[:, 0]) / math.pi
    distance = np.linalg.norm(gap, axis=1) / 6.0
    expected = np.column_stack([nu[:, 0], gap / 6.0, relative, distance, bearing])
    np.testing.assert_allclose(observation, expected, atol=2e-5)


@pytest.mark.parametrize("name", ["finsrov", "bluerov2_heavy"])
def test_the_preys_speed_is_a_part_of_what_the_pursuer_can_do(name):
    """The pursuer's speed solves d1 v + d2 v² = tau at full surge, or is lower where the Munk moment dominates.

    FinsROV is limited by its thrust, BlueROV2 Heavy by its stiffness. A straight prey settles at its share of it.
    """
    vehicle = load_vehicle(name)
    hydro = vehicle.hydrodynamics["calibrated"]
    d1 = hydro.linear_damping[0, 0]
    d2 = hydro.quadratic_damping[0, 0] + hydro.surge_damping[0, 0]
    top = brentq(lambda v: d1 * v + d2 * v * v - vehicle.wrench_limits[0], 0.0, 20.0)
    arm = vehicle.body.center_of_buoyancy[2] - vehicle.body.center_of_gravity[2]
    mass = np.diag(vehicle.mass_matrix("calibrated"))
    munk = math.sqrt(vehicle.buoyancy * arm / (mass[2] - mass[0]))
    assert (munk < top) == (name == "bluerov2_heavy")
    top = min(top, munk)
    env = environment(hunted("straight", prey_speed=0.5, farthest=2.5), vehicle=vehicle)
    assert env.task.speed == pytest.approx(0.5 * top, rel=1e-6)
    for _ in range(100):
        env.step(np.zeros((8, 4)))
    speed = np.linalg.norm(world_velocity(env, 1)[:, :2], axis=1)
    np.testing.assert_allclose(speed, 0.5 * top, rtol=0.05)


def test_a_prey_is_no_faster_than_its_own_thrusters():
    """A slow prey before a fast pursuer stays within nine tenths of its sustainable speed."""
    fast, slow = load_vehicle("finsrov"), load_vehicle("bluerov2_heavy")
    speed = Pursuit(prey_speed=1.0).fitted([fast, slow]).speed
    assert speed == pytest.approx(0.9 * DriveNumbers.of(slow).top)


def test_at_the_speed_it_can_hold_a_vehicle_stays_level():
    """BlueROV2 at nine tenths of `level_speed` stays within 30° of level; at full thrust, for 2.5 m/s, it
    tips over."""
    env = environment(hunted("straight", prey_speed=1.0), vehicle="bluerov2")
    assert env.task.speed < 0.5
    tilt = np.zeros(2)
    for _ in range(80):
        env.step(np.tile([1.0, 0.0, 0.0, 0.0], (8, 1)))
        up = [
            Rotation.from_quat(env.simulator.state.quaternion.numpy()[:, v])
            .apply([0.0, 0.0, 1.0])[:, 2]
            .min()
            for v in (0, 1)
        ]
        tilt = np.maximum(tilt, np.degrees(np.arccos(up)))
    assert tilt[1] < 30.0
    assert tilt[0] > 45.0


@pytest.mark.slow
@pytest.mark.parametrize("mode", PREY_MODES)
def test_every_prey_stays_in_its_range_and_below_its_speed(mode):
    """In two minutes of lead pursuit it exceeds its speed by at most 20 %, in turns, and its range by 0.5 m."""
    env = environment(hunted(mode, hold=1e9, time_limit=1e9), worlds=16)
    chaser = baseline("pursuit", "lead")
    observation, fastest = env.arrays.observation.numpy(), 0.0
    for _ in range(1200):
        observation = env.step(chaser.act(None, observation)[0]).observation
        fastest = max(fastest, np.linalg.norm(world_velocity(env, 1)[:, :2], axis=1).max())
    x = env.simulator.state.position.numpy()[:, 1]
    assert 0.5 * env.task.speed < fastest < 1.2 * env.task.speed
    assert np.hypot(x[:, 0], x[:, 1]).max() < 9.5
    assert x[:, 2].min() > -5.5 and x[:, 2].max() < -0.5


def courses(mode, gap=2.0, steps=100):
    """Return the prey's level course in each world after some time, and the direction away from a resting
    pursuer."""
    env = environment(hunted(mode), worlds=32)
    place(env, (0.0, 0.0, -3.0), (gap, 0.0, -3.0))
    for _ in range(steps):
        env.step(np.zeros((32, 4)))
    v = world_velocity(env, 1)[:, :2]
    x = env.simulator.state.position.numpy()[:, :, :2]
    away = x[:, 1] - x[:, 0]
    return np.sum(v * away, axis=1) / np.linalg.norm(v, axis=1) / np.linalg.norm(away, axis=1)


def test_a_prey_in_line_of_sight_flees_straight_away():
    assert courses("line-of-sight", gap=3.5).min() > 0.97


def test_a_hybrid_prey_flees_from_who_is_near_and_wanders_otherwise():
    near, far = courses("hybrid", gap=1.0, steps=40), courses("hybrid", gap=6.0, steps=40)
    assert near.min() > 0.5
    assert far.min() < -0.3 < 0.3 < far.max()


def test_a_straight_prey_keeps_its_course_and_a_random_one_does_not():
    """The course change is taken from 5 s to 13 s with a distant pursuer; a random prey redraws every 4 s."""
    turns = {}
    for mode in ("straight", "random"):
        env = environment(hunted(mode, farthest=2.5), worlds=32)
        seen = []
        for k in range(130):
            env.step(np.zeros((32, 4)))
            if k in (49, 129):
                v = world_velocity(env, 1)
                seen.append(np.arctan2(v[:, 1], v[:, 0]))
        turns[mode] = np.abs(np.angle(np.exp(1j * (seen[1] - seen[0]))))
    assert turns["straight"].max() < 0.05
    assert np.median(turns["random"]) > 0.5


@pytest.mark.parametrize(("distance", "captured"), [(0.78, True), (0.82, False)])
def test_captured_is_half_a_second_within_the_radius(distance, captured):
    """With prey and pursuer at rest, capture comes after 5 steps and not after 4."""
    env = environment(STILL)
    place(env, (0.0, 0.0, -3.0), (distance, 0.0, -3.0))
    ended = [env.step(np.zeros((8, 4))).terminated.all() for _ in range(5)]
    assert ended == [False] * 4 + [captured]
    measured = env.task.metrics(env.arrays)
    if captured:
        assert (measured["success"] == 1.0).all()
        np.testing.assert_allclose(measured["success_time"], 0.5, atol=1e-6)
        assert (env.arrays.reward.numpy() > 19.0).all()


def test_a_pursuer_that_rushes_by_has_not_captured():
    """It is within the radius for longer than half a second, but faster than 0.35 m/s."""
    env = environment(STILL)
    place(env, (-0.4, 0.0, -3.0), (0.0, 0.2, -3.0))
    state = env.simulator.state
    state.quaternion.assign(np.tile(np.float32([0, 0, 0, 1]), (8, 2, 1)))
    nu = np.zeros((8, 2, 6), dtype=np.float32)
    nu[:, 0, 0] = 0.47
    state.velocity.assign(nu)
    full = np.tile([1.0, 0.0, 0.0, 0.0], (8, 1))
    for _ in range(12):
        step = env.step(full)
        assert not step.terminated.any()
    assert (env.task.metrics(env.arrays)["success"] == 0.0).all()
    assert (env.arrays.totals.numpy()[:, env.task.totals.index("closest")] < 0.3).all()


def test_leaving_the_bounds_ends_the_episode_and_costs():
    env = environment(STILL)
    place(env, (12.1, 0.0, -3.0), (6.0, 0.0, -3.0))
    step = env.step(np.zeros((8, 4)))
    assert step.terminated.all() and (step.reward < -19.0).all()
    assert (env.task.metrics(env.arrays)["left"] == 1.0).all()
    assert np.isnan(env.task.metrics(env.arrays)["success_time"]).all()


def test_lead_pursuit_captures_and_a_still_vehicle_does_not():
    """All modes of prey occur, each in about a fourth of the worlds."""
    env, chaser = environment(Pursuit(), worlds=32), baseline("pursuit", "lead")
    rates = {}
    for who in ("lead", "still"):
        observation, caught = env.reset(seed=0), np.zeros(32, dtype=bool)
        for _ in range(600):
            a = chaser.act(None, observation)[0] if who == "lead" else np.zeros((32, 4))
            step = env.step(a)
            caught |= step.terminated & (env.task.metrics(env.arrays)["success"] > 0.0)
            observation = step.observation
        rates[who] = caught.mean()
    assert rates["lead"] > 0.9 and rates["still"] < 0.4


@pytest.mark.parametrize("action", ["wrench4", "wrench6"])
def test_a_world_does_not_know_how_many_there_are(action):
    """World w of 5 and of 200 are identical, prey included, over several episodes; other seeds differ."""

    def one(worlds, seed=3):
        env = Environment(Pursuit(time_limit=1.5), worlds=worlds, seed=seed, action=action)
        rng = np.random.default_rng(1)
        rows = []
        for _ in range(40):
            a = rng.uniform(-1.0, 1.0, (200, env.action_size))[:worlds]
            step = env.step(a)
            rows.append(np.column_stack([step.observation, step.reward, step.truncated])[:5])
        return np.stack(rows)

    assert np.array_equal(one(5), one(200))
    assert not np.array_equal(one(5), one(5, seed=4))


def test_what_does_not_fit_is_refused():
    with pytest.raises(EnvironmentSetupError, match="wrench4"):
        environment(Pursuit(), action="thruster8")
    with pytest.raises(EnvironmentSetupError, match="does not control sway"):
        environment(Pursuit(), vehicle="remus100")
    with pytest.raises(EnvironmentSetupError, match="prey_speed is 1.5"):
        environment(Pursuit(prey_speed=1.5))
    with pytest.raises(EnvironmentSetupError, match="unknown prey mode 'lazy'"):
        Prey(mode="lazy")


def test_a_prey_has_its_whole_thrust_however_gently_the_agents_act():
    """The scale of action 1 applies to the agents only."""
    speeds = []
    for part in (1.0, 0.1):
        env = Environment(Pursuit(prey=Prey(mode="straight")), worlds=2, seed=1, wrench_scale=part)
        for _ in range(40):
            env.step(np.zeros((2, 4)))
        speeds.append(env.simulator.numpy("velocity")[:, 1])
    np.testing.assert_array_equal(*speeds)
