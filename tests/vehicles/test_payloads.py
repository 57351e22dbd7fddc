"""A vehicle with payloads is one rigid body with the numbers of mechanics."""

from __future__ import annotations

import json

import numpy as np
import pytest

from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.core.mesh import parametric_hull, write_stl
from finssim.identification.vehicle_file import write_vehicle
from finssim.vehicles import VehicleError, check_vehicle, load_vehicle
from finssim.vehicles.capability import trim
from vehicles.minnow import MINNOW

LOADS = """
payloads:
  lamp: {mass: 0.6, volume: 2.0e-4, position: [0.2, 0.05, -0.06], size: [0.12, 0.06, 0.06]}
  lead: {mass: 1.1, volume: 0.0, position: [-0.1, -0.03, -0.1]}
  foam: {mass: 0.0, volume: 9.0e-4, position: [0.0, 0.0, 0.09]}
"""
PARTS = [
    (0.6, 2.0e-4, [0.2, 0.05, -0.06], [0.12, 0.06, 0.06]),
    (1.1, 0.0, [-0.1, -0.03, -0.1], [0, 0, 0]),
    (0.0, 9.0e-4, [0.0, 0.0, 0.09], [0, 0, 0]),
]


def load(folder, text=MINNOW + LOADS, name="minnow.yaml"):
    (folder / name).write_text(text, encoding="utf-8")
    return load_vehicle(folder / name)


def mass_matrix(m, r, box):
    """Return M_RB of a homogeneous box at r about the body origin: m/12 (b² + c²), and [[m I, -m S], [m S, I
    - m S S]]."""
    x, y, z = r
    S = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    a, b, c = np.square(box)
    inertia = m / 12.0 * np.diag([b + c, a + c, a + b])
    return np.block([[m * np.eye(3), -m * S], [m * S, inertia - m * S @ S]])


def test_mass_matrices_about_one_point_add(tmp_path):
    """M_RB about the body origin is the sum of those of the body and of the payloads (parallel axes)."""
    bare = load(tmp_path, MINNOW, "bare.yaml")
    expected = bare.rigid_body_mass_matrix() + sum(mass_matrix(m, r, box) for m, _, r, box in PARTS)
    np.testing.assert_allclose(load(tmp_path).rigid_body_mass_matrix(), expected, rtol=1e-12, atol=1e-12)


def test_two_halves_of_a_box_are_the_box(tmp_path):
    """With the front half as payload of the back half, mass, centres and inertia are those of the whole."""
    a, b, c, m, V = 0.6, 0.4, 0.3, 20.0, 0.02
    half = m / 2.0 / 12.0 * np.array([b**2 + c**2, (a / 2) ** 2 + c**2, (a / 2) ** 2 + b**2])
    text = MINNOW
    for old, new in (
        ("mass: 11.2", f"mass: {m / 2}"),
        ("inertia: [0.2, 0.3, 0.4]", f"inertia: {half.tolist()}"),
        ("center_of_gravity: [0.0, 0.0, -0.02]", f"center_of_gravity: [{-a / 4}, 0, 0]"),
        ("displaced_volume: 0.0113", f"displaced_volume: {V / 2}"),
        ("center_of_buoyancy: [0.0, 0.0, 0.02]", f"center_of_buoyancy: [{-a / 4}, 0, 0]"),
    ):
        assert old in text
        text = text.replace(old, new)
    place = f"position: [{a / 4}, 0, 0], size: [{a / 2}, {b}, {c}]"
    text += f"\npayloads: {{front: {{mass: {m / 2}, volume: {V / 2}, {place}}}}}\n"
    body = load(tmp_path, text).body
    assert body.mass == m and body.displaced_volume == V
    np.testing.assert_allclose(body.center_of_gravity, 0.0, atol=1e-15)
    np.testing.assert_allclose(body.center_of_buoyancy, 0.0, atol=1e-15)
    whole = m / 12.0 * np.array([b**2 + c**2, a**2 + c**2, a**2 + b**2])
    np.testing.assert_allclose(body.inertia, np.diag(whole), rtol=1e-12, atol=1e-15)


def test_the_trim_differs_by_the_weights_in_water(tmp_path):
    """Level rest needs (m - rho V) g up at each payload, as force and moment about one point."""
    bare, loaded = load(tmp_path, MINNOW, "bare.yaml"), load(tmp_path)
    point = {"wrench_reference": [0.0, 0.0, 0.0]}
    change = trim(loaded.replace(point)).wrench - trim(bare.replace(point)).wrench
    expected = np.zeros(6)
    for m, volume, r, _ in PARTS:
        force = np.array([0.0, 0.0, 9.81 * (m - 1000.0 * volume)])
        expected += np.concatenate([force, np.cross(r, force)])
    np.testing.assert_allclose(change, expected, atol=1e-12)


