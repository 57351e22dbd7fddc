"""Frames packed by hand, without the table of fields, and a bitwise CRC, as references for the tests of the
link."""

import math
import struct

from hypothesis import strategies as st

from finssim.robot.links.frames import DebugConfig
from finssim.robot.messages import CommandEcho, Telemetry, ThrusterCommand


def crc_bitwise(data: bytes) -> int:
    """Return the CRC16-MODBUS as in the standard: initial value 0xFFFF, polynomial 0xA001, bit by bit."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            carry = crc & 1
            crc >>= 1
            if carry:
                crc ^= 0xA001
    return crc


BYTES = tuple(crc_bitwise(bytes([0xFF ^ byte])) ^ 0xFF for byte in range(256))
"""Register after one byte in an empty register; 0xFF in its lower half comes from the initial value."""


def crc_bytewise(data: bytes) -> int:
    """Return the same CRC, eight steps at once, for fuzzing."""
    crc = 0xFFFF
    for byte in data:
        crc = (crc >> 8) ^ BYTES[(crc ^ byte) & 0xFF]
    return crc


def with_crc(magic: bytes, body: bytes, tail: bytes = b"") -> bytes:
    return magic + body + struct.pack("<H", crc_bitwise(body)) + tail


def command_bytes(command: ThrusterCommand) -> bytes:
    values = command.normalised
    if command.setpoints:
        payload = struct.pack(f"<?{len(values)}f", command.enable, *values)
        payload += struct.pack(f"<{len(command.setpoints)}f", *command.setpoints)
        return with_crc(b"\xac\xca", struct.pack("<BBH", 2, 2, len(payload)) + payload)
    return with_crc(b"\xaa", struct.pack(f"<B{len(values)}f", command.enable, *values), b"\xbb")


def telemetry_bytes(t: Telemetry) -> bytes:
    x, y, z, w = t.quaternion
    payload = struct.pack("<4f3f3ff", w, x, y, z, *t.gyro, *t.accel, t.depth) + struct.pack(
        "<fI", t.pressure, t.flags
    )
    if t.motor_rpm is not None:
        payload += struct.pack(f"<{len(t.motor_rpm)}f", *t.motor_rpm)
    payload += struct.pack(f"<{len(t.actuators)}f", *t.actuators)
    version = 2 if t.actuators else 1
    return with_crc(
        b"\xa5\x5a", struct.pack("<BBHHI", 1, version, len(payload), t.sequence, t.mcu_ms) + payload
    )


def echo_bytes(e: CommandEcho) -> bytes:
    payload = struct.pack(
        "<IIHBBI", e.command_count, e.receive_ms, e.command_crc, e.enabled, e.accepted, e.reject_flags
    )
    payload += struct.pack(f"<{len(e.received)}f{len(e.applied)}f", *e.received, *e.applied)
    payload += struct.pack("<IH", e.debug_mask, e.decimation)
    return with_crc(b"\xa5\x5a", struct.pack("<BBHHI", 2, 1, len(payload), e.sequence, e.mcu_ms) + payload)


def debug_config_bytes(d: DebugConfig) -> bytes:
    return with_crc(b"\xac\xca", struct.pack("<BBHHIHH", 1, 1, 8, d.sequence, d.mask, d.decimation, 0))


U16, U32 = st.integers(0, 2**16 - 1), st.integers(0, 2**32 - 1)
NUMBER = st.floats(allow_nan=False, allow_infinity=False, width=32)
SHARE = st.floats(-1.0, 1.0, width=32)


def numbers(count, of=NUMBER):
    return st.tuples(*[of] * count)


def commands(outputs=8):
    return st.builds(ThrusterCommand, enable=st.booleans(), normalised=numbers(outputs, SHARE))


def telemetries(outputs=8):
    return st.builds(
        Telemetry,
        sequence=U16,
        mcu_ms=U32,
        quaternion=numbers(4),
        gyro=numbers(3),
        accel=numbers(3),
        depth=NUMBER,
        pressure=NUMBER,
        flags=U32,
        motor_rpm=st.none() | numbers(outputs),
    )


def echoes(outputs=8):
    return st.builds(
        CommandEcho,
        sequence=U16,
        mcu_ms=U32,
        command_count=U32,
        receive_ms=U32,
        command_crc=U16,
        enabled=st.booleans(),
        accepted=st.booleans(),
        reject_flags=U32,
        received=numbers(outputs),
        applied=numbers(outputs),
        debug_mask=U32,
        decimation=U16,
    )


def debug_configs():
    return st.builds(DebugConfig, sequence=U16, mask=U32, decimation=U16)


def sealed(frame: bytes) -> bytes:
    """Return the frame with a valid CRC, for the kind of frame that it appears to be."""
    head, tail = (1, 1) if frame[:1] == b"\xaa" else (2, 0)
    if len(frame) < head + 2 + tail:
        return frame
    at = len(frame) - 2 - tail
    return frame[:at] + struct.pack("<H", crc_bytewise(frame[head:at])) + frame[at + 2 :]


def frame_at(stream: bytes, at: int, side: str, outputs: int = 8):
    """Read one frame by hand; return its length (0: none begins here) and message (None: a number is not
    finite)."""
    if side == "mcu" and stream[at] == 0xAA:
        return _read(stream, at, 1, f"<B{outputs}f", 1, _command)
    magic = b"\xa5\x5a" if side == "host" else b"\xac\xca"
    if stream[at : at + 2] != magic or len(stream) < at + 6:
        return 0, None
    kind, version, length = struct.unpack_from("<BBH", stream, at + 2)
    n = 4 * outputs
    known = {
        ("host", 1, 84 - 32 + n): (f"<BBHHI12fI{outputs}f", _telemetry),
        ("host", 1, 52): ("<BBHHI12fI", _telemetry),
        ("host", 2, 22 + 2 * n): (f"<BBHHIIIHBBI{2 * outputs}fIH", _echo),
        ("mcu", 1, 8): ("<BBHHIHH", _debug_config),
    }
    if version != 1 or (side, kind, length) not in known:
        return 0, None
    body, build = known[side, kind, length]
    return _read(stream, at, 2, body, 0, build)


def _read(stream, at, head, body, tail, build):
    end = at + head + struct.calcsize(body)
    size = end + 2 + tail - at
    whole = len(stream) >= at + size and stream[end + 2 : at + size] == b"\xbb"[:tail]
    if not whole or crc_bytewise(stream[at + head : end]) != int.from_bytes(stream[end : end + 2], "little"):
        return 0, None
    values = struct.unpack_from(body, stream, at + head)
    return size, build(values) if all(map(math.isfinite, values)) else None


def _command(v):
    return ThrusterCommand(v[0] != 0, v[1:])


def _telemetry(v):
    w, x, y, z = v[5:9]
    return Telemetry(v[3], v[4], (x, y, z, w), v[9:12], v[12:15], v[15], v[16], v[17], v[18:] or None)


def _echo(v):
    n = (len(v) - 13) // 2
    bools = (v[8] != 0, v[9] != 0)
    return CommandEcho(*v[3:8], *bools, v[10], v[11 : 11 + n], v[11 + n : 11 + 2 * n], *v[-2:])


def _debug_config(v):
    return DebugConfig(v[3], v[4], v[5])


def frames_in(stream: bytes, side: str, outputs: int = 8):
    """Return all messages of a stream, the reference for decoders, by trying every byte as the beginning of a
    frame."""
    at, found = 0, []
    while at < len(stream):
        size, message = frame_at(stream, at, side, outputs)
        if size and message is not None:
            found.append(message)
        at += size or 1
    return found
