"""`inspect.checkpoints`: compare orthoimages with surveyed points."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.errors import MethodError
from orthoflow.geometry.bands import IN_MEMORY_CELLS, in_memory, row_bands
from orthoflow.products import (
    Cameras,
    CheckPoints,
    Finding,
    Inspection,
    JsonValue,
    Orthoimage,
    Orthoimages,
    Truth,
    Wall,
    Walls,
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
from orthoflow_plugins.inspect.figures import draw_arrows
from orthoflow_plugins.inspect.findings import (
    CAPPED,
    CHECK_TABLE,
    COMPLETENESS,
    DISPLACEMENTS,
    IMAGE_QUALITY,
    LENGTHS,
    check_findings,
    findings_of,
    length_findings,
    lower,
    of_walls,
    prefixed,
    report,
    rms,
)
from orthoflow_plugins.inspect.image_quality import (
    OrthoimageGrey,
    completeness,
    quality_findings,
)
from orthoflow_plugins.inspect.patches import IntensityGrey
from orthoflow_plugins.inspect.placing import in_files, on_walls, wall_of
from orthoflow_plugins.inspect.point_doubts import (
    is_own,
    missed_points,
    report_doubts,
    with_reasons,
)
from orthoflow_plugins.inspect.point_places import Picture, PointFinder, ShownPoint

# Maximum number of unused points that are logged.
_MAX_LOGGED: Final = 200
MISSED: Final = DiagnosticSpec(
    code="check-points-missed",
    severity="warning",
    text="{n_missed} of {n_points} check points are not used: {reasons}",
    remedy="measure them in an orthoimage, or increase {step[raster.grid]}.margin_m or "
    "{step[raster.grid]}.buffer_m to include them",
    rank_by="n_missed",
)
CAPPED_RULE: Final = DiagnosticSpec(
    code="outlier-rule-capped",
    severity="warning",
    text="the iterated outlier rule stopped at its limit of a quarter of the points ({numbers}), "
    "although more exceed twice the RMS of the remaining points: the points seem to fall into two "
    "groups, which the rule cannot separate",
    remedy="use n_outliers_once instead",
)


class InspectCheckpoints(Method):
    """Measure the displacement of surveyed points in the orthoimages (skarlatos2012, Table 1).

    A point is used if its position in the image was measured (in cells or in metres, see
    `read.checkpoints`) or if a black and white quadrant target is recognised there. In a simulated
    room, it is used if its surroundings, rendered from the true scene, are found in the image.
    Without orthoimages, the points are searched for in the intensity of the walls. The RMS and the
    standard deviation are computed from the lengths of the residuals. With the rule `once`, which
    is meant for comparisons, a point is an outlier if its residual exceeds twice the RMS of all
    points. With the rule `iterated`, it is an outlier if its residual exceeds twice the RMS of the
    remaining points; this removes at most a quarter of the points (`iterated_capped` if it reaches
    that limit). Metrics for a class of points (flat, vertical ...) have the name of the class as a
    prefix. `x` points right along u, and `y` down along v. Residuals are shown minus surveyed
    positions. `length_error_..._share` are relative errors of distances between points on a wall.
    Targets are also compared in 3D (`3d`): their positions are measured on the plane that fits the
    depths around them.
    """

    id: ClassVar[str] = "inspect.checkpoints"
    determinism: ClassVar[Determinism] = "loose"
    result_version: ClassVar[int] = 2
    metrics: ClassVar[tuple[MetricSpec, ...]] = (
        MetricSpec("n_points", label="check points"),
        MetricSpec("n_3d", label="check points compared in space"),
        lower("rms_3d_mm", label="check points in space, RMS", headline=True, counted_by="n_3d"),
        MetricSpec("max_3d_mm", label="check points in space, largest error"),
        *(*CHECK_TABLE, *LENGTHS, *DISPLACEMENTS),
        *prefixed((*CHECK_TABLE, *DISPLACEMENTS), "*_", "{0}"),
        *of_walls((COMPLETENESS, *IMAGE_QUALITY)),
    )
    citations: ClassVar[tuple[str, ...]] = (
        (
            "Skarlatos, Kiparissi, Theodoridou 2012, Direct orthophoto generation from color "
            "point clouds of complex scenes (4.5, Table 1)"
        ),
    )

    class Params(MethodParams):
        """Search for points whose position was not measured."""

        search_m: float = Field(0.03, gt=0.0, le=1.0, description="Search radius for a point.")
        target_radius_m: float = Field(
            0.04,
            gt=0.0,
            le=1.0,
            description="Radius of the quadrant targets, or of the part of them to use.",
        )

    class In(Ports):
        """The surveyed points, and the images in which they are searched for."""

        checkpoints: CheckPoints
        walls: Walls
        orthoimages: Orthoimages | None = None
        truth: Truth | None = None
        cameras: Cameras | None = None

    class Out(Ports):
        """The residuals."""

        inspection: Inspection

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Find all points, then compute the statistics."""
        if is_own(inputs.checkpoints).all():
            raise MethodError(
                "x, y, z of all check points were taken from the orthoimage in which they were "
                "clicked, so there is nothing to compare: enter the surveyed coordinates "
                "in their file and keep shown_x, shown_y, shown_z (inspect.checkpoints)"
            )
        pictures = _pictures(inputs, ctx)
        finder = PointFinder(
            pictures=pictures,
            checkpoints=inputs.checkpoints,
            walls=inputs.walls,
            truth=inputs.truth,
            search_m=params.search_m,
            target_radius_m=params.target_radius_m,
        )
        points = []
        for index in range(len(inputs.checkpoints.names)):
            ctx.progress(index / len(inputs.checkpoints.names), inputs.checkpoints.names[index])
            points.append(finder.find(index))
        found = [k for k, point in enumerate(points) if np.isfinite(point.place).all()]
        is_simulated = inputs.truth is not None
        missed = missed_points(
            points, inputs.checkpoints, pictures, inputs.walls, is_simulated=is_simulated
        )
        if not found:
            raise MethodError(
                f"none of the {len(points)} check points was found in an orthoimage: "
                f"{with_reasons(missed)}; measure them (columns wall, u_px, v_px or map_x, map_y), "
                "or check that the scan and the points use the same unit and coordinate system "
                "(inspect.checkpoints)"
            )
        report_doubts(points, inputs.checkpoints, pictures, ctx)
        # In simulated rooms, some points are hidden deliberately.
        if missed and not is_simulated:
            reasons = with_reasons(missed)
            ctx.report(MISSED, n_missed=len(missed), n_points=len(points), reasons=reasons)
        gsd_m = {picture.wall: picture.frame.gsd_m for picture in pictures}
        numbers = {picture.wall: picture.image.number for picture in pictures}
        shown = [points[k] for k in found]
        shift_m = np.array([gsd_m[one.wall] * (one.place - one.expected) for one in shown])
        surveyed_m = np.array([gsd_m[one.wall] * one.expected for one in shown])
        walls = np.array([one.wall for one in shown], dtype=np.int32)
        classes = [inputs.checkpoints.classes[k] for k in found]
        findings = _findings(shift_m, classes, max(gsd_m.values()))
        findings += length_findings(surveyed_m, shift_m, walls)
        findings += findings_in_space(shown, inputs.checkpoints, found)
        if inputs.orthoimages is not None:
            findings += _findings_of_images(pictures, inputs.cameras)
        ctx.metric("n_points", len(points), "1")
        report(findings, pictures[0].wall, numbers, ctx)
        _warn_of_cap(findings, ctx)
        _draw(pictures, shown, [inputs.checkpoints.names[k] for k in found], ctx)
        for name, reason in list(missed.items())[:_MAX_LOGGED]:
            ctx.log(f"check point {name}: not used, {reason}")
        names = tuple(dict.fromkeys(classes))
        return self.Out(
            inspection=Inspection(
                wall=walls,
                points_world=inputs.checkpoints.points_world[found],
                displacement_m=shift_m,
                kind=np.array([names.index(name) for name in classes], dtype=np.uint8),
                kinds=tuple(name or "check point" for name in names),
                findings=tuple(findings),
                details={"points": _table(points, inputs.checkpoints, gsd_m, numbers)},
            )
        )


