"""Gates pass the stated share of valid measurements, and accept a run of refused ones that is self-consistent."""

import numpy as np
import pytest

from finssim.localization.fusion.gates import GateMemory, OutlierGate, due, judge, judge_carried, remember


@pytest.mark.parametrize("dimension", [1, 2, 3])
@pytest.mark.parametrize("probability", [0.95, 0.999])
def test_the_limit_passes_its_share(dimension, probability):
    """Squared lengths of standard normal vectors of that dimension are below the limit with that probability."""
    draws = np.random.default_rng(0).standard_normal((200000, dimension))
    passed = np.mean(np.sum(draws**2, axis=1) <= OutlierGate(probability).limit(dimension))
    assert passed == pytest.approx(probability, abs=4 * np.sqrt(probability * (1 - probability) / 200000))


@pytest.mark.parametrize("carried", [False, True])
def test_an_outlier_is_what_lies_beyond_the_limit(carried):
    """At 99.9 % of chi-square, a yaw passes at 10.82 and not at 10.84, a position in the plane at 13.8 and
    not at 13.9."""

    def verdict(distance, dimension):
        memory, R = GateMemory(5), 1e-4 * np.eye(dimension)
        if dimension == 1 and carried:
            return judge_carried(OutlierGate(), memory, 0.0, 0.03, 1e-4, distance, 0.05)[0]
        return judge(OutlierGate(), memory, 0.0, np.zeros(dimension), R, distance, 0.3)[0]

    assert [verdict(10.82, 1), verdict(10.84, 1)] == ["accepted", "gate"]
    assert [verdict(13.8, 2), verdict(13.9, 2)] == ["accepted", "gate"]


def refused(gate, values, period=0.1, variance=1e-4, support=5):
    """Return verdicts on distant measurements, for a state supported by a number of others."""
    memory, verdicts, R = GateMemory(support), [], variance * np.eye(len(values[0]))
    for k, value in enumerate(values):
        verdict, memory = judge(gate, memory, k * period, np.asarray(value, float), R, 1e6, 0.3)
        verdicts.append(verdict)
    return verdicts


def test_a_run_that_agrees_takes_over_in_time():
    """Refused for a second at 10 Hz, the run is accepted with the eleventh measurement."""
    assert refused(OutlierGate(), [(5.0, 1.0)] * 11) == ["gate"] * 10 + ["reacquired"]


def test_a_slow_stream_needs_its_number():
    """At 1 Hz five measurements are required, not two."""
    assert refused(OutlierGate(), [(5.0, 1.0)] * 5, period=1.0) == ["gate"] * 4 + ["reacquired"]


def test_scattered_outliers_never_take_over():
    """Inconsistent measurements are refused forever."""
    values = np.random.default_rng(2).uniform(-50, 50, (200, 2))
    assert set(refused(OutlierGate(), values)) == {"gate"}


def test_outliers_in_between_do_not_stop_a_run():
    """With every third measurement an outlier, the run is still accepted in time."""
    values = [(5.0, 1.0) if k % 3 else (np.sin(k) * 40, 30.0) for k in range(1, 20)]
    assert "reacquired" in refused(OutlierGate(), values)[:13]


def test_the_run_may_move():
    """Measurements of a vehicle that moves while it is refused count as consistent."""
    assert refused(OutlierGate(), [(5.0 + 0.03 * k, 1.0) for k in range(11)])[-1] == "reacquired"


def test_a_gate_that_never_gives_in():
    """With `reacquire_after` of infinity, a run of refused measurements is never accepted."""
    assert set(refused(OutlierGate(reacquire_after=np.inf), [(5.0, 1.0)] * 100)) == {"gate"}


def test_an_accepted_measurement_clears_the_memory():
    """A measurement that passes ends the run."""
    gate, R = OutlierGate(), np.eye(1)
    suspects = remember(None, 0.0, np.ones(1), R, 0.3, gate)
    assert not due(suspects, gate)
    verdict, memory = judge(gate, GateMemory(5, suspects), 0.1, np.ones(1), R, 0.5, 0.3)
    assert (verdict, memory) == ("accepted", GateMemory(5))


def test_a_first_measurement_is_outvoted_by_the_next_two():
    """A state started from an outlier is replaced by two that agree, and then kept once five have supported it."""
    assert refused(OutlierGate(), [(5.0, 1.0)] * 2, support=1) == ["gate", "reacquired"]
    assert refused(OutlierGate(), [(5.0, 1.0)] * 4, support=3) == ["gate"] * 3 + ["reacquired"]
    assert refused(OutlierGate(reacquire_after=np.inf), [(5.0, 1.0)] * 9, support=1) == ["gate"] * 9
