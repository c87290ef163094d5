"""`ortho.pointcloud-direct`: the topmost coloured points paint their cells (skarlatos2012)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.errors import MethodError
from orthoflow.geometry.slabs import Slab
from orthoflow.products import Layer, LayerMask, Layers, PointCloud, Wall, Walls
from orthoflow.sdk import Method, MethodParams, Ports, StepContext
from orthoflow.sdk.methods import Determinism
from orthoflow_plugins.ortho.filling import (
    Inpainting,
    Painted,
    fillable_gaps,
    filling_preview,
    inpainted,
    painted_between,
)
from orthoflow_plugins.ortho.point_colours import Colouring, ColourRule, colours_of


@dataclass(frozen=True, kw_only=True)
class _Projection:
    """A wall before its gaps are filled: colours, and where each winner lies in its cell."""

    rgb: NDArray[np.uint8]
    is_void: NDArray[np.bool_]
    distance_cells: NDArray[np.float32]
    painted: Painted


class PointcloudDirect(Method):
    """Paint each cell of a wall with the colour of the topmost point in it; fill small gaps.

    Of the points inside the wall's buffer the one with the largest depth wins, ties go to the
    point nearer the centre of the cell, then to the lower index; `colouring` has other rules. Gaps
    are void cells with few void cells around them; what is filled is marked as filled.
    """

    id: ClassVar[str] = "ortho.pointcloud-direct"
    result_version: ClassVar[int] = 3
    determinism: ClassVar[Determinism] = "exact"
    metrics: ClassVar[tuple[str, ...]] = (
        "painted_share",
        "filled_share",
        "void_share",
        "projection_s",
        "filling_s",
    )
    citations: ClassVar[tuple[str, ...]] = (
        "skarlatos2012: Direct orthophoto generation from color point clouds of complex scenes, 3",
    )

    class Params(MethodParams):
        """Which gaps are filled, and how."""

        void_limits: tuple[
            Annotated[int, Field(ge=0, le=9)],
            Annotated[int, Field(ge=0, le=25)],
            Annotated[int, Field(ge=0, le=49)],
        ] = Field(
            default=(7, 23, 46),
            description="Most void cells in the 3x3, 5x5 and 7x7 windows around a void cell, "
            "itself and cells outside the image included, for it to be filled.",
        )
        colouring: Colouring = Field(
            default="topmost",
            description="Colour of a cell: of its topmost point; of the point nearest its centre "
            "on the topmost surface; gaussian mean of that surface by distance to the centre; "
            "median of its n_top highest points.",
        )
        layer_m: float = Field(
            default=0.02,
            gt=0,
            description="Points so far below the topmost one lie on its surface (not with "
            "topmost).",
        )
        n_top: int = Field(
            default=5, ge=1, le=50, description="Points that the median takes at most."
        )
        inpaint: Inpainting = Field(
            default="between",
            description="How gaps are filled: between the painted cells about them, by where their "
            "points lie; telea and navier-stokes of OpenCV, the mean of all eight ways in which "
            "the raster may be turned and mirrored; none.",
        )
        inpaint_radius_px: float = Field(
            default=3.0,
            gt=0,
            le=100,
            description="Reach from which a gap takes its colour; with between, one without a "
            "painted cell so near stays void.",
        )

    class In(Ports):
        """Walls, whose frames and buffers are used, and the coloured cloud."""

        walls: Walls
        cloud: PointCloud

    class Out(Ports):
        """One layer per wall."""

        layers: Layers

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Project the cloud onto each wall, then fill its gaps."""
        inputs.cloud.require_points(3)
        colours = _colours(inputs.cloud, ctx)
        rule = ColourRule(
            colouring=params.colouring,
            layer_m=params.layer_m,
            n_top=params.n_top,
            threads=ctx.cores,
        )
        layers: list[Layer] = []
        seconds = np.zeros(2)
        best_preview: tuple[int, bytes] | None = None
        for k, wall in enumerate(inputs.walls.walls):
            ctx.progress(k / len(inputs.walls.walls), wall.name)
            started = ctx.clock_s()
            projection = _project(inputs.cloud, colours, inputs.walls.slab(k), rule)
            projected = ctx.clock_s()
            layers.append(_filled(projection, wall, k, params, threads=ctx.cores))
            seconds += (projected - started, ctx.clock_s() - projected)
            n_filled = _n_filled(layers[-1])
            if best_preview is None or n_filled > best_preview[0]:
                best_preview = (n_filled, filling_preview(projection.rgb, layers[-1]))
        _require_paint(layers)
        _report(ctx, layers, seconds)
        if best_preview is not None:
            ctx.figure("filling", best_preview[1], "Before and after filling; magenta is void.")
        names = tuple(wall.name for wall in inputs.walls.walls)
        places = tuple(wall.plane_index for wall in inputs.walls.walls)
        return self.Out(layers=Layers(layers=tuple(layers), names=names, plane_indices=places))


