"""`raster.grid`: the scanned surface of each wall as a regular raster (markiewicz2015, 3.4)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache, partial
from typing import ClassVar, Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry import WallFrame
from orthoflow.geometry.slabs import Slab
from orthoflow.products import IntensitySource, Planes, PointCloud, Surfaces, Wall, Walls
from orthoflow.sdk import DiagnosticSpec, Method, MetricSpec, Ports, StepContext
from orthoflow.sdk.methods import Determinism
from orthoflow_plugins.raster.balancing import balanced
from orthoflow_plugins.raster.curved import CurvedWalls, blank_beside, flattened
from orthoflow_plugins.raster.emptiness import Emptiness, Sight, emptiness_of
from orthoflow_plugins.raster.extents import (
    Extent,
    Reach,
    SampledPoints,
    extent_of,
    free_before_m,
    sampled,
)
from orthoflow_plugins.raster.frames import (
    blank_outside,
    cropped,
    mapped,
)
from orthoflow_plugins.raster.parameters import RasterParams
from orthoflow_plugins.raster.reporting import (
    is_noisy,
    report,
    report_empty,
    report_tones,
    warn,
    warn_of_covered,
)
from orthoflow_plugins.raster.selection import (
    chosen_walls,
    covered_planes,
    frame_of,
    nearest_wall,
)
from orthoflow_plugins.raster.walls import rastered_wall, require_memory

ExtentOf = Callable[[int], Extent]

# A point of `near` that is farther from the wall than this is probably wrong.
_FAR_M: Final = 1.0
# A missing strip that is wider than this would be noticed in a drawing.
_CUT_WORTH_WORDS_M: Final = 0.05
OBLIQUE: Final = DiagnosticSpec(
    code="wall-beside-an-oblique-surface",
    severity="warning",
    text="{subject}: at its {side}, the raster ends at the nearest point of the adjoining "
    "surface, which is oblique: up to {cut_m:.2f} m of the plane are omitted",
    remedy="set {step}.margin_m to include them",
    rank_by="cut_m",
)
NEAR_FAR: Final = DiagnosticSpec(
    code="near-is-far",
    severity="warning",
    text="near: the wall nearest to {place}, {subject}, is {apart_m:.2f} m away",
    remedy="check the point, the unit of its coordinates, and the planes",
    rank_by="apart_m",
)
CROP_OF_SEVERAL: Final = DiagnosticSpec(
    code="crop-of-several-walls",
    severity="warning",
    text="crop is applied to each of {n_walls} walls",
    remedy="select one wall with {step}.near or {step}.ranks",
)


class RasterGrid(Method):
    """Rasterise the cloud on each wall: depth, spread, number of points, intensity and colour.

    Narrow gaps are interpolated. If the rows and columns of a scan are known, they are interpolated
    between neighbouring points of the scan, and otherwise from the measured cells around the gap,
    at the positions of their points. Wider gaps, such as windows, remain void. In cells with up to
    16 points, mean intensities and colours are extrapolated along their gradients from the mean
    position of the points to the centre of the cell.

    Cylinders and cones are unrolled, and depths are distances from the surface. One axis of a
    cylinder's raster is the length of the arc. A cone becomes a sector of an annulus around its
    apex, beside which cells are void. Where two vaults cross, each raster ends at the groins.
    """

    id: ClassVar[str] = "raster.grid"
    determinism: ClassVar[Determinism] = "exact"
    result_version: ClassVar[int] = 7
    metrics: ClassVar[tuple[MetricSpec, ...]] = (
        MetricSpec("n_walls", label="walls"),
        MetricSpec("omega_deg", label="direction of the first wall's normal (omega)"),
        MetricSpec("phi_deg", label="inclination of the first wall's normal (phi)"),
        MetricSpec("area_m2", label="area of the first wall's raster"),
        MetricSpec("gsd_mm", label="cell size"),
        MetricSpec("n_points_inside", label="points used for the walls"),
        MetricSpec("points_per_cell", label="points per cell"),
        MetricSpec("depth_noise_mm", label="depth noise"),
        MetricSpec("scan_step_mm", label="point spacing on the first wall"),
        MetricSpec(
            "sigma_median_mm", label="spread of the depths in a cell, median", better="lower"
        ),
        MetricSpec("empty_share", label="cells without a depth"),
        MetricSpec("empty_*_share", label="cells without a depth, by cause"),
        MetricSpec("measured_share", label="cells with a measured depth"),
        MetricSpec("recovered_share", label="cells interpolated between measured ones"),
        MetricSpec(
            "intensity_cosine_power", label="intensity model: exponent of the cosine of incidence"
        ),
        MetricSpec("intensity_range_power", label="intensity model: exponent of the range"),
        MetricSpec(
            "intensity_scale_spread", label="intensity model: spread of the scales between stations"
        ),
    )
    citations: ClassVar[tuple[str, ...]] = (
        "Markiewicz, Podlasiak, Zawieska 2015, doi:10.3390/rs71215869 (3.4, 4.2)",
    )

    Params = RasterParams

    class In(Ports):
        """The cloud, and its planes, which may be included in its surfaces."""

        cloud: PointCloud
        planes: Planes | None = None
        surfaces: Surfaces | None = None

    class Out(Ports):
        """One raster per wall."""

        walls: Walls

    def run(self, inputs: In, params: RasterParams, ctx: StepContext) -> Out:
        """Rasterise the selected planes."""
        from orthoflow.geometry.cloud_quality import scan_step_m

        cloud, planes = inputs.cloud, _planes_of(inputs)
        cloud.require_points(3)
        points = sampled(cloud)
        curved = CurvedWalls(inputs.surfaces, planes, params)
        extent_of = _extents(points, planes, curved, cloud.stations, params, ctx)
        frames, covered = _frames(planes, curved, params, extent_of, ctx)
        slabs = {
            index: Slab(
                frame=frame,
                front_m=extent_of(index).front_m,
                behind_m=extent_of(index).behind_m,
                rms_m=(
                    curved.surfaces[index].rms_m
                    if index in curved.surfaces
                    else float(planes.rms_m[index])
                ),
            )
            for index, frame in frames.items()
        }
        require_memory(list(frames.values()), is_tin=params.surface == "tin")
        walls: list[Wall] = []
        rules: list[str] = []
        empty: list[Emptiness] = []
        sight = Sight(points=points, stations=cloud.stations)
        source: IntensitySource = "none" if cloud.rgb is None else "luminance"
        if cloud.intensity is not None:
            source = "laser"
        if params.balance_intensity:
            cloud = balanced(cloud, list(slabs.values()), ctx)
        for k, (index, slab) in enumerate(slabs.items()):
            name, is_curved = slab.frame.name, slab.frame.bend is not None
            ctx.progress(k / len(slabs), name)
            make = partial(
                rastered_wall,
                *flattened(cloud, slab),
                index=index,
                name=name,
                allocate=partial(_allocated, ctx, k),
                threads=ctx.cores,
            )
            rule = params.surface or ("denoised" if is_curved else "median")
            wall = make(params.model_copy(update={"surface": rule}))
            if params.surface is None and not is_curved and is_noisy(ctx, wall):
                rule = "denoised"
                wall = make(params.model_copy(update={"surface": rule}))
            rules.append(rule)
            wall = replace(wall, frame=slab.frame)
            if is_curved:
                blank_beside(wall)
            free_m = math.inf if is_curved else free_before_m(planes, index, cloud.stations)
            empty.append(emptiness_of(wall, slab, sight, free_m=free_m, threads=ctx.cores))
            if is_curved:
                curved.blank_beyond_groins(wall, index)
            if params.crop is not None and np.ndim(params.crop) == 2:
                blank_outside(wall, params.crop)
            walls.append(wall)
        if not any(wall.count.any() for wall in walls):
            first = next(iter(slabs.values()))
            raise MethodError(
                f"no point of the cloud is inside the rectangle and the buffer of a wall "
                f"({first.front_m:g} m in front, {first.behind_m:g} m behind): the planes do not "
                "belong to this cloud, or buffer_m is too small"
            )
        steps_m = [scan_step_m(wall.count, gsd_m=wall.frame.gsd_m) for wall in walls]
        warn(ctx, walls, steps_m, source)
        report(ctx, walls, steps_m[0], planes.up)
        report_empty(ctx, walls, empty)
        report_tones(ctx, walls, cloud)
        return self.Out(
            walls=Walls(
                walls=tuple(walls),
                up=planes.up.copy(),
                intensity_source=source,
                buffer_front_m=max(slab.front_m for slab in slabs.values()),
                buffer_behind_m=max(slab.behind_m for slab in slabs.values()),
                buffers_m=tuple((slab.front_m, slab.behind_m) for slab in slabs.values()),
                percentiles=params.percentiles,
                included=tuple(
                    tuple(index for index, by in covered.items() if by == wall.plane_index)
                    for wall in walls
                ),
                details={"surface": [*rules], "scan_step_m": [*steps_m]},
            )
        )


def _planes_of(inputs: RasterGrid.In) -> Planes:
    """Return the planes, given either separately or with the surfaces.

    Raises:
        MethodError: there are none, or they are given twice.
    """
    included = None if inputs.surfaces is None else inputs.surfaces.planes
    if inputs.planes is not None and included is not None:
        raise MethodError(
            "the planes are given twice, in planes and in surfaces: remove planes from the inputs"
        )
    planes = included if inputs.planes is None else inputs.planes
    if planes is None:
        raise MethodError(
            "planes are needed: connect planes to the output of a plane.* step, or surfaces to a "
            "chain of steps that begins with surface.planes"
        )
    return planes


def _extents(
    points: SampledPoints,
    planes: Planes,
    curved: CurvedWalls,
    stations: NDArray[np.float64] | None,
    params: RasterParams,
    ctx: StepContext,
) -> ExtentOf:
    """Return a function that determines the extent of a wall when first called with its plane."""
    reach = Reach(
        front_m=params.buffer_m if params.buffer_front_m is None else params.buffer_front_m,
        behind_m=params.buffer_m if params.buffer_behind_m is None else params.buffer_behind_m,
        least_m=3.0 * planes.tolerance_m,
    )

    @cache
    def extent(index: int) -> Extent:
        if index in curved.frames:
            return curved.extent(index, points, reach, threads=ctx.cores)
        if params.rectangle == "points" and reach.is_set:
            return reach.as_set
        found = extent_of(points, planes, index, reach, stations=stations, threads=ctx.cores)
        return (
            found if params.rectangle == "room" else replace(found, growth_m=(0.0,) * 4, cut_m={})
        )

    return extent


def _frames(
    planes: Planes,
    curved: CurvedWalls,
    params: RasterParams,
    extent_of: ExtentOf,
    ctx: StepContext,
) -> tuple[dict[int, WallFrame], dict[int, int]]:
    """Return the frames of selected planes and surfaces by index, and the planes that they cover.

    Raises:
        MethodError: a selected plane does not exist, or no wall contains the requested part.
    """

    def buffer_m(index: int) -> tuple[float, float]:
        return extent_of(index).front_m, extent_of(index).behind_m

    every = chosen_walls(planes, params, buffer_m, curved.frames)
    chosen = [index for index in every if index < len(planes)]
    curved_frames = {index: curved.frames[index] for index in every if index >= len(planes)}
    covered = covered_planes(planes, params, buffer_m, chosen)
    if params.skip_covered and not (params.ranks or params.near):
        for index in curved_frames:
            within = [k for k in chosen if curved.covers(k, buffer_m(index), index)]
            covered |= dict.fromkeys(within, index)
            chosen = [k for k in chosen if k not in within]
    names = dict(enumerate(planes.names)) | {k: one.name for k, one in curved_frames.items()}
    warn_of_covered(ctx, names, covered)
    frames = {
        index: frame_of(planes, index, gsd_m=params.gsd_m, margin_m=params.margin_m)
        for index in chosen
    }
    if params.crs is not None and frames:
        reach_m = max(max(buffer_m(index)) for index in frames)
        frames = mapped(frames, planes, params.crs, reach_m=reach_m, ctx=ctx)
    frames = {index: extent_of(index).widened(frame) for index, frame in frames.items()}
    frames |= curved_frames
    report_doubts(frames, planes, params, extent_of, ctx)
    if params.crop is None:
        return frames, covered
    parts = {index: cropped(frame, params.crop) for index, frame in frames.items()}
    crops = {index: part for index, part in parts.items() if part is not None}
    if not crops:
        frame = next(iter(frames.values()))
        raise MethodError(
            f"crop {list(params.crop)} is outside every wall: the raster of "
            f"{frame.name} is {frame.width * frame.gsd_m:.3f} m wide and "
            f"{frame.height * frame.gsd_m:.3f} m high"
        )
    if len(frames) > 1:
        ctx.report(CROP_OF_SEVERAL, n_walls=len(frames))
    return crops, covered


def report_doubts(
    frames: Mapping[int, WallFrame],
    planes: Planes,
    params: RasterParams,
    extent_of: ExtentOf,
    ctx: StepContext,
) -> None:
    """Report walls that oblique planes cut off, and points of `near` far from all walls."""
    for index, frame in frames.items():
        for side, askew_m in extent_of(index).cut_m.items():
            cut_m = askew_m - params.margin_m
            if cut_m >= _CUT_WORTH_WORDS_M:
                ctx.report(OBLIQUE, subject=frame.name, side=side, cut_m=cut_m)
    for place in params.near:
        index, apart_m = nearest_wall(planes, list(frames), frames, np.array(place))
        if apart_m > _FAR_M:
            name = frames[index].name
            ctx.report(NEAR_FAR, subject=name, place=str(list(place)), apart_m=apart_m)


def _allocated(
    ctx: StepContext, wall: int, name: str, shape: tuple[int, ...], dtype: DTypeLike
) -> NDArray[np.generic]:
    return ctx.allocate("walls", f"{wall}.{name}", shape, dtype).view(np.ndarray)
