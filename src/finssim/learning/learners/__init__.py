"""The learners by name: each trains a network in an environment, with any library."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.learning.learners.catalogue import (
        LEARNERS,
        Learner,
        LearnerKind,
        LearningError,
        learner_named,
    )

__all__ = ["LEARNERS", "Learner", "LearnerKind", "LearningError", "learner_named"]

__getattr__, __dir__ = exports(__name__)
