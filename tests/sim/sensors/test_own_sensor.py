"""A sensor that the package does not know: one file with its schema and what it measures, and one line."""
# mypy: disable-error-code="valid-type,misc,index,no-any-return,no-untyped-def,untyped-decorator"

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import warp as wp

from finssim.core.registry import RegistryError
from finssim.physics.types import vec6
from finssim.sim.sensors import SensorError, SensorSuite, add_sensor
from finssim.vehicles import VehicleError, load_vehicle
from reference.examples import EXAMPLES, example
from reference.installed import install

PingerBatch = add_sensor(example("own/sensor/pinger").PingerBatch)
SOURCE = Path(__file__).parents[3] / "src"

FILE = """
extends: bluerov2
sensors:
  pinger:
    origin: measured
    rate: 5.0
    position: [0.0, 0.0, 0.0]
    noise_std: 0.2
"""


@pytest.fixture(autouse=True)
def known():
    """The one line; the next test may say it again."""
    assert add_sensor(PingerBatch) is PingerBatch


def state(worlds):
    full = lambda value, dtype: wp.full((worlds, 1), value=value, dtype=dtype, device="cpu")  # noqa: E731
    return SimpleNamespace(
        position=full(wp.vec3(3.0, 0.0, -4.0), wp.vec3), quaternion=full(wp.quat(0.0, 0.0, 0.0, 1.0), wp.quat),
        velocity=full(vec6(), vec6), acceleration=full(vec6(), vec6),
        steps=wp.zeros(worlds, dtype=int, device="cpu"), episode=wp.zeros(worlds, dtype=int, device="cpu"),
    )  # fmt: skip


def test_a_vehicle_file_may_have_it_and_a_suite_samples_it(tmp_path):
    """Ranges of 5 m with the file's noise, at the file's rate, beside the sensors of the catalogue's vehicle."""
    (tmp_path / "mine.yaml").write_text(FILE, encoding="utf-8")
    vehicle = load_vehicle(tmp_path / "mine.yaml")
    assert vehicle.sensors.pinger.noise_std == 0.2 and vehicle.sensors.imu is not None
    assert vehicle.origin_of("sensors.pinger.noise_std").origin == "measured"
    again = vehicle.replace({"sensors.pinger.noise_std": 0.1})
    assert again.sensors.pinger.noise_std == 0.1 and again.sha256 != vehicle.sha256
    suite, now = SensorSuite(vehicle, worlds=2000, control_step=0.1, seed=1), state(2000)
    suite.reset(now)
    read = suite.by_name["pinger"].numpy()["range"][:, 0]
    assert abs(read.mean() - 5.0) < 0.03 and read.std() == pytest.approx(0.2, rel=0.1)
    fresh = []
    for _ in range(4):
        now.steps.assign(now.steps.numpy() + 1)
        suite.update(now)
        fresh.append(bool(suite.by_name["pinger"].fresh.numpy()[0, 0]))
    assert fresh == [False, True, False, True]
    assert "pinger" not in SensorSuite(load_vehicle("bluerov2"), worlds=1, control_step=0.1).by_name


def test_mistakes_in_its_section_are_refused_in_one_sentence(tmp_path):
    """A key that it does not have, a number that it may not be, kinds and names that do not exist."""
    named = FILE.replace("  pinger:", "  front:\n    kind: pinger")
    for text, sentence in (
        (
            FILE.replace("noise_std: 0.2", "noise_std: -1.0"),
            "bad.yaml: sensors: pinger: noise_std is -1.0, expected",
        ),
        (FILE.replace("noise_std: 0.2", "noise: 1.0"), "bad.yaml: sensors: pinger: unknown key 'noise'"),
        (FILE.replace("pinger", "pingre"), "unknown key 'pingre', did you mean 'pinger'"),
        (named.replace("kind: pinger", "kind: pingre"), "front: kind is 'pingre', did you mean 'pinger'"),
        (named.replace("front", "Front"), "'Front' cannot be the name of a sensor"),
        (named.replace("front", "camera"), "'camera' cannot be the name of a sensor"),
        (named.replace("front", "depth"), "unknown key 'kind'"),
    ):
        (tmp_path / "bad.yaml").write_text(text, encoding="utf-8")
        with pytest.raises(VehicleError, match=sentence):
            load_vehicle(tmp_path / "bad.yaml")
    (tmp_path / "good.yaml").write_text(named, encoding="utf-8")
    assert load_vehicle(tmp_path / "good.yaml").sensors.kind_of("front") == "pinger"


