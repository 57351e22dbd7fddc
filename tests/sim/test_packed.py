"""Views of packed structs share memory and keep it alive."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import warp as wp

from finssim.sim.packed import Packed
from finssim.sim.state import VehicleState


def as_numpy(view: wp.array) -> Any:
    """Return NumPy's view of the same memory."""
    return view.numpy()


def as_torch(view: wp.array) -> Any:
    """Return Torch's view of the same memory."""
    return wp.to_torch(view, requires_grad=False)


@pytest.mark.slow
@pytest.mark.parametrize("look", [as_numpy, as_torch, lambda view: view], ids=["numpy", "torch", "warp"])
def test_a_view_keeps_the_memory_it_looks_at(look: Callable[[wp.array], Any]) -> None:
    """A reference to a field keeps the structs alive; without references they are freed."""
    packed = Packed(VehicleState, (10, 1), wp.get_device("cpu"))
    memory = weakref.ref(packed.array)
    view = look(packed.position)
    del packed
    gc.collect(1)  # ignore older objects
    assert memory() is not None
    del view
    gc.collect(1)
    assert memory() is None


def test_a_field_is_the_struct() -> None:
    """A value written to a field is in the struct, and vice versa."""
    packed = Packed(VehicleState, (3, 2), wp.get_device("cpu"))
    packed.position.numpy()[1, 1] = [1.0, 2.0, 3.0]
    table = packed.array.numpy()
    np.testing.assert_array_equal(table["position"][1, 1], [1.0, 2.0, 3.0])
    table["velocity"][2, 0, 4] = 5.0
    assert packed.velocity.numpy()[2, 0, 4] == 5.0
