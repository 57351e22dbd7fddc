"""`rclpy.task`: answers that have yet to come."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

__all__ = ["Future"]


class Future:
    """An answer that comes while some executor spins. Not to be awaited: coroutines need a sourced ROS 2."""

    def __init__(self, *, executor: Any = None) -> None:
        self._finished = threading.Event()
        self._result: Any = None
        self._exception: BaseException | None = None
        self._cancelled = False
        self._callbacks: list[Callable[[Future], Any]] = []

    def done(self) -> bool:
        """Whether it has come, or never will."""
        return self._finished.is_set()

    def cancelled(self) -> bool:
        """Whether nobody waits for it any more."""
        return self._cancelled

    def result(self) -> Any:
        """The answer; None until then. Raises what the asked one raised."""
        if self._exception is not None:
            raise self._exception
        return self._result

    def exception(self) -> BaseException | None:
        """What went wrong."""
        return self._exception

    def set_result(self, result: Any) -> None:
        """Give the answer."""
        self._result = result
        self._finish()

    def set_exception(self, exception: BaseException) -> None:
        """Tell what went wrong."""
        self._exception = exception
        self._finish()

    def cancel(self) -> None:
        """Stop waiting."""
        if not self.done():
            self._cancelled = True
            self._finish()

    def add_done_callback(self, callback: Callable[[Future], Any]) -> None:
        """Call it with this future once done, at once if it is."""
        if self.done():
            callback(self)
        else:
            self._callbacks.append(callback)

    def wait(self, timeout: float | None = None) -> bool:
        """Block until done, while another thread spins; whether it is."""
        return self._finished.wait(timeout)

    def _finish(self) -> None:
        self._finished.set()
        callbacks, self._callbacks = self._callbacks, []
        for callback in callbacks:
            callback(self)
