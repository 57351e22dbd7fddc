"""Tables of results on a terminal: every unit, every digit, in 80 columns."""

import io

import pytest
from rich.console import Console

from finssim.evaluation.evaluate import (
    T1_COLUMNS,
    T2_COLUMNS,
    tables_of,
)
from finssim.evaluation.metrics import MEASURES
from finssim.evaluation.tables import print_tables

T1_FIGURES = {
    "e_p_m": 0.0188,
    "e_y_m": 0.0139,
    "e_psi_deg": 44.08,
    "t_s_s": 36.9,
    "J_p_m": 0.017,
    "J_psi_deg": 12.49,
}
T2_FIGURES = dict.fromkeys(MEASURES) | {
    "horizontal_rmse_m": 0.0681,
    "vertical_rmse_m": 0.1293,
    "p95_m": 0.4052,
    "cross_track_rmse_m": 0.0312,
    "completion": 1.0,
    "max_tilt_deg": 12.3,
    "complete": True,
}


def result(figures, task="t1", **trial):
    whose = {
        "task": task,
        "controller": {
            "kind": "policy",
            "name": "policy",
            "hydrodynamics": "calibrated",
            "randomization": "pool",
        },
        "vehicle": {"name": "finsrov_identified"},
        "hydrodynamics": "calibrated",
        "plant": {"name": "nominal", "title": "as described"},
    }
    counts = {"trials": 8, "valid": 8, "success": 8}
    one = {"success": True, "valid": True, **trial, **figures}
    return {**whose, **counts, **figures, "per_trial": [one]}


def printed(tables):
    out = io.StringIO()
    print_tables(tables, Console(file=out, width=80))
    return out.getvalue()


@pytest.mark.parametrize("plants", [1, 2])
def test_station_keeping_shows_every_unit_and_digit(plants):
    """Every unit and digit is shown, although Rich would interpret `[m]` as a style and omit it."""
    text = printed(tables_of({"plants": [result(T1_FIGURES, setpoint="P01")] * plants}))
    units = [heading.split(" [")[1] for heading, _ in T1_COLUMNS.values() if " [" in heading]
    assert [text.count(f"[{unit}") >= units.count(unit) for unit in units] == [True] * len(units)
    assert "…" not in text and all(
        figure in text for figure in ("0.0188", "0.0139", "44.08", "36.9", "12.49")
    )


def test_tracking_shows_every_unit_and_digit():
    """The table of T2 shows every unit and digit."""
    text = printed(tables_of(result(T2_FIGURES, "t2", trajectory="lemniscate")))
    assert all(word in text for heading, _ in T2_COLUMNS.values() for word in heading.split())
    assert "…" not in text and all(
        figure in text for figure in ("0.0681", "0.1293", "0.4052", "100%", "12.3")
    )
