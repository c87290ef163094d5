"""Errors of planes, and scores of point labels, from a comparison with the truth."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane, angle_between_deg
from orthoflow.products import Finding, Inspection, Planes, PointCloud, PointLabels, Truth
from orthoflow.sdk import DiagnosticSpec, StepContext
from orthoflow_plugins.inspect.findings import Number, findings_of

_FOUND_ANGLE_DEG: Final = 1.0
_FOUND_OFFSET_M: Final = 0.015
# Maximum differences between the plane of a wall and the true plane that it matches.
_SAME_ANGLE_DEG: Final = 3.0
_SAME_OFFSET_M: Final = 0.03
# Name of each label score in metric names, and its text in metric labels.
LABEL_SCORES: Final = {"precision": "precision", "recall": "recall", "f1": "F1", "iou": "IoU"}
MAIN_MISSED: Final = DiagnosticSpec(
    code="main-wall-missed",
    severity="error",
    text="none of the {n_planes} detected planes matches the main wall of the scene within "
    "{angle_deg:g} deg and {offset_m:g} m: the errors of the other planes are reported",
)

LABELS_NOT_COMPARED: Final = DiagnosticSpec(
    code="labels-not-compared",
    severity="warning",
    text="labels are not compared with the truth: there are {n_labels:,} labels for {n_true:,} "
    "simulated points, and it is unknown to which points they belong",
    remedy="connect the labelled cloud to {step}; filters keep track of points with "
    "`cloud.selected(...)`",
)
POINTS_LEFT_OUT: Final = DiagnosticSpec(
    code="points-left-out-before-labels",
    severity="note",
    text="labels are compared for {n_labels:,} of {n_true:,} simulated points: an earlier step "
    "removed the others",
)


def inspect_planes(
    planes: Planes,
    labels: PointLabels | None,
    cloud: PointCloud | None,
    truth: Truth,
    ctx: StepContext,
) -> Inspection:
    """Compare planes, and labels if given, with the truth.

    Metrics without a prefix describe the main wall, which is the first plane of the truth. Metrics
    with the prefix `worst_` are the largest errors of all true planes that were found, and
    `label_..._mean` are means over all true planes.
    """
    nearest = [
        _nearest(
            _distances(planes, truth.planes, index),
            angle_deg=_FOUND_ANGLE_DEG,
            offset_m=_FOUND_OFFSET_M,
        )
        for index in range(len(truth.planes))
    ]
    findings = found_planes(planes, truth.planes)
    main = nearest[0]
    ctx.metric("main_found", float(main is not None), "1")
    if main is None:
        ctx.report(
            MAIN_MISSED,
            n_planes=len(planes),
            angle_deg=_FOUND_ANGLE_DEG,
            offset_m=_FOUND_OFFSET_M,
        )
    else:
        findings += findings_of(main.numbers(), 0)
    seen = [distance for distance in nearest if distance is not None]
    if seen:
        worst = _PlaneDistance(
            angle_deg=max(distance.angle_deg for distance in seen),
            offset_m=max(abs(distance.offset_m) for distance in seen),
        )
        findings += findings_of(worst.numbers(), prefix="worst_")
    for plane, distance in zip(truth.planes.names, nearest, strict=True):
        if distance is not None:
            findings += findings_of(distance.numbers(f"[{plane}]"))
    if labels is not None:
        findings += _with_those_of_the_main_wall(label_findings(labels, cloud, truth, ctx), truth)
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


def _with_those_of_the_main_wall(scores: list[Finding], truth: Truth) -> list[Finding]:
    """Add the scores of the main wall under names that omit the name of the plane."""
    if not scores:
        return []
    values = {item.name: item.value for item in scores}
    main = truth.planes.names[0]
    return scores + findings_of(
        (f"label_{score}", values[f"label_{score}[{main}]"], "1") for score in LABEL_SCORES
    )


def wall_plane_findings(plane: Plane, wall: int, true: Planes) -> list[Finding]:
    """Return the errors of the plane of one wall; empty if the plane matches no true plane."""
    distances = (_plane_distance(plane, true, index) for index in range(len(true)))
    nearest = _nearest(distances, angle_deg=_SAME_ANGLE_DEG, offset_m=_SAME_OFFSET_M)
    return [] if nearest is None else findings_of(nearest.numbers(), wall)


def worst_plane_findings(findings: Sequence[Finding]) -> list[Finding]:
    """Return the largest errors over the planes of all walls."""
    worst = []
    for name in ("plane_angle_deg", "plane_offset_mm"):
        values = [finding for finding in findings if finding.name == name]
        if values:
            largest = max(abs(finding.value) for finding in values)
            worst.append(Finding(name=name, value=largest, unit=values[0].unit))
    return worst


def found_planes(planes: Planes, true: Planes) -> list[Finding]:
    """Count the true planes that were found with errors of at most 1 deg and 15 mm."""
    n_found = sum(
        any(d.is_within(_FOUND_ANGLE_DEG, _FOUND_OFFSET_M) for d in _distances(planes, true, index))
        for index in range(len(true))
    )
    return findings_of([("true_planes", len(true), "1"), ("true_planes_found", n_found, "1")])


def label_findings(
    labels: PointLabels, cloud: PointCloud | None, truth: Truth, ctx: StepContext
) -> list[Finding]:
    """Compute precision, recall, F1 and IoU of labels for true planes, matched one to one.

    The result is empty if it is unknown to which points the labels belong. Points that a filter
    removed before the detection are ignored.

    Args:
        labels: labels from a detector.
        cloud: the labelled cloud; None for the whole simulated cloud.
        truth: truth of the simulated cloud.
        ctx: context that receives diagnostics.
    """
    from scipy.optimize import linear_sum_assignment

    true_labels = truth.labels
    ids = None if cloud is None else cloud.point_id
    n_labels, n_true = len(labels.plane_index), len(true_labels)
    if ids is not None and len(ids) == n_labels and n_labels and int(ids.max()) < n_true:
        true_labels = true_labels[ids]
        if n_labels < n_true:
            ctx.report(POINTS_LEFT_OUT, n_labels=n_labels, n_true=n_true)
    elif n_labels != n_true:
        ctx.report(LABELS_NOT_COMPARED, n_labels=n_labels, n_true=n_true)
        return []
    counts = _joint_counts(labels.plane_index, true_labels, len(truth.planes))
    both = counts[1:, 1:].astype(np.float64)
    n_true, n_found = counts[1:].sum(axis=1), counts[:, 1:].sum(axis=0)
    union = n_true[:, None] + n_found[None, :] - both
    iou = both / np.maximum(union, 1.0)
    rows, columns = linear_sum_assignment(-iou)
    match = dict(zip(rows.tolist(), columns.tolist(), strict=True))
    scores = np.zeros((len(truth.planes), 4))
    for index, column in match.items():
        hits = both[index, column]
        scores[index] = (
            hits / max(n_found[column], 1),
            hits / max(n_true[index], 1),
            2.0 * hits / max(n_found[column] + n_true[index], 1),
            iou[index, column],
        )
    numbers: list[Number] = []
    for kind, values in zip(LABEL_SCORES, scores.T, strict=True):
        numbers.append((f"label_{kind}_mean", values.mean(), "1"))
        numbers += [
            (f"label_{kind}[{name}]", value, "1")
            for name, value in zip(truth.planes.names, values, strict=True)
        ]
    return findings_of(numbers)


@dataclass(frozen=True, kw_only=True)
class _PlaneDistance:
    """Differences between a detected and a true plane.

    Attributes:
        angle_deg: angle between the normals of both planes.
        offset_m: distance of the detected plane from the centroid of the true rectangle, positive
            towards the viewer.
    """

    angle_deg: float
    offset_m: float

    def is_within(self, angle_deg: float, offset_m: float) -> bool:
        return self.angle_deg <= angle_deg and abs(self.offset_m) <= offset_m

    def numbers(self, suffix: str = "") -> list[Number]:
        return [
            (f"plane_angle_deg{suffix}", self.angle_deg, "deg"),
            (f"plane_offset_mm{suffix}", 1e3 * self.offset_m, "mm"),
        ]

    @property
    def score(self) -> float:
        return self.angle_deg / _FOUND_ANGLE_DEG + abs(self.offset_m) / _FOUND_OFFSET_M


def _plane_distance(found: Plane, true: Planes, index: int) -> _PlaneDistance:
    centroid = true.corners[index].mean(axis=0)
    return _PlaneDistance(
        angle_deg=angle_between_deg(found.normal, true.normal[index]),
        offset_m=-float(found.distances_m(centroid[None])[0]),
    )


def _distances(found: Planes, true: Planes, index: int) -> list[_PlaneDistance]:
    return [_plane_distance(found.plane(k), true, index) for k in range(len(found))]


def _nearest(
    distances: Iterable[_PlaneDistance], *, angle_deg: float, offset_m: float
) -> _PlaneDistance | None:
    near = (distance for distance in distances if distance.is_within(angle_deg, offset_m))
    return min(near, key=lambda distance: distance.score, default=None)


def _joint_counts(
    found: NDArray[np.int16], true: NDArray[np.int16], n_true: int
) -> NDArray[np.int64]:
    """Return a table of point counts, indexed by true label + 1 and detected label + 1."""
    n_found = int(found.max(initial=-1)) + 2
    joint = (true.astype(np.int64) + 1) * n_found + (found.astype(np.int64) + 1)
    return np.bincount(joint, minlength=(n_true + 1) * n_found).reshape(n_true + 1, n_found)
