"""Any reader returns what was recorded; written data remain readable when the process dies."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import yaml

from finssim.core.files import OutputError
from finssim.core.rotations import quat_from_euler, quat_to_matrix
from finssim.robot.messages import (
    HEADING,
    POSE,
    POSITION,
    VELOCITY,
    CommandEcho,
    NavigationAid,
    Picture,
    TagCorners,
    Telemetry,
)
from finssim.robot.pictures import picture_of
from finssim.robot.reading import Reading
from finssim.robot.record_messages import TOPICS
from finssim.vehicles import load_vehicle
from reference.finned import torpedo

pytest.importorskip("mcap")
pytest.importorskip("rosbags")
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag2.metadata import dump_qos_v8, parse_qos

from finssim.robot.record_files import vehicle_of
from finssim.robot.record_messages import Messages, RecordError
from finssim.robot.record_reader import describe_record, open_record
from finssim.robot.recorder import Recorder

VEHICLE = load_vehicle("finsrov")
RPM = tuple(100.0 * (i + 1) for i in range(8))


def telemetry(i=0, *, rpm=RPM):
    return Telemetry(
        i & 0xFFFF, 10 * i, (0.0, 0.0, 0.0, 1.0), (0.1, 0.2, 0.3), (0.5, -0.25, 9.81), 0.4, 105e3, 7, rpm
    )


def reading(t, *, x=0.0):
    return Reading(
        t,
        np.array([x, 0.2, -0.5]),
        quat_from_euler(0.1, -0.2, 0.3),
        np.array([0.4, 0.1, -0.1, 0.01, 0.02, 0.03]),
        True,
        "coast",
        std=np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3, 0.05]),
    )


def messages(path):
    """Return messages with their times [ns] by topic."""
    found = {}
    with AnyReader([path]) as reader:
        for connection, time, raw in reader.messages():
            found.setdefault(connection.topic, []).append((time, reader.deserialize(raw, connection.msgtype)))
    return found


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    """A finished record with every kind of message."""
    path = tmp_path_factory.mktemp("record") / "run.mcap"
    picture = np.tile(np.arange(64, dtype=np.uint8) * 4, (48, 1))
    echo = CommandEcho(1, 2, 3, 4, 5, True, False, 8, (0.5,) * 8, (0.4,) * 8, 1, 2)
    with Recorder(path, VEHICLE, {"seed": 3, "configuration": {"rate": 60}}, epoch=1.7e9) as recorder:
        recorder.telemetry(0.02, telemetry(), time=0.01)
        recorder.reading(0.03, reading(0.025))
        recorder.command(0.04, np.arange(8.0), "pid", np.arange(6.0))
        recorder.thrusters(0.05, "fault", reason="tilt", force=np.ones(8), normalised=(0.1,) * 8)
        recorder.policy(0.06, "policy", task="t1", observation=(1.0, 2.0), missed=4)
        recorder.goal(0.07, (1.0, 2.0, -0.5), np.pi / 2)
        recorder.echo(0.08, echo)
        recorder.picture(0.09, Picture(0.085, 1, picture))
        recorder.picture(0.10, Picture(0.095, 2, tags=(TagCorners(15, np.arange(8.0).reshape(4, 2)),)))
        recorder.aid(0.105, NavigationAid(1, POSITION, 0.1, (1.0, 2.0, -3.0), (0.5, 0.0)))
        recorder.aid(0.106, NavigationAid(2, POSE, 0.02, (1.0, 2.0, np.pi / 2), (0.002, 0.005)))
        recorder.aid(0.107, NavigationAid(3, VELOCITY, 0.06, (0.4, 0.1, -0.1), (0.0, 0.0)))
        recorder.aid(0.108, NavigationAid(4, HEADING, 0.02, (np.pi / 2, 0.0, 0.0), (0.0, 0.0)))
        recorder.aid(0.109, NavigationAid(5, 99, 0.02, (1.0, 0.0, 0.0), (0.0, 0.0)))
        recorder.event(0.11, "arm", "by hand", source="keyboard")
        recorder.diagnostics(0.12, "link", "warn", "3 lost", {"lost": 3})
    assert recorder.problem == "" and recorder.dropped == 0
    return path


def test_rosbags_reads_back_what_the_robot_knew(full):
    """Odometry, body-frame inertial data, shaft speeds by thruster, raw telemetry and their times."""
    found = messages(full)
    time, odometry = found["/finsrov/odom"][0]
    assert time == 1_700_000_000_030_000_000
    assert (odometry.header.stamp.sec, odometry.header.stamp.nanosec) == (1_700_000_000, 25_000_000)
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("map", "base_link")
    assert odometry.pose.pose.position.z == -0.5 and odometry.twist.twist.angular.z == 0.03
    assert odometry.pose.covariance[[0, 35]] == pytest.approx([1e-4, 25e-4])
    _, imu = found["/finsrov/imu"][0]
    # The IMU is turned by half a turn about z: its x and y point backwards and right.
    assert (imu.angular_velocity.x, imu.linear_acceleration.y) == pytest.approx((-0.1, 0.25))
    assert imu.orientation.z == pytest.approx(-1.0)
    _, shafts = found["/finsrov/joint_states"][0]
    assert list(shafts.name) == list(VEHICLE.thruster_names)
    # V_LF is output 2 (300 rpm) with sign -1, H_RF output 5 with sign +1.
    assert shafts.velocity[[0, 7]] == pytest.approx(np.array([-300.0, 600.0]) * 2 * np.pi / 60)
    _, raw = found["/finsrov/telemetry"][0]
    assert list(raw.motor_rpm) == list(RPM) and raw.depth == 0.4 and raw.header.stamp.nanosec == 10_000_000
    _, status = found["/finsrov/estimator_status"][0]
    assert status.mode == "coast" and np.isnan(status.vision_age)
    _, tree = found["/tf"][0]
    assert tree.transforms[0].child_frame_id == "base_link"


def test_channels_offer_the_quality_of_their_topics(full):
    """The quality of service is as rosbag2 stores it: rosbags' own reader accepts the Humble form, which
    Jazzy reads too."""
    with full.open("rb") as file:
        channels = make_reader(file).get_summary().channels.values()
    keys = {topic.under("finsrov"): key for key, topic in TOPICS.items()}
    for channel in channels:
        text, quality = channel.metadata["offered_qos_profiles"], TOPICS[keys[channel.topic]].quality
        (profile,) = parse_qos(text)
        assert yaml.safe_load(dump_qos_v8([profile])) == yaml.safe_load(text)
        assert (profile.durability.name == "TRANSIENT_LOCAL") == (quality == "latched")
        assert (profile.reliability.name == "BEST_EFFORT") == (quality == "sensor")
    assert len(channels) > 10


def test_rosbags_reads_back_what_the_robot_did(full):
    """Commands, bridge state, decisions, goal, echo, events, health and pictures."""
    found = messages(full)
    _, command = found["/finsrov/thruster_cmd"][0]
    assert (command.source, list(command.force)) == ("pid", list(range(8)))
    assert list(command.names) == list(VEHICLE.thruster_names)
    assert found["/finsrov/wrench_cmd"][0][1].wrench.torque.z == 5.0
    _, state = found["/finsrov/thruster_state"][0]
    assert (state.state, state.reason, list(state.force)) == (state.FAULT, "tilt", [1.0] * 8)
    _, policy = found["/finsrov/policy_info"][0]
    assert (policy.pilot, policy.task, policy.missed, list(policy.observation)) == ("policy", "t1", 4, [1, 2])
    _, goal = found["/finsrov/goal"][0]
    assert goal.pose.orientation.w == pytest.approx(np.cos(np.pi / 4))
    _, echo = found["/finsrov/command_echo"][0]
    assert (echo.accepted, echo.reject_flags, list(echo.applied)) == (False, 8, [0.4] * 8)
    event = json.loads(found["/finsrov/events"][0][1].data)
    assert (event["kind"], event["text"], event["source"]) == ("arm", "by hand", "keyboard")
    _, health = found["/diagnostics"][0]
    assert (health.status[0].level, health.status[0].values[0].value) == (1, "3")
    tags = json.loads(found["/finsrov/camera/tags"][0][1].data)["tags"]
    assert tags == [{"id": 15, "corners": [[0, 1], [2, 3], [4, 5], [6, 7]]}]
    _, picture = found["/finsrov/camera/image/compressed"][0]
    assert picture.format == "jpeg" and bytes(picture.data[:2]) == b"\xff\xd8"


def test_rosbags_reads_back_what_navigation_instruments_said(full):
    """Messages carry the time of measurement in map, log and body; unmeasured values have the largest
    uncertainty."""
    found = messages(full)
    (_, fix), (time, pose) = found["/finsrov/positioning/pose"]  # an unknown kind makes no message
    assert time == 1_700_000_000_106_000_000
    assert (fix.header.frame_id, fix.header.stamp.nanosec) == ("map", 5_000_000)
    assert (fix.pose.pose.position.x, fix.pose.pose.position.z) == (1.0, -3.0)
    assert np.diag(fix.pose.covariance.reshape(6, 6)).tolist() == [0.25] * 3 + [1e6] * 3
    assert pose.pose.pose.orientation.z == pytest.approx(np.sin(np.pi / 4))
    assert np.diag(pose.pose.covariance.reshape(6, 6)) == pytest.approx([4e-6, 4e-6, 1e6, 1e6, 1e6, 25e-6])
    ((_, log),) = found["/finsrov/dvl/twist"]
    assert (log.header.frame_id, log.header.stamp.nanosec) == ("dvl_link", 47_000_000)
    assert (log.twist.twist.linear.x, log.twist.twist.linear.z) == (0.4, -0.1)
    assert log.twist.covariance[[0, 35]] == pytest.approx([0.008**2, 1e6])
    ((_, compass),) = found["/finsrov/compass/imu"]
    assert compass.header.frame_id == "base_link" and compass.orientation.w == pytest.approx(
        np.cos(np.pi / 4)
    )
    assert compass.orientation_covariance[[0, 8]] == pytest.approx([1e6, np.radians(0.4) ** 2])
    assert compass.angular_velocity_covariance[0] == compass.linear_acceleration_covariance[0] == -1.0
    with open_record(full) as record:
        told = describe_record(record)["topics"]
    assert told["/finsrov/positioning/pose"]["messages"] == 2


def test_the_mcap_library_finds_summary_metadata_and_vehicle_file(full):
    """An independent reader checks every checksum and decodes each message."""
    from mcap.reader import make_reader

    decoders = pytest.importorskip("mcap_ros2.decoder").DecoderFactory()
    with full.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[decoders])
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary.statistics.message_count == 21 == len(list(reader.iter_decoded_messages()))
        (about,) = [m.metadata for m in reader.iter_metadata()]
        (kept,) = list(reader.iter_attachments())
    assert about["vehicle_sha256"] == VEHICLE.sha256
    assert json.loads(about["configuration"]) == {"rate": 60} and about["seed"] == "3"
    assert "finssim" in json.loads(about["provenance"])
    assert kept.data == VEHICLE.path.read_bytes()


def test_a_record_keeps_the_files_that_its_vehicle_extends(tmp_path):
    """The record includes a parent beside the file and one in the catalogue, and is read without their
    folder."""
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "otter.yaml").write_text(
        "extends: finsrov\nbody: {mass: 12.4}\norigin: guessed\nsource: me\n"
    )
    child = tmp_path / "own" / "otter_heavy.yaml"
    child.write_text("extends: otter\nbody: {mass: 12.9}\norigin: guessed\nsource: me\n")
    vehicle = load_vehicle(child)
    with Recorder(tmp_path / "run.mcap", vehicle):
        pass
    shutil.rmtree(tmp_path / "own")
    with open_record(tmp_path / "run.mcap") as record:
        assert set(record.files) == {"otter.yaml", "otter_heavy.yaml"}
        assert vehicle_of(record).sha256 == vehicle.sha256


def test_a_parent_that_a_record_keeps_may_not_name_a_path(tmp_path):
    (tmp_path / "otter.yaml").write_text(
        "extends: finsrov\nbody: {mass: 12.4}\norigin: guessed\nsource: me\n"
    )
    child = tmp_path / "heavy.yaml"
    child.write_text("extends: otter.yaml\norigin: guessed\nsource: me\n")
    with Recorder(tmp_path / "run.mcap", load_vehicle(child)):
        pass
    with open_record(tmp_path / "run.mcap") as record:
        record.files["otter.yaml"] = "extends: /etc/otter.yaml\n"
        with pytest.raises(RecordError, match="otter.yaml: extends"):
            vehicle_of(record)


@pytest.mark.parametrize(
    ("count", "kept"), [(7, 7), (2**32 - 1, 2**32 - 1), (2**32, 2**32 - 1), (10**30, 2**32 - 1)]
)
def test_counts_and_times_beyond_their_fields_are_the_last_that_fit(count, kept):
    """Beyond the ends of uint32 (2³² - 1) and of the seconds of a time (±2³¹) the serialiser would raise."""
    messages = Messages(VEHICLE)
    policy = messages.policy(10**9 * count, "pid", {"missed": count})
    state = messages.estimator(0, reading(0.0), {"fixes_accepted": count, "fixes_rejected": count})
    for message, kind in ((policy, "PolicyInfo"), (state, "EstimatorStatus")):
        assert messages.cdr(message, f"finssim_msgs/msg/{kind}")
    assert policy.missed == state.fixes_accepted == state.fixes_rejected == kept
    assert policy.header.stamp.sec == min(count, 2**31 - 1)
    assert messages.time(-(10**30)).sec == -(2**31)


def test_pictures_are_left_out_on_request(tmp_path):
    """`pictures="none"` keeps tags and drops images."""
    with Recorder(tmp_path / "run.mcap", VEHICLE, pictures="none") as recorder:
        recorder.picture(0.0, Picture(0.0, 1, np.zeros((4, 4), np.uint8)))
        recorder.picture(0.1, Picture(0.1, 2, tags=(TagCorners(1, np.zeros((4, 2))),)))
    assert set(messages(tmp_path / "run.mcap")) == {"/finsrov/camera/tags"}


def test_an_existing_record_is_never_replaced(tmp_path):
    path = tmp_path / "run.mcap"
    path.write_bytes(b"mine")
    with pytest.raises(OutputError, match="never replaced: give a new name"):
        Recorder(path, VEHICLE)
    assert path.read_bytes() == b"mine"


def test_the_imu_message_agrees_with_the_mount():
    """The attitude of the body is that of the IMU times the inverse of its mount, for any mount."""
    mount = quat_from_euler(0.3, -0.4, 1.0)
    imu = VEHICLE.sensors.imu.model_copy(update={"orientation": tuple(mount)})
    turned = VEHICLE.model_copy(update={"sensors": VEHICLE.sensors.model_copy(update={"imu": imu})})
    q_world_imu = quat_from_euler(-0.1, 0.2, 0.7)
    sample = Telemetry(0, 0, tuple(q_world_imu), (0.1, 0.2, 0.3), (1.0, 2.0, 3.0), 0.0, 0.0, 0, None)
    message = Messages(turned).imu(0, sample)
    q = [message.orientation.x, message.orientation.y, message.orientation.z, message.orientation.w]
    R = quat_to_matrix(q_world_imu) @ quat_to_matrix(mount).T
    assert quat_to_matrix(q) == pytest.approx(R, abs=1e-12)
    force = message.linear_acceleration
    assert [force.x, force.y, force.z] == pytest.approx(quat_to_matrix(mount) @ [1.0, 2.0, 3.0])


def test_a_vehicle_changed_by_a_program_is_kept_as_it_is(tmp_path):
    """The stored mass is that of the changed vehicle, not that of its file."""
    with Recorder(tmp_path / "run.mcap", VEHICLE.replace({"body.mass": 13.0})):
        pass
    with open_record(tmp_path / "run.mcap") as record:
        assert json.loads(record.files["finsrov.json"])["body"]["mass"] == 13.0


def test_own_sensors_are_in_the_record(tmp_path):
    """Pictures are stored as JPEG with their lens, pings with a fan view, and ranges; stamps are those of
    exposure."""
    path, image = tmp_path / "run.mcap", np.zeros((36, 64, 3), np.uint8)
    image[..., 0] = 200
    echoes = np.zeros((128, 128), np.uint8)
    echoes[:, 64] = 255
    with Recorder(path, VEHICLE, {}) as recorder:
        recorder.picture(1.1, Picture(1.1, 1, image, source="front_camera"))
        recorder.picture(1.1, Picture(1.1, 1, echoes, source="sonar"))
        recorder.picture(1.1, Picture(1.05, 1, source="altimeter", ranges=np.array([2.5], np.float32)))
        recorder.picture(1.1, Picture(1.05, 1, image, source="stranger"))
    assert recorder.dropped == 0
    found = {topic.removeprefix("/finsrov/"): rows[0][1] for topic, rows in messages(path).items()}
    assert set(found) == {
        "front_camera/image/compressed", "front_camera/camera_info", "sonar/sonar_image", "sonar/image/compressed",
        "altimeter/range",
    }  # fmt: skip
    picture = found["front_camera/image/compressed"]
    assert (picture.header.stamp.sec, picture.header.frame_id) == (1, "front_camera_optical")
    assert np.abs(picture_of(picture.data, colour=True).astype(int) - image).max() < 6
    fan = picture_of(found["sonar/image/compressed"].data)
    assert fan[200 - 2 : 200 + 2, fan.shape[1] // 2].max() > 200  # half the range ahead, from above
    assert found["altimeter/range"].range == 2.5 and found["sonar/sonar_image"].image.beam_count == 128
    with open_record(path) as record:
        assert describe_record(record)["topics"]["/finsrov/altimeter/range"]["messages"] == 1


def test_shaft_speeds_need_the_output_of_every_thruster():
    """Speeds of all outputs give all thrusters in their order; with one output missing there is no message."""
    messages = Messages(VEHICLE)
    message = messages.shafts(0, RPM)
    assert list(message.name) == list(VEHICLE.thruster_names) and len(message.velocity) == 8
    assert messages.shafts(0, RPM[:-1]) is None
    unknown = VEHICLE.replace({"thrusters.V_LF.motor_index": None})
    assert Messages(unknown).shafts(0, RPM) is None


def test_actuators_besides_thrusters_are_joints(tmp_path):
    """Measured values carry their stamps beside the requested ones; `record info` lists both topics."""
    ours = torpedo()
    with Recorder(tmp_path / "run.mcap", ours) as recorder:
        snapshot = Telemetry(1, 10, (0.0, 0.0, 0.0, 1.0), (0.1,) * 3, (0.0, 0.0, 9.8), 1.0, 1e5, 7, (60.0,))
        recorder.telemetry(0.02, replace(snapshot, actuators=(0.1, -0.2, 3e-4, 0.01)), time=0.01)
        recorder.command(0.03, [5.0, 0.2, -0.3, 4e-4, 0.02], "pilot")
        recorder.command(0.04, [5.0], "pilot")
    with open_record(tmp_path / "run.mcap") as record:
        found = {
            topic: list(record.messages([topic]))
            for topic in ("actuator_states", "actuator_cmd", "thruster_cmd")
        }
        rows = describe_record(record)["topics"]
    states, asked = found["actuator_states"], found["actuator_cmd"]
    assert len(states) == len(asked) == 1 and len(found["thruster_cmd"]) == 2
    assert states[0].message.name == ["rudder", "elevator", "engine", "battery"]
    assert states[0].message.header.stamp.nanosec == 10_000_000
    np.testing.assert_allclose(states[0].message.position, [0.1, -0.2, 3e-4, 0.01])
    np.testing.assert_allclose(asked[0].message.position, [0.2, -0.3, 4e-4, 0.02])
    assert found["thruster_cmd"][0].message.force.tolist() == [5.0]
    assert rows["/torpedo/actuator_states"]["type"] == "sensor_msgs/msg/JointState"
