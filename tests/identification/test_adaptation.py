"""Changes of a vehicle during a drive: payload, weak thruster and drag, in simulated driving with known truth."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from finssim.core.rotations import quat_from_euler
from finssim.identification.adaptation import (
    WINDOW,
    Adaptation,
    Follower,
    _thinned,
    _whitened,
    calibrate_changes,
    windows_of,
)
from finssim.identification.programme import multisine
from finssim.identification.synthetic import simulate_programme
from finssim.sim.plant_arrays import vehicle_parameters
from finssim.trials.findings import CalibrationError
from finssim.trials.trial_files import write_trial
from finssim.vehicles import load_vehicle

VEHICLE = load_vehicle("finsrov")
NOMINAL = vehicle_parameters(VEHICLE, "calibrated")
PLAY = {"surge": 8.0, "sway": 6.0, "heave": 6.0, "roll": 0.3, "pitch": 0.3, "yaw": 1.0}
GRAVITY = VEHICLE.water.density * VEHICLE.water.gravity
WEAK = VEHICLE.thruster_names.index("H_LB")


def weak_thruster():
    gain = np.array(NOMINAL["gain"], float)
    gain[WEAK] = 0.7
    return {"gain": gain}


def payload():
    """Return a plant that weighs 6 N more in water, 0.1 m in front of the body origin."""
    before, centre = VEHICLE.body.displaced_volume, np.array(VEHICLE.body.center_of_buoyancy)
    volume = before - 6.0 / GRAVITY
    return {"volume": volume, "r_b": (before * centre - np.array([0.6, 0.0, 0.0]) / GRAVITY) / volume}


def fouled():
    return {name: 1.3 * np.array(NOMINAL[name], float) for name in ("D1", "D2")}


@cache
def driven(plant=dict, seed=1):
    """Return a trial of all axes with the noise of the vehicle's sensors; `plant` gives its differences from
    the file."""
    programme = multisine(PLAY, VEHICLE, seed=seed, duration=28.0, band=(0.1, 1.0))
    columns = ("u", "v", "w", "p", "q", "r", "roll", "pitch", "yaw", "x", "y", "z")
    options = {"inputs": ("command",), "columns": columns, "noise": "sensors"}
    return simulate_programme([programme], VEHICLE, seed=seed, plant=plant(), **options)[0]


@pytest.mark.slow
def test_motors_that_stand_still_below_their_slowest_speed_are_not_weak():
    """If small commands do not turn the vertical motors, no change is reported."""
    vertical = [name.startswith("V") for name in VEHICLE.thruster_names]

    def stand_still(simulator):
        simulator.command.thrust.numpy()[:, 0, vertical] = 0.0

    plan = multisine({"surge": 8.0, "sway": 6.0, "yaw": 1.0}, VEHICLE, seed=3, duration=28.0, band=(0.1, 1.0))
    columns = ("u", "v", "w", "p", "q", "r", "roll", "pitch", "yaw", "x", "y", "z")
    options = {"inputs": ("command",), "columns": columns, "noise": "sensors", "each_step": stand_still}
    trial = simulate_programme([plan], VEHICLE, seed=3, **options)[0]
    for k in np.flatnonzero(vertical):
        name, thruster = VEHICLE.thruster_names[k], VEHICLE.thrusters[VEHICLE.thruster_names[k]]
        low, high = thruster.thrust(
            np.array([thruster.dead_rpm_minus, thruster.dead_rpm_plus]) * np.pi / 30.0
        )
        share = 0.5 + 0.49 * np.sin(2.0 * np.pi * (0.2 + 0.07 * k) * trial.t)
        trial.channels[f"command_{name}"] = low + (high - low) * share
    followed = Adaptation(VEHICLE)
    for window in windows_of(trial, VEHICLE):
        followed.update(window)
    assert not [name for name, e in followed.estimates.items() if e.identifiable]


@pytest.mark.parametrize("end", (4.999999999999998, 5.0, 5.05))
def test_times_that_are_rounded_are_thinned(end):
    """Times are thinned to tenths of a second, even if the last lies a rounding error after the last sample."""
    segment = next(windows_of(driven(), VEHICLE))[0]
    t = np.linspace(0.0, end, 101)
    (thin, values) = _thinned(replace(segment, measured={"u": (t, t)})).measured["u"]
    assert len(thin) == 51 and np.array_equal(thin, values) and np.diff(thin).min() > 0.09


def followed(*trials):
    adaptation = Adaptation(VEHICLE)
    for trial in trials:
        for window in windows_of(trial, VEHICLE):
            adaptation.update(window)
    return adaptation


def differing(adaptation):
    return {name for name, estimate in adaptation.estimates.items() if estimate.identifiable}


CASES = {
    "payload": (payload, {"weight": 6.0, "weight_x": 0.6}),
    "thruster": (weak_thruster, {"thruster.H_LB": 0.7}),
    "drag": (fouled, {"drag": 1.3}),
    "nothing": (dict, {}),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_what_changed_is_found_and_nothing_else(case):
    """Within 30 s, the interval contains the truth and excludes the file's value; no other estimate differs."""
    plant, truth = CASES[case]
    adaptation = followed(driven(plant))
    assert differing(adaptation) == set(truth)
    for name, value in truth.items():
        low, high = adaptation.estimates[name].ci95
        assert low <= value <= high


