"""Colours of figures, reports, films and views."""

__all__ = ["BLACK", "BLUE", "COLORS", "GREEN", "ORANGE", "PINK", "SKY", "VERMILION", "rgb"]

BLUE, VERMILION, GREEN = "#0072B2", "#D55E00", "#009E73"
PINK, ORANGE, SKY, BLACK = "#CC79A7", "#E69F00", "#56B4E9", "#000000"
COLORS = (BLUE, VERMILION, GREEN, PINK, ORANGE, SKY, BLACK)
"""Okabe and Ito's palette, which is also distinguishable with colour-vision deficiency."""


def rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue, 0 to 255, of a colour written as `#rrggbb`."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue
