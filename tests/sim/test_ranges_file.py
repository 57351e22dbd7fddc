"""Ranges files: the packaged ones load, and invalid ones are refused in one sentence."""

from __future__ import annotations

from pathlib import Path

import pytest

from finssim.evaluation.plants import PlantError, load_plant
from finssim.sim.ranges_file import Ranges, RangesError, available, load_ranges
from finssim.vehicles import VehicleError, load_vehicle

READERS = {
    "ranges": (load_ranges, RangesError),
    "plant": (load_plant, PlantError),
    "vehicle": (load_vehicle, VehicleError),
}

FILES = {
    "binary": (b"\xff\xd8\xff\xe0\x00\x10JFIF", "is not a text file in UTF-8: give a YAML file"),
    "control characters": (b"mass: \x00\x01", "is not a text file in UTF-8: give a YAML file"),
    "bracket open": (b"title: x\nmass: [1, 2\n", "line 3: not valid YAML: "),
    "unknown tag": (b"title: x\nmass: !kg 2\n", "line 2: not valid YAML: "),
    "key twice": (b"title: x\ntitle: y\n", "line 2: not valid YAML: key 'title' is given twice"),
    "list": (b"- 1\n", "found a list"),
    "words": (b"hello\n", "found plain text"),
    "empty": (b"", "found nothing"),
}


@pytest.mark.parametrize("case", FILES)
@pytest.mark.parametrize("reader", READERS)
def test_what_is_no_yaml_mapping_gets_the_same_sentence_from_every_reader(reader, case, tmp_path):
    """One reader serves ranges, plants and vehicles."""
    (load, error), (content, sentence) = READERS[reader], FILES[case]
    path = tmp_path / "file.yaml"
    path.write_bytes(content)
    with pytest.raises(error) as caught:
        load(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert sentence in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("reader", READERS)
def test_a_missing_file_is_refused(reader, tmp_path):
    load, error = READERS[reader]
    with pytest.raises(error, match=r"gone\.yaml"):
        load(tmp_path / "gone.yaml")


@pytest.mark.parametrize("reader", ["ranges", "plant"])
def test_a_key_that_is_a_number_is_refused(reader, tmp_path):
    load, error = READERS[reader]
    with pytest.raises(error, match=r"file\.yaml: 1: "):
        load(written(tmp_path, "1: 2\n", "file.yaml"))


@pytest.mark.parametrize("name", available())
def test_ranges_that_ship_load(name):
    assert isinstance(load_ranges(name), Ranges)


WAVES = "waves: {{count: {}, amplitude: {}, wavelength: {}}}"
SMALL = ("[0, 0.03]", "[3, 8]")
COUNT = "expected two integers [low, high] with 0 <= low <= high <= 8"

IMPOSSIBLE = {
    "no mass": ("mass: [0, 0]", "mass: is [0.0, 0.0], expected numbers above 0"),
    "negative mass": ("mass: [-1, 1]", "mass: is [-1.0, 1.0], expected numbers above 0"),
    "no volume": ("volume: [0, 1]", "volume: is [0.0, 1.0], expected numbers above 0"),
    "volume reversed": ("volume: [2, 1]", "volume: is [2.0, 1.0], expected two finite numbers [low, high]"),
    "volume a word": (
        "volume: with_mas",
        "volume: is 'with_mas', expected two numbers [low, high] or with_mass",
    ),
    "no inertia": ("inertia: [0, 1]", "inertia: is [0.0, 1.0], expected numbers above 0"),
    "negative damping": (
        "linear_damping: {axes: {yaw: [-1, 1]}}",
        "linear_damping.axes.yaw: is [-1.0, 1.0], expected numbers of 0 or more",
    ),
    "count reversed": (WAVES.format("[3, 1]", *SMALL), f"waves.count: is [3, 1], {COUNT}"),
    "count negative": (WAVES.format("[-1, 1]", *SMALL), f"waves.count: is [-1, 1], {COUNT}"),
    "count of nine": (WAVES.format("[0, 9]", *SMALL), f"waves.count: is [0, 9], {COUNT}"),
    "no wavelength": (
        WAVES.format("[0, 1]", "[0, 0]", "[0, 0]"),
        "waves.wavelength: is [0.0, 0.0], expected numbers above 0",
    ),
    "wavelength infinite": (
        WAVES.format("[0, 1]", "[0, 0]", "[1, .inf]"),
        "waves.wavelength: is [1.0, inf], expected two finite numbers",
    ),
    "breaking": (
        WAVES.format("[0, 1]", "[0, 0.22]", "[3, 8]"),
        "waves: amplitude is [0.0, 0.22], expected less than 0.07 of the shortest wavelength, 0.21 m here",
    ),
}


@pytest.mark.parametrize("case", IMPOSSIBLE)
def test_what_cannot_be_drawn_is_refused(case, tmp_path):
    """The message names file, key, value and the expected value."""
    text, sentence = IMPOSSIBLE[case]
    path = written(tmp_path, text + "\n")
    with pytest.raises(RangesError) as caught:
        load_ranges(path)
    assert str(caught.value).startswith(f"{path}: {sentence}")


@pytest.mark.parametrize("count", ["[0, 0]", "[8, 8]"])
def test_waves_up_to_the_limits_are_read(count, tmp_path):
    text = WAVES.format(count, "[0, 0.2]", "[3, 3]") + "\nvolume: with_mass\n"
    ranges = load_ranges(written(tmp_path, text))
    assert ranges.waves.amplitude == (0.0, 0.2) and ranges.volume == "with_mass"


def written(tmp_path: Path, text: str, name: str = "ranges.yaml") -> Path:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path
