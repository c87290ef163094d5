"""Common result of all readers for point files: scans with metadata, then blocks of points.

A reader opens a file, reads its header, describes its scans and yields blocks of points.
`point_block` builds a block from the columns of any format, so that points without a return,
flagged points and poses are handled in the same way for all formats.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError, OrthoflowError, PluginError
from orthoflow.files.points.units import StatedUnit

# A block has 12 MB of float64 coordinates: fast to process, and small enough for several copies.
BLOCK_POINTS: Final = 500_000
# Many programs that read our products use 32-bit point indices.
#: points of a scan file (at most one less can be read)
MOST_POINTS: Final = 2**32

PointField = Literal["intensity", "rgb", "grid"]
# Any: the arrays may have any type.
Values = dict[str, NDArray[Any]]


@dataclass(kw_only=True)
class Scan:
    """One scan of a file and its metadata.

    Attributes:
        name: name of the scan in the file, or empty.
        fields: attributes of the points besides coordinates.
        fields_used: names of the file's fields that are read.
        fields_not_used: names of the file's other fields.
        intensity_limits: smallest and largest intensity according to the file, or None.
        rgb_limit: colour value for full brightness according to the file, or None.
        unit: unit of the coordinates, or None if the file does not declare one.
        station: (3,) position of the scanner, in the file's unit, or None.
        station_is_posed: whether the file contains a pose other than the identity.
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
    """A block of points of one scan, with poses applied and values as in the file.

    Attributes:
        points: (n, 3) float64 in the file's unit; may contain NaN and infinities.
        scan: index of the scan in its file.
        n_read: number of points read from the file for this block, including omitted ones.
        left_out: number of omitted points by cause: `invalid`, `no_return`, `withheld`, `synthetic`
            or `other_class`.
        intensity: (n,) float32 on the file's own scale, NaN if invalid; None if not available.
        rgb: (n, 3) on the file's own scale and of its type; None if not available.
        has_rgb: (n,) True for points with a valid colour; None if all colours are valid.
        row: (n,) int64 row of each point in the scan's grid, or None.
        column: (n,) int64 column of each point in the scan's grid, or None.
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

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest coordinates (2, 3); NaN if any is NaN, infinite without points."""
        if not len(self.points):
            return np.array([[np.inf] * 3, [-np.inf] * 3])
        return np.stack([self.points.min(axis=0), self.points.max(axis=0)])


