"""Pictures and videos as a stream of gray pictures with names and times; unreadable files are reported and
left out."""

from __future__ import annotations

import math
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from finssim.core.budget import PIXELS, decoded_picture, read_bytes
from finssim.core.files import atomic_write
from finssim.core.text_table import read_text_table
from finssim.localization import LocalizationError

Image = npt.NDArray[np.uint8]
Timed = tuple[float, str, Image]

PICTURE_FILES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm")
VIDEO_FILES = (".mp4", ".avi", ".mkv", ".mov", ".m4v", ".webm", ".mpg", ".mpeg")

_UNITS = {10: 1.0, 13: 1e-3, 16: 1e-6, 19: 1e-9}
"""Number of digits of a count since 1970 -> its unit [s]."""


def pictures(
    sources: Path | str | Sequence[Path | str],
    *,
    times: Path | str | None = None,
    notify: Callable[[str], None] | None = None,
) -> Iterator[Timed]:
    """Return an iterator over time stamp [s], name and gray picture (h, w) of all sources, in sequence.

    A folder stands for its pictures in natural order (2 before 10), or for its videos if it contains no
    pictures. The time of a picture is that in `times`; else that in its name, where a number with a decimal
    point is seconds and a count of 10, 13, 16 or 19 digits is seconds, milli-, micro- or nanoseconds since
    1970; else NaN. Pictures of a video have its time stamps and are called `video.mp4#0`, `video.mp4#1`, ...
    Pixels stay as the camera wrote them: the orientation stored in a file is ignored, so that all pictures of
    a camera share one pixel frame.

    Args:
        sources: Pictures, folders or videos.
        times: CSV file with the columns `image` and `time` [s].
        notify: Function that receives one sentence for each excluded file and one with their number; None: print to
            standard error.

    Raises:
        LocalizationError: A source is missing or of unknown kind, no picture can be read, or `times` lacks one.
    """
    locations = [sources] if isinstance(sources, (str, Path)) else list(sources)
    files = [file for source in locations for file in _files(Path(source))]
    clock = None if times is None else _read_times(Path(times))
    names = _names(files)
    if clock is not None:
        for file, name in names.items():
            if file.suffix.lower() in PICTURE_FILES and name not in clock and file.name not in clock:
                raise LocalizationError(f"{times}: no time of {name}: add a line with it or omit the picture")
    return _stream(files, names, clock or {}, notify or _print_note)


def read_picture(path: Path) -> Image:
    """Return one gray picture, (h, w).

    Raises:
        LocalizationError: The file cannot be read, is cut short or is not a picture.
    """
    import cv2

    raw = read_bytes(path, LocalizationError)
    if not raw:
        raise LocalizationError(f"{path}: the file is empty")
    if _cut_short(raw):
        raise LocalizationError(f"{path}: the picture is cut short")
    image = decoded_picture(raw, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if isinstance(image, str):
        raise LocalizationError(f"{path}: {image}")
    return image


def write_picture(image: npt.NDArray[np.uint8], path: Path | str) -> None:
    """Write a picture, gray (h, w) or red-green-blue (h, w, 3), in the format of the path's suffix.

    Raises:
        LocalizationError: Unknown suffix.
        OutputError: The file cannot be written.
    """
    import cv2

    suffix = Path(path).suffix.lower()
    if suffix not in PICTURE_FILES:
        raise LocalizationError(f"{path}: expected a name that ends in {', '.join(PICTURE_FILES)}")
    ordered = image[..., ::-1] if image.ndim == 3 else image
    _, encoded = cv2.imencode(suffix, np.ascontiguousarray(ordered))
    with atomic_write(path) as temporary:
        temporary.write_bytes(encoded.tobytes())


def _print_note(sentence: str) -> None:
    print(sentence, file=sys.stderr)


def _files(source: Path) -> list[Path]:
    """Return the files of one source."""
    if source.is_dir():
        inside = sorted(
            (p for p in source.iterdir() if p.is_file() and not p.name.startswith(".")), key=_natural
        )
        for kinds in (PICTURE_FILES, VIDEO_FILES):
            chosen = [p for p in inside if p.suffix.lower() in kinds]
            if chosen:
                return chosen
        raise LocalizationError(f"{source}: the folder holds no pictures ({', '.join(PICTURE_FILES)})")
    if not source.exists():
        raise LocalizationError(f"{source}: there is no such file or folder")
    if source.suffix.lower() not in PICTURE_FILES + VIDEO_FILES:
        raise LocalizationError(
            f"{source}: expected a picture ({', '.join(PICTURE_FILES)}), a video ({', '.join(VIDEO_FILES)}) "
            "or a folder of them"
        )
    return [source]


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """Return a sorting key in which numbers are compared as numbers."""
    parts = re.findall(r"\d+|\D+", path.name.lower())
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]


