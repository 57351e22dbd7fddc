"""Bags of MAVROS and of Doppler logs become trials without a map, and an unusable topic does not prevent it."""

import numpy as np
import pytest

from finssim.trials.findings import CalibrationError
from finssim.trials.importers.dispatch import read_trials
from finssim.vehicles import load_vehicle
from finssim.vehicles.autopilot import FRAMES

pytest.importorskip("rosbags")
from rosbags.rosbag2 import StoragePlugin

from trials.importers.bags import T0, Bag, xyz

HEADER = "std_msgs/Header header\n"
BEAM = "int64 id\nfloat64 velocity\nfloat64 distance\nfloat64 rssi\nfloat64 nsd\nbool valid\n"
TYPES = {
    "mavros_msgs/msg/RCOut": HEADER + "uint16[] channels",
    "mavros_msgs/msg/RCIn": HEADER + "uint8 rssi\nuint16[] channels",
    "mavros_msgs/msg/OverrideRCIn": "uint16[18] channels",
    "mavros_msgs/msg/State": HEADER
    + "bool connected\nbool armed\nbool guided\nbool manual_input\nstring mode\nuint8 system_status",
    "mavros_msgs/msg/VfrHud": HEADER + "float32 airspeed",
    "mavros_msgs/msg/ParamValue": "int64 integer\nfloat64 real",
    "mavros_msgs/msg/Param": HEADER
    + "string param_id\nmavros_msgs/ParamValue value\nuint16 param_index\nuint16 param_count",
    "mavros_msgs/msg/ParamEvent": HEADER
    + "string param_id\nrcl_interfaces/ParameterValue value\nuint16 param_index\nuint16 param_count",
    "waterlinked_a50_ros_driver/msg/DVLBeam": BEAM,
    "waterlinked_a50_ros_driver/msg/DVL": HEADER
    + "float64 time\ngeometry_msgs/Vector3 velocity\nfloat64 fom\nfloat64 altitude\n"
    "waterlinked_a50_ros_driver/DVLBeam[] beams\nbool velocity_valid\nint64 status\nstring form",
}
N = 100
TIMES = np.arange(N) * 0.1
PULSES = np.stack([1500.0 + 20.0 * (i + 1) * np.sin(TIMES + i) for i in range(8)], axis=-1).round()


class VehicleBag(Bag):
    """A bag of an ArduSub with MAVROS and a Doppler log."""

    def __init__(self, kind=2):
        super().__init__(kind, TYPES)

    def imu(self, topic="/mavros/imu/data", known=(True, True, True), scale=1.0):
        names = ("orientation", "angular_velocity", "linear_acceleration")
        unknown = {
            f"{name}_covariance": np.full(9, -1.0)
            for name, good in zip(names, known, strict=True)
            if not good
        }
        return self.add(
            topic,
            "sensor_msgs/Imu",
            lambda i, t: {
                "orientation": {"z": np.sin(t / 2), "w": np.cos(t / 2)},
                "angular_velocity": xyz(
                    *(scale * np.array([0.1 * np.sin(t), 0.2 * np.sin(t), 1.0 + 0.1 * t]))
                ),
                "linear_acceleration": xyz(*(scale * np.array([0.1 * t, 0.1 * np.sin(t), 9.8 + t]))),
                **unknown,
            },
        )

    def odom(self, topic="/mavros/local_position/odom", bad=lambda i: False):
        def make(i, t):
            six = np.zeros(36)
            six[0] = -1.0 if bad(i) else 0.1
            pose = {"position": xyz(np.sin(t), 0.0, -1.0 - 0.1 * np.sin(t)), "orientation": {"w": 1.0}}
            twist = {"linear": xyz(np.cos(t), 0.1 * t, 0.0), "angular": xyz(9.0, 9.0, 9.0)}
            return {"pose": {"pose": pose}, "twist": {"twist": twist, "covariance": six}}

        return self.add(topic, "nav_msgs/Odometry", make)

    def twist(self, topic, value=5.0):
        make = lambda i, t: {"twist": {"linear": xyz(value, t, t), "angular": xyz(t, t, t)}}  # noqa: E731
        return self.add(topic, "geometry_msgs/TwistStamped", make)

    def pressure(self, topic="/mavros/imu/static_pressure", scale=1.0):
        make = lambda i, t: {"fluid_pressure": scale * (101325.0 + 9806.65 * (2.0 + np.sin(t)))}  # noqa: E731
        return self.add(topic, "sensor_msgs/FluidPressure", make)

    def rel_alt(self, value=lambda t: -2.0 - np.sin(t)):
        make = lambda i, t: {"data": float(value(t))}  # noqa: E731
        return self.add("/mavros/global_position/rel_alt", "std_msgs/Float64", make)

    def outputs(self):
        make = lambda i, t: {"channels": np.r_[PULSES[2 * i], [0] * 8].astype(np.uint16)}  # noqa: E731
        return self.add("/mavros/rc/out", "mavros_msgs/RCOut", make, rate=5.0)

    def pilot(self, sticks, kind="OverrideRCIn", topic="/mavros/rc/override"):
        make = lambda i, t: {"channels": np.r_[sticks(t), [65535] * 12].astype(np.uint16)}  # noqa: E731
        return self.add(topic, f"mavros_msgs/{kind}", make)

    def state(self, armed, mode=lambda t: "MANUAL"):
        make = lambda i, t: {"connected": True, "armed": bool(armed(t)), "mode": mode(t)}  # noqa: E731
        return self.add("/mavros/state", "mavros_msgs/State", make)

    def dvl(self, topic="/dvl/data", valid=lambda i: True):
        make = lambda i, t: {  # noqa: E731
            "velocity": xyz(np.sin(t), -np.cos(t), -0.1) if valid(i) else xyz(0.56, 0.0, 0.0),
            "fom": 0.002 if i % 10 else 2.0,
            "velocity_valid": bool(valid(i)),
        }
        return self.add(topic, "waterlinked_a50_ros_driver/DVL", make)


