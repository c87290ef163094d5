"""`raster.grid`: the scanned surface over each wall as a regular raster (markiewicz2015, 3.4)."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, ClassVar, Final

import numpy as np
from numpy.typing import DTypeLike, NDArray
from pydantic import Field

from orthoflow.errors import MethodError
from orthoflow.geometry import WallFrame
from orthoflow.geometry.slabs import Slab
from orthoflow.products import IntensitySource, Planes, PointCloud, SurfaceMask, Wall, Walls
from orthoflow.sdk import Method, MethodParams, Ports, StepContext
from orthoflow.sdk.methods import Determinism
from orthoflow_plugins.raster.balancing import balanced
from orthoflow_plugins.raster.reporting import WallRaster, report, warn
from orthoflow_plugins.raster.rules import Surface, SurfaceRule
from orthoflow_plugins.raster.scan_steps import scan_step_m
from orthoflow_plugins.raster.selection import Constraint, WallChoice, chosen_planes, frame_of

if TYPE_CHECKING:
    from orthoflow.geometry.row_bands import Allocate
    from orthoflow_plugins.raster.banding import Raster
    from orthoflow_plugins.raster.gaps import GapRule

# Rec. 601 luma on the sRGB values as they are: the grey of cv2.cvtColor.
_LUMA: Final = np.array([0.299, 0.587, 0.114], dtype=np.float32)
# Bytes per cell: what a finished wall keeps, and what the passes over one wall hold on top.
_BYTES_KEPT: Final = 25
_BYTES_WORKING: Final = 90
_MEMORY_SHARE: Final = 0.75
# Larger walls are rastered in bands of so many cells: 3 GB of memory.
_BAND_CELLS: Final = 1 << 25


class RasterGrid(Method):
    """Lay the cloud into a raster on each wall: depth, spread, count, intensity, colour.

    Narrow gaps are closed: between neighbours of the scan's own rows and columns where these are
    known, else with the nearest measured cell. Wider ones, such as windows, stay void.
    """

    id: ClassVar[str] = "raster.grid"
    result_version: ClassVar[int] = 4
    determinism: ClassVar[Determinism] = "exact"
    citations: ClassVar[tuple[str, ...]] = (
        "markiewicz2015: orthoimages of cultural heritage objects from TLS and images, 3.4, 4.2",
    )

    class Params(MethodParams):
        """Cell size, reach of the surface, which planes, and how gaps close."""

        gsd_m: float = Field(
            default=0.005, gt=0, description="Side of a cell; not finer than the scan's step."
        )
        buffer_m: float | None = Field(
            default=None,
            gt=0,
            description="Points so far from the plane, on both sides, count; unset, three times "
            "the tolerance with which the planes were found (markiewicz2015: 3 x 5 cm).",
        )
        buffer_front_m: float | None = Field(
            default=None, ge=0, description="Reach towards the viewer instead of buffer_m."
        )
        buffer_behind_m: float | None = Field(
            default=None, ge=0, description="Reach behind the plane instead of buffer_m."
        )
        surface: Surface = Field(
            default="median",
            description="Depth of a cell: median of its best supported layer, cells of outliers "
            "left out; the same denoised, with steps kept; of the nearest point, also of the next "
            "cells (markiewicz2015); of its point nearest the centre; of the topmost point "
            "(skarlatos2012); mean of all; or tin, a net of triangles, which closes windows (for "
            "comparison).",
        )
        denoise_cells: int = Field(
            default=4, ge=0, le=20, description="Reach of the filter of surface denoised."
        )
        layer_m: float = Field(
            default=0.02,
            gt=0,
            description="Depth step within a cell that separates two layers, of which the median "
            "takes the one with more points.",
        )
        percentiles: tuple[Annotated[float, Field(ge=0, le=100)], ...] = Field(
            default=(),
            max_length=9,
            description="Percentiles of the depths of a cell's points, rasters of their own.",
        )
        balance_intensity: bool = Field(
            default=False,
            description="Take out of the intensity what range, incidence and the scan itself "
            "change, told from where scans overlap.",
        )
        recover_gap_cells: int = Field(
            default=2,
            ge=0,
            le=50,
            description="Void cells are recovered where no disc of this radius fits into the gap; "
            "0 recovers nothing.",
        )
        recover_scan_steps: int = Field(
            default=2,
            ge=0,
            le=10,
            description="Where the scan's rows and columns are known, void cells between points so "
            "many rows or columns apart are recovered first, linear between them, if the points "
            "lie on one surface (layer_m) and at most four times recover_gap_cells apart.",
        )
        constraint: Constraint = Field(
            default="any", description="Raster only vertical, only horizontal, or any planes."
        )
        min_area_m2: float = Field(
            default=1.0,
            ge=0,
            description="Smallest rectangle of a plane; the one with the most support is exempt.",
        )
        n_walls_max: int = Field(
            default=12, ge=1, le=1000, description="At most so many planes, by support."
        )
        ranks: tuple[Annotated[int, Field(ge=0)], ...] = Field(
            default=(),
            description="Raster exactly these planes, by their place in planes.json, where 0 has "
            "the most support; empty: as constraint, min_area_m2, n_walls_max, skip_covered say.",
        )
        skip_covered: bool = Field(
            default=True,
            description="Leave out a plane that lies within the buffer of a larger parallel wall, "
            "which shows it as relief.",
        )
        margin_m: float = Field(
            default=0.0, ge=0, description="Widens the rectangle of a plane on all sides."
        )

    class In(Ports):
        """The cloud and the planes found in it."""

        cloud: PointCloud
        planes: Planes

    class Out(Ports):
        """One raster per wall."""

        walls: Walls

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Raster the chosen planes, one pass over the cloud or a few for each."""
        cloud, planes = inputs.cloud, inputs.planes
        cloud.require_points(3)
        slabs = _slabs(planes, params)
        rasters: list[WallRaster] = []
        source = _intensity_source(cloud)
        if params.balance_intensity:
            cloud = balanced(cloud, list(slabs.values()), ctx)
        for k, (index, slab) in enumerate(slabs.items()):
            ctx.progress(k / len(slabs), planes.names[index])
            rasters.append(
                _wall(
                    cloud,
                    slab,
                    params,
                    plane=(planes, index),
                    allocate=partial(_allocated, ctx, k),
                    threads=ctx.cores,
                )
            )
        walls = tuple(raster.wall for raster in rasters)
        _require_points_near(walls, next(iter(slabs.values())))
        warn(ctx, rasters, source)
        report(ctx, rasters)
        slab = next(iter(slabs.values()))
        return self.Out(
            walls=Walls(
                walls=walls,
                up=planes.up.copy(),
                intensity_source=source,
                buffer_front_m=slab.front_m,
                buffer_behind_m=slab.behind_m,
                percentiles=params.percentiles,
                details={
                    "surface": params.surface,
                    "scan_step_m": [raster.scan_step_m for raster in rasters],
                },
            )
        )


