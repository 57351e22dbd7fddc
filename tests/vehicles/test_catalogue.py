"""The catalogue contains the published numbers, converted to FinsSim's frames."""

from __future__ import annotations

import math

import numpy as np
import pytest
import yaml

from finssim import acceleration
from finssim.vehicles import HydrodynamicSet, check, check_vehicle, load_vehicle
from finssim.vehicles.capability import terminal_speeds
from reference.fossen import F, Torpedo
from reference.remus import Remus

FLIP = np.array([1.0, -1.0, -1.0])  # NED body axes (x forward, y right, z down) to FinsSim's
FLIP6 = np.diag([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])
RAD_PER_RPM = math.pi / 30.0


def published_B() -> np.ndarray:
    """Return FinsROV's allocation matrix as printed, in its controller frame: x forward, y up, z left (left-handed).

    Rows are Fx Fy Fz Mx My Mz, columns in canonical order.
    """
    return np.array(
        [
            [0, 0, 0, 0, 0.707107, 0.707107, -0.707107, -0.707107],
            [1, 1, 1, 1, 0, 0, 0, 0],
            [0, 0, 0, 0, -0.707107, 0.707107, 0.707107, -0.707107],
            [-0.133047, -0.133047, 0.142953, 0.142953, -0.026283, 0.026283, 0.026283, -0.026283],
            [0, 0, 0, 0, 0.230379, 0.268390, 0.275395, 0.237384],
            [0.083122, -0.136877, -0.136877, 0.083122, -0.026283, -0.026283, 0.026283, 0.026283],
        ]
    )


def controller_frame(B: np.ndarray) -> np.ndarray:
    """Convert to the controller frame: forces exchange y and z; moments do too and change sign (axial
    vectors)."""
    return np.vstack([B[[0, 2, 1]], -B[[3, 5, 4]]])


def test_finsrov_allocation_matrix_is_the_published_one():
    B = controller_frame(load_vehicle("finsrov").control_matrix)
    np.testing.assert_allclose(B, published_B(), atol=6e-7)  # six digits printed


def test_finsrov_allocation_has_the_published_singular_values():
    singular = np.linalg.svd(load_vehicle("finsrov").control_matrix, compute_uv=False)
    np.testing.assert_allclose(singular, [2.0008, 1.4158, 1.4152, 0.5056, 0.2758, 0.2198], atol=5e-5)
    assert singular[0] / singular[-1] == pytest.approx(9.10, abs=5e-3)


def test_scaling_by_the_simulated_limits_gives_the_published_condition_number():
    vehicle = load_vehicle("finsrov_sim7")
    scaled = vehicle.control_matrix / vehicle.wrench_limits[:, None]
    assert np.linalg.cond(scaled) == pytest.approx(1.50, abs=5e-3)


def test_positive_vertical_thrust_on_the_left_rolls_right_side_down():
    """A force up on the left side (y > 0) turns about +x, left side up."""
    vehicle = load_vehicle("finsrov")
    column = vehicle.thruster_matrix()[:, vehicle.thruster_names.index("V_LF")]
    assert column[3] > 0.0


FORCES = {  # rpm: CC +, CC -, CCW +, CCW -, normal +, normal -, reverse +, reverse -
    500: (0.257, 0.198, 0.307, 0.284, 0.241, 0.200, 0.329, 0.252),
    1000: (1.029, 0.792, 1.227, 1.137, 0.965, 0.801, 1.316, 1.009),
    1500: (2.316, 1.782, 2.761, 2.559, 2.171, 1.801, 2.961, 2.270),
    2000: (4.118, 3.169, 4.908, 4.550, 3.860, 3.202, 5.264, 4.036),
    2500: (6.434, 4.951, 7.669, 7.109, 6.031, 5.003, 8.225, 6.306),
}


@pytest.mark.parametrize("rpm", FORCES)
def test_finsrov_thrust_curves_give_the_published_forces(rpm):
    real, simulated = load_vehicle("finsrov").thrusters, load_vehicle("finsrov_sim7").thrusters
    omega2 = (rpm * RAD_PER_RPM) ** 2
    forces = [
        c * omega2
        for thrusters in (real, simulated)
        for name in ("V_LB", "V_LF")  # CC (normal), CCW (reverse)
        for c in (thrusters[name].c_plus, thrusters[name].c_minus)
    ]
    np.testing.assert_allclose(forces, FORCES[rpm], atol=5.1e-4)


