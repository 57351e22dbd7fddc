"""Policy directories of networks made by tests."""

import numpy as np
from onnx import TensorProto, helper, numpy_helper

from finssim.control.modes import action_mode
from finssim.control.policy import PolicyDescription, VehicleIdentity
from finssim.learning.export import export_policy
from finssim.tasks import task_named
from finssim.vehicles import load_vehicle

FINSROV = load_vehicle("finsrov")
SHAPE = (27, 48, 3)
"""Shape of the pictures of `seeing`."""


def linear(gain):
    """Return a network without bias: action = gain · observation."""
    import torch
    from torch import nn

    layer = nn.Linear(gain.shape[1], gain.shape[0], bias=False)
    layer.weight.data = torch.from_numpy(gain)
    return nn.Sequential(layer)


def written(network, folder, task, size):
    """Return a policy directory of a network."""
    description = PolicyDescription(
        task=task.name,
        observation=task.schema,
        action={**action_mode("wrench6", FINSROV).describe(), "size": size},
        control_period=task.control_step,
        vehicle=VehicleIdentity(name=FINSROV.name, sha256=FINSROV.sha256),
        hydrodynamics="calibrated",
        seed=0,
        training={"randomization": None},
    )
    return export_policy(network, folder, description)


def _light():
    """Return a network: surge is the mean of red, sway that of blue, as parts of 255; the row is ignored."""
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


def seeing(folder):
    """Return a policy directory for docking by camera: surge is the mean of red in the picture, sway that of
    blue."""
    task = task_named("camera-docking")
    about = {"device": "low_light_camera", "shape": list(SHAPE), "rate": 10.0, "latency": 0.1}
    description = PolicyDescription(
        task=task.name, observation=task.schema, pictures={"front_camera": about},
        action=action_mode("wrench6", FINSROV).describe(), control_period=task.control_step,
        vehicle=VehicleIdentity(name=FINSROV.name, sha256=FINSROV.sha256), hydrodynamics="calibrated", seed=0,
        training={"randomization": None},
    )  # fmt: skip
    return export_policy(_light(), folder, description)
