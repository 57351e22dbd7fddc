"""Robustness against corrupted input: thousands of broken files and numbers are given to the real commands.

    python benchmarks/hostile.py [--inputs 5000] [--first 0] [--seed 1] [--only KIND,KIND] [--keep FOLDER]
                                 [--seeds FOLDER]

Inputs are numbered, and each depends only on the seed and its number, so that a long run can be split into parts:
`--first` continues it, and `--seeds` reuses the valid files that an earlier part made.

One file of every kind that a command reads is made by the commands themselves or taken from `tests/data`. Each input is
a copy of one of them with one to three changes: bytes flipped, removed, duplicated or inserted; a number that is huge,
tiny, negative, NaN, a word or 5000 digits long; a value of another type, nested deeply, an alias of itself or an
exponential expansion of aliases; a name that is a path or looks like markup; a column or key that is missing or
duplicated; a file that is empty, all zeros or truncated; or, with valid files, such a number on the command line. The
commands run in a worker, which is restarted when an input takes more than 10 s of processor time, including that of
its child processes.

Inputs are counted that end in a traceback, that hang, that write outside their output folder or into their input, and
those of `REFUSED` that are accepted; the exit status is 0 only if there are none.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import io
import multiprocessing
import os
import random
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "tests" / "data"
LIMIT = 10.0
"""Largest processor time of a command for one input [s]."""
PATIENCE = 30.0
"""Ratio of the largest wall time to `LIMIT`, for a busy machine or a worker that waits indefinitely [-]."""
WARM_UP = 120.0
"""Limit for unchanged files, which may compile kernels [s]."""
MEMORY = 12 << 30
"""Largest memory of a worker [bytes]."""
PARAMETERS = "@parameters"
"""Placeholder for the reader of ROS parameter files, since the nodes that call it run until they are stopped."""

FINSROV = ROOT / "src" / "finssim" / "vehicles" / "catalogue" / "finsrov.yaml"

MADE = {
    "pool.yaml": """
camera:
  lens: {width: 640, height: 480, fx: 400, cx: 320, cy: 240}
  position: [0.0, 0.1, 2.6]
  orientation: [1, 0, 0, 0]
  latency: 0.04
