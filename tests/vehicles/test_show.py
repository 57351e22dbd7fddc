"""Every vehicle can be printed and drawn."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from finssim.vehicles import CalibrationRecord, Provenance, catalogue, load_vehicle
from finssim.vehicles.show import draw_vehicle, print_catalogue, print_vehicle
from vehicles.minnow import MINNOW


def console() -> Console:
    return Console(file=io.StringIO(), width=160)


def printed(screen: Console) -> str:
    return screen.file.getvalue()  # type: ignore[attr-defined]


def test_the_catalogue_names_every_vehicle():
    screen = console()
    print_catalogue(screen)
    for name in catalogue():
        assert name in printed(screen)


@pytest.mark.slow
@pytest.mark.parametrize("name", catalogue())
def test_a_vehicle_prints_its_thrusters_digest_and_sources(name):
    vehicle, screen = load_vehicle(name), console()
    print_vehicle(vehicle, screen)
    text = printed(screen)
    for expected in (
        vehicle.sha256,
        *vehicle.thruster_names,
        "guessed",
        "wrench + [N, N m]",
        "speed [m/s, rad/s]",
    ):
        assert expected in text
    assert "fail" not in text


def test_guesses_are_marked_beside_the_number():
    screen = console()
    print_vehicle(load_vehicle("finsrov"), screen)
    row = next(line for line in printed(screen).splitlines() if line.startswith("M_A"))
    assert row.split() == ["M_A", "15.0347", "28.5059", "23.3544", "0.1", "?", "0.1", "?", "0.590397"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["finsrov", "remus100", "rexrov"])
def test_a_picture_of_the_layout_is_saved(name, tmp_path):
    draw_vehicle(load_vehicle(name), tmp_path / "layout.png")
    assert (tmp_path / "layout.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_a_file_of_ones_own_is_printed_like_the_catalogue(tmp_path):
    path = tmp_path / "minnow.yaml"
    path.write_text(MINNOW, encoding="utf-8")
    screen = console()
    print_vehicle(load_vehicle(path), screen)
    draw_vehicle(load_vehicle(path), tmp_path / "minnow.svg")
    assert "front_left" in printed(screen)
    assert (tmp_path / "minnow.svg").stat().st_size > 1000


def test_a_list_of_mixed_origin_and_a_calibration_are_shown():
    """With one entry measured and the rest unchanged, the list has the mark of its least known entry; fits
    are named."""
    record = CalibrationRecord(kind="hydrodynamics", method="simulation", trials={"a": "1" * 64})
    vehicle = load_vehicle("finsrov")
    vehicle = vehicle.replace({"body.center_of_buoyancy.2": 0.02}, Provenance("guessed"))
    origins = {f"body.center_of_buoyancy.{i}": Provenance("measured") for i in (0, 1)}
    kept = {key: p for key, p in vehicle.provenance.items() if key != "body.center_of_buoyancy"}
    vehicle = vehicle.model_copy(update={"provenance": kept | origins, "calibrations": (record,)})
    screen = console()
    print_vehicle(vehicle, screen)
    assert "0 0 0.02 ?" in printed(screen)
    assert "calibrated: hydrodynamics by simulation on 1 trial" in printed(screen)
