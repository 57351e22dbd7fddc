"""ROS 2 bags become trials without ROS: both storages, stamps, custom messages, damaged files."""

import numpy as np
import pytest

from finssim.core import budget
from finssim.trials.findings import CalibrationError
from finssim.trials.importers import bag
from finssim.trials.importers.dispatch import read_trials

pytest.importorskip("rosbags")
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from trials.importers.bags import T0, Bag, xyz

MOTORS = "std_msgs/Header header\nstring[] name\nfloat64[] speed\nstring state"
LATENCY = 0.03
"""Delay from the stamp of a message to its arrival [s]."""


def odometry(i, t):
    turned = {"z": np.sqrt(0.5), "w": np.sqrt(0.5)}
    twist = {"linear": xyz(0.5, 0.02, -0.01), "angular": xyz(0.0, 0.0, 0.3)}
    return {
        "pose": {"pose": {"position": xyz(0.1 * i, 0.0, -1.0), "orientation": turned}},
        "twist": {"twist": twist},
    }


def motors(i, t):
    state = "baseline" if i < 20 else "excitation"
    return {"name": ["T1", "T2"], "speed": np.array([100.0, 200.0 + i]), "state": state}


RATES = {"angular_velocity": xyz(0.01, 0.02, 0.3), "linear_acceleration": xyz(0.0, 0.0, 9.81)}
WRENCH = {"wrench": {"force": xyz(12.0, 0.0, 0.0), "torque": xyz(0.0, 0.0, 1.2)}}
TOPICS = {
    "/odom": ("nav_msgs/Odometry", odometry, 20.0),
    "/imu": ("sensor_msgs/Imu", lambda i, t: RATES, 50.0),
    "/wrench": ("geometry_msgs/WrenchStamped", lambda i, t: WRENCH, 10.0),
    "/pressure": ("sensor_msgs/FluidPressure", lambda i, t: {"fluid_pressure": 101325.0 + 9806.65}, 5.0),
    "/array": ("std_msgs/Float64MultiArray", lambda i, t: {"data": np.array([1.0, 2.0, 3.0 + i])}, 10.0),
    "/motors": ("lab_msgs/Motors", motors, 10.0),
}
SECONDS = 4.0


def written(folder, storage, topics=("/odom", "/imu", "/wrench", "/pressure"), mode=None):
    """Write a bag of 4 s, compressed if a mode is given."""
    bag = Bag(types={"lab_msgs/msg/Motors": MOTORS})
    for topic in topics:
        bag.add(topic, *TOPICS[topic], delay=LATENCY, seconds=SECONDS)
    return bag.write(folder, storage=storage, mode=mode, version=8)


@pytest.fixture(params=[StoragePlugin.SQLITE3, StoragePlugin.MCAP], ids=["sqlite3", "mcap"])
def storage(request):
    return request.param


def mapped(path, text, tmp_path):
    (tmp_path / "map.yaml").write_text(text)
    (trial,) = read_trials([path], column_map=tmp_path / "map.yaml")
    return trial


def test_topics_of_usual_types_need_no_map(tmp_path, storage):
    """Odometry, Imu, WrenchStamped and FluidPressure are read at their own rates, in SI units."""
    (trial,) = read_trials([written(tmp_path / "run7", storage)])
    assert trial.name == "run7"
    expected = {"u": (0.5, 80), "r": (0.3, None), "az": (9.81, 200), "tau_x": (12.0, 40), "tau_n": (1.2, 40)}
    for column, (value, count) in expected.items():
        t, values = trial.series(column)
        np.testing.assert_allclose(values, value)
        assert count is None or len(t) == count
    np.testing.assert_allclose(trial.series("depth")[1], 1.0, rtol=1e-6)
    np.testing.assert_allclose(trial.series("qz")[1], np.sqrt(0.5))


def test_the_gyroscope_comes_before_the_rates_of_an_odometry(tmp_path, storage):
    """Both contain p, q, r: those of the Imu are used, and this is reported."""
    (trial,) = read_trials([written(tmp_path / "run", storage)])
    assert len(trial.series("p")[0]) == 200
    assert any(
        one.values == {"columns": ("p", "q", "r"), "topic": "/odom", "better": "/imu"}
        for one in trial.findings
    )


