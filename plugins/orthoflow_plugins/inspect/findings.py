"""What displacements add up to, and which of an inspection's numbers bear plain names.

The numbers are those of markiewicz2015, and the table of skarlatos2012: lengths of residuals,
outliers by two rules, and what is left.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthoflow.geometry.robust import median_deviation
from orthoflow.products import Finding
from orthoflow.sdk import StepContext

_AXES: Final = ("x", "y")
# Never are more than so many of the points called outliers.
_OUTLIERS_MOST: Final = 0.25
# More than half are no outliers by any rule.
_MOST_WITHOUT_CAP: Final = 0.5
# Shorter lengths between check points say more of the single points than of a scale.
_LENGTH_LEAST_SHARE: Final = 0.25
# Of more points of a wall every so manieth takes part: their pairs are millions.
_POINTS_MOST: Final = 1000
# Behind the rule in the name of a number that the cap has made.
CAPPED: Final = "_capped"
# What displacements, check points and an orthoimage itself add up to, as metrics.
DISPLACEMENTS: Final = (
    *("rmse_[xy]_mm", "rmse_[xy]_cells", "mean_[xy]_mm", "nmad_[xy]_mm", "max_[xy]_mm"),
    *("beyond_2rmse_[xy]_share", "beyond_2rmse_any_share", "p95_mm"),
)
LENGTHS: Final = ("n_lengths", "length_error_rms_share", "length_error_max_share")
CHECK_TABLE: Final = (
    *("n_found", "rms_mm", "sd_mm", "mean_shift_mm", "mean_shift_share"),
    *("n_outliers_once", "n_outliers_iterated", "n_outliers_iterated_capped"),
    *("rms_after_once_mm", "rms_after_iterated_mm", "rms_after_iterated_capped_mm"),
)
IMAGE_QUALITY: Final = (
    *("completeness", "n_edges", "edge_width_cells", "mtf50_per_cell"),
    *("filled_share", "stretch_share", "smear_share"),
)
# What a comparison asks of every wall; the record has the rest.
_OF_EACH_WALL: Final = ("rmse_u_mm", "rmse_v_mm", "completeness")


def displacement_findings(
    shift_m: NDArray[np.float64], gsd_m: float, wall: int, *, prefix: str = ""
) -> list[Finding]:
    """Sum up displacements (n, 2) along u (`x`, to the right) and v (`y`, down), shown - true.

    Root mean squares, means, robust and plain spreads, the largest, and the shares beyond twice
    the RMSE (markiewicz2015, Table 2; of normal errors it is 4.6 % per axis, and never over 25 %).

    Args:
        shift_m: metres, at least one.
        gsd_m: side of a cell, for the numbers in cells.
        wall: of the findings, -1 for all together.
        prefix: of their names.
    """
    findings = []

    def say(name: str, value: float, unit: str) -> None:
        findings.append(Finding(name=f"{prefix}{name}", value=float(value), unit=unit, wall=wall))

    shift_mm = 1e3 * shift_m
    for axis, name in enumerate(_AXES):
        values = shift_mm[:, axis]
        rmse = rms(values)
        say(f"rmse_{name}_mm", rmse, "mm")
        say(f"rmse_{name}_cells", rmse / (1e3 * gsd_m), "cells")
        say(f"mean_{name}_mm", values.mean(), "mm")
        say(f"nmad_{name}_mm", median_deviation(values), "mm")
        say(f"max_{name}_mm", np.abs(values).max(), "mm")
        say(f"beyond_2rmse_{name}_share", float(np.mean(np.abs(values) > 2.0 * rmse)), "1")
    both = np.any(np.abs(shift_mm) > 2.0 * np.sqrt(np.mean(shift_mm**2, axis=0)), axis=1)
    say("beyond_2rmse_any_share", both.mean(), "1")
    length = np.linalg.norm(shift_mm, axis=1)
    say("p95_mm", np.percentile(length, 95), "mm")
    return findings


def check_findings(
    shift_m: NDArray[np.float64], gsd_m: float, *, prefix: str = ""
) -> list[Finding]:
    """Sum up the displacements (n, 2) of check points, at least one: Table 1 and more.

    `rms_mm`, `sd_mm` are of lengths; `mean_shift_share` says how much of the RMS is one common
    shift.

    Args:
        shift_m: metres along u and v, shown - surveyed.
        gsd_m: side of a cell.
        prefix: of the names, for a class of points.
    """
    length = np.linalg.norm(shift_m, axis=1)
    mean_shift = float(np.linalg.norm(shift_m.mean(axis=0)))
    numbers = [("n_found", float(len(length)), "1"), ("rms_mm", 1e3 * rms(length), "mm")]
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
            (f"n_outliers_{name}", float(np.count_nonzero(out)), "1"),
            (f"rms_after_{name}_mm", 1e3 * rms(length[~out]), "mm"),
        ]
    table = [
        Finding(name=f"{prefix}{name}", value=value, unit=unit) for name, value, unit in numbers
    ]
    return table + displacement_findings(shift_m, gsd_m, -1, prefix=prefix)


def length_findings(
    surveyed_m: NDArray[np.float64], shift_m: NDArray[np.float64], wall: NDArray[np.int32]
) -> list[Finding]:
    """Sum up the relative errors of lengths between check points (markiewicz2015, 5: 0.2 %).

    The lengths are those between points of one wall, from a quarter of its longest on; empty
    without any.

    Args:
        surveyed_m: (n, 2) metres along u and v, where the points are.
        shift_m: (n, 2) where the orthoimage shows them, less that.
        wall: (n,) on which.
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
    values = (float(len(share)), rms(share), float(share.max()))
    return [
        Finding(name=name, value=value, unit="1")
        for name, value in zip(LENGTHS, values, strict=True)
    ]


def outliers_at_once(length_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which lengths (n,) exceed twice the RMS of all."""
    return length_m > 2.0 * rms(length_m)


def outliers_iterated(length_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which lengths (n,) exceed twice the RMS of the others that do not.

    The largest set of longest ones, a quarter at most, each beyond twice the RMS of what is left.
    Lengths of two kinds, at edges and on flat parts, go on to lose the longer kind; `cap_binds`
    says where they do. So the rule of all points is the one to compare.
    """
    return _iterated(length_m, _OUTLIERS_MOST)


def cap_binds(length_m: NDArray[np.float64]) -> bool:
    """Whether the iterated rule calls as many of the lengths (n,) outliers as it may, too few."""
    n_most = math.floor(_OUTLIERS_MOST * len(length_m))
    n_capped, n_all = (
        int(np.count_nonzero(_iterated(length_m, share)))
        for share in (_OUTLIERS_MOST, _MOST_WITHOUT_CAP)
    )
    return n_capped == n_most < n_all


def of_walls(names: Sequence[str]) -> tuple[str, ...]:
    """Names of metrics as `report` gives them: of the main wall, of each, and of all together."""
    walls = [f"wall_[0-9]*_{name}" for name in _OF_EACH_WALL]
    return (*names, *walls, *(f"all_{name}" for name in names))


def rms(values: ArrayLike) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def report(
    findings: Sequence[Finding], main: int, numbers: Mapping[int, int], ctx: StepContext
) -> None:
    """Report the main wall by plain names, all walls with `all_`, the rest as it is called.

    Displacements and completeness of the other walls are reported too, with `wall_1_` and so on,
    by the place of the plane in `planes.json`.

    Args:
        findings: of walls, and of all together (wall -1).
        main: the wall whose numbers bear plain names.
        numbers: index of a wall -> place of its plane.
        ctx: where they go.
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
    """Lengths between all pairs of places (n, 2)."""
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
