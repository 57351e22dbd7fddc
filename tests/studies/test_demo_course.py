"""A short demonstration of a vehicle with fins identifies, trains, dives, reports, and continues."""

import pytest
from rich.console import Console

from finssim.studies import demo_course
from finssim.studies.demo import DemoSettings, demo
from finssim.vehicles import load_vehicle

pytestmark = pytest.mark.slow


def test_the_loop_closes_and_an_interrupted_one_continues(tmp_path, monkeypatch, capsys):
    """It makes trials, vehicle, policy, dives and report; a second call repeats nothing and prints the same."""
    monkeypatch.setattr(demo_course, "FIT", ("zigzag_fast",))
    monkeypatch.setattr(demo_course, "AXES_FITTED", ("surge", "sway", "yaw"))
    monkeypatch.setattr(demo_course, "DIVES", 1)
    out = tmp_path / "demo"
    settings = DemoSettings(vehicle="remus100", steps=40_000)
    report = demo(out, settings=settings, console=Console(quiet=True))
    first = capsys.readouterr().out
    assert "fin.lift_slope" in first and "line-of-sight" in first and "by DVL, compass and USBL" in first
    identified = load_vehicle(out / "remus100_identified.yaml")
    slope = identified.actuators["rudder"].lift_slope
    true = load_vehicle(out / "remus100_in_water.yaml").actuators["rudder"].lift_slope
    assert abs(slope / true - 1.0) < 0.1
    page = report.read_text(encoding="utf-8")
    assert "finssim train path" in page and page.count("<img") == 1
    changed = {file: file.stat().st_mtime_ns for file in out.rglob("*.mcap")}
    assert len(changed) == 2
    demo(out, settings=settings, console=Console(quiet=True))
    assert capsys.readouterr().out == first
    assert changed == {file: file.stat().st_mtime_ns for file in out.rglob("*.mcap")}