interface: {height: 1.0}
""",
    "site.yaml": "rate: 1.0\nfixes: {position_std: 0.2, yaw_std: 0.05, delay: 0.5, dropout: 0.1}\n",
    "goal.yaml": "goal: [0.5, 0.0, -0.5, 90.0]\n",
    "way.yaml": "points: [[0, 0, 0, -0.5], [10, 1, 0, -0.5], [20, 1, 1, -0.5]]\n",
    "lap.yaml": "name: lap\nheading: tangent\nshape: {kind: circle, radius: 0.5, turns: 1, duration: 40, depth: -0.4}\n",  # noqa: E501
    "way.csv": "t,x,y,z,yaw\n0,0,0,-0.5,0\n5,0.5,0,-0.5,0.5\n10,1,0,-0.5,1\n",
    "parameters.yaml": "/**:\n  ros__parameters: {vehicle: finsrov, rate: 20.0}\n/finsrov/controller:\n"
    "  ros__parameters: {goal: [0.5, 0.0, -0.5, 90.0], armed: false}\n",
    "sweep.yaml": "task: t1\nseeds: [1]\ntrain: {steps: 1, worlds: 16}\n"
    "grid: {action: [nonsense], settings.epochs: [2, 4]}\nevaluate: {plants: [nominal], trials: 1}\n",
    "small-sweep.yaml": "task: t1\nseeds: [1]\ntrain: {steps: 1024, worlds: 16}\nevaluate: {trials: 1}\n",
    "points.csv": "id,x,y,z\nnear,0.1,0.2,0.3\nabove,0.1,0.2,1.3\nfar,9.0,0.2,0.3\n",
    "pixels.csv": "id,u,v\na,300,200\nb,320.5,240\n",
    "rack/rack.yaml": "about: A rack.\nwater: {jerlov: II, veil: [0.1, 0.2, 0.3]}\nobjects:\n"
    "  rack: {shape: model, file: rack.xml, position: [2, 0, -1]}\n  buoy: {shape: model, file: buoy.urdf, position: "
    "[3, 1, -1]}\nviewpoint: {position: [0, 0, -1]}\n",
    "rack/rack.xml": "<mujoco><include file='more.xml'/><worldbody><body pos='0 0 0.5' euler='0 0 90'>"
    "<joint type='hinge' axis='0 0 1'/><geom type='box' size='0.3 0.2 0.1' rgba='0.8 0.1 0.1 1'/>"
    "<geom type='capsule' fromto='0 0 0  0 0 1' size='0.05'/></body><geom type='mesh' mesh='wedge' pos='2 0 0'/>"
    "</worldbody></mujoco>\n",
    "rack/more.xml": "<mujoco><asset><mesh name='wedge' vertex='0 0 0  1 0 0  0 1 0  0 0 1'/></asset></mujoco>\n",
    "rack/buoy.urdf": "<robot name='buoy'><link name='base'><inertial><mass value='1'/><inertia ixx='1' iyy='1' "
    "izz='1' ixy='0' ixz='0' iyz='0'/></inertial><collision><origin xyz='0 0 0.4' rpy='1.57 0 0'/><geometry>"
    "<cylinder radius='0.2' length='1.0'/></geometry></collision></link></robot>\n",
    "plate/plate.yaml": "about: A plate.\nwater: {jerlov: II, veil: [0.1, 0.2, 0.3]}\nseabed: "
    "{depth: 3.0, size: [8, 8], heights: bed.csv}\nobjects:\n"
    "  plate: {shape: box, size: [0.1, 2, 1], position: [2, 0, -1], texture: "
    "{kind: picture, file: plate.png, size: 0.8}}\n  tag: {shape: box, size: [0.1, 1, 1], position: [2, 2, -1], "
    "texture: {kind: tag, tag: 3, size: 0.4}}\n  sand: {shape: box, size: [1, 1, 1], position: [2, -2, -1], texture: "
    "{kind: mottled, size: 0.1, contrast: 0.4}}\nviewpoint: {position: [0, 0, -1]}\n",
    "plate/bed.csv": "0,0.1,0.2\n0.1,0.2,0.3\n0,0,0\n",
    "seeing/seeing.yaml": "extends: finsrov\norigin: measured\nsource: here\nperception:\n"
    "  altimeter: {device: altimeter.yaml, rate: 5.0, position: "
    "[0, 0, -0.1], orientation: [0, 0.70710678, 0, 0.70710678]}\n",
    "dvl.jsonl": "".join(
        f'{{"time": {90 + 20 * (i % 3)}, "vx": 0.{i}, "vy": -0.1, "vz": 0.0, "fom": 0.002, "velocity_valid": '
        f'{"true" if i % 4 else "false"}, "status": 0, "format": "json_v1"}}\n' for i in range(30)
    ),
    "vehicle1.csv": "Timestamp,roll,pitch,heading,rollRate,altitudeRelative,battery0.voltage\n" + "".join(
        f"2026-05-04 10:00:{i:02d}.000,{i % 7},-2.0,{(350 + i) % 360},0.{i},-1.{i},--.--\n" for i in range(30)
    ),
    "fixes.csv": "timestamp,position_valid,x,y,z,std\n" + "".join(
        f"{1.7e9 + 0.2 * i:.1f},{i % 5 > 0},{0.1 * i:.1f},2.0,1.{i},0.2\n" for i in range(30)
    ),
    "map.yaml": "vehicle: bluerov2_heavy\npassive: true\nfiles:\n  \"*_imu.csv\":\n    time: time_secs\n"
    "    columns: {p: x_angvel, q: y_angvel, r: z_angvel, ax: x_linacc, ay: y_linacc, az: z_linacc}\n",
}  # fmt: skip
"""Files that are written by hand, as the docs show them."""


@dataclass(frozen=True)
class Kind:
    """Kind of file, and the commands that read it."""

    name: str
    file: str
    """Path or pattern below the folder of valid files; in a folder of several files, the file that is
    changed."""
    commands: tuple[str, ...]
    """Commands: `{}` is the file, or its folder with `folder`; `OUT` is an output, `SEEDS` the valid files."""
    folder: int = 0
    """Number of levels above the file of the folder that is the input."""
    inside: bool = False
    """True if the input is an earlier output that the command continues."""
    weight: int = 1


def kinds() -> list[Kind]:
    """Return all kinds of files."""
    camera = "--pool SEEDS/pool.yaml"
    located = f"{camera} --vehicle finsrov --out OUT/rows.csv"
    fitted = "--survey SEEDS/pool-survey.yaml --camera SEEDS/camera.yaml --out OUT/pool.yaml"
    return [
        Kind("vehicle", "vehicle.yaml", (
            "vehicles show {}", "tasks show t1 --vehicle {}",
            "simulate --vehicle {} --command surge=5 --duration 0.2 --out OUT/run.csv",
            "excite surge --vehicle {} --levels 5 --out OUT/programmes",
            "run --policy pid --goal 0,0,-0.5,0 --vehicle {} --pool-file none --robot udp://127.0.0.1:9 "
            "--bind 127.0.0.1:0 --duration 0",
        ), weight=3),
        Kind("ranges", "ranges.yaml", ("collect pid --task t1 --episodes 1 --randomize {} --out OUT/set",)),
        Kind("observe", "site.yaml", ("collect pid --task t1 --episodes 1 --observe {} --out OUT/set",)),
        Kind("evaluation plant", "plant.yaml", ("evaluate pid --trials 1 --plant {}",)),
        Kind("pool plant", "pool-plant.yaml", ("pool --plant {} --camera none --port 50321 --duration 0",)),
        Kind("pool file", "pool.yaml", (
            "project SEEDS/points.csv --pool {}", "backproject SEEDS/pixels.csv --z 0 --pool {}",
            "localize SEEDS/log/detections.csv --vehicle finsrov --out OUT/rows.csv --depth 0.5 --pool {}",
        ), weight=2),
        Kind("camera file", "camera.yaml", (
            "calibrate pool SEEDS/survey.csv --survey SEEDS/pool-survey.yaml --camera {} --out OUT/pool.yaml",
        )),
        Kind("camera file of OpenCV", "left_intrinsics.yml", (
            "calibrate pool SEEDS/survey.csv --survey SEEDS/pool-survey.yaml --camera {} --out OUT/pool.yaml",
        )),
        Kind("survey", "survey.csv", (f"calibrate pool {{}} {fitted}",), weight=2),
        Kind("survey file", "pool-survey.yaml", (
            "calibrate pool SEEDS/survey.csv --survey {} --camera SEEDS/camera.yaml --out OUT/pool.yaml",
        )),
        Kind("points", "points.csv", (f"project {{}} {camera}",)),
        Kind("pixels", "pixels.csv", (f"backproject {{}} {camera} --z 0",)),
        Kind("detections", "log/detections.csv", (
            f"localize {{}} {located} --depth 0.5", f"localize {{}} {located} --depth SEEDS/log/depth.csv",
        ), weight=2),
        Kind("depths", "log/depth.csv", (f"localize SEEDS/log/detections.csv {located} --depth {{}}",)),
        Kind("truth in a log", "log/truth.csv", (f"fuse {{}} {located}",), folder=1),
        Kind("log of fuse", "log/imu.csv", (f"fuse {{}} {located}",), folder=1),
        Kind("detections in a log", "log/detections.csv", (f"fuse {{}} {located}",), folder=1),
        Kind("header of a trial", "trials/surge_plus_9/trial.yaml", ("trials check {}",), folder=1, weight=2),
        Kind("table of a trial", "trials/surge_plus_9/data.csv", (
            "trials check {}", "replay {} --vehicle finsrov", "replay {} --vehicle finsrov --out OUT/replay",
            "calibrate hydrodynamics {} --vehicle finsrov --out OUT/v.yaml",
        ), folder=1, weight=4),
        Kind("Parquet", "bare.parquet", ("trials check {} --vehicle finsrov",)),
        Kind("steps of motors", "steps/surge_plus_9/data.csv", (
            "calibrate motor {} --vehicle finsrov --out OUT/v.yaml",
        ), folder=1),
        Kind("thrust table", "thrust.csv", ("calibrate thruster {} --vehicle bluerov2 --out OUT/v.yaml",)),
        Kind("map", "map.yaml", ("trials import SEEDS/logs/small_imu.csv --map {} --out OUT/trials",), weight=2),
        Kind("log of an import", "logs/small_imu.csv", (
            "trials import {} --map SEEDS/map.yaml --out OUT/trials", "trials import {} --out OUT/trials",
        )),
        *(
            Kind(file, file, ("trials import {} --vehicle bluerov2 --out OUT/trials",))
            for file in ("dvl.jsonl", "vehicle1.csv", "fixes.csv")
        ),
        Kind("BIN", "small.BIN", ("trials import {} --vehicle bluerov2 --split arming --out OUT/trials",)),
        Kind("tlog", "small.tlog", ("trials import {} --vehicle bluerov2_heavy --out OUT/trials",)),
        Kind("bag in SQLite", "bags/sqlite3/sqlite3.db3", ("trials import {} --map SEEDS/bag.yaml --out OUT/t",), folder=1),  # noqa: E501
        Kind("bag in MCAP", "bags/mcap/mcap.mcap", ("trials import {} --map SEEDS/bag.yaml --out OUT/t",), folder=1),
        Kind("metadata of a bag", "bags/mcap/metadata.yaml", (
            "trials import {} --map SEEDS/bag.yaml --out OUT/t",
        ), folder=1),
        Kind("ROS 1 bag", "bags/ros1.bag", ("trials import {} --map SEEDS/bag.yaml --out OUT/t",)),
        Kind("record", "run.mcap", (
            "record info {}", "record info {} --json", "record repair {} --out OUT/whole.mcap", "play {}",
            "trials import {} --out OUT/trials", "evaluate {} --task t1", "view {} --no-browser --duration 0",
            "collect {} --task t1 --goal end --out OUT/set",
        ), weight=5),
        Kind("truth of the pool", "truth.fst", ("evaluate SEEDS/run.mcap --task t1 --truth {}",)),
        Kind("motion capture", "mocap.csv", ("evaluate SEEDS/run.mcap --task t1 --truth {}",)),
        Kind("policy", "policy/policy.yaml", (
            "evaluate {} --trials 1", "run --policy {} --goal 0,0,-0.5,0 --pool-file none --robot udp://127.0.0.1:9 "
            "--bind 127.0.0.1:0 --duration 0",
        ), folder=1, weight=3),
        Kind("network", "policy/policy.onnx", ("evaluate {} --trials 1",), folder=1),
        Kind("task", "own.py", ("tasks show {}:KeepDepth",)),
        Kind("goal", "goal.yaml", (
            "run --policy pid --goal {} --pool-file none --robot udp://127.0.0.1:9 --bind 127.0.0.1:0 --duration 0",
        )),
        Kind("way", "way.yaml", ("evaluate pid --task t2 --trajectory {} --trials 1",)),
        Kind("lap", "lap.yaml", ("evaluate pid --task t2 --trajectory {} --trials 1",)),
        Kind("table of a way", "way.csv", ("evaluate pid --task t2 --trajectory {} --trials 1",)),
        Kind("parameters of ROS", "parameters.yaml", (f"{PARAMETERS} {{}}",)),
        Kind("sweep", "sweep.yaml", ("sweep {} --out OUT/swept",)),
        Kind("result of a sweep", "swept/evaluations/*.json", ("sweep SEEDS/small-sweep.yaml --processes 1 --out {}",), folder=2, inside=True),  # noqa: E501
        Kind("world", "world.yaml", (
            "worlds show {}", "worlds show {} --seed 3 --json", "worlds show {} --out OUT/seen.png",
        ), weight=2),
        Kind("mesh of a world", "wreck/wreck.stl", ("worlds show IN/wreck/wreck.yaml --out OUT/seen.png",), folder=1),
        Kind("model of a world", "rack/rack.xml", ("worlds show IN/rack/rack.yaml", "worlds show IN/rack/rack.yaml --out OUT/seen.png"), folder=1),  # noqa: E501
        Kind("part of a model", "rack/more.xml", ("worlds show IN/rack/rack.yaml",), folder=1),
        Kind("URDF of a world", "rack/buoy.urdf", ("worlds show IN/rack/rack.yaml",), folder=1),
        Kind("world with pictures", "plate/plate.yaml", ("worlds show IN/plate/plate.yaml --out OUT/seen.png",), folder=1, weight=2),  # noqa: E501
        Kind("picture of a world", "plate/plate.png", ("worlds show IN/plate/plate.yaml --out OUT/seen.png",), folder=1, weight=2),  # noqa: E501
        Kind("heights of a world", "plate/bed.csv", ("worlds show IN/plate/plate.yaml --out OUT/seen.png",), folder=1),
        Kind("picture of tags", "tags/tags.png", (f"localize {{}} {located} --depth 0.5",), folder=1, weight=2),
        Kind("picture of a board", "board/left01.jpg", (
            "calibrate camera {} --board 9x6 --out OUT/camera.yaml",
        ), folder=1, weight=2),
        Kind("sensors of a vehicle", "seeing/seeing.yaml", (
            "vehicles show {}/seeing.yaml",
            "pool --world pool --vehicle {}/seeing.yaml --camera none --port 50321 --duration 0",
        ), folder=1),
        Kind("altimeter of a vehicle", "seeing/altimeter.yaml", (
            "pool --world pool --vehicle {}/seeing.yaml --camera none --port 50321 --duration 0",
        ), folder=1, weight=2),
        Kind("camera of a world", "camera-device.yaml", ("worlds show pool --camera {} --out OUT/seen.png",)),
        Kind("sonar of a world", "sonar-device.yaml", ("worlds show pool --sonar {} --out OUT/seen.png",)),
        Kind("number", "goal.yaml", (
            "simulate --vehicle finsrov --command surge=NUMBER --duration 0.2 --out OUT/run.csv",
            "simulate --vehicle finsrov --command surge=5 --duration NUMBER --out OUT/run.csv",
            "simulate --vehicle finsrov --command surge=5 --duration 0.2 --depth NUMBER --out OUT/run.csv",
            "excite surge --vehicle finsrov --levels NUMBER --out OUT/programmes",
            "excite surge --vehicle finsrov --coast NUMBER --out OUT/programmes",
            "excite surge --vehicle finsrov --kind multisine --duration NUMBER --out OUT/programmes",
            "train t1 --steps 1024 --worlds 16 --set learning_rate=NUMBER --out OUT/policy",
            "train t1 --steps 1024 --worlds 16 --set discount=NUMBER --until NUMBER --out OUT/policy",
            "replay SEEDS/trials --vehicle finsrov --horizon NUMBER",
            "calibrate hydrodynamics SEEDS/trials --vehicle finsrov --fix surge.m=NUMBER --out OUT/v.yaml",
            f"localize SEEDS/log/detections.csv {located} --depth NUMBER --pixel-std NUMBER",
            f"localize SEEDS/log/detections.csv {located} --depth 0.5 --tilt-std-deg NUMBER",
            f"fuse SEEDS/log {located} --rate NUMBER", f"fuse SEEDS/log {located} --pixel-std NUMBER",
            f"backproject SEEDS/pixels.csv {camera} --z NUMBER", f"backproject SEEDS/pixels.csv {camera} --plane 0,0,1,NUMBER",  # noqa: E501
            "play SEEDS/run.mcap --start NUMBER", "view SEEDS/run.mcap --no-browser --duration 0 --basin 4,2,NUMBER",
            "evaluate pid --trials NUMBER", "collect pid --task t1 --episodes NUMBER --disturb NUMBER --out OUT/set",
            "run --policy pid --goal 0,0,NUMBER,NUMBER --pool-file none --robot udp://127.0.0.1:9 --bind 127.0.0.1:0 "
            "--duration 0", "pool --camera none --port 50321 --duration 0 --start 0,0,-0.5,NUMBER",
        )),
    ]  # fmt: skip


REFUSED = (
    "calibrate hydrodynamics SEEDS/mm --vehicle finsrov --out OUT/v.yaml",
    "record repair SEEDS/run.mcap --out SEEDS/run.mcap",
    "train t1 --steps 1024 --worlds 16 --set learning_rate=-1 --out OUT/policy",
    "evaluate SEEDS/strong --trials 1",
    "evaluate SEEDS/endless --trials 1",
    "view SEEDS/run.mcap --no-browser --duration 0 --bind 10.255.255.1",
    "excite surge --vehicle finsrov --simulate --repeats 0 --out OUT/trials",
)
"""Commands that must be refused: a log in mm/s, a policy with limits of 1e9 N or a period without end, ..."""


# Changes of an input. Each is a function of the bytes and a generator that returns other bytes.

NUMBERS = (
    "0", "-0.0", "-1", "1", "1e-300", "1e300", "-1e300", "1e12", "-1e9", "1e19", "nan", ".nan", "inf", "-inf", ".inf",
    "1e400", "9" * 5000, "0x" + "f" * 400, "1_000", "1,5", "--3", "1e", "", "null", "true", "2026-99-99",
)  # fmt: skip
NAMES = (
    "../../../escaped", "/tmp/finssim-escaped", "a/b", "..", "", " ", "[/bold]", "[red]x", "[link=file:///x]",
    "a" * 5000, "\N{SNOWMAN}", "\u202e", "x\ty", "x\0y", "x\ny", "%s%n{0}{x}", "-rf", "CON", "C:\\x", "$HOME", "~", "`id`",  # noqa: E501
    "'", '"',
)  # fmt: skip
BOMB = "{a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1], " + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 10)}], " for a, b in zip("abcdefgh", "bcdefghi", strict=True)
) + "j: 1}"  # fmt: skip
VALUES = (
    "[]", "{}", "[[]]", "{a: 1}", "[1, 2]", "[a, b]", "text", "1.5", "null", "true", "[" * 500 + "]" * 500,
    "[" * 40000, "{a: " * 300 + "1" + "}" * 300,
    "&z [*z]", "&z {a: *z}", BOMB, "!!int abc", "!!float x", "!!bool x", "!!timestamp abc", "!!binary '%'", "!!set [1]",
    "!!omap 3", "!!pairs {a: 1}", "!!python/object:os.system x", "!<x> y", "*nowhere", "? {a: 1}\n: 2",
    "- 1\n- 2", "|", "%",
)  # fmt: skip
Change = Callable[[bytes, random.Random], bytes]


def _spot(data: bytes, rng: random.Random) -> tuple[int, int]:
    """Return a short random range of bytes."""
    a = rng.randrange(len(data) + 1)
    return a, min(len(data), a + rng.choice((1, 1, 2, 4, 8, 64, 1000)))


def flipped(data: bytes, rng: random.Random) -> bytes:
    """Flip one bit."""
    if not data:
        return data
    made = bytearray(data)
    made[rng.randrange(len(made))] ^= 1 << rng.randrange(8)
    return bytes(made)


def written_over(data: bytes, rng: random.Random) -> bytes:
    """Overwrite a range."""
    a, b = _spot(data, rng)
    return data[:a] + rng.choice((rng.randbytes(b - a), b"\0" * (b - a), b"\xff" * (b - a))) + data[b:]


def cut_out(data: bytes, rng: random.Random) -> bytes:
    """Remove a range."""
    a, b = _spot(data, rng)
    return data[:a] + data[b:]


def doubled(data: bytes, rng: random.Random) -> bytes:
    """Duplicate a range."""
    a, b = _spot(data, rng)
    return data[:b] + data[a:b] + data[b:]


def cut_off(data: bytes, rng: random.Random) -> bytes:
    """Truncate the end."""
    return data[: rng.randrange(len(data) + 1)]


def nothing(data: bytes, rng: random.Random) -> bytes:
    """Replace everything by nothing, zeros, spaces, or unrelated content."""
    zeros, noise = bytes(len(data)), rng.randbytes(len(data) % 5000)
    return rng.choice((b"", zeros, b" \n", b"\xff\xfe" + data, noise, b"[" * 100_000))


def length_field(data: bytes, rng: random.Random) -> bytes:
    """Replace two, four or eight bytes by a huge or negative number, as in a length field of a binary file."""
    size = rng.choice((2, 4, 8))
    if len(data) < size:
        return data
    a = rng.randrange(len(data) - size + 1)
    value = rng.choice((0, 1, 2 ** (8 * size - 1) - 1, 2 ** (8 * size) - 1, len(data), 2 ** (8 * size - 4)))
    return data[:a] + (value % 2 ** (8 * size)).to_bytes(size, "little") + data[a + size :]


def _text(change: Callable[[str, random.Random], str]) -> Change:
    @functools.wraps(change)
    def changed(data: bytes, rng: random.Random) -> bytes:
        text = data.decode("utf-8", errors="surrogateescape")
        return change(text, rng).encode("utf-8", errors="surrogateescape")

    return changed


def _at(text: str, pattern: str, words: tuple[str, ...], rng: random.Random) -> str:
    """Replace one match of a pattern by one of several words."""
    found = list(re.finditer(pattern, text, re.MULTILINE))
    if not found:
        return text + rng.choice(words)
    match = rng.choice(found)
    return text[: match.start()] + rng.choice(words) + text[match.end() :]


@_text
def number(text: str, rng: random.Random) -> str:
    """Replace a number by another."""
    return _at(text, r"(?<![\w.])[-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?(?![\w.])", NUMBERS, rng)


@_text
def name(text: str, rng: random.Random) -> str:
    """Replace a word by another name."""
    return _at(text, r"(?<![\w.])[A-Za-z][\w.-]*", NAMES, rng)


@_text
def value(text: str, rng: random.Random) -> str:
    """Replace the value of a key, or the content of brackets."""
    return _at(text, r"(?<=: )(?:\[[^\]\n]*\]|\{[^}\n]*\}|[^,{}\[\]\n#]+)", VALUES, rng)


@_text
def line(text: str, rng: random.Random) -> str:
    """Remove, duplicate, move or indent a line."""
    lines = text.splitlines(keepends=True) or [""]
    i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    taken = lines.pop(i)
    kind = rng.randrange(5)
    if kind > 0:
        lines.insert(i if kind > 1 else j, {2: taken * 2, 3: "  " + taken, 4: taken[:-1]}.get(kind, taken))
    return "".join(lines)


@_text
def column(text: str, rng: random.Random) -> str:
    """Scale a column of a table by a thousand, make it constant, remove or duplicate it, or replace its
    numbers."""
    rows = [line.split(",") for line in text.splitlines()]
    if not rows or not rows[0]:
        return text
    i, kind, word = rng.randrange(len(rows[0])), rng.randrange(5), rng.choice(NUMBERS + NAMES)
    for k, row in enumerate(rows):
        if i >= len(row):
            continue
        if kind == 0 and k:
            with contextlib.suppress(ValueError):
                row[i] = repr(float(row[i]) * 1000.0)
        elif kind == 1 and k:
            row[i] = word
        elif kind == 2:
            del row[i]
        elif kind == 3:
            row.insert(i, row[i])
        elif kind == 4 and rng.random() < 0.5:
            row[i] = rng.choice(("", "nan", row[i - 1]))
    return "\n".join(map(",".join, rows)) + "\n"


BYTES = (flipped, written_over, cut_out, doubled, cut_off, nothing, length_field)
TEXT = (number, number, name, value, value, line)
BINARY = {".stl", ".png", ".jpg", ".mcap", ".BIN", ".tlog", ".db3", ".bag", ".onnx", ".fst", ".parquet"}


def changed(data: bytes, suffix: str, rng: random.Random) -> tuple[bytes, str]:
    """Return a corrupted copy, and a description of the changes."""
    if suffix in BINARY:
        of: tuple[Change, ...] = BYTES
    else:
        of = TEXT if rng.random() < 0.8 else BYTES
        if suffix == ".csv" and rng.random() < 0.5:
            of = (column,)
    done = []
    for _ in range(rng.choice((1, 1, 2, 3))):
        change = rng.choice(of)
        data = change(data, rng)
        done.append(change.__name__)
    return data, " ".join(done)


# Valid files.


def make(folder: Path, run: Callable[..., None]) -> None:
    """Make a valid file of every kind.

    Args:
        folder: Output folder, which is the working directory.
        run: Runs a command, and raises an error if it fails.
    """
    for file, text in MADE.items():
        (folder / file).parent.mkdir(exist_ok=True)
        (folder / file).write_text(text)
    source = ROOT / "src" / "finssim"
    (folder / "log").mkdir()
    (folder / "logs").mkdir()
    (folder / "wreck").mkdir()
    for file, made in (
        (FINSROV, "vehicle.yaml"),
        (source / "sim" / "ranges" / "pool.yaml", "ranges.yaml"),
        (source / "evaluation" / "plants" / "current.yaml", "plant.yaml"),
        (source / "extensions" / "perception" / "catalogue" / "dock.yaml", "world.yaml"),
        (source / "extensions" / "perception" / "catalogue" / "wreck.yaml", "wreck/wreck.yaml"),
        (source / "extensions" / "perception" / "catalogue" / "wreck.stl", "wreck/wreck.stl"),
        (source / "vehicles" / "catalogue" / "devices" / "low_light_camera.yaml", "camera-device.yaml"),
        (source / "vehicles" / "catalogue" / "devices" / "gemini_720is.yaml", "sonar-device.yaml"),
        (DATA / "opencv_chessboards" / "left_intrinsics.yml", "left_intrinsics.yml"),
        (DATA / "t200" / "t200_16V_bluerobotics_2019.csv", "thrust.csv"),
        (DATA / "hinsdale" / "traj026-0_imu.csv", "logs/small_imu.csv"),
        (DATA / "ardusub" / "small.BIN", "small.BIN"),
        (DATA / "ardusub" / "small_cut.tlog", "small.tlog"),
        (ROOT / "examples" / "own/task/keep_depth.py", "own.py"),
        (source / "vehicles" / "catalogue" / "devices" / "ping.yaml", "seeing/altimeter.yaml"),
        *(
            (DATA / "opencv_chessboards" / f"left{k:02}.jpg", f"board/left{k:02}.jpg")
            for k in (1, 2, 3, 4, 5)
        ),
    ):
        (folder / made).parent.mkdir(exist_ok=True)
        shutil.copyfile(file, folder / made)
    _pictures(folder)
    _what_a_camera_saw(folder)
    _bags(folder / "bags")
    _plant(folder / "pool-plant.yaml")
    excite = ("excite", "surge", "--vehicle", "finsrov", "--levels", "9", "--simulate", "--out")
    run(*excite, "trials")
    run(*excite, "steps", "--inputs", "command,rpm")
    steps = folder / "steps" / "surge_plus_9" / "data.csv"
    steps.write_text("".join(steps.read_text().splitlines(keepends=True)[:700]))
    run("train", "t1", "--steps", "1024", "--worlds", "16", "--out", "policy")
    run("sweep", "small-sweep.yaml", "--processes", "1", "--out", "swept")
    stack = ["t1", "--policy", folder / "policy", "--episodes", "1", "--records", "--out", folder / "stack"]
    subprocess.run([sys.executable, "-m", "studies.stack", *stack], cwd=ROOT, check=True, capture_output=True)
    shutil.copyfile(next((folder / "stack").rglob("*.mcap")), folder / "run.mcap")
    shutil.copyfile(next((folder / "stack").rglob("*.truth")), folder / "truth.fst")
    _parquet(folder / "trials" / "surge_plus_9" / "data.csv", folder / "bare.parquet")
    _wrongly_accepted(folder)


def _pictures(folder: Path) -> None:
    """Write a texture, and a picture of tags."""
    import cv2
    import numpy as np

    from finssim.localization.detection.families import bitmap

    random = np.random.default_rng(1)
    cv2.imwrite(str(folder / "plate" / "plate.png"), random.integers(0, 256, (24, 32, 3), dtype=np.uint8))
    scene = np.full((480, 640), 200, np.uint8)
    for tag in range(2):
        cells = np.kron(np.pad(bitmap("tag25h9", tag), 1, constant_values=1), np.ones((10, 10), np.uint8))
        scene[180 : 180 + len(cells), 150 + 150 * tag : 150 + 150 * tag + len(cells)] = 40 + 180 * cells
    (folder / "tags").mkdir(exist_ok=True)
    cv2.imwrite(str(folder / "tags" / "tags.png"), scene)


def _wrongly_accepted(folder: Path) -> None:
    """Write well-formed files with impossible content, for `REFUSED`."""
    import pandas

    shutil.copytree(folder / "trials", folder / "mm")
    for table in (folder / "mm").rglob("data.csv"):
        columns = pandas.read_csv(table)
        columns[["u", "v", "w"]] *= 1000.0
        columns.to_csv(table, index=False)
    for name, pattern, text in (
        ("strong", r"(?<=limits: \[)[^\]]*", "1.0e+9, 1.0e+9, 1.0e+9, 1.0e+9, 1.0e+9, 1.0e+9"),
        ("endless", r"(?<=\ncontrol_period: ).*", ".inf"),
    ):
        shutil.copytree(folder / "policy", folder / name)
        about = folder / name / "policy.yaml"
        changed, count = re.subn(pattern, text, about.read_text(), count=1)
        assert count == 1, name
        about.write_text(changed)


def _what_a_camera_saw(folder: Path) -> None:
    """Write a survey of points below the water, and detections of a vehicle that moves in a circle."""
    import numpy as np

    from finssim.core.optics import Interface, Lens, project
    from finssim.localization.camera_file import write_camera
    from finssim.localization.detection.detections import Detection, Frame, write_detections
    from finssim.localization.detection.families import tag_corners_b
    from finssim.localization.overhead_camera import load_pool
    from finssim.vehicles import load_vehicle

    pool, rng = load_pool(folder / "pool.yaml"), np.random.default_rng(0)
    write_camera(folder / "camera.yaml", Lens(640, 480, 400.0, 400.0, 320.0, 240.0), {})
    points = rng.uniform((-0.8, -0.5, 0.0), (0.8, 0.5, 0.5), (16, 3))
    pixels = project(pool.camera, Interface.water(1.0), points).pixels + 0.2 * rng.standard_normal((16, 2))
    rows = np.column_stack([np.arange(16), pixels, points])
    (folder / "pool-survey.yaml").write_text(
        "sigma: 0.002\nsurface: {height: 1.0, sigma: 0.005}\nfit: [pose, height, tilt]\nfolds: 2\n",
        encoding="utf-8",
    )
    np.savetxt(folder / "survey.csv", rows, "%.9g", ",", header="id,u,v,x,y,z", comments="")
    tags = load_vehicle("finsrov").tags
    t = np.arange(0.0, 3.0, 0.02)
    yaw, zero = 0.3 * t, 0.0 * t
    place = np.column_stack([0.3 * np.cos(t), 0.3 * np.sin(t), zero + 0.5])
    frames = []
    for time_, at, angle in zip(t[::10], place[::10], yaw[::10], strict=True):
        c, s = np.cos(angle), np.sin(angle)
        seen = [
            (
                tag,
                project(
                    pool.camera, pool.interface, corners @ [[c, s, 0], [-s, c, 0], [0, 0, 1]] + at
                ).pixels,
            )
            for tag, corners in tag_corners_b(tags).items()
        ]
        found = tuple(Detection(tag, pixels, 60.0, 0, tags.family) for tag, pixels in seen)
        frames.append(Frame(float(time_ + 0.04), f"{time_:.3f}.png", found))
    write_detections(frames, folder / "log" / "detections.csv")
    for file, names, columns in (
        ("log/truth", "t,x,y,z,yaw", [t, place, yaw]),
        ("mocap", "t,x,y,z,yaw", [t * 10, place - [0, 0, 1], yaw]),
        (
            "log/imu",
            "t,p,q,r,ax,ay,az,roll,pitch",
            [t, zero, zero, zero + 0.3, zero, zero, zero + 9.81, zero, zero],
        ),
        ("log/depth", "t,depth", [t, zero + 0.615]),
    ):
        np.savetxt(folder / f"{file}.csv", np.column_stack(columns), "%.9g", ",", header=names, comments="")


def _bags(folder: Path) -> None:
    """Write the same second of odometry as a bag in SQLite, in MCAP, and of ROS 1."""
    import numpy as np
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    folder.mkdir()
    (folder.parent / "bag.yaml").write_text("vehicle: finsrov\ntopics:\n  /odom: {}\n")
    kind = "nav_msgs/msg/Odometry"
    for bag in ("sqlite3", "mcap", "ros1.bag"):
        one = bag == "ros1.bag"
        store = get_typestore(Stores.ROS1_NOETIC if one else Stores.ROS2_HUMBLE)
        place = folder / bag
        writer: Any = (
            Writer1(place) if one else Writer(place, version=8, storage_plugin=StoragePlugin[bag.upper()])
        )
        with writer:
            connection = writer.add_connection("/odom", kind, typestore=store)
            for i in range(50):
                ns = 20_000_000 * i
                make = {name.split("/")[-1]: made for name, made in store.types.items()}
                stamp = store.types["builtin_interfaces/msg/Time"](0, ns)
                header = make["Header"](*([i] if one else []), stamp, "map")
                pose = make["Pose"](
                    make["Point"](0.002 * i, 0.0, -0.5), make["Quaternion"](0.0, 0.0, 0.0, 1.0)
                )
                twist = make["Twist"](make["Vector3"](0.1, 0.0, 0.0), make["Vector3"](0.0, 0.0, 0.0))
                message = make["Odometry"](
                    header,
                    "base",
                    make["PoseWithCovariance"](pose, np.zeros(36)),
                    make["TwistWithCovariance"](twist, np.zeros(36)),
                )
                raw = (store.serialize_ros1 if one else store.serialize_cdr)(message, kind)
                writer.write(connection, ns, raw)


def _parquet(table: Path, target: Path) -> None:
    import pandas

    pandas.read_csv(table).to_parquet(target)


def _plant(path: Path) -> None:
    from finssim.pool.drawn_plant import draw_plant
    from finssim.vehicles import load_vehicle

    draw_plant(load_vehicle("finsrov"), 1).write(path)


# Running the commands.


@dataclass
class Outcome:
    """Result of a command for an input."""

    end: str
    """Exit status such as `0` or `2`; or `traceback`, `hang` or `killed`."""
    seconds: float
    text: str = ""
    """Last line of its error output."""
    outside: tuple[str, ...] = ()
    """Files that it wrote outside its output folder."""

    @property
    def bad(self) -> bool:
        """Return True if the result is a defect of FinsSim."""
        return self.end in ("traceback", "hang", "killed") or bool(self.outside)


class _Watch:
    """Audit hook that records every file that Python opens for writing, moves or removes."""

    def __init__(self, allowed: tuple[str, ...]) -> None:
        self.allowed = allowed
        self.outside: list[str] = []
        self.on = False
        sys.addaudithook(self)

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.on:
            return
        if event == "open":
            path, mode, flags = arguments
            writes = isinstance(mode, str) and set(mode) & set("wax+")
            if not writes and not (isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)):
                return
        elif event in ("os.rename", "os.link", "os.symlink"):
            path = arguments[1]
        elif event in ("os.mkdir", "os.remove", "os.rmdir", "os.truncate", "os.chmod"):
            path = arguments[0]
            if event in ("os.remove", "os.rmdir") and arguments[1] != -1:
                return  # relative to an open folder, as `shutil.rmtree` does inside its folder
        else:
            return
        if isinstance(path, str | bytes | os.PathLike):
            place = os.path.realpath(os.fsdecode(path))
            if not place.startswith(self.allowed):
                self.outside.append(f"{event} {place}")


def _work(connection: Any, scratch: Path) -> None:
    """Run command lines in the worker until the connection ends."""
    os.environ.update(OMP_NUM_THREADS="1", TMPDIR=str(scratch / "tmp"), MPLBACKEND="Agg", COLUMNS="120")
    os.environ["MPLCONFIGDIR"] = str(scratch / "matplotlib")
    tempfile.tempdir = None
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 30, 1 << 30))
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    null = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(null, descriptor)
    caches = (
        Path.home() / ".cache",
        Path("/dev"),
        Path("/proc"),
        scratch / "tmp",
        scratch / "out",
        scratch / "matplotlib",
    )
    watch = _Watch(tuple(map(str, caches)))
    while True:
        words, folder, free = connection.recv()
        os.chdir(folder)
        shown, begin, end, text = io.StringIO(), time.monotonic(), "traceback", ""
        watch.outside, watch.on = [], not free
        try:
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(shown):
                end = str(_run(words))
        except BaseException as error:
            frame = traceback.extract_tb(error.__traceback__)[-1]
            ours = [f for f in traceback.extract_tb(error.__traceback__) if "finssim" in f.filename]
            places = " < ".join(f"{Path(f.filename).name}:{f.lineno}" for f in (frame, *ours[:-4:-1]))
            text = f"{type(error).__name__}: {str(error)[:160]} at {places}"
        watch.on = False
        text = text or " ".join(shown.getvalue().strip().splitlines()[-1:])
        connection.send(Outcome(end, time.monotonic() - begin, text, tuple(dict.fromkeys(watch.outside))))


def _run(words: list[str]) -> int:
    from finssim.cli import boundary
    from finssim.cli.commands import app

    if words[0] != PARAMETERS:
        return int(boundary.run(app, words))
    from finssim.extensions.ros2.shim.arguments import read_parameters
    from finssim.extensions.ros2.shim.exceptions import RosArgumentsError

    try:
        read_parameters(Path(words[1]), {})
    except RosArgumentsError:
        return 2
    return 0


class Runner:
    """Runner of commands in a worker that is replaced when it hangs or dies."""

    def __init__(self, scratch: Path) -> None:
        self.scratch = scratch
        self._worker: Any = None
        for name in ("tmp", "out", "in"):
            (scratch / name).mkdir(exist_ok=True)

    def __call__(
        self, words: list[str], folder: Path, *, limit: float = LIMIT, free: bool = False
    ) -> Outcome:
        """Run a command.

        Args:
            words: Words of the command line.
            folder: Working directory.
            limit: Largest processor time [s].
            free: True if it may write anywhere.
        """
        if self._worker is None:
            context = multiprocessing.get_context("spawn")
            self._connection, other = context.Pipe()
            self._worker = context.Process(target=_work, args=(other, self.scratch))
            self._worker.start()
            other.close()
        try:
            self._connection.send((words, str(folder), free))
            begin, used = time.monotonic(), self._processor_time()
            while not self._connection.poll(0.2):
                waited, worked = time.monotonic() - begin, self._processor_time() - used
                if worked > limit or waited > PATIENCE * limit:
                    self.close()
                    return Outcome("hang", waited)
            outcome: Outcome = self._connection.recv()
            return outcome
        except (EOFError, OSError):
            self.close()
            return Outcome("killed", 0.0, "the worker died")

    def _processor_time(self) -> float:
        """Return the processor time of the worker and of the child processes for which it has waited [s]."""
        words = Path(f"/proc/{self._worker.pid}/stat").read_text().rpartition(")")[2].split()
        return sum(map(int, words[11:15])) / os.sysconf("SC_CLK_TCK")

    def close(self) -> None:
        """End the worker."""
        if self._worker is not None:
            self._worker.kill()
            self._worker.join()
            self._worker = None


def place_input(kind: Kind, seeds: Path, scratch: Path) -> tuple[Path, Path]:
    """Copy a valid input; return the path for the command, and that of the file to change."""
    for name in ("in", "out", "tmp"):
        shutil.rmtree(scratch / name, ignore_errors=True)
        (scratch / name).mkdir()
    source = next(seeds.glob(kind.file))
    top = source.parents[kind.folder - 1] if kind.folder else source
    target = scratch / ("out" if kind.inside else "in") / top.name
    if not kind.folder:
        shutil.copyfile(source, target)
        return target, target
    shutil.copytree(top, target)
    return target, target / source.relative_to(top)


def words_of(
    command: str, file: Path, scratch: Path, seeds: Path, rng: random.Random | None = None
) -> list[str]:
    """Return the words of a command for an input; numbers are drawn if a generator is given."""
    places = {"{}": str(file), "OUT": str(scratch / "out"), "IN/": f"{scratch / 'in'}/", "SEEDS": str(seeds)}
    words = [functools.reduce(lambda w, m: w.replace(m, places[m]), places, word) for word in command.split()]
    return [re.sub("NUMBER", lambda _: rng.choice(NUMBERS) if rng else "1", word) for word in words]


def cases(
    inputs: int, seed: int, only: Sequence[str], first: int = 0
) -> Iterator[tuple[int, Kind, str, random.Random]]:
    """Yield numbers, kinds and commands in turn, each with its own generator."""
    pairs = [
        (k, c) for k in kinds() if not only or k.name in only for c in k.commands for _ in range(k.weight)
    ]
    for i in range(first, first + inputs):
        kind, command = pairs[i % len(pairs)]
        yield i, kind, command, random.Random(f"{seed} {i}")


def fuzz(
    seeds: Path,
    run: Runner,
    inputs: int,
    seed: int = 1,
    only: Sequence[str] = (),
    keep: Path | None = None,
    first: int = 0,
) -> list[tuple[str, Outcome]]:
    """Give every input to its command; return the failures, with command and changes of the file."""
    bad, ends, begin = [], Counter[str](), time.monotonic()
    for i, kind, command, rng in cases(inputs, seed, only, first):
        given, file = place_input(kind, seeds, run.scratch)
        done = ""
        if "NUMBER" not in command:
            data, done = changed(file.read_bytes(), file.suffix, rng)
            file.write_bytes(data)
        words = words_of(command, given, run.scratch, seeds, rng)
        outcome = run(words, run.scratch / "in")
        ends[outcome.end] += 1
        if outcome.bad:
            bad.append((f"{i} {kind.name}, {done}: finssim {' '.join(words)[:300]}", outcome))
            print(f"{bad[-1][0]}\n  {outcome}", flush=True)
            if keep:
                shutil.copyfile(file, keep / f"{i}-{file.name}")
        if (i + 1) % 100 == 0:
            print(
                f"{i + 1} inputs, {time.monotonic() - begin:.0f} s, {dict(ends)}", file=sys.stderr, flush=True
            )
    return bad


def main() -> int:
    """Fuzz, print, and return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--inputs", type=int, default=5000)
    parser.add_argument("--first", type=int, default=0, help="number of the first input")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="kinds of files, with commas between")
    parser.add_argument("--keep", type=Path, help="folder for the inputs that ended badly")
    parser.add_argument("--seeds", type=Path, help="folder of the whole files, made if it is not there")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        seeds = given.seeds.resolve() if given.seeds else scratch / "seeds"
        run = Runner(scratch)

        def made(*words: str) -> None:
            outcome = run(list(words), seeds, limit=WARM_UP, free=True)
            if outcome.end != "0":
                raise SystemExit(f"finssim {' '.join(words)}: {outcome.end} {outcome.text}")

        if not seeds.exists():
            seeds.mkdir(parents=True)
            make(seeds, made)
        if given.keep:
            given.keep.mkdir(parents=True, exist_ok=True)
        try:
            for kind in kinds():
                for command in kind.commands:
                    file, _ = place_input(kind, seeds, scratch)
                    outcome = run(words_of(command, file, scratch, seeds), scratch / "in", limit=WARM_UP)
                    print(f"unchanged, {kind.name}: {command}: {outcome}")
            accepted = []
            for command in REFUSED:
                place_input(kinds()[0], seeds, scratch)
                if run(words_of(command, scratch, scratch, seeds), scratch / "in").end != "2":
                    accepted.append(command)
            bad = fuzz(
                seeds,
                run,
                given.inputs,
                given.seed,
                [k for k in given.only.split(",") if k],
                given.keep,
                given.first,
            )
        finally:
            run.close()
    ends = Counter("outside" if outcome.outside else outcome.end for _, outcome in bad)
    print(
        f"{given.inputs} inputs: {ends['traceback'] + ends['killed']} tracebacks, {ends['hang']} hangs over {LIMIT:g} s, "  # noqa: E501
        f"{ends['outside']} writes outside; {len(accepted)} of {len(REFUSED)} wrongly accepted {accepted or ''}"
    )
    return 1 if bad or accepted else 0


if __name__ == "__main__":
    sys.exit(main())
