"""Manoeuvres of vehicles with fins, and fits of them."""

import csv

import numpy as np
import pytest

from finssim.evaluation.excitation import PlanSettings, excite
from finssim.identification.manoeuvres import Manoeuvre, Order, manoeuvres, simulate_manoeuvres
from finssim.identification.parameters import Parameters, actuator_fields, scaled_actuators
from finssim.identification.rollout import segments, streams
from finssim.identification.shooting import Point, Shooting
from finssim.identification.simulation_error import fit_by_simulation
from finssim.trials.findings import CalibrationError
from finssim.vehicles import load_vehicle
from reference.torpedo import FIN, hull

TAIL = {**FIN, "area": 0.05, "position": [-0.6, 0.0, 0.0], "time_constant": 0.1, "rate_limit": 1.0}
TORPEDO = hull({"rudder": TAIL, "stern": {**TAIL, "span": [0.0, 1.0, 0.0]}})
TURN = Manoeuvre(
    name="turn",
    axes=("surge", "sway", "yaw"),
    orders=(
        Order(duration=8.0, speed=1.5),
        Order(duration=6.0, speed=1.5, course=0.4),
        Order(duration=6.0, speed=1.5, course=-0.4),
        Order(duration=6.0, speed=1.0, course=0.4, depth=1.0),
        Order(duration=6.0, speed=2.0, course=-0.2),
    ),
)


def test_an_order_holds_until_the_next():
    """Orders are looked up by the time since the start; the last one stays."""
    assert TURN.duration == 32.0
    assert [TURN.at(t).course for t in (0.0, 8.0, 13.99, 14.0, 40.0)] == [0.0, 0.4, 0.4, -0.4, -0.2]


def test_the_set_excites_every_axis_but_roll():
    """Each manoeuvre names its axes and has its own name."""
    chosen = manoeuvres(TORPEDO)
    assert {axis for one in chosen for axis in one.axes} == {"surge", "sway", "heave", "pitch", "yaw"}
    assert len({one.name for one in chosen}) == len(chosen)


def test_tables_for_another_autopilot(tmp_path):
    """`excite --kind manoeuvres` writes the orders; options of other kinds are refused."""
    file = tmp_path / "torpedo.yaml"
    file.write_text("extends: remus100\n", encoding="utf-8")
    folders = excite("all", vehicle=str(file), plan=PlanSettings(kind="manoeuvres"), out=tmp_path / "plan")
    with (folders[1] / "programme.csv").open(encoding="utf-8") as table:
        rows = list(csv.DictReader(table))
    assert list(rows[0]) == ["t", "speed", "course", "depth", "turn"]
    assert {float(row["course"]) for row in rows} == {0.0, 60.0, -60.0}
    assert [float(row["speed"]) for row in rows[-2:]] == [0.0, 0.0]  # the stop, and its end
    with pytest.raises(CalibrationError, match="axes all"):
        excite("surge", vehicle=str(file), plan=PlanSettings(kind="manoeuvres"), out=tmp_path / "other")


def test_a_factor_moves_a_parameter_of_every_actuator_of_a_kind():
    """The parameters of a fit are fins and the inflow of propellers; the results are written to the file."""
    tail = {"rudder": TAIL, "stern": {**TAIL, "lift_slope": 2.0}}
    vehicle = hull(tail, propeller={"inflow": {"thrust_loss": 0.01}})
    fields = actuator_fields(vehicle)
    assert fields["fin.lift_slope"] == {"actuators.fin_1.lift_slope": 3.0, "actuators.fin_2.lift_slope": 2.0}
    assert fields["propeller.thrust_loss"] == {"actuators.propeller_0.thrust_loss": 0.01}
    for name, before in (("fin.lift_slope", [3.0, 2.0]), ("propeller.thrust_loss", [0.01])):
        changed = vehicle.replace(scaled_actuators(vehicle, name, 1.5))
        np.testing.assert_allclose(list(actuator_fields(changed)[name].values()), 1.5 * np.array(before))


@pytest.mark.slow
def test_a_manoeuvre_begins_at_speed_and_ends_in_a_stop():
    """The motion begins at the speed of the first order; while the propeller stands still, the fins keep
    their angle."""
    stop = Manoeuvre(
        name="stop",
        axes=("surge", "yaw"),
        orders=(
            Order(duration=2.0, speed=1.5),
            Order(duration=2.0, speed=1.5, course=1.0),
            Order(duration=3.0, speed=0.0),
        ),
    )
    (trial,) = simulate_manoeuvres([stop], TORPEDO, noise="none", seed=1)
    u, rudder, t = trial.channels["u"], trial.channels["actuator_rudder"], trial.t
    assert 1.4 < u[0] < 1.6
    stopped = t > 4.5
    np.testing.assert_allclose(trial.channels["rpm_propeller"][t > 6.0], 0.0, atol=5.0)
    np.testing.assert_allclose(rudder[stopped], rudder[-1], atol=0.02)
    assert abs(rudder[-1]) > 0.1


