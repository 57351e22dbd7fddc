"""Plants drawn around a vehicle: physical, repeatable, graded, and recognisably the vehicle."""

import numpy as np
import pytest

from finssim.pool import SPREADS, PlantSpecError, draw_plant
from finssim.pool.plant import Plant
from finssim.pool.plant_spec import Basin, Circulation
from finssim.vehicles import load_vehicle

FINSROV = load_vehicle("finsrov")
HYDRO = FINSROV.hydrodynamics["calibrated"]
OPEN_WATER = {
    "basin": Basin(length=400.0, width=400.0, depth=200.0),
    "circulation": Circulation(),
    "tether": None,
}


def distance(spec):
    """Return a plant's distance from the vehicle file: relative changes of its largest groups of numbers."""
    M_A = spec.added_mass.about_origin() - FINSROV.added_mass_matrix()
    gains = [g - 1.0 for t in spec.thrusters.values() for g in (t.gain_plus, t.gain_minus)]
    offset = np.subtract(spec.body.center_of_gravity, FINSROV.body.center_of_gravity)
    current = sum(eddy.speed for eddy in spec.circulation.eddies)
    return np.array(
        [np.linalg.norm(M_A), np.linalg.norm(gains), np.linalg.norm(offset), spec.battery.fade, current]
    )


def test_equal_seeds_give_equal_plants_and_others_do_not():
    """Seed, severity and vehicle determine a plant."""
    assert draw_plant(FINSROV, 7, "realistic") == draw_plant(FINSROV, 7, "realistic")
    assert draw_plant(FINSROV, 7, "realistic") != draw_plant(FINSROV, 8, "realistic")


def test_the_nominal_plant_has_the_numbers_of_the_file():
    """It has no added coupling, no loss, no current and no tether."""
    spec = draw_plant(FINSROV, 3, "nominal")
    assert np.all(distance(spec) == 0.0)
    assert np.allclose(spec.damping.linear, HYDRO.linear_damping)
    assert np.allclose(spec.damping.quadratic, HYDRO.quadratic_damping)
    assert spec.hull.form_drag == 0.0 and spec.tether is None and spec.buoyancy.grams == ()


def test_each_seed_is_harder_where_the_severity_is():
    """nominal < realistic < hard, for every seed and every group of numbers."""
    for seed in range(10):
        nominal, realistic, hard = (distance(draw_plant(FINSROV, seed, s)) for s in SPREADS)
        assert np.all(nominal < realistic) and np.all(realistic < hard)


def test_matrices_are_coupled_and_physical():
    """Added mass is symmetric positive definite, with off-diagonal entries that the file does not have."""
    for seed in range(10):
        M_A = draw_plant(FINSROV, seed, "hard").added_mass.about_origin()
        assert np.allclose(M_A, M_A.T) and np.linalg.eigvalsh(M_A)[0] > 0.0
        extra = M_A - FINSROV.added_mass_matrix()
        assert np.abs(extra[0, 2]) > 0.01 and np.abs(extra[1, 3]) > 0.01


def test_couplings_that_could_add_energy_are_made_smaller():
    """For a vehicle that rolls by its sideways drag, the drawn plant still only loses energy; `Damping`
    checks this."""
    strong = load_vehicle("bluerov2").hydrodynamics["calibrated"].quadratic_damping.copy()
    strong[3, 1] = -strong[1, 1]
    vehicle = load_vehicle("bluerov2").replace(
        {"hydrodynamics.calibrated.quadratic_damping": strong.tolist()}
    )
    found = np.array(draw_plant(vehicle, 1).damping.quadratic)
    usual = np.array(draw_plant(load_vehicle("bluerov2"), 1).damping.quadratic)
    assert np.diag(found) == pytest.approx(np.diag(usual)) and 0.0 < -found[3, 1] < 0.5 * strong[1, 1]


