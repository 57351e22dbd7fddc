"""Learning: training on the batched environment, and trained networks as policy directories."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.learning.export import save_policy
    from finssim.learning.learners.catalogue import learner_named
    from finssim.learning.pettingzoo_env import PettingZooEnv
    from finssim.learning.rsl_rl_env import RslRlVecEnv
    from finssim.learning.sb3 import Sb3VecEnv
    from finssim.learning.tensors import Tensors
    from finssim.learning.torchrl_env import TorchRlEnv

__all__ = [
    "PettingZooEnv",
    "RslRlVecEnv",
    "Sb3VecEnv",
    "Tensors",
    "TorchRlEnv",
    "learner_named",
    "save_policy",
]

__getattr__, __dir__ = exports(__name__)
