"""Everything is loaded before a robot moves: a process that first imports or compiles misses its deadlines."""

import json
import subprocess
import sys

import pytest

LOOP = """
import json, sys
from warp._src.context import user_modules

from finssim.control.guidance import Station
from finssim.pool.plan import make_plan
from finssim.robot.goals import station_of
from finssim.robot.lockstep import run_lockstep
from finssim.robot.perception import Perception
from finssim.robot.pilots import make_pilot
from finssim.robot.recorder import recording
from finssim.robot.runtime import Runtime
from finssim.vehicles import load_vehicle

states = []

def in_memory():
    kernels = {module.name for module in user_modules.values() if module.execs}
    return set(sys.modules) | kernels

vehicle = load_vehicle("finsrov")
plan = make_plan("finsrov", "1", "nominal", camera="corners")
world = plan.world(plan.eye(), start=station_of("0,0,-0.5,0"), seed=1, truth=None)
world.exchange(1 / 60, [])  # the pool's own kernels
with recording(sys.argv[2], vehicle, {}, lockstep=True) as recorder:
    pilot = make_pilot(sys.argv[1], vehicle)
    perception, goal = Perception(vehicle, plan.calibrated), Station((0.2, 0, -0.5), 0.0)
    runtime = Runtime(vehicle, perception, pilot, goal, arm=True, recorder=recorder)
    before = in_memory()
    run_lockstep(runtime, world, 2.0, start=1 / 60, show=lambda runtime: states.append(runtime.bridge.state))
print(json.dumps(["armed" in states, runtime.counters.decisions, sorted(in_memory() - before)]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("controller", ["pid", "lqr"])
def test_nothing_is_imported_or_compiled_once_the_loop_has_begun(controller, tmp_path):
    """This holds for filter, controller and record, up to and after the first armed decision."""
    words = [sys.executable, "-c", LOOP, controller, str(tmp_path / "run.mcap")]
    answer = subprocess.run(words, stdout=subprocess.PIPE, text=True, check=True, timeout=300).stdout
    armed, decisions, added = json.loads(answer.splitlines()[-1])
    assert armed and decisions > 10
    assert added == []
