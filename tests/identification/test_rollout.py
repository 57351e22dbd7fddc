"""Segments under candidate plants move as in a separate simulator."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.core.rotations import quat_conjugate, quat_from_euler, quat_rotate
from finssim.identification.parameters import Parameters
from finssim.identification.rollout import (
    Changes,
    Drive,
    InitialState,
    Rollouts,
    Segment,
    SensorPlaces,
    segments,
    streams,
)
from finssim.identification.shooting import Point, Shooting
from finssim.sim.simulator import Simulator
from finssim.trials.findings import CalibrationError
from finssim.trials.trial import Header, Trial
from finssim.vehicles import load_vehicle

STEP = 0.02
DEPTH = 50.0


def segment(vehicle, force, *, B=None, commanded=True, before=None, changes=None, start=None, **fields):
    """Return a segment that starts level and at rest, with motors settled at the first force."""
    force = np.asarray(force, float)
    thrusters = B is None
    drive = Drive(
        force=force,
        before=np.repeat(force[:1], 50, axis=0) if before is None else np.asarray(before, float),
        B=vehicle.thruster_matrix() if thrusters else np.asarray(B, float),
        commanded=commanded,
        thrusters=thrusters,
        changes=changes,
    )
    state = {"position": np.zeros(3), "quaternion": np.array([0.0, 0.0, 0.0, 1.0]), "nu": np.zeros(6)}
    given = {
        "trial": "made up",
        "index": 0,
        "t0": 0.0,
        "step": STEP,
        "drive": drive,
        "start": InitialState(**{**state, **(start or {})}, known=np.ones(12, bool)),
        "sink": -DEPTH,
        "density": vehicle.water.density,
        "current": np.zeros(3),
        "measured": {},
        "sensors": SensorPlaces(
            velocity_at=np.zeros(3), velocity_in_water=False, position_at=np.zeros(3), depth_at=np.zeros(3)
        ),
    }
    return Segment(**{**given, **fields})


def steps_of(vehicle, n, seed=0, size=3.0):
    """Return thruster forces that jump every 0.2 s."""
    levels = size * np.random.default_rng(seed).normal(size=(n // 10 + 1, len(vehicle.thrusters)))
    return np.repeat(levels, 10, axis=0)[:n]


def plain(vehicle, force, *, hydrodynamics="calibrated"):
    """Return the velocity after every step of an ordinary simulation with motors settled at the first command."""
    sim = Simulator(vehicle, control_step=STEP, substeps=1, integrator="rk4", hydrodynamics=hydrodynamics)
    for _ in range(100):
        sim.set_thrust(force[0])
        sim.step()
    sim.numpy("position")[...] = [0.0, 0.0, -DEPTH]
    sim.numpy("quaternion")[...] = [0.0, 0.0, 0.0, 1.0]
    sim.numpy("velocity")[...] = 0.0
    out = [np.zeros(6, np.float32)]
    for f in force:
        sim.set_thrust(f)
        sim.step()
        out.append(sim.numpy("velocity")[0, 0].copy())
    return np.array(out)


@pytest.mark.parametrize("hydrodynamics", ["calibrated", "mesh"])
@pytest.mark.parametrize("name", ["finsrov", "bluerov2", "bluerov2_heavy"])
def test_a_rollout_is_an_ordinary_simulation(name, hydrodynamics):
    """Motors, delay and hydrodynamics are the simulator's: every candidate's world moves as in a plain run."""
    vehicle = load_vehicle(name)
    force = steps_of(vehicle, 60)
    response = Rollouts(vehicle, [segment(vehicle, force)], hydrodynamics=hydrodynamics).run(candidates=2)
    expected = plain(vehicle, force, hydrodynamics=hydrodynamics)
    np.testing.assert_allclose(response.nu[:, 1, 0], expected, atol=2e-6)
    assert response.finite.all()


@pytest.mark.parametrize("domain", ["force", "speed"])
def test_motors_of_a_later_segment_are_already_running(domain):
    """A segment cut from a run continues as that run did, lag and delay line included."""
    slew = {"force": 100.0, "speed": 2000.0}[domain]
    vehicle = load_vehicle("finsrov").replace({"thrusters.*.domain": domain, "thrusters.*.slew": slew})
    force, begin = steps_of(vehicle, 120), 80
    first = Rollouts(vehicle, [segment(vehicle, force)]).run()
    state = {"nu": first.nu, "quaternion": first.quaternion, "position": first.position}
    start = {name: values[begin, 0, 0].astype(float) for name, values in state.items()}
    later = segment(vehicle, force[begin:], before=force[:begin], start=start)
    again = Rollouts(vehicle, [later]).run()
    np.testing.assert_allclose(again.nu[:, 0, 0], first.nu[begin:, 0, 0], atol=5e-5)


def test_a_wrench_acts_as_the_thrusters_that_make_it():
    """Applied thruster forces f and the applied wrench B f give the same motion."""
    vehicle = load_vehicle("bluerov2")
    force = steps_of(vehicle, 60)
    B = vehicle.thruster_matrix()
    pair = [
        segment(vehicle, force, commanded=False),
        segment(vehicle, force @ B.T, B=np.eye(6), commanded=False),
    ]
    nu = Rollouts(vehicle, pair).run().nu
    np.testing.assert_allclose(nu[:, 0, 0], nu[:, 0, 1], atol=2e-6)


@pytest.mark.parametrize("thrusters", [True, False])
def test_what_was_commanded_is_delayed_and_what_acted_is_not(thrusters):
    """FinsROV's motors have a delay of 0.05 s: a commanded step moves nothing before, an applied one does."""
    vehicle = load_vehicle("finsrov")
    force = np.repeat(vehicle.thruster_matrix()[:1] * 3.0, 20, axis=0)
    B = None
    if not thrusters:
        force, B = force @ vehicle.thruster_matrix().T, np.eye(6)
    pair = [
        segment(vehicle, force, B=B, commanded=commanded, before=np.zeros((50, force.shape[1])))
        for commanded in (True, False)
    ]
    u = Rollouts(vehicle, pair).run().nu[:, 0, :, 0]
    assert abs(u[2, 0]) < 1e-6 < 0.005 < u[2, 1]
    assert u[10, 0] > 0.01


