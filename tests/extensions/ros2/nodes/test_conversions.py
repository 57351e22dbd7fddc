"""Robot values become messages and return through wire bytes; malformed ones give a reason and never raise."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from finssim.control.guidance import Station
from finssim.core.rotations import quat_from_euler, quat_to_matrix
from finssim.extensions.ros2.codec import codec_of
from finssim.extensions.ros2.nodes.conversions import (
    RosMessages,
    aid_of,
    compressed_of,
    force_of,
    image_of,
    nanoseconds,
    reading_of,
    ros_type,
    setpoints_of,
    station_of_pose,
    tags_of,
    telemetry_of,
    wrench_of,
)
from finssim.extensions.ros2.topics import TOPICS
from finssim.robot.messages import (
    HEADING,
    POSE,
    POSITION,
    VELOCITY,
    NavigationAid,
    Picture,
    TagCorners,
    Telemetry,
)
from finssim.robot.reading import Reading
from finssim.vehicles import load_vehicle
from reference.finned import torpedo

VEHICLE = load_vehicle("finsrov")
MAKE = RosMessages(VEHICLE)
STAMP = 1_700_000_000_123_456_789
ANY = st.floats(allow_nan=True, allow_infinity=True)


def wire(message):
    """Return the message after serialisation and deserialisation."""
    codec = codec_of()
    return codec.deserialize(bytes(codec.serialize(message)), message.TYPE)


def telemetry(**changes):
    """Return a snapshot with distinct numbers."""
    values = {
        "sequence": 65_535,
        "mcu_ms": 2**32 - 1,
        "quaternion": (0.1, -0.2, 0.3, 0.927),
        "gyro": (0.01, -0.02, 0.03),
        "accel": (0.4, -0.5, 9.7),
        "depth": 0.61,
        "pressure": 107_000.0,
        "flags": 0x8100_0000,
        "motor_rpm": tuple(float(i) for i in range(8)),
    }
    return Telemetry(**values | changes)


@pytest.mark.parametrize("rpm", [tuple(float(i) for i in range(8)), None])
def test_telemetry_comes_back_as_it_was(rpm):
    """Every field survives, with both times."""
    message = wire(MAKE.telemetry(STAMP, STAMP + 5, telemetry(motor_rpm=rpm)))
    assert telemetry_of(message) == telemetry(motor_rpm=rpm)
    assert (nanoseconds(message.header.stamp), nanoseconds(message.received)) == (STAMP, STAMP + 5)


@pytest.mark.parametrize(
    ("kind", "values", "std"),
    [
        (POSITION, (1.0, -2.0, -3.0), (0.5, 0.0)),
        (POSE, (1.0, -2.0, 3.1), (0.002, 0.005)),
        (VELOCITY, (0.4, -0.1, 0.02), (0.1, 0.0)),
        (HEADING, (-3.1, 0.0, 0.0), (0.0, 0.0)),
    ],
)
def test_what_a_navigation_instrument_said_comes_back_as_it_was(kind, values, std):
    """All but its sequence survives; another frame is refused, and a variance that is not a number is passed
    on."""
    key, message = MAKE.aid(STAMP, NavigationAid(7, kind, 0.25, values, std))
    message = wire(message)
    frame = TOPICS[key].frame
    back = aid_of(key, message, 0.25, frame)
    assert (back.kind, back.age, nanoseconds(message.header.stamp)) == (kind, 0.25, STAMP)
    assert (back.values, back.std) == (pytest.approx(values), pytest.approx(std))
    message.header.frame_id = "odom"
    assert aid_of(key, message, 0.25, frame) == "of another frame"
    if key == "positioning":
        message.header.frame_id, message.pose.covariance = "map", [math.nan] * 36
        assert math.isnan(aid_of(key, message, 0.25, frame).std[0])


def test_an_imu_message_is_in_body_axes():
    """Measurements are turned by the unit's mount into the axes of REP-103: x forward, y left, z up."""
    mount = VEHICLE.sensors.imu.orientation
    message = wire(MAKE.imu(STAMP, telemetry()))
    from finssim.core.rotations import quat_rotate

    expected = quat_rotate(mount, (0.01, -0.02, 0.03))
    told = message.angular_velocity
    assert (told.x, told.y, told.z) == pytest.approx(tuple(expected))
    assert message.header.frame_id == "base_link"


def test_thrusts_are_matched_by_name():
    """Names may come in any order."""
    names, force = list(MAKE.names), np.arange(8.0)
    message = wire(MAKE.command(STAMP, force, "pid"))
    assert force_of(message, names).tolist() == force.tolist()
    message.names, message.force = names[::-1], force[::-1].tolist()
    assert force_of(message, names).tolist() == force.tolist()


