"""`ortho.pointcloud-direct`: colour each cell of a wall from the points of its topmost surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry.bands import (
    Allocate,
    Band,
    bands_with_reach,
    count_cells,
    holds_cells,
)
from orthoflow.geometry.levels import lit
from orthoflow.geometry.slabs import Slab
from orthoflow.products import Layer, LayerMask, Layers, PointCloud, Walls
from orthoflow.sdk import DiagnosticSpec, Method, MetricSpec, Ports, StepContext
from orthoflow.sdk.methods import Determinism
from orthoflow_plugins.ortho.filling import (
    fillable_gaps,
    inpainted,
    painted_between,
    reach_rows,
)
from orthoflow_plugins.ortho.parameters import LAYER_M, DirectParams

if TYPE_CHECKING:
    from orthoflow_plugins.ortho.point_colours import CellColours, Painters

# Larger walls are processed in bands of this many cells; a band needs about 600 MB.
BAND_CELLS: Final = 1 << 22
_POINTS_AT_ONCE: Final = 1 << 22
# Pure black points are reported if their share is larger, since real surfaces have hardly any.
_BLACK_WORTH_WORDS: Final = 0.001
# Points darker than this in all channels are almost black.
_ALMOST_BLACK_GREY: Final = 10
# Scans are not balanced if their colours differ by less, because a colour cast of 3 % is hardly
# visible.
_CAST_LEAST: Final = 0.03
# If the share of pure black points is larger, black is considered a real colour.
_MOST_SPECKS: Final = 0.1

SPECKS: Final = DiagnosticSpec(
    code="black-points-left-out",
    severity="note",
    text="{n_points:,} points of {subject} ({share:.1%}) are pure black, which many files use for "
    "points without a colour: they are not used for colours",
    remedy="set {step}.skip_below_grey to 0 to use them, or to 10 to ignore almost black points, "
    "too",
)
SCANS_BALANCED: Final = DiagnosticSpec(
    code="scans-balanced",
    severity="note",
    text="{n} of {n_scans} scans differ in brightness or white balance from the others where they "
    "overlap, by up to {share:.0%}: their colours are balanced",
    remedy="set {step}.balance_scans to false to keep the original colours",
    rank_by="share",
)
NO_COLOUR: Final = DiagnosticSpec(
    code="cloud-without-colour",
    severity="warning",
    text="the cloud has no colours: its intensity is used as grey",
)
BLACK_POINTS: Final = DiagnosticSpec(
    code="points-black",
    severity="warning",
    text="{n_black} points of the cloud ({share:.1%}) are pure black, which many files use for "
    "points without a colour, and {n_almost} are almost black; all of them are used",
    remedy="if the orthoimage has black specks that do not belong to the wall, set "
    "{step}.skip_below_grey={grey} (1 for pure black only) to ignore the colours of these points",
    rank_by="share",
)


class PointcloudDirect(Method):
    """Colour each cell of a wall from its topmost point, and fill small gaps.

    The topmost point of a cell is the point nearest to the viewer within the buffer of the wall. Of
    points at the same depth, it is the one nearest to the cell centre, then the one with the lowest
    index. `colouring` offers other rules. A void cell is filled if there are few void cells around
    it; filled cells are marked as filled.
    """

    id: ClassVar[str] = "ortho.pointcloud-direct"
    determinism: ClassVar[Determinism] = "exact"
    metrics: ClassVar[tuple[MetricSpec, ...]] = (
        MetricSpec("painted_share", label="covered cells"),
        MetricSpec("filled_share", label="cells filled from neighbours"),
        MetricSpec("empty_share", label="cells without a colour"),
        MetricSpec("projection_s", label="time for the projection", better="lower"),
        MetricSpec("filling_s", label="time for filling gaps", better="lower"),
    )
    citations: ClassVar[tuple[str, ...]] = (
        (
            "Skarlatos, Kiparissi, Theodoridou 2012, Direct orthophoto generation from color "
            "point clouds of complex scenes (3)"
        ),
    )

    Params = DirectParams

    class In(Ports):
        """The coloured cloud, and the walls: their frames, buffers, and voids if curved."""

        walls: Walls
        cloud: PointCloud

    class Out(Ports):
        """One layer per wall."""

        layers: Layers

    def run(self, inputs: In, params: DirectParams, ctx: StepContext) -> Out:
        """Project the cloud onto each wall, then fill its gaps."""
        from orthoflow_plugins.ortho.point_colours import colours_of, on_plane

        inputs.cloud.require_points(3)
        painters = _painters(inputs.cloud, params, ctx)
        slabs = [inputs.walls.slab(k) for k in range(len(inputs.walls.walls))]
        if params.balance_scans and inputs.cloud.rgb is not None:
            painters = _balanced(painters, slabs, ctx)
        layers: list[Layer] = []
        seconds = np.zeros(2)
        n_filled = 0
        reach = reach_rows(params.inpaint, params.inpaint_radius_px)
        for k, wall in enumerate(inputs.walls.walls):
            ctx.progress(k / len(inputs.walls.walls), wall.name)
            shape = wall.frame.shape
            new = _arrays_of(ctx, k)
            filled = np.asarray(new("filled", shape, np.uint8), np.uint8)
            layer = Layer(
                frame=wall.frame,
                wall=k,
                source="cloud",
                rgb=np.asarray(new("rgb", (*shape, 3), np.uint8), np.uint8),
                mask=np.asarray(new("mask", shape, np.uint8), np.uint8),
                quality=np.asarray(new("quality", shape, np.float32), np.float32),
                filled=filled,
            )
            started = ctx.clock_s()
            own, slab = on_plane(painters, slabs[k], wall.mask)
            seconds[0] += ctx.clock_s() - started
            for band in bands_with_reach(shape, cells_most=BAND_CELLS, reach_rows=reach):
                started = ctx.clock_s()
                found = colours_of(own, slab.over(band.around), params, threads=ctx.cores)
                projected = ctx.clock_s()
                _fill(found, layer, band, params, threads=ctx.cores)
                seconds += (projected - started, ctx.clock_s() - projected)
                # Release this band before projecting the next one.
                del found
            layers.append(layer)
            n_filled += int(np.count_nonzero(filled))
        if not any(holds_cells(layer.mask, LayerMask.PAINTED) for layer in layers):
            raise MethodError(
                "no point of the cloud is within the buffer of a wall: the walls were made from "
                "another cloud, or wall.buffer_m is too small"
            )
        names = tuple(wall.name for wall in inputs.walls.walls)
        ctx.metric("projection_s", seconds[0], "s")
        ctx.metric("filling_s", seconds[1], "s")
        _report(ctx, layers, names, n_filled)
        places = tuple(wall.plane_index for wall in inputs.walls.walls)
        return self.Out(layers=Layers(layers=tuple(layers), names=names, plane_indices=places))


def _painters(cloud: PointCloud, params: DirectParams, ctx: StepContext) -> Painters:
    """Return the points with their colours, or with their intensity as grey."""
    from orthoflow_plugins.ortho.point_colours import Painters

    if cloud.rgb is not None:
        rgb = np.asarray(cloud.rgb)
        return Painters(cloud=cloud, values=rgb, is_left_out=_left_out(cloud, rgb, params, ctx))
    if cloud.intensity is None:
        raise MethodError(
            "the cloud has neither colours nor intensity, so no orthoimage can be made from it: "
            "use a coloured scan, or make the orthoimage from photos"
        )
    ctx.report(NO_COLOUR)
    n_points = len(cloud)
    grey = np.asarray(ctx.allocate("layers", "grey", (n_points, 1), np.uint8), np.uint8)
    is_left_out: NDArray[np.bool_] | None = None
    for first in range(0, n_points, _POINTS_AT_ONCE):
        part = slice(first, first + _POINTS_AT_ONCE)
        grey[part, 0] = np.rint(255.0 * np.clip(np.nan_to_num(cloud.intensity[part]), 0, 1))
        if (is_unknown := np.isnan(cloud.intensity[part])).any():
            if is_left_out is None:
                is_left_out = _mask(ctx, n_points)
            is_left_out[part] = is_unknown
    return Painters(cloud=cloud, values=grey, is_left_out=is_left_out)


def _balanced(painters: Painters, slabs: list[Slab], ctx: StepContext) -> Painters:
    from orthoflow_plugins.ortho.point_colours import scan_gains

    gains, scans = scan_gains(painters, slabs, threads=ctx.cores), painters.cloud.scan
    casts = np.expm1(np.abs(gains)).max(axis=1, initial=0.0)
    if scans is None or casts.max(initial=0.0) < _CAST_LEAST:
        return painters
    n_cast = int(np.count_nonzero(casts >= _CAST_LEAST))
    ctx.report(SCANS_BALANCED, n=n_cast, n_scans=len(casts), share=float(casts.max()))
    values = np.asarray(
        ctx.allocate("layers", "balanced", painters.values.shape, np.uint8), np.uint8
    )
    for first in range(0, len(values), _POINTS_AT_ONCE):
        part = slice(first, first + _POINTS_AT_ONCE)
        values[part] = lit(painters.values[part], gains[scans[part]].astype(np.float32))
    return replace(painters, values=values)


def _mask(ctx: StepContext, n_points: int) -> NDArray[np.bool_]:
    return np.asarray(ctx.allocate("layers", "left_out", (n_points,), np.bool_), np.bool_)


def _left_out(
    cloud: PointCloud, rgb: NDArray[np.uint8], params: DirectParams, ctx: StepContext
) -> NDArray[np.bool_] | None:
    """Return a mask (n,) of points that are too dark or without colour; None if there are none.

    These points contribute depths but no colours.
    """
    n_points, has_rgb = len(rgb), cloud.has_rgb
    counts = np.zeros(256, dtype=np.int64)
    parts = [slice(k, k + _POINTS_AT_ONCE) for k in range(0, n_points, _POINTS_AT_ONCE)]
    for part in parts:
        valid = slice(None) if has_rgb is None else np.asarray(has_rgb[part])
        counts += np.bincount(rgb[part].max(axis=1)[valid], minlength=256)
    n_black, n_almost = int(counts[0]), int(counts[1:_ALMOST_BLACK_GREY].sum())
    is_worth_words = n_black >= _BLACK_WORTH_WORDS * n_points
    are_specks = is_worth_words and n_almost <= n_black <= _MOST_SPECKS * n_points
    least = params.skip_below_grey
    if least is None:
        least = int(are_specks)
    is_dark = _mask(ctx, n_points) if least > 0 or has_rgb is not None else None
    if is_dark is not None:
        for part in parts:
            is_dark[part] = rgb[part].max(axis=1) < least
            if has_rgb is not None:
                is_dark[part] |= ~np.asarray(has_rgb[part])
    if least > 0 and params.skip_below_grey is None:
        ctx.report(SPECKS, subject="the cloud", n_points=n_black, share=n_black / n_points)
    elif least == 0 and is_worth_words:
        ctx.report(
            BLACK_POINTS,
            n_black=n_black,
            share=n_black / n_points,
            n_almost=n_almost,
            grey=_ALMOST_BLACK_GREY,
        )
    return is_dark


def _arrays_of(ctx: StepContext, wall: int) -> Allocate:
    return lambda name, shape, dtype: ctx.allocate("layers", f"{wall}.{name}", shape, dtype)


def _fill(
    found: CellColours,
    layer: Layer,
    band: Band,
    params: DirectParams,
    *,
    threads: int,
) -> None:
    from orthoflow.geometry.interpolation import Surroundings

    width = layer.frame.width
    is_void = ~found.has_point.reshape(-1, width)
    rgb, is_filled = found.rgb.reshape(-1, width, 3).copy(), np.zeros_like(is_void)
    if params.inpaint != "none" and not is_void.all():
        is_filled = fillable_gaps(is_void, params.void_limits)
    if params.inpaint == "between":
        is_filled = painted_between(
            np.flatnonzero(is_filled),
            rgb,
            Surroundings(found.places, width, LAYER_M),
            found.depth_m,
            reach_cells=params.inpaint_radius_px,
            threads=threads,
        )
    elif params.inpaint != "none":
        rgb = inpainted(
            rgb, is_void, is_filled, method=params.inpaint, radius_px=params.inpaint_radius_px
        )
    shown, inner = ~is_void | is_filled, band.inner
    # Quality decreases linearly from 1 for a point at the cell centre to 0.5 for a point in a
    # corner, and is lower for filled cells.
    distance_cells = found.distance_cells.reshape(-1, width)
    quality = np.where(is_void, np.float32(0.0), 1.0 - distance_cells / np.sqrt(2.0))
    quality[is_filled] = 0.25
    layer.rgb[band.rows] = rgb[inner]
    layer.mask[band.rows] = np.where(shown[inner], LayerMask.PAINTED, LayerMask.NO_SURFACE)
    layer.quality[band.rows] = quality[inner]
    if layer.filled is not None:
        layer.filled[band.rows] = is_filled[inner]


def _report(ctx: StepContext, layers: list[Layer], names: Sequence[str], n_filled: int) -> None:
    n_cells = sum(layer.mask.size for layer in layers)
    n_shown = [count_cells(layer.mask, LayerMask.PAINTED) for layer in layers]
    ctx.metric("painted_share", (sum(n_shown) - n_filled) / n_cells, "1")
    ctx.metric("filled_share", n_filled / n_cells, "1")
    ctx.metric("empty_share", 1.0 - sum(n_shown) / n_cells, "1")
    for layer, n_shown_here in zip(layers, n_shown, strict=True):
        n_void = layer.mask.size - n_shown_here
        if n_void:
            ctx.log(
                f"{names[layer.wall]}: {n_void / layer.mask.size:.1%} of its cells contain no "
                "point and are not part of a small gap; to fill larger gaps, increase void_limits "
                "and inpaint_radius_px (recover_gap_cells affects only depths)"
            )
