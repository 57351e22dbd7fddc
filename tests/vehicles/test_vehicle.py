"""Quantities that follow directly from a vehicle's numbers."""

from __future__ import annotations

import pickle
import subprocess
import sys

import numpy as np
import pytest

from finssim.core.mesh import mesh_centroid, mesh_volume
from finssim.vehicles import (
    HydrodynamicSet,
    Provenance,
    VehicleError,
    catalogue,
    load_vehicle,
)
from finssim.vehicles.vehicle import moved_to_origin

EVERY = pytest.mark.parametrize("name", catalogue())


@EVERY
def test_every_number_of_the_catalogue_has_an_origin_and_published_ones_a_source(name):
    vehicle = load_vehicle(name)
    numbers = [path for path, value in leaves(vehicle.values()) if isinstance(value, float)]
    assert len(numbers) > 50
    for path in numbers:
        provenance = vehicle.origin_of(path)
        assert provenance.source or provenance.note or provenance.origin == "derived", path


def leaves(tree, path=""):
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from leaves(value, f"{path}.{key}".lstrip("."))
    elif isinstance(tree, list):
        for i, value in enumerate(tree):
            yield from leaves(value, f"{path}.{i}")
    else:
        yield path, tree


@EVERY
def test_kinetic_energy_does_not_depend_on_the_point_it_is_reckoned_from(name):
    """nuᵀ M_RB nu = m |v_g|² + omegaᵀ I omega, with v_g the velocity of the centre of gravity."""
    vehicle = load_vehicle(name)
    nu = np.random.default_rng(1).standard_normal(6)
    v_g = nu[:3] + np.cross(nu[3:], vehicle.body.center_of_gravity)
    expected = vehicle.body.mass * v_g @ v_g + nu[3:] @ vehicle.body.inertia @ nu[3:]
    assert nu @ vehicle.rigid_body_mass_matrix() @ nu == pytest.approx(expected, rel=1e-12)


@EVERY
def test_power_of_the_thrusters_equals_power_of_their_wrench(name):
    """sum f_i (a_i · v_i + q_i a_i · omega) = nu · B f, v_i the velocity of each propeller, q_i its reaction."""
    vehicle = load_vehicle(name)
    generator = np.random.default_rng(2)
    nu, f = generator.standard_normal(6), generator.standard_normal(len(vehicle.thrusters))
    power = sum(
        force * thruster.axis @ (nu[:3] + np.cross(nu[3:], thruster.position) + thruster.reaction * nu[3:])
        for force, thruster in zip(f, vehicle.thrusters.values(), strict=True)
    )
    assert nu @ vehicle.thruster_matrix() @ f == pytest.approx(power, rel=1e-9, abs=1e-12)


def test_a_matrix_moved_to_the_origin_gives_the_same_power():
    """nuᵀ M' nu = nu_pᵀ M nu_p, nu_p the twist at the point."""
    generator = np.random.default_rng(3)
    M, point, nu = (
        generator.standard_normal((6, 6)),
        generator.standard_normal(3),
        generator.standard_normal(6),
    )
    nu_p = np.concatenate([nu[:3] + np.cross(nu[3:], point), nu[3:]])
    assert nu @ moved_to_origin(M, point) @ nu == pytest.approx(nu_p @ M @ nu_p, rel=1e-12)


@EVERY
def test_wrenches_are_commanded_about_the_centre_of_gravity_unless_the_file_says_otherwise(name):
    vehicle = load_vehicle(name)
    np.testing.assert_array_equal(vehicle.wrench_reference, vehicle.body.center_of_gravity)
    moved = vehicle.replace({"body.center_of_gravity": [0.01, 0.0, 0.0]})
    np.testing.assert_array_equal(moved.wrench_reference, [0.01, 0.0, 0.0])


@EVERY
def test_the_digest_is_of_the_numbers_and_not_of_the_words(name):
    vehicle = load_vehicle(name)
    assert len(vehicle.sha256) == 64
    assert load_vehicle(name) == vehicle
    assert vehicle.replace({"title": "another title"}).sha256 == vehicle.sha256
    assert vehicle.replace({"body.mass": vehicle.body.mass * (1 + 1e-12)}).sha256 != vehicle.sha256


def test_the_order_of_the_thrusters_is_part_of_the_digest():
    vehicle = load_vehicle("finsrov")
    values = vehicle.values()
    values["thrusters"] = dict(reversed(values["thrusters"].items()))
    assert type(vehicle)(**values, name="finsrov").sha256 != vehicle.sha256


