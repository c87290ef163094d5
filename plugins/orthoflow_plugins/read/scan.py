"""`read.scan`: point files of scanners and other programs into one cloud."""

from __future__ import annotations

from collections import Counter
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, ClassVar, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from orthoflow.errors import InputError
from orthoflow.files.points import Scan, ScanFile, open_scan
from orthoflow.files.points.copc import Wish
from orthoflow.files.points.fields import Columns, columns_of_user, plain_name
from orthoflow.files.points.formats import LAS, TEXT
from orthoflow.files.points.units import UNITS_M, refuse_degrees
from orthoflow.geometry import UpDirection, up_vector
from orthoflow.geometry.frames import FARTHEST_M
from orthoflow.products import InputFiles, JsonValue, PointCloud
from orthoflow.sdk import Method, MethodParams, Ports, StepContext
from orthoflow_plugins.read.assembly import (
    COARSE_M,
    FINE_M,
    CloudAssembly,
    ScanCount,
    resolution_m,
)
from orthoflow_plugins.read.figures import plan_view_png, polar_view_png, scan_lines_png
from orthoflow_plugins.read.quality import judge_quality, report_quality, warn_of_up
from orthoflow_plugins.read.scales import (
    LUMINANCE_CORRELATION,
    IntensityScale,
    choose_scales,
    correlation_with_grey,
    is_grey,
    normalise,
    robust_range,
)
from orthoflow_plugins.read.stations import ScanSummary, Stations, choose_stations

Unit = Literal["m", "cm", "mm", "ft", "us-ft", "in", "km"]
Corner = tuple[float, float, float]

# Where two sides of a scan are shorter, it is rather in another unit than of a wall.
_SMALL_M: Final = 1.0

# Where two sides of a scan are longer, it is rather in millimetres than of a building.
_LARGE_M: Final = 1000.0
_PERCENTILES: Final = (0.5, 99.5)
_SAMPLE: Final = 200_000


