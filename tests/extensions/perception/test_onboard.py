"""The vehicle's own cameras, sonars and altimeters in the virtual site: rate, latency, losses and transport."""

import subprocess
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("newton", reason="finssim[perception] is not installed")

from finssim.core.rotations import quat_from_yaw
from finssim.extensions.perception.onboard import OnboardSensors
from finssim.pool.plan import make_plan
from finssim.pool.plant_spec import PlantSpecError
from finssim.pool.run import Ends, SiteChoice, run
from finssim.pool.servers import LockstepServer
from finssim.robot.goals import station_of
from finssim.robot.links.frames import encode_command
from finssim.robot.lockstep import LockstepClient
from finssim.robot.messages import ThrusterCommand
from finssim.vehicles import load_vehicle

WALL = """
about: A wall 3 m ahead, 4 m of water over a floor.
water: {attenuation: [0.1, 0.1, 0.1], veil: [0.1, 0.1, 0.1], daylight_attenuation: [0.1, 0.1, 0.1]}
seabed: {depth: 4.0}
objects:
  wall: {shape: box, position: [3.5, 0, -2], size: [1, 20, 8]}
viewpoint: {position: [0, 0, -2]}
"""
VEHICLE = load_vehicle("finsrov")
STILL = np.array([0.0, 0.0, -2.0]), quat_from_yaw(0.0)


@pytest.fixture(scope="module")
def wall(tmp_path_factory):
    """World file of a wall."""
    path = tmp_path_factory.mktemp("world") / "wall.yaml"
    path.write_text(WALL, encoding="utf-8")
    return str(path)


def counted(pictures):
    """Count the pictures of each source."""
    names = [picture.source for picture in pictures]
    return {name: names.count(name) for name in names}


def test_readings_come_at_their_rate_as_late_as_the_file_says(wall):
    """In 10 s, readings of a camera, a sonar and an altimeter arrive at their rates with their latencies.

    The camera has 10 Hz, 0.1 s and 1 % losses, the sonar 5 Hz, the altimeter 10 Hz and 0.05 s.
    """
    sensors = OnboardSensors(VEHICLE, wall, seed=1)
    pictures = sensors.advance(0.0, 10.0, lambda t: STILL)
    assert counted(pictures)["sonar"] == 49 and counted(pictures)["altimeter"] == 99
    assert 93 <= counted(pictures)["front_camera"] <= 99
    for picture in pictures:
        entry = VEHICLE.perception[picture.source]
        taken = (picture.time - entry.latency) * entry.rate
        assert taken == pytest.approx(picture.sequence + 1, abs=1e-9)


def test_a_reading_is_of_the_place_at_its_exposure(wall):
    """With a vehicle that sinks at 0.1 m/s, the altimeter's range is that of 0.05 s before its arrival."""
    sensors = OnboardSensors(VEHICLE, wall, names=["altimeter"])

    def sinking(t):
        return np.array([0.0, 0.0, -1.0 - 0.1 * t]), STILL[1]

    arrived = [p for k in range(60) for p in sensors.advance(k / 60, (k + 1) / 60, sinking)]
    under = VEHICLE.perception["altimeter"].position[2]
    for picture in arrived:
        true = 4.0 - 1.0 - 0.1 * (picture.time - 0.05) + under
        assert picture.ranges[0] == pytest.approx(true, rel=0.02)  # noise of 0.5 %


def test_equal_seeds_see_the_same_and_others_do_not(wall):
    """Equal seeds give bit-identical readings for any lengths of the steps; other seeds do not."""
    once, twice, other = (
        _in_steps(OnboardSensors(VEHICLE, wall, seed=seed), n) for seed, n in ((3, 1), (3, 50), (4, 1))
    )
    key = lambda p: (p.source, p.sequence)  # noqa: E731
    for a, b in zip(sorted(once, key=key), sorted(twice, key=key), strict=True):
        assert key(a) == key(b) and np.array_equal(a.image, b.image) and np.array_equal(a.ranges, b.ranges)
    first, second = (next(p for p in found if p.source == "front_camera") for found in (once, other))
    assert not np.array_equal(first.image, second.image)


def _in_steps(sensors, n):
    return [p for k in range(n) for p in sensors.advance(k / n, (k + 1) / n, lambda t: STILL)]


def test_the_site_takes_the_size_of_its_world(wall):
    """The site is open water down to the seabed, or a basin with its walls; an explicit site stays unchanged."""
    for world, size in (("gate", (16.0, 10.0, 3.2)), (wall, (2000.0, 2000.0, 4.0))):
        basin = make_plan("finsrov", "1", "nominal", camera="none", world=world).spec.basin
        assert (basin.length, basin.width, basin.depth) == size
    pool = make_plan("finsrov", "1", "nominal", camera="corners", world=wall, site="pool")
    assert pool.spec.basin == make_plan("finsrov", "1", "nominal", camera="corners").spec.basin
    assert make_plan("finsrov", "1", "nominal", camera="none", world=wall).vehicle.sensors.dvl is not None


def test_own_sensors_and_the_overhead_camera_go_one_way(wall):
    """In lock-step over TCP, tag corners arrive without a name and readings with theirs, equal to local ones."""
    plan = make_plan("finsrov", "1", "nominal", camera="corners", world=wall, site="pool", seed=5)
    begin = station_of("0,0,-0.5,0")
    here, there = (plan.standing(begin, seed=5) for _ in range(2))
    server = LockstepServer(("127.0.0.1", 0))
    serving = threading.Thread(target=server.serve, args=(there,), daemon=True)
    serving.start()
    with LockstepClient(f"127.0.0.1:{server.address[1]}") as client:
        for k in range(1, 31):
            a, b = here.exchange(k / 60), client.exchange(k / 60, ())
            for p, q in zip(a.pictures, b.pictures, strict=True):
                assert (p.source, p.time, len(p.tags)) == (q.source, q.time, len(q.tags))
                assert p.source == "" or np.array_equal(p.image, q.image)
                assert p.ranges is None or np.array_equal(p.ranges, q.ranges)
    serving.join(timeout=10.0)
    here.close(), there.close()


def test_the_hull_meets_the_things_of_the_world(wall):
    """In 5 s ahead, the nose stops at the wall 3 m away, within the penalty's 5 cm; a wall without contact is
    passed."""
    plan = make_plan("finsrov", "1", "nominal", camera="none", world=wall)
    nose = 0.5 * VEHICLE.body.size[0]
    ends = []
    for solid in (True, False):
        made = replace(plan, onboard=replace(plan.onboard, solid=solid))
        pool = made.world(None, start=station_of("2.6,0,-2,0"), seed=0, truth=None)
        for k in range(1, 301):
            sent = [encode_command(ThrusterCommand(True, (-0.6, -0.6, 0.0, 0.0, 0.0, -0.6, 0.6, 0.0)))]
            pool.exchange(k / 60, sent)
        ends.append(float(pool.plant.position[0]) + nose)
        pool.close()
    assert 2.8 < ends[0] < 3.05 < 3.3 < ends[1]


def test_a_team_has_no_world():
    """A world supports a single vehicle only."""
    with pytest.raises(PlantSpecError, match="--world out"):
        run(SiteChoice(world="dock"), Ends(), team="finsrov,finsrov")


@pytest.mark.slow
def test_a_pool_without_a_world_leaves_newton_alone():
    """Starting a pool without a world does not import Newton."""
    script = (
        "import sys; from finssim.pool.run import make_plan; "
        "make_plan('finsrov', '1', 'nominal', camera='none'); sys.exit('newton' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", script], timeout=120).returncode == 0