def test_a_camera_may_not_have_its_name(tmp_path):
    """Names of sensors are those of frames and topics, so each is given once."""
    camera = "perception:\n  pinger: {origin: guessed, device: altimeter, rate: 1.0, position: [0, 0, 0]}\n"
    (tmp_path / "bad.yaml").write_text(FILE + camera, encoding="utf-8")
    with pytest.raises(VehicleError, match="'pinger' is already used by another part"):
        load_vehicle(tmp_path / "bad.yaml")


def test_one_name_is_of_one_kind_in_a_suite():
    """Two vehicles of one world whose sensors share a name share its kind."""
    mount = {"rate": 1.0, "position": [0.0, 0.0, 0.0], "noise_std": 0.1}
    one, other = (
        load_vehicle("bluerov2").replace({"sensors.front": {"kind": kind, **mount}})
        for kind in ("pinger", "depth")
    )
    with pytest.raises(SensorError, match="sensor 'front' of bluerov2 is of the kind depth"):
        SensorSuite([one, other], worlds=1, control_step=0.1)


def test_a_kind_is_taken_once_and_needs_a_schema():
    """Another class of the same kind, and one without a schema."""
    with pytest.raises(RegistryError, match="already"):
        add_sensor(type("Other", (PingerBatch,), {}))
    with pytest.raises(SensorError, match="has no schema"):
        add_sensor(type("Bare", (PingerBatch,), {"schema": None, "kind": "bare"}))


COMMANDS = """
import sys
from finssim.cli import boundary
from finssim.cli.commands import app

for line in sys.argv[1:]:
    if status := boundary.run(app, line.split()):
        sys.exit(status)
"""


@pytest.mark.slow
def test_commands_accept_a_vehicle_file_with_the_sensor_of_a_package(tmp_path, monkeypatch):
    """Show, simulate and train, in a process of their own; without the package, in another one, one sentence."""
    source = (EXAMPLES / "own/sensor/pinger.py").read_text(encoding="utf-8")
    install(tmp_path, monkeypatch, "acoustics", source, {"sensors": {"pinger": "acoustics:PingerBatch"}})
    (tmp_path / "mine.yaml").write_text(FILE, encoding="utf-8")

    def run(*lines, path=(str(tmp_path / "site_acoustics"),)):
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([*path, str(SOURCE)])}
        return subprocess.run(
            [sys.executable, "-c", COMMANDS, *lines], capture_output=True, text=True, env=environment, cwd=tmp_path,
            timeout=600,
        )  # fmt: skip

    small = "--steps 64 --worlds 8 --set rollout=8 --set batch=32"
    done = run(
        "vehicles show mine.yaml",
        "simulate --vehicle mine.yaml --command surge=5 --duration 1 --out run.csv",
        f"train t1 --vehicle mine.yaml {small} --out policy",
    )
    assert done.returncode == 0 and "pinger" in done.stdout, done.stderr
    assert (tmp_path / "run.csv").is_file() and (tmp_path / "policy" / "policy.onnx").is_file()
    refused = run("vehicles show mine.yaml", path=())
    assert refused.returncode == 2 and "unknown key 'pinger'" in refused.stderr


@pytest.mark.slow
def test_the_example_reads_both_ranges():
    """It prints the distances of two mounts from (3, 0, -4) m, and is the code of the page."""
    run = subprocess.run(
        [sys.executable, EXAMPLES / "own/sensor/pinger.py"], capture_output=True, text=True, timeout=300
    )
    assert run.stdout.split("\n")[:2] == [
        "pinger: 5.12 m, standard deviation 0.1 m", "stern_pinger: 4.88 m, standard deviation 0.1 m"
    ], run.stderr  # fmt: skip
    page = (EXAMPLES.parent / "docs" / "reference" / "own_sensor.md").read_text(encoding="utf-8")
    assert f"```py\n{(EXAMPLES / 'own/sensor/pinger.py').read_text(encoding='utf-8')}```" in page
