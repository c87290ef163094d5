"""Diagnostics as data: each is declared once, with a code by which diagnostics are grouped.

A method declares a `DiagnosticSpec` and reports it with `ctx.report(SPEC, subject=..., **values)`.
The terminal, the report and the record use the code, severity and values; no code parses the text.
"""

from __future__ import annotations

import math
import re
import string
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

from orthoflow_provenance.document import RecordedDiagnostic as Diagnostic

from orthoflow.errors import ProductError
from orthoflow.untrusted_text import first_few, shown

__all__ = [
    "FIRST_SHOWN",
    "Diagnostic",
    "DiagnosticGroup",
    "DiagnosticSpec",
    "grouped",
    "placement",
    "standing",
    "warning_texts",
]

Severity = Literal["error", "warning", "note"]
Value = bool | int | float | str | None

# Number of groups that a summary shows.
FIRST_SHOWN: Final = 5
_ORDER: Final = ("error", "warning", "note")
_LONGEST: Final = 2000
_CODE: Final = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")
_STEP: Final = re.compile(r"\{step(?:\[([^\]]+)\])?\}")
_UNLESS: Final = re.compile(r"\{unless\[([^\]]+)\]:([^}]*)\}")


@dataclass(frozen=True, kw_only=True)
class DiagnosticSpec:
    """Declaration of a diagnostic.

    In `text` and `remedy`, `{step}` is replaced by the name of the reporting step, and
    `{step[raster]}` or `{step[raster.grid]}` by the name of the step with that kind or method, so
    that a remedy can refer to a setting, as in `{step[raster]}.margin_m=0.2`. The part of a remedy
    that recommends a method, such as `{unless[match.guided]:match again with match.guided, or }`,
    is omitted in workflows with this method.

    Attributes:
        code: stable name for documents and tests, e.g. `scan-without-colour`.
        severity: `error` (the result is wrong), `warning` (the result is limited) or `note`.
        text: format string that describes the problem, with fields for the values and `{subject}`.
        remedy: format string that describes what to do.
        rank_by: name of the value that determines the worst diagnostic of a group, which is the one
            with the largest value or, if the name begins with `-`, with the smallest.
        settled_by: method ids and codes of diagnostics; a later step with one of these methods or
            diagnostics resolves this diagnostic.
        is_summary: whether the diagnostic summarises its step; if so, it is printed when it is
            reported, even if it is a note.
    """

    code: str
    text: str
    severity: Severity = "warning"
    remedy: str = ""
    rank_by: str = ""
    settled_by: tuple[str, ...] = ()
    is_summary: bool = False

    def __post_init__(self) -> None:
        if not _CODE.fullmatch(self.code):
            raise ProductError(
                "the code of a diagnostic must be lower-case words joined by `-`, got "
                f"{self.code!r}"
            )
        if self.severity not in _ORDER:
            raise ProductError(
                f"the severity of {self.code} must be error, warning or note, got {self.severity!r}"
            )

    def of(self, subject: str, values: Mapping[str, object]) -> Diagnostic:
        """Return the diagnostic with these values.

        Raises:
            ProductError: a value in the text is missing, or is neither a number nor a string.
        """
        later = {name: _Placeholder(name) for name in ("step", "unless")}
        fields = {**values, "subject": subject, **later}
        try:
            text, remedy = (
                _FORMATTER.vformat(template, (), fields) for template in (self.text, self.remedy)
            )
        except (KeyError, IndexError, ValueError, TypeError, AttributeError) as error:
            raise ProductError(
                f"diagnostic {self.code} cannot be formatted: {type(error).__name__}: {error}; "
                f"its values are {', '.join(values) or 'none'}"
            ) from error
        plain = {name: _plain(self.code, name, value) for name, value in values.items()}
        rank = plain.get(self.rank_by.removeprefix("-"))
        if self.rank_by and (isinstance(rank, str) or rank is None):
            raise ProductError(
                f"diagnostic {self.code} is ranked by {self.rank_by}, which must be a number, got "
                f"{rank!r}"
            )
        return Diagnostic(
            code=self.code,
            severity=self.severity,
            subject=_line(subject),
            values=plain,
            text=_line(text),
            remedy=_line(remedy),
            rank_by=self.rank_by,
            settled_by=self.settled_by,
            is_summary=self.is_summary,
        )


@dataclass(frozen=True, kw_only=True)
class DiagnosticGroup:
    """Diagnostics with the same code.

    Attributes:
        worst: the diagnostic with the worst value.
        count: number of diagnostics.
        subjects: distinct subjects of the other diagnostics, in order.
        places: distinct addresses of the cells that reported the diagnostics, beginning with that
            of the worst one.
    """

    worst: Diagnostic
    count: int
    subjects: tuple[str, ...]
    places: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """The worst diagnostic, the number and the subjects of the others, and the remedy."""
        text = self.worst.text
        # A diagnostic that several combinations report for the same subject counts once.
        if self.count > 1 and (self.subjects or self.count > len(self.places)):
            also = f"; also {first_few(self.subjects)}" if self.subjects else ""
            text = f"{text} ({'the worst of ' if self.worst.rank_by else ''}{self.count}{also})"
        return f"{text}: {self.worst.remedy}" if self.worst.remedy else text

    @property
    def where(self) -> str:
        """The first address, and the number of further addresses."""
        return first_few(self.places, most=1)


