"""`read.scan`: point files from scanners and other programs, merged into one cloud."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, ClassVar, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from orthoflow.errors import InputError
from orthoflow.files.points import PointQuery, Scan, ScanFile, open_scan
from orthoflow.files.points.fields import Columns, columns_of_user, plain_name
from orthoflow.files.points.formats import LAS, TEXT
from orthoflow.files.points.units import UNITS_M, refuse_degrees
from orthoflow.geometry import UpDirection, up_vector
from orthoflow.geometry.cloud_quality import judge_quality
from orthoflow.products import InputFiles, PointCloud
from orthoflow.sdk import Method, MethodParams, MetricSpec, Ports, StepContext
from orthoflow_plugins.read.assembly import CloudAssembly, ScanCount
from orthoflow_plugins.read.figures import plan_chart, polar_view_png, scan_lines_png
from orthoflow_plugins.read.reporting import (
    COLOUR_DEPTH,
    COLOUR_LIMIT,
    COLOURS_GREY,
    FEW_STATIONS,
    FIELD_ZERO,
    INTENSITY_LUMINANCE,
    NO_EFFECT,
    report_fields,
    report_notes,
    report_precision,
    report_quality,
    report_scales,
    report_summary,
    scan_json,
    warn_of_up,
)
from orthoflow_plugins.read.scales import (
    IntensityScale,
    choose_scales,
    correlation_with_grey,
    is_grey,
    normalise,
    robust_range,
)

Unit = Literal["m", "cm", "mm", "ft", "us-ft", "in", "km"]
Corner = tuple[float, float, float]
_PERCENTILES: Final = (0.5, 99.5)
_SAMPLE: Final = 200_000


class ReadScan(Method):
    """Read one or several E57, LAS, LAZ, COPC, PLY, PCD, PTX or text files into one cloud."""

    id = "read.scan"
    result_version: ClassVar[int] = 2
    determinism = "exact"
    metrics = (
        MetricSpec("n_points", label="points"),
        MetricSpec("n_scans", label="scans"),
        MetricSpec("n_stations", label="stations"),
        MetricSpec("n_points_left_out", label="points in the files that are not used"),
        MetricSpec("n_left_out_*", label="points in the files that are not used: {0}"),
        MetricSpec("extent_[xyz]_m", label="extent along the world {0} axis"),
        MetricSpec("thickness_mm", label="thickness of the cloud in patches of about 10 cm"),
        MetricSpec(
            "thickness_width_mm",
            label="width that contains 95 % of the distances from the first plane",
        ),
        MetricSpec("thickness_scan_steps", label="thickness divided by the point spacing"),
        MetricSpec("scan_step_mm", label="point spacing"),
        MetricSpec("scans_apart_mm", label="distance between scans on the same surface"),
    )
    citations: ClassVar[tuple[str, ...]] = (
        "ASTM E2807, E57 file format for 3D imaging data exchange",
        "ASPRS LAS specification 1.4 R15",
    )

    class Params(MethodParams):
        """Parameters that are not in the files."""

        up: UpDirection = Field("z", description="Axis of the files that points up.")
        unit: Unit | None = Field(
            None,
            description="Unit of the coordinates, which overrides the unit in the files. None: "
            "the unit in each file, or metres if it contains none. The cloud is in metres.",
        )
        view_from: tuple[float, float, float] | None = Field(
            None,
            description="Position of a viewer, [x, y, z], in world metres (after unit is "
            "applied); it distinguishes the front of a wall from its back if the files "
            "contain no scanner positions.",
        )
        columns: str | tuple[str, ...] | None = Field(
            None,
            description="Columns of text files, [x, y, z, r, g, b, intensity] or 'x y z _'; _ "
            "skips a column. None: from the header, or else from the number and values of the "
            "columns.",
        )
        intensity_field: str | None = Field(
            None,
            description="Name of the field to use as intensity, e.g. Reflectance; None: the "
            "usual field of the format, or else reflectance, amplitude or remission.",
        )
        intensity_max: float | None = Field(
            None,
            gt=0,
            description="Intensity in the files that maps to 1 (0 maps to 0); None: for each scan "
            "the limits in its file if the data fit them, or else the range of the data.",
        )

        box: tuple[Corner, Corner] | None = Field(
            None,
            description="Lowest and highest corner of a box, [[x, y, z], [x, y, z]], in world "
            "metres (after unit is applied): points outside are dropped, points on its faces are "
            "kept.",
        )
        gsd_m: float | None = Field(
            None,
            gt=0,
            description="Point spacing in metres that is sufficient. COPC files are read down to "
            "the first level of the octree with this spacing or less. None: all points are read.",
        )
        classes: tuple[Annotated[int, Field(ge=0, le=255)], ...] = Field(
            (),
            description="Classes of LAS and LAZ points to keep, e.g. [1, 6] (ASPRS: 6 is "
            "building); if empty, all are kept.",
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
        """Read all files."""
        columns = None if params.columns is None else columns_of_user(params.columns)
        if not inputs.files.paths:
            raise InputError(f"the input {inputs.files.name} has no files: expected a scan")
        box_m = None if params.box is None else np.array(params.box)
        files = [_opened(path, columns, box_m, params) for path in inputs.files.paths]
        _check_settings(ctx, files, params)
        assembly = CloudAssembly(ctx, files, partial(_unit_m, params=params), box_m)
        for file in files:
            # Values in damaged files may overflow. Values that are not finite are omitted and
            # counted.
            with np.errstate(all="ignore"):
                assembly.add_file(file)
            report_notes(ctx, file)
        assembly.require_points()
        cloud = _finish(ctx, assembly, params)
        ctx.figure(
            "plan",
            partial(plan_chart, cloud),
            "The cloud from above, brighter where it is denser. Walls are thin bright lines; "
            "double lines indicate misaligned scans.",
        )
        polar = polar_view_png(cloud)
        if polar is not None:
            ctx.figure(
                "polar",
                polar,
                "Intensity in the rows and columns of the scanner. Black pixels have no return; "
                "where a wall is black, nothing can be measured.",
            )
        lines = scan_lines_png(cloud)
        if lines is not None:
            caption = (
                "Rows (yellow) and columns (blue) of the scan on a wall, seen frontally. The "
                "mesh is regular where the scan is good; interrupted or crossing lines are "
                "gaps and mixed points."
            )
            ctx.figure("scan-lines", lines, caption)
        return self.Out(cloud=cloud)

    @classmethod
    def tools(cls) -> dict[str, str]:
        """Return the versions of the libraries that decode the files."""
        return {name: version(name) for name in ("laspy", "lazrs", "pandas", "pye57")}


def _opened(
    path: Path, columns: Columns | None, box_m: NDArray[np.float64] | None, params: ReadScan.Params
) -> ScanFile:
    """Open a file; of a COPC file, only the requested parts are read."""
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
    query = PointQuery(
        box=None if box_m is None else box_m / unit_m,
        spacing=None if params.gsd_m is None else params.gsd_m / float(unit_m[0]),
    )
    return opened(query=query)


def _unit_m(scan: Scan, params: ReadScan.Params) -> NDArray[np.float64]:
    """Return metres per unit of a scan, along x, y and z."""
    if params.unit is not None:
        return np.full(3, UNITS_M[params.unit])
    return np.ones(3) if scan.unit is None else np.array(scan.unit.metres)


def _check_settings(ctx: StepContext, files: list[ScanFile], params: ReadScan.Params) -> None:
    formats = {file.format_name for file in files}
    is_idle = {
        ("gsd_m", "COPC"): params.gsd_m is not None and not any(file.is_chosen for file in files),
        ("classes", "LAS and LAZ"): params.classes and LAS.name not in formats,
        ("columns", "text"): params.columns is not None and TEXT.name not in formats,
    }
    for (setting, kind), is_so in is_idle.items():
        if is_so:
            why = f"it applies only to {kind} files, and none was read"
            ctx.report(NO_EFFECT, setting=setting, why=why)
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
    """Convert the raw arrays to a cloud and report limitations of the cloud."""
    rgb, has_rgb = _colours(ctx, assembly)
    intensity, scales = _intensity(ctx, assembly, params)
    intensity, intensity_source = _judged_intensity(ctx, intensity, rgb, has_rgb)
    counts = [count for count in assembly.counts if count.n_kept]
    extents = [_extent(assembly, count) for count in counts]
    stations, stations_source = _choose_stations(counts, extents, params.view_from)
    is_from_files = stations is not None and stations_source == "file"
    is_per_scan = stations is not None and len(stations) == len(counts)
    if is_from_files and stations is not None and not is_per_scan:
        ctx.report(FEW_STATIONS, n_stations=len(stations), n_scans=len(counts))
    if is_from_files and params.view_from is not None:
        ctx.report(NO_EFFECT, setting="view_from", why="the files contain scanner positions")
    precision = report_precision(ctx, assembly, extents, params.unit)
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
        # Scan numbers are only stored if they are indices of the stations.
        scan=assembly.array("scan") if is_per_scan or not is_from_files else None,
        row=assembly.array("row"),
        column=assembly.array("column"),
        stations=stations,
        stations_source=stations_source,
        source={
            "up": params.up,
            "intensity_source": intensity_source,
            "scans": [
                scan_json(count, scale, params.unit)
                for count, scale in zip(assembly.counts, scales, strict=True)
            ],
            **precision,
        },
    )
    report_fields(ctx, assembly.counts, cloud)
    report_summary(ctx, assembly, cloud, up=params.up, unit=params.unit)
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
            ctx.report(FIELD_ZERO, subject=count.title, field="colour")
            count.n_without_rgb = count.n_kept
            has_rgb = assembly.colour_mask()
            has_rgb[part] = False
        elif colours.misfit is not None:
            ctx.report(
                COLOUR_LIMIT,
                subject=count.title,
                limit=colours.misfit,
                largest=colours.largest,
                scale=colours.scale,
            )
        elif colours.scale in ("10 bit", "12 bit"):
            ctx.report(
                COLOUR_DEPTH, subject=count.title, largest=colours.largest, scale=colours.scale
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
            ctx.report(FIELD_ZERO, subject=count.title, field="intensity")
            values[:] = np.nan
            seen = None
        ranges.append(seen)
    stated = [count.scan.intensity_limits for count in assembly.counts]
    scales = choose_scales(ranges, stated, params.intensity_max)
    clipped = [
        0 if scale is None else normalise(intensity[count.start : count.stop], scale)
        for count, scale in zip(assembly.counts, scales, strict=True)
    ]
    report_scales(ctx, assembly.counts, scales, clipped)
    if all(scale is None for scale in scales):
        return None, scales
    return intensity, scales


def _judged_intensity(
    ctx: StepContext,
    intensity: NDArray[np.float32] | None,
    rgb: NDArray[np.uint8] | None,
    has_rgb: NDArray[np.bool_] | None,
) -> tuple[NDArray[np.float32] | None, str]:
    """Discard an intensity that only repeats the brightness of the colours.

    Also return the source of the intensity.
    """
    if intensity is None:
        return None, "none"
    if rgb is None:
        return intensity, "laser"
    correlation = correlation_with_grey(intensity, rgb, has_rgb)
    if correlation is None:
        return intensity, "laser"
    if is_grey(rgb):
        ctx.report(COLOURS_GREY)
        return intensity, "laser"
    if has_rgb is not None:
        return intensity, "luminance"
    ctx.report(INTENSITY_LUMINANCE, correlation=correlation)
    return None, "luminance"


def _choose_stations(
    counts: Sequence[ScanCount],
    extents: Sequence[NDArray[np.float64]],
    view_from: tuple[float, float, float] | None,
) -> tuple[NDArray[np.float64] | None, str | None]:
    """Return stations (s, 3) and their source: those in the files, or the viewpoint of the user.

    The station of a scan without a pose is the origin, if there is only one such scan and it could
    have been taken from the origin. The points of a scan in the frame of the scanner surround the
    origin or are in front of it, whereas a cloud in survey coordinates can be anywhere.

    Args:
        counts: statistics of the scans that have points.
        extents: (2, 3) smallest and largest coordinates of each scan, except for a few outliers.
        view_from: viewpoint given by the user, or None.
    """
    is_only = sum(c.scan.station is not None and not c.scan.station_is_posed for c in counts) == 1
    known = []
    for count, extent in zip(counts, extents, strict=True):
        if count.scan.station is None:
            continue
        station = count.scan.station * count.unit_m
        off_m = float(np.linalg.norm(np.clip(station, *extent) - station))
        may_be_origin = is_only and off_m <= float(np.linalg.norm(np.ptp(extent, axis=0)))
        if count.scan.station_is_posed or may_be_origin:
            known.append(station)
    if known:
        return np.vstack(known), "file"
    return (None, None) if view_from is None else (np.array([view_from]), "view_from")


def _extent(assembly: CloudAssembly, count: ScanCount) -> NDArray[np.float64]:
    """Return the smallest and the largest coordinates (2, 3) of a scan, except for outliers."""
    part = slice(count.start, count.stop, max(1, count.n_kept // _SAMPLE))
    ends = [np.percentile(values[part], _PERCENTILES) for values in assembly.offsets]
    return np.asarray(assembly.origin + np.array(ends).T)
