"""The tables of the wire page match the code, and its C reads what Python writes."""

import re
import shutil
import struct
import subprocess
from pathlib import Path

import pytest

from finssim.robot.links.frames import (
    LAYOUTS,
    OTHERS,
    Layout,
    RejectFlag,
    StatusFlag,
    encode_command,
    forms,
)
from robot.links import wire
from robot.links.test_frames import COMMAND

PAGE = (Path(__file__).parents[3] / "docs" / "reference" / "wire.md").read_text(encoding="utf-8")
TYPES = {"?": "u8", "B": "u8", "H": "u16", "I": "u32", "f": "f32"}
OUTPUTS, ACTUATORS = 8, 4


def table(layout: Layout) -> str:
    """Return rows of offset, type, name and meaning of every byte of a frame."""
    form = forms(layout, OUTPUTS, ACTUATORS)[0]
    rows, at = (
        [("0", "1 byte" if len(layout.magic) == 1 else "2 bytes", "magic", layout.magic.hex(" ").upper())],
        len(layout.magic),
    )
    for field in form.fields:
        count = {0: OUTPUTS, OTHERS: ACTUATORS}.get(field.values, field.values)
        kind = TYPES[field.code] + (f"[{count}]" if field.values != 1 else "")
        always = "" if field.constant is None else f"{field.constant}: "
        rows.append((str(at), kind, f"`{field.name}`", always + field.meaning))
        at += struct.calcsize(f"<{count}{field.code}")
    rows.append((str(at), "u16", "CRC", f"of bytes {len(layout.magic)} to {at - 1}"))
    if layout.tail:
        rows.append((str(at + 2), "1 byte", "tail", layout.tail.hex().upper()))
    lines = ["| offset | type | name | meaning |", "| --- | --- | --- | --- |"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows), "", f"{form.size} bytes."])


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.title)
def test_the_table_of_a_frame_is_that_of_the_code(layout):
    """The table lists every byte in the order in which the encoder writes and the decoder reads."""
    assert table(layout) in PAGE


def test_the_flags_on_the_page_are_those_of_the_code():
    """Each status bit has its row, and the reject flags their sentence."""
    rows = dict(re.findall(r"^\| (\d+) \| ([^|]*) \|$", PAGE, flags=re.MULTILINE))
    assert {flag.value.bit_length() - 1 for flag in StatusFlag} <= {int(bit) for bit in rows}
    said = ", ".join(f"{flag.value} {flag.name.lower().replace('_', ' ')}" for flag in RejectFlag)
    assert f"`reject_flags`: {said}." in PAGE


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_the_firmware_on_the_page_reads_commands(tmp_path):
    """The compiled C accepts a command, and refuses a wrong CRC, a wrong tail and a value beyond full speed."""
    (code,) = re.findall(r"^```c\n(.*?)^```", PAGE, flags=re.MULTILINE | re.DOTALL)
    code += """
#include <stdio.h>
int main(void) {
  uint8_t frame[37], enable = 9;
  float thrust[8];
  while (fread(frame, 37, 1, stdin)) {
    printf("%d", read_command(frame, &enable, thrust));
    for (int i = 0; i < 8; i++) printf(" %g", thrust[i]);
    printf(" %d\\n", enable);
  }
}
"""
    (tmp_path / "firmware.c").write_text(code, encoding="utf-8")
    subprocess.run(["cc", "-Wall", "-Werror", "-o", "firmware", "firmware.c"], cwd=tmp_path, check=True)
    good = encode_command(COMMAND)
    beyond = wire.sealed(good[:2] + struct.pack("<f", float("nan")) + good[6:])
    wrong = (good[:10] + bytes([good[10] ^ 1]) + good[11:], good[:-1] + b"\xba", beyond)
    run = subprocess.run(
        [tmp_path / "firmware"], input=b"".join((good, *wrong)), capture_output=True, check=True
    )
    lines = run.stdout.decode().splitlines()
    assert lines[0] == "1 0 0.125 -0.25 0.5 -0.5 0.75 -1 1 1"
    assert [line[0] for line in lines[1:]] == ["0", "0", "0"]
