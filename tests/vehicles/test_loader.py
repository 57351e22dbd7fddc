"""Files are loaded as vehicles or refused in one sentence with location, problem and remedy."""

from __future__ import annotations

import time
from pathlib import Path
from xml.etree.ElementTree import tostring

import numpy as np
import pytest

from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.core.mesh import parametric_hull, write_stl
from finssim.trials.trial_files import vehicle_reference
from finssim.vehicles import Vehicle, VehicleError, catalogue, load_vehicle
from finssim.vehicles.importers.draft import read_foreign
from finssim.vehicles.part import VehicleWarning, sentence_of
from reference.gz_sim import HEAVY, element, tree, write
from vehicles.minnow import MINNOW


def load(tmp_path: Path, text: str, name: str = "minnow.yaml") -> Vehicle:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return load_vehicle(path)


def refusal(tmp_path: Path, old: str, new: str) -> str:
    """Return the loader's message about the minnow with `old` replaced by `new`, after the file's name."""
    assert MINNOW.count(old) >= 1
    with pytest.raises(VehicleError) as caught:
        load(tmp_path, MINNOW.replace(old, new, 1))
    message = str(caught.value)
    assert message.startswith(str(tmp_path / "minnow.yaml") + ":")
    return message.removeprefix(str(tmp_path / "minnow.yaml") + ":").strip()


def test_a_file_of_ones_own_loads_by_path(tmp_path):
    vehicle = load(tmp_path, MINNOW)
    assert vehicle.name == "minnow"
    assert vehicle.thruster_names == ("front_left", "front_right", "up")
    np.testing.assert_array_equal(vehicle.body.inertia, np.diag([0.2, 0.3, 0.4]))


def test_numbers_of_the_group_reach_its_thrusters_and_own_numbers_win(tmp_path):
    vehicle = load(tmp_path, MINNOW)
    np.testing.assert_array_equal(vehicle.force_limits[0], [-4.0, -4.0, -4.0])
    np.testing.assert_array_equal(vehicle.force_limits[1], [5.0, 5.0, 6.0])


def test_every_number_knows_its_origin(tmp_path):
    vehicle = load(tmp_path, MINNOW)
    assert vehicle.origin_of("body.mass") == ("measured", "kitchen scale", "")
    assert vehicle.origin_of("hydrodynamics.calibrated.linear_damping.4").origin == "measured"
    assert vehicle.origin_of("hydrodynamics.calibrated.linear_damping.5") == ("guessed", "", "nobody spun it")
    assert vehicle.origin_of("thrusters.up.rpm_max").origin == "measured"
    with pytest.raises(VehicleError, match="no number at 'body.maas', did you mean 'body.mass'"):
        vehicle.origin_of("body.maas")


def test_a_new_origin_does_not_inherit_the_old_source(tmp_path):
    text = MINNOW.replace("mass: 11.2", "mass: {value: 11.2, origin: guessed}")
    assert load(tmp_path, text).origin_of("body.mass") == ("guessed", "", "")


def test_a_section_may_give_the_origin_of_everything_inside(tmp_path):
    text = MINNOW.replace("body:\n", "body:\n  origin: published\n  source: a book\n")
    vehicle = load(tmp_path, text)
    assert vehicle.origin_of("body.inertia") == ("published", "a book", "")
    assert vehicle.origin_of("water.density").origin == "measured"


def test_an_axis_in_four_digits_is_a_unit_vector(tmp_path):
    """cos 45° given as 0.7071 is scaled to length 1."""
    axis = load(tmp_path, MINNOW.replace("axis: [0, 0, 1]", "axis: [0, 0.7071, 0.7071]")).thrusters["up"].axis
    assert axis == pytest.approx([0.0, 0.5**0.5, 0.5**0.5], abs=1e-15)


def test_a_number_without_origin_is_refused(tmp_path):
    message = refusal(tmp_path, "origin: measured\nsource: kitchen scale\n", "")
    assert message.startswith("water: density has no origin: write {value: 1000.0, origin: measured")


