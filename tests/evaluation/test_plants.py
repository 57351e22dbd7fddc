"""Plants: shipped ones have their documented content, and mistakes in a file are refused in a sentence."""

import math

import numpy as np
import pytest

from finssim.agents.agent import agent_for
from finssim.control.modes import MODES
from finssim.control.trajectories import load_trajectory
from finssim.evaluation import trials as trials_module
from finssim.evaluation.plants import PlantChanges, PlantError, available_plants, load_plant
from finssim.evaluation.trials import TrialSettings, run_episodes, run_trials
from finssim.sim import read_run
from finssim.sim.ranges_file import load_ranges
from finssim.tasks import Environment, EnvironmentSetupError, MeasurementNoise, Sensing, task_named
from finssim.vehicles import VehicleError, load_vehicle

FINSROV = load_vehicle("finsrov")
OPEN_LOOP = [name for name, kind in MODES.items() if not kind.pilot and not kind.course]
"""Modes of any vehicle whose commands do not depend on its motion."""


def test_the_plants_of_the_protocol_ship():
    """The shipped plants are nominal, randomised, foreign, held out, current, waves, noise, sensors, lag, and the
    other two models."""
    expected = [
        "beyond_cruise",
        "current",
        "foreign",
        "held_out",
        "lag",
        "mesh",
        "noise",
        "nominal",
        "randomised",
        "sensors",
        "simplified",
        "waves",
    ]
    assert available_plants() == expected
    assert all(load_plant(name).title for name in expected)


def test_a_plant_is_seen_with_what_is_asked_for():
    """Sensors replace the plant's noise; the environment contains them, and the result says so."""
    assert load_plant("sensors").environment_arguments()["noise"] == Sensing()
    seen = load_plant("noise").with_observation("sensors")
    assert seen.observe == "sensors" and not seen.noise and seen.title.endswith("; observation: sensors")
    assert (
        load_plant("nominal").with_observation("truth").environment_arguments()["noise"] == MeasurementNoise()
    )
    told = seen.observe_record(FINSROV)["observe"]
    assert told["name"] == "sensors" and told["fixes"]["rate"] == 30.0 and told["imu"]["rate"] == 100.0
    assert load_plant("noise").observe_record(FINSROV) == {}
    with pytest.raises(PlantError, match="observe is 'eyes', expected truth, estimator, sensors"):
        load_plant("nominal").with_observation("eyes")
    with pytest.raises(ValueError, match="noise and observe: sensors are both given"):
        PlantChanges(name="both", noise={"yaw_std": 0.1}, observe="sensors")


def test_nominal_changes_nothing():
    plant = load_plant("nominal")
    assert plant.changed(FINSROV) is FINSROV
    assert set(plant.environment_arguments().values()) == {None}


def test_the_noise_is_the_papers():
    """The noise is 5 cm per axis and 10° of yaw."""
    noise = load_plant("noise").environment_arguments()["noise"]
    assert noise.position_std == 0.05 and noise.yaw_std == pytest.approx(math.radians(10.0))


def test_the_current_is_ten_centimetres_per_second():
    ranges = load_plant("current").environment_arguments()["randomization"].ranges
    assert ranges.current == (0.10, 0.10)


def test_lag_is_added_to_every_thruster():
    changed = PlantChanges(name="slow", extra_time_constant=0.1, extra_delay=0.02).changed(FINSROV)
    before, after = (list(v.thrusters.values()) for v in (FINSROV, changed))
    np.testing.assert_allclose(
        [a.time_constant - b.time_constant for a, b in zip(after, before, strict=True)], 0.1
    )
    np.testing.assert_allclose([a.delay - b.delay for a, b in zip(after, before, strict=True)], 0.02)
    assert changed.sha256 != FINSROV.sha256