def test_finsrov_force_limits_are_the_published_ones_in_canonical_order():
    lower, upper = load_vehicle("finsrov").force_limits
    np.testing.assert_array_equal(upper, [8.4749, 7.3809, 7.3809, 8.4749, 7.3809, 8.4749, 7.3809, 8.4749])
    np.testing.assert_array_equal(
        lower, [-7.9750, -5.7618, -5.7618, -7.9750, -5.7618, -7.9750, -5.7618, -7.9750]
    )
    lower, upper = load_vehicle("finsrov_sim7").force_limits
    np.testing.assert_array_equal([lower, upper], [np.full(8, -7.0), np.full(8, 7.0)])


def test_finsrov_dead_zones_give_the_published_smallest_forces():
    thrusters = load_vehicle("finsrov").thrusters
    smallest = [
        c * (rpm * RAD_PER_RPM) ** 2
        for name in ("V_LB", "V_LF")
        for c, rpm in (
            (thrusters[name].c_plus, thrusters[name].dead_rpm_plus),
            (thrusters[name].c_minus, thrusters[name].dead_rpm_minus),
        )
    ]
    np.testing.assert_allclose(smallest, [0.233, 0.093, 0.462, 0.111], atol=5.1e-4)


def test_finsrov_motor_outputs_are_the_published_permutation():
    """M1 to M8 drive H_LF H_LB V_LF V_LB V_RB H_RF H_RB V_RF with signs - - - + - + - -."""
    by_output = sorted(load_vehicle("finsrov").thrusters.items(), key=lambda item: item[1].motor_index)
    assert [name for name, _ in by_output] == ["H_LF", "H_LB", "V_LF", "V_LB", "V_RB", "H_RF", "H_RB", "V_RF"]
    assert [thruster.motor_sign for _, thruster in by_output] == [-1, -1, -1, 1, -1, 1, -1, -1]


def test_finsrov_weight_and_buoyancy_are_the_published_ones():
    vehicle = load_vehicle("finsrov")
    assert vehicle.weight == pytest.approx(118.80, abs=5e-3)
    assert vehicle.buoyancy == pytest.approx(118.88, abs=5e-3)
    assert vehicle.buoyancy - vehicle.weight == pytest.approx(0.084, abs=5e-4)


@pytest.mark.parametrize("axis", [3, 4])
@pytest.mark.parametrize("key", ["added_mass", "linear_damping", "quadratic_damping"])
def test_finsrov_roll_and_pitch_are_told_to_be_placeholders(key, axis):
    provenance = load_vehicle("finsrov").origin_of(f"hydrodynamics.calibrated.{key}.{axis}")
    assert provenance == ("guessed", "", "unmeasured placeholder")


def test_bluerov2_heavy_thrusters_are_the_published_ned_ones():
    """Rows of the published NED matrix, rotated, agree; axes point where ArduSub's positive output pushes, against it.

    The horizontal thrusters are at the height of CentraleNantes's model: 0.0725 m instead of 0.085 m.
    """
    vehicle = load_vehicle("bluerov2_heavy")
    s = math.sqrt(0.5)
    positions = np.array(
        [[0.156, 0.111, 0.0725], [0.156, -0.111, 0.0725], [-0.156, 0.111, 0.0725], [-0.156, -0.111, 0.0725]]
    )
    directions = -np.array([[s, -s, 0], [s, s, 0], [-s, -s, 0], [-s, s, 0]])
    for name, position, direction in zip(("T1", "T2", "T3", "T4"), positions, directions, strict=True):
        np.testing.assert_allclose(vehicle.thrusters[name].position, FLIP * position, atol=1e-12)
        np.testing.assert_allclose(vehicle.thrusters[name].axis, FLIP * direction, atol=1e-8)
    ned = -FLIP6 @ vehicle.thruster_matrix()
    published_yaw = [-0.1888, 0.1888, 0.1888, -0.1888]
    np.testing.assert_allclose(ned[5, :4], published_yaw, atol=5e-5)
    lever = 0.06 * 0.0725 / 0.085
    np.testing.assert_allclose(ned[3, :4], lever * np.array([1, -1, 1, -1]), atol=2e-4)
    np.testing.assert_allclose(ned[4, :4], lever * np.array([1, 1, -1, -1]), atol=2e-4)
    np.testing.assert_allclose(ned[2, 4:], -1.0)
    np.testing.assert_allclose(np.abs(ned[3, 4:]), 0.218)
    np.testing.assert_allclose(np.abs(ned[4, 4:]), 0.12)


