"""Tank and open water instead of the pool, and position fixes on the wire."""

import math

import numpy as np
import pytest

from finssim.pool.camera import PoolCamera, camera_of
from finssim.pool.drawn_plant import OPEN, draw_plant, positioning_of, site_of
from finssim.pool.plan import make_plan
from finssim.pool.plant_spec import PlantSpec, PlantSpecError, load_plant_spec
from finssim.pool.positioning import POSITIONING, Positioning
from finssim.pool.run import SiteChoice
from finssim.pool.virtual_pool import VirtualPool
from finssim.robot.links.frames import Decoder
from finssim.robot.messages import HEADING, POSE, POSITION, VELOCITY, NavigationAid
from finssim.vehicles import load_vehicle
from finssim.vehicles.defaults import SITES, vehicle_at
from studies.open_water import swim, way_of

HEAVY = load_vehicle("bluerov2_heavy")


def still(time):
    return np.array([3.0, -2.0, -5.0]), np.array([0.0, 0.0, math.sin(0.25), math.cos(0.25)])


def test_open_water_has_no_walls_in_reach_but_a_stream_waves_and_a_vehicle_that_navigates():
    """The body is the one drawn for the pool, and the plant's file contains all of it."""
    spec = draw_plant(HEAVY, 1, "realistic")
    open_, there = site_of("open-water", spec), vehicle_at("open-water", HEAVY)
    assert open_.body == spec.body and open_.basin == OPEN and open_.tether is None
    assert (
        math.hypot(*open_.circulation.stream[:2]) == pytest.approx(0.1) and len(open_.circulation.waves) == 3
    )
    assert PlantSpec.model_validate(open_.model_dump(mode="json")) == open_
    assert there.sensors.dvl is not None and there.sensors.compass is not None and HEAVY.sensors.dvl is None
    assert there.safety.workspace_lower[2] == -OPEN.depth
    assert site_of("pool", spec) is spec and vehicle_at("pool", HEAVY) is HEAVY
    assert site_of("tank", spec).basin.depth == 5.0


def test_sites_and_systems_that_do_not_exist_are_refused():
    """The refusal lists what exists; a camera over open water and a vehicle too large for the tank are
    refused too."""
    spec = draw_plant(HEAVY, 1, "nominal")
    with pytest.raises(PlantSpecError, match=", ".join(SITES)):
        site_of("pond", spec)
    with pytest.raises(PlantSpecError, match="none, motion-capture, usbl"):
        positioning_of("gps", 1)
    with pytest.raises(PlantSpecError, match="open water has no overhead camera"):
        make_plan("bluerov2_heavy", "1", "nominal", camera="corners", site="open-water")
    with pytest.raises(PlantSpecError, match="choose open-water"):
        site_of("tank", draw_plant(load_vehicle("rexrov"), 1, "nominal"))
    assert make_plan("rexrov", "1", "nominal", camera="none", site="open-water").spec.basin == OPEN


@pytest.mark.parametrize("name", ["finsrov", "bluerov2_heavy"])
def test_the_camera_over_the_tank_finds_the_vehicle_down_to_the_floor(name):
    """It hangs three times as high as over the pool, with proportionally more pixels; the pool's camera is
    the paper's."""
    vehicle = load_vehicle(name)
    basin = site_of("tank", draw_plant(vehicle, 1, "realistic")).basin
    true, _, settings = camera_of(vehicle, 1, "realistic", basin=basin)
    assert camera_of(vehicle, 1)[0].camera.lens.width == 1280
    camera = PoolCamera(vehicle, true, mode="corners", settings=settings, seed=1)
    for t, place in enumerate(((0.0, 0.0, -0.5), (3.0, -2.0, -2.5), (0.0, 0.0, -4.7))):
        pose = np.array(place), np.array([0.0, 0.0, 0.0, 1.0])
        pictures = camera.advance(t, t + 1.0, lambda time, pose=pose: pose)
        assert np.mean([len(picture.tags) > 0 for picture in pictures]) > 0.8, place


