"""Every vector in the parameter box is a physical plant."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from finssim.identification.estimates import changes
from finssim.identification.parameters import Parameters
from finssim.sim.plant_arrays import vehicle_parameters
from finssim.trials.findings import CalibrationError
from finssim.vehicles import AXES, load_vehicle

VEHICLES = {
    name: load_vehicle(name) for name in ("finsrov", "bluerov2", "bluerov2_heavy", "rexrov", "remus100")
}


def made(name, axes, extras=()):
    vehicle = VEHICLES[name]
    return Parameters(
        vehicle,
        axes=axes,
        damping=dict.fromkeys(axes, "both"),
        extras=extras,
        biases=axes,
    )


def vectors(p, seed):
    """Return random vectors over orders of magnitude, in and far outside the box."""
    rng = np.random.default_rng(seed)
    size = p.scale * 10.0 ** rng.uniform(-3.0, 3.0, (20, len(p.scale)))
    return p.start * rng.choice([0.0, 1.0], (20, 1)) + rng.choice([-1.0, 0.0, 1.0], size.shape) * size


@pytest.mark.parametrize("name", VEHICLES)
@settings(max_examples=15)
@given(seed=st.integers(0, 10_000), chosen=st.sets(st.sampled_from(AXES), min_size=1))
def test_any_vector_is_positive_definite_and_takes_energy_out(name, seed, chosen):
    """M_RB + M_A is symmetric and positive definite; nu · (D1 + D2 diag|nu|) nu >= 0 for velocities of all sizes."""
    axes = tuple(a for a in AXES if a in chosen)
    p = made(name, axes)
    M_A, D1, D2 = p.matrices(vectors(p, seed))
    M = p.M_RB + M_A
    np.testing.assert_allclose(M, np.swapaxes(M, 1, 2), rtol=1e-9, atol=1e-12 * np.abs(M).max())
    scale = np.sqrt(np.einsum("wii->wi", M))
    assert np.linalg.eigvalsh(M / (scale[:, :, None] * scale[:, None, :])).min() > 0.0
    rng = np.random.default_rng(seed)
    nu = rng.normal(size=(300, 6)) * 10.0 ** rng.uniform(-2.0, 2.0, (300, 6))
    for matrices, speed, own in (
        (D1, nu, p.set.linear_damping),
        (D2, np.abs(nu) * nu, p.set.quadratic_damping),
    ):
        if np.einsum("ni,ij,nj->n", nu, own, speed).min() < 0.0 or np.any(own - np.diag(np.diag(own))):
            continue  # couplings of the vehicle file, which a fit of some axes keeps
        power = np.einsum("ni,wij,nj->wn", nu, matrices, speed)
        size = np.einsum("ni,wij,nj->wn", np.abs(nu), np.abs(matrices), np.abs(speed))
        assert (power >= -1e-9 * size).all()


@pytest.mark.parametrize("name", VEHICLES)
def test_the_start_is_the_vehicle_file(name):
    """Added mass, damping, buoyancy and stiffness of the start vector are those that the simulator derives
    from the file."""
    p = made(name, AXES, ("k", "buoyancy_excess", "thrust_scale"))
    plants = p.plants(p.start)
    own = vehicle_parameters(VEHICLES[name], "calibrated")
    np.testing.assert_allclose(
        plants.fields["M_A"][0, 0], own["M_A"], rtol=1e-7, atol=1e-6 * np.abs(own["M_A"]).max()
    )
    np.testing.assert_allclose(plants.fields["volume"][0, 0], own["volume"], rtol=1e-9)
    assert plants.fields["gain"][0, 0].tolist() == [1.0] * 8
    assert not plants.bias.any()
    if VEHICLES[name].body.center_of_buoyancy[2] > VEHICLES[name].body.center_of_gravity[2]:
        np.testing.assert_allclose(plants.fields["r_b"][0, 0], own["r_b"], atol=1e-9)
    np.testing.assert_allclose(plants.fields["D1"][0, 0], own["D1"])
    np.testing.assert_allclose(plants.fields["D2"][0, 0], own["D2"])


def test_what_is_not_free_stays():
    """A fit of surge leaves every entry of the other axes unchanged."""
    p = made("bluerov2", ("surge",))
    M_A, D1, D2 = p.matrices(p.start + 3.0)
    rest = ~np.eye(6, dtype=bool)[0]
    assert (M_A[0, 0, 0], D1[0, 0, 0], D2[0, 0, 0]) == pytest.approx((8.5, 7.03, 21.18))
    for found, name in ((M_A, "added_mass"), (D1, "linear_damping"), (D2, "quadratic_damping")):
        assert np.array_equal(found[0][:, rest], getattr(p.set, name)[:, rest])


def test_a_bias_acts_against_the_motion_at_the_reference_point():
    """M nu_dot + D nu + b = tau: a surge bias b pushes with -b at the reference point, and so turns the origin."""
    p = made("finsrov", ("surge",))
    x = p.start.copy()
    x[p.names.index("surge.bias")] = 2.0
    np.testing.assert_allclose(p.plants(x).bias[0, 0], [-2.0, 0, 0, 0, -2.0 * -0.08, 0], atol=1e-12)


def test_stiffness_is_the_restoring_moment_of_the_plant():
    """k = B (z_b - z_r) - W (z_g - z_r), whatever other parameters are free."""
    p = made("finsrov", ("roll",), ("k", "buoyancy_excess"))
    x = p.start.copy()
    x[p.names.index("k")], x[p.names.index("buoyancy_excess")] = 5.0, 3.0
    f, v = p.plants(x).fields, VEHICLES["finsrov"]
    B = v.water.density * v.water.gravity * float(f["volume"][0, 0])
    assert B - v.weight == pytest.approx(3.0)
    k = B * (f["r_b"][0, 0, 2] - p.r_h[2]) - v.weight * (v.body.center_of_gravity[2] - p.r_h[2])
    assert k == pytest.approx(5.0)


def test_what_tilts_a_vehicle_at_rest_turns_it_once_it_rolls():
    """A roll or pitch bias is a centre of buoyancy offset from that of gravity: B r_b - W r_g = (b_pitch,
    -b_roll, k)."""
    p = made("bluerov2_heavy", AXES, ("k", "buoyancy_excess"))
    x, given = p.start.copy(), {"roll.bias": 0.2, "pitch.bias": -0.3, "k": 2.0, "surge.bias": 1.5}
    for name, value in given.items():
        x[p.names.index(name)] = value
    plants, v = p.plants(x), VEHICLES["bluerov2_heavy"]
    B = v.water.density * v.water.gravity * float(plants.fields["volume"][0, 0])
    arm = B * plants.fields["r_b"][0, 0] - v.weight * v.body.center_of_gravity
    np.testing.assert_allclose(arm, [-0.3, -0.2, 2.0], atol=1e-9)
    np.testing.assert_allclose(plants.bias[0, 0], [-1.5, 0, 0, 0, 0, 0], atol=1e-12)


def test_a_set_without_coefficients_is_refused():
    """A mesh, which has no damping coefficients to fit, is refused."""
    sets = VEHICLES["finsrov"].hydrodynamics
    bare = VEHICLES["finsrov"].model_copy(update={"hydrodynamics": {"calibrated": sets["mesh"]}})
    with pytest.raises(CalibrationError, match="no coefficients in hydrodynamics.calibrated"):
        Parameters(bare, axes=("surge",), damping={"surge": "both"})


def test_gains_of_thrusters_average_to_one_and_scale_their_columns():
    """Each gain has a prior of 1 with 5 %; a common factor of all belongs to `thrust_scale`."""
    p = made("bluerov2_heavy", ("surge", "yaw"), ("thrust_scale", "thruster_gains"))
    x = p.expected.copy()
    x[p.names.index("gain.T3")], x[p.names.index("thrust_scale")] = 0.9, 0.7
    plants = p.plants(x)
    np.testing.assert_allclose(plants.gains, [[1.0, 1.0, 0.9, 1.0, 1.0, 1.0, 1.0, 1.0]])
    np.testing.assert_allclose(plants.fields["gain"], 0.7)
    assert {c.std for c in p.coordinates if c.name.startswith("gain.")} == {0.05}
    rows, target = p.prior_rows()
    assert rows @ p.expected == pytest.approx(target)
    common = np.where([name.startswith("gain.") for name in p.names], 1.01, p.expected)
    assert rows @ common - target == pytest.approx([10.0])
    assert (
        made("bluerov2_heavy", ("surge",)).plants(made("bluerov2_heavy", ("surge",)).expected).gains is None
    )


def test_couplings_scale_with_their_diagonals():
    """Four times an inertia, estimated or given, or a drag doubles its couplings. `rexrov` couples all axes."""
    p = made("remus100", ("sway", "yaw"))
    x = p.start.copy()
    for kind in ("sway.added_mass", "yaw.d2"):
        x[p.names.index(kind)] *= 4.0
    M_A, _, D2 = p.matrices(x)
    file_M_A, file_D2 = np.asarray(p.set.added_mass), np.asarray(p.set.quadratic_damping)
    assert M_A[0, 1, 5] == M_A[0, 5, 1] == pytest.approx(2.0 * file_M_A[1, 5])
    assert M_A[0, 2, 4] == file_M_A[2, 4] != 0.0
    assert (D2[0, 1, 5], D2[0, 5, 1]) == pytest.approx((2.0 * file_D2[1, 5], 2.0 * file_D2[5, 1]))
    mass = float(p.M_RB[1, 1] + 4.0 * file_M_A[1, 1])
    held = Parameters(
        VEHICLES["remus100"], axes=("sway",), damping={"sway": "both"}, held={"sway": mass}
    ).matrices(np.zeros(2))[0]
    np.testing.assert_allclose(held[0], M_A[0])
    every = made("rexrov", AXES)
    doubled = every.start * np.where([n.endswith("added_mass") for n in every.names], 2.0, 1.0)
    np.testing.assert_allclose(every.matrices(doubled)[0][0], 2.0 * np.asarray(every.set.added_mass))


def test_the_file_keeps_couplings_symmetric():
    """Only sway is written: its coupling with yaw, in both rows, scales with it and with the file's yaw."""
    p = made("remus100", ("sway", "yaw"))
    path, x = "hydrodynamics.calibrated.added_mass", 4.0 * p.start
    written = changes(p, x, {}, {f"{path}.1.1": 142.0}, unmeasured=(), scaled=False)
    twice = 2.0 * float(p.set.added_mass[1][5])
    assert written == pytest.approx({f"{path}.1.1": 142.0, f"{path}.1.5": twice, f"{path}.5.1": twice})
    assert not changes(p, x, {}, {}, unmeasured=(), scaled=False)


@pytest.mark.filterwarnings("error")  # a glider has no thrusters with lags to average
def test_a_parameter_of_a_term_may_be_called_like_a_damping():
    """Only coordinates of the six axes are entries of the matrices."""
    p = Parameters(
        load_vehicle("slocum"), axes=("surge",), damping={"surge": "both"}, extras=("lift_drag.drag",)
    )
    p.names, p.terms = tuple(name.replace(".drag", ".d1") for name in p.names), ()
    assert "lift_drag.d1" in p.names
    assert not changes(p, p.start, {}, {}, unmeasured=(), scaled=False)
