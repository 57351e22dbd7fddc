"""`python -m studies.faults` and its table."""

import json
import re
from pathlib import Path

import pytest

from reference.programs import study
from studies.faults import AUTOPILOT, row_ok, tables_of

ROOT = Path(__file__).resolve().parents[2]

GOOD = {
    "ok": True, "thrust_gone_s": 0.4, "frames_off_s": 0.1, "margin_m": 0.2, "state": "fault", "reason": "silence",
    "raised": "", "record_lost_s": 0.2, "record_problem": "",
}  # fmt: skip


def trial(row, **changes):
    return {**GOOD, "job": {"row": row, "target": "up moving", "plant": 1}, **changes}


def told(*trials):
    result = {"severity": "realistic", "seeds": [1], "vehicle": {"name": "finsrov", "sha256": "0" * 64}}
    (shown,) = tables_of({**result, "trials": list(trials)})
    return shown.rows, shown


@pytest.mark.slow
def test_the_command_plays_a_scenario_and_goes_on_where_it_was(capsys, tmp_path):
    """The control fails as intended: status 0, a result and a table; a second call does not play it again."""
    words = ["--scenarios", "control", "--processes", "1", "--out", tmp_path]
    assert study("faults", *words, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    (only,) = result["trials"]
    assert result["ok"] and not only["ok"] and only["margin_m"] < 0.0
    written = next((tmp_path / "trials").glob("*.json")).stat().st_mtime_ns
    assert study("faults", *words) == 0
    assert "control" in capsys.readouterr().out
    assert next((tmp_path / "trials").glob("*.json")).stat().st_mtime_ns == written
    assert "fails, as it must" in (tmp_path / "faults.html").read_text()


def test_an_unknown_scenario_is_refused(capsys, tmp_path):
    """The refusal lists the known scenarios."""
    assert study("faults", "--scenarios", "flood", "--out", tmp_path) == 2
    assert "unknown scenario 'flood'; available: kill-robot" in capsys.readouterr().err


def test_a_row_shows_the_worst_of_its_trials():
    """It has the longest times, the least margin, and every outcome."""
    rows, shown = told(
        trial("link-cut"),
        trial("link-cut", thrust_gone_s=0.9, margin_m=0.1, reason="noise"),
        trial("link-cut", thrust_gone_s=None, state="armed", reason="", record_lost_s=0.5),
    )
    (row,) = rows
    assert row[1:5] == ["3", "0.90, 1 drive on", "0.10", "0.10"] and row[6:] == ["0.50", "passed"]
    assert "1 × fault: noise" in row[5] and "1 × armed" in row[5]
    assert "passed: 3 of 3" in shown.headline and not shown.sentences


def test_what_failed_is_told():
    """A failure appears in its row, in the count, and in a sentence with its numbers."""
    rows, shown = told(trial("mcu-reboot", ok=False, thrust_gone_s=None, margin_m=-0.3), trial("mcu-reboot"))
    assert rows[0][-1] == "FAILED 1" and "passed: 1 of 2" in shown.headline
    (sentence,) = shown.sentences
    assert "thrust never ended, inside by -0.30 m" in sentence


def test_a_control_that_passes_is_wrong():
    """A passing control would mean that the table cannot detect failures."""
    assert row_ok("control", [trial("control", ok=False)]) and not row_ok("control", [trial("control")])
    assert not row_ok("link-cut", [trial("link-cut", ok=False)]) and not row_ok("link-cut", [])
    rows, _ = told(trial("control"))
    assert rows[0][-1] == "PASSED, which a control must not"


def test_the_page_on_ardusub_has_the_figures_of_the_result():
    """Every scenario in the result passed, and the times in the page's table are the longest of its trials."""
    result = json.loads((ROOT / "results" / "bluerov2_faults.json").read_text())
    assert result["ok"] and {t["job"]["row"] for t in result["trials"]} == set(AUTOPILOT)
    page = (ROOT / "docs" / "bluerov2.md").read_text()
    rows = {
        "manual input": "ap-joystick", "mode changed": "ap-mode", "disarmed": "ap-disarm", "leak": "ap-leak",
        "an origin": "ap-origin", "its north": "ap-north", "its DVL": "ap-own-dvl", "battery low": "ap-battery",
        "no telemetry": "ap-silence", "our frames": "ap-deaf", "only the autopilot's": "ap-heartbeat",
        "autopilot restarted": "ap-reboot", "DVL lost": "ap-dvl", "depth frozen": "ap-depth",
    }  # fmt: skip
    for begin, name in rows.items():
        (cell,) = re.findall(rf"^\| {begin}.* \| ([^|]*) \|$", page, re.MULTILINE)
        trials = [t for t in result["trials"] if t["job"]["row"] == name]
        keys = (
            ["frames_off_s"]
            if "person" in cell
            else ["thrust_gone_s", "frames_off_s"][: 1 + ("axes" in cell)]
        )
        found = [max(t[key] for t in trials) for key in keys]
        assert [float(x) for x in re.findall(r"[0-9]+\.[0-9]+", cell)] == pytest.approx(found, abs=0.0051), (
            begin
        )
    assert f"{len(result['trials'])} of {len(result['trials'])} trials ended so" in page
