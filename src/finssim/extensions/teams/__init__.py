"""Teams: tasks of several vehicles, and what they communicate."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.extensions.teams.pursuit import Prey

__all__ = [
    "Prey",
]

__getattr__, __dir__ = exports(__name__)
