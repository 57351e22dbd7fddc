"""The batch: seeds, independence of worlds, automatic reset, refusals, noise and failing worlds."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pandas
import pytest
import warp as wp

from finssim.control.course import FARTHEST, STEEPEST, WIDEST, CoursePilot, course_speeds
from finssim.control.guidance import Known
from finssim.control.modes import action_mode
from finssim.core.rotations import quat_rotate
from finssim.sim.free_motion import linear_model
from finssim.sim.randomize import Randomization
from finssim.sim.site import RectangularPool
from finssim.sim.state import State
from finssim.tasks import Environment, EnvironmentSetupError, MeasurementNoise, StationKeeping
from finssim.tasks.terms import place_at_rest
from reference.guess import Steady

TASK = StationKeeping(time_limit=1.0)
NOISE = MeasurementNoise(position_std=0.05, yaw_std=0.17, velocity_std=0.02, rate_std=0.03)


def environment(worlds=8, **options):
    return Environment(TASK, worlds=worlds, **options)


def run(env, steps=25, seed=0):
    """Return observations, rewards and ends of a run with random actions, different in each world."""
    actions = np.random.default_rng(seed).uniform(-1.0, 1.0, (steps, 512, env.action_size))
    out = [env.arrays.observation.numpy().copy()]
    for a in actions:
        step = env.step(a[: env.worlds])
        out += [np.column_stack([step.observation, step.reward, step.terminated, step.truncated])]
    return out


def same(first, second):
    return all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize("action", ["wrench6", "wrench4", "thruster8", "surfaces", "course"])
def test_equal_seeds_are_equal_runs_and_others_are_not(action):
    """Runs are bit-identical through several episodes, with randomisation and noise."""

    def one(seed):
        ranges = Randomization("hold_for_position")
        return run(environment(seed=seed, action=action, randomization=ranges, noise=NOISE))

    assert same(one(3), one(3))
    assert not same(one(3), one(4))


@pytest.mark.parametrize("threads", [1, 2])
def test_a_world_does_not_know_how_many_there_are(threads):
    """World w of 5 and of 300 is the same, for any number of threads."""
    options = {"seed": 9, "randomization": Randomization("hold_for_position"), "noise": NOISE}
    few, many = run(environment(5, **options)), run(environment(300, threads=threads, **options))
    assert same(few, [x[:5] for x in many])


def test_a_seed_starts_the_streams_over():
    """After reset(seed) a used environment equals a new environment of this seed."""
    used = environment(noise=NOISE, randomization=Randomization("fossen_learn_to_swim"), seed=1)
    run(used, 5)
    used.reset(seed=7)
    assert same(
        run(used), run(environment(noise=NOISE, randomization=Randomization("fossen_learn_to_swim"), seed=7))
    )


def test_the_last_observation_of_an_episode_is_kept():
    """At the end of an episode final_observation is what a world without reset shows, and the next episode
    begins."""
    going, staying = environment(16, seed=2), environment(16, seed=2, auto_reset=False)
    for a in np.random.default_rng(1).uniform(-1.0, 1.0, (10, 16, 6)):
        step, other = going.step(a), staying.step(a)
    assert step.truncated.all() and not step.terminated.any()
    np.testing.assert_array_equal(step.final_observation, other.observation)
    assert not np.isclose(step.observation, other.observation).all(axis=1).any()
    assert (going.simulator.state.steps.numpy() == 0).all()
    assert (going.arrays.held.numpy() == 0.0).all()


def test_totals_of_an_episode():
    """final_return is the sum of the episode's rewards and final_length their number."""
    env = environment(4)
    rewards = [env.step(np.zeros((4, 6))).reward.copy() for _ in range(10)]
    np.testing.assert_allclose(env.arrays.final_return.numpy(), np.sum(rewards, axis=0), rtol=1e-5)
    assert env.arrays.final_length.numpy().tolist() == [10] * 4


@pytest.mark.parametrize("shape", [(8, 5), (7, 6), (6,), (8, 6, 1), ()])
def test_an_action_of_another_shape_is_refused(shape):
    with pytest.raises(EnvironmentSetupError, match=r"expected \(8, 6\)"):
        environment().step(np.zeros(shape))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_action_that_is_not_finite_is_refused_by_world(value):
    """The sentence names the world, and no world moves."""
    env = environment()
    before = env.simulator.state.steps.numpy().copy()
    action = np.zeros((8, 6))
    action[5, 2] = value
    with pytest.raises(EnvironmentSetupError, match="action of world 5 has a number that is not finite"):
        env.step(action)
    assert np.array_equal(env.simulator.state.steps.numpy(), before)


def test_infinities_of_both_signs_are_refused():
    action = np.zeros((8, 6))
    action[1, 0], action[2, 0] = np.inf, -np.inf
    with pytest.raises(EnvironmentSetupError, match="world 1"):
        environment().step(action)


