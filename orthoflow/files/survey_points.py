"""Tables of points, as surveyors export and people write them: a header, one point per line."""

from __future__ import annotations

import csv
import difflib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Final, TypeVar

from orthoflow.errors import InputError
from orthoflow.files.sidecars import MOST_WALLS
from orthoflow.foreign_text import text_of_file

_MEASURED: Final = ("wall", "u_px", "v_px")
_IN_MAP: Final = ("map_x", "map_y")
_IN_SPACE: Final = ("shown_x", "shown_y", "shown_z")
_TWICE: Final = "measured twice, as {} and as {}: leave one of them out"
_SEPARATORS: Final = (";", "\t", ",")
MOST_BYTES: Final = 20_000_000
MOST_POINTS: Final = 100_000
_MAX_PROBLEMS: Final = 20
MOST_LINE: Final = 10_000


@dataclass(frozen=True, kw_only=True)
class SurveyPoint:
    """A point with its name.

    Attributes:
        name: unique in its file.
        position: x, y, z as they stand in the file.
        class_name: empty without one.
        wall: wall in whose orthoimage the point was measured, or None.
        pixel_wall: measured column and row there, or None.
        place_m: measured X and Y there, as its GeoTIFF has them, or None.
        shown_m: x, y, z in metres of what is shown where the point was measured, or None.
    """

    name: str
    position: tuple[float, float, float]
    class_name: str = ""
    wall: int | None = None
    pixel_wall: tuple[float, float] | None = None
    place_m: tuple[float, float] | None = None
    shown_m: tuple[float, float, float] | None = None


@dataclass(frozen=True, kw_only=True)
class MeasuredTie:
    """A point of a photo that somebody measured.

    Attributes:
        where: file and line, for messages.
        photo: name of the photo.
        pixel: column and row as they stand in the file.
        position: x, y, z as they stand in the file.
        sigma_px: standard deviation of each pixel coordinate, or None.
    """

    where: str
    photo: str
    pixel: tuple[float, float]
    position: tuple[float, float, float]
    sigma_px: float | None = None


def read_measured_ties(path: Path) -> tuple[MeasuredTie, ...]:
    """Read a file of ties: `photo,u_px,v_px,x,y,z[,sigma_px]`, otherwise as `read_survey_points`.

    Raises:
        InputError: the file cannot be used; one line per problem, `file:line: ...`.
    """
    reader = _TieReader(path.name)
    return reader.checked(reader.ties(_text_of(path, reader.form)))


def read_survey_points(path: Path) -> tuple[SurveyPoint, ...]:
    """Read a file of points.

    Columns are separated by commas, semicolons or tabs and named in the first line, in any order:
    `name,x,y,z[,class][,wall,u_px,v_px]`; instead of the last three there may be `map_x,map_y` or
    `shown_x,shown_y,shown_z`, each with or without `wall`.
    Without such a line there are four or five columns in that order. Lines that are empty or begin
    with # are skipped.

    Raises:
        InputError: the file cannot be used; one line per problem, `file:line: ...`.
    """
    reader = _PointReader(path.name)
    return reader.checked(reader.points(_text_of(path, reader.form)))


@dataclass(frozen=True, kw_only=True)
class _Form:
    """Columns of a table.

    Attributes:
        content: what its lines are.
        required: columns that are always there.
        known: all columns, in the order of a table whose first line does not name them.
        bare: how many such a table may have.
        together: columns of which all are there or none.
        instead: groups of columns that stand for them, of each of which all are there or none;
            the first of `together` may go with them.
    """

    content: str
    required: tuple[str, ...]
    known: tuple[str, ...]
    bare: tuple[int, ...]
    together: tuple[str, ...] = ()
    instead: tuple[tuple[str, ...], ...] = ()


_POINTS: Final = _Form(
    content="points",
    required=("name", "x", "y", "z"),
    known=("name", "x", "y", "z", "class", *_MEASURED, *_IN_MAP, *_IN_SPACE),
    bare=(4, 5),
    together=_MEASURED,
    instead=(_IN_MAP, _IN_SPACE),
)
_TIES: Final = _Form(
    content="ties",
    required=("photo", "u_px", "v_px", "x", "y", "z"),
    known=("photo", "u_px", "v_px", "x", "y", "z", "sigma_px"),
    bare=(6, 7),
)