def test_any_number_of_the_vehicle_can_differ(tmp_path):
    (tmp_path / "heavy.yaml").write_text(
        "vehicle: {body.mass: 13.0}\nhydrodynamics: simplified\n", encoding="utf-8"
    )
    plant = load_plant(tmp_path / "heavy.yaml")
    assert plant.name == "heavy" and plant.hydrodynamics == "simplified"
    assert plant.changed(FINSROV).body.mass == 13.0
    with pytest.raises(VehicleError, match="body: unknown key 'weight'"):
        PlantChanges(name="x", vehicle={"body.weight": 1.0}).changed(FINSROV)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("currant: 1", "plant.yaml: currant: unknown key; known keys: name, title"),
        ("ranges: hold", "plant.yaml: ranges: no ranges 'hold'"),
        ("ranges: {mass: [2, 1]}", "plant.yaml: ranges.*name"),
        ("water: {current: [0.1, 0]}", "water.current.2: is missing"),
        ("water: {current: 0.1}", "water.current: is 0.1, expected a list of values"),
        ("water: {flow: 1}", "water.flow: unknown key; known keys: current, shear"),
        ("water: {waves: 3}", "water.waves: Input should be an instance of Sequence"),
        ("water: {waves: [{amplitude: 1, wavelength: 2}]}", "a linear wave breaks"),
        ("water: {waves: [{amplitude: 0.1}]}", "water.waves.0.wavelength: is missing: add it"),
        ("noise: {position_std: .nan}", "noise"),
        ("noise: {yaw_sd: 1}", "noise.yaw_sd: unknown key, did you mean 'yaw_std'"),
        ("extra_delay: -1", "extra_delay: Input should be greater than or equal to 0, found -1"),
        ("extra_delay: 1e9", "extra_delay: Input should be less than or equal to 5"),
        ("extra_time_constant: 5.1", "less than or equal to 5"),
        ("a: [", "not valid YAML"),
        ("- 1", "expected keys such as"),
    ],
)
def test_a_wrong_plant_gets_its_sentence(tmp_path, text, sentence):
    (tmp_path / "plant.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(PlantError, match=sentence):
        load_plant(tmp_path / "plant.yaml")


@pytest.mark.parametrize("load", [load_plant, load_ranges])
def test_a_name_is_of_those_that_ship(load, tmp_path, monkeypatch):
    """Plants and sweeps name ranges and plants: a name is looked up, and never becomes part of a path."""
    (tmp_path / "mine.yaml").write_text("mass: [0.9, 1.1]\n", encoding="utf-8")
    for module in ("finssim.evaluation.plants", "finssim.sim.ranges_file"):
        monkeypatch.setattr(f"{module}.SHIPPED", tmp_path / "shipped")
    (tmp_path / "shipped").mkdir()
    with pytest.raises(ValueError, match="no (plant|ranges) '../mine'"):
        load("../mine")


def test_an_unknown_plant_is_told_the_nearest():
    with pytest.raises(PlantError, match="no plant 'nominel'.*did you mean 'nominal'"):
        load_plant("nominel")


def thruster_limits(factor):
    """Return a plant whose thruster limits are a multiple of the vehicle file's."""
    changes = {
        f"thrusters.{name}.{key}": factor * getattr(t, key)
        for name, t in FINSROV.thrusters.items()
        for key in ("force_min", "force_max")
    }
    return PlantChanges(name="limits", vehicle=changes)


def commands_and_thrusts(run, plant, folder):
    """Return commanded and delivered thrust [N] of every thruster, (rows, thrusters), of a recorded evaluation."""
    run(plant, folder)
    table = read_run(folder)
    return tuple(
        table[[f"{what}_{name}" for name in FINSROV.thruster_names]].to_numpy()
        for what in ("command", "thrust")
    )


def t1_trials(controller):
    def run(plant, folder):
        task = task_named("t1")
        run_trials(
            agent_for(controller, FINSROV, task), task, FINSROV, plant, TrialSettings(trials=8, record=folder)
        )

    return run


def t2_trials(plant, folder):
    task = task_named("t2")
    guides = [load_trajectory("lemniscate")]
    settings = TrialSettings(trials=1, record=folder)
    run_trials(agent_for("pid", FINSROV, task), task, FINSROV, plant, settings, guides=guides)


def episodes(name, action=None):
    def run(plant, folder):
        task = task_named(name, time_limit=3.0)
        run_episodes(Restless(task, action), task, FINSROV, plant, TrialSettings(trials=4, record=folder))

    return run


class Restless:
    """Agent that requests another fraction of every limit in every step, up to the whole."""

    wrench_scale = 1.0

    def __init__(self, task, action=None):
        self.action, self.period = action or task.action, task.control_step

    def reset(self, n):
        return np.random.default_rng(3)

    def act(self, rng, readings, goal):
        shape = (len(readings.observation), len(MODES[self.action].labels(FINSROV)))
        return rng.uniform(-1.0, 1.0, shape).astype(np.float32), rng


EVERY_EVALUATION = {
    "T1, PID": t1_trials("pid"),
    "T1, published PID": t1_trials("pid-paper"),
    "T2, PID": t2_trials,
    "episodes by wrench": episodes("docking"),
    "episodes by thruster": episodes("t3", "thruster8"),
    "episodes of a scripted prey": episodes("pursuit"),
}


@pytest.mark.parametrize("name", EVERY_EVALUATION)
def test_stronger_thrusters_deliver_what_is_asked_of_the_vehicle_that_the_controller_knows(
    name, tmp_path, monkeypatch
):
    """No command is beyond the limits of the file, so doubled limits give bit-identical results."""
    monkeypatch.setattr(trials_module, "DURATION", 10.0)
    run = EVERY_EVALUATION[name]
    known = commands_and_thrusts(run, load_plant("nominal"), tmp_path / "nominal")
    strong = commands_and_thrusts(run, thruster_limits(2.0), tmp_path / "strong")
    assert np.abs(known[1]).max() > 0.5  # the thrusters work
    for ours, theirs in zip(known, strong, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def commanded_and_delivered(mode, plant):
    """Return thruster forces [N], commanded and delivered, (worlds, thrusters), 3 s after random actions that are equal
    for every plant, which is long after every lag."""
    arguments = plant.environment_arguments()
    environment = Environment(
        task_named("t1"),
        plant.changed(FINSROV),
        nominal=FINSROV,
        action=mode,
        worlds=16,
        auto_reset=False,
        seed=2,
        **arguments,
    )
    action = np.random.default_rng(5).uniform(-1.0, 1.0, (16, environment.action_size)).astype(np.float32)
    for _ in range(30):
        environment.step(action)
    n, simulator = len(FINSROV.thrusters), environment.simulator
    return simulator.command.thrust.numpy()[:, 0, :n], simulator.numpy("thrust")[:, 0, :n]


@pytest.mark.parametrize("mode", OPEN_LOOP)
def test_weak_thrusters_deliver_what_is_asked_up_to_their_own_limits(mode):
    """With half the limits, commands are bit-identical to the nominal plant's, and delivered thrusts are clipped."""
    plant = thruster_limits(0.5)
    asked, _ = commanded_and_delivered(mode, load_plant("nominal"))
    commanded, delivered = commanded_and_delivered(mode, plant)
    np.testing.assert_array_equal(commanded, asked)
    lower, upper = (np.asarray(limit, np.float32) for limit in plant.changed(FINSROV).force_limits)
    expected = np.clip(asked, lower, upper)
    assert 0.1 < (expected != asked).mean() < 0.9  # some saturate, and some do not
    np.testing.assert_allclose(delivered, expected, rtol=1e-5, atol=1e-5 * upper.max())


@pytest.mark.parametrize("mode", OPEN_LOOP)
def test_what_is_drawn_of_thrusters_does_not_change_what_is_asked(mode):
    """Ranges scale the thrust that a command produces, never the limits that scale actions."""
    asked, nominal = commanded_and_delivered(mode, load_plant("nominal"))
    commanded, delivered = commanded_and_delivered(mode, load_plant("randomised"))
    np.testing.assert_array_equal(commanded, asked)
    assert np.abs(delivered - nominal).max() > 0.1


def test_a_controller_of_other_thrusters_is_refused():
    with pytest.raises(
        EnvironmentSetupError, match="bluerov2 has thrusters .*, expected those that its contr"
    ):
        Environment(task_named("t1"), "bluerov2", nominal=FINSROV)
