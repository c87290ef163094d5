"""What a detector says about its planes: metrics of the first, a warning of guessed sides."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import angle_between_deg, omega_phi_deg
from orthoflow.products import Planes
from orthoflow.sdk import StepContext
from orthoflow_plugins.plane.assembling import Assembly
from orthoflow_plugins.plane.thickness import Thickness


def report_planes(ctx: StepContext, assembly: Assembly, *, n_points: int) -> None:
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
    _report_raw(ctx, planes)
    if assembly.n_guessed:
        warn_of_guesses(ctx, assembly.n_guessed, len(planes))


def report_times(ctx: StepContext, passed_s: NDArray[np.float64]) -> None:
    """Report the seconds of a detection, loading apart, as Table 1 of markiewicz2015 does.

    Args:
        ctx: takes the metrics.
        passed_s: seconds up to each plane, and from the last one to the labels of all points.
    """
    ctx.metric("detection_s", float(passed_s.sum()), "s")
    ctx.metric("first_plane_s", float(passed_s[0]), "s")
    if len(passed_s) > 2:
        ctx.metric("next_plane_s", float(passed_s[1:-1].mean()), "s")


def report_thickness(ctx: StepContext, found: tuple[Thickness | None, ...]) -> None:
    """Report how thick the cloud is on the first plane, beside its scan step, and the worst."""
    known = [item for item in found if item is not None]
    if known:
        ctx.metric("thickest_mm", 1000.0 * max(item.sigma_m for item in known), "mm")
    first = found[0]
    if first is not None:
        ctx.metric("thickness_mm", 1000.0 * first.sigma_m, "mm")
        ctx.metric("thickness_width_mm", 1000.0 * first.width_m, "mm")
        ctx.metric("scan_step_mm", 1000.0 * first.scan_step_m, "mm")
        ctx.metric("thickness_scan_steps", first.sigma_m / first.scan_step_m, "1")


def _report_raw(ctx: StepContext, planes: Planes) -> None:
    """Report what the detector itself said about the first plane, and how far the fit moved it."""
    raw = planes.details["raw"]
    if not isinstance(raw, list) or not isinstance(raw[0], dict):
        return
    normal = np.array(raw[0]["normal"], dtype=np.float64)
    offset_m = float(str(raw[0]["offset_m"]))
    omega_deg, phi_deg = omega_phi_deg(normal, planes.up)
    middle = planes.corners[0].mean(axis=0)
    ctx.metric("raw_omega_deg", omega_deg, "deg")
    ctx.metric("raw_phi_deg", phi_deg, "deg")
    ctx.metric("raw_r_m", abs(offset_m), "m")
    ctx.metric("raw_angle_deg", angle_between_deg(normal, planes.normal[0]), "deg")
    ctx.metric("raw_offset_mm", 1000.0 * float(offset_m - normal @ middle), "mm")


def warn_of_guesses(ctx: StepContext, n_guessed: int, n_planes: int) -> None:
    """Say that the side from which planes are seen was guessed, and how to state it."""
    ctx.warn(
        f"no scanner station says from which side {n_guessed} of {n_planes} planes were seen; the "
        "side with more of the other points was taken: if an image comes out mirrored, set "
        "view_from of read.scan"
    )
