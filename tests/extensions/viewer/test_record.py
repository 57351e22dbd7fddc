"""Frames of a record equal the recorded messages, at any time and in any order."""

from types import SimpleNamespace

import numpy as np
import pytest

from finssim.evaluation.clocks import ClockError, clock_offset
from finssim.extensions.viewer.series import PoseSeries
from finssim.extensions.viewer.sources import RecordSource, _vision, known_covariance
from finssim.pool.virtual_pool import TruthError, read_truth
from finssim.robot.record_messages import UNKNOWN, RecordError
from finssim.robot.record_reader import open_record
from finssim.vehicles import VehicleError

GOAL = (0.7, 0.3, -0.6)


@pytest.fixture(scope="module")
def source(trial):
    return RecordSource(trial.record, truth=trial.truth, basin=(4.0, 2.0, 1.0))


def test_frames_are_the_recorded_messages(source, trial):
    """Estimate, goal and forces are those of the newest messages at the time, and time can run backwards."""
    with open_record(trial.record) as record:
        odom = [(e.time, e.message.pose.pose.position) for e in record.messages(["odom"])]
        states = [(e.time, e.message.force) for e in record.messages(["thruster_state"])]
    for time in (5.0, 2.0, 3.7):
        at = source.begin + time
        frame = source.frame(time)
        p = [p for t, p in odom if t <= at][-1]
        assert frame.estimate.position.tolist() == [p.x, p.y, p.z]
        assert frame.force.tolist() == [f for t, f in states if t <= at][-1].tolist()
        assert frame.goal.position == pytest.approx(GOAL)
        assert frame.status["bridge"] == "armed" and frame.status["shafts"].endswith(" rpm")


def test_pictures_come_with_the_tags_in_them(source):
    """Both tags are found in a recorded picture; between two pictures the earlier one is shown."""
    frame = source.frame(4.0)
    assert frame.picture.image.shape == (720, 1280)
    assert {tag.tag_id for tag in frame.picture.tags} == set(source.stage.vehicle.tags.mounts)
    assert source.frame(4.001).picture is frame.picture
    assert source.frame(5.0).picture is not frame.picture


def test_the_truth_lies_under_the_estimate(source, trial):
    """In lock-step both clocks agree: the truth of the file is shown at its own time, near the estimate."""
    truth, frame = read_truth(trial.truth), source.frame(5.0)
    true = truth.position[np.searchsorted(truth.time, source.begin + 5.0, side="right") - 1]
    assert frame.truth.position == pytest.approx(true)
    assert np.linalg.norm(frame.truth.position - frame.estimate.position) < 0.05
    labels = {(curve.plot, curve.label) for curve in source.curves()}
    assert ("position error [m]", "of the estimate") in labels and (
        "heading error [deg]",
        "to the goal",
    ) in labels


def test_the_covariance_is_that_of_the_estimator(source):
    """The greatest standard deviation is that of the panel; a position with an unknown axis has none."""
    frame = source.frame(5.0)
    std = 100.0 * np.sqrt(np.diag(frame.covariance)).max()
    assert frame.status["position std"] == f"{std:.1f} cm" and std > 0.0
    assert known_covariance(np.diag([0.1, 0.1, UNKNOWN])) is None


def test_events_of_the_whole_record_are_known_at_its_beginning(source):
    """Events are in order, with their times in the record; loss of vision is one, coasting between pictures
    is not."""
    times, texts = zip(*source.stage.events, strict=True)
    assert list(times) == sorted(times) and times[-1] <= source.duration + 0.1
    assert any(text.startswith("armed:") for text in texts) and texts[-1].startswith("disarmed:")
    modes = [SimpleNamespace(mode=mode) for mode in ("fresh", "coast", "fresh", "lost", "lost", "fresh")]
    assert _vision(range(6), modes) == [(3, "vision: lost"), (5, "vision: fresh")]


def test_clocks_are_laid_over_each_other_by_the_motion(trial, source):
    """A truth clock offset of 123.4 s is found to within the time in which the vehicle moves some
    millimetres."""
    truth = read_truth(trial.truth)
    found = clock_offset(source._odom.time, source._odom.position, truth.time - 123.4, truth.position)
    assert found == pytest.approx(123.4, abs=0.1)
    with pytest.raises(ClockError, match="less than half"):
        clock_offset(source._odom.time, source._odom.position, truth.time[:50], truth.position[:50])
    with pytest.raises(ClockError, match="expected at most 86400 s with the record: give times in s"):
        clock_offset(source._odom.time, source._odom.position, 1e5 * truth.time, truth.position)


def test_a_damaged_truth_is_refused(trial, tmp_path):
    """A table with ten bytes repeated, which misaligns all following rows, is refused."""
    damaged, data = tmp_path / "truth.fst", trial.truth.read_bytes()
    middle = len(data) // 2
    damaged.write_bytes(data[:middle] + data[middle - 10 :])
    with pytest.raises(TruthError, match="is damaged: its times do not increase"):
        read_truth(damaged)