def test_an_applied_force_is_linear_between_its_samples():
    """Coarse samples of a ramp move the vehicle as fine ones do."""
    vehicle = load_vehicle("finsrov")
    ends = []
    for step in (0.025, 0.0025):
        t = step * np.arange(1, round(2.0 / step) + 1)
        force = np.outer(20.0 * t, [1.0, 0, 0, 0, 0, 0])
        s = segment(vehicle, force, B=np.eye(6), commanded=False, before=np.zeros((5, 6)), step=step)
        ends.append(Rollouts(vehicle, [s]).run().nu[-1, 0, 0, 0])
    # A zero-order hold would lead by half a coarse step, 0.25 N of 40 N.
    np.testing.assert_allclose(*ends, rtol=2e-3)


def test_a_batch_equals_its_parts():
    """Worlds are independent: candidates and segments together are bit-identical to each alone."""
    vehicle = load_vehicle("finsrov")
    parts = [segment(vehicle, steps_of(vehicle, n, seed=n)) for n in (30, 50)]
    damping = np.stack([np.diag([s, 50.0, 80.0, 1.0, 1.0, 0.3]) for s in (20.0, 40.0, 60.0)])[:, None]
    whole = Rollouts(vehicle, parts).run({"D1": damping})
    for i, part in enumerate(parts):
        for c in range(3):
            alone = Rollouts(vehicle, [part]).run({"D1": damping[c : c + 1]})
            assert np.array_equal(alone.nu[:, 0, 0], whole.nu[: part.steps + 1, c, i])
    assert np.isnan(whole.nu[31:, :, 0]).all()
    assert np.isfinite(whole.nu[:, :, 1]).all()


