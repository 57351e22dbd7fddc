"""Per-vehicle structs in one Warp array, with a view of each field as a separate array.

The physics kernel reads one struct per vehicle: one address instead of forty. All other code sees plain arrays by
(world, vehicle), which share that memory.
"""

from typing import Any

import numpy as np
import warp as wp


class Packed:
    """An array of structs by (world, vehicle), whose fields are also attributes: `plant.mass` is a Warp array."""

    def __init__(self, struct: Any, shape: tuple[int, int], device: wp.Device) -> None:
        """Allocate zeroed structs of one Warp struct type."""
        self.array: wp.array = wp.zeros(shape, dtype=struct, device=device)
        """The structs themselves, for kernels."""
        layout = np.dtype(struct.numpy_dtype()).fields or {}
        self.fields: dict[str, wp.array] = {
            name: wp.array(
                ptr=self.array.ptr + layout[name][1],
                dtype=dtype,
                shape=shape,
                strides=self.array.strides,
                device=device,
            )
            for name, dtype in struct.cls.__annotations__.items()
        }
        """Every field as an array that shares the structs' memory."""
        for view in self.fields.values():
            # As in Warp's own views: a view keeps the memory alive, also under NumPy and torch.
            view._ref = self.array

    def __getattr__(self, name: str) -> wp.array:
        try:
            return self.__dict__["fields"][name]
        except KeyError:
            raise AttributeError(name) from None