def _text_of(path: Path, form: _Form) -> str:
    what = f"a CSV file of {form.content} with the columns {','.join(form.required)}"
    return text_of_file(path, MOST_BYTES, what)


@dataclass(frozen=True, kw_only=True)
class _Row:
    line: int
    cells: tuple[str, ...]


_Item = TypeVar("_Item")


class _TableReader:
    """Turns lines into rows of a table and collects everything that is wrong with them."""

    form: ClassVar[_Form]

    def __init__(self, file_name: str) -> None:
        self.file_name = file_name
        self.problems: list[str] = []

    def checked(self, items: tuple[_Item, ...]) -> tuple[_Item, ...]:
        """Give what was read, or say what is wrong with it."""
        if self.problems:
            left_out = len(self.problems) - _MAX_PROBLEMS
            more = [f"... and {left_out} more problems"] if left_out > 0 else []
            raise InputError("\n".join(self.problems[:_MAX_PROBLEMS] + more))
        return items

    def _table(self, text: str) -> Iterator[tuple[_Row, dict[str, str]]]:
        """Give the rows that have a cell for every column."""
        form, rows = self.form, list(_rows(text))
        if rows and len(rows[-1].cells) == 0:
            self._add(
                rows[-1],
                f"the line is longer than {MOST_LINE} letters: this is no list"
                if len(rows) <= MOST_POINTS
                else f"the file holds more than {MOST_POINTS} {form.content}: split it",
            )
            return
        if not rows:
            self.problems.append(
                f"{self.file_name} holds no {form.content}: expected {','.join(form.required)} "
                "per line"
            )
            return
        columns = self._columns(rows[0])
        if columns is None:
            return
        body = rows[1:] if _is_header(rows[0]) else rows
        if not body:
            self._add(rows[0], f"only the names of the columns, no {form.content}")
        for row in body:
            if len(row.cells) == len(columns):
                yield row, dict(zip(columns, row.cells, strict=True))
                continue
            hint = "; write decimal points, not commas" if len(row.cells) > len(columns) else ""
            self._add(row, f"expected {len(columns)} columns, got {len(row.cells)}{hint}")

    def _columns(self, first: _Row) -> tuple[str, ...] | None:
        form = self.form
        if not _is_header(first):
            if len(first.cells) in form.bare:
                return form.known[: len(first.cells)]
            single = [
                name
                for name in form.known[len(form.required) :]
                if name not in sum(form.instead, form.together)
            ]
            optional = [f"[,{name}]" for name in single]
            optional += [f"[,{','.join(form.together)}]"] if form.together else []
            self._add(
                first,
                f"expected the names of the columns, {','.join(form.required)}"
                f"{''.join(optional)}, got {len(first.cells)} values without names",
            )
            return None
        names = tuple(cell.lower() for cell in first.cells)
        n_before = len(self.problems)
        for name in names:
            if name not in form.known:
                near = difflib.get_close_matches(name, form.known, n=1)
                hint = f" (did you mean {near[0]}?)" if near else ""
                self._add(first, f"unknown column {name}{hint}; known are {', '.join(form.known)}")
            elif names.count(name) > 1:
                self._add(first, f"the column {name} is there {names.count(name)} times")
        missing = [name for name in form.required if name not in names]
        if missing:
            self._add(first, f"the column {', '.join(missing)} is missing")
        self._check_groups(first, names)
        return names if len(self.problems) == n_before else None

    def _check_groups(self, first: _Row, names: tuple[str, ...]) -> None:
        """Say which columns lack others that belong to them."""
        together = self.form.together
        given = [name for name in together if name in names]
        groups = [([name for name in group if name in names], group) for group in self.form.instead]
        if any(there for there, _ in groups) and given == [together[0]]:
            given = []
        for there, group in (*groups, (given, together)):
            if there and len(there) < len(group):
                only = ", ".join(there)
                self._add(first, f"{', '.join(group)} belong together, got only {only}")

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


