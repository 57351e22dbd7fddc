"""Vehicles with coefficients in Python or MATLAB move as Fossen's equations require."""

import math

import numpy as np
import pytest

from finssim import acceleration
from finssim.vehicles import VehicleError, VehicleWarning, load_vehicle
from finssim.vehicles.importers.assignments import read_assignments
from finssim.vehicles.importers.coefficients import one_sign, symbol_of
from finssim.vehicles.importers.draft import read_foreign
from finssim.vehicles.importers.rigid import flu_of_frd
from reference.fossen import F, Fossen, Torpedo
from reference.imported import assert_moves_alike, driven, simulated
from reference.remus import Remus

HEAVY = """
clc; clear;                 % BlueROV2 Heavy of von Benzon et al. 2022
g = 9.82;  rho = 1000;      % m/s^2, kg/m3
m = 13.5;  V = 0.0134;
Ix = 0.26; Iy = 0.23; Iz = 0.37;
r_bg = [0 0 0.01]'; r_bb = [0 0 -0.01]';
MA = diag([6.36 7.12 18.68 0.189 0.135 0.222]);
Xu_l = 13.7; Yv_l = 0; Zw_l = 33.0; Kp_l = 0; Mq_l = 0.8; Nr_l = 0;
D_q = [141.0, 217.0, 190.0, 1.19, 0.47, 1.5];
c = cos(pi/4);
T = [ c   c  -c  -c  0 0 0 0
     -c   c  -c   c  0 0 0 0
      0   0   0   0  -1 -1 -1 -1
      zeros(1,4)  0.2 -0.2 0.2 -0.2
      zeros(1,4)  0.1 0.1 -0.1 -0.1
     -0.18 0.18 0.18 -0.18  0 0 0 0];
"""
ROV = """
import numpy as np
class BlueROV2:
    '''Coefficients of Wu 2018.'''
    def __init__(self, m=11.5):
        self.m, self.W, self.B = m, m * 9.81, 114.8
        I_0 = np.diag([0.16, 0.16, 0.16])
        self.zg = 0.02
        self.X_udot = -5.5; self.Y_vdot = -12.7; self.Z_wdot = -14.57
        self.K_pdot = self.M_qdot = self.N_rdot = -0.12
        self.Xu = -4.03; self.Yv = -6.22; self.Zw = -5.18; self.Kp = self.Mq = self.Nr = -0.07
        self.Xabs_u = -18.18; self.Yabs_v = -21.66; self.Zabs_w = -36.99
        self.Kabs_p = self.Mabs_q = self.Nabs_r = -1.55
        self.thrusters = 6
    def dynamics(self, nu):
        m = 99.0
        return np.linalg.inv(self.M) @ nu
"""
THRUSTERS = """
extends: rov.py
origin: measured
thrusters:
  left: {group: thruster, position: [-0.1, 0.1, 0], axis: [1, 0, 0]}
  right: {group: thruster, position: [-0.1, -0.1, 0], axis: [1, 0, 0], force_max: 30.0}
controlled_axes: [surge, yaw]
"""
PVS = """
import math
import numpy as np
from python_vehicle_simulator.lib.gnc import crossFlowDrag, forceLiftDrag, Hmtrx, m2c, gvect
class torpedo:
    def __init__(self, V_current=0):
        self.rho = RHO
        g = 9.81
        self.L = LENGTH
        self.diam = DIAM
        self.nMax = 1525
        self.T_n = 1.0
        self.S = 0.7 * self.L * self.diam
        a = self.L/2
        b = self.diam/2
        self.r_bg = np.array([0, 0, 0.02], float)
        self.r_bb = np.array([0, 0, 0], float)
        Cd = CDRAG
        self.CD_0 = Cd * math.pi * b**2 / self.S
        m = 4/3 * math.pi * self.rho * a * b**2
        Ix = (2/5) * m * b**2
        Iy = (1/5) * m * (a**2 + b**2)
        MRB_CG = np.diag([m, m, m, Ix, Iy, Iy])
        H_rg = Hmtrx(self.r_bg)
        self.MRB = H_rg.T @ MRB_CG @ H_rg
        self.W = m * g
        self.B = self.W
        e = math.sqrt(1-(b/a)**2)
        alpha_0 = (2 * (1-e**2)/pow(e,3)) * (0.5 * math.log((1+e)/(1-e)) - e)
        beta_0 = 1/(e**2) - (1-e**2) / (2*pow(e,3)) * math.log((1+e)/(1-e))
        k1 = alpha_0 / (2 - alpha_0)
        k2 = beta_0 / (2 - beta_0)
        k_prime = pow(e,4) * (beta_0-alpha_0) / ((2-e**2) * (2*e**2 - (2-e**2) * (beta_0-alpha_0)))
        self.MA = np.diag([m*k1, m*k2, m*k2, 0.3*Ix, k_prime*Iy, k_prime*Iy])
        self.M = self.MRB + self.MA
        self.w_roll = math.sqrt(self.W * (self.r_bg[2]-self.r_bb[2]) / self.M[3][3])
        self.w_pitch = math.sqrt(self.W * (self.r_bg[2]-self.r_bb[2]) / self.M[4][4])
        self.T_surge = 20; self.T_sway = 20; self.T_yaw = 1
    def dynamics(self, eta, nu, u_actual, u_control, sampleTime):
        nu_r = nu - nu_c
        n = u_actual[2]
        D_prop = 0.14; t_prop = 0.1; Ja_max = 0.6632; KT_0 = 0.4566; KT_max = 0.1798
        CA = m2c(self.MA, nu_r)
        CA[4][0] = 0; CA[0][4] = 0; CA[4][2] = 0; CA[2][4] = 0
        CA[5][0] = 0; CA[0][5] = 0; CA[5][1] = 0; CA[1][5] = 0
        D = np.diag([self.M[0][0] / self.T_surge, self.M[1][1] / self.T_sway, self.M[2][2] / self.T_sway,
                     self.M[3][3] * 2 * 0.3 * self.w_roll, self.M[4][4] * 2 * 0.8 * self.w_pitch,
                     self.M[5][5] / self.T_yaw])
        D[0][0] = D[0][0] * math.exp(-3*U_r)
        D[1][1] = D[1][1] * math.exp(-3*U_r)
        tau_liftdrag = forceLiftDrag(self.diam, self.S, self.CD_0, alpha, U_r)
        tau_crossflow = crossFlowDrag(self.L, self.diam, self.diam, nu_r)
        g = gvect(self.W, self.B, eta[4], eta[3], self.r_bg, self.r_bb)
"""
MSS = """
function [xdot,U,M] = remus(x,ui)
mu = deg2rad(63.446827); g_mu = gravity(mu); rho = 1026;
nu = x(1:6); alpha = atan2(nu(3), nu(1));
L_auv = 1.6; D_auv = 0.19; a = L_auv/2; b = D_auv/2; S = 0.7 * L_auv * D_auv;
r_bG = [ 0 0 0.02 ]'; r_bB = [ 0 0 0 ]';
CD_0 = 0.42 * pi * b^2 / S;
[MRB,CRB] = spheroid(a,b,nu(4:6),r_bG);
[MA,CA] = imlay61(a, b, nu, 0.3);
CA(5,3) = 0; CA(5,1) = 0; CA(6,1) = 0; CA(6,2) = 0;
m = MRB(1,1); W = m * g_mu; B = W;
D = Dmtrx([20 20 1],[0.3 0.8],MRB,MA,[W r_bG' r_bB']);
D(1,1) = D(1,1) * exp(-3 * U);
tau_liftdrag = forceLiftDrag(D_auv,S,CD_0,alpha,U);
tau_crossflow = crossFlowDrag(L_auv,D_auv,D_auv,nu,'cylinder');
xdot = [ (MRB + MA) \\ (tau_liftdrag + tau_crossflow); ...
         nu ];
"""
REMUS = {"RHO": "1026", "LENGTH": "1.6", "DIAM": "0.19", "CDRAG": "0.42"}
LONG = {"RHO": "1000", "LENGTH": "2.4", "DIAM": "0.24", "CDRAG": "0.3"}


