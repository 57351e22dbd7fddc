"""A hydrodynamic term from outside the package: one file with its definition, and one line to register it."""
# mypy: disable-error-code="valid-type,misc,index,no-any-return,no-untyped-def,untyped-decorator"

import subprocess
import sys

import numpy as np
import pytest
import warp as wp

from finssim.core.registry import RegistryError
from finssim.identification.vehicle_file import write_vehicle
from finssim.physics.terms import Term, add_term
from finssim.physics.terms.composed import TermError, composed
from finssim.physics.types import vec6
from finssim.sim import Simulator
from finssim.sim.ranges_file import RangesError, load_ranges
from finssim.vehicles import VehicleError, check_vehicle, load_vehicle
from reference.draws import column, draw
from reference.examples import EXAMPLES, example
from reference.installed import install

own_term = example("own/term/wing")
WING, Wing, wing_wrench = own_term.WING, own_term.Wing, own_term.wing_wrench

FILE = """
extends: bluerov2
hydrodynamics:
  calibrated:
    wing:
      origin: measured
      source: tow tank
      lift: 40.0
      moment: {value: 1.5, origin: guessed}
"""


@pytest.fixture(autouse=True)
def known():
    """The one line that registers the term; a later test may repeat it."""
    assert add_term(WING) is WING


@pytest.fixture
def winged(tmp_path):
    """The catalogue's vehicle with a wing."""
    (tmp_path / "mine.yaml").write_text(FILE, encoding="utf-8")
    return load_vehicle(tmp_path / "mine.yaml")


def bare(vehicle, **wing):
    """Return a point of diagonal mass 20 kg and 1 kg m² on which only the wing acts."""
    zero = [0.0] * 6
    base = "hydrodynamics.calibrated"
    return vehicle.replace(
        {
            f"{base}.added_mass": zero, f"{base}.linear_damping": zero, f"{base}.quadratic_damping": zero,
            f"{base}.wing": wing, f"{base}.reference_point": [0.0, 0.0, 0.0], "body.mass": 20.0,
            "body.inertia": [1.0, 1.0, 1.0], "body.center_of_gravity": [0.0, 0.0, 0.0],
            "body.center_of_buoyancy": [0.0, 0.0, 0.0], "body.displaced_volume": 20.0 / vehicle.water.density,
        }
    )  # fmt: skip


def test_a_vehicle_file_may_have_it(winged, tmp_path):
    """It is read with its origins, changed, written and read again; the catalogue's vehicle has none."""
    wing = winged.hydrodynamics["calibrated"].wing
    assert (wing.lift, wing.moment) == (40.0, 1.5)
    assert winged.origin_of("hydrodynamics.calibrated.wing.lift").source == "tow tank"
    assert winged.origin_of("hydrodynamics.calibrated.wing.moment").origin == "guessed"
    other = winged.replace({"hydrodynamics.calibrated.wing.lift": 30.0})
    assert other.hydrodynamics["calibrated"].wing.lift == 30.0 and other.sha256 != winged.sha256
    write_vehicle(other, tmp_path / "written.yaml")
    again = load_vehicle(tmp_path / "written.yaml")
    assert again.sha256 == other.sha256 and again.provenance == other.provenance
    assert "lift: {value: 30.0" in (tmp_path / "written.yaml").read_text(encoding="utf-8")
    plain = load_vehicle("bluerov2").hydrodynamics["calibrated"]
    assert plain.wing is None and not plain.terms


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ("lift: -1.0", "bad.yaml: hydrodynamics.calibrated.wing: lift is -1.0, expected >= 0"),
        ("lft: 1.0", "hydrodynamics.calibrated.wing: unknown key 'lft', did you mean 'lift'"),
    ],
)
def test_its_mistakes_are_told_like_those_of_others(tmp_path, change, sentence):
    """The message is one sentence with the file and the key."""
    (tmp_path / "bad.yaml").write_text(FILE.replace("lift: 40.0", change), encoding="utf-8")
    with pytest.raises(VehicleError, match=sentence) as told:
        load_vehicle(tmp_path / "bad.yaml")
    assert len(str(told.value).splitlines()) == 1


