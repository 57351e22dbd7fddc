"""Where a vehicle is, by a camera above the pool: tags in pictures, poses through the water, and their fusion."""

__all__ = ["LocalizationError"]


class LocalizationError(ValueError):
    """A camera, pool, detection or log that cannot be used; the message says what, where and what to do."""