def grouped(reported: Iterable[tuple[str, Diagnostic]]) -> tuple[DiagnosticGroup, ...]:
    """Group diagnostics by code, most severe first.

    Args:
        reported: address of the cell and its diagnostic, in the order of the run.

    Returns:
        One group per code, or per text for diagnostics without a code of their own. The most severe
        groups come first; groups of equal severity are sorted by whether they have a remedy, by
        size, and by the order of the run.
    """
    groups: dict[tuple[str, str], list[tuple[str, Diagnostic]]] = {}
    for place, one in reported:
        key = (one.code, one.text if one.code == PLAIN_WARNING.code else "")
        groups.setdefault(key, []).append((place, one))
    found = [_group(members) for members in groups.values()]
    return tuple(
        sorted(
            found,
            key=lambda group: (
                _ORDER.index(group.worst.severity),
                not group.worst.remedy,
                -group.count,
            ),
        )
    )


def warning_texts(reported: Iterable[Diagnostic]) -> tuple[str, ...]:
    """Return the text of each distinct warning and error, with its remedy."""
    return tuple(
        dict.fromkeys(
            f"{one.text}: {one.remedy}" if one.remedy else one.text
            for one in reported
            if one.severity != "note"
        )
    )


# Any, because these are cells of a run or of a record.
def standing(cells: Iterable[Any]) -> tuple[tuple[str, Diagnostic], ...]:
    """Return the diagnostics that no later step resolved, each with the address of its cell."""
    cells = tuple(cells)
    settled = {
        (given.digest, name)
        for cell in cells
        if cell.status == "ok"
        for name in (cell.method, *(one.code for one in cell.diagnostics))
        for given in cell.inputs.values()
    }
    return tuple(
        (cell.address, one)
        for cell in cells
        for one in cell.diagnostics
        if not any(
            (made.digest, name) in settled
            for name in one.settled_by
            for made in cell.outputs.values()
        )
    )


def placement(steps: Iterable[tuple[str, str]]) -> Callable[[Diagnostic, str], Diagnostic]:
    """Return a function that inserts the names of a workflow's steps into a diagnostic.

    Its arguments are the diagnostic and the name of the reporting step. It also omits remedies with
    methods of the workflow. Workflows share results, but may have different names for steps, so the
    names are inserted when a result is used.

    Args:
        steps: for each cell, the name of its step and the id of its method.
    """
    found: dict[str, set[str]] = {}
    methods: set[str] = set()
    for step, method in steps:
        methods.add(method)
        for name in (method, method.partition(".")[0]):
            found.setdefault(name, set()).add(step)

    def step_of(name: str) -> str:
        # If several steps have this kind or method, the reference is ambiguous.
        return min(found[name]) if len(found.get(name, ())) == 1 else name

    def placed(one: Diagnostic, step: str) -> Diagnostic:
        def inserted(text: str) -> str:
            return _STEP.sub(lambda match: step_of(match[1]) if match[1] else step, text)

        remedy = _UNLESS.sub(lambda match: "" if match[1] in methods else match[2], one.remedy)
        return replace(one, text=inserted(one.text), remedy=inserted(remedy))

    return placed


class _Placeholder:
    """A field that remains in the text until the function from `placement` replaces it."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __format__(self, form: str) -> str:
        return f"{{{self._name}{form and ':'}{form}}}"

    def __getitem__(self, name: str) -> _Placeholder:
        return _Placeholder(f"{self._name}[{name}]")


_FORMATTER: Final = string.Formatter()
# Spec for `ctx.warn`, which has no values besides its text.
PLAIN_WARNING: Final = DiagnosticSpec(code="warning", severity="warning", text="{text}")
TOO_MANY: Final = DiagnosticSpec(
    code="more-diagnostics",
    severity="note",
    text="{n:,} more diagnostics of this step were discarded",
    rank_by="n",
)


def _line(text: str) -> str:
    line = shown(" ".join(text[: _LONGEST + 1].split()))
    return line if len(text) <= _LONGEST else f"{line[:_LONGEST]}... ({len(text)} characters)"


def _plain(code: str, name: str, value: object) -> Value:
    # Convert scalars of numpy, which is not imported here.
    item = getattr(value, "item", None)
    plain = item() if callable(item) and getattr(value, "ndim", 1) == 0 else value
    if isinstance(plain, float) and not math.isfinite(plain):
        return None
    if isinstance(plain, str):
        return _line(plain)
    if plain is None or isinstance(plain, bool | int | float):
        return plain
    raise ProductError(
        f"value {name} of diagnostic {code} must be a number or text, got {type(value).__name__}"
    )


def _group(members: Sequence[tuple[str, Diagnostic]]) -> DiagnosticGroup:
    place, worst = max(members, key=lambda member: _harm(member[1]))
    others = dict.fromkeys(one.subject for _, one in members if one.subject != worst.subject)
    return DiagnosticGroup(
        worst=worst,
        count=len(members),
        subjects=tuple(filter(None, others)),
        places=tuple(dict.fromkeys((place, *(place for place, _ in members)))),
    )


def _harm(one: Diagnostic) -> float:
    value = one.values.get(one.rank_by.removeprefix("-"))
    if not isinstance(value, int | float):
        return -math.inf
    return -value if one.rank_by.startswith("-") else float(value)
