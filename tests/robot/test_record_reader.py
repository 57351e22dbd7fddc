"""Finished, cut and damaged records are read, and repaired into files that every reader accepts."""

import numpy as np
import pytest

pytest.importorskip("mcap")
pytest.importorskip("rosbags")
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.highlevel import AnyReader

from finssim.robot.messages import Telemetry
from finssim.robot.record_messages import RecordError, types
from finssim.robot.record_reader import info, open_record, play_record, repair_record
from finssim.robot.recorder import Recorder
from finssim.vehicles import load_vehicle

VEHICLE = load_vehicle("finsrov")
LEVEL = (0.0, 0.0, 0.0, 1.0)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Four seconds of telemetry on a clock that begins in 2023, in at least eight chunks."""
    path = tmp_path_factory.mktemp("record") / "run.mcap"
    with Recorder(path, VEHICLE, {"seed": 5}, epoch=1.7e9) as recorder:
        for i in range(400):
            rpm = tuple(np.random.default_rng(i).normal(0.0, 100.0, 8))
            recorder.telemetry(
                10.0 + 0.01 * i, Telemetry(i, 10 * i, LEVEL, LEVEL[:3], LEVEL[:3], 0.01 * i, 0.0, 0, rpm)
            )
    return path


def depths(path):
    with open_record(path) as record:
        return [entry.message.depth for entry in record.messages(["telemetry"])]


def test_times_are_of_the_robots_clock(run):
    """The epoch is subtracted again; `start` skips earlier messages."""
    with open_record(run) as record:
        times = [entry.time for entry in record.messages(["telemetry"])]
        later = [entry.time for entry in record.messages(["/finsrov/telemetry"], start=13.0)]
        assert not record.cut and record.topics["/finsrov/telemetry"] == "finssim_msgs/msg/HardwareTelemetry"
        assert record.files["finsrov.yaml"] == VEHICLE.path.read_text(encoding="utf-8")
    assert times == pytest.approx(10.0 + 0.01 * np.arange(400), abs=1e-6)
    assert len(later) == 100


def test_an_unknown_topic_is_refused_with_those_there_are(run):
    with open_record(run) as record, pytest.raises(RecordError, match="no topic 'odom'; it has .*/imu"):
        list(record.messages(["odom"]))


@pytest.mark.parametrize("part", [0.2, 0.35, 0.6, 0.95, 0.999])
def test_a_cut_anywhere_leaves_what_is_before_it(run, tmp_path, part):
    """A file cut to a part of its length yields its first messages, unchanged."""
    cut = tmp_path / "cut.mcap"
    whole = run.read_bytes()
    cut.write_bytes(whole[: int(part * len(whole))])
    found, all_of_it = depths(cut), depths(run)
    assert found == all_of_it[: len(found)]
    assert len(found) >= (part - 0.3) * len(all_of_it)
    with open_record(cut) as record:
        assert record.cut and record.metadata["seed"] == "5"


def test_a_repaired_record_is_whole(run, tmp_path):
    """It has a summary, opens in rosbags, and contains metadata and files; the cut record is unchanged."""
    cut, mended = tmp_path / "cut.mcap", tmp_path / "mended.mcap"
    cut.write_bytes(run.read_bytes()[:-3000])
    before = cut.read_bytes()
    (note,) = repair_record(cut, mended)
    assert "cut off" in note and cut.read_bytes() == before
    with open_record(mended) as record:
        assert not record.cut and record.metadata["seed"] == "5" and "finsrov.yaml" in record.files
    assert depths(mended) == depths(cut)
    with AnyReader([mended]) as reader:
        assert reader.message_count == sum(1 for _ in reader.messages())
    assert repair_record(mended, tmp_path / "again.mcap") == []


def chunks(path):
    """Return start and length of each chunk."""
    with path.open("rb") as file:
        found = make_reader(file).get_summary().chunk_indexes
    return [(chunk.chunk_start_offset, chunk.chunk_length) for chunk in found]


@pytest.mark.parametrize("number", [0, 4])
@pytest.mark.parametrize("at", ["data", "length", "kind"])
def test_a_flipped_bit_costs_its_chunk_alone(run, tmp_path, number, at):
    """The messages of all other chunks are read, and a sentence states what is missing."""
    damaged, mended = tmp_path / "damaged.mcap", tmp_path / "mended.mcap"
    data, places = bytearray(run.read_bytes()), chunks(run)
    begin, length = places[number]
    data[begin + {"data": length // 2, "length": 4, "kind": 0}[at]] ^= 0x10
    damaged.write_bytes(data)
    (note,) = repair_record(damaged, mended)
    assert "damaged" in note and "in 1 place cannot be read and are left out" in note
    read, written = depths(mended), depths(run)
    assert depths(damaged) == read == [depth for depth in written if depth in read]
    assert len(written) - len(read) == pytest.approx(len(written) / len(places), rel=0.6)
    with open_record(mended) as record:
        assert not record.cut and "finsrov.yaml" in record.files


def test_a_broken_index_costs_nothing(run, tmp_path):
    damaged, data = tmp_path / "damaged.mcap", bytearray(run.read_bytes())
    data[-100] ^= 0x10
    damaged.write_bytes(data)
    assert depths(damaged) == depths(run)
    assert repair_record(damaged, tmp_path / "mended.mcap") == [
        "damaged.mcap is damaged: its index cannot be read"
    ]


def test_a_record_without_its_header_is_read(run, tmp_path):
    """If the first record is not a header, the repaired copy still has one and an index."""
    damaged, data = tmp_path / "damaged.mcap", bytearray(run.read_bytes())
    data[8] ^= 0x40  # the kind of the header
    data[-100] ^= 0x10
    damaged.write_bytes(data)
    assert depths(damaged) == depths(run)


def test_a_file_that_ends_between_two_records_is_cut(run, tmp_path):
    """Such a file is intact except for its missing end."""
    cut, data, at = tmp_path / "cut.mcap", run.read_bytes(), 8
    while at < run.stat().st_size // 2:
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    cut.write_bytes(data[:at])
    assert repair_record(cut, tmp_path / "copy.mcap") == ["cut.mcap is cut off and was read up to the cut"]
    assert depths(tmp_path / "copy.mcap") == depths(cut) != []


@pytest.mark.parametrize("repeated", [True, False])
def test_a_channel_without_a_schema_and_a_summary_without_schemas_are_read(tmp_path, capsys, repeated):
    """JSON without a schema next to a topic of a known type, with schemas only in the data, as another
    program writes."""
    path, text = tmp_path / "other.mcap", "builtin_interfaces/msg/Time"
    with path.open("wb") as file:
        writer = Writer(file, repeat_schemas=repeated)
        writer.start()
        clock = writer.register_schema(text, "ros2msg", b"int32 sec\nuint32 nanosec\n")
        typed = writer.register_channel("/time", "cdr", clock)
        untyped = writer.register_channel("/words", "json", 0)
        for i in range(3):
            writer.add_message(typed, i, types().serialize_cdr(types().types[text](i, 0), text), i)
            writer.add_message(untyped, i, b'{"a": 1}', i)
        writer.finish()
    info(path)
    shown = capsys.readouterr().out
    assert "6 messages" in shown and text in shown and "no type" in shown
    play_record(path)
    shown = capsys.readouterr()
    assert (
        len(shown.out.splitlines()) == 3
        and "/words has no type in the file (schema 0) and is left out" in shown.err
    )
    with pytest.raises(RecordError, match="/words has no type in the file"):
        play_record(path, topics=["words"])
    assert repair_record(path, tmp_path / "mended.mcap") == []
    info(tmp_path / "mended.mcap")
    assert "6 messages" in capsys.readouterr().out


def test_a_record_is_not_repaired_into_itself(run):
    before = run.read_bytes()
    with pytest.raises(RecordError, match="cannot be repaired into itself: give another file"):
        repair_record(run, run.parent / "." / run.name)
    assert run.read_bytes() == before


@pytest.mark.parametrize("data", [b"", b"\x89MCA", b"t,x\n0,1\n"])
def test_other_files_are_refused(tmp_path, data):
    path = tmp_path / "log.mcap"
    path.write_bytes(data)
    with pytest.raises(RecordError, match="is no MCAP file"), open_record(path):
        pass
