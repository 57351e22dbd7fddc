"""Ranges files: those that ship load, those that cannot be are refused in one sentence."""

from __future__ import annotations

from pathlib import Path

import pytest

from finssim.engine.ranges_file import Ranges, RangesError, available, load_ranges
from finssim.experiments.plants import PlantError, load_plant
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
    "words": (b"hello\n", "found a str"),
    "empty": (b"", "found nothing"),
}


@pytest.mark.parametrize("case", FILES)
@pytest.mark.parametrize("reader", READERS)
def test_what_is_no_yaml_mapping_gets_the_same_sentence_from_every_reader(reader, case, tmp_path):
    """Ranges, plants and vehicles are read by one reader."""
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


def written(tmp_path: Path, text: str, name: str = "ranges.yaml") -> Path:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path
