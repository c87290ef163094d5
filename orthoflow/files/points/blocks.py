"""The result of every reader of point files: a description of the file, then blocks of points."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points.units import StatedUnit

# 12 MB of float64 coordinates: large enough for memory speed, small enough to hold several copies.
BLOCK_POINTS: Final = 500_000
# Half of the programs that read our products count positions in 32 bits.
#: points of a scan file (one less is read)
MOST_POINTS: Final = 2**32
# The densest encodings take a byte for eight points; a small file that states more is refused
# before memory is allocated for them.
#: points that a file states, per byte that it has
MOST_POINTS_PER_BYTE: Final = 8
# Lines of text scans and headers are much shorter.
#: bytes of a line of a text scan
MOST_LINE_BYTES: Final = 10_000
# Fields of a point, known or not.
#: fields of a point in PLY and PCD files
MOST_FIELDS: Final = 1000

PointField = Literal["intensity", "rgb", "grid"]


@dataclass(kw_only=True)
class Scan:
    """One scan of a file, with its own metadata.

    Attributes:
        name: as the file calls it, or empty.
        fields: what each of its points has besides coordinates.
        fields_used: names of the file's fields that are read.
        fields_not_used: names of those that are not.
        intensity_limits: smallest and largest intensity stated in the file, or None.
        rgb_limit: stated value of full brightness, or None.
        unit: unit of its coordinates, if the file states one.
        station: (3,) position of the scanner, in the file's unit, or None.
        station_is_posed: the file states a pose other than the identity.
    """

    name: str = ""
    fields: frozenset[PointField] = frozenset()
    fields_used: tuple[str, ...] = ()
    fields_not_used: tuple[str, ...] = ()
    intensity_limits: tuple[float, float] | None = None
    rgb_limit: float | None = None
    unit: StatedUnit | None = None
    station: NDArray[np.float64] | None = None
    station_is_posed: bool = True


@dataclass(frozen=True, kw_only=True)
class PointBlock:
    """Some points of one scan, as in the file, with poses applied.

    Attributes:
        points: (n, 3) float64 in the file's unit; may contain NaN and infinities.
        scan: position of the scan in its file.
        n_read: points of the file that this block accounts for, including those left out.
        left_out: number of points left out, by cause: `invalid`, `no_return`, `withheld`,
            `synthetic`, `other_class`, `damaged`.
        intensity: (n,) float32 in the file's own scale, NaN if invalid; None without.
        rgb: (n, 3) in the file's own scale and type, or None.
        has_rgb: (n,) which points have a valid colour; None if all have.
        row: (n,) int64 position in the scan's grid, or None; column likewise.
        bounds: (2, 3) smallest and largest coordinates, if the reader knows them and all are
            finite; else None.
    """

    points: NDArray[np.float64]
    n_read: int
    scan: int = 0
    left_out: dict[str, int] = field(default_factory=dict)
    intensity: NDArray[np.float32] | None = None
    rgb: NDArray[np.generic] | None = None
    has_rgb: NDArray[np.bool_] | None = None
    row: NDArray[np.int64] | None = None
    column: NDArray[np.int64] | None = None
    bounds: NDArray[np.float64] | None = None


@dataclass(frozen=True, kw_only=True)
class ScanFile:
    """One point file, opened up to its header.

    Attributes:
        name: file name without folder, for messages and the record.
        format_name: e.g. `E57`.
        n_most: maximum number of points.
        scans: its scans, in the order of their blocks.
        read: yields the points; can be called once.
        notes: notes of the reader, as sentences for the user; complete after reading.
        is_chosen: only the requested parts of the file are read.
    """

    name: str
    format_name: str
    n_most: int
    scans: list[Scan]
    read: Callable[[], Iterator[PointBlock]]
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

    @property
    def fields(self) -> frozenset[PointField]:
        """What the points of at least one scan have besides coordinates."""
        return frozenset().union(*(scan.fields for scan in self.scans))


def short_file_error(path: Path, what: str, found: str, expected: str) -> InputError:
    """Return the error for a file that ends before its header says it does."""
    return InputError(
        f"{path.name} is cut off: its {what} holds {found}, its header states {expected}; copy or "
        "export it again"
    )
