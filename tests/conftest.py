"""What every test shares: one thread per process, reproducible examples, the errors of a whole run at a glance."""

import os
import signal

# Before any numeric library starts: OpenMP on busy cores slows torch tens of times.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from hypothesis import HealthCheck, settings

settings.register_profile(
    "finssim",
    deadline=None,  # a first call may compile a kernel
    derandomize=True,  # equal runs on every machine
    database=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("finssim")

# A run in the background inherits an ignored Ctrl-C, and so would the processes that tests interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)
