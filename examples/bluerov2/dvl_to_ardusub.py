"""Send ArduSub the velocities of a Water Linked DVL: python dvl_to_ardusub.py 127.0.0.1:16171 tcp:127.0.0.1:5762

The DVL is real, or that of `finssim ardusub-sitl --dvl` or of the virtual pool; ArduSub is behind any MAVLink address,
here the second serial port of SITL. Each velocity goes out as VISION_POSITION_DELTA, as BlueOS' driver sends it. Ctrl-C
ends it.
"""

import math
import os
import sys
import time

os.environ["MAVLINK20"] = "1"  # before the import: the message has no form in MAVLink 1
from pymavlink import mavutil

from finssim.core import TO_FOSSEN
from finssim.robot import DvlClient, decode_line, host_port

SHORTEST, LONGEST = 0.05, 1.0
"""Time between messages [s]: below the first ArduSub's EKF drops them; beyond the second the bottom was lost, and the
distance since then is unknown."""
WORST = 0.4
"""Figure of merit that means no confidence [m/s]."""


def forward(dvl: DvlClient, ardusub, until=lambda sent: False) -> None:
    """Pass velocities on.

    Args:
        dvl: Where they come from.
        ardusub: MAVLink connection.
        until: Told how many were sent, whether that is enough.
    """
    sent, last = 0, -math.inf
    while not until(sent):
        for line in dvl.receive():
            aid = decode_line(line)
            measured = time.monotonic() - aid.age if aid else math.nan
            if aid is None or measured - last < SHORTEST:
                continue
            dt, last = measured - last, measured
            if dt > LONGEST:
                continue
            delta = (dt * TO_FOSSEN.vector(aid.values)).tolist()
            fom = WORST if math.isnan(aid.fom) else aid.fom
            confidence = 100.0 * (1.0 - min(fom, WORST) / WORST)
            micros = round(1e6 * measured), round(1e6 * dt)
            ardusub.mav.vision_position_delta_send(*micros, [0.0, 0.0, 0.0], delta, confidence)
            sent += 1
        time.sleep(0.005)


if __name__ == "__main__":
    source, sink = sys.argv[1:]
    forward(DvlClient(*host_port(source, "DVL")), mavutil.mavlink_connection(sink, dialect="ardupilotmega"))
