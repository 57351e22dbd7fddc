"""The one exception of the vehicle family."""

from __future__ import annotations


class VehicleError(ValueError):
    """A vehicle file or a value given for a vehicle is refused; the message says where, what and what to do."""
