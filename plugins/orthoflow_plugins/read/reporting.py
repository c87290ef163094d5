"""Reports on the scans that were read: limitations, and a summary of each scan."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.points import ScanFile
from orthoflow.files.points.fields import may_be_intensity
from orthoflow.geometry import UpDirection, up_vector
from orthoflow.geometry.cloud_quality import CloudQuality
from orthoflow.geometry.frames import FARTHEST_M
from orthoflow.products import JsonValue, PointCloud
from orthoflow.sdk import DiagnosticSpec, StepContext
from orthoflow_plugins.read.assembly import COARSE_M, FINE_M, CloudAssembly, ScanCount, resolution_m
from orthoflow_plugins.read.scales import IntensityScale

# If the second-longest side of a scan is outside this range, the unit is probably wrong.
_SMALL_M: Final = 1.0
_LARGE_M: Final = 1000.0
# Maximum number of names in a sentence.
_MOST_NAMES: Final = 12

SUMMARY: Final = DiagnosticSpec(
    code="scan-summary",
    severity="note",
    is_summary=True,
    text="{format}: {n_scans} scan{plural}, {n_points:,} points; fields read: {used}; ignored: "
    "{not_used}; unit: {unit}; up: {up}; extent: {extent} m; points left out: {left_out}",
)
NO_EFFECT: Final = DiagnosticSpec(
    code="scan-setting-without-effect",
    text="{step}.{setting} has no effect: {why}",
)
FILE_NOTE: Final = DiagnosticSpec(code="scan-file-differs", text="{text}")
FIELD_ZERO: Final = DiagnosticSpec(
    code="scan-field-zero",
    text="{subject}: the {field} of all points is zero and is treated as missing, not as black",
)
COLOUR_LIMIT: Final = DiagnosticSpec(
    code="scan-colour-limit-misfit",
    text="{subject}: the file declares colours up to {limit:g}, but contains colours up to "
    "{largest:g}, which are read as {scale}",
)
COLOUR_DEPTH: Final = DiagnosticSpec(
    code="scan-colour-depth-small",
    text="{subject}: the file declares no colour range; its colours reach {largest:g} and are "
    "read as {scale}",
    rank_by="largest",
)
COLOURS_GREY: Final = DiagnosticSpec(
    code="scan-colours-grey",
    text="the colours are all grey and follow the intensity: they do not come from photos",
)
INTENSITY_LIMITS: Final = DiagnosticSpec(
    code="scan-intensity-limits-misfit",
    text="{subject}: the file declares intensities from {stated_low:g} to {stated_high:g}, which "
    "do not fit its data: they are scaled from {low:g} to {high:g}",
    remedy="set the intensity of white with {step}.intensity_max=NUMBER",
)
INTENSITY_CLIPPED: Final = DiagnosticSpec(
    code="scan-intensity-clipped",
    text="{subject}: {n_points} intensities are outside {low:g} to {high:g} ({rule}) and were "
    "clipped",
    rank_by="n_points",
)
INTENSITY_RANGES: Final = DiagnosticSpec(
    code="scan-intensity-ranges-differ",
    text="the intensities of the scans have different ranges ({ranges}), and their files declare "
    "no limits: each scan is scaled by its own range, so the same surface may differ in brightness",
    remedy="set the same limit for all scans with {step}.intensity_max=NUMBER",
)
INTENSITY_LUMINANCE: Final = DiagnosticSpec(
    code="scan-intensity-is-luminance",
    text="the intensity is not laser intensity but the luminance of the colours (correlation "
    "{correlation:.5f}), so it is ignored",
)
WITHOUT_FIELD: Final = DiagnosticSpec(
    code="points-without-field",
    text="{subject}: {n_points} points have no {field}, only coordinates",
    rank_by="n_points",
)
NO_INTENSITY: Final = DiagnosticSpec(
    code="scan-intensity-not-chosen",
    text="the scans have no intensity; fields not used: {names}",
    remedy="set {step}.intensity_field={candidate} to use one as the intensity",
)
FEW_STATIONS: Final = DiagnosticSpec(
    code="scan-stations-missing",
    text="only {n_stations} of {n_scans} scans contain a scanner position; the nearest "
    "station determines the front of a wall",
)
COARSE_OFFSETS: Final = DiagnosticSpec(
    code="scan-offsets-coarse",
    text="the points reach {farthest_m:.0f} m from the origin of the cloud, where coordinates are "
    "rounded to {resolution_mm:.2f} mm",
    remedy="check {step}.unit, or remove stray points with {step}.box",
)
ROUNDED: Final = DiagnosticSpec(
    code="scan-coordinates-rounded",
    text="the coordinates of {subject} are rounded to {rounding_mm:g} mm, which limits the "
    "resolution of planes and depths; a grid may be visible",
    rank_by="rounding_mm",
)
SIZE: Final = DiagnosticSpec(
    code="scan-size-implausible",
    text="the extent of the scan is {size} m ({unit}), which is unusual",
    remedy="set {step}.unit={other} if the file is in {other}, or to cm, ft, us-ft or in",
)
LEFT_OUT: Final = DiagnosticSpec(
    code="points-left-out",
    text="{subject}: {n_points} points {why}, and were left out",
    remedy="check the file and {step}.unit",
    rank_by="n_points",
)
OTHER_UP: Final = DiagnosticSpec(
    code="scan-up-doubtful",
    text="the up axis seems to be {axis}, not {up}: {share:.0%} of the surfaces are horizontal or "
    "vertical with respect to it, {share_up:.0%} with respect to {up}",
    remedy="set {step}.up={axis}, or -{axis} if floors become ceilings",
)
THICK: Final = DiagnosticSpec(
    code="scan-thick",
    text="the cloud is thicker than its point spacing: in patches of about {side_cm:.0f} cm, the "
    "points scatter by {sigma_mm:.1f} mm normal to the surface (95 % within {width_mm:.1f} "
    "mm), and the nearest other point is {step_mm:.1f} mm away, which limits the accuracy of "
    "planes and depths",
    remedy="check for noise, rough surfaces and misaligned scans",
    rank_by="sigma_mm",
)
DISAGREE: Final = DiagnosticSpec(
    code="scans-disagree",
    text="the scans disagree: where two show the same surface, they are {apart_mm:.1f} "
    "mm apart (median), while the scatter of each is {sigma_mm:.1f} mm",
    remedy="register them again, or use only one of them",
    rank_by="apart_mm",
)
RULES: Final = {
    "intensity_max": "intensity_max",
    "stated": "limits in the file",
    "nominal": "usual range of such data",
    "data": "range of its data",
}


def report_notes(ctx: StepContext, file: ScanFile) -> None:
    """Report the notes of the reader."""
    for note in file.notes:
        ctx.report(FILE_NOTE, subject=file.name, text=note)


def report_scales(
    ctx: StepContext,
    counts: Sequence[ScanCount],
    scales: Sequence[IntensityScale | None],
    clipped: Sequence[int],
) -> None:
    """Report intensities outside the range in the metadata, and scans with different scales."""
    for count, scale, n_clipped in zip(counts, scales, clipped, strict=True):
        if scale is None:
            continue
        low, high = scale.low, scale.high
        if n_clipped:
            ctx.report(
                INTENSITY_CLIPPED,
                subject=count.title,
                n_points=n_clipped,
                low=low,
                high=high,
                rule=RULES[scale.rule],
            )
        if scale.stated is not None:
            ctx.report(
                INTENSITY_LIMITS,
                subject=count.title,
                stated_low=scale.stated[0],
                stated_high=scale.stated[1],
                low=low,
                high=high,
            )
    known = [(c, s) for c, s in zip(counts, scales, strict=True) if s is not None]
    ranges: dict[str, str] = {}
    for count, scale in known:
        ranges.setdefault(f"{scale.low:g} to {scale.high:g}", count.title)
    if len(ranges) > 1 and any(scale.rule in ("data", "nominal") for _, scale in known):
        texts = [f"{title} {text}" for text, title in ranges.items()]
        ctx.report(INTENSITY_RANGES, ranges=_listed(texts))


def report_fields(ctx: StepContext, counts: Sequence[ScanCount], cloud: PointCloud) -> None:
    """Report attributes that only some scans have, and fields that could be the intensity."""
    counts = [count for count in counts if count.n_kept]
    without = {"colour": [count.n_without_rgb for count in counts]}
    if cloud.intensity is not None:
        without["intensity"] = [
            int(np.count_nonzero(np.isnan(cloud.intensity[count.start : count.stop])))
            for count in counts
        ]
    if cloud.rgb is None:
        del without["colour"]
    for name, missing in without.items():
        for count, n_missing in zip(counts, missing, strict=True):
            if n_missing:
                ctx.report(WITHOUT_FIELD, subject=count.title, field=name, n_points=n_missing)
    unused = _names(count.scan.fields_not_used for count in counts)
    candidates = [name for name in unused if may_be_intensity(name)]
    if cloud.intensity is None and candidates:
        ctx.report(NO_INTENSITY, names=_listed(unused), candidate=candidates[0])


def report_precision(
    ctx: StepContext,
    assembly: CloudAssembly,
    extents: Sequence[NDArray[np.float64]],
    unit: str | None,
) -> dict[str, JsonValue]:
    """Report coarse coordinates, and sizes that are implausible for walls and buildings."""
    farthest_m = max(float(np.abs(values).max()) for values in assembly.offsets)
    resolution = resolution_m(farthest_m)
    if resolution > FINE_M:
        ctx.report(COARSE_OFFSETS, farthest_m=farthest_m, resolution_mm=1000 * resolution)
    roundings = {count.file: count.rounding_m for count in assembly.counts}
    for name, rounding in roundings.items():
        if rounding >= COARSE_M:
            ctx.report(ROUNDED, subject=name, rounding_mm=1000 * rounding)
    low, high = np.min(extents, axis=(0, 1)), np.max(extents, axis=(0, 1))
    side_m = float(np.median(high - low))
    if not _SMALL_M <= side_m <= _LARGE_M:
        units = [unit_and_source(count, unit) for count in assembly.counts]
        is_assumed = {source for _, source in units} == {"assumed"}
        ctx.report(
            SIZE,
            size=_size(high - low),
            unit="no file contains a unit" if is_assumed else f"unit {units[0][0]}",
            other="mm" if side_m > _LARGE_M else "m" if units[0][0] in ("mm", "cm") else "km",
        )
    return {"resolution_m": resolution, "rounding_m": max(roundings.values())}


def unit_and_source(count: ScanCount, unit: str | None) -> tuple[str, str]:
    """Return the unit of a scan and its source; `unit` is given by the user, or None."""
    if unit is not None:
        return unit, "cloud.unit"
    stated = count.scan.unit
    return ("m", "assumed") if stated is None else (stated.name, stated.source)


def scan_json(
    count: ScanCount, scale: IntensityScale | None, unit: str | None
) -> dict[str, JsonValue]:
    """Return the summary of a scan for `scans.json`."""
    name, unit_from = unit_and_source(count, unit)
    return {
        "file": count.file,
        "scan": count.index,
        "name": count.scan.name,
        "format": count.format_name,
        "n_points": count.n_kept,
        "n_read": count.n_read,
        "fields_used": list(count.scan.fields_used),
        "fields_not_used": list(count.scan.fields_not_used),
        "unit": name,
        "unit_m": count.unit_m.tolist(),
        "unit_from": unit_from,
        "left_out": {cause: n for cause, n in sorted(count.left_out.items()) if n},
        "n_without_colour": count.n_without_rgb,
        "intensity": None
        if scale is None
        else {"low": scale.low, "high": scale.high, "rule": scale.rule},
        "rgb_scale": None if count.colours is None else count.colours.scale,
        "rounding_m": count.rounding_m,
    }


def report_summary(
    ctx: StepContext, assembly: CloudAssembly, cloud: PointCloud, *, up: str, unit: str | None
) -> None:
    """Report counts and the extent as metrics, and a summary in one line."""
    counts = assembly.counts
    left_out: Counter[str] = Counter()
    for count in counts:
        left_out.update({cause: n for cause, n in count.left_out.items() if n})
        far = " ".join(f"{value:g}" for value in count.first_far_m)
        place = "" if count.repeated_m is None else " ".join(map("{:.3f}".format, count.repeated_m))
        reasons = {
            "too_far": f"are farther than {FARTHEST_M:g} m from the origin, the first at {far}",
            "one_place": f"are at exactly {place}, where the scanner had no return",
            "no_return": "are at 0 0 0, where the scanner had no return",
            "not_finite": "have coordinates that are not finite",
        }
        for cause, why in reasons.items():
            if count.left_out[cause]:
                n_points = count.left_out[cause]
                ctx.report(LEFT_OUT, subject=count.title, n_points=n_points, why=why)
    ctx.metric("n_points", len(cloud), "1")
    ctx.metric("n_points_left_out", left_out.total(), "1")
    for cause, n_points in sorted(left_out.items()):
        ctx.metric(f"n_left_out_{cause}", n_points, "1")
    ctx.metric("n_scans", len(counts), "1")
    ctx.metric("n_stations", 0 if cloud.stations is None else len(cloud.stations), "1")
    sides_m = np.array([values.max() - values.min() for values in assembly.offsets])
    for side_m, name in zip(sides_m, "xyz", strict=True):
        ctx.metric(f"extent_{name}_m", float(side_m), "m")
    units = dict.fromkeys(unit_and_source(count, unit) for count in counts)
    causes = [f"{n} {cause.replace('_', ' ')}" for cause, n in sorted(left_out.items())]
    ctx.report(
        SUMMARY,
        format=", ".join(dict.fromkeys(count.format_name for count in counts)),
        n_scans=len(counts),
        plural="" if len(counts) == 1 else "s",
        n_points=len(cloud),
        used=_listed(_names(count.scan.fields_used for count in counts)),
        not_used=_listed(_names(count.scan.fields_not_used for count in counts)) or "none",
        unit=_listed([f"{name} ({source})" for name, source in units]),
        up=up,
        extent=_size(sides_m),
        left_out=", ".join(causes) or "none",
    )


def warn_of_up(quality: CloudQuality | None, up: UpDirection, ctx: StepContext) -> None:
    """Warn if most surfaces are horizontal or vertical for an axis other than the given one."""
    axis = None if quality is None else quality.plainly_up(up_vector(up))
    if quality is None or axis is None:
        return
    by_up, by_other = (quality.square_shares(one)[1] for one in (up_vector(up), np.eye(3)[axis]))
    ctx.report(OTHER_UP, axis="xyz"[axis], up=up, share=by_other, share_up=by_up)


def report_quality(quality: CloudQuality | None, ctx: StepContext) -> None:
    """Report quality metrics; warn if surfaces of the cloud are thick or its scans disagree."""
    if quality is None:
        return
    sigma_mm, step_mm = 1e3 * quality.sigma_m, 1e3 * quality.scan_step_m
    ctx.metric("thickness_mm", sigma_mm, "mm")
    ctx.metric("thickness_width_mm", 1e3 * quality.width_95_m, "mm")
    ctx.metric("scan_step_mm", step_mm, "mm")
    ctx.metric("thickness_scan_steps", quality.sigma_m / quality.scan_step_m, "1")
    if quality.is_thick:
        ctx.report(
            THICK,
            side_cm=1e2 * quality.side_m,
            sigma_mm=sigma_mm,
            width_mm=1e3 * quality.width_95_m,
            step_mm=step_mm,
        )
    if quality.scans_apart_m is None:
        return
    apart_mm = 1e3 * quality.scans_apart_m
    ctx.metric("scans_apart_mm", apart_mm, "mm")
    if quality.disagrees:
        ctx.report(DISAGREE, apart_mm=apart_mm, sigma_mm=sigma_mm)


def _names(groups: Iterable[Sequence[str]]) -> list[str]:
    return list(dict.fromkeys(name for group in groups for name in group))


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return ", ".join(names[:_MOST_NAMES]) + more


def _size(sides_m: NDArray[np.float64]) -> str:
    return " x ".join(
        f"{side_m:.3f}" if 0.1 < side_m < 1e4 else f"{side_m:.3g}" for side_m in sides_m
    )
