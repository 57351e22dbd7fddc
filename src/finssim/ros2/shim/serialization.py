"""`rclpy.serialization`: messages to bytes and back."""

from typing import Any

from finssim.ros2.codec import Message, codec_of

__all__ = ["deserialize_message", "serialize_message"]


def serialize_message(message: Message) -> bytes:
    """CDR bytes of a message."""
    return bytes(codec_of().serialize(message))


def deserialize_message(data: bytes, message_type: type[Message]) -> Any:
    """A message of a class from its CDR bytes."""
    return codec_of().deserialize(bytearray(data), message_type.TYPE)
