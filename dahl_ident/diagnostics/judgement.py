"""Judgements: lists of findings, the worst severity of which is the status."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from dahl_ident.diagnostics.text import sentence


class VerdictStatus(StrEnum):
    """The judgement of a result, from good to bad; its value is what users read."""

    TRUSTED = "trusted"
    """Every parameter is determined and the model describes the data."""
    APPROXIMATE = "approximate"
    """The misfit exceeds the noise, and the stated uncertainty includes it."""
    NOT_DETERMINED = "not determined"
    """The data do not determine a parameter, or the computation has not converged."""
    NOT_DESCRIBED = "not described"
    """The misfit is so large that no uncertainty can be stated."""

    @property
    def usable(self) -> bool:
        """Whether the numbers can be used with their stated uncertainty."""
        return self in (VerdictStatus.TRUSTED, VerdictStatus.APPROXIMATE)

    @property
    def rank(self) -> int:
        """Place in the order from good to bad."""
        return list(VerdictStatus).index(self)


class Question(StrEnum):
    """The question that a finding answers."""

    DETERMINED = "determined"
    """Which parameters or combinations do the data determine?"""
    DESCRIBED = "described"
    """Does the model describe the data, and how large is the misfit?"""
    ASSUMED = "assumed"
    """What does the result depend on that the data cannot test?"""


@dataclass(frozen=True)
class Finding:
    """One finding about a result; printed, a sentence or two."""

    question: Question  # which of the three questions it answers
    severity: VerdictStatus  # the best status that a result with this finding can have
    code: str  # its kind, such as "misfit" or "negative"; it does not change with the wording
    values: Mapping[str, Any] = field(default_factory=dict)  # its numbers and names

    def __str__(self) -> str:
        return sentence(self.code, self.values)

    def to_dict(self) -> dict[str, Any]:
        """Return the finding as plain data, with its text."""
        names = {"question": str(self.question), "severity": str(self.severity)}
        return {**names, "code": self.code, "values": dict(self.values), "text": str(self)}


def described(
    code: str, severity: VerdictStatus = VerdictStatus.TRUSTED, /, **values: Any
) -> Finding:
    """Return a finding about how the model describes the data."""
    return Finding(Question.DESCRIBED, severity, code, values)


def determined(
    code: str, severity: VerdictStatus = VerdictStatus.NOT_DETERMINED, /, **values: Any
) -> Finding:
    """Return a finding about what the data determine, or do not."""
    return Finding(Question.DETERMINED, severity, code, values)


def assumed(code: str, /, **values: Any) -> Finding:
    """Return a finding about what the result depends on and the data cannot test."""
    return Finding(Question.ASSUMED, VerdictStatus.TRUSTED, code, values)


_MOST_SHOWN = 5  # findings of a verdict; more would not be read


class Judgement:
    """The findings about a result, the most serious first.

    The worst severity is its `status`. At most five findings are `shown`, including the assumptions
    of a usable result; for an unusable one, what is identified or assumed is left out. The others
    are `supporting`.
    """

    def __init__(self, findings: Iterable[Finding]) -> None:
        self.findings = tuple(sorted(findings, key=lambda finding: -finding.severity.rank))
        self.status = self.findings[0].severity if self.findings else VerdictStatus.TRUSTED
        needed = [
            finding
            for finding in self.findings
            if self.status.usable
            or finding.severity is not VerdictStatus.TRUSTED
            or finding.question is Question.DESCRIBED
        ]
        assumed = [finding for finding in needed if finding.question is Question.ASSUMED]
        others = [finding for finding in needed if finding.question is not Question.ASSUMED]
        self.shown = (*others[: _MOST_SHOWN - len(assumed)], *assumed)
        self.supporting = tuple(f for f in self.findings if f not in self.shown)

    @property
    def statements(self) -> tuple[str, ...]:
        """The verdict in words; the first sentence begins with the status."""
        texts = [str(finding) for finding in self.shown]
        return (" ".join([f"{self.status.capitalize()}.", *texts[:1]]), *texts[1:])
