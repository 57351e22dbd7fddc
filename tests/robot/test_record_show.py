"""`finssim record` and `finssim play` print figures and messages of a record."""

import json

import numpy as np
import pytest

from finssim.cli import boundary
from finssim.cli.commands import app

pytest.importorskip("mcap")
pytest.importorskip("rosbags")

from finssim.robot.messages import Picture, Telemetry
from finssim.robot.recorder import Recorder
from finssim.vehicles import load_vehicle

LEVEL = (0.0, 0.0, 0.0, 1.0)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Two seconds at 50 Hz from 100 s on, with half a second of silence, a fault and a picture."""
    path = tmp_path_factory.mktemp("record") / "run.mcap"
    with Recorder(path, load_vehicle("finsrov"), {"seed": 7}) as recorder:
        for i in range(101):
            t = 100.0 + 0.02 * i
            if not 40 <= i < 65:
                recorder.telemetry(
                    t, Telemetry(i, 0, LEVEL, LEVEL[:3], LEVEL[:3], 0.5, float("nan"), 0, None)
                )
        recorder.event(101.0, "fault", "tilted")
        recorder.picture(101.5, Picture(101.5, 1, np.zeros((8, 8), np.uint8)))
    return path


def finssim(capsys, *words):
    """Return the standard output of a command that succeeds."""
    assert boundary.run(app, [str(word) for word in words]) == 0
    return capsys.readouterr().out


def test_info_tells_rates_gaps_events_and_the_vehicle(run, capsys):
    told = json.loads(finssim(capsys, "record", "info", run, "--json"))
    assert told["duration_s"] == pytest.approx(2.0) and told["metadata"]["vehicle"] == "finsrov"
    topic = told["topics"]["/finsrov/telemetry"]
    assert (topic["messages"], topic["gaps"], topic["longest_gap_s"]) == (76, 1, 0.52)
    assert topic["rate_hz"] == pytest.approx(37.5)
    assert told["events"] == [{"time": 101.0, "kind": "fault", "text": "tilted"}]
    assert not told["cut"] and told["files"] == ["finsrov.yaml"]


def test_info_is_readable(run, capsys):
    text = finssim(capsys, "record", "info", run)
    assert "2.00 s" in text and "vehicle finsrov" in text and "seed: 7" in text
    assert " 1.000 s  fault: tilted" in text and "/finsrov/telemetry" in text


def test_repair_writes_beside_the_cut_record(run, tmp_path, capsys):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(run.read_bytes()[:-2000])
    assert "cut off" in finssim(capsys, "record", "repair", cut)
    assert not json.loads(finssim(capsys, "record", "info", tmp_path / "cut-repaired.mcap", "--json"))["cut"]
    assert "nothing is damaged" in finssim(capsys, "record", "repair", run, "--out", tmp_path / "other.mcap")
    assert (tmp_path / "other.mcap").is_file()


def test_play_prints_the_messages_of_the_topics_asked_for(run, capsys):
    lines = finssim(capsys, "play", run, "--topics", "events,camera/image/compressed").splitlines()
    assert len(lines) == 2 and "tilted" in lines[0] and "bytes" in lines[1]


def test_play_starts_where_it_is_told_and_writes_json(run, capsys):
    text = finssim(capsys, "play", run, "--topics", "telemetry", "--start", 1.9)
    lines = [json.loads(line) for line in text.splitlines()]
    assert [line["time"] for line in lines] == pytest.approx([101.9, 101.92, 101.94, 101.96, 101.98, 102.0])
    assert lines[0]["message"]["depth"] == 0.5 and lines[0]["message"]["pressure"] is None
