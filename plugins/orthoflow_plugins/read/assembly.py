"""Assembly of one cloud from the blocks of several files, and detection of rounded coordinates."""

from __future__ import annotations

import contextlib
import mmap
import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError, StoreError
from orthoflow.files.points import PointBlock, Scan, ScanFile
from orthoflow.geometry.frames import FARTHEST_M
from orthoflow.sdk import StepContext
from orthoflow_plugins.read.scales import ColourScale

# Coordinates that are rounded more coarsely than this limit the detail of an orthoimage.
COARSE_M: Final = 0.005
# A warning is reported if the resolution of offsets is coarser than this.
FINE_M: Final = 5e-5
_POINT_BYTES: Final = 40
_MOST_SCANS: Final = 2**16
# MADV_POPULATE_WRITE of Linux 5.14, which Python does not define.
_POPULATE_WRITE: Final = 23
_ROUNDING_SAMPLE: Final = 20_000
_ROUNDING_VALUES: Final = 10
# A position stands for missing points if at least this share of a sample has it. Even coarsely
# rounded coordinates do not give so many points the same position.
_REPEATED_SAMPLE: Final = 2000
_REPEATED_SHARE: Final = 0.05
_FEWEST_REPEATED: Final = 20
# Decimal steps, and the powers of two to which float32 rounds large coordinates.
_ROUNDING_STEPS: Final = sorted(
    {digit * 10.0**power for digit in (1, 2, 5) for power in range(-4, 3)}
    | {2.0**power for power in range(-10, 4)},
    reverse=True,
)


@dataclass(kw_only=True)
class ScanCount:
    """Statistics of the points of one scan.

    Attributes:
        file: name of the file.
        index: index of the scan in the file.
        format_name: format of the file.
        scan: metadata of the scan.
        unit_m: metres per unit along x, y and z.
        start: index of the first point in the cloud.
        stop: index after the last point in the cloud.
        n_read: number of points that the scan has in the file.
        left_out: number of points that are not in the cloud, by cause.
        n_without_rgb: number of points in the cloud without a valid colour.
        rounding_m: step in metres to which coordinates are rounded; 0 if the step is small.
        colours: scale of the colours; None if there are no colours.
        first_far_m: first point that is too far from the origin; empty if there is none.
        repeated_m: position shared by so many points that they cannot be laser returns, or None.
    """

    file: str
    index: int
    format_name: str
    scan: Scan
    unit_m: NDArray[np.float64]
    start: int = 0
    stop: int = 0
    n_read: int = 0
    left_out: Counter[str] = field(default_factory=Counter)
    n_without_rgb: int = 0
    rounding_m: float = 0.0
    colours: ColourScale | None = None
    first_far_m: tuple[float, ...] = ()
    repeated_m: NDArray[np.float64] | None = None

    @property
    def n_kept(self) -> int:
        """Number of points in the cloud."""
        return self.stop - self.start

    @property
    def title(self) -> str:
        """Name of the scan in messages."""
        name = f" ({self.scan.name})" if self.scan.name else ""
        return f"{self.file}, scan {self.index}{name}"


