"""Parameters of `raster.grid`."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from orthoflow.sdk import MethodParams
from orthoflow_plugins.raster.frames import Polygon, Rectangle, area_m2

Constraint = Literal["vertical", "horizontal", "any"]
Place = tuple[float, float, float]
Surface = Literal["median", "denoised", "nearest", "centre", "topmost", "mean", "tin"]


class RasterParams(MethodParams):
    """Parameters for the cell size, the depth of the surface, the selection of planes, and gaps."""

    gsd_m: float = Field(
        default=0.005,
        gt=0,
        description="Cell size; it should not be smaller than the point spacing.",
    )
    buffer_m: float | None = Field(
        default=None,
        gt=0,
        description="Distance from the plane, on both sides, within which points are used; by "
        "default, the depth of the relief connected to the wall, at most 0.5 m in front (3 m for "
        "vertical walls if connected objects hide 3 % of them) and 1 m behind, and at least three "
        "times the tolerance of the planes (markiewicz2015: 3 x 5 cm).",
    )
    buffer_front_m: float | None = Field(
        default=None,
        ge=0,
        description="Maximum distance of points in front of the plane, "
        "towards the viewer, instead of buffer_m.",
    )
    buffer_behind_m: float | None = Field(
        default=None,
        ge=0,
        description="Maximum distance of points behind the plane instead of buffer_m.",
    )
    rectangle: Literal["points", "room"] = Field(
        default="room",
        description="Extent of a raster. room: the whole surface of the wall with cornices "
        "and pilasters, up to the nearest points of adjoining walls, floor and ceiling; "
        "points: the rectangle of the points on the plane.",
    )
    surface: Surface | None = Field(
        default=None,
        description="Depth of a cell. median (default on planes): median of the layer with the "
        "most points (layers are more than 2 cm and four standard deviations of the noise apart), "
        "without outliers; denoised (default on "
        "curved surfaces, parts of which every photo sees obliquely, and on planes whose depth "
        "noise exceeds gsd_m): the same after edge-preserving smoothing; nearest: depth of the "
        "point nearest to the centre, also from neighbouring cells (markiewicz2015); centre: the "
        "same, but only from points of the cell; topmost: depth of the point nearest to the viewer "
        "(skarlatos2012); mean: mean of all points; tin: a triangulation, which closes windows "
        "(for comparison).",
    )
    percentiles: tuple[Annotated[float, Field(ge=0, le=100)], ...] = Field(
        default=(),
        max_length=9,
        description="Percentiles of the depths of the points in a cell, written as separate "
        "rasters.",
    )
    balance_intensity: bool = Field(
        default=False,
        description="Correct intensities for range, angle of incidence and scan, using overlaps "
        "of scans.",
    )
    recover_gap_cells: int = Field(
        default=2,
        ge=0,
        le=50,
        description="Void cells are interpolated in gaps that do not contain a disc of this "
        "radius; 0 disables this.",
    )
    recover_scan_steps: int = Field(
        default=2,
        ge=0,
        le=10,
        description="If the rows and columns of the scan are known, void cells are first "
        "interpolated linearly between points of the same layer. The distance between these "
        "points is at most this number of rows or columns in the scan, and at most four "
        "times recover_gap_cells on the wall.",
    )
    constraint: Constraint = Field(
        default="any", description="Orientation of the planes to rasterise."
    )
    min_area_m2: float = Field(
        default=1.0,
        ge=0,
        description="Minimum area of a plane's rectangle; the plane with the most points is "
        "exempt.",
    )
    n_walls_max: int = Field(
        default=12,
        ge=1,
        le=1000,
        description="Maximum number of planes; those with the most points are used.",
    )
    ranks: tuple[Annotated[int, Field(ge=0)], ...] = Field(
        default=(),
        description="Rasterise just these planes, by index in planes.json, where 0 has the most "
        "points; curved surfaces are numbered after the last plane. Indices change with the scan, "
        "the detector and its tolerances; to select walls by position, use `near`. If empty, "
        "planes are selected by constraint, min_area_m2, n_walls_max and skip_covered.",
    )
    near: tuple[Place, ...] = Field(
        default=(),
        description="Rasterise only the walls nearest to these points, [[x, y, z], ...] in "
        "world metres, among planes of the required orientation (constraint).",
    )
    crop: Rectangle | Polygon | None = Field(
        default=None,
        description="Part of the wall to rasterise, in metres right of and below the top-left "
        "corner of its whole raster: a rectangle [left, top, right, bottom], or a polygon "
        "[[right, down], ...] outside which cells are void. Photos are matched only to this "
        "part, so orient them with the whole wall first, and use the resulting cameras.",
    )
    skip_covered: bool = Field(
        default=True,
        description="Omit planes in the buffer of a larger parallel wall, whose raster shows them "
        "as relief.",
    )
    margin_m: float = Field(
        default=0.0, ge=0, description="Margin added to the rectangle of a plane on all sides."
    )
    crs: str | None = Field(
        default=None,
        pattern=r"^(EPSG:[0-9]{4,6}|site)$",
        description="Coordinate system of the cloud: EPSG:nnnn, or site for a local system. "
        "Rasters of horizontal planes seen from above are then maps in this system, with x as "
        "easting and y as northing.",
    )

    @model_validator(mode="after")
    def _one_choice_of_walls(self) -> Self:
        if self.ranks and self.near:
            raise ValueError("walls are selected by ranks or by near, not by both: omit one")
        return self

    @field_validator("crop")
    @classmethod
    def _crop_has_an_area(cls, crop: Rectangle | Polygon | None) -> Rectangle | Polygon | None:
        if crop is not None and not area_m2(crop) > 0.0:
            raise ValueError(
                "crop must be [left, top, right, bottom] or at least three corners "
                f"[[right, down], ...] that span an area, in metres, got {list(crop)}"
            )
        return crop
