"""`rclpy.exceptions`: the errors that code written for rclpy catches."""

from finssim.ros2.errors import Ros2Error

__all__ = [
    "InvalidNamespaceException",
    "InvalidNodeNameException",
    "InvalidParameterException",
    "InvalidParameterTypeException",
    "InvalidParameterValueException",
    "InvalidTopicNameException",
    "NotInitializedException",
    "ParameterAlreadyDeclaredException",
    "ParameterException",
    "ParameterImmutableException",
    "ParameterNotDeclaredException",
    "ParameterUninitializedException",
]


class NotInitializedException(Ros2Error):
    """`rclpy.init` has not been called, or `rclpy.shutdown` has."""


class InvalidNodeNameException(Ros2Error):
    """A node's name holds something other than letters, digits and underscores."""


class InvalidNamespaceException(Ros2Error):
    """A namespace is malformed."""


class InvalidTopicNameException(Ros2Error):
    """A topic's or service's name is malformed."""


class ParameterException(Ros2Error):
    """Something is wrong with a parameter."""


class ParameterNotDeclaredException(ParameterException):
    """A parameter is used that was not declared."""


class ParameterAlreadyDeclaredException(ParameterException):
    """A parameter is declared twice."""


class ParameterUninitializedException(ParameterException):
    """A parameter is read that has a type but no value."""


class ParameterImmutableException(ParameterException):
    """A read-only parameter is set."""


class InvalidParameterException(ParameterException):
    """A parameter's name is malformed."""


class InvalidParameterTypeException(ParameterException):
    """A value is of another type than the parameter."""


class InvalidParameterValueException(ParameterException):
    """A value is outside its range, or was refused."""