@pytest.fixture(params=[1, 2], ids=["ROS 1", "ROS 2"])
def bag(request):
    return VehicleBag(request.param)


def one(path, **options):
    (trial,) = read_trials([path], vehicle=options.pop("vehicle", "bluerov2_heavy"), **options)
    return trial


def codes(trial):
    return [item.code for item in trial.findings]


def test_a_bag_of_mavros_needs_no_map(bag, tmp_path):
    """Outputs by the vehicle's frame, attitude and rates of the IMU, depth of rel_alt, velocity of the odometry; no
    set-point and no world velocity counts as a measurement, and unread messages are named with their count."""
    bag.outputs().imu().odom().rel_alt().pressure().state(lambda t: 2.0 < t < 8.0)
    bag.twist("/mavros/setpoint_velocity/cmd_vel").twist("/mavros/local_position/velocity_local").twist(
        "/cmd_vel"
    )
    bag.add("/mavros/vfr_hud", "mavros_msgs/VfrHud", lambda i, t: {"airspeed": 0.0})
    path = bag.write(tmp_path / "dive")
    trial = one(path)
    for i in range(8):
        np.testing.assert_array_equal(trial.series(f"pwm_T{i + 1}")[1], PULSES[::2, i])
    np.testing.assert_allclose(trial.series("qz")[1], np.sin(TIMES / 2), atol=1e-12)
    np.testing.assert_allclose(trial.series("p")[1], 0.1 * np.sin(TIMES), atol=1e-12)
    np.testing.assert_allclose(trial.series("u")[1], np.cos(TIMES), atol=1e-12)
    np.testing.assert_allclose(trial.series("x")[1], np.sin(TIMES), atol=1e-12)
    np.testing.assert_allclose(trial.series("depth")[1], 2.0 + np.sin(TIMES), atol=1e-12)
    assert "columns_left_out" in codes(trial) and "directions_assumed" in codes(trial)
    unread = str(trial.findings[-1])
    for topic in (
        "/cmd_vel",
        "/mavros/local_position/velocity_local",
        "/mavros/setpoint_velocity/cmd_vel",
        "/mavros/vfr_hud",
    ):
        assert f"{topic} (" in unread
    assert "/mavros/vfr_hud (mavros_msgs/VfrHud, 100 messages)" in unread
    (armed,) = read_trials([path], vehicle="bluerov2_heavy", split="arming")
    assert armed.duration == pytest.approx(5.8, abs=0.11)


@pytest.mark.parametrize("topic", ["/mavros/global_position/raw/fix", "/gnss/fix"])
def test_fixes_become_metres_from_the_first(bag, tmp_path, topic):
    """A path of 20 m north and 10 m east at 45° by the arcs of WGS 84; without a fix there is no position."""
    north, east = 20.0 * TIMES / TIMES[-1], 10.0 * np.sin(TIMES)
    lat = 45.0 + np.degrees(north / 6367381.8)  # radius of the meridian at 45°
    lon = 7.0 + np.degrees(east / (6388838.3 * np.cos(np.radians(45.0))))  # radius of the normal

    def make(i, t):
        lost = i % 7 == 3
        place = {} if lost else {"latitude": lat[i], "longitude": lon[i]}
        return {"status": {"status": -1 if lost else 0, "service": 1}, "altitude": 51.0, **place}

    trial = one(bag.imu().add(topic, "sensor_msgs/NavSatFix", make).write(tmp_path / "a"))
    good = np.arange(N) % 7 != 3
    np.testing.assert_allclose(trial.series("x")[1], (east - east[0])[good], atol=1e-3)
    np.testing.assert_allclose(trial.series("y")[1], north[good], atol=1e-3)
    (origin,) = [str(item) for item in trial.findings if item.code == "fix_origin"]
    assert "latitude 45.0000000, longitude 7.0000000" in origin


