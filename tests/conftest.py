"""Shared test configuration: threads, order of files, processor time by test, and the guard of `make quick`."""

import os
import signal

# Before any numeric library starts: OpenMP on busy cores slows torch tens of times.
os.environ.setdefault("OMP_NUM_THREADS", "1")
if "PYTEST_XDIST_WORKER" in os.environ:
    # As many processes as processors: further threads would wait for each other.
    os.environ.setdefault("FINSSIM_THREADS", "1")

import gc
import importlib.util
import multiprocessing.process
import sys
import time
from collections import Counter, defaultdict
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile(
    "finssim",
    deadline=None,  # a first call may compile a kernel
    derandomize=True,  # the same examples on every machine
    database=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("finssim")

# A background process inherits an ignored Ctrl-C, and so would the processes that tests interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)


# ---- processor time by test: `--durations N` shows wall-clock time, which varies with the machine's other load


def processor_time() -> float:
    """Return the processor time of this process and of its ended children so far [s]."""
    children = os.times()
    return time.process_time() + children.children_user + children.children_system


_before = 0.0


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport():
    """Add the processor time since the previous report [s] to each report, also to those of other workers."""
    global _before
    report = yield
    now = processor_time()
    report.processor_time, _before = now - _before, now
    return report


def pytest_terminal_summary(terminalreporter, config):
    """Print the N tests that took the most processor time (`--durations N`), and the sum of all tests."""
    if not config.option.durations:
        return
    spent = defaultdict(float)
    for reports in terminalreporter.stats.values():
        for report in reports:
            spent[getattr(report, "nodeid", "")] += getattr(report, "processor_time", 0.0)
    terminalreporter.section(
        f"processor time, {sum(spent.values()) / 60.0:.1f} minutes beside importing the tests"
    )
    for name, seconds in sorted(spent.items(), key=lambda item: -item[1])[: config.option.durations]:
        terminalreporter.write_line(f"{seconds:7.2f}s {name}")


# ---- order: each process gets whole files, and the last ones should be short


def pytest_collection_modifyitems(items):
    """Put files with many slow tests first: xdist, which orders by number of tests, would run trainings last."""
    slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: -slow[item.path])


# ---- garbage: one collection of all that the tests import takes a second, and every robot in real time begins with
# one: objects that exist before the first test of a file are excluded from later collections

_file = None


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Import the tests without garbage collection, which otherwise takes a quarter of the time."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()


# ---- real time: the processes of a test share a clock that is slowed to the speed of the machine


SPIN = 0.7e-3
"""Processor time of one call of `_turn` on the machine on which the tests were written [s]."""


def _turn() -> None:
    sum(range(50_000))


def measured_rate() -> float:
    """Return the rate at which a session's clock can run now: the speed available to this process, at most 1."""
    began, turns = time.monotonic(), 0
    while time.monotonic() - began < 0.3:
        _turn()
        turns += 1
    return min(max(turns * SPIN / (time.monotonic() - began), 0.1), 1.0)


@pytest.fixture
def slow_clock(monkeypatch) -> float:
    """Slow the clock of processes that a test starts to a rate that this machine sustains, and return the rate."""
    rate = measured_rate()
    monkeypatch.setenv("FINSSIM_CLOCK_RATE", f"{rate:.3f}")
    return rate


# ---- the core without its extensions (`make core`): tests that ask the registry for an extension are skipped

ALONE = importlib.util.find_spec("finssim.extensions") is None


@contextmanager
def extensions_missing():
    """Skip a test in which the registry refuses a task, command or world of an extension that is missing."""
    try:
        yield
    except Exception as error:
        said = str(error)
        if ALONE and "cannot be used" in said and "No module named 'finssim.extensions'" in said:
            pytest.skip("needs an extension")
        raise


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup():
    """See `extensions_missing`."""
    with extensions_missing():
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call():
    """See `extensions_missing`."""
    with extensions_missing():
        return (yield)


# ---- `make quick`: no test starts a process

LOOK_UPS = {"fc-list", "git", "gcc", "ld", "ldconfig", "uname"}
"""Programs that Python, matplotlib (for fonts, without its cache) and FinsSim call to inspect the machine or
checkout."""

_guarded = False


def _refuse(program: str) -> None:
    if _guarded and Path(program).name not in LOOK_UPS:
        pytest.fail(f"this test starts a process ({program}): mark it with pytest.mark.slow")


def _audit(event: str, arguments: tuple) -> None:
    if event in ("subprocess.Popen", "os.posix_spawn"):
        _refuse(os.fsdecode(arguments[0] or arguments[1][0]))
    elif event in ("os.fork", "os.forkpty", "os.system"):
        _refuse(event)


def pytest_collection_finish():
    """Exclude the processor time of importing the tests from that of the first test."""
    global _before
    _before = processor_time()


def pytest_sessionstart(session):
    """Install the guard: with -m "not slow", a test that starts a process fails."""
    if session.config.option.markexpr == "not slow":
        with suppress(ImportError):
            import glfw  # noqa: F401  # which MuJoCo imports; it asks a Python process for its library's version
        sys.addaudithook(_audit)
        start = multiprocessing.process.BaseProcess.start

        def guarded_start(process):
            _refuse(f"multiprocessing, {process.name}")
            start(process)

        multiprocessing.process.BaseProcess.start = guarded_start


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    """Enable the guard only while a test runs, and exclude older objects from its garbage collections."""
    global _file, _guarded
    if item.path != _file:
        _file = item.path
        gc.collect()
        gc.freeze()
    _guarded = True
    try:
        return (yield)
    finally:
        _guarded = False
