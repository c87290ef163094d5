"""Statistics of displacements, and their report as metrics of an inspection.

The statistics are those of markiewicz2015 and of Table 1 in skarlatos2012: lengths of residuals,
outliers according to two rules, and the RMS without outliers.
"""

from __future__ import annotations

import fnmatch
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthoflow.geometry.robust import median_deviation
from orthoflow.products import Finding
from orthoflow.sdk import MetricSpec, StepContext

_Samples = TypeVar("_Samples")
# Name, value and unit of a metric.
Number: TypeAlias = tuple[str, float, str]

lower, higher = (partial(MetricSpec, better=better) for better in ("lower", "higher"))

_AXES: Final = ("x", "y")
# Maximum share of the points that the iterated outlier rule may remove.
_OUTLIERS_MOST: Final = 0.25
# Higher limit, with which the iterated rule is repeated to find out whether _OUTLIERS_MOST stopped
# it.
_MOST_WITHOUT_CAP: Final = 0.5
# Minimum distance between check points, relative to the longest distance. Shorter distances depend
# more on single points than on the scale.
_LENGTH_LEAST_SHARE: Final = 0.25
# If a wall has more points than this, every nth point is used, since the number of pairs grows
# quadratically.
_POINTS_MOST: Final = 1000
# Suffix of the metrics of the iterated rule if it reached the cap.
CAPPED: Final = "_capped"
# Metrics of displacements, of check points, and of the orthoimage itself.
DISPLACEMENTS: Final = (
    lower("rmse_[xy]_mm", label="displacement along {0}, RMS"),
    lower("rmse_[xy]_cells", label="displacement along {0}, RMS"),
    MetricSpec("mean_[xy]_mm", label="displacement along {0}, mean"),
    lower("nmad_[xy]_mm", label="typical displacement along {0} (NMAD)"),
    MetricSpec("max_[xy]_mm", label="largest displacement along {0}"),
    MetricSpec(
        "beyond_2rmse_[xy]_share", label="share of displacements beyond twice the RMS along {0}"
    ),
)
LENGTHS: Final = (
    MetricSpec("n_lengths", label="distances compared"),
    lower("length_error_rms_share", label="relative error of distances, RMS"),
    lower("length_error_max_share", label="relative error of distances, largest"),
)
CHECK_TABLE: Final = (
    MetricSpec("n_found", label="check points found"),
    lower("rms_mm", label="check points, RMS", headline=True, counted_by="n_found"),
    MetricSpec("sd_mm", label="check points, standard deviation"),
    MetricSpec("mean_shift_mm", label="check points, mean shift"),
    MetricSpec("mean_shift_share", label="mean shift divided by the RMS"),
    MetricSpec("n_outliers_once", label="outliers, rule applied once"),
    MetricSpec("n_outliers_iterated", label="outliers, rule iterated"),
    MetricSpec("n_outliers_iterated_capped", label="outliers, rule iterated up to the limit"),
    lower("rms_after_once_mm", label="RMS without outliers, rule applied once"),
    lower("rms_after_iterated_mm", label="RMS without outliers, rule iterated"),
    lower(
        "rms_after_iterated_capped_mm",
        label="RMS without outliers, rule iterated up to the limit of a quarter",
    ),
)
COMPLETENESS: Final = higher(
    "completeness",
    label="share of the scanned surface that is covered or filled",
    headline=True,
)
IMAGE_QUALITY: Final = (
    MetricSpec("n_edges", label="edges whose sharpness was measured"),
    MetricSpec("edge_width_cells", label="edge width"),
    MetricSpec("mtf50_per_cell", label="sharpness (MTF50)"),
    MetricSpec("filled_share", label="cells filled from neighbours"),
    lower("stretch_share", label="cells smeared over steep relief"),
    lower("smear_share", label="cells smeared along edges"),
)
# Metrics that are reported for every wall; all others of single walls are only in the record.
_OF_EACH_WALL: Final = ("rmse_u_mm", "rmse_v_mm", "completeness")


def findings_of(numbers: Iterable[Number], wall: int = -1, *, prefix: str = "") -> list[Finding]:
    """Return the metrics of a wall, or of all walls together (wall -1)."""
    return [
        Finding(name=f"{prefix}{name}", value=float(value), unit=unit, wall=wall)
        for name, value, unit in numbers
    ]