@dataclass(frozen=True, kw_only=True)
class ScanFile:
    """A point file whose header has been read.

    Attributes:
        name: file name without folder, for messages and the record.
        format_name: name of the format, e.g. `E57`.
        n_most: maximum number of points.
        scans: the scans, in the order of their blocks.
        read: function that yields the points; it can be called only once.
        notes: the reader's remarks, as sentences for the user; complete once all points are read.
        is_chosen: whether only the requested parts of the file are read.
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
                f"{self.name} contains no points: expected a scan; export it again from the "
                "program that wrote it"
            )
        if self.n_most >= MOST_POINTS:
            raise InputError(
                f"{self.name} declares {self.n_most} points; the limit is {MOST_POINTS - 1}: "
                "thin or split it, or export it again if the number is wrong"
            )

    @property
    def fields(self) -> frozenset[PointField]:
        """Attributes, besides coordinates, of the points of at least one scan."""
        return frozenset().union(*(scan.fields for scan in self.scans))


@dataclass(frozen=True, kw_only=True)
class PointQuery:
    """The points requested from a file; a reader may return more.

    Attributes:
        box: (2, 3) lowest and highest coordinates in the file's unit; None for no limits.
        spacing: sufficient point spacing, in the file's unit; None for all points.
    """

    box: NDArray[np.float64] | None = None
    spacing: float | None = None

    def __bool__(self) -> bool:
        return self.box is not None or self.spacing is not None


def point_block(
    axes: NDArray[np.float64],
    values: Mapping[str, NDArray[Any]],
    *,
    causes: Mapping[str, NDArray[np.bool_]] | None = None,
    scan: int = 0,
    pose: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
) -> PointBlock:
    """Build a block of points from the values of a file.

    Args:
        axes: (3, n) x, y, z; if all three are exactly zero, the point has no return.
        values: (n,) by name: `intensity`, `r`, `g`, `b` or packed `rgb`, `has_rgb`, `row`,
            `column`; in the file's own types.
        causes: (n,) True for points to omit, by cause; a point is counted under its first cause.
        scan: index of the scan.
        pose: (3, 3) rotation and (3,) translation to the file's world; None for the identity.
    """
    n_read = axes.shape[1]
    is_void = axes[0] == 0.0
    if is_void.any():
        is_void &= (axes[1] == 0.0) & (axes[2] == 0.0)
    left_out: dict[str, int] = {}
    kept = np.ones(n_read, dtype=np.bool_)
    for cause, is_out in {**(causes or {}), "no_return": is_void}.items():
        if n_out := int(np.count_nonzero(kept & is_out)):
            left_out[cause] = n_out
            kept &= ~is_out
    if left_out:
        axes = axes[:, kept]
        values = {name: array[kept] for name, array in values.items()}
    if pose is not None:
        axes = pose[0] @ axes + pose[1][:, None]
    rgb: NDArray[Any] | None = None
    if "r" in values:
        rgb = np.stack([values[name] for name in "rgb"]).T
    elif "rgb" in values:
        rgb = _unpacked(values["rgb"])

    def cast(name: str, dtype: Any) -> Any:
        array = values.get(name)
        if array is not None and dtype is np.int64 and array.dtype.kind == "f":
            array = np.nan_to_num(array, posinf=0.0, neginf=0.0)
        return None if array is None else array.astype(dtype)

    return PointBlock(
        points=axes.T,
        scan=scan,
        n_read=n_read,
        left_out=left_out,
        intensity=cast("intensity", np.float32),
        rgb=rgb,
        has_rgb=cast("has_rgb", np.bool_),
        row=cast("row", np.int64),
        column=cast("column", np.int64),
    )


def axes_of(values: Mapping[str, NDArray[Any]]) -> NDArray[np.float64]:
    """Return (3, n) coordinates; each axis is contiguous, since later code processes whole axes."""
    return np.stack([values[axis].astype(np.float64, copy=False) for axis in "xyz"])


def _unpacked(packed: NDArray[Any]) -> NDArray[np.uint8]:
    """Return colours (n, 3) from 0x00RRGGBB, stored as an integer or in the bits of a float."""
    if packed.dtype.kind == "f":
        bits = np.ascontiguousarray(packed.astype(np.float32)).view(np.uint32)
    else:
        bits = packed.astype(np.int64).astype(np.uint32)
    return np.column_stack([(bits >> shift) & 255 for shift in (16, 8, 0)]).astype(np.uint8)


def cut_off(path: Path, what: str, found: str, expected: str) -> InputError:
    """Return the error for a file that is shorter than its header declares."""
    return InputError(
        f"{path.name} is truncated: its {what} contains {found}, but its header declares "
        f"{expected}; copy or export it again"
    )


@contextmanager
def reading(path: Path, format_name: str) -> Iterator[None]:
    """Convert errors of a library that reads a file to an `InputError` with a one-line message.

    Raises:
        InputError: the library failed.
    """
    try:
        yield
    except (OrthoflowError, KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except BaseException as error:
        # BaseException is caught because a panic in a Rust library is not an Exception.
        raise InputError(
            f"{path.name} cannot be read as {format_name}: {_first_line(error)}; the file is "
            "damaged or truncated; copy or export it again"
        ) from error


# Any: the libraries have no types.
def load_library(name: str, path: Path) -> Any:
    """Import a library for reading, only when a file needs it.

    Raises:
        PluginError: the library is not installed, or its import fails.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise PluginError(
            f"{path.name} needs the library {name}, which cannot be imported "
            f"({_first_line(error)}): install it with `python -m pip install {name}`"
        ) from error


def _first_line(error: BaseException) -> str:
    text = str(error).strip() or type(error).__name__
    return " ".join(text.splitlines()[0].split())[:200].rstrip(".:;, ")
