"""One function per node, for `ros2 run finssim_ros NODE`."""

from functools import partial
from importlib import import_module

from finssim.ros2.graphs import NODES


def __getattr__(node):
    """The function that runs a node."""
    if node not in NODES:
        raise AttributeError(f"finssim_ros has no node '{node}'; available: {', '.join(NODES)}")
    return partial(_run, NODES[node])


def _run(module):
    import_module(module).main()
