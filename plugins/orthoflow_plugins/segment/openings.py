"""`segment.openings`: outlines of the windows, doors and niches of walls."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.errors import MethodError
from orthoflow.files.images import encode_webp
from orthoflow.geometry.frames import signed_area
from orthoflow.geometry.levels import eight_bits
from orthoflow.products import (
    Opening,
    OpeningKind,
    Openings,
    Orthoimages,
    OutlineSource,
    PointCloud,
    Wall,
    Walls,
    is_painted,
)
from orthoflow.sdk import (
    Determinism,
    DiagnosticSpec,
    Method,
    MethodParams,
    MetricSpec,
    Ports,
    StepContext,
)
from orthoflow.untrusted_text import first_few
from orthoflow_plugins.segment.areas import Area, Relief, open_areas, relief_of, sight_lines
from orthoflow_plugins.segment.outlines import Outline, moved_to_edges, outline_of

# Planes whose tilt from the vertical exceeds this angle are floors, ceilings and slopes.
_UPRIGHT: Final = math.sin(math.radians(30.0))
# A surface farther behind the plane than this is not the face of the same wall.
_FACE_FARTHEST_M: Final = 0.3
# An empty area must fill at least this share of its bounding rectangle. Round windows fill a larger
# share, and scan shadows a smaller one.
_FILLED_LEAST: Final = 0.7
# If the wall was measured along less than this share of an outline, the area is not an opening, but
# at the border of the scan.
_SEEN_LEAST_SHARE: Final = 0.5
_LONGEST_PX: Final = 1004
_SMALLEST_PX: Final = 500
_KIND_RGB: Final[Mapping[OpeningKind, tuple[int, int, int]]] = {
    "through": (30, 110, 230),
    "niche": (235, 120, 0),
    "no data": (200, 30, 160),
}
_CAPTION: Final = (
    "blue: rays passed through; orange: the back was measured; purple: no returns. Sides should "
    "follow visible edges; a side that crosses a surface, or an outline around nothing, is "
    "wrong."
)
_COUNTED: Final = {"through": "n_through", "niche": "n_niche", "no data": "n_no_data"}
NO_CLOUD: Final = DiagnosticSpec(
    code="openings-without-cloud",
    severity="warning",
    text="without the cloud, it is unknown which openings are only areas hidden by furniture, "
    "and which are open or have no returns",
    remedy="connect the cloud to {step}",
)
OTHER_SURFACE: Final = DiagnosticSpec(
    code="wall-behind-its-plane",
    severity="warning",
    text="{subject}: most of its surface is {behind_m:.2f} m behind its plane, so {what}",
    rank_by="behind_m",
)
OTHER_CELLS: Final = DiagnosticSpec(
    code="orthoimage-of-other-cells",
    severity="warning",
    text="{subject}: the cells of its orthoimage differ from those of its depth raster, so sides "
    "are measured from depth alone",
    remedy="use the same gsd_m for both",
)


CURVED: Final = DiagnosticSpec(
    code="openings-of-curved-walls",
    severity="warning",
    text="{subject}: openings are searched for on planes only, not on curved walls",
)


class SegmentOpenings(Method):
    """Find windows, doors and niches: areas of a wall that are behind its face or without points.

    Connected cells that are behind the face of a wall or empty form an opening if they contain a
    square of a given width and the face was measured along most of their border. The face is the
    plane of the wall, or the median depth of the cells behind it if these are more than half of the
    wall. If a cloud is given, the rays of the scanner are traced: an area through which some rays
    pass is `through`, and an area in front of which rays end is hidden and not reported. An empty
    area without rays is `no data` if it is at least about as compact as a round window; usually, it
    is glass or a mirror. An area whose back was measured is a `niche`, and so are closed doors and
    windows that are set back.

    Sides are lines fitted to the borders of the cells. The standard deviation of a side is computed
    from the cell size, the point spacing and the scatter of the border. If orthoimages from photos
    are given, a long side is moved to the corresponding edge in the orthoimage, provided that this
    edge is unambiguous and more accurate than the scan.
    """

    id: ClassVar[str] = "segment.openings"
    determinism: ClassVar[Determinism] = "exact"
    metrics: ClassVar[tuple[MetricSpec, ...]] = (
        MetricSpec("n_openings", label="openings found"),
        MetricSpec("n_through", label="openings with points behind them"),
        MetricSpec("n_niche", label="openings with a measured back"),
        MetricSpec("n_no_data", label="openings without returns"),
        MetricSpec("openings_area_m2", label="area of the openings"),
        MetricSpec("openings_share", label="share of the walls that is open"),
        MetricSpec("side_sigma_mm", label="predicted standard deviation of a side, median"),
        MetricSpec("image_side_share", label="share of sides located in the orthoimage"),
        MetricSpec("n_unbounded", label="open areas rejected because of their border or shape"),
    )
    citations: ClassVar[tuple[str, ...]] = (
        "Pu and Vosselman 2009, doi:10.1016/j.isprsjprs.2009.04.001 (holes of walls as windows)",
        "Tuttas and Stilla 2011, Window detection in sparse point clouds (PIA11)",
    )

    class Params(MethodParams):
        """Criteria for openings."""

        behind_m: float = Field(
            default=0.05,
            gt=0.0,
            le=5.0,
            description="Cells at least this far behind the wall's face do not belong to it.",
        )
        width_least_m: float = Field(
            default=0.25,
            gt=0.0,
            le=100.0,
            description="Side of a square that must fit into each opening.",
        )
        area_least_m2: float = Field(
            default=0.1, gt=0.0, le=10_000.0, description="Smallest area of an opening."
        )
        level: bool = Field(
            default=False, description="Also search for openings in floors, ceilings and slopes."
        )

    class In(Ports):
        """Walls; optionally, a cloud to detect hidden areas, and orthoimages to refine sides."""

        walls: Walls
        cloud: PointCloud | None = None
        orthoimages: Orthoimages | None = None

    class Out(Ports):
        """The openings found."""

        openings: Openings

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Find the openings of each wall."""
        walls = inputs.walls
        curved = [wall.name for wall in walls.walls if wall.frame.bend is not None]
        if curved:
            ctx.report(CURVED, subject=first_few(curved))
        chosen = [
            place
            for place, wall in enumerate(walls.walls)
            if wall.frame.bend is None
            and (params.level or abs(float(wall.frame.normal_world @ walls.up)) < _UPRIGHT)
        ]
        if not chosen:
            raise MethodError(
                f"none of the {len(walls.walls)} walls is a vertical plane; set level: true to "
                "search floors and ceilings, too (segment.openings)"
            )
        if inputs.cloud is not None:
            inputs.cloud.require_points(2)
        else:
            ctx.report(NO_CLOUD)
        found: list[tuple[Wall, list[Opening], int]] = []
        for count, place in enumerate(chosen):
            ctx.progress(count / len(chosen), walls.walls[place].name)
            found.append((walls.walls[place], *_found_on(inputs, place, params, ctx)))
        openings = tuple(opening for _, of_wall, _ in found for opening in of_wall)
        _report(openings, found, ctx)
        crs = {wall.frame.map_crs for wall in walls.walls if wall.frame.map_crs is not None}
        return self.Out(
            openings=Openings(
                openings=openings,
                walls=tuple(wall.plane_index for wall, _, _ in found),
                map_crs=crs.pop() if len(crs) == 1 else None,
            )
        )


