"""Pictures of a record, in JPEG."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["jpeg", "picture_of"]

QUALITY = 90

Image = npt.NDArray[np.uint8]


def jpeg(image: Image) -> bytes | None:
    """A gray picture (h, w) or one in blue, green and red (h, w, 3); None where it is no such picture."""
    import cv2

    if image.dtype != np.uint8 or image.ndim not in (2, 3) or not image.size:
        return None
    try:
        well, packed = cv2.imencode(".jpg", np.ascontiguousarray(image), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    except cv2.error:  # a size that the format has not
        return None
    return packed.tobytes() if well else None


def picture_of(data: Image | bytes) -> Image | None:
    """The gray picture, (h, w); None where the data are none."""
    import cv2

    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE) if len(data) else None
    return None if image is None else np.asarray(image, np.uint8)
