"""Errors of localization."""

__all__ = ["LocalizationError"]


class LocalizationError(ValueError):
    """A camera, pool, detection or log that cannot be used; the message says what, where and what to do."""
