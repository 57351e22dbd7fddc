"""Slices on threads: an interrupt leaves no unfinished work, and a forked process starts its own threads."""

from __future__ import annotations

import os
import signal
import threading
import time

import numpy as np
import pytest

from finssim.sim import Simulator, SimulatorError


def simulator(threads: int) -> Simulator:
    """Return a simulator of two slices or one under random thrust."""
    made = Simulator("finsrov", worlds=4096, threads=threads)
    made.set_thrust(np.random.default_rng(3).uniform(-5.0, 5.0, (4096, 1, 8)))
    return made


def test_a_step_is_over_when_it_returns_even_after_an_interrupt() -> None:
    """After SIGINTs in the middle of steps, every step moves all slices by exactly one step."""
    threaded, alone = simulator(2), simulator(1)
    for delay in (1e-4, 3e-4, 6e-4, 1e-3, 2e-3):
        with pytest.raises(KeyboardInterrupt):
            threading.Timer(delay, os.kill, (os.getpid(), signal.SIGINT)).start()
            lost = time.monotonic() + 5.0
            while True:
                threaded.step()
                if time.monotonic() > lost:  # Python drops an interrupt that occurs in a destructor
                    os.kill(os.getpid(), signal.SIGINT)
    for made in (threaded, alone):
        made.place(position=(0.0, 0.0, -5.0))
        for _ in range(20):
            made.step()
            assert (made.numpy("steps") == made.numpy("steps")[0]).all()
    np.testing.assert_array_equal(threaded.numpy("velocity"), alone.numpy("velocity"))


def test_the_environment_limits_the_threads_of_who_names_none(monkeypatch) -> None:
    """Each thread has one slice; a number in the call overrides the environment, and invalid values are
    refused."""

    def slices(**options: int) -> int:
        return len(Simulator("finsrov", worlds=4096, **options).pipeline().slices)

    for given, expected in (("1", 1), ("3", 3)):
        monkeypatch.setenv("FINSSIM_THREADS", given)
        assert slices() == expected and slices(threads=2) == 2
    for given in ("0", "-1", "many"):
        monkeypatch.setenv("FINSSIM_THREADS", given)
        with pytest.raises(SimulatorError, match=f"FINSSIM_THREADS is '{given}', expected an integer"):
            slices()


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_forked_process_steps_on_threads_of_its_own() -> None:
    """Threads do not survive a fork: the child must not wait for the parent's."""
    made = simulator(2)
    made.step()
    child = os.fork()
    if child == 0:
        signal.alarm(30)  # a child that waits forever is ended by the system
        made.step()
        os._exit(0)
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == 0
