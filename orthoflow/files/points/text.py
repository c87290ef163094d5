"""Text scans with one point per line, and fast block-by-block reading of lines of numbers."""

from __future__ import annotations

import codecs
import csv
import io
import math
import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points.fields import (
    IGNORED,
    Columns,
    columns_of_names,
    columns_of_values,
    meaning_of,
)
from orthoflow.files.points.scan_file import (
    PointBlock,
    ScanFile,
    Values,
    axes_of,
    cut_off,
    point_block,
)
from orthoflow.files.points.units import unit_of_comments, unit_of_name, unit_of_word

# The limit is far longer than the lines of any text scan or header.
#: bytes of a line of a text scan
MOST_LINE_BYTES: Final = 10_000
_HEADER_LINES: Final = 200
_SAMPLE_LINES: Final = 1000
# A block has about 300,000 points.
BLOCK_BYTES: Final = 1 << 24
# Maximum number of digits of a point count; a longer number is not a count.
_MOST_DIGITS: Final = 20
_NUMBER: Final = re.compile(
    r"[-+]?(\d+(\.\d*|,\d+)?|[.,]\d+)([eE][-+]?\d+)?"
    r"|[-+]?(nan(\(\w*\))?|inf(inity)?|1\.#\w+)|n/a|na|null|#(num!|n/a|value!|div/0!|ref!)",
    re.IGNORECASE,
)
# NaN and infinity as printed by C libraries (`nan(0x8000)`, `-nan(ind)`, `1.#QNAN`, `-1.#IND00`)
# and by spreadsheets.
_NOT_A_NUMBER: Final = re.compile(
    rb"(?:[-+]?(?:nan(?:\(\w*\))?|1[.,]#(?:ind|[qs]?nan|inf)\d*)|(?<![^\s,;])(?:n/a|na|null))"
    rb"(?![\w(])|#(?:num!|n/a|value!|div/0!|ref!)",
    re.IGNORECASE,
)
_COMMENT: Final = "#/ \t;!%"
# Pattern of column names such as `Points:0` or `P_x`, which do not occur in sentences.
_NO_WORD: Final = re.compile(
    r"[A-Za-z]+(?:[:_.\[(]?[0-2]|[:_.\[(][xyzXYZ])[\])]?|//?X|[PL][xyz]|[A-Za-z]+Time"
)


