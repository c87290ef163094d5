"""Named points from text files, as surveyors export them: a header, one point per line."""

from __future__ import annotations

import csv
import difflib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from orthoflow.errors import InputError

_REQUIRED: Final = ("name", "x", "y", "z")
_MEASURED: Final = ("wall", "u_px", "v_px")
_COLUMNS: Final = (*_REQUIRED, "class", *_MEASURED)
_SEPARATORS: Final = (";", "\t", ",")
_MAX_BYTES: Final = 100_000_000
_MAX_PROBLEMS: Final = 20
_MAX_WALL: Final = 32_000
_MAX_LINE: Final = 10_000


@dataclass(frozen=True, kw_only=True)
class SurveyPoint:
    """A point with its name.

    Attributes:
        name: unique in its file.
        position: x, y, z as they stand in the file.
        class_name: empty without one.
        wall: wall in whose orthoimage the point was measured, or None.
        pixel_wall: measured column and row there, or None.
    """

    name: str
    position: tuple[float, float, float]
    class_name: str = ""
    wall: int | None = None
    pixel_wall: tuple[float, float] | None = None


def read_survey_points(path: Path) -> tuple[SurveyPoint, ...]:
    """Read a file of points.

    Columns are separated by commas, semicolons or tabs and named in the first line, in any order:
    `name,x,y,z[,class][,wall,u_px,v_px]`. Without such a line there are four or five columns in
    that order. Lines that are empty or begin with # are skipped.

    Raises:
        InputError: the file cannot be used; one line per problem, `file:line: ...`.
    """
    reader = _Reader(path.name)
    points = reader.read(_text_of(path))
    if reader.problems:
        left_out = len(reader.problems) - _MAX_PROBLEMS
        more = [f"... and {left_out} more problems"] if left_out > 0 else []
        raise InputError("\n".join(reader.problems[:_MAX_PROBLEMS] + more))
    return points


def _text_of(path: Path) -> str:
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise InputError(f"{path.name} is too large for a list of points: expected a CSV file")
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path.name} is no UTF-8 text: expected a CSV file with the columns "
            f"{','.join(_REQUIRED)}; save it as UTF-8"
        ) from error
    except OSError as error:
        raise InputError(f"{path.name} cannot be read: {error.strerror}") from error


@dataclass(frozen=True, kw_only=True)
class _Row:
    line: int
    cells: tuple[str, ...]


