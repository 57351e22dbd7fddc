"""Water as data: profiles over depth and time, sea states, water files, and draws from them."""

import json
import math

import numpy as np
import pytest
import warp as wp

from finssim.cli.simulate import simulate
from finssim.evaluation.plants import PlantError, load_plant
from finssim.learning.train import TrainingSettings
from finssim.physics.water import Flow, WaterArrays, flow_at, wave_number
from finssim.sim import CurrentProfile, SeaState, Simulator, SurroundingsError, Water, load_water
from finssim.sim.randomize import Randomization
from finssim.sim.ranges_file import Ranges, RangesError
from finssim.sim.water import read_profile, sea_bands
from finssim.tasks import task_named

wp.set_module_options({"enable_backward": False})
TABLE = """depth,time,east,north,up
0,0,0.4,0.0,0
5,0,0.2,0.1,0
20,0,0.0,0.2,0.01
0,600,0.0,-0.4,0
5,600,0.1,-0.2,0
20,600,0.2,0.0,0
"""


@wp.kernel
def flow_kernel(
    water: WaterArrays, world: int, position: wp.array(dtype=wp.vec3), t: float, out: wp.array(dtype=Flow)
):
    i = wp.tid()
    out[i] = flow_at(water, world, position[i], t, 0.0)


def flow_here(arrays, position, t, world=0):
    points = wp.array(np.asarray(position, np.float32), dtype=wp.vec3, device="cpu")
    out = wp.zeros(len(points), dtype=Flow, device="cpu")
    wp.launch(flow_kernel, len(points), [arrays, world, points, t, out], device="cpu")
    return {name: out.numpy()[name].astype(float) for name in Flow.vars}


def arrays_of(water, worlds=1):
    return water.arrays(worlds, 1000.0, 9.81, wp.get_device("cpu"))


@pytest.fixture
def table(tmp_path):
    path = tmp_path / "profile.csv"
    path.write_text(TABLE, encoding="utf-8")
    return path


def test_a_profile_is_linear_between_its_rows_and_constant_beyond_them(table):
    """Velocity, its gradient and its rate equal NumPy's interpolation, at depths and times within and
    outside."""
    arrays = arrays_of(Water(current=table))
    depths, times = np.array([0.0, 5.0, 20.0]), np.array([0.0, 600.0])
    values = np.loadtxt(table, delimiter=",", skiprows=1)[:, 2:].reshape(2, 3, 3)
    for depth, t in [
        (0.0, 0.0),
        (2.5, 0.0),
        (5.0, 300.0),
        (12.0, 450.0),
        (20.0, 600.0),
        (35.0, 60.0),
        (1.0, 900.0),
    ]:
        found = flow_here(arrays, [(3.0, -2.0, -depth)], t)
        at = [np.array([np.interp(depth, depths, row[:, k]) for k in range(3)]) for row in values]
        part = np.interp(t, times, [0.0, 1.0])
        np.testing.assert_allclose(found["velocity"][0], (1 - part) * at[0] + part * at[1], atol=1e-6)
        rate = (at[1] - at[0]) / 600.0 if t <= 600.0 else np.zeros(3)
        np.testing.assert_allclose(found["acceleration"][0], rate, atol=1e-7)
        i = min(int(np.searchsorted(depths, depth, side="right")) - 1, 1)
        slopes = [-(row[i + 1] - row[i]) / (depths[i + 1] - depths[i]) for row in values]
        slope = (1 - part) * slopes[0] + part * slopes[1] if depth <= 20.0 else np.zeros(3)
        gradient = found["gradient"][0].reshape(3, 3)
        np.testing.assert_allclose(gradient[:, 2], slope, atol=1e-6)
        np.testing.assert_array_equal(gradient[:, :2], 0.0)


def test_a_still_vehicle_is_carried_as_the_water_at_its_depth(tmp_path):
    """After ten minutes it moves with the profile at its depth, to 3 mm/s; a vehicle above moves differently."""
    (tmp_path / "p.csv").write_text("depth;east;north\n0;0,3;0\n10;0,1;0,2\n", encoding="utf-8")
    simulator = Simulator("finsrov", worlds=2, water=Water(current=tmp_path / "p.csv", depth=30.0))
    simulator.place(position=[[[0.0, 0.0, -2.0]], [[0.0, 0.0, -8.0]]])
    for _ in range(6000):
        simulator.step()
    position, start = simulator.numpy("position")[:, 0].copy(), simulator.numpy("position")[:, 0].copy()
    for _ in range(10):
        simulator.step()
    speed = (simulator.numpy("position")[:, 0] - start)[:, :2]
    expected = np.array(
        [[np.interp(-z, [0, 10], c) for c in ((0.3, 0.1), (0.0, 0.2))] for z in position[:, 2]]
    )
    np.testing.assert_allclose(speed, expected, atol=0.003)


