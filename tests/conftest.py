"""What every test shares: one thread per process, reproducible examples, the errors of a whole run at a glance."""

import os

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