class _Reader:
    """Turns lines into points and collects everything that is wrong with them."""

    def __init__(self, file_name: str) -> None:
        self.file_name = file_name
        self.problems: list[str] = []

    def read(self, text: str) -> tuple[SurveyPoint, ...]:
        rows = list(_rows(text))
        if rows and len(rows[-1].cells) == 0:
            self._add(rows[-1], f"the line is longer than {_MAX_LINE} letters: this is no list")
            return ()
        if not rows:
            self.problems.append(
                f"{self.file_name} holds no points: expected {','.join(_REQUIRED)} per line"
            )
            return ()
        columns = self._columns(rows[0])
        if columns is None:
            return ()
        points = []
        lines: dict[str, int] = {}
        for row in rows[1:] if _is_header(rows[0]) else rows:
            point = self._point(row, columns)
            if point is None:
                continue
            if point.name in lines:
                self._add(
                    row, f"the name {point.name} is there already, in line {lines[point.name]}"
                )
            lines.setdefault(point.name, row.line)
            points.append(point)
        if not points and not self.problems:
            self._add(rows[0], "only the names of the columns, no points")
        return tuple(points)

    def _columns(self, first: _Row) -> tuple[str, ...] | None:
        if not _is_header(first):
            if len(first.cells) in (4, 5):
                return _COLUMNS[: len(first.cells)]
            self._add(
                first,
                f"expected the names of the columns, {','.join(_REQUIRED)}[,class]"
                f"[,{','.join(_MEASURED)}], got {len(first.cells)} values without names",
            )
            return None
        names = tuple(cell.lower() for cell in first.cells)
        n_before = len(self.problems)
        for name in names:
            if name not in _COLUMNS:
                near = difflib.get_close_matches(name, _COLUMNS, n=1)
                hint = f" (did you mean {near[0]}?)" if near else ""
                self._add(first, f"unknown column {name}{hint}; known are {', '.join(_COLUMNS)}")
            elif names.count(name) > 1:
                self._add(first, f"the column {name} is there {names.count(name)} times")
        missing = [name for name in _REQUIRED if name not in names]
        if missing:
            self._add(first, f"the column {', '.join(missing)} is missing")
        measured = [name for name in _MEASURED if name in names]
        if measured and len(measured) < len(_MEASURED):
            self._add(first, f"{', '.join(_MEASURED)} belong together, got only {measured[0]}")
        return names if len(self.problems) == n_before else None

    def _point(self, row: _Row, columns: Sequence[str]) -> SurveyPoint | None:
        if len(row.cells) != len(columns):
            hint = "; write decimal points, not commas" if len(row.cells) > len(columns) else ""
            self._add(row, f"expected {len(columns)} columns, got {len(row.cells)}{hint}")
            return None
        cells = dict(zip(columns, row.cells, strict=True))
        n_before = len(self.problems)
        if not cells["name"]:
            self._add(row, "the name is missing")
        x, y, z = (self._number(row, key, cells[key]) for key in "xyz")
        wall, pixel = self._measured(row, cells)
        if len(self.problems) > n_before:
            return None
        return SurveyPoint(
            name=cells["name"],
            position=(x, y, z),
            class_name=cells.get("class", ""),
            wall=wall,
            pixel_wall=pixel,
        )

    def _measured(
        self, row: _Row, cells: dict[str, str]
    ) -> tuple[int | None, tuple[float, float] | None]:
        given = [key for key in _MEASURED if cells.get(key)]
        if not given:
            return None, None
        if len(given) < len(_MEASURED):
            self._add(row, f"{', '.join(_MEASURED)} belong together, got only {', '.join(given)}")
            return None, None
        wall = self._number(row, "wall", cells["wall"])
        if math.isfinite(wall) and not (wall.is_integer() and 0 <= wall <= _MAX_WALL):
            self._add(row, f"wall must be the number of a wall, from 0, got {cells['wall']}")
            return None, None
        pixel = (self._number(row, "u_px", cells["u_px"]), self._number(row, "v_px", cells["v_px"]))
        return (int(wall) if math.isfinite(wall) else None), pixel

    def _number(self, row: _Row, key: str, cell: str) -> float:
        number = _as_number(cell)
        if number is None or not math.isfinite(number):
            has_decimal_comma = "," in cell and _as_number(cell.replace(",", ".")) is not None
            hint = "; write a decimal point" if has_decimal_comma else ""
            self._add(row, f"{key} must be a number, got {cell or 'nothing'}{hint}")
            return math.nan
        return number

    def _add(self, row: _Row, message: str) -> None:
        self.problems.append(f"{self.file_name}:{row.line}: {message}")


def _rows(text: str) -> Iterator[_Row]:
    lines = text.splitlines()
    first = next((line for line in lines if line.strip() and line.strip()[0] != "#"), "")
    # A comma may be part of a number; the others may not.
    separator = next((mark for mark in _SEPARATORS if mark in first), ",")
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.strip()[0] == "#":
            continue
        if len(line) > _MAX_LINE:
            yield _Row(line=number, cells=())
            return
        cells = next(csv.reader([line], delimiter=separator))
        yield _Row(line=number, cells=tuple(cell.strip() for cell in cells))


def _is_header(row: _Row) -> bool:
    return not any(_as_number(cell) is not None for cell in row.cells[1:4])


def _as_number(cell: str) -> float | None:
    try:
        # Python's own grouping mark has no place in a table.
        return None if "_" in cell else float(cell)
    except ValueError:
        return None
