"""Provenance of an artefact: source revision, package versions, machine. Stored in every policy, report and
result."""

from __future__ import annotations

import platform
import subprocess
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import finssim

PACKAGES = (
    "numpy",
    "scipy",
    "warp-lang",
    "torch",
    "stable_baselines3",
    "gymnasium",
    "onnx",
    "onnxruntime",
    "mujoco",
)
"""Distributions whose version can affect a result."""


def provenance() -> dict[str, Any]:
    """Return the provenance of a saved artefact, as plain values for JSON or YAML.

    It contains no timestamp, so that equal runs write equal files.

    Returns:
        `finssim` (version), `revision` (git commit of the source, or None outside a checkout), `python`,
        `packages` (name -> installed version) and `platform` (system, machine).
    """
    return {
        "finssim": finssim.__version__,
        "revision": revision(),
        "python": platform.python_version(),
        "packages": package_versions(PACKAGES),
        "platform": {"system": platform.platform(), "machine": platform.machine()},
    }


@cache
def revision() -> str | None:
    """Return the git commit of the FinsSim source in use, with `+modified` if its files differ from the commit.

    None if the package is not run from its own checkout (for example installed from a wheel inside another
    project's repository) or git is not available.
    """
    package = Path(finssim.__file__).resolve().parent
    top = _git(package, "rev-parse", "--show-toplevel")
    if top is None or Path(top).resolve() / "src" / "finssim" != package:
        return None
    commit = _git(package, "rev-parse", "HEAD")
    if commit is None:
        return None
    return commit + ("+modified" if _git(package, "status", "--porcelain", "--", ".") else "")


def package_versions(names: tuple[str, ...]) -> dict[str, str]:
    """Return the versions of those named distributions that are installed, without importing any."""
    versions = {}
    for name in names:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return versions


def _git(directory: Path, *arguments: str) -> str | None:
    try:
        answer = subprocess.run(
            ["git", "-C", directory, *arguments], capture_output=True, encoding="utf-8", timeout=10
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return answer.stdout.strip() if answer.returncode == 0 else None
