"""Cut records made whole: everything up to the cut, with the summary that lets readers find their way."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from finssim.files import atomic_write
from finssim.mcap_repair import MAGIC, whole_mcap
from finssim.robot.record_types import RecordError

__all__ = ["refuse_foreign", "repair_record", "write_whole"]


def repair(
    file: Path,
    *,
    out: Path | None = None,
) -> None:
    """Write a whole record of all that can be read of a cut or damaged one; FILE itself stays as it is.

    Example: finssim record repair run.mcap --out whole.mcap

    Args:
        file (FILE): Record of a run (.mcap).
        out (FILE): File to write; FILE-repaired.mcap if not given.
    """
    target = out or file.with_name(f"{file.stem}-repaired.mcap")
    for note in repair_record(file, target) or ["nothing is damaged"]:
        print(note)
    print(f"wrote {target}")


def repair_record(path: Path, out: Path) -> list[str]:
    """Write a whole record of all that can be read of a cut or damaged one.

    Args:
        path: The record; it stays as it is.
        out: File to write.

    Returns:
        What was found damaged, one sentence each; none of a record that is well.

    Raises:
        RecordError: Not an MCAP file.
        OutputError: `out` cannot be written.
    """
    refuse_foreign(path)
    notes: list[str] = []
    with whole_mcap(path, notes) as whole, atomic_write(out) as temporary:
        write_whole(whole, temporary, notes)
    return notes


def refuse_foreign(path: Path) -> None:
    """Refuse what is no MCAP file.

    Raises:
        RecordError: It is none, or cannot be read.
    """
    try:
        with path.open("rb") as file:
            begins = file.read(len(MAGIC))
    except OSError as error:
        raise RecordError(f"{path}: cannot be read: {error.strerror or error}") from None
    if begins != MAGIC:
        raise RecordError(f"{path}: is no MCAP file: expected a record that FinsSim or rosbag2 wrote")


def write_whole(source: Path, target: Path, notes: list[str]) -> None:
    """Copy every record of a file, as far as it can be read, into one with an index."""
    from mcap.stream_reader import StreamReader
    from mcap.writer import CompressionType, Writer

    with source.open("rb") as given, target.open("wb") as made:
        writer = Writer(made, compression=CompressionType.LZ4)
        copier = _Copier(writer)
        try:
            for record in StreamReader(given, validate_crcs=True).records:
                copier.copy(record)
        except Exception as error:  # damage shows in whatever layer meets it
            notes.append(f"{source.name} is damaged and was read up to there: {str(error).splitlines()[0]}")
        copier.finish()


class _Copier:
    """Puts records of one file into a writer, which numbers schemas and channels anew."""

    def __init__(self, writer: Any) -> None:
        self.writer = writer
        self.schemas: dict[int, int] = {0: 0}
        self.channels: dict[int, int] = {}
        self.started = False

    def copy(self, record: Any) -> None:
        from mcap import records

        if isinstance(record, records.Header):
            self._start(record.profile, record.library)
        elif isinstance(record, records.Schema) and record.id not in self.schemas:
            self.schemas[record.id] = self.writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, records.Channel) and record.id not in self.channels:
            self.channels[record.id] = self.writer.register_channel(
                record.topic, record.message_encoding, self.schemas[record.schema_id], record.metadata
            )
        elif isinstance(record, records.Message):
            self.writer.add_message(
                self.channels[record.channel_id],
                record.log_time,
                record.data,
                record.publish_time,
                record.sequence,
            )
        elif isinstance(record, records.Metadata):
            self.writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, records.Attachment):
            self.writer.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )

    def finish(self) -> None:
        self._start("", "")
        self.writer.finish()

    def _start(self, profile: str, library: str) -> None:
        if not self.started:
            self.writer.start(profile=profile, library=library)
            self.started = True