class ReadScan(Method):
    """Read E57, LAS, LAZ, COPC, PLY, PCD, PTX and text scans, several files into one cloud."""

    id = "read.scan"
    result_version = 2
    determinism = "exact"
    metrics = (
        "n_points",
        "n_scans",
        "n_stations",
        "n_invalid",
        "n_not_finite",
        "n_withheld",
        "n_points_left_out",
        "n_left_out_*",
        "extent_[xyz]_m",
        "thickness_mm",
        "thickness_width_mm",
        "thickness_scan_steps",
        "scan_step_mm",
        "scans_apart_mm",
    )
    citations: ClassVar[tuple[str, ...]] = (
        "ASTM E2807, E57 file format for 3D imaging data exchange",
        "ASPRS LAS specification 1.4 R15",
    )

    class Params(MethodParams):
        """What the files do not say themselves."""

        up: UpDirection = Field("z", description="World direction that is up in the files.")
        unit: Unit | None = Field(
            None,
            description="Unit of the files' coordinates, whatever they state; None: what each "
            "file states, metres where it states none. The cloud is in metres.",
        )
        view_from: tuple[float, float, float] | None = Field(
            None,
            description="Where a viewer stands, [x, y, z], world metres (unit applied); tells the "
            "front of a wall from its back when the files have no scanner positions.",
        )
        columns: str | tuple[str, ...] | None = Field(
            None,
            description="Columns of text files, [x, y, z, r, g, b, intensity] or 'x y z _'; _ "
            "skips one. None: the header names them, else their number and values.",
        )
        intensity_field: str | None = Field(
            None,
            description="Name of the field that is the intensity, e.g. Reflectance; None: the "
            "usual one of the format, else reflectance, amplitude or remission.",
        )
        intensity_max: float | None = Field(
            None,
            gt=0,
            description="Intensity in the files that becomes 1 (0 becomes 0); None: for each scan "
            "the limits it states, if its data fit them, else the range of its data.",
        )

        box: tuple[Corner, Corner] | None = Field(
            None,
            description="Lowest and highest corner, [[x, y, z], [x, y, z]], world metres (after "
            "unit was applied): points outside are left out, those on its faces are kept.",
        )
        gsd_m: float | None = Field(
            None,
            gt=0,
            description="Of a COPC file read points only as dense as this, in metres: levels of "
            "its octree down to the first whose points are no farther apart. None reads all.",
        )
        classes: tuple[Annotated[int, Field(ge=0, le=255)], ...] = Field(
            (),
            description="Classes of LAS and LAZ points that are kept, e.g. [1, 6] (ASPRS: 6 is "
            "building); empty for all.",
        )

        @model_validator(mode="after")
        def _box_has_an_inside(self) -> Self:
            if self.box is not None and not all(
                low < high for low, high in zip(*self.box, strict=True)
            ):
                raise ValueError(
                    "box must be [[x, y, z], [x, y, z]], the lowest corner and then the highest, "
                    f"got {[list(corner) for corner in self.box]}"
                )
            return self

    class In(Ports):
        """The files."""

        files: InputFiles

    class Out(Ports):
        """The cloud of all files."""

        cloud: PointCloud

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Read all files; see the class."""
        columns = None if params.columns is None else columns_of_user(params.columns)
        if not inputs.files.paths:
            raise InputError(f"the input {inputs.files.name} names no files: expected a scan")
        box_m = None if params.box is None else np.array(params.box)
        files = [_opened(path, columns, box_m, params) for path in inputs.files.paths]
        _warn_of_settings(ctx, files, params)
        assembly = CloudAssembly(ctx, files, partial(_unit_m, params=params), box_m)
        for file in files:
            # Damaged numbers overflow on their way; what is not finite is dropped and counted.
            with np.errstate(all="ignore"):
                assembly.add_file(file)
            for note in file.notes:
                ctx.warn(note)
        assembly.require_points()
        cloud = _finish(ctx, assembly, params)
        ctx.figure(
            "plan",
            plan_view_png(cloud),
            "The cloud from above, brighter where denser: walls are thin bright lines; double "
            "lines are scans that do not fit each other.",
        )
        polar = polar_view_png(cloud)
        if polar is not None:
            ctx.figure(
                "polar",
                polar,
                "Intensity over the scanner's own rows and columns: what the scanner saw; black is "
                "no return, and where a wall is black nothing can be measured on it.",
            )
        lines = scan_lines_png(cloud)
        if lines is not None:
            caption = (
                "A wall seen squarely: rows of the scan yellow, columns blue. Meshes are even "
                "where the scan is good; lines that break off or cross are gaps and mixed points."
            )
            ctx.figure("scan-lines", lines, caption)
        return self.Out(cloud=cloud)

    @classmethod
    def tools(cls) -> dict[str, str]:
        """Libraries that decode the files."""
        return {name: version(name) for name in ("laspy", "lazrs", "pandas", "pye57")}


def _opened(
    path: Path, columns: Columns | None, box_m: NDArray[np.float64] | None, params: ReadScan.Params
) -> ScanFile:
    """Open a file; of COPC only the parts that are asked for, in the file's unit."""
    opened = partial(
        open_scan,
        path,
        columns,
        classes=params.classes,
        intensity_field=params.intensity_field,
    )
    file = opened()
    for scan in file.scans:
        if scan.unit is not None and params.unit is None:
            refuse_degrees(file.name, scan.unit)
    if file.format_name != LAS.name or (box_m is None and params.gsd_m is None):
        return file
    unit_m = _unit_m(file.scans[0], params)
    wish = Wish(
        box=None if box_m is None else box_m / unit_m,
        spacing=None if params.gsd_m is None else params.gsd_m / float(unit_m[0]),
    )
    return opened(wish=wish)


def _unit_m(scan: Scan, params: ReadScan.Params) -> NDArray[np.float64]:
    """Metres per unit of a scan, along x, y and z."""
    if params.unit is not None:
        return np.full(3, UNITS_M[params.unit])
    return np.ones(3) if scan.unit is None else np.array(scan.unit.metres)


def _warn_of_settings(ctx: StepContext, files: list[ScanFile], params: ReadScan.Params) -> None:
    formats = {file.format_name for file in files}
    if params.gsd_m is not None and not any(file.is_chosen for file in files):
        ctx.warn("gsd_m only concerns COPC files, and none was read; it has no effect")
    if params.classes and LAS.name not in formats:
        ctx.warn("classes only concerns LAS and LAZ files, and none was read; it has no effect")
    if params.columns is not None and TEXT.name not in formats:
        ctx.warn("columns only concerns text files, and none was read; it has no effect")
    wanted = params.intensity_field
    if wanted is not None:
        found = {name for file in files for scan in file.scans for name in scan.fields_used}
        if plain_name(wanted) not in {plain_name(name) for name in found}:
            others = {n for file in files for scan in file.scans for n in scan.fields_not_used}
            raise InputError(
                f"cloud.intensity_field={wanted}: no file has such a field; they have "
                f"{', '.join(sorted(found | others))}"
            )


