"""The truth file is readable up to any cut."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from finssim.pool.virtual_pool import FLUSH, TruthError, TruthWriter, read_truth

THRUSTERS = ("a", "b")


def values(i):
    parts = (3, 4, 6, 2, 2, 1, 3)
    return [np.full(size, i + 0.1 * k, dtype=np.float32) for k, size in enumerate(parts)]


def test_what_is_written_is_read(tmp_path):
    """Every column is read back in single precision, the time in double."""
    writer = TruthWriter(tmp_path / "a.truth", THRUSTERS, {"seed": 4})
    for i in range(10):
        writer.write(1000.0 + 0.01 * i, values(i))
    writer.close()
    truth = read_truth(tmp_path / "a.truth")
    assert truth.header["seed"] == 4
    assert np.array_equal(truth.time, 1000.0 + 0.01 * np.arange(10))
    assert truth.thrust.shape == (10, 2) and truth.voltage.shape == (10,)
    np.testing.assert_allclose(truth.shaft_rpm[7], 7.3, rtol=1e-6)


def test_a_cut_file_opens_up_to_the_cut(tmp_path):
    """All complete records before the cut are read."""
    writer = TruthWriter(tmp_path / "a.truth", THRUSTERS, {})
    for i in range(5):
        writer.write(float(i), values(i))
    writer.close()
    data = (tmp_path / "a.truth").read_bytes()
    (tmp_path / "cut.truth").write_bytes(data[:-1])
    assert len(read_truth(tmp_path / "cut.truth").time) == 4


@pytest.mark.slow
def test_a_killed_writer_leaves_all_but_the_last_records(tmp_path):
    """kill -9 loses at most the data not yet passed to the operating system."""
    script = (
        "import sys, time, numpy as np\n"
        "from finssim.pool.virtual_pool import TruthWriter\n"
        "w = TruthWriter(sys.argv[1], ('a',), {})\n"
        "for i in range(475): w.write(0.01 * i, [np.zeros(19, dtype=np.float32)])\n"
        "print('written', flush=True); time.sleep(60)\n"
    )
    path = tmp_path / "a.truth"
    child = subprocess.Popen([sys.executable, "-c", script, str(path)], stdout=subprocess.PIPE, text=True)
    assert child.stdout.readline() == "written\n"
    os.kill(child.pid, signal.SIGKILL)
    child.wait()
    child.stdout.close()
    assert 475 - FLUSH <= len(read_truth(path).time) <= 475


def test_a_full_disk_ends_the_file_and_not_the_pool(tmp_path, caplog):
    """Writing continues without an error, and the log reports it once."""
    if not os.path.exists("/dev/full"):
        pytest.skip("needs /dev/full")
    writer = TruthWriter(tmp_path / "a.truth", THRUSTERS, {})
    writer._file = open("/dev/full", "wb", buffering=0)
    for i in range(3):
        writer.write(float(i), values(i))
    writer.close()
    assert sum("the truth ends" in record.message for record in caplog.records) == 1


def test_what_is_no_truth_file_is_refused(tmp_path):
    """A missing file and a foreign file are refused with different sentences."""
    with pytest.raises(TruthError, match="cannot be read"):
        read_truth(tmp_path / "none")
    (tmp_path / "other").write_text("time,x\n0,1\n")
    with pytest.raises(TruthError, match="is not a truth file"):
        read_truth(tmp_path / "other")
