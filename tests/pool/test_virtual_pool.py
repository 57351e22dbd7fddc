"""The virtual pool as a robot sees it: through frames on the wire only."""

import numpy as np
import pytest

from finssim.core.rotations import quat_inverse_rotate, quat_rotate
from finssim.pool import VirtualPool, draw_plant, read_truth
from finssim.pool.plant import RPM
from finssim.pool.plant_spec import Instruments
from finssim.pool.virtual_pool import PoolClockError
from finssim.robot.links.frames import Decoder, encode_command
from finssim.robot.messages import ThrusterCommand
from finssim.vehicles import load_vehicle

FINSROV = load_vehicle("finsrov")
STILL = (0.0,) * 8


def command(normalised=STILL, enable=True):
    return encode_command(ThrusterCommand(enable, tuple(normalised)))


def driven(pool, duration, normalised=STILL, enable=True, rate=60.0):
    """Return the vehicle's messages while it is sent the same command at a rate."""
    decoder, messages = Decoder(), []
    start = pool.time
    for i in range(1, round(duration * rate) + 1):
        for _, frame in pool.exchange(start + i / rate, [command(normalised, enable)]).frames:
            messages += decoder.feed(frame)
    return messages


def forward(pool, force=2.0):
    """Return the command that gives each thruster, by the file's curve, its share of a surge force."""
    vehicle = pool.vehicle
    share = np.linalg.pinv(vehicle.thruster_matrix()) @ (force * np.eye(6)[0])
    normalised = np.zeros(vehicle.mcu.outputs)
    for thruster, f in zip(vehicle.thrusters.values(), share, strict=True):
        rpm = float(thruster.speed(f)) * 60.0 / (2.0 * np.pi)
        if abs(f) > 0.1:
            normalised[thruster.motor_index] = thruster.motor_sign * rpm / vehicle.mcu.rpm_full_scale
    return normalised


def test_telemetry_comes_at_the_rate_of_the_imu_without_a_gap():
    """100 frames a second arrive, numbered consecutively, each a few milliseconds old."""
    pool = VirtualPool(FINSROV, draw_plant(FINSROV, 1, "realistic"))
    messages = driven(pool, 2.0)
    assert 198 <= len(messages) <= 200
    assert np.all(np.diff([m.sequence for m in messages]) == 1)
    assert np.all(np.abs(np.diff([m.mcu_ms for m in messages]) - 10) <= 1)


def test_frames_arrive_after_they_are_sent_and_in_time():
    """Arrivals are sorted, no later than the exchange, and no earlier than the sample plus the IMU's latency."""
    pool = VirtualPool(FINSROV, draw_plant(FINSROV, 1, "realistic"))
    arrivals = []
    for i in range(1, 61):
        delivery = pool.exchange(i / 60)
        assert all(i / 60 - 1 / 60 - 0.012 < t <= i / 60 for t, _ in delivery.frames)
        arrivals += [t for t, _ in delivery.frames]
    assert arrivals == sorted(arrivals)
    age = np.mod(np.array(arrivals) - FINSROV.sensors.imu.latency, 0.01)
    assert age.min() >= 0.001 - 1e-9 and age.max() <= 0.003 + 1e-9


def test_a_commanded_vehicle_moves_and_an_idle_one_does_not():
    """Surge thrust moves it forward in its own axes; without a command nothing turns."""
    idle = VirtualPool(FINSROV, draw_plant(FINSROV, 0, "nominal"))
    driven(idle, 2.0)
    assert np.linalg.norm(idle.plant.position[:2]) < 1e-3
    pool = VirtualPool(FINSROV, draw_plant(FINSROV, 0, "nominal"))
    messages = driven(pool, 4.0, forward(pool))
    assert pool.plant.position[0] > 0.08
    assert max(abs(r) for r in messages[-1].motor_rpm) > 500.0


def test_equal_seeds_give_equal_frames_and_other_seeds_do_not():
    """All data that a robot receives repeat, byte by byte."""
    spec = draw_plant(FINSROV, 3, "realistic")

    def frames(seed):
        pool = VirtualPool(FINSROV, spec, seed=seed)
        return [f for i in range(1, 31) for f in pool.exchange(i / 60, [command()]).frames]

    assert frames(4) == frames(4) != frames(5)


