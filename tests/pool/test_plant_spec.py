"""A plant's file determines the plant, and an unphysical file is refused in one sentence."""

import pytest
import yaml

from finssim.pool import PlantSpecError, draw_plant, load_plant_spec
from finssim.vehicles import load_vehicle

FINSROV = load_vehicle("finsrov")
SPEC = draw_plant(FINSROV, 5, "hard")


def test_a_file_read_again_is_the_same_plant(tmp_path):
    """Every number survives exactly."""
    SPEC.write(tmp_path / "plant.yaml")
    assert load_plant_spec(tmp_path / "plant.yaml") == SPEC


def changed(tmp_path, path, value):
    """Return a plant file with one value changed."""
    data = SPEC.model_dump(mode="json")
    section = data
    *way, last = path
    for key in way:
        section = section[key]
    section[last] = value
    file = tmp_path / "plant.yaml"
    file.write_text(yaml.safe_dump(data), encoding="utf-8")
    return file


@pytest.mark.parametrize(
    ("path", "value", "says"),
    [
        (("added_mass", "matrix", 0, 1), 3.0, "not symmetric"),
        (("added_mass", "matrix", 5, 5), -1.0, "negative eigenvalue"),
        (("damping", "linear", 2, 2), -5.0, "adds energy"),
        (("damping", "quadratic", 0, 5), 50.0, "may add energy"),
        (("body", "mass"), -1.0, "body.mass"),
        (("body", "mass"), float("nan"), "body.mass"),
        (("battery", "volts"), 12.0, "battery.volts"),
        (("buoyancy", "periods"), [100.0], "differ in length"),
        (("firmware", "uplink"), [0.003, 0.001], "shortest time first"),
        (("severity",), "gentle", "severity"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path, path, value, says):
    """The message names the file and the key or the reason."""
    with pytest.raises(PlantSpecError, match=says) as refusal:
        load_plant_spec(changed(tmp_path, path, value))
    assert "plant.yaml" in str(refusal.value) and "\n" not in str(refusal.value)
