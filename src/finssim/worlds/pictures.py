"""Pictures and printed tags that stand on the shapes of a world, as reflectances."""
# mypy: ignore-errors

from __future__ import annotations

import numpy as np

from finssim.worlds.description import Texture, World, WorldError

SIDE = 256
"""Pixels along each side of every picture, whatever its proportions."""
PAPER, INK = 0.85, 0.04
"""Reflectance of a tag's white and black."""


def picture_of(world: World, texture: Texture) -> tuple[np.ndarray, float, float]:
    """A texture's picture.

    Args:
        world: Its file lies beside the picture's.
        texture: Of kind picture or tag.

    Returns:
        Reflectance of red, green, blue, row 0 at the top, (SIDE, SIDE, 3); width [m]; height over width [-].

    Raises:
        WorldError: OpenCV is missing, or there is no such picture or tag.
    """
    try:
        import cv2
    except ImportError:
        raise WorldError("pictures and tags on shapes need OpenCV: pip install 'finssim[vision]'") from None
    if texture.kind == "tag":
        bits = _tag(cv2, world, texture)
        paper = np.kron(np.pad(bits, 1, constant_values=True), np.ones((32, 32)))
        gray = cv2.resize(paper.astype(np.float32), (SIDE, SIDE), interpolation=cv2.INTER_AREA)
        colour = np.repeat((INK + (PAPER - INK) * gray)[..., None], 3, axis=2)
        return colour, texture.size * (len(bits) + 2.0) / len(bits), 1.0
    path = world.beside(texture.file, "texture: file")
    data = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.is_file() else None
    if data is None:
        raise WorldError(
            f"{world.path}: texture: cannot read {texture.file}: give a PNG or JPEG beside the world file"
        )
    small = cv2.resize(data, (SIDE, SIDE), interpolation=cv2.INTER_AREA)[..., ::-1]
    return (small / 255.0) ** 2.2, texture.size, data.shape[0] / data.shape[1]


def _tag(cv2, world: World, texture: Texture) -> np.ndarray:
    """Cells of a tag within and with its black border, True where white, row 0 at the top, (n, n)."""
    code = getattr(cv2.aruco, f"DICT_{texture.family.upper()}".replace("APRILTAG_36H", "APRILTAG_36h"), None)
    dictionary = cv2.aruco.getPredefinedDictionary(code) if code is not None else None
    if dictionary is None or texture.tag >= len(dictionary.bytesList):
        lack = "no such family" if dictionary is None else f"it has {len(dictionary.bytesList)} tags"
        raise WorldError(f"{world.path}: texture: tag {texture.tag} of {texture.family}: {lack}")
    n = dictionary.markerSize + 2
    return cv2.aruco.generateImageMarker(dictionary, texture.tag, n) > 127