class CloudAssembly:
    """Arrays of a cloud to which files are added one by one.

    Attributes:
        origin: (3,) whole metres near the data; set by the first points.
        n_points: number of points so far.
        counts: statistics of each scan, in the order of the files.
    """

    origin: NDArray[np.float64]

    def __init__(
        self,
        ctx: StepContext,
        files: list[ScanFile],
        unit_m: Callable[[Scan], NDArray[np.float64]],
        box_m: NDArray[np.float64] | None = None,
    ) -> None:
        """Allocate arrays for the maximum number of points; unused parts are cut off later.

        Args:
            ctx: context of the step.
            files: files to read.
            unit_m: function that returns metres per unit of a scan, along x, y and z.
            box_m: (2, 3) lowest and highest coordinates of the points to keep; None for all.
        """
        self._ctx, self._box_m, self._unit_m = ctx, box_m, unit_m
        self._reach_m = np.array([[np.inf] * 3, [-np.inf] * 3])
        self._capacity = sum(file.n_most for file in files)
        # Check the disk space before writing, since writing to a memory-mapped file on a full disk
        # terminates the process with a signal.
        needed, free = self._capacity * _POINT_BYTES, shutil.disk_usage(ctx.scratch).free
        if free < needed:
            raise StoreError(
                f"{self._capacity} points need {needed / 1e9:.2f} GB of scratch space, but only "
                f"{free / 1e9:.2f} GB are free: free some disk space, or choose another --store"
            )
        fields = frozenset().union(*(file.fields for file in files))
        has_grid = all("grid" in scan.fields for file in files for scan in file.scans)
        self._arrays = {name: self._new(name, np.float32) for name in "xyz"}
        if "intensity" in fields:
            self._arrays["intensity"] = self._new("intensity", np.float32)
        if "rgb" in fields:
            self._arrays["rgb"] = self._new("rgb", np.uint8, 3)
        if has_grid:
            self._arrays |= {name: self._new(name, np.uint32) for name in ("row", "column")}
        self.n_points = 0
        self.counts: list[ScanCount] = []

    def add_file(self, file: ScanFile) -> None:
        """Read all blocks of a file.

        Raises:
            InputError: the file is damaged, or none of its points is usable.
        """
        counts = [
            ScanCount(
                file=file.name,
                index=index,
                format_name=file.format_name,
                scan=scan,
                unit_m=self._unit_m(scan),
            )
            for index, scan in enumerate(file.scans)
        ]
        first_scan = len(self.counts)
        self.counts += counts
        if len(self.counts) > _MOST_SCANS:
            raise InputError(
                f"there are more than {_MOST_SCANS} scans: read them in several workflows"
            )
        n_before, n_done = sum(count.n_read for count in self.counts), 0
        for block in file.read():
            self._add(block, first_scan + block.scan)
            n_done += block.n_read
            share = min((n_before + n_done) / self._capacity, 1.0)
            self._ctx.progress(share, f"{file.name}: {n_done} points")
        left_out = sum((count.left_out for count in counts), Counter())
        is_choice = left_out["outside_box"] or left_out["other_class"]
        if not is_choice and not any(count.n_kept for count in counts):
            causes = ", ".join(f"{n} {c.replace('_', ' ')}" for c, n in left_out.items() if n)
            raise InputError(
                f"{file.name} contains no usable points: all {sum(c.n_read for c in counts)} "
                f"were left out ({causes}); export it again"
            )

    def require_points(self) -> None:
        """Check that points are left in the cloud.

        Raises:
            InputError: all points belong to classes that were not requested, or are outside the
                box.
        """
        if self.n_points:
            return
        n_unwanted, n_outside = (
            sum(count.left_out[cause] for count in self.counts)
            for cause in ("other_class", "outside_box")
        )
        text = f"no point is left: {n_unwanted} are of other classes than requested"
        if n_outside:
            low, high = (", ".join(f"{value:.2f}" for value in corner) for corner in self._reach_m)
            text += f", {n_outside} are outside the box; the points extend from ({low}) to ({high})"
        raise InputError(f"{text}; change classes or box (read.scan)")

    @property
    def offsets(self) -> list[NDArray[Any]]:
        """Return x, y and z relative to the origin, truncated to the current number of points."""
        return [self._arrays[name][: self.n_points] for name in "xyz"]

    def array(self, name: str) -> NDArray[Any] | None:
        """Return another array, truncated to the number of points; None if no file contains it."""
        array = self._arrays.get(name)
        return None if array is None else array[: self.n_points]

    def colour_mask(self) -> NDArray[Any]:
        """Return the mask of valid colours, truncated to the current number of points."""
        if "has_rgb" not in self._arrays:
            self._arrays["has_rgb"] = self._new("has_rgb", np.bool_)
            self._arrays["has_rgb"][: self.n_points] = True
        return self._arrays["has_rgb"][: self.n_points]

    def _add(self, block: PointBlock, scan: int) -> None:
        count = self.counts[scan]
        if count.n_read == 0:
            count.rounding_m = rounding_m(block.points, float(count.unit_m.max()))
            count.start = count.stop = self.n_points
        count.n_read += block.n_read
        count.left_out.update(block.left_out)
        points, bounds = block.points, block.bounds
        if np.any(count.unit_m != 1.0):
            points, bounds = points * count.unit_m, bounds * count.unit_m
        kept = self._kept(points, bounds, count)
        usable = points[kept]
        part = slice(self.n_points, self.n_points + len(usable))
        if not len(usable):
            return
        if part.stop > self._capacity:
            raise InputError(f"{count.file} contains more points than its header declares")
        if scan > 0 and "scan" not in self._arrays:
            # The array starts with zeros, since all previous points belong to scan 0.
            self._arrays["scan"] = self._new("scan", np.uint16)
        if self.n_points == 0:
            # Distant stray points have no effect on the median, so they do not reduce the precision
            # of the scan.
            self.origin = np.floor(np.median(usable, axis=0))
        self._store(usable, block, kept, part)
        if "scan" in self._arrays:
            self._arrays["scan"][part] = scan
        if "rgb" in self._arrays:
            self._store_colours(block, kept, part, count)
        self.n_points = count.stop = part.stop

    def _store(
        self,
        points: NDArray[np.float64],
        block: PointBlock,
        kept: NDArray[np.bool_] | slice,
        part: slice,
    ) -> None:
        for array in self._arrays.values():
            _make_ready(array, part)
        for axis, name in enumerate("xyz"):
            target = self._arrays[name][part]
            np.subtract(points[:, axis], self.origin[axis], out=target, casting="same_kind")
        if "intensity" in self._arrays:
            values = np.float32(np.nan) if block.intensity is None else block.intensity[kept]
            self._arrays["intensity"][part] = values
        for name, places in (("row", block.row), ("column", block.column)):
            if name in self._arrays and places is not None:
                self._arrays[name][part] = np.clip(places[kept], 0, 2**32 - 1)

    def _kept(
        self, points: NDArray[np.float64], bounds: NDArray[np.float64], count: ScanCount
    ) -> NDArray[np.bool_] | slice:
        """Return a mask of the points (n, 3) to keep, or a slice if all are kept."""
        usable: NDArray[np.bool_] | slice = slice(None)
        # If a coordinate is NaN, the bounds are NaN and the comparison is False.
        if not np.all(np.abs(bounds) < FARTHEST_M) and len(points):
            usable = is_near = np.asarray((np.abs(points) < FARTHEST_M).all(axis=1))
            lost = points[~is_near]
            far = lost[np.isfinite(lost).all(axis=1)]
            if len(far) and not count.left_out["too_far"]:
                count.first_far_m = tuple(far[0].tolist())
            count.left_out["too_far"] += len(far)
            count.left_out["not_finite"] += len(lost) - len(far)
            if len(lost) < len(points):
                bounds = np.stack([points[usable].min(axis=0), points[usable].max(axis=0)])
        if count.repeated_m is None:
            count.repeated_m = repeated_place(points[usable])
        if count.repeated_m is not None:
            is_there = (points == count.repeated_m).all(axis=1)
            count.left_out["one_place"] += int(np.count_nonzero(is_there))
            usable = ~is_there if isinstance(usable, slice) else usable & ~is_there
        if self._box_m is None or not len(points[usable]):
            return usable
        self._reach_m = np.stack(
            [np.minimum(self._reach_m[0], bounds[0]), np.maximum(self._reach_m[1], bounds[1])]
        )
        # Points on the faces of the box are kept.
        low, high = self._box_m
        is_inside = np.asarray(((points >= low) & (points <= high)).all(axis=1))
        if not isinstance(usable, slice):
            is_inside &= usable
        count.left_out["outside_box"] += len(points[usable]) - int(np.count_nonzero(is_inside))
        return is_inside

    def _store_colours(
        self, block: PointBlock, kept: NDArray[np.bool_] | slice, part: slice, count: ScanCount
    ) -> None:
        n_points = part.stop - part.start
        valid = np.zeros(n_points, dtype=np.bool_)
        if block.rgb is not None:
            rgb = block.rgb[kept]
            valid[:] = True if block.has_rgb is None else block.has_rgb[kept]
            if rgb.dtype.kind == "f":
                valid &= np.isfinite(rgb).all(axis=1)
            if count.colours is None:
                stored = self._arrays["rgb"][part.start :]
                count.colours = ColourScale(stored, count.scan.rgb_limit)
            count.colours.add(rgb, None if valid.all() else valid)
        count.n_without_rgb += n_points - int(np.count_nonzero(valid))
        if not valid.all():
            self.colour_mask()
        if "has_rgb" in self._arrays:
            self._arrays["has_rgb"][part] = valid

    def _new(self, name: str, dtype: type[np.generic], width: int = 1) -> NDArray[Any]:
        shape = (self._capacity,) if width == 1 else (self._capacity, width)
        return self._ctx.allocate("cloud", name, shape, dtype)


