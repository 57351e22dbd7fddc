"""Live sources advance, recorded ones can be read at any time, and every option has an effect."""

import json
import math

import numpy as np
import pytest

from finssim.extensions.perception import WorldLayout
from finssim.extensions.viewer.app import draw_own
from finssim.extensions.viewer.frame import ViewError
from finssim.extensions.viewer.run import SourceChoice, open_source
from finssim.extensions.viewer.sources import PoolSource, RunSource, SimulatorSource
from finssim.robot.messages import Picture as Seen
from finssim.robot.reading import Reading
from finssim.robot.recorder import Recorder as RecordWriter
from finssim.sim import Simulator
from finssim.sim.recorder import StateRecorder
from finssim.vehicles import VehicleError, load_vehicle


def test_the_pool_lives_and_the_robot_in_it_goes_to_the_goal():
    """Truth and estimate are shown close together and approach the goal; equal seeds begin alike."""
    source = open_source(SourceChoice(source="pool", goal="0.5,0.2,-0.6,20"))
    first = source.frame(0.1)
    assert math.isinf(source.duration) and first.time == pytest.approx(0.1)
    frame = source.frame(6.0)
    assert frame.status["bridge"] == "armed" and np.abs(frame.force).max() > 0.0
    assert np.linalg.norm(frame.truth.position - frame.estimate.position) < 0.05
    start, now = (np.linalg.norm(f.truth.position - frame.goal.position) for f in (first, frame))
    assert now < 0.5 * start
    assert {tag.tag_id for tag in frame.picture.tags} <= set(source.stage.vehicle.tags.mounts)
    assert len(frame.trail) > 20 and source.curves()[0].value[-1] == pytest.approx(now, abs=0.02)
    twin = open_source(SourceChoice(source="pool", goal="0.5,0.2,-0.6,20"))
    assert np.array_equal(twin.frame(0.1).force, first.force)
    source.close()


@pytest.mark.slow
def test_the_pool_is_the_one_that_was_asked_for():
    """Plant, severity, policy, trajectory and vehicle are those requested."""
    plain = open_source(SourceChoice(trajectory="ellipse", camera="pictures"))
    assert isinstance(plain, PoolSource) and "realistic plant 1: pid, ellipse" in plain.stage.title
    assert len(plain.stage.path) > 100 and plain.frame(0.3).picture.image.shape == (720, 1280)
    other = open_source(SourceChoice(plant="3", severity="hard", policy="pid-paper", task="t2"))
    assert "hard plant 3: pid-paper, ellipse" in other.stage.title


def test_the_simulator_is_a_source(tmp_path):
    """The simulator holds a station from its true state, in the requested model."""
    source = open_source(SourceChoice(source="sim", goal="0.3,0.1,-0.6,30"))
    assert isinstance(source, SimulatorSource)
    frame = source.frame(10.0)
    assert frame.estimate is None and np.linalg.norm(frame.truth.position - [0.3, 0.1, -0.6]) < 0.1
    other = open_source(SourceChoice(source="sim", goal="0.3,0.1,-0.6,30", hydrodynamics="simplified"))
    assert not np.allclose(other.frame(2.0).truth.position, source.frame(2.0).truth.position)


def test_a_run_of_the_engine_is_a_source(tmp_path):
    """The recorded pose of the chosen world is shown at its time."""
    simulator = Simulator("finsrov", worlds=2)
    with StateRecorder(simulator, tmp_path / "run") as recorder:
        simulator.set_thrust(np.stack([np.full((1, 8), 1.0), np.full((1, 8), -2.0)]))
        for _ in range(30):
            simulator.step()
            recorder.record()
    source = open_source(SourceChoice(source=str(tmp_path / "run"), world="1"))
    assert isinstance(source, RunSource) and source.duration == pytest.approx(2.9)
    assert source.frame(2.9).truth.position == pytest.approx(simulator.numpy("position")[1, 0], abs=1e-6)
    assert source.frame(2.9).force == pytest.approx(simulator.numpy("thrust")[1, 0], abs=1e-5)
    with pytest.raises(ViewError, match="world 7 was not recorded; it has 0, 1"):
        RunSource(tmp_path / "run", world=7)