def test_the_passes_of_a_large_batch_change_nothing(monkeypatch):
    """Candidates that exceed the memory together are simulated in several passes, with the same result."""
    vehicle = load_vehicle("finsrov")
    rollouts = Rollouts(vehicle, [segment(vehicle, steps_of(vehicle, 20))])
    mass = np.linspace(10.0, 14.0, 7)[:, None]
    at_once = rollouts.run({"mass": mass}).nu
    monkeypatch.setattr("finssim.identification.rollout.BUDGET", 3 * 8000.0)
    assert np.array_equal(rollouts.run({"mass": mass}).nu, at_once)


def test_the_water_of_a_trial_is_its_own():
    """Denser water in the trial's header has the same effect as in the vehicle file."""
    vehicle = load_vehicle("finsrov")
    still = np.zeros((50, 8))
    dense = Rollouts(vehicle, [segment(vehicle, still, density=1050.0)]).run().nu[-1, 0, 0]
    file = vehicle.replace({"water.density": 1050.0})
    assert dense[2] > 0.01
    np.testing.assert_allclose(dense, Rollouts(file, [segment(file, still)]).run().nu[-1, 0, 0], atol=1e-7)


def test_a_current_carries_the_vehicle():
    """From rest in a current, drag and the water's own acceleration pull it along until it drifts with the water."""
    vehicle = load_vehicle("finsrov")
    current = np.array([0.1, 0.0, 0.0])
    response = Rollouts(vehicle, [segment(vehicle, np.zeros((600, 8)), current=current)]).run()
    assert response.nu[-1, 0, 0, 0] == pytest.approx(0.1, rel=0.02)


def test_a_pull_keeps_its_direction_while_the_vehicle_turns():
    """A force along the body at the start equals one that is fixed in the world; one that turns with the body
    differs."""
    vehicle = load_vehicle("bluerov2_heavy")
    turn = vehicle.thruster_matrix()[5] * 8.0
    force, heading = np.tile(turn, (150, 1)), quat_from_euler(0.0, 0.0, 0.7)
    constant = np.array([[[0.5, 0.0, 0.0, 0.0, 0.0, 0.1]]])
    rollouts = Rollouts(vehicle, [segment(vehicle, force, start={"quaternion": heading})])
    response = rollouts.run(disturbance=constant, pull=np.array([[[2.0, -1.0, 0.0]]]))
    sim = Simulator(vehicle, control_step=STEP, substeps=1, integrator="rk4")
    for _ in range(100):
        sim.set_thrust(turn)
        sim.step()
    for name, value in (("position", [0.0, 0.0, -DEPTH]), ("quaternion", heading), ("velocity", 0.0)):
        sim.numpy(name)[...] = value
    world, expected = quat_rotate(heading, np.array([2.0, -1.0, 0.0])), [np.zeros(6)]
    for _ in force:
        pull = quat_rotate(quat_conjugate(sim.numpy("quaternion")[0, 0]), world)
        sim.command.disturbance.numpy()[0, 0] = constant[0, 0] + np.append(pull, np.zeros(3))
        sim.set_thrust(turn)
        sim.step()
        expected.append(sim.numpy("velocity")[0, 0].copy())
    assert response.nu[-1, 0, 0, 5] > 0.8
    np.testing.assert_allclose(response.nu[:, 0, 0], expected, atol=3e-6)


def test_pulls_say_nothing_of_an_unknown_thrust():
    """The deviation of pulls is relative to the thrust at the file's voltage, so they scale with all forces."""
    vehicle = load_vehicle("bluerov2_heavy")
    times = np.linspace(0.1, 1.9, 10)
    measured = {name: (times, np.zeros(10)) for name in ("u", "v")}
    still = np.zeros((100, 8))
    one = segment(
        vehicle, still, measured=measured, changes=Changes(still, np.full(100, -1), np.zeros((100, 2)))
    )
    axes = ("surge", "sway")
    free = Parameters(
        vehicle, axes=axes, damping=dict.fromkeys(axes, "both"), extras=("thrust_scale",), likely=True
    )
    problem = Shooting([one], free, ("u", "v"))
    start, scale = problem.start(), problem.names.index("thrust_scale")
    points = Point(np.tile(start.theta, (2, 1)), np.tile(start.z, (2, 1, 1)))
    points.theta[:, scale], points.z[:, 0, problem.free == 12] = (0.5, 1.0), ((2.0,), (1.0,))
    residual = problem.residuals(points)
    assert np.abs(residual[:, 0]).max() > 0.02
    np.testing.assert_allclose(residual[:, 0], residual[:, 1], atol=1e-7)


