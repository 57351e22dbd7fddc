"""A data set as LeRobot reads it (format 3.0): the same numbers and pixels, indices that fit, statistics of all frames.

LeRobot 0.4.4 itself read such sets by hand (docs/learning.md); here the files are read with Arrow and Pillow, by the
rules of the format.
"""

import io
import json

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from PIL import Image

from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.learning import lerobot
from finssim.learning.demonstrations import DatasetError, Episode, collect, load, save
from finssim.learning.lerobot import export_lerobot

DESCRIBED = {
    "task": "camera-docking",
    "title": "dock by camera",
    "period": 0.05,
    "expert": "nobody",
    "vehicle": {"name": "finsrov", "sha256": "0"},
    "observation": {
        "entries": [{"name": "velocity", "indices": [0, 1]}, {"name": "depth", "indices": [2]}],
    },
    "action": {"labels": ["surge", "yaw"]},
}


def seen(steps, success, seed):
    """An episode of random numbers and pixels."""
    rng = np.random.default_rng(seed)
    return Episode(
        observation=rng.standard_normal((steps + 1, 3)).astype(np.float32),
        action=rng.uniform(-1, 1, (steps, 2)).astype(np.float32),
        reward=rng.standard_normal(steps).astype(np.float32),
        terminated=True,
        metrics={"success": success},
        pictures={"front": rng.integers(0, 256, (steps + 1, 9, 16, 3), dtype=np.uint8)},
    )


EPISODES = [seen(5, 1.0, 1), seen(3, 0.0, 2), seen(4, 1.0, 3)]


@pytest.fixture
def written(tmp_path):
    return save(tmp_path / "set", EPISODES, DESCRIBED)


def test_pictures_come_back_as_they_were(written):
    """No pixel is changed by the way it is kept."""
    found = load(written)
    assert np.array_equal(
        found.pictures["front"], np.concatenate([e.pictures["front"][:-1] for e in EPISODES])
    )


