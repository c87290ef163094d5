"""LAS, LAZ and COPC through laspy, chunk by chunk."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.points.blocks import (
    BLOCK_POINTS,
    PointBlock,
    ScanFile,
    point_fields,
    short_file_error,
)
from orthoflow.files.points.foreign import guarded, load_library, reading
from orthoflow.files.points.las_headers import check_chunks, check_header

FORMAT: Final = "LAS/LAZ"
_FARTHEST: Final = 1e12


def open_las(path: Path) -> ScanFile:
    """Open a LAS, LAZ or COPC file."""
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
        read=lambda: _blocks(path, laspy, n_points, bounds, notes),
        details=details,
        notes=notes,
    )


def _blocks(
    path: Path, laspy: Any, n_points: int, bounds: NDArray[np.float64], notes: list[str]
) -> Iterator[PointBlock]:
    n_read = 0
    n_outside = 0
    with reading(path, FORMAT):
        reader = laspy.open(path)
    try:
        for chunk in guarded(reader.chunk_iterator(BLOCK_POINTS), path, FORMAT):
            with reading(path, FORMAT):
                block = _block(chunk)
            n_read += block.n_read
            n_outside += _outside(path, block.points, bounds)
            yield block
    finally:
        reader.close()
    if n_read != n_points:
        raise short_file_error(path, "data", f"{n_read} points", f"{n_points}")
    if n_outside:
        notes.append(
            f"{path.name}: {n_outside} points lie outside the bounds its header states; they are "
            "kept, but check that the file is whole"
        )


def _block(chunk: Any) -> PointBlock:
    # Scale and offset in float64: survey coordinates keep every digit.
    # Axis by axis in memory: later passes go along the axes.
    axes = np.empty((3, len(chunk)))
    for place, name in enumerate("XYZ"):
        np.multiply(chunk[name], chunk.scales[place], out=axes[place])
        axes[place] += chunk.offsets[place]
    points = axes.T
    names = set(chunk.point_format.dimension_names)
    intensity = np.asarray(chunk.intensity, dtype=np.float32) if "intensity" in names else None
    rgb = None
    if {"red", "green", "blue"} <= names:
        rgb = np.column_stack([np.asarray(chunk[name]) for name in ("red", "green", "blue")])
    block = PointBlock(points=points, scan=0, n_read=len(points), intensity=intensity, rgb=rgb)
    withheld = np.asarray(chunk.withheld, dtype=np.bool_)
    if not withheld.any():
        return block
    kept = ~withheld
    return PointBlock(
        points=points[kept],
        scan=0,
        n_read=len(points),
        n_withheld=int(withheld.sum()),
        intensity=None if intensity is None else intensity[kept],
        rgb=None if rgb is None else rgb[kept],
    )


def _outside(path: Path, points: NDArray[np.float64], bounds: NDArray[np.float64]) -> int:
    """Count points outside the header's bounds; far outside is what damaged bytes decode to.

    Compressed points carry no checksum, so the bounds are the only witness of a changed byte.
    """
    low, high = bounds
    # Bounds that no scan has say nothing; NaN compares as False.
    if not (np.all(np.abs(bounds) < _FARTHEST) and np.all(high >= low)) or not len(points):
        return 0
    extent = float((high - low).max())
    if extent == 0.0:
        return 0
    # Headers are often rounded to the last digit.
    slack = 1e-3 * max(extent, 1.0)
    if np.all(points.min(axis=0) >= low - slack) and np.all(points.max(axis=0) <= high + slack):
        return 0
    beyond = np.maximum(low - points, points - high).max(axis=1)
    far = float(beyond.max())
    if far > max(extent, 1.0):
        raise InputError(
            f"{path.name} is damaged: points lie {far:.0f} units outside the bounds its header "
            f"states ({low.tolist()} to {high.tolist()}); copy or export it again"
        )
    return int(np.count_nonzero(beyond > slack))
