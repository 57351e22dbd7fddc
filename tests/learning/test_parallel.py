"""Training in several processes: networks stay equal, and invalid requests are refused."""

import time

import numpy as np
import pytest

from finssim.control.policy import Policy
from finssim.learning.layers import Arrays
from finssim.learning.parallel import leading
from finssim.learning.train import TrainingError, TrainingSettings, train
from reference.averaged_gradients import GRADIENTS, optimize, optimized


@pytest.mark.slow
def test_gradients_are_averaged(tmp_path):
    """Both processes have the parameters of one process with the mean gradients."""
    with leading(2, "cpu", optimize, tmp_path) as group:
        optimize(group, tmp_path)
        while not (tmp_path / "1.npy").is_file():
            time.sleep(0.01)
    expected = optimized(Arrays(1), GRADIENTS.mean(1))
    for rank in range(2):
        np.testing.assert_allclose(np.load(tmp_path / f"{rank}.npy"), expected, rtol=1e-5)


@pytest.mark.slow
def test_a_policy_is_trained_by_two_processes(tmp_path):
    """Two processes run on a CPU with gloo; curves count the steps of both."""
    settings = TrainingSettings(worlds=32, steps=3 * 4096, processes=2, seed=3)
    policy = Policy.load(train("t1", settings, out=tmp_path / "p"))
    assert policy.description.training["complete"] and policy.description.training["processes"] == 2
    assert policy.description.training["steps_done"] == 3 * 4096


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"learner": "sb3-ppo"}, "learner 'sb3-ppo' trains in one"),
        ({"worlds": 33}, "33 worlds cannot be shared by 2"),
        ({"resume": True}, "cannot be resumed"),
        ({"device": "cuda", "processes": 1000, "worlds": 1000}, "but there are . GPUs"),
    ],
)
def test_what_several_processes_cannot_share_is_refused(tmp_path, changes, sentence):
    """Each request is refused in one sentence, before anything is created."""
    options = {"worlds": 32, "processes": 2, **changes}
    resume = options.pop("resume", False)
    if resume:
        (tmp_path / "p-training").mkdir()
    with pytest.raises(TrainingError, match=sentence):
        train("t1", TrainingSettings(**options), out=tmp_path / "p", resume=resume)
    assert not (tmp_path / "p").exists()
