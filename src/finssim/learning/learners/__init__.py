"""The learners by name: each turns an environment into a network, with any library."""

from finssim.learning.learners.catalogue import LEARNERS, Learner, LearnerKind, LearningError, learner_named

__all__ = ["LEARNERS", "Learner", "LearnerKind", "LearningError", "learner_named"]
