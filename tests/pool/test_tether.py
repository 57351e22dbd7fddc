"""A slack tether exerts no force until it is nearly straight, and then pulls towards its anchor."""

import numpy as np
import pytest
import warp as wp

from finssim.physics.types import vec6
from finssim.pool import draw_plant
from finssim.pool.plant import Plant, SlackTetherData, dragged_line, slack_line, slack_pull
from finssim.pool.plant_spec import Basin, Circulation, Eddy, HullDrag, SlackTether
from finssim.vehicles import load_vehicle

TETHER = SlackTether(
    anchor=(0.0, 0.0, 0.0), attachment=(-0.2, 0.0, 0.1), length=3.0, slack_share=0.1, stiffness=30.0
)


@wp.kernel(enable_backward=False)
def evaluate(line: SlackTetherData, position: wp.vec3, out: wp.array(dtype=vec6)):
    out[0] = slack_pull(line, position, wp.quat_identity())


def pull(distance, tether=TETHER):
    """Return the wrench when the attachment is straight below the anchor at a distance."""
    out = wp.zeros(1, dtype=vec6, device="cpu")
    position = wp.vec3(0.2, 0.0, -distance - 0.1)
    wp.launch(evaluate, dim=1, inputs=[slack_line(tether), position, out], device="cpu")
    return out.numpy()[0]


def test_a_slack_line_does_not_pull():
    """There is no pull up to nine tenths of the length here."""
    assert np.all(pull(2.7) == 0.0) and np.all(pull(1.0) == 0.0)


def test_a_straight_line_pulls_towards_its_anchor_at_its_attachment():
    """F = k e²/(2 s), and the moment is that of a force at the attachment."""
    wrench = pull(2.85)
    F = 30.0 * 0.15**2 / (2.0 * 0.3)
    np.testing.assert_allclose(wrench, [0.0, 0.0, F, 0.0, 0.2 * F, 0.0], atol=1e-4)


def test_the_pull_has_no_jump():
    """The pull is continuous where it sets in and where the line becomes straight."""
    for distance in (2.7, 3.0):
        assert abs(pull(distance + 1e-3)[2] - pull(distance - 1e-3)[2]) < 2.1e-3 * 30.0


def test_no_tether_is_no_force():
    """There is neither pull nor drag."""
    assert np.all(pull(9.0, None) == 0.0)
    assert dragged_line(None) is None


def test_a_plant_cannot_leave_its_tether():
    """Pushed away with full force, the plant comes to rest about where pull and thrust balance."""
    vehicle = load_vehicle("finsrov")
    short = SlackTether(anchor=(0.0, 0.0, -0.5), attachment=(0.0, 0.0, 0.0), length=1.0, stiffness=200.0)
    spec = draw_plant(vehicle, 0, "nominal").model_copy(
        update={
            "tether": short,
            "basin": Basin(length=20.0, width=20.0),
            # Almost zero, so that the kernel is that of every drawn plant and nothing is compiled for this test.
            "hull": HullDrag(form_drag=1e-9),
            "circulation": Circulation(
                eddies=(Eddy(cells=1, speed=0.0, unsteadiness=0.0, period=1.0, phase=0.0),)
            ),
        }
    )
    plant = Plant(vehicle, spec)
    share = np.linalg.pinv(vehicle.control_matrix) @ (5.0 * np.eye(6)[0])
    pairs = zip(vehicle.thrusters.values(), share, strict=True)
    plant.target[:] = [float(t.speed(f)) if abs(f) > 0.1 else 0.0 for t, f in pairs]
    plant.advance(6000)
    # k e²/(2 s) = 5 N at e = 63 mm beyond 0.92 m
    assert np.linalg.norm(plant.position - (0.0, 0.0, -0.5)) == pytest.approx(0.92 + 0.063, abs=0.02)