def rounding_m(points: NDArray[np.float64], unit_m: float) -> float:
    """Return the step in metres to which coordinates (n, 3) of a block are rounded, if coarse.

    Args:
        points: coordinates in the unit of the file.
        unit_m: unit of the file in metres.

    Returns:
        For each axis, the largest step is found of which all values are multiples. The result is
        the smallest of the three, or 0 if it is less than `COARSE_M` or unknown.
    """
    sample = points[:: max(1, len(points) // _ROUNDING_SAMPLE)]
    found = []
    for axis in range(3):
        values = np.unique(sample[:, axis])
        values = values[np.isfinite(values)]
        if len(values) >= _ROUNDING_VALUES:
            found.append(_common_step(values, unit_m))
    return min(found, default=0.0) * unit_m


def repeated_place(points: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return a position (3,) shared by too many points (n, 3) for laser returns, or None.

    Some files contain points at 0 0 0 for rays without a return. Programs that transform a scan
    also transform these points.
    """
    sample = points[:: max(1, len(points) // _REPEATED_SAMPLE)]
    sample = sample[np.isfinite(sample).all(axis=1)]
    places, counts = np.unique(sample, axis=0, return_counts=True)
    if counts.max(initial=0) < max(_FEWEST_REPEATED, _REPEATED_SHARE * len(sample)):
        return None
    return np.asarray(places[counts.argmax()])


def resolution_m(farthest_m: float) -> float:
    """Return the distance between neighbouring float32 numbers at the given offset."""
    return float(np.spacing(np.float32(farthest_m)))


def _make_ready(array: NDArray[Any], part: slice) -> None:
    """Request in one call all pages of a memory-mapped file that will be written next.

    This is four times as fast as one page fault per page.
    """
    mapping: object = array.base
    if not isinstance(mapping, mmap.mmap):
        return
    first = part.start * array.strides[0] // mmap.PAGESIZE * mmap.PAGESIZE
    with contextlib.suppress(OSError):
        mapping.madvise(_POPULATE_WRITE, first, part.stop * array.strides[0] - first)


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