def displacement_findings(
    shift_m: NDArray[np.float64], gsd_m: float, wall: int, *, prefix: str = ""
) -> list[Finding]:
    """Compute statistics of displacements (n, 2), which are shown minus true positions.

    `x` points right along u, and `y` points down along v. The statistics are the RMSE, the mean,
    the NMAD, the maximum, and the share of displacements beyond twice the RMSE (markiewicz2015,
    Table 2). For each axis, this share is 4.6 % if errors are normally distributed, and never over
    25 %.

    Args:
        shift_m: displacements in metres, at least one.
        gsd_m: side of a cell, to convert to cells.
        wall: index of the wall, -1 for all walls together.
        prefix: prefix of the metric names.
    """
    numbers: list[Number] = []
    shift_mm = 1e3 * shift_m
    for axis, name in enumerate(_AXES):
        values = shift_mm[:, axis]
        rmse = rms(values)
        numbers += [
            (f"rmse_{name}_mm", rmse, "mm"),
            (f"rmse_{name}_cells", rmse / (1e3 * gsd_m), "cells"),
            (f"mean_{name}_mm", values.mean(), "mm"),
            (f"nmad_{name}_mm", median_deviation(values), "mm"),
            (f"max_{name}_mm", np.abs(values).max(), "mm"),
            (f"beyond_2rmse_{name}_share", float(np.mean(np.abs(values) > 2.0 * rmse)), "1"),
        ]
    return findings_of(numbers, wall, prefix=prefix)


def check_findings(
    shift_m: NDArray[np.float64], gsd_m: float, *, prefix: str = ""
) -> list[Finding]:
    """Compute statistics of displacements (n, 2) of check points (skarlatos2012, Table 1).

    `rms_mm` and `sd_mm` are computed from the lengths of the displacements; `mean_shift_share` is
    the length of the mean displacement divided by the RMS.

    Args:
        shift_m: shown minus surveyed positions along u and v, in metres.
        gsd_m: side of a cell.
        prefix: prefix of the metric names, for a class of points.
    """
    length = np.linalg.norm(shift_m, axis=1)
    mean_shift = float(np.linalg.norm(shift_m.mean(axis=0)))
    numbers: list[Number] = [("n_found", len(length), "1"), ("rms_mm", 1e3 * rms(length), "mm")]
    if len(length) > 1:
        numbers.append(("sd_mm", 1e3 * float(length.std(ddof=1)), "mm"))
    numbers += [
        ("mean_shift_mm", 1e3 * mean_shift, "mm"),
        ("mean_shift_share", mean_shift / max(rms(length), 1e-12), "1"),
    ]
    is_capped = cap_binds(length)
    for name, out in (
        ("once", outliers_at_once(length)),
        (f"iterated{CAPPED}" if is_capped else "iterated", outliers_iterated(length)),
    ):
        numbers += [
            (f"n_outliers_{name}", count_true(out), "1"),
            (f"rms_after_{name}_mm", 1e3 * rms(length[~out]), "mm"),
        ]
    return [
        *findings_of(numbers, prefix=prefix),
        *displacement_findings(shift_m, gsd_m, -1, prefix=prefix),
    ]