def test_show_lists_it_and_its_check_is_made(winged):
    """`finssim vehicles show` prints its numbers with their marks; a wing that violates its check is
    reported."""
    from io import StringIO

    from rich.console import Console

    from finssim.vehicles.show import print_vehicle

    page = StringIO()
    print_vehicle(winged, Console(file=page, width=120))
    assert "wing.lift" in page.getvalue() and "1.5 ?" in page.getvalue() and "N s²/m²" in page.getvalue()
    page = StringIO()
    print_vehicle(
        believed(3.0).replace({"hydrodynamics.calibrated.wing": {"lift": 7.0}}), Console(file=page, width=120)
    )
    assert "7 ?" in page.getvalue() and "wing.moment" in page.getvalue()
    large = winged.replace({"hydrodynamics.calibrated.wing.lift": 900.0})
    findings = {finding.name: finding for finding in check_vehicle(large)}
    assert not findings["wing (calibrated)"].passed
    assert "900" in findings["wing (calibrated)"].sentence


@pytest.mark.slow
@pytest.mark.parametrize("worlds", [1, 21])
def test_the_simulator_feels_it(winged, worlds):
    """m w' = -lift u w + m q u ..., I q' = -moment u q at constant u: q = q0 exp(-moment u t), w by quadrature.

    u is held by giving surge no force: without pitch it stays. So q0 = 0 in one run, and w = w0 exp(-lift u t/m) with
    u'= 0; and w0 = 0 with a small q0 in the other, where u and w change by the turning alone: |nu| stays.
    """
    u, t = 0.8, 2.0
    vehicle = bare(winged, lift=15.0, moment=1.5)
    sim = Simulator(vehicle, worlds=worlds, control_step=0.05, substeps=2, threads=1)
    sim.place(position=(0.0, 0.0, -5.0), velocity=(u, 0.0, 0.1, 0.0, 0.0, 0.0))
    for _ in range(round(t / 0.05)):
        sim.step()
    nu = sim.numpy("velocity")[:, 0]
    np.testing.assert_allclose(nu[:, 0], u, rtol=1e-6)
    np.testing.assert_allclose(nu[:, 2], 0.1 * np.exp(-15.0 * u * t / 20.0), rtol=2e-3)
    sim.place(position=(0.0, 0.0, -5.0), velocity=(u, 0.0, 0.0, 0.0, 1e-3, 0.0))
    for _ in range(round(t / 0.05)):
        sim.step()
    np.testing.assert_allclose(sim.numpy("velocity")[:, 0, 4], 1e-3 * np.exp(-1.5 * u * t), rtol=2e-3)


@pytest.mark.slow
def test_blocks_of_worlds_feel_it_as_single_worlds_do(monkeypatch, winged):
    """The traced path of eight worlds agrees with the kernel for one, with a different wing in each world."""
    runs = []
    for lanes in (True, False):
        monkeypatch.setattr(Simulator, "in_lanes", property(lambda self, lanes=lanes: lanes))
        sim = Simulator(winged, worlds=19, threads=1)
        sim.plant.fields["wing.lift"].assign(np.linspace(0.0, 80.0, 19, dtype=np.float32)[:, None])
        sim.refresh()
        sim.place(position=(0.0, 0.0, -5.0), velocity=(0.8, 0.1, 0.2, 0.0, 0.1, 0.0))
        for _ in range(10):
            sim.step()
        runs.append(sim.numpy("velocity")[:, 0].copy())
    assert np.all(np.diff(runs[0][:, 2]) < 0.0), "the larger the wing, the less heave is left"
    np.testing.assert_allclose(runs[0], runs[1], rtol=0, atol=2e-6)