# A table is a sequence of columns (n,) of numbers.
Table = Sequence[NDArray[np.float64]]


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Separators and number of the fields in a line.

    Attributes:
        separator: character between fields; a space represents any white space.
        decimal: decimal separator, `.` or `,`.
        n_columns: number of fields in the first line.
        is_quoted: whether fields may be in quotes and then contain separators.
    """

    separator: str = " "
    decimal: str = "."
    n_columns: int
    is_quoted: bool = False

    def fields(self, line: str) -> list[str]:
        """Split a line into fields; remove quotes and an empty field after a final separator."""
        if self.separator == " ":
            return [_unquoted(item) for item in line.split()]
        fields = line.split(self.separator)
        if '"' in line:
            fields = next(csv.reader([line], delimiter=self.separator, skipinitialspace=True))
        fields = [_unquoted(field.strip()) for field in fields]
        while fields and not fields[-1]:
            fields.pop()
        return fields


def open_text(
    path: Path, columns: Columns | None = None, *, intensity_field: str | None = None
) -> ScanFile:
    """Open a text scan (.xyz, .txt, .csv, .asc, .pts).

    Args:
        path: the file.
        columns: meaning of the columns, if given by the user.
        intensity_field: name of the column to use as intensity; None for the usual one.

    Raises:
        InputError: the meaning of the columns is unknown.
    """
    lines = _first_lines(path)
    n_stated: int | None = None
    headers: list[str] = []
    for index, line in enumerate(lines[:_HEADER_LINES]):
        layout = None if is_comment(line.encode()) else find_layout(line, lines[index:])
        if layout is not None:
            n_header_lines = index
            break
        if line.isascii() and line.isdigit() and len(line) <= _MOST_DIGITS:
            n_stated = int(line)
        elif line:
            headers.append(line)
    else:
        raise InputError(
            f"{path.name} has no line with three numbers among its first "
            f"{min(len(lines), _HEADER_LINES)}: expected a point per line, e.g. x y z"
        )
    if columns is None:
        columns = _columns_of_header(path, headers, line, layout, intensity_field)
    elif len(columns.names) > layout.n_columns:
        raise InputError(
            f"{path.name} has {layout.n_columns} columns, but cloud.columns names "
            f"{len(columns.names)}: {' '.join(columns.names)}; its first line is {line[:80]!r}"
        )
    elif headers and len(labels := _labels(headers[-1])) == len(columns.names):
        columns = replace(columns, labels=tuple(labels))
    if columns is None:
        sample = [_numbers(item, layout) for item in lines[n_header_lines:] if item]
        columns = columns_of_values(
            path.name,
            np.array([row for row in sample if len(row) == layout.n_columns]),
            line,
            is_pts=path.suffix.lower() == ".pts",
        )
    unit = unit_of_comments(header.lstrip(_COMMENT) for header in headers)
    if unit is None and columns.unit is not None:
        unit = unit_of_name(columns.unit, "names of the columns")
    return ScanFile(
        name=path.name,
        format_name="text",
        n_most=line_at(path) - 1 - n_header_lines,
        scans=[columns.scan(unit=unit)],
        read=partial(_blocks, path, layout, columns, n_header_lines, n_stated),
    )


def _blocks(
    path: Path, layout: Layout, columns: Columns, n_header_lines: int, n_stated: int | None
) -> Iterator[PointBlock]:
    n_read = 0
    with path.open("rb") as file:
        take_lines(file, n_header_lines)
        places = columns.places.values()
        for table in read_tables(file, layout, places):
            n_read += len(table[0])
            values = values_of(table, columns)
            yield point_block(axes_of(values), values)
    if n_stated is not None and n_read < n_stated:
        raise cut_off(path, "list", f"{n_read} points", str(n_stated))


def _columns_of_header(
    path: Path, headers: list[str], line: str, layout: Layout, intensity_field: str | None
) -> Columns | None:
    """Return the columns named in the last header line; None if there is no such line.

    A line of units may follow the line of names.

    Raises:
        InputError: there is a header, but it does not name x, y and z or has too few columns.
    """
    unit: str | None = None
    for header in reversed(headers):
        labels = _labels(header)
        units = {word for label in labels if (word := unit_of_word(label)) is not None}
        if len(units) == 1 and all(unit_of_word(label) or not label for label in labels):
            unit = units.pop()
            continue
        found = columns_of_names(labels, intensity_field=intensity_field)
        fits = len(labels) == layout.n_columns
        if found is not None and fits:
            return replace(found, unit=unit or found.unit)
        is_remark = header != header.lstrip(_COMMENT)
        names_something = any(
            meaning_of(label) != IGNORED or _NO_WORD.fullmatch(label) for label in labels
        )
        if found is None and not (fits and (not is_remark or names_something)):
            continue
        text = (
            f"{path.name} has the header {header[:120]!r}, which does not name x, y and z for the "
            f"{layout.n_columns} columns below it (first line {line[:80]!r})"
        )
        if any(re.match(r"lat(?!er)|lon(?!ger)", label, re.IGNORECASE) for label in labels):
            text += "; if these are degrees, project them to metres first"
        # Keep known columns; missing x, y, z are assumed to be the last of the unknown ones.
        names = [meaning_of(label) for label in labels] if fits else []
        missing = [axis for axis in "xyz" if axis not in names]
        others = [place for place, name in enumerate(names) if name == IGNORED]
        if len(others) >= len(missing):
            for place, axis in zip(others[len(others) - len(missing) :], missing, strict=True):
                names[place] = axis
        else:
            names = [*"xyz", *[IGNORED] * layout.n_columns][: layout.n_columns]
        raise InputError(
            f"{text}: name the columns with cloud.columns, e.g. --set "
            f"'cloud.columns=[{', '.join(names)}]', with {IGNORED} for columns to skip"
        )
    return None


def _labels(header: str) -> list[str]:
    # A semicolon starts a comment, unless it separates columns and the first column has no name.
    stripped = header.lstrip(_COMMENT if header.count(";") == 1 else _COMMENT.replace(";", ""))
    return _fields_of(stripped)[0]


def _ended_by_returns(path: Path) -> InputError:
    return InputError(
        f"{path.name} uses only carriage returns (CR) as line ends, as old Macintosh programs do: "
        "save it with line feeds (LF or CR LF)"
    )


def _first_lines(path: Path) -> list[str]:
    with path.open("rb") as file:
        start = file.read(MOST_LINE_BYTES)
        if b"\r" in start and b"\n" not in start:
            raise _ended_by_returns(path)
        file.seek(0)
        raw = take_lines(file, _HEADER_LINES + _SAMPLE_LINES)
    if raw and raw[0].startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise InputError(f"{path.name} is UTF-16 text: save it as UTF-8 or plain ASCII")
    if any(b"\0" in line for line in raw):
        raise InputError(
            f"{path.name} has the suffix of a text file but contains binary data: give it the "
            "suffix of its format, or export it as text"
        )
    if raw:
        raw[0] = raw[0].removeprefix(codecs.BOM_UTF8)
    try:
        return [line.decode().strip() for line in raw]
    except UnicodeDecodeError:
        return [line.decode("latin-1").strip() for line in raw]


def line_at(path: Path, place: int | None = None) -> int:
    """Return the number (1 for the first) of the line at an offset; None is the file's end."""
    n_lines, n_left, is_within = 1, path.stat().st_size if place is None else place, False
    with path.open("rb") as file:
        while block := file.read(min(BLOCK_BYTES, n_left)):
            n_left -= len(block)
            n_lines += _count_ends(block)
            is_within = not block.endswith(b"\n")
    return n_lines + is_within


