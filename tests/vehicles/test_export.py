"""Exported gz-sim files import with the same numbers, and what they cannot represent is named."""

import json
from xml.etree import ElementTree

import numpy as np
import pytest

from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.vehicles import HydrodynamicSet, VehicleError, load_vehicle
from finssim.vehicles.export import export_vehicle
from finssim.vehicles.importers.draft import read_foreign
from reference.cases import THRUSTED
from reference.finned import torpedo
from reference.gz_sim import HEAVY, Origin, write
from vehicles.minnow import MINNOW

COEFFICIENTS = [
    name for name in THRUSTED if isinstance(load_vehicle(name).hydrodynamics["calibrated"], HydrodynamicSet)
]


def returned(folder, vehicle, kind):
    export_vehicle(vehicle, folder / f"rov.{kind}", kind)
    return read_foreign(folder / f"rov.{kind}").vehicle(folder)


def unreactive(vehicle):
    """Return the vehicle without reaction torque, which gz-sim's plugin does not have."""
    return vehicle.replace({"thrusters.*.torque_constant": 0.0})


@pytest.mark.parametrize("kind", ["sdf", "urdf"])
@pytest.mark.parametrize("name", COEFFICIENTS)
def test_what_is_held_comes_back(tmp_path, name, kind):
    """Body, water, added mass, damping and thrusters agree about the reference point of the coefficients."""
    vehicle, found = load_vehicle(name), returned(tmp_path, load_vehicle(name), kind)
    given, read = vehicle.hydrodynamics["calibrated"], found.hydrodynamics["calibrated"]
    point = given.reference_point
    same = {
        "mass": (found.body.mass, vehicle.body.mass),
        "inertia": (found.body.inertia, vehicle.body.inertia),
        "center_of_gravity": (found.body.center_of_gravity, vehicle.body.center_of_gravity - point),
        "displaced_volume": (found.body.displaced_volume, vehicle.body.displaced_volume),
        "center_of_buoyancy": (found.body.center_of_buoyancy, vehicle.body.center_of_buoyancy - point),
        "density": (found.water.density, vehicle.water.density),
        "thrusters": (found.thruster_matrix(), unreactive(vehicle).thruster_matrix(point)),
        "limits": (np.array(found.force_limits), np.array(vehicle.force_limits)),
        "added_mass": (read.added_mass, given.added_mass),
        "linear_damping": (read.linear_damping, given.linear_damping),
        "quadratic_damping": (read.quadratic_damping, given.quadratic_damping),
    }  # fmt: skip
    for key, (theirs, ours) in same.items():
        assert theirs == pytest.approx(ours, rel=1e-9, abs=1e-9 * max(1.0, np.abs(ours).max())), key
    assert found.thruster_names == vehicle.thruster_names
    for ours, theirs in zip(vehicle.thrusters.values(), found.thrusters.values(), strict=True):
        assert theirs.c_plus == pytest.approx(ours.c_plus, rel=1e-9)
    if kind == "sdf":
        assert found.water.gravity == pytest.approx(vehicle.water.gravity)


def test_signs_are_those_of_gz_sim(tmp_path):
    """Added mass is positive in SDF's link and negative in a plugin; damping is negative; the dead zone is a thrust."""
    text = MINNOW.replace("domain: speed", "domain: speed, dead_rpm_plus: 100, dead_rpm_minus: -100")
    (tmp_path / "minnow.yaml").write_text(text)
    vehicle = load_vehicle(tmp_path / "minnow.yaml")
    for kind in ("sdf", "urdf"):
        export_vehicle(vehicle, tmp_path / f"rov.{kind}", kind)
    sdf, urdf = (ElementTree.parse(tmp_path / f"rov.{kind}").getroot() for kind in ("sdf", "urdf"))
    assert sdf.findtext(".//fluid_added_mass/yy") == "6.0" and sdf.find(".//xDotU") is None
    assert urdf.findtext(".//yDotV") == "-6.0" and urdf.findtext(".//xUabsU") == "-20.0"
    assert sdf.findtext(".//nR") == "-1.5" and sdf.findtext("world/gravity") == "0.0 0.0 -9.81"
    assert float(sdf.findtext(".//deadband")) == pytest.approx(4.1e-4 * (100 * np.pi / 30) ** 2)
    box = np.array(sdf.findtext(".//collision/geometry/box/size").split(), float)
    assert np.prod(box) == pytest.approx(0.0113) and box / box[0] == pytest.approx([1.0, 0.8, 0.6])


