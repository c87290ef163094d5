"""Plain text for terminals: tables, diagnostics, quantities and JSON."""

from __future__ import annotations

import json
import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

import click

from orthoflow.untrusted_text import shown, shown_json

if TYPE_CHECKING:
    from orthoflow.records import RecordedCell
    from orthoflow.records.compare import Distance, ProductDistance

Row = TypeVar("Row")
_VERDICTS: Final = ("identical", "within tolerance", "different", "not measured")
# Maximum number of rows of a table, unless all rows are requested.
ROWS_MOST: Final = 20
# Unit of a difference -> printed unit; plain numbers have the unit `1`.
_UNITS: Final = {"grey": " grey levels", "1": ""}


def echo(*lines: str, err: bool = False) -> None:
    """Print lines with control characters escaped, optionally on standard error.

    All commands use this function for their output, because names, messages and logs are untrusted.
    """
    for line in lines or ("",):
        click.echo(shown(line), err=err)  # noqa: TID251 - the only place


def echo_diagnostics(cells: Iterable[RecordedCell], run: Path, *, is_whole: bool = False) -> None:
    """Print the diagnostics of cells, grouped by code, beginning with the most severe.

    Args:
        cells: cells of the run.
        run: folder or record of the run, for a hint on how to print the remaining diagnostics.
        is_whole: whether to print all diagnostics, including notes.
    """
    from orthoflow.diagnostics import FIRST_SHOWN, grouped, standing

    groups = [
        group for group in grouped(standing(cells)) if is_whole or group.worst.severity != "note"
    ]
    for group in groups if is_whole else groups[:FIRST_SHOWN]:
        echo(f"{group.worst.severity}, {group.where}: {group.sentence}")
    n_more = 0 if is_whole else len(groups) - FIRST_SHOWN
    if n_more > 0:
        echo(f"and {counted(n_more, 'more warning')}: orthoflow show {shlex.quote(str(run))} --all")


def echo_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print rows under a header in aligned columns; print nothing if there are no rows."""
    if rows:
        for line in table_lines(header, rows):
            echo(line)


def table_lines(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return lines with a header and rows in aligned columns.

    >>> table_lines(("step", "time"), [("cloud", "1.0 s")])
    ['step   time', 'cloud  1.0 s']
    """
    # Escape first, because escape sequences change the widths.
    laid = [[shown(text) for text in row] for row in (header, *rows)]
    widths = [max(len(row[i]) for row in laid) for i in range(len(header))]
    return [
        "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip()
        for row in laid
    ]


def echo_json(value: object) -> None:
    """Print a value as indented JSON."""
    text = shown_json(json.dumps(value, indent=2, ensure_ascii=False))
    click.echo(text)  # noqa: TID251 - control characters are escaped as in JSON


def echo_distances(distances: Sequence[ProductDistance], most: int | None = None) -> None:
    """Print one row per product, the reasons for differences, and the number of each verdict.

    Args:
        distances: comparisons of products.
        most: maximum number of rows, beginning with those with differences; None for all rows.
    """
    rows = first_rows(distances, most, lambda item: item.verdict == "identical")
    echo_table(
        ("product", "type", "verdict", "largest differences"),
        [
            (
                f"{item.cell}.{item.port}",
                item.type_name,
                item.verdict,
                ", ".join(_distance_text(distance) for distance in item.distances),
            )
            for item in rows
        ],
    )
    for item in rows:
        if item.reason:
            echo(f"{item.cell}.{item.port} {item.verdict}: {item.reason}")
    echo_left_out(len(distances), most)
    verdicts = Counter(item.verdict for item in distances)
    counts = ", ".join(f"{verdicts[name]} {name}" for name in _VERDICTS if verdicts[name])
    echo(f"{counted(len(distances), 'product')}{': ' if counts else ''}{counts}")


def first_rows(
    rows: Sequence[Row], most: int | None, place: Callable[[Row], int | tuple[int, ...]]
) -> Sequence[Row]:
    """Return the rows to print; if there are too many, the first ones in the order of `place`."""
    if most is None or len(rows) <= most:
        return rows
    return sorted(rows, key=place)[:most]


def echo_left_out(n_rows: int, most: int | None) -> None:
    """Print how many rows of a table were omitted, and how to print them."""
    if most is not None and n_rows > most:
        echo(f"and {n_rows - most} more, shown by --all")


def duration(seconds: float) -> str:
    """Format a duration in hours, minutes and seconds.

    >>> [duration(seconds) for seconds in (0.001, 0.042, 59.97, 75, 3700)]
    ['< 0.01 s', '0.04 s', '1 min 00 s', '1 min 15 s', '1 h 02 min']
    """
    if seconds < 0.01:
        return "< 0.01 s"
    if seconds < 1:
        return f"{seconds:.2f} s"
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    if seconds < 3599.5:
        return "{} min {:02d} s".format(*divmod(round(seconds), 60))
    return "{} h {:02d} min".format(*divmod(round(seconds / 60), 60))


def size(n_bytes: float) -> str:
    """Format a number of bytes in binary units.

    >>> [size(n) for n in (512, 2048, 5 * 1024**3)]
    ['512 B', '2.0 KiB', '5.0 GiB']
    """
    value = float(n_bytes)
    for unit in ("B", "KiB", "MiB", "GiB"):
        if value < 1024:
            return f"{value:.0f} B" if unit == "B" else f"{value:.1f} {unit}"
        value /= 1024
    return f"{value:.1f} TiB"


def number(value: float) -> str:
    """Format a number with six significant digits, or an integer with all its digits.

    >>> number(2251930.0), number(0.0012345678), number(-3.0)
    ('2251930', '0.00123457', '-3')
    """
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else f"{value:.6g}"


def counted(count: int, noun: str) -> str:
    """Format a count with its noun in the singular or plural.

    >>> counted(1, "step"), counted(3, "step")
    ('1 step', '3 steps')
    """
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _distance_text(distance: Distance) -> str:
    unit = _UNITS.get(distance.unit, f" {distance.unit}")
    largest = "not comparable" if distance.largest is None else f"{number(distance.largest)}{unit}"
    return f"{largest} ({distance.field})"
