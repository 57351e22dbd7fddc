"""Localization by a camera above the pool: tags in pictures, poses through the water, and their fusion."""

__all__ = ["LocalizationError"]


class LocalizationError(ValueError):
    """A camera, pool, detection or log cannot be used; the message states what, where and what to do."""
