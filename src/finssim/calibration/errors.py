"""The error of this package."""


class CalibrationError(ValueError):
    """A trial, table or fit that cannot be used; the message says where, what was found and what to do.

    Attributes:
        subject: The trial or file that cannot be used; empty where the reason names it.
        reason: The message without it.
    """

    def __init__(self, reason: str, subject: str = "") -> None:
        """What is wrong, and with which trial or file."""
        super().__init__(f"{subject}: {reason}" if subject else reason)
        self.reason, self.subject = reason, subject
