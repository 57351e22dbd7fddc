"""Laws that every kind of actuator obeys: those of the package, of installed packages, and one of a program."""
# mypy: disable-error-code="valid-type,misc,index,no-any-return,no-untyped-def,untyped-decorator"

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

import finssim as fs
from finssim.core.registry import ACTUATORS
from finssim.physics.actuators.fin import DRAG_MAX
from finssim.physics.terms.composed import composed, parameter_row
from finssim.physics.types import vec6, vec8
from finssim.sim import SimulatorError, Water
from finssim.sim.ranges_file import Ranges
from finssim.vehicles import VehicleError
from finssim.vehicles.actuators import installed
from finssim.vehicles.capability import terminal_speeds
from reference.draws import draw
from reference.torpedo import FIN, RHO, SECTIONS, G, hull

DEEP = [0.0, 0.0, -100.0, 0.0, 0.0, 0.0]
RNG = np.random.default_rng(35)


NAMES = sorted({*ACTUATORS, "brake"} - {"propeller"})
EVERY = pytest.mark.parametrize("name", NAMES)
# Those of one vehicle are one kernel to compile. A moving mass is stepped one world at a time, all else in blocks.
SHIFTING = [name for name in NAMES if name != "brake" and ACTUATORS[name].shift is not None]
TOGETHER = pytest.mark.parametrize(
    "names", [[x for x in NAMES if x not in SHIFTING], SHIFTING], ids=["blocks", "single"]
)


def wrench(vehicle, nu, values):
    """Return the wrench of the actuators: M times the acceleration that they add, (n, 6) [N, N m]."""
    zero = np.zeros(len(vehicle.channel_names))
    gained = fs.acceleration(vehicle, DEEP, nu, actuators=values) - fs.acceleration(
        hull({}), DEEP, nu, actuators=zero[:1]
    )
    return gained @ vehicle.mass_matrix().T


@EVERY
def test_at_its_rest_value_it_only_feels_the_flow(name):
    """At value 0, at rest in the water, it exerts no wrench."""
    vehicle = hull({name: SECTIONS[name]})
    np.testing.assert_allclose(wrench(vehicle, np.zeros(6), [0.0, 0.0]), 0.0, atol=2e-4)


@EVERY
def test_its_force_at_rest_does_no_work_on_a_vehicle_that_stands(name):
    """Without flow and thrust a fin, a gimbal and a brake exert no wrench at any value."""
    vehicle = hull({name: SECTIONS[name]})
    tau = wrench(vehicle, np.zeros(6), [0.0, vehicle.actuators[name].maximum])
    active = name in ("buoyancy", "moving_mass")
    assert (np.abs(tau).max() > 1e-3) == active


@TOGETHER
def test_a_step_follows_lag_rate_and_travel(names):
    """Commanded beyond its travel, it moves at its rate, then by its lag, and stops at its end; equal in all
    worlds."""
    sections = {
        name: {**SECTIONS[name], "time_constant": 0.2, "rate_limit": 2.0 * SECTIONS[name]["maximum"]}
        for name in names
    }
    ends = np.array([SECTIONS[name]["maximum"] for name in names])
    sim = fs.Simulator(hull(sections), worlds=9, control_step=0.05)
    sim.place(position=(0.0, 0.0, -50.0))
    sim.set_actuators([0.0, *3.0 * ends])
    values = []
    for _ in range(60):
        sim.step()
        values.append(sim.numpy("thrust")[:, 0, 1 : 1 + len(names)].copy())
    x = np.array(values) / ends
    assert (x == x[:, :1]).all()
    np.testing.assert_allclose(x[-1], 1.0, rtol=1e-5)
    rate = np.diff(np.vstack([np.zeros_like(x[:1]), x]), axis=0) / 0.05
    assert rate.max() <= 2.0 * (1.0 + 1e-4)
    # It moves at its rate until the remaining travel is rate times time constant, then by the lag.
    t = 0.05 * np.arange(1, 61)
    lag = 1.0 - 0.4 * np.exp(-(t - 0.3) / 0.2)
    expected = np.where(t <= 0.3, np.minimum(2.0 * t, 1.0), lag)
    np.testing.assert_allclose(x[:, 0], np.broadcast_to(expected[:, None], x[:, 0].shape), atol=1e-4)


