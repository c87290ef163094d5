"""`inspect.truth`: orthoimages, walls, planes and labels against a simulated scene."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydantic import Field

from orthoflow.errors import MethodError
from orthoflow.geometry.scenes import Viewers
from orthoflow.products import (
    Finding,
    Inspection,
    Orthoimage,
    Orthoimages,
    Planes,
    PointLabels,
    Truth,
    Wall,
    Walls,
)
from orthoflow.sdk import Determinism, Method, MethodParams, Ports, StepContext

if TYPE_CHECKING:
    from orthoflow.geometry.scene_views import TrueOrthoimage
    from orthoflow_plugins.inspect.samples import WallErrors


class InspectTruth(Method):
    """Compare with the truth of a simulated scene, cell by cell and patch by patch.

    The true orthoimage is rendered on each wall's own frame: the first surface within the buffer,
    seen square to the wall. Depths and colours are compared away from true depth steps; a band of
    2 cells at the steps is reported apart. Displacements come from patches of 32 x 32 painted
    cells, matched to the truth by least squares. Metrics without prefix are of the first wall;
    those with `all_` are of all walls together.
    """

    id: ClassVar[str] = "inspect.truth"
    result_version: ClassVar[int] = 1
    determinism: ClassVar[Determinism] = "loose"
    citations: ClassVar[tuple[str, ...]] = (
        "Gruen 1985, Adaptive least squares correlation (patch matching)",
        "Hoehle and Hoehle 2009, doi:10.1016/j.isprsjprs.2009.02.003 (NMAD)",
    )

    class Params(MethodParams):
        """How finely the truth is rendered."""

        supersample: int = Field(
            3, ge=1, le=8, description="True colours are means of so many rays squared per cell."
        )

    class In(Ports):
        """What to judge, and the truth."""

        orthoimages: Orthoimages
        walls: Walls
        truth: Truth
        planes: Planes | None = None
        labels: PointLabels | None = None

    class Out(Ports):
        """The verdict."""

        inspection: Inspection

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Compare wall by wall, then all together."""
        from orthoflow_plugins.inspect.samples import pooled
        from orthoflow_plugins.inspect.scores import found_planes, label_findings, sample_findings

        if not inputs.orthoimages.images:
            raise MethodError("there is no orthoimage to inspect, at least one is needed")
        findings: list[Finding] = []
        errors: list[WallErrors] = []
        for place, image in enumerate(inputs.orthoimages.images):
            ctx.progress(place / len(inputs.orthoimages.images), f"wall {image.name}")
            wall = _wall_of(image, inputs.walls)
            true = _true_orthoimage(image, inputs, params, ctx.cores)
            findings += _plane_findings(image, inputs.truth)
            errors.append(_wall_errors(image, wall, true))
            findings += sample_findings(errors[-1].samples, image.wall)
            _draw(image, errors[-1], ctx)
        findings += sample_findings(pooled([item.samples for item in errors]), -1)
        findings += _worst_planes(findings)
        if inputs.planes is not None:
            findings += found_planes(inputs.planes, inputs.truth.planes)
        if inputs.labels is not None:
            findings += label_findings(inputs.labels, inputs.truth)
        _report(findings, inputs.orthoimages.images[0].wall, ctx)
        return self.Out(inspection=_inspection(inputs.orthoimages, errors, findings))


def _wall_of(image: Orthoimage, walls: Walls) -> Wall:
    if not 0 <= image.wall < len(walls.walls):
        raise MethodError(
            f"orthoimage {image.name} is of wall {image.wall}, but there are "
            f"{len(walls.walls)} walls: wire the walls that the orthoimages were made from"
        )
    wall = walls.walls[image.wall]
    if wall.frame.shape != image.frame.shape:
        raise MethodError(
            f"orthoimage {image.name} has {image.frame.shape} cells, but its wall has "
            f"{wall.frame.shape}: wire the walls that the orthoimages were made from"
        )
    return wall


