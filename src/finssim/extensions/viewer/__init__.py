"""A live view in the browser of the virtual pool, of the simulator, and of records."""

from typing import TYPE_CHECKING

from finssim.core.lazy import exports

if TYPE_CHECKING:
    from finssim.extensions.viewer.run import SourceChoice, open_source

__all__ = [
    "SourceChoice",
    "open_source",
]

__getattr__, __dir__ = exports(__name__)
