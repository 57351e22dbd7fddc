"""Fault injection on the wire changes the intended data, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.core.quiet import start_warp
from finssim.pool.drawn_plant import draw_plant
from finssim.pool.virtual_pool import VirtualPool
from finssim.robot.links.frames import Decoder, encode_command
from finssim.robot.messages import ThrusterCommand
from finssim.vehicles import load_vehicle
from studies.faults import FaultyWire

VEHICLE = load_vehicle("finsrov")
SURGE = encode_command(ThrusterCommand(True, (-0.3, -0.3, 0.0, 0.0, 0.0, -0.3, 0.3, 0.0)))


@pytest.fixture
def wire():
    """A wire to a pool without a camera."""
    start_warp()
    return FaultyWire(VirtualPool(VEHICLE, draw_plant(VEHICLE, 1, "nominal")), 60.0)


def test_an_untouched_wire_passes_every_byte(wire):
    """The bytes equal those of the pool alone."""
    alone = VirtualPool(VEHICLE, draw_plant(VEHICLE, 1, "nominal"))
    for k in range(1, 31):
        assert wire.exchange(k / 60, [SURGE]) == alone.exchange(k / 60, [SURGE])


def test_a_shift_moves_the_robots_clock_and_not_the_pools(wire):
    """Deliveries and arrivals shift by 5 s; the pool advances by one period per turn, whatever time is
    requested."""
    first = wire.exchange(1 / 60, [])
    wire.shift = 5.0
    second = wire.exchange(99.0, [])
    assert (first.time, second.time) == pytest.approx((1 / 60, 5.0 + 2 / 60))
    assert all(5.0 < arrival <= second.time for arrival, _ in second.frames)
    assert wire.pool.time == pytest.approx(2 / 60)


def test_a_changed_snapshot_still_decodes(wire):
    """The depth is the injected one, with a valid checksum; everything else is unchanged."""
    wire.change = lambda telemetry: replace(telemetry, depth=0.25)
    decoder = Decoder(outputs=8)
    delivery = wire.exchange(0.0, [])
    delivery = delivery if delivery.frames else wire.exchange(0.0, [])
    found = [message for _, data in delivery.frames for message in decoder.feed(data)]
    assert found and all(message.depth == 0.25 for message in found)


def test_the_course_is_the_truth_at_each_exchange(wire):
    """Thrust appears after frames that enable it, and both are recorded."""
    for _ in range(30):
        wire.exchange(0.0, [SURGE])
    course = wire.course()
    assert course.time[0] == 0.0 and course.enabled.all()
    assert np.abs(course.thrust[0]).max() == 0.0 and np.abs(course.thrust[-1]).max() > 0.5
