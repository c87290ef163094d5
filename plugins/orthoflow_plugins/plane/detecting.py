"""The road that all detectors share: prepare, search, fit, label, measure, report.

The search is greedy: the best plane first, its points taken away, then the best of what remains. A
`Proposer` names candidates (an accumulator's maximum, a consensus set); what follows is the same
for each. All planes are found in the sample; one pass over all points fits them, one labels.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry import angle_between_deg, basis_from_up, omega_phi_deg
from orthoflow.products import Planes, PointCloud, PointLabels, Thickness
from orthoflow.sdk import StepContext
from orthoflow_plugins.plane.assembling import Assembly, RawPlane, assemble, warn_of_guesses
from orthoflow_plugins.plane.candidates import (
    Candidate,
    Criterion,
    FoundPlane,
    Refusal,
    Rules,
    as_proposed,
    verify,
)
from orthoflow_plugins.plane.figures import draw_deviations, draw_planes, draw_thickness
from orthoflow_plugins.plane.final_fit import fit_to_all, label, name_points
from orthoflow_plugins.plane.measuring import measure_planes, measure_thickness, row_points
from orthoflow_plugins.plane.noise import CloudNoise, measure_noise
from orthoflow_plugins.plane.parameters import DetectorParams
from orthoflow_plugins.plane.sample import PreparedCloud, Unassigned, prepare, thinned
from orthoflow_plugins.plane.support import CELL_LEAST_M

Report = Callable[[float, str], None]

# Steps of the robust box of detectors that do not look at the plan.
_PLAN_CELL_M: Final = 0.5
# What the report begins with when a plane was found.
_PLANE_FOUND: Final = "plane"
# Candidates in a row that turned out to be none, after which the search gives up.
_REJECTED_MOST: Final = 30

_NO_PLANE: Final = (
    "no plane was found in {count} points ({size}) with tolerance_m {tolerance:.3g} and min_share "
    "{share:.2%}: {why}; {advice}{small} ({method})"
)
_CRITERIA: Final[Mapping[Criterion, str]] = {
    "few": "the largest candidate holds {share:.2%} of the points",
    "scattered": "no points crowd about any candidate",
    "strip": "the candidates are strips too narrow for a plane",
    "smear": "most points near the largest candidate, which holds {share:.2%} of all, only pass "
    "through it, as on a rounded body or in a cloud noisier than the tolerance",
    "bent": "the largest candidate, which holds {share:.2%} of the points, is a curved surface",
    "tilt": "the candidates lean by more than max_tilt_deg",
}
_NO_CANDIDATE: Final = "no candidate was proposed"
_ADVICE: Final = (
    "wider tolerances up to {wider:.3g} m were tried and find none either: lower min_share for "
    "small planes, or raise max_tilt_deg"
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

    def propose(self, unassigned: Unassigned) -> Candidate | None:
        """Name the best candidate among the points that remain, or None when there is none."""

    def reject(self, candidate: Candidate) -> None:
        """Hear that the last candidate was none, so as not to name it again."""


ProposerOf = Callable[[PreparedCloud, Unassigned, Rules], Proposer]


@dataclass(frozen=True, kw_only=True)
class Detector:
    """What is a detector's own on the road.

    Attributes:
        method: id of the method, for messages.
        proposer_of: makes what proposes planes of a cloud, of which nothing is taken yet.
        plan_cell_m: side of the plan's cells; None for detectors that do not look at the plan.
        relabel: changes the claims of the whole cloud once all points have theirs.
    """

    method: str
    proposer_of: ProposerOf
    plan_cell_m: float | None = None
    relabel: Callable[[list[FoundPlane], PreparedCloud], None] | None = None


@dataclass(frozen=True, kw_only=True)
class Detection:
    """What a detector gives back.

    Attributes:
        planes: the planes.
        labels: the plane of each point.
        raw: of each plane what its detector itself said.
    """

    planes: Planes
    labels: PointLabels
    raw: tuple[RawPlane, ...]


def rules_of(params: DetectorParams, noise: CloudNoise | None = None) -> Rules:
    """Return the rules that parameters state, of a cloud with a noise (None: unknown)."""
    find_m, fit_m = params.tolerances_m(noise)
    return Rules(
        find_m=find_m,
        fit_m=fit_m,
        n_planes_most=params.n_planes_max,
        least_share=params.min_share,
        stop_unclassified_share=params.stop_unclassified_share,
        tilt_most_deg=params.max_tilt_deg,
        stop_rest_share=params.stop_rest_share,
        is_exact=params.exact,
        joins_parts=params.join_parts,
    )


def detect(
    cloud: PointCloud, params: DetectorParams, ctx: StepContext, detector: Detector
) -> Detection:
    """Find the planes of a cloud and turn them into products.

    Args:
        cloud: the cloud.
        params: what every detector takes.
        ctx: the step's context.
        detector: what looks for planes.

    Raises:
        ProductError: the cloud has fewer than three points, or coordinates that are not finite.
        MethodError: the points fix no plane, or none has enough of them; or materials are asked for
            of a cloud without intensity.
    """
    if params.materials and cloud.intensity is None:
        raise MethodError(_NO_INTENSITY.format(method=detector.method))
    prepared, found, rules = _found(cloud, params, ctx, detector)
    ctx.progress(0.8, "measuring deviations")
    deviations = measure_planes(
        prepared,
        np.array([item.raster.slab() for item in found]),
        np.array([item.support.bounds_m for item in found]),
        find_m=rules.find_m,
        fit_m=rules.fit_m,
    )
    assembly = assemble(found, prepared, deviations, cloud)
    labels = ctx.allocate("labels", "plane_index", (len(cloud),), np.int16).view(np.int16)
    name_points(prepared, assembly.labels_from_claims, labels)
    ctx.metric("thinning", params.thinning, "1")
    ctx.metric("tolerance_m", rules.find_m, "m")
    ctx.metric("fit_tolerance_m", rules.fit_m, "m")
    _report_planes(ctx, assembly, n_points=len(cloud))
    ctx.progress(0.9, "drawing")
    draw_deviations(ctx, assembly)
    # The last of the labels is for points on no plane: a claim of -1 picks it.
    plane_of_sample = assembly.labels_from_claims[prepared.sample_claims].astype(np.int64)
    draw_planes(ctx, assembly.planes, prepared.sample.offsets_m, plane_of_sample, cloud)
    thickness = measure_thickness(
        assembly.planes,
        plane_of_sample,
        prepared,
        cloud,
        reach_m=rules.fit_m,
        materials=params.materials,
    )
    row = row_points(assembly.planes, plane_of_sample, prepared, cloud)
    _report_thickness(ctx, thickness)
    draw_thickness(ctx, assembly.planes, thickness, row, params.materials)
    planes = replace(
        assembly.planes,
        thickness=thickness,
        scan_row=None if row is None else row.measured(params.materials),
    )
    return Detection(planes=planes, labels=PointLabels(plane_index=labels), raw=assembly.raw)


def find_planes(
    cloud: PreparedCloud, proposer_of: ProposerOf, rules: Rules, report: Report
) -> list[FoundPlane]:
    """Find all planes in the sample of a cloud, then fit them to all points and label those.

    Args:
        cloud: the cloud; its claims are filled.
        proposer_of: the detector.
        rules: when a plane counts and when to stop.
        report: hears progress, 0..1.
    """
    unassigned = Unassigned.of(cloud)
    found = greedy_search(unassigned, proposer_of(cloud, unassigned, rules), rules, report)
    fitted = fit_to_all(found, cloud, rules)
    label(fitted, cloud, rules.find_m)
    return fitted


def greedy_search(
    unassigned: Unassigned,
    proposer: Proposer,
    rules: Rules,
    report: Report,
    refusals: list[Refusal] | None = None,
) -> list[FoundPlane]:
    """Find planes one after the other until a stop rule holds.

    Args:
        unassigned: the sample; its claims are filled.
        proposer: the detector.
        rules: when a plane counts and when to stop.
        report: hears progress, 0..1.
        refusals: gets what refused each candidate that is none.

    Returns:
        The planes in the order they were found; `unassigned.claims` refers to that order.
    """
    found: list[FoundPlane] = []
    n_rejected = 0
    n_all = len(unassigned.claims)
    while len(found) < rules.n_planes_most and n_rejected < _REJECTED_MOST:
        if unassigned.n_points < rules.stop_unclassified_share * n_all:
            break
        candidate = proposer.propose(unassigned)
        if candidate is None:
            break
        plane = verify(candidate, unassigned, rules, refusals)
        if plane is None:
            proposer.reject(candidate)
            n_rejected += 1
            continue
        if plane.support.n_points < rules.stop_rest_share * unassigned.n_points:
            break
        found.append(plane)
        n_rejected = 0
        unassigned.claim(plane.claim(rules.find_m))
        report(len(found) / rules.n_planes_most, f"{_PLANE_FOUND} {len(found)}")
    return found


def _found(
    cloud: PointCloud, params: DetectorParams, ctx: StepContext, detector: Detector
) -> tuple[PreparedCloud, list[FoundPlane], Rules]:
    """Prepare a cloud, and find, fit and label its planes; reports how long that takes."""
    moments_s = [_now(ctx)]
    ctx.progress(0.0, "preparing the points")

    def prepared(points: PointCloud) -> PreparedCloud:
        return prepare(
            points,
            basis_from_up(cloud.up),
            cell_m=_PLAN_CELL_M if detector.plan_cell_m is None else detector.plan_cell_m,
            least_share=params.min_share,
            parts=ctx.cores,
            counts_plan=detector.plan_cell_m is not None,
        )

    def heard(part: float, text: str) -> None:
        if text.startswith(_PLANE_FOUND):
            moments_s.append(_now(ctx))
        ctx.progress(0.1 + 0.7 * part, text)

    whole = prepared(thinned(cloud, params.thinning))
    noise = measure_noise(whole.sample.offsets_m)
    if noise is not None:
        ctx.metric("noise_mm", 1000.0 * noise.single_m, "mm")
    rules = rules_of(params, noise)
    found = find_planes(whole, detector.proposer_of, rules, heard)
    if not found:
        raise MethodError(
            _NO_PLANE.format(
                share=params.min_share,
                count=len(cloud),
                tolerance=rules.find_m,
                why=_why_none(whole, detector.proposer_of, rules),
                advice=_advice(whole, detector.proposer_of, rules),
                **_said_of_size(cloud),
                method=detector.method,
            )
        )
    if params.thinning > 1:
        whole = prepared(cloud)
        label(found, whole, rules.find_m)
    if not params.refit:
        found = [as_proposed(item, whole.up) for item in found]
        label(found, whole, rules.find_m)
    if detector.relabel is not None:
        detector.relabel(found, whole)
    moments_s.append(_now(ctx))
    _report_times(ctx, np.diff(moments_s, axis=0))
    return whole, found, rules


def _why_none(cloud: PreparedCloud, proposer_of: ProposerOf, rules: Rules) -> str:
    """State the criterion that refused the candidate with most points."""
    refusals: list[Refusal] = []
    unassigned = Unassigned.of(cloud)
    proposer = proposer_of(cloud, unassigned, rules)
    greedy_search(unassigned, proposer, rules, lambda _part, _text: None, refusals)
    if not refusals:
        return _NO_CANDIDATE
    largest = max(refusals, key=lambda refusal: refusal.share)
    return _CRITERIA[largest.criterion].format(share=largest.share)


def _advice(cloud: PreparedCloud, proposer_of: ProposerOf, rules: Rules) -> str:
    """Name a wider tolerance with which a plane is found, where one was tried that finds one."""
    for times in _WIDER:
        wider = replace(
            rules,
            find_m=times * rules.find_m,
            fit_m=max(rules.fit_m, 0.3 * times * rules.find_m),
            n_planes_most=1,
        )
        unassigned = Unassigned.of(cloud)
        proposer = proposer_of(cloud, unassigned, wider)
        if greedy_search(unassigned, proposer, wider, lambda _part, _text: None):
            return _ADVICE_WIDER.format(wider=wider.find_m)
    return _ADVICE.format(wider=_WIDER[-1] * rules.find_m)


def _said_of_size(cloud: PointCloud) -> dict[str, str]:
    """Say how large a cloud is, and what helps where it is small: parts of `_NO_PLANE`."""
    sides_m = [float(np.ptp(axis)) for axis in (cloud.x, cloud.y, cloud.z)]
    size = " x ".join(f"{side_m:.3g}" for side_m in sides_m) + " m"
    is_small = sorted(sides_m)[1] < _SMALL_M
    return {"size": size, "small": _SMALL.format(least=2 * CELL_LEAST_M) if is_small else ""}


def _now(ctx: StepContext) -> tuple[float, float]:
    """Give seconds by the clock, and by the processor."""
    return ctx.clock_s(), ctx.processor_s()


def _report_planes(ctx: StepContext, assembly: Assembly, *, n_points: int) -> None:
    """Report number, shares, angles and accuracy of the planes."""
    planes, deviations = assembly.planes, assembly.deviations
    omega_deg, phi_deg = omega_phi_deg(planes.normal[0], planes.up)
    ctx.metric("n_planes", len(planes), "1")
    ctx.metric("labelled_share", float(deviations.n_find.sum()) / n_points, "1")
    ctx.metric("first_share", float(deviations.n_find[0]) / n_points, "1")
    ctx.metric("rms_mm", 1000.0 * float(planes.rms_m[0]), "mm")
    ctx.metric("fit_rms_mm", 1000.0 * float(deviations.rms_fit_m[0]), "mm")
    ctx.metric("omega_deg", omega_deg, "deg")
    ctx.metric("phi_deg", phi_deg, "deg")
    ctx.metric("offset_m", float(planes.offset[0]), "m")
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
    _report_raw(ctx, planes, assembly.raw[0])
    if assembly.n_guessed:
        warn_of_guesses(ctx, assembly.n_guessed, len(planes))


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


def _report_thickness(ctx: StepContext, found: tuple[Thickness | None, ...]) -> None:
    """Report how thick the cloud is on the first plane, beside its scan step, and the worst."""
    known = [item for item in found if item is not None]
    if known:
        ctx.metric("thickest_mm", 1000.0 * max(item.sigma_m for item in known), "mm")
    first = found[0]
    if first is not None:
        ctx.metric("thickness_mm", 1000.0 * first.sigma_m, "mm")
        ctx.metric("thickness_width_mm", 1000.0 * first.width_95_m, "mm")
        ctx.metric("scan_step_mm", 1000.0 * first.scan_step_m, "mm")
        ctx.metric("thickness_scan_steps", first.sigma_m / first.scan_step_m, "1")


def _report_raw(ctx: StepContext, planes: Planes, raw: RawPlane) -> None:
    """Report what the detector itself said about the first plane, and how far the fit moved it."""
    normal, offset_m = raw.plane.normal, raw.plane.offset_m
    omega_deg, phi_deg = omega_phi_deg(normal, planes.up)
    middle = planes.corners[0].mean(axis=0)
    ctx.metric("raw_omega_deg", omega_deg, "deg")
    ctx.metric("raw_phi_deg", phi_deg, "deg")
    ctx.metric("raw_r_m", abs(offset_m), "m")
    ctx.metric("raw_angle_deg", angle_between_deg(normal, planes.normal[0]), "deg")
    ctx.metric("raw_offset_mm", 1000.0 * float(offset_m - normal @ middle), "mm")
