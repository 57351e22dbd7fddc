"""Output is complete or absent, and a refusal is one sentence."""

import json
import os
import resource
import signal
import socket
import subprocess
import sys

import pytest

from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.core.files import (
    OutputError,
    atomic_directory,
    atomic_write,
    plain_name,
    refuse_unwritable,
    sole_writer,
)


def entries(directory):
    """Return the names in a directory, hidden ones included."""
    return sorted(entry.name for entry in directory.iterdir())


def test_a_file_appears_whole_and_alone(tmp_path):
    """The target contains the written text, parents are created, and no temporary file remains."""
    target = tmp_path / "new" / "report.html"
    with atomic_write(target) as temporary:
        temporary.write_text("first")
        assert temporary.suffix == ".html" and not target.exists()
    assert target.read_text() == "first" and entries(target.parent) == ["report.html"]


def test_a_failed_write_leaves_the_old_file(tmp_path):
    """Any error inside the block keeps the earlier content and removes the partial file."""
    target = tmp_path / "table.csv"
    target.write_text("old")
    for error in (RuntimeError("boom"), KeyboardInterrupt()):
        with pytest.raises(type(error)), atomic_write(target) as temporary:
            temporary.write_text("half")
            raise error
    assert target.read_text() == "old" and entries(tmp_path) == ["table.csv"]


def test_new_files_follow_the_umask(tmp_path):
    """A new file has the permissions of any other file of the user."""
    (tmp_path / "plain").touch()
    with atomic_write(tmp_path / "ours"):
        pass
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_symbolic_link_is_followed(tmp_path):
    """Writing to a link writes the file that it names."""
    (tmp_path / "real").write_text("old")
    (tmp_path / "link").symlink_to("real")
    with atomic_write(tmp_path / "link") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "real").read_text() == "new"


@pytest.mark.parametrize("atomic", [atomic_write, atomic_directory])
def test_a_file_as_parent_is_refused_on_entry(tmp_path, atomic):
    """A path through a file is refused before the block runs."""
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=r"cannot write .*/file/out: part of that path is a file"):
        with atomic(tmp_path / "file" / "out"):
            pytest.fail("the block ran")


@pytest.mark.parametrize("atomic", [atomic_write, atomic_directory])
def test_a_place_that_takes_no_files_is_refused_on_entry(atomic):
    """/proc refuses files from everyone, the superuser included."""
    with pytest.raises(OutputError, match=r"^cannot write /proc/finssim/out: .* write elsewhere$"):
        with atomic("/proc/finssim/out"):
            pytest.fail("the block ran")


def test_directories_and_devices_are_no_files(tmp_path):
    """A directory is not replaced by a file, and a device is not replaced at all."""
    with pytest.raises(OutputError, match="is a directory"), atomic_write(tmp_path):
        pass
    with pytest.raises(OutputError, match="not an ordinary file"), atomic_write(os.devnull):
        pass


@pytest.mark.slow
def test_a_full_disk_leaves_nothing(tmp_path):
    """A write past the limit on file sizes fails as on a full disk: one sentence, no file."""
    target = tmp_path / "big.bin"
    script = (
        "import sys; from finssim.core.files import *\n"
        "try:\n"
        "    with atomic_write(sys.argv[1]) as temporary: temporary.write_bytes(bytes(100_000))\n"
        "except OutputError as error: print(error)\n"
    )

    def limit():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))

    run = subprocess.run(
        [sys.executable, "-B", "-c", script, target],
        preexec_fn=limit,
        capture_output=True,
        text=True,
        check=True,
    )
    assert run.stdout.startswith(f"cannot write {target}: the file grew past the limit")
    assert entries(tmp_path) == []


def test_no_space_left_is_said_so(tmp_path):
    """ENOSPC, here from /dev/full, becomes its sentence; the partial file is removed."""
    with pytest.raises(OutputError, match=r"cannot write .*log.csv: the disk is full: free some space"):
        with atomic_write(tmp_path / "log.csv"), open("/dev/full", "w") as full:
            full.write("x")
    assert entries(tmp_path) == []


def test_an_unreadable_input_is_not_called_an_output(tmp_path):
    """An input that is missing keeps its own error."""
    with pytest.raises(FileNotFoundError, match="nowhere"), atomic_write(tmp_path / "out"):
        open("/nowhere/at/all")


def test_a_directory_appears_whole(tmp_path):
    """The name is free until the block ends; then it has every file, and no temporary directory remains."""
    with atomic_directory(tmp_path / "policy") as temporary:
        (temporary / "sub").mkdir()
        (temporary / "sub" / "a.txt").write_text("a")
        assert not (tmp_path / "policy").exists()
    assert (tmp_path / "policy" / "sub" / "a.txt").read_text() == "a" and entries(tmp_path) == ["policy"]


def test_an_interrupted_directory_leaves_nothing(tmp_path):
    """Control-C removes the partial directory."""
    with pytest.raises(KeyboardInterrupt), atomic_directory(tmp_path / "policy") as temporary:
        (temporary / "half").touch()
        raise KeyboardInterrupt
    assert entries(tmp_path) == []