def _names(files: Sequence[Path]) -> dict[Path, str]:
    """Return the name of each file: its own, with its folders if another file has the same name."""
    often = Counter(file.name for file in files)
    return {file: file.name if often[file.name] == 1 else file.as_posix() for file in files}


def _stream(
    files: Sequence[Path],
    names: Mapping[Path, str],
    clock: Mapping[str, float],
    notify: Callable[[str], None],
) -> Iterator[Timed]:
    excluded, yielded = 0, 0
    first = ""
    for file in files:
        try:
            for picture in _of_file(file, names[file], clock, notify):
                yielded += 1
                yield picture
        except LocalizationError as error:
            excluded += 1
            first = first or str(error)
            notify(f"{error}: left out")
    if not yielded:
        raise LocalizationError(f"none of {len(files)} files can be read; the first: {first}")
    if excluded:
        notify(f"{excluded} of {len(files)} files were left out")


def _of_file(
    file: Path, name: str, clock: Mapping[str, float], notify: Callable[[str], None]
) -> Iterator[Timed]:
    if file.suffix.lower() in VIDEO_FILES:
        yield from _of_video(file, name, notify)
        return
    time = clock.get(name, clock.get(file.name, math.nan))
    yield (_time_in(file.stem) if math.isnan(time) else time), name, read_picture(file)


def _of_video(file: Path, name: str, notify: Callable[[str], None]) -> Iterator[Timed]:
    import cv2

    video = cv2.VideoCapture(str(file))
    try:
        rate = float(video.get(cv2.CAP_PROP_FPS))
        announced = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        width, height = video.get(cv2.CAP_PROP_FRAME_WIDTH), video.get(cv2.CAP_PROP_FRAME_HEIGHT)
        if width * height > PIXELS:
            raise LocalizationError(
                f"{file}: its pictures have {width:g} x {height:g} pixels, expected at most {PIXELS >> 20} million"
            )
        count, last = 0, -math.inf
        while True:
            there, image = video.read()
            if not there:
                break
            time = 1e-3 * float(video.get(cv2.CAP_PROP_POS_MSEC))
            if time <= last:  # a container without time stamps
                time = last + (1.0 / rate if rate > 0.0 else math.nan)
            last = time
            gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            yield time, f"{name}#{count}", np.asarray(gray, np.uint8)
            count += 1
    finally:
        video.release()
    if count == 0:
        raise LocalizationError(f"{file}: is no video that can be read")
    if 0 < count < announced:
        notify(f"{file}: the video is cut short: {count} of {announced} pictures were read")


def _time_in(stem: str) -> float:
    """Return the time stamp in a file's name [s], NaN if it contains none."""
    decimal = re.findall(r"(?<![\d.])\d+\.\d+(?![\d.])", stem)
    if len(decimal) == 1:
        return float(decimal[0])
    for digits in re.findall(r"\d+", stem):
        seconds = int(digits) * _UNITS.get(len(digits), math.nan)
        if 1e9 <= seconds < 3e9:  # 2001 to 2065
            return float(seconds)
    return math.nan


def _read_times(path: Path) -> dict[str, float]:
    """Return name -> time [s] from a CSV file with the columns image and time."""
    table = read_text_table(path, LocalizationError)
    image = table.place(("image", "file", "filename", "name"))
    time = table.place(("time", "t", "timestamp", "time_s"))
    if image is None or time is None:
        raise LocalizationError(f"{path}: expected a first line 'image,time'")
    times = {}
    for number, row in zip(table.lines, table.rows, strict=True):
        try:
            value = float(row[time])
            times[row[image]] = value
        except (ValueError, IndexError):
            value = math.nan
        if not math.isfinite(value):
            raise LocalizationError(f"{path}: line {number}: expected the name of a picture and its time [s]")
    return times


def _cut_short(raw: bytes) -> bool:
    """Return whether a PNG or JPEG file lacks its end; decoders would fill the rest with gray."""
    if raw.startswith(b"\x89PNG"):
        return b"IEND" not in raw
    if not raw.startswith(b"\xff\xd8"):
        return False
    at = 2
    while raw[at : at + 2] not in (
        b"\xff\xda",
        b"",
    ):
        # Skip the segments, which may contain a thumbnail.
        if raw[at] != 0xFF or at + 4 > len(raw):
            return True
        filled = raw[at + 1] == 0xFF  # a fill byte
        at += 1 if filled else 2 + int.from_bytes(raw[at + 2 : at + 4], "big")
    return raw.find(b"\xff\xd9", at) < 0