@TOGETHER
def test_play_keeps_it_from_the_command(names):
    """It does not move while the command is within its play, and stops short of it by the play, from both
    sides."""
    ends = np.array([SECTIONS[name]["maximum"] for name in names])
    sections = {name: {**SECTIONS[name], "play": 0.1 * SECTIONS[name]["maximum"]} for name in names}
    sim = fs.Simulator(hull(sections), control_step=0.05)
    sim.place(position=(0.0, 0.0, -50.0))
    for command, expected in ((0.09, 0.0), (0.5, 0.4), (0.35, 0.4), (0.2, 0.3)):
        sim.set_actuators([0.0, *command * ends])
        for _ in range(3):
            sim.step()
        np.testing.assert_allclose(sim.numpy("thrust")[0, 0, 1 : 1 + len(names)] / ends, expected, atol=1e-6)


@TOGETHER
def test_vehicles_with_and_without_it_share_a_simulation(names):
    """A vehicle without the actuators moves beside one with them exactly as it does alone."""
    plain, fitted = hull({}), hull({name: SECTIONS[name] for name in names})
    ends = []
    for crew in ([plain], [fitted, plain]):
        sim = fs.Simulator(crew, control_step=0.1)
        sim.place(position=(0.0, 0.0, -50.0), velocity=(1.0, 0.1, 0.0, 0.0, 0.0, 0.1))
        for _ in range(20):
            sim.step()
        ends.append(np.r_[sim.numpy("position")[0, -1], sim.numpy("velocity")[0, -1]])
    np.testing.assert_allclose(ends[0], ends[1], rtol=2e-5, atol=2e-5)


@TOGETHER
@pytest.mark.slow
def test_both_integrators_agree(names):
    """`rk4`, one world at a time, and `midpoint`, eight worlds together, agree on a manoeuvre of 5 s with
    each alone."""
    vehicle, found = hull({name: SECTIONS[name] for name in names}), []
    commands = np.diag([0.5 * SECTIONS[name]["maximum"] for name in names])
    for integrator in ("rk4", "midpoint"):
        sim = fs.Simulator(vehicle, worlds=len(names), control_step=0.05, integrator=integrator, substeps=8)
        sim.place(position=(0.0, 0.0, -50.0), velocity=(1.5, 0.0, 0.0, 0.0, 0.0, 0.0))
        sim.set_actuators(np.column_stack([np.full(len(names), 10.0), commands])[:, None])
        for _ in range(100):
            sim.step()
        found.append(np.column_stack([sim.numpy("position")[:, 0], sim.numpy("quaternion")[:, 0]]))
    np.testing.assert_allclose(found[0], found[1], atol=2e-3)


# Fins


def fin(**changes):
    return hull({"fin": {**FIN, **changes}})


@pytest.mark.parametrize("alpha", [0.02, 0.25, -0.29])
def test_lift_and_drag_of_a_fin_are_the_closed_forms(alpha):
    """Straight ahead, L = ½ρ A a α U² to the side of the leading edge, D = ½ρ A (d0 + d1 |α| + d2 α²) U²."""
    U = 1.7
    q = 0.5 * RHO * 0.02 * U**2
    tau = wrench(fin(), [U, 0, 0, 0, 0, 0], [0.0, alpha])
    L, D = q * 3.0 * alpha, q * (0.01 + 0.02 * abs(alpha) + 1.1 * alpha**2)
    np.testing.assert_allclose(tau, [-D, L, 0.0, -0.1 * L, -0.1 * D, -0.6 * L], atol=4e-3)


def test_its_slope_is_its_derivative():
    """Around zero deflection dY/dδ = ½ρ A a U²; -Y falls with the sideways speed by ½ρ A (a + d0) U."""
    U, h = 2.0, 1e-2
    ends = [wrench(fin(), [U, 0, 0, 0, 0, 0], [0.0, s * h])[1] for s in (1.0, -1.0)]
    np.testing.assert_allclose((ends[0] - ends[1]) / (2 * h), 0.5 * RHO * 0.02 * 3.0 * U**2, rtol=2e-3)
    ends = [wrench(fin(), [U, s * h, 0, 0, 0, 0], [0.0, 0.0])[1] for s in (1.0, -1.0)]
    np.testing.assert_allclose((ends[0] - ends[1]) / (2 * h), -0.5 * RHO * 0.02 * 3.01 * U, rtol=1e-2)


