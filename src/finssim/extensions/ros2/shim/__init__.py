"""rclpy API on `finssim.extensions.ros2.wire`: the target of `import rclpy` without an installed ROS 2.

Names, arguments and errors follow rclpy, so that one node source runs with both. Do not import this package by its
own name: `finssim.extensions.ros2.backend.activate` selects it or the real one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from finssim.extensions.ros2.shim.context import (
    Context,
    SignalHandlerOptions,
    get_default_context,
    ok,
    renew_default_context,
    shutdown,
    try_shutdown,
)
from finssim.extensions.ros2.shim.endpoint import Future
from finssim.extensions.ros2.shim.executors import SingleThreadedExecutor
from finssim.extensions.ros2.shim.node import Node

__all__ = [
    "Context",
    "create_node",
    "get_default_context",
    "get_global_executor",
    "init",
    "ok",
    "shutdown",
    "spin",
    "spin_once",
    "spin_until_future_complete",
    "try_shutdown",
]


def init(
    *,
    args: Sequence[str] | None = None,
    context: Context | None = None,
    domain_id: int | None = None,
    signal_handler_options: SignalHandlerOptions | None = None,
) -> None:
    """Join the network, before anything else. SIGTERM ends `spin` unless the options leave it to the program."""
    if context is None:
        context = get_default_context()
        if not context.ok():
            context = renew_default_context()
    context.init(args, domain_id=domain_id)
    if signal_handler_options in (None, SignalHandlerOptions.ALL, SignalHandlerOptions.SIGTERM):
        context.leave_on_sigterm()


def create_node(node_name: str, **arguments: Any) -> Node:
    """Return a node; arguments as in `Node`."""
    return Node(node_name, **arguments)


def get_global_executor(context: Context | None = None) -> SingleThreadedExecutor:
    """Return the executor that `spin` and `spin_once` use."""
    context = context or get_default_context()
    if context.executor is None:
        context.executor = SingleThreadedExecutor(context=context)
    return context.executor  # type: ignore[no-any-return]


def spin(node: Node, executor: SingleThreadedExecutor | None = None) -> None:
    """Run a node's callbacks until shutdown."""
    executor = executor or get_global_executor(node.context)
    added = executor.add_node(node)
    try:
        executor.spin()
    finally:
        if added:
            executor.remove_node(node)


def spin_once(
    node: Node, *, executor: SingleThreadedExecutor | None = None, timeout_sec: float | None = None
) -> None:
    """Run one callback of a node, waiting for it at most `timeout_sec` [s]."""
    executor = executor or get_global_executor(node.context)
    added = executor.add_node(node)
    try:
        executor.spin_once(timeout_sec)
    finally:
        if added:
            executor.remove_node(node)


def spin_until_future_complete(
    node: Node,
    future: Future,
    executor: SingleThreadedExecutor | None = None,
    timeout_sec: float | None = None,
) -> None:
    """Run a node's callbacks until a future is done, at most `timeout_sec` [s]."""
    executor = executor or get_global_executor(node.context)
    added = executor.add_node(node)
    try:
        executor.spin_until_future_complete(future, timeout_sec)
    finally:
        if added:
            executor.remove_node(node)
