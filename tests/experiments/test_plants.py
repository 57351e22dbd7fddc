"""Plants: those that ship mean what they say, a file's mistakes get their sentence."""

import math

import numpy as np
import pytest

from finssim.experiments.plants import Plant, PlantError, available_plants, load_plant
from finssim.vehicles import VehicleError, load_vehicle

FINSROV = load_vehicle("finsrov")


def test_the_plants_of_the_protocol_ship():
    """Nominal, randomised, current, waves, noise, lag, and the other two models."""
    expected = ["current", "lag", "mesh", "noise", "nominal", "randomised", "simplified", "waves"]
    assert available_plants() == expected
    assert all(load_plant(name).title for name in expected)


def test_nominal_changes_nothing():
    plant = load_plant("nominal")
    assert plant.changed(FINSROV) is FINSROV
    assert set(plant.environment_arguments().values()) == {None}


def test_the_noise_is_the_papers():
    """5 cm per axis and 10° of yaw."""
    noise = load_plant("noise").environment_arguments()["noise"]
    assert noise.position_std == 0.05 and noise.yaw_std == pytest.approx(math.radians(10.0))


def test_the_current_is_ten_centimetres_per_second():
    ranges = load_plant("current").environment_arguments()["randomization"].ranges
    assert ranges.current == (0.10, 0.10)


def test_lag_is_added_to_every_thruster():
    changed = Plant(name="slow", extra_time_constant=0.1, extra_delay=0.02).changed(FINSROV)
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
        Plant(name="x", vehicle={"body.weight": 1.0}).changed(FINSROV)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("currant: 1", "plant.yaml: currant: Extra inputs are not permitted"),
        ("ranges: hold", "plant.yaml: ranges: no ranges 'hold'"),
        ("ranges: {mass: [2, 1]}", "plant.yaml: ranges.*name"),
        ("water: {current: [0.1, 0]}", "water: current is .* expected finite numbers"),
        ("water: {flow: 1}", "water: unknown key 'flow'; available: current"),
        ("water: {waves: 3}", "waves: expected a list"),
        ("water: {waves: [{amplitude: 1, wavelength: 2}]}", "a linear wave breaks"),
        ("water: {waves: [{amplitude: 0.1}]}", "missing 1 required keyword-only argument: 'wavelength'"),
        ("noise: {position_std: .nan}", "noise"),
        ("noise: {yaw: 1}", "noise: unknown key 'yaw'; available: position_std"),
        ("extra_delay: -1", "extra_delay: Input should be greater than or equal to 0"),
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


def test_an_unknown_plant_is_told_the_nearest():
    with pytest.raises(PlantError, match="no plant 'nominel'.*did you mean 'nominal'"):
        load_plant("nominel")