@pytest.mark.parametrize(
    ("names", "force", "words"),
    [
        (None, [0.0] * 7, "7 thrusts for 8"),
        (["a"] * 8, [0.0] * 8, "names the thrusters a"),
        ([], [], "none"),
        (None, [math.nan] + [0.0] * 7, "not finite"),
    ],
)
def test_a_command_that_cannot_be_used_says_why(names, force, words):
    """Commands that are too short, empty, NaN or have other names are refused with the reason."""
    message = MAKE.command(STAMP, np.zeros(8), "pid")
    message.force = force
    if names is not None:
        message.names = names
    assert words in force_of(message, MAKE.names)


def reading(**changes):
    """Return a reading with distinct numbers."""
    values = {
        "time": 12.5,
        "position": np.array([0.5, -0.25, -0.75]),
        "quaternion": np.asarray(quat_from_euler(0.1, -0.2, 2.5)),
        "nu": np.array([0.1, 0.2, 0.3, -0.1, -0.2, -0.3]),
        "ready": True,
        "mode": "coast",
        "std": np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3, 0.05]),
    }
    return Reading(**values | changes)


def test_a_reading_comes_back_as_it_was():
    """Odometry and EstimatorStatus together restore the reading."""
    odometry, status = wire(MAKE.odometry(STAMP, reading())), wire(MAKE.estimator(STAMP, reading(), {}))
    back = reading_of(status, odometry, 12.5)
    for name in ("position", "quaternion", "nu", "std"):
        assert getattr(back, name) == pytest.approx(getattr(reading(), name), abs=1e-15)
    assert (back.time, back.ready, back.mode, back.reason) == (12.5, True, "coast", "")
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("map", "base_link")


def test_covariances_hold_numbers_only():
    """Covariances suit filters: turned into the axes of the twist, and large where values are unknown."""
    odometry = MAKE.odometry(STAMP, reading())
    pose, twist = (np.reshape(c.covariance, (6, 6)) for c in (odometry.pose, odometry.twist))
    assert np.diag(pose) == pytest.approx([1e-4, 4e-4, 9e-4, 0.02, 0.02, 25e-4])
    R = quat_to_matrix(reading().quaternion)
    assert R @ twist[:3, :3] @ R.T == pytest.approx(np.diag([0.01, 0.04, 0.09]))
    assert twist[3:, 3:] == pytest.approx(0.01 * np.eye(3)) and not twist[:3, 3:].any()
    for std in (np.full(7, np.nan), np.array([0.01, np.nan, 0.03, np.nan, 0.2, 0.3, np.inf])):
        odometry = MAKE.odometry(STAMP, reading(std=std))
        for c in (odometry.pose, odometry.twist):
            matrix = np.reshape(c.covariance, (6, 6))
            assert np.isfinite(matrix).all() and np.linalg.eigvalsh(matrix)[0] > 0.0 and matrix.max() == 1e6


@given(numbers=st.lists(ANY, min_size=13, max_size=13))
def test_a_reading_with_a_bad_number_is_not_ready(numbers):
    """The ready flag of the message does not matter."""
    odometry, status = MAKE.odometry(STAMP, reading()), MAKE.estimator(STAMP, reading(), {})
    pose, twist = odometry.pose.pose, odometry.twist.twist
    pose.position.x, pose.position.y, pose.position.z = numbers[:3]
    q = pose.orientation
    q.x, q.y, q.z, q.w = numbers[3:7]
    twist.linear.x, twist.linear.y, twist.linear.z = numbers[7:10]
    twist.angular.x, twist.angular.y, twist.angular.z = numbers[10:]
    back = reading_of(status, odometry, 0.0)
    if back.ready:
        assert np.isfinite([*back.position, *back.nu]).all()
        assert math.hypot(*back.quaternion) == pytest.approx(1.0, abs=0.011)


def test_without_odometry_nothing_is_known():
    """Without odometry a controller may not act."""
    back = reading_of(MAKE.estimator(STAMP, reading(), {}), None, 0.0)
    assert not back.ready and np.isnan(back.position).all() and back.reason == "no odometry"


@given(x=ANY, yaw=st.floats(-3.1, 3.1), tilt=st.floats(-3.0, 3.0))
def test_a_goal_is_a_level_pose_or_a_sentence(x, yaw, tilt):
    """A goal must be finite, in the map and upright; otherwise the reason is returned."""
    message = wire(MAKE.goal(STAMP, (x, -0.25, -0.75), yaw))
    qx, qy, qz, qw = (float(v) for v in quat_from_euler(tilt, 0.0, yaw))
    q = message.pose.orientation
    q.x, q.y, q.z, q.w = qx, qy, qz, qw
    found = station_of_pose(message)
    if math.isfinite(x) and abs(tilt) < math.radians(19.0):
        assert isinstance(found, Station) and found.position == (x, -0.25, -0.75)
        if tilt == 0.0:
            assert found.yaw == pytest.approx(yaw)
    elif not math.isfinite(x) or abs(tilt) > math.radians(21.0):
        assert isinstance(found, str)


