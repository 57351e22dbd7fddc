"""The plant moves as the engine does if nothing is hidden, and physically if everything is."""

import numpy as np
import pytest

from finssim.core.rotations import quat_to_matrix
from finssim.pool import draw_plant
from finssim.pool.plant import Plant
from finssim.pool.plant_spec import Basin, Battery, BuoyancyDrift, Circulation
from finssim.sim import RectangularPool, Simulator
from finssim.vehicles import load_vehicle

LEVEL = (0.0, 0.0, 0.0, 1.0)
FINSROV = load_vehicle("finsrov")
QUIET = {"circulation": Circulation(), "tether": None, "buoyancy": BuoyancyDrift()}


def test_the_nominal_plant_moves_as_the_engine_does():
    """The calibrated simulation, driven with the thrusts of the plant's motors, follows it for five seconds."""
    spec = draw_plant(FINSROV, 0, "nominal")
    plant = Plant(FINSROV, spec)
    engine = Simulator(FINSROV, control_step=plant.step, substeps=1, pool=RectangularPool(), max_delay=0.1)
    engine.plant.time_constant.zero_()
    engine.plant.delay.zero_()
    engine.plant.dead_plus.zero_()
    engine.plant.dead_minus.zero_()
    engine.refresh()
    engine.place(position=(0.0, 0.0, -0.5))
    plant.target[:] = (80.0, 80.0, 60.0, 60.0, 120.0, 90.0, -80.0, -110.0)
    for _ in range(1000):
        plant.advance()
        engine.set_thrust(plant.thrust)
        engine.step()
    assert np.linalg.norm(plant.position[:2]) > 0.2
    # float32 and two orders of summation, over a thousand steps
    np.testing.assert_allclose(plant.position, engine.numpy("position")[0, 0], atol=2e-3)
    np.testing.assert_allclose(plant.nu, engine.numpy("velocity")[0, 0], atol=2e-3)


@pytest.mark.parametrize("seed", range(4))
def test_without_thrust_a_moving_plant_only_slows_down(seed):
    """Coupled damping and panels remove energy at every step; the balance excludes the work of trim and
    buoyancy."""
    spec = draw_plant(FINSROV, seed, "hard")
    body = spec.body.model_copy(update={"displaced_volume": spec.body.mass / FINSROV.water.density,
                                        "center_of_buoyancy": spec.body.center_of_gravity})  # fmt: skip
    basin = Basin(length=400.0, width=400.0, depth=200.0)
    plant = Plant(
        FINSROV,
        spec.model_copy(update={**QUIET, "body": body, "basin": basin}),
        start=((0.0, 0.0, -100.0), LEVEL),
    )
    M = np.linalg.inv(plant.simulator.plant.M_inv.numpy()[0, 0].astype(float))
    plant.nu[:] = np.random.default_rng(seed).normal(size=6) * (0.4, 0.4, 0.3, 1.0, 1.0, 1.0)
    energy = []
    for _ in range(400):
        energy.append(0.5 * plant.nu @ M @ plant.nu)
        plant.advance()
    assert np.all(np.diff(energy) < 1e-6 * energy[0])
    assert energy[-1] < 0.3 * energy[0]


def test_a_plant_lies_where_its_hidden_trim_puts_it():
    """At rest its centre of gravity hangs below its centre of buoyancy, and it is not level."""
    spec = draw_plant(FINSROV, 2, "hard").model_copy(update=QUIET)
    plant = Plant(FINSROV, spec)
    plant.advance(2000)
    arm = np.subtract(spec.body.center_of_buoyancy, spec.body.center_of_gravity)
    up = quat_to_matrix(plant.quaternion)[2]
    assert np.allclose(up, arm / np.linalg.norm(arm), atol=2e-3)


def test_it_drifts_with_the_circulation():
    """A passive vehicle is carried along by the circulation; in still water it stays."""
    spec = draw_plant(FINSROV, 1, "realistic")
    spec = spec.model_copy(update={"tether": spec.tether.model_copy(update={"length": 50.0})})
    # Eddies without speed use the same kernel, so nothing is compiled for this test alone.
    calm = Circulation(eddies=[eddy.model_copy(update={"speed": 0.0}) for eddy in spec.circulation.eddies])
    carried = Plant(FINSROV, spec, start=((0.6, 0.3, -0.5), LEVEL))
    still = Plant(FINSROV, spec.model_copy(update={"circulation": calm}), start=((0.6, 0.3, -0.5), LEVEL))
    for plant in (carried, still):
        plant.advance(2000)
    assert np.hypot(*(carried.position[:2] - (0.6, 0.3))) > 0.04
    assert np.hypot(*(still.position[:2] - (0.6, 0.3))) < 0.01


def test_it_stays_inside_the_walls():
    """With full surge into the wall the envelope ends at the wall, to within its compliance."""
    spec = draw_plant(FINSROV, 1, "hard")
    plant = Plant(FINSROV, spec)
    share = np.linalg.pinv(FINSROV.control_matrix) @ (15.0 * np.eye(6)[0])
    plant.target[:] = [float(t.speed(f)) for t, f in zip(FINSROV.thrusters.values(), share, strict=True)]
    for _ in range(200):
        plant.advance(10)
        assert np.all(np.abs(plant.position[:2]) < (2.0, 1.0)) and -1.0 < plant.position[2] < 0.1


def test_buoyancy_drifts_by_grams():
    """A plant heavier by a few grams sinks at the speed where damping balances them."""
    drift = BuoyancyDrift(grams=(50.0,), periods=(1.0e6,), phases=(-np.pi / 2.0,))
    spec = draw_plant(FINSROV, 0, "nominal")
    body = spec.body.model_copy(update={"displaced_volume": spec.body.mass / FINSROV.water.density})
    basin = Basin(depth=20.0)
    plant = Plant(
        FINSROV,
        spec.model_copy(update={"buoyancy": drift, "body": body, "basin": basin}),
        start=((0.0, 0.0, -5.0), LEVEL),
    )
    plant.advance(1600)
    F, d1, d2 = 0.05 * 9.81, 80.09677, 100.0
    assert plant.nu[2] == pytest.approx(-2.0 * F / (d1 + np.sqrt(d1 * d1 + 4.0 * d2 * F)), rel=0.02)


def test_a_battery_that_sags_gives_less_speed_at_full_throttle():
    """At full command the shafts turn slower in proportion to the loss of voltage."""
    spec = draw_plant(FINSROV, 0, "nominal")
    speeds = []
    for battery in (Battery(), Battery(fade=0.2, fade_time=0.1)):
        plant = Plant(FINSROV, spec.model_copy(update={"battery": battery}))
        plant.target[4] = 600.0
        plant.advance(300)
        speeds.append(float(plant.shaft_speed[4]))
        assert plant.electric[0] == pytest.approx(16.4 * (1.0 - battery.fade), rel=1e-5)
    assert speeds[1] == pytest.approx(0.8 * speeds[0], rel=1e-3)