REFUSALS = {
    "axis not of unit length": (
        "axis: [0, 0, 1]",
        "axis: [0, 0, 0.94]",
        "thrusters.up: axis has length 0.94, expected 1: give a body-frame unit vector",
    ),
    "axis of two numbers": (
        "axis: [0, 0, 1]",
        "axis: [0, 1]",
        "thrusters.up: axis has shape (2,), expected 3 numbers [x, y, z]",
    ),
    "nan without origin": (
        "origin: measured\nsource: kitchen scale\n\nwater: {density: 1000.0,",
        "water: {density: .nan,",
        "water: density is nan, expected a finite number",
    ),
    "infinity without origin": (
        "origin: measured\nsource: kitchen scale\n\nwater: {density: 1000.0,",
        "water: {density: -.inf,",
        "water: density is -inf, expected a finite number",
    ),
    "extends a number": (
        "title: Minnow",
        "title: Minnow\nextends: 5",
        "extends is 5, expected the name or path of a vehicle, such as finsrov",
    ),
    "list as a key": ("title: Minnow", "[a, b]: Minnow", "line 1: not valid YAML: "),
    "negative mass": ("mass: 11.2", "mass: -11.2", "body: mass is -11.2, expected > 0"),
    "mass not a number": ("mass: 11.2", "mass: heavy", "body: mass is 'heavy', expected a number"),
    "mass nan": ("mass: 11.2", "mass: .nan", "body: mass is nan, expected a finite number"),
    "infinite coordinate": (
        "center_of_gravity: [0.0, 0.0, -0.02]",
        "center_of_gravity: [0.0, .inf, 0.0]",
        "body: center_of_gravity contains inf, expected finite numbers: give 3 numbers [x, y, z]",
    ),
    "missing key": ("  mass: 11.2\n", "", "body: mass is missing: add it, with its origin"),
    "misspelt key": ("  mass: 11.2\n", "  mas: 11.2\n", "body: unknown key 'mas', did you mean 'mass'?"),
    "unknown key": (
        "title: Minnow",
        "title: Minnow\ncolour: red",
        "unknown key 'colour'; known keys: title,",
    ),
    "inertia of no body": (
        "inertia: [0.2, 0.3, 0.4]",
        "inertia: [0.1, 0.1, 0.4]",
        "body: inertia has principal moments 0.1, 0.1, 0.4 kg m², expected the largest to be at most the sum",
    ),
    "inertia not positive": (
        "inertia: [0.2, 0.3, 0.4]",
        "inertia: [-0.2, 0.3, 0.4]",
        "body: inertia has principal moments -0.2, 0.3, 0.4 kg m², expected all > 0",
    ),
    "added mass not symmetric": (
        "added_mass: [5, 6, 7, 0.1, 0.1, 0.1]",
        "added_mass: [[5,1,0,0,0,0],[0,6,0,0,0,0],[0,0,7,0,0,0],[0,0,0,1,0,0],[0,0,0,0,1,0],[0,0,0,0,0,1]]",
        "hydrodynamics.calibrated: added_mass has 1 at row 1, column 2 but 0 across the diagonal",
    ),
    "added mass too negative": (
        "added_mass: [5, 6, 7, 0.1, 0.1, 0.1]",
        "added_mass: [-12, 6, 7, 0.1, 0.1, 0.1]",
        "hydrodynamics.calibrated: added_mass makes M_RB + M_A not positive definite (smallest eigenvalue -",
    ),
    "damping of five numbers": (
        "linear_damping: [10, 11, 12, 1, 1, ",
        "linear_damping: [10, 11, 12, 1, ",
        "hydrodynamics.calibrated: linear_damping has shape (5,), expected 6 diagonal entries or 6 rows of 6",
    ),
    "reverse force positive": ("force_min: -4.0", "force_min: 4.0", "force_min is 4.0, expected < 0"),
    "unknown domain": ("domain: speed", "domain: torque", "domain is 'torque', expected 'force' or 'speed'"),
    "unknown group": (
        "up: {group: small",
        "up: {group: smal",
        "thrusters.up: group is 'smal', did you mean 'small'? expected one of small",
    ),
    "unknown axis to control": (
        "controlled_axes: [surge, heave, yaw]",
        "controlled_axes: [surge, have]",
        "controlled_axes is ['surge', 'have'], expected a list drawn from surge, sway, heave, roll, pitch, yaw",
    ),
    "unknown origin": (
        "origin: measured",
        "origin: mesured",
        "origin is 'mesured', did you mean 'measured'?",
    ),
    "key twice": (
        "  mass: 11.2\n",
        "  mass: 11.2\n  mass: 11.3\n",
        "line 9: not valid YAML: key 'mass' is given twice",
    ),
    "bracket open": ("size: [0.5, 0.4, 0.3]", "size: [0.5, 0.4, 0.3", "line 14: not valid YAML:"),
    "section a number": (
        "water: {density: 1000.0, gravity: 9.81}",
        "water: 1000",
        "water is 1000, expected a section of keys",
    ),
    "no thrusters": (
        MINNOW[MINNOW.index("thrusters:\n") : MINNOW.index("controlled")],
        "thrusters: {}\n",
        "thrusters is empty, expected at least one entry",
    ),
    "mesh drag without hull": (
        "hydrodynamics:\n",
        "hydrodynamics:\n  mesh: {form_drag: 1.0, skin_drag: 0.02}\n",
        "hydrodynamics.mesh: needs a hull",
    ),
    "hull of two kinds": (
        "hydrodynamics:\n",
        "hull: {parametric: true, file: hull.stl}\nhydrodynamics:\n",
        "hull: expected either 'parametric: true' or 'file: NAME.stl'",
    ),
    "hull file missing": ("hydrodynamics:\n", "hull: {file: hull.stl}\nhydrodynamics:\n", "hull: file "),
    "mass a truth": ("mass: 11.2", "mass: true", "body: mass is True, expected a number"),
    "huge coordinate": (
        "center_of_gravity: [0.0, 0.0, -0.02]",
        "center_of_gravity: [0.0, 0.0, -1e300]",
        "body.center_of_gravity: 2 is -1e+300, expected numbers up to 1e+12",
    ),
    "huge mass": ("mass: 11.2", "mass: 1e13", "body: mass is 1e+13, expected numbers up to 1e+12"),
    "name given": (
        "title: Minnow",
        "title: Minnow\nname: minnow",
        "unknown key 'name': the name is that of the file",
    ),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_what_cannot_be_right_is_refused_in_one_sentence(case, tmp_path):
    old, new, expected = REFUSALS[case]
    first, *others = refusal(tmp_path, old, new).splitlines()
    assert expected in first
    assert all(expected in other for other in others)  # once per thruster where the group is at fault


def test_what_a_library_refuses_of_the_whole_file_is_a_sentence():
    """NumPy's error about eigenvalues names no key."""
    detail = {"type": "value_error", "loc": (), "msg": "Value error, Eigenvalues did not converge", "ctx": {}}
    assert sentence_of(detail, "own.yaml") == "own.yaml: Eigenvalues did not converge"


def test_an_open_hull_is_refused(tmp_path):
    vertices, faces = parametric_hull([0.5, 0.4, 0.3], 0.0113)
    write_stl(tmp_path / "hull.stl", vertices, faces[:-1])
    message = refusal(tmp_path, "hydrodynamics:\n", "hull: {file: hull.stl}\nhydrodynamics:\n")
    assert message.startswith("hull: file hull.stl: ") and "open" in message


def test_an_inverted_hull_is_refused(tmp_path):
    vertices, faces = parametric_hull([0.5, 0.4, 0.3], 0.0113)
    write_stl(tmp_path / "hull.stl", vertices, faces[:, ::-1])
    message = refusal(tmp_path, "hydrodynamics:\n", "hull: {file: hull.stl}\nhydrodynamics:\n")
    assert message.startswith("hull: file hull.stl: ") and "inverted" in message


def test_a_good_hull_is_read_from_beside_the_file_and_enters_the_digest(tmp_path):
    vertices, faces = parametric_hull([0.5, 0.4, 0.3], 0.0113, [0.0, 0.0, 0.02])
    write_stl(tmp_path / "hull.stl", vertices, faces)
    text = MINNOW.replace("hydrodynamics:\n", "hull: {file: hull.stl}\nhydrodynamics:\n")
    first = load(tmp_path, text)
    assert len(first.hull_mesh()[1]) == len(faces)
    digest = first.sha256
    write_stl(tmp_path / "hull.stl", 0.99 * vertices, faces)
    assert load(tmp_path, text).sha256 != digest


def test_unknown_names_are_answered_with_the_known_ones():
    with pytest.raises(
        VehicleError, match="unknown vehicle 'finrov', did you mean 'finsrov'. available: bluerov2, "
    ):
        load_vehicle("finrov")
    with pytest.raises(VehicleError, match="nowhere/minnow.yaml: no such file"):
        load_vehicle("nowhere/minnow.yaml")


def test_a_variant_replaces_lists_merges_sections_and_removes_with_null(tmp_path):
    load(tmp_path, MINNOW)
    vehicle = load(
        tmp_path,
        "extends: minnow\norigin: guessed\nbody: {mass: 12.0}\nthrusters: {up: null}\ncontrolled_axes: [surge, yaw]\n",
        "heavy_minnow.yaml",
    )
    assert vehicle.name == "heavy_minnow"
    assert vehicle.body.mass == 12.0
    assert vehicle.body.displaced_volume == 0.0113
    assert vehicle.thruster_names == ("front_left", "front_right")
    assert vehicle.origin_of("body.mass").origin == "guessed"
    assert vehicle.origin_of("body.displaced_volume").origin == "measured"


def test_a_variant_exchanges_one_kind_of_hull_for_the_other(tmp_path):
    """A given mesh file drops the inherited `parametric`; `parametric: true` drops the inherited file and its
    scale."""
    vertices, faces = parametric_hull([0.5, 0.4, 0.3], 0.0113, [0.0, 0.0, 0.02])
    write_stl(tmp_path / "hull.stl", 1000.0 * vertices, faces)
    load(tmp_path, MINNOW + "hull: {parametric: true}\n")
    head = "origin: guessed\nhull: "
    scanned = load(tmp_path, f"extends: minnow\n{head}{{file: hull.stl, scale: 0.001}}\n", "scanned.yaml")
    assert scanned.hull.file == (tmp_path / "hull.stl").resolve() and not scanned.hull.parametric
    np.testing.assert_allclose(np.ptp(scanned.hull_mesh()[0], axis=0), np.ptp(vertices, axis=0), rtol=1e-6)
    back = load(tmp_path, f"extends: scanned\n{head}{{parametric: true}}\n", "back.yaml")
    assert back.hull.values() == {"parametric": True}
    assert not [key for key in back.provenance if key.startswith("hull")]
    with pytest.raises(VehicleError, match="hull: expected either"):
        load(tmp_path, f"extends: minnow\n{head}{{parametric: true, file: hull.stl}}\n", "both.yaml")


def test_a_variant_of_a_group_reaches_the_thrusters_of_the_base(tmp_path):
    load(tmp_path, MINNOW)
    vehicle = load(
        tmp_path,
        "extends: minnow\norigin: guessed\nthruster_groups: {small: {force_max: 3.0}}\n",
        "weak.yaml",
    )
    np.testing.assert_array_equal(vehicle.force_limits[1], [3.0, 3.0, 6.0])
    assert vehicle.origin_of("thrusters.front_left.force_max").origin == "guessed"
    assert vehicle.origin_of("thrusters.up.force_max").origin == "measured"


def test_files_that_extend_each_other_are_refused(tmp_path):
    (tmp_path / "b.yaml").write_text("extends: a\n", encoding="utf-8")
    with pytest.raises(VehicleError, match="extends itself through"):
        load(tmp_path, "extends: b\n", "a.yaml")


def test_numbers_in_yaml_1_2_notation_are_numbers(tmp_path):
    assert (
        load(tmp_path, MINNOW.replace("c_plus: 4.1e-4", "c_plus: 41e-5")).thrusters["front_left"].c_plus
        == 41e-5
    )


@pytest.mark.parametrize("name", catalogue())
def test_loading_takes_less_than_a_control_step(name):
    """Loading takes under 0.1 s of processor time, the best of three."""
    load_vehicle(name)
    best = min(_seconds(name) for _ in range(3))
    assert best < 0.1


def _seconds(name: str) -> float:
    start = time.process_time()
    load_vehicle(name)
    return time.process_time() - start


def test_the_model_of_another_program_is_read_directly(tmp_path, monkeypatch, capsys):
    """It is loaded by path, or by name in the working directory; guesses are listed once per run."""
    write(tmp_path / "rov.sdf", HEAVY)
    monkeypatch.chdir(tmp_path)
    for name in (tmp_path / "rov.sdf", "rov.sdf", "./rov.sdf"):
        with pytest.warns(
            VehicleWarning, match=r"guessed thrusters.*; body.size = .*vehicles import .*rov.sdf"
        ):
            vehicle = load_vehicle(name)
    assert vehicle.sha256 == read_foreign(tmp_path / "rov.sdf").vehicle(tmp_path).sha256
    assert vehicle.path == Path("rov.sdf") and vehicle.origin_of("body.size").origin == "guessed"
    assert boundary.run(app, ["vehicles", "show", "rov.sdf"]) == 0
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1 and said[0].startswith(
        "finssim: warning: rov.sdf: guessed thrusters.*.time_constant"
    )
    with pytest.raises(VehicleError, match=r"rovv\.sdf: no such file"):
        load_vehicle("rovv.sdf")


def test_a_variant_of_another_programs_model_corrects_its_guesses(tmp_path):
    write(tmp_path / "rov.sdf", HEAVY)
    text = "origin: measured\nextends: rov.sdf\nthrusters: {t0: {time_constant: 0.2}}\n"
    with pytest.warns(VehicleWarning):
        vehicle = load(tmp_path, text)
    assert [t.time_constant for t in vehicle.thrusters.values()] == [0.2] + [0.05] * 7
    assert vehicle.origin_of("thrusters.t0.time_constant").origin == "measured"


@pytest.mark.slow
def test_a_mesh_of_another_programs_model_is_there_while_the_program_runs(tmp_path):
    """A trial names such a file by its path."""
    write_stl(tmp_path / "hull.stl", *parametric_hull([0.4, 0.3, 0.2], 0.0135))
    root = tree(HEAVY)[0]
    geometry = root.find("world/model/link/collision/geometry")
    geometry.clear()
    element(element(geometry, "mesh"), "uri", "hull.stl")
    (tmp_path / "rov.sdf").write_bytes(tostring(root))
    with pytest.warns(VehicleWarning):
        vehicle = load_vehicle(tmp_path / "rov.sdf")
    assert vehicle.hull.file.is_file() and len(vehicle.hull_mesh()[1]) > 100
    assert vehicle_reference(str(tmp_path / "rov.sdf")) == str(tmp_path / "rov.sdf")
