"""The effect of each entry of the table on plant, water, tether and sensors agrees with its closed form."""

from __future__ import annotations

import numpy as np
import pytest

from finssim.sim import TetherLine, Water, Wave
from finssim.sim.measured import SENSORS, MeasurementErrors
from finssim.sim.packed import Packed
from finssim.sim.ranges_file import AXES, available, load_ranges
from finssim.sim.ranges_table import ENTRIES, INDEX, WORLD_END, drawn_entries
from finssim.vehicles import load_vehicle
from reference.draws import again, column, draw

FACTOR, OFFSET = [0.6, 1.7], [-0.03, 0.05]


def parts_for(name: str) -> dict:
    """Return a ranges file that draws an entry, and the others of its family if the file cannot separate
    them."""
    family, _, rest = name.partition(".")
    if family in ("center_of_gravity", "center_of_buoyancy"):
        return {family: {rest: OFFSET}}
    if family in ("added_mass", "linear_damping", "quadratic_damping"):
        return {family: {"all": FACTOR}} if rest == "all" else {family: {"axes": {rest: FACTOR}}}
    if family in ("thrust", "time_constant"):
        return {family: {rest.split(".")[0]: FACTOR}}
    if family in ("sensors", "tether"):
        return {family: {rest: [0.001, 0.3]}}
    if family == "waves":
        return {"waves": {"count": [0, 8], "amplitude": [0.01, 0.03], "wavelength": [2.0, 8.0]}}
    if family == "current_drift":
        return {"current_drift": {"deviation": [0.0, 0.05], "time": [5.0, 20.0]}}
    if family == "current":
        return {"current": [0.1, 0.3]}
    return {name: FACTOR if ENTRIES[INDEX[name]].unit == "1" else [0.0, 0.2]}


