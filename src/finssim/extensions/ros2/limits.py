"""Names of rclpy that the built-in one lacks, each with an alternative."""

from __future__ import annotations

from typing import Any, NoReturn

_CALLBACKS = "use add_on_set_parameters_callback"
_SELF = "use the object itself"
MISSING: dict[str, dict[str, str]] = {
    "Node": {
        "create_rate": "use create_timer",
        "destroy_rate": "use create_timer",
        "create_guard_condition": "call executor.wake() from the other thread",
        "destroy_guard_condition": "call executor.wake() from the other thread",
        "guards": "there are none",
        "add_waitable": "use a subscription or a timer",
        "remove_waitable": "use a subscription or a timer",
        "waitables": "there are none",
        "default_callback_group": "leave callback_group out: callbacks run one at a time",
        "executor": "make a SingleThreadedExecutor and keep it",
        "handle": "use the node itself",
        "get_parameters_by_prefix": "use list_parameters and get_parameters",
        "set_descriptor": "declare the parameter with its descriptor",
        "add_pre_set_parameters_callback": _CALLBACKS,
        "add_post_set_parameters_callback": _CALLBACKS,
        "remove_pre_set_parameters_callback": _CALLBACKS,
        "remove_post_set_parameters_callback": _CALLBACKS,
        "get_node_names_and_namespaces_with_enclaves": "use get_node_names_and_namespaces",
        "wait_for_node": "look at get_node_names_and_namespaces in a timer",
    },
    "Publisher": {
        "handle": _SELF,
        "assert_liveliness": "liveliness is automatic",
        "wait_for_all_acked": "let the other side answer",
        "event_handlers": "there are none",
    },
    "Subscription": {
        "handle": _SELF,
        "callback_group": "keep the group that you gave",
        "event_handlers": "there are none",
        "content_filter": "filter in the callback",
        "set_content_filter": "filter in the callback",
        "get_content_filter": "filter in the callback",
    },
    "Service": {
        "handle": _SELF,
        "send_response": "return the response from the callback",
        "configure_introspection": "log in the callback",
    },
    "Client": {
        "handle": _SELF,
        "call": "use call_async and spin_until_future_complete",
        "configure_introspection": "log where you call",
    },
    "Timer": {
        "handle": _SELF,
        "callback_group": "keep the group that you gave",
        "time_since_last_call": "take the time in the callback",
    },
    "SingleThreadedExecutor": {
        "create_task": "use a timer with the period 0 and cancel it",
        "spin_once_until_future_complete": "use spin_until_future_complete",
        "wait_for_ready_callbacks": "use spin_once",
        "can_execute": "use spin_once",
    },
    "Context": {
        "on_shutdown": "write what must happen after spin, in a finally clause",
        "handle": "use the context itself",
        "track_node": "nodes join their context themselves",
    },
    "Clock": {
        "sleep_until": "use create_timer",
        "create_jump_callback": "compare the time with the last one",
        "handle": "use the clock itself",
    },
    "Future": {"__await__": "use add_done_callback", "add_exception_callback": "use add_done_callback"},
    "Buffer": {
        "transform": "use lookup_transform and apply it",
        "transform_full": "use lookup_transform_full and apply it",
        "registration": "use lookup_transform and apply it",
        "wait_for_transform_async": "ask can_transform in a timer",
        "wait_for_transform_full_async": "ask can_transform in a timer",
        "lookup_transform_async": "ask can_transform in a timer",
        "lookup_transform_full_async": "ask can_transform in a timer",
        "can_transform_full": "catch TransformException of lookup_transform_full",
        "all_frames_as_yaml": "use ros2 run tf2_tools view_frames on another computer",
        "all_frames_as_string": "use ros2 run tf2_tools view_frames on another computer",
    },
}
"""Class -> missing name of real rclpy -> alternative."""

MODULES = {
    "MultiThreadedExecutor": "use SingleThreadedExecutor",
    "Executor": "use SingleThreadedExecutor",
    "EventsExecutor": "use SingleThreadedExecutor",
    "Rate": "use Node.create_timer",
    "ShutdownException": "nothing raises it here",
    "TimeoutException": "nothing raises it here",
    "PublisherEventCallbacks": "leave event_callbacks out",
    "get_rmw_implementation_identifier": "it would be rmw_cyclonedds_cpp",
    "BufferClient": "use Buffer and TransformListener",
    "BufferServer": "let each node have a Buffer of its own",
}
"""Missing name of a module of rclpy or tf2_ros -> alternative."""

PACKAGES = {
    "message_filters": "compare the stamps of messages in your callbacks",
    "tf2_geometry_msgs": "apply the transform of Buffer.lookup_transform yourself",
    "tf2_py": "use tf2_ros",
    "cv_bridge": "make an array of Image.data with numpy.frombuffer and reshape",
    "rosbag2_py": "use the package rosbags, or finssim record",
}
"""Package of ROS 2 that nodes import besides rclpy -> alternative."""


class Limited:
    """Base of rclpy classes that suggests alternatives for missing attributes."""

    def __getattr__(self, name: str) -> NoReturn:
        for kind in type(self).__mro__:
            hint = MISSING.get(kind.__name__, {}).get(name)
            if hint is not None and issubclass(kind, Limited):
                raise AttributeError(f"{kind.__name__}.{name} needs a sourced ROS 2: {hint}")
        raise AttributeError(f"'{type(self).__name__}' object has no attribute '{name}'")


def refuse(module: str, name: str) -> Any:
    """Refuse a name that a module lacks; used as the module's `__getattr__`.

    Raises:
        ImportError: Always; unlike an AttributeError, its text reaches the user of `from module import name`.
        AttributeError: The name is one of Python's own.
    """
    if name.startswith("__"):
        raise AttributeError(f"module '{module}' has no attribute '{name}'")
    hint = MODULES.get(name, "FinsSim's built-in rclpy has no such name")
    raise ImportError(f"{module}.{name} needs a sourced ROS 2: {hint}", name=module)