@pytest.mark.slow
def test_a_vehicle_that_turns_over_gives_no_trial():
    """REMUS with a third of its lift, which the autopilot of its file cannot hold, gives no trial."""
    vehicle = load_vehicle("remus100")
    weak = vehicle.replace({f"actuators.{name}.lift_slope": 1.0 for name in vehicle.actuators})
    (dive,) = (one for one in manoeuvres(vehicle) if one.name == "dives_slow")
    with pytest.raises(CalibrationError, match="dives_slow: the vehicle turned over"):
        simulate_manoeuvres([dive], vehicle, truth=weak, seed=1)


@pytest.mark.slow
def test_a_fit_finds_what_is_true(monkeypatch):
    """Without noise, from values 15 to 40 % off, drag, added mass and the slope of the fins are within 3 %.

    The fit starts from the file, since the weak form does not include the forces of fins.
    """
    monkeypatch.delattr("finssim.identification.stages.weak_form")
    base = "hydrodynamics.calibrated"
    file = TORPEDO.replace(
        {
            "actuators.*.lift_slope": 2.2, f"{base}.added_mass": [1.0, 22.0, 30.0, 0.1, 4.0, 3.2],
            f"{base}.quadratic_damping": [7.5, 130.0, 100.0, 0.2, 9.0, 9.0],
        }
    )  # fmt: skip
    trials = simulate_manoeuvres([TURN], file, truth=TORPEDO, noise="none", seed=1)
    fit = fit_by_simulation(
        trials, file, axes=("surge", "sway", "yaw"), damping="both", estimate=("fin.lift_slope",)
    )
    found = {name: estimate.estimate for name, estimate in fit.estimates.items()}
    drag = [found[f"surge.d{k}"] for k in (1, 2)] @ np.array([1.5, 1.5**2])
    np.testing.assert_allclose(drag, 2.0 * 1.5 + 6.0 * 1.5**2, rtol=0.03)
    np.testing.assert_allclose(found["sway.added_mass"], 30.0, rtol=0.03)
    np.testing.assert_allclose(found["yaw.m_eff"], 4.0 + TORPEDO.rigid_body_mass_matrix()[5, 5], rtol=0.03)
    np.testing.assert_allclose(found["fin.lift_slope"], 3.0 / 2.2, rtol=0.03)
    np.testing.assert_allclose(fit.changes["actuators.rudder.lift_slope"], 3.0, rtol=0.03)


@pytest.mark.slow
def test_derivatives_of_an_unstable_hull_are_those_of_small_changes():
    """Over 3 s of a zigzag of REMUS a change of the initial velocity grows a hundredfold.

    Along every direction of the initial state that changes readings by at most 0.02, the derivatives predict the
    simulation to 0.003.
    """
    vehicle, axes = load_vehicle("remus100"), ("sway", "heave", "pitch", "yaw")
    (zigzag,) = (one for one in manoeuvres(vehicle) if one.name == "zigzag_fast")
    (trial,) = simulate_manoeuvres([zigzag], vehicle, noise="none", seed=1)
    problem = Shooting(
        segments(streams(trial, vehicle), vehicle, length=3.0),
        Parameters(vehicle, axes=axes, damping=dict.fromkeys(axes, "both")),
        ("u", "v", "w", "p", "q", "r", "roll", "pitch"),
    )
    start = problem.start()
    growth = problem.growth(start)
    assert growth.max() > 100.0
    s, moved = int(growth.argmax()), start._replace(z=start.z + 1e-9)
    rows, states = slice(*problem.edges[s : s + 2]), len(problem.free)
    linear = problem.linearise(moved)
    own = linear.own[rows, :states]
    for direction in np.linalg.svd(own, full_matrices=False)[2]:
        step = direction * min(0.005, 0.02 / np.abs(own @ direction).max())
        z = moved.z.copy()
        z[s, :states] += step
        residual = problem.residuals(Point(moved.theta[None], z[None]))[rows, 0]
        np.testing.assert_allclose(linear.residual[rows] - residual, own @ step, rtol=0, atol=0.003)