def _slabs(planes: Planes, params: RasterGrid.Params) -> dict[int, Slab]:
    """Slab of each chosen plane by its index.

    Raises:
        MethodError: the rasters would not fit into memory.
    """
    both = 3.0 * planes.tolerance_m if params.buffer_m is None else params.buffer_m
    front = both if params.buffer_front_m is None else params.buffer_front_m
    behind = both if params.buffer_behind_m is None else params.buffer_behind_m
    choice = WallChoice(
        constraint=params.constraint,
        min_area_m2=params.min_area_m2,
        n_walls_max=params.n_walls_max,
        skip_covered=params.skip_covered,
        front_m=front,
        behind_m=behind,
        ranks=params.ranks,
    )
    slabs = {
        index: Slab(
            frame=frame_of(planes, index, gsd_m=params.gsd_m, margin_m=params.margin_m),
            front_m=front,
            behind_m=behind,
        )
        for index in chosen_planes(planes, choice)
    }
    _require_memory([slab.frame for slab in slabs.values()], params)
    return slabs


def _require_memory(frames: list[WallFrame], params: RasterGrid.Params) -> None:
    sizes = [frame.width * frame.height for frame in frames]
    # What is rastered in bands lies in files, and takes the memory of a band.
    kept = [
        size for size, frame in zip(sizes, frames, strict=True) if not _is_banded(frame, params)
    ]
    working = max([*kept, _BAND_CELLS] if len(kept) < len(sizes) else kept)
    needed = _BYTES_KEPT * sum(kept) + _BYTES_WORKING * working
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    # Cells are numbered with 32 bits.
    if needed > _MEMORY_SHARE * memory or max(sizes) > np.iinfo(np.int32).max:
        largest = frames[int(np.argmax(sizes))]
        raise MethodError(
            f"cells of gsd_m = {largest.gsd_m:g} m make {sum(sizes):.3g} cells ({largest.width} "
            f"x {largest.height} on the largest wall), which need {needed / 2**30:.3g} GiB where "
            f"this machine has {memory / 2**30:.3g} GiB: raise gsd_m, or lower n_walls_max"
        )


