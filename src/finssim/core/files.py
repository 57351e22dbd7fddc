"""Output that is either complete or absent: written beside its target under another name, then renamed into place.

And names that may become part of a path: one that came from data is never a path itself.
"""

from __future__ import annotations

import errno
import json
import os
import secrets
import shutil
import socket
import sys
import unicodedata
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

LONGEST_NAME = 200
"""Longest name of a file or folder that data gives [bytes]: 255 are possible, and suffixes, seeds and digests are
added."""

_REMEDIES = {
    errno.ENOSPC: "the disk is full: free some space or write elsewhere",
    errno.EDQUOT: "the disk quota is used up: free some space or write elsewhere",
    errno.EFBIG: "the file grew past the limit on file sizes: raise the limit or write elsewhere",
    errno.EROFS: "the file system is read-only: write elsewhere",
    errno.EACCES: "permission denied: write elsewhere or ask for the right to write there",
    errno.EPERM: "not permitted there: write elsewhere",
    errno.EEXIST: "part of that path is a file, not a directory: write elsewhere",
    errno.ENOTDIR: "part of that path is a file, not a directory: write elsewhere",
    errno.ENOENT: "the directory cannot be made there: write elsewhere",
    errno.ENAMETOOLONG: "the name is too long: give a shorter one",
}


class OutputError(OSError):
    """An output could not be written; the message is one sentence that names the path and what to do."""


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Write one file so that a reader sees either the old or the new file, never a part.

    Yields the path of an empty temporary file beside the target, with the target's suffix (libraries that choose a
    format by suffix work). When the block ends well, the file is flushed to disk and renamed over the target; when it
    raises, is interrupted or the disk fills, the temporary file is removed and the target stays as it was. Missing
    parent directories are made. A place that cannot be written is refused on entry, before any work is done.

        with atomic_write("run/report.html") as temporary:
            temporary.write_text(html, encoding="utf-8")

    Args:
        path: File to write. A symbolic link is followed.

    Raises:
        OutputError: The target is a directory or a device, or the system refused to write.
    """
    target = Path(os.path.realpath(path))
    with _as_output_error(target, label=path):
        if target.is_dir():
            raise OutputError(f"cannot write {path}: it is a directory: give a file name")
        if target.exists() and not target.is_file():
            raise OutputError(f"cannot write {path}: it is not an ordinary file: write elsewhere")
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = _beside(target)
        temporary.touch(exist_ok=False)
        try:
            yield temporary
            _flush(temporary)
            os.replace(temporary, target)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        _flush(target.parent)


@contextmanager
def atomic_directory(path: str | os.PathLike[str], *, replaces: str | None = None) -> Iterator[Path]:
    """Fill a directory so that it appears complete or not at all.

    Yields an empty temporary directory beside the target. When the block ends well its files are flushed to disk and it
    takes the target's name; when it raises or is interrupted it is removed with all it holds.

        with atomic_directory("runs/hold", replaces="policy.yaml") as temporary:
            save_network(temporary / "policy.onnx")

    Args:
        path: Directory to make. It may exist if it is empty.
        replaces: Name of a file that marks an earlier output of the same kind. A directory holding it is replaced as a
            whole; any other directory with files in it is refused, so that nobody's files are lost.

    Raises:
        OutputError: The target is a file or holds other files, or the system refused to write.
    """
    target = Path(os.path.realpath(path))
    with _as_output_error(target, label=path):
        _refuse_foreign(target, path, replaces)
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = _beside(target)
        temporary.mkdir()
        try:
            yield temporary
            for file in temporary.rglob("*"):
                _flush(file)
            _refuse_foreign(target, path, replaces)
            _swap_in(target, temporary)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
        _flush(target.parent)


@contextmanager
def sole_writer(path: str | os.PathLike[str]) -> Iterator[None]:
    """Refuse a directory that another process writes into, and keep others out while the block lasts.

    A hidden file beside the directory names the process. One that a killed process left behind is replaced.

        with sole_writer("runs/hold"):
            train(...)

    Args:
        path: Directory, which need not exist.

    Raises:
        OutputError: Another process writes there, or there is no place beside the directory.
    """
    target = Path(os.path.realpath(path))
    lock = target.with_name(f".{target.name[:100]}.lock")
    with _as_output_error(target, label=path):
        made = [folder for folder in lock.parents if not folder.exists()]
        lock.parent.mkdir(parents=True, exist_ok=True)
        file = _locked(lock, path)
    try:
        yield
    finally:
        os.close(file)
        lock.unlink(missing_ok=True)
        for folder in made:  # of a refused command nothing stays
            try:
                folder.rmdir()
            except OSError:
                break


def _locked(lock: Path, label: str | os.PathLike[str]) -> int:
    """Make the lock file and return its descriptor, which stays open: Windows removes no open file."""
    about = {
        "pid": os.getpid(),
        "host": socket.gethostname(),
        "command": " ".join(["finssim", *sys.argv[1:]])[:200],
    }
    for _ in range(10):
        try:
            file = os.open(lock, os.O_CREAT | os.O_EXCL | os.O_WRONLY)
        except FileExistsError:
            _remove_stale(lock, label)
            continue
        os.write(file, json.dumps(about).encode())
        return file
    raise OutputError(f"cannot write {label}: {lock} cannot be replaced: remove it")


def _remove_stale(lock: Path, label: str | os.PathLike[str]) -> None:
    """Remove the lock of a process that has ended.

    Raises:
        OutputError: The process may still run.
    """
    try:
        text = lock.read_text(encoding="utf-8")
    except FileNotFoundError:
        return
    try:
        about = json.loads(text)
        pid, host, command = int(about["pid"]), str(about["host"]), str(about["command"])
    except (ValueError, KeyError, TypeError):  # killed, or seen, before it was written
        pid, host, command = 0, "", "another process"
    if host == socket.gethostname() and not _runs(pid):
        aside = _beside(lock)
        try:
            os.rename(lock, aside)
        except FileNotFoundError:
            return  # another process was faster
        except PermissionError:
            pass  # Windows: it is open
        else:
            if aside.read_text(encoding="utf-8") != text:  # another process made it in between
                os.rename(aside, lock)
            else:
                aside.unlink()
                return
    raise OutputError(
        f"cannot write {label}: '{command}' (process {pid} on {host or 'an unknown computer'}) is writing there: wait "
        f"for its end or give another directory; if it does not run any more, remove {lock}"
    )


def _runs(pid: int) -> bool:
    """Return whether a process of this computer runs; not asked on Windows, where its open file cannot be renamed."""
    if os.name == "nt":
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    try:  # one that ended, but for its parent to notice
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return True


def contents(folder: Path) -> dict[str, bytes]:
    """Return the bytes of every file directly in a folder, by name."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def plain_name(name: str, subject: str, error: type[Exception]) -> str:
    """Return a name from data that becomes part of a path, if it names one file or folder in one place.

        file = folder / f"{plain_name(name, 'run.mcap: vehicle', ViewError)}.yaml"

    Refused are names that any system reads as a path or not at all: empty, `.`, `..`, absolute, with a separator, a
    drive letter or a control character, too long, or in no encoding of files.

    Args:
        name: From a file, a record, a message or another machine.
        subject: What is named and by whom; the message begins with it.
        error: Class of the refusal.

    Returns:
        The name as it is.

    Raises:
        error: The name is refused, in one sentence.
    """
    reason = _no_plain_name(name)
    if reason:
        quoted = repr(name if len(name) <= 60 else f"{name[:57]}...")
        raise error(f"{subject} {quoted} {reason}, expected the plain name of a file or folder: rename it")
    return name


