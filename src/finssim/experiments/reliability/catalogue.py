"""The faults that a robot must survive. A new one is an entry here, and perhaps a function in `touches`."""

from __future__ import annotations

import math
from collections.abc import Mapping

from finssim.experiments.reliability.scenario import Fault, Scenario
from finssim.experiments.reliability.touches import (
    blind,
    full_disk,
    jump_mcu_clock,
    jump_robot_clock,
    pool_fault,
    reboot,
    see_again,
    stuck_pictures,
    stuck_sensors,
    two_publishers,
)

__all__ = ["SCENARIOS", "UNWATCHED"]

VALUES = {"quaternion": 4, "gyro": 3, "accel": 3, "depth": 0, "pressure": 0, "motor_rpm": 8}
"""Numbers in the fields of the telemetry; 0: one, without an index."""

UNWATCHED: Mapping[str, object] = {
    "command_timeout": math.inf,
    "telemetry_timeout": math.inf,
    "state_timeout": math.inf,
    "frozen_limit": math.inf,
    "max_tilt": math.inf,
    "hold_limit": math.inf,
    "clock_step": math.inf,
    "reject_limit": math.inf,
    "need_reading": False,
}
"""Bridge settings without watchdogs: the control that shows that they are needed, and that the table can tell."""


def _loss(share: float) -> Scenario:
    return Scenario(
        title=f"packet loss {100 * share:.0f} %",
        faults={
            "up": Fault(begin=pool_fault(drop=share)),
            "down": Fault(begin=pool_fault(drop_commands=share)),
            "all": Fault(begin=pool_fault(share, drop=share, drop_commands=share)),
        },
    )


def _nan(field: str) -> Scenario:
    names = [field, *(f"{field}.{i}" for i in range(VALUES[field]))]
    faults = {name: Fault(begin=pool_fault(nan_field=name)) for name in names}
    return Scenario(title=f"NaN in {field}", faults=faults, motions=("moving",))


def _stuck(title: str, *names: str) -> Scenario:
    return Scenario(title=f"frozen {title}", faults={"": Fault(begin=stuck_sensors(*names))})


def _jumps(title: str, touch: object, steps: tuple[float, ...]) -> Scenario:
    return Scenario(title=title, faults={f"{step:+g} s": Fault(begin=touch(step)) for step in steps})  # type: ignore[operator]


SCENARIOS: Mapping[str, Scenario] = {
    "loss-0": Scenario(title="no fault", faults={"": Fault(begin=pool_fault())}),
    "loss-10": _loss(0.1),
    "loss-30": _loss(0.3),
    "loss-50": _loss(0.5),
    "link-cut": Scenario(
        title="link cut",
        faults={
            "up": Fault(begin=pool_fault(drop=1.0)),
            "down": Fault(begin=pool_fault(drop_commands=1.0)),
            "all": Fault(begin=pool_fault(1.0, drop=1.0, drop_commands=1.0)),
        },
    ),
    "reordering": Scenario(
        title="reordering, half of the frames", faults={"": Fault(begin=pool_fault(reorder=0.5))}
    ),
    "duplicates": Scenario(
        title="duplicates, half of the frames", faults={"": Fault(begin=pool_fault(duplicate=0.5))}
    ),
    "corrupt": Scenario(
        title="corrupt frames",
        faults={
            "half": Fault(begin=pool_fault(corrupt=0.5)),
            "all": Fault(begin=pool_fault(corrupt=1.0)),
        },
    ),
    "frozen-imu": _stuck("IMU", "quaternion", "gyro", "accel"),
    "frozen-depth": _stuck("depth", "depth", "pressure"),
    "frozen-sensors": Scenario(
        title="all sensors frozen", faults={"": Fault(begin=pool_fault(freeze_sensors=True))}
    ),
    "frozen-picture": Scenario(title="frozen picture", faults={"": Fault(begin=stuck_pictures)}),
    **{f"nan-{field}": _nan(field) for field in VALUES},
    "blind-3": Scenario(
        title="3 s without vision", faults={"": Fault(begin=blind, end=see_again, lasts=3.0)}
    ),
    "blind-10": Scenario(
        title="10 s without vision", faults={"": Fault(begin=blind, end=see_again, lasts=10.0)}
    ),
    "second-publisher": Scenario(
        title="second publisher", faults={"": Fault(begin=two_publishers, during=two_publishers)}
    ),
    "mcu-reboot": Scenario(title="MCU reboot", faults={"": Fault(begin=reboot)}),
    "robot-clock": _jumps("robot's clock jumps", jump_robot_clock, (-3600.0, -2.0, -0.2, 0.5, 2.0, 3600.0)),
    "mcu-clock": _jumps("MCU's clock jumps", jump_mcu_clock, (-100.0, -2.0, -0.2, 0.5, 2.0, 100.0)),
    "full-disk": Scenario(title="full disk", faults={"": Fault(begin=full_disk, cuts_record=True)}),
    "control": Scenario(
        title="control: no watchdogs, link cut up",
        faults={"": Fault(begin=pool_fault(drop=1.0))},
        settings=UNWATCHED,
        motions=("moving",),
        must_fail=True,
    ),
}
"""Name -> scenario, in the order of the table; those with processes of their own are in `process_trial`."""