def test_rexrov_added_mass_is_the_published_ned_matrix():
    published = np.array(
        [
            [779.79, -6.8773, -103.32, 8.5426, -165.54, -7.8033],
            [-6.8773, 1222, 51.29, 409.44, -5.8488, 62.726],
            [-103.32, 51.29, 3659.9, 6.1112, -386.42, 10.774],
            [8.5426, 409.44, 6.1112, 534.9, -10.027, 21.019],
            [-165.54, -5.8488, -386.42, -10.027, 842.69, -1.1162],
            [-7.8033, 62.726, 10.775, 21.019, -1.1162, 224.32],
        ]
    )
    chosen = load_vehicle("rexrov").hydrodynamic_set("calibrated")
    np.testing.assert_allclose(FLIP6 @ chosen.added_mass @ FLIP6, (published + published.T) / 2.0, rtol=1e-12)


def test_rexrov_added_mass_acts_above_the_centre_of_gravity_where_the_hull_is():
    """M_A[sway, roll] = -m_sway z: pushing sideways through a point above turns the vehicle about it."""
    vehicle = load_vehicle("rexrov")
    M_A = vehicle.hydrodynamic_set("calibrated").added_mass
    height = -M_A[1, 3] / M_A[1, 1]
    assert height == pytest.approx(vehicle.body.center_of_buoyancy[2], abs=0.05)


def test_remus_runs_at_its_published_top_speed():
    """2.5 m/s at 1525 rpm; the published drag and propeller in its inflow agree with it to a few per cent."""
    assert terminal_speeds(load_vehicle("remus100"))[0] == pytest.approx(2.5, rel=0.05)


def test_remus_hull_fins_and_added_mass_add_up_to_the_printed_totals():
    """Prestero: X.. total = added-mass part + hull + fixed fins; N_uv = -(X_udot - Y_vdot) + ... = -24, and so on."""
    vehicle = load_vehicle("remus100")
    chosen = vehicle.hydrodynamic_set("calibrated")
    M_A, Du = FLIP6 @ chosen.added_mass @ FLIP6, FLIP6 @ chosen.surge_damping @ FLIP6
    X_udot, Y_vdot, Y_rdot, Z_qdot = -M_A[0, 0], -M_A[1, 1], -M_A[1, 5], -M_A[2, 4]
    relief = chosen.munk_relief
    for fin in vehicle.actuators.values():
        lift, x = 0.5 * vehicle.water.density * fin.area * fin.lift_slope, fin.position[0]
        assert (lift, lift * x) == (
            pytest.approx(9.64, abs=0.01),
            pytest.approx(-6.15, abs=0.01),
        )  # Y_uudr, N_uudr
    assert -Du[1, 1] - lift == pytest.approx(-28.6, abs=0.01)  # Y_uv
    assert -Du[2, 2] - lift == pytest.approx(-28.6, abs=0.01)  # Z_uw
    N_uv = -(X_udot - Y_vdot) - Du[5, 1] + relief[1] - relief[0] - lift * x
    M_uw = (X_udot - Y_vdot) - Du[4, 2] + relief[0] - relief[2] + lift * x
    assert (N_uv, M_uw) == (pytest.approx(-24.0, abs=0.01), pytest.approx(24.0, abs=0.01))
    assert X_udot - Du[1, 5] - lift * x == pytest.approx(5.22, abs=0.01)  # Y_ur
    assert -X_udot - Du[2, 4] + lift * x == pytest.approx(-5.22, abs=0.01)  # Z_uq
    assert Y_rdot - Du[5, 5] - lift * x**2 == pytest.approx(-2.0, abs=0.01)  # N_ur
    assert -Z_qdot - Du[4, 4] - lift * x**2 == pytest.approx(-2.0, abs=0.01)  # M_uq