class _PointReader(_TableReader):
    form = _POINTS

    def points(self, text: str) -> tuple[SurveyPoint, ...]:
        points = []
        lines: dict[str, int] = {}
        for row, cells in self._table(text):
            point = self._point(row, cells)
            if point is None:
                continue
            if point.name in lines:
                self._add(
                    row, f"the name {point.name} is there already, in line {lines[point.name]}"
                )
            lines.setdefault(point.name, row.line)
            points.append(point)
        return tuple(points)

    def _point(self, row: _Row, cells: dict[str, str]) -> SurveyPoint | None:
        n_before = len(self.problems)
        if not cells["name"]:
            self._add(row, "the name is missing")
        x, y, z = (self._number(row, key, cells[key]) for key in "xyz")
        place = self._instead(row, cells, _IN_MAP)
        shown = self._instead(row, cells, _IN_SPACE)
        if place and shown:
            self._add(row, _TWICE.format(", ".join(_IN_MAP), ", ".join(_IN_SPACE)))
        wall, pixel = self._measured(row, cells, is_placed=bool(place or shown))
        if len(self.problems) > n_before:
            return None
        return SurveyPoint(
            name=cells["name"],
            position=(x, y, z),
            class_name=cells.get("class", ""),
            wall=wall,
            pixel_wall=pixel,
            place_m=(place[0], place[1]) if place else None,
            shown_m=(shown[0], shown[1], shown[2]) if shown else None,
        )

    def _instead(
        self, row: _Row, cells: dict[str, str], group: tuple[str, ...]
    ) -> tuple[float, ...]:
        """Numbers of one of the groups that stand for a pixel; empty where there are none."""
        given = [key for key in group if cells.get(key)]
        if not given:
            return ()
        if len(given) < len(group):
            only = ", ".join(given)
            self._add(row, f"{', '.join(group)} belong together, got only {only}")
            return ()
        if cells.get("u_px") or cells.get("v_px"):
            self._add(row, _TWICE.format("u_px, v_px", ", ".join(group)))
        return tuple(self._number(row, key, cells[key]) for key in group)

    def _measured(
        self, row: _Row, cells: dict[str, str], *, is_placed: bool
    ) -> tuple[int | None, tuple[float, float] | None]:
        given = [key for key in _MEASURED if cells.get(key)]
        if not given:
            return None, None
        if len(given) < len(_MEASURED) and not (is_placed and given == ["wall"]):
            self._add(row, f"{', '.join(_MEASURED)} belong together, got only {', '.join(given)}")
            return None, None
        wall = self._number(row, "wall", cells["wall"])
        if math.isfinite(wall) and not (wall.is_integer() and 0 <= wall <= MOST_WALLS):
            self._add(row, f"wall must be the number of a wall, from 0, got {cells['wall']}")
            return None, None
        number = int(wall) if math.isfinite(wall) else None
        if is_placed:
            return number, None
        pixel = (self._number(row, "u_px", cells["u_px"]), self._number(row, "v_px", cells["v_px"]))
        return number, pixel


class _TieReader(_TableReader):
    form = _TIES

    def ties(self, text: str) -> tuple[MeasuredTie, ...]:
        ties = (self._tie(row, cells) for row, cells in self._table(text))
        return tuple(tie for tie in ties if tie is not None)

    def _tie(self, row: _Row, cells: dict[str, str]) -> MeasuredTie | None:
        n_before = len(self.problems)
        if not cells["photo"]:
            self._add(row, "the name of the photo is missing")
        u, v, x, y, z = (self._number(row, key, cells[key]) for key in self.form.required[1:])
        sigma_px = (
            self._number(row, "sigma_px", cells["sigma_px"]) if cells.get("sigma_px") else None
        )
        if sigma_px is not None and sigma_px <= 0.0:
            self._add(row, f"sigma_px must be positive, got {cells['sigma_px']}")
        if len(self.problems) > n_before:
            return None
        return MeasuredTie(
            where=f"{self.file_name}:{row.line}",
            photo=cells["photo"],
            pixel=(u, v),
            position=(x, y, z),
            sigma_px=sigma_px,
        )


def _rows(text: str) -> Iterator[_Row]:
    lines = text.splitlines()
    first = next((line for line in lines if line.strip() and line.strip()[0] != "#"), "")
    # A comma may be part of a number; the others may not.
    separator = next((mark for mark in _SEPARATORS if mark in first), ",")
    n_rows = 0
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.strip()[0] == "#":
            continue
        n_rows += 1
        if len(line) > MOST_LINE or n_rows > MOST_POINTS:
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