def _count_ends(block: bytes) -> int:
    # For short lines, this is five times as fast as `bytes.count`.
    return int(np.count_nonzero(np.frombuffer(block, dtype=np.uint8) == ord("\n")))


# Any: arrays of any type.
def values_of(table: Table, columns: Columns, packed: Any = np.int64) -> Values:
    """Return the columns of a text table by meaning; `packed` is the type of packed colours."""
    values: Values = dict(zip(columns.places, table, strict=True))
    if "rgb" in values:
        values["rgb"] = np.nan_to_num(values["rgb"], posinf=0.0, neginf=0.0).astype(packed)
    return values


def is_comment(line: bytes) -> bool:
    """Return whether a line begins with `#` or `//`, and not with an error value like `#NUM!`."""
    start = line.lstrip()
    return start.startswith((b"#", b"//")) and not _NOT_A_NUMBER.match(start)


def find_layout(line: str, sample: Sequence[str] = ()) -> Layout | None:
    """Return the layout of a line; None if it has fewer than three numbers or mostly other words.

    Numbers may be quoted, as in CSV files.

    Args:
        line: the first line of numbers.
        sample: the following lines, used to detect decimal commas if the first has only integers.
    """
    fields, separator = _fields_of(line)
    if not _are_mostly_numbers(fields):
        return None
    layout = Layout(
        separator=separator,
        n_columns=len(fields),
        is_quoted=any('"' in item for item in [line, *sample]),
    )
    numbers = (field for item in [line, *sample] for field in layout.fields(item))
    has_comma = any("," in number for number in numbers if _NUMBER.fullmatch(number))
    return replace(layout, decimal="," if has_comma else ".")


def _are_mostly_numbers(fields: Sequence[str]) -> bool:
    n_numbers = sum(_NUMBER.fullmatch(field) is not None for field in fields)
    return n_numbers >= 3 and 2 * n_numbers >= len(fields)


def _fields_of(line: str) -> tuple[list[str], str]:
    """Return the fields of a line and its separator: semicolon, tab, comma or white space."""
    # Ignore separators in quotes.
    bare = re.sub('"[^"]*"', '""', line)
    words = bare.split()
    separator = " "
    if ";" in bare:
        separator = ";"
    elif "\t" in bare and not any(_are_numbers(f.split()) for f in bare.split("\t") if " " in f):
        separator = "\t"
    # `1,5 2,5 3,5` is three numbers with decimal commas; `1, 2, 3` and `1,2,3` are not.
    elif "," in bare and not (len(words) >= 3 and _are_numbers(words)):
        separator = ","
    return Layout(separator=separator, n_columns=0).fields(line), separator


def _unquoted(field: str) -> str:
    return field[1:-1].strip() if len(field) > 1 and field[0] == field[-1] == '"' else field


def _are_numbers(fields: Sequence[str]) -> bool:
    return all(_NUMBER.fullmatch(field) for field in fields)


def _numbers(line: str, layout: Layout) -> list[float]:
    """Return the numbers of a line; NaN for a field that is not a number."""
    texts = [field.replace(layout.decimal, ".") for field in layout.fields(line)]
    is_number = [
        _NUMBER.fullmatch(text) and "," not in text and not _NOT_A_NUMBER.fullmatch(text.encode())
        for text in texts
    ]
    return [float(t) if is_so else math.nan for t, is_so in zip(texts, is_number, strict=True)]


def take_lines(file: BinaryIO, n_lines: int) -> list[bytes]:
    """Read up to `n_lines` further lines of a file; no line is read beyond the maximum length.

    Raises:
        InputError: a line is longer than `MOST_LINE_BYTES`.
    """
    lines: list[bytes] = []
    while len(lines) < n_lines and (line := file.readline(MOST_LINE_BYTES + 1)):
        if len(line) > MOST_LINE_BYTES:
            raise long_line(Path(file.name), file.tell())
        lines.append(line)
    return lines


def long_line(path: Path, place: int) -> InputError:
    """Return the error for a line that is too long; `place` is an offset within this line."""
    return InputError(
        f"{path.name}, line {line_at(path, place) - 1}: the line has more than {MOST_LINE_BYTES} "
        "bytes, so this is not a list of points; export the file again"
    )


