"""A policy directory runs only with the setup it was trained for, and reports any difference in one sentence."""

from __future__ import annotations

import copy
import hashlib
import re
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from onnx import TensorProto, helper, numpy_helper

from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.control.policy import Policy, PolicyError
from reference.policies import seeing

GAIN = np.array([[0.5, 0.0, 0.0], [0.0, -0.25, 1.0]], dtype=np.float32)
MODE = {"mode": "wrench2", "size": 2, "limits": [18.6, 6.9], "scale": [1.0, 0.5]}
TASK = {
    "name": "hold",
    "observation": {
        "size": 3,
        "entries": [
            {"name": "position_error_body", "indices": (0, 1), "unit": "m", "scale": 3.0, "clip": None},
            {"name": "yaw_rate", "indices": (2,), "unit": "rad/s", "scale": 1.0, "clip": (-2.0, 2.0)},
        ],
    },
}
MINNOW = SimpleNamespace(name="minnow", sha256="ab" * 32)
TROUT = SimpleNamespace(name="trout", sha256="cd" * 32)


def network(inputs: int = 3) -> bytes:
    """Return clip(GAIN x, -1, 1) as an ONNX file."""
    weights = [numpy_helper.from_array(GAIN[:, :inputs], "gain")]
    weights += [numpy_helper.from_array(np.float32(v), n) for v, n in ((-1, "low"), (1, "high"))]
    nodes = [helper.make_node("Gemm", ["observation", "gain"], ["x"], transB=1)]
    nodes += [helper.make_node("Clip", ["x", "low", "high"], ["action"])]
    x = helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["N", inputs])
    y = helper.make_tensor_value_info("action", TensorProto.FLOAT, ["N", 2])
    graph = helper.make_graph(nodes, "policy", [x], [y], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    return model.SerializeToString()


def write(folder, content: bytes | None = None, **changes):
    content = network() if content is None else content
    description = {
        "format": 1,
        "task": TASK["name"],
        "observation": yaml.safe_load(yaml.safe_dump(as_lists(TASK["observation"]))),
        "action": MODE,
        "control_period": 0.1,
        "vehicle": {"name": MINNOW.name, "sha256": MINNOW.sha256},
        "hydrodynamics": "calibrated",
        "seed": 42,
        "files": {"policy.onnx": hashlib.sha256(content).hexdigest()},
    } | changes
    folder.mkdir(exist_ok=True)
    (folder / "policy.yaml").write_text(yaml.safe_dump(description))
    (folder / "policy.onnx").write_bytes(content)
    return folder


def as_lists(value):
    if isinstance(value, dict):
        return {key: as_lists(item) for key, item in value.items()}
    return [as_lists(item) for item in value] if isinstance(value, list | tuple) else value


@pytest.fixture
def folder(tmp_path):
    return write(tmp_path / "run")


def test_the_action_is_the_network_of_the_observation(folder):
    """The action is clip(GAIN x): by hand for one vehicle, and row by row for many."""
    policy = Policy.load(folder, vehicle=MINNOW, task=TASK, mode=MODE)
    np.testing.assert_allclose(policy.act([1.0, 2.0, 0.25]), [0.5, -0.25], atol=1e-7)
    np.testing.assert_allclose(policy.act([8.0, 0.0, -3.0]), [1.0, -1.0], atol=0)
    many = np.random.default_rng(0).normal(size=(4, 5, 3))
    actions = policy.act(many)
    assert actions.dtype == np.float32
    assert all(np.array_equal(actions[i, j], policy.act(many[i, j])) for i in range(4) for j in range(5))
    assert policy.act(np.empty((0, 3))).shape == (0, 2)


def test_arrays_and_tuples_describe_a_mode_as_lists_do(folder):
    Policy.load(folder, mode=MODE | {"limits": np.array(MODE["limits"]), "scale": tuple(MODE["scale"])})


def observation_with(entry: int, **changes):
    task = copy.deepcopy(TASK)
    task["observation"]["entries"][entry].update(changes)
    return task


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        (
            {"task": observation_with(0, scale=2.0)},
            "observation.entries[0].scale is 3.0 in the policy and 2.0 here",
        ),
        (
            {"task": observation_with(1, clip=None)},
            "entries[1].clip is [-2.0, 2.0] in the policy and None here",
        ),
        (
            {"task": observation_with(1, name="roll_rate")},
            "schema does not match: observation.entries[1].name is 'yaw_rate'",
        ),
        ({"task": TASK | {"name": "docking"}}, "trained for task 'hold', but this is 'docking'"),
        (
            {"mode": MODE | {"limits": [18.6, 7.1]}},
            "does not match: action.limits[1] is 6.9 in the policy and 7.1 here",
        ),
        (
            {"mode": MODE | {"mode": "thruster2"}},
            "action.mode is 'wrench2' in the policy and 'thruster2' here",
        ),
        ({"mode": MODE | {"slew": 4.0}}, "action.slew is not in the policy"),
        ({"vehicle": TROUT}, "trained for vehicle minnow abababababab, but this is trout cdcdcdcdcdcd"),
    ],
)
def test_a_policy_refuses_what_it_was_not_trained_with(folder, given, sentence):
    with pytest.raises(PolicyError, match=re.escape(sentence)) as error:
        Policy.load(folder, **given)
    assert "\n" not in str(error.value)


