"""State of a training for an exact continuation: random streams, and arrays in a file."""

from __future__ import annotations

import json
import random
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from finssim.core.files import OutputError

RESUME_FILE = "resume.npz"

ARRAY, TENSOR, PAIRS = "__array__", "__tensor__", "__pairs__"
"""Keys that represent a NumPy array or a torch tensor of the file, and a dictionary whose keys are not strings."""


class ResumeError(ValueError):
    """A training cannot continue from the existing files."""


def random_state() -> dict[str, Any]:
    """Return the states of the global random streams of Python, NumPy and, if imported, torch."""
    name, keys, position, has_gauss, gauss = np.random.get_state()  # noqa: NPY002  SB3 draws from it
    version, state, extra = random.getstate()
    streams: dict[str, Any] = {
        "python": [version, list(state), extra],
        "numpy": [name, keys, position, has_gauss, gauss],
    }
    if torch := sys.modules.get("torch"):
        streams["torch"] = torch.get_rng_state()
        streams["cuda"] = list(torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [])
    return streams


def set_random_state(state: dict[str, Any]) -> None:
    """Restore the streams to the states that `random_state` returned."""
    version, numbers, extra = state["python"]
    random.setstate((version, tuple(numbers), extra))
    np.random.set_state(tuple(state["numpy"]))  # noqa: NPY002
    if "torch" in state:
        import torch

        torch.set_rng_state(state["torch"])
        if state["cuda"]:
            torch.cuda.set_rng_state_all(state["cuda"])


def write_state(state: dict[str, Any], path: Path) -> None:
    """Write a state: dictionaries, lists, numbers, strings, NumPy arrays and torch tensors."""
    arrays: list[Any] = []
    text = json.dumps(_packed(state, arrays))
    try:
        with path.open("wb") as file:
            np.savez(file, tree=np.array(text), **{f"array_{i}": array for i, array in enumerate(arrays)})
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error}: is the disk full?") from error


def read_state(path: Path) -> dict[str, Any]:
    """Read a file of `write_state`; code in the file is never executed.

    Raises:
        ResumeError: The file is missing or incomplete.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            state: dict[str, Any] = _unpacked(json.loads(str(file["tree"])), file)
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        reason = " ".join(str(error).split())[:200]
        raise ResumeError(f"{path}: cannot be resumed from ({reason}): remove its directory") from error
    return state


def _packed(value: Any, arrays: list[Any]) -> Any:
    """Return a value in JSON's types; arrays are appended to the list and replaced by their index."""
    if isinstance(value, np.ndarray):
        arrays.append(value)
        return {ARRAY: len(arrays) - 1}
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(value, torch.Tensor):
        arrays.append(value.detach().cpu().numpy())
        return {TENSOR: len(arrays) - 1}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, dict):
        if all(isinstance(key, str) for key in value):
            return {key: _packed(item, arrays) for key, item in value.items()}
        return {PAIRS: [[key, _packed(item, arrays)] for key, item in value.items()]}
    if isinstance(value, list | tuple):
        return [_packed(item, arrays) for item in value]
    return value


def _unpacked(value: Any, file: Any) -> Any:
    if isinstance(value, list):
        return [_unpacked(item, file) for item in value]
    if not isinstance(value, dict):
        return value
    if value.keys() == {ARRAY}:
        return file[f"array_{value[ARRAY]}"]
    if value.keys() == {TENSOR}:
        import torch

        return torch.from_numpy(file[f"array_{value[TENSOR]}"])
    if value.keys() == {PAIRS}:
        return {key: _unpacked(item, file) for key, item in value[PAIRS]}
    return {key: _unpacked(item, file) for key, item in value.items()}
