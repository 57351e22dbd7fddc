"""Pictures of tags with exactly known corners: a homography of the bitmap, integrated over every pixel."""

import numpy as np

from finssim.localization.detection.families import bitmap, corners, family_named

WHITE, BLACK = 210.0, 40.0


def homography(source, target):
    """Return the homography that maps four points to four others, (4, 2) each -> (3, 3)."""
    rows = []
    for (x, y), (u, v) in zip(source, target, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
    h = np.linalg.solve(np.array(rows, float), np.asarray(target, float).ravel())
    return np.append(h, 1.0).reshape(3, 3)


def moved(H, points):
    """Return points transformed by a homography, (..., 2)."""
    p = np.asarray(points) @ H[:, :2].T + H[:, 2]
    return p[..., :2] / p[..., 2:]


def pose_corners(edge, *, centre, turn=0.0, tilt=0.0, distance=6.0, towards=0.7):
    """Return pixel corners of a tag turned in the image [rad], then tilted out of it [rad] about an axis at `towards`.

    `edge` is the length of the border in pixels without tilt, `distance` that of the camera in edges.
    """
    ring = corners(1.0) * [1.0, -1.0, 1.0]  # v points down
    c, s = np.cos(turn), np.sin(turn)
    ring = ring @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T
    k = np.array([np.cos(towards), np.sin(towards), 0.0])
    ring = ring * np.cos(tilt) + np.cross(k, ring) * np.sin(tilt) + np.outer(ring @ k, k) * (1 - np.cos(tilt))
    return np.asarray(centre) + edge * ring[:, :2] * distance / (distance + ring[:, 2:])


def draw(
    shape, tags, *, family, margin=1.0, blur=0.0, noise=0.0, gamma=1.0, seed=0, oversampling=8, ground=120.0
):
    """Return a gray picture of tags, uint8 (h, w), with pixels that average the light over their area.

    Args:
        shape: Size (h, w) [px].
        tags: Id -> corners of the measured edge, pixels with integers at pixel centres, (4, 2).
        family: Family of all tags.
        margin: White margin around the bitmap [cells].
        blur: Standard deviation of the lens's blur [px].
        noise: Standard deviation of the sensor's noise [gray levels].
        gamma: Encoding: gray = 255 (light / 255)^(1/gamma).
        seed: Seed of the noise.
        oversampling: Samples along each side of a pixel.
        ground: Light from around the tags [gray levels].
    """
    from scipy.ndimage import gaussian_filter

    k = oversampling
    light = np.full((shape[0] * k, shape[1] * k), ground)
    for tag, ring in tags.items():
        _paint(light, family_named(family), tag, np.asarray(ring, float), margin, k)
    if blur:
        light = gaussian_filter(light, blur * k, truncate=5.0)
    light = light.reshape(shape[0], k, shape[1], k).mean(axis=(1, 3))
    gray = 255.0 * (light / 255.0) ** (1.0 / gamma)
    gray += noise * np.random.default_rng(seed).standard_normal(gray.shape)
    return np.clip(np.rint(gray), 0, 255).astype(np.uint8)


def _paint(light, family, tag, ring, margin, k):
    """Set the finely sampled light to a tag's cells."""
    n, o = family.border, family.outside
    square = np.array([[0, 0], [n, 0], [n, n], [0, n]], float)  # cells from the top left of the measured edge
    H = homography(square, ring)
    reach = o + margin
    outline = moved(H, square + reach * np.sign(square - n / 2))
    low = np.maximum(np.floor(outline.min(axis=0)).astype(int), 0)
    high = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + 2, np.array(light.shape)[::-1] // k)
    u, v = (np.arange(a * k, b * k) + 0.5 for a, b in zip(low, high, strict=True))
    pixels = np.stack(np.meshgrid(u / k - 0.5, v / k - 0.5), -1)
    x, y = np.moveaxis(moved(np.linalg.inv(H), pixels), -1, 0)
    cells = np.pad(bitmap(family.name, tag), 1, constant_values=1)
    i, j = (np.clip(np.floor(z).astype(int) + o + 1, 0, len(cells) - 1) for z in (y, x))
    inside = (np.abs(x - n / 2) <= n / 2 + reach) & (np.abs(y - n / 2) <= n / 2 + reach)
    patch = light[low[1] * k : high[1] * k, low[0] * k : high[0] * k]
    patch[inside] = (BLACK + (WHITE - BLACK) * cells[i, j])[inside]
