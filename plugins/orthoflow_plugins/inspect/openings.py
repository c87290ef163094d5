"""`inspect.openings`: compare outlines of windows, doors and niches with a simulated scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.errors import MethodError
from orthoflow.files.polygons import filled
from orthoflow.geometry import WallFrame
from orthoflow.geometry.scenes import Scene, SurfaceRole
from orthoflow.geometry.slabs import Slab
from orthoflow.products import Finding, Inspection, Opening, Openings, OutlineSource, Truth, Walls
from orthoflow.sdk import Determinism, Method, MethodParams, MetricSpec, Ports, StepContext
from orthoflow_plugins.inspect.findings import Number, findings_of, higher, lower, rms

if TYPE_CHECKING:
    from orthoflow.geometry.scene_views import SceneCameras

# Larger walls are sampled more coarsely, except along the borders of openings.
MAX_SAMPLES: Final = 1 << 24
# Maximum depth of a recess in the scene, in metres.
_BEHIND_MOST_M: Final = 2.0
# A recess belongs to the wall if at least _RIM_LEAST of the cells in the rim around it, which is
# _RIM_CELLS wide, are on the face of the wall.
_RIM_CELLS: Final = 5
_RIM_LEAST: Final = 0.5
# An outline matches an opening if the intersection over union (IoU) is at least this.
_SAME_IOU: Final = 0.5
# Distance on either side of an outline within which the true border is searched for.
_REACH_CELLS: Final = 10.0
# Sampling interval of this search, in cells.
_STEP_CELLS: Final = 1.0 / 16.0
# Number of lines perpendicular to a side along which the border is searched for.
_LINES: Final = 33
# Share of a side that is ignored at each end, because corners influence it.
_ENDS_SHARE: Final = 0.1


class InspectOpenings(Method):
    """Compare outlines of openings with the recesses of a simulated scene.

    True openings are connected areas of a wall in which rays perpendicular to the wall hit a
    surface that is deep enough behind its face. An outline matches an opening if their intersection
    over union (IoU) is at least one half. To compute the IoU, walls with more than 17 million cells
    are sampled more coarsely. Each scanned side is compared with the border of the recess along
    rays a sixteenth of a cell apart. Errors are positive if the outline is too large.
    """

    id: ClassVar[str] = "inspect.openings"
    determinism: ClassVar[Determinism] = "loose"
    metrics: ClassVar[tuple[MetricSpec, ...]] = (
        MetricSpec("n_true_openings", label="true openings"),
        higher("n_found_openings", label="true openings found"),
        lower("n_false_openings", label="false openings"),
        higher("opening_iou_mean", label="IoU with the true openings, mean"),
        higher("opening_iou_min", label="IoU with the true openings, smallest"),
        lower("opening_depth_error_max_mm", label="depth error of an opening, largest"),
        lower("side_rmse_mm", label="position error of opening sides, RMS"),
        MetricSpec(
            "side_mean_mm", label="position error of opening sides, mean (+: opening too large)"
        ),
        MetricSpec("side_max_mm", label="position error of opening sides, largest"),
        lower("side_rmse_cells", label="position error of opening sides, RMS"),
        MetricSpec(
            "side_error_over_sigma",
            label="position error of opening sides divided by the predicted error",
            better="one",
        ),
        lower("n_stray_sides", label="sides without a true side nearby"),
    )

    class Params(MethodParams):
        """Limits for recesses that count as openings."""

        behind_m: float = Field(
            default=0.05,
            gt=0.0,
            le=2.0,
            description="Smallest depth of an opening.",
        )
        area_least_m2: float = Field(
            default=0.1, gt=0.0, le=10_000.0, description="Smaller openings are ignored."
        )

    class In(Ports):
        """The openings to compare, their walls, and the truth."""

        truth: Truth
        openings: Openings
        walls: Walls

    class Out(Ports):
        """The errors of the outlines."""

        inspection: Inspection

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Compare the openings of each wall."""
        from orthoflow.geometry.scene_views import SceneCameras

        places = {wall.plane_index: place for place, wall in enumerate(inputs.walls.walls)}
        missing = [number for number in inputs.openings.walls if number not in places]
        if missing:
            raise MethodError(
                f"there are openings on wall {missing[0]}, which is not among the connected walls "
                f"({', '.join(map(str, places)) or 'none'}): connect the walls on which they were "
                "found"
            )
        views = SceneCameras(inputs.truth.scene, cores=ctx.cores)
        verdicts = []
        for count, number in enumerate(inputs.openings.walls):
            ctx.progress(count / len(inputs.openings.walls), f"wall {number}")
            place = places[number]
            wall = _true_wall(inputs, place, params, views, ctx.cores)
            verdicts.append(_verdict(wall, inputs.openings.of_wall(number)))
        findings = _findings(verdicts)
        for finding in findings:
            ctx.metric(finding.name, finding.value, finding.unit)
        return self.Out(inspection=_inspection(verdicts, findings))


