"""Agents that act in tasks: classical controllers, scripted baselines and policies."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.agents.agent import Agent
    from finssim.agents.catalogue import baseline, baselines_of
    from finssim.agents.controllers import controller
    from finssim.agents.memory import restarted

__all__ = ["Agent", "baseline", "baselines_of", "controller", "restarted"]

__getattr__, __dir__ = exports(__name__)
