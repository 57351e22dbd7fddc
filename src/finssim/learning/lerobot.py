"""Demonstrations as a LeRobot data set, format 3.0: Parquet of frames and of episodes, JSON of features and statistics.

LeRobot itself is not needed to write one. Pictures stay lossless, PNG inside the Parquet, as LeRobot's own feature
`image` has them.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.core.files import atomic_directory
from finssim.learning.demonstrations import OURS, DatasetError, Episode, about, read_episodes

FORMAT = "v3.0"
"""Version of the format (`codebase_version`)."""
INFO_FILE = "meta/info.json"
"""File that marks a data set of LeRobot."""
FILE_MIB = 100
"""Size at which a file of frames ends with the current episode [MiB]."""
FILES = 1000
"""Greatest number of files in a folder."""
FILE_PATH = "chunk-{chunk_index:03d}/file-{file_index:03d}"
QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)


def export_lerobot(source: str | Path, out: str | Path) -> dict[str, Any]:
    """Write a data set of `finssim collect` once more, as LeRobot reads it.

        from lerobot.datasets.lerobot_dataset import LeRobotDataset
        dataset = LeRobotDataset("finssim/dock", root="lerobot/dock")

    A frame is what was observed and the action that followed: `observation.state` as the policy sees it (scaled and
    clipped as the task declares), `observation.images.NAME`, `action` in [-1, 1] and `next.done`; `next.reward` and
    `next.success` (true of the last frame alone) where they are known, which of records they are not. The observation
    after the last action has no frame. `task` is the task's title, and `meta/finssim.json` has what FinsSim keeps of a
    data set.

    Args:
        source: The data set.
        out: Folder to write; an earlier LeRobot data set there is replaced.

    Returns:
        `episodes`, `frames`, `fps` [Hz], and the names of the `features`.

    Raises:
        DatasetError: There is no data set, or it does not tell its rate, or that is no whole number of hertz.
        OutputError: The folder cannot be written.
    """
    import pandas as pd

    if Path(os.path.realpath(out)).is_relative_to(os.path.realpath(source)):
        raise DatasetError(
            f"--lerobot {out}: lies in the data set {source}, which is read: give a folder next to it"
        )
    described = about(source)
    fps, title = _rate(described, source), str(described.get("title") or described["task"])
    with atomic_directory(out, replaces=INFO_FILE) as folder:
        rows, parts = _frames(folder, source, fps, title)
        features = _features({key: x[0] for key, x in parts.items()}, described)
        episodes = folder / "meta/episodes" / f"{_file_path(0)}.parquet"
        episodes.parent.mkdir(parents=True)
        pd.DataFrame(rows).to_parquet(episodes, index=False)
        pd.DataFrame({"task_index": [0]}, index=[title]).to_parquet(folder / "meta/tasks.parquet")
        info = {
            "codebase_version": FORMAT,
            "robot_type": described["vehicle"]["name"],
            "total_episodes": len(rows),
            "total_frames": rows[-1]["dataset_to_index"],
            "total_tasks": 1,
            "chunks_size": FILES,
            "data_files_size_in_mb": FILE_MIB,
            "video_files_size_in_mb": 2 * FILE_MIB,
            "fps": fps,
            "splits": {"train": f"0:{len(rows)}"},
            "data_path": f"data/{FILE_PATH}.parquet",
            "video_path": None,
            "features": features,
        }
        statistics = {key: _statistics(np.concatenate(x)) for key, x in parts.items()}
        for name, value in (("info", info), ("stats", statistics), (OURS, described)):
            (folder / f"meta/{name}.json").write_text(json.dumps(value, indent=2), encoding="utf-8")
    return {"episodes": len(rows), "frames": info["total_frames"], "fps": fps, "features": list(features)}


def _frames(
    folder: Path, source: str | Path, fps: int, title: str
) -> tuple[list[dict[str, Any]], dict[str, list[NDArray[Any]]]]:
    """Write the files of frames: the row of each episode in the table of episodes, and all columns by episode."""
    import pyarrow.parquet as pq

    rows: list[dict[str, Any]] = []
    parts: dict[str, list[NDArray[Any]]] = {}
    began, file, size, writer = 0, 0, 0, None
    for i, episode in enumerate(read_episodes(source)):
        columns = _columns(episode, i, began, fps)
        table = _table(columns)
        if writer is not None and size >= FILE_MIB * 2**20:
            writer.close()
            file, size, writer = file + 1, 0, None
        if writer is None:
            path = folder / "data" / f"{_file_path(file)}.parquet"
            path.parent.mkdir(parents=True, exist_ok=True)
            writer = pq.ParquetWriter(path, table.schema)
        writer.write_table(table)
        size += table.nbytes
        rows.append(_episode_row(i, columns, began, file, title))
        began = rows[-1]["dataset_to_index"]
        for key, x in columns.items():
            parts.setdefault(key, []).append(x)
    if writer is not None:
        writer.close()
    return rows, parts


def _episode_row(
    index: int, columns: Mapping[str, NDArray[Any]], began: int, file: int, title: str
) -> dict[str, Any]:
    """Return a row of the table of episodes: the place of its frames, and their statistics."""
    steps = len(columns["action"])
    return {
        "episode_index": index,
        "tasks": [title],
        "length": steps,
        "data/chunk_index": file // FILES,
        "data/file_index": file % FILES,
        "dataset_from_index": began,
        "dataset_to_index": began + steps,
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
        **{
            f"stats/{key}/{name}": value
            for key, x in columns.items()
            for name, value in _statistics(x).items()
        },
    }


def _rate(described: Mapping[str, Any], source: str | Path) -> int:
    """Frames in a second [Hz]."""
    period = described.get("period")
    if not period:
        raise DatasetError(f"{source}: has no period: collect it again with this version")
    fps = round(1.0 / period)
    if abs(fps * period - 1.0) > 1e-6:
        raise DatasetError(
            f"{source}: a step takes {period:g} s, expected an integer number of steps in a second"
        )
    return fps


def _file_path(file: int) -> str:
    return FILE_PATH.format(chunk_index=file // FILES, file_index=file % FILES)


def _columns(episode: Episode, index: int, began: int, fps: int) -> dict[str, NDArray[Any]]:
    """All frames of an episode by feature, (T, ...)."""
    steps = len(episode.action)
    last = np.arange(steps) == steps - 1
    done: dict[str, NDArray[Any]] = {"next.done": last}
    if np.isfinite(episode.reward).all():
        done["next.reward"] = episode.reward
    if "success" in episode.metrics:
        done["next.success"] = last & (episode.metrics["success"] > 0.0)
    return {
        "observation.state": episode.observation[:-1],
        **{f"observation.images.{name}": x[:-1] for name, x in episode.pictures.items()},
        "action": episode.action,
        **done,
        "timestamp": (np.arange(steps) / fps).astype(np.float32),
        "frame_index": np.arange(steps),
        "episode_index": np.full(steps, index),
        "index": began + np.arange(steps),
        "task_index": np.zeros(steps, np.int64),
    }


def _features(columns: Mapping[str, NDArray[Any]], described: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entry of each column in `info.json`: type, shape, names."""
    names: dict[str, Any] = {"action": list(described["action"]["labels"])}
    names["observation.state"] = [
        f"{entry['name']} {k}" if len(entry["indices"]) > 1 else entry["name"]
        for entry in described["observation"]["entries"]
        for k in range(len(entry["indices"]))
    ]
    features = {}
    for key, x in columns.items():
        if x.dtype == np.uint8:
            about_it = {
                "dtype": "image",
                "shape": list(x.shape[1:]),
                "names": ["height", "width", "channels"],
            }
        else:
            about_it = {"dtype": str(x.dtype), "shape": list(x.shape[1:]) or [1], "names": names.get(key)}
        features[key] = about_it
    return features


