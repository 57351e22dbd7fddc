"""Warp's own output, and the messages that replace it."""

import json
import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow

SCRIPT = """
import json
from finssim.core.quiet import start_warp
start_warp()
import numpy as np
from finssim.control.allocation import Allocator
from finssim.vehicles import load_vehicle
thrusts = Allocator.from_vehicle(load_vehicle("finsrov")).allocate(np.ones(6))
print(json.dumps(thrusts.tolist()))
"""


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two runs of the same script, with a kernel cache that is empty at first."""
    cache = tmp_path_factory.mktemp("kernels")
    environment = {**os.environ, "WARP_CACHE_PATH": str(cache)}
    command = [sys.executable, "-c", SCRIPT]
    return [
        subprocess.run(command, env=environment, capture_output=True, text=True, check=True) for _ in range(2)
    ]


def test_what_is_compiled_is_told_once_and_on_standard_error(runs):
    """The message names the module of the kernels; with compiled kernels there is none."""
    announced, *compiled = runs[0].stderr.splitlines()
    assert "once on this machine" in announced
    assert [line.split(" in ")[0] for line in compiled] == ["compiled the kernels of control.allocation"]
    assert runs[1].stderr == ""


def test_standard_output_holds_what_the_program_prints_alone(runs):
    """JSON can be read from it, and is the same whether kernels were compiled or not."""
    first, second = (json.loads(run.stdout) for run in runs)
    assert len(first) == 8 and first == second
