"""One function per node, for `ros2 run finssim_ros NODE`."""

from importlib import import_module

from finssim.ros2.graphs import NODES


def _run(node: str) -> None:
    import_module(NODES[node]).main()


def camera() -> None:
    """Pictures of the overhead camera."""
    _run("camera")


def controller() -> None:
    """PID, policy or wrench to thrusts."""
    _run("controller")


def hardware_bridge() -> None:
    """The one node that talks to the motor controller."""
    _run("hardware_bridge")


def localizer() -> None:
    """Pictures to poses."""
    _run("localizer")


def recorder() -> None:
    """Everything to one MCAP file."""
    _run("recorder")


def sim() -> None:
    """Any vehicle of the engine, with /clock."""
    _run("sim")


def state_estimation() -> None:
    """Poses, inertial samples and pressure to one state."""
    _run("state_estimation")


def teleop() -> None:
    """Gamepad or keyboard to wrenches."""
    _run("teleop")


def virtual_pool() -> None:
    """The vehicle and the room, without either."""
    _run("virtual_pool")
