"""Acoustic messages between agents: sent periodically, delayed by the speed of sound, with losses."""

import math
from dataclasses import dataclass

import warp as wp

from finssim.sim.state import State
from finssim.tasks.arrays import MessageTable, TaskArrays, allocated
from finssim.tasks.terms import measured_velocity
from finssim.tasks.validation import EnvironmentSetupError

MOST_UNDER_WAY = 32
"""Greatest number of messages of one agent that can be in transit."""


@dataclass(frozen=True, kw_only=True)
class Communication:
    """Settings of the messages between agents. A message contains the sender's measured position and velocity."""

    period: float = 1.0
    """Time between two messages of an agent [s]; within it, agents transmit in turn."""
    processing: float = 0.1
    """Time from the measurement to its use, besides the travel time through the water [s]."""
    loss: float = 0.1
    """Probability that a receiver misses a message, independently for each receiver."""
    speed_of_sound: float = 1500.0
    """[m/s]"""

    def __post_init__(self) -> None:
        for name, good, expected in (
            ("period", 0.0 < self.period < math.inf, "more than 0"),
            ("speed_of_sound", 0.0 < self.speed_of_sound < math.inf, "more than 0"),
            ("processing", 0.0 <= self.processing < math.inf, "0 s or more"),
            ("loss", 0.0 <= self.loss <= 1.0, "a probability, 0 to 1"),
        ):
            if not good:
                raise EnvironmentSetupError(
                    f"communication: {name} is {getattr(self, name)}, expected {expected}"
                )


def message_table(
    communication: Communication | None,
    worlds: int,
    agents: int,
    control_step: float,
    reach: float,
    device: wp.Device,
) -> MessageTable:
    """Return the message table of every world; without communication, every agent observes all others directly.

    Args:
        communication: Settings of the messages, or None.
        worlds: Number of worlds.
        agents: Number of agents in each world.
        control_step: [s]
        reach: Greatest distance between two agents [m].
        device: Warp device of the table.

    Raises:
        EnvironmentSetupError: More messages would be in transit at once than the table can store.
    """
    if communication is None:
        return MessageTable()
    c, period = communication, max(1, round(communication.period / control_step))
    longest, every = c.processing + reach / c.speed_of_sound, period * control_step
    slots = math.ceil(longest / every) + 1
    if slots > MOST_UNDER_WAY:
        raise EnvironmentSetupError(
            f"communication: a message takes up to {longest:.3g} s, one is sent every {every:g} s, "
            f"expected at most {MOST_UNDER_WAY} under way: give a longer period or a shorter way"
        )
    sent, heard = agents * slots, agents**2
    table: MessageTable = allocated(
        MessageTable, worlds, device, sent_position=sent, sent_velocity=sent, sent_step=sent, arrival=(sent, agents),
        position=heard, velocity=heard, step=heard,
    )  # fmt: skip
    table.on, table.control_step, table.period, table.slots = 1, control_step, period, slots
    table.processing, table.loss, table.speed_of_sound = c.processing, c.loss, c.speed_of_sound
    table.arrival.fill_(-1)
    return table


@wp.func
def mate_position(arrays: TaskArrays, w: int, a: int, b: int) -> wp.vec3:
    """Return the position of agent b in the newest message that agent a received, world frame [m]."""
    x = arrays.position[w, b]
    if arrays.messages.on != 0 and a != b:
        x = arrays.messages.position[w, a * arrays.agent_reward.shape[1] + b]
    return x


@wp.func
def mate_velocity(arrays: TaskArrays, w: int, a: int, b: int) -> wp.vec3:
    """Return the velocity of agent b in the newest message that agent a received, world frame [m/s]."""
    v = measured_velocity(arrays, w, b)
    if arrays.messages.on != 0 and a != b:
        v = arrays.messages.velocity[w, a * arrays.agent_reward.shape[1] + b]
    return v


@wp.func
def key_messages(arrays: TaskArrays, key: int, w: int):
    """Set the key of the episode's message losses; part of spawning."""
    if arrays.messages.on != 0:
        arrays.messages.key[w] = key + 11


@wp.func
def open_messages(arrays: TaskArrays, w: int):
    """Start an episode: every agent knows the others' initial states, and no message is in transit; part of
    observing."""
    if arrays.messages.on == 0:
        return
    agents = arrays.agent_reward.shape[1]
    for a in range(agents):
        for b in range(agents):
            arrays.messages.position[w, a * agents + b] = arrays.position[w, b]
            arrays.messages.velocity[w, a * agents + b] = measured_velocity(arrays, w, b)
            arrays.messages.step[w, a * agents + b] = 0
        for k in range(arrays.messages.arrival.shape[1]):
            arrays.messages.arrival[w, k, a] = -1


@wp.func
def send(state: State, arrays: TaskArrays, w: int, b: int, step: int):
    """Send agent b's measurement of its own state, and determine its arrival at each of the others."""
    m = arrays.messages
    agents = arrays.agent_reward.shape[1]
    k = b * m.slots + (step // m.period) % m.slots
    m.sent_position[w, k] = arrays.position[w, b]
    m.sent_velocity[w, k] = measured_velocity(arrays, w, b)
    m.sent_step[w, k] = step
    for a in range(agents):
        way = wp.length(state.position[w, a] - state.position[w, b])
        delay = (way / m.speed_of_sound + m.processing) / m.control_step
        sender_state = wp.rand_init(wp.randi(wp.rand_init(m.key[w], w)), (step * agents + b) * agents + a)
        lost = wp.randf(sender_state) < m.loss
        m.arrival[w, k, a] = wp.where(lost or a == b, -1, step + int(wp.ceil(delay - 1.0e-3)))


@wp.func
def exchange_messages(state: State, arrays: TaskArrays, w: int):
    """Exchange messages after a control step: agents whose turn it is send, and due messages arrive; part of
    evaluation."""
    if arrays.messages.on == 0:
        return
    m = arrays.messages
    agents = arrays.agent_reward.shape[1]
    step = state.steps[w]
    for b in range(agents):
        if step % m.period == (b * m.period) // agents:
            send(state, arrays, w, b, step)
    for b in range(agents):
        for slot in range(m.slots):
            k = b * m.slots + slot
            for a in range(agents):
                # A message that was overtaken by a newer one is ignored.
                if m.arrival[w, k, a] == step and m.sent_step[w, k] > m.step[w, a * agents + b]:
                    m.position[w, a * agents + b] = m.sent_position[w, k]
                    m.velocity[w, a * agents + b] = m.sent_velocity[w, k]
                    m.step[w, a * agents + b] = m.sent_step[w, k]
