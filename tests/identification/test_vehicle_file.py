"""A vehicle written to a file is the same vehicle, and the file states the origin of every number."""

import shutil

import numpy as np
import pytest

from finssim.identification.vehicle_file import file_tree, folded, leaves, number_origins, write_vehicle
from finssim.trials.findings import CalibrationError
from finssim.vehicles import CalibrationRecord, Provenance, VehicleError, catalogue, load_vehicle

RECORD = CalibrationRecord(
    kind="hydrodynamics",
    method="simulation",
    trials={"surge_1": "1e5" + "0" * 61, "2024-05-04": "ab" * 32},
    settings={"seed": 3, "axes": ["surge", "yaw"], "horizon": None, "note": "a: b # c"},
    start="cd" * 32,
    finssim="0.1.0",
    revision=None,
)


@pytest.mark.parametrize("name", catalogue())
def test_every_vehicle_reads_back_as_itself(tmp_path, name):
    """Hash, every origin with source and note, texts and order of the thrusters are kept, for every kind of vehicle."""
    vehicle = load_vehicle(name)
    write_vehicle(vehicle, tmp_path / "again.yaml")
    again = load_vehicle(tmp_path / "again.yaml")
    assert again.sha256 == vehicle.sha256
    assert again.provenance == vehicle.provenance
    assert (again.title, again.description) == (vehicle.title, vehicle.description)
    assert again.thruster_names == vehicle.thruster_names
    assert "extends" not in (tmp_path / "again.yaml").read_text(encoding="utf-8")


def test_a_changed_vehicle_reads_back_with_the_origin_of_each_entry(tmp_path):
    """One entry of a diagonal, one of a thruster in a group, and a coupling change: only these are measured."""
    vehicle = load_vehicle("finsrov")
    D2 = np.array(vehicle.hydrodynamic_set("calibrated").quadratic_damping)
    D2[1, 5] = D2[5, 1] = 0.25
    measured = Provenance("measured", "our pool", 'a note with: a colon, "quotes" and # a hash')
    changed = vehicle.replace(
        {
            "hydrodynamics.calibrated.linear_damping.1.1": 55.5,
            "hydrodynamics.calibrated.quadratic_damping": D2,
            "thrusters.V_LB.time_constant": 0.2,
            "water.density": 998.0,
        },
        measured,
    )
    write_vehicle(changed, tmp_path / "changed.yaml")
    again = load_vehicle(tmp_path / "changed.yaml")
    assert again.sha256 == changed.sha256
    assert number_origins(again) == number_origins(changed)
    path = "hydrodynamics.calibrated.linear_damping"
    assert again.origin_of(f"{path}.1") == again.origin_of(f"{path}.1.1") == measured
    assert again.origin_of(f"{path}.0").origin == "published"
    assert again.origin_of("thrusters.V_LB.time_constant") == measured
    assert again.origin_of("thrusters.V_RB.time_constant").origin == "published"
    text = (tmp_path / "changed.yaml").read_text(encoding="utf-8")
    assert "55.5" in text and "0.0, 55.5" not in text  # six numbers, not six rows


def test_origins_fold_as_reading_folds_them():
    """The folded origins of a vehicle are those in its own file."""
    for name in ("finsrov", "remus100"):
        vehicle = load_vehicle(name)
        assert folded(file_tree(vehicle), number_origins(vehicle)) == vehicle.provenance


