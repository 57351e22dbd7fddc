"""`rclpy.exceptions`: the errors that code written for rclpy catches, with rclpy's bases: none is a ValueError."""


class RosArgumentsError(RuntimeError):
    """Arguments after `--ros-args` that ROS refuses; in rclpy RCLInvalidROSArgsError or UnknownROSArgsError."""


class InvalidHandle(RuntimeError):
    """Something is used that was destroyed."""


class NotInitializedException(Exception):
    """`rclpy.init` has not been called, or `rclpy.shutdown` has."""


class NameValidationException(Exception):
    """A name is malformed."""


class InvalidNodeNameException(NameValidationException):
    """A node's name holds something other than letters, digits and underscores."""


class InvalidNamespaceException(NameValidationException):
    """A namespace is malformed."""


class InvalidTopicNameException(NameValidationException):
    """A topic's name is malformed."""


class InvalidServiceNameException(NameValidationException):
    """A service's name is malformed."""


class NodeNameNonExistentError(RuntimeError):
    """No node of that name is on the wire."""


class ParameterException(Exception):
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
