"""One function per node, for `ros2 run finssim_ros NODE`."""

from functools import partial

from finssim.ros2.up import NODES, run_node


def __getattr__(node):
    """The function that runs a node."""
    if node not in NODES:
        raise AttributeError(f"finssim_ros has no node '{node}'; available: {', '.join(NODES)}")
    return partial(run_node, node)
