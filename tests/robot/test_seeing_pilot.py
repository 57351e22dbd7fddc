"""A policy directory that sees, on the robot: the pictures that it names, in its size, through onnxruntime."""

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from finssim.control import ControlError
from finssim.control.guidance import Station
from finssim.control.modes import action_mode
from finssim.control.policy import PolicyDescription, VehicleIdentity
from finssim.learning.export import export_policy
from finssim.robot.messages import Picture
from finssim.robot.pilots import make_pilot
from finssim.robot.reading import Reading
from finssim.robot.runtime import Runtime
from finssim.tasks import task_named
from finssim.vehicles import load_vehicle

FINSROV = load_vehicle("finsrov")
SHAPE = (27, 48, 3)


def network():
    """Surge is the mean of red, sway that of blue, as parts of 255; the row is not looked at."""
    weights = np.zeros((6, 3), np.float32)
    weights[0, 0] = weights[1, 2] = 1.0 / 255.0
    constants = [numpy_helper.from_array(weights, "gain"), numpy_helper.from_array(np.array([1, 2]), "axes")]
    nodes = [
        helper.make_node("Cast", ["front_camera"], ["light"], to=TensorProto.FLOAT),
        helper.make_node("ReduceMean", ["light", "axes"], ["mean"], keepdims=0),
        helper.make_node("Gemm", ["mean", "gain"], ["action"], transB=1),
    ]
    inputs = [
        helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["N", 10]),
        helper.make_tensor_value_info("front_camera", TensorProto.UINT8, ["N", *SHAPE]),
    ]
    action = helper.make_tensor_value_info("action", TensorProto.FLOAT, ["N", 6])
    graph = helper.make_graph(nodes, "policy", inputs, [action], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    return model.SerializeToString()


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """Its directory."""
    task = task_named("camera-docking")
    about = {"device": "low_light_camera", "shape": list(SHAPE), "rate": 10.0, "latency": 0.1}
    description = PolicyDescription(
        task=task.name, observation=task.schema, pictures={"front_camera": about},
        action=action_mode("wrench6", FINSROV).describe(), control_period=task.control_step,
        vehicle=VehicleIdentity(name=FINSROV.name, sha256=FINSROV.sha256), hydrodynamics="calibrated", seed=0,
        training={"randomization": None},
    )  # fmt: skip
    return export_policy(network(), tmp_path_factory.mktemp("seeing") / "policy", description)


def reading(image):
    """A vehicle at rest that sees an image."""
    pictures = {"front_camera": Picture(1.0, 0, image, source="front_camera")}
    place, level = np.array([0.0, 0.0, -2.0]), np.array([0.0, 0.0, 0.0, 1.0])
    return Reading(1.0, place, level, np.zeros(6), True, pictures=pictures)


@pytest.mark.parametrize("finer", [1, 2, 10])
def test_the_network_gets_the_picture_in_its_own_size(policy, finer):
    """Whatever the camera's: by area, so that means stay; and what it asks for is thrust along surge and sway."""
    image = np.zeros((27 * finer, 48 * finer, 3), np.uint8)
    image[:, : 24 * finer, 0], image[..., 2] = 102, 51
    pilot = make_pilot(policy, FINSROV)
    force = pilot.act(reading(image), Station((0.0, 0.0, 0.0), 0.0), 0.0)
    assert pilot.action == pytest.approx([0.2, 0.2, 0.0, 0.0, 0.0, 0.0], abs=1e-3)
    tau = FINSROV.control_matrix @ force
    assert tau[0] > 1.0 and tau[1] > 1.0 and abs(tau[2:]).max() < 1e-3 and pilot.took > 0.0


def test_what_the_robot_cannot_show_is_refused(policy):
    """No camera of that name; a gray picture where colours are seen stops the vehicle with a sentence."""
    blind = FINSROV.model_copy(update={"perception": {"altimeter": FINSROV.perception["altimeter"]}})
    with pytest.raises(
        ControlError, match="policy sees front_camera, which finsrov does not have: .*altimeter"
    ):
        make_pilot(policy, blind)
    runtime = Runtime(FINSROV, None, make_pilot(policy, FINSROV), Station((0.0, 0.0, 0.0), 0.0))
    runtime.start(0.0)
    gray = reading(np.zeros((27, 48), np.uint8))
    runtime._decide(1.0, gray)
    assert runtime.bridge.state == "fault" or "a picture of shape (27, 48) came" in runtime.bridge.reason
