"""The refusal of impossible optics."""

__all__ = ["OpticsError"]


class OpticsError(ValueError):
    """A lens, camera or interface that cannot be; the message is one sentence that says what was expected."""
