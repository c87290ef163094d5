"""Walls rastered one by one: surface and narrow gaps, a large wall in bands of rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np
import psutil
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry import WallFrame
from orthoflow.geometry.bands import IN_MEMORY_CELLS, Allocate, bands_with_reach
from orthoflow.geometry.levels import REC_601
from orthoflow.geometry.scan_steps import scan_step_m
from orthoflow.geometry.slabs import Slab
from orthoflow.products import Planes, PointCloud, SurfaceMask, Wall
from orthoflow_plugins.raster.rules import RasterRule

if TYPE_CHECKING:
    from orthoflow_plugins.raster.nets import Net
    from orthoflow_plugins.raster.surfaces import CellSurface

# Bytes per cell: of a finished wall, and additionally during the passes over one wall.
_BYTES_KEPT: Final = 25
_BYTES_WORKING: Final = 90
_MEMORY_SHARE: Final = 0.75
# Larger walls are rastered in bands of this many cells: 1.5 GB of memory.
_BAND_CELLS: Final = 1 << 24


@dataclass(frozen=True, kw_only=True)
class WallRaster:
    """A rastered wall, and the point spacing of the scan on it."""

    wall: Wall
    scan_step_m: float


def require_memory(frames: Sequence[WallFrame]) -> None:
    """Refuse cells that are too fine for the machine.

    Raises:
        MethodError: the rasters would not fit into memory.
    """
    sizes = [frame.width * frame.height for frame in frames]
    # A large wall is kept in files when finished; processed in bands it takes the memory of a band.
    kept = sum(size for size in sizes if size <= IN_MEMORY_CELLS)
    working = min(max(sizes), _BAND_CELLS)
    needed = _BYTES_KEPT * kept + _BYTES_WORKING * working
    memory = psutil.virtual_memory().total
    # Cells are numbered with 32 bits.
    if needed > _MEMORY_SHARE * memory or max(sizes) > np.iinfo(np.int32).max:
        largest = frames[int(np.argmax(sizes))]
        raise MethodError(
            f"cells of gsd_m = {largest.gsd_m:g} m make {sum(sizes):.3g} cells ({largest.width} "
            f"x {largest.height} on the largest wall), which need {needed / 2**30:.3g} GiB where "
            f"this machine has {memory / 2**30:.3g} GiB: raise gsd_m, or lower n_walls_max"
        )


def rastered_wall(
    cloud: PointCloud,
    slab: Slab,
    rule: RasterRule,
    *,
    planes: Planes,
    index: int,
    allocate: Allocate,
) -> WallRaster:
    """Raster the wall of a plane.

    Args:
        cloud: the points.
        slab: of the wall.
        rule: how.
        planes: all planes, of which the wall is one.
        index: of the wall's plane.
        allocate: returns the arrays of a large wall, by name.
    """
    if slab.n_cells > _BAND_CELLS:
        raster = _rastered_in_bands(cloud, slab, rule, allocate)
    else:
        raster = _rastered(cloud, slab, rule)
        if slab.n_cells > IN_MEMORY_CELLS:
            raster = _in_files(raster, allocate)
    surface, shape = raster.surface, slab.frame.shape
    wall = Wall(
        frame=slab.frame,
        plane_index=index,
        name=planes.names[index],
        depth_m=surface.depth_m.reshape(shape),
        sigma_m=surface.sigma_m.reshape(shape),
        count=surface.count.reshape(shape),
        mask=raster.mask.reshape(shape),
        intensity=None if surface.intensity is None else surface.intensity.reshape(shape),
        rgb=None if surface.rgb is None else surface.rgb.reshape(*shape, 3),
        rgb_mask=None if surface.rgb is None else _where_known(raster, shape, allocate),
        percentiles_m=None
        if surface.percentiles_m is None
        else surface.percentiles_m.reshape(*shape, -1),
    )
    return WallRaster(wall=wall, scan_step_m=scan_step_m(wall.count, gsd_m=slab.frame.gsd_m))


@dataclass(frozen=True, kw_only=True)
class _Raster:
    """The surface over a slab, and the state of its cells.

    Attributes:
        surface: flat over the cells.
        mask: (cells,) uint8 `SurfaceMask`.
    """

    surface: CellSurface
    mask: NDArray[np.uint8]


def _rastered(cloud: PointCloud, slab: Slab, rule: RasterRule, net: Net | None = None) -> _Raster:
    from orthoflow_plugins.raster.gaps import close_gaps
    from orthoflow_plugins.raster.surfaces import carried_to_centres, surface_of

    surface = surface_of(cloud, slab, rule.surface, net)
    mask = close_gaps(cloud, slab, surface, rule.gaps)
    surface = carried_to_centres(surface, slab, rule.surface)
    if surface.intensity is None:
        surface = replace(surface, intensity=_grey(surface, mask))
    return _Raster(surface=surface, mask=mask)


def _rastered_in_bands(
    cloud: PointCloud, slab: Slab, rule: RasterRule, allocate: Allocate
) -> _Raster:
    """Raster a wall band by band, with the memory of one band."""
    from orthoflow_plugins.raster.surfaces import CellSurface

    whole: dict[str, NDArray[np.generic]] = {}
    frame, width = slab.frame, slab.frame.width
    net = _net_in_bands(cloud, slab, rule, allocate) if rule.surface.surface == "tin" else None
    for band in bands_with_reach(frame.shape, cells_most=_BAND_CELLS, reach_rows=rule.reach_rows):
        around = slice(band.around.start * width, band.around.stop * width)
        part = None if net is None else net.part(around)
        raster = _rastered(cloud, slab.over(band.around), rule, part)
        cells = slice(band.rows.start * width, band.rows.stop * width)
        inner = slice(band.inner.start * width, band.inner.stop * width)
        arrays = {"mask": raster.mask} | _fields_of(raster.surface)
        for name, values in arrays.items():
            if name not in whole:
                shape = (slab.n_cells, *values.shape[1:])
                whole[name] = allocate(name, shape, values.dtype)
            whole[name][cells] = values[inner]
    mask = whole.pop("mask")
    absent = dict.fromkeys(("intensity", "rgb", "has_rgb", "percentiles_m", "places"))
    # The arrays have the types of the bands' own.
    surface = CellSurface(**cast("dict[str, Any]", absent | whole))
    return _Raster(surface=surface, mask=mask.astype(np.uint8, copy=False))


def _net_in_bands(cloud: PointCloud, slab: Slab, rule: RasterRule, allocate: Allocate) -> Net:
    """Triangulate a large wall: its vertices are found band by band, and are kept in files."""
    from orthoflow_plugins.raster.nets import Vertices, interpolate_net
    from orthoflow_plugins.raster.surfaces import vertices_of

    shape = slab.frame.shape
    vertices = Vertices(
        point=np.asarray(allocate("net_point", shape, np.uint32), np.uint32),
        depth_m=np.asarray(allocate("net_corner_m", shape, np.float32), np.float32),
    )
    for band in bands_with_reach(shape, cells_most=_BAND_CELLS, reach_rows=0):
        found = vertices_of(cloud, slab.over(band.rows), rule.surface)
        vertices.point[band.rows] = found.point
        vertices.depth_m[band.rows] = found.depth_m
    return interpolate_net(cloud, slab, vertices, allocate)


def _in_files(raster: _Raster, allocate: Allocate) -> _Raster:
    """Move the arrays of a finished raster into files."""
    kept: dict[str, Any] = {}
    for name, values in (("mask", raster.mask), *_fields_of(raster.surface).items()):
        kept[name] = allocate(name, values.shape, values.dtype)
        kept[name][...] = values
    mask = kept.pop("mask")
    return _Raster(surface=replace(raster.surface, **kept), mask=mask)


def _fields_of(surface: CellSurface) -> dict[str, NDArray[np.generic]]:
    """Return arrays of a surface that a wall keeps, by name."""
    found = {field.name: getattr(surface, field.name) for field in fields(surface)}
    return {
        name: values for name, values in found.items() if name != "places" and values is not None
    }


def _where_known(raster: _Raster, shape: tuple[int, int], allocate: Allocate) -> NDArray[np.uint8]:
    """Return 1 where a cell has a colour, else 0; in a file for a large wall."""
    mask = raster.mask.reshape(shape)
    if mask.size <= _BAND_CELLS:
        known = (mask > 0).astype(np.uint8)
    else:
        known = np.asarray(allocate("rgb_mask", shape, np.uint8), np.uint8)
        np.minimum(mask, 1, out=known)
    if raster.surface.has_rgb is not None:
        known &= raster.surface.has_rgb.reshape(shape).view(np.uint8)
    return known


def _grey(surface: CellSurface, mask: NDArray[np.uint8]) -> NDArray[np.float32] | None:
    rgb = surface.rgb
    if rgb is None:
        return None
    grey = rgb.astype(np.float32) @ REC_601.astype(np.float32) / np.float32(255.0)
    grey[mask == SurfaceMask.VOID] = np.nan
    if surface.has_rgb is not None:
        grey[~surface.has_rgb] = np.nan
    return grey.astype(np.float32)
