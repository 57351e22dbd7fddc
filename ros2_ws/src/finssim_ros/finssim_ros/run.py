"""One function per node, for `ros2 run finssim_ros NODE`."""

import sys
from functools import partial

from finssim.cli.boundary import run
from finssim.cli.commands import app
from finssim.extensions.ros2.up import NODES


def __getattr__(node):
    """Return the function that runs a node with the arguments of the process."""
    if node not in NODES:
        raise AttributeError(f"finssim_ros has no node '{node}'; available: {', '.join(NODES)}")
    return partial(_run, node)


def _run(node):
    return run(app, ["ros2", "node", node, *sys.argv[1:]])