TORPEDO = Torpedo()


def test_torpedo_has_the_masses_of_pythonvehiclesimulator():
    """Mass matrix, linear damping except surge and sway, and restoring arm follow its formulas for a
    spheroid."""
    vehicle = load_vehicle("torpedo")
    M = np.outer(F, F) * (TORPEDO.M_RB + TORPEDO.M_A)
    np.testing.assert_allclose(vehicle.mass_matrix(), M, rtol=1e-7, atol=1e-9)
    D = np.diag(vehicle.hydrodynamics["calibrated"].linear_damping)
    np.testing.assert_allclose(D, TORPEDO.damping * [0, 0, 1, 1, 1, 1], rtol=1e-7)
    assert vehicle.weight == pytest.approx(vehicle.buoyancy) == pytest.approx(TORPEDO.W)


def test_torpedo_has_the_drag_and_propeller_of_pythonvehiclesimulator():
    """By `acceleration` at 2.5 m/s ahead, also with sway and heave, hull, fins and propeller agree within 1.5 %.

    Roll agrees within 6 %, because in a turn each of our fins has its own speed.
    """
    vehicle, remus = load_vehicle("torpedo"), Remus(fin_drag=False)
    nu = np.array(
        [[2.5, 0, 0, 0, 0, 0], [2.5, 0.2, 0, 0, 0, 0.2], [2.5, 0, 0.1, 0, 0, 0], [1.0, 0, 0, 0, 0, 0]]
    )
    full = vehicle.thrusters["propeller"].force_max
    for rudder, plane in ((0.0, 0.0), (0.2, 0.0), (0.0, -0.2)):
        values = [full, rudder, rudder, plane, plane]
        found = acceleration(vehicle, [0.0, 0.0, -50.0, 0.0, 0.0, 0.0], nu * F, actuators=values) * F
        for row, speeds in zip(found, nu, strict=True):
            expected = remus.acceleration(np.zeros(6), speeds, [rudder, plane, 1525.0])
            share = np.where(np.arange(6) == 3, 0.06, 0.015)
            assert (np.abs(row - expected) < share * np.abs(expected).max()).all()


