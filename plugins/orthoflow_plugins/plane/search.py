"""The road that all detectors share: prepare, search, fit, label, measure, report.

The search is greedy: the best plane first, its points taken away, then the best of what remains. A
`Proposer` names candidates (an accumulator's maximum, a consensus set); what follows is the same
for each. All planes are found in the sample; one pass over all points fits them, one labels.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Final, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry import angle_between_deg, basis_from_up, omega_phi_deg
from orthoflow.products import PointCloud, PointLabels
from orthoflow.sdk import DiagnosticSpec, StepContext
from orthoflow_plugins.plane.candidates import (
    FoundPlane,
    fit_to_all,
    label,
    name_points,
    verify,
)
from orthoflow_plugins.plane.cloud import (
    Criterion,
    PreparedCloud,
    Search,
    measure_noise,
    prepare,
    thinned,
)
from orthoflow_plugins.plane.detector import Candidate, DetectorOut, DetectorParams
from orthoflow_plugins.plane.figures import draw_deviations, draw_planes, draw_thickness
from orthoflow_plugins.plane.planes import Assembly, RawPlane, assemble, report_planes
from orthoflow_plugins.plane.support import CELL_LEAST_M
from orthoflow_plugins.plane.thickness import measure_thickness, report_thickness, row_points

# Steps of the robust box of detectors that do not look at the plan.
_PLAN_CELL_M: Final = 0.5
# Four times the share of the points that may lie outside the box on each side. Mirror ghosts and
# stray points, 0.4 % in simulated rooms, would else make it several times as large as the scene.
_STRAY_SHARE: Final = 0.005
# Candidates in a row that turned out to be none, after which the search gives up.
_REJECTED_MOST: Final = 60

_NO_PLANE: Final = (
    "no plane was found in {count} points ({size}) with tolerance_m {tolerance:.3g} and min_share "
    "{share:.2%}: {why}; {advice}{small} ({method})"
)
_CRITERIA: Final[Mapping[Criterion, str]] = {
    "few": "the largest candidate holds {share:.2%} of the points",
    "small": "the largest candidate, which holds {share:.2%} of the points, shows less than "
    "{area:.2g} m2",
    "scattered": "no points crowd about any candidate",
    "strip": "the candidates are strips too narrow for a plane",
    "smear": "most points near the largest candidate, which holds {share:.2%} of all, only pass "
    "through it, as on a rounded body or in a cloud noisier than the tolerance",
    "bent": "the largest candidate, which holds {share:.2%} of the points, is a curved surface",
    "tilt": "the candidates lean by more than max_tilt_deg",
}
_NO_CANDIDATE: Final = "no candidate was proposed"
_ADVICE: Final = (
    "wider tolerances up to {wider:.3g} m were tried and find none either: lower min_area_m2 for "
    "small planes, min_share for sparse ones, or raise max_tilt_deg"
)
_ADVICE_WIDER: Final = "with tolerance_m {wider:.3g} one is found"
# Tolerances that are tried for the message, as multiples of the one that found nothing.
_WIDER: Final = (1.5, 2.0, 3.0, 4.0, 6.0)
# Where two sides of a cloud are shorter, its unit may be wrong, and planes are hard to find.
_SMALL_M: Final = 1.0
_SMALL: Final = (
    ". It is small: is unit of read.scan right? A plane must be {least} m wide and high; points "
    "beside its edges bend one that is little larger: lower fit_tolerance_m to 0.005, with "
    "max_tilt_deg 45 where it leans, or state it (plane.given)"
)
_NO_INTENSITY: Final = (
    "materials are told apart by the intensity of the points, which the cloud has not: leave "
    "materials out, or read a scan with intensity ({method})"
)


class Proposer(Protocol):
    """What a detector must do to take part."""

    def propose(self, search: Search) -> Candidate | None:
        """Name the best candidate among the points that remain, or None when there is none."""

    def reject(self, candidate: Candidate) -> None:
        """Take note that the last candidate was none, so as not to name it again."""


P = TypeVar("P", bound=Proposer)
# Makes what proposes planes in a search that has taken none yet.
ProposerOf = Callable[[Search], P]
UNEXPLAINED: Final = DiagnosticSpec(
    code="points-on-no-plane",
    severity="warning",
    text="{share:.0%} of the points lie on no plane, more than on the largest one ({largest:.0%}): "
    "walls may be missing, unless these are vegetation, furniture or curved surfaces",
    remedy="{step}.min_share={min_share:.2g} finds smaller planes, "
    "{step}.tolerance_m={tolerance_m:.2g} rougher ones",
    rank_by="share",
)


@dataclass(frozen=True, kw_only=True)
class Detection(Generic[P]):
    """What a detector gives back.

    Attributes:
        out: planes and labels.
        proposer: what proposed the planes.
        raw: of each plane what its detector itself gave.
        cloud: the cloud as the passes take it.
    """

    out: DetectorOut
    proposer: P
    raw: tuple[RawPlane, ...]
    cloud: PreparedCloud


def detect(
    cloud: PointCloud,
    params: DetectorParams,
    ctx: StepContext,
    proposer_of: ProposerOf[P],
    *,
    method: str,
    plan_cell_m: float | None = None,
    relabel: Callable[[P, list[FoundPlane], PreparedCloud], None] | None = None,
) -> Detection[P]:
    """Find the planes of a cloud and turn them into products.

    Args:
        cloud: the cloud.
        params: what every detector takes.
        ctx: the step's context.
        proposer_of: makes what proposes planes.
        method: id of the method, for messages.
        plan_cell_m: side of the plan's cells; None for detectors that do not look at the plan.
        relabel: changes the claims of the whole cloud once all points have theirs.

    Raises:
        ProductError: the cloud has fewer than three points, or coordinates that are not finite.
        MethodError: the points fix no plane, or none has enough of them; or materials are asked for
            of a cloud without intensity.
    """
    if params.materials and cloud.intensity is None:
        raise MethodError(_NO_INTENSITY.format(method=method))
    moments_s = [_now(ctx)]
    ctx.progress(0.0, "preparing the points")
    cell_m = _PLAN_CELL_M if plan_cell_m is None else plan_cell_m

    def prepared(points: PointCloud) -> PreparedCloud:
        return prepare(
            points,
            basis_from_up(cloud.up),
            cell_m=cell_m,
            least_share=_STRAY_SHARE,
            parts=ctx.cores,
            counts_plan=plan_cell_m is not None,
        )

    search = _search_in(prepared(thinned(cloud, params.thinning)), params, ctx)
    proposer = proposer_of(search)

    def on_found(n_found: int) -> None:
        moments_s.append(_now(ctx))
        ctx.progress(0.1 + 0.7 * n_found / params.n_planes_max, f"plane {n_found}")

    found = find_planes(search, proposer, on_found)
    if not found:
        raise MethodError(_why_none(cloud, search, proposer_of, method))
    whole = search.cloud
    if params.thinning > 1:
        whole = prepared(cloud)
        label(found, whole, search.tolerance_m)
    if not params.refit:
        found = [item.as_proposed(whole.up) for item in found]
        label(found, whole, search.tolerance_m)
    if relabel is not None:
        relabel(proposer, found, whole)
    _report_times(ctx, np.diff([*moments_s, _now(ctx)], axis=0))
    return _products(cloud, whole, found, search, proposer, ctx)


def find_planes(
    search: Search, proposer: Proposer, on_found: Callable[[int], None] = lambda _: None
) -> list[FoundPlane]:
    """Find all planes in the sample of a cloud, then fit them to all points and label those.

    Args:
        search: what is looked for; its claims, and those of its cloud, are filled.
        proposer: the detector.
        on_found: is called with the number of planes so far, after each of them.
    """
    found = fit_to_all(greedy_search(search, proposer, on_found), search)
    label(found, search.cloud, search.tolerance_m)
    return found


def greedy_search(
    search: Search, proposer: Proposer, on_found: Callable[[int], None] = lambda _: None
) -> list[FoundPlane]:
    """Find planes in the sample one after the other until a stop rule holds; see `find_planes`.

    Returns:
        The planes in the order they were found; `search.claims` refers to that order.
    """
    params, found, n_rejected = search.params, list[FoundPlane](), 0
    least_left = params.stop_unclassified_share * len(search.claims)
    while len(found) < params.n_planes_max and n_rejected < _REJECTED_MOST:
        if search.n_points < least_left:
            break
        candidate = proposer.propose(search)
        if candidate is None:
            break
        plane = verify(candidate, search)
        if plane is None:
            proposer.reject(candidate)
            n_rejected += 1
            continue
        if plane.support.n_points < params.stop_rest_share * search.n_points:
            break
        found.append(plane)
        n_rejected = 0
        search.claim(plane.claim(search.tolerance_m))
        on_found(len(found))
    return found


def _search_in(cloud: PreparedCloud, params: DetectorParams, ctx: StepContext) -> Search:
    """Begin a search with the tolerances that the noise of the cloud asks for."""
    noise = measure_noise(cloud.sample.offsets_m)
    tolerance_m, fit_tolerance_m = params.tolerances_m(*(noise or (0.0, 0.0)))
    if noise is not None:
        ctx.metric("noise_mm", 1000.0 * noise.single_m, "mm")
    ctx.metric("tolerance_m", tolerance_m, "m")
    ctx.metric("fit_tolerance_m", fit_tolerance_m, "m")
    ctx.metric("thinning", params.thinning, "1")
    return Search(
        cloud=cloud, params=params, tolerance_m=tolerance_m, fit_tolerance_m=fit_tolerance_m
    )


def _products(
    cloud: PointCloud,
    whole: PreparedCloud,
    found: list[FoundPlane],
    search: Search,
    proposer: P,
    ctx: StepContext,
) -> Detection[P]:
    """Measure, assemble, report and draw the planes that were found."""
    ctx.progress(0.8, "measuring deviations")
    assembly = assemble(found, whole, cloud, search.tolerance_m, search.fit_tolerance_m)
    labels = ctx.allocate("labels", "plane_index", (len(cloud),), np.int16).view(np.int16)
    name_points(whole, assembly.labels_from_claims, labels)
    report_planes(
        ctx,
        assembly.planes,
        assembly.deviations,
        n_points=len(cloud),
        n_guessed=assembly.n_guessed,
    )
    n_on_planes = assembly.deviations.n_points
    n_left = len(cloud) - int(n_on_planes.sum())
    if n_left > n_on_planes.max():
        ctx.report(
            UNEXPLAINED,
            share=n_left / len(cloud),
            largest=float(n_on_planes.max()) / len(cloud),
            min_share=search.params.min_share / 2.0,
            tolerance_m=2.0 * search.tolerance_m,
        )
    _report_fit(ctx, assembly, n_points=len(cloud))
    ctx.progress(0.9, "drawing")
    draw_deviations(ctx, assembly)
    # The last of the labels is for points on no plane: a claim of -1 picks it.
    plane_of_sample = assembly.labels_from_claims[whole.sample_claims].astype(np.int64)
    draw_planes(ctx, assembly.planes, whole.sample.offsets_m, plane_of_sample, cloud)
    materials = search.params.materials
    thickness = measure_thickness(
        assembly.planes,
        plane_of_sample,
        whole,
        cloud,
        reach_m=search.fit_tolerance_m,
        materials=materials,
    )
    row = row_points(assembly.planes, plane_of_sample, whole, cloud)
    report_thickness(ctx, thickness)
    draw_thickness(ctx, assembly.planes, thickness, row, materials)
    planes = replace(
        assembly.planes,
        thickness=thickness,
        scan_row=None if row is None else row.measured(materials),
    )
    out = DetectorOut(planes=planes, labels=PointLabels(plane_index=labels))
    return Detection(out=out, proposer=proposer, raw=assembly.raw, cloud=whole)


def _why_none(cloud: PointCloud, search: Search, proposer_of: ProposerOf[P], method: str) -> str:
    """State which criterion refused the largest candidate, and what was tried and works."""
    why = _NO_CANDIDATE
    if search.refusals:
        criterion, share = max(search.refusals, key=lambda refusal: refusal[1])
        why = _CRITERIA[criterion].format(share=share, area=search.min_area_m2)
    advice = _ADVICE.format(wider=_WIDER[-1] * search.tolerance_m)
    for times in _WIDER:
        wider = replace(
            search,
            params=search.params.model_copy(update={"n_planes_max": 1}),
            tolerance_m=times * search.tolerance_m,
            fit_tolerance_m=max(search.fit_tolerance_m, 0.3 * times * search.tolerance_m),
        )
        if greedy_search(wider, proposer_of(wider)):
            advice = _ADVICE_WIDER.format(wider=wider.tolerance_m)
            break
    sides_m = [float(np.ptp(axis)) for axis in (cloud.x, cloud.y, cloud.z)]
    return _NO_PLANE.format(
        count=len(cloud),
        size=" x ".join(f"{side_m:.3g}" for side_m in sides_m) + " m",
        tolerance=search.tolerance_m,
        share=search.params.min_share,
        why=why,
        advice=advice,
        small=_SMALL.format(least=2 * CELL_LEAST_M) if sorted(sides_m)[1] < _SMALL_M else "",
        method=method,
    )


def _now(ctx: StepContext) -> tuple[float, float]:
    """Return seconds by the clock, and by the processor."""
    return ctx.clock_s(), ctx.processor_s()


def _report_times(ctx: StepContext, passed_s: NDArray[np.float64]) -> None:
    """Report the seconds of a detection, loading apart, as Table 1 of markiewicz2015 does.

    Args:
        ctx: takes the metrics.
        passed_s: (n, 2) seconds up to each plane, and from the last one to the labels of all
            points; by the clock and by the processor.
    """
    whole_s, first_s = passed_s.sum(axis=0), passed_s[0]
    ctx.metric("detection_s", whole_s[0], "s")
    ctx.metric("detection_cpu_s", whole_s[1], "s")
    ctx.metric("first_plane_s", first_s[0], "s")
    ctx.metric("first_plane_cpu_s", first_s[1], "s")
    if len(passed_s) > 2:
        next_s = passed_s[1:-1].mean(axis=0)
        ctx.metric("next_plane_s", next_s[0], "s")
        ctx.metric("next_plane_cpu_s", next_s[1], "s")


def _report_fit(ctx: StepContext, assembly: Assembly, *, n_points: int) -> None:
    """Report how the first plane fits, and how far the fit moved what the detector itself gave."""
    planes, raw = assembly.planes, assembly.raw[0].plane
    ctx.metric("first_share", float(planes.n_points[0]) / n_points, "1")
    ctx.metric("fit_rms_mm", 1000.0 * float(assembly.deviations.rms_fit_m[0]), "mm")
    ctx.metric("r_m", abs(float(planes.offset[0])), "m")
    ctx.metric("sigma_angle_deg", planes.sigma_angle_deg(0), "deg")
    ctx.metric("sigma_offset_mm", 1000.0 * planes.sigma_offset_m(0), "mm")
    ctx.metric("n_independent", assembly.n_independent[0], "1")
    shape = assembly.normalities[0]
    if shape is not None:
        ctx.metric("skewness", shape.skewness, "1")
        ctx.metric("excess_kurtosis", shape.excess_kurtosis, "1")
        for reach, share in enumerate(shape.within, start=1):
            ctx.metric(f"within_{reach}_sigma", share, "1")
    omega_deg, phi_deg = omega_phi_deg(raw.normal, planes.up)
    miss_m = raw.offset_m - float(raw.normal @ planes.corners[0].mean(axis=0))
    ctx.metric("raw_omega_deg", omega_deg, "deg")
    ctx.metric("raw_phi_deg", phi_deg, "deg")
    ctx.metric("raw_r_m", abs(raw.offset_m), "m")
    ctx.metric("raw_angle_deg", angle_between_deg(raw.normal, planes.normal[0]), "deg")
    ctx.metric("raw_offset_mm", 1000.0 * miss_m, "mm")