@pytest.mark.parametrize("name", ["{}/mine", "../mine", "mine.yaml", "mine"])
def test_the_vehicle_that_a_run_names_is_of_the_catalogue(tmp_path, monkeypatch, name):
    """The catalogue's vehicle is used, not a file of the same name."""
    (tmp_path / "mine.yaml").write_text("extends: finsrov\n", encoding="utf-8")
    simulator = Simulator("finsrov")
    with StateRecorder(simulator, tmp_path / "run") as recorder:
        recorder.record()
    about = json.loads((tmp_path / "run" / "_run.json").read_text(encoding="utf-8"))
    about["vehicles"][0]["name"] = name.format(tmp_path)
    (tmp_path / "run" / "_run.json").write_text(json.dumps(about), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(VehicleError, match="_run.json: (vehicle '.*' has a separator|unknown vehicle 'mine)"):
        RunSource(tmp_path / "run")
    assert RunSource(tmp_path / "run", vehicle="finsrov").stage.vehicle.name == "finsrov"


@pytest.mark.parametrize(
    ("choice", "sentence"),
    [
        (SourceChoice(source="nowhere.mcap"), "no such file or folder"),
        (SourceChoice(source="sim", plant="3"), "--plant is for pool, not for a sim"),
        (SourceChoice(source="pool", basin="4,2,1"), "--basin is for record, not for a pool"),
        (SourceChoice(source="pool", goal="5,0,-0.5,0"), "outside the workspace"),
        (SourceChoice(source="pool", camera="none"), "camera"),
    ],
)
def test_what_cannot_be_shown_is_refused_in_a_sentence(choice, sentence):
    """The message states what to do instead."""
    with pytest.raises(ValueError, match=sentence):
        open_source(choice)


@pytest.mark.slow
@pytest.mark.parametrize("basin", ["4,2", "4,2,0", "a,b,c"])
def test_a_pool_has_three_lengths(trial, basin):
    """A pool needs length, width and depth above zero."""
    with pytest.raises(ViewError, match=r"expected length,width,depth"):
        open_source(SourceChoice(source=str(trial.record), basin=basin))


def test_a_record_may_be_shown_with_another_vehicle(trial):
    """--vehicle overrides the vehicle of the record."""
    assert open_source(SourceChoice(source=str(trial.record))).stage.vehicle.name == "finsrov"
    other = open_source(SourceChoice(source=str(trial.record), vehicle="bluerov2_heavy"))
    assert other.stage.vehicle.name == load_vehicle("bluerov2_heavy").name


def test_a_world_is_seen_heard_and_drawn():
    """In a pool with a world, objects stand where they were drawn; pictures, a sonar fan and ranges are
    shown."""
    pytest.importorskip("newton", reason="finssim[perception] is not installed")
    source = open_source(SourceChoice(source="pool", world="dock", seed=3))
    layout = WorldLayout("dock")
    layout.draw(3)
    back = next(body for body in source.stage.bodies if body.name == "back")
    assert back.vertices.mean(axis=0) == pytest.approx(layout.poses("back")[0, :3], abs=1e-5)
    rails = next(body for body in source.stage.bodies if body.name == "rails_upper")
    assert np.ptp(rails.vertices, axis=0).max() > 0.9 and len(rails.faces) > 150  # two of them
    frame = source.frame(2.0)
    assert frame.status["bridge"] == "armed" and frame.status["altimeter"].endswith(" m")
    assert frame.pictures["front_camera"].shape[2] == 3 and frame.pictures["sonar"].shape[0] == 400
    assert list(source.stage.eyes) == ["front_camera", "sonar"]
    for image in frame.pictures.values():
        drawn = draw_own(image)
        assert drawn.shape[1] >= 480 and drawn.shape[2] == 3
    source.close()


def test_a_record_shows_own_sensors_and_the_world_that_is_named(tmp_path):
    """Colour pictures, sonar fans and ranges of a record are shown until they are outdated."""
    vehicle, path = load_vehicle("finsrov"), tmp_path / "run.mcap"
    image = np.zeros((36, 64, 3), np.uint8)
    image[..., 0] = 200
    with RecordWriter(path, vehicle, {}) as recorder:
        for k in range(40):
            t = 0.1 * k
            place = np.array([0.0, 0.0, -2.0])
            recorder.reading(t, Reading(t, place, np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(6), True))
            if k < 10:
                recorder.picture(t, Seen(t, k, image, source="front_camera"))
                recorder.picture(t, Seen(t, k, image[..., 0], source="sonar"))
                recorder.picture(t, Seen(t, k, source="altimeter", ranges=np.array([2.5], np.float32)))
    source = open_source(SourceChoice(source=str(path), world="gate", seed=1))
    frame = source.frame(0.8)
    assert np.abs(frame.pictures["front_camera"].astype(int) - image).max() < 6
    assert frame.pictures["sonar"].ndim == 2 and frame.status["altimeter"] == "2.50 m"
    assert not source.frame(3.5).pictures and "altimeter" not in source.frame(3.5).status
    assert {body.name for body in source.stage.bodies} >= {"near_left", "buoy_0"}
    assert source.stage.lower.tolist() == [-8.0, -5.0, -3.2]
    with pytest.raises(ViewError, match="--world dock: expected the number of a world"):
        open_source(SourceChoice(source=str(tmp_path), world="dock"))
