"""Tables of points, from surveyors or written by hand: a header, then one point per line."""

from __future__ import annotations

import csv
import difflib
import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Final

from orthoflow.errors import InputError
from orthoflow.files.sidecars import MOST_WALLS
from orthoflow.untrusted_text import text_of_file

_POSITION: Final = ("x", "y", "z")
_IN_IMAGE: Final = ("u_px", "v_px")
_IN_MAP: Final = ("map_x", "map_y")
_IN_SPACE: Final = ("shown_x", "shown_y", "shown_z")
_SEPARATORS: Final = (";", "\t", ",")
#: bytes of a check point file
MOST_BYTES: Final = 20_000_000
#: lines of a check point file
MOST_POINTS: Final = 100_000
#: lines of a tie file; runs with many photos write long ones
MOST_TIES: Final = 1_000_000
#: bytes of a tie file
MOST_TIE_BYTES: Final = 200_000_000
_MAX_PROBLEMS: Final = 20
#: characters of a line of a check point file
MOST_LINE: Final = 10_000
# Columns that the `ties.csv` of a run has in addition to those of measured ties.
_RESIDUALS: Final = ("residual_u_px", "residual_v_px")
_OF_WRITTEN_TIES: Final = ("wall", "role", *_RESIDUALS, "opencv_pixel_convention")


