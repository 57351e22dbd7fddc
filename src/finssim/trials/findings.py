"""Findings about data and fits, with all their wordings, and the error of this package."""

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
"""The worst first."""

MAX_NAMES = 8
"""Items of a list that a sentence names."""

MAX_SUBJECTS = 3
"""Subjects that a sentence names where it holds for several."""


class _Template(string.Formatter):
    """`str.format` that writes a tuple as a list of words."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if not isinstance(value, (tuple, list)):
            return str(super().format_field(value, format_spec))
        return listed([format(item, format_spec) for item in value], MAX_NAMES)


def listed(texts: Sequence[str], limit: int) -> str:
    """Words after one another, and how many more than `limit` there are."""
    return ", ".join(texts[:limit]) + (f" and {len(texts) - limit} more" if len(texts) > limit else "")


@dataclass(frozen=True)
class Finding:
    """One remark about data or a fit."""

    code: str
    """Key of `wordings`."""
    severity: Severity
    subject: str = ""
    """Subject: a trial, file, thruster, axis or parameter; empty if it is obvious."""
    values: Mapping[str, Any] = field(default_factory=dict, hash=False)
    """Fields of the sentence, in SI or in the unit that the sentence names."""

    @property
    def text(self) -> str:
        """The sentence without its subject: what, and what to do."""
        return _Template().format(wordings()[self.code][1], **self.values)

    def __str__(self) -> str:
        return f"{self.subject}: {self.text}" if self.subject else self.text

    def about(self, subject: str) -> Finding:
        """Return the finding with a subject, or with a part of the subject that it has."""
        return replace(self, subject=f"{subject}: {self.subject}" if self.subject else subject)

    def as_json(self) -> dict[str, Any]:
        """Code, severity, subject, values and sentence; numbers that are not finite become None."""
        return {
            "code": self.code,
            "severity": self.severity,
            "subject": self.subject,
            "values": plain(self.values),
            "sentence": str(self),
        }


def finding(code: str, subject: str = "", /, *, severity: Severity | None = None, **values: Any) -> Finding:
    """A finding with the severity that its code usually has.

    Args:
        code: Key of `wordings`.
        subject: What it is about.
        severity: Where it differs from the usual one.
        values: Fields of the sentence.
    """
    return Finding(code, severity or wordings()[code][0], subject, values)


def sentences(findings: Iterable[Finding]) -> list[str]:
    """Sentences in their order; what holds for several subjects is one sentence."""
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
    """Return a value in JSON's types: lists, text, and numbers of so many significant digits, None for those that are
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
    """Code -> its usual severity, and its sentence with the fields that `Finding.values` fills (`findings.yaml`)."""
    table = yaml.safe_load(Path(__file__).with_name("findings.yaml").read_text(encoding="utf-8"))
    return {code: next(iter(wording.items())) for code, wording in table.items()}


class CalibrationError(ValueError):
    """A trial, table or fit that cannot be used; the message states where, what was found and what to do.

    Attributes:
        subject: The trial or file that cannot be used; empty where the reason names it.
        reason: The message without it.
    """

    def __init__(self, reason: str, subject: str = "") -> None:
        """Make the error with its reason, and the trial or file that it concerns."""
        super().__init__(f"{subject}: {reason}" if subject else reason)
        self.reason, self.subject = reason, subject
