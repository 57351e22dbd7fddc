"""`finssim view` serves its page to this machine only and ends with Ctrl-C."""

import os
import re
import signal
import subprocess
import sys
import urllib.request

import pytest
import viser
import zstandard
from websockets.sync.client import connect


def start(*words, **environment):
    """Start the command in its own process and return it with the address that it prints."""
    run = subprocess.Popen(
        [sys.executable, "-m", "finssim", "view", *map(str, words), "--no-browser"],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, **environment},
    )
    for line in run.stdout:
        found = re.match(r"view: (http://127\.0\.0\.1:\d+) ", line)
        if found:
            return run, found[1]
    pytest.fail("no address was printed")


@pytest.mark.slow
def test_the_page_is_served_until_control_c(trial):
    """The printed address answers; Ctrl-C ends the command with status 0 and no further output."""
    run, url = start(trial.record, "--truth", trial.truth, "--port", "8240")
    with urllib.request.urlopen(url, timeout=60.0) as answer:
        assert answer.status == 200 and b"<html" in answer.read()
    run.send_signal(signal.SIGINT)
    out, _ = run.communicate(timeout=120.0)
    assert run.returncode == 0 and len(out.splitlines()) <= 1  # the title, if it had been read


@pytest.mark.slow
def test_the_vehicle_is_shown_before_kernels_are_compiled(tmp_path):
    """With an empty cache the page shows the vehicle, the pool and a notice before any kernel is compiled.

    Ctrl-C then ends the command before all kernels are compiled.
    """
    run, url = start("pool", "--port", "8242", WARP_CACHE_PATH=str(tmp_path))
    try:
        options = {"subprotocols": [f"viser-v{viser.__version__}"], "additional_headers": {"Origin": url}}
        missing = {b"/truth/hull", b"/pool/walls", b"/floor/0", "compiling kernels …".encode()}
        with connect(url.replace("http", "ws"), **options, proxy=None, max_size=None) as page:
            for _ in range(40):
                message = page.recv(timeout=60.0)
                size, packed = (int.from_bytes(message[i : i + 8], "little") for i in (0, 8))
                text = zstandard.decompress(message[16 : 16 + packed], max_output_size=size)
                missing -= {part for part in missing if part in text}
                if not missing:
                    break
        assert not missing and not list(tmp_path.rglob("*.o"))
        run.send_signal(signal.SIGINT)
        out, _ = run.communicate(timeout=60.0)
        assert run.returncode == 0 and out == "" and len(list(tmp_path.rglob("*.o"))) < 3
    finally:
        run.kill()


@pytest.mark.slow
def test_a_live_pool_ends_by_itself():
    """--duration ends a live pool; --port and --speed are accepted."""
    run, url = start("pool", "--goal", "0.2,0,-0.5,0", "--port", "8241", "--speed", "4", "--duration", "2")
    assert re.search(r":82\d\d$", url)
    out, _ = run.communicate(timeout=120.0)
    assert run.returncode == 0 and out.startswith("virtual pool, ")