def test_a_fin_takes_energy_out_whatever_the_flow():
    """At any deflection and velocity, also in turns, nu · tau <= 0: lift does no work and drag dissipates."""
    nu = RNG.uniform(-2.0, 2.0, (200, 6))
    values = np.column_stack([np.zeros(200), RNG.uniform(-0.5, 0.5, 200)])
    power = (nu * wrench(fin(), nu, values)).sum(1)
    assert (power <= 2e-2).all() and power.min() < -10.0


def test_a_fin_is_symmetric():
    """Mirrored flow and deflection give the mirrored force."""
    nu = np.array([1.2, 0.4, 0.0, 0.0, 0.0, 0.2])
    mirror, turned = np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0]), wrench(fin(), nu, [0.0, 0.2])
    np.testing.assert_allclose(wrench(fin(), mirror * nu, [0.0, -0.2]), mirror * turned, atol=4e-3)


def test_beyond_the_stall_lift_falls_to_nothing_at_a_right_angle():
    """In purely sideways motion the fin is a plate: drag at its coefficient's limit, and no lift."""
    V = 1.5
    tau = wrench(fin(), [0, V, 0, 0, 0, 0], [0.0, 0.0])
    np.testing.assert_allclose(tau[:2], [0.0, -0.5 * RHO * 0.02 * DRAG_MAX * V**2], atol=1e-2)
    a = np.array([0.3, 0.8, 1.2, 1.5])
    nu = V * np.column_stack([np.cos(a), np.sin(a), *np.zeros((4, 4))])
    across = np.column_stack([-np.sin(a), np.cos(a)])
    lifts = np.abs((wrench(fin(), nu, np.zeros((4, 2)))[:, :2] * across).sum(1))
    expected = 0.5 * RHO * 0.02 * V**2 * 3.0 * 0.3 * (np.pi / 2 - a) / (np.pi / 2 - 0.3)
    np.testing.assert_allclose(lifts, expected, atol=2e-2)


def test_without_incidence_only_the_deflection_counts():
    """`incidence: 0`: sideways motion contributes to the speed but not to the angle."""
    tau = wrench(fin(incidence=0.0), [1.2, 0.5, 0, 0, 0, 0], [0.0, 0.1])
    q = 0.5 * RHO * 0.02 * (1.2**2 + 0.5**2)
    np.testing.assert_allclose(tau[:2], [-q * (0.01 + 0.002 + 0.011), q * 0.3], atol=4e-3)


def test_a_propeller_s_wake_makes_a_fin_work_at_rest():
    """V² = 2 k T / (ρ A_disc) at zero speed gives lift at bollard pull (momentum theory)."""
    T, k = 20.0, 0.6
    vehicle = hull({"fin": {**FIN, "wake": {"propeller": k}}})
    gained = wrench(vehicle, np.zeros(6), [T, 0.2])
    square = 2.0 * k * T / (RHO * np.pi * 0.07**2)
    np.testing.assert_allclose(gained[1], 0.5 * RHO * 0.02 * 3.0 * 0.2 * square, rtol=1e-3)