def _table(columns: Mapping[str, NDArray[Any]]) -> Any:
    """The frames in Arrow: rows of numbers as lists of fixed length, pictures as PNG with a name."""
    import pyarrow as pa

    arrays = {}
    for key, x in columns.items():
        if x.dtype == np.uint8:
            kind = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
            arrays[key] = pa.array(
                [{"bytes": _png(picture), "path": f"frame-{k:06d}.png"} for k, picture in enumerate(x)], kind
            )
        elif x.ndim > 1:
            arrays[key] = pa.FixedSizeListArray.from_arrays(pa.array(x.ravel()), x.shape[1])
        else:
            arrays[key] = pa.array(x)
    return pa.table(arrays)


def _png(picture: NDArray[np.uint8]) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG")
    return file.getvalue()


def _statistics(x: NDArray[Any]) -> dict[str, Any]:
    """Return the statistics by which LeRobot normalises: of a picture each channel in [0, 1], shape (3, 1, 1); plain
    data."""
    picture = x.dtype == np.uint8
    rows = x.reshape(-1, x.shape[-1]) / 255.0 if picture else x.reshape(len(x), -1).astype(float)
    values = {
        "min": rows.min(0),
        "max": rows.max(0),
        "mean": rows.mean(0),
        "std": rows.std(0),
        **{f"q{round(100 * q):02d}": np.quantile(rows, q, axis=0) for q in QUANTILES},
    }
    shaped = {name: value.reshape(-1, 1, 1) if picture else value for name, value in values.items()}
    return {**{name: value.tolist() for name, value in shaped.items()}, "count": [len(x)]}
