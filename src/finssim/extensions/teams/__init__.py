"""Teams: tasks of several vehicles and the messages between them."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.extensions.teams.pursuit import Prey

__all__ = [
    "Prey",
]

__getattr__, __dir__ = exports(__name__)