def test_a_submerged_vehicle_does_not_surface_while_it_drifts():
    """The vehicle is simulated far below and reported at its start, so that buoyancy stays complete as it rises."""
    vehicle = load_vehicle("finsrov").replace({"body.displaced_volume": 0.0121})
    response = Rollouts(
        vehicle, [segment(vehicle, np.zeros((500, 8)), start={"position": np.array([0.0, 0.0, -0.5])})]
    ).run()
    z, w = response.position[:, 0, 0, 2], response.nu[:, 0, 0, 2]
    assert z[0] == pytest.approx(-0.5, abs=1e-5) and z[-1] > -0.4
    assert (np.diff(w) > -1e-6).all()


def test_a_candidate_that_diverges_is_told_and_harms_no_other():
    """Negative damping grows without bound; the neighbour's motion is unchanged."""
    vehicle = load_vehicle("finsrov")
    D2 = np.zeros((2, 1, 6, 6))
    D2[1, 0, 0, 0] = -1e5
    moving = segment(vehicle, np.zeros((100, 8)), start={"nu": np.array([1.0, 0, 0, 0, 0, 0])})
    response = Rollouts(vehicle, [moving]).run({"D2": D2})
    assert response.finite[:, 0].tolist() == [True, False]
    assert np.isfinite(response.nu[:, 0]).all() and np.isnan(response.nu[-1, 1]).all()


def test_segments_of_different_steps_are_refused():
    """Segments with different time steps are refused, since a batch has one clock."""
    vehicle = load_vehicle("finsrov")
    pair = [segment(vehicle, np.zeros((10, 8))), replace(segment(vehicle, np.zeros((10, 8))), step=0.05)]
    with pytest.raises(CalibrationError, match="one step"):
        Rollouts(vehicle, pair)
    with pytest.raises(CalibrationError, match="nothing to simulate"):
        Rollouts(vehicle, [])


def test_a_sampled_command_changes_when_it_is_told_to():
    """The command changes at a time between two samples 0.2 s apart: old before, new after."""
    vehicle = load_vehicle("bluerov2")
    old, new = steps_of(vehicle, 20)[[0, 10]]
    n, which = np.arange(60), np.full(60, -1)
    which[20:30] = 0
    sampled = segment(
        vehicle,
        np.where((n < 30)[:, None], old, new),
        changes=Changes(
            np.where((which == 0)[:, None], new - old, 0.0), which, np.stack([n - 20, n - 19], axis=-1) / 10.0
        ),
    )
    rollouts = Rollouts(vehicle, [sampled])
    for at, earlier in ((25, None), (27, -0.2), (21, 0.4)):
        told = Rollouts(vehicle, [segment(vehicle, np.where((n < at)[:, None], old, new))]).run().nu
        found = rollouts.run(earlier=None if earlier is None else np.full((1, 1, 1), earlier)).nu
        np.testing.assert_allclose(found, told, atol=2e-6)


def test_a_slow_command_is_halfway_between_samples_unless_stated_to_hold():
    """Pulses at 5 Hz change in the middle on average; `inputs_between: held` keeps them as logged."""
    vehicle = load_vehicle("bluerov2")
    t = 0.2 * np.arange(20)
    columns = {f"command_{name}": np.where(t < 2.0, 0.0, 5.0) for name in vehicle.thrusters}
    columns["u"] = 0.0 * t
    for stated in (None, "held"):
        header = Header(inputs_between=stated)
        trial = Trial(name="made up", t=t, channels=columns, header=header, phase=None)
        part = segments(streams(trial, vehicle), vehicle, changes=True)[0].drive
        if stated:
            assert part.changes is None and part.force[99, 0] == 0.0 and part.force[100, 0] == 5.0
        else:
            np.testing.assert_array_equal(np.flatnonzero(part.changes.which == 0), np.arange(90, 100))
            assert (part.force[:100] == 0.0).all() and (part.changes.change[90:100, 0] == 5.0).all()
