"""Complete or absent outputs: each is written under a temporary name beside its target and then renamed.

Also names from data that become part of a path: such a name is never accepted as a path.
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
"""Longest name of a file or folder that is taken from data [bytes]: file systems allow 255, and suffixes, seeds and
digests are appended."""

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
    """Write one file so that a reader sees either the complete old file or the complete new one.

    Yields the path of an empty temporary file beside the target, with the target's suffix (libraries that
    choose a format by suffix work). If the block ends without an error, the file is flushed to disk and
    renamed to the target; if it raises, is interrupted or the disk is full, the temporary file is removed and
    the target remains unchanged. Missing parent directories are created. A path that cannot be written is
    refused on entry, before any work is done.

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

    Yields an empty temporary directory beside the target. If the block ends without an error, its files are flushed
    to disk and it is renamed to the target; if it raises or is interrupted, it is removed with its contents.

        with atomic_directory("runs/hold", replaces="policy.yaml") as temporary:
            save_network(temporary / "policy.onnx")

    Args:
        path: Directory to create. It may exist if it is empty.
        replaces: Name of a file that marks an earlier output of the same kind. A directory that contains it is
            replaced completely; any other directory with files in it is refused, so that no foreign files are lost.

    Raises:
        OutputError: The target is a file or contains other files, or the system refused to write.
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
    """Refuse a directory that another process is writing to, and lock it for other processes within the block.

    A hidden lock file beside the directory identifies the process. The lock of a process that was killed is replaced.

        with sole_writer("runs/hold"):
            train(...)

    Args:
        path: Directory, which need not exist.

    Raises:
        OutputError: Another process is writing there, or the lock file cannot be created beside the directory.
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
        for folder in made:  # a refused command leaves no folders behind
            try:
                folder.rmdir()
            except OSError:
                break


def _locked(lock: Path, label: str | os.PathLike[str]) -> int:
    """Create the lock file and return its descriptor, which stays open: Windows cannot remove an open file."""
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
        OutputError: The process may still be running.
    """
    try:
        text = lock.read_text(encoding="utf-8")
    except FileNotFoundError:
        return
    try:
        about = json.loads(text)
        pid, host, command = int(about["pid"]), str(about["host"]), str(about["command"])
    except (ValueError, KeyError, TypeError):  # killed, or read, before the lock was written
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
            if aside.read_text(encoding="utf-8") != text:
                # Another process created a new lock in the meantime.
                os.rename(aside, lock)
            else:
                aside.unlink()
                return
    raise OutputError(
        f"cannot write {label}: '{command}' (process {pid} on {host or 'an unknown computer'}) is writing there: wait "
        f"for its end or give another directory; if it does not run any more, remove {lock}"
    )


def _runs(pid: int) -> bool:
    """Return whether a process of this computer is running; True on Windows, where its open lock cannot be
    renamed."""
    if os.name == "nt":
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    try:  # a process that has ended but that its parent has not yet reaped
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return True


def contents(folder: Path) -> dict[str, bytes]:
    """Return the bytes of every file directly in a folder, by name."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def plain_name(name: str, subject: str, error: type[Exception]) -> str:
    """Return a name from data that becomes part of a path, if it is the plain name of one file or folder.

        file = folder / f"{plain_name(name, 'run.mcap: vehicle', ViewError)}.yaml"

    Names that some system interprets as a path or cannot represent are refused: empty, `.`, `..`, absolute,
    with a separator, a drive letter or a control character, too long, or not encodable as a file name.

    Args:
        name: Name from a file, a record, a message or another machine.
        subject: Subject of the error message: the source and the kind of the name.
        error: Class of the error.

    Returns:
        The unchanged name.

    Raises:
        error: The name is refused; the message is one sentence.
    """
    reason = _no_plain_name(name)
    if reason:
        quoted = repr(name if len(name) <= 60 else f"{name[:57]}...")
        raise error(f"{subject} {quoted} {reason}, expected the plain name of a file or folder: rename it")
    return name


def _no_plain_name(name: str) -> str:
    """Return the reason why a name is refused; empty if it is accepted."""
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
    """Exception that leaves an atomic output without creating it."""


def refuse_unwritable(writer: AbstractContextManager[Path]) -> None:
    """Refuse an output path that cannot be written before long work instead of after it; nothing is written.

        refuse_unwritable(atomic_directory("runs/hold", replaces="policy.yaml"))

    Args:
        writer: An `atomic_write` or `atomic_directory` that has not been entered.

    Raises:
        OutputError: The output cannot be written.
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
    """Rename `temporary` to `target`; an earlier output is moved aside first and restored if the rename
    fails."""
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
    """Return a hidden, unused name in the target's directory (a rename never crosses file systems)."""
    return target.with_name(f".{target.stem[:100]}.{secrets.token_hex(6)}.partial{target.suffix}")


def _flush(path: Path) -> None:
    """Wait until the data of a file or directory is on disk, as far as the system can flush it."""
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except PermissionError:
        if path.is_dir():  # Windows cannot open directories
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
    """Convert the system's errors when writing under the target's directory to one `OutputError`."""
    try:
        yield
    except OutputError:
        raise
    except OSError as error:
        if error.errno not in _REMEDIES or not _about_output(error, target):
            raise
        raise OutputError(f"cannot write {label}: {_REMEDIES[error.errno]}") from error


def _about_output(error: OSError, target: Path) -> bool:
    """Return whether the error concerns the output: its file is under the target's directory or above it, or it
    names no file."""
    if error.filename is None:
        return True
    named = Path(os.path.abspath(os.fsdecode(error.filename)))
    return named.is_relative_to(target.parent) or target.is_relative_to(named)
