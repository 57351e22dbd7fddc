"""The examples on the pages work: their Python runs, their vehicle loads, and the strict build passes."""

import ast
import json
import re
import runpy
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from finssim.core.optics import Interface
from finssim.core.registry import FAMILIES
from finssim.evaluation.plants import load_plant
from finssim.extensions.perception import load_world
from finssim.localization.camera_file import write_camera
from finssim.localization.overhead_camera import load_pool
from finssim.sim.ranges_file import load_ranges
from finssim.studies.sweep import load_sweep
from finssim.survey.pool import run
from finssim.tasks.sensing import load_sensing
from finssim.trials.importers.dispatch import read_trials
from finssim.vehicles import VehicleError, load_vehicle
from finssim.vehicles.check import check_vehicle

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted((ROOT / "docs").rglob("*.md"))


def blocks(page: Path, language: str) -> list[str]:
    """Return the fenced code of one language, in the page's order."""
    text = page.read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [page for page in PAGES if blocks(page, "python")], ids=lambda page: page.stem
)
def test_python_on_a_page_runs(page, tmp_path, monkeypatch):
    """The Python blocks of a page run one after the other, as a reader would try them."""
    (tmp_path / "page.py").write_text("\n".join(blocks(page, "python")), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    try:
        runpy.run_path("page.py", run_name="__main__")
    finally:
        for family in FAMILIES:  # a page adds a task
            for name, package in family.packages().items():
                if package == "this program":
                    del family[name]


def test_the_vehicle_on_the_page_loads(tmp_path):
    """The example vehicle loads, and a wrong axis in it gives the error that the page shows."""
    example, actuators = blocks(ROOT / "docs" / "reference" / "vehicle_file.md", "yaml")
    (tmp_path / "minnow.yaml").write_text(example, encoding="utf-8")
    assert load_vehicle(tmp_path / "minnow.yaml").thruster_names == ("left", "right")
    (tmp_path / "minnow.yaml").write_text(example.replace("[1, 0, 0]", "[0.94, 0, 0]", 1), encoding="utf-8")
    with pytest.raises(VehicleError) as refused:
        load_vehicle(tmp_path / "minnow.yaml")
    shown = "minnow.yaml: thrusters.left: axis has length 0.94, expected 1: give a body-frame unit vector"
    assert str(refused.value).endswith(shown)
    assert shown in (ROOT / "docs" / "reference" / "vehicle_file.md").read_text(encoding="utf-8")
    head = "extends: remus100\norigin: guessed\nthrusters: {propeller: {diameter: 0.14}}\n"
    (tmp_path / "torpedo.yaml").write_text(head + actuators, encoding="utf-8")
    names = set(load_vehicle(tmp_path / "torpedo.yaml").actuators)
    assert names >= {"rudder", "tank", "battery", "nozzle"}


def test_the_sensing_the_sweep_and_the_plant_on_the_pages_load(tmp_path):
    """The commands accept the example files of the learning and evaluation pages."""
    sensing, sweep = blocks(ROOT / "docs" / "learning.md", "yaml")
    (plant,) = blocks(ROOT / "docs" / "evaluation.md", "yaml")
    for example, load in (
        (sensing, load_sensing), (plant, load_plant), (sweep, load_sweep),
    ):  # fmt: skip
        (tmp_path / "example.yaml").write_text(example, encoding="utf-8")
        load(tmp_path / "example.yaml")


def test_the_pools_on_the_page_load(tmp_path):
    """The commands accept the full pool file and the shortest one."""
    full, shortest = blocks(ROOT / "docs" / "reference" / "pool_file.md", "yaml")
    for example, height in ((full, 0.96), (shortest, 1.0)):
        (tmp_path / "pool.yaml").write_text(example, encoding="utf-8")
        assert load_pool(tmp_path / "pool.yaml").interface.height(0.0, 0.0) == pytest.approx(height)


@pytest.mark.slow
def test_the_survey_on_the_page_calibrates_a_pool(tmp_path, monkeypatch):
    """The survey file of the page, with a survey of the published pool in millimetres, locates the camera to 15 mm."""
    from survey.surveyed_pools import FLOOR, PLUMB_BOB, overhead, survey

    monkeypatch.chdir(tmp_path)
    (example,) = blocks(ROOT / "docs" / "reference" / "survey_file.md", "yaml")
    Path("survey.yaml").write_text(example, encoding="utf-8")
    write_camera("camera.yaml", PLUMB_BOB, {})
    seen = survey(overhead(), Interface.water(1.02), FLOOR, 30)
    for name, header, rows in (
        ("points.csv", "id,x,y", 1000.0 * seen.points[:, :2]), ("pixels.csv", "id,u,v", seen.pixels),
    ):  # fmt: skip
        lines = [f"{label},{a},{b}" for label, (a, b) in zip(seen.names, rows, strict=True)]
        Path(name).write_text("\n".join([header, *lines]), encoding="utf-8")
    fit = run(
        [Path("pixels.csv")], survey=Path("survey.yaml"), camera=Path("camera.yaml"), out=Path("pool.yaml")
    )
    assert np.linalg.norm(fit.model.camera.position - overhead().position) < 0.015
    assert load_pool("pool.yaml").latency == 0.045


def test_the_rov_on_the_page_is_sound_and_its_log_is_read(tmp_path, monkeypatch):
    """The vehicle of the one-hour tutorial loads and passes its checks, its truth extends it, and its map
    reads its log."""
    page = ROOT / "docs" / "own_rov.md"
    monkeypatch.chdir(tmp_path)
    for name, example in zip(("minnow.yaml", "log.yaml", "water.yaml"), blocks(page, "yaml"), strict=True):
        Path(name).write_text(example, encoding="utf-8")
    assert Path("minnow.yaml").read_text() == (ROOT / "examples/own/vehicle/minnow.yaml").read_text()
    (log,) = blocks(page, "text")
    Path("dive_surge.csv").write_text(log, encoding="utf-8")
    assert [found.sentence for found in check_vehicle(load_vehicle("minnow.yaml")) if not found.passed] == []
    assert load_vehicle("water.yaml").thruster_names == load_vehicle("minnow.yaml").thruster_names
    (trial,) = read_trials([Path("dive_surge.csv")], column_map=Path("log.yaml"))
    assert trial.channels["v"][0] == -0.0067 and trial.channels["rpm_back_right"][1] == 835.0


def test_the_world_on_the_page_loads(tmp_path):
    """The example file is a valid world, with its mooring and moving bodies."""
    example, *_ = blocks(ROOT / "docs" / "worlds.md", "yaml")
    (tmp_path / "buoy.yaml").write_text(example, encoding="utf-8")
    assert load_world(tmp_path / "buoy.yaml").objects["buoy"].frame == "mooring"


def test_every_range_of_the_section_on_randomisation_loads(tmp_path):
    """Complete files load; the schedules, of which a file has one, load line by line."""
    path = tmp_path / "ranges.yaml"
    *_, first, tied, schedules = blocks(ROOT / "docs" / "reference" / "ranges.md", "yaml")
    for example in (first, tied, *(f"mass: [0.9, 1.1]\n{line}" for line in schedules.splitlines())):
        path.write_text(example, encoding="utf-8")
        load_ranges(path)


@pytest.mark.slow
def test_pages_build_without_a_warning(tmp_path):
    """Every link between pages leads to an existing page and heading."""
    mkdocs = "import gc; gc.disable(); from mkdocs.__main__ import cli; cli()"  # collection takes a fifth of the time
    words = ["build", "--strict", "--quiet", "--site-dir", tmp_path / "site"]
    run = subprocess.run([sys.executable, "-c", mkdocs, *words], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


def test_a_page_about_a_package_begins_with_what_to_call_first():
    """A page about a package names the first call, then uses it in a few lines, which run with its other Python."""
    pages = {page: page.read_text(encoding="utf-8") for page in PAGES}
    of_packages = {page: text.partition("\n::: ")[0] for page, text in pages.items() if "\n::: " in text}
    assert len(of_packages) > 15
    assert [page.name for page, head in of_packages.items() if "**Call first:** " not in head] == []
    assert [page.name for page, head in of_packages.items() if "```python" not in head] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_files_that_a_page_names_exist(page):
    """Tests and sources that a page names by path exist."""
    named = re.findall(r"`((?:tests|src|examples|finssim)/[\w./]+)`", page.read_text(encoding="utf-8"))
    missing = [name for name in named if not (ROOT / name).exists() and not (ROOT / "src" / name).exists()]
    assert missing == []


def texts() -> dict[Path, str]:
    """Return the Python code of every page, example and notebook by its file."""
    found = {page: "\n".join(blocks(page, "py(?:thon)?")) for page in [*PAGES, ROOT / "README.md"]}
    found |= {file: file.read_text(encoding="utf-8") for file in (ROOT / "examples").rglob("*.py")}
    for file in (ROOT / "examples").rglob("*.ipynb"):
        cells = json.loads(file.read_text(encoding="utf-8"))["cells"]
        lines = [line for cell in cells if cell["cell_type"] == "code" for line in [*cell["source"], "\n"]]
        found[file] = "".join(line for line in lines if not line.startswith("%"))
    return found


def imports_of(text: str) -> set[tuple[str, str]]:
    """Return the FinsSim modules that Python code imports, with the imported names; "" for the module itself."""
    names = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names |= {(alias.name, "") for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {(str(node.module), alias.name) for alias in node.names}
    return {(module, name) for module, name in names if module.partition(".")[0] == "finssim"}


def test_pages_and_examples_import_from_finssim_or_one_of_its_packages():
    """Readers use the names that packages export, so that the defining modules may change."""
    deeper, unknown = set(), set()
    for file, text in texts().items():
        for module, name in imports_of(text):
            about = (file.relative_to(ROOT).as_posix(), module, name)
            if module.count(".") > (2 if module.startswith("finssim.extensions.") else 1):
                deeper.add(about)
            folder = ROOT / "src" / module.replace(".", "/")
            modules = {path.stem for path in folder.glob("*.py")} | {
                path.parent.name for path in folder.glob("*/__init__.py")
            }
            if name not in {"", *modules, *import_module(module).__all__}:
                unknown.add(about)
    assert not deeper and not unknown