def shift(r):
    """Return H with nu(at r) = H nu(at the origin)."""
    x, y, z = r
    H = np.eye(6)
    H[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    return H


def expected_plant(x, vehicle):
    """Return every drawn field of the plant for one vehicle, from the draws and the vehicle file, in double
    precision."""
    body, hydro = vehicle.body, vehicle.hydrodynamics["calibrated"]
    r_g = np.array(body.center_of_gravity) + [x(f"center_of_gravity.{a}") for a in "xyz"]
    r_b = np.array(body.center_of_buoyancy) + [x(f"center_of_buoyancy.{a}") for a in "xyz"]
    mass = x("mass") * body.mass

    def family(name):
        f = np.sqrt([x(f"{name}.all") * x(f"{name}.{axis}") for axis in AXES])
        return np.outer(f, f) * np.array(getattr(hydro, name))

    H = shift(hydro.reference_point)
    thrusters = list(vehicle.thrusters.values())
    lag = np.array([t.time_constant for t in thrusters])
    lag = lag * x("time_constant.all") * [x(f"time_constant.each.{k}") for k in range(8)] + x(
        "added_time_constant"
    )
    rpm = 2.0 * np.pi / 60.0
    dead = [t.c_plus * (t.dead_rpm_plus * rpm) ** 2 if t.domain == "speed" else 0.0 for t in thrusters]
    return {
        "mass": mass,
        "volume": x("volume") * x("buoyancy") * body.displaced_volume,
        "r_g": r_g,
        "r_b": r_b,
        "inertia": x("inertia") * np.array(body.inertia)
        + mass * (r_g @ r_g * np.eye(3) - np.outer(r_g, r_g)),
        "M_A": H.T @ family("added_mass") @ H,
        "D1": family("linear_damping"),
        "D2": family("quadratic_damping"),
        "gain": x("thrust.all")
        * np.array([x(f"thrust.each.{k}") * x(f"thrust.failure.{k}") for k in range(8)]),
        "time_constant": lag,
        "delay": x("delay") * thrusters[0].delay + x("added_delay"),
        "slew": x("slew") * np.array([t.slew or 1.0e9 for t in thrusters]),
        "dead_plus": x("dead_zone") * np.array(dead) + x("added_dead_zone"),
    }


VEHICLE_ENTRIES = [
    e.name
    for e in ENTRIES[:WORLD_END]  # fields of terms and actuators follow
    if not e.world and not e.name.startswith(("sensors.", "tether.", "mesh_drag"))
]


@pytest.mark.slow
@pytest.mark.parametrize("name", VEHICLE_ENTRIES)
def test_an_entry_does_to_the_plant_what_its_closed_form_says(name):
    """All fields are compared, so that an entry has no other effects."""
    simulator, draws = draw(parts_for(name), worlds=12)
    assert name in draws.names
    values = draws.values.numpy()[:, 0].astype(float)
    assert len(np.unique(values[:, INDEX[name]])) > 6
    vehicle = simulator.vehicles[0]
    fields = {field: array.numpy()[:, 0].astype(float) for field, array in simulator.plant.fields.items()}
    for w in range(simulator.worlds):
        for field, number in expected_plant(lambda n, w=w: values[w, INDEX[n]], vehicle).items():
            np.testing.assert_allclose(fields[field][w], number, rtol=2e-5, atol=2e-6, err_msg=field)


def test_mesh_drag_scales_form_and_skin_drag():
    simulator, draws = draw({"mesh_drag": FACTOR}, worlds=12, hydrodynamics="mesh")
    hydro, factor = simulator.vehicles[0].hydrodynamics["mesh"], column(draws, "mesh_drag")
    for field in ("form_drag", "skin_drag"):
        found = getattr(simulator.plant, field).numpy()[:, 0]
        np.testing.assert_allclose(found, factor * getattr(hydro, field), rtol=1e-6)


def test_surge_damping_scales_what_the_vehicle_has():
    """Catalogue vehicles have no coupled damping, so the vehicle here has some."""
    vehicle = load_vehicle("finsrov")
    coupled = np.diag([0.0, 4.0, 0.0, 0.0, 0.0, 2.0]).tolist()
    vehicle = vehicle.replace({"hydrodynamics.calibrated.surge_damping": coupled})
    simulator, draws = draw({"surge_damping": FACTOR}, worlds=12, vehicles=vehicle)
    found = simulator.plant.surge_damping.numpy()[:, 0]
    np.testing.assert_allclose(found, column(draws, "surge_damping")[:, None, None] * coupled, rtol=1e-6)


@pytest.mark.parametrize("name", [f"sensors.{name}" for name in SENSORS])
def test_a_sensors_entry_replaces_its_own_number_and_keeps_the_others(name):
    seen = Packed(MeasurementErrors, (12, 1), "cpu")
    for i, array in enumerate(seen.fields.values()):
        array.fill_(0.01 * (i + 1))
    given = {field: array.numpy().copy() for field, array in seen.fields.items()}
    _, draws = draw(parts_for(name), worlds=12, seen=seen)
    for field, array in seen.fields.items():
        expected = column(draws, name)[:, None] if f"sensors.{field}" == name else given[field]
        np.testing.assert_array_equal(array.numpy(), expected.astype(np.float32))
    assert np.ptp(column(draws, name)) > 0.1


@pytest.mark.parametrize("given", [TetherLine(anchor=(1.0, 0.0, 0.0), diameter=0.01, wet_weight=0.2), None])
@pytest.mark.parametrize("name", ["diameter", "drag_coefficient", "wet_weight"])
def test_a_tethers_entry_replaces_its_own_number_and_keeps_the_others(name, given):
    """A default tether is used where none is given."""
    simulator, draws = draw(parts_for(f"tether.{name}"), worlds=12, tether=given)
    line = given or TetherLine()
    found = simulator.tether.array.numpy()[:, 0]
    for field in ("diameter", "drag_coefficient", "wet_weight"):
        expected = column(draws, f"tether.{name}") if field == name else getattr(line, field)
        np.testing.assert_allclose(found[field], expected, rtol=1e-6)
    np.testing.assert_allclose(found["anchor"], np.tile(line.anchor, (12, 1)))
    assert np.ptp(found[name]) > 0.1


def test_current_and_drift_are_written_on_top_of_what_is_given():
    given = Water(current=(0.3, 0.1, 0.0))
    parts = {**parts_for("current"), **parts_for("current_drift.deviation"), "vertical_current": [-0.1, 0.1]}
    simulator, draws = draw(parts, worlds=400, water=given)
    speed, direction, up = (column(draws, n) for n in ("current", "current.direction", "vertical_current"))
    expected = np.stack([speed * np.cos(direction), speed * np.sin(direction), up], axis=1) + given.current
    np.testing.assert_allclose(simulator.water.current.numpy(), expected, atol=1e-6)
    np.testing.assert_allclose(column(draws, "current.x"), speed * np.cos(direction), atol=1e-6)
    deviation, time = (column(draws, f"current_drift.{n}") for n in ("deviation", "time"))
    np.testing.assert_allclose(
        simulator.water.drift_std.numpy(),
        np.stack([deviation, deviation, 0.0 * deviation], axis=1),
        rtol=1e-6,
    )
    np.testing.assert_allclose(simulator.water.drift_time.numpy(), time, rtol=1e-6)
    simulator.step()
    drift = simulator.water.drift.numpy()[:, :2] / np.maximum(deviation, 1e-9)[:, None]
    # The first value is normal with this standard deviation.
    assert drift.std() == pytest.approx(1.0, abs=0.15)


def test_waves_follow_the_given_one_on_the_dispersion_relation():
    given = Water(depth=3.0, waves=(Wave(amplitude=0.02, wavelength=4.0),))
    simulator, draws = draw(parts_for("waves.count"), worlds=300, water=given)
    water, count = simulator.water, column(draws, "waves.count")
    assert set(count) == set(range(9))
    amplitude, k = water.wave_amplitude.numpy(), water.wave_number.numpy().astype(float)
    np.testing.assert_allclose(amplitude[:, 0], 0.02, rtol=1e-6)
    for i in range(8):
        drawn = {n: column(draws, f"waves.{i}.{n}") for n in ("amplitude", "wavelength", "heading", "phase")}
        np.testing.assert_allclose(amplitude[:, 1 + i], drawn["amplitude"])
        assert ((amplitude[:, 1 + i] > 0.0) == (count > i)).all()
        np.testing.assert_allclose(2.0 * np.pi / k[:, 1 + i], drawn["wavelength"], rtol=1e-5)
        np.testing.assert_allclose(water.wave_heading.numpy()[:, 1 + i], drawn["heading"])
        np.testing.assert_allclose(water.wave_phase.numpy()[:, 1 + i], drawn["phase"])
    omega = water.wave_frequency.numpy()
    np.testing.assert_allclose(omega**2, 9.81 * k * np.tanh(3.0 * k), rtol=2e-3)


def test_a_thruster_that_failed_gives_nothing():
    """Thrusters fail independently with the given probability; a failed one gives no thrust."""
    parts = {"thrust": {"failure": {"uniform": [0.0, 0.0], "probability": 0.25}}}
    simulator, draws = draw(parts, worlds=500)
    gain = simulator.plant.gain.numpy()[:, 0]
    assert set(np.unique(gain)) == {0.0, 1.0}
    assert np.mean(gain == 0.0) == pytest.approx(0.25, abs=0.03)
    assert abs(np.corrcoef(gain.T) - np.eye(8)).max() < 0.2
    simulator.set_thrust(np.full(8, 3.0))
    for _ in range(5):
        simulator.step()
    thrust = simulator.numpy("thrust")[:, 0]
    assert not thrust[gain == 0.0].any() and (thrust[gain == 1.0] > 1.0).all()


def test_a_jittering_command_comes_later_by_up_to_the_jitter():
    """The jitter is uniform and redrawn in every control step; the rest of the delay is unchanged."""
    simulator, draws = draw({"command_jitter": [0.04, 0.04], "delay": [2.0, 2.0]}, worlds=300)
    step = simulator.pipeline()
    draws.add_step(step, 7)
    simulator.add_step(step)
    nominal, late = 2.0 * list(simulator.vehicles[0].thrusters.values())[0].delay, []
    for _ in range(20):
        step.run()
        late.append(simulator.plant.delay.numpy()[:, 0] - nominal)
    late = np.array(late)
    assert late.min() >= -1e-6 and late.max() <= 0.04 + 1e-6
    assert late.mean() == pytest.approx(0.02, abs=0.001) and late.std() == pytest.approx(
        0.04 / np.sqrt(12), rel=0.05
    )
    assert abs(np.corrcoef(late[:-1].ravel(), late[1:].ravel())[0, 1]) < 0.06


def test_draws_do_not_depend_on_how_many_worlds_and_threads_there_are():
    """Eight worlds are bit-identical to the first eight of two hundred."""
    ranges = load_ranges("pool").model_dump(exclude={"name"})
    few, many = (draw(ranges, worlds=n, threads=t)[0] for n, t in ((8, 1), (200, 3)))
    for name, array in few.plant.fields.items():
        np.testing.assert_array_equal(array.numpy(), many.plant.fields[name].numpy()[:8], err_msg=name)
    np.testing.assert_array_equal(few.water.current.numpy(), many.water.current.numpy()[:8])


def test_the_vehicles_of_a_world_differ_and_share_its_water():
    heavier = load_vehicle("finsrov").replace({"body.mass": 13.0})
    parts = {"mass": FACTOR, "current": [0.1, 0.3], "thrust": {"each": FACTOR}}
    simulator, draws = draw(parts, vehicles=["finsrov", heavier])
    mass = simulator.plant.mass.numpy() / [vehicle.body.mass for vehicle in simulator.vehicles]
    np.testing.assert_allclose(mass, draws.numpy(["mass"])[..., 0], rtol=1e-6)
    assert abs(np.corrcoef(mass.T)[0, 1]) < 0.3
    water = draws.numpy(["current", "current.direction"])
    np.testing.assert_array_equal(water[:, 0], water[:, 1])


def test_an_entry_more_does_not_change_the_others():
    """Each entry has its own random stream."""
    one = column(draw({"slew": FACTOR})[1], "slew")
    two = column(draw({"mass": FACTOR, "slew": FACTOR})[1], "slew")
    np.testing.assert_array_equal(one, two)


def test_every_episode_and_every_seed_draws_anew():
    simulator, draws = draw({"slew": FACTOR})
    first = column(draws, "slew")
    simulator.reset()
    again(simulator, draws)
    second = column(draws, "slew")
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.3 and (first != second).all()
    other = column(draw({"slew": FACTOR}, seed=8)[1], "slew")
    assert abs(np.corrcoef(first, other)[0, 1]) < 0.3


# Published tables (Unity profile assets of FinsSim): entry -> range.
PUBLISHED = {
    "equivalent_box": {
        "volume": (0.87288, 1.12712),
        **{f"center_of_buoyancy.{axis}": (-0.05, 0.05) for axis in "xyz"},
    },
    "fossen_learn_to_swim": {
        "mass": (0.98, 1.02),
        "inertia": (0.95, 1.05),
        "added_mass.all": (0.9, 1.1),
        **{f"added_mass.{axis}": (0.9, 1.1) for axis in AXES[:5]},
        "added_mass.yaw": (0.85, 1.15),
        "linear_damping.all": (0.85, 1.15),
        **{f"linear_damping.{axis}": (0.9, 1.1) for axis in AXES[:5]},
        "linear_damping.yaw": (0.75, 1.35),
        "quadratic_damping.all": (0.8, 1.25),
        **{f"quadratic_damping.{axis}": (0.85, 1.2) for axis in AXES[:3]},
        **{f"quadratic_damping.{axis}": (0.9, 1.15) for axis in AXES[3:5]},
        "quadratic_damping.yaw": (0.7, 1.5),
        "thrust.all": (0.95, 1.05),
        **{f"thrust.each.{k}": (0.95, 1.05) for k in range(8)},
        "time_constant.all": (0.7, 1.3),
        "delay": (0.5, 1.5),
        "slew": (0.8, 1.2),
    },
    "hold_for_position": {
        "added_mass.all": (0.9, 1.1),
        **{f"added_mass.{axis}": (0.9, 1.1) for axis in ("surge", "heave")},
        "added_mass.sway": (0.85, 1.15),
        **{f"added_mass.{axis}": (0.8, 1.25) for axis in AXES[3:]},
        "linear_damping.all": (0.85, 1.15),
        "linear_damping.surge": (0.9, 1.1),
        **{f"linear_damping.{axis}": (0.85, 1.15) for axis in AXES[1:3]},
        **{f"linear_damping.{axis}": (0.8, 1.25) for axis in AXES[3:5]},
        "linear_damping.yaw": (0.7, 1.4),
        "quadratic_damping.all": (0.8, 1.25),
        "quadratic_damping.heave": (0.85, 1.2),
        **{f"quadratic_damping.{axis}": (0.75, 1.3) for axis in AXES[3:5]},
        "quadratic_damping.yaw": (0.5, 1.75),
        **{f"thrust.each.{k}": (0.9, 1.1) for k in range(8)},
        "time_constant.all": (0.5, 1.5),
        "delay": (0.25, 2.0),
        "waves.count": (0.0, 2.999),
        **{f"waves.{i}.amplitude": (0.0, 0.03) for i in range(2)},
        **{f"waves.{i}.wavelength": (3.0, 8.0) for i in range(2)},
    },
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_published_set_draws_what_was_published_and_nothing_else(name):
    drawn = drawn_entries(load_ranges(name))
    found = {entry: d.bounds() for entry, d in drawn.items() if not ENTRIES[INDEX[entry]].angle}
    assert found == PUBLISHED[name]
    assert all(d.kind == "uniform" and d.probability == 1.0 for d in drawn.values())


@pytest.mark.parametrize("name", available())
def test_draws_of_every_set_fill_its_ranges(name):
    _, draws = draw(load_ranges(name).model_dump(exclude={"name"}), worlds=1500)
    for entry, distribution in draws.distributions.items():
        x, (low, high) = column(draws, entry), distribution.bounds()
        if entry == "waves.count":
            assert set(x) == {0.0, 1.0, 2.0}
            continue
        if entry.startswith("waves.") and entry.endswith("amplitude"):
            x = x[x > 0.0]  # components beyond the count are absent
        width = high - low
        assert low - 1e-5 <= x.min() and x.max() <= high + 1e-5
        assert x.min() <= low + 0.03 * width and x.max() >= high - 0.03 * width


def test_the_dead_zone_widens_to_both_sides():
    """For simulated dead zones they become [factor · dead_minus - added, factor · dead_plus + added]."""
    vehicle = load_vehicle("finsrov")
    vehicle = vehicle.replace({f"thrusters.{name}.domain": "speed" for name in vehicle.thruster_names})
    simulator, draws = draw({"dead_zone": FACTOR, "added_dead_zone": [0.0, 0.4]}, worlds=12, vehicles=vehicle)
    factor, added = (column(draws, name)[:, None] for name in ("dead_zone", "added_dead_zone"))
    thrusters, rpm = vehicle.thrusters.values(), 2.0 * np.pi / 60.0
    low = np.array([-t.c_minus * (t.dead_rpm_minus * rpm) ** 2 for t in thrusters])
    high = np.array([t.c_plus * (t.dead_rpm_plus * rpm) ** 2 for t in thrusters])
    assert (low < -0.05).all() and (high > 0.05).all()
    np.testing.assert_allclose(simulator.plant.dead_minus.numpy()[:, 0], factor * low - added, rtol=1e-5)
    np.testing.assert_allclose(simulator.plant.dead_plus.numpy()[:, 0], factor * high + added, rtol=1e-5)


def test_each_world_feels_its_own_line():
    """In a step of 0.1 ms a line across the flow changes nu_dot by M⁻¹ [-ρ C d L |v| v / 8, 0, ...], with C drawn.

    In this step the vehicle's rotation contributes at most ω_dot h v: 0.62 · 1e-4 · 0.5 [m/s²].
    """
    line, h = TetherLine(diameter=0.02), 1e-4
    parts = {"tether": {"drag_coefficient": [0.0, 2.0]}}
    simulator, draws = draw(parts, worlds=20, tether=line, control_step=h, substeps=1)
    simulator.place(position=(0.0, 0.0, -4.0), velocity=(0.5, 0.0, 0.0, 0.0, 0.0, 0.0))
    simulator.step()
    vehicle, C = simulator.vehicles[0], column(draws, "tether.drag_coefficient")
    slope = np.polyfit(C, simulator.numpy("acceleration")[:, 0].astype(float), 1)[0]
    drag = -vehicle.water.density * 0.02 * 4.0 * 0.5 * 0.5 / 8.0
    expected = np.linalg.solve(vehicle.mass_matrix("calibrated"), [drag, 0.0, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(slope, expected, rtol=1e-3, atol=4e-5)
