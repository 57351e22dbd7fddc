"""Columns of fins and other actuators in a trial."""

import numpy as np
import pytest

from finssim.identification.programme import Programme
from finssim.identification.synthetic import simulate_programme
from finssim.trials.findings import CalibrationError
from finssim.trials.inputs import applied_wrench, drive
from finssim.trials.trial import Trial
from reference.torpedo import FIN, hull

TORPEDO = hull({"rudder": {**FIN, "time_constant": 0.1, "rate_limit": 1.0}})


def trial(**channels):
    t = np.arange(0.0, 3.0, 0.1)
    values = {"rpm_propeller": 600.0, "actuator_rudder": 0.1, "u": 1.0} | channels
    columns = {name: np.full(len(t), x) for name, x in values.items() if x is not None}
    return Trial(name="run", t=t, channels=columns)


def test_they_are_channels_after_the_thrusters():
    """Thrust comes by the curve, then the angle; the wrench of the inputs contains the thrusters' part alone."""
    inputs = drive(trial(), TORPEDO)
    assert inputs.names == ("propeller", "rudder") and inputs.thrusters
    np.testing.assert_allclose(inputs.force[0], [1.6e-3 * (600.0 * np.pi / 30.0) ** 2, 0.1])
    tau = applied_wrench(inputs, TORPEDO, np.array([1.0]))
    np.testing.assert_allclose(tau[0], [inputs.force[0, 0], 0, 0, 0, 0, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("channels", "words"),
    [
        ({"actuator_rudder": None}, "actuator_rudder is missing"),
        ({"actuator_ruder": 0.0}, "no such actuator, did you mean 'actuator_rudder'"),
        ({"rpm_propeller": None, "tau_x": 10.0}, "the inputs are a wrench"),
    ],
)
def test_what_cannot_be_is_refused(channels, words):
    """Refused are a missing or unknown actuator, and a wrench in place of the thrusters' inputs."""
    with pytest.raises(CalibrationError, match=words):
        drive(trial(**channels), TORPEDO)


def test_synthetic_trials_log_them():
    """Applied values follow the command, which each step may give, with lag and rate limit."""
    n = 100
    programme = Programme(
        name="turn",
        axes=("surge", "yaw"),
        rate=50.0,
        tau_desired=np.zeros((n, 6)),
        phase=np.full(n, "excitation"),
    )

    def helm(sim):
        sim.command.thrust.numpy()[:, 0, :2] = 20.0, 0.3

    applied, commanded = (
        simulate_programme([programme], TORPEDO, noise="none", each_step=helm, inputs=inputs)[0].channels
        for inputs in (("rpm",), ("command",))
    )
    t = np.arange(n) / 50.0
    expected = np.where(t < 0.2, t, 0.3 - 0.1 * np.exp(-(t - 0.2) / 0.1))
    np.testing.assert_allclose(applied["actuator_rudder"], expected, atol=2e-3)
    np.testing.assert_allclose(commanded["actuator_rudder"], 0.3, rtol=1e-6)
