"""Data on disk after the recording process dies or the disk is full."""

import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

pytest.importorskip("mcap")
pytest.importorskip("rosbags")

from finssim.robot.record_reader import open_record

RECORD = """
import sys, time
import numpy as np
from finssim.robot.messages import Picture, Telemetry
from finssim.robot.recorder import Recorder
from finssim.vehicles import load_vehicle

vehicle = load_vehicle("finsrov")
picture = np.random.default_rng(0).integers(0, 255, (120, 160), np.uint8)
with Recorder(sys.argv[1], vehicle, {"seed": 1}) as recorder:
    start, i, after = time.monotonic(), 0, 0
    while after < 10 and i < 2000:
        after += bool(recorder.problem)
        now = time.monotonic() - start
        recorder.telemetry(now, Telemetry(i, 0, (0.0, 0.0, 0.0, 1.0), (0, 0, 0), (0, 0, 9.8), 0.0, 0.0, 0, None))
        if i % 3 == 0:
            recorder.picture(now, Picture(now, i, picture))
        print(now, flush=True)
        i += 1
        time.sleep(0.01)
print("problem", recorder.problem, recorder.dropped > 0)
"""


def recording(path, *, before=""):
    """Start a process that records a hundred telemetries a second and prints the time of each."""
    script = textwrap.dedent(before) + RECORD
    return subprocess.Popen([sys.executable, "-c", script, str(path)], stdout=subprocess.PIPE, text=True)


@pytest.mark.slow
def test_kill_9_loses_less_than_the_last_second(tmp_path):
    """After two seconds of recording the process is killed; everything but at most its last second can be
    read."""
    path = tmp_path / "run.mcap"
    with recording(path) as process:
        told = [0.0]
        while told[-1] < 2.0:
            told.append(float(process.stdout.readline()))
        process.send_signal(signal.SIGKILL)
        told += [float(line) for line in process.stdout.read().split("\n")[:-1]]
    with open_record(path) as record:
        times = [m.time for m in record.messages(["/finsrov/telemetry"])]
        assert record.cut and record.metadata["seed"] == "1"
    assert told[-1] - times[-1] < 1.0
    assert times == pytest.approx(told[1 : len(times) + 1], abs=1e-6), "and nothing before is missing"


@pytest.mark.slow
def test_a_full_disk_stops_the_record_and_not_the_loop(tmp_path):
    """At a limit on file size recording stops with a message; the file is readable and the loop continues."""
    path = tmp_path / "run.mcap"
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))\n"
    with recording(path, before=limit) as process:
        *times, last = process.stdout.read().splitlines()
    assert process.returncode == 0
    assert (
        last.startswith("problem ") and "recording stopped: File too large" in last and last.endswith("True")
    )
    with open_record(path) as record:
        kept = [m.time for m in record.messages(["/finsrov/telemetry"])]
    assert 10 < len(kept) < len(times)
    assert Path(path).stat().st_size <= 300_000


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_a_device_that_takes_nothing_is_refused_before_the_run(tmp_path):
    """A record at /dev/full would replace what exists."""
    from finssim.core.files import OutputError
    from finssim.robot.recorder import Recorder
    from finssim.vehicles import load_vehicle

    with pytest.raises(OutputError, match="exists"):
        Recorder("/dev/full", load_vehicle("finsrov"))
