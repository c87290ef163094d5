"""Lines of numbers: how they are separated, and reading many of them fast."""

from __future__ import annotations

import io
import math
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points.blocks import BLOCK_POINTS, MOST_LINE_BYTES, short_file_error

_NUMBER: Final = re.compile(
    r"[-+]?(\d+(\.\d*|,\d+)?|[.,]\d+)([eE][-+]?\d+)?"
    r"|[-+]?(nan(\(\w*\))?|inf(inity)?|1\.#\w+)|n/a|na|null|#(num!|n/a|value!|div/0!|ref!)",
    re.IGNORECASE,
)
# How C libraries print what is not finite: `nan(0x8000)`, `-nan(ind)`, `1.#QNAN`, `-1.#IND00`; and
# how spreadsheets do.
_NOT_A_NUMBER: Final = re.compile(
    rb"(?:[-+]?(?:nan(?:\(\w*\))?|1[.,]#(?:ind|[qs]?nan|inf)\d*)|(?<![^\s,;])(?:n/a|na|null))"
    rb"(?![\w(])|#(?:num!|n/a|value!|div/0!|ref!)",
    re.IGNORECASE,
)
_COMMENTS: Final = (b"#", b"//")
_SCAN_BYTES: Final = 1 << 24
_LINES_AT_ONCE: Final = 10_000


@dataclass(frozen=True, kw_only=True)
class Layout:
    r"""How the numbers of a line are told apart.

    Attributes:
        separator: pattern for pandas: a character, or `\s+` for any white space.
        decimal: `.` or `,`.
        n_columns: numbers in the first line.
    """

    separator: str
    decimal: str
    n_columns: int


def split_fields(line: str) -> tuple[list[str], str]:
    """Fields of a line, and the separator found: semicolon, tab, comma or white space."""
    if ";" in line:
        return _split(line, ";"), ";"
    words = line.split()
    tabbed = _split(line, "\t")
    if "\t" in line and not any(_are_numbers(field.split()) for field in tabbed if " " in field):
        return tabbed, "\t"
    # `1,5 2,5 3,5` is three numbers with decimal commas, `1, 2, 3` and `1,2,3` are not.
    if "," in line and not (len(words) >= 3 and _are_numbers(words)):
        return _split(line, ","), ","
    return words, r"\s+"


def is_comment(line: bytes) -> bool:
    """Whether a line is no data: it begins with `#` or `//`, and not with `#NUM!` or the like."""
    start = line.lstrip()
    return start.startswith(_COMMENTS) and not _NOT_A_NUMBER.match(start)


def find_data(line: str) -> Layout | None:
    """Layout of a line with at least three numbers, and more numbers than texts; None for others.

    Numbers may be quoted, as in CSV files.
    """
    fields, separator = split_fields(line)
    numbers = [field for field in map(unquoted, fields) if _NUMBER.fullmatch(field)]
    if len(numbers) < 3 or 2 * len(numbers) < len(fields):
        return None
    has_comma = separator != "," and any("," in number for number in numbers)
    return Layout(separator=separator, decimal="," if has_comma else ".", n_columns=len(fields))


def unquoted(field: str) -> str:
    """Field of a CSV line without the quotes around it."""
    return field[1:-1].strip() if len(field) > 1 and field[0] == field[-1] == '"' else field


def numbers_of(line: str, layout: Layout) -> list[float]:
    """Numbers of a line; NaN for a field that is none."""
    return [
        _number(field.replace(layout.decimal, ".")) if _NUMBER.fullmatch(field) else math.nan
        for field in map(unquoted, _fields(line, layout))
    ]


def count_lines(path: Path) -> int:
    """Count the lines of a file; a last line without an end counts too."""
    lines = 0
    last = b"\n"
    with path.open("rb") as file:
        while block := file.read(_SCAN_BYTES):
            lines += block.count(b"\n")
            last = block[-1:]
    return lines + (last != b"\n")


def take_lines(file: BinaryIO, n_lines: int, *, first_line: int) -> list[bytes]:
    """Read the next lines of a file, at most so many; never more of a line than it may have.

    Raises:
        InputError: a line is longer than `MOST_LINE_BYTES`.
    """
    lines: list[bytes] = []
    pieces = iter(partial(file.readline, MOST_LINE_BYTES + 1), b"")
    # Some at a time: what is one line of gigabytes is noticed before it is all in memory.
    while part := list(islice(pieces, min(_LINES_AT_ONCE, n_lines - len(lines)))):
        if max(map(len, part)) > MOST_LINE_BYTES:
            place = next(place for place, line in enumerate(part) if len(line) > MOST_LINE_BYTES)
            raise InputError(
                f"{Path(file.name).name}, line {first_line + len(lines) + place}: the line has "
                f"more than {MOST_LINE_BYTES} bytes, so this is not a list of points; export the "
                "file again"
            )
        lines += part
    return lines


