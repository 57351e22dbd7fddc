"""`finssim view` serves its page to this machine and ends with Ctrl-C."""

import re
import signal
import subprocess
import sys
import urllib.request

import pytest


def start(*words):
    """The command in a process of its own, and the address that it prints."""
    run = subprocess.Popen(
        [sys.executable, "-m", "finssim", "view", *map(str, words), "--no-browser"],
        stdout=subprocess.PIPE,
        text=True,
    )
    for line in run.stdout:
        found = re.match(r"view: (http://127\.0\.0\.1:\d+) ", line)
        if found:
            return run, found[1]
    pytest.fail("no address was printed")


@pytest.mark.slow
def test_the_page_is_served_until_control_c(trial):
    """The printed address answers; Ctrl-C ends with 0 and says nothing more."""
    run, url = start(trial.record, "--truth", trial.truth, "--port", "8240")
    with urllib.request.urlopen(url, timeout=60.0) as answer:
        assert answer.status == 200 and b"<html" in answer.read()
    run.send_signal(signal.SIGINT)
    out, _ = run.communicate(timeout=120.0)
    assert run.returncode == 0 and out == ""


@pytest.mark.slow
def test_a_live_pool_ends_by_itself():
    """--duration ends it, and --port and --speed are taken."""
    run, url = start("pool", "--goal", "0.2,0,-0.5,0", "--port", "8241", "--speed", "4", "--duration", "2")
    assert re.search(r":82\d\d$", url)
    out, _ = run.communicate(timeout=120.0)
    assert run.returncode == 0 and out == ""