def test_an_offset_that_is_given_is_used(trial):
    """--truth-offset moves the truth in time."""
    late = RecordSource(trial.record, truth=trial.truth, offset=1.0)
    right = RecordSource(trial.record, truth=trial.truth)
    assert late.frame(5.0).truth.position == pytest.approx(right.frame(4.0).truth.position, abs=1e-2)
    assert late.frame(5.0).truth.position != pytest.approx(right.frame(5.0).truth.position, abs=1e-2)


def test_the_box_is_the_pool_or_the_workspace(trial, source):
    """--basin draws walls; without it the vehicle's workspace is outlined."""
    plain = RecordSource(trial.record)
    assert source.stage.walls and source.stage.lower.tolist() == [-2.0, -1.0, -1.0]
    safety = plain.stage.vehicle.safety
    assert not plain.stage.walls and plain.stage.lower.tolist() == safety.workspace_lower.tolist()
    assert plain.frame(3.0).truth is None


def test_events_are_told_when_they_have_happened(source):
    """The start of the trial is not listed before its time."""
    assert not source.frame(0.0).events
    assert any("trial_start" in line for line in source.frame(5.0).events)


def test_a_trail_ends_where_the_body_is():
    """The trail covers the last half minute of the past."""
    time = np.arange(0.0, 100.0, 0.1)
    poses = PoseSeries(
        time, np.stack([time, 0 * time, 0 * time], axis=1), np.tile([0.0, 0.0, 0.0, 1.0], (1000, 1))
    )
    trail = poses.trail(60.0)
    assert 29.0 < trail[0, 0] < 31.0 and 59.0 < trail[-1, 0] < 60.0
    assert poses.at(-1.0) is None and len(poses.trail(-1.0)) == 0


def rewritten(source, target, files=None, **metadata):
    """Return a record as a third party could have written it: with other metadata and other files."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    with source.open("rb") as old, target.open("wb") as new:
        reader, writer = make_reader(old), Writer(new)
        writer.start()
        (found,) = [m for m in reader.iter_metadata() if m.name == "finssim"]
        writer.add_metadata("finssim", {**found.metadata, **metadata})
        for name, text in (files or {}).items():
            writer.add_attachment(0, 0, name, "text/plain", text.encode())
        channels = {}
        for schema, channel, message in reader.iter_messages(topics=["/finsrov/odom"]):
            if channel.id not in channels:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, kind)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    return target


@pytest.mark.parametrize("place", ["{}/mine", "../{}/mine", "..\\mine", "", "..", "mine\0"])
def test_the_name_of_a_vehicle_is_no_path(trial, tmp_path, monkeypatch, place):
    """A record whose file would be written outside is refused in one sentence, and the user's file stays
    unchanged."""
    theirs = tmp_path / "home" / "mine.yaml"
    theirs.parent.mkdir()
    theirs.write_text("precious: 1\n", encoding="utf-8")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    name = place.format(theirs.parent if place.startswith("{") else "home")
    bad = rewritten(trial.record, tmp_path / "bad.mcap", {f"{name}.yaml": "extends: finsrov\n"}, vehicle=name)
    with pytest.raises(RecordError, match="bad.mcap: vehicle '.*expected the plain name"):
        RecordSource(bad)
    assert theirs.read_text(encoding="utf-8") == "precious: 1\n"
    assert {path.name for path in tmp_path.rglob("*")} == {"home", "mine.yaml", "bad.mcap"}


def test_a_record_names_vehicles_of_the_catalogue_or_keeps_their_file(trial, tmp_path, monkeypatch):
    """The record's own file is used, not a file of the user with the same name."""
    (tmp_path / "other.yaml").write_text(
        "extends: finsrov\norigin: measured\nsource: test\nbody: {mass: 99.0}\n", encoding="utf-8"
    )
    monkeypatch.chdir(tmp_path)
    named = rewritten(trial.record, tmp_path / "a.mcap", vehicle="other.yaml")
    with pytest.raises(VehicleError, match="unknown vehicle 'other.yaml'"):
        RecordSource(named)
    kept = rewritten(
        trial.record,
        tmp_path / "b.mcap",
        {"other.yaml": "extends: finsrov\norigin: measured\nsource: test\nbody: {mass: 13.0}\n"},
        vehicle="other",
    )
    assert RecordSource(kept).stage.vehicle.body.mass == 13.0


@pytest.mark.parametrize(
    ("files", "sentence"),
    [
        ({"mine.yaml": "extends: ../x.yaml\n"}, "mine.yaml: extends '../x.yaml' has a separator"),
        (
            {"mine.yaml": "extends: finsrov\nhull: {file: /theirs}\n"},
            "mine.yaml: hull: file '/theirs' has",
        ),
        (
            {"mine.yaml": "extends: finsrov\n", "pool.yaml": "camera: {lens: /theirs}\n"},
            "pool.yaml: camera: lens '/theirs' has a separator",
        ),
    ],
)
def test_what_a_record_keeps_names_no_file_elsewhere(trial, tmp_path, files, sentence):
    bad = rewritten(trial.record, tmp_path / "bad.mcap", files, vehicle="mine")
    with pytest.raises(RecordError, match=sentence):
        RecordSource(bad)