def test_a_goal_of_another_frame_is_refused():
    """The position of another frame is unknown."""
    message = MAKE.goal(STAMP, (0.0, 0.0, -0.5), 0.0)
    message.header.frame_id = "base_link"
    assert "frame 'base_link'" in station_of_pose(message)


@given(tau=st.lists(ANY, min_size=6, max_size=6))
def test_a_wrench_is_finite_or_none(tau):
    """NaN never becomes a command."""
    found = wrench_of(wire(MAKE.wrench(STAMP, tau)))
    if np.isfinite(tau).all():
        assert found.tolist() == tau
    else:
        assert found is None


def test_pictures_come_back_as_they_were():
    """Gray pictures exactly, with padded rows too; JPEG nearly; colours by their brightness."""
    image = np.tile(np.arange(64, dtype=np.uint8) * 3, (48, 1))
    assert np.array_equal(image_of(wire(MAKE.image(STAMP, image))), image)
    jpeg = compressed_of(wire(MAKE.compressed(STAMP, image)))
    assert np.abs(jpeg.astype(int) - image).max() < 10
    colour = MAKE.image(STAMP, image)
    colour.encoding, colour.step, colour.data = "rgb8", 192, np.repeat(image, 3, axis=1).tobytes()
    assert np.array_equal(image_of(colour), image)
    padded = MAKE.image(STAMP, image)
    padded.step, padded.data = 70, np.pad(image, ((0, 0), (0, 6))).tobytes()
    assert np.array_equal(image_of(padded), image)


@given(
    height=st.integers(0, 9),
    width=st.integers(0, 9),
    step=st.integers(0, 30),
    encoding=st.sampled_from(["mono8", "rgb8", "16UC1", ""]),
    data=st.binary(max_size=90),
)
def test_a_malformed_picture_is_none(height, width, step, encoding, data):
    """Inconsistent sizes, unknown encodings and bytes that are not a JPEG give None."""
    message = ros_type("sensor_msgs/msg/Image")(
        height=height, width=width, step=step, encoding=encoding, data=data
    )
    image = image_of(message)
    assert image is None or image.shape == (height, width)
    assert compressed_of(ros_type("sensor_msgs/msg/CompressedImage")(format="jpeg", data=data)) is None


def test_tags_come_back_as_they_were():
    """Tags survive with their time of exposure and their detector."""
    corners = np.array([[1.5, 2.25], [3.0, 4.0], [5.0, 6.0], [7.0, 8.0]])
    picture = Picture(0.0, 7, None, (TagCorners(3, corners),))
    stamp, finder, back = tags_of(wire(MAKE.found_tags(STAMP, picture, "camera")))
    assert (stamp, finder, back.sequence, back.tags[0].tag_id) == (STAMP, "camera", 7, 3)
    assert np.array_equal(back.tags[0].corners, corners)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | ANY | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.sampled_from(["tags", "id", "corners", "stamp_ns", "sequence", "finder"]), inner)
    ),
)


@pytest.mark.slow
@given(told=JSON)
def test_malformed_tags_are_none(told):
    """Other JSON and text that is not JSON give None."""
    text = ros_type("std_msgs/msg/String")
    for data in (json.dumps(told), json.dumps(told)[:-1]):
        found = tags_of(text(data=data))
        assert found is None or isinstance(found[2], Picture)


@pytest.mark.parametrize("stamp", ["1" + 400 * "0", "-1" + 400 * "0", str(2**31 * 10**9), "1e400", "NaN"])
def test_tags_of_a_time_that_no_stamp_has_are_none(stamp):
    """JSON numbers have any size: one of 400 digits is not a float and would end the localizer."""
    told = f'{{"stamp_ns": {stamp}, "sequence": 1, "finder": "camera", "tags": []}}'
    assert tags_of(ros_type("std_msgs/msg/String")(data=told)) is None


def test_every_topic_of_the_table_has_its_type():
    """Each type can be imported like the classes of rclpy."""
    for topic in TOPICS.values():
        assert ros_type(topic.type)


def test_values_of_other_actuators_are_matched_by_name():
    """Joints may come in any order; an unknown name and a value that is not a number are refused with the
    reason."""
    make = RosMessages(torpedo())
    message = wire(make.actuators(STAMP, [0.1, -0.2, 3e-4, 0.01]))
    assert setpoints_of(message, make.others).tolist() == [0.1, -0.2, 3e-4, 0.01]
    message.name, message.position = make.others[::-1], [0.01, 3e-4, -0.2, 0.1]
    assert setpoints_of(message, make.others).tolist() == [0.1, -0.2, 3e-4, 0.01]
    message.position = [0.01, math.nan, -0.2, 0.1]
    assert setpoints_of(message, make.others) == "it holds a position that is not finite"
    message.name = ["rudder"]
    assert "names the actuators rudder, expected rudder, elevator" in setpoints_of(message, make.others)
