"""LAS, LAZ and COPC through laspy, chunk by chunk."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points.blocks import PointBlock, ScanFile, point_fields, short_file_error
from orthoflow.files.points.foreign import guarded, load_library, reading
from orthoflow.files.points.las_decoding import records
from orthoflow.files.points.las_headers import check_chunks, check_header

FORMAT: Final = "LAS/LAZ"
_FARTHEST: Final = 1e12
_PART_POINTS: Final = 1 << 15


def open_las(path: Path, *, cores: int = 1) -> ScanFile:
    """Open a LAS, LAZ or COPC file; so many processes may decode its points."""
    laspy = load_library("laspy", path)
    check_header(path)
    with reading(path, FORMAT), laspy.open(path) as reader:
        header = reader.header
        names = set(header.point_format.dimension_names)
        bounds = np.vstack([header.mins, header.maxs]).astype(np.float64)
        n_points = int(header.point_count)
        details: dict[str, str | int | float] = {
            "version": str(header.version),
            "point_format": int(header.point_format.id),
            "scale": float(np.max(header.scales)),
        }
        if n_points > 0:
            check_chunks(path, header)
    notes: list[str] = []
    return ScanFile(
        name=path.name,
        format_name=FORMAT,
        n_most=n_points,
        fields=point_fields(
            has_intensity="intensity" in names, has_rgb={"red", "green", "blue"} <= names
        ),
        read=lambda: _blocks(path, laspy, n_points, bounds, notes, cores=cores),
        details=details,
        notes=notes,
    )


def _blocks(
    path: Path,
    laspy: Any,
    n_points: int,
    bounds: NDArray[np.float64],
    notes: list[str],
    *,
    cores: int,
) -> Iterator[PointBlock]:
    n_read = 0
    n_outside = 0
    for chunk in guarded(records(path, laspy, cores=cores), path, FORMAT):
        with reading(path, FORMAT):
            block = _block(chunk)
        n_read += block.n_read
        n_outside += _outside(path, block, bounds)
        yield block
    if n_read != n_points:
        raise short_file_error(path, "data", f"{n_read} points", f"{n_points}")
    if n_outside:
        notes.append(
            f"{path.name}: {n_outside} points lie outside the bounds its header states; they are "
            "kept, but check that the file is whole"
        )


def _block(chunk: Any) -> PointBlock:
    axes = _coordinates(chunk)
    points = axes.T
    names = set(chunk.point_format.dimension_names)
    intensity = np.asarray(chunk.intensity, dtype=np.float32) if "intensity" in names else None
    rgb = None
    if {"red", "green", "blue"} <= names:
        rgb = np.column_stack([np.asarray(chunk[name]) for name in ("red", "green", "blue")])
    block = PointBlock(
        points=points,
        scan=0,
        n_read=len(points),
        intensity=intensity,
        rgb=rgb,
        bounds=_bounds(axes),
    )
    flags = chunk.withheld
    if not np.bitwise_or.reduce(flags.array) & flags.bit_mask:
        return block
    withheld = np.asarray(flags, dtype=np.bool_)
    kept = ~withheld
    axes = axes[:, kept]
    return PointBlock(
        points=axes.T,
        scan=0,
        n_read=len(points),
        n_withheld=int(withheld.sum()),
        intensity=None if intensity is None else intensity[kept],
        rgb=None if rgb is None else rgb[kept],
        bounds=_bounds(axes),
    )


def _coordinates(chunk: Any) -> NDArray[np.float64]:
    """(3, n) coordinates of a record, axis by axis in memory: later passes go along the axes."""
    axes = np.empty((3, len(chunk)))
    # Part by part, so that a part stays in the processor's cache from one step to the next.
    for start in range(0, len(chunk), _PART_POINTS):
        part = slice(start, start + _PART_POINTS)
        for place, name in enumerate("XYZ"):
            # Scale and offset in float64: survey coordinates keep every digit.
            np.multiply(chunk[name][part], chunk.scales[place], out=axes[place, part])
            axes[place, part] += chunk.offsets[place]
    return axes


def _bounds(axes: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """(2, 3) bounds of coordinates (3, n); None where some are not finite, or there are none."""
    if not axes.size:
        return None
    bounds = np.stack([axes.min(axis=1), axes.max(axis=1)])
    return bounds if np.isfinite(bounds).all() else None


def _outside(path: Path, block: PointBlock, bounds: NDArray[np.float64]) -> int:
    """Count points outside the header's bounds; far outside is what damaged bytes decode to.

    Compressed points carry no checksum, so the bounds are the only witness of a changed byte.
    """
    low, high = bounds
    points = block.points
    # Bounds that no scan has say nothing; NaN compares as False.
    if not (np.all(np.abs(bounds) < _FARTHEST) and np.all(high >= low)) or not len(points):
        return 0
    extent = float((high - low).max())
    if extent == 0.0:
        return 0
    # Headers are often rounded to the last digit.
    slack = 1e-3 * max(extent, 1.0)
    found = block.bounds
    if found is not None and np.all(found[0] >= low - slack) and np.all(found[1] <= high + slack):
        return 0
    beyond = np.maximum(low - points, points - high).max(axis=1)
    far = float(beyond.max())
    if far > max(extent, 1.0):
        raise InputError(
            f"{path.name} is damaged: points lie {far:.0f} units outside the bounds its header "
            f"states ({low.tolist()} to {high.tolist()}); copy or export it again"
        )
    return int(np.count_nonzero(beyond > slack))