def _allocated(
    ctx: StepContext, wall: int, name: str, shape: tuple[int, ...], dtype: DTypeLike
) -> NDArray[np.generic]:
    return ctx.allocate("walls", f"{wall}.{name}", shape, dtype).view(np.ndarray)


def _wall(
    cloud: PointCloud,
    slab: Slab,
    params: RasterGrid.Params,
    *,
    plane: tuple[Planes, int],
    allocate: Allocate,
    threads: int,
) -> WallRaster:
    from orthoflow_plugins.raster.banding import rastered_in_bands

    raster_of = partial(_raster, cloud, params=params, threads=threads)
    if _is_banded(slab.frame, params):
        raster = rastered_in_bands(
            slab,
            raster_of,
            cells_most=_BAND_CELLS,
            # Outliers are told from 20 cells around, noise taken out twice.
            reach_rows=32
            + 2 * params.denoise_cells
            + _gap_rule(params, threads=threads).reach_cells,
            allocate=allocate,
        )
    else:
        raster = raster_of(slab)
    surface, shape = raster.surface, slab.frame.shape
    planes, index = plane
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
        rgb_mask=None if surface.rgb is None else _where_known(raster.mask, shape, allocate),
        percentiles_m=None
        if surface.percentiles_m is None
        else surface.percentiles_m.reshape(*shape, -1),
    )
    return WallRaster(wall=wall, scan_step_m=scan_step_m(wall.count, gsd_m=params.gsd_m))


def _where_known(
    mask: NDArray[np.uint8], shape: tuple[int, int], allocate: Allocate
) -> NDArray[np.uint8]:
    """1 where a `SurfaceMask` (cells,) is not void, else 0; of a large wall in a file."""
    if mask.size <= _BAND_CELLS:
        return (mask > 0).astype(np.uint8).reshape(shape)
    known = np.asarray(allocate("rgb_mask", shape, np.uint8), np.uint8)
    np.minimum(mask.reshape(shape), 1, out=known)
    return known


def _is_banded(frame: WallFrame, params: RasterGrid.Params) -> bool:
    """Whether a wall is rastered band by band; the triangles of a net know no bands."""
    return frame.width * frame.height > _BAND_CELLS and params.surface != "tin"


def _gap_rule(params: RasterGrid.Params, *, threads: int) -> GapRule:
    from orthoflow_plugins.raster.gaps import GapRule

    return GapRule(
        gap_cells=params.recover_gap_cells,
        scan_steps=params.recover_scan_steps,
        layer_m=params.layer_m,
        threads=threads,
    )


def _raster(cloud: PointCloud, slab: Slab, *, params: RasterGrid.Params, threads: int) -> Raster:
    from orthoflow_plugins.raster.banding import Raster
    from orthoflow_plugins.raster.gaps import close_gaps
    from orthoflow_plugins.raster.surfaces import surface_of

    rule = SurfaceRule(
        surface=params.surface,
        layer_m=params.layer_m,
        denoise_cells=params.denoise_cells,
        percentiles=params.percentiles,
        threads=threads,
    )
    surface = surface_of(cloud, slab, rule)
    mask = close_gaps(cloud, slab, surface, _gap_rule(params, threads=threads))
    if surface.intensity is None:
        surface = replace(surface, intensity=_grey(surface.rgb, mask))
    return Raster(surface=surface, mask=mask)


def _grey(rgb: NDArray[np.uint8] | None, mask: NDArray[np.uint8]) -> NDArray[np.float32] | None:
    if rgb is None:
        return None
    grey = rgb.astype(np.float32) @ _LUMA / np.float32(255.0)
    grey[mask == SurfaceMask.VOID] = np.nan
    return grey.astype(np.float32)


def _require_points_near(walls: tuple[Wall, ...], slab: Slab) -> None:
    if not any(wall.count.any() for wall in walls):
        raise MethodError(
            f"no point of the cloud lies inside the rectangle and the buffer of a wall "
            f"({slab.front_m:g} m in front, {slab.behind_m:g} m behind): the planes do not belong "
            "to this cloud, or buffer_m is too small"
        )


def _intensity_source(cloud: PointCloud) -> IntensitySource:
    if cloud.intensity is not None:
        return "laser"
    return "none" if cloud.rgb is None else "luminance"
