"""Findings: coded remarks about data and fits, with their texts, and the error of this package."""

from __future__ import annotations

import math
import string
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import yaml

Severity = Literal["refused", "care", "note"]
"""Severity: refused (the trial or fit cannot be used), care (a part may not be used), note (for information)."""

SEVERITIES: tuple[Severity, ...] = ("refused", "care", "note")
"""Severities, worst first."""

MAX_NAMES = 8
"""Largest number of list items in a sentence."""

MAX_SUBJECTS = 3
"""Largest number of subjects in a sentence that applies to several."""


class _Template(string.Formatter):
    """Formatter like `str.format` that writes a tuple as a list."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if not isinstance(value, (tuple, list)):
            return str(super().format_field(value, format_spec))
        return listed([format(item, format_spec) for item in value], MAX_NAMES)


def listed(texts: Sequence[str], limit: int) -> str:
    """Join texts by commas, and state how many are omitted beyond `limit`."""
    return ", ".join(texts[:limit]) + (f" and {len(texts) - limit} more" if len(texts) > limit else "")


@dataclass(frozen=True)
class Finding:
    """Remark about data or a fit."""

    code: str
    """Key of `wordings`."""
    severity: Severity
    subject: str = ""
    """Subject: a trial, file, thruster, axis or parameter; empty if it is obvious from the context."""
    values: Mapping[str, Any] = field(default_factory=dict, hash=False)
    """Values of the sentence's fields, in SI or in the unit that the sentence names."""

    @property
    def text(self) -> str:
        """Sentence without its subject: the fact and the remedy."""
        return _Template().format(wordings()[self.code][1], **self.values)

    def __str__(self) -> str:
        return f"{self.subject}: {self.text}" if self.subject else self.text

    def about(self, subject: str) -> Finding:
        """Return the finding with a subject, which precedes the existing one."""
        return replace(self, subject=f"{subject}: {self.subject}" if self.subject else subject)

    def as_json(self) -> dict[str, Any]:
        """Return code, severity, subject, values and sentence; non-finite numbers become None."""
        return {
            "code": self.code,
            "severity": self.severity,
            "subject": self.subject,
            "values": plain(self.values),
            "sentence": str(self),
        }


def finding(code: str, subject: str = "", /, *, severity: Severity | None = None, **values: Any) -> Finding:
    """Return a finding with the default severity of its code.

    Args:
        code: Key of `wordings`.
        subject: Subject of the finding.
        severity: Severity, if it differs from the default.
        values: Fields of the sentence.
    """
    return Finding(code, severity or wordings()[code][0], subject, values)


def sentences(findings: Iterable[Finding]) -> list[str]:
    """Return sentences in order; findings with the same text are combined in one sentence with several subjects."""
    subjects: dict[tuple[str, str], list[str]] = {}
    for item in findings:
        named = subjects.setdefault((item.code, item.text), [])
        if item.subject not in named:
            named.append(item.subject)
    return [
        f"{listed(named, MAX_SUBJECTS)}: {text}" if any(named) else text
        for (_, text), named in subjects.items()
    ]


def plain(value: Any, digits: int = 17) -> Any:
    """Return a value in JSON types: lists, text, and numbers with this number of significant digits, None if
    not finite."""
    if isinstance(value, Mapping):
        return {key: plain(item, digits) for key, item in value.items()}
    value = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(value, (tuple, list)):
        return [plain(item, digits) for item in value]
    if isinstance(value, float):
        return float(f"{value:.{digits}g}") if math.isfinite(value) else None
    return value


@cache
def wordings() -> dict[str, tuple[Severity, str]]:
    """Return code -> default severity, and sentence with the fields of `Finding.values` (`findings.yaml`)."""
    table = yaml.safe_load(Path(__file__).with_name("findings.yaml").read_text(encoding="utf-8"))
    return {code: next(iter(wording.items())) for code, wording in table.items()}


class CalibrationError(ValueError):
    """Trial, table or fit that cannot be used; the message states location, problem and remedy.

    Attributes:
        subject: The trial or file that cannot be used; empty if the reason names it.
        reason: The message without the subject.
    """

    def __init__(self, reason: str, subject: str = "") -> None:
        """Create the error with its reason, and the trial or file that it concerns."""
        super().__init__(f"{subject}: {reason}" if subject else reason)
        self.reason, self.subject = reason, subject
