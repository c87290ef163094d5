"""`ortho.dsm-backward`: every cell of a wall takes its colour from the photos that see it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.geometry.bands import Allocate, holds_cells
from orthoflow.products import Layer, LayerMask
from orthoflow.sdk import Determinism, DiagnosticSpec, Method, MetricSpec, StepContext
from orthoflow_plugins.ortho.layers import (
    CellCounts,
    LayerStack,
    PaintedPhotos,
    count_shown,
)
from orthoflow_plugins.ortho.photos_on_walls import (
    LayersOfPhotos,
    OpenedPhoto,
    PhotosOnWalls,
    VisibilityParams,
    layers_of_photos,
    level_of_all,
    oriented_photos,
    pixels_of,
)

if TYPE_CHECKING:
    from orthoflow_plugins.ortho.painting import Painting
    from orthoflow_plugins.ortho.sampling import CellFootprint
    from orthoflow_plugins.ortho.surfaces import Surface
VISIBILITY_OFF: Final = DiagnosticSpec(
    code="visibility-not-tested",
    severity="warning",
    text="visibility none: cells that a photo cannot see are painted as well",
)


@dataclass(frozen=True, kw_only=True)
class PaintedTiles(PaintedPhotos):
    """Statistics of the photos on the tiles that they paint.

    Attributes:
        n_cells: (n,) int64 painted cells of each tile.
        photo_gsd_m: (n,) float64 size of a photo pixel, perpendicular to the ray.
        obliquity_deg: (n,) float64 between the ray and the wall's normal.
    """

    n_cells: NDArray[np.int64]
    photo_gsd_m: NDArray[np.float64]
    obliquity_deg: NDArray[np.float64]


class DsmBackward(Method):
    """Project each cell of a wall into the photos and take the colour there.

    A cell with a depth is a point in the world; the photo's camera with distortion gives its
    position in the photo. It is painted unless something hides it: the wall's own relief (the ray
    to the camera is followed over the raster), or points of the cloud in front of the slab of the
    raster (a depth buffer in the photo; single points are taken for outliers). Where the photo is
    finer than the wall, colours are averaged over the cell.

    The quality of a cell is the number of photo pixels that it covers: the cosine of incidence
    times the square of cell size over photo GSD, decreasing to 0 at the border of the photo.
    """

    id: ClassVar[str] = "ortho.dsm-backward"
    determinism: ClassVar[Determinism] = "exact"
    metrics: ClassVar[tuple[MetricSpec, ...]] = (
        MetricSpec("n_layers", label="photos projected onto walls"),
        MetricSpec("painted_share", label="cells painted"),
        MetricSpec("occluded_share", label="cells hidden from the photo"),
        MetricSpec("photo_gsd_mm", label="size of a photo's pixel on the wall"),
        MetricSpec("obliquity_deg", label="obliquity of the views"),
        MetricSpec("occluders_s", label="time of the occlusion test", better="lower"),
        MetricSpec("decoding_s", label="time of decoding photos", better="lower"),
        MetricSpec("painting_s", label="time of painting", better="lower"),
    )
    citations: ClassVar[tuple[str, ...]] = (
        "Markiewicz, Podlasiak, Zawieska 2015, doi:10.3390/rs71215869 (3.7, 4.4)",
    )

    class Params(VisibilityParams):
        """How colours are sampled, and when a cell counts as seen."""

        resampling: Literal["nearest", "bilinear", "cubic", "lanczos"] = Field(
            default="bilinear",
            description="Interpolation of colours; nearest paints the photo's pixels unchanged.",
        )
        antialias: bool = Field(
            default=True,
            description="Average over the cell where the photo is finer than the wall "
            "(not with nearest).",
        )
        visibility: Literal["full", "none"] = Field(
            default="full",
            description="What hides cells: relief and cloud (full), or nothing, for "
            "comparison and for flat "
            "walls without objects in "
            ""
            ""
            "front.",
        )
        erosion_cells: int = Field(
            default=1,
            ge=0,
            le=20,
            description=(
                "Cells this close to a hidden patch are not painted, because edges smear there."
            ),
        )

    In = PhotosOnWalls
    Out = LayersOfPhotos

    def run(self, inputs: PhotosOnWalls, params: Params, ctx: StepContext) -> LayersOfPhotos:
        """Project the photos onto all walls, and sort their layers."""
        painted = self._painted(inputs, params, ctx)
        out = layers_of_photos(inputs, painted, ctx)
        _report(ctx, count_shown(inputs.walls, out.layers), painted)
        return out

    def _painted(self, inputs: PhotosOnWalls, params: Params, ctx: StepContext) -> PaintedTiles:
        """Project photo by photo onto every wall it sees."""
        from orthoflow_plugins.ortho.occlusion import depth_buffer_of, occluders_of
        from orthoflow_plugins.ortho.surfaces import surfaces_of

        oriented = oriented_photos(inputs.walls, inputs.photos, inputs.cameras)
        level = level_of_all([photo for photo, _ in oriented], ctx)
        hides = params.visibility == "full"
        if not hides:
            ctx.report(VISIBILITY_OFF)
        surfaces = surfaces_of(inputs.walls, params, ctx, hides=hides)
        seconds: defaultdict[str, float] = defaultdict(float)
        started = ctx.clock_s()
        # For all photos, whichever are painted: which points are outliers depends on all cameras.
        viewers = [camera.viewing() for _, camera in oriented]
        occluders = occluders_of(inputs, viewers, params, ctx, method=self.id) if hides else None
        seconds["occluders_s"] += ctx.clock_s() - started
        stack = LayerStack(inputs.walls, ctx)
        footprints: list[CellFootprint] = []
        for nth, ((photo, camera), viewer) in enumerate(zip(oriented, viewers, strict=True)):
            ctx.progress(nth / len(oriented), photo.name)
            started = ctx.clock_s()
            pixels = pixels_of(photo, camera, level)
            decoded = ctx.clock_s()
            buffer = depth_buffer_of(occluders, viewer, photo)
            looked = ctx.clock_s()
            opened = OpenedPhoto(name=photo.name, pixels=pixels, viewer=viewer, buffer=buffer)
            footprints += _project(opened, surfaces, stack, params, threads=ctx.cores)
            seconds["decoding_s"] += decoded - started
            seconds["occluders_s"] += looked - decoded
            seconds["painting_s"] += ctx.clock_s() - looked
            # The next photo is decoded after this one is released.
            del pixels, buffer, opened
        return PaintedTiles(
            layers=tuple(stack.painted),
            reached=stack.reached,
            seconds=dict(seconds),
            n_cells=np.array([tile.n_cells for tile in footprints], dtype=np.int64),
            photo_gsd_m=np.array([tile.photo_gsd_m for tile in footprints], dtype=np.float64),
            obliquity_deg=np.array([tile.obliquity_deg for tile in footprints], dtype=np.float64),
        )


def _project(
    photo: OpenedPhoto,
    surfaces: Sequence[Surface],
    stack: LayerStack,
    params: DsmBackward.Params,
    *,
    threads: int,
) -> list[CellFootprint]:
    """Project a photo onto all walls; return statistics of the tiles that it paints."""
    footprints: list[CellFootprint] = []
    with stack.painting_from(photo.name):
        for index, surface in enumerate(surfaces):
            allocate = stack.allocator(index)
            painting = _painting(photo, surface, params, allocate, threads=threads)
            if painting is None:
                continue
            footprints += [painting.footprints[key] for key in sorted(painting.footprints)]
            layer = _layer(painting, photo.name, surface, index)
            if layer is None:
                stack.note_reached(index, painting.mask)
            else:
                stack.add(layer)
    return footprints


def _painting(
    photo: OpenedPhoto,
    surface: Surface,
    params: DsmBackward.Params,
    allocate: Allocate,
    *,
    threads: int,
) -> Painting | None:
    """Project a photo onto one wall; None if its camera is behind it."""
    from orthoflow_plugins.ortho.painting import PaintRule, paint
    from orthoflow_plugins.ortho.surfaces import is_before, view_of

    # The nearest pixel changes within a hundredth of a pixel.
    is_exact = params.resampling == "nearest"
    view = view_of(photo.viewer, surface, params, is_exact=is_exact)
    if not is_before(view, surface):
        return None
    rule = PaintRule(
        resampling=params.resampling,
        is_filtered=params.antialias,
        erosion_cells=params.erosion_cells if params.visibility == "full" else 0,
    )
    return paint(
        photo.pixels, view, surface, photo.buffer, rule, allocate=allocate, threads=threads
    )


def _layer(painting: Painting, source: str, surface: Surface, wall: int) -> Layer | None:
    """Return the layer of a painting; None if nothing was painted."""
    is_bare = not holds_cells(painting.mask, LayerMask.PAINTED)
    if is_bare or painting.rgb is None or painting.quality is None:
        return None
    return Layer(
        frame=surface.frame,
        wall=wall,
        source=source,
        rgb=painting.rgb,
        mask=painting.mask,
        quality=painting.quality,
    )


def _report(ctx: StepContext, counts: CellCounts, painted: PaintedTiles) -> None:
    ctx.metric("n_layers", len(painted.layers), "1")
    ctx.metric("painted_share", counts.n_painted / max(1, counts.n_surface), "1")
    ctx.metric("occluded_share", counts.n_hidden / max(1, counts.n_surface), "1")
    n_cells = painted.n_cells
    gsds = painted.photo_gsd_m
    angles = painted.obliquity_deg
    ctx.metric("photo_gsd_mm", 1e3 * _weighted_median(gsds, n_cells), "mm")
    ctx.metric("obliquity_deg", _weighted_median(angles, n_cells), "deg")
    for name in ("occluders_s", "decoding_s", "painting_s"):
        ctx.metric(name, painted.seconds.get(name, 0.0), "s")


def _weighted_median(values: NDArray[np.float64], weights: NDArray[np.int64]) -> float:
    """Return the value below which half of the weight lies."""
    order = np.argsort(values, kind="stable")
    totals = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(totals, totals[-1] / 2.0)])