def test_replace_makes_a_new_vehicle_and_leaves_the_old():
    vehicle = load_vehicle("finsrov")
    measured = Provenance("measured", "our scale")
    changed = vehicle.replace({"body.mass": 11.6, "thrusters.*.force_max": 5.0}, measured)
    assert (vehicle.body.mass, changed.body.mass) == (12.11, 11.6)
    np.testing.assert_array_equal(changed.force_limits[1], np.full(8, 5.0))
    assert changed.origin_of("body.mass") == measured
    assert changed.origin_of("thrusters.H_LF.force_max") == measured
    assert changed.origin_of("thrusters.H_LF.force_min").origin == "derived"
    assert vehicle.replace({}) == vehicle


def test_replace_reaches_tags_by_their_number():
    """Ids of tags are numbers in the file and text in a dotted path."""
    vehicle = load_vehicle("finsrov")
    moved = vehicle.replace({"tags.mounts.15.position": [0.08, 0.0, 0.10]})
    assert moved.tags.mounts[15].position.tolist() == [0.08, 0.0, 0.10]
    assert moved.tags.mounts[16] == vehicle.tags.mounts[16]
    with pytest.raises(VehicleError, match="no '17'; there are 15, 16"):
        vehicle.replace({"tags.mounts.17.position": [0.0, 0.0, 0.0]})


def test_replace_reaches_single_elements():
    vehicle = load_vehicle("finsrov").replace({"hydrodynamics.calibrated.linear_damping.3.3": 2.5})
    chosen = vehicle.hydrodynamic_set("calibrated")
    assert isinstance(chosen, HydrodynamicSet)
    assert chosen.linear_damping[3, 3] == 2.5


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("body.mas.x", 1.0, "body: no 'mas', did you mean 'mass'?"),
        ("body.mass", -1.0, "body: mass is -1.0, expected > 0"),
        ("body.mas", 1.0, "body: unknown key 'mas', did you mean 'mass'?"),
        ("body.inertia.5.5", 1.0, "body.inertia: no element '5' in a list of 3"),
    ],
)
def test_replace_refuses_as_the_loader_does(path, value, message):
    with pytest.raises(VehicleError) as caught:
        load_vehicle("finsrov").replace({path: value})
    assert message in str(caught.value)


@EVERY
def test_a_vehicle_is_frozen_and_survives_pickling(name):
    vehicle = load_vehicle(name)
    with pytest.raises(ValueError, match="frozen"):
        vehicle.body.mass = 1.0
    with pytest.raises(ValueError, match="read-only"):
        vehicle.body.inertia[0, 0] = 1.0
    assert pickle.loads(pickle.dumps(vehicle)).sha256 == vehicle.sha256


@EVERY
def test_the_hull_encloses_the_displaced_volume_about_the_centre_of_buoyancy(name):
    vehicle = load_vehicle(name)
    if vehicle.hull is None:
        with pytest.raises(VehicleError, match="has no hull"):
            vehicle.hull_mesh()
        return
    vertices, faces = vehicle.hull_mesh()
    assert mesh_volume(vertices, faces) == pytest.approx(vehicle.body.displaced_volume, rel=1e-6)
    gap = np.linalg.norm(mesh_centroid(vertices, faces) - vehicle.body.center_of_buoyancy)
    assert gap < 0.01 * vehicle.body.size.max()
    assert np.all(np.ptp(vertices, axis=0) <= vehicle.body.size * 1.01)


def test_an_unknown_set_is_answered_with_the_known_ones():
    with pytest.raises(
        VehicleError, match="lauv has no hydrodynamic set 'simplified'; available: calibrated"
    ):
        load_vehicle("lauv").hydrodynamic_set("simplified")


@pytest.mark.slow
def test_loading_a_vehicle_imports_nothing_heavy():
    code = (
        "import sys; from finssim.vehicles import load_vehicle; load_vehicle('finsrov');"
        "print([m for m in ('warp', 'torch', 'matplotlib', 'trimesh', 'scipy', 'rich') if m in sys.modules])"
    )
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert printed.strip() == "[]"


def test_a_zero_has_no_sign():
    """-0.0 and 0.0 are equal, so vehicles that contain them have equal hashes."""
    ways = [load_vehicle("finsrov").replace({"body.center_of_gravity": [0.0, y, 0.0]}) for y in (0.0, -0.0)]
    assert ways[0].sha256 == ways[1].sha256