def test_records_travel_with_the_vehicle_and_not_with_its_hash(tmp_path):
    """Trials persist through write, read, `replace` and `extends`; digests that look like numbers stay strings."""
    vehicle = load_vehicle("finsrov")
    fitted = vehicle.model_copy(update={"calibrations": (RECORD,)})
    assert fitted.sha256 == vehicle.sha256
    write_vehicle(fitted, tmp_path / "fitted.yaml")
    again = load_vehicle(tmp_path / "fitted.yaml")
    assert again.calibrations == (RECORD,) and again.sha256 == vehicle.sha256
    (tmp_path / "child.yaml").write_text(
        "extends: fitted.yaml\norigin: guessed\nbody: {mass: 12.5}\n", "utf-8"
    )
    for heir in (again, again.replace({"body.mass": 12.5}), load_vehicle(tmp_path / "child.yaml")):
        assert heir.fitted_on("ab" * 32) and not heir.fitted_on("ba" * 32)
    assert not vehicle.fitted_on("ab" * 32)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (
            "kind: hydrodynamics",
            "kind: hydro",
            "calibrations.0: kind is 'hydro', expected 'thruster', 'motor'",
        ),
        ("method:", "methode:", "unknown key 'methode', did you mean 'method'?"),
    ],
)
def test_a_wrong_record_is_refused(tmp_path, old, new, sentence):
    """A record is validated like every section."""
    fitted = load_vehicle("finsrov").model_copy(update={"calibrations": (RECORD,)})
    write_vehicle(fitted, tmp_path / "v.yaml")
    text = (tmp_path / "v.yaml").read_text(encoding="utf-8").replace(old, new)
    (tmp_path / "v.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(VehicleError, match="calibrations") as refused:
        load_vehicle(tmp_path / "v.yaml")
    assert sentence in str(refused.value)


def test_a_hull_mesh_comes_along(tmp_path):
    """The folder can be moved: the mesh and its licence notice are written beside the file, once."""
    vehicle = load_vehicle("rexrov")
    for name in ("one.yaml", "two.yaml"):
        write_vehicle(vehicle, tmp_path / "here" / name)
    assert len(list((tmp_path / "here").iterdir())) == 4
    assert len(list((tmp_path / "here").glob("*.NOTICE"))) == 1
    shutil.move(tmp_path / "here", tmp_path / "there")
    moved = load_vehicle(tmp_path / "there" / "one.yaml")
    assert moved.sha256 == vehicle.sha256
    write_vehicle(moved, tmp_path / "there" / "three.yaml")
    assert len(list((tmp_path / "there").glob("*.stl"))) == 1


def test_another_suffix_is_refused(tmp_path):
    """A vehicle file that no command would read is not written."""
    with pytest.raises(CalibrationError, match=r"expected \.yaml"):
        write_vehicle(load_vehicle("finsrov"), tmp_path / "vehicle.json")
    assert list(tmp_path.iterdir()) == []


def test_the_file_is_for_people(tmp_path):
    """Groups are kept, vectors are on one line, and the file is at most twice as long as the catalogue's."""
    vehicle = load_vehicle("finsrov")
    write_vehicle(vehicle, tmp_path / "v.yaml")
    text = (tmp_path / "v.yaml").read_text(encoding="utf-8")
    numbers = sum(1 for _ in leaves(file_tree(vehicle)))
    assert len(text.splitlines()) < numbers
    assert text.count("c_plus:") == 2 and "mass: 12.11  # [kg]" in text


def test_numbers_of_one_source_share_it_and_keep_their_notes(tmp_path):
    """Each number has its own interval; the common source appears once, at the section."""
    vehicle = load_vehicle("finsrov")
    for i, key in enumerate(("mass", "displaced_volume", "surface_half_height")):
        vehicle = vehicle.replace(
            {f"body.{key}": (12.0, 0.0119, 0.11)[i]}, Provenance("measured", "our scale", f"note {i}")
        )
    vehicle = vehicle.replace({"body.size": [0.5, 0.4, 0.3]}, Provenance("measured", "our scale"))
    write_vehicle(vehicle, tmp_path / "v.yaml")
    assert (tmp_path / "v.yaml").read_text(encoding="utf-8").count("our scale") == 1
    assert load_vehicle(tmp_path / "v.yaml").provenance == vehicle.provenance


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("name", ["finsrov", "rexrov", "lauv"])
def test_any_mixture_of_origins_is_kept(tmp_path, name, seed):
    """Sources and notes are drawn for every number, many equal and many empty: folding loses none of them."""
    rng = np.random.default_rng(seed)
    vehicle = load_vehicle(name)
    pool = [
        Provenance(o, s, n)
        for o in ("measured", "guessed")
        for s in ("", "a book", "a scale")
        for n in ("", "once", "95 % interval 1 to 2")
    ]
    few = [pool[i] for i in rng.choice(len(pool), 1 + seed, replace=False)]
    origins = {path: few[rng.integers(len(few))] for path in number_origins(vehicle)}
    tree = file_tree(vehicle)
    mixed = vehicle.model_copy(update={"provenance": folded(tree, origins)})
    assert number_origins(mixed) == origins
    write_vehicle(mixed, tmp_path / "v.yaml")
    again = load_vehicle(tmp_path / "v.yaml")
    assert number_origins(again) == origins and again.sha256 == vehicle.sha256