@pytest.mark.slow
def test_a_stiff_one_does_not_run_away(winged):
    """Its slope is integrated implicitly: at 60 times the explicit limit w still decays."""
    vehicle = bare(winged, lift=20000.0, moment=0.0)
    sim = Simulator(vehicle, control_step=0.1, substeps=2, threads=1)
    sim.place(position=(0.0, 0.0, -5.0), velocity=(0.8, 0.0, 0.1, 0.0, 0.0, 0.0))
    for _ in range(40):
        sim.step()
    assert abs(sim.numpy("velocity")[0, 0, 2]) < 1e-3


@pytest.mark.slow
def test_beside_vehicles_without_it(winged):
    """Of two vehicles in a world, one with a wing, the other moves bit for bit as without it."""
    plain = load_vehicle("bluerov2")
    both, alone = (Simulator(pair, threads=1) for pair in ([plain, winged], [plain, plain]))
    for sim in (both, alone):
        sim.place(position=[(0.0, 0.0, -5.0), (0.0, 3.0, -5.0)], velocity=(0.8, 0.0, 0.3, 0.0, 0.0, 0.0))
        for _ in range(10):
            sim.step()
    one, other = both.numpy("velocity")[0], alone.numpy("velocity")[0]
    np.testing.assert_allclose(one[0], other[0], rtol=1e-5, atol=1e-6)
    assert abs(one[1, 2] - other[1, 2]) > 0.01


RANGES = "wing: {lift: [0.5, 1.5], added_moment: [-1.0, 1.0]}\n"


@pytest.mark.slow
def test_its_parameters_are_drawn_by_name(winged, tmp_path):
    """A factor on the file's lift and an addition to its moment; other parameters keep their values."""
    (tmp_path / "ranges.yaml").write_text(RANGES, encoding="utf-8")
    ranges = load_ranges(tmp_path / "ranges.yaml")
    simulator, draws = draw(ranges.model_dump(include={"terms"}), worlds=40, vehicles=winged)
    assert set(draws.names) == {"wing.lift", "wing.added_moment"}
    lift, moment = column(draws, "wing.lift"), column(draws, "wing.added_moment")
    assert 0.5 <= lift.min() < 0.7 and 1.3 < lift.max() <= 1.5 and abs(np.corrcoef(lift, moment)[0, 1]) < 0.5
    fields = simulator.plant.fields
    np.testing.assert_allclose(fields["wing.lift"].numpy()[:, 0], 40.0 * lift, rtol=1e-6)
    np.testing.assert_allclose(fields["wing.moment"].numpy()[:, 0], 1.5 + moment, rtol=1e-5)


