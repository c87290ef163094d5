"""`read.scan`: point files of scanners and other programs into one cloud."""

from __future__ import annotations

from importlib.metadata import version
from typing import Annotated, ClassVar, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from orthoflow.errors import InputError
from orthoflow.files.points import ScanFile, open_scan
from orthoflow.files.points.ahead import read_ahead
from orthoflow.files.points.columns import columns_of_text
from orthoflow.files.points.copc import Wish
from orthoflow.files.points.formats import LAS
from orthoflow.geometry import UpDirection, up_vector
from orthoflow.products import InputFiles, JsonValue, PointCloud
from orthoflow.sdk import Method, MethodParams, Ports, StepContext
from orthoflow_plugins.read.assembly import COARSE_M, FINE_M, CloudAssembly, resolution_m
from orthoflow_plugins.read.figures import plan_view_png, polar_view_png, scan_lines_png
from orthoflow_plugins.read.quality import judge_quality, report_quality, warn_of_up
from orthoflow_plugins.read.scales import (
    LUMINANCE_CORRELATION,
    IntensityScale,
    choose_scale,
    correlation_with_grey,
    is_grey,
    normalise,
)
from orthoflow_plugins.read.stations import Stations, choose_stations

Unit = Literal["m", "cm", "mm", "ft", "us-ft"]
Corner = tuple[float, float, float]

# Where two sides of a scan are shorter, it is rather in another unit than of a wall.
_SMALL_M: Final = 1.0

UNITS_M: Final[dict[Unit, float]] = {
    "m": 1.0,
    "cm": 0.01,
    "mm": 0.001,
    "ft": 0.3048,
    "us-ft": 1200.0 / 3937.0,
}


