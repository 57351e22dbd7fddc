"""A vision policy on the robot: its named pictures, in its size, through onnxruntime."""

import numpy as np
import pytest

from finssim.control import ControlError
from finssim.control.guidance import Station
from finssim.robot.messages import Picture
from finssim.robot.perception import Perception
from finssim.robot.pilots import make_pilot
from finssim.robot.reading import Reading
from finssim.robot.runtime import Runtime
from finssim.vehicles import load_vehicle
from reference.policies import seeing

FINSROV = load_vehicle("finsrov")


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """A policy directory."""
    return seeing(tmp_path_factory.mktemp("seeing") / "policy")


def reading(image):
    """Return the reading of a vehicle at rest with an image."""
    pictures = {"front_camera": Picture(1.0, 0, image, source="front_camera")}
    place, level = np.array([0.0, 0.0, -2.0]), np.array([0.0, 0.0, 0.0, 1.0])
    return Reading(1.0, place, level, np.zeros(6), True, pictures=pictures)


@pytest.mark.parametrize("finer", [1, 2, 10])
def test_the_network_gets_the_picture_in_its_own_size(policy, finer):
    """Pictures are resized by area, so means are kept; the action is thrust along surge and sway."""
    image = np.zeros((27 * finer, 48 * finer, 3), np.uint8)
    image[:, : 24 * finer, 0], image[..., 2] = 102, 51
    pilot = make_pilot(policy, FINSROV)
    force = pilot.act(reading(image), Station((0.0, 0.0, 0.0), 0.0), 0.0)
    assert pilot.action == pytest.approx([0.2, 0.2, 0.0, 0.0, 0.0, 0.0], abs=1e-3)
    tau = FINSROV.control_matrix @ force
    assert tau[0] > 1.0 and tau[1] > 1.0 and abs(tau[2:]).max() < 1e-3 and pilot.took > 0.0


def test_what_the_robot_cannot_show_is_refused(policy):
    """A missing camera is refused; a grey picture in place of a colour one stops the vehicle with a message."""
    blind = FINSROV.model_copy(update={"perception": {"altimeter": FINSROV.perception["altimeter"]}})
    with pytest.raises(
        ControlError, match="policy sees front_camera, which finsrov does not have: .*altimeter"
    ):
        make_pilot(policy, blind)
    runtime = Runtime(
        FINSROV, Perception(FINSROV, None), make_pilot(policy, FINSROV), Station((0.0, 0.0, 0.0), 0.0)
    )
    runtime.start(0.0)
    gray = reading(np.zeros((27, 48), np.uint8))
    runtime._decide(1.0, gray)
    assert runtime.bridge.state == "fault" or "a picture of shape (27, 48) came" in runtime.bridge.reason