def test_a_missing_directory_or_file_is_named(folder):
    with pytest.raises(PolicyError, match="nowhere: no such policy directory"):
        Policy.load(folder / "nowhere")
    (folder / "policy.onnx").unlink()
    with pytest.raises(PolicyError, match=r"policy\.onnx: cannot be read: No such file or directory"):
        Policy.load(folder)
    (folder / "policy.yaml").unlink()
    with pytest.raises(PolicyError, match=r"policy\.yaml: cannot be read"):
        Policy.load(folder)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"format": 2}, "format is 2, but this version reads format 1"),
        ({"colour": "red"}, "colour: unknown key; known keys: format"),
        ({"control_period": -0.1}, "control_period: Input should be greater than or equal to 0.001"),
        ({"control_period": 1e-9}, "control_period: Input should be greater than or equal to 0.001"),
        ({"memory": 10**12}, "memory: Input should be less than or equal to 1048576"),
        (
            {"observation": {"size": 10**12, "entries": []}},
            "size: Input should be less than or equal to 1048576",
        ),
        ({"control_period": float("inf")}, "control_period: Input should be less than or equal to 10"),
        (
            {"action": {"mode": "wrench2"}},
            "action: size is None, expected a positive integer",
        ),
        ({"observation": {"size": 3, "entries": []}}, "expected each of 0 to 2 once"),
    ],
)
def test_a_wrong_description_is_refused_by_key(tmp_path, changes, sentence):
    with pytest.raises(PolicyError, match=re.escape(sentence)):
        Policy.load(write(tmp_path / "run", **changes))


def test_a_description_that_is_no_mapping_is_refused(folder):
    for text, sentence in (
        ("a: [1", "not valid YAML"),
        ("- 1", "expected keys such as 'task: t1', found a list"),
        ("", "found nothing"),
    ):
        (folder / "policy.yaml").write_text(text)
        with pytest.raises(PolicyError, match=sentence) as error:
            Policy.load(folder)
        assert "\n" not in str(error.value)


def test_a_changed_truncated_or_foreign_network_is_refused(folder, tmp_path):
    content = (folder / "policy.onnx").read_bytes()
    (folder / "policy.onnx").write_bytes(content[:-10])
    with pytest.raises(PolicyError, match=r"policy\.onnx: corrupt"):
        Policy.load(folder)
    with pytest.raises(PolicyError, match="not a network onnxruntime can run"):
        Policy.load(write(tmp_path / "other", content=b"not onnx"))
    with pytest.raises(PolicyError, match=r"maps 2 values to 2, but policy\.yaml describes 3 to 2"):
        Policy.load(write(tmp_path / "smaller", content=network(inputs=2)))


def test_a_bad_observation_is_refused_by_name(folder):
    policy = Policy.load(folder)
    with pytest.raises(PolicyError, match=r"observation element 2 \(yaw_rate\) is nan"):
        policy.act([0.0, 0.0, np.nan])
    with pytest.raises(PolicyError, match=r"observation element 1 \(position_error_body\) is -inf"):
        policy.act([[0.0, 0.0, 0.0], [0.0, -np.inf, 0.0]])
    for wrong in (np.zeros(4), np.zeros((5, 2)), np.float32(0)):
        with pytest.raises(PolicyError, match="elements, expected 3"):
            policy.act(wrong)