def test_parameters_of_the_autopilot_give_the_directions_of_the_motors(bag, tmp_path):
    """MOT_n_DIRECTION of /mavros/param replaces assumptions, and the pulses of a reversed motor are flipped."""
    vehicle = load_vehicle("bluerov2_heavy")
    usual = list(vehicle.autopilot.signs(8))
    signs = [-sign if i == 2 else sign for i, sign in enumerate(usual)]
    frame = next(n for n, (name, _) in FRAMES.items() if name == "VECTORED_6DOF")
    told = [("FRAME_CONFIG", frame), *((f"MOT_{i + 1}_DIRECTION", sign) for i, sign in enumerate(signs))]

    def make(i, t):
        name, value = told[i % len(told)]
        ros2 = {"type": 2, "integer_value": int(value)}
        return {"param_id": name, "value": {"integer": int(value)} if bag.kind == 1 else ros2}

    bag.imu().outputs()
    plain = one(bag.write(tmp_path / "plain"))
    topic, kind = ("param_value", "Param") if bag.kind == 1 else ("event", "ParamEvent")
    trial = one(bag.add(f"/mavros/param/{topic}", f"mavros_msgs/{kind}", make).write(tmp_path / "a"))
    assert "directions_assumed" in codes(plain) and "directions_assumed" not in codes(trial)
    for name in vehicle.thruster_names:
        sign = -1.0 if name == "T3" else 1.0
        pulses = trial.series(f"pwm_{name}")[1] - 1500.0
        np.testing.assert_allclose(pulses, sign * (plain.series(f"pwm_{name}")[1] - 1500.0))
    assert not any("param" in str(item) for item in trial.findings)


def test_without_a_vehicle_outputs_keep_their_numbers(tmp_path):
    trial = one(VehicleBag().outputs().imu().write(tmp_path / "a"), vehicle=None)
    assert {f"pwm_C{i}" for i in range(1, 9)} <= set(trial.channels) and "pwm_C9" not in trial.channels


def test_pressure_gives_the_depth_where_rel_alt_is_dead(tmp_path):
    """A constant column yields to one that varies; kilopascals are recognised by their size."""
    trial = one(VehicleBag().imu().rel_alt(lambda t: 0.0).pressure(scale=1e-3).write(tmp_path / "a"))
    density = load_vehicle("bluerov2_heavy").water.density
    np.testing.assert_allclose(
        trial.series("depth")[1],
        (2.0 + np.sin(TIMES)) * 9806.65 / (density * load_vehicle("bluerov2_heavy").water.gravity),
        rtol=1e-9,
    )
    assert {"stream_dead", "pressure_unit"} <= set(codes(trial))


def test_a_dead_sensor_loses_to_one_that_moves(tmp_path):
    """Of two IMUs of one kind, the one with zero rates throughout is dropped, with one sentence."""
    trial = one(VehicleBag().imu("/a/imu", scale=0.0).imu("/b/imu").write(tmp_path / "a"))
    np.testing.assert_allclose(trial.series("p")[1], 0.1 * np.sin(TIMES), atol=1e-12)
    (note,) = [item for item in trial.findings if item.code == "stream_dead"]
    assert note.values["topic"] == "/a/imu" and set(note.values["columns"]) == {
        "p",
        "q",
        "r",
        "ax",
        "ay",
        "az",
    }


@pytest.mark.parametrize("kind", ["OverrideRCIn", "RCIn"])
def test_pilots_channels_go_through_the_mixer_in_manual(tmp_path, kind):
    """Half forward, by ArduSub's own factors. Disarmed, nothing turns; other modes are dropped and counted."""
    forward, released = 1700.0, 65535.0
    sticks = lambda t: [1500, 1500, 1500, 1500, forward if t != 5.0 else released, 1500]  # noqa: E731
    bag = VehicleBag().imu().pilot(sticks, kind, "/mavros/rc/in" if kind == "RCIn" else "/mavros/rc/override")
    bag.state(lambda t: t >= 2.0, lambda t: "ALT_HOLD" if t >= 8.0 else "MANUAL")
    trial = one(bag.write(tmp_path / "a"))
    factors = np.array(dict(FRAMES.values())["VECTORED_6DOF"], float)[:, 4]
    for i, factor in enumerate(factors):
        t, pulse = trial.series(f"pwm_T{i + 1}")
        np.testing.assert_allclose(pulse[(t > 2.2) & (t < 7.8)], 1500.0 + 400.0 * 0.5 * factor, atol=1.0)
        np.testing.assert_allclose(pulse[t < 1.8], 1500.0)
        assert t.max() < 8.1
    assert "other_modes_left_out" in codes(trial) and "sticks_mixed" in codes(trial)


