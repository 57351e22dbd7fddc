"""A run continued from a saved state is bit-identical to the uninterrupted run."""

import numpy as np
import pytest

import finssim
from finssim.sim import Water
from finssim.sim.randomize import Randomization
from finssim.sim.ranges_file import Curriculum, Ranges, load_ranges
from finssim.tasks import EnvironmentSetupError, MeasurementNoise, numeric_tasks
from finssim.tasks.sensing import Sensing
from finssim.vehicles import load_vehicle
from finssim.vehicles.equipment import DepthSensor, Dvl

NUMERIC = numeric_tasks()

NOISE = MeasurementNoise(
    position_std=0.02, yaw_std=0.1, velocity_std=0.02, rate_std=0.02, position_bias=0.01, delay=0.2
)
WATER = Water(current=(0.05, 0.0, 0.0), drift_std=(0.05, 0.05, 0.02), drift_time=5.0)


def made(task, **options):
    """Return a few worlds with all randomisation, at random episode ages, so that some end soon."""
    usual = {"worlds": 6, "seed": 4, "observe": NOISE, "water": WATER, "randomize": "fossen_learn_to_swim"}
    environment = finssim.make(task, **{**usual, **options})
    limit = round(environment.task.time_limit / environment.task.control_step)
    age = np.linspace(0, limit - 12, environment.worlds).astype(np.int32)
    environment.simulator.state.steps.assign(age)
    return environment


def act(environment, steps, seed):
    """Return all outputs for random actions."""
    rng, seen = np.random.default_rng(seed), []
    for _ in range(steps):
        action = rng.uniform(-1.0, 1.0, environment.arrays.action.shape).astype(np.float32)
        environment.arrays.action.assign(action)
        environment.advance()
        out = environment.outcome()
        seen += [
            np.array(x)
            for x in (out.observation, out.reward, out.terminated, out.truncated, out.final_observation)
        ]
    return seen


@pytest.mark.slow
@pytest.mark.parametrize("task", NUMERIC)
def test_a_run_that_goes_on_is_the_run_that_was_not_interrupted(task):
    """Outputs and states agree through ends of episodes, new draws and the delay lines."""
    whole, other = made(task), made(task)
    act(whole, 7, seed=0)
    saved = whole.state()
    act(other, 3, seed=9)  # its earlier history is overwritten
    other.reset(seed=77)
    other.load_state(saved)
    first, second = act(whole, 12, seed=1), act(other, 12, seed=1)
    assert any(done.any() for done in first[3::5]), "no episode ended: the test proves less than it says"
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))
    after, again = whole.state(), other.state()
    assert after.keys() == again.keys() and all(
        np.array_equal(after[k], again[k], equal_nan=True) for k in after
    )


def test_instruments_and_filters_go_on():
    """The state includes late fixes, delayed samples, drifting biases and the filters' estimates."""
    late = {"rate": 4.0, "latency": 0.3, "dropout": 0.2, "position": np.zeros(3)}
    finsrov = load_vehicle("finsrov")
    gauge, dvl = (
        DepthSensor(**late, noise_std=0.01),
        Dvl(**late, noise_std=0.01, bias_walk=0.01, scale_error=0.02),
    )
    sensors = finsrov.sensors.model_copy(update={"depth": gauge, "dvl": dvl})
    vehicle = finsrov.model_copy(update={"sensors": sensors})
    sensing = Sensing(
        rate=15.0, fixes=MeasurementNoise(position_std=0.02, yaw_std=0.02, delay=0.2, dropout=0.2)
    )
    whole, other = (made("t1", vehicle=vehicle, observe=sensing, randomize=None) for _ in range(2))
    act(whole, 7, seed=0)
    saved = whole.state()
    act(other, 4, seed=9)
    other.reset(seed=77)
    other.load_state(saved)
    first, second = act(whole, 12, seed=1), act(other, 12, seed=1)
    assert any(done.any() for done in first[3::5]), "no episode ended: the test proves less than it says"
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))
    after, again = whole.state(), other.state()
    assert {"readings.dvl.ring", "readings.gauge_samples.sent", "estimates.position"} <= after.keys()
    assert all(np.array_equal(after[k], again[k], equal_nan=True) for k in after)


@pytest.mark.parametrize("by", ["steps", "success"])
def test_ranges_that_grow_go_on_growing(by):
    """The evaluation of success falls into the second part only if earlier steps are counted."""
    growing = load_ranges("fossen_learn_to_swim").model_copy(
        update={"curriculum": Curriculum(by=by, episodes=1, narrow_at=0.0, widen_at=0.0, over=(0.0, 1000.0))}
    )
    whole, other = (made("t1", randomize=Randomization(growing)) for _ in range(2))
    act(whole, 45, seed=0)
    before = whole.schedule.width
    other.load_state(whole.state())
    first, second = act(whole, 12, seed=1), act(other, 12, seed=1)
    assert other.schedule.width == whole.schedule.width > before
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def test_tethers_that_were_drawn_are_kept():
    """Draws of a saved episode are restored in worlds that never had them."""
    ranges = Ranges.model_validate({"name": "line", "tether": {"diameter": [0.005, 0.02]}})
    whole, other = (finssim.make("t1", worlds=4, seed=1, randomize=Randomization(ranges)) for _ in range(2))
    whole.reset()
    other.load_state(whole.state())
    first, second = act(whole, 12, seed=1), act(other, 12, seed=1)
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def test_a_saved_state_is_a_copy():
    """Later steps do not change it."""
    environment = made("t1")
    saved = environment.state()
    before = {name: array.copy() for name, array in saved.items()}
    act(environment, 5, seed=2)
    assert all(np.array_equal(saved[name], before[name], equal_nan=True) for name in saved)
    assert not np.array_equal(saved["state.position"], environment.state()["state.position"])


def test_loading_keeps_the_memory_of_the_arrays():
    """Tensors that share memory with the arrays remain valid."""
    environment = made("t1")
    place = environment.arrays.observation.ptr
    environment.load_state(environment.state())
    assert environment.arrays.observation.ptr == place


def test_a_state_of_another_environment_is_refused():
    """Another number of worlds or another task is refused."""
    saved = made("t1").state()
    with pytest.raises(EnvironmentSetupError, match=r"has shape \(6, .*expected \(5, .*same arguments"):
        made("t1", worlds=5).load_state(saved)
    with pytest.raises(EnvironmentSetupError, match="'task.reference.duration' is not in the saved state"):
        made("t2").load_state(saved)