def test_only_an_earlier_output_is_replaced(tmp_path):
    """A directory with the marker of its kind is replaced as a whole; other files are refused on entry."""
    policy = tmp_path / "policy"
    for content in ("one", "two"):
        with atomic_directory(policy, replaces="policy.yaml") as temporary:
            (temporary / "policy.yaml").write_text(content)
            (temporary / content).touch()
    assert entries(policy) == ["policy.yaml", "two"] and entries(tmp_path) == ["policy"]
    with pytest.raises(OutputError, match="already holds files"):
        with atomic_directory(policy, replaces="report.html"):
            pytest.fail("the block ran")
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="it is a file"), atomic_directory(tmp_path / "file"):
        pass


@pytest.mark.slow
def test_a_killed_run_leaves_no_target(tmp_path):
    """A process that is killed while it writes leaves the target's name free."""
    script = (
        "import sys, time; from finssim.core.files import *\n"
        "with atomic_write(sys.argv[1]) as temporary:\n"
        "    temporary.write_text('half'); print('writing', flush=True); time.sleep(60)\n"
    )
    run = subprocess.Popen(
        [sys.executable, "-c", script, tmp_path / "out"], stdout=subprocess.PIPE, text=True
    )
    assert run.stdout.readline() == "writing\n"
    run.kill()
    run.wait()
    assert not (tmp_path / "out").exists()


def test_a_place_is_tried_without_leaving_anything(tmp_path):
    """Before long work, an unwritable path is refused and a writable one is left as it was."""
    (tmp_path / "old.yaml").write_text("old")
    refuse_unwritable(atomic_write(tmp_path / "old.yaml"))
    refuse_unwritable(atomic_directory(tmp_path / "new"))
    assert entries(tmp_path) == ["old.yaml"] and (tmp_path / "old.yaml").read_text() == "old"
    with pytest.raises(OutputError, match="already holds files"):
        refuse_unwritable(atomic_directory(tmp_path))


NO_NAMES = {
    "": "is empty",
    " ": "is empty",
    ".": "is a folder's link",
    "..": "is a folder's link",
    "/etc/passwd": "has a separator",
    "../x": "has a separator",
    "a/b": "has a separator",
    "a/": "has a separator",
    "..\\x": "has a separator",
    "\\\\server\\share": "has a separator",
    "C:": "has the letter of a drive",
    "c:x": "has the letter of a drive",
    "a\0b": "has a control character",
    "a\nb": "has a control character",
    "a\x7f": "has a control character",
    "a\u2028b": "has a control character",
    "a" * 201: "is 201 bytes long, more than 200",
    "\u00fc" * 101: "is 202 bytes long",
    "\ud800": "no file's name can have",
}


@pytest.mark.parametrize(("name", "reason"), NO_NAMES.items(), ids=map(ascii, range(len(NO_NAMES))))
def test_a_name_from_data_is_no_path(name, reason):
    """Separators and drives of every system are refused; one sentence names the source, the text and the remedy."""
    with pytest.raises(KeyError, match=reason) as refused:
        plain_name(name, "run.mcap: vehicle", KeyError)
    sentence = refused.value.args[0]
    assert sentence.startswith("run.mcap: vehicle '") and sentence.endswith("rename it")
    assert sentence.isprintable() and len(sentence) < 200


@pytest.mark.parametrize(
    "name",
    [
        "finsrov",
        "surge +3 N",
        "2024-05-01T12:30:00",
        "..a",
        "a..",
        "...",
        ".x",
        "\u6c34\u69fd",
        "a" * 200,
        "\udcff",
        "~",
        "$HOME",
    ],
)
def test_a_plain_name_is_one_file_of_its_folder(tmp_path, name):
    """The name is returned unchanged, and a file of that name lies in the intended folder, beside its temporary one."""
    with atomic_write(tmp_path / f"{plain_name(name, 'trial', KeyError)}.yaml") as temporary:
        assert temporary.parent == tmp_path
    assert [file.name for file in tmp_path.iterdir()] == [f"{name}.yaml"]


def test_a_directory_has_one_writer(tmp_path, capsys):
    """The second writer is told of the first; afterwards, and after a refused command, no lock remains."""
    out = tmp_path / "new" / "hold"
    with sole_writer(out), sole_writer(tmp_path / "new" / "other"):
        with pytest.raises(
            OutputError, match=rf"hold: '.*' \(process {os.getpid()} on .*\) is writing there"
        ):
            with sole_writer(tmp_path / "new" / ".." / "new" / "hold"):
                pytest.fail("two writers")
        assert boundary.run(app, ["train", "t1", "--out", str(out)]) == 2
        assert "is writing there" in capsys.readouterr().err
        out.mkdir()
    assert entries(tmp_path / "new") == ["hold"]
    assert boundary.run(app, ["train", "nosuch", "--out", str(tmp_path / "a" / "b")]) == 2
    assert entries(tmp_path) == ["new"]


def test_a_lock_of_a_dead_process_is_replaced_and_one_of_another_computer_is_not(tmp_path):
    """A dead process's lock is replaced, so that a killed training can be resumed; another computer's is kept."""
    lock = tmp_path / ".hold.lock"
    for host, refused in ((socket.gethostname(), False), ("elsewhere", True)):
        lock.write_text(json.dumps({"pid": 2**30, "host": host, "command": "finssim train"}))
        if refused:
            with pytest.raises(OutputError, match="on elsewhere"), sole_writer(tmp_path / "hold"):
                pytest.fail("two writers")
        else:
            with sole_writer(tmp_path / "hold"):
                assert json.loads(lock.read_text())["pid"] == os.getpid()
            assert entries(tmp_path) == []
