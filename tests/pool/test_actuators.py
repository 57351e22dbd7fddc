"""Fins, buoyancy engines, moving masses and hydrodynamic terms in the plants of the virtual pool."""

import numpy as np
import pytest

from finssim.pool import PlantSpecError, VirtualPool, draw_plant, read_truth
from finssim.pool.drawn_plant import site_of
from finssim.pool.firmware import Firmware
from finssim.pool.plant import Plant
from finssim.robot.links.frames import (
    HOST,
    Decoder,
    LinkError,
    RejectFlag,
    crc16_modbus,
    encode_command,
    encode_debug_config,
)
from finssim.robot.messages import Telemetry, ThrusterCommand
from finssim.robot.wiring import link_of
from finssim.sim import Simulator
from finssim.vehicles import load_vehicle
from reference.finned import torpedo

TORPEDO = torpedo()
NOMINAL = site_of("open-water", draw_plant(TORPEDO, 0, "nominal"))
COMMAND = np.array([0.2, -0.15, 6e-4, 0.03])


@pytest.mark.slow
def test_a_nominal_torpedo_moves_as_the_engine_does():
    """The simulation with all actuators and hull terms, given the plant's thrust, follows the plant for five
    seconds."""
    plant = Plant(TORPEDO, NOMINAL, start=((0.0, 0.0, -8.0), (0.0, 0.0, 0.0, 1.0)))
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
    """Gain and offset act between an actuator's sensor, which shows the request, and its value; seeds repeat."""
    spec = draw_plant(TORPEDO, 3, "hard")
    assert spec == draw_plant(TORPEDO, 3, "hard") and set(spec.actuators) == set(TORPEDO.actuators)
    assert spec.terms["surge_damping"] != 1.0
    assert spec.thrusters == draw_plant(load_vehicle("remus100"), 3, "hard").thrusters
    plant = Plant(TORPEDO, spec, start=((0.0, 0.0, -8.0), (0.0, 0.0, 0.0, 1.0)))
    plant.set_points(COMMAND)
    plant.advance(1000)
    elevator = spec.actuators["elevator"]
    assert plant.measured_values[1] == pytest.approx(-0.15, abs=1e-4)
    assert plant.values[1] == pytest.approx(elevator.gain * (-0.15 + elevator.offset), abs=1e-4)


def test_the_axes_of_a_slender_hull_are_hardly_tilted():
    """Tilt, centre and trim are drawn in proportion to beam over length: otherwise added mass would outweigh
    the rudder."""
    remus = load_vehicle("remus100")
    spec, share = draw_plant(remus, 3, "hard"), 0.191 / 1.33
    assert 0.0 < np.abs(spec.added_mass.tilt_deg).max() < 6.0 * share
    assert np.linalg.norm(spec.body.center_of_gravity - remus.body.center_of_gravity) < 0.012 * share
    assert np.abs(draw_plant(load_vehicle("finsrov"), 3, "hard").added_mass.tilt_deg).max() > 6.0 * share


def test_a_term_of_a_drawn_plant_is_stronger_or_weaker_than_in_the_file():
    """The term's factor scales its wrench: a plant damped by this term alone slows down faster by that
    factor."""
    spec = draw_plant(TORPEDO, 3, "nominal")
    slowed = []
    for factor in (1.0, 1.5):
        plant = Plant(
            TORPEDO, spec.model_copy(update={"terms": {"surge_damping": factor, "munk_relief": 1.0}})
        )
        plant.nu[:] = (1.0, 0.3, 0.0, 0.0, 0.0, 0.0)
        Y = np.linalg.inv(plant.simulator.plant.M_inv.numpy()[0, 0].astype(float))
        before = plant.nu.astype(float)
        plant.advance()
        slowed.append((Y @ (plant.nu - before))[1] / plant.step)
    assert slowed[1] - slowed[0] == pytest.approx(-0.5 * 18.96 * 1.0 * 0.3, rel=0.03)


def test_plants_of_other_actuators_are_refused():
    """One sentence names the actuators of both sides."""
    other = torpedo(rudder=TORPEDO.actuators["rudder"].model_dump())
    with pytest.raises(
        PlantSpecError, match="has the actuators rudder, elevator, engine, battery, but torpedo has"
    ):
        Plant(other, NOMINAL)
    with pytest.raises(PlantSpecError, match="terms none, but remus100 has munk_relief, surge_damping"):
        Plant(
            load_vehicle("remus100"), draw_plant(load_vehicle("remus100"), 0).model_copy(update={"terms": {}})
        )