def _finish(ctx: StepContext, assembly: CloudAssembly, params: ReadScan.Params) -> PointCloud:
    """Turn raw arrays into a cloud, and report what limits it."""
    rgb, has_rgb = _colours(ctx, assembly)
    intensity, scales = _intensity(ctx, assembly, params)
    intensity, intensity_source = _judged_intensity(ctx, intensity, rgb, has_rgb)
    summaries = _summaries(assembly)
    stations = choose_stations(summaries, params.view_from)
    _warn_of_stations(ctx, stations, len(summaries), params)
    precision = _precision(ctx, assembly, summaries)
    x, y, z = assembly.offsets
    cloud = PointCloud(
        origin=assembly.origin,
        x=x,
        y=y,
        z=z,
        up=up_vector(params.up),
        intensity=intensity,
        rgb=rgb,
        has_rgb=has_rgb,
        scan=assembly.array("scan") if stations.per_scan or stations.source != "file" else None,
        row=assembly.array("row"),
        column=assembly.array("column"),
        stations=stations.positions,
        stations_source=stations.source,
        source={
            "up": params.up,
            "intensity_source": intensity_source,
            "scans": [
                _scan_json(count, scale, params)
                for count, scale in zip(assembly.counts, scales, strict=True)
            ],
            **precision,
        },
    )
    _report_fields(ctx, assembly, cloud)
    _report_summary(ctx, assembly, cloud, params)
    quality = judge_quality(assembly.offsets, assembly.array("scan"))
    report_quality(quality, ctx)
    warn_of_up(quality, params.up, ctx)
    return cloud


def _colours(
    ctx: StepContext, assembly: CloudAssembly
) -> tuple[NDArray[np.uint8] | None, NDArray[np.bool_] | None]:
    rgb, has_rgb = assembly.array("rgb"), assembly.array("has_rgb")
    if rgb is None:
        return None, None
    for count in assembly.counts:
        part, colours = slice(count.start, count.stop), count.colours
        if colours is None or not count.n_kept:
            continue
        if not rgb[part].any():
            ctx.warn(
                f"{count.title}: the colours of all points are zero: they are taken as absent, "
                "not as black"
            )
            count.n_without_rgb = count.n_kept
            if has_rgb is None:
                has_rgb = assembly.with_all_colours()
            has_rgb[part] = False
        elif colours.misfit is not None:
            ctx.warn(
                f"{count.title}: it states that colours reach {colours.misfit:g}, but they reach "
                f"{colours.largest:g}: the limit does not fit and they are read as {colours.scale}"
            )
    if has_rgb is not None and not has_rgb.any():
        return None, None
    return rgb, has_rgb


def _intensity(
    ctx: StepContext, assembly: CloudAssembly, params: ReadScan.Params
) -> tuple[NDArray[np.float32] | None, list[IntensityScale | None]]:
    intensity = assembly.array("intensity")
    if intensity is None:
        return None, [None] * len(assembly.counts)
    ranges: list[tuple[float, float] | None] = []
    for count in assembly.counts:
        values = intensity[count.start : count.stop]
        seen = robust_range(values)
        if seen == (0.0, 0.0) and not np.nan_to_num(values).any():
            ctx.warn(f"{count.title}: the intensity of all points is zero: it is taken as absent")
            values[:] = np.nan
            seen = None
        ranges.append(seen)
    stated = [count.scan.intensity_limits for count in assembly.counts]
    scales = choose_scales(ranges, stated, params.intensity_max)
    for count, scale in zip(assembly.counts, scales, strict=True):
        values = intensity[count.start : count.stop]
        if scale is None:
            continue
        n_clipped = normalise(values, scale)
        if n_clipped:
            ctx.warn(
                f"{count.title}: {n_clipped} intensities lie beyond {scale.low:g} to "
                f"{scale.high:g} ({_RULES[scale.rule]}) and were clipped"
            )
        if scale.stated is not None:
            ctx.warn(
                f"{count.title}: it states intensities from {scale.stated[0]:g} to "
                f"{scale.stated[1]:g}, which its data do not fit: they are scaled from "
                f"{scale.low:g} to {scale.high:g}"
            )
    if all(scale is None for scale in scales):
        return None, scales
    return intensity, scales


def _judged_intensity(
    ctx: StepContext,
    intensity: NDArray[np.float32] | None,
    rgb: NDArray[np.uint8] | None,
    has_rgb: NDArray[np.bool_] | None,
) -> tuple[NDArray[np.float32] | None, str]:
    """Leave out an intensity that only repeats the colours, and tell where it comes from."""
    if intensity is None:
        return None, "none"
    if rgb is None:
        return intensity, "laser"
    correlation = correlation_with_grey(intensity, rgb, has_rgb)
    if correlation < LUMINANCE_CORRELATION:
        return intensity, "laser"
    if is_grey(rgb):
        ctx.warn("the colours are all grey and follow the intensity: they are no photographs")
        return intensity, "laser"
    if has_rgb is not None:
        return intensity, "luminance"
    ctx.warn(
        f"the intensity is not the laser's but the luminance of the colours (correlation "
        f"{correlation:.5f}): it is left out, the colours hold it"
    )
    return None, "luminance"


