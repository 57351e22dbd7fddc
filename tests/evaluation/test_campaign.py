"""A campaign plays each trial once, keeps finished results, and returns results in the order of its jobs."""

import json
import math
import os
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from signal import SIGINT, SIGKILL, SIGTERM

import pytest

from finssim.evaluation import campaign
from finssim.evaluation.campaign import ResultError, keep_result, load_result, run_jobs, write_json
from finssim.evaluation.robot_trials import RobotJob
from reference import played

ROOT = Path(__file__).resolve().parents[2]
JOBS = [RobotJob(row="pid", controller="pid", target=target) for target in ("P01", "P02", "P03")]


def marks(folder):
    """Return the targets that were played, sorted."""
    return sorted((folder / "played.txt").read_text().split())


@pytest.mark.slow
def test_results_come_in_the_order_of_the_jobs(tmp_path):
    """Results have the order of the jobs, whichever process ended first."""
    results = run_jobs(JOBS, tmp_path, played.known, processes=2)
    assert [r["job"]["target"] for r in results] == ["P01", "P02", "P03"]
    assert [r["success"] for r in results] == [True, False, True]


@pytest.mark.slow
def test_what_is_finished_is_not_played_again(tmp_path):
    """A second call plays only new jobs."""
    run_jobs(JOBS[:2], tmp_path, played.known, processes=1)
    told, shown = [], []
    run_jobs(
        JOBS,
        tmp_path,
        played.known,
        processes=1,
        progress=lambda part, what: told.append(part),
        show=lambda job, result: shown.append((job.target, result["success"])),
    )
    assert marks(tmp_path) == ["P01", "P02", "P03"]
    assert told[-1] == 1.0 and shown == [("P03", True)]


def test_a_result_that_was_changed_is_not_gone_on_with(tmp_path):
    """A result reads back exactly, numbers of 70 bits included; a changed digit, a missing key or half is refused."""
    path, result = tmp_path / "P01.json", {"e_p": 0.1 + 0.2, "seed": 2**70, "target": ["P01", None]}
    keep_result(path, result)
    assert load_result(path) == result
    text = path.read_text()
    for changed, reason in (
        (text.replace("P01", "P02"), "has been changed since it was written: remove it"),
        (text.replace("seed", "sead"), "has been changed since it was written"),
        (text[:20], "not valid JSON"),
        ("{}", "expected a JSON object with the key 'sha256'"),
    ):
        path.write_text(changed)
        with pytest.raises(ResultError, match=reason):
            load_result(path)


@pytest.mark.slow
def test_a_trial_that_breaks_loses_no_other(tmp_path):
    """The error of a broken trial is raised; the results so far stay complete."""
    with pytest.raises(RuntimeError, match="P02 broke"):
        run_jobs(JOBS, tmp_path, played.failing, processes=1)
    kept = [json.loads(path.read_text()) for path in tmp_path.glob("*.json")]
    assert [r["job"]["target"] for r in kept] == ["P01"]


def gone(pid):
    """Return whether a process has ended."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return Path(f"/proc/{pid}/stat").read_text().split()[2] == "Z"


@pytest.mark.slow
@pytest.mark.parametrize("signal", [SIGTERM, SIGKILL, SIGINT], ids=lambda signal: signal.name)
def test_workers_do_not_outlive_a_campaign(tmp_path, signal):
    """However the campaign ends, no worker continues to play its trials."""
    program = (
        "import sys; sys.path.insert(0, 'tests')\n"
        "from pathlib import Path\nfrom reference import played\n"
        "from finssim.evaluation.campaign import run_jobs\n"
        "from finssim.evaluation.robot_trials import RobotJob\n"
        "if __name__ == '__main__':\n"
        "    jobs = [RobotJob(row='pid', controller='pid', target='P01')]\n"
        f"    run_jobs(jobs, Path({str(tmp_path)!r}), played.endless, processes=2)\n"
    )
    script = tmp_path / "campaign_of_one.py"
    script.write_text(program)
    campaign = subprocess.Popen([sys.executable, script], cwd=ROOT, stderr=subprocess.DEVNULL)
    mark = tmp_path / "pid.txt"
    wait_until(lambda: mark.is_file() and mark.read_text())
    worker = int(mark.read_text())
    campaign.send_signal(signal)
    campaign.wait(60.0)
    wait_until(lambda: gone(worker))


def wait_until(true):
    """Wait for a condition that becomes true soon, or fail."""
    for _ in range(1200):
        if true():
            return
        time.sleep(0.1)
    raise AssertionError("nothing happened for two minutes")


def test_a_key_names_everything_that_decides_the_result():
    """Another noise, camera or plant is another trial; another row of the same trial differs in its name alone."""
    base = JOBS[0]
    others = [
        RobotJob(row="pid", controller="pid", target="P01", **change)
        for change in (
            {"plant": 2},
            {"seed": 2},
            {"severity": "hard"},
            {"camera": "corners"},
            {"fusion": False},
            {"position_noise": 0.05},
            {"yaw_noise": 0.1},
            {"vehicle": "bluerov2"},
            {"pool_vehicle": "bluerov2"},
            {"duration": 30.0},
        )
    ]
    assert len({job.key() for job in (base, *others)}) == len(others) + 1
    assert RobotJob(row="x", controller="pid", target="P01").key().removeprefix(
        "x"
    ) == base.key().removeprefix("pid")


def test_a_result_with_nan_is_refused_and_nothing_is_written(tmp_path):
    with pytest.raises(ResultError, match="result.json: not written, since it contains a non-finite number"):
        write_json(tmp_path / "result.json", {"e_p_m": math.nan})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "says, reason", [(b"", "timed out"), (b"SSH-2.0-OpenSSH_9.6\r\n", "another program")]
)
def test_a_stranger_at_the_address_of_a_cluster_is_found_out(monkeypatch, says, reason):
    """A silent server is refused after the time for an answer, one with another greeting at once."""
    monkeypatch.setattr(campaign, "PATIENCE", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        address = f"127.0.0.1:{listener.getsockname()[1]}"

        def greet():
            guest = listener.accept()[0]
            with suppress(ConnectionResetError):
                guest.sendall(says)
                while guest.recv(1 << 10):  # until the other end has closed
                    pass
            guest.close()

        stranger = threading.Thread(target=greet)
        stranger.start()
        with pytest.raises(campaign.ClusterError, match=f"no Ray cluster answers at {address}: .*{reason}"):
            campaign._knock(address)
        stranger.join(10.0)
    assert not stranger.is_alive()


@pytest.mark.parametrize("processes", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_further_jobs_are_prepared_while_others_are_played(tmp_path, processes):
    """The results of jobs added later follow, and a second call plays none of them again."""
    shown = []

    def more():
        return JOBS[2:]

    for _ in range(2):
        results = run_jobs(
            JOBS[:2], tmp_path, played.known, processes=processes, more=more,
            show=lambda job, result: shown.append(job.target),
        )  # fmt: skip
        assert [result["job"]["target"] for result in results] == [job.target for job in JOBS]
    assert sorted(shown) == sorted({job.target for job in JOBS})