@pytest.mark.slow
def test_a_sudden_change_is_followed_at_once():
    """After 60 s without change, the first window with a payload renews the estimate, which contains the new weight."""
    adaptation = followed(driven(), driven(seed=2))
    assert differing(adaptation) == set() and adaptation.renewed == []
    adaptation.update(next(windows_of(driven(payload, seed=3), VEHICLE)))
    assert adaptation.renewed == [adaptation.windows]
    low, high = adaptation.estimates["weight"].ci95
    assert low <= 6.0 <= high and low > 3.0


@pytest.mark.slow
def test_the_adapted_vehicle_moves_as_the_changed_one():
    """Forces are those of the changed plant: volume and centre, thrust, drag; all other values are unchanged."""
    adapted = followed(driven(payload), driven(payload, seed=2)).adapted
    weight = (VEHICLE.body.displaced_volume - adapted.body.displaced_volume) * GRAVITY
    assert weight == pytest.approx(6.0, abs=0.6)
    assert adapted.body.mass == VEHICLE.body.mass and adapted.thrusters == VEHICLE.thrusters
    assert adapted.origin_of("body.displaced_volume").origin == "measured"
    weak = followed(driven(weak_thruster)).adapted.thrusters["H_LB"]
    assert weak.c_plus / VEHICLE.thrusters["H_LB"].c_plus == pytest.approx(0.7, abs=0.06)
    assert weak.force_max / VEHICLE.thrusters["H_LB"].force_max == pytest.approx(0.7, abs=0.06)


@pytest.mark.slow
def test_a_follower_of_live_states_finds_what_the_log_shows():
    """The same states arrive one by one; a gap begins a new window, and windows are fitted in order."""
    trial = driven(weak_thruster)
    follower = Follower(VEHICLE)
    channels = trial.channels
    nu = np.column_stack([channels[c] for c in ("u", "v", "w", "p", "q", "r")])
    force = np.column_stack([channels[f"command_{name}"] for name in VEHICLE.thruster_names])
    position = np.column_stack([channels[c] for c in "xyz"])

    for i, t in enumerate(trial.t):
        q = quat_from_euler(*(channels[c][i] for c in ("roll", "pitch", "yaw")))
        follower.add(t + (2.0 if t > 12.0 else 0.0), nu[i], q, position[i], force[i])
    adaptation = follower.finish()
    assert adaptation.windows == int(10.0 / WINDOW) + int((trial.t[-1] - 12.0) / WINDOW)
    assert differing(adaptation) == {"thruster.H_LB"}


@pytest.mark.slow
def test_the_command_writes_the_vehicle_as_it_is_now(tmp_path, capsys):
    """`calibrate changes` writes JSON with the estimates, and a file that loads."""
    write_trial(driven(fouled), tmp_path / "dive")
    out = tmp_path / "now.yaml"
    calibrate_changes([tmp_path / "dive"], vehicle="finsrov", out=out, as_json=True)
    said = json.loads(capsys.readouterr().out)
    low, high = said["changes"]["drag"]["ci95"]
    assert low <= 1.3 <= high and said["windows"] == 4
    drag = [load_vehicle(v).hydrodynamics["calibrated"].linear_damping[0][0] for v in (out, "finsrov")]
    assert drag[0] / drag[1] == pytest.approx(said["changes"]["drag"]["estimate"])


def test_a_trial_without_motion_and_a_vehicle_without_coefficients_are_refused(tmp_path):
    log = tmp_path / "still.csv"
    names = ",".join(f"command_{name}" for name in VEHICLE.thruster_names)
    rows = "\n".join(",".join([f"{0.1 * i:.1f}", *["0.0"] * 9]) for i in range(20))
    log.write_text(f"t,u,{names}\n{rows}\n")
    with pytest.raises(CalibrationError, match="no 2.5 s with commands"):
        calibrate_changes([log], vehicle="finsrov")
    mesh = VEHICLE.model_copy(update={"hydrodynamics": {}})
    with pytest.raises(CalibrationError, match="no calibrated hydrodynamics"):
        Adaptation(mesh)


def test_what_a_window_does_not_show_moves_nothing_and_is_no_contradiction():
    """A direction whose information is rounding, of either sign, keeps its state, however large the quotient."""
    J, right = np.diag([4.0, 1e-12, -1e-12]), np.array([8.0, 1e-3, 1e-3])
    size, along, y = _whitened(np.eye(3), J, right)
    moved = along @ (y * size / (1.0 + size))
    assert moved == pytest.approx([2.0 * 4.0 / 5.0, 0.0, 0.0])
    assert np.max(y**2 * size / (1.0 + size)) == pytest.approx(4.0 * 4.0 / 5.0)