def _pictures(inputs: InspectCheckpoints.In, ctx: StepContext) -> list[Picture]:
    if inputs.orthoimages is not None:
        pictures = [
            Picture(
                wall=image.wall,
                frame=image.frame,
                grey=OrthoimageGrey(image),
                surface=wall_of(image, inputs.walls, in_files(ctx, f"{place}.laid")),
                image=image,
            )
            for place, image in enumerate(on_walls(inputs.orthoimages, inputs.walls).images)
        ]
    else:
        pictures = [
            _intensity_picture(index, wall, wall.intensity, ctx)
            for index, wall in enumerate(inputs.walls.walls)
            if wall.intensity is not None
        ]
    if not pictures:
        raise MethodError(
            "there is no image in which check points can be found: connect orthoimages, or walls "
            "with intensity (inspect.checkpoints)"
        )
    return pictures


def _intensity_picture(
    index: int, wall: Wall, intensity: NDArray[np.float32], ctx: StepContext
) -> Picture:
    cells, shape = IntensityGrey(intensity=intensity), wall.frame.shape
    is_large = wall.mask.size > IN_MEMORY_CELLS
    allocate = in_files(ctx, str(index)) if is_large else in_memory
    rgb = np.asarray(allocate("rgb", (*shape, 3), np.uint8), np.uint8)
    mask = np.asarray(allocate("mask", shape, np.uint8), np.uint8)
    source = np.asarray(allocate("source", shape, np.int16), np.int16)
    for rows in row_bands(shape):
        part = cells.cut((rows, slice(0, shape[1])))
        rgb[rows] = np.clip(part.grey, 0, 255).astype(np.uint8)[:, :, np.newaxis]
        mask[rows] = part.valid
        source[rows] = np.where(part.valid, 0, -1)
    return Picture(
        wall=index,
        frame=wall.frame,
        grey=cells,
        surface=wall,
        image=Orthoimage(
            frame=wall.frame,
            wall=index,
            name=wall.name,
            rgb=rgb,
            mask=mask,
            source=source,
            sources=("intensity",),
            plane_index=wall.plane_index,
        ),
    )


