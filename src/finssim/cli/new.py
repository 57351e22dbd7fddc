"""`finssim new`: create your own vehicle, task, term, sensor, actuator, agent or study from a working example."""

from __future__ import annotations

import json
import keyword
import re
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

from finssim.core.files import atomic_directory

__all__ = ["new"]

PACKAGE = Path(__file__).resolve().parents[1]
TEMPLATES = next(
    folder for folder in (PACKAGE / "templates", PACKAGE.parents[1] / "examples" / "own") if folder.is_dir()
)
"""Folder of the examples, which a wheel contains."""

KINDS: Mapping[str, tuple[str, str, str]] = {
    "vehicle": ("minnow", "", "finssim vehicles show {name}/{name}.yaml"),
    "task": ("keep_depth", "tasks:{dashed} = '{name}:{Name}'", "finssim train {name}/{name}.py:{Name} --out policy"),
    "term": ("wing", "terms:{name} = '{name}:{NAME}'", "python {name}/{name}.py"),
    "sensor": ("pinger", "sensors:{name} = '{name}:{Name}Batch'", "python {name}/{name}.py"),
    "actuator": ("brake", "actuators:{name} = '{name}:{NAME}'", "python {name}/{name}.py"),
    "agent": ("homing", "", "finssim evaluate {name}/{name}.py:{Name} --task t1"),
    "study": ("study", "", "python {name}/{name}.py"),
}  # fmt: skip
"""Kind -> name in its example, entry point by which every command finds it, and command to try first."""

PROJECT = """[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"

[project]
name = "{dashed}"
version = "0.1.0"
dependencies = ["finssim"]

[project.entry-points."finssim.{group}"]
{point}

[tool.hatch.build.targets.wheel]
include = ["{name}.py"]
"""


class TemplateError(ValueError):
    """Template that cannot be created; the message is one sentence."""


def new(kind: str, name: str, *, out: Path | None = None, as_json: bool = False) -> Path:
    """Write your own vehicle, task, term, sensor, actuator, agent or study, which runs and passes its tests.

    The directory contains the file to edit, tests of the laws that it must obey and, for kinds that every
    command can use after installation, the `pyproject.toml` that registers it.

    Example: finssim new vehicle minnow

    Example: finssim new term keel

    Args:
        kind: vehicle, task, term, sensor, actuator, agent or study.
        name: Name of the new object: lower-case letters, digits and underscores.
        out (DIR): Directory to write; default NAME.
        as_json: Print one JSON object instead of text.

    Returns:
        The directory.

    Raises:
        TemplateError: The kind is unknown, or the name is invalid or already used by Python or an installed
            package.
        OutputError: The directory exists.
    """
    if kind not in KINDS:
        raise TemplateError(f"unknown kind '{kind}'; available: {', '.join(KINDS)}")
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or keyword.iskeyword(name):
        raise TemplateError(f"name '{name}', expected small letters, digits and underscores, such as keel_2")
    if kind != "vehicle" and find_spec(name) is not None:
        raise TemplateError(f"Python has a module '{name}' already: choose another name")
    old, point, command = KINDS[kind]
    before, after = _forms(old), _forms(name)
    folder = out or Path(name)
    with atomic_directory(folder) as temporary:
        for template in sorted((TEMPLATES / kind).iterdir()):
            if template.is_file():
                text = _renamed(template.read_text(encoding="utf-8"), before, after)
                (temporary / _renamed(template.name, before, after)).write_text(text, encoding="utf-8")
        if point:
            group, _, entry = point.format(**after).partition(":")
            text = PROJECT.format(group=group, point=entry, **after)
            (temporary / "pyproject.toml").write_text(text, encoding="utf-8")
    shown = command.format(**after).replace(f"{name}/", f"{folder}/")
    messages = {"written": str(folder), "try it": shown, "test it": f"python -m pytest {folder}"}
    if point:
        messages["use it in every command"] = f"pip install -e {folder}"
    print(json.dumps(messages) if as_json else "\n".join(f"{key}: {text}" for key, text in messages.items()))
    return folder


def _forms(name: str) -> dict[str, str]:
    """Return a name in the forms of a module, a class, a constant and a task."""
    camel = "".join(part.capitalize() for part in name.split("_"))
    return {"name": name, "Name": camel, "NAME": name.upper(), "dashed": name.replace("_", "-")}


def _renamed(text: str, before: Mapping[str, str], after: Mapping[str, str]) -> str:
    """Return a text with every form of one name replaced by that of another; words that only contain it are
    not changed."""
    for form in ("name", "Name", "NAME", "dashed"):
        text = re.sub(rf"(?<![A-Za-z]){re.escape(before[form])}(?![a-z])", after[form], text)
    return text
