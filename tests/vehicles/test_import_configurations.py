"""Vehicles of HoloOcean and MarineGym move by these programs' equations; data kept elsewhere are requested."""

import json
import math

import numpy as np
import pytest

from finssim.sim.model import acceleration
from finssim.vehicles import VehicleError, VehicleWarning, load_vehicle
from finssim.vehicles.importers.draft import read_foreign
from finssim.vehicles.importers.marinegym import thrust
from reference.fossen import F, Fossen, Torpedo
from reference.imported import assert_moves_alike, driven, simulated

COUGUV = {
    "rho": 1026, "mass": 31.03, "length": 1.6, "diam": 0.19, "r_bg": [0, 0, 0.02], "r_bb": [0, 0, 0],
    "area_fraction": 0.7, "T_surge": 20, "T_sway": 20, "zeta_roll": 0.3, "zeta_pitch": 0.8, "T_yaw": 1,
    "K_nomoto": 0.25, "r44": 0.3, "Cd": 0.42, "e": 0.7,
}  # fmt: skip
"""Example of HoloOcean's documentation (fossen-based-dynamics), agent CougUV."""
ACTUATOR = {"fin_count": 4, "fin_area": 0.00697, "nMax": 1525, "T_n": 1.0, "D_prop": 0.14, "t_prop": 0.1,
            "KT_0": 0.4566, "KQ_0": 0.07, "KT_max": 0.1798, "KQ_max": 0.0312, "w": 0.056, "Ja_max": 0.6632}  # fmt: skip
LIGHT = COUGUV | {"mass": 16, "length": 1.4, "diam": 0.15, "Cd": 0.3}
"""Lighter vehicle, as in the older examples; its buoyancy still equals its weight."""

BLUEROV = {
    "name": "BlueROV", "drag_coef": 0.3, "volume": 0.0113459, "coBM": 0.01,
    "hydro_coef": {
        "added_mass": [5.5, 12.7, 14.57, 0.12, 0.12, 0.12], "linear_damping": [4.03, 6.22, 5.18, 0.07, 0.07, 0.07],
        "quadratic_damping": [18.18, 21.66, 36.99, 1.55, 1.55, 1.55],
    },
    "rotor_configuration": {
        "directions": [1.0, -1.0] * 3, "time_constants": [0.01] * 6, "force_constants": [4.4e-7] * 6,
        "max_rotation_velocities": [3900] * 6, "moment_constants": [1.4e-9] * 6, "num_rotors": 6,
    },
}  # fmt: skip
"""Marine-RL/MarineGym, BlueROV.yaml, commit b6d39c4."""
HAUV = {
    "volume": 0.00455865,
    "hydro_coef": {
        "added_mass": [9.08, 8.952, 10.9018, 0.3, 0.3, 0.3], "linear_damping": [0.0413, 0.432, 0.413, 0.1, 0.1, 0.1],
        "quadratic_damping": [8.9, 12.27, 15.278, 0.3, 0.3, 0.3],
    },
}  # fmt: skip
"""Hull of HAUV.yaml of MarineGym, commit a72ed67, with the rotors of BlueROV."""
OWN = """
extends: BlueROV.yaml
origin: measured
body: {mass: 11.2, inertia: [0.3, 0.32, 0.28], size: [0.45, 0.34, 0.25]}
thrusters:
  rotor_0: {position: [0.14, -0.09, 0], axis: [0.70710678, 0.70710678, 0]}
  rotor_1: {position: [0.14, 0.09, 0], axis: [0.70710678, -0.70710678, 0]}
  rotor_2: {position: [-0.15, -0.09, 0], axis: [0.70710678, -0.70710678, 0]}
  rotor_3: {position: [-0.15, 0.09, 0], axis: [0.70710678, 0.70710678, 0]}
  rotor_4: {position: [0, -0.11, 0.07], axis: [0, 0, 1]}
  rotor_5: {position: [0, 0.11, 0.07], axis: [0, 0, 1]}
controlled_axes: [surge, sway, heave, roll, yaw]
"""