REFUSED = {
    "an unknown column": (TABLE.replace("up", "salt"), "column 'salt' is unknown"),
    "a missing column": ("depth,east\n0,1\n", "no column 'north'"),
    "no number": (TABLE.replace("0.4", "fast"), "line 2: east is 'fast', expected a finite number"),
    "an empty cell": (TABLE.replace("0.4", ""), "line 2: east is '', expected a finite number"),
    "a gap": (TABLE.replace("5,600,0.1,-0.2,0\n", ""), "no row for depth 5 m at 600 s"),
    "a row twice": (TABLE + "0,0,1,1,0\n", "line 8: depth 0 m at 0 s is there twice"),
    "cm/s": (TABLE.replace("0.4", "40"), "are the velocities in m/s?"),
    "nothing": ("depth,east,north\n", "0 rows, expected 1"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_table_with_an_error_is_refused_by_line(name, tmp_path):
    text, sentence = REFUSED[name]
    (tmp_path / "p.csv").write_text(text, encoding="utf-8")
    with pytest.raises(SurroundingsError) as refusal:
        read_profile(tmp_path / "p.csv")
    assert sentence in str(refusal.value)


@pytest.mark.parametrize(("spectrum", "peak"), [("jonswap", 3.3), ("pierson-moskowitz", 1.0)])
def test_a_sea_has_the_energy_the_shape_and_the_directions_of_its_spectrum(spectrum, peak):
    """The energy is H² / 16 exactly; the cumulative energy of 200 components follows the published spectrum's
    integral."""
    sea = SeaState(
        spectrum=spectrum, height=0.8, period=5.0, heading=0.7, spread=0.4, components=200, seed=3, peak=peak
    )
    waves = sea.waves(1000.0)
    a = np.array([wave.amplitude for wave in waves])
    assert np.sum(a**2) / 2 == pytest.approx(0.8**2 / 16, rel=1e-12)
    omega = np.sort(np.sqrt(9.81 * 2 * np.pi / np.array([wave.wavelength for wave in waves])))
    wp_, w = 2 * np.pi / 5.0, np.linspace(0.3, 8.0, 200_001)
    density = w**-5.0 * np.exp(-1.25 * (wp_ / w) ** 4)
    if spectrum == "jonswap":
        sigma = np.where(w <= wp_, 0.07, 0.09)
        density *= 3.3 ** np.exp(-((w / wp_ - 1) ** 2) / (2 * sigma**2))
    inside = (w > 0.4 * wp_) & (w < 4.0 * wp_)
    assert density[inside].sum() / density.sum() > 0.994  # energy beyond the cut
    energy = np.cumsum(density * inside)
    np.testing.assert_allclose(
        np.interp(omega, w, energy / energy[-1]), (np.arange(200) + 0.5) / 200, atol=0.004
    )
    heading = np.array([wave.heading for wave in waves])
    mean = np.mean(np.exp(1j * heading))
    assert np.angle(mean) == pytest.approx(0.7, abs=1e-3)
    assert math.sqrt(2.0 * (1.0 - abs(mean))) == pytest.approx(0.4, rel=0.01)


def test_the_surface_of_a_sea_has_its_significant_height():
    """It is four standard deviations of the elevation over 20 minutes, within the statistical error of 24
    components."""
    arrays = arrays_of(
        Water(waves=SeaState(spectrum="jonswap", height=0.5, period=4.0, spread=0.3), depth=20.0)
    )
    heights = [flow_here(arrays, [(0.0, 0.0, 0.0)], t)["elevation"][0] for t in np.arange(0.0, 1200.0, 1.3)]
    assert 4.0 * np.std(heights) == pytest.approx(0.5, rel=0.05)


def test_pierson_moskowitz_is_jonswap_without_its_peak():
    one = sea_bands("jonswap", 1.0, 0.0, 30)[0]
    np.testing.assert_allclose(one, sea_bands("pierson-moskowitz", 3.3, 0.0, 30)[0], rtol=1e-12)


def test_a_sea_that_breaks_or_is_not_possible_is_refused():
    for change, sentence in (
        ({"height": 6.0}, "a height of 6 m with a period of 4 s breaks"),
        ({"height": 0.0}, "height is 0.0 m"),
        ({"spread": 2.0}, "spread is 2.0 rad"),
        ({"components": 0}, "0 components"),
        ({"period": -1.0}, "period is -1.0 s"),
    ):
        values = {"spectrum": "jonswap", "height": 0.5, "period": 4.0, "components": 6} | change
        with pytest.raises(SurroundingsError, match=sentence):
            Water(waves=SeaState(**values), depth=20.0)


def test_a_water_file_finds_its_table_and_refuses_unknown_words(table, tmp_path):
    path = tmp_path / "sub" / "water.yaml"
    path.parent.mkdir()
    path.write_text(
        "current: ../profile.csv\ndepth: 20.0\nwaves: {spectrum: jonswap, height: 0.3, period: 3.5}\n"
    )
    water = load_water(path)
    assert water.profile.depths == (0.0, 5.0, 20.0) and len(water.components) == 24 and water.moving
    path.write_text("curent: profile.csv\n")
    with pytest.raises(SurroundingsError, match=r"water.yaml: curent: unknown key, did you mean .current"):
        load_water(path)
    path.write_text("waves: {spectrum: jonswap, hight: 0.3, height: 1.0, period: 3.5}\n")
    with pytest.raises(SurroundingsError, match=r"hight: unknown key"):
        load_water(path)
    plant = tmp_path / "plant.yaml"
    plant.write_text("water: {current: profile.csv, depth: 20.0}\n")
    assert load_plant(plant).water.profile == water.profile
    plant.write_text("water: {current: nowhere.csv}\n")
    with pytest.raises((PlantError, SurroundingsError), match=r"nowhere.csv: cannot be read"):
        load_plant(plant)


def drawn(ranges, water, worlds=200):
    randomization = Randomization(Ranges.model_validate({"name": "r", **ranges}))
    simulator = Simulator("finsrov", worlds=worlds, water=water, **randomization.simulator_arguments(0.1))
    draws = randomization.draws(simulator)
    pipeline = simulator.pipeline()
    draws.add(pipeline, wp.ones(worlds, dtype=wp.int32, device="cpu"), 3)
    pipeline.run()
    return simulator, draws


def test_a_drawn_sea_is_on_the_dispersion_relation_with_its_height_and_period():
    ranges = {"waves": {"spectrum": "jonswap", "height": [0.1, 0.4], "period": [3.0, 5.0], "spread": 0.3}}
    simulator, draws = drawn(ranges, Water(depth=8.0))
    height, period, heading = draws.numpy(["sea.height", "sea.period", "sea.heading"])[:, 0].T
    water = simulator.water
    amplitude, k, omega, angle = (
        getattr(water, f"wave_{name}").numpy() for name in ("amplitude", "number", "frequency", "heading")
    )
    assert 0.1 <= height.min() < 0.12 and 0.38 < height.max() <= 0.4 and np.ptp(heading) > 6.0
    np.testing.assert_allclose(np.sum(amplitude**2, axis=1) / 2, height**2 / 16, rtol=1e-5)
    ratios, turns = sea_bands("jonswap", 3.3, 0.3, 8)
    expected = ratios * 2 * np.pi / period[:, None]
    np.testing.assert_allclose(omega, expected, rtol=2e-5)
    np.testing.assert_allclose(k, wave_number(expected, 8.0), rtol=1e-4)
    np.testing.assert_allclose(
        np.sort(angle - heading[:, None], axis=1), np.tile(np.sort(turns), (200, 1)), atol=1e-5
    )


def test_a_drawn_profile_is_the_given_one_scaled_and_turned():
    profile = CurrentProfile(depths=(0.0, 10.0), velocities=(((0.2, 0.0, 0.0), (0.0, 0.1, 0.0)),))
    ranges = {"current_profile": {"scale": [0.5, 1.5], "turn": [-3.0, 3.0]}}
    simulator, draws = drawn(ranges, Water(current=profile, depth=20.0), worlds=5)
    for w, (scale, turn) in enumerate(draws.numpy(["current_profile.scale", "current_profile.turn"])[:, 0]):
        R = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        found = flow_here(simulator.water, [(0, 0, 0), (0, 0, -10.0)], 0.0, w)["velocity"][:, :2]
        np.testing.assert_allclose(found, [R @ (0.2, 0.0), R @ (0.0, 0.1)], atol=1e-6)
    with pytest.raises(RangesError, match="the ranges draw current_profile, and the water has none"):
        drawn(ranges, Water())


def test_the_command_simulates_in_the_water_of_a_file(tmp_path, table):
    """The vehicle drifts east with the water, and the record beside the table names it."""
    (tmp_path / "water.yaml").write_text("current: profile.csv\ndepth: 30.0\n")
    out = tmp_path / "run.csv"
    water = tmp_path / "water.yaml"
    simulate(vehicle="finsrov", command="surge=0", duration=60.0, out=out, depth=1.0, water=water)
    rows = np.genfromtxt(out, delimiter=",", names=True)
    assert rows["x"][-1] > 5.0 and abs(rows["y"][-1]) < 2.0
    assert json.loads((tmp_path / "run.csv.json").read_text())["water"]["profile"]["depths"] == [
        0.0,
        5.0,
        20.0,
    ]


def test_a_training_is_in_the_water_of_a_file(tmp_path, table):
    (tmp_path / "water.yaml").write_text("current: profile.csv\ndepth: 30.0\n")
    task = task_named("t1")
    environment = TrainingSettings(water=tmp_path / "water.yaml").environment(task, 2, None, 1)
    assert environment.simulator.surroundings[0].profile.depths == (0.0, 5.0, 20.0)
    assert TrainingSettings().environment(task, 2, None, 1).simulator.surroundings[0].profile is None
