"""Trained policies as directories: `policy.yaml` describes inputs and outputs, `policy.onnx` is the network.

The same directory is run by the evaluation, by the robot and by the virtual pool, with onnxruntime and
without torch. It includes the conditions of the training, and `Policy.load` refuses to run it under others: a
network with a different order of inputs or other limits would still return actions, but wrong ones.
"""

from __future__ import annotations

import hashlib
import math
import shutil
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from finssim.core.budget import SECONDS, limited_memory, read_bytes
from finssim.core.files import atomic_directory
from finssim.core.page import notebook_html
from finssim.core.yaml_file import first_problem, read_mapping

# `policy.yaml`: its schema, and the comparison of two descriptions.


FORMAT = 1
"""Version of the directory's layout; increased if an older reader would misinterpret it."""
LARGEST = 1 << 20
"""Largest number of elements of an observation, an action or a memory."""

NETWORK_FILE = "policy.onnx"
DESCRIPTION_FILE = "policy.yaml"


class PolicyError(ValueError):
    """Policy directory that cannot be read, or does not match the vehicle that it is to control."""


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class ObservationEntry(_Record):
    """Contiguous observation elements of one quantity, as clip(quantity / scale)."""

    name: str
    """Name of the quantity with its frame, such as `position_error_body`."""
    indices: tuple[int, ...]
    """Indices of its components in the observation, in order."""
    unit: str
    """Unit of the quantity before division; "1" if dimensionless."""
    scale: float = Field(default=1.0, gt=0.0)
    """Divisor, in `unit`."""
    clip: tuple[float, float] | None = None
    """Bounds (low, high) of the divided value [-], or None."""


class ObservationSchema(_Record):
    """Layout of the observation: the index, unit and scale of each quantity."""

    size: int = Field(gt=0, le=LARGEST)
    entries: tuple[ObservationEntry, ...]

    @model_validator(mode="after")
    def _covers_every_index_once(self) -> ObservationSchema:
        indices = sorted(index for entry in self.entries for index in entry.indices)
        if indices != list(range(self.size)):
            raise ValueError(f"entries contain indices {indices}, expected each of 0 to {self.size - 1} once")
        return self

    def name_at(self, index: int) -> str:
        """Return the name of the entry with observation element `index`."""
        return next(entry.name for entry in self.entries if index in entry.indices)


class VehicleIdentity(_Record):
    """Vehicle that a policy was trained for."""

    name: str
    sha256: str
    """Hex digest of the resolved vehicle file."""


class PolicyDescription(_Record):
    """Content of `policy.yaml`. Mappings are plain data: numbers, strings, lists and dictionaries."""

    format: int = FORMAT
    task: str
    observation: ObservationSchema
    pictures: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """Pictures in addition to the observation, by the name of the entry of the vehicle's `perception`:
    device, shape (height, width, 3), rate [Hz] and latency [s]."""
    action: dict[str, Any]
    """Action mode, as returned by its `describe()`: at least `mode` (name), `size`, and its limits and scale."""
    control_period: float = Field(ge=1e-3, le=10.0)
    """Interval between two actions [s]."""
    memory: int = Field(default=0, ge=0, le=LARGEST)
    """Size of the network's recurrent state, which is zero at an episode's start; 0 for a network without memory."""
    vehicle: VehicleIdentity
    hydrodynamics: str
    """Hydrodynamic set or model used in training."""
    seed: int
    training: dict[str, Any] = Field(default_factory=dict)
    """Training configuration, complete enough to repeat the training."""
    provenance: dict[str, Any] = Field(default_factory=dict)
    """Git revision, package versions and platform."""
    created: str = ""
    """Time of creation, ISO 8601, UTC."""
    files: dict[str, str] = Field(default_factory=dict)
    """SHA-256 of the other files of the directory that must not change (the network)."""

    @field_validator("task")
    @classmethod
    def _names_no_code(cls, task: str) -> str:
        if ":" in task:
            raise ValueError(
                f"task is {task!r}, expected the plain name of a task: only a user names a file with code"
            )
        return task

    @field_validator("action", "training", "provenance", mode="before")
    @classmethod
    def _plain_data(cls, value: Any) -> Any:
        return plain_data(value)

    @field_validator("action")
    @classmethod
    def _names_mode_and_size(cls, action: dict[str, Any]) -> dict[str, Any]:
        if not isinstance(action.get("mode"), str):
            raise ValueError("needs `mode`, the action mode's name")
        if not isinstance(action.get("size"), int) or not 1 <= action["size"] <= LARGEST:
            raise ValueError(f"size is {action.get('size')!r}, expected a positive integer")
        return action

    @property
    def action_size(self) -> int:
        """Number of action elements, m."""
        return int(self.action["size"])