@pytest.mark.parametrize(("name", "robot"), [("lauv", "lauv_gazebo"), ("eca_a9", "eca_a9")])
def test_fins_of_uuv_simulator_turn_and_dive_as_there(name, robot):
    """Fins turned equally about outward axes roll the vehicle; upper and lower with opposite sign yaw it, and
    so on."""
    vehicle = load_vehicle(name)
    fins = list(vehicle.actuators.values())
    state = ([0.0, 0.0, -50.0, 0.0, 0.0, 0.0], [1.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    rest = acceleration(vehicle, *state)

    def turned(signs):
        return acceleration(vehicle, *state, actuators=[0.0, *(0.1 * np.asarray(signs))]) - rest

    up, left = np.array([fin.span[2] for fin in fins]), np.array([fin.span[1] for fin in fins])
    for signs, axis in ((np.ones(4), 3), (np.sign(np.round(up, 9)), 5), (np.sign(np.round(left, 9)), 4)):
        rates = turned(signs)
        others = [i for i in (3, 4, 5) if i != axis]
        assert np.abs(rates[others]).max() < 0.02 * abs(rates[axis]), (signs, rates)
    assert turned(np.sign(np.round(up, 9)))[5] < 0.0  # a positive angle about z turns the bow to starboard
    lift = {"lauv": 0.5 * 1028 * 0.0064 * 3.0, "eca_a9": 0.5 * 1027 * 0.04155 * 13.98}[name]
    assert 0.5 * vehicle.water.density * fins[0].area * fins[0].lift_slope == pytest.approx(lift)


@pytest.mark.parametrize(
    ("name", "m_eff", "speeds", "yaw_rate"),
    [
        ("bluerov2", (17.0, 24.2, 26.1), (1.55, 1.38, 1.09), 1.77),
        ("bluerov2_einarsson", (14.0, 29.9, 24.7), (1.19, 0.69, 0.82), 0.99),
        ("bluerov2_heavy", (19.9, 20.6, 32.2), (0.55, 0.48, 0.43), 1.83),
        ("bluerov2_heavy_morgan", (37.2, 22.2, 66.2), (0.68, 1.49, 0.39), 1.00),
        ("bluerov2_centralenantes", (20.3, 27.5, 29.4), (0.90, 0.89, 0.71), 0.31),
    ],
)
def test_bluerov2_sets_answer_a_push_as_the_survey_of_them_says(name, m_eff, speeds, yaw_rate):
    """The steady response to 50 N on each axis and 5 N m of yaw agrees to the printed digits."""
    from finssim.vehicles.capability import terminal_speed

    vehicle = load_vehicle(name)
    chosen = vehicle.hydrodynamic_set("calibrated")
    assert isinstance(chosen, HydrodynamicSet)
    # The survey counts CentraleNantes's body without its propellers (0.42 kg).
    atol = 0.5 if name == "bluerov2_centralenantes" else 0.06
    np.testing.assert_allclose(vehicle.body.mass + np.diag(chosen.added_mass)[:3], m_eff, atol=atol)
    d1, d2 = np.diag(chosen.linear_damping), np.diag(chosen.quadratic_damping)
    np.testing.assert_allclose([terminal_speed(d1[i], d2[i], 50.0) for i in range(3)], speeds, atol=0.0051)
    assert terminal_speed(d1[5], d2[5], 5.0) == pytest.approx(yaw_rate, abs=0.0051)


def test_bluerov2_heavy_floats_as_its_manufacturer_trims_it():
    """Net buoyancy is 0.2 kg; the set with an arm keeps the thruster height with which it was identified."""
    vehicle = load_vehicle("bluerov2_heavy")
    assert (vehicle.buoyancy - vehicle.weight) / vehicle.water.gravity == pytest.approx(0.2, abs=1e-6)
    assert load_vehicle("bluerov2_heavy_morgan").thrusters["T1"].position[2] == -0.085


PUBLISHED = yaml.safe_load(check.PUBLISHED.read_text())


@pytest.mark.parametrize("name", PUBLISHED)
def test_top_speed_and_pull_are_near_the_published_ones_or_have_a_reason(name):
    """d1 v + d2 v² = thrust; exactly the differences of more than a fifth have a stated reason."""
    vehicle, row = load_vehicle(name), PUBLISHED[name]
    chosen = vehicle.hydrodynamics["calibrated"]
    d1, d2 = chosen.linear_damping[0, 0], chosen.axis_drag[0]
    for propeller in vehicle.thrusters.values():
        if propeller.inflow is not None:
            d1 += (
                (1.0 - propeller.inflow.wake_fraction)
                * propeller.inflow.thrust_loss
                * propeller.rpm_max
                * RAD_PER_RPM
            )
    thrust = vehicle.wrench_limits[0]
    speed = 2.0 * thrust / (d1 + math.sqrt(d1**2 + 4.0 * d2 * thrust))
    ours = {"top_speed": speed} | dict(zip(("surge", "sway", "heave"), vehicle.wrench_limits, strict=False))
    apart = {key for key in ours if key in row and abs(ours[key] / row[key] - 1.0) > 0.2}
    assert bool(apart) == ("why" in row), ours
    found = [
        result for result in check_vehicle(vehicle) if result.name.startswith(("top speed", "bollard pull"))
    ]
    assert len(found) == len(row.keys() & ours.keys()) and all(result.passed for result in found)
    assert {result.name for result in found if result.remark} == {
        {"top_speed": "top speed"}.get(key, f"bollard pull in {key}") for key in apart
    }
    assert f"{speed:.3g} m/s; the real one {row['top_speed']:g} m/s ({row['source']})" in found[0].sentence


def test_a_top_speed_far_from_the_published_one_is_reported(monkeypatch):
    """It is reported if it has no reason; a vehicle without a row has no published speed."""
    monkeypatch.setattr(
        check, "read_mapping", lambda *_, **__: {"remus100": {"top_speed": 1.5, "source": "x"}}
    )
    (found,) = (result for result in check_vehicle(load_vehicle("remus100")) if result.name == "top speed")
    assert not found.passed and found.sentence == "2.56 m/s; the real one 1.5 m/s (x)"
    assert not [r for r in check_vehicle(load_vehicle("finsrov")) if r.name == "top speed"]