def pvs(words):
    text = PVS
    for word, value in words.items():
        text = text.replace(word, value)
    return text


def read(folder, text, name="rov.m"):
    (folder / name).write_text(text)
    return read_foreign(folder / name)


# Motion


@pytest.mark.slow
def test_matlab_moves_as_fossens_equations(tmp_path):
    """Force steps on each axis, floating up or sinking, and a decay with all velocities agree within 0.2 %."""
    vehicle = read(tmp_path, HEAVY).vehicle(tmp_path)
    origin = Fossen(13.5, [0.26, 0.23, 0.37], [0, 0, 0.01], [0, 0, -0.01], 1000 * 9.82 * 0.0134,
                    [6.36, 7.12, 18.68, 0.189, 0.135, 0.222], [13.7, 0, 33.0, 0, 0.8, 0],
                    [141.0, 217.0, 190.0, 1.19, 0.47, 1.5], g=9.82)  # fmt: skip
    assert_moves_alike(vehicle, origin, [20.0, 20.0, 20.0, 0.5, 0.5, 2.0])


@pytest.mark.slow
def test_python_moves_as_fossens_equations(tmp_path):
    read_text(tmp_path)
    with pytest.warns(VehicleWarning):
        vehicle = load_vehicle(tmp_path / "own.yaml")
    origin = Fossen(11.5, [0.16] * 3, [0, 0, 0.02], [0, 0, 0], 114.8, [5.5, 12.7, 14.57, 0.12, 0.12, 0.12],
                    [4.03, 6.22, 5.18, 0.07, 0.07, 0.07], [18.18, 21.66, 36.99, 1.55, 1.55, 1.55])  # fmt: skip
    assert_moves_alike(vehicle, origin, [20.0, 20.0, 20.0, 0.5, 0.5, 2.0])


