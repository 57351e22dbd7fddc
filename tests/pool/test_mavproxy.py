"""A real MAVProxy process against `finssim pool --firmware ardusub`."""

import importlib.util
import os
import re
import signal
import subprocess
import sys
import threading
import time

import pytest

from finssim.pool.virtual_pool import read_truth

NEEDED = [name for name in ("MAVProxy", "pymavlink") if importlib.util.find_spec(name) is None]


class Program:
    """A process and its output so far."""

    def __init__(self, *words, **environment):
        self.process = subprocess.Popen(
            [sys.executable, *map(str, words)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**os.environ, "OMP_NUM_THREADS": "1", **environment},
        )
        self.output = ""
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()

    def _read(self):
        while data := os.read(self.process.stdout.fileno(), 4096):
            self.output += data.decode(errors="replace")

    def until(self, pattern, seconds=60.0):
        """Return the match of a pattern in its output."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if match := re.search(pattern, self.output):
                return match
            time.sleep(0.05)
        raise AssertionError(f"no {pattern!r} in:\n{self.output}")

    def type(self, line, pattern=None):
        """Type a line, and wait for a pattern in the output that follows."""
        self.output = ""
        self.process.stdin.write(f"{line}\n".encode())
        self.process.stdin.flush()
        return self.until(pattern) if pattern else None

    def __enter__(self):
        return self

    def __exit__(self, *problem):
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            try:
                self.process.wait(20.0)
            except subprocess.TimeoutExpired:
                self.process.kill()
        self.process.wait()
        self.process.stdin.close()
        self.reader.join(5.0)
        self.process.stdout.close()


@pytest.mark.slow
@pytest.mark.skipif(bool(NEEDED), reason=f"not installed: {', '.join(NEEDED)} (make installs them)")
def test_mavproxy_connects_arms_drives_and_disarms(tmp_path):
    """It fetches all parameters, changes mode, arms, drives ahead by its rc module, and disarms; the truth
    file confirms it."""
    truth = tmp_path / "truth.fst"
    pool = ["--firmware", "ardusub", "--vehicle", "bluerov2_heavy", "--severity", "nominal", "--port", 0]
    pool += ["--tcp", "127.0.0.1:0", "--dvl", "127.0.0.1:0", "--ground", "none", "--truth", truth]
    with Program("-m", "finssim", "pool", *pool) as site:
        port = site.until(r"127\.0\.0\.1:(\d+) \(TCP\)")[1]
        words = f"--master tcp:127.0.0.1:{port} --state-basedir {tmp_path} --default-modules".split()
        words += "mode,arm,rc,param".split()
        with Program("-m", "MAVProxy.mavproxy", *words, HOME=str(tmp_path)) as station:
            received = station.until(r"Received (\d+) parameters")
            assert int(received[1]) > 90
            station.type("param show JS_GAIN_DEFAULT", r"JS_GAIN_DEFAULT\s+0\.5")
            station.type("mode stabilize", "Mode STABILIZE")
            station.type("rc all 1500")
            station.type("arm throttle", "Arming motors")
            station.type("rc 5 1600")
            time.sleep(3.0)
            station.type("rc 5 1500")
            station.type("disarm", "Disarming motors")
            station.type("mode manual", "Mode MANUAL")
    ahead = read_truth(truth).position[:, 0]
    assert ahead[-1] - ahead[0] > 0.3 and read_truth(truth).thrust[-1].tolist() == [0.0] * 8