def _colours(cloud: PointCloud, ctx: StepContext) -> NDArray[np.uint8]:
    """Colours (n, 3) of the points, or their intensity as grey (n, 1)."""
    if cloud.rgb is not None:
        return np.asarray(cloud.rgb)
    if cloud.intensity is None:
        raise MethodError(
            "the cloud has neither colours nor intensity, so no orthoimage can be painted from it: "
            "give a coloured scan, or paint the walls from photos"
        )
    ctx.warn("the cloud has no colours: its intensity is painted as grey")
    grey: NDArray[np.uint8] = np.rint(255.0 * np.clip(cloud.intensity, 0, 1)).astype(np.uint8)
    return grey[:, np.newaxis]


def _project(
    cloud: PointCloud, colours: NDArray[np.uint8], slab: Slab, rule: ColourRule
) -> _Projection:
    found = colours_of(cloud, colours, slab, rule)
    shape = slab.frame.shape
    return _Projection(
        rgb=found.rgb.reshape(*shape, 3),
        is_void=~found.has_point.reshape(shape),
        distance_cells=found.distance_cells.reshape(shape),
        painted=Painted(places=found.places, depth_m=found.depth_m, layer_m=rule.layer_m),
    )


def _filled(
    projection: _Projection,
    wall: Wall,
    index: int,
    params: PointcloudDirect.Params,
    *,
    threads: int,
) -> Layer:
    is_void = projection.is_void
    rgb, is_filled = projection.rgb.copy(), np.zeros_like(is_void)
    if params.inpaint != "none" and not is_void.all():
        is_filled = fillable_gaps(is_void, params.void_limits)
    if params.inpaint == "between":
        is_filled = painted_between(
            np.flatnonzero(is_filled),
            rgb,
            projection.painted,
            reach_cells=params.inpaint_radius_px,
            threads=threads,
        )
    elif params.inpaint != "none":
        rgb = inpainted(
            projection.rgb,
            is_void,
            is_filled,
            method=params.inpaint,
            radius_px=params.inpaint_radius_px,
        )
    shown = ~is_void | is_filled
    # 1 at the centre of the cell, 0.5 in its corner: how well the point stands for the cell. A
    # filled cell is worth less than any painted one.
    quality = np.where(is_void, np.float32(0.0), 1.0 - projection.distance_cells / np.sqrt(2.0))
    quality[is_filled] = 0.25
    return Layer(
        frame=wall.frame,
        wall=index,
        source="cloud",
        rgb=rgb,
        mask=np.where(shown, LayerMask.PAINTED, LayerMask.NO_SURFACE).astype(np.uint8),
        quality=quality.astype(np.float32),
        filled=is_filled.astype(np.uint8),
    )


def _n_filled(layer: Layer) -> int:
    return 0 if layer.filled is None else int(np.count_nonzero(layer.filled))


def _require_paint(layers: list[Layer]) -> None:
    if not any((layer.mask == LayerMask.PAINTED).any() for layer in layers):
        raise MethodError(
            "no point of the cloud lies within the buffer of a wall: the walls were not made from "
            "this cloud, or wall.buffer_m is too small"
        )


def _report(ctx: StepContext, layers: list[Layer], seconds: NDArray[np.float64]) -> None:
    n_cells = sum(layer.mask.size for layer in layers)
    n_shown = sum(int(np.count_nonzero(layer.mask == LayerMask.PAINTED)) for layer in layers)
    n_filled = sum(_n_filled(layer) for layer in layers)
    ctx.metric("projection_s", seconds[0], "s")
    ctx.metric("filling_s", seconds[1], "s")
    ctx.metric("painted_share", (n_shown - n_filled) / n_cells, "1")
    ctx.metric("filled_share", n_filled / n_cells, "1")
    ctx.metric("void_share", 1.0 - n_shown / n_cells, "1")
