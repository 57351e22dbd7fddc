"""The weak form gives initial values near the truth, and none where the trials determine no inertia."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.identification.rollout import streams
from finssim.identification.weak_form import weak_form
from identification.known_trials import trials, truth


@pytest.mark.parametrize(
    ("name", "axis"), [("finsrov", "surge"), ("bluerov2_heavy", "heave"), ("finsrov", "yaw")]
)
def test_start_values_are_near_the_truth(name, axis):
    """In steps with the noise of real sensors, inertia is within 15 %, drag at the top speed within a twentieth."""
    vehicle, some = trials(name, axis)
    expected, prepared = truth(vehicle), [streams(t, vehicle) for t in some]
    found = weak_form(prepared, axis, vehicle, {}).values
    assert found["m_eff"] == pytest.approx(expected[f"{axis}.m_eff"], rel=0.15)
    i = {"surge": 0, "heave": 2, "yaw": 5}[axis]
    top = max(float(np.nanpercentile(np.abs(s.motion.nu[:, i]), 99.0)) for s in prepared)
    force, true = (
        d1 * top + d2 * top**2
        for d1, d2 in ((found["d1"], found["d2"]), (expected[f"{axis}.d1"], expected[f"{axis}.d2"]))
    )
    assert force == pytest.approx(true, rel=0.05)


def test_a_late_motion_is_no_inertia():
    """For velocities logged 60 ms late, the lag is found, and the inertia is unchanged."""
    vehicle, some = trials("bluerov2_heavy", "surge")
    late = [
        replace(
            t,
            channels={
                n: np.interp(t.t - 0.06, t.t, c) if n in "uvwpqr" else c for n, c in t.channels.items()
            },
        )
        for t in without_places(some)
    ]
    found = weak_form([streams(t, vehicle) for t in late], "surge", vehicle, {}).values
    assert found["late"] == pytest.approx(0.06, abs=0.03)
    assert found["m_eff"] == pytest.approx(truth(vehicle)["surge.m_eff"], rel=0.1)


def without_places(some):
    """Return trials whose only velocity is the logged one."""
    return [
        replace(t, channels={n: c for n, c in t.channels.items() if n not in ("x", "y", "z")}) for t in some
    ]


def test_numbers_that_are_known_are_kept():
    """A given inertia is kept, and the drag follows from it."""
    vehicle, some = trials("finsrov", "surge")
    found = weak_form([streams(t, vehicle) for t in some], "surge", vehicle, {"m_eff": 30.0}).values
    assert found["m_eff"] == 30.0 and found["d1"] > 0.0


def test_trials_that_show_nothing_give_no_start():
    """An axis that was not measured has no value."""
    vehicle, some = trials("finsrov", "yaw")
    prepared = [streams(t, vehicle) for t in some]
    unknown = [replace(s, motion=replace(s.motion, nu=np.full_like(s.motion.nu, np.nan))) for s in prepared]
    assert weak_form(unknown, "yaw", vehicle, {}).values == {}


def test_bursts_of_a_wrong_wrench_are_found_and_lose_their_weight():
    """With two quarters of a second of three times the largest wrench per trial, mass is within 5 %; clean
    trials have none."""
    vehicle, some = trials("bluerov2_heavy", "surge")
    assert weak_form([streams(t, vehicle) for t in some], "surge", vehicle, {}).jolts == []
    bad = [with_bursts(t, j) for j, t in enumerate(some)]
    found = weak_form([streams(t, vehicle) for t, _ in bad], "surge", vehicle, {})
    assert found.values["m_eff"] == pytest.approx(truth(vehicle)["surge.m_eff"], rel=0.05)
    assert len(found.jolts) >= 6
    for g, begin, end in found.jolts:
        assert any(begin < at < end for at in bad[g][1])


def with_bursts(trial, j):
    """Return the trial with two bursts of the wrench, and the times of their middles [s]."""
    channels = {n: c for n, c in trial.channels.items() if not n.startswith("rpm")}
    tau, times = channels["tau_x"].copy(), []
    most = 3.0 * np.nanmax(np.abs(tau))
    for k, at in enumerate((0.35, 0.6)):
        begin = int(at * len(tau))
        tau[begin : begin + 12] += most * (-1) ** (j + k + 1)
        times.append(float(trial.t[begin + 6]))
    return replace(trial, channels=channels | {"tau_x": tau}), times