def test_a_current_is_part_of_the_flow():
    """At rest in water that moves aft, a fin steers as in motion ahead through still water."""
    found = []
    for water, speed in ((None, 1.0), (Water(current=(-1.0, 0.0, 0.0)), 0.0)):
        sim = fs.Simulator(fin(), control_step=0.01, substeps=1, water=water, water_moves=True)
        sim.place(position=(0.0, 0.0, -50.0), velocity=(speed, 0.0, 0.0, 0.0, 0.0, 0.0))
        sim.set_actuators([0.0, 0.2])
        for _ in range(20):
            sim.step()
        attitude, velocity = (sim.numpy(name)[0, 0].astype(float) for name in ("quaternion", "velocity"))
        flow = Rotation.from_quat(attitude).inv().apply([speed - 1.0, 0.0, 0.0])
        found.append(velocity - np.r_[flow, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(found[0], found[1], atol=1e-4)


# Propellers


INFLOW = {"thrust_loss": 0.01, "torque_loss": 4e-4, "wake_fraction": 0.1}


def test_thrust_and_torque_fall_with_the_inflow():
    """T = c ω² - a ω V_a and Q = k ω² - b ω V_a; the vehicle feels -Q about the axis."""
    changes = {"inflow": INFLOW, "torque_constant": 1e-4}
    vehicle, U, T = hull({}, propeller=changes), 2.0, 25.0
    omega, ahead = np.sqrt(T / 1.6e-3), 0.9 * U
    tau = wrench(vehicle, [U, 0, 0, 0, 0, 0], [T])
    mean = 1e-4 * 2.0 / (1.6e-3 + 1.4e-3)  # thrust to torque by the mean of both directions
    np.testing.assert_allclose(tau[0], T - 0.01 * omega * ahead, rtol=1e-4)
    np.testing.assert_allclose(tau[3], -mean * T + 4e-4 * omega * ahead, atol=1e-3)


def test_the_inflow_takes_energy_out():
    """Its part of the thrust opposes the motion, ahead and astern, for either direction of rotation."""
    nu = RNG.uniform(-2.0, 2.0, (100, 6))
    values = RNG.uniform(-40.0, 40.0, (100, 1))
    without = wrench(hull({}), nu, values)
    power = (nu * (wrench(hull({}, propeller={"inflow": {"thrust_loss": 0.01}}), nu, values) - without)).sum(
        1
    )
    assert (power <= 1e-2).all() and power.min() < -1.0


# Buoyancy and mass


def test_a_buoyancy_engine_lifts_and_pitches():
    """The force is ρ g V upwards at its position."""
    tau = wrench(hull({"tank": SECTIONS["buoyancy"]}), np.zeros(6), [0.0, 5e-4])
    F = RHO * G * 5e-4
    np.testing.assert_allclose(tau, [0, 0, F, 0, -0.4 * F, 0], atol=1e-3)


def test_a_moved_mass_moves_centre_and_inertia():
    """With the mass at r + δ the vehicle accelerates like one whose body has the resulting centre and
    inertia."""
    delta, m, p = 0.15, 4.0, np.array([0.1, 0.0, -0.05])
    vehicle, nu = hull({"battery": SECTIONS["moving_mass"]}), [1.0, 0.2, -0.1, 0.1, 0.3, -0.2]
    r_g, M = vehicle.body.center_of_gravity, vehicle.body.mass
    r = p + [delta, 0.0, 0.0]
    moved = r_g + m / M * (r - p)

    def about_origin(r, m):
        return m * (r @ r * np.eye(3) - np.outer(r, r))

    inertia = vehicle.body.inertia + about_origin(r_g, M) - about_origin(p, m)
    inertia += about_origin(r, m) - about_origin(moved, M)
    expected = hull({}).replace({"body.center_of_gravity": moved.tolist(), "body.inertia": inertia.tolist()})
    found = fs.acceleration(vehicle, DEEP, nu, actuators=[0.0, delta])
    np.testing.assert_allclose(found, fs.acceleration(expected, DEEP, nu), atol=2e-4)


def weightless(**changes):
    """Return a hull with a moving mass of 4 kg, without gravity and drag: impulse including the water's is
    conserved."""
    none = dict.fromkeys(("linear_damping", "quadratic_damping"), [0.0] * 6)
    vehicle = hull({"battery": {**SECTIONS["moving_mass"], "rate_limit": 0.05, **changes}})
    return vehicle.replace(
        {"water.gravity": 1e-6, **{f"hydrodynamics.calibrated.{k}": v for k, v in none.items()}}
    )


def impulse(vehicle, sim, delta):
    """Return the linear and angular impulse about the world's origin of a hull with its mass at rest [N s, N
    m s], (6,)."""
    section, body = vehicle.actuators["battery"], vehicle.body
    r_g, M, m, p = np.array(body.center_of_gravity), body.mass, section.mass, np.array(section.position)
    r = p + delta * np.array(section.axis)

    def about_origin(r, m):
        return m * (r @ r * np.eye(3) - np.outer(r, r))

    moved = r_g + m / M * (r - p)
    S = -M * np.cross(np.eye(3), moved)
    inertia = body.inertia + about_origin(r_g, M) - about_origin(p, m) + about_origin(r, m)
    M6 = np.block([[M * np.eye(3), S], [S.T, inertia]]) + vehicle.added_mass_matrix()
    x, q, nu = (sim.numpy(name)[0, 0].astype(float) for name in ("position", "quaternion", "velocity"))
    R, pi = Rotation.from_quat(q).as_matrix(), M6 @ nu
    return np.concatenate([R @ pi[:3], R @ pi[3:] + np.cross(x - [0.0, 0.0, -50.0], R @ pi[:3])])


@pytest.mark.slow
def test_the_hull_recoils_from_a_moved_mass_and_keeps_its_impulse():
    """At rest it recoils by m δ / (M + added mass); tumbling, it keeps its impulse (2.4 % were lost without
    recoil)."""
    still = weightless(position=[0.1, 0.0, 0.0]).replace({"body.center_of_gravity": [0.0, 0.0, 0.0]})
    tumbling = weightless()
    for vehicle, nu in ((still, np.zeros(6)), (tumbling, np.array([0.3, -0.2, 0.1, 0.3, -0.2, 0.4]))):
        sim = fs.Simulator(vehicle, control_step=0.05, substeps=20)
        sim.place(position=(0.0, 0.0, -50.0), velocity=nu)
        sim.set_actuators([0.0, 0.2])
        before = impulse(vehicle, sim, 0.0)
        for _ in range(100):
            sim.step()
        assert sim.numpy("thrust")[0, 0, 1] == pytest.approx(0.2, abs=1e-6)
        np.testing.assert_allclose(
            impulse(vehicle, sim, 0.2), before, atol=5e-4 * np.abs(before).max() + 1e-4
        )
        if vehicle is still:
            x = sim.numpy("position")[0, 0] + [0.0, 0.0, 50.0]
            np.testing.assert_allclose(x, [-4.0 * 0.2 / 31.0, 0.0, 0.0], atol=1e-4)


def test_a_gimbal_turns_the_thrust():
    """The thrust is T (cos δ, sin δ, 0) at the disc."""
    T, d = 30.0, 0.3
    tau = wrench(hull({"nozzle": SECTIONS["gimbal"]}), np.zeros(6), [T, d])
    np.testing.assert_allclose(tau, [T * np.cos(d), T * np.sin(d), 0, 0, 0, -0.7 * T * np.sin(d)], atol=2e-3)


def test_a_fins_slope_is_twice_its_damping_ahead():
    """-d tau_i/d nu_i of each axis alone, by central differences straight ahead at 2 m/s, is half of the
    slope."""
    fin = {**FIN, "drag": [0.02, 0.0, 0.0], "incidence": 0.8}
    vehicle = hull({"rudder": fin})
    items = {item: section for item, section in installed(vehicle).items() if item.kind.name == "fin"}
    ((item, section),) = items.items()
    function = composed((item,), "yield")

    @wp.kernel(enable_backward=False, module="unique")
    def sample(x: wp.array3d(dtype=float), out: wp.array(dtype=vec6)):
        nu = vec6(2.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        out[0] = function(x, 0, 0, nu, wp.vec3(0.0, 0.0, 1.0), 5.0, 1025.0, vec8())

    row = np.asarray(parameter_row((item,), item.numbers(section, vehicle)), np.float32)[None, None]
    out = wp.zeros(1, dtype=vec6, device="cpu")
    wp.launch(sample, dim=1, inputs=[wp.array(row, dtype=float, device="cpu"), out], device="cpu")
    found, step = out.numpy()[0], 1e-2
    for i in range(1, 6):
        pair = [
            wrench(vehicle, np.array([2.0, 0, 0, 0, 0, 0]) + sign * step * np.eye(6)[i], [0.0, 0.0])
            for sign in (1, -1)
        ]
        assert found[i] == pytest.approx(-(pair[0] - pair[1])[i] / step, rel=0.02, abs=0.05)


# Files


@pytest.mark.parametrize(
    ("section", "words"),
    [
        ({**FIN, "kind": "wing"}, "kind is 'wing'"),
        ({k: x for k, x in FIN.items() if k != "area"}, "area is missing"),
        ({**FIN, "colour": 3}, "unknown key 'colour'"),
        ({**FIN, "minimum": 0.1}, "a range that contains 0"),
        ({**FIN, "chord": [0.0, 0.0, 1.0]}, "not perpendicular"),
        ({**FIN, "stall": 1.6}, "less than a right angle"),
        ({**FIN, "wake": {"screw": 0.5}}, "no thruster 'screw'"),
        ({**SECTIONS["gimbal"], "thruster": "screw"}, "no thruster 'screw'"),
    ],
)
def test_a_section_that_cannot_be_is_refused(tmp_path, section, words):
    """The refusal is one sentence that names file, actuator and key."""
    import yaml

    file = tmp_path / "rov.yaml"
    file.write_text(
        yaml.safe_dump(
            {"extends": "remus100", "title": "x", "origin": "guessed", "actuators": {"flap": section}}
        ),
        encoding="utf-8",
    )
    with pytest.raises(VehicleError, match=words) as error:
        fs.load_vehicle(file)
    assert "flap" in str(error.value)


def test_actuators_are_part_of_the_file_and_of_its_digest():
    """A file survives reading and writing; another area makes another vehicle."""
    vehicle = fin()
    again = type(vehicle)(**vehicle.values(), name="hull")
    assert again.sha256 == vehicle.sha256 and again.values() == vehicle.values()
    assert vehicle.replace({"actuators.fin.area": 0.03}).sha256 != vehicle.sha256
    assert vehicle.channel_names == ("propeller", "fin") and len(installed(vehicle)) == 1


def test_commands_keep_to_channels():
    """Thrust commands do not move the other actuators; too many channels are refused."""
    sim = fs.Simulator("lauv", worlds=2)
    sim.set_actuators([5.0, *[0.1] * 4])
    sim.set_thrust([10.0])
    np.testing.assert_allclose(sim.numpy_command()[:, 0, :5], [[10.0, *[0.1] * 4]] * 2)
    with pytest.raises(SimulatorError, match="expected"):
        sim.set_actuators([1.0] * 6)
    with pytest.raises(SimulatorError, match="1 thrusters and 8 other actuators; at most 8"):
        fs.Simulator(hull({f"fin{i}": FIN for i in range(8)}))


def test_top_speed_counts_the_inflow():
    """At full simulated thrust a propeller that loses thrust with inflow reaches the speed of
    `terminal_speeds`."""
    vehicle = hull({}, propeller={"inflow": {"thrust_loss": 0.02, "wake_fraction": 0.2}})
    stable = {"hydrodynamics.calibrated.added_mass": [1.0, 1.0, 1.0, 0.1, 4.0, 4.0]}  # no Munk moment
    level = vehicle.replace({"body.center_of_gravity": [0.0, 0.0, -0.02], **stable})
    sim = fs.Simulator(level, control_step=0.1)
    sim.place(position=(0.0, 0.0, -50.0))
    sim.set_thrust([40.0])
    for _ in range(600):
        sim.step()
    expected = terminal_speeds(level)[0]
    np.testing.assert_allclose(sim.numpy("velocity")[0, 0, 0], expected, rtol=1e-3)
    assert expected < 0.95 * terminal_speeds(hull({}))[0]


def test_ranges_draw_the_parameters_of_all_fins():
    """`fin: {lift_slope: ...}` scales all fins of a world equally; a scale of thrust does not change angles."""
    vehicle = fs.load_vehicle("lauv").replace(
        {"actuators.fin_starboard.lift_slope": 2.0}
    )  # the others have 3
    parts = {"fin": {"lift_slope": [0.5, 1.5]}, "thrust": {"all": [0.5, 0.6]}}
    sim, _ = draw(parts, vehicles=vehicle, worlds=200, seed=3)
    slopes = np.array([sim.plant.fields[f"actuators.fin_{k}.lift_slope"].numpy()[:, 0] for k in (1, 2)])
    np.testing.assert_allclose(slopes[1] / slopes[0], 2.0 / 3.0, rtol=1e-5)
    assert 1.45 < slopes[0].min() < 1.7 and 4.3 < slopes[0].max() < 4.55
    gain = sim.plant.gain.numpy()[:, 0]
    assert (gain[:, 0] < 0.61).all() and (gain[:, 1:] == 1.0).all()
    with pytest.raises(ValueError, match="lift_slop"):
        Ranges.model_validate({"name": "x", "fin": {"lift_slop": [0.5, 1.5]}})
