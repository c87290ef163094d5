"""A cloud in the making: blocks of several files into its arrays, held once; how fine they are."""

from __future__ import annotations

import contextlib
import mmap
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError, StoreError
from orthoflow.files.points import PointBlock, ScanFile
from orthoflow.geometry.frames import FARTHEST_M
from orthoflow.sdk import StepContext
from orthoflow_plugins.read.scales import ColourScale
from orthoflow_plugins.read.stations import ScanSummary

# Coordinates rounded more coarsely than this limit what an orthoimage can show.
COARSE_M: Final = 0.005
# Offsets keep half a tenth of a millimetre; beyond, the user is told.
FINE_M: Final = 5e-5
_POINT_BYTES: Final = 40
_MOST_SCANS: Final = 2**16
# MADV_POPULATE_WRITE of Linux 5.14, which Python does not name.
_POPULATE_WRITE: Final = 23
_ROUNDING_SAMPLE: Final = 20_000
_ROUNDING_VALUES: Final = 10
# Decimal rounding, and the powers of two that float32 leaves of large coordinates.
_ROUNDING_STEPS: Final = sorted(
    {digit * 10.0**power for digit in (1, 2, 5) for power in range(-4, 3)}
    | {2.0**power for power in range(-10, 4)},
    reverse=True,
)


@dataclass(kw_only=True)
class FileCount:
    """What became of the points of one file.

    Attributes:
        name: of the file.
        format_name: of the file.
        n_read: points that the file holds.
        n_kept: those of them that are in the cloud.
        n_invalid: those marked as invalid.
        n_withheld: those marked as deleted.
        n_unwanted: those of a class that nobody asked for.
        n_outside: those outside the box that was asked for.
        n_not_finite: those whose coordinates are not finite, or beyond any survey frame.
        rounding_m: step to which coordinates are rounded, 0 where it is fine.
        rgb_scale: what the file's colours range to, or None without colours.
        n_far: those of `n_not_finite` that are finite.
        first_far_m: the first of them.
        header: what else the file says of itself, for people.
    """

    name: str
    format_name: str
    n_read: int = 0
    n_kept: int = 0
    n_invalid: int = 0
    n_withheld: int = 0
    n_unwanted: int = 0
    n_outside: int = 0
    n_not_finite: int = 0
    rounding_m: float = 0.0
    rgb_scale: str | None = None
    n_far: int = 0
    first_far_m: tuple[float, ...] = ()
    header: Mapping[str, str | int | float] = field(default_factory=dict)

    def note_far(self, lost: NDArray[np.float64]) -> None:
        """Count points (n, 3), metres, that were left out though their coordinates are finite."""
        far = lost[np.isfinite(lost).all(axis=1)]
        if len(far) and not self.n_far:
            self.first_far_m = tuple(far[0].tolist())
        self.n_far += len(far)


