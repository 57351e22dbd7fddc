"""Policy directories of networks that tests make."""

from finssim.control.modes import action_mode
from finssim.control.policy import PolicyDescription, VehicleIdentity
from finssim.learning.export import export_policy
from finssim.vehicles import load_vehicle

FINSROV = load_vehicle("finsrov")


def linear(gain):
    """A network without bias: action = gain · observation."""
    import torch
    from torch import nn

    layer = nn.Linear(gain.shape[1], gain.shape[0], bias=False)
    layer.weight.data = torch.from_numpy(gain)
    return nn.Sequential(layer)


def written(network, folder, task, size):
    """A policy directory of a network."""
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