def read_text(folder):
    (folder / "rov.py").write_text(ROV)
    (folder / "own.yaml").write_text(THRUSTERS)


@pytest.mark.slow
@pytest.mark.parametrize("words", [REMUS, LONG], ids=["remus100", "longer"])
def test_a_torpedo_reaches_the_speeds_of_pythonvehiclesimulator(tmp_path, words):
    """Terminal speeds along each axis, and with its propeller, agree within 1 % with the original equations."""
    vehicle = read(tmp_path, pvs(words), "remus.py").vehicle(tmp_path)
    L, diam, Cd, rho = (float(words[w]) for w in ("LENGTH", "DIAM", "CDRAG", "RHO"))
    origin = Torpedo(L, diam, Cd=Cd, rho=rho)
    upright = np.repeat(np.eye(3)[None], 3, axis=0)
    tau = np.zeros((3, 6))
    tau[0, 0], tau[1, 1], tau[2, 5] = 20.0, 60.0, 5.0
    found = simulated(vehicle, upright, np.zeros((3, 6)), tau, 30.0)[-1]
    expected = origin.run(upright, np.zeros((3, 6)), tau, 30.0, step=0.05)[1][-1]
    for k, axis in enumerate((0, 1, 5)):
        assert found[k, axis] == pytest.approx(expected[k, axis], rel=0.01)
    origin.rpm = 1525.0
    top = origin.run(upright[:1], np.zeros((1, 6)), np.zeros((1, 6)), 60.0, step=0.05)[1][-1, 0, 0]
    assert driven(vehicle, 60.0)[0] == pytest.approx(top, rel=0.01)


@pytest.mark.slow
def test_a_torpedo_goes_straight_where_the_munk_moment_is_left_out(tmp_path):
    """Sway and yaw, heave and pitch at 2 m/s decay as in the original, within 1 % of each velocity's maximum."""
    vehicle, origin = read(tmp_path, pvs(REMUS), "remus.py").vehicle(tmp_path), Torpedo()
    nu = np.array([[2.0, 0.2, 0, 0, 0, 0.3], [2.0, 0, 0.2, 0, 0.3, 0], [2.0, -0.2, 0.2, 0, 0.1, 0.3]])
    tau = np.zeros((3, 6))
    tau[:, 0] = 0.5 * 1026 * 0.42 * np.pi * 0.095**2 * 4.0
    upright = np.repeat(np.eye(3)[None], 3, axis=0)
    found = simulated(vehicle, upright, nu, tau, 2.0)
    expected = origin.run(upright, nu, tau, 2.0)[1][::5]
    for k, axes in enumerate(([0, 1, 5], [0, 2, 4], [0, 1, 2, 4, 5])):
        scale = np.abs(expected[:, k, axes]).max(axis=0)
        assert (np.abs(found - expected)[:, k, axes] < 0.01 * scale).all()
    assert abs(found[-1, 0, 5]) < 0.1


FINS = """
        S_fin = 0.00665
        self.CL_delta_r = 0.5; self.CL_delta_s = 0.7
        self.A_r = 2 * S_fin; self.A_s = 2 * S_fin
        self.x_r = -a; self.x_s = -a
        self.T_delta = 0.1; self.deltaMax_r = 15 * math.pi / 180; self.deltaMax_s = 0.2
"""


