"""`tools/report.py`: tables in pages, refused requests, and the pages of this repository."""

import json
import shutil
from pathlib import Path

import pytest

from tools.report import ReportError, filled, report

ROOT = Path(__file__).parents[1]
RESULTS = sorted((ROOT / "results").glob("*.json"))
PAGES = [
    ROOT / "README.md",
    *(ROOT / f"docs/{name}.md" for name in ("bluerov2", "evidence", "learning", "reference/ardusub_sitl")),
]


def figures(value):
    return {
        key: {"value": value, "ci95": [value, value], "count": 8} for key in ("success", "e_p_m", "t_s_s")
    }


ANATOMY = {
    "experiment": "anatomy",
    "vehicle": {"name": "finsrov", "sha256": "0" * 64},
    "seeds": [1],
    "rows": {"a": "Row A", "b": "Row B"},
    "causes": {
        "lag": {
            "title": "slower by",
            "unit": "s",
            "amounts": [0.0, 0.1],
            "rows": {"a": [figures(1.0), figures(0.5)], "b": [figures(1.0), figures(1.0)]},
        }
    },
    "foreign": {"a": figures(0.5), "b": figures(1.0)},
}


def test_the_pages_that_ship_say_what_the_results_do():
    """Every figure in the tables of shipped pages comes from `results/`."""
    assert RESULTS and report(RESULTS, into=PAGES, check=True) == 0
    assert all("<!-- report: " in page.read_text(encoding="utf-8") for page in PAGES)


def test_a_block_is_filled_and_the_rest_stays(tmp_path):
    """A block gets the whole table, or the rows and columns that the page names; a second run changes nothing."""
    page, result = tmp_path / "page.md", tmp_path / "anatomy.json"
    result.write_text(json.dumps(ANATOMY))
    page.write_text(
        "before\n<!-- report: anatomy -->\nold\n<!-- end -->\nbetween\n"
        "<!-- report: anatomy table=2 columns=0,1 rows=Row B;Row A -->\n<!-- end -->\nafter\n"
    )
    assert report([result], into=[page], check=True) == 1 and "old" in page.read_text()
    assert report([result], into=[page]) == 0
    assert page.read_text() == (
        "before\n<!-- report: anatomy -->\n| wrong | a | b |\n| --- | --: | --: |\n"
        "| slower by [s] | 0 | 0.1+ |\n<!-- end -->\nbetween\n"
        "<!-- report: anatomy table=2 columns=0,1 rows=Row B;Row A -->\n|  | held |\n| --- | --: |\n"
        "| Row B | 1.000 |\n| Row A | 0.500 |\n<!-- end -->\nafter\n"
    )
    assert report([result], into=[page], check=True) == 0


def test_a_result_in_sentences_is_a_list():
    """A soak result, which has no table, is printed as a list."""
    soaked = {
        "experiment": "soak",
        "vehicle_h": 20.0,
        "wall_s": 7200.0,
        "times_real_time": 10.0,
        "verdict": "flat",
        "slope_mib_per_h": 0.01,
        "first_mib": 340.0,
        "last_mib": 341.0,
        "error_rms_m": 0.02,
        "faults": [],
        "missed_decisions": 0,
        "decisions": 1440000,
    }
    page = filled("<!-- report: soak -->\n<!-- end -->", {"soak": soaked}, "page")
    assert page.splitlines()[1:4] == [
        "- 20.00 h of vehicle time in 120.0 min, 10.0 times real time",
        "- memory: flat, +0.01 MiB per hour of vehicle time; 340.0 MiB at the start, 341.0 at the end",
        "- off the station: rms 2.0 cm; faults: none; decisions missed: 0 of 1440000",
    ]


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("t1", "no result 't1.json' was given"),
        ("anatomy table=3", "table 3: the result has 2"),
        ("anatomy rows=Row C", "no row 'Row C'; there are: slower by"),
        ("anatomy columns=0,7", "no column 7: the table has 0 to 2"),
    ],
)
def test_what_there_is_not_is_refused(what, message):
    """The refusal names the page and its request."""
    with pytest.raises(ReportError, match=f"^page: <!-- report: {what} -->: {message}"):
        filled(f"<!-- report: {what} -->\n<!-- end -->", {"anatomy": ANATOMY}, "page")


def test_a_file_that_is_no_result_is_refused(tmp_path):
    """The refusal says what the file is instead."""
    page = shutil.copy(ROOT / "README.md", tmp_path / "page.md")
    for text, message in (
        ("no", "not the result of"),
        ("[]", "not the result of"),
        ('{"experiment": "stack"}', "'stack', expected one of"),
    ):
        (tmp_path / "x.json").write_text(text)
        with pytest.raises(ReportError, match=message):
            report([tmp_path / "x.json"], into=[Path(page)])
