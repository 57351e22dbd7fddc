"""Every hand-written file has a closed vocabulary: an unknown key or word is refused by name."""

import copy
from pathlib import Path

import pytest
import yaml

from finssim import evaluation as experiments
from finssim import vehicles
from finssim.control.modes import action_mode, mode_from_dict
from finssim.control.policy import read_description
from finssim.control.trajectories import read_trajectory
from finssim.evaluation.plants import load_plant
from finssim.extensions import perception as worlds
from finssim.extensions.perception.description import load_world
from finssim.localization.camera_file import load_camera
from finssim.localization.overhead_camera import load_pool
from finssim.pool.drawn_plant import draw_plant
from finssim.pool.plant_spec import load_plant_spec
from finssim.robot.goals import station_of
from finssim.sim.ranges_file import SHIPPED, load_ranges
from finssim.studies.sweep import load_sweep
from finssim.survey.survey_file import load_survey_file
from finssim.tasks.sensing import load_sensing
from finssim.trials.importers.column_map import read_map
from finssim.trials.trial_files import read_header
from finssim.vehicles import load_vehicle
from finssim.vehicles.device_files import DEVICES, load_device

VEHICLES = Path(vehicles.__file__).parent / "catalogue"
WORLDS = Path(worlds.__file__).parent
PLANTS = Path(experiments.__file__).parent / "plants"

LENS = "{width: 640, height: 480, fx: 400, cx: 320, cy: 240, model: fisheye, distortion: [0.1, 0, 0, 0]}"
POLICY = f"""
format: 1
task: t1
observation: {{size: 1, entries: [{{name: depth, indices: [0], unit: m, scale: 2.0}}]}}
action: {action_mode("wrench4", load_vehicle("finsrov")).describe()}
control_period: 0.1
vehicle: {{name: finsrov, sha256: abab}}
hydrodynamics: calibrated
seed: 42
"""
FREE = {"about", "source", "note", "description", "name", "title", "license", "license_url", "camera_name"}
"""Keys whose values are free text."""
RECORDS = {"calibration", "calibrations", "training", "provenance"}
"""Sections in which a program records the origin of a file."""
LATER = {
    "map": {"vehicle", "column", "p", "value"},
    "trial": {"vehicle"},
    "plant of the pool": {"vehicle"},
    "vehicle": {"family"},
    "survey through a window": {"points"},
    "policy": {"task", "unit", "mode", "sha256", "hydrodynamics"},
}
"""Words that name something outside the file and are checked only when used."""


def policy(path):
    """Return the description of a policy, whose action mode is that of its vehicle."""
    mode_from_dict(read_description(path.parent).action, load_vehicle("finsrov"))


READERS = {
    "camera": (load_camera, f"lens: {LENS}\n", "camera.yaml"),
    "camera of ROS": (
        load_camera,
        "image_width: 640\nimage_height: 480\ncamera_name: pool\ncamera_matrix: {rows: 3, cols: 3, data: "
        "[400, 0, 320, 0, 400, 240, 0, 0, 1]}\ndistortion_model: equidistant\ndistortion_coefficients: {rows: 1, "
        "cols: 4, data: [0.1, 0, 0, 0]}\n",
        "camera.yaml",
    ),
    "pool": (
        load_pool,
        f"camera:\n  lens: {LENS}\n  position: [0, 0, 2]\n  orientation: [1, 0, 0, 0]\ninterface:\n  height: 1.0\n"
        "  window: [{thickness: 0.01, index: 1.5}]\nframes: {world: {position: [0, 0, 1]}}\n",
        "pool.yaml",
    ),
    "vehicle": (load_vehicle, VEHICLES / "finsrov.yaml", "own.yaml"),
    "site": (load_world, WORLDS / "catalogue" / "dock.yaml", "own.yaml"),
    "site with models": (load_world, WORLDS / "catalogue" / "wreck.yaml", "own.yaml"),
    "camera of a vehicle": (load_device, DEVICES / "low_light_camera.yaml", "own.yaml"),
    "sonar": (load_device, DEVICES / "oculus_m750d.yaml", "own.yaml"),
    "altimeter": (load_device, DEVICES / "ping.yaml", "own.yaml"),
    "map": (
        read_map,
        "vehicle: bluerov2_heavy\nsplit: {gaps: 2.0}\nfiles:\n  a.csv:\n    time: {column: t, unit: s, "
        "kind: counter, wrap: 256}\n    valid: [{column: status, value: OK}, {column: fom, below: 0.4}]\n"
        "    frame: {body: FRD, world: NED}\n"
        "    columns: {p: x, ax: {column: y, unit: g, valid: {column: z, above: 1}}}\n"
        "    phase: {column: mode, words: {run: excitation}}\nardusub: {velocity: ekf, imu: 0}\n"
        "trials: {one: {role: fit}}\n",
        "map.yaml",
    ),
    "trial": (
        read_header,
        "vehicle: finsrov\naxis: [surge]\nrole: fit\nacceleration: kinematic\nvelocity: water\n"
        "water: {density: 1000.0}\n",
        "trial.yaml",
    ),
    "survey": (
        load_survey_file,
        "grid: {first: 0, columns: 3, rows: 2, spacing: [0.1, 0.1], edge: 0.08, position: [0, 0, 0]}\nunit: mm\n"
        "tags: {family: tag36h11}\nsurface: {height: 1.0}\nwater: {index: 1.34}\ncamera: {latency: 0.1}\n"
        "fit: [pose, height]\n",
        "survey.yaml",
    ),
    "survey through a window": (
        load_survey_file,
        "points: survey.csv\nwindow: {thickness: 0.01, index: 1.52, plane: [0, 1, 0, 0]}\n",
        "survey.yaml",
    ),
    "points": (
        read_trajectory,
        "heading: tangent\npoints: [[0, 0, 0, -0.5], [10, 1, 0, -0.5]]\n",
        "way.yaml",
    ),
    "shape": (
        read_trajectory,
        "heading: tangent\nshape: {kind: circle, radius: 0.5, turns: 1, duration: 40, depth: -0.4}\n",
        "lap.yaml",
    ),
    "goal": (lambda path: station_of(str(path)), "goal: [0.5, 0, -0.5, 90]\n", "goal.yaml"),
    "observe": (load_sensing, "rate: 1.0\nfixes: {position_std: 0.2}\n", "site.yaml"),
    "ranges": (load_ranges, SHIPPED / "pool.yaml", "ranges.yaml"),
    "plant": (load_plant, PLANTS / "sensors.yaml", "plant.yaml"),
    "plant with waves": (load_plant, PLANTS / "waves.yaml", "plant.yaml"),
    "plant of the pool": (load_plant_spec, None, "plant.yaml"),
    "policy": (policy, POLICY, "policy.yaml"),
    "sweep": (
        load_sweep,
        "task: t1\nseeds: [1]\ntrain: {steps: 1, worlds: 16}\ngrid: {steps: [2]}\n"
        "evaluate: {plants: [nominal], trials: 1}\n",
        "sweep.yaml",
    ),
}


