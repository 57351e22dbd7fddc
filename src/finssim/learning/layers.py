"""Networks with hand-written gradients, for NumPy and torch: linear layers with tanh, a GRU, and Adam.

Every function is written once with the common subset of the two libraries (`@`, `tanh`, `where`, `out=`), so that the
same code trains with NumPy on a CPU, without torch, and with torch on a GPU, without copies to the host. Rows are
samples.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from finssim.learning.parallel import Group

Array = Any
"""A NumPy array or a torch tensor, float32."""


@contextmanager
def single_thread() -> Iterator[None]:
    """Limit matrix products to one thread: a second gains little on such small networks, and loses much on a busy
    machine."""
    from threadpoolctl import threadpool_limits

    if torch := sys.modules.get("torch"):
        torch.set_num_threads(1)
    with threadpool_limits(limits=1):
        yield


class Arrays:
    """A library of arrays and their device: NumPy, or torch on one of its devices.

    Attributes:
        xp: The library.
    """

    def __init__(self, seed: int, torch_device: str | None = None, group: Group | None = None) -> None:
        """Use torch on a device such as `cuda`, or NumPy if that is None.

        Args:
            seed: Seed of all random numbers.
            torch_device: Device of torch.
            group: Processes that share a training, with torch; None: this process alone.
        """
        self.xp: ModuleType = np
        self.device, self.group = torch_device, group
        self.processes = 1 if group is None else group.size
        self._rng: Any = np.random.Generator(np.random.SFC64(seed))
        """Stream of initial weights and sample orders; with NumPy also of noise."""
        self._pool: Any = None
        """Memory pool of all recordings."""
        if torch_device is not None:
            import torch

            self.xp = torch
            self._noise = torch.Generator(device=torch_device)
            self._noise.manual_seed(seed if group is None else group.seed(seed))

    def view(self, array: Any) -> Array:
        """Return a view of a Warp array."""
        if self.device is None:
            return array.numpy()
        import warp as wp

        return wp.to_torch(array, requires_grad=False)

    def empty(self, *shape: int) -> Array:
        """Return an uninitialised array."""
        return (
            np.empty(shape, np.float32) if self.device is None else self.xp.empty(shape, device=self.device)
        )

    def zeros(self, *shape: int) -> Array:
        """Return an array of zeros."""
        return (
            np.zeros(shape, np.float32) if self.device is None else self.xp.zeros(shape, device=self.device)
        )

    def array(self, values: Any) -> Array:
        """Return a copy of numbers from NumPy."""
        if self.device is None:
            return np.array(values, np.float32)
        return self.xp.tensor(np.asarray(values, np.float32), device=self.device)

    def bools(self, values: Any) -> Array:
        """Return a copy of boolean values from NumPy."""
        return np.array(values, bool) if self.device is None else self.xp.tensor(values, device=self.device)

    def plain(self) -> Any:
        """Return a context without gradient recording of torch and without warnings of NumPy: the caller checks the
        results."""
        return np.errstate(all="ignore") if self.device is None else self.xp.no_grad()

    def numpy(self, array: Array) -> Any:
        """Return a copy as a NumPy array."""
        return np.array(array) if self.device is None else array.detach().cpu().numpy().copy()

    def copy(self, array: Array) -> Array:
        """Return a copy."""
        return array.copy() if self.device is None else array.clone()

    def average(self, array: Array) -> Array:
        """Replace an array by its mean over the processes of a training, and return it."""
        if self.group is not None:
            self.group.average(array)
        return array

    def noise(self, out: Array) -> Array:
        """Fill an array with standard normal numbers, and return it."""
        if self.device is None:
            return self._rng.standard_normal(out=out, dtype=np.float32)
        return out.normal_(generator=self._noise)

    def order(self, n: int) -> Array:
        """Return the integers below n in random order, as indices."""
        if self.device is None:
            return self._rng.permutation(n)
        return self.xp.randperm(n, generator=self._noise, device=self.device)

    def orthogonal(self, rows: int, columns: int, gain: float) -> Any:
        """Return an orthogonal matrix (Saxe et al. 2014), as NumPy. `gain` is a factor."""
        q, r = np.linalg.qr(self._rng.standard_normal((max(rows, columns), min(rows, columns))))
        q *= np.sign(np.diag(r))
        return (gain * (q if rows >= columns else q.T)).astype(np.float32)

    def recorded(self, function: Callable[..., None]) -> Callable[..., None]:
        """Return an equivalent function; on a GPU it replays a recording, see `CudaGraph`.

        Args:
            function: Function of arrays that writes its results into arrays at fixed addresses.
        """
        if self.device is None or self.group is not None or not self.device.startswith("cuda"):
            return function
        self._pool = self._pool or self.xp.cuda.graph_pool_handle()
        return CudaGraph(function, self._pool)

    def state(self) -> dict[str, Any]:
        """Return the states of the random streams, for `load`."""
        saved: dict[str, Any] = {"numpy": self._rng.bit_generator.state}
        if self.device is not None:
            saved["torch"] = self._noise.get_state().cpu().numpy()
        return saved

    def load(self, state: dict[str, Any]) -> None:
        """Restore the states that `state` returned."""
        self._rng.bit_generator.state = state["numpy"]
        if self.device is not None:
            self._noise.set_state(self.xp.from_numpy(np.asarray(state["torch"])))


class CudaGraph:
    """A function of torch tensors, replayed on a GPU as one CUDA graph for each shape of its arguments.

    Launching the kernels of a small network one by one takes longer than their execution. A graph replays the same
    kernels at the same addresses with the same scalars: everything that changes between calls must be in the arguments,
    or in tensors that are written in place. The function must not wait for the host. The first calls run without a
    recording, so that torch's libraries can allocate their memory.
    """

    FIRST_CALLS = 2

    def __init__(self, function: Callable[..., None], pool: Any) -> None:
        """Store the function, which writes its results in place, and torch's handle of memory for graphs.

        Recordings share this memory: none needs its content after a call.
        """
        self._function, self._pool = function, pool
        self._calls: dict[Any, int] = {}
        self._graphs: dict[Any, tuple[Any, list[Array]]] = {}

    def __call__(self, *arguments: Array) -> None:
        """Call the function, or replay its recording with the values of these arguments."""
        import torch

        shapes = tuple(argument.shape for argument in arguments)
        calls = self._calls[shapes] = self._calls.get(shapes, 0) + 1
        if calls <= self.FIRST_CALLS:
            stream, current = torch.cuda.Stream(), torch.cuda.current_stream()
            stream.wait_stream(current)
            with torch.cuda.stream(stream):
                self._function(*arguments)
            current.wait_stream(stream)
            return
        if shapes not in self._graphs:
            own = [argument.clone() for argument in arguments]
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph, pool=self._pool):
                self._function(*own)
            self._graphs[shapes] = graph, own
        graph, own = self._graphs[shapes]
        for target, argument in zip(own, arguments, strict=True):
            target.copy_(argument)
        graph.replay()


class NetworkParameters:
    """All parameters of some networks in one row, and their gradient in another, for an optimiser."""

    def __init__(self, arrays: Arrays, *networks: Any) -> None:
        """Allocate the memory of the networks: `shapes()` of each gives the shapes, `bind` assigns the arrays."""
        sizes = [[math.prod(shape) for shape in network.shapes()] for network in networks]
        total = sum(map(sum, sizes))
        self.values, self.gradient = arrays.zeros(total), arrays.zeros(total)
        first = 0
        for network in networks:
            views: list[list[Array]] = [[], []]
            for shape in network.shapes():
                size = math.prod(shape)
                for row, arrays_of_network in zip((self.values, self.gradient), views, strict=True):
                    arrays_of_network.append(row[first : first + size].reshape(shape))
                first += size
            network.bind(*views)


class FreeRow:
    """Parameters that do not depend on any input."""

    def __init__(self, size: int) -> None:
        """Set the number of parameters."""
        self.size = size

    def shapes(self) -> list[tuple[int, ...]]:
        """Return the shape of the parameters."""
        return [(self.size,)]

    def bind(self, weights: list[Array], gradients: list[Array]) -> None:
        """Set the memory of the parameters and of their gradient."""
        self.values, self.gradient = weights[0], gradients[0]


class TanhLayers:
    """Linear layers with tanh between them: tanh(... tanh(x W_1 + b_1) ...) W_n + b_n."""

    def __init__(self, arrays: Arrays, sizes: Sequence[int]) -> None:
        """Set the numbers of inputs, hidden units and outputs, in order."""
        self.arrays, self.sizes = arrays, tuple(sizes)
        self.weights: list[Array] = []
        """W and b of each layer, one after the other."""
        self._room: dict[tuple[int, ...], Array] = {}

    def shapes(self) -> list[tuple[int, ...]]:
        """Return the shapes of W, (inputs, outputs), and b, (outputs,), of each layer."""
        return [shape for a, b in zip(self.sizes, self.sizes[1:], strict=False) for shape in ((a, b), (b,))]

    def bind(self, weights: list[Array], gradients: list[Array]) -> None:
        """Set the memory of the weights and of their gradients."""
        self.weights, self._gradients = weights, gradients

    def initialize(self, last_gain: float) -> None:
        """Initialise orthogonal weights of gain √2, `last_gain` in the last layer, and zero biases."""
        last = len(self.sizes) - 2
        for i in range(last + 1):
            gain = last_gain if i == last else math.sqrt(2.0)
            self.weights[2 * i][:] = self.arrays.array(
                self.arrays.orthogonal(self.sizes[i], self.sizes[i + 1], gain)
            )
            self.weights[2 * i + 1][:] = 0.0

    def __call__(self, x: Array) -> Array:
        """Return the outputs, (N, outputs), for inputs (N, inputs); the next call with as many rows overwrites
        them."""
        self._inputs = [x]
        last = len(self.sizes) - 2
        for i in range(last + 1):
            y = self._memory("y", i, len(x))
            self.arrays.xp.matmul(x, self.weights[2 * i], out=y)
            y += self.weights[2 * i + 1]
            if i < last:
                self.arrays.xp.tanh(y, out=y)
                self._inputs.append(y)
            x = y
        return x

    def backward(self, dy: Array, inputs: bool = False) -> Array | None:
        """Write the gradient of the weights, from that of the last outputs; return that of the inputs if requested."""
        xp = self.arrays.xp
        for i in reversed(range(len(self.sizes) - 1)):
            x = self._inputs[i]
            xp.matmul(x.T, dy, out=self._gradients[2 * i])
            self._gradients[2 * i + 1][:] = dy.sum(0)
            if i == 0 and not inputs:
                return None
            dx = self._memory("d", i, len(x))
            xp.matmul(dy, self.weights[2 * i].T, out=dx)
            if i > 0:
                slope = self._memory("s", i, len(x))
                xp.multiply(x, x, out=slope)
                xp.subtract(self._layer, slope, out=slope)
                dx *= slope
            dy = dx
        return dy

    @property
    def _layer(self) -> Array:
        if "one" not in self.__dict__:
            self.__dict__["one"] = self.arrays.array(1.0)
        return self.__dict__["one"]

    def _memory(self, kind: str, layer: int, rows: int) -> Array:
        """Return the memory of a layer's numbers, always the same: allocating a new array costs more than the
        computation."""
        size = self.sizes[layer + 1] if kind == "y" else self.sizes[layer]
        key = (kind, layer, rows)
        if key not in self._room:
            self._room[key] = self.arrays.empty(rows, size)
        return self._room[key]


class Gru:
    """A gated recurrent unit (Cho et al. 2014) with the equations of torch and ONNX, over a time series.

    r = σ(x W_xr + b_xr + h W_hr + b_hr), z likewise, n = tanh(x W_xn + b_xn + r (h W_hn + b_hn)), h' = (1 - z) n + z h
    """

    def __init__(self, arrays: Arrays, inputs: int, units: int) -> None:
        """Set the number of inputs, and of units, whose outputs are also the memory."""
        self.arrays, self.inputs, self.units = arrays, inputs, units
        self.weights: list[Array] = []
        """W_x (inputs, 3 units), b_x, W_h (units, 3 units), b_h, with r, z and n concatenated."""

    def shapes(self) -> list[tuple[int, ...]]:
        """Return the shapes of the weights."""
        k = 3 * self.units
        return [(self.inputs, k), (k,), (self.units, k), (k,)]

    def bind(self, weights: list[Array], gradients: list[Array]) -> None:
        """Set the memory of the weights and of their gradients."""
        self.weights, self._gradients = weights, gradients

    def initialize(self) -> None:
        """Initialise orthogonal weights gate by gate, and zero biases."""
        for weight, rows in ((self.weights[0], self.inputs), (self.weights[2], self.units)):
            gates = [self.arrays.orthogonal(rows, self.units, 1.0) for _ in range(3)]
            weight[:] = self.arrays.array(np.concatenate(gates, axis=1))

    def __call__(self, x: Array, h: Array, keep: Array) -> Array:
        """Return the outputs of a time series.

        Args:
            x: Inputs, (time, rows, inputs).
            h: Memory before the series, (rows, units).
            keep: 0 where an episode starts with these inputs, otherwise 1, (time, rows).

        Returns:
            (time, rows, units).
        """
        xp, k = self.arrays.xp, self.units
        W_x, b_x, W_h, b_h = self.weights
        from_x = (x.reshape(-1, self.inputs) @ W_x + b_x).reshape(*x.shape[:2], 3 * k)
        out = self.arrays.empty(*x.shape[:2], k)
        self._x, self._keep, self._steps = x, keep, []
        for t in range(len(x)):
            h = h * keep[t][:, None]
            from_h = h @ W_h + b_h
            gates = 1.0 / (1.0 + xp.exp(-(from_x[t, :, : 2 * k] + from_h[:, : 2 * k])))
            r, z = gates[:, :k], gates[:, k:]
            n = xp.tanh(from_x[t, :, 2 * k :] + r * from_h[:, 2 * k :])
            self._steps.append((h, r, z, n, from_h[:, 2 * k :]))
            h = n + z * (h - n)
            out[t] = h
        return out

    def backward(self, dy: Array) -> None:
        """Write the gradient of the weights by backpropagation through time from that of the outputs, (time, rows,
        units)."""
        k, W_h = self.units, self.weights[2]
        d_x = self.arrays.empty(*dy.shape[:2], 3 * k)
        d_h = self.arrays.empty(*dy.shape[:2], 3 * k)
        carried = self.arrays.zeros(*dy.shape[1:])
        for t in reversed(range(len(dy))):
            h, r, z, n, from_h = self._steps[t]
            dh = dy[t] + carried
            dn = dh * (1.0 - z) * (1.0 - n * n)
            d_x[t, :, :k] = dn * from_h * r * (1.0 - r)
            d_x[t, :, k : 2 * k] = dh * (h - n) * z * (1.0 - z)
            d_x[t, :, 2 * k :] = dn
            d_h[t, :, : 2 * k] = d_x[t, :, : 2 * k]
            d_h[t, :, 2 * k :] = dn * r
            carried = (dh * z + d_h[t] @ W_h.T) * self._keep[t][:, None]
        from_x, from_h = d_x.reshape(-1, 3 * k), d_h.reshape(-1, 3 * k)
        before = self.arrays.empty(*dy.shape)
        for t, step in enumerate(self._steps):
            before[t] = step[0]
        for i, (inputs, d) in enumerate(((self._x, from_x), (before, from_h))):
            self._gradients[2 * i][:] = inputs.reshape(len(d), -1).T @ d
            self._gradients[2 * i + 1][:] = d.sum(0)


class Adam:
    """Adam (Kingma and Ba 2015), with gradients clipped to the norm `largest`."""

    B1, B2, EPSILON = 0.9, 0.999, 1e-5

    def __init__(self, parameters: NetworkParameters, arrays: Arrays, largest: float) -> None:
        """Set the parameters to optimise."""
        self.parameters, self.arrays, self.xp, self.largest = parameters, arrays, arrays.xp, largest
        n = len(parameters.values)
        self.mean, self.square = arrays.zeros(n), arrays.zeros(n)
        self.count = 0

    def schedule(self, rate: float, steps: int) -> Array:
        """Count future steps of a learning rate [-]; return the coefficients of each for `step`, (steps, 2)."""
        counts = self.count + 1.0 + np.arange(steps)
        self.count += steps
        return self.arrays.array(np.stack([rate / (1.0 - self.B1**counts), 1.0 - self.B2**counts], axis=1))

    def step(self, scheduled: Array) -> None:
        """Make one gradient step, with a row of `schedule`, (2,)."""
        g = self.arrays.average(self.parameters.gradient)
        norm = self.xp.sqrt((g * g).sum())
        g *= self.largest / self.xp.clip(norm, self.largest, None)
        self.mean += (1.0 - self.B1) * (g - self.mean)
        self.square += (1.0 - self.B2) * (g * g - self.square)
        root = self.xp.sqrt(self.square / scheduled[1])
        self.parameters.values -= scheduled[0] * self.mean / (root + self.EPSILON)