def read_tables(
    file: BinaryIO,
    layout: Layout,
    columns: Iterable[int],
    *,
    n_rows: int | None = None,
    end: int | None = None,
) -> Iterator[Table]:
    """Read lines of numbers in blocks.

    Args:
        file: file, positioned at the start of a line.
        layout: separators of the numbers.
        columns: indices of the requested columns, from 0.
        n_rows: maximum number of rows, after which no line is read; None for all rows.
        end: offset in the file where the last line ends; None for the end of the file.

    Yields:
        The columns of a block, without blank lines and comments; NaN where a line is too short.

    Raises:
        InputError: a line contains something other than numbers.
    """
    wanted, n_left = list(columns), n_rows
    while n_left != 0:
        start = file.tell()
        block = _take_block(file, n_left, end)
        if not block:
            return
        try:
            table = _table(block, layout, wanted)
        except ValueError as error:
            raise _unread_line(Path(file.name), start, block, layout, wanted) from error
        if n_left is not None:
            n_left -= len(table[0])
            if n_left < 0:  # the parser ends lines at CR, too
                raise _ended_by_returns(Path(file.name))
        yield table


def _take_block(file: BinaryIO, n_lines: int | None, end: int | None) -> bytes:
    """Read the next complete lines, up to a given number of lines and a given offset."""
    size = BLOCK_BYTES if end is None else min(BLOCK_BYTES, end - file.tell())
    block = file.read(size)
    if block and not block.endswith(b"\n"):
        rest = file.readline(MOST_LINE_BYTES)
        if len(rest) == MOST_LINE_BYTES:
            raise long_line(Path(file.name), file.tell())
        block += rest
    if n_lines is not None and _count_ends(block) > n_lines:
        ends = np.flatnonzero(np.frombuffer(block, dtype=np.uint8) == ord("\n"))
        kept = int(ends[n_lines - 1]) + 1
        file.seek(kept - len(block), io.SEEK_CUR)
        block = block[:kept]
    return block


def _table(block: bytes, layout: Layout, wanted: list[int]) -> Table:
    """Parse lines; if this fails, remove comments and other spellings of NaN, and parse again."""
    try:
        table = _parse(block, layout, wanted, layout.separator)
        # If single spaces are the separator, a line of spaces would become a row.
        if layout.separator != " " or not np.isnan(table[0]).any():
            return table
    except ValueError:
        pass
    if b"#" in block or b"//" in block:
        block = b"\n".join(line for line in block.split(b"\n") if not is_comment(line))
    plain = _NOT_A_NUMBER.sub(b"nan", block)
    return _parse(plain, layout, wanted, layout.separator.replace(" ", r"\s+"))


def _parse(block: bytes, layout: Layout, columns: list[int], separator: str) -> Table:
    import pandas as pd

    if block.isspace() or not block:
        return [np.empty(0)] * len(columns)
    with warnings.catch_warnings():
        # pandas only warns about a longer first line, and would drop numbers.
        warnings.simplefilter("error", pd.errors.ParserWarning)
        try:
            frame = pd.read_csv(
                io.BytesIO(block),
                sep=separator,
                decimal=layout.decimal,
                header=None,
                # Pass all columns, requested or not; otherwise, pandas does not detect lines with
                # too many fields.
                names=list(range(layout.n_columns)),
                index_col=False,
                engine="c",
                low_memory=False,
                dtype=dict.fromkeys(columns, np.float64),
                skipinitialspace=True,
                encoding_errors="replace",
                quoting=csv.QUOTE_MINIMAL if layout.is_quoted else csv.QUOTE_NONE,
            )
        except pd.errors.ParserWarning as warning:
            raise ValueError(str(warning)) from warning
    return [frame[name].to_numpy() for name in columns]


def _unread_line(
    path: Path, start: int, block: bytes, layout: Layout, wanted: list[int]
) -> InputError:
    """Return the error for the first line without data in the block at the offset `start`."""
    first_line = line_at(path, start)
    where, got = f"from line {first_line}", " per line"
    for number, line in enumerate(block.split(b"\n"), start=first_line):
        text = line.decode("utf-8", "replace").strip()
        fields = layout.fields(text)
        cells = [fields[k] for k in wanted if k < len(fields) and fields[k]]
        fits = len(fields) <= layout.n_columns and _are_numbers(cells)
        if not fits and not is_comment(line):
            where, got = f"line {number}", f" as in the preceding lines, got {text[:60]!r}"
            break
    return InputError(
        f"{path.name}, {where}: expected {layout.n_columns} numbers{got}; correct the line or "
        "export the file again"
    )