def test_stamps_of_the_header_come_before_times_of_recording(tmp_path, storage):
    """Messages arrive 30 ms after their stamps; a map may choose either."""
    bag = written(tmp_path / "run", storage, ("/odom", "/array"))
    columns = "/array: {columns: {rpm_T1: 'data[0]', rpm_T2: data.2}}"
    stamped = mapped(bag, f"topics:\n  /odom: {{}}\n  {columns}\n", tmp_path)
    received = mapped(bag, f"topics:\n  /odom: {{stamps: received}}\n  {columns}\n", tmp_path)
    # A bare array has no stamp, so its times are those of recording, 30 ms after the stamps of the odometry.
    np.testing.assert_allclose(stamped.series("rpm_T1")[0][0] - stamped.series("u")[0][0], 0.03, atol=1e-6)
    np.testing.assert_allclose(received.series("rpm_T1")[0][0], received.series("u")[0][0], atol=1e-6)
    np.testing.assert_allclose(stamped.series("rpm_T2")[1], 3.0 + np.arange(40))


def test_custom_messages_by_path_name_and_phase(tmp_path, storage):
    """The type is defined only in the bag: elements by the message's own names, units, and the phase that it
    names."""
    bag = written(tmp_path / "run", storage, ("/motors", "/odom"))
    text = """
topics:
  /motors:
    phase: state
    columns:
      rpm_T1: {column: "speed[T1]", unit: rad/s}
      rpm_T2: {column: "speed[1]", unit: rad/s}
  /odom: {columns: {u: twist.twist.linear.x}}
"""
    trial = mapped(bag, text, tmp_path)
    np.testing.assert_allclose(trial.series("rpm_T1")[1], 100.0 * 30.0 / np.pi)
    assert trial.series("rpm_T2")[1][5] == pytest.approx(205.0 * 30.0 / np.pi)
    assert trial.phase[0] == "baseline" and trial.phase[-1] == "excitation"
    assert trial.t[np.argmax(trial.phase == "excitation")] == pytest.approx(2.0)
    assert sorted(trial.channels) == ["rpm_T1", "rpm_T2", "u"]


def test_a_forward_right_down_topic_is_turned(tmp_path, storage):
    """A left turn is negative in an odometry in FRD axes."""
    bag = written(tmp_path / "run", storage, ("/odom",))
    trial = mapped(bag, "topics:\n  /odom: {frame: FRD}\n", tmp_path)
    assert trial.series("r")[1][0] == pytest.approx(-0.3)
    assert trial.series("z")[1][0] == pytest.approx(1.0)


def test_a_single_file_without_its_folder_opens(tmp_path):
    """Foxglove and loggers of vehicles write a single .mcap."""
    bag = written(tmp_path / "run", StoragePlugin.MCAP)
    (trial,) = read_trials([next(bag.glob("*.mcap"))])
    assert trial.has("u", "tau_x", "depth")


def test_a_folder_that_lost_its_metadata_opens(tmp_path, storage):
    """The recorder was killed before it wrote metadata.yaml."""
    bag = written(tmp_path / "run", storage)
    (whole,) = read_trials([bag])
    (bag / "metadata.yaml").unlink()
    (trial,) = read_trials([bag])
    assert trial.sha256 == whole.sha256 and "no_metadata" in {one.code for one in trial.findings}


@pytest.mark.parametrize("part", [0.8, 0.5])
@pytest.mark.parametrize("mode", [None, CompressionMode.STORAGE])
def test_an_mcap_cut_off_opens_up_to_the_cut(tmp_path, part, mode):
    """After a power loss there is no index and no end; complete messages are read, also inside the last
    chunk."""
    data = next(written(tmp_path / "run", StoragePlugin.MCAP, mode=mode).glob("*.mcap")).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: int(part * len(data))])
    (trial,) = read_trials([tmp_path / "cut.mcap"])
    assert 10 < len(trial.series("u")[0]) <= 80
    np.testing.assert_allclose(trial.series("u")[1], 0.5)
    assert any("cut off" in str(one) for one in trial.findings)


@pytest.mark.parametrize(
    "text, sentence",
    [
        ("/odometry: {}", "no topic '/odometry', did you mean '/odom'?"),
        ("/array: {}", "has no default columns"),
        ("/odom: {columns: {u: twist.linear.x}}", "no field 'linear' of 'twist.linear.x'"),
        ("/odom: {columns: {u: twist.twist.linear}}", "expected a number: it contains x, y, z"),
        ("/array: {columns: {rpm_T1: 'data[7]'}}", "has no element 7"),
        ("/motors: {columns: {rpm_T9: 'speed[T9]'}}", "the message contains T1, T2"),
        ("/array: {columns: {x: 'data[0]'}, phase: 'data'}", "field 'data' is a ndarray"),
    ],
)
def test_one_sentence_says_what_a_bag_has_not(tmp_path, text, sentence):
    """Topics, types and fields that do not exist are named, with those that do."""
    bag = written(tmp_path / "run", StoragePlugin.MCAP, tuple(TOPICS))
    with pytest.raises(CalibrationError) as refused:
        mapped(bag, f"topics:\n  {text}\n", tmp_path)
    assert sentence in str(refused.value)