def read_table(
    file: BinaryIO, layout: Layout, columns: Sequence[int], *, n_lines: int, first_line: int
) -> NDArray[np.float64]:
    """Read the next lines of a file as numbers.

    Args:
        file: open at the start of a line.
        layout: how numbers are told apart.
        columns: which columns are wanted, counted from 0.
        n_lines: at most so many lines are read.
        first_line: number of the next line, counted from 1, for messages.

    Returns:
        (n, len(columns)) float64; fewer rows at the end of the file and where lines are blank or
        comments; NaN where a line is too short.

    Raises:
        InputError: a line holds something else than numbers.
    """
    lines = take_lines(file, n_lines, first_line=first_line)
    try:
        return _parse(lines, layout, columns)
    except ValueError as error:
        kept = [_NOT_A_NUMBER.sub(b"nan", line) for line in lines if not is_comment(line)]
        try:
            return _parse(kept, layout, columns)
        except ValueError:
            raise _bad_line(Path(file.name), lines, layout, columns, first_line) from error


def read_stated(
    file: BinaryIO,
    layout: Layout,
    columns: Sequence[int],
    *,
    n_points: int,
    first_line: int,
    what: str,
) -> Iterator[NDArray[np.float64]]:
    """Read as many points as a header states, a line each, in blocks.

    Raises:
        InputError: a line holds something else than numbers, or there are fewer; `what` holds them.
    """
    for start in range(0, n_points, BLOCK_POINTS):
        count = min(BLOCK_POINTS, n_points - start)
        table = read_table(file, layout, columns, n_lines=count, first_line=first_line + start)
        if len(table) != count:
            found = f"{start + len(table)} points"
            raise short_file_error(Path(file.name), what, found, str(n_points))
        yield table


def read_tables(
    file: BinaryIO, layout: Layout, columns: Sequence[int], *, block_lines: int, first_line: int
) -> Iterator[NDArray[np.float64]]:
    """Read the rest of a file in blocks of lines."""
    line = first_line
    while file.peek(1) if isinstance(file, io.BufferedReader) else True:
        table = read_table(file, layout, columns, n_lines=block_lines, first_line=line)
        line += block_lines
        yield table


def _parse(lines: list[bytes], layout: Layout, columns: Sequence[int]) -> NDArray[np.float64]:
    import pandas as pd

    content = b"".join(lines)
    if not content.strip():
        return np.empty((0, len(columns)))
    with warnings.catch_warnings():
        # A longer first line is only warned about and would lose numbers.
        warnings.simplefilter("error", pd.errors.ParserWarning)
        try:
            frame = pd.read_csv(
                io.BytesIO(content),
                sep=layout.separator,
                decimal=layout.decimal,
                header=None,
                # All columns, wanted or not: only so does pandas notice a line with too many.
                names=list(range(layout.n_columns)),
                index_col=False,
                engine="c",
                low_memory=False,
                dtype=dict.fromkeys(columns, np.float64),
                skipinitialspace=True,
                encoding_errors="replace",
                quoting=0 if b'"' in lines[0] else 3,
            )
        except pd.errors.ParserWarning as warning:
            raise ValueError(str(warning)) from warning
    table: NDArray[np.float64] = frame[list(columns)].to_numpy(dtype=np.float64)
    return table


def _bad_line(
    path: Path, lines: list[bytes], layout: Layout, columns: Sequence[int], first_line: int
) -> InputError:
    for offset, line in enumerate(lines):
        text = line.decode("utf-8", "replace").strip()
        if not is_comment(line) and not _fits(text, layout, columns):
            return InputError(
                f"{path.name}, line {first_line + offset}: expected {layout.n_columns} numbers as "
                f"in the lines before, got {text[:60]!r}; correct the line or export the file again"
            )
    return InputError(
        f"{path.name}, from line {first_line}: expected {layout.n_columns} numbers per line; "
        "export the file again"
    )


def _fits(text: str, layout: Layout, columns: Sequence[int]) -> bool:
    fields = _fields(text, layout)
    wanted = [fields[column] for column in columns if column < len(fields)]
    return len(fields) <= layout.n_columns and _are_numbers(
        [unquoted(item) for item in wanted if item]
    )


def _number(text: str) -> float:
    """Number of a text; NaN where it has a decimal comma that the first lines do not have."""
    is_none = "," in text or _NOT_A_NUMBER.fullmatch(text.encode())
    return math.nan if is_none else float(text)


def _fields(line: str, layout: Layout) -> list[str]:
    return line.split() if layout.separator == r"\s+" else _split(line, layout.separator)


def _split(line: str, separator: str) -> list[str]:
    """Fields without blanks around them, and without the empty one after a closing separator."""
    fields = [field.strip() for field in line.split(separator)]
    while fields and not fields[-1]:
        fields.pop()
    return fields


def _are_numbers(fields: Sequence[str]) -> bool:
    return all(_NUMBER.fullmatch(field) for field in fields)