class ReadScan(Method):
    """Read E57, LAS, LAZ, COPC, PLY, PCD, PTX and text scans, several files into one cloud."""

    id = "read.scan"
    result_version = 1
    determinism = "exact"
    metrics = (
        "n_points",
        "n_scans",
        "n_stations",
        "n_invalid",
        "n_not_finite",
        "n_withheld",
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
        unit: Unit = Field(
            "m", description="Unit of the files' coordinates; the cloud is in metres."
        )
        view_from: tuple[float, float, float] | None = Field(
            None,
            description="Where a viewer stands, [x, y, z], world metres (unit applied); tells the "
            "front of a wall from its back when the files have no scanner positions.",
        )
        columns: str | None = Field(
            None,
            description="Columns of text files, e.g. 'x y z r g b intensity'; _ skips one. "
            "Without it the header or the number of columns says.",
        )
        intensity_max: float | None = Field(
            None,
            gt=0,
            description="Intensity in the files that becomes 1 (0 becomes 0); without it the "
            "limits the files state, else the range of the data.",
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
        columns = None if params.columns is None else columns_of_text(params.columns)
        if not inputs.files.paths:
            raise InputError(f"the input {inputs.files.name} names no files: expected a scan")
        unit_m = UNITS_M[params.unit]
        box_m = None if params.box is None else np.array(params.box)
        wish = Wish(
            box=None if box_m is None else box_m / unit_m,
            spacing=None if params.gsd_m is None else params.gsd_m / unit_m,
        )
        files = [
            open_scan(path, columns, classes=params.classes, cores=ctx.cores, wish=wish)
            for path in inputs.files.paths
        ]
        if params.gsd_m is not None and not any(file.is_chosen for file in files):
            ctx.warn("gsd_m only speaks of COPC files, and none was read; it has no effect")
        if params.classes and not any(file.format_name == LAS.name for file in files):
            ctx.warn(
                "classes only speaks of LAS and LAZ files, and none was read; it has no effect"
            )
        if columns is not None and not any(file.format_name == "text" for file in files):
            ctx.warn("columns only speaks of text files, and none was read; it has no effect")
        assembly = CloudAssembly(ctx, files, unit_m, box_m)
        _warn_of_missing_fields(ctx, files)
        with read_ahead(files, inputs.files.paths, columns, cores=ctx.cores) as read:
            for file in read:
                # Damaged numbers overflow on their way; what is not finite is dropped and counted.
                with np.errstate(all="ignore"):
                    assembly.add_file(file)
                for note in file.notes:
                    ctx.warn(note)
        assembly.require_points()
        cloud = _finish(ctx, assembly, files, params)
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


def _finish(
    ctx: StepContext, assembly: CloudAssembly, files: list[ScanFile], params: ReadScan.Params
) -> PointCloud:
    """Turn raw arrays into a cloud, and say what limits it."""
    rgb = _colours(ctx, assembly)
    intensity, scale = _intensity(ctx, assembly, files, params)
    intensity, intensity_source = _judged_intensity(ctx, intensity, rgb)
    stations = choose_stations(assembly.scans, params.view_from)
    _warn_of_stations(ctx, stations, assembly, params)
    precision = _precision(ctx, assembly)
    x, y, z = assembly.offsets
    cloud = PointCloud(
        origin=assembly.origin,
        x=x,
        y=y,
        z=z,
        up=up_vector(params.up),
        intensity=intensity,
        rgb=rgb,
        scan=assembly.array("scan") if stations.per_scan or stations.source != "file" else None,
        row=assembly.array("row"),
        column=assembly.array("column"),
        stations=stations.positions,
        stations_source=stations.source,
        source={
            "unit": params.unit,
            "unit_m": UNITS_M[params.unit],
            "up": params.up,
            "intensity_source": intensity_source,
            "intensity": _scale_json(scale, assembly),
            "scans": len(assembly.scans),
            **precision,
            **_counts_json(assembly),
        },
    )
    _report_metrics(ctx, assembly, cloud)
    quality = judge_quality(assembly.offsets, assembly.array("scan"))
    report_quality(quality, ctx)
    warn_of_up(quality, params.up, ctx)
    return cloud


def _colours(ctx: StepContext, assembly: CloudAssembly) -> NDArray[np.uint8] | None:
    rgb = assembly.array("rgb")
    if rgb is not None and not rgb.any():
        ctx.warn("the colours of all points are zero: they are taken as absent, not as black")
        return None
    return rgb


def _intensity(
    ctx: StepContext, assembly: CloudAssembly, files: list[ScanFile], params: ReadScan.Params
) -> tuple[NDArray[np.float32] | None, IntensityScale | None]:
    intensity = assembly.array("intensity")
    if intensity is None:
        return None, None
    low, high = assembly.intensity_range
    if low > high or low == high == 0.0:
        ctx.warn("the intensity of all points is zero: it is taken as absent")
        return None, None
    stated = [file.intensity_limits for file in files]
    scale = choose_scale((low, high), stated, params.intensity_max)
    may_exceed = low < scale.low or high > scale.high or assembly.n_intensity_lost > 0
    n_clipped = normalise(intensity, scale, may_exceed=may_exceed)
    if n_clipped:
        ctx.warn(
            f"{n_clipped} intensities lie beyond 0..{scale.high:g} (intensity_max) and were "
            f"clipped; the data reach from {low:g} to {high:g}"
        )
    return intensity, scale


def _judged_intensity(
    ctx: StepContext, intensity: NDArray[np.float32] | None, rgb: NDArray[np.uint8] | None
) -> tuple[NDArray[np.float32] | None, str]:
    """Leave out an intensity that only repeats the colours, and say where it comes from."""
    if intensity is None:
        return None, "none"
    if rgb is None:
        return intensity, "laser"
    correlation = correlation_with_grey(intensity, rgb)
    if correlation < LUMINANCE_CORRELATION:
        return intensity, "laser"
    if is_grey(rgb):
        ctx.warn("the colours are all grey and follow the intensity: they are no photographs")
        return intensity, "laser"
    ctx.warn(
        f"the intensity is not the laser's but the luminance of the colours (correlation "
        f"{correlation:.5f}): it is left out, the colours hold it"
    )
    return None, "luminance"


def _warn_of_missing_fields(ctx: StepContext, files: list[ScanFile]) -> None:
    for name, title in (("intensity", "intensity"), ("rgb", "colours")):
        without = [file.name for file in files if name not in file.fields]
        if 0 < len(without) < len(files):
            ctx.warn(
                f"{', '.join(without[:3])}{' ...' if len(without) > 3 else ''} has no {title}, "
                f"the other files have: the cloud goes without {title}"
            )


def _warn_of_stations(
    ctx: StepContext, stations: Stations, assembly: CloudAssembly, params: ReadScan.Params
) -> None:
    if stations.source == "file" and not stations.per_scan and stations.positions is not None:
        ctx.warn(
            f"only {len(stations.positions)} of {len(assembly.scans)} scans say where the scanner "
            "stood; the nearest station decides the front of a wall"
        )
    if stations.source == "file" and params.view_from is not None:
        ctx.warn("view_from has no effect: the files say where the scanner stood")


def _precision(ctx: StepContext, assembly: CloudAssembly) -> dict[str, JsonValue]:
    low, high = _extent(assembly)
    farthest_m = float(np.maximum(high - assembly.origin, assembly.origin - low).max())
    resolution = resolution_m(farthest_m)
    if resolution > FINE_M:
        ctx.warn(
            f"the points reach {farthest_m:.0f} m from the origin of the cloud, where coordinates "
            f"are kept to {1000 * resolution:.2f} mm only: check unit, or cut stray points off"
        )
    for count in assembly.files:
        if count.rounding_m >= COARSE_M:
            ctx.warn(
                f"the coordinates of {count.name} are rounded to {1000 * count.rounding_m:g} mm: "
                "planes and depths cannot be finer, and a grid may show"
            )
    rounding = max(count.rounding_m for count in assembly.files)
    return {"resolution_m": resolution, "rounding_m": rounding}


def _warn_of_size(ctx: StepContext, sides_m: NDArray[np.float64]) -> None:
    if np.median(sides_m) < _SMALL_M:
        size = " x ".join(f"{side_m:.3g}" for side_m in sides_m)
        ctx.warn(f"the scan is {size} m only: is unit of read.scan right?")


def _extent(assembly: CloudAssembly) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    lows = np.array([scan.low for scan in assembly.scans])
    highs = np.array([scan.high for scan in assembly.scans])
    return lows.min(axis=0), highs.max(axis=0)


def _scale_json(scale: IntensityScale | None, assembly: CloudAssembly) -> JsonValue:
    if scale is None:
        return None
    return {
        "low": scale.low,
        "high": scale.high,
        "rule": scale.rule,
        "data_range": list(assembly.intensity_range),
        "not_finite": assembly.n_intensity_lost,
    }


def _counts_json(assembly: CloudAssembly) -> dict[str, JsonValue]:
    files: list[JsonValue] = [
        {
            "name": count.name,
            "format": count.format_name,
            "read": count.n_read,
            "kept": count.n_kept,
            "invalid": count.n_invalid,
            "withheld": count.n_withheld,
            "not_finite": count.n_not_finite,
            # Of scans that were read as a whole, records do not change.
            **({"unwanted": count.n_unwanted} if count.n_unwanted else {}),
            **({"outside": count.n_outside} if count.n_outside else {}),
            "rounding_m": count.rounding_m,
            "rgb_scale": count.rgb_scale,
            "header": dict(count.header),
        }
        for count in assembly.files
    ]
    formats = sorted({count.format_name for count in assembly.files})
    n_read = sum(count.n_read for count in assembly.files)
    return {
        "format": ", ".join(formats),
        "files": files,
        "counts": {
            "read": n_read,
            "kept": assembly.n_points,
            "dropped": n_read - assembly.n_points,
        },
    }


def _report_metrics(ctx: StepContext, assembly: CloudAssembly, cloud: PointCloud) -> None:
    counts = assembly.files
    ctx.metric("n_points", len(cloud), "1")
    ctx.metric("n_invalid", sum(count.n_invalid for count in counts), "1")
    ctx.metric("n_withheld", sum(count.n_withheld for count in counts), "1")
    ctx.metric("n_not_finite", sum(count.n_not_finite for count in counts), "1")
    ctx.metric("n_scans", len(assembly.scans), "1")
    ctx.metric("n_stations", 0 if cloud.stations is None else len(cloud.stations), "1")
    low, high = _extent(assembly)
    _warn_of_size(ctx, high - low)
    for axis, name in enumerate("xyz"):
        ctx.metric(f"extent_{name}_m", float(high[axis] - low[axis]), "m")
    n_dropped = sum(count.n_read for count in counts) - len(cloud)
    ctx.log(f"{len(cloud)} points of {len(counts)} files, {n_dropped} left out")
