"""Pictures with the tags found in them: from pictures and videos, or from detection files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from finssim.geometry.optics import Lens
from finssim.localization.detection.detections import Frame, read_detections
from finssim.localization.errors import LocalizationError

__all__ = ["TABLES", "Seeing", "frames_of"]

TABLES = (".csv", ".tsv", ".txt")
"""Suffixes of detection files."""


@dataclass(frozen=True)
class Seeing:
    """How tags are found in pictures; see `detector`."""

    family: str
    tags: tuple[int, ...] = ()
    """Those looked for in videos, near where they were a picture before."""
    library: str | None = None
    refine: str = "fit"
    gamma: float = 1.0
    times: Path | None = None
    """File with the time stamps of the pictures."""


def frames_of(
    inputs: Sequence[Path],
    lens: Lens,
    seeing: Seeing,
    notes: list[str],
) -> tuple[Iterator[Frame], int | None]:
    """Frames one after the other, and how many there will be where that is known.

    Args:
        inputs: Pictures, folders of them, videos or detection files.
        lens: Of the camera: pictures of another size are refused.
        seeing: How tags are found in pictures.
        notes: Takes one sentence on each thing that was left out.

    Raises:
        LocalizationError: An input is not there, of unknown kind or cannot be read.
    """
    if not inputs:
        raise LocalizationError(
            "no input: give pictures, a folder of them, a video, or a detections file (.csv)"
        )
    tables = [path for path in inputs if path.suffix.lower() in TABLES]
    if tables and len(tables) < len(inputs):
        raise LocalizationError("detection files and pictures are mixed: give the ones or the others")
    if tables:
        frames = [frame for path in tables for frame in read_detections(path, notes)]
        return iter(frames), len(frames)
    return _seen(inputs, lens, seeing, notes), _count(inputs)


def _seen(
    inputs: Sequence[Path],
    lens: Lens,
    seeing: Seeing,
    notes: list[str],
) -> Iterator[Frame]:
    from finssim.localization.detection.detector import detector
    from finssim.localization.detection.pictures import pictures
    from finssim.localization.detection.region import RegionTracker

    find = detector(seeing.family, library=seeing.library, refine=seeing.refine, gamma=seeing.gamma)
    film, tracker = "", None
    for time, name, image in pictures(list(inputs), times=seeing.times, tell=notes.append):
        if image.shape != (lens.height, lens.width):
            raise LocalizationError(
                f"{name}: {image.shape[1]} x {image.shape[0]} pixels, expected {lens.width} x {lens.height} as the "
                "pool file's lens: calibrate at the size at which you record"
            )
        of_film, number, _ = name.rpartition("#")
        if not number:  # a picture for itself
            yield Frame(time, name, tuple(find.detect(image)))
            continue
        if tracker is None or of_film != film:
            film, tracker = of_film, RegionTracker(find, seeing.tags or None)
        yield Frame(time, name, tuple(tracker.detect(image, time)))


def _count(inputs: Sequence[Path]) -> int | None:
    """How many pictures there are; None with videos."""
    from finssim.localization.detection.pictures import PICTURE_FILES

    count = 0
    for path in inputs:
        inside = path.iterdir() if path.is_dir() else [path]
        here = sum(file.suffix.lower() in PICTURE_FILES for file in inside)
        if not here:
            return None
        count += here
    return count