@dataclass(frozen=True, kw_only=True)
class _TrueWall:
    """Ground truth for the openings of a wall.

    Attributes:
        slab: raster and depth range of the wall.
        place: index of the wall in `Walls`.
        step: side of a cell of `labels`, in raster cells.
        labels: (rows, cols) number of the opening, from 1; 0 elsewhere.
        face_m: depth of the face of the wall.
        deep_m: smallest depth of an opening.
        scene: the simulated scene.
        views: the scene, prepared for many rays.
    """

    slab: Slab
    place: int
    step: int
    labels: NDArray[np.int32]
    face_m: float
    deep_m: float
    scene: Scene
    views: SceneCameras

    @property
    def frame(self) -> WallFrame:
        return self.slab.frame

    def depths_m(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the depths (n,) of openings at positions (n, 2) = (column, row); NaN elsewhere."""
        frame, front_m = self.frame, self.slab.front_m
        starts = frame.world_from_wall(places, front_m) - self.scene.origin
        hits = self.views.cast(starts, -frame.axes_at(places)[:, 2])
        depth_m = front_m - hits.t
        is_open = (hits.rectangle >= 0) & (depth_m <= self.deep_m)
        is_open &= self.scene.role[hits.rectangle] == SurfaceRole.RECESS
        return np.where(is_open, depth_m, np.nan)


@dataclass(frozen=True, kw_only=True)
class _SideError:
    """The middle of a side, its error (positive outwards), and its predicted standard deviation."""

    point_world: NDArray[np.float64]
    outwards: NDArray[np.float64]
    error_m: float
    sigma_m: float


@dataclass(frozen=True, kw_only=True)
class _Verdict:
    """The findings for one wall; `ious` has one entry per true opening, 0 if it was not found."""

    place: int
    gsd_m: float
    ious: tuple[float, ...]
    n_false: int
    depth_errors_m: tuple[float, ...]
    sides: tuple[_SideError, ...]
    n_stray: int


def _true_wall(
    inputs: InspectOpenings.In,
    place: int,
    params: InspectOpenings.Params,
    views: SceneCameras,
    cores: int,
) -> _TrueWall:
    from orthoflow.geometry.scene_views import render

    scene, slab = inputs.truth.scene, inputs.walls.slab(place)
    step = max(1, math.ceil(math.sqrt(slab.n_cells / MAX_SAMPLES)))
    rows, columns = (-(-count // step) for count in slab.frame.shape)
    sampled = replace(slab.frame, gsd_m=step * slab.frame.gsd_m, width=columns, height=rows)
    nowhere = np.zeros(sampled.shape, dtype=np.bool_)
    true = render(
        scene,
        sampled,
        front_m=slab.front_m,
        behind_m=_BEHIND_MOST_M,
        coloured=nowhere,
        judged=nowhere,
        cores=cores,
    )
    # Rays that do not hit a surface have no depth.
    role = scene.role[true.rectangle]
    of_face = true.depth_m[(role == SurfaceRole.WALL) & (true.depth_m >= -slab.behind_m)]
    face_m = float(np.median(of_face)) if of_face.size else 0.0
    deep_m = face_m - params.behind_m
    with np.errstate(invalid="ignore"):
        is_open = (role == SurfaceRole.RECESS) & (true.depth_m <= deep_m)
        is_face = true.depth_m > deep_m
    return _TrueWall(
        slab=slab,
        place=place,
        step=step,
        labels=_labelled(is_open, is_face, params.area_least_m2 / sampled.gsd_m**2),
        face_m=face_m,
        deep_m=deep_m,
        scene=scene,
        views=views,
    )


def _labelled(
    is_open: NDArray[np.bool_], is_face: NDArray[np.bool_], n_least: float
) -> NDArray[np.int32]:
    """Number the open areas that are large enough and surrounded by the face of the wall."""
    import cv2

    n_areas, labels, boxes, _ = cv2.connectedComponentsWithStats(
        is_open.astype(np.uint8), connectivity=4
    )
    # Exclude recesses of other walls that are visible beyond the edge of this wall.
    about = np.ones((_RIM_CELLS, _RIM_CELLS), dtype=np.uint8)
    names = np.zeros(n_areas, dtype=np.int32)
    # The background has label 0.
    for label in 1 + np.flatnonzero(boxes[1:, cv2.CC_STAT_AREA] >= n_least):
        left, top, width, height, _ = boxes[label]
        part = (
            slice(max(0, top - _RIM_CELLS), top + height + _RIM_CELLS),
            slice(max(0, left - _RIM_CELLS), left + width + _RIM_CELLS),
        )
        own = (labels[part] == label).astype(np.uint8)
        is_rim = cv2.dilate(own, about) > own
        if is_face[part][is_rim].mean() >= _RIM_LEAST:
            names[label] = names.max() + 1
    return np.asarray(names[labels])


def _verdict(wall: _TrueWall, openings: Sequence[Opening]) -> _Verdict:
    sizes = np.bincount(wall.labels.ravel())
    ious = np.zeros(len(sizes))
    depth_errors_m: list[float] = []
    sides: list[_SideError] = []
    n_false = n_stray = 0
    for opening in openings:
        cells = wall.frame.wall_from_world(opening.outline_world)[:, :2]
        is_own = filled((cells / wall.step,), wall.labels.shape)
        shared = np.bincount(wall.labels[is_own], minlength=len(sizes))
        shared[0] = 0
        best = int(shared.argmax())
        union = int(np.count_nonzero(is_own)) + int(sizes[best]) - int(shared[best])
        iou = shared[best] / union if best else 0.0
        if iou < _SAME_IOU:
            n_false += 1
            continue
        ious[best] = max(ious[best], iou)
        if opening.depth_m is not None:
            some = np.flatnonzero(wall.labels == best)[::7]
            down, right = np.unravel_index(some, wall.labels.shape)
            centres = np.column_stack([right, down]).astype(np.float64) + 0.5
            middle = wall.depths_m(wall.step * centres)
            true_m = wall.face_m - float(np.nanmedian(middle))
            depth_errors_m.append(opening.depth_m - true_m)
        for k in np.flatnonzero(opening.side_source != OutlineSource.UNSEEN):
            begin, end = cells[k], cells[(k + 1) % len(cells)]
            found = _side_error(wall, begin, end, float(opening.side_sigma_m[k]))
            if found is None:
                n_stray += 1
            else:
                sides.append(found)
    return _Verdict(
        place=wall.place,
        gsd_m=wall.frame.gsd_m,
        ious=tuple(ious[1:].tolist()),
        n_false=n_false,
        depth_errors_m=tuple(depth_errors_m),
        sides=tuple(sides),
        n_stray=n_stray,
    )


def _side_error(
    wall: _TrueWall, begin: NDArray[np.float64], end: NDArray[np.float64], sigma_m: float
) -> _SideError | None:
    """Measure the error of a side; None if most lines across the side cross no true border."""
    way = end - begin
    length = float(np.linalg.norm(way))
    if length <= 0.0:
        return None
    # Outlines are counter-clockwise for the viewer, and rows are counted downwards.
    outwards = np.array([-way[1], way[0]]) / length
    along = np.linspace(_ENDS_SHARE, 1.0 - _ENDS_SHARE, _LINES)
    offsets = np.arange(-_REACH_CELLS, _REACH_CELLS + _STEP_CELLS / 2, _STEP_CELLS)
    places = begin + along[:, None, None] * way + offsets[None, :, None] * outwards
    depths_m = wall.depths_m(places.reshape(-1, 2)).reshape(places.shape[:2])
    is_open = np.isfinite(depths_m)
    borders = []
    for line in is_open:
        ends = np.flatnonzero(line[:-1] & ~line[1:])
        if len(ends):
            middles = offsets[ends] + 0.5 * _STEP_CELLS
            borders.append(float(middles[np.abs(middles).argmin()]))
    if len(borders) < 0.5 * _LINES:
        return None
    return _SideError(
        point_world=wall.frame.world_from_wall((0.5 * (begin + end))[None])[0],
        outwards=outwards,
        error_m=-wall.frame.gsd_m * float(np.median(borders)),
        sigma_m=sigma_m,
    )


def _findings(verdicts: Sequence[_Verdict]) -> tuple[Finding, ...]:
    ious = [iou for verdict in verdicts for iou in verdict.ious]
    sides = [side for verdict in verdicts for side in verdict.sides]
    depth_errors_m = [error for verdict in verdicts for error in verdict.depth_errors_m]
    numbers: list[Number] = [
        ("n_true_openings", len(ious), "1"),
        ("n_found_openings", sum(iou >= _SAME_IOU for iou in ious), "1"),
        ("n_false_openings", sum(verdict.n_false for verdict in verdicts), "1"),
        ("n_stray_sides", sum(verdict.n_stray for verdict in verdicts), "1"),
    ]
    if ious:
        numbers += [
            ("opening_iou_mean", float(np.mean(ious)), "1"),
            ("opening_iou_min", min(ious), "1"),
        ]
    if depth_errors_m:
        worst_m = np.abs(depth_errors_m).max()
        numbers.append(("opening_depth_error_max_mm", 1e3 * worst_m, "mm"))
    if sides:
        errors_m = np.array([side.error_m for side in sides])
        sigmas_m = np.array([side.sigma_m for side in sides])
        cells = [side.error_m / verdict.gsd_m for verdict in verdicts for side in verdict.sides]
        numbers += [
            ("side_rmse_mm", 1e3 * rms(errors_m), "mm"),
            ("side_mean_mm", 1e3 * errors_m.mean(), "mm"),
            ("side_max_mm", 1e3 * np.abs(errors_m).max(), "mm"),
            ("side_rmse_cells", rms(cells), "cells"),
            ("side_error_over_sigma", rms(errors_m / sigmas_m), "1"),
        ]
    return tuple(findings_of(numbers))


def _inspection(verdicts: Sequence[_Verdict], findings: tuple[Finding, ...]) -> Inspection:
    sides = [side for verdict in verdicts for side in verdict.sides]
    walls = [verdict.place for verdict in verdicts for _ in verdict.sides]
    return Inspection(
        wall=np.array(walls, dtype=np.int32),
        points_world=np.array([side.point_world for side in sides]).reshape(-1, 3),
        displacement_m=np.array([side.error_m * side.outwards for side in sides]).reshape(-1, 2),
        kind=np.zeros(len(sides), dtype=np.uint8),
        kinds=("side of an opening",),
        findings=findings,
    )