@pytest.mark.parametrize("seed", [-1, 2**31])
def test_a_seed_that_kernels_cannot_take_is_refused(seed):
    """It is refused at construction and at a reset; the environment is unchanged."""
    task = StationKeeping()
    with pytest.raises(EnvironmentSetupError, match=f"seed is {seed}, expected 0 to 2147483647"):
        Environment(task, seed=seed)
    environment = Environment(task, seed=2**31 - 1)
    with pytest.raises(EnvironmentSetupError, match=f"seed is {seed}"):
        environment.reset(seed=seed)
    assert environment.seed == 2**31 - 1


def test_unknown_names_are_refused():
    with pytest.raises(EnvironmentSetupError, match="unknown action mode 'wrench5'; available: thruster8"):
        environment(action="wrench5")


@pytest.mark.parametrize("name", ["wrench6", "wrench4", "thruster8", "pilot6", "surfaces"])
def test_an_action_commands_what_its_mode_says(name):
    """The environment's kernels and the mode on the robot give the same thrusts, also beyond ±1."""
    env = environment(200, action=name, **({"vehicle": "bluerov2_heavy"} if name == "pilot6" else {}))
    mode = action_mode(name, env.simulator.vehicles[0])
    action = np.random.default_rng(4).uniform(-1.3, 1.3, (200, mode.size))
    env.step(action)
    commanded = env.simulator.command.thrust.numpy()[:, 0]
    # Forces of up to 8 N in float32; at limits, rounding of the wrench moves them slightly more.
    np.testing.assert_allclose(commanded, mode.to_thrusters(action), atol=2e-4)


@pytest.mark.parametrize(("name", "dive"), [("course", "depth"), ("course_pitch", "pitch")])
def test_an_order_is_carried_out_as_by_the_autopilot_of_one_robot(name, dive):
    """From the same states the channels agree step by step; the memory is per world and empty when an episode
    starts."""
    env = environment(6, action=name, auto_reset=False)
    vehicle, state = env.nominal[0], env.simulator.state
    pilot = CoursePilot(linear_model(vehicle), vehicle.name, TASK.control_step)
    speeds, rng = course_speeds(vehicle), np.random.default_rng(3)
    memory = pilot.reset(6)
    for _ in range(5):
        a = rng.uniform(-1.2, 1.2, (6, 3))
        x, q, nu = (
            np.array(y.numpy()[:, 0], float) for y in (state.position, state.quaternion, state.velocity)
        )
        env.step(a)
        speed, turn, down = np.clip(a, -1.0, 1.0).T
        now = quat_rotate(q, nu[:, :3])
        bow = quat_rotate(q, [1.0, 0.0, 0.0])
        ahead = (now * bow)[:, :2].sum(axis=1) / np.linalg.norm(bow[:, :2], axis=1)
        way = np.where((ahead >= 0.5 * speeds[0])[:, None], now, bow)
        order = {
            "speed": speeds[0] + 0.5 * (1.0 + speed) * (speeds[-1] - speeds[0]),
            "course": np.arctan2(way[:, 1], way[:, 0]) + WIDEST * turn,
            dive: FARTHEST * down - x[:, 2] if dive == "depth" else STEEPEST * down,
        }
        channels, memory = pilot.command(memory, Known(None, x, q, nu), **order)
        np.testing.assert_allclose(env.simulator.command.thrust.numpy()[:, 0], channels, atol=2e-3)
    assert env.arrays.steering.numpy()[:, 0, 9] == pytest.approx(memory[:, 9], abs=1e-3)
    env.reset()
    np.testing.assert_array_equal(env.arrays.steering.numpy()[:, 0], pilot.reset(6))


def test_a_scaled_wrench_is_that_part_of_the_limits():
    """wrench_scale is part of the meaning of an action."""
    scale = (0.1, 0.2, 0.3, 0.0, 0.0, 0.05)
    env = environment(50, wrench_scale=scale)
    action = np.random.default_rng(4).uniform(-1.0, 1.0, (50, 6))
    env.step(action)
    expected = action_mode("wrench6", env.simulator.vehicles[0], scale).to_thrusters(action)
    np.testing.assert_allclose(env.simulator.command.thrust.numpy()[:, 0], expected, atol=1e-4)


def test_without_noise_the_controller_sees_the_truth_itself():
    """The measured arrays are the state, without a copy."""
    env = environment()
    assert env.arrays.position.ptr == env.simulator.state.position.ptr