def _found_on(
    inputs: SegmentOpenings.In, place: int, params: SegmentOpenings.Params, ctx: StepContext
) -> tuple[list[Opening], int]:
    """Return the openings of a wall, and the number of areas rejected for their border or shape."""
    wall, slab = inputs.walls.walls[place], inputs.walls.slab(place)
    lines = None if inputs.cloud is None else sight_lines(inputs.cloud, slab)
    relief = relief_of(wall, lines, params.behind_m)
    if relief.face_m:
        is_other = relief.face_m < -_FACE_FARTHEST_M
        what = "it is another surface, with no openings" if is_other else "openings begin there"
        ctx.report(OTHER_SURFACE, subject=wall.name, behind_m=-relief.face_m, what=what)
        if is_other:
            return [], 0
    grey = _grey(inputs.orthoimages, wall, relief, ctx)
    spacing_m = replace(inputs.walls, walls=(wall,), buffers_m=(), included=()).spacing_m()
    openings: list[Opening] = []
    n_unbounded = 0
    for area in open_areas(relief, params.width_least_m, params.area_least_m2):
        outline = outline_of(area, relief, spacing_m)
        if outline is None or outline.seen_of_all < _SEEN_LEAST_SHARE:
            n_unbounded += 1
            continue
        by_image = np.zeros(len(outline.corners), dtype=np.bool_)
        if grey is not None:
            outline, by_image = moved_to_edges(outline, grey)
        opening = _opening(wall, relief, area, outline, by_image)
        if opening.kind == "no data" and opening.area_m2 < _FILLED_LEAST * (
            opening.width_m * opening.height_m
        ):
            n_unbounded += 1
            continue
        openings.append(opening)
    openings.sort(key=lambda opening: float(opening.outline_m[:, 0].min()))
    if openings:
        frame, step = wall.frame, relief.step
        # Draw over the orthoimage or, if there is none, over the intensity.
        shown = np.where(relief.is_face, np.float32(0.8), np.float32(0.2))
        if grey is not None:
            shown = grey / 255.0
        elif wall.intensity is not None:
            shown = wall.intensity[::step, ::step]
        drawn = [(each.kind, frame.wall_from_raster(each.outline_m) / step) for each in openings]
        ctx.figure(
            f"wall_{wall.plane_index}_openings",
            outline_map(np.asarray(shown, dtype=np.float32), drawn),
            f"{wall.name}: openings, from left to right; {_CAPTION}",
        )
    return openings, n_unbounded


