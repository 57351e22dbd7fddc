"""Defaults of the sections that a vehicle file omits."""

from __future__ import annotations

import io
import math
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from finssim.core.rotations import quat_to_matrix
from finssim.identification.vehicle_file import write_vehicle
from finssim.pool.camera import camera_of
from finssim.pool.drawn_plant import draw_plant
from finssim.pool.plant_spec import Basin, basin_of
from finssim.vehicles import VehicleError, catalogue, load_vehicle
from finssim.vehicles.defaults import DEFAULTS
from finssim.vehicles.show import print_vehicle


@pytest.mark.parametrize("name", catalogue())
def test_tags_lie_on_the_top_and_face_up(name):
    """Two tags with separate margins lie on the envelope, printed side up."""
    vehicle = load_vehicle(name)
    tags, half = vehicle.tags, 0.5 * vehicle.body.size
    first, second = (np.asarray(mount.position) for mount in tags.mounts.values())
    assert np.linalg.norm(first - second) > 9.0 / 7.0 * tags.edge
    for mount in tags.mounts.values():
        np.testing.assert_allclose(quat_to_matrix(mount.orientation)[:, 2], [0.0, 0.0, 1.0], atol=1e-7)
        if "tags" in vehicle.defaults:
            place = np.asarray(mount.position) - vehicle.body.center_of_buoyancy
            assert place[2] == pytest.approx(half[2])
            assert np.all(np.abs(place[:2]) + 0.5 * tags.edge <= half[:2])


@pytest.mark.parametrize(
    "name", [name for name in catalogue() if name not in ("eca_a9", "lauv", "remus100", "slocum", "torpedo")]
)
def test_every_vehicle_that_hovers_has_a_pool(name):
    """It has a plant and a camera, a basin that fits the hull, and a workspace as large as the basin."""
    vehicle = load_vehicle(name)
    spec = draw_plant(vehicle, 1, "realistic")
    camera_of(vehicle, 1, "realistic")
    assert min(spec.basin.width, spec.basin.length) > 2.0 * math.hypot(*vehicle.body.size[:2])
    assert spec.basin == basin_of(vehicle)
    if "safety" in vehicle.defaults:
        np.testing.assert_allclose(
            vehicle.safety.workspace_upper[:2], [spec.basin.length / 2, spec.basin.width / 2]
        )
        assert vehicle.safety.workspace_lower[2] == -spec.basin.depth


def test_the_published_vehicle_has_the_published_pool():
    """FinsROV's file defines everything, with its pool of 4 m x 2 m x 1 m."""
    vehicle = load_vehicle("finsrov")
    assert vehicle.defaults == ("perception",) and basin_of(vehicle) == Basin()


def test_defaults_are_no_part_of_the_digest_or_the_file(tmp_path):
    """A vehicle written and read again has the same defaults and digest; its file has no default section."""
    vehicle = load_vehicle("rexrov")
    assert vehicle.defaults == tuple(DEFAULTS)
    write_vehicle(vehicle, tmp_path / "copy.yaml")
    again = load_vehicle(tmp_path / "copy.yaml")
    assert again.sha256 == vehicle.sha256 and again.defaults == vehicle.defaults
    assert again.tags == vehicle.tags and again.mcu == vehicle.mcu


def test_one_number_of_a_default_can_be_changed():
    """The rest of the section keeps its defaults and belongs to the vehicle."""
    vehicle = load_vehicle("bluerov2_heavy")
    changed = vehicle.replace({"safety.max_tilt": 0.5, "tags.edge": 0.05})
    assert changed.safety.max_tilt == 0.5 and changed.safety.command_rate == vehicle.safety.command_rate
    assert changed.tags.mounts.keys() == vehicle.tags.mounts.keys() and changed.tags.edge == 0.05
    assert changed.defaults == ("perception", "mcu") and changed.file_tags is changed.tags


def test_tags_can_be_taken_off(tmp_path):
    """`tags: null` gives a vehicle without tags, and a real camera may not look for default ones."""
    (tmp_path / "bare.yaml").write_text("extends: bluerov2\ntags: null\n", encoding="utf-8")
    assert load_vehicle(tmp_path / "bare.yaml").tags is None
    assert load_vehicle("bluerov2").file_tags is None


def test_show_says_which_sections_are_defaults():
    """Each is shown with its default, and no other section is."""
    for name, said in (("bluerov2_heavy", True), ("finsrov", False)):
        console = Console(record=True, width=200, file=io.StringIO())
        print_vehicle(load_vehicle(name), console)
        text = console.export_text()
        assert "Defaults" in text and ("15 ahead" in text) is said and "altimeter under the hull" in text


def test_sensors_of_a_site_are_listed_once_a_file_gives_them(tmp_path):
    """They replace the default's names; a sensor's own file lies beside the vehicle's and is copied with it."""
    device = "kind: range\nabout: a\nsource: s\nminimum_range: 0.1\nrange: 5.0\nrate: 4.0\n"
    (tmp_path / "short.yaml").write_text(device, encoding="utf-8")
    entry = (
        "perception:\n  origin: guessed\n  down: {device: short.yaml, position: [0, 0, -0.1], rate: 5.0}\n"
    )
    (tmp_path / "mine.yaml").write_text("extends: bluerov2\n" + entry, encoding="utf-8")
    vehicle = load_vehicle(tmp_path / "mine.yaml")
    console = Console(record=True, width=200, file=io.StringIO())
    print_vehicle(vehicle, console)
    assert "short.yaml" in console.export_text() and list(vehicle.perception) == ["down"]
    (tmp_path / "there").mkdir()
    write_vehicle(vehicle, tmp_path / "there" / "copy.yaml")
    copy = load_vehicle(tmp_path / "there" / "copy.yaml")
    assert copy.sha256 == vehicle.sha256 != load_vehicle("bluerov2").sha256
    assert Path(copy.perception["down"].device).parent == tmp_path / "there"
    (tmp_path / "short.yaml").write_text(device.replace("5.0", "6.0"), encoding="utf-8")
    assert load_vehicle(tmp_path / "mine.yaml").sha256 != vehicle.sha256


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("down: {device: other.yaml, position: [0, 0, 0], rate: 5.0}", "perception.down: no file other.yaml"),
        ("down: {device: ping, position: [0, 0], rate: 5.0}", "perception.down: position has shape"),
        ("down: {device: ping, rate: 5.0}", "perception.down: position is missing"),
        ("Down: {device: ping, position: [0, 0, 0], rate: 5.0}", "'Down' is no name of a sensor"),
        ("dvl: {device: ping, position: [0, 0, 0], rate: 5.0}", "'dvl' is already used by another part"),
    ],
)
def test_a_sensor_that_cannot_be_is_refused(tmp_path, entry, message):
    """The refusal is one sentence that names the entry."""
    text = f"extends: bluerov2\nperception:\n  origin: guessed\n  {entry}\n"
    (tmp_path / "mine.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(VehicleError, match=message):
        load_vehicle(tmp_path / "mine.yaml")