def test_the_mean_plant_is_the_vehicle():
    """Over seeds, mean added mass and thrust are the file's, within the scatter of 40 draws of ±10 and ±15 %."""
    specs = [draw_plant(FINSROV, seed, "realistic") for seed in range(40)]
    M_A = np.mean([np.diag(s.added_mass.matrix) for s in specs], axis=0)
    assert np.allclose(M_A, np.diag(HYDRO.added_mass), rtol=3.0 * 0.1 / np.sqrt(3.0 * 40.0))
    gains = np.mean([t.gain_plus for s in specs for t in s.thrusters.values()])
    assert abs(gains - 1.0) < 3.0 * 0.15 / np.sqrt(3.0 * 320.0)


def steady_speed(spec, axis, wrench):
    """Return the steady speed of a plant that can move along one axis only [m/s, rad/s]."""
    plant = Plant(
        FINSROV, spec.model_copy(update=OPEN_WATER), start=((0.0, 0.0, -100.0), (0.0, 0.0, 0.0, 1.0))
    )
    force = np.linalg.pinv(FINSROV.control_matrix) @ (wrench * np.eye(6)[axis])
    plant.target[:] = [
        float(t.speed(f)) if abs(f) > 0.1 else 0.0
        for t, f in zip(FINSROV.thrusters.values(), force, strict=True)
    ]
    M = np.linalg.inv(plant.simulator.plant.M_inv.numpy()[0, 0].astype(float))
    for _ in range(1200):
        plant.advance()
        # A guide rail: its forces change no momentum along the axis.
        along = (M @ plant.nu)[axis] / M[axis, axis]
        plant.nu[:] = along * np.eye(6)[axis]
        plant.quaternion[:] = (0.0, 0.0, 0.0, 1.0)
    return float(plant.nu[axis])


def file_speed(axis, wrench):
    """Return the same speed from the file: d1 v + d2 v² = wrench."""
    d1, d2 = HYDRO.linear_damping[axis, axis], HYDRO.quadratic_damping[axis, axis]
    return 2.0 * wrench / (d1 + np.sqrt(d1 * d1 + 4.0 * d2 * wrench))


@pytest.mark.slow
@pytest.mark.parametrize("axis", [0, 1, 2, 5])
def test_a_realistic_plant_is_still_as_fast_as_the_vehicle(axis):
    """At 0.3 of full power each of 6 plants is within a quarter of the file's speed, and their mean within a tenth."""
    wrench = 0.3 * FINSROV.wrench_limits[axis]
    ratios = [
        steady_speed(draw_plant(FINSROV, seed, "realistic"), axis, wrench) / file_speed(axis, wrench)
        for seed in range(6)
    ]
    assert 0.75 < min(ratios) and max(ratios) < 1.25
    assert abs(np.mean(ratios) - 1.0) < 0.1


def test_a_vehicle_without_what_the_pool_needs_is_refused():
    """The message names what is missing, or an unknown severity."""
    blind = FINSROV.model_copy(update={"sensors": FINSROV.sensors.model_copy(update={"imu": None})})
    with pytest.raises(PlantSpecError, match="has no sensors.imu"):
        draw_plant(blind, 0, "nominal")
    with pytest.raises(PlantSpecError, match="available: nominal, realistic, hard"):
        draw_plant(FINSROV, 0, "cruel")
    other = FINSROV.model_copy(update={"thrusters": dict(list(FINSROV.thrusters.items())[:6])})
    with pytest.raises(PlantSpecError, match="draw a plant around this vehicle"):
        Plant(other, draw_plant(FINSROV, 0, "nominal"))


def test_a_plant_is_drawn_around_an_identified_file_too():
    """Draws are centred on the values of the file, whatever its source."""
    heavier = FINSROV.replace({"body.mass": 13.0, "hydrodynamics.calibrated.linear_damping.0.0": 60.0})
    spec = draw_plant(heavier, 1, "nominal")
    assert spec.body.mass == 13.0 and spec.damping.linear[0][0] == 60.0
