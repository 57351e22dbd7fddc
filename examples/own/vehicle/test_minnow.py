"""The vehicle file is read, and every check passes."""

from pathlib import Path

from finssim.vehicles import check_vehicle, load_vehicle

FILE = Path(__file__).with_name("minnow.yaml")


def test_every_check_passes():
    """`finssim vehicles show` marks each check with pass."""
    failed = [check for check in check_vehicle(load_vehicle(FILE)) if not check.passed]
    assert not failed
