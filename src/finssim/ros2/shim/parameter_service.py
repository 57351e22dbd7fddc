"""`rclpy.parameter_service`: the services by which `ros2 param` lists, reads and sets a node's parameters."""

from __future__ import annotations

from typing import Any

from finssim.ros2.codec import codec_of
from finssim.ros2.shim.exceptions import ParameterNotDeclaredException, ParameterUninitializedException
from finssim.ros2.shim.parameter import Parameter
from finssim.ros2.shim.qos import qos_profile_parameters

__all__ = ["ParameterService"]

NAMES = (
    "DescribeParameters",
    "GetParameters",
    "GetParameterTypes",
    "ListParameters",
    "SetParameters",
    "SetParametersAtomically",
)


class ParameterService:
    """The six services of one node; what they refuse they say in the answer, as rclpy's do."""

    def __init__(self, node: Any) -> None:
        self._node = node
        for name in NAMES:
            short = "".join(f"_{c.lower()}" if c.isupper() else c for c in name)[1:]
            node.create_service(
                codec_of().service(f"rcl_interfaces/srv/{name}"),
                f"{node.get_name()}/{short}",
                getattr(self, f"_{short}"),
                qos_profile=qos_profile_parameters,
            )

    def _describe_parameters(self, request: Any, response: Any) -> Any:
        try:
            response.descriptors = self._node.describe_parameters(request.names)
        except ParameterNotDeclaredException:
            pass  # nothing at all, as in rclpy
        return response

    def _get_parameters(self, request: Any, response: Any) -> Any:
        try:
            response.values = [p.get_parameter_value() for p in self._node.get_parameters(request.names)]
        except (ParameterNotDeclaredException, ParameterUninitializedException):
            pass
        return response

    def _get_parameter_types(self, request: Any, response: Any) -> Any:
        try:
            response.types = self._node.get_parameter_types(request.names)
        except ParameterNotDeclaredException:
            pass
        return response

    def _list_parameters(self, request: Any, response: Any) -> Any:
        response.result = self._node.list_parameters(request.prefixes, request.depth)
        return response

    def _set_parameters(self, request: Any, response: Any) -> Any:
        response.results = [self._set([parameter]) for parameter in request.parameters]
        return response

    def _set_parameters_atomically(self, request: Any, response: Any) -> Any:
        response.result = self._set(request.parameters)
        return response

    def _set(self, parameters: Any) -> Any:
        try:
            return self._node.set_parameters_atomically([Parameter.from_parameter_msg(p) for p in parameters])
        except ParameterNotDeclaredException as error:
            result = codec_of().message("rcl_interfaces/msg/SetParametersResult")
            return result(successful=False, reason=str(error))
