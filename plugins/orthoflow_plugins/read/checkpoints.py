"""`read.checkpoints`: surveyed points from text files."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import Field

from orthoflow.errors import InputError
from orthoflow.files.points.units import UNITS_M
from orthoflow.files.survey_points import SurveyPoint, read_survey_points
from orthoflow.products import CheckPoints, InputFiles
from orthoflow.sdk import Method, MethodParams, MetricSpec, Ports, StepContext
from orthoflow_plugins.read.scan import Unit


class ReadCheckpoints(Method):
    """Read check points: `name,x,y,z[,class]`, optionally with a position in an orthoimage.

    World coordinates are those of the scan files. The position in an orthoimage can be given in
    three ways. `wall,u_px,v_px` are the number of the wall, and the column and row in its
    orthoimage. Columns and rows are counted from the corner, as in GIS programs, so that the centre
    of the first cell is at (0.5, 0.5). `map_x,map_y` are the X and Y in metres that a GIS shows for
    the GeoTIFF: positions in the plane of the wall, or easting and northing (`crs` of
    `raster.grid`). `wall` is not needed with easting and northing, which are valid for any cell
    size and for images from other programs. `shown_x,shown_y,shown_z` are the world coordinates, in
    metres, of the position in the image, as saved from the report. They are valid for any cell size
    and crop of the same scan.
    """

    id = "read.checkpoints"
    determinism = "exact"
    metrics = (
        MetricSpec("n_points", label="check points"),
        MetricSpec("n_measured", label="check points measured in images"),
        MetricSpec("extent_[xyz]_m", label="extent along the world {0} axis"),
    )
    citations: ClassVar[tuple[str, ...]] = ()

    class Params(MethodParams):
        """Parameters that are not in the files."""

        unit: Unit = Field(
            "m", description="Unit of x, y, z in the files; points are converted to metres."
        )

    class In(Ports):
        """The files."""

        files: InputFiles

    class Out(Ports):
        """The points of all files."""

        checkpoints: CheckPoints

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Read all files."""
        if not inputs.files.paths:
            raise InputError(f"the input {inputs.files.name} has no files: expected check points")
        points: list[SurveyPoint] = []
        places: dict[str, str] = {}
        for index, path in enumerate(inputs.files.paths):
            ctx.progress(index / len(inputs.files.paths), path.name)
            for point in read_survey_points(path):
                if point.name in places:
                    raise InputError(
                        f"check point {point.name} occurs in {places[point.name]} and in "
                        f"{path.name}: rename or remove one of the two"
                    )
                points.append(point)
            places.update((point.name, path.name) for point in points)
        checkpoints = _checkpoints(points, UNITS_M[params.unit])
        n_measured = sum(
            bool(point.pixel_wall or point.place_m or point.shown_m) for point in points
        )
        ctx.metric("n_points", len(points), "1")
        ctx.metric("n_measured", n_measured, "1")
        extent = np.ptp(checkpoints.points_world, axis=0)
        for name, length in zip("xyz", extent, strict=True):
            ctx.metric(f"extent_{name}_m", float(length), "m")
        ctx.log(f"{len(points)} check points, {n_measured} of them measured in an orthoimage")
        return self.Out(checkpoints=checkpoints)


def _checkpoints(points: list[SurveyPoint], unit_m: float) -> CheckPoints:
    nowhere = (np.nan, np.nan)
    is_placed = any(point.place_m is not None for point in points)
    is_shown = any(point.shown_m is not None for point in points)
    return CheckPoints(
        names=tuple(point.name for point in points),
        points_world=unit_m * np.array([point.position for point in points], dtype=np.float64),
        classes=tuple(point.class_name for point in points),
        wall=np.array([-1 if p.wall is None else p.wall for p in points], dtype=np.int32),
        pixels_wall=np.array([p.pixel_wall or nowhere for p in points], dtype=np.float64),
        places_m=np.array([p.place_m or nowhere for p in points], dtype=np.float64)
        if is_placed
        else None,
        shown_world=np.array([p.shown_m or (*nowhere, np.nan) for p in points], dtype=np.float64)
        if is_shown
        else None,
    )
