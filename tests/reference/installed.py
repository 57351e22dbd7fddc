"""Installed packages for tests: a module and the metadata that pip would write beside it."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def install(
    folder: Path, monkeypatch: Any, name: str, source: str, members: Mapping[str, Mapping[str, str]]
) -> None:
    """Write a package with entry points into its own folder, and put that on the search path.

    Args:
        folder: Target folder.
        monkeypatch: Fixture that removes the path and the imported module after the test.
        name: Name of distribution and module; its version is 1.0.
        source: Code of the module.
        members: Family -> name -> module:object.
    """
    place = folder / f"site_{name}"
    about = place / f"{name}-1.0.dist-info"
    about.mkdir(parents=True)
    (place / f"{name}.py").write_text(source, encoding="utf-8")
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n", encoding="utf-8")
    lines = [
        line
        for family, points in members.items()
        for line in (f"[finssim.{family}]", *(f"{key} = {value}" for key, value in points.items()))
    ]
    (about / "entry_points.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    monkeypatch.syspath_prepend(place)
    monkeypatch.setitem(sys.modules, name, None)
    del sys.modules[name]
