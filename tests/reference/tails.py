"""REMUS 100 with four separately turning fins, of the size of its own tail's: a cruciform or an X."""

import math

from finssim.vehicles import Vehicle, load_vehicle

TAILS = {"cruciform": 0.0, "x": math.pi / 4.0}


def tailed(tail: str, name: str = "remus100", area: float = 0.00665, **changes: object) -> Vehicle:
    """Return a torpedo of the catalogue with such a tail, at 0.48 of its length behind the middle."""
    body = load_vehicle(name)
    fins = {}
    for k in range(4):
        angle = TAILS[tail] + 0.5 * math.pi * k
        span = [0.0, round(math.cos(angle), 12), round(math.sin(angle), 12)]
        fins[f"fin_{k}"] = {
            "kind": "fin",
            "position": [-0.48 * body.body.size[0], 0.1 * span[1], 0.1 * span[2]],
            "span": span,
            "chord": [1.0, 0.0, 0.0],
            "area": area,
            "lift_slope": 3.12,
            "stall": 0.4,
            "drag": [0.01, 0.0, 1.0],
            "minimum": -0.35,
            "maximum": 0.35,
            "time_constant": 0.1,
            "rate_limit": 2.0,
        }
    return body.replace({"actuators": fins, **changes})