def length_findings(
    surveyed_m: NDArray[np.float64], shift_m: NDArray[np.float64], wall: NDArray[np.int32]
) -> list[Finding]:
    """Compute relative errors of distances between check points (0.2 % in markiewicz2015, 5).

    Distances between points on the same wall are compared if they are at least a quarter of the
    longest one. The result is empty if there is no such distance.

    Args:
        surveyed_m: (n, 2) surveyed positions along u and v, in metres.
        shift_m: (n, 2) shown minus surveyed positions, in metres.
        wall: (n,) index of the wall of each point.
    """
    errors = [np.empty(0)]
    for mine in (np.flatnonzero(wall == number) for number in np.unique(wall)):
        chosen = mine[:: max(1, len(mine) // _POINTS_MOST)]
        true = _lengths(surveyed_m[chosen])
        shown = _lengths(surveyed_m[chosen] + shift_m[chosen])
        counts = true >= max(_LENGTH_LEAST_SHARE * true.max(initial=0.0), 1e-9)
        errors.append(np.abs(shown[counts] - true[counts]) / true[counts])
    share = np.concatenate(errors)
    if not len(share):
        return []
    values = (len(share), rms(share), share.max())
    return findings_of((spec.name, value, "1") for spec, value in zip(LENGTHS, values, strict=True))


def outliers_at_once(length_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask (n,) of the lengths that exceed twice the RMS of all lengths."""
    return length_m > 2.0 * rms(length_m)


def outliers_iterated(length_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask (n,) of the lengths that exceed twice the RMS of all other lengths.

    At most a quarter of the lengths are removed. If there are two kinds of points, such as points
    at edges and points on flat parts, the iteration would remove all points of the worse kind
    without this limit; `cap_binds` detects this. Comparisons should therefore use the rule that is
    applied once.
    """
    return _iterated(length_m, _OUTLIERS_MOST)


def cap_binds(length_m: NDArray[np.float64]) -> bool:
    """Return whether the iterated rule stops because it reaches the maximum share of outliers."""
    n_most = math.floor(_OUTLIERS_MOST * len(length_m))
    n_capped, n_all = (
        count_true(_iterated(length_m, share)) for share in (_OUTLIERS_MOST, _MOST_WITHOUT_CAP)
    )
    return n_capped == n_most < n_all


def of_walls(specs: Sequence[MetricSpec]) -> tuple[MetricSpec, ...]:
    """Return the metrics that `report` reports for the main wall, each wall and all walls."""
    of_each = [spec for spec in specs if fnmatch.filter(_OF_EACH_WALL, spec.name)]
    return (
        *specs,
        *prefixed(of_each, "wall_[0-9]*_", "wall {0}{1}"),
        *prefixed(specs, "all_", "all walls"),
    )


def prefixed(specs: Sequence[MetricSpec], prefix: str, what: str) -> tuple[MetricSpec, ...]:
    """Return copies of metrics, with other names and labels, that are not headline metrics.

    Args:
        specs: the metrics.
        prefix: prefix of the new names, possibly with wildcards.
        what: suffix of the new labels; `{0}` is replaced by the part of the name that the wildcard
            matches.
    """
    n_wildcards = len(re.findall(r"\*|\[[^\]]+\]", prefix))
    return tuple(
        replace(
            spec,
            name=f"{prefix}{spec.name}",
            label=f"{spec.label.replace('{0}', f'{{{n_wildcards}}}')}; {what}",
            headline=False,
            counted_by=spec.counted_by and f"{prefix}{spec.counted_by}" if not n_wildcards else "",
        )
        for spec in specs
    )


def pooled(samples: Sequence[_Samples]) -> _Samples:
    """Combine samples of several walls or bands by concatenating arrays and adding counts."""
    together: dict[str, Any] = {}
    for name, value in vars(samples[0]).items():
        parts = [getattr(item, name) for item in samples]
        together[name] = sum(parts) if isinstance(value, int) else np.concatenate(parts)
    return type(samples[0])(**together)


def count_true(mask: NDArray[np.bool_]) -> int:
    """Return the number of true cells."""
    return int(np.count_nonzero(mask))


def rms(values: ArrayLike) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def report(
    findings: Sequence[Finding], main: int, numbers: Mapping[int, int], ctx: StepContext
) -> None:
    """Report findings as metrics; those of the main wall get no prefix.

    Findings of all walls together get the prefix `all_`. Displacements and completeness of the
    other walls get a prefix, such as `wall_1_`, with the index of the plane in `planes.json`.

    Args:
        findings: findings of walls, and of all walls together (wall -1).
        main: index of the main wall.
        numbers: index of the plane in `planes.json`, by index of the wall.
        ctx: context that receives the metrics.
    """
    per_wall = {finding.name for finding in findings if finding.wall >= 0}
    for finding in findings:
        if finding.wall == main:
            ctx.metric(finding.name, finding.value, finding.unit)
        elif finding.wall >= 0 and finding.name in _OF_EACH_WALL:
            ctx.metric(f"wall_{numbers[finding.wall]}_{finding.name}", finding.value, finding.unit)
        elif finding.wall < 0 and finding.name in per_wall:
            ctx.metric(f"all_{finding.name}", finding.value, finding.unit)
        elif finding.wall < 0 and "[" not in finding.name:
            ctx.metric(finding.name, finding.value, finding.unit)


def _lengths(places_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distances between all pairs of positions (n, 2)."""
    first, second = np.triu_indices(len(places_m), k=1)
    lengths: NDArray[np.float64] = np.linalg.norm(places_m[first] - places_m[second], axis=1)
    return lengths


def _iterated(length_m: NDArray[np.float64], most_share: float) -> NDArray[np.bool_]:
    order = np.argsort(-length_m, kind="stable")
    chosen = np.zeros(len(length_m), dtype=np.bool_)
    for count in range(1, math.floor(most_share * len(length_m)) + 1):
        if length_m[order[count - 1]] > 2.0 * rms(length_m[order[count:]]):
            chosen[order[:count]] = True
    return chosen
