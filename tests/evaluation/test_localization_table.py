"""The table beside the paper's, as printed in the width of a terminal and on a page."""

import io

import pytest
from rich.console import Console

from finssim.evaluation.tables import markdown_of, print_tables
from finssim.studies.localization import (
    CONDITIONS,
    METHOD_TITLES,
    PAPER_TABLE_2,
    tables_of,
)


def figures(rmse, located=10):
    """Return figures of one method."""
    return {
        "rmse_cm": rmse,
        "rmse_ci95_cm": [rmse - 0.125, rmse + 0.125],
        "p95_cm": 2.0 * rmse,
        "p95_ci95_cm": [2.0 * rmse - 0.25, 2.0 * rmse + 0.25],
        "located": located,
        "pictures": 12,
    }


NOTHING = {
    "rmse_cm": None,
    "rmse_ci95_cm": [None, None],
    "p95_cm": None,
    "p95_ci95_cm": [None, None],
    "located": 0,
    "pictures": 12,
}


@pytest.fixture
def result():
    """Made-up figures, different for each method."""
    methods = {method: figures(1.0 + k) for k, method in enumerate(METHOD_TITLES)}
    return {
        "seeds": [1, 2],
        "seeds_asked_for": 2,
        "places": 170,
        "pictures_per_seed": 720,
        "renderer": "own",
        "results": dict.fromkeys((*CONDITIONS, "lifted"), methods),
        "paper": {m: {"rmse_cm": r, "p95_cm": p} for m, (r, p) in PAPER_TABLE_2.items()},
        "calibration": [
            {
                "seed": 1,
                "camera_height_mm": 1.234,
                "water_height_mm": -5.678,
                "camera_over_water_mm": 6.912,
                "tilt_deg": 0.0456,
                "index": 0.0012,
            }
        ],
        "provenance": {"finssim": "0.1", "revision": "abc"},
    }


def printed(result, width=100):
    """Return the output in a terminal of a given width."""
    text = io.StringIO()
    print_tables(tables_of(result), Console(file=text, width=width))
    return text.getvalue()


def test_every_figure_of_every_method_is_shown(result):
    """Each figure appears under its conditions, with its interval and number of located pictures, and on the page."""
    text, page = printed(result), markdown_of(tables_of(result))
    for k in range(len(METHOD_TITLES)):
        for cell in (f"{1 + k:.2f}", f"[{0.875 + k:.2f}, {1.125 + k:.2f}]", f"{2 + 2 * k:.2f}"):
            assert text.count(cell) >= 4 and page.count(cell) >= 4
    assert "10/12" in text and "10/12" in page
    for name in (*CONDITIONS, "lifted"):
        assert f"ours, {name} conditions" in text and f"Ours, {name} conditions" in page


def test_the_paper_stands_beside_ours_as_another_experiment(result):
    """The table contains the paper's figures and the remark that the two experiments differ."""
    for text in (printed(result), markdown_of(tables_of(result))):
        words = " ".join(text.split())
        for rmse, p95 in PAPER_TABLE_2.values():
            assert f"{rmse:.2f}" in words and f"{p95:.2f}" in words
        assert "different experiments" in words
        assert "2 seeds, each 720 pictures at 170 places, renderer own" in words


def test_the_gain_is_against_what_it_names(result):
    """The gain is 1 minus the ratio to the rival's figure, in percent, for both rivals."""
    words = " ".join(printed(result).split())
    for rival in ("pinhole", "pinhole, refractive pose"):
        other = result["results"]["published"][rival]["rmse_cm"]
        assert f"RMSE {100.0 * (1.0 - 1.0 / other):.1f} %, P95 {100.0 * (1.0 - 1.0 / other):.1f} %" in words


def test_the_table_fits_a_terminal(result):
    """In 80 columns, no figure is cut."""
    lines = printed(result, width=80).splitlines()
    assert max(map(len, lines)) <= 80
    assert any("[0.88, 1.12]" in line or "[0.88, 1.13]" in line for line in lines)


def test_where_nothing_was_located_the_table_says_so(result):
    """A text replaces the figure, and no gain over it is claimed."""
    result["results"]["published"] = {**result["results"]["published"], "pinhole": NOTHING}
    for text in (printed(result), markdown_of(tables_of(result))):
        assert "–" in text and "0/12" in text
        assert "calibrated on the same half" not in " ".join(text.split())


def test_errors_of_the_calibrations_are_on_the_page(result):
    """Each seed has a row, with units and the origin of the numbers."""
    page = markdown_of(tables_of(result))
    assert "| 1 | 1.23 | -5.68 | 6.91 | 0.046 | +0.0012 |" in page
    assert "camera height [mm]" in page and "FinsSim 0.1, revision abc, seeds [1, 2]" in page