def test_fins_and_propeller_of_a_torpedo_act_as_in_pythonvehiclesimulator(tmp_path):
    """Accelerations at 2 m/s ahead and 1525 rpm with deflected fins agree, without the torque, which is not
    read."""
    content = pvs(REMUS).replace("    def dynamics", f"{FINS}    def dynamics")
    draft, remus = read(tmp_path, content, "remus.py"), Remus()
    remus.propulsion = lambda U: Remus.propulsion(remus, U) * np.eye(6)[0]
    vehicle = draft.vehicle(tmp_path)
    assert [(fin.maximum, fin.time_constant) for fin in vehicle.actuators.values()] == [
        (pytest.approx(math.radians(15.0)), 0.1), (0.2, 0.1)
    ]  # fmt: skip
    assert not any("fins" in text for text in draft.not_read)
    nu, full = np.array([2.0, 0, 0, 0, 0, 0]), vehicle.thrusters["propeller"].force_max
    for rudder, plane in ((0.2, 0.0), (0.0, -0.15), (-0.1, 0.2)):
        found = acceleration(vehicle, [0.0, 0.0, -50.0, 0, 0, 0], nu, actuators=[full, rudder, plane]) * F
        expected = remus.acceleration(np.zeros(6), nu, [rudder, plane, 1525.0])
        assert (np.abs(found - expected) < 0.002 * np.abs(expected).max()).all()


def test_free_decay_of_a_torpedo_in_roll(tmp_path):
    """Roll and pitch from rest have the linear damping of the file."""
    vehicle = read(tmp_path, pvs(REMUS), "remus.py").vehicle(tmp_path)
    D = np.diag(vehicle.hydrodynamics["calibrated"].linear_damping)
    assert D[2:] == pytest.approx(Torpedo().damping[2:], rel=1e-6) and not D[:2].any()
    assert vehicle.mass_matrix() == pytest.approx(
        np.outer(F, F) * (Torpedo().M_RB + Torpedo().M_A), rel=1e-9, abs=1e-9
    )


def test_functions_of_mss_give_the_matrices_of_a_torpedo(tmp_path):
    """spheroid (1025 kg/m³), imlay61 (1026 kg/m³), Dmtrx and gravity, as remus100.m of MSS calls them."""
    draft = read(tmp_path, MSS, "remus.m")
    draft.missing = {}
    group = draft.values.pop("thruster_groups")["thruster"]
    draft.values["thrusters"] = {"t": {"position": [0, 0, 0], "axis": [1, 0, 0]} | group}
    vehicle, origin = draft.vehicle(tmp_path), Torpedo(1.6, 0.19, m=4 / 3 * np.pi * 1025 * 0.8 * 0.095**2)
    added = Torpedo(1.6, 0.19).M_A
    assert vehicle.mass_matrix() == pytest.approx(np.outer(F, F) * (origin.M_RB + added), rel=1e-9, abs=1e-9)
    M, W = np.diag(origin.M_RB + added), origin.W / 9.81 * 9.8214
    swing = 2 * np.array([0.3, 0.8]) * np.sqrt(W * 0.02 * M[3:5])
    expected = [0.0, M[1] / 20, M[2] / 20, *swing, M[5] / 1.0]
    D = np.diag(vehicle.hydrodynamics["calibrated"].linear_damping)
    assert D == pytest.approx(expected, rel=1e-4)
    assert any("model cylinder is left out" in sentence for sentence in draft.different)
    assert vehicle.buoyancy == pytest.approx(vehicle.weight)


# Conversions, one by one


def test_axes_turn_about_x():
    assert flu_of_frd([1.0, 2.0, 3.0]).tolist() == [1.0, -2.0, -3.0]
    assert flu_of_frd([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]).tolist() == [1.0, -2.0, -3.0, 4.0, -5.0, -6.0]
    M = np.arange(36.0).reshape(6, 6)
    assert flu_of_frd(M) == pytest.approx(np.diag(F) @ M @ np.diag(F))
    r, w = np.array([0.3, -0.2, 0.5]), np.array([1.0, 2.0, -0.5])
    assert flu_of_frd(np.cross(r, w)) == pytest.approx(np.cross(flu_of_frd(r), flu_of_frd(w)))


