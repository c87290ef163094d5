"""What all detectors do around their search: thin, prepare, settle, label, measure, report."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from threading import Thread
from time import perf_counter
from typing import Final

import numpy as np

from orthoflow.errors import MethodError
from orthoflow.geometry import basis_from_up
from orthoflow.products import JsonValue, Planes, PointCloud, PointLabels
from orthoflow.sdk import StepContext
from orthoflow_plugins.plane.assembling import assemble
from orthoflow_plugins.plane.candidates import FoundPlane, Rules
from orthoflow_plugins.plane.deviations import measure_planes
from orthoflow_plugins.plane.examining import as_proposed
from orthoflow_plugins.plane.figures import draw_deviations
from orthoflow_plugins.plane.parameters import DetectorParams
from orthoflow_plugins.plane.peeling import PLANE_FOUND, Proposer, find_planes
from orthoflow_plugins.plane.preparing import prepare, sample_alone
from orthoflow_plugins.plane.remainders import Remainder
from orthoflow_plugins.plane.reporting import report_planes, report_thickness, report_times
from orthoflow_plugins.plane.sampling import thinned
from orthoflow_plugins.plane.scan_rows import scan_row
from orthoflow_plugins.plane.scene_figures import draw_planes
from orthoflow_plugins.plane.settling import label, name_points, settle
from orthoflow_plugins.plane.thickness import measure_thickness
from orthoflow_plugins.plane.thickness_figures import draw_thickness

Report = Callable[[float, str], None]
# Steps of the robust box of detectors that do not look at the plan.
_PLAN_CELL_M: Final = 0.5

_NO_PLANE: Final = (
    "no plane holds {share:.2%} of the {count} points within {tolerance} m: raise tolerance_m "
    "or fit_tolerance_m for rough or noisy walls, lower min_share for small ones, or raise "
    "max_tilt_deg ({method})"
)

_NO_INTENSITY: Final = (
    "materials are told apart by the intensity of the points, which the cloud has not: leave "
    "materials out, or read a scan with intensity ({method})"
)


@dataclass(frozen=True, kw_only=True)
class Detection:
    """What a detector gives back.

    Attributes:
        planes: the planes.
        labels: the plane of each point.
        own_tolerances_m: of each plane the tolerance that the detector found itself, or None.
    """

    planes: Planes
    labels: PointLabels
    own_tolerances_m: tuple[float | None, ...]


def rules_of(params: DetectorParams) -> Rules:
    """Give the rules that parameters state."""
    return Rules(
        find_m=params.tolerance_m,
        fit_m=min(params.fit_tolerance_m, params.tolerance_m),
        n_planes_most=params.n_planes_max,
        least_share=params.min_share,
        stop_unclassified_share=params.stop_unclassified_share,
        tilt_most_deg=params.max_tilt_deg,
        stop_rest_share=params.stop_rest_share,
        is_exact=params.exact,
        joins_parts=params.join_parts,
    )


def search_sample(
    remainder: Remainder,
    rules: Rules,
    report: Report,
    proposer_of: Callable[[Remainder], Proposer],
) -> list[FoundPlane]:
    """Find all planes on the sample, then fit them to all points and label those at once.

    Args:
        remainder: the cloud; its claims are filled.
        rules: when a plane counts and when to stop.
        report: hears progress, 0..1.
        proposer_of: makes the detector, given the sample as a cloud of its own.
    """
    sample = sample_alone(remainder)
    found = find_planes(sample, proposer_of(sample), rules, report)
    settled = settle(found, remainder, rules)
    label(settled, remainder, rules.find_m)
    return settled


def detect(
    cloud: PointCloud,
    params: DetectorParams,
    ctx: StepContext,
    find: Callable[[Remainder, Rules, Report], list[FoundPlane]],
    *,
    method: str,
    plan_cell_m: float | None = None,
    relabel: Callable[[list[FoundPlane], Remainder], None] | None = None,
) -> Detection:
    """Run a search on a cloud and turn what it finds into products.

    Args:
        cloud: the cloud.
        params: what every detector takes.
        ctx: the step's context.
        find: the search: finds planes in a remainder. If it leaves points unclaimed that lie on
            its planes, they are claimed here.
        method: id of the method, for messages.
        plan_cell_m: side of the plan's cells; None for detectors that do not look at the plan.
        relabel: changes the claims of the whole cloud once all points have theirs.

    Raises:
        ProductError: the cloud has fewer than three points, or coordinates that are not finite.
        MethodError: the points fix no plane, or none has enough of them; or materials are asked for
            of a cloud without intensity.
    """
    rules = rules_of(params)
    if params.materials and cloud.intensity is None:
        raise MethodError(_NO_INTENSITY.format(method=method))
    started_s = perf_counter()
    Thread(target=_load_charts, daemon=True).start()
    ctx.progress(0.0, "preparing the points")

    def prepared(points: PointCloud) -> Remainder:
        return prepare(
            points,
            basis_from_up(cloud.up),
            cell_m=_PLAN_CELL_M if plan_cell_m is None else plan_cell_m,
            least_share=params.min_share,
            parts=ctx.cores,
            counts_plan=plan_cell_m is not None,
        )

    whole = remainder = prepared(thinned(cloud, params.thinning))
    moments_s = [started_s]

    def heard(part: float, text: str) -> None:
        if text.startswith(PLANE_FOUND):
            moments_s.append(perf_counter())
        ctx.progress(0.1 + 0.7 * part, text)

    found = find(remainder, rules, heard)
    if not found:
        raise MethodError(
            _NO_PLANE.format(
                share=params.min_share,
                count=len(cloud),
                tolerance=params.tolerance_m,
                method=method,
            )
        )
    if params.thinning > 1:
        whole = prepared(cloud)
        label(found, whole, rules.find_m)
    if not params.refit:
        found = [as_proposed(item, whole.up) for item in found]
        label(found, whole, rules.find_m)
    if relabel is not None:
        relabel(found, whole)
    moments_s.append(perf_counter())
    report_times(ctx, np.diff(moments_s))
    ctx.progress(0.8, "measuring deviations")
    deviations = measure_planes(
        whole,
        np.array([item.raster.slab() for item in found]),
        np.array([item.footprint.bounds_m for item in found]),
        find_m=rules.find_m,
        fit_m=rules.fit_m,
    )
    assembly = assemble(found, whole, deviations, cloud)
    labels = ctx.allocate("labels", "plane_index", (len(cloud),), np.int16).view(np.int16)
    name_points(whole, assembly.labels_from_claims, labels)
    ctx.metric("thinning", params.thinning, "1")
    report_planes(ctx, assembly, n_points=len(cloud))
    ctx.progress(0.9, "drawing")
    draw_deviations(ctx, assembly)
    # The last of the labels is for points on no plane: a claim of -1 picks it.
    plane_of_sample = assembly.labels_from_claims[whole.sample_claims].astype(np.int64)
    draw_planes(ctx, assembly.planes, whole.sample.offsets_m, plane_of_sample, cloud)
    found_thickness = measure_thickness(
        assembly.planes,
        plane_of_sample,
        whole,
        cloud,
        reach_m=rules.fit_m,
        materials=params.materials,
    )
    row = scan_row(assembly.planes, plane_of_sample, whole, cloud)
    report_thickness(ctx, found_thickness)
    draw_thickness(ctx, assembly.planes, found_thickness, row, params.materials)
    details: dict[str, JsonValue] = {
        **assembly.planes.details,
        "thickness": [None if item is None else item.to_json() for item in found_thickness],
        "scan_row": None if row is None else row.to_json(params.materials),
    }
    return Detection(
        planes=replace(assembly.planes, details=details),
        labels=PointLabels(plane_index=labels),
        own_tolerances_m=assembly.own_tolerances_m,
    )


def _load_charts() -> None:
    """Load what draws, which takes as long as some passes: they leave the interpreter free."""
    with contextlib.suppress(ImportError):
        importlib.import_module("matplotlib.figure")
