"""Quality of service: ROS 2's policies as values, and as Cyclone DDS takes them."""

from __future__ import annotations

from dataclasses import dataclass

from cyclonedds.qos import Policy, Qos

__all__ = ["LATCHED", "POLICY_NAMES", "Quality", "dds_qos"]

BLOCKING_NS = 100_000_000
"""The longest a reliable writer waits for its readers; ROS 2 would wait for ever and stop the control loop."""

POLICY_NAMES = {2: "DURABILITY", 4: "DEADLINE", 8: "LIVELINESS", 11: "RELIABILITY", 12: "DESTINATION_ORDER"}
"""DDS's numbers of the policies that can keep two endpoints apart."""


@dataclass(frozen=True)
class Quality:
    """What a writer offers or a reader asks for; the defaults are ROS 2's."""

    depth: int = 10
    """Samples kept; 0 keeps all."""
    reliable: bool = True
    transient_local: bool = False
    """Whether the last samples are kept for readers that come later."""
    deadline: float = 0.0
    """Longest time between samples [s]; 0 is no promise."""
    lifespan: float = 0.0
    """Age at which a sample is worthless [s]; 0 is never."""


LATCHED = Quality(depth=1, transient_local=True)


def dds_qos(quality: Quality, user_data: bytes = b"", *, ignore_own: bool = False) -> Qos:
    """Cyclone's form.

    Args:
        quality: The policies.
        user_data: What the endpoint tells its peers, e.g. the hash of its type.
        ignore_own: For readers: do not match writers of the same process.
    """
    history = Policy.History.KeepLast(quality.depth) if quality.depth else Policy.History.KeepAll
    policies = [
        history,
        Policy.Reliability.Reliable(BLOCKING_NS) if quality.reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if quality.transient_local else Policy.Durability.Volatile,
        Policy.DataRepresentation(use_cdrv0_representation=True),
    ]
    if quality.transient_local:
        policies.append(Policy.DurabilityService(0, history, -1, -1, -1))
    if quality.deadline:
        policies.append(Policy.Deadline(round(quality.deadline * 1e9)))
    if quality.lifespan:
        policies.append(Policy.Lifespan(round(quality.lifespan * 1e9)))
    if user_data:
        policies.append(Policy.Userdata(user_data))
    if ignore_own:
        policies.append(Policy.IgnoreLocal.Participant)
    return Qos(*policies)