@pytest.mark.parametrize("mib", [100, 0])
def test_frames_are_the_steps(written, tmp_path, monkeypatch, mib):
    """All in one file, and one file for each episode where files are small."""
    monkeypatch.setattr(lerobot, "FILE_MIB", mib)
    out = tmp_path / "out"
    told = export_lerobot(written, out)
    assert (told["episodes"], told["frames"], told["fps"]) == (3, 12, 20)
    info = json.loads((out / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["splits"] == {"train": "0:3"}
    table = pd.read_parquet(out / "meta/episodes/chunk-000/file-000.parquet")
    assert list(table["dataset_from_index"]) == [0, 5, 8] and list(table["dataset_to_index"]) == [5, 8, 12]
    for i, (row, episode) in enumerate(zip(table.to_dict("records"), EPISODES, strict=True)):
        path = info["data_path"].format(
            chunk_index=row["data/chunk_index"], file_index=row["data/file_index"]
        )
        frames = pq.read_table(out / path, filters=[("episode_index", "=", i)]).to_pydict()
        assert set(frames) == set(info["features"]) == set(told["features"])
        assert np.array_equal(np.float32(frames["observation.state"]), episode.observation[:-1])
        assert np.array_equal(np.float32(frames["action"]), episode.action)
        assert np.array_equal(np.float32(frames["next.reward"]), episode.reward)
        pixels = [np.array(Image.open(io.BytesIO(x["bytes"]))) for x in frames["observation.images.front"]]
        assert np.array_equal(pixels, episode.pictures["front"][:-1])
        steps = len(episode.action)
        assert frames["index"] == list(range(row["dataset_from_index"], row["dataset_to_index"]))
        assert frames["frame_index"] == list(range(steps)) and row["length"] == steps
        assert frames["timestamp"] == pytest.approx([k / 20 for k in range(steps)])
        assert frames["next.done"] == [False] * (steps - 1) + [True]
        assert frames["next.success"][-1] == (episode.metrics["success"] > 0) and not any(
            frames["next.success"][:-1]
        )
        assert row["stats/action/mean"] == pytest.approx(episode.action.mean(0), rel=1e-6)
    files = list((out / "data").rglob("*.parquet"))
    assert len(files) == (1 if mib else 3)


def test_features_are_those_of_the_files(written, tmp_path):
    """Types, shapes and names; pictures with the channel last, as the format has it."""
    export_lerobot(written, tmp_path / "out")
    features = json.loads((tmp_path / "out/meta/info.json").read_text())["features"]
    assert features["observation.images.front"] == {
        "dtype": "image",
        "shape": [9, 16, 3],
        "names": ["height", "width", "channels"],
    }
    assert features["observation.state"] == {
        "dtype": "float32",
        "shape": [3],
        "names": ["velocity 0", "velocity 1", "depth"],
    }
    assert features["action"]["names"] == ["surge", "yaw"]
    schema = pq.read_schema(tmp_path / "out/data/chunk-000/file-000.parquet")
    for key, feature in features.items():
        kind = str(schema.field(key).type)
        expected = {"image": "struct", "bool": "bool", "int64": "int64", "float32": "float"}[feature["dtype"]]
        assert expected in kind, key
        if feature["dtype"] != "image" and feature["shape"] != [1]:
            assert kind.endswith(f"[{feature['shape'][0]}]")
    tasks = pd.read_parquet(tmp_path / "out/meta/tasks.parquet")
    assert list(tasks.index) == ["dock by camera"] and list(tasks["task_index"]) == [0]


def test_statistics_are_of_all_frames(written, tmp_path):
    """Per channel of a picture, in [0, 1]; quantiles between the extremes."""
    export_lerobot(written, tmp_path / "out")
    found = json.loads((tmp_path / "out/meta/stats.json").read_text())
    pictures = np.concatenate([e.pictures["front"][:-1] for e in EPISODES]) / 255.0
    of_picture = {name: np.array(x) for name, x in found["observation.images.front"].items()}
    assert of_picture["mean"].shape == (3, 1, 1) and of_picture["count"].tolist() == [12]
    assert np.allclose(of_picture["mean"].ravel(), pictures.mean((0, 1, 2)))
    assert np.allclose(of_picture["std"].ravel(), pictures.std((0, 1, 2)))
    actions = np.concatenate([e.action for e in EPISODES])
    assert np.allclose(found["action"]["q50"], np.median(actions, axis=0))
    order = ("min", "q01", "q10", "q50", "q90", "q99", "max")
    assert np.all(np.diff([found["action"][name] for name in order], axis=0) >= 0.0)


def test_by_the_command(tmp_path, capsys):
    """What was collected is exported by its folder; an earlier export is replaced, other files are not."""
    collect("pid", "t1", episodes=2, out=tmp_path / "set")
    words = ["datasets", str(tmp_path / "set"), "--lerobot", str(tmp_path / "out"), "--json"]
    for _ in range(2):
        assert boundary.run(app, words) == 0
        told = json.loads(capsys.readouterr().out)[str(tmp_path / "set")]["lerobot"]
        assert told["frames"] == 400 and told["fps"] == 10 and "next.success" in told["features"]
    (tmp_path / "full").mkdir()
    (tmp_path / "full/mine.txt").write_text("mine")
    assert boundary.run(app, [*words[:3], str(tmp_path / "full")]) == 2
    assert "already holds files" in capsys.readouterr().err


def test_what_cannot_be_exported_is_refused(tmp_path, capsys):
    """An old set, a rate that is no whole number, two sets, a folder in the set: nothing is written."""
    out = tmp_path / "out"
    old = save(tmp_path / "sets/old", EPISODES, {k: x for k, x in DESCRIBED.items() if k != "period"})
    with pytest.raises(DatasetError, match="has no period: collect it again"):
        export_lerobot(old, out)
    odd = save(tmp_path / "sets/odd", EPISODES, {**DESCRIBED, "period": 0.15})
    with pytest.raises(
        DatasetError, match=r"a step takes 0.15 s, expected an integer number of steps in a second"
    ):
        export_lerobot(odd, out)
    assert boundary.run(app, ["datasets", str(tmp_path / "sets"), "--lerobot", str(out)]) == 2
    assert "2 data sets are named, expected one" in capsys.readouterr().err
    inside = tmp_path / "sets/odd/lerobot"
    assert boundary.run(app, ["datasets", str(tmp_path / "sets/odd"), "--lerobot", str(inside)]) == 2
    assert "lies in the data set" in capsys.readouterr().err and not inside.exists()
    assert not out.exists()


def test_records_have_no_reward(tmp_path):
    """Nor is a column of NaN made of that."""
    episode = EPISODES[0]
    driven = Episode(
        observation=episode.observation,
        action=episode.action,
        reward=np.full(5, np.nan, np.float32),
        terminated=False,
        metrics={"length": 5.0},
    )
    told = export_lerobot(save(tmp_path / "set", [driven], DESCRIBED), tmp_path / "out")
    assert not {"next.reward", "next.success"} & set(told["features"])
    assert "NaN" not in (tmp_path / "out/meta/stats.json").read_text()