def _opening(
    wall: Wall, relief: Relief, area: Area, outline: Outline, by_image: NDArray[np.bool_]
) -> Opening:
    frame = wall.frame
    # Convert coordinates in the reduced grid (every nth cell, beginning with the first) to those in
    # the full grid.
    cells = np.clip(relief.step * (outline.corners - 0.5) + 0.5, 0.0, [frame.width, frame.height])
    places = frame.raster_from_wall(cells)
    spans_m = frame.gsd_m * (cells.max(axis=0) - cells.min(axis=0))
    source = np.where(by_image, OutlineSource.IMAGE, OutlineSource.DEPTH)
    return Opening(
        wall=wall.plane_index,
        wall_name=wall.name,
        kind=area.kind,
        outline_m=places,
        outline_world=frame.world_from_wall(cells),
        side_sigma_m=np.where(outline.is_seen, relief.gsd_m * outline.sigma, np.nan),
        side_source=np.where(outline.is_seen, source, OutlineSource.UNSEEN).astype(np.uint8),
        depth_m=area.depth_m,
        area_m2=abs(signed_area(places - places[0])),
        width_m=float(spans_m[0]),
        height_m=float(spans_m[1]),
        sill_m=frame.gsd_m * float(frame.height - cells[:, 1].max()),
        seen_share=outline.seen_of_all,
        crs=frame.crs,
    )


def _grey(
    images: Orthoimages | None, wall: Wall, relief: Relief, ctx: StepContext
) -> NDArray[np.float32] | None:
    """Return grey values (rows, cols), 0..255, of a wall's orthoimage in the relief's cells.

    Cells without colour are NaN. The result is None if there is no suitable orthoimage.
    """
    known = () if images is None else images.images
    image = next((each for each in known if each.number == wall.plane_index), None)
    # Edges in an orthoimage coloured from the cloud are no more accurate than the borders of the
    # cells.
    if image is None or set(image.sources) <= {"cloud"}:
        return None
    if not image.frame.has_cells_of(wall.frame):
        ctx.report(OTHER_CELLS, subject=wall.name)
        return None
    step = relief.step
    grey = eight_bits(image.rgb[::step, ::step]).mean(axis=2, dtype=np.float32)
    grey[~is_painted(image.mask[::step, ::step])] = np.nan
    return np.asarray(grey, dtype=np.float32)


def _report(
    openings: tuple[Opening, ...], found: list[tuple[Wall, list[Opening], int]], ctx: StepContext
) -> None:
    ctx.metric("n_openings", len(openings), "1")
    for kind, name in _COUNTED.items():
        ctx.metric(name, sum(opening.kind == kind for opening in openings), "1")
    area_m2 = sum(opening.area_m2 for opening in openings)
    frames = [wall.frame for wall, _, _ in found]
    whole_m2 = sum(frame.gsd_m**2 * frame.width * frame.height for frame in frames)
    ctx.metric("openings_area_m2", area_m2, "m2")
    ctx.metric("openings_share", area_m2 / whole_m2, "1")
    ctx.metric("n_unbounded", sum(n_unbounded for _, _, n_unbounded in found), "1")
    sigma_m = np.concatenate([np.empty(0), *(opening.side_sigma_m for opening in openings)])
    sources = np.concatenate(
        [np.empty(0, dtype=np.uint8), *(opening.side_source for opening in openings)]
    )
    is_seen = sources != OutlineSource.UNSEEN
    if is_seen.any():
        ctx.metric("side_sigma_mm", 1e3 * float(np.median(sigma_m[is_seen])), "mm")
        by_image = np.count_nonzero(sources == OutlineSource.IMAGE)
        ctx.metric("image_side_share", by_image / np.count_nonzero(is_seen), "1")


def outline_map(
    grey: NDArray[np.float32],
    outlines: Sequence[tuple[OpeningKind, NDArray[np.float64]]],
) -> bytes:
    """Draw numbered outlines over a pale image of the wall.

    Args:
        grey: (rows, cols) grey values 0..1, NaN where unknown.
        outlines: kind and corners of each outline; corners are (n, 2) = (column, row).
    """
    import cv2

    longest = max(grey.shape)
    scale = float(np.clip(1.0, _SMALLEST_PX / longest, _LONGEST_PX / longest))
    size = (max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale)))
    way = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_NEAREST
    pale = 70.0 + 180.0 * np.clip(np.nan_to_num(grey, nan=0.0), 0.0, 1.0)
    small = np.asarray(cv2.resize(pale.astype(np.uint8), size, interpolation=way), dtype=np.uint8)
    picture = np.repeat(small[:, :, None], 3, axis=2)
    for number, (kind, corners) in enumerate(outlines):
        places = np.rint(scale * corners).astype(np.int32)
        cv2.polylines(
            picture,
            [places],
            isClosed=True,
            color=_KIND_RGB[kind],
            thickness=2,
            lineType=cv2.LINE_AA,
        )
        left, top = (int(value) for value in places.min(axis=0))
        cv2.putText(
            picture,
            str(number),
            (left + 6, top + 22),
            cv2.FONT_HERSHEY_SIMPLEX,
            0.85,
            _KIND_RGB[kind],
            2,
            cv2.LINE_AA,
        )
    return encode_webp(picture)
