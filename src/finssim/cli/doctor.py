"""`finssim doctor`: installed packages, compute devices, missing extras, and what packages register."""

# No postponed annotations here: Warp reads the annotations of its kernels.
import json
import os
import platform
from dataclasses import dataclass
from typing import Any

from finssim.core.provenance import package_versions, revision
from finssim.core.registry import FAMILIES, Family

CORE = (
    "numpy", "scipy", "warp-lang", "pydantic", "PyYAML", "typer", "rich", "onnx", "onnxruntime", "threadpoolctl",
    "matplotlib", "mcap", "rosbags", "pupil-apriltags",
)  # fmt: skip
"""Required distributions."""


@dataclass(frozen=True)
class Extra:
    """Optional part of the installation."""

    distributions: dict[str, str]
    """Distribution that pip installs -> module that Python imports."""
    enables: str
    """Purpose of the extra, for the report."""


EXTRAS = {
    "learn": Extra(
        {
            "torch": "torch",
            "stable-baselines3": "stable_baselines3",
            "gymnasium": "gymnasium",
            "tensorboard": "tensorboard",
            "onnxscript": "onnxscript",
            "pandas": "pandas",
            "pyarrow": "pyarrow",
        },
        "train with learners on torch, use the Gymnasium environments, watch curves, record runs as Parquet",
    ),
    "torchrl": Extra(
        {"tensordict": "tensordict", "torchrl": "torchrl"},
        "learn with TorchRL: PPO, IPPO, MAPPO, TensorDicts",
    ),
    "rsl-rl": Extra({"rsl-rl-lib": "rsl_rl", "tensordict": "tensordict"}, "learn with RSL-RL"),
    "pettingzoo": Extra(
        {"pettingzoo": "pettingzoo"}, "use tasks of several agents as PettingZoo environments"
    ),
    "imitation": Extra({"minari": "minari"}, "collect demonstrations and learn from them"),
    "sweep": Extra(
        {"ray": "ray"},
        "train over seeds and settings on many machines",
    ),
    "wandb": Extra({"wandb": "wandb"}, "send the curves of a training to Weights & Biases"),
    "logs": Extra(
        {
            "pandas": "pandas",
            "pyarrow": "pyarrow",
            "pymavlink": "pymavlink",
            "pyulog": "pyulog",
        },
        "read Parquet and logs of ArduSub and PX4",
    ),
    "view": Extra(
        {"viser": "viser"},
        "show vehicles and runs live in the browser",
    ),
    "mujoco": Extra({"mujoco": "mujoco"}, "place MJCF and URDF models in described worlds"),
    "xacro": Extra({"xacro": "xacro"}, "import vehicles from xacro"),
    "mpc": Extra({"casadi": "casadi"}, "control by nonlinear model prediction (nmpc)"),
    "perception": Extra(
        {"newton": "newton"}, "simulate cameras, sonars and altimeters in finssim.extensions.perception"
    ),
    "vision": Extra(
        {"opencv-python-headless": "cv2"},
        "calibrate cameras and pools from pictures, locate a vehicle from pictures or video",
    ),
    "render": Extra(
        {"mitsuba": "mitsuba"}, "compare, in the tests, the overhead camera's pictures with Mitsuba's"
    ),
    "ros2": Extra({"cyclonedds": "cyclonedds"}, "run ROS 2 nodes without an installed ROS 2"),
    "hardware": Extra(
        {
            "pygame": "pygame",
            "pymavlink": "pymavlink",
            "pyserial": "serial",
        },
        "reach a vehicle over a serial line or MAVLink, steer it with a gamepad",
    ),
}

EXTRA_OF_MODULE = {
    module: name for name, extra in reversed(EXTRAS.items()) for module in extra.distributions.values()
}
"""Module that could not be imported -> extra that installs it."""


def doctor(*, as_json: bool = False) -> int:
    """List installed packages, compute devices, missing extras with what they enable, and members registered
    by packages.

    Exit status 1: a core package or a working compute device is missing.

    Example: finssim doctor
    """
    report = examine()
    if as_json:
        print(json.dumps(report, indent=2))
    else:
        _print(report)
    return 0 if report["healthy"] else 1


