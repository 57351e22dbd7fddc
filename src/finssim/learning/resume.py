"""What lets a killed training go on to the same result: random streams, and states in a file."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import numpy as np
import torch

from finssim.files import OutputError

__all__ = ["RESUME_FILE", "ResumeError", "random_state", "read_state", "set_random_state", "write_state"]

RESUME_FILE = "resume.pt"

ARRAY = "numpy"
"""Key that marks a NumPy array, written as a tensor so that reading runs no code of the file's."""


class ResumeError(ValueError):
    """A training that cannot go on from what is there."""


def random_state() -> dict[str, Any]:
    """The global random streams of Python, NumPy and torch."""
    name, keys, position, has_gauss, gauss = np.random.get_state()  # noqa: NPY002  SB3 draws from it
    cuda = torch.cuda.get_rng_state_all() if torch.cuda.is_available() else []
    version, words, extra = random.getstate()
    return {
        "python": [version, list(words), extra],
        "numpy": [name, keys, position, has_gauss, gauss],
        "torch": torch.get_rng_state(),
        "cuda": list(cuda),
    }


def set_random_state(state: dict[str, Any]) -> None:
    """Set the streams to where `random_state` found them."""
    version, words, extra = state["python"]
    random.setstate((version, tuple(words), extra))
    np.random.set_state(tuple(state["numpy"]))  # noqa: NPY002
    torch.set_rng_state(state["torch"])
    if state["cuda"]:
        torch.cuda.set_rng_state_all(state["cuda"])


def write_state(state: dict[str, Any], path: Path) -> None:
    """Write a state: dictionaries, lists, numbers, strings, tensors and NumPy arrays."""
    try:
        torch.save(_packed(state), path)
    except RuntimeError as error:  # torch's way of saying that a file cannot be written
        raise OutputError(f"cannot write {path}: {error}: is the disk full?") from error


def read_state(path: Path) -> dict[str, Any]:
    """Read what `write_state` wrote; no code in the file is run.

    Raises:
        ResumeError: It is not whole, or no such file.
    """
    try:
        state: dict[str, Any] = _unpacked(torch.load(path, map_location="cpu", weights_only=True))
    except Exception as error:  # a zip, pickle, key or value error, as the damage has it
        reason = " ".join(str(error).split())[:200]
        raise ResumeError(f"{path}: cannot be resumed from ({reason}): remove its directory") from error
    return state


def _packed(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return {ARRAY: torch.from_numpy(np.array(value, order="C"))}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, dict):
        return {key: _packed(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_packed(item) for item in value]
    return value


def _unpacked(value: Any) -> Any:
    if isinstance(value, dict):
        if value.keys() == {ARRAY}:
            return value[ARRAY].numpy()
        return {key: _unpacked(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_unpacked(item) for item in value]
    return value