def test_two_sources_of_one_column_are_refused(tmp_path):
    """Only the user can decide which source is better."""
    bag = written(tmp_path / "run", StoragePlugin.MCAP, ("/odom", "/array"))
    with pytest.raises(CalibrationError, match="u is in /odom and in /array"):
        mapped(
            bag,
            "topics:\n  /odom: {columns: {u: twist.twist.linear.x}}\n  /array: {columns: {u: 'data[0]'}}\n",
            tmp_path,
        )


@pytest.mark.parametrize("name", ["broken.mcap", "broken.db3"])
def test_what_is_no_bag_is_refused(tmp_path, name):
    """A file of zeros and a wrongly given kind are refused."""
    (tmp_path / name).write_bytes(bytes(4096))
    with pytest.raises(CalibrationError, match="broken"):
        read_trials([tmp_path / name])
    (tmp_path / "table.csv").write_text("t,u\n0,1\n")
    with pytest.raises(CalibrationError, match="cannot be opened as a bag"):
        read_trials([tmp_path / "table.csv"], format="rosbag")


def test_a_small_bag_that_unpacks_to_much_is_refused(tmp_path, monkeypatch):
    """A message of 300 MB takes 30 kB in the bag; the limit here is 128 MiB."""
    pytest.importorskip("resource")
    writer = Writer(tmp_path / "bomb", version=8, storage_plugin=StoragePlugin.SQLITE3)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        writer.write(
            writer.add_connection("/odom", "nav_msgs/msg/Odometry", typestore=Bag().types),
            T0 * 10**9,
            bytes(300 << 20),
        )
    assert sum(file.stat().st_size for file in (tmp_path / "bomb").iterdir()) < 1 << 20
    monkeypatch.setattr(bag, "limited_memory", lambda: budget.limited_memory(128 << 20))
    with pytest.raises(CalibrationError, match="Unable to allocate|MemoryError"):
        read_trials([tmp_path / "bomb"])


def packed_bag(folder, storage, size):
    """Return a bag compressed as a whole file, with one meaningful message followed by one of `size` zeros."""
    writer = Writer(folder, version=8, storage_plugin=storage)
    writer.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/odom", "nav_msgs/msg/Odometry", typestore=Bag().types)
        writer.write(connection, T0 * 10**9, bytes(size))
    return folder


def test_a_bag_that_is_packed_as_a_whole_is_unpacked_up_to_a_limit(tmp_path, storage, monkeypatch):
    """It is unpacked to its own directory on disk; larger bags are not written, and must be given unpacked."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "scratch"))
    (tmp_path / "scratch").mkdir()
    bag = packed_bag(tmp_path / "bomb", storage, 64 << 20)
    assert sum(file.stat().st_size for file in bag.iterdir()) < 1 << 20
    monkeypatch.setattr(budget, "UNPACKED", 32 << 20)
    unpacked = []
    monkeypatch.setattr("shutil.copyfileobj", lambda *given: unpacked.append(given))
    with pytest.raises(
        CalibrationError, match="bomb: unpacks to more than 32 MiB: unpack its files with 'zstd -d'"
    ):
        read_trials([bag])
    assert not unpacked and not list((tmp_path / "scratch").iterdir())


def test_a_bag_that_is_packed_as_a_whole_says_what_the_plain_one_says(tmp_path, storage):
    """This holds also after a skippable frame."""
    plain = written(tmp_path / "plain", storage)
    packed = written(tmp_path / "packed", storage, mode=CompressionMode.FILE)
    (file,) = packed.glob("*.zstd")
    file.write_bytes(b"\x50\x2a\x4d\x18\x02\0\0\0ab" + file.read_bytes())
    (one,), (other,) = read_trials([plain]), read_trials([packed])
    assert one.channels and sorted(one.channels) == sorted(other.channels)
    for name in one.channels:
        np.testing.assert_array_equal(one.series(name), other.series(name))