def _findings(shift_m: NDArray[np.float64], classes: Sequence[str], gsd_m: float) -> list[Finding]:
    findings = check_findings(shift_m, gsd_m)
    names = [name for name in dict.fromkeys(classes) if name]
    for name in names if len(names) > 1 or "" in classes else ():
        chosen = np.array([one == name for one in classes])
        prefix = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
        findings += check_findings(shift_m[chosen], gsd_m, prefix=f"{prefix}_")
    return findings


def findings_in_space(
    points: Sequence[ShownPoint], surveyed: CheckPoints, found: Sequence[int]
) -> list[Finding]:
    """Return the errors in space of the check points that were shown as targets."""
    apart = np.array(
        [
            np.linalg.norm(point.point_world - surveyed.points_world[k])
            for point, k in zip(points, found, strict=True)
        ]
    )
    apart = 1e3 * apart[np.isfinite(apart)]
    if not len(apart):
        return []
    return findings_of(
        [
            ("n_3d", len(apart), "1"),
            ("rms_3d_mm", rms(apart), "mm"),
            ("max_3d_mm", apart.max(), "mm"),
        ]
    )


def _findings_of_images(pictures: Sequence[Picture], cameras: Cameras | None) -> list[Finding]:
    return [
        finding
        for picture in pictures
        for finding in (
            completeness(picture.image, picture.surface),
            *quality_findings(picture.image, picture.surface, cameras),
        )
    ]


def _warn_of_cap(findings: Sequence[Finding], ctx: StepContext) -> None:
    capped = [item for item in findings if item.name.endswith(f"n_outliers_iterated{CAPPED}")]
    if capped:
        numbers = ", ".join(f"{item.name} {item.value:.0f}" for item in capped)
        ctx.report(CAPPED_RULE, numbers=numbers)


def _draw(
    pictures: Sequence[Picture],
    points: Sequence[ShownPoint],
    names: Sequence[str],
    ctx: StepContext,
) -> None:
    for picture in pictures:
        own = [k for k, point in enumerate(points) if point.wall == picture.wall]
        if not own:
            continue
        mine = [points[k] for k in own]
        places = np.array([point.place for point in mine])
        shifts = places - np.array([point.expected for point in mine])
        draw_arrows(
            ctx,
            f"wall_{picture.image.number}_residuals",
            picture.image,
            places,
            shifts,
            title="residuals of check points (position in the image minus surveyed position)",
            names=[names[k] for k in own],
        )


def _table(
    points: Sequence[ShownPoint],
    surveyed: CheckPoints,
    gsd_m: Mapping[int, float],
    numbers: Mapping[int, int],
) -> list[JsonValue]:
    rows: list[JsonValue] = []
    for k, point in enumerate(points):
        row: dict[str, JsonValue] = {
            "name": surveyed.names[k],
            "class": surveyed.classes[k],
            "how": point.how,
        }
        if np.isfinite(point.place).all():
            shift_mm = 1e3 * gsd_m[point.wall] * (point.place - point.expected)
            row |= {
                "wall": numbers[point.wall],
                "u_px": round(float(point.place[0]), 3),
                "v_px": round(float(point.place[1]), 3),
                "x_mm": round(float(shift_mm[0]), 3),
                "y_mm": round(float(shift_mm[1]), 3),
            }
        rows.append(row)
    return rows
