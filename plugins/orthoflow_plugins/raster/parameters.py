"""Parameters of `raster.grid`."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from orthoflow.sdk import MethodParams
from orthoflow_plugins.raster.frames import Polygon, Rectangle, area_m2

Constraint = Literal["vertical", "horizontal", "any"]
Place = tuple[float, float, float]


class RasterParams(MethodParams):
    """Cell size, depth of the surface, choice of planes, and how gaps are closed."""

    gsd_m: float = Field(
        default=0.005, gt=0, description="Side of a cell; not finer than the point spacing."
    )
    buffer_m: float | None = Field(
        default=None,
        gt=0,
        description="Distance from the plane, on both sides, within which points are used; "
        "by default as far as the relief that is connected to the wall, 0.5 m in front "
        "and 1 m behind at most, and at "
        "least three times the tolerance of the planes (markiewicz2015: 3 x 5 cm); 3 m "
        "in front of an upright wall "
        "if connected objects hide 3 % of it.",
    )
    buffer_front_m: float | None = Field(
        default=None, ge=0, description="Depth towards the viewer instead of buffer_m."
    )
    buffer_behind_m: float | None = Field(
        default=None, ge=0, description="Depth behind the plane instead of buffer_m."
    )
    rectangle: Literal["points", "room"] = Field(
        default="room",
        description="room: the wall as far as its surface goes, cornices and pilasters in, up "
        "to adjoining walls, floor and ceiling, where they run askew to where they come "
        "nearest; points: the rectangle of its plane's points.",
    )
    surface: Literal["median", "denoised", "nearest", "centre", "topmost", "mean", "tin"] = Field(
        default="median",
        description="Depth of a cell: median of the layer with most points (layers are more than "
        "2 cm apart), without outliers; the same denoised, with steps preserved; of the "
        "nearest point, also of the next cells (markiewicz2015); of its point nearest "
        "the centre; of the topmost point (skarlatos2012); mean of all; or tin, a triangulation, "
        "which closes windows (for comparison).",
    )
    percentiles: tuple[Annotated[float, Field(ge=0, le=100)], ...] = Field(
        default=(),
        max_length=9,
        description=("Percentiles of the depths of a cell's points, written as separate rasters."),
    )
    balance_intensity: bool = Field(
        default=False,
        description="Correct the intensity for range, incidence "
        "and scan, estimated where scans overlap.",
    )
    recover_gap_cells: int = Field(
        default=2,
        ge=0,
        le=50,
        description="Void cells are recovered where no disc of this radius fits into the gap; "
        "0 recovers nothing.",
    )
    recover_scan_steps: int = Field(
        default=2,
        ge=0,
        le=10,
        description="Where the scan's rows and columns are known, void cells between points so "
        "many rows or columns apart are recovered first, linear between them, if the points "
        "lie on one layer and at most four times recover_gap_cells apart.",
    )
    constraint: Constraint = Field(
        default="any", description="Raster only vertical, only horizontal, or any planes."
    )
    min_area_m2: float = Field(
        default=1.0,
        ge=0,
        description="Smallest rectangle of a plane; the one with the most support is exempt.",
    )
    n_walls_max: int = Field(
        default=12, ge=1, le=1000, description="Maximum number of planes, by support."
    )
    ranks: tuple[Annotated[int, Field(ge=0)], ...] = Field(
        default=(),
        description="Raster exactly these planes, by their place in planes.json, where 0 has "
        "the most support: other planes where a tolerance, detector or scan finds others (near "
        "takes the one at a point); empty: as constraint, min_area_m2, n_walls_max and "
        "skip_covered.",
    )
    near: tuple[Place, ...] = Field(
        default=(),
        description="Raster the wall nearest to each of these points and no others, "
        "[[x, y, z], ...] in world metres, among planes of the right direction (constraint).",
    )
    crop: Rectangle | Polygon | None = Field(
        default=None,
        description="Part of the wall to raster, metres to the right and down from the "
        "top-left corner of its whole raster: a rectangle [left, top, right, bottom], or a "
        "polygon [[right, down], ...] beyond which cells stay void. Photos are matched to this "
        "part only: orient them on the whole wall first, and pass on their cameras.",
    )
    skip_covered: bool = Field(
        default=True,
        description="Leave out a plane that lies within the buffer of a larger parallel wall, "
        "which shows it as relief.",
    )
    margin_m: float = Field(
        default=0.0, ge=0, description="Widens the rectangle of a plane on all sides."
    )
    crs: str | None = Field(
        default=None,
        pattern=r"^(EPSG:[0-9]{4,6}|site)$",
        description="Coordinate system of the cloud, EPSG:nnnn, or site for one without a "
        "name: rasters of level planes seen from above are maps of it, x east, y north.",
    )

    @model_validator(mode="after")
    def _one_choice_of_walls(self) -> Self:
        if self.ranks and self.near:
            raise ValueError("walls are chosen by ranks or by near, got both; leave one out")
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