def _true_orthoimage(
    image: Orthoimage, inputs: InspectTruth.In, params: InspectTruth.Params, cores: int
) -> TrueOrthoimage:
    from orthoflow.geometry.scene_views import render_frame

    truth = inputs.truth
    viewers = Viewers(
        positions_world=np.unique(truth.stations, axis=0),
        up=truth.planes.up,
        lowest_elevation_deg=_detail_deg(truth, "lowest_elevation_deg", -90.0),
        highest_elevation_deg=_detail_deg(truth, "highest_elevation_deg", 90.0),
    )
    return render_frame(
        truth.scene,
        image.frame,
        buffer_front_m=inputs.walls.buffer_front_m,
        buffer_behind_m=inputs.walls.buffer_behind_m,
        viewers=viewers,
        supersample=params.supersample,
        cores=cores,
    )


def _detail_deg(truth: Truth, name: str, default: float) -> float:
    value = truth.details.get(name, default)
    return float(value) if isinstance(value, int | float) else default


def _wall_errors(image: Orthoimage, wall: Wall, true: TrueOrthoimage) -> WallErrors:
    from orthoflow_plugins.inspect.samples import wall_errors

    return wall_errors(image, wall, true)


def _plane_findings(image: Orthoimage, truth: Truth) -> list[Finding]:
    from orthoflow_plugins.inspect.scores import (
        nearest_true_plane,
        plane_distance,
        plane_findings,
    )

    index = nearest_true_plane(image.frame.plane, truth.planes)
    if index is None:
        return []
    return plane_findings(plane_distance(image.frame.plane, truth.planes, index), image.wall)


def _worst_planes(findings: list[Finding]) -> list[Finding]:
    """The largest error of any wall's plane, as numbers on all walls."""
    worst = []
    for name in ("plane_angle_deg", "plane_offset_mm", "plane_corner_max_mm"):
        values = [finding for finding in findings if finding.name == name]
        if values:
            largest = max(abs(finding.value) for finding in values)
            worst.append(Finding(name=name, value=largest, unit=values[0].unit))
    return worst


def _draw(image: Orthoimage, errors: WallErrors, ctx: StepContext) -> None:
    from orthoflow_plugins.inspect.maps import (
        COLOUR_SPAN_GREY,
        DEPTH_SPAN_MM,
        colour_error_map,
        depth_error_map,
    )

    ctx.figure(
        f"wall_{image.wall}_depth_error",
        depth_error_map(errors.depth_m),
        f"{image.name}: measured - true depth, blue {-DEPTH_SPAN_MM:g} mm to red "
        f"{DEPTH_SPAN_MM:g} mm.",
    )
    ctx.figure(
        f"wall_{image.wall}_colour_error",
        colour_error_map(errors.grey),
        f"{image.name}: colour error, black 0 to yellow {COLOUR_SPAN_GREY:g} grey levels.",
    )


def _report(findings: list[Finding], main: int, ctx: StepContext) -> None:
    """Report the first wall by plain names, all walls with `all_`, the rest as it is called."""
    per_wall = {finding.name for finding in findings if finding.wall >= 0}
    for finding in findings:
        if finding.wall == main:
            ctx.metric(finding.name, finding.value, finding.unit)
        elif finding.wall < 0 and finding.name in per_wall:
            ctx.metric(f"all_{finding.name}", finding.value, finding.unit)
        elif finding.wall < 0 and "[" not in finding.name:
            ctx.metric(finding.name, finding.value, finding.unit)


def _inspection(
    orthoimages: Orthoimages, errors: list[WallErrors], findings: list[Finding]
) -> Inspection:
    walls, points, shifts = [], [], []
    for image, item in zip(orthoimages.images, errors, strict=True):
        walls.append(np.full(len(item.patches.centre), image.wall, dtype=np.int32))
        points.append(image.frame.world_from_wall(item.patches.centre))
        shifts.append(item.samples.shift_m)
    return Inspection(
        wall=np.concatenate(walls),
        points_world=np.concatenate(points),
        displacement_m=np.concatenate(shifts),
        kind=np.zeros(sum(len(item) for item in walls), dtype=np.uint8),
        kinds=("patch",),
        findings=tuple(findings),
        details={"patch_cells": 32},
    )
