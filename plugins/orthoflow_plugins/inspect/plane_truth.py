"""Planes and labels against the truth where no orthoimage was made: how well detectors do."""

from __future__ import annotations

import numpy as np

from orthoflow.products import Finding, Inspection, Planes, PointLabels, Truth
from orthoflow.sdk import StepContext
from orthoflow_plugins.inspect.scores import (
    FOUND_ANGLE_DEG,
    FOUND_OFFSET_M,
    PlaneDistance,
    found_planes,
    label_findings,
    plane_distance,
    plane_findings,
)

_LABEL_SCORES = ("precision", "recall", "f1", "iou")


def inspect_planes(
    planes: Planes, labels: PointLabels | None, truth: Truth, ctx: StepContext
) -> Inspection:
    """Compare planes, and labels if there are any, with the truth.

    Metrics without prefix are of the truth's first plane, its main wall; `worst_` are the largest
    of all true planes that were found; `label_..._mean` are means over all true planes.
    """
    nearest = [_nearest(planes, truth.planes, index) for index in range(len(truth.planes))]
    findings = found_planes(planes, truth.planes)
    main = nearest[0]
    ctx.metric("main_found", float(main is not None), "1")
    if main is not None:
        findings += plane_findings(main, 0)
    seen = [distance for distance in nearest if distance is not None]
    if seen:
        worst = PlaneDistance(
            angle_deg=max(distance.angle_deg for distance in seen),
            offset_m=max(abs(distance.offset_m) for distance in seen),
            corner_m=max(distance.corner_m for distance in seen),
        )
        findings += [
            Finding(name=f"worst_{item.name}", value=item.value, unit=item.unit)
            for item in plane_findings(worst, 0)
        ]
    for name, distance in zip(truth.planes.names, nearest, strict=True):
        if distance is not None:
            findings += [
                Finding(name=f"{item.name}[{name}]", value=item.value, unit=item.unit)
                for item in plane_findings(distance, 0)
            ]
    if labels is not None:
        scores = label_findings(labels, truth)
        by_name = {item.name: item.value for item in scores}
        findings += scores
        findings += [
            Finding(
                name=f"label_{score}",
                value=by_name[f"label_{score}[{truth.planes.names[0]}]"],
                unit="1",
            )
            for score in _LABEL_SCORES
        ]
    for item in findings:
        if "[" not in item.name:
            ctx.metric(item.name, item.value, item.unit)
    return Inspection(
        wall=np.zeros(0, dtype=np.int32),
        points_world=np.zeros((0, 3)),
        displacement_m=np.zeros((0, 2)),
        kind=np.zeros(0, dtype=np.uint8),
        kinds=(),
        findings=tuple(findings),
    )


def _nearest(planes: Planes, true: Planes, index: int) -> PlaneDistance | None:
    """How far the best plane lies off a true one, None when none counts as found."""
    best: PlaneDistance | None = None
    best_score = np.inf
    for k in range(len(planes)):
        distance = plane_distance(planes.plane(k), true, index)
        if distance.angle_deg > FOUND_ANGLE_DEG or abs(distance.offset_m) > FOUND_OFFSET_M:
            continue
        score = distance.angle_deg / FOUND_ANGLE_DEG + abs(distance.offset_m) / FOUND_OFFSET_M
        if score < best_score:
            best, best_score = distance, score
    return best