def _no_plain_name(name: str) -> str:
    """Return why a name is refused; empty if it is accepted."""
    if not name.strip():
        return "is empty"
    if name in (".", ".."):
        return "is a folder's link"
    if any(c in "/\\" for c in name):
        return "has a separator of folders"
    if len(name) > 1 and name[1] == ":" and name[0].isascii() and name[0].isalpha():
        return "has the letter of a drive"
    if any(unicodedata.category(c) in ("Cc", "Zl", "Zp") for c in name):
        return "has a control character"
    try:
        size = len(os.fsencode(name))
    except UnicodeEncodeError:
        return "has a character that no file's name can have"
    return f"is {size} bytes long, more than {LONGEST_NAME}" if size > LONGEST_NAME else ""


class _Probe(Exception):
    """Leaves an atomic output without making it."""


def refuse_unwritable(writer: AbstractContextManager[Path]) -> None:
    """Refuse a place that cannot be written before long work, not after it; nothing is written.

        refuse_unwritable(atomic_directory("runs/hold", replaces="policy.yaml"))

    Args:
        writer: An `atomic_write` or `atomic_directory` that has not been entered.

    Raises:
        OutputError: As the place says.
    """
    try:
        with writer:
            raise _Probe
    except _Probe:
        pass


def _refuse_foreign(target: Path, label: str | os.PathLike[str], replaces: str | None) -> None:
    if not target.exists():
        return
    if not target.is_dir():
        raise OutputError(f"cannot write {label}: it is a file: give a directory name")
    ours = replaces is not None and (target / replaces).is_file()
    if not ours and any(target.iterdir()):
        raise OutputError(f"cannot write {label}: the directory already holds files: give a new or empty one")


def _swap_in(target: Path, temporary: Path) -> None:
    """Rename `temporary` to `target`; an earlier output steps aside first and returns if the rename fails."""
    if not target.exists():
        os.rename(temporary, target)
        return
    earlier = _beside(target)
    os.rename(target, earlier)
    try:
        os.rename(temporary, target)
    except BaseException:
        os.rename(earlier, target)
        raise
    shutil.rmtree(earlier, ignore_errors=True)


def _beside(target: Path) -> Path:
    """A hidden, unused name in the target's directory (a rename never crosses file systems)."""
    return target.with_name(f".{target.stem[:100]}.{secrets.token_hex(6)}.partial{target.suffix}")


def _flush(path: Path) -> None:
    """Wait until a file's or directory's data is on disk, as far as the system can flush it."""
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except PermissionError:
        if path.is_dir():  # Windows opens no directories
            return
        raise
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:  # this file system has no fsync
            raise
    finally:
        os.close(descriptor)


@contextmanager
def _as_output_error(target: Path, *, label: str | os.PathLike[str]) -> Iterator[None]:
    """Turn the system's refusals to write under the target's directory into one `OutputError`."""
    try:
        yield
    except OutputError:
        raise
    except OSError as error:
        if error.errno not in _REMEDIES or not _about_output(error, target):
            raise
        raise OutputError(f"cannot write {label}: {_REMEDIES[error.errno]}") from error


def _about_output(error: OSError, target: Path) -> bool:
    """Return whether the error concerns the output: its file is under the target's directory or above it, or has no
    name."""
    if error.filename is None:
        return True
    named = Path(os.path.abspath(os.fsdecode(error.filename)))
    return named.is_relative_to(target.parent) or target.is_relative_to(named)