@pytest.mark.parametrize(
    ("name", "meaning"),
    [
        ("Xudot", ("added", 0, 0)), ("X_udot", ("added", 0, 0)), ("X_u_dot", ("added", 0, 0)), ("Xdu", ("added", 0, 0)),
        ("X_ud", ("added", 0, 0)), ("Yrdot", ("added", 1, 5)), ("M_wdot", ("added", 4, 2)), ("Xu", ("linear", 0, 0)),
        ("X_u", ("linear", 0, 0)), ("Xu_l", ("linear", 0, 0)), ("Mq", ("linear", 4, 4)), ("M_q", ("linear", 4, 4)),
        ("Xuu", ("quadratic", 0, 0)), ("X_uu", ("quadratic", 0, 0)), ("Xu_q", ("quadratic", 0, 0)),
        ("Mq_q", ("quadratic", 4, 4)), ("Mqq", ("quadratic", 4, 4)), ("Xabs_u", ("quadratic", 0, 0)),
        ("X_u_abs", ("quadratic", 0, 0)), ("Xu_abs_u", ("quadratic", 0, 0)), ("N_r_r", ("quadratic", 5, 5)),
        ("Yuv", ("product", 1, 0)), ("Zuq", ("product", 2, 0)), ("X_prop", None), ("Kp_theta", None),
        ("Ndr", ("added", 5, 5)),
        ("M", None), ("MA", None), ("Xuudr", None), ("Kd", None),
    ],
)  # fmt: skip
def test_names_of_coefficients(name, meaning):
    assert symbol_of(name) == meaning


def test_signs_of_coefficients():
    """Added mass and drag are positive here, Fossen's coefficients are their negatives; mixed signs are
    refused."""
    given = np.diag([-5.5, -12.7, -14.57, -0.12, -0.12, -0.12])
    given[1, 5] = given[5, 1] = 1.93
    for some in (given, -given):
        assert one_sign(some, "added mass", "f") == pytest.approx(-given)
    with pytest.raises(VehicleError, match="added mass has both signs .*Yv 12.7.* expected one"):
        one_sign(np.diag([-5.5, 12.7, -14.57, -0.12, -0.12, -0.12]), "added mass", "f")


def test_matlab_is_read_as_matlab_reads_it(tmp_path):
    (tmp_path / "a.m").write_text(
        "function x = a(u)\n% m = 1;\nL = 2; W = ...\n 5 * L^2; s = 'it''s 5% [';  B = [1, -2\n 3 4];\n"
        "y = [1 -2 3 - 1];\n"
        "z = [B B; eye(2) -B]; q = B(2,1); t = y'; B(1,2) = 7; p = struct('m', 3.5, 'name', 'x');\n"
        "if u > 0\n L = 9;\nend\nfor k = 1:3, q = q + 1; end\nv = u * 2; d = diag([1 2]) * B; e = 2 * L;\nend\n"
    )
    values = read_assignments(tmp_path / "a.m").values
    assert values["W"] == 20.0 and values["y"].tolist() == [[1.0, -2.0, 2.0]] and values["p.m"] == 3.5
    assert (
        values["B"].tolist() == [[1.0, 7.0], [3.0, 4.0]]
        and values["z"].shape == (4, 4)
        and values["t"].shape == (3, 1)
    )
    assert values["d"].tolist() == [[1.0, 7.0], [6.0, 8.0]]
    assert not {"m", "L", "v", "e", "s", "q"} & values.keys()  # a comment, a condition, a loop, an argument


def test_python_is_not_executed(tmp_path):
    """Only known calls are evaluated, no imports or huge numbers; a name assigned under a condition has no
    value."""
    (tmp_path / "a.py").write_text(
        f"open({str(tmp_path / 'made')!r}, 'w')\nimport os\nx = os.system('touch made')\ny = 9.0**9.0**9.0**9.0\n"
        "import numpy as np\nz = np.zeros((10**9, 10**9))\nm = 3\nif y:\n    m = 4\nk = [0] * 10**12\n"
        "p = dict(a=1)\nd = {'m': 2.5, 'f': open}\nn: float = 7.0\nn += 1\n"
    )
    values = read_assignments(tmp_path / "a.py").values
    assert values == {"d.m": 2.5, "n": 8.0} and not (tmp_path / "made").exists()
    grow = "x = [1, 2]\n" + "x = np.array([x, x])\n" * 60
    (tmp_path / "a.py").write_text(grow + "y = [" + "x, " * 100_000 + "x]\nz = np.eye(30)\n")
    assert read_assignments(tmp_path / "a.py").values.keys() == {"z"}
    (tmp_path / "a.m").write_text(
        "x = [1 2];\n" + "x = [x x; x x];\n" * 60 + "y = [" + "x " * 100_000 + "];\nz = 1;\n"
    )
    assert read_assignments(tmp_path / "a.m").values.keys() == {"z"}
    (tmp_path / "a.py").write_text("x = (" * 3000)
    with pytest.raises(VehicleError, match="cannot be read as Python"):
        read_assignments(tmp_path / "a.py")