def test_noise_has_the_statistics_it_was_given():
    """The mean is zero, deviations are as given, and axes, steps and worlds are uncorrelated."""
    n = 4000
    env = environment(n, noise=NOISE, threads=1)
    state, a = env.simulator.state, env.arrays
    samples = []
    for _ in range(3):
        env.step(np.zeros((n, 6)))
        position = (a.position.numpy() - state.position.numpy())[:, 0]
        velocity = (a.velocity.numpy() - state.velocity.numpy())[:, 0]
        yaw = 2.0 * np.arcsin(_relative(a.quaternion.numpy()[:, 0], state.quaternion.numpy()[:, 0])[:, 2])
        samples.append(np.column_stack([position, yaw, velocity]))
    stds = np.array([0.05] * 3 + [0.17] + [0.02] * 3 + [0.03] * 3)
    unit = np.concatenate(samples) / stds
    error = 5.0 / math.sqrt(len(unit))
    np.testing.assert_allclose(unit.mean(axis=0), 0.0, atol=error)
    np.testing.assert_allclose(unit.std(axis=0), 1.0, atol=error)
    np.testing.assert_allclose(np.corrcoef(unit.T), np.eye(10), atol=error)
    first, second = samples[0] / stds, samples[1] / stds
    np.testing.assert_allclose((first * second).mean(axis=0), 0.0, atol=5.0 / math.sqrt(n))
    np.testing.assert_allclose((first[1:] * first[:-1]).mean(axis=0), 0.0, atol=5.0 / math.sqrt(n))


def _relative(q, q_true):
    """Return q times the inverse of q_true, xyzw: the rotation in the world frame."""
    v, w = -q_true[:, :3], q_true[:, 3:]
    vector = q[:, 3:] * v + w * q[:, :3] + np.cross(q[:, :3], v)
    scalar = q[:, 3] * w[:, 0] - np.sum(q[:, :3] * v, axis=1)
    return np.column_stack([vector, scalar]) * np.sign(scalar)[:, None]


@pytest.mark.parametrize("std", [-0.1, np.nan, np.inf])
def test_impossible_noise_is_refused(std):
    with pytest.raises(ValueError, match="expected finite numbers of 0 or more"):
        MeasurementNoise(position_std=std)


@pytest.mark.parametrize("auto_reset", [True, False])
def test_a_world_that_breaks_is_reported_and_starts_over(tmp_path, capsys, auto_reset):
    """A NaN in one world terminates its episode, leaves a file, and affects no other world."""
    broken, well = (environment(8, crash_directory=tmp_path, auto_reset=auto_reset) for _ in range(2))
    for env in (broken, well):
        for _ in range(3):
            env.step(np.full((8, 6), 0.1))
    velocity = broken.simulator.state.velocity.numpy().copy()
    velocity[5, 0, 2] = np.nan
    broken.simulator.state.velocity.assign(velocity)
    step, other = broken.step(np.full((8, 6), 0.1)), well.step(np.full((8, 6), 0.1))
    assert step.terminated.tolist() == [w == 5 for w in range(8)] and not step.truncated.any()
    assert np.isfinite(step.observation).all() and np.isfinite(step.reward).all()
    assert np.isfinite(step.final_observation).all()
    rest = np.arange(8) != 5
    np.testing.assert_array_equal(step.observation[rest], other.observation[rest])
    (file,) = tmp_path.iterdir()
    assert str(file) in capsys.readouterr().err
    table = pandas.read_csv(file)
    assert len(table) == 4 and table.iloc[:-1].notna().all(axis=None) and table.iloc[-1].isna().any()
    again = broken.step(np.full((8, 6), 0.1))
    assert not again.terminated.any() and np.isfinite(again.observation).all()


@wp.func
def in_the_wall(state: State, w: int):
    """Start the third world 0.1 m inside a wall."""
    place_at_rest(state, w, 0, wp.vec3(wp.where(w == 2, 2.1, 1.0), 0.0, -0.5), 0.0)


@dataclass(frozen=True, kw_only=True)
class Walled(Steady):
    """A task with an invalid start."""

    name: str = "walled"
    pool: RectangularPool | None = RectangularPool()

    def terms(self):
        return replace(super().terms(), start=in_the_wall)


def test_a_start_outside_the_arena_is_refused_with_its_place():
    """The wall would eject the vehicle at 46 m/s; in a wider arena this start is allowed."""
    with pytest.raises(
        EnvironmentSetupError, match=r"'walled' starts .* in world 2 at \(2.1, 0, -0.5\) m, outside"
    ):
        Environment(Walled(), worlds=4)
    assert Environment(replace(Walled(), pool=RectangularPool(length=6.0)), worlds=4).worlds == 4


def test_of_many_worlds_that_break_three_are_written(tmp_path, capsys):
    """The others are counted in one sentence, however many fail and however often."""
    env = Environment(StationKeeping(), worlds=8, crash_directory=tmp_path / "broken")
    for _ in range(3):
        velocity = env.simulator.state.velocity.numpy()
        velocity[:] = np.nan
        env.simulator.state.velocity.assign(velocity)
        env.step(np.zeros((8, 6)))
    assert len(list((tmp_path / "broken").iterdir())) == 3
    said = capsys.readouterr().err
    assert said.count("last states in") == 3 and said.count("are not written") == 1
