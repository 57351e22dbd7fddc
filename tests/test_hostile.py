"""A small sample of `benchmarks/hostile.py`: broken files are refused in a sentence or read, and no output remains."""

import importlib.util
import random
import shutil
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SPEC = importlib.util.spec_from_file_location("hostile", ROOT / "benchmarks" / "hostile.py")
sys.modules["hostile"] = hostile = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(hostile)

CASES = (
    ("vehicle.yaml", "vehicles show {}"),
    ("pool.yaml", "project SEEDS/points.csv --pool {}"),
    ("pool.yaml", "backproject SEEDS/pixels.csv --z 0 --pool {}"),
    ("points.csv", "project {} --pool SEEDS/pool.yaml"),
    ("pixels.csv", "backproject {} --z 0 --pool SEEDS/pool.yaml"),
    ("parameters.yaml", f"{hostile.PARAMETERS} {{}}"),
)
"""Files that can be made without a command, and commands that read them in milliseconds."""


@pytest.fixture(scope="module")
def seeds(tmp_path_factory):
    folder = tmp_path_factory.mktemp("seeds")
    for name, text in hostile.MADE.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    shutil.copyfile(hostile.FINSROV, folder / "vehicle.yaml")
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(("name", "command"), CASES)
def test_broken_files_are_read_or_refused(seeds, tmp_path, monkeypatch, capsys, name, command):
    """For fifteen inputs of each kind, the exit status is 0 or 2 whatever the content, and no other file appears."""
    monkeypatch.chdir(tmp_path)
    file, ends = tmp_path / name, set()
    for i in range(15):
        data, done = hostile.changed((seeds / name).read_bytes(), file.suffix, random.Random(f"{name} {i}"))
        file.write_bytes(data)
        end = hostile._run(hostile.words_of(command, file, tmp_path, seeds))
        assert end in (0, 2), (i, done, end)
        assert list(tmp_path.iterdir()) == [file] and file.read_bytes() == data, (i, done)
        ends.add(end)
    assert 2 in ends
    capsys.readouterr()
