"""A ground station in lock-step with a pool whose vehicle has an autopilot."""

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from finssim.core.rotations import quat_from_euler
from finssim.pool import VirtualPool, draw_plant
from finssim.pool.ardusub import MANUAL
from finssim.vehicles import load_vehicle
from finssim.vehicles.defaults import with_navigation

HEAVY = with_navigation(load_vehicle("bluerov2_heavy"))
SPEC = draw_plant(HEAVY, 1, "nominal")
DEEP = SPEC.model_copy(
    update={
        "basin": SPEC.basin.model_copy(update={"depth": 5.0}),
        "firmware": SPEC.firmware.model_copy(update={"aiding_delay": 0.2}),
    }
)
"""Basin 5 m deep, with an autopilot that soon has a position."""
ARM, MODE, INTERVAL, REQUEST, REBOOT = 400, 176, 511, 512, 246
NEUTRAL = (0, 0, 500, 0)
"""x, y, z, r of MANUAL_CONTROL."""
ACCEPTED = 0


class Ground:
    """Ground station in lock-step with a pool that sends heartbeats and may steer."""

    def __init__(
        self, *, system=255, start=(0.0, 0.0, -2.0), yaw=0.0, attitude=None, vehicle=HEAVY, spec=DEEP
    ):
        q = quat_from_euler(*(attitude or (0.0, 0.0, yaw)))
        self.pool = VirtualPool(vehicle, spec, firmware="ardusub", start=(start, q))
        self.mav = mavlink.MAVLink(None, system, 190)
        self.mav.robust_parsing = True
        self.beats, self.axes, self.buttons, self.tilt = True, None, 0, (0, 0)
        self.channels, self.lines, self.last = None, [], {}
        self.sent = 0.0

    @property
    def firmware(self):
        return self.pool.firmware

    def pack(self, message):
        data = message.pack(self.mav)
        self.mav.seq = (self.mav.seq + 1) % 256
        return data

    def run(self, duration, *messages):
        """Send the given messages, and return the messages received during this time."""
        out, queue, end = [], [self.pack(m) for m in messages], self.pool.time + duration
        while self.pool.time < end - 1e-9:
            if self.beats and self.pool.time >= self.sent:
                self.sent += 1.0
                queue.append(self.pack(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3)))
            if self.axes is not None:
                x, y, z, r = self.axes
                s, t = self.tilt
                queue.append(
                    self.pack(mavlink.MAVLink_manual_control_message(1, x, y, z, r, self.buttons, s=s, t=t))
                )
            if self.channels is not None:
                six = [self.channels.get(i, 65535) for i in range(1, 9)]
                queue.append(self.pack(mavlink.MAVLink_rc_channels_override_message(1, 1, *six)))
            for _, frame in self.pool.exchange(self.pool.time + 0.05, queue).frames:
                if frame[:1] == b"{":
                    self.lines += [frame] if b"velocity_valid" in frame else []
                else:
                    out += self.mav.parse_buffer(frame) or ()
            queue = []
        self.last = {m.get_type(): m for m in out}
        return out

    def command(self, number, *values, wait=0.15):
        """Return the result of a command."""
        values = [*values, *[0.0] * (7 - len(values))]
        out = self.run(wait, mavlink.MAVLink_command_long_message(1, 1, number, 0, *values))
        (ack,) = [m for m in out if m.get_type() == "COMMAND_ACK"]
        assert ack.command == number and ack.target_system == self.mav.srcSystem
        return ack.result

    def texts(self, out):
        return [m.text for m in out if m.get_type() == "STATUSTEXT"]

    def set(self, **values):
        """Store parameters and return their answered values."""
        out = []
        for name, value in values.items():
            out += self.run(0.1, mavlink.MAVLink_param_set_message(1, 1, name.encode(), value, 9))
        return {m.param_id: m.param_value for m in out if m.get_type() == "PARAM_VALUE"}

    def armed(self, mode=MANUAL, gain=1.0):
        """Return the ground station, armed and ready to steer."""
        self.set(JS_GAIN_DEFAULT=gain)
        self.pool.reboot()
        self.axes = NEUTRAL
        self.run(3.0)
        self.set(BARO1_GND_PRESS=101325.0)  # the restart under water calibrated the pressure sensor there
        self.run(2.0)
        assert self.command(MODE, 1, mode) == ACCEPTED
        assert self.command(ARM, 1) == ACCEPTED and self.firmware.armed
        self.run(0.5)  # the vertical axis is ramped
        return self