class CloudAssembly:
    """Arrays of a growing cloud.

    Attributes:
        origin: (3,) whole metres near the data; set by the first points.
        n_points: points so far.
        files: counts per file.
        intensity_range: smallest and largest finite intensity.
        n_intensity_lost: intensities that are not finite.
    """

    origin: NDArray[np.float64]

    def __init__(
        self,
        ctx: StepContext,
        files: list[ScanFile],
        unit_m: float,
        box_m: NDArray[np.float64] | None = None,
    ) -> None:
        """Allocate for the most points that may come; what is not filled is cut off later.

        Args:
            ctx: of the step.
            files: what will be read.
            unit_m: metres per unit of the files.
            box_m: (2, 3) lowest and highest coordinates of the points to keep; None for all.
        """
        self._ctx = ctx
        self._box_m = box_m
        self._reach_m = _bounds(np.empty((0, 3)))
        self._unit_m = unit_m
        self._capacity = sum(file.n_most for file in files)
        _require_space(ctx, self._capacity)
        self.fields = frozenset.intersection(*(file.fields for file in files))
        self._axes = [self._new(name, np.float32) for name in "xyz"]
        self._intensity = self._new("intensity", np.float32) if "intensity" in self.fields else None
        self._rgb = self._new("rgb", np.uint8, 3) if "rgb" in self.fields else None
        grid = "grid" in self.fields
        self._grid = [self._new(name, np.uint32) for name in ("row", "column")] if grid else []
        self._scan: NDArray[Any] | None = None
        self._scans: list[ScanSummary] = []
        self.n_points = 0
        self.files: list[FileCount] = []
        self.intensity_range = (np.inf, -np.inf)
        self.n_intensity_lost = 0

    def add_file(self, file: ScanFile) -> None:
        """Read all blocks of a file.

        Raises:
            InputError: the file is damaged, or none of its points can be used.
        """
        count = FileCount(name=file.name, format_name=file.format_name, header=file.details)
        self.files.append(count)
        first_scan = len(self._scans)
        colours = (
            None if self._rgb is None else ColourScale(self._rgb[self.n_points :], file.rgb_limit)
        )
        for block in file.read():
            if count.n_read == 0:
                count.rounding_m = rounding_m(block.points, self._unit_m)
            self._add(block, first_scan + block.scan, count, colours)
            done = sum(item.n_read for item in self.files) / self._capacity
            self._ctx.progress(min(done, 1.0), f"{file.name}: {count.n_read} points")
        if colours is not None:
            count.rgb_scale = colours.scale
        if count.n_far:
            place = " ".join(f"{value:g}" for value in count.first_far_m)
            self._ctx.warn(
                f"{count.name}: {count.n_far} points lie farther than {FARTHEST_M:g} m from the "
                f"origin, the first at {place}, and were left out: check the file and unit"
            )
        if count.n_kept + count.n_unwanted + count.n_outside == 0:
            raise InputError(
                f"{file.name} holds no usable points: of {count.n_read}, {count.n_invalid} are "
                f"marked as invalid, {count.n_withheld} as deleted and {count.n_not_finite} are "
                "not finite; export it again"
            )

    def require_points(self) -> None:
        """Refuse a choice of points that leaves none of any file.

        Raises:
            InputError: all points are of other classes or outside the box.
        """
        if self.n_points:
            return
        n_unwanted, n_outside = (
            sum(getattr(count, name) for count in self.files)
            for name in ("n_unwanted", "n_outside")
        )
        text = f"no point is left: {n_unwanted} are of other classes than those asked for"
        if n_outside:
            low, high = (", ".join(f"{value:.2f}" for value in corner) for corner in self._reach_m)
            text += f", {n_outside} lie outside the box: the points reach from ({low}) to ({high})"
        raise InputError(f"{text}; change classes or box (read.scan)")

    @property
    def offsets(self) -> list[NDArray[Any]]:
        """x, y and z from the origin, cut to the points that came."""
        return [array[: self.n_points] for array in self._axes]

    def array(self, name: str) -> NDArray[Any] | None:
        """One of the other arrays, cut to the points that came; None when the files lack it."""
        found: dict[str, NDArray[Any] | None] = {
            "intensity": self._intensity,
            "rgb": self._rgb,
            "scan": self._scan,
            **dict(zip(("row", "column"), self._grid, strict=False)),
        }
        array = found.get(name)
        return None if array is None else array[: self.n_points]

    @property
    def scans(self) -> list[ScanSummary]:
        """The scans so far, in the order of the files."""
        return self._scans

    def _add(
        self, block: PointBlock, scan: int, count: FileCount, colours: ColourScale | None
    ) -> None:
        count.n_read += block.n_read
        count.n_invalid += block.n_invalid
        count.n_withheld += block.n_withheld
        count.n_unwanted += block.n_unwanted
        points, bounds = block.points, block.bounds
        if self._unit_m != 1.0:
            points = points * self._unit_m
            bounds = None if bounds is None else bounds * self._unit_m
        if bounds is None:
            bounds = _bounds(points)
        kept = self._kept(points, bounds, count)
        usable = points[kept]
        if not isinstance(kept, slice):
            bounds = _bounds(usable)
        n_kept = len(usable)
        self._summarise(block, scan, bounds)
        if n_kept == 0:
            return
        if self.n_points + n_kept > self._capacity:
            raise InputError(f"{count.name} holds more points than its header states")
        part = slice(self.n_points, self.n_points + n_kept)
        for array in (*self._axes, *self._grid, self._intensity, self._rgb):
            if array is not None:
                _make_ready(array, part)
        self._store_points(usable, part)
        self._store_fields(block, kept, part)
        if colours is not None and block.rgb is not None:
            colours.add(block.rgb[kept])
        if scan > 0:
            self._store_scan(scan, part)
        self.n_points = part.stop

    def _kept(
        self, points: NDArray[np.float64], bounds: NDArray[np.float64], count: FileCount
    ) -> NDArray[np.bool_] | slice:
        """Which points (n, 3) are usable and lie in the box, counted."""
        usable = _usable(points, bounds)
        if not isinstance(usable, slice):
            count.note_far(points[~usable])
        n_usable = len(points[usable])
        count.n_not_finite += len(points) - n_usable
        kept = self._in_box(points, usable)
        n_kept = len(points[kept])
        count.n_outside += n_usable - n_kept
        count.n_kept += n_kept
        return kept

    def _in_box(
        self, points: NDArray[np.float64], usable: NDArray[np.bool_] | slice
    ) -> NDArray[np.bool_] | slice:
        """Which usable points (n, 3) lie in the box, its faces included."""
        if self._box_m is None:
            return usable
        low, high = _bounds(points[usable])
        self._reach_m = np.stack(
            [np.minimum(self._reach_m[0], low), np.maximum(self._reach_m[1], high)]
        )
        inside = np.zeros(len(points), dtype=np.bool_)
        inside[usable] = True
        inside &= ((points >= self._box_m[0]) & (points <= self._box_m[1])).all(axis=1)
        return inside

    def _store_points(self, points: NDArray[np.float64], part: slice) -> None:
        if self.n_points == 0:
            # The median, so that stray points far away cannot cost the scan its precision.
            self.origin = np.floor(np.median(points, axis=0))
        for axis, array in enumerate(self._axes):
            np.subtract(points[:, axis], self.origin[axis], out=array[part], casting="same_kind")

    def _store_fields(
        self, block: PointBlock, kept: NDArray[np.bool_] | slice, part: slice
    ) -> None:
        if self._intensity is not None and block.intensity is not None:
            self._store_intensity(self._intensity[part], block.intensity[kept])
        if self._grid and block.row is not None and block.column is not None:
            for array, values_of in zip(self._grid, (block.row, block.column), strict=True):
                array[part] = np.clip(values_of[kept], 0, 2**32 - 1)

    def _store_intensity(self, place: NDArray[Any], values: NDArray[np.float32]) -> None:
        place[:] = values
        lowest, highest = float(values.min()), float(values.max())
        if not np.isfinite(lowest + highest):
            finite = values[np.isfinite(values)]
            self.n_intensity_lost += len(values) - len(finite)
            if not len(finite):
                return
            lowest, highest = float(finite.min()), float(finite.max())
        low, high = self.intensity_range
        self.intensity_range = (min(low, lowest), max(high, highest))

    def _store_scan(self, scan: int, part: slice) -> None:
        if scan >= _MOST_SCANS:
            raise InputError(
                f"there are more than {_MOST_SCANS} scans: read them in several workflows"
            )
        if self._scan is None:
            # Zeros are right for everything that came before.
            self._scan = self._new("scan", np.uint16)
        self._scan[part] = scan

    def _summarise(self, block: PointBlock, scan: int, bounds: NDArray[np.float64]) -> None:
        low, high = bounds
        if scan < len(self._scans):
            before = self._scans[scan]
            low, high = np.minimum(low, before.low), np.maximum(high, before.high)
        summary = ScanSummary(
            station=None if block.station is None else block.station * self._unit_m,
            is_posed=block.station_is_posed,
            low=low,
            high=high,
        )
        self._scans[scan:] = [summary]

    def _new(self, name: str, dtype: type[np.generic], width: int = 1) -> NDArray[Any]:
        shape = (self._capacity,) if width == 1 else (self._capacity, width)
        return self._ctx.allocate("cloud", name, shape, dtype)


