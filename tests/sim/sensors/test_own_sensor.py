"""A sensor that the package does not know: one file with its schema and what it measures, and one line."""
# mypy: disable-error-code="valid-type,misc,index,no-any-return,no-untyped-def,untyped-decorator"

from types import SimpleNamespace

import pytest
import warp as wp

from finssim.physics.types import vec6
from finssim.sim.sensors import SensorError, SensorSuite, add_sensor
from finssim.vehicles import VehicleError, load_vehicle
from reference.pinger import PingerBatch

FILE = """
extends: bluerov2
sensors:
  pinger:
    origin: measured
    rate: 5.0
    position: [0.1, 0.0, 0.0]
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
    read = suite.by_kind["pinger"].numpy()["range"][:, 0]
    assert abs(read.mean() - 5.0) < 0.03 and read.std() == pytest.approx(0.2, rel=0.1)
    fresh = []
    for _ in range(4):
        now.steps.assign(now.steps.numpy() + 1)
        suite.update(now)
        fresh.append(bool(suite.by_kind["pinger"].fresh.numpy()[0, 0]))
    assert fresh == [False, True, False, True]
    assert "pinger" not in SensorSuite(load_vehicle("bluerov2"), worlds=1, control_step=0.1).by_kind


def test_its_mistakes_are_told_like_those_of_others(tmp_path):
    """A key that it does not have, a number that it may not be, a kind that nobody knows."""
    for change, said in (
        ("noise_std: -1.0", "noise_std is -1.0, expected >= 0"),
        ("noise: 1.0", "unknown key 'noise'"),
    ):
        (tmp_path / "bad.yaml").write_text(FILE.replace("noise_std: 0.2", change), encoding="utf-8")
        with pytest.raises(VehicleError, match=said):
            load_vehicle(tmp_path / "bad.yaml")
    (tmp_path / "bad.yaml").write_text(FILE.replace("pinger", "pingre"), encoding="utf-8")
    with pytest.raises(VehicleError, match="unknown key 'pingre', did you mean 'pinger'"):
        load_vehicle(tmp_path / "bad.yaml")


def test_a_kind_is_taken_once_and_needs_a_schema():
    """Another class of the same kind, and one without a schema."""
    with pytest.raises(SensorError, match="already"):
        add_sensor(type("Other", (PingerBatch,), {}))
    with pytest.raises(SensorError, match="has no schema"):
        add_sensor(type("Bare", (PingerBatch,), {"schema": None, "kind": "bare"}))