def scenario(dynamics=COUGUV, **agent):
    parts = {"agent_name": "auv0", "agent_type": "CougUV", "fossen_model": "torpedo", "sensors": [{"sensor_type": "I"}],
             "dynamics": dynamics, "actuator": ACTUATOR} | agent  # fmt: skip
    other = {"agent_name": "other", "agent_type": "SurfaceVessel"}
    return {"name": "t", "main_agent": "auv0", "agents": [other, parts]}


def holoocean(folder, tree):
    (folder / "auv.json").write_text(json.dumps(tree))
    return read_foreign(folder / "auv.json")


# HoloOcean


@pytest.mark.slow
@pytest.mark.parametrize("dynamics", [COUGUV, LIGHT], ids=["couguv", "light"])
def test_a_torpedo_of_holoocean_reaches_its_speeds(tmp_path, dynamics):
    """Terminal speeds along each axis, and with its propeller, agree within 1 % with the equations of
    torpedo.py."""
    vehicle = holoocean(tmp_path, scenario(dynamics)).vehicle(tmp_path)
    origin = Torpedo(dynamics["length"], dynamics["diam"], m=dynamics["mass"], Cd=dynamics["Cd"])
    tau, upright = np.zeros((3, 6)), np.repeat(np.eye(3)[None], 3, axis=0)
    tau[0, 0], tau[1, 1], tau[2, 5] = 20.0, 60.0, 5.0
    found = simulated(vehicle, upright, np.zeros((3, 6)), tau, 30.0)[-1]
    expected = origin.run(upright, np.zeros((3, 6)), tau, 30.0, step=0.05)[1][-1]
    for k, axis in enumerate((0, 1, 5)):
        assert found[k, axis] == pytest.approx(expected[k, axis], rel=0.01)
    origin.rpm = 1525.0
    top = origin.run(upright[:1], np.zeros((1, 6)), np.zeros((1, 6)), 60.0, step=0.05)[1][-1, 0, 0]
    assert driven(vehicle, 60.0)[0] == pytest.approx(top, rel=0.01)


@pytest.mark.parametrize("dynamics", [COUGUV, LIGHT], ids=["couguv", "light"])
def test_matrices_of_a_torpedo_of_holoocean(tmp_path, dynamics):
    """Mass matrix, and linear damping except surge and sway, equal those of torpedo.py in axes with z up."""
    vehicle = holoocean(tmp_path, scenario(dynamics)).vehicle(tmp_path)
    origin = Torpedo(dynamics["length"], dynamics["diam"], m=dynamics["mass"], Cd=dynamics["Cd"])
    M = np.outer(F, F) * (origin.M_RB + origin.M_A)
    assert vehicle.mass_matrix() == pytest.approx(M, rel=1e-9, abs=1e-9)
    D = np.diag(vehicle.hydrodynamics["calibrated"].linear_damping)
    assert D[2:] == pytest.approx(origin.damping[2:], rel=1e-9) and not D[:2].any()
    assert vehicle.buoyancy == pytest.approx(vehicle.weight)


@pytest.mark.parametrize(
    "fins", [{}, {"fin_count": 3, "fin_offset_deg": 30.0, "fin_area": 0.01, "CL_delta": 0.6}]
)
def test_fins_of_a_torpedo_of_holoocean(tmp_path, fins):
    """Each acts across its radius, half a length behind the middle: force and moment of HoloOcean's
    `fin.tau`."""
    actuator = ACTUATOR | {"fin_center": 0.12, "deltaMax_fin_deg": 20.0} | fins
    vehicle = holoocean(tmp_path, scenario(actuator=actuator)).vehicle(tmp_path)
    count, area, slope = (
        actuator.get(k, x) for k, x in (("fin_count", 4), ("fin_area", 0), ("CL_delta", 0.5))
    )
    assert len(vehicle.actuators) == count
    eta, nu, U = np.array([0.0, 0, -10, 0, 0, 0]), np.array([2.0, 0, 0, 0, 0, 0]), 2.0
    free = acceleration(vehicle, eta, nu, actuators=np.zeros(1 + count))
    for k, fin in enumerate(vehicle.actuators.values()):
        angle = np.radians(actuator.get("fin_offset_deg", 0.0) + 360.0 * k / count)
        push = 0.5 * 1026.0 * area * slope * 0.1 * U**2 * np.array([0.0, np.sin(angle), -np.cos(angle)])
        arm = np.array([-0.8, 0.12 * np.cos(angle), 0.12 * np.sin(angle)])
        expected = np.concatenate([push, np.cross(arm, push)]) * np.concatenate([F[:3], F[3:]])
        turned = acceleration(vehicle, eta, nu, actuators=np.eye(1 + count)[1 + k] * 0.1) - free
        assert vehicle.mass_matrix() @ turned == pytest.approx(expected, rel=1e-3, abs=2e-3)
        assert (fin.maximum, fin.rate_limit, fin.time_constant) == pytest.approx((np.radians(20.0), 0.5, 0.1))


