"""Fins, buoyancy engines, moving masses and hydrodynamic terms in the plants of the virtual pool."""

import numpy as np
import pytest

from finssim.pool import PlantSpecError, draw_plant
from finssim.pool.drawn_plant import site_of
from finssim.pool.plant import Plant
from finssim.sim import Simulator
from finssim.vehicles import load_vehicle
from tests.reference.finned import torpedo

TORPEDO = torpedo()
NOMINAL = site_of("open-water", draw_plant(TORPEDO, 0, "nominal"))
COMMAND = np.array([0.2, -0.15, 6e-4, 0.03])


@pytest.mark.slow
def test_a_nominal_torpedo_moves_as_the_engine_does():
    """All actuators and the terms of its hull: the simulation that gets its thrust follows it for five seconds."""
    plant = Plant(TORPEDO, NOMINAL, position=(0.0, 0.0, -8.0))
    engine = Simulator(TORPEDO, control_step=plant.step, substeps=1)
    engine.plant.time_constant.numpy()[..., 0] = 0.0
    engine.plant.dead_plus.zero_()
    engine.refresh()
    engine.place(position=(0.0, 0.0, -8.0))
    plant.target[:] = 120.0
    plant.set_points(COMMAND)
    for _ in range(1000):
        plant.advance()
        engine.set_actuators([*plant.thrust, *COMMAND])
        engine.step()
    np.testing.assert_allclose(plant.values, [0.196, -0.15, 6e-4, 0.03], rtol=1e-3)
    assert plant.nu[0] > 1.0 and plant.nu[5] < -0.1
    np.testing.assert_allclose(plant.position, engine.numpy("position")[0, 0], atol=5e-3)
    np.testing.assert_allclose(plant.nu, engine.numpy("velocity")[0, 0], atol=5e-3)


def test_a_drawn_actuator_is_not_quite_that_of_the_file():
    """Gain and offset lie between its sensor, which shows what was asked for, and its value; seeds keep their draws."""
    spec = draw_plant(TORPEDO, 3, "hard")
    assert spec == draw_plant(TORPEDO, 3, "hard") and set(spec.actuators) == set(TORPEDO.actuators)
    assert spec.terms["surge_damping"] != 1.0
    assert spec.thrusters == draw_plant(load_vehicle("remus100"), 3, "hard").thrusters
    plant = Plant(TORPEDO, spec, position=(0.0, 0.0, -8.0))
    plant.set_points(COMMAND)
    plant.advance(1000)
    elevator = spec.actuators["elevator"]
    assert plant.measured_values[1] == pytest.approx(-0.15, abs=1e-4)
    assert plant.values[1] == pytest.approx(elevator.gain * (-0.15 + elevator.offset), abs=1e-4)


def test_a_term_of_a_drawn_plant_is_stronger_or_weaker_than_in_the_file():
    """Its factor scales the wrench: a plant whose damping is the term alone slows down so much faster."""
    spec = draw_plant(TORPEDO, 3, "nominal")
    slowed = []
    for factor in (1.0, 1.5):
        plant = Plant(TORPEDO, spec.model_copy(update={"terms": {"surge_damping": factor}}))
        plant.nu[:] = (1.0, 0.3, 0.0, 0.0, 0.0, 0.0)
        Y = np.linalg.inv(plant.simulator.plant.M_inv.numpy()[0, 0].astype(float))
        before = plant.nu.astype(float)
        plant.advance()
        slowed.append((Y @ (plant.nu - before))[1] / plant.step)
    assert slowed[1] - slowed[0] == pytest.approx(-0.5 * 28.6 * 1.0 * 0.3, rel=0.03)


def test_plants_of_other_actuators_are_refused():
    """One sentence names both sides."""
    other = torpedo(rudder=TORPEDO.actuators["rudder"].model_dump())
    with pytest.raises(
        PlantSpecError, match="has the actuators rudder, elevator, engine, battery, but torpedo has"
    ):
        Plant(other, NOMINAL)
    with pytest.raises(PlantSpecError, match="terms none, but remus100 has surge_damping"):
        Plant(
            load_vehicle("remus100"), draw_plant(load_vehicle("remus100"), 0).model_copy(update={"terms": {}})
        )