def test_lengths_of_the_exchanges_do_not_change_the_world():
    """The same commands at the same times give the same motion, however often the robot exchanges."""
    ends = []
    for rate in (60, 240):
        pool = VirtualPool(FINSROV, draw_plant(FINSROV, 2, "realistic"))
        push = command(forward(pool))
        for i in range(1, 2 * rate + 1):
            pool.exchange(i / rate, [push] if (i - 1) % (rate // 20) == 0 else [])
        ends.append(np.concatenate((pool.plant.position, pool.plant.nu)).copy())
    assert np.array_equal(*ends)


def test_time_never_goes_back():
    """An exchange into the past is refused in one sentence."""
    pool = VirtualPool(FINSROV, draw_plant(FINSROV, 0, "nominal"))
    pool.exchange(0.1)
    with pytest.raises(PoolClockError, match="is in the past"):
        pool.exchange(0.05)
    with pytest.raises(PoolClockError):
        pool.exchange(float("nan"))


def test_a_camera_is_asked_for_every_interval_and_can_look_back():
    """Intervals join without a gap; a pose between two steps lies between their poses."""

    class Watcher:
        def __init__(self):
            self.intervals, self.poses = [], []

        def advance(self, t0, t1, pose_at):
            self.intervals.append((t0, t1))
            self.poses.append(pose_at(0.5 * (t0 + t1) - 0.004))
            return []

    camera = Watcher()
    pool = VirtualPool(FINSROV, draw_plant(FINSROV, 2, "realistic"), camera=camera, truth_period=0.005)
    driven(pool, 1.0, forward(pool, 10.0))
    ends = np.array(camera.intervals)
    assert ends[0, 0] == 0.0 and np.array_equal(ends[1:, 0], ends[:-1, 1])
    x = np.array([pose[0][0] for pose in camera.poses])
    assert np.all(np.diff(x[10:]) > 0.0)
    assert all(abs(np.linalg.norm(q) - 1.0) < 1e-6 for _, q in camera.poses)


def test_start_and_truth(tmp_path):
    """The vehicle starts at the given pose, and the truth file has every record, the first at time 0."""
    start = ((0.3, -0.2, -0.4), (0.0, 0.0, 0.6, 0.8))
    pool = VirtualPool(
        FINSROV,
        draw_plant(FINSROV, 1, "realistic"),
        start=start,
        truth=tmp_path / "a.truth",
        truth_period=0.02,
    )
    driven(pool, 1.0)
    pool.close()
    truth = read_truth(tmp_path / "a.truth")
    assert np.allclose(truth.time, 0.02 * np.arange(51))
    assert np.allclose(truth.position[0], start[0]) and np.allclose(truth.quaternion[0], start[1])
    assert np.allclose(truth.position[-1], pool.plant.position)
    assert truth.header["plant_seed"] == 1 and truth.header["thrusters"] == list(FINSROV.thruster_names)


def test_telemetry_is_the_truth_through_the_instruments():
    """In the IMU's axes (x back, y right): the body's angular rate, its tilt, and the depth of the port."""
    spec = draw_plant(FINSROV, 1, "nominal")
    pool = VirtualPool(FINSROV, spec.model_copy(update={"instruments": Instruments(noise=0.0)}))
    yaw = np.linalg.pinv(FINSROV.control_matrix) @ (1.0 * np.eye(6)[5])
    normalised = np.zeros(8)
    for thruster, f in zip(FINSROV.thrusters.values(), yaw, strict=True):
        rpm = float(thruster.speed(f)) / RPM
        normalised[thruster.motor_index] = thruster.motor_sign * rpm / 3000.0
    last = driven(pool, 4.0, normalised)[-1]
    q_bs = FINSROV.sensors.imu.orientation
    assert pool.plant.nu[5] > 0.5
    np.testing.assert_allclose(quat_rotate(q_bs, last.gyro), pool.plant.nu[3:], atol=0.02)
    up = quat_inverse_rotate(last.quaternion, (0.0, 0.0, 1.0))
    np.testing.assert_allclose(
        quat_rotate(q_bs, up), quat_inverse_rotate(pool.plant.quaternion, (0.0, 0.0, 1.0)), atol=0.02
    )
    assert last.depth == pytest.approx(-pool.plant.position[2] + 0.115, abs=0.005)
    rpm = np.array(last.motor_rpm)
    assert np.allclose(rpm, normalised * 3000.0, atol=50.0)


def test_faults_and_a_reboot_reach_the_robot():
    """Losses thin out telemetry, lost commands stop the motors, a reboot is 1.5 s of silence."""
    pool = VirtualPool(FINSROV, draw_plant(FINSROV, 1, "realistic"))
    pool.faults.drop = 0.5
    assert 30 <= len(driven(pool, 1.0)) <= 70
    pool.faults.drop = 0.0
    driven(pool, 1.0, forward(pool))
    pool.faults.drop_commands = 1.0
    driven(pool, 0.7, forward(pool))
    assert not pool.firmware.target.any()
    pool.faults.drop_commands = 0.0
    pool.reboot()
    pool.exchange(pool.time + 0.01)  # frames in transit still arrive
    assert driven(pool, 1.4) == []
    again = driven(pool, 0.5)
    assert again[0].sequence == 1 and again[0].mcu_ms < 50


def test_an_hour_costs_no_memory_of_its_own():
    """Memory does not grow with time: queues and poses keep the size that they have after a second."""
    pool = VirtualPool(FINSROV, draw_plant(FINSROV, 1, "realistic"))
    driven(pool, 2.0)
    sizes = len(pool._up), len(pool._down), len(pool._poses)
    driven(pool, 5.0)
    assert max(len(pool._up), len(pool._down)) <= 2 and len(pool._poses) == sizes[2]
