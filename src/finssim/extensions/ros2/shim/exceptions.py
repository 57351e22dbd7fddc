"""`rclpy.exceptions`: exceptions with the base classes of rclpy; none is a ValueError."""


class RosArgumentsError(RuntimeError):
    """Invalid arguments after `--ros-args`; in rclpy RCLInvalidROSArgsError or UnknownROSArgsError."""


class InvalidHandle(RuntimeError):
    """Use of a destroyed object."""


class NotInitializedException(Exception):
    """Use before `rclpy.init` or after `rclpy.shutdown`."""


class NameValidationException(Exception):
    """Malformed name."""


class InvalidNodeNameException(NameValidationException):
    """Name of a node with characters other than letters, digits and underscores."""


class InvalidNamespaceException(NameValidationException):
    """Malformed namespace."""


class InvalidTopicNameException(NameValidationException):
    """Malformed topic name."""


class InvalidServiceNameException(NameValidationException):
    """Malformed service name."""


class NodeNameNonExistentError(RuntimeError):
    """No node with that name on the network."""


class ParameterException(Exception):
    """Base of the exceptions about parameters."""


class ParameterNotDeclaredException(ParameterException):
    """Use of a parameter that was not declared."""


class ParameterAlreadyDeclaredException(ParameterException):
    """Second declaration of a parameter."""


class ParameterUninitializedException(ParameterException):
    """Read of a parameter that has a type but no value."""


class ParameterImmutableException(ParameterException):
    """Change of a read-only parameter."""


class InvalidParameterException(ParameterException):
    """Malformed parameter name."""


class InvalidParameterTypeException(ParameterException):
    """Value of another type than the parameter."""


class InvalidParameterValueException(ParameterException):
    """Value outside its range, or refused by a callback."""