def _summaries(assembly: CloudAssembly) -> list[ScanSummary]:
    found = []
    for count in assembly.counts:
        if not count.n_kept:
            continue
        step = max(1, count.n_kept // _SAMPLE)
        low, high = np.array(
            [
                np.percentile(values[count.start : count.stop : step], _PERCENTILES)
                for values in assembly.offsets
            ]
        ).T
        station = count.scan.station
        found.append(
            ScanSummary(
                station=None if station is None else station * count.unit_m,
                is_posed=count.scan.station_is_posed,
                low=assembly.origin + low,
                high=assembly.origin + high,
            )
        )
    return found


def _report_fields(ctx: StepContext, assembly: CloudAssembly, cloud: PointCloud) -> None:
    """Report which scans lack what others have, and which fields are not used."""
    counts = [count for count in assembly.counts if count.n_kept]
    for title, is_there, missing in (
        ("colour", cloud.rgb is not None, [count.n_without_rgb for count in counts]),
        (
            "intensity",
            cloud.intensity is not None,
            [_n_without_intensity(cloud, count) for count in counts],
        ),
    ):
        without = [c for c, n in zip(counts, missing, strict=True) if n == c.n_kept]
        if is_there and without:
            n_points = sum(count.n_kept for count in without)
            names = ", ".join(count.title for count in without[:3])
            more = f" and {len(without) - 3} more" if len(without) > 3 else ""
            ctx.warn(f"{names}{more} has no {title}: its {n_points} points have a position only")
        n_invalid = sum(n for c, n in zip(counts, missing, strict=True) if n < c.n_kept)
        if is_there and n_invalid:
            ctx.warn(f"{n_invalid} points have no valid {title}: they have a position only")
    unused = list(dict.fromkeys(n for count in counts for n in count.scan.fields_not_used))
    if unused:
        shown = ", ".join(unused[:12]) + (" ..." if len(unused) > 12 else "")
        text = f"fields not used: {shown}"
        if cloud.intensity is None:
            ctx.warn(f"{text}; one of them can be the intensity: cloud.intensity_field={unused[0]}")
        else:
            ctx.log(f"{text}; cloud.intensity_field=NAME takes one as the intensity")


def _n_without_intensity(cloud: PointCloud, count: ScanCount) -> int:
    if cloud.intensity is None:
        return count.n_kept
    return int(np.count_nonzero(np.isnan(cloud.intensity[count.start : count.stop])))


def _warn_of_stations(
    ctx: StepContext, stations: Stations, n_scans: int, params: ReadScan.Params
) -> None:
    if stations.source == "file" and not stations.per_scan and stations.positions is not None:
        ctx.warn(
            f"only {len(stations.positions)} of {n_scans} scans state where the scanner "
            "stood; the nearest station decides the front of a wall"
        )
    if stations.source == "file" and params.view_from is not None:
        ctx.warn("view_from has no effect: the files state where the scanner stood")


def _precision(
    ctx: StepContext, assembly: CloudAssembly, summaries: list[ScanSummary]
) -> dict[str, JsonValue]:
    farthest_m = max(float(np.abs(values).max()) for values in assembly.offsets)
    resolution = resolution_m(farthest_m)
    if resolution > FINE_M:
        ctx.warn(
            f"the points reach {farthest_m:.0f} m from the origin of the cloud, where coordinates "
            f"are kept to {1000 * resolution:.2f} mm only: check unit, or cut stray points off"
        )
    roundings = {count.file: count.rounding_m for count in assembly.counts}
    for name, rounding in roundings.items():
        if rounding >= COARSE_M:
            ctx.warn(
                f"the coordinates of {name} are rounded to {1000 * rounding:g} mm: "
                "planes and depths cannot be finer, and a grid may show"
            )
    low = np.min([summary.low for summary in summaries], axis=0)
    high = np.max([summary.high for summary in summaries], axis=0)
    _warn_of_size(ctx, assembly, high - low)
    return {"resolution_m": resolution, "rounding_m": max(roundings.values())}


def _warn_of_size(ctx: StepContext, assembly: CloudAssembly, sides_m: NDArray[np.float64]) -> None:
    side_m = float(np.median(sides_m))
    if _SMALL_M <= side_m <= _LARGE_M:
        return
    size = " x ".join(f"{side:.3g}" for side in sides_m)
    units, sources = zip(*(_unit_and_source(count, None) for count in assembly.counts), strict=True)
    other = "mm" if side_m > _LARGE_M else "km"
    stated = "no file states a unit" if set(sources) == {"assumed"} else f"unit {units[0]}"
    ctx.warn(
        f"the scan is {size} m ({stated}): is that right? Set cloud.unit={other} if it is in "
        f"{other}, or cm, ft, us-ft, in"
    )


def _unit_and_source(count: ScanCount, unit: str | None) -> tuple[str, str]:
    if unit is not None:
        return unit, "cloud.unit"
    stated = count.scan.unit
    return ("m", "assumed") if stated is None else (stated.name, stated.source)


def _scan_json(
    count: ScanCount, scale: IntensityScale | None, params: ReadScan.Params
) -> dict[str, JsonValue]:
    unit, unit_from = _unit_and_source(count, params.unit)
    left_out: dict[str, JsonValue] = {c: n for c, n in sorted(count.left_out.items()) if n}
    return {
        "file": count.file,
        "scan": count.index,
        "name": count.scan.name,
        "format": count.format_name,
        "n_points": count.n_kept,
        "n_read": count.n_read,
        "fields_used": list(count.scan.fields_used),
        "fields_not_used": list(count.scan.fields_not_used),
        "unit": unit,
        "unit_m": count.unit_m.tolist(),
        "unit_from": unit_from,
        "left_out": left_out,
        "n_without_colour": count.n_without_rgb,
        "intensity": None
        if scale is None
        else {"low": scale.low, "high": scale.high, "rule": scale.rule},
        "rgb_scale": None if count.colours is None else count.colours.scale,
        "rounding_m": count.rounding_m,
    }


def _report_summary(
    ctx: StepContext, assembly: CloudAssembly, cloud: PointCloud, params: ReadScan.Params
) -> None:
    """Report counts and extent as metrics, and everything in one line."""
    counts = assembly.counts
    left_out = Counter({c: n for c, n in sum((k.left_out for k in counts), Counter()).items() if n})
    ctx.metric("n_points", len(cloud), "1")
    ctx.metric("n_points_left_out", left_out.total(), "1")
    for cause, n_points in sorted(left_out.items()):
        ctx.metric(f"n_left_out_{cause}", n_points, "1")
    ctx.metric("n_invalid", left_out["invalid"] + left_out["no_return"], "1")
    ctx.metric("n_withheld", left_out["withheld"], "1")
    ctx.metric("n_not_finite", left_out["not_finite"] + left_out["too_far"], "1")
    ctx.metric("n_scans", len(counts), "1")
    ctx.metric("n_stations", 0 if cloud.stations is None else len(cloud.stations), "1")
    sides_m = [float(values.max() - values.min()) for values in assembly.offsets]
    for side_m, name in zip(sides_m, "xyz", strict=True):
        ctx.metric(f"extent_{name}_m", side_m, "m")
    for count in counts:
        if count.left_out["too_far"]:
            place = " ".join(f"{value:g}" for value in count.first_far_m)
            ctx.warn(
                f"{count.title}: {count.left_out['too_far']} points lie farther than "
                f"{FARTHEST_M:g} m from the origin, the first at {place}, and were left out: check "
                "the file and unit"
            )
    n_void = left_out["no_return"]
    if n_void > 1:
        ctx.warn(f"{n_void} points at 0 0 0 are no returns of the scanner and were left out")
    n_lost = left_out["not_finite"]
    if n_lost:
        ctx.warn(f"{n_lost} points with coordinates that are not finite were left out")
    units = dict.fromkeys(_unit_and_source(count, params.unit) for count in counts)
    fields = dict.fromkeys(name for count in counts for name in count.scan.fields_used)
    causes = ", ".join(f"{n} {cause.replace('_', ' ')}" for cause, n in sorted(left_out.items()))
    formats = ", ".join(dict.fromkeys(count.format_name for count in counts))
    ctx.log(
        f"{formats}: {len(counts)} scan{'s' * (len(counts) != 1)}, {len(cloud)} points; fields "
        f"{' '.join(fields)}; unit {', '.join(f'{u} ({source})' for u, source in units)}; up "
        f"{params.up}; extent {' x '.join(f'{side_m:.3f}' for side_m in sides_m)} m; left out "
        f"{causes or 'none'}"
    )


_RULES: Final = {
    "intensity_max": "intensity_max",
    "stated": "limits that the scan states",
    "data": "range of its data",
}
