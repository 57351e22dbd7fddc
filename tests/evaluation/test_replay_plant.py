"""The hidden plant of the replay experiment is physical, near the published values and unlike each model."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from finssim.identification.programme import programmes
from finssim.sim import Simulator
from finssim.studies.replay import ReplayPlant
from finssim.vehicles import load_vehicle

FINSROV = load_vehicle("finsrov")
PLANT = ReplayPlant()


def test_the_plant_couples_axes_that_every_model_of_the_file_keeps_apart():
    """Sway couples with roll, and surge with heave and pitch."""
    for matrix in (PLANT.added_mass.matrix(), PLANT.linear_damping.matrix()):
        scale = np.sqrt(np.outer(np.diag(matrix), np.diag(matrix)))
        relative = np.abs(matrix / scale)
        for i, j in ((1, 3), (0, 4), (0, 2)):
            assert relative[i, j] > 0.02


def forces_at(nu, thrust):
    """Return the plant's extra wrench and gains for one state."""
    sim = Simulator(FINSROV, hydrodynamics="mesh", control_step=0.005, substeps=1)
    sim.place(position=(0.0, 0.0, -5.0), velocity=nu)
    sim.numpy("actuator")[0, 0] = thrust
    PLANT.forces(FINSROV)(sim)
    return sim.command.disturbance.numpy()[0, 0].copy(), sim.plant.gain.numpy()[0, 0].copy()


@settings(max_examples=25)
@given(nu=st.tuples(*[st.floats(-0.5, 0.5)] * 3, *[st.floats(-1.5, 1.5)] * 3))
def test_the_coupled_damping_never_adds_energy(nu):
    tau, _ = forces_at(nu, np.zeros(8))
    assert float(np.dot(tau, nu)) <= 1e-6


def test_a_lone_propeller_at_rest_gives_its_bollard_thrust():
    _, gain = forces_at(np.zeros(6), [0, 0, 0, 0, 5.0, 0, 0, 0])
    assert gain[4] == pytest.approx(1.0)


def test_propellers_take_thrust_from_their_neighbours_and_from_their_own_motion():
    """With all horizontals on surge, each loses thrust; moving ahead they lose more, backwards less."""
    thrust = [0, 0, 0, 0, 4.0, 4.0, -4.0, -4.0]
    still, ahead, astern = (forces_at([u, 0, 0, 0, 0, 0], thrust)[1][4:] for u in (0.0, 0.4, -0.4))
    assert ((0.85 < still) & (still < 0.99)).all()
    assert (ahead < still - 0.05).all() and (astern > still + 0.05).all()


@pytest.mark.slow
@pytest.mark.parametrize(("axis", "level"), [("surge", 12.0), ("sway", 9.0), ("heave", 9.0), ("yaw", 1.2)])
def test_the_total_drag_is_within_a_quarter_of_the_published(axis, level):
    """At the steady speed, the published drag d1 v + d2 v² is within a quarter of the applied middle level."""
    plan = programmes(axis, FINSROV, levels=[level])[:1]
    recording = PLANT.record(plan, FINSROV, seed=1)
    k = ("surge", "sway", "heave", "roll", "pitch", "yaw").index(axis)
    end = int(10.9 / recording.step)
    speed = float(recording.velocity[end - 200 : end, 0, k].mean())
    d = FINSROV.hydrodynamics["calibrated"]
    published = d.linear_damping[k, k] * speed + d.quadratic_damping[k, k] * speed**2
    assert published == pytest.approx(level, rel=0.25)


def test_telemetry_hides_what_the_propellers_lose():
    """Logged speeds give the nominal thrust, level over the axis, although less acts."""
    trial = PLANT.trials(programmes("surge", FINSROV, levels=[12.0])[:1], FINSROV, seed=1)[0]
    steady = (trial.t > 8.0) & (trial.t < 10.5)
    logged = 0.0
    for name, thruster in FINSROV.thrusters.items():
        omega = trial.channels[f"rpm_{name}"][steady] * 2.0 * np.pi / 60.0
        c = np.where(omega > 0.0, thruster.c_plus, thruster.c_minus)
        logged += thruster.axis[0] * float(np.mean(c * omega * np.abs(omega)))
    assert logged == pytest.approx(12.0, rel=0.02)