@dataclass(frozen=True, kw_only=True)
class SurveyPoint:
    """A named point.

    Attributes:
        name: name of the point, unique in its file.
        position: x, y, z as given in the file.
        class_name: class of the point; empty if the file does not give it.
        wall: wall in whose orthoimage the point was measured, or None.
        pixel_wall: measured column and row in the wall's orthoimage, or None.
        place_m: measured X and Y in the coordinates of the orthoimage's GeoTIFF, or None.
        shown_m: x, y, z in metres at which the orthoimage shows the point, or None.
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
    """A point measured in a photo, by hand or in a run.

    Attributes:
        where: file and line of the tie, for messages.
        photo: name of the photo.
        pixel: column and row as given in the file.
        position: x, y, z as given in the file.
        sigma_px: standard deviation of each pixel coordinate, or None.
        is_check: whether a run withheld the tie from the orientation.
        residual_px: residuals along u and v in a run, or None.
    """

    where: str
    photo: str
    pixel: tuple[float, float]
    position: tuple[float, float, float]
    sigma_px: float | None = None
    is_check: bool = False
    residual_px: tuple[float, float] | None = None


def read_measured_ties(path: Path) -> tuple[MeasuredTie, ...]:
    """Read a tie file: `photo,u_px,v_px,x,y,z[,sigma_px]`, in the format of `read_survey_points`.

    In a `ties.csv` written by orthoflow, rejected ties are skipped.

    Raises:
        InputError: the file is invalid; one line per problem, `file:line: ...`.
    """
    required = ("photo", *_IN_IMAGE, *_POSITION)
    table = _Table(
        path,
        content="ties",
        required=required,
        single=("sigma_px",),
        of_runs=_OF_WRITTEN_TIES,
        max_rows=MOST_TIES,
        max_bytes=MOST_TIE_BYTES,
    )
    ties = []
    for line, cells in table.rows():
        if cells.get("role") == "rejected":
            continue
        if not cells["photo"]:
            table.add(line, "the name of the photo is missing")
        u, v, x, y, z = table.numbers(line, cells, required[1:])
        sigma_px = None
        if cells.get("sigma_px"):
            (sigma_px,) = table.numbers(line, cells, ("sigma_px",))
            if sigma_px <= 0.0:
                table.add(line, f"sigma_px must be positive, got {cells['sigma_px']}")
        residual_px = None
        if all(cells.get(name) for name in _RESIDUALS):
            first, second = table.numbers(line, cells, _RESIDUALS)
            residual_px = (first, second)
        tie = MeasuredTie(
            where=f"{path.name}:{line}",
            photo=cells["photo"],
            pixel=(u, v),
            position=(x, y, z),
            sigma_px=sigma_px,
            is_check=cells.get("role") == "check",
            residual_px=residual_px,
        )
        ties.append(tie)
    table.check()
    return tuple(ties)


def read_survey_points(path: Path) -> tuple[SurveyPoint, ...]:
    """Read a file of points.

    Columns are separated by commas, semicolons or tabs and named in the first line, in any order:
    `name,x,y,z[,class][,wall,u_px,v_px]`. Instead of the last three, `map_x,map_y` or
    `shown_x,shown_y,shown_z` are possible, each with or without `wall`. A file without a header has
    four or five columns in this order. Empty lines and lines that begin with # are skipped.

    Raises:
        InputError: the file is invalid; one line per problem, `file:line: ...`.
    """
    measured = ("wall", *_IN_IMAGE, *_IN_MAP, *_IN_SPACE)
    table = _Table(
        path,
        content="points",
        required=("name", *_POSITION),
        single=("class",),
        measured=measured,
    )
    points = []
    lines: dict[str, int] = {}
    for line, cells in table.rows():
        name = cells["name"]
        if not name:
            table.add(line, "the name is missing")
        elif lines.setdefault(name, line) != line:
            table.add(line, f"the name {name} is already used in line {lines[name]}")
        x, y, z = table.numbers(line, cells, _POSITION)
        group = table.measured_by(line, {key for key in measured if cells.get(key)})
        place = tuple(table.numbers(line, cells, group))
        wall = None
        if cells.get("wall"):
            (number,) = table.numbers(line, cells, ("wall",))
            if number.is_integer() and 0 <= number <= MOST_WALLS:
                wall = int(number)
            elif math.isfinite(number):
                table.add(
                    line, f"wall must be a wall number from 0 to {MOST_WALLS}, got {cells['wall']}"
                )
        point = SurveyPoint(
            name=name,
            position=(x, y, z),
            class_name=cells.get("class", ""),
            wall=wall,
            pixel_wall=(place[0], place[1]) if group == _IN_IMAGE else None,
            place_m=(place[0], place[1]) if group == _IN_MAP else None,
            shown_m=(place[0], place[1], place[2]) if group == _IN_SPACE else None,
        )
        points.append(point)
    table.check()
    return tuple(points)


@dataclass(kw_only=True)
class _Table:
    """The rows of a file, and the problems found in it.

    Attributes:
        path: the file.
        content: content of the rows, for messages.
        required: columns that must be present.
        single: optional columns, which are also possible without a header.
        measured: further optional columns, some of which belong together.
        of_runs: further columns of files written by orthoflow.
        max_rows: maximum number of rows; `MOST_POINTS` if None.
        max_bytes: maximum size of the file; `MOST_BYTES` if None.
    """

    path: Path = field(kw_only=False)
    content: str
    required: tuple[str, ...]
    single: tuple[str, ...]
    measured: tuple[str, ...] = ()
    of_runs: tuple[str, ...] = ()
    max_rows: int | None = None
    max_bytes: int | None = None
    problems: list[str] = field(default_factory=list)

    def add(self, line: int, message: str) -> None:
        self.problems.append(f"{self.path.name}:{line}: {message}")

    def check(self) -> None:
        left_out = len(self.problems) - _MAX_PROBLEMS
        more = [f"... and {left_out} more"] if left_out > 0 else []
        if self.problems:
            raise InputError("\n".join(self.problems[:_MAX_PROBLEMS] + more))

    def rows(self) -> Iterator[tuple[int, dict[str, str]]]:
        """Yield the line number and the cells of each row that has a cell for every column."""
        names = ",".join(self.required)
        text = text_of_file(
            self.path,
            self.max_bytes or MOST_BYTES,
            f"a CSV file of {self.content} with the columns {names}",
        )
        rows = self._cells(text.splitlines())
        line, first = next(rows, (0, []))
        if not first:
            if not self.problems:
                self.problems.append(
                    f"{self.path.name} contains no {self.content}: expected {names} per line"
                )
            return
        # In a header, even the columns for numbers contain no numbers.
        is_header = not any(_as_number(cell) is not None for cell in first[1:4])
        columns = self._columns(line, [cell.lower() for cell in first], is_header=is_header)
        if not columns:
            return
        n_rows = 0
        body = rows if is_header else chain([(line, first)], rows)
        for number, cells in body:
            n_rows += 1
            if len(cells) == len(columns):
                yield number, dict(zip(columns, cells, strict=True))
                continue
            hint = "; write decimal points, not commas" if len(cells) > len(columns) else ""
            self.add(number, f"expected {len(columns)} columns, got {len(cells)}{hint}")
        if not n_rows and not self.problems:
            self.add(line, f"there is only a header, but no {self.content}")

    def numbers(self, line: int, cells: Mapping[str, str], keys: Collection[str]) -> list[float]:
        """Return the numbers in some columns; NaN for cells that are not finite numbers."""
        found = []
        for key in keys:
            cell = cells[key]
            number = _as_number(cell)
            if number is None or not math.isfinite(number):
                is_decimal = "," in cell and _as_number(cell.replace(",", ".")) is not None
                hint = "; write a decimal point" if is_decimal else ""
                self.add(line, f"{key} must be a number, got {cell or 'nothing'}{hint}")
                number = math.nan
            found.append(number)
        return found

    def measured_by(
        self, line: int, given: Collection[str], *, is_row: bool = True
    ) -> tuple[str, ...]:
        """Return the columns with the measured position; empty if some are missing."""
        groups = [
            group
            for group in (_IN_IMAGE, _IN_MAP, _IN_SPACE)
            if any(name in given for name in group)
        ]
        if "wall" in given and not groups:
            groups = [_IN_IMAGE]
        n_before = len(self.problems)
        for group in groups:
            whole = ("wall", *group) if group == _IN_IMAGE else group
            there = [name for name in whole if name in given]
            if len(there) < len(whole):
                self.add(line, f"{', '.join(whole)} belong together, got only {', '.join(there)}")
        if is_row and len(groups) > 1:
            one, other = (", ".join(group) for group in groups[:2])
            self.add(line, f"the point is given twice, as {one} and as {other}: remove one")
        return groups[0] if groups and len(self.problems) == n_before else ()

    def _cells(self, lines: list[str]) -> Iterator[tuple[int, list[str]]]:
        numbered = [
            (number, line)
            for number, line in enumerate(lines, start=1)
            if line.strip() and line.strip()[0] != "#"
        ]
        # The comma is tried last, because it may also be a decimal separator.
        first = numbered[0][1] if numbered else ""
        max_rows = self.max_rows or MOST_POINTS
        separator = next((mark for mark in _SEPARATORS if mark in first), ",")
        for place, (number, line) in enumerate(numbered):
            if len(line) > MOST_LINE:
                problem = f"the line has more than {MOST_LINE} characters: expected {self.content}"
            elif place >= max_rows:
                problem = f"the file contains more than {max_rows} {self.content}; split it"
            else:
                cells = next(csv.reader([line], delimiter=separator))
                yield number, [cell.strip() for cell in cells]
                continue
            self.problems = []
            self.add(number, problem)
            return

    def _columns(self, line: int, names: list[str], *, is_header: bool) -> tuple[str, ...]:
        known = (*self.required, *self.single, *self.measured)
        if not is_header:
            if len(self.required) <= len(names) <= len(self.required) + len(self.single):
                return known[: len(names)]
            optional = f"[,{','.join(self.single)}]"
            optional += f"[,wall,{','.join(_IN_IMAGE)}]" if self.measured else ""
            self.add(
                line,
                f"expected the column names {','.join(self.required)}{optional}, got {len(names)} "
                "values without names",
            )
            return ()
        n_before = len(self.problems)
        unknown = []
        for name in names:
            if name not in (*known, *self.of_runs):
                near = difflib.get_close_matches(name, known, n=1)
                unknown.append(f"{name} (did you mean {near[0]}?)" if near else name)
            elif names.count(name) > 1:
                self.add(line, f"the column {name} occurs {names.count(name)} times")
        if unknown:
            what = "column" if len(unknown) == 1 else "columns"
            found, expected = ", ".join(unknown), ", ".join(known)
            self.add(line, f"unknown {what} {found}; known columns: {expected}")
        missing = [name for name in self.required if name not in names]
        if missing:
            what = "column" if len(missing) == 1 else "columns"
            self.add(line, f"missing {what}: {', '.join(missing)}")
        if self.measured:
            self.measured_by(line, names, is_row=False)
        return tuple(names) if len(self.problems) == n_before else ()


def _as_number(cell: str) -> float | None:
    try:
        # Python accepts digits grouped by underscores, which are not numbers here.
        return None if "_" in cell else float(cell)
    except ValueError:
        return None