def examine() -> dict[str, Any]:
    """Return the state of the installation, as plain values.

    Returns:
        `healthy`; `machine`; `core` (name -> version or None); `devices`, each with `name`, `works`,
        `detail`; `extras` (name -> `complete`, `versions`, `missing`, `enables`); `registered` (family ->
        package -> names); `failures`, a sentence about each member of another package that cannot be used.
    """
    core = package_versions(CORE)
    devices = _devices() if "warp-lang" in core else []
    extras = {}
    for name, extra in EXTRAS.items():
        versions = package_versions(tuple(extra.distributions))
        missing = [distribution for distribution in extra.distributions if distribution not in versions]
        extras[name] = {
            "complete": not missing,
            "versions": versions,
            "missing": missing,
            "enables": extra.enables,
        }
    works = any(device["name"] == "cpu" and device["works"] for device in devices)
    return {
        "healthy": works and len(core) == len(CORE),
        "machine": {
            "system": platform.platform(),
            "python": platform.python_version(),
            "cores": os.cpu_count(),
            "revision": revision(),
        },
        "core": {name: core.get(name) for name in CORE},
        "devices": devices,
        "extras": extras,
        "registered": {f"{family.noun}s": _by_package(family) for family in FAMILIES},
        "failures": [sentence for family in FAMILIES for sentence in family.failures().values()],
    }


def _by_package(family: Family) -> dict[str, list[str]]:
    """Return package -> names of the members that it registers."""
    packages: dict[str, list[str]] = {}
    for name, package in family.packages().items():
        packages.setdefault(package, []).append(name)
    return {package: sorted(names) for package, names in sorted(packages.items())}


def _devices() -> list[dict[str, Any]]:
    """Return every device that Warp lists, each tested with a kernel."""
    import numpy as np
    import warp as wp

    from finssim.core.quiet import start_warp

    start_warp()

    @wp.kernel
    def square(x: wp.array(dtype=float), y: wp.array(dtype=float)):  # type: ignore[valid-type]
        i = wp.tid()
        y[i] = x[i] * x[i]

    def attempt(device: Any) -> dict[str, Any]:
        answer = {"name": device.alias, "works": True, "detail": device.name}
        try:
            x = wp.array(np.arange(100.0), dtype=float, device=device)
            y = wp.zeros_like(x)
            wp.launch(square, dim=100, inputs=[x, y], device=device)
            if not np.array_equal(y.numpy(), np.arange(100.0) ** 2):
                answer.update(works=False, detail="a kernel ran and gave a wrong answer")
        except Exception as error:  # any error of a driver is a result
            answer.update(works=False, detail=" ".join(str(error).split()) or type(error).__name__)
        return answer

    attempts = [attempt(device) for device in wp.get_devices()]
    if not wp.is_cuda_available():
        attempts.append({"name": "cuda", "works": False, "detail": "no NVIDIA GPU or driver found"})
    return attempts


def _print(report: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console()
    machine = report["machine"]
    console.print(
        f"Python {machine['python']} on {machine['system']}, {machine['cores']} cores", highlight=False
    )
    table = Table(box=None, pad_edge=False)
    for heading in ("", "state", "purpose, or result"):
        table.add_column(heading, overflow="fold")
    for name, version in report["core"].items():
        table.add_row(
            name, version or "[red]missing[/]", "needed: pip install finssim" if version is None else "core"
        )
    for device in report["devices"]:
        absent = device["name"] == "cuda"
        state = "[green]works[/]" if device["works"] else ("absent" if absent else "[red]fails[/]")
        table.add_row(f"device {device['name']}", state, device["detail"].replace("[", r"\["))
    for name, extra in report["extras"].items():
        missing = "missing" if extra["missing"] else "[green]complete[/]"
        table.add_row(f"extra {name}", missing, extra["enables"])
        if extra["versions"]:
            table.add_row(
                "", "", "[dim]" + ", ".join(f"{k} {v}" for k, v in extra["versions"].items()) + "[/]"
            )
        if extra["missing"]:
            missing_text = ", ".join(extra["missing"])
            table.add_row("", "", f"without {missing_text}: pip install 'finssim\\[{name}]'")
    for family, packages in report["registered"].items():
        for package, names in packages.items():
            table.add_row(family, package, ", ".join(names))
    console.print(table)
    for sentence in report["failures"]:
        console.print(f"[red]{escape(sentence)}[/]", highlight=False)
    console.print(
        "ready" if report["healthy"] else "[red]not ready: the core does not work[/]", highlight=False
    )
