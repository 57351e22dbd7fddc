"""An optimiser in each of several processes, in a module that these can import."""

import numpy as np

from finssim.learning.layers import Adam, Arrays, FreeRow, NetworkParameters

GRADIENTS = np.random.default_rng(1).normal(size=(3, 2, 5)).astype(np.float32)
"""Gradients of three steps, two processes and five parameters."""


def optimized(arrays, gradients):
    """Return the parameters after a step for each gradient."""
    row = FreeRow(GRADIENTS.shape[2])
    parameters = NetworkParameters(arrays, row)
    adam = Adam(parameters, arrays, 0.5)
    for gradient in gradients:
        parameters.gradient[:] = arrays.array(gradient)
        adam.step(adam.schedule(0.1, 1)[0])
    return arrays.numpy(row.values)


def optimize(group, folder):
    """Write the parameters of this process, which has its own gradients."""
    values = optimized(Arrays(1, group.device, group), GRADIENTS[:, group.rank])
    np.save(folder / f"begun-{group.rank}.npy", values)
    (folder / f"begun-{group.rank}.npy").rename(folder / f"{group.rank}.npy")