def test_messages_that_say_they_know_nothing_are_left_out(bag, tmp_path):
    """Covariances of -1 mark an IMU without rates, and velocities without a measurement."""
    bag.imu(known=(True, False, True)).odom(bad=lambda i: i % 4 == 0)
    trial = one(bag.write(tmp_path / "a"))
    np.testing.assert_allclose(trial.series("u")[1], np.cos(TIMES)[np.arange(N) % 4 != 0], atol=1e-12)
    assert trial.series("p")[1].max(initial=9.0) == 9.0  # those of the odometry, where it is valid
    assert {item.values["column"] for item in trial.findings if item.code == "invalid_left_out"} >= {
        "angular_velocity_covariance[0]",
        "twist.covariance[0]",
    }


def test_a_doppler_log_is_read_in_its_own_axes(bag, tmp_path):
    """Its axes are forward-right-down; without bottom lock, or with a figure of merit of 2 m/s, velocities
    are dropped."""
    trial = one(bag.dvl(valid=lambda i: i % 5 != 3).write(tmp_path / "a"))
    good = (np.arange(N) % 5 != 3) & (np.arange(N) % 10 != 0)
    t, u = trial.series("u")
    np.testing.assert_allclose(u, np.sin(TIMES)[good], atol=1e-12)
    np.testing.assert_allclose(trial.series("v")[1], np.cos(TIMES)[good], atol=1e-12)
    np.testing.assert_allclose(trial.series("w")[1], 0.1)
    invalid = {
        item.values["column"]: item.values["samples"] for item in trial.findings if "column" in item.values
    }
    assert invalid == {"velocity_valid": 20, "fom": 10}


def test_a_doppler_log_comes_before_the_estimate_of_the_autopilot(bag, tmp_path):
    """It is preferred, as position deltas in ArduSub logs are; the position is kept, and one line names the
    source."""
    trial = one(bag.odom().imu().dvl().write(tmp_path / "a"))
    np.testing.assert_allclose(trial.series("v")[1], np.cos(TIMES)[np.arange(N) % 10 != 0], atol=1e-12)
    assert "x" in trial.channels and {"velocity_at_sensor", "columns_left_out"} <= set(codes(trial))


def test_one_unusable_topic_does_not_refuse_a_bag(bag, tmp_path):
    """Tested with cut messages, and with a topic whose samples are all invalid."""
    bag.imu().dvl(valid=lambda i: False).odom()
    bag.pressure("/other/pressure")
    trial = one(bag.write(tmp_path / "a", broken=("/mavros/local_position/odom",)))
    assert trial.has("p", "depth") and "u" not in trial.channels
    texts = {item.values["topic"]: str(item) for item in trial.findings if item.code == "topic_unusable"}
    assert texts["/mavros/local_position/odom"].startswith(
        "100 messages of /mavros/local_position/odom cannot be read"
    )
    assert "no sample is valid" in texts["/dvl/data"]
    with pytest.raises(CalibrationError, match="cannot be read"):
        one(VehicleBag().odom().write(tmp_path / "b", broken=("/mavros/local_position/odom",)))


def test_a_topic_with_the_clock_of_another_computer_is_timed_by_receipt(tmp_path):
    """Its stamps count from the start of an autopilot, while others are Unix times."""
    bag = VehicleBag().imu().pressure()
    header = bag.header
    bag.header = lambda t: header(t - T0 + 100.0)
    bag.twist("/sensor/twist", 0.5)
    bag.header = header
    trial = one(bag.write(tmp_path / "a"))
    assert trial.duration < 11.0 and "other_clock" in codes(trial)
    np.testing.assert_allclose(trial.series("u")[0][0], 0.003, atol=1e-4)


def test_a_bag_without_definitions_of_mavros_is_read(tmp_path):
    """Recorders before ROS 2 Iron write no definitions; topics of an unknown type are skipped."""
    bag = VehicleBag().outputs().imu()
    bag.write(tmp_path / "old", version=8, storage=StoragePlugin.SQLITE3)
    trial = one(tmp_path / "old")
    np.testing.assert_array_equal(trial.series("pwm_T3")[1], PULSES[::2, 2])