def places(tree, path=(), done=None):
    """Return the paths of the mappings in a tree that are not records, one for each set of keys."""
    done = set() if done is None else done
    if isinstance(tree, dict) and frozenset(tree) not in done:
        done.add(frozenset(tree))
        yield path
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
        if isinstance(value, dict | list) and key not in RECORDS:
            yield from places(value, (*path, key), done)


def words(tree, path=(), done=None):
    """Return the paths of the words that have a meaning, each once."""
    done = set() if done is None else done
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
        if isinstance(value, dict | list) and key not in RECORDS:
            yield from words(value, (*path, key), done)
        elif isinstance(value, str) and key not in FREE | RECORDS and (key, value) not in done:
            done.add((key, value))
            yield (*path, key)


def changed(tree, path, key, value):
    """Return a copy of the tree with one value set."""
    tree = copy.deepcopy(tree)
    here = tree
    for step in path:
        here = here[step]
    here[key] = value
    return tree


def refusal(read, path, tree):
    path.write_text(yaml.safe_dump(tree, sort_keys=False))
    try:
        read(path)
    except ValueError as error:
        return str(error)
    return None


LONG = {"site", "site with models", "vehicle", "plant of the pool"}


@pytest.fixture(
    params=[pytest.param(name, marks=pytest.mark.slow if name in LONG else ()) for name in READERS]
)
def reader(request, tmp_path):
    read, source, name = READERS[request.param]
    path = tmp_path / name
    if source is None:
        draw_plant(load_vehicle("finsrov"), 1).write(path)
    text = path.read_text() if source is None else source if isinstance(source, str) else source.read_text()
    for file in source.parent.glob("*.stl") if isinstance(source, Path) else ():
        (tmp_path / file.name).symlink_to(file)
    tree = yaml.safe_load(text)
    assert refusal(read, path, tree) is None
    return read, path, tree, LATER.get(request.param, set())


def test_an_unknown_key_is_refused_by_name(reader):
    """A key with a digit appended is known, or named in the refusal, in any section of any file."""
    read, path, tree, _ = reader
    missed = []
    for place in places(tree):
        sentence = refusal(read, path, changed(tree, place, "turboness", 1.5))
        if sentence is None or "turboness" not in sentence:
            missed.append((place, sentence))
    assert not missed


def test_an_unknown_word_is_refused_by_name(reader):
    """A word that selects something is known, or named in the refusal."""
    read, path, tree, later = reader
    missed = []
    for *place, key in words(tree):
        if key in later:
            continue
        sentence = refusal(read, path, changed(tree, place, key, "turbo_model"))
        if sentence is None or "turbo_model" not in sentence:
            missed.append((*place, key, sentence))
    assert not missed