# Over the wire: commands reach the plant, and actuator values come back.


def exchanged(pool, until, command=None):
    """Return the newest telemetry of a pool that is sent a command 50 times a second until a time [s]."""
    decoder, newest = Decoder(HOST, 1, 4), None
    while pool.time < until - 1e-6:
        sent = [] if command is None else [encode_command(command)]
        for _, data in pool.exchange(pool.time + 0.02, sent).frames:
            newest = next((m for m in decoder.feed(data) if isinstance(m, Telemetry)), newest)
    return newest


def test_actuators_follow_the_wire_and_stop_when_it_falls_silent():
    """Setpoints of version 2 move them and telemetry reports values; after the timeout fins go to 0, others
    keep theirs."""
    pool = VirtualPool(TORPEDO, NOMINAL, start=((0.0, 0.0, -8.0), (0.0, 0.0, 0.0, 1.0)))
    heard = exchanged(pool, 2.0, ThrusterCommand(True, (0.3,), (0.2, -0.15, 2e-4, 0.02)))
    np.testing.assert_allclose(heard.actuators, [0.196, -0.15, 2e-4, 0.02], atol=1e-5)
    np.testing.assert_allclose(pool.plant.values, heard.actuators, atol=1e-6)
    heard = exchanged(pool, 3.5)
    np.testing.assert_allclose(heard.actuators, [0.0, 0.0, 2e-4, 0.02], atol=5e-3)
    assert heard.actuators[2] == pytest.approx(2e-4, rel=1e-3) and not pool.plant.target.any()


def test_a_moving_engine_stops_where_it_is_when_motors_are_switched_off():
    """The engine moves at 2e-4 m³/s for one second before it is disabled."""
    pool = VirtualPool(TORPEDO, NOMINAL, start=((0.0, 0.0, -8.0), (0.0, 0.0, 0.0, 1.0)))
    exchanged(pool, 1.0, ThrusterCommand(True, (0.0,), (0.0, 0.0, 1e-3, 0.0)))
    heard = exchanged(pool, 2.0, ThrusterCommand(False, (0.0,), (0.0, 0.0, 1e-3, 0.0)))
    assert heard.actuators[2] == pytest.approx(2e-4, rel=0.05)


def test_a_command_without_setpoints_is_a_bad_frame():
    """Version 1 does not move a vehicle that has other actuators than thrusters; the echo gives the reason."""
    firmware = Firmware(TORPEDO, NOMINAL)
    firmware.receive(0.0, encode_debug_config(1, 1, 1))
    (echo,) = Decoder(HOST, 1, 4).feed(
        firmware.receive(0.1, encode_command(ThrusterCommand(True, (0.5,))))[0]
    )
    assert not echo.accepted and echo.reject_flags == RejectFlag.BAD_FRAME and not firmware.target.any()
    command = encode_command(ThrusterCommand(True, (0.5,), (0.9, 0.0, 0.0, 0.0)))
    (echo,) = Decoder(HOST, 1, 4).feed(firmware.receive(0.2, command)[0])
    assert echo.accepted and echo.command_crc == crc16_modbus(command[2:-2])
    np.testing.assert_allclose(firmware.setpoints, [0.35, 0.0, 0.0, 0.0])


def test_an_autopilot_that_moves_thrusters_alone_is_refused():
    """Pool and robot each refuse it in one sentence."""
    with pytest.raises(PlantSpecError, match="firmware ardusub moves only thrusters, but torpedo has rudder"):
        VirtualPool(TORPEDO, NOMINAL, firmware="ardusub")
    with pytest.raises(LinkError, match="mavlink moves only thrusters, but torpedo has rudder"):
        link_of("mavlink", TORPEDO)


def test_the_truth_holds_the_values(tmp_path):
    """There is one column for each actuator, named in the header; none for a vehicle of thrusters alone."""
    pool = VirtualPool(
        TORPEDO, NOMINAL, start=((0.0, 0.0, -8.0), (0.0, 0.0, 0.0, 1.0)), truth=tmp_path / "t.fst"
    )
    exchanged(pool, 0.5, ThrusterCommand(True, (0.0,), (0.2, 0.0, 0.0, 0.0)))
    pool.close()
    truth = read_truth(tmp_path / "t.fst")
    assert truth.header["actuators"] == ["rudder", "elevator", "engine", "battery"]
    assert truth.actuators.shape == (len(truth.time), 4)
    assert truth.actuators[-1, 0] == pytest.approx(float(pool.plant.values[0]))