@pytest.mark.parametrize(("name", "kind"), [("motion-capture", POSE), ("usbl", POSITION)])
def test_fixes_come_at_their_rate_late_and_with_their_noise(name, kind):
    """Checked over many fixes of a vehicle at rest; outliers are as frequent as specified."""
    s, system = POSITIONING[name], Positioning(POSITIONING[name], 3)
    duration = 1000.0 / s.rate
    frames = [
        f for k in range(100) for f in system.advance(k * duration / 100, (k + 1) * duration / 100, still)
    ]
    aids = [aid for _, data in frames for aid in Decoder().feed(data)]
    assert len(aids) == len(frames) == pytest.approx(1000 * (1.0 - s.dropout), rel=0.05)
    assert all(isinstance(aid, NavigationAid) and aid.kind == kind for aid in aids)
    assert np.mean([aid.age for aid in aids]) == pytest.approx(s.latency, rel=0.1)
    error = np.array([aid.values[:2] for aid in aids]) - [3.0, -2.0]
    wrong = np.abs(error).max(axis=1) > 5.0 * s.std
    assert wrong.mean() == pytest.approx(s.outliers, abs=0.03)
    assert error[~wrong].std() == pytest.approx(s.std, rel=0.1)
    if kind == POSE:
        assert np.mean([aid.values[2] for aid in aids]) == pytest.approx(0.5, abs=0.01)


def test_log_and_compass_speak_on_the_wire_of_the_motor_controller():
    """They come at their rates, with the stream's velocity over the floor of a drifting vehicle; without
    them, no frame."""
    # Neutral, because a tilted vehicle that rises has a part of that velocity in its own axes.
    neutral = HEAVY.replace({"body.displaced_volume": 0.0135})
    spec = site_of("open-water", draw_plant(neutral, 1, "realistic"))
    for vehicle, expected in ((vehicle_at("open-water", neutral), True), (neutral, False)):
        world = VirtualPool(vehicle, spec, start=((0.0, 0.0, -5.0), (0.0, 0.0, 0.0, 1.0)), seed=2)
        frames = world.exchange(20.0).frames
        aids = [
            m for _, data in frames for m in Decoder(outputs=8).feed(data) if isinstance(m, NavigationAid)
        ]
        assert bool(aids) is expected
        if not expected:
            continue
        log = np.array([aid.values for aid in aids if aid.kind == VELOCITY])
        assert len(log) == pytest.approx(160, rel=0.05)
        assert sum(aid.kind == HEADING for aid in aids) == pytest.approx(400, rel=0.05)
        # Starting from rest it needs a while: after 20 s it moves with the stream.
        np.testing.assert_allclose(np.linalg.norm(log[-20:, :2].mean(axis=0)), 0.1, atol=0.03)
        np.testing.assert_allclose(log[-1, :2], world.plant.nu[:2], atol=0.04)


@pytest.mark.slow
@pytest.mark.parametrize("positioning", ["none", "usbl"])
def test_a_vehicle_finds_its_way_in_open_water(positioning):
    """For 12 s through stream and waves it stays near the path, with an error within its own uncertainty."""
    told = swim(HEAVY, way_of("line", 12.0, 0.3), plant=2, positioning=positioning, seed=2)
    assert told["fault"] == "" and told["way_m"] == pytest.approx(3.6, abs=0.5)
    assert told["drift_m"] < 0.25 and told["off_m"] < 0.5 and told["nees"] < 13.8


def test_ways_keep_their_speed():
    """A square of 10 m is finished; a line lasts as long as its length requires."""
    for shape in ("line", "square"):
        way = way_of(shape, 100.0, 0.3)
        speed = np.linalg.norm(way.at(np.linspace(0.1, way.duration - 0.1, 333)).velocity, axis=1)
        np.testing.assert_allclose(speed, 0.3)
    assert way_of("square", 100.0, 0.3).duration == pytest.approx(40.0 / 0.3)
    with pytest.raises(ValueError, match="line, square"):
        way_of("spiral", 1.0, 0.3)


def test_a_water_file_adds_to_the_site(tmp_path):
    """A passive vehicle in open water drifts with the profile at its depth, and a plant file keeps the water."""
    (tmp_path / "p.csv").write_text("depth,east,north\n0,0.3,0\n8,0.0,0.3\n", encoding="utf-8")
    (tmp_path / "water.yaml").write_text(
        "current: p.csv\nwaves: {spectrum: jonswap, height: 0.05, period: 3.0}\n"
    )
    choice = SiteChoice(
        site="open-water", severity="nominal", water=tmp_path / "water.yaml", start="0,0,-4,0"
    )
    plan, start = choice.plan()
    water = plan.spec.circulation.water
    assert water.profile.depths == (0.0, 8.0)
    world = plan.world(None, start=start, seed=1, truth=None)
    world.exchange(60.0, ())
    x, y, _ = world.plant.position
    assert 3.0 < x < 10.0 and 3.0 < y < 10.0
    world.close()
    plan.spec.write(tmp_path / "plant.yaml")
    assert load_plant_spec(tmp_path / "plant.yaml").circulation.water == water
