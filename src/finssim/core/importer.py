"""Importers of other programs' files: the class of the members of `IMPORTERS`, and the selection by content.

An importer is one file with an `Importer`, registered as `KIND.FORMAT`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from finssim.core.registry import IMPORTERS, RegistryError

__all__ = ["Importer", "check_registered", "first_bytes", "importers", "recognised"]

KINDS = ("vehicle", "trial", "lens")
"""Kinds of content that can be imported."""
HEAD = 1 << 20
"""Number of bytes from which an importer recognises its format."""


@dataclass(frozen=True)
class Importer:
    """Importer of the files of one format."""

    kind: str
    """Kind of content: vehicle, trial or lens."""
    title: str
    """Name of the format."""
    recognises: Callable[[Path, bytes], bool]
    """Function of a path and the first bytes of its file (none for a folder) that returns whether it has this
    format."""
    read: Callable[..., Any]
    """Function that reads a file; it reports errors in one sentence.

    Its arguments are a path, and a list of folders if `folders`, for a vehicle (returns a `Draft`); a path
    and a `Request` for a log (`TrialStreams`); a path for a lens (`Lens`).
    """
    folders: bool = False
    """True if its files refer to other files by a package name or relative to a folder that is not in the
    file."""
    general: bool = False
    """True if more specific formats are tried first."""


def check_registered(name: str, member: Any) -> None:
    """Refuse an object that is not an importer.

    Args:
        name: Name in the family: the kind of content, a dot, and the format.
        member: Object that is registered under this name.

    Raises:
        RegistryError: The name or the object is not valid.
    """
    kind, _, format = name.partition(".")
    if kind not in KINDS or not format:
        raise RegistryError(
            f"importer '{name}': expected a name that begins with {' or '.join(f'{one}.' for one in KINDS)}"
        )
    if not isinstance(member, Importer) or member.kind != kind:
        raise RegistryError(f"{name} is {member!r}, expected an Importer of kind '{kind}': register it so")


def importers(kind: str) -> dict[str, Importer]:
    """Return the importers of a kind by format; general ones come last."""
    usable = {
        name.partition(".")[2]: member
        for name, member in IMPORTERS.usable().items()
        if name.startswith(f"{kind}.")
    }
    return dict(sorted(usable.items(), key=lambda item: item[1].general))


def first_bytes(path: Path) -> bytes:
    """Return the bytes of a file from which its format is recognised; none for a folder."""
    if not path.is_file():
        return b""
    with path.open("rb") as file:
        return file.read(HEAD)


def recognised(kind: str, path: Path) -> str | None:
    """Return the format of the first importer of a kind that recognises a file or folder; None if none does."""
    head = first_bytes(path)
    return next((name for name, one in importers(kind).items() if one.recognises(path, head)), None)
