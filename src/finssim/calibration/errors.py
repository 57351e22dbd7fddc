"""The error of this package."""


class CalibrationError(ValueError):
    """A trial, table or fit that cannot be used; the message says where, what was found and what to do."""
