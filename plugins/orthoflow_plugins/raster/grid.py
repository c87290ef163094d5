"""`raster.grid`: the scanned surface over each wall as a regular raster (markiewicz2015, 3.4)."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.errors import MethodError
from orthoflow.geometry import WallFrame
from orthoflow.geometry.depth_noise import depth_noise_m
from orthoflow.geometry.slabs import Slab
from orthoflow.products import Planes, PointCloud, SurfaceMask, Wall, Walls
from orthoflow.sdk import Method, MethodParams, Ports, StepContext
from orthoflow.sdk.methods import Determinism
from orthoflow_plugins.raster.balancing import balanced
from orthoflow_plugins.raster.previews import depth_preview
from orthoflow_plugins.raster.rules import Surface, SurfaceRule
from orthoflow_plugins.raster.scan_steps import scan_step_m
from orthoflow_plugins.raster.selection import Constraint, WallChoice, chosen_planes, frame_of

if TYPE_CHECKING:
    from orthoflow_plugins.raster.surfaces import CellSurface

# Rec. 601 luma on the sRGB values as they are: the grey of cv2.cvtColor.
_LUMA: Final = np.array([0.299, 0.587, 0.114], dtype=np.float32)
# Bytes per cell: what a finished wall keeps, and what the passes over one wall hold on top.
_BYTES_KEPT: Final = 25
_BYTES_WORKING: Final = 90
_MEMORY_SHARE: Final = 0.75
# Neighbours in the scan may lie so many widths of a narrow gap's radius apart.
_SPAN_GAPS: Final = 4


@dataclass(frozen=True, kw_only=True)
class _Raster:
    wall: Wall
    scan_step_m: float


class RasterGrid(Method):
    """Lay the cloud into a raster on each wall: depth, spread, count, intensity, colour.

    Narrow gaps are closed: between neighbours of the scan's own rows and columns where these are
    known, else with the nearest measured cell. Wider ones, such as windows, stay void.
    """

    id: ClassVar[str] = "raster.grid"
    result_version: ClassVar[int] = 2
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
        rasters: list[_Raster] = []
        source = _intensity_source(cloud)
        if params.balance_intensity:
            cloud = balanced(cloud, list(slabs.values()), ctx)
        for k, (index, slab) in enumerate(slabs.items()):
            ctx.progress(k / len(slabs), planes.names[index])
            rasters.append(_raster(cloud, slab, params, threads=ctx.cores, plane=(planes, index)))
        walls = tuple(raster.wall for raster in rasters)
        _require_points_near(walls, next(iter(slabs.values())))
        _warn(ctx, params, rasters, source)
        _report(ctx, params, rasters)
        slab = next(iter(slabs.values()))
        return self.Out(
            walls=Walls(
                walls=walls,
                up=planes.up.copy(),
                intensity_source=source,
                buffer_front_m=slab.front_m,
                buffer_behind_m=slab.behind_m,
                details={
                    "surface": params.surface,
                    "scan_step_m": [raster.scan_step_m for raster in rasters],
                    "percentiles": list(params.percentiles),
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
    _require_memory([slab.frame for slab in slabs.values()])
    return slabs


def _require_memory(frames: list[WallFrame]) -> None:
    n_cells = [frame.width * frame.height for frame in frames]
    needed = _BYTES_KEPT * sum(n_cells) + _BYTES_WORKING * max(n_cells)
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    # Cells are numbered with 32 bits.
    if needed > _MEMORY_SHARE * memory or max(n_cells) > np.iinfo(np.int32).max:
        largest = frames[int(np.argmax(n_cells))]
        raise MethodError(
            f"cells of gsd_m = {largest.gsd_m:g} m make {sum(n_cells):.3g} cells ({largest.width} "
            f"x {largest.height} on the largest wall), which need {needed / 2**30:.3g} GiB where "
            f"this machine has {memory / 2**30:.3g} GiB: raise gsd_m, or lower n_walls_max"
        )


def _raster(
    cloud: PointCloud,
    slab: Slab,
    params: RasterGrid.Params,
    *,
    threads: int,
    plane: tuple[Planes, int],
) -> _Raster:
    from orthoflow.geometry.rastering import lenders_in_gaps
    from orthoflow_plugins.raster.scan_neighbours import SpanRule, recover_between_neighbours
    from orthoflow_plugins.raster.surfaces import surface_of

    rule = SurfaceRule(
        surface=params.surface,
        layer_m=params.layer_m,
        denoise_cells=params.denoise_cells,
        percentiles=params.percentiles,
        threads=threads,
    )
    surface = surface_of(cloud, slab, rule)
    is_known = np.isfinite(surface.depth_m)
    mask = np.where(surface.count > 0, SurfaceMask.MEASURED, SurfaceMask.RECOVERED).astype(np.uint8)
    mask[~is_known] = SurfaceMask.VOID
    spans = SpanRule(
        steps=params.recover_scan_steps,
        side_cells=_SPAN_GAPS * params.recover_gap_cells,
        layer_m=params.layer_m,
        threads=threads,
    )
    mask[recover_between_neighbours(cloud, slab, surface, spans)] = SurfaceMask.RECOVERED
    lent = lenders_in_gaps(
        is_known.reshape(slab.frame.shape), params.recover_gap_cells, threads=threads
    )
    _recover(surface, mask, lent[mask[lent[:, 0]] == SurfaceMask.VOID])
    planes, index = plane
    shape = slab.frame.shape
    intensity = _grey(surface.rgb, mask) if surface.intensity is None else surface.intensity
    wall = Wall(
        frame=slab.frame,
        plane_index=index,
        name=planes.names[index],
        depth_m=surface.depth_m.reshape(shape),
        sigma_m=surface.sigma_m.reshape(shape),
        count=surface.count.reshape(shape),
        mask=mask.reshape(shape),
        intensity=None if intensity is None else intensity.reshape(shape),
        rgb=None if surface.rgb is None else surface.rgb.reshape(*shape, 3),
        rgb_mask=None if surface.rgb is None else (mask > 0).astype(np.uint8).reshape(shape),
        percentiles_m=None
        if surface.percentiles_m is None
        else surface.percentiles_m.reshape(*shape, -1),
    )
    return _Raster(wall=wall, scan_step_m=scan_step_m(wall.count, gsd_m=params.gsd_m))


def _recover(surface: CellSurface, mask: NDArray[np.uint8], lent: NDArray[np.int64]) -> None:
    """Copy values into the cells of narrow gaps; their spread stays unknown, their count 0."""
    void, lender = lent[:, 0], lent[:, 1]
    mask[void] = SurfaceMask.RECOVERED
    for values in (surface.depth_m, surface.intensity, surface.rgb):
        if values is not None:
            values[void] = values[lender]


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


def _intensity_source(cloud: PointCloud) -> str:
    if cloud.intensity is not None:
        return "laser"
    return "none" if cloud.rgb is None else "luminance"


def _warn(ctx: StepContext, params: RasterGrid.Params, rasters: list[_Raster], source: str) -> None:
    if source == "luminance":
        ctx.warn("the cloud has no laser intensity; the grey of its colours (Rec. 601) stands in")
    if source == "none":
        ctx.warn("the cloud has neither intensity nor colour; only the depth of walls is rastered")
    for raster in rasters:
        if not raster.wall.count.any():
            ctx.warn(f"{raster.wall.name}: no point lies within its buffer")
        elif raster.scan_step_m > params.gsd_m:
            measured = np.count_nonzero(raster.wall.count) / raster.wall.count.size
            ctx.warn(
                f"{raster.wall.name}: cells of gsd_m = {params.gsd_m:g} m are finer than the scan, "
                f"whose points lie about {raster.scan_step_m:.2g} m apart; {measured:.0%} of the "
                "cells have a point"
            )


def _report(ctx: StepContext, params: RasterGrid.Params, rasters: list[_Raster]) -> None:
    walls = [raster.wall for raster in rasters]
    n_cells = sum(wall.mask.size for wall in walls)
    per_cell = np.concatenate([wall.count[wall.count > 0] for wall in walls])
    spread_m = np.concatenate([wall.sigma_m[wall.count > 1] for wall in walls])
    ctx.metric("n_walls", len(walls), "1")
    ctx.metric("n_points_inside", int(per_cell.sum(dtype=np.int64)), "1")
    ctx.metric("points_per_cell", float(np.median(per_cell)), "1")
    ctx.metric("scan_step_mm", 1000.0 * rasters[0].scan_step_m, "mm")
    ctx.metric("gsd_mm", 1000.0 * params.gsd_m, "mm")
    noise_m = depth_noise_m(walls[0].depth_m)
    ctx.metric("depth_noise_mm", 1000.0 * noise_m, "mm")
    if spread_m.size:
        ctx.metric("sigma_median_mm", 1000.0 * float(np.median(spread_m)), "mm")
    for state in SurfaceMask:
        share = sum(np.count_nonzero(wall.mask == state) for wall in walls) / n_cells
        ctx.metric(f"{state.name.lower()}_share", share, "1")
    ctx.figure(
        "depth",
        depth_preview(walls[0]),
        f"Depth of {walls[0].name}: brighter is nearer to the viewer, grey is void.",
    )
