"""What every reader of point files gives: a description of the file, then blocks of points."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError

# 12 MB of float64 coordinates: large enough for memory speed, small enough to hold several copies.
BLOCK_POINTS: Final = 500_000
# Positions are counted in 32 bits by half the programs that will read our products.
MOST_POINTS: Final = 2**32
# What packs points best takes a byte for each and more; a small file that states many is refused
# before there is room made for them.
MOST_POINTS_PER_BYTE: Final = 8
# Honest lines of text scans and headers are much shorter.
MOST_LINE_BYTES: Final = 10_000
# Fields of a point, known or not.
MOST_FIELDS: Final = 1000

PointField = Literal["intensity", "rgb", "grid"]


@dataclass(frozen=True, kw_only=True)
class PointBlock:
    """Some points of one scan, as the file has them, poses applied.

    Attributes:
        points: (n, 3) float64 in the file's unit; may hold NaN and infinities.
        scan: position of the scan in its file.
        n_read: points of the file that this block accounts for, those left out included.
        n_invalid: points left out because the file calls them invalid (no return, 0 0 0).
        n_withheld: points left out because the file calls them deleted.
        n_unwanted: points left out because nobody asked for their class.
        intensity: (n,) float32 in the file's own scale, or None.
        rgb: (n, 3) in the file's own scale and type, or None.
        row: (n,) int64 position in the scan's grid, or None; column alike.
        station: (3,) float64 where the scanner stood, in the file's unit, or None.
        station_is_posed: the file states a pose other than the identity.
        bounds: (2, 3) smallest and largest coordinates, where the reader has them already and all
            are finite; None where it has not.
    """

    points: NDArray[np.float64]
    scan: int
    n_read: int
    n_invalid: int = 0
    n_withheld: int = 0
    n_unwanted: int = 0
    intensity: NDArray[np.float32] | None = None
    rgb: NDArray[np.generic] | None = None
    row: NDArray[np.int64] | None = None
    column: NDArray[np.int64] | None = None
    station: NDArray[np.float64] | None = None
    station_is_posed: bool = True
    bounds: NDArray[np.float64] | None = None


@dataclass(frozen=True, kw_only=True)
class ScanFile:
    """One point file, opened as far as its header.

    Attributes:
        name: file name without folder, for messages and the record.
        format_name: e.g. `E57`.
        n_most: at most so many points will come.
        fields: what each of its points has besides coordinates.
        read: gives the points; may be called once.
        intensity_limits: smallest and largest intensity the file or its format states, or None.
        rgb_limit: the value of full brightness the file states, or None when it must be found out.
        details: what else the header says and is worth keeping.
        notes: what the reader noticed while reading, in sentences for the user.
        is_chosen: only the parts of the file come that were asked for.
    """

    name: str
    format_name: str
    n_most: int
    fields: frozenset[PointField]
    read: Callable[[], Iterator[PointBlock]]
    intensity_limits: tuple[float, float] | None = None
    rgb_limit: float | None = None
    details: dict[str, str | int | float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    is_chosen: bool = False

    def __post_init__(self) -> None:
        if self.n_most <= 0:
            raise InputError(
                f"{self.name} holds no points: expected a scan; export it again from the program "
                "that wrote it"
            )
        if self.n_most >= MOST_POINTS:
            raise InputError(
                f"{self.name} states {self.n_most} points, at most {MOST_POINTS - 1} can be read: "
                "thin it or split it, or export it again if that number is wrong"
            )


def point_fields(
    *, has_intensity: bool, has_rgb: bool, has_grid: bool = False
) -> frozenset[PointField]:
    """Collect the names of the fields that a file has."""
    found: set[PointField] = set()
    if has_intensity:
        found.add("intensity")
    if has_rgb:
        found.add("rgb")
    if has_grid:
        found.add("grid")
    return frozenset(found)


def short_file_error(path: Path, what: str, found: str, expected: str) -> InputError:
    """Build the error for a file that ends before its header says it does."""
    return InputError(
        f"{path.name} is cut off: its {what} holds {found}, its header states {expected}; copy or "
        "export it again"
    )