def test_a_scenario_in_python_and_one_of_ros_are_read(tmp_path):
    """Neither is executed; the vehicle is the same."""
    expected = holoocean(tmp_path, scenario()).vehicle(tmp_path).sha256
    tree = scenario()
    text = (
        f"import holoocean\nname = 'auv0'\nscenario = {tree!r}\nenv = holoocean.make(scenario_cfg=scenario)\n"
    )
    (tmp_path / "auv.py").write_text(text.replace("'main_agent': 'auv0'", "'main_agent': name"))
    assert read_foreign(tmp_path / "auv.py").vehicle(tmp_path).sha256 == expected
    (tmp_path / "auv.yaml").write_text(json.dumps({"/**": {"ros__parameters": {"holoocean_scenario": tree}}}))
    assert read_foreign(tmp_path / "auv.yaml").vehicle(tmp_path).sha256 == expected


def test_what_a_scenario_lacks_or_has_besides_is_named(tmp_path):
    draft = holoocean(tmp_path, scenario({"mass": 16}))
    assert any("what the scenario lacks" in x and "diam" in x and "mass" not in x for x in draft.different)
    assert "agent: KQ_0" in draft.not_read and "agent: sensors" in draft.not_read
    assert draft.vehicle(tmp_path).body.mass == 16.0


@pytest.mark.parametrize(
    ("tree", "sentence"),
    [
        (scenario(agent_type="BlueROV2", fossen_model=None, dynamics=None), "a BlueROV2, are in HoloOcean's engine"),
        (scenario(fossen_model="otter"), "expected an agent with fossen_model torpedo"),
        (scenario(COUGUV | {"diamm": 0.2}), "unknown key 'diamm', did you mean 'diam'"),
        (scenario(COUGUV | {"mass": "16"}), "mass is '16', expected a number > 0"),
        (scenario(COUGUV | {"T_sway": 0}), "T_sway is 0, expected a number > 0"),
        (scenario(COUGUV | {"r_bg": [0, 0]}), "r_bg is [0, 0], expected 3 numbers"),
        (scenario(COUGUV | {"diam": 2.0}), "length is 1.6 and diam is 2, expected a body longer than it is wide"),
    ],
)  # fmt: skip
def test_refusals_of_scenarios_are_sentences(tmp_path, tree, sentence):
    with pytest.raises(VehicleError) as error:
        holoocean(tmp_path, tree)
    assert sentence in str(error.value) and "\n" not in str(error.value)


# MarineGym


def marinegym(folder, changes=(), name="BlueROV.yaml"):
    tree = json.loads(json.dumps(BLUEROV))
    for path, value in changes:
        node = tree
        *sections, key = path.split(".")
        for section in sections:
            node = node[section]
        node[key] = value
    (folder / name).write_text(json.dumps(tree))
    return folder / name


@pytest.mark.slow
@pytest.mark.parametrize(("hull", "mass"), [(BLUEROV, 11.2), (HAUV, 4.5)], ids=["bluerov", "hauv"])
def test_a_vehicle_of_marinegym_moves_as_its_equations(tmp_path, hull, mass):
    """With mass, inertia and thrusters added, force steps, floating up and a decay agree within 0.2 %."""
    marinegym(tmp_path, [(key, hull[key]) for key in HAUV])
    (tmp_path / "own.yaml").write_text(OWN.replace("mass: 11.2", f"mass: {mass}"))
    with pytest.warns(VehicleWarning):
        vehicle = load_vehicle(tmp_path / "own.yaml")
    origin = Fossen(mass, [0.3, 0.32, 0.28], [0, 0, 0], [0, 0, -0.01], 997 * 9.8 * hull["volume"],
                    *hull["hydro_coef"].values(), g=9.8)  # fmt: skip
    assert_moves_alike(vehicle, origin, [20.0, 20.0, 20.0, 0.5, 0.5, 2.0])