def rounding_m(points: NDArray[np.float64], unit_m: float) -> float:
    """Step to which a block's coordinates (n, 3) are rounded, in metres, if it is coarse.

    Args:
        points: in the file's unit.
        unit_m: the file's unit in metres.

    Returns:
        The largest step on which all values of an axis lie, the finest of the axes; 0 when that
        is finer than `COARSE_M` or cannot be told.
    """
    sample = points[:: max(1, len(points) // _ROUNDING_SAMPLE)]
    found = []
    for axis in range(3):
        values = np.unique(sample[:, axis])
        values = values[np.isfinite(values)]
        if len(values) >= _ROUNDING_VALUES:
            found.append(_common_step(values, unit_m))
    return min(found, default=0.0) * unit_m


def resolution_m(farthest_m: float) -> float:
    """Distance between neighbouring float32 numbers at an offset."""
    return float(np.spacing(np.float32(farthest_m)))


def _make_ready(array: NDArray[Any], part: slice) -> None:
    """Ask for the pages of a mapped file that are about to be written, all at once.

    One by one, each when it is first written to, they take four times as long.
    """
    mapping: object = array.base
    if not isinstance(mapping, mmap.mmap):
        return
    first = part.start * array.strides[0] // mmap.PAGESIZE * mmap.PAGESIZE
    with contextlib.suppress(OSError):
        mapping.madvise(_POPULATE_WRITE, first, part.stop * array.strides[0] - first)


def _bounds(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2, 3) smallest and largest coordinates of points (n, 3); NaN shows, none give infinity."""
    if not len(points):
        return np.array([[np.inf] * 3, [-np.inf] * 3])
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _usable(points: NDArray[np.float64], bounds: NDArray[np.float64]) -> NDArray[np.bool_] | slice:
    """Which points can be used; a slice when all can, so that nothing need be copied."""
    # NaN passes through minimum and maximum, and compares as False.
    if len(points) and np.all(np.abs(bounds) < FARTHEST_M):
        return slice(None)
    mask: NDArray[np.bool_] = np.logical_and.reduce(
        [np.abs(points[:, axis]) < FARTHEST_M for axis in (0, 1, 2)]
    )
    return mask


def _require_space(ctx: StepContext, n_points: int) -> None:
    """Refuse before writing: a mapped file on a full disk ends the process by a signal."""
    needed = n_points * _POINT_BYTES
    free = shutil.disk_usage(ctx.scratch).free
    if free < needed:
        raise StoreError(
            f"{n_points} points need {needed / 1e9:.2f} GB of scratch space, but only "
            f"{free / 1e9:.2f} GB are free: free some space or choose another --store"
        )


def _common_step(values: NDArray[np.float64], unit_m: float) -> float:
    finest = float(np.diff(values).min())
    for step in _ROUNDING_STEPS:
        if step * unit_m < COARSE_M:
            break
        if step > 1.1 * finest:
            continue
        multiples = (values - values[0]) / step
        if np.abs(multiples - np.rint(multiples)).max() < 0.01:
            return step
    return 0.0
