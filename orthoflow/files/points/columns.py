"""Which column of a text scan is what: said by the user, by the header, or by their number."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points.blocks import PointBlock

IGNORED: Final = "_"
NAMES: Final = ("x", "y", "z", "r", "g", "b", "intensity", "row", "column")
_COLOURS: Final = ("r", "g", "b")
_COLOURS_FIRST: Final = ("x", "y", "z", *_COLOURS, "intensity")
_COLOURS_LAST: Final = ("x", "y", "z", "intensity", *_COLOURS)
_ALIASES: Final = {
    "x": "x easting east e xcoord xcoordinate cartesianx",
    "y": "y northing north n ycoord ycoordinate cartesiany",
    "z": "z height elevation alt altitude h zcoord zcoordinate cartesianz",
    "r": "r red rf colorred diffusered",
    "g": "g green gf colorgreen diffusegreen",
    "b": "b blue bf colorblue diffuseblue",
    "intensity": "intensity i int scalarintensity scalarfield reflectance reflectivity amplitude "
    "scalarreflectance scalaramplitude scalarscalarfield",
    "row": "row rowindex",
    "column": "column columnindex col",
}
_MEANINGS: Final = {alias: name for name, text in _ALIASES.items() for alias in text.split()}
# Looking for brackets takes time with the square of it.
_LONGEST_NAME: Final = 200


@dataclass(frozen=True, kw_only=True)
class Columns:
    """Positions of the columns of a text scan.

    Attributes:
        names: meaning of each column, `_` for one that is not used.
        rule: how they were found: `parameter`, `header`, `count`.
    """

    names: tuple[str, ...]
    rule: str

    @property
    def used(self) -> tuple[str, ...]:
        """Names of the columns that are read, coordinates first."""
        present = [name for name in NAMES if name in self.names]
        has_rgb = set(_COLOURS) <= set(present)
        has_grid = {"row", "column"} <= set(present)
        return tuple(
            name
            for name in present
            if (name not in _COLOURS or has_rgb) and (name not in {"row", "column"} or has_grid)
        )

    @property
    def positions(self) -> tuple[int, ...]:
        """Position of each of `used`."""
        return tuple(self.names.index(name) for name in self.used)

    def index_of(self, names: Sequence[str]) -> list[int]:
        """Where these columns are among `used`; empty unless all are."""
        used = self.used
        return [used.index(name) for name in names] if set(used).issuperset(names) else []


def meaning_of(name: str) -> str:
    """Meaning of a column's or property's name in a file, `_` when it has none for us."""
    if len(name) > _LONGEST_NAME:
        return IGNORED
    plain = re.sub(r"[\[(].*?[\])]", "", name.lower())
    return _MEANINGS.get(re.sub(r"[^a-z]", "", plain), IGNORED)


def columns_of_text(text: str) -> Columns:
    """Columns that the user names, e.g. `x y z r g b intensity`; `_` skips one.

    Raises:
        InputError: a name is unknown or given twice, or x, y, z are not all there.
    """
    names = tuple(text.replace(",", " ").split())
    unknown = [name for name in names if name not in NAMES and name != IGNORED]
    named = [name for name in names if name != IGNORED]
    if unknown or len(set(named)) != len(named) or not {"x", "y", "z"} <= set(named):
        raise InputError(
            f"columns must name x, y and z once each, and may name {', '.join(NAMES[3:])} or skip "
            f"one with {IGNORED}, got {text!r}"
        )
    return Columns(names=names, rule="parameter")


def columns_of_header(fields: Sequence[str]) -> Columns | None:
    """Columns as a header line names them, or None when it names no x, y and z."""
    names = [meaning_of(field) for field in fields]
    # A name met twice (`I` and `Intensity`) stands for its first column.
    names = [IGNORED if name in names[:index] else name for index, name in enumerate(names)]
    return Columns(names=tuple(names), rule="header") if {"x", "y", "z"} <= set(names) else None


def columns_of_count(
    file_name: str, samples: Sequence[Sequence[float]], *, is_pts: bool
) -> Columns:
    """Columns by their number, where that leaves no doubt.

    Args:
        file_name: for messages.
        samples: the first lines' numbers.
        is_pts: the file is a PTS file, which puts the intensity before the colours.

    Raises:
        InputError: the number of columns can mean several things.
    """
    known = {3: "x y z", 4: "x y z intensity", 6: "x y z r g b"}
    count = len(samples[0])
    if count in known:
        return Columns(names=tuple(known[count].split()), rule="count")
    if count == 7:
        colours_first = _are_colours(samples, 3)
        colours_last = _are_colours(samples, 4)
        if colours_first and not colours_last:
            return Columns(names=_COLOURS_FIRST, rule="count")
        if colours_last and (is_pts or not colours_first):
            return Columns(names=_COLOURS_LAST, rule="count")
    raise InputError(
        f"{file_name} has {count} columns and no header that names them: say what they are with "
        "the parameter columns, e.g. columns: 'x y z r g b intensity', with _ for one to skip"
    )


def point_block(table: NDArray[np.float64], columns: Columns) -> PointBlock:
    """Sort the columns of a table, which are `columns.used`, into a block of points."""
    intensity = columns.index_of(["intensity"])
    colours = columns.index_of(["r", "g", "b"])
    grid = columns.index_of(["row", "column"])
    rows = np.nan_to_num(table[:, grid]).astype(np.int64) if grid else None
    return PointBlock(
        points=table[:, :3],
        scan=0,
        n_read=len(table),
        intensity=table[:, intensity[0]].astype(np.float32) if intensity else None,
        rgb=table[:, colours] if colours else None,
        row=None if rows is None else rows[:, 0],
        column=None if rows is None else rows[:, 1],
    )


def _are_colours(samples: Sequence[Sequence[float]], first: int) -> bool:
    """Whether three columns hold whole numbers 0..255."""
    values = [value for line in samples for value in line[first : first + 3]]
    return all(0 <= value <= 255 and value == int(value) for value in values)