def test_one_action_takes_microseconds(folder):
    """One action with N = 1, as on a robot, takes microseconds; processor time counts, as the machine may be shared."""
    policy, observation = Policy.load(folder), np.zeros(3, dtype=np.float32)
    durations = []
    for _ in range(500):
        start = time.process_time()
        policy.act(observation)
        durations.append(time.process_time() - start)
    assert np.median(durations) < 100e-6


@pytest.mark.slow
def test_running_a_policy_needs_no_torch(folder):
    code = (
        "import sys; from finssim.control.policy import Policy\n"
        f"Policy.load({str(folder)!r}).act([0, 0, 0])\n"
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_network_with_other_names_is_refused(folder):
    """A network whose input has another name, which would fail at the first action, is refused."""
    write(folder, network().replace(b"observation", b"observatlon"))
    with pytest.raises(PolicyError, match="maps observatlon to action, expected observation to action"):
        Policy.load(folder)


def test_a_network_that_takes_too_much_memory_is_refused(folder):
    """A network that multiplies two weights of 400 kB into 10^10 elements is refused."""
    wide = numpy_helper.from_array(np.ones((100_000, 1), np.float32), "wide")
    nodes = [helper.make_node("MatMul", ["observation", "gain"], ["x"])]
    nodes += [
        helper.make_node("MatMul", ["wide", "tall"], ["y"]),
        helper.make_node("ReduceSum", ["y"], ["z"]),
    ]
    nodes += [helper.make_node("Add", ["x", "z"], ["action"])]
    x = helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["N", 3])
    y = helper.make_tensor_value_info("action", TensorProto.FLOAT, ["N", 2])
    tall = numpy_helper.from_array(np.ones((1, 100_000), np.float32), "tall")
    weights = [numpy_helper.from_array(GAIN.T.copy(), "gain"), wide, tall]
    graph = helper.make_graph(nodes, "policy", [x], [y], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    write(folder, model.SerializeToString())
    with pytest.raises(PolicyError, match="not a network onnxruntime can run"):
        Policy.load(folder)


@pytest.mark.parametrize(
    "picture",
    [None, np.zeros((1, 27, 47, 3), np.uint8), np.zeros((1, 27, 48, 3), np.float32)],
    ids=["none", "another size", "another type"],
)
def test_a_picture_that_is_not_the_policys_is_refused(tmp_path, picture):
    """A missing picture, one of another shape and one of another type are each refused before the network runs."""
    policy = Policy.load(seeing(tmp_path / "policy"))
    row = np.zeros((1, policy.description.observation.size), np.float32)
    assert policy.step(None, row, {"front_camera": np.zeros((1, 27, 48, 3), np.uint8)})[0].shape == (1, 6)
    with pytest.raises(PolicyError, match="the policy requires picture front_camera: it received"):
        policy.step(None, row, {} if picture is None else {"front_camera": picture})


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ["evaluate", "policy"],
        ["play", "policy", "--video", "a.mp4"],
        ["run", "--policy", "policy", "--pool-file", "none"],
    ],
)
def test_a_policy_directory_names_no_file_to_run(tmp_path, monkeypatch, capsys, words):
    """A policy whose task is FILE.py:CLASS, or whose vehicle is a path, is refused; no code of it runs."""
    monkeypatch.chdir(tmp_path)
    seeing("policy")
    Path("evil.py").write_text("from pathlib import Path\nPath('ran').touch()\n", encoding="utf-8")
    text = Path("policy/policy.yaml").read_text(encoding="utf-8")
    Path("policy/policy.yaml").write_text(
        text.replace("task: camera-docking", "task: evil.py:Evil"), encoding="utf-8"
    )
    assert boundary.run(app, words) == 2
    assert "expected the plain name of a task" in capsys.readouterr().err
    if words[0] != "run":  # whose vehicle is the one on the command line
        bad = text.replace("name: finsrov", "name: ../finsrov.yaml")
        Path("policy/policy.yaml").write_text(bad, encoding="utf-8")
        assert boundary.run(app, words) == 2
    assert not Path("ran").exists()
