"""Frames out of a stream of bytes: whole or in parts, with garbage between them, and never a wrong one."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable

from finssim.robot.link.frames import COMMAND, DEBUG_CONFIG, ECHO, NAVIGATION, TELEMETRY, Message
from finssim.robot.link.layout import Form, Layout, crc16_modbus, forms

__all__ = ["HOST", "MCU", "Decoder"]

HOST = (TELEMETRY, ECHO, NAVIGATION)
"""What the robot's computer listens for."""
MCU = (COMMAND, DEBUG_CONFIG)
"""What the motor controller listens for."""

_HEADER = 6
"""Bytes of magic, type, version and length."""


class Decoder:
    """Turns what came over the wire into messages; keeps the beginning of a frame until its end has come.

    A frame counts only with its magic, a known type, version and length, a right CRC and finite numbers. Where one of
    the first three is wrong, the search goes on one byte further, so a true frame is found behind any garbage, at
    the latest when the bytes that a false beginning announces (at most `longest`) have come.

    Note:
        `counts` tells what was seen: `accepted` messages by class name; `bad_crc`, `bad_length`, `unknown_type` of
        what looked like a beginning, `not_finite` frames, and `skipped_bytes` outside of frames with a right CRC.
    """

    def __init__(self, kinds: Iterable[Layout] = HOST, outputs: int = 8) -> None:
        """Args:
        kinds: Layouts to decode, `HOST` or `MCU`.
        outputs: Motor outputs of the vehicle (`vehicle.mcu.outputs`).
        """
        self.accepted: Counter[str] = Counter()
        self.refused: Counter[str] = Counter(bad_crc=0, bad_length=0, unknown_type=0, not_finite=0)
        self.skipped_bytes = 0
        self._rest = b""
        known = [form for layout in kinds for form in forms(layout, outputs)]
        self.longest = max(form.size for form in known)
        self._plain = {f.layout.magic[0]: f for f in known if len(f.prefix) < _HEADER}
        self._headed = {f.prefix: f for f in known if len(f.prefix) >= _HEADER}
        self._types = {prefix[:4] for prefix in self._headed}
        self._magic = _search(form.layout.magic for form in known)

    @property
    def counts(self) -> dict[str, int | dict[str, int]]:
        """What has been accepted and refused so far."""
        return {"accepted": dict(self.accepted), **self.refused, "skipped_bytes": self.skipped_bytes}

    def feed(self, data: bytes) -> list[Message]:
        """Messages that `data` completes, in the order of their bytes; never raises, whatever the bytes are."""
        data, at = self._rest + data, 0
        found: list[Message] = []
        while begin := self._magic.search(data, at):
            self.skipped_bytes += begin.start() - at
            at = begin.start()
            form = self._frame(data, at)
            if form is None:
                self._rest = data[at:]
                return found
            if isinstance(form, str):
                self.refused[form] += 1
                self.skipped_bytes += 1
                at += 1
                continue
            message = form.decode(data, at)
            at += form.size
            if message is None:
                self.refused["not_finite"] += 1
            else:
                self.accepted[type(message).__name__] += 1
                found.append(message)
        self.skipped_bytes += len(data) - at
        self._rest = b""
        return found

    def _frame(self, data: bytes, at: int) -> Form | str | None:
        """The frame that begins at a magic, why none does, or None while too few bytes have come to tell."""
        form = self._plain.get(data[at])
        if form is None:
            prefix = data[at : at + _HEADER]
            form = self._headed.get(prefix)
            if len(prefix) >= 4 and prefix[:4] not in self._types:
                return "unknown_type"
            if form is None:
                return "bad_length" if len(prefix) == _HEADER else None
        end = at + form.crc_at
        if len(data) < at + form.size:
            return None
        if data[end + 2 : at + form.size] != form.layout.tail:
            return "bad_length"
        body = data[at + len(form.layout.magic) : end]
        return form if crc16_modbus(body) == data[end] | data[end + 1] << 8 else "bad_crc"


def _search(magics: Iterable[bytes]) -> re.Pattern[bytes]:
    """Finds where a frame may begin: at a magic, or at a part of one where the bytes end."""
    parts = {
        re.escape(m) if len(m) == 1 else re.escape(m[:1]) + b"(?:" + re.escape(m[1:]) + rb"|\Z)"
        for m in magics
    }
    return re.compile(b"|".join(sorted(parts)))
