"""Numbers that sum up errors: of depths, colours, displacements, planes and labels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry import Plane, angle_between_deg
from orthoflow.products import Finding, Planes, PointLabels, Truth
from orthoflow_plugins.inspect.samples import WallSamples

FOUND_ANGLE_DEG: Final = 1.0
FOUND_OFFSET_M: Final = 0.015
# A wall further off than this shows no true plane.
_SAME_ANGLE_DEG: Final = 3.0
_SAME_OFFSET_M: Final = 0.03
_NAMES_BESIDE_TRACED: Final = {
    "rmse_u_mm": "patch_rmse_u_mm",
    "rmse_v_mm": "patch_rmse_v_mm",
    "mean_u_mm": "patch_mean_u_mm",
    "mean_v_mm": "patch_mean_v_mm",
    "ghost_share": "ghost_colour_share",
}


@dataclass(frozen=True, kw_only=True)
class PlaneDistance:
    """How far a plane lies off a true one.

    Attributes:
        angle_deg: between the normals.
        offset_m: signed distance at the centroid of the true rectangle, + towards the viewer.
        corner_m: largest distance at its corners.
    """

    angle_deg: float
    offset_m: float
    corner_m: float


def plane_distance(found: Plane, true: Planes, index: int) -> PlaneDistance:
    """Compare a plane with a true plane."""
    corners = true.corners[index]
    centroid = corners.mean(axis=0)
    return PlaneDistance(
        angle_deg=angle_between_deg(found.normal, true.normal[index]),
        offset_m=-float(found.distances_m(centroid[None])[0]),
        corner_m=float(np.abs(found.distances_m(corners)).max()),
    )


def nearest_true_plane(found: Plane, true: Planes) -> int | None:
    """Index of the true plane a plane shows, or None when it is near none."""
    best, best_score = None, np.inf
    for index in range(len(true)):
        distance = plane_distance(found, true, index)
        if distance.angle_deg > _SAME_ANGLE_DEG or abs(distance.offset_m) > _SAME_OFFSET_M:
            continue
        score = distance.angle_deg / FOUND_ANGLE_DEG + abs(distance.offset_m) / FOUND_OFFSET_M
        if score < best_score:
            best, best_score = index, score
    return best


def plane_findings(distance: PlaneDistance, wall: int) -> list[Finding]:
    """Numbers on the plane of one wall."""
    return [
        Finding(name="plane_angle_deg", value=distance.angle_deg, unit="deg", wall=wall),
        Finding(name="plane_offset_mm", value=1e3 * distance.offset_m, unit="mm", wall=wall),
        Finding(name="plane_corner_max_mm", value=1e3 * distance.corner_m, unit="mm", wall=wall),
    ]


def sample_findings(
    samples: WallSamples, wall: int, *, sources_are_traced: bool = False
) -> list[Finding]:
    """Numbers on the cells of one wall, or of all with wall -1; none for what has no samples.

    Displacements and ghosts bear a longer name when they are also told from the photos' cameras,
    which says more.
    """
    renamed = _NAMES_BESIDE_TRACED if sources_are_traced else {}
    return [
        Finding(name=renamed.get(name, name), value=value, unit=unit, wall=wall)
        for name, value, unit in (
            *_depth_numbers(samples),
            *_colour_numbers(samples),
            *_shift_numbers(samples),
            *_share_numbers(samples),
        )
    ]


def found_planes(planes: Planes, true: Planes) -> list[Finding]:
    """Count the true planes that were found within 1 deg and 15 mm."""
    n_found = 0
    for index in range(len(true)):
        distances = [plane_distance(planes.plane(k), true, index) for k in range(len(planes))]
        n_found += any(
            d.angle_deg <= FOUND_ANGLE_DEG and abs(d.offset_m) <= FOUND_OFFSET_M for d in distances
        )
    return [
        Finding(name="true_planes", value=len(true), unit="1"),
        Finding(name="true_planes_found", value=n_found, unit="1"),
    ]


def label_findings(labels: PointLabels, truth: Truth) -> list[Finding]:
    """Precision, recall, F1 and IoU of the labels per true plane, matched one to one.

    Raises:
        MethodError: the labels are not of the simulated cloud.
    """
    from scipy.optimize import linear_sum_assignment

    if len(labels.plane_index) != len(truth.labels):
        raise MethodError(
            f"the labels have {len(labels.plane_index)} points, but the truth has "
            f"{len(truth.labels)}: wire the labels of the simulated cloud itself"
        )
    counts = _joint_counts(labels.plane_index, truth.labels, len(truth.planes))
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
    findings = []
    for place, kind in enumerate(("precision", "recall", "f1", "iou")):
        findings.append(
            Finding(name=f"label_{kind}_mean", value=float(scores[:, place].mean()), unit="1")
        )
        findings += [
            Finding(name=f"label_{kind}[{name}]", value=float(scores[k, place]), unit="1")
            for k, name in enumerate(truth.planes.names)
        ]
    return findings


def kept_shifts(samples: WallSamples) -> NDArray[np.bool_]:
    """Patches whose displacement belongs to the rest: 4 robust deviations, at least 1/4 cell."""
    cells = samples.shift_cells
    if len(cells) == 0:
        return np.zeros(0, dtype=np.bool_)
    middle = np.median(cells, axis=0)
    nmad = 1.4826 * np.median(np.abs(cells - middle), axis=0)
    kept: NDArray[np.bool_] = np.all(np.abs(cells - middle) <= np.maximum(4.0 * nmad, 0.25), axis=1)
    return kept


def _joint_counts(
    found: NDArray[np.int16], true: NDArray[np.int16], n_true: int
) -> NDArray[np.int64]:
    """Points by (true + 1, found + 1)."""
    n_found = int(found.max(initial=-1)) + 2
    joint = (true.astype(np.int64) + 1) * n_found + (found.astype(np.int64) + 1)
    return np.bincount(joint, minlength=(n_true + 1) * n_found).reshape(n_true + 1, n_found)


Number = tuple[str, float, str]


def _depth_numbers(samples: WallSamples) -> list[Number]:
    errors = 1e3 * samples.depth_m
    if errors.size == 0:
        return []
    middle = float(np.median(errors))
    numbers = [
        ("depth_median_mm", middle, "mm"),
        ("depth_nmad_mm", 1.4826 * float(np.median(np.abs(errors - middle))), "mm"),
        ("depth_rmse_mm", _rms(errors), "mm"),
    ]
    stated = samples.sigma_m > 0.0
    if stated.any():
        inside = np.abs(samples.depth_m[stated]) <= 3.0 * samples.sigma_m[stated]
        numbers.append(("depth_within_3sigma", float(inside.mean()), "1"))
    if samples.step_depth_m.size:
        numbers.append(("depth_step_rmse_mm", 1e3 * _rms(samples.step_depth_m), "mm"))
    return numbers


def _colour_numbers(samples: WallSamples) -> list[Number]:
    named = (
        ("colour_rmse_grey", samples.colour),
        ("filled_colour_rmse_grey", samples.filled_colour),
        ("step_colour_rmse_grey", samples.step_colour),
    )
    return [
        (name, float(np.sqrt(squares.mean())), "grey") for name, squares in named if squares.size
    ]


def _shift_numbers(samples: WallSamples) -> list[Number]:
    kept = kept_shifts(samples)
    numbers: list[Number] = [("n_patches", float(len(kept)), "1")]
    if not kept.any():
        return numbers
    shifts = 1e3 * samples.shift_m[kept]
    for axis, name in enumerate(("u", "v")):
        numbers += [
            (f"rmse_{name}_mm", _rms(shifts[:, axis]), "mm"),
            (f"mean_{name}_mm", float(shifts[:, axis].mean()), "mm"),
        ]
    numbers.append(("displaced_share", 1.0 - float(kept.mean()), "1"))
    return numbers


def _share_numbers(samples: WallSamples) -> list[Number]:
    numbers: list[Number] = []
    if samples.n_seen:
        numbers += [
            ("completeness", samples.n_seen_painted / samples.n_seen, "1"),
            ("completeness_filled", samples.n_seen_shown / samples.n_seen, "1"),
        ]
    if samples.n_painted:
        numbers += [
            ("unseen_painted_share", samples.n_unseen_painted / samples.n_painted, "1"),
        ]
    if samples.n_coloured:
        numbers += [
            ("gross_colour_share", samples.n_gross / samples.n_coloured, "1"),
            ("ghost_share", samples.n_ghost / samples.n_coloured, "1"),
        ]
    return numbers


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))
