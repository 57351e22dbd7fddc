"""Experiments of tests are small: they stay in one process, since another takes seconds to start."""

import os

import pytest


@pytest.fixture(scope="session", autouse=True)
def one_processor():
    """What asks for as many processes as there are processors gets one; who names a number gets that."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "cpu_count", lambda: 1)
        yield