def test_added_mass_and_thrusters_are_those_of_the_file(tmp_path):
    bare, loaded = load(tmp_path, MINNOW, "bare.yaml"), load(tmp_path)
    assert loaded.hydrodynamics == bare.hydrodynamics and loaded.thrusters == bare.thrusters
    np.testing.assert_array_equal(loaded.wrench_reference, loaded.body.center_of_gravity)


def test_a_variant_adds_and_removes_payloads(tmp_path):
    """With `extends` the parent's payloads count once; `null` removes one."""
    load(tmp_path)
    hook = "{mass: 0.5, volume: 0, position: [0, 0, 0]}"
    more = f"origin: measured\nextends: minnow\npayloads: {{lead: null, hook: {hook}}}\n"
    variant = load(tmp_path, more, "variant.yaml")
    assert list(variant.payloads) == ["lamp", "foam", "hook"]
    assert variant.body.mass == pytest.approx(11.2 + 0.6 + 0.5)
    none = "origin: measured\nextends: minnow\npayloads: null\n"
    assert load(tmp_path, none, "none.yaml").sha256 == load(tmp_path, MINNOW, "bare.yaml").sha256


def test_a_written_file_has_the_sum_and_no_payloads(tmp_path):
    """A fit's numbers are those of the loaded vehicle, so payloads must not be added to them again."""
    vehicle = load(tmp_path)
    write_vehicle(vehicle, tmp_path / "out.yaml")
    written = load_vehicle(tmp_path / "out.yaml")
    assert written.sha256 == vehicle.sha256 and not written.payloads
    changed = vehicle.replace({"body.mass": 13.0})
    assert changed.body.mass == 13.0 and list(changed.payloads) == ["lamp", "lead", "foam"]


def test_sums_have_the_origin_of_their_least_known_part(tmp_path):
    vehicle = load(tmp_path)
    origin = vehicle.origin_of("body.mass")
    assert origin.origin == "derived" and "lamp, lead, foam" in origin.note
    assert vehicle.origin_of("body.size").origin == "measured"
    assert vehicle.origin_of("payloads.lead.mass").origin == "measured"
    guessed = load(tmp_path, MINNOW + LOADS.replace("mass: 1.1", "mass: {value: 1.1, origin: guessed}"))
    assert guessed.origin_of("body.mass").origin == "guessed"


@pytest.mark.slow
def test_show_lists_them(tmp_path, capsys):
    load(tmp_path)
    assert boundary.run(app, ["vehicles", "show", str(tmp_path / "minnow.yaml")]) == 0
    text = capsys.readouterr().out
    row = next(line for line in text.splitlines() if line.startswith("lead"))
    assert "Payloads" in text and row.split()[-1] == f"{1.1 * 9.81:.2f}"
    assert boundary.run(app, ["vehicles", "show", str(tmp_path / "minnow.yaml"), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["payloads"]["foam"] == {"mass": 0.0, "volume": 9.0e-4, "position": [0.0, 0.0, 0.09]}
    assert shown["values"]["body"]["mass"] == pytest.approx(12.9)


@pytest.mark.slow
def test_a_mesh_is_compared_without_payloads(tmp_path):
    """The hull's file has the volume of the body alone."""
    write_stl(tmp_path / "hull.stl", *parametric_hull([0.5, 0.4, 0.3], 0.0113, [0.0, 0.0, 0.02]))
    found = check_vehicle(load(tmp_path, MINNOW + LOADS + "hull: {file: hull.stl}\n"))
    assert [f.passed for f in found if f.name.startswith("hull")] == [True, True, True]
    wrong = MINNOW.replace("displaced_volume: 0.0113", "displaced_volume: 0.0124")
    found = check_vehicle(load(tmp_path, wrong + LOADS + "hull: {file: hull.stl}\n"))
    assert [f.passed for f in found if f.name == "hull volume"] == [False]


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("mass: 1.1", "weight: 1.1", "payloads.lead: unknown key 'weight'"),
        ("mass: 1.1", "mass: -1.1", "payloads.lead: mass is -1.1, expected >= 0"),
        ("mass: 1.1", "mass: 0", "payloads.lead: mass and volume are both 0, expected one of them > 0"),
        ("mass: 1.1, ", "", "payloads.lead: mass is missing"),
        ("[-0.1, -0.03, -0.1]", "[0, 0]", "payloads.lead: position has shape (2,), expected 3 numbers"),
        ("size: [0.12, 0.06, 0.06]", "size: [0.12, 0.06, 0]", "payloads.lamp: size is"),
        ("payloads:", "payload:", "unknown key 'payload', did you mean 'payloads'"),
        ("{mass: 1.1, volume: 0.0, position: [-0.1, -0.03, -0.1]}", "1.1", "lead is 1.1, expected a section"),
    ],
)  # fmt: skip
def test_refusals_are_sentences(tmp_path, old, new, sentence):
    assert old in LOADS
    with pytest.raises(VehicleError) as error:
        load(tmp_path, MINNOW + LOADS.replace(old, new, 1))
    assert sentence in str(error.value)
