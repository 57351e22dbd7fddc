"""A learner from outside the package: one file with a class, selected by name on the command line."""

import pytest

from finssim.control.policy import Policy
from finssim.learning.learners import LearningError, learner_named
from finssim.learning.train import TrainingSettings, train
from finssim.tasks import EnvironmentSetupError

CLIMB = '''
"""Random search (Rechenberg 1973): keep a change of the weights if the next episodes earn more."""
from dataclasses import dataclass

import numpy as np

from finssim.learning.learners.base import ActingLearner
from finssim.learning.network import Linear, Network


@dataclass(frozen=True, kw_only=True)
class Settings:
    worlds: int = 16
    steps: int = 2048
    spread: float = 0.1


class Climb(ActingLearner):
    """Random search on a linear policy."""

    Settings = Settings

    def __init__(self, environment, settings, *, seed, device="cpu"):
        super().__init__(environment, settings)
        self.rng = np.random.default_rng(seed)
        self.best = np.zeros((environment.observation_size, environment.action_size), np.float32)
        self.score = -np.inf

    def update(self):
        e = self.environment
        tried = self.best + self.settings.spread * self.rng.standard_normal(self.best.shape).astype(np.float32)
        earned = 0.0
        for _ in range(32):
            e.arrays.action.numpy()[:] = e.arrays.observation.numpy() @ tried
            e.advance()
            self.tally.look()
            earned += float(e.arrays.reward.numpy().mean())
        if earned > self.score:
            self.best, self.score = tried, earned
        self.steps += 32 * e.worlds
        return {**self.tally.row(), "score": self.score}

    def network(self):
        return Network((Linear(self.best.copy(), None),))

    def learned(self):
        return {"best": self.best, "score": self.score, "stream": self.rng.bit_generator.state}

    def load_learned(self, state):
        self.best, self.score = state["best"], state["score"]
        self.rng.bit_generator.state = state["stream"]


class Nothing:
    """No learner."""
'''


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "climb.py"
    path.write_text(CLIMB, encoding="utf-8")
    return path


def test_a_learner_of_ones_own_trains_resumes_and_says_what_it_is(file, tmp_path):
    """The learner's settings, name and steps are recorded in the policy, which runs without the learner."""
    folder = train(
        "t1", TrainingSettings(learner=f"{file}:Climb", seed=3, settings={"spread": 0.2}), out=tmp_path / "p"
    )
    policy = Policy.load(folder)
    told = policy.description.training
    assert (told["learner"], told["spread"], told["steps_done"]) == (f"{file}:Climb", 0.2, 2048)
    assert told["algorithm"] == "Random search on a linear policy."
    again = train(
        "t1", TrainingSettings(learner=f"{file}:Climb", seed=3, settings={"spread": 0.2}), out=tmp_path / "q"
    )
    assert (folder / "policy.onnx").read_bytes() == (again / "policy.onnx").read_bytes()


def test_what_is_no_learner_is_refused(file, tmp_path):
    """Refused: a class of another kind, an unknown name, and a missing file."""
    with pytest.raises(LearningError, match="is no learner: derive it from finssim.learning.learners.base"):
        learner_named(f"{file}:Nothing")
    with pytest.raises(EnvironmentSetupError, match="has no learner 'Climp'; learners there: Climb"):
        learner_named(f"{file}:Climp")
    with pytest.raises(EnvironmentSetupError, match="there is no file"):
        learner_named(f"{tmp_path / 'none.py'}:Climb")