def read_file(path: Path) -> bytes:
    """Return the content of one file of a policy directory; raise a `PolicyError` if it cannot be read."""
    try:
        return read_bytes(path, PolicyError)
    except PolicyError as error:
        raise PolicyError(f"{error}: this is not a complete policy directory") from error


def read_description(folder: Path) -> PolicyDescription:
    """Return the validated `policy.yaml` of a directory; a `PolicyError` names the file, the key and the
    expected value."""
    path = folder / DESCRIPTION_FILE
    if not folder.is_dir():
        raise PolicyError(f"{folder}: no such policy directory: give the folder that `finssim train` wrote")
    data = read_mapping(path, PolicyError, such_as="task: t1")
    if data.get("format") != FORMAT:
        raise PolicyError(f"{path}: format is {data.get('format')!r}, but this version reads format {FORMAT}")
    try:
        return PolicyDescription.model_validate(data)
    except ValidationError as error:
        raise PolicyError(f"{path}: {first_problem(error, PolicyDescription)}") from error


def plain_data(value: Any) -> Any:
    """Return `value` as read back from YAML: NumPy arrays and tuples become lists, NumPy scalars Python scalars."""
    if isinstance(value, Mapping):
        return {str(key): plain_data(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [plain_data(item) for item in value]
    return value


def first_difference(trained: Any, actual: Any, path: str, tolerance: float = 1e-9) -> str | None:
    """Return the first difference of two pieces of plain data, as "PATH is A in the policy and B here", or None.

    Args:
        trained: Data of the policy.
        actual: Data to compare.
        path: Path of both in the message.
        tolerance: Relative difference of numbers that is ignored [-].
    """
    if isinstance(trained, dict) and isinstance(actual, dict):
        for key in [*trained, *(key for key in actual if key not in trained)]:
            if key not in trained or key not in actual:
                return f"{path}.{key} is {'only' if key in trained else 'not'} in the policy"
            difference = first_difference(trained[key], actual[key], f"{path}.{key}", tolerance)
            if difference:
                return difference
        return None
    if isinstance(trained, list) and isinstance(actual, list) and len(trained) == len(actual):
        pairs = enumerate(zip(trained, actual, strict=True))
        here = (first_difference(a, b, f"{path}[{i}]", tolerance) for i, (a, b) in pairs)
        return next(filter(None, here), None)
    numbers = isinstance(trained, int | float) and isinstance(actual, int | float)
    if trained == actual or (numbers and math.isclose(trained, actual, rel_tol=tolerance)):
        return None
    return f"{path} is {trained!r} in the policy and {actual!r} here"


OUTPUTS = ["action", "memory_after"]
"""Outputs of the network; the second only for a network with memory."""


class Identified(Protocol):
    """Name of a vehicle and the SHA-256 of its file, which a policy compares. A `Vehicle` has both."""

    @property
    def name(self) -> str: ...

    @property
    def sha256(self) -> str: ...


class Policy:
    """Trained policy, from an observation to an action in [-1, 1]. Create one with `Policy.load`.

    Attributes:
        description: Content of `policy.yaml`.
        folder: Policy directory that it was read from.
        vehicle: Vehicle that it was loaded for; None if that was not checked.
    """

    def __init__(
        self, description: PolicyDescription, session: Any, folder: Path, vehicle: Identified | None = None
    ) -> None:
        self.description = description
        self.folder = folder
        self.vehicle = vehicle
        self._session = session
        self._size = description.observation.size

    @classmethod
    def load(
        cls,
        directory: str | Path,
        *,
        vehicle: Identified | None = None,
        task: Mapping[str, Any] | None = None,
        mode: Mapping[str, Any] | None = None,
    ) -> Policy:
        """Read a policy directory and check that it matches its application; arguments that are None are not checked.

        Args:
            directory: Folder with `policy.yaml` and `policy.onnx`.
            vehicle: Vehicle to control; its SHA-256 must equal that in training.
            task: Description of the task, with keys `name` and `observation` (the schema as plain data).
            mode: Result of the action mode's `describe()`: name, size, limits, scale.

        Raises:
            PolicyError: The message is one sentence with the file or the first value that does not match.
        """
        folder = Path(directory)
        description = read_description(folder)
        if task is not None:
            _check_task(folder, description, task)
        if mode is not None:
            difference = first_difference(description.action, plain_data(mode), "action")
            if difference:
                raise PolicyError(
                    f"{folder}: action does not match: {difference}: train again with this mode"
                )
        if vehicle is not None and vehicle.sha256 != description.vehicle.sha256:
            trained = description.vehicle
            raise PolicyError(
                f"{folder}: trained for vehicle {trained.name} {trained.sha256[:12]}, but this is {vehicle.name} "
                f"{vehicle.sha256[:12]}: train again, or give the vehicle file it was trained with"
            )
        return cls(description, _open_network(folder, description), folder, vehicle)

    def save(self, directory: str | Path) -> Path:
        """Copy the policy directory, and return the copy's path.

        Raises:
            OutputError: The directory contains something other than a policy, or cannot be written.
        """
        with atomic_directory(directory, replaces=DESCRIPTION_FILE) as folder:
            shutil.copytree(self.folder, folder, dirs_exist_ok=True)
        return Path(directory)

    def __repr__(self) -> str:
        about = self.description
        return f"<Policy for {about.task} of {about.vehicle.name}: {self._size} observations to {about.action_size}>"

    def _repr_html_(self) -> str:
        about = self.description
        rows = [
            ("task", about.task),
            ("vehicle", f"{about.vehicle.name} ({about.hydrodynamics})"),
            ("action mode", str(about.action["mode"])),
            ("observations", ", ".join(entry.name for entry in about.observation.entries)),
            ("control period", f"{about.control_period:g} s"),
            ("learner", str(about.training.get("learner", "–"))),
            ("seed", str(about.seed)),
        ]
        return notebook_html("Policy", ("", ""), rows)

    def act(self, observation: ArrayLike) -> NDArray[np.float32]:
        """Return the action for each observation, for a policy without memory.

        Args:
            observation: Scaled and clipped observation [-] according to the schema, shape (..., n); converted
                to float32.

        Returns:
            Action in [-1, 1], shape (..., m); `description.action` defines its meaning.

        Raises:
            PolicyError: An observation does not have length n, or an element is not finite; or the policy has
                a memory.
        """
        return self.step(None, observation)[0]

    def reset(self, n: int) -> NDArray[np.float32] | None:
        """Return the initial memory of n episodes, (n, k); None for a policy without memory.

        The memory is dimensionless [-].
        """
        k = self.description.memory
        return np.zeros((n, k), dtype=np.float32) if k else None

    def step(
        self,
        memory: NDArray[Any] | None,
        observation: ArrayLike,
        pictures: Mapping[str, NDArray[np.uint8]] | None = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Return actions, and the memory for the next step.

        Args:
            memory: Memory from `reset` or the previous step, with a row for each observation.
            observation: Observation as for `act`.
            pictures: Pictures by name, uint8 (rows, height, width, channels), a row for each observation;
                None for a policy without pictures.

        Returns:
            Actions as from `act`, and the new memory.

        Raises:
            PolicyError: As for `act`; or memory or pictures do not match this policy.
        """
        x = self._checked(observation)
        rows, k = x.reshape(-1, self._size), self.description.memory
        expected = (len(rows), k) if k else None
        shape = None if memory is None else np.shape(memory)
        if shape != expected:
            labels = [f"one of shape {s}" if s else "no memory" for s in (shape, expected)]
            raise PolicyError(
                f"the policy received {labels[0]}, expected {labels[1]}: start with the result of reset"
            )
        inputs: dict[str, Any] = {"memory": np.asarray(memory, dtype=np.float32)} if k else {}
        for name, about in self.description.pictures.items():
            picture = (pictures or {}).get(name)
            expected_shape = (len(rows), *about["shape"])
            if picture is None or picture.shape != expected_shape or picture.dtype != np.uint8:
                got = "nothing" if picture is None else f"{picture.dtype} {picture.shape}"
                raise PolicyError(
                    f"the policy requires picture {name}: it received {got}, expected uint8 {expected_shape}"
                )
            inputs[name] = picture
        action, *after = self._session.run(OUTPUTS[: 1 + bool(k)], {"observation": rows, **inputs})
        return action.reshape(*x.shape[:-1], action.shape[-1]), after[0] if after else None

    def _checked(self, observation: ArrayLike) -> NDArray[np.float32]:
        """Return the observation, after checking that it has the correct length and is finite."""
        x = np.asarray(observation, dtype=np.float32)
        if x.ndim == 0 or x.shape[-1] != self._size:
            length = x.shape[-1] if x.ndim else "no"
            raise PolicyError(
                f"observation has {length} elements, expected {self._size} as in {DESCRIPTION_FILE}"
            )
        finite = np.isfinite(x)
        if not finite.all():
            index = int(np.argwhere(~finite)[0, -1])
            name = self.description.observation.name_at(index)
            raise PolicyError(
                f"observation element {index} ({name}) is {x[~finite][0]}, expected a finite number"
            )
        return x


def _open_network(folder: Path, description: PolicyDescription) -> Any:
    """Return the network as an onnxruntime session with one thread: more threads do not accelerate a batch of one."""
    path = folder / NETWORK_FILE
    content = read_file(path)
    digest = hashlib.sha256(content).hexdigest()
    expected = description.files.get(NETWORK_FILE, "none")
    if digest != expected:
        raise PolicyError(
            f"{path}: corrupt: its SHA-256 starts with {digest[:12]}, "
            f"but {DESCRIPTION_FILE} has {expected[:12]}: copy the directory again"
        )
    try:
        import onnxruntime
    except ImportError as error:
        raise PolicyError("running a policy needs onnxruntime: pip install onnxruntime") from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3

    def refused(error: Exception) -> PolicyError:
        reason = " ".join(str(error).split())[:300]
        return PolicyError(f"{path}: not a network onnxruntime can run ({reason})")

    try:
        with limited_memory():
            session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except (
        Exception
    ) as error:  # onnxruntime raises a class per error code, without a common base other than Exception
        raise refused(error) from error
    k = [description.memory] if description.memory else []
    shapes: list[Any] = [tuple(picture["shape"]) for picture in description.pictures.values()]
    described: list[list[Any]] = [[description.observation.size, *k, *shapes], [description.action_size, *k]]
    maps = [
        [tensor.shape[-1] if len(tensor.shape) == 2 else tuple(tensor.shape[1:]) for tensor in side]
        for side in (session.get_inputs(), session.get_outputs())
    ]
    if maps != described:
        sides_text = [[" and ".join(map(str, side)) for side in sides] for sides in (maps, described)]
        raise PolicyError(
            f"{path}: maps {sides_text[0][0]} values to {sides_text[0][1]}, but {DESCRIPTION_FILE} describes "
            f"{sides_text[1][0]} to {sides_text[1][1]}"
        )
    names = [[tensor.name for tensor in side] for side in (session.get_inputs(), session.get_outputs())]
    expected_names = [
        ["observation", *(["memory"] if k else []), *description.pictures],
        OUTPUTS[: 1 + len(k)],
    ]
    if names != expected_names:
        here, there = (" to ".join(", ".join(side) for side in sides) for sides in (names, expected_names))
        raise PolicyError(f"{path}: maps {here}, expected {there}: export it with these names")
    zeros: dict[str, Any] = {"observation": np.zeros((1, description.observation.size), np.float32)}
    zeros |= {"memory": np.zeros((1, *k), np.float32)} if k else {}
    zeros |= {
        name: np.zeros((1, *shape), np.uint8)
        for name, shape in zip(description.pictures, shapes, strict=True)
    }
    stop = onnxruntime.RunOptions()
    timer = threading.Timer(SECONDS, setattr, (stop, "terminate", True))
    timer.daemon = True
    timer.start()
    try:  # run once, so that missing requirements appear here and not during operation
        with limited_memory():
            session.run(names[1], zeros, stop)
    except Exception as error:
        raise refused(error) from error
    finally:
        timer.cancel()
    return session


def _check_task(folder: Path, description: PolicyDescription, task: Mapping[str, Any]) -> None:
    if task["name"] != description.task:
        sentence = f"trained for task {description.task!r}, but this is {task['name']!r}"
        raise PolicyError(f"{folder}: {sentence}: give a policy trained for it")
    trained = description.observation.model_dump(mode="json")
    current = ObservationSchema.model_validate(plain_data(task["observation"])).model_dump(mode="json")
    difference = first_difference(trained, current, "observation")
    if difference:
        raise PolicyError(
            f"{folder}: observation schema does not match: {difference}: train again with this task"
        )