def test_ranges_of_a_record_read_back(tmp_path):
    """The ranges saved by a training name the same entries when read again."""
    from finssim.sim.ranges_file import Ranges

    (tmp_path / "ranges.yaml").write_text(RANGES + "surge_damping: [0.9, 1.1]\n", encoding="utf-8")
    kept = load_ranges(tmp_path / "ranges.yaml").model_dump(mode="json")
    again = Ranges.model_validate(kept)
    assert set(again.terms) == {"wing.lift", "wing.added_moment", "surge_damping"}
    assert again.model_dump(mode="json") == kept
    with pytest.raises(ValueError, match="wign"):
        Ranges.model_validate({**kept, "terms": {"wign.lift": [0.5, 1.5]}})


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("wing: {lift: [1.5, 0.5]}", "wing.lift: is .1.5, 0.5., expected"),
        ("wing: {lft: [0.5, 1.5]}", "wing: unknown entry 'wing.lft'; did you mean 'wing.lift'"),
        ("wing: [0.5, 1.5]", "expected ranges of wing.lift"),
        ("wign: {lift: [0.5, 1.5]}", "unknown entry 'wign'"),
    ],
)
def test_ranges_that_cannot_be_are_refused(tmp_path, text, sentence):
    (tmp_path / "ranges.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(RangesError, match=sentence):
        load_ranges(tmp_path / "ranges.yaml")


@wp.func
def pushing(nu_r: vec6, lift: float, moment: float) -> vec6:
    """Return a force even at rest."""
    return vec6(1.0, lift, moment, 0.0, 0.0, 0.0)


@wp.func
def curious(nu_r: vec6, lift: float, moment: float, colour: float) -> vec6:
    """Take a parameter that does not exist."""
    return vec6(lift, moment, colour, 0.0, 0.0, 0.0)


def test_a_term_that_cannot_be_is_refused():
    """Refused are a duplicate name, a reserved key, an unknown argument, a missing unit, and a wrench at
    rest."""
    units, parts = WING.units, {"schema": Wing, "units": WING.units, "wrench": wing_wrench}
    for term, sentence in (
        (Term(name="wing", **parts), "there is a term 'wing' already"),
        (Term(name="linear_damping", **parts), "cannot be named 'linear_damping'"),
        (
            Term(name="fin", schema=Wing, units=units, wrench=curious),
            "has the argument 'colour: float', expected of: nu_r",
        ),
        (
            Term(name="fin", schema=Wing, units={"lift": "N"}, wrench=wing_wrench),
            "has units of lift, expected",
        ),
    ):
        with pytest.raises((TermError, RegistryError), match=sentence):
            add_term(term)
    with pytest.raises(TermError, match="not zero when all its parameters are"):
        composed((Term(name="fin", schema=Wing, units=units, wrench=pushing),), "wrench")


@pytest.fixture(scope="module")
def trials():
    """Simultaneous multisines on surge and heave of the vehicle with the wing, with noise of its sensors."""
    from finssim.identification.programme import programmes
    from finssim.identification.synthetic import simulate_programme

    vehicle = load_vehicle("bluerov2").replace(
        {"hydrodynamics.calibrated.wing": {"lift": 40.0, "moment": 1.5}}
    )
    return simulate_programme(programmes(("surge", "heave"), vehicle, kind="multisine"), vehicle, seed=3)


def believed(lift):
    """Return the vehicle with a wrong value of the lift."""
    return load_vehicle("bluerov2").replace({"hydrodynamics.calibrated.wing": {"lift": lift, "moment": 1.5}})


@pytest.mark.slow
def test_a_calibration_estimates_its_parameter(trials, tmp_path):
    """From a file with 0, trials give 40 N s²/m² within the interval, which is narrower than a tenth."""
    from finssim.identification.simulation_error import fit_by_simulation
    from finssim.identification.vehicle_file import calibrated, write_ranges

    fit = fit_by_simulation(trials, believed(0.0), axes=("surge", "heave"), estimate=("wing.lift",))
    found = fit.estimates["wing.lift"]
    assert found.identifiable and found.unit == "N s²/m²"
    assert found.ci95[0] <= 40.0 <= found.ci95[1] and np.ptp(found.ci95) < 4.0
    vehicle = calibrated(fit)
    assert vehicle.hydrodynamics["calibrated"].wing.lift == pytest.approx(found.estimate, rel=1e-6)
    assert vehicle.origin_of("hydrodynamics.calibrated.wing.lift").origin == "measured"
    write_vehicle(vehicle, tmp_path / "fitted.yaml")
    assert load_vehicle(tmp_path / "fitted.yaml").sha256 == vehicle.sha256
    write_ranges(fit, tmp_path / "ranges.yaml", vehicle)
    assert set(load_ranges(tmp_path / "ranges.yaml").terms) == {"wing.lift", "wing.moment"}


@pytest.mark.slow
def test_a_known_wing_does_not_bias_what_is_fitted(trials):
    """From trials with a wing, heave damping equals the file's if the file has the wing, and not otherwise."""
    from finssim.identification.simulation_error import fit_by_simulation

    vehicle = believed(40.0)
    chosen = vehicle.hydrodynamics["calibrated"]
    drag = lambda fit: sum(fit.estimates[f"heave.d{i}"].estimate * 0.4**i for i in (1, 2))  # noqa: E731
    true = chosen.linear_damping[2, 2] * 0.4 + chosen.quadratic_damping[2, 2] * 0.4**2
    assert drag(fit_by_simulation(trials, vehicle, axes=("heave",))) == pytest.approx(true, rel=0.03)
    assert drag(fit_by_simulation(trials, load_vehicle("bluerov2"), axes=("heave",))) > 1.2 * true


@pytest.mark.slow
def test_a_parameter_that_the_vehicle_does_not_have_is_refused(trials):
    from finssim.identification.simulation_error import fit_by_simulation
    from finssim.trials.findings import CalibrationError

    for vehicle, name in ((load_vehicle("bluerov2"), "wing.lift"), (believed(1.0), "wing.lft")):
        with pytest.raises(CalibrationError, match=f"cannot estimate '{name}'"):
            fit_by_simulation(trials, vehicle, axes=("heave",), estimate=(name,))


def test_the_page_shows_the_example():
    """The page contains the code word for word, so readers see the code that runs."""
    page = (EXAMPLES.parent / "docs" / "reference" / "terms.md").read_text(encoding="utf-8")
    assert f"```py\n{(EXAMPLES / 'own/term/wing.py').read_text(encoding='utf-8')}```" in page


@pytest.mark.slow
def test_the_example_runs():
    """The wing damps heave."""
    run = subprocess.run(
        [sys.executable, EXAMPLES / "own/term/wing.py"], capture_output=True, text=True, check=True
    )
    without, with_wing = (
        float(line.split()[-2]) for line in run.stdout.splitlines() if line.startswith("heave")
    )
    assert with_wing < 0.8 * without


PACKAGE = """
import warp as wp
from finssim.physics.terms import Term
from finssim.physics.types import vec6
from finssim.vehicles.part import NonNegative

@wp.func
def fin_wrench(nu_r: vec6, fin_drag: float) -> vec6:
    return vec6(0.0, -fin_drag * nu_r[1], 0.0, 0.0, 0.0, 0.0)

FIN_DRAG = Term(name="fin_drag", schema=NonNegative, units={"fin_drag": "N s/m"}, wrench=fin_wrench)
"""


def test_an_installed_package_brings_its_own(tmp_path, monkeypatch):
    """A key that is not imported anywhere is found by a package's entry point, also by the commands."""
    install(tmp_path, monkeypatch, "finned", PACKAGE, {"terms": {"fin_drag": "finned:FIN_DRAG"}})
    vehicle = load_vehicle("bluerov2").replace({"hydrodynamics.calibrated.fin_drag": 3.0})
    assert vehicle.hydrodynamics["calibrated"].term_parameters == {"fin_drag": 3.0}
    with pytest.raises(VehicleError, match="fin_drag is -3.0, expected >= 0"):
        vehicle.replace({"hydrodynamics.calibrated.fin_drag": -3.0})
    (tmp_path / "ranges.yaml").write_text("fin_drag: [0.5, 2.0]\n", encoding="utf-8")
    assert load_ranges(tmp_path / "ranges.yaml").terms == {"fin_drag": (0.5, 2.0)}


def test_a_term_of_a_package_without_a_unit_is_refused_in_one_sentence(tmp_path, monkeypatch):
    """The sentence names package and object; a vehicle without the key still loads."""
    bad = PACKAGE.replace('units={"fin_drag": "N s/m"}', "units={}")
    install(tmp_path, monkeypatch, "finless", bad, {"terms": {"fin_drag": "finless:FIN_DRAG"}})
    with pytest.raises(
        VehicleError, match="'fin_drag' of package finless 1.0 cannot be used: finless:FIN_DRAG"
    ):
        load_vehicle("bluerov2").replace({"hydrodynamics.calibrated.fin_drag": 3.0})
    assert load_vehicle("bluerov2").name == "bluerov2"
