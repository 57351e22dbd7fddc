"""Agents: what acts in a task, from classical controllers and scripted baselines to policies."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.agents.agents import Agent, baseline, restarted
    from finssim.agents.controllers import controller

__all__ = ["Agent", "baseline", "controller", "restarted"]

__getattr__, __dir__ = exports(__name__)