def test_thrust_of_a_rotor_at_its_limits(tmp_path):
    """It is 64.1 N forward and -51.5 N backward at 3900 rpm, in kgf by its curves; the file's limits equal
    these."""
    assert thrust(4.4e-7, 3900.0) == pytest.approx(
        9.81 * (4.7368e-7 * 3900**2 - 1.9275e-4 * 3900 + 8.4452e-2)
    )
    assert thrust(4.4e-7, -3900.0) == pytest.approx(
        9.81 * (-3.8442e-7 * 3900**2 + 1.6186e-4 * 3900 - 3.9139e-2)
    )
    marinegym(tmp_path, [("rotor_configuration.force_constants", [4.4e-7] * 5 + [8.8e-7])])
    (tmp_path / "own.yaml").write_text(OWN)
    with pytest.warns(VehicleWarning):
        thrusters = load_vehicle(tmp_path / "own.yaml").thrusters
    assert thrusters["rotor_0"].force_max == pytest.approx(64.13, abs=0.01)
    assert thrusters["rotor_5"].force_min == pytest.approx(-2 * 51.55, abs=0.01)
    assert thrusters["rotor_0"].thrust(3900.0 * math.pi / 30.0) == pytest.approx(64.13, abs=0.01)
    assert thrusters["rotor_0"].time_constant == 0.01


def test_words_that_marinegym_does_not_use_are_listed(tmp_path):
    read = read_foreign(marinegym(tmp_path, [("rotor_configuration.num_arms", 6)])).not_read
    assert {f"{word} (MarineGym does not use it)" for word in ("num_arms", "drag_coef")} <= set(read)


def test_what_stands_in_a_usd_file_is_asked_for(tmp_path):
    """The message gives the lines for a file beside it."""
    with pytest.raises(VehicleError) as error:
        load_vehicle(marinegym(tmp_path))
    text = str(error.value)
    assert "body, thrusters cannot be read from it: write a file beside it with these lines" in text
    assert "{extends: BlueROV.yaml, origin: measured, body: {mass: KG, inertia: [KG M2, KG M2, KG M2]" in text
    assert text.count("position: [x, y, z], axis: [x, y, z]") == 6 and "\n" not in text
    (tmp_path / "own.yaml").write_text(
        OWN.replace("  rotor_5: {position: [0, 0.11, 0.07], axis: [0, 0, 1]}\n", "")
    )
    with pytest.warns(VehicleWarning), pytest.raises(VehicleError, match="rotor_5: position is missing"):
        load_vehicle(tmp_path / "own.yaml")


@pytest.mark.parametrize(
    ("path", "value", "sentence"),
    [
        ("volum", 0.01, "unknown key 'volum', did you mean 'volume'"),
        ("hydro_coef.added_masses", [1.0] * 6, "unknown key 'added_masses', did you mean 'added_mass'"),
        ("hydro_coef.added_mass", [1.0] * 5, "added_mass is [1.0, 1.0, 1.0, 1.0, 1.0], expected 6 numbers"),
        ("hydro_coef.linear_damping", [-4.03] + [1.0] * 5, "expected 6 numbers of 0 or more"),
        ("rotor_configuration.num_rotors", 8, "time_constants is [0.01"),
        ("rotor_configuration.force_constants", ["x"] * 6, "expected 6 numbers of 0 or more"),
        ("volume", None, "volume is None, expected 1 numbers"),
        ("fin_configuration", {"num_fins": 4}, "vehicles of MarineGym with fins, whose propeller has another law"),
    ],
)  # fmt: skip
def test_refusals_of_parameters_are_sentences(tmp_path, path, value, sentence):
    with pytest.raises(VehicleError) as error:
        read_foreign(marinegym(tmp_path, [(path, value)]))
    assert sentence in str(error.value) and "\n" not in str(error.value)
