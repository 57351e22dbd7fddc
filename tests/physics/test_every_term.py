"""Laws that every hydrodynamic term obeys: those of the package, of installed packages, and of an example."""
# mypy: disable-error-code="valid-type,misc,index,no-any-return,no-untyped-def,untyped-decorator"

import numpy as np
import pytest
import warp as wp

from finssim.core.registry import TERMS
from finssim.physics.terms.composed import composed, layout, parameter_row
from finssim.physics.types import mat66, vec6, vec8
from finssim.sim import Simulator
from finssim.vehicles import load_vehicle
from finssim.vehicles.terms import unit_of
from reference.examples import example

WING = example("own/term/wing").WING
NAMES = sorted({*TERMS, WING.name})
EVERY = pytest.mark.parametrize("name", NAMES)
RNG = np.random.default_rng(7)
NU = RNG.uniform(-2.0, 2.0, (64, 6))


@pytest.fixture
def term(name):
    TERMS[WING.name] = WING
    return TERMS[name]


def drawn(term, diagonal=False):
    """Return path of each parameter -> positive numbers, or a matrix whose symmetric part is positive definite.

    Lengths are those of a vehicle.
    """
    numbers = {}
    for slot in layout((term,)):
        if unit_of(slot.path) == "m":
            numbers[slot.path] = RNG.uniform(0.5, 2.0)
            continue
        if slot.kind is mat66:
            half = RNG.normal(size=(6, 6))
            matrix = 5.0 * half @ half.T
            numbers[slot.path] = np.diag(np.diag(matrix)) if diagonal else matrix
        else:
            numbers[slot.path] = (
                RNG.uniform(20.0, 40.0, slot.size) if slot.size > 1 else RNG.uniform(20.0, 40.0)
            )
    return numbers


def evaluated(term, role, numbers, nu):
    """Return wrench or slope at velocities, (n, 6)."""
    function = composed((term,), role)

    @wp.kernel(enable_backward=False, module="unique")
    def sample(x: wp.array3d(dtype=float), nu_r: wp.array(dtype=vec6), out: wp.array(dtype=vec6)):
        i = wp.tid()
        out[i] = function(x, 0, 0, nu_r[i], wp.vec3(0.0, 0.0, 1.0), 5.0, 1000.0, vec8())

    row = np.asarray(parameter_row((term,), numbers), np.float32)[None, None]
    out = wp.zeros(len(nu), dtype=vec6, device="cpu")
    inputs = [
        wp.array(row, dtype=float, device="cpu"),
        wp.array(np.asarray(nu, np.float32), dtype=vec6, device="cpu"),
    ]
    wp.launch(sample, dim=len(nu), inputs=[*inputs, out], device="cpu")
    return out.numpy().astype(float)


def value_of(term, numbers):
    """Return the value of the term's key in a vehicle file."""
    plain = {path: np.asarray(number).tolist() for path, number in numbers.items()}
    return plain[term.name] if term.name in plain else {p.partition(".")[2]: x for p, x in plain.items()}


@EVERY
def test_at_rest_it_gives_nothing(term):
    """At zero velocity, with any parameters, there is no wrench."""
    assert not evaluated(term, "wrench", drawn(term), np.zeros((1, 6))).any()


@EVERY
def test_a_damping_term_takes_energy_out(term):
    """nu_r · tau <= 0 for a term that declares the slope of its wrench by velocity."""
    if term.slope is None:
        pytest.skip(f"{term.name} declares no slope: it is no damping")
    for _ in range(4):
        power = (NU * evaluated(term, "wrench", drawn(term), NU)).sum(1)
        assert (power <= 1e-4).all() and (power < -1e-3).any()


@EVERY
def test_its_slope_is_its_derivative(term):
    """-dtau_i/dnu_i by central differences: never more than the slope, and equal to it while going straight ahead.

    Of a matrix its diagonal: the slope is that of each axis alone. Two differences are extrapolated to none: that of
    v|v| about 0 is off by its size.
    """
    if term.slope is None:
        pytest.skip(f"{term.name} declares no slope")
    numbers, h = drawn(term, diagonal=True), 1e-2
    ahead = NU * [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    rounding = 1e-6 * np.abs(evaluated(term, "slope", numbers, NU)).max()
    for nu in (NU, ahead):
        slope, derivative = evaluated(term, "slope", numbers, nu), np.zeros_like(nu)
        for i in range(6):
            for share, weight in ((1.0, -1.0), (0.5, 2.0)):
                step = share * h * np.eye(6)[i]
                pair = [evaluated(term, "wrench", numbers, nu + sign * step)[:, i] for sign in (1.0, -1.0)]
                derivative[:, i] -= weight * (pair[0] - pair[1]) / (2.0 * share * h)
        smooth = np.abs(nu) > h  # |u| has no derivative at 0
        smooth[:, 1:] |= nu is ahead
        atol = 2e-3 * np.abs(slope).max() + rounding  # float32 over 2 h
        assert (slope >= -atol).all() and (slope >= derivative - atol)[smooth].all()
    np.testing.assert_allclose(slope[smooth], derivative[smooth], rtol=0, atol=atol)


@EVERY
def test_its_declared_share_of_quadratic_drag_is_its_drag(term):
    """For motion along one axis alone, in either direction, -tau_i = d2_i v|v|."""
    numbers = drawn(term)
    d2 = term.quadratic(term.read(value_of(term, numbers)))
    for v in (-1.5, 0.5, 2.0):
        alone = np.diag(np.full(6, v))
        found = -np.diag(evaluated(term, "wrench", numbers, alone))
        np.testing.assert_allclose(found, d2 * v * abs(v), rtol=1e-5, atol=1e-5)


def test_the_simulator_accelerates_by_the_wrench_of_each():
    """M (nu' - nu0') = tau, where nu0' is without the term; one step of 50 µs, short compared with 1 / 160 s.

    There is one vehicle for each term, in a world whose kernel has them all.
    """
    TERMS[WING.name] = WING
    terms = [TERMS[name] for name in NAMES]
    base, numbers = "hydrodynamics.calibrated", [drawn(term) for term in terms]
    plain = load_vehicle("bluerov2").replace({f"{base}.reference_point": [0.0, 0.0, 0.0]})
    fitted = [
        plain.replace({f"{base}.{term.name}": value_of(term, its)})
        for term, its in zip(terms, numbers, strict=True)
    ]
    nu, dt = np.array([0.8, -0.3, 0.4, 0.2, -0.5, 0.3]), 5e-5
    sim = Simulator([plain, *fitted], control_step=dt, substeps=1, threads=1)
    sim.place(position=(0.0, 0.0, -5.0), velocity=nu)
    sim.step()
    without, *after = sim.numpy("velocity")[0].astype(float)
    for term, its, velocity in zip(terms, numbers, after, strict=True):
        expected = evaluated(term, "wrench", its, nu[None])[0]
        found = plain.mass_matrix("calibrated") @ (velocity - without) / dt
        np.testing.assert_allclose(
            found, expected, rtol=0.0, atol=0.03 * np.abs(expected).max(), err_msg=term.name
        )