@pytest.mark.slow
def test_a_model_of_gz_sim_returns_to_gz_sim(tmp_path):
    """bluerov2_gz heavy, imported and exported, has gz-sim's terminal speeds in surge and sway at 20 N."""
    vehicle = read_foreign(write(tmp_path / "heavy.sdf", HEAVY)).vehicle(tmp_path)
    found = returned(tmp_path, vehicle, "sdf")
    assert found.mass_matrix() == pytest.approx(vehicle.mass_matrix(), abs=1e-9)
    drag = np.diag(found.hydrodynamics["calibrated"].quadratic_damping)
    assert np.sqrt(20.0 / drag[:2]) == pytest.approx([0.5851, 0.6023], abs=1e-4)
    assert (found.buoyancy - found.weight) == pytest.approx(vehicle.buoyancy - vehicle.weight, abs=1e-9)
    assert Origin(HEAVY).rigid[0, 0] == pytest.approx(found.body.mass)


def test_the_command_lists_what_is_not_held(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert boundary.run(app, ["vehicles", "export", "remus100", "--format", "urdf", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["file"] == "remus100.urdf" and "hydrodynamic term surge_damping" in told["not held"]
    assert any("Coriolis" in sentence for sentence in told["not held"])
    assert boundary.run(app, ["vehicles", "export", "finsrov", "--out", "rov.sdf"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert (
        lines[0] == "rov.sdf"
        and "not held: section sensors" in lines
        and "not held: hydrodynamic set mesh" in lines
    )
    assert any("reference point [0.0, 0.0, -0.08]" in line for line in lines)
    assert boundary.run(app, ["vehicles", "export", "finsrov", "--out", "rov.txt"]) == 2
    assert "expected .sdf, as the format" in capsys.readouterr().err
    assert boundary.run(app, ["vehicles", "export", "finsrov", "--format", "sdff", "--out", "rov.sdf"]) == 2
    assert "unknown format 'sdff'; available: sdf, urdf" in capsys.readouterr().err
    with pytest.raises(VehicleError, match="the set 'mesh' is based on a mesh"):
        export_vehicle(load_vehicle("finsrov"), tmp_path / "rov.sdf", "sdf", "mesh")


@pytest.mark.parametrize("kind", ["sdf", "urdf"])
def test_fins_are_joints_with_their_travel(tmp_path, kind):
    """Each fin is a revolute joint about its span at its position, with a plate of its area; the body keeps
    its mass."""
    vehicle = torpedo()
    lost = export_vehicle(vehicle, tmp_path / f"rov.{kind}", kind)
    root = ElementTree.parse(tmp_path / f"rov.{kind}").getroot()
    joint = root.find(".//joint[@name='rudder']")
    link = root.find(".//link[@name='rudder_fin']")
    axis, limit = joint.find("axis"), joint.find(".//limit")
    xyz = axis.findtext("xyz") or axis.get("xyz")
    ends = [limit.findtext(k) or limit.get(k) for k in ("lower", "upper")]
    box = link.find("visual/geometry/box")
    size = np.array((box.findtext("size") or box.get("size")).split(), float)
    assert joint.get("type") == "revolute" and xyz == "0.0 0.0 1.0" and ends == ["-0.35", "0.35"]
    assert size[0] * size[1] == pytest.approx(0.0133)
    assert returned(tmp_path, vehicle, kind).body.mass == pytest.approx(vehicle.body.mass)
    rest = "drag apart from that in proportion to the angle, wake, lag, rate and play"
    assert {
        f"{rest if kind == 'sdf' else 'force'} of fin rudder, which is a joint with a plate",
        "buoyancy engine",
        "moving_mass battery",
    } <= set(lost)
    assert "inflow of propeller" in lost


@pytest.mark.parametrize("incidence", [None, 0.0, 0.6])
@pytest.mark.parametrize("name", ["remus100", "torpedo", "eca_a9"])
def test_the_lift_of_fins_comes_back(tmp_path, name, incidence):
    """It is a LiftDrag of the fin's link, or of the body's where the flow angle counts only in part."""
    vehicle = load_vehicle(name)
    changes = {f"actuators.{fin}.drag": [0.01, 0.3, 1.0] for fin in vehicle.actuators}
    if incidence is not None:
        changes |= {f"actuators.{fin}.incidence": incidence for fin in vehicle.actuators}
    vehicle = vehicle.replace(changes)
    found, point = returned(tmp_path, vehicle, "sdf"), vehicle.hydrodynamics["calibrated"].reference_point
    assert set(found.actuators) == set(vehicle.actuators)
    for fin, ours in vehicle.actuators.items():
        theirs = found.actuators[fin]
        across = ours.span - ours.chord * (ours.span @ ours.chord)  # the file's value may be rounded
        assert theirs.span == pytest.approx(across / np.linalg.norm(across), rel=1e-9, abs=1e-9)
        for key in ("chord", "area", "lift_slope", "incidence", "stall", "minimum", "maximum"):
            assert getattr(theirs, key) == pytest.approx(getattr(ours, key), rel=1e-9, abs=1e-9), key
        assert theirs.position == pytest.approx(ours.position - point, rel=1e-9, abs=1e-9)
        assert theirs.drag == pytest.approx([0.0, 0.3, 0.0], rel=1e-9)