# Guesses, refusals and findings


def test_thrusters_that_a_file_lacks_are_asked_for(tmp_path):
    """The message gives the lines to add to the file, which then loads as the vehicle."""
    read_text(tmp_path)
    with pytest.raises(VehicleError) as error:
        load_vehicle(tmp_path / "rov.py")
    lines = (
        "{extends: rov.py, origin: measured, "
        "thrusters: {NAME: {group: thruster, position: [x, y, z], axis: [x, y, z]}}}"
    )
    assert "thrusters cannot be read from it" in str(error.value) and str(error.value).endswith(lines)
    with pytest.warns(VehicleWarning, match="force_max = 33.8"):
        vehicle = load_vehicle(tmp_path / "own.yaml")
    assert vehicle.thrusters["left"].force_max == pytest.approx(0.3 * 11.5 * 9.81)
    assert vehicle.thrusters["right"].force_max == 30.0
    assert vehicle.origin_of("thrusters.left.force_max").origin == "guessed"
    assert vehicle.origin_of("thrusters.left.axis").origin == "measured"
    assert vehicle.body.mass == 11.5 and vehicle.body.center_of_gravity.tolist() == [0.0, 0.0, -0.02]


def test_a_matrix_of_thrusters_gives_axes_and_lines_of_action(tmp_path):
    """Its columns are the wrenches of the thrusters, so B of tau = B f is the same, in axes with z up."""
    vehicle = read(tmp_path, HEAVY).vehicle(tmp_path)
    c = np.sqrt(0.5)
    T = np.array([[c, c, -c, -c, 0, 0, 0, 0], [-c, c, -c, c, 0, 0, 0, 0], [0] * 4 + [-1] * 4,
                  [0] * 4 + [0.2, -0.2, 0.2, -0.2], [0] * 4 + [0.1, 0.1, -0.1, -0.1],
                  [-0.18, 0.18, 0.18, -0.18] + [0] * 4])  # fmt: skip
    assert vehicle.thruster_matrix() == pytest.approx(F[:, None] * T, abs=1e-12)


def test_what_is_not_read_is_named(tmp_path):
    """Products of two velocities, functions that compute forces, and numbers with unknown names are listed."""
    draft = read(tmp_path, HEAVY + "Yuv = -3; Cd_cable = 1.2; tau_tether = tether(x);\n")
    text = " | ".join(draft.not_read)
    for words in (
        "products of two velocities: Yuv",
        "numbers of other names: c, Cd_cable",
        "not read: tau_tether",
    ):
        assert words in text
    assert any("x forward, y right, z down" in sentence for sentence in draft.different)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("m = 13.5", "n = 13.5", "no mass is read"),
        ("Iz = 0.37", "", "no inertia is read"),
        ("m = 13.5;", "m = 13.5; W = 500;", "the weight W is 500 N, and m g is 132.57 N"),
        ("m = 13.5;", "m = 13.5; B = 1.08;", "the buoyancy B is 1.08 N and the weight 132.57 N"),
        ("m = 13.5;", "m = 13.5; mass = 0.07;", "m is 13.5 and mass is 0.07, which should be the same"),
        ("Xu_l = 13.7", "Xu_l = -13.7", "linear damping has both signs"),
        ("diag([6.36", "diag([-6.36", "added mass has both signs"),
        ("MA = ", "G = eye(6); MA = ", "as a surface vessel does"),
        ("      0   0   0   0  -1", "      0   0   0   0   0", "column 5 of the matrix of thrusters has no force"),
    ],
)  # fmt: skip
def test_refusals_are_sentences(tmp_path, old, new, sentence):
    assert old in HEAVY
    with pytest.raises(VehicleError) as error:
        read(tmp_path, HEAVY.replace(old, new, 1)).vehicle(tmp_path)
    assert sentence in str(error.value) and "\n" not in str(error.value)
