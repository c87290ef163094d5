"""Parameters of the methods of the kind `ortho`."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import Field

from orthoflow.sdk import MethodParams

Resampling = Literal["nearest", "bilinear", "cubic", "lanczos"]
# Points at most this far below the topmost one are on its surface.
LAYER_M: Final = 0.02

Inpainting = Literal["between", "telea", "navier-stokes", "none"]


class VisibilityParams(MethodParams):
    """When a photo counts as seeing a cell."""

    incidence_max_deg: float = Field(
        default=80.0, gt=0, lt=90, description="Cells seen more obliquely are not painted."
    )


class BackwardParams(VisibilityParams):
    """How colours are sampled, and when a cell counts as seen."""

    resampling: Literal["nearest", "bilinear", "cubic", "lanczos"] = Field(
        default="bilinear",
        description="Interpolation of colours; nearest paints the photo's pixels unchanged.",
    )
    antialias: bool = Field(
        default=True,
        description="Average over the cell where the photo is finer than the wall "
        "(not with nearest).",
    )
    visibility: Literal["full", "none"] = Field(
        default="full",
        description="What hides cells: relief and cloud (full), or nothing, for "
        "comparison and for flat walls without objects in front.",
    )
    erosion_cells: int = Field(
        default=1,
        ge=0,
        le=20,
        description=(
            "Cells this close to a hidden patch are not painted, because edges smear there."
        ),
    )


class DirectParams(MethodParams):
    """Which gaps are filled, and how."""

    void_limits: tuple[
        Annotated[int, Field(ge=0, le=9)],
        Annotated[int, Field(ge=0, le=25)],
        Annotated[int, Field(ge=0, le=49)],
    ] = Field(
        default=(7, 23, 46),
        description="Most void cells in the 3x3, 5x5 and 7x7 windows around a void cell, "
        "itself and cells outside the image included, for it to be filled.",
    )
    colouring: Literal["topmost", "centre", "gaussian", "median"] = Field(
        default="topmost",
        description="Colour of a cell: of its topmost point; of the point nearest its centre "
        "on the topmost surface; gaussian mean of that surface by distance to the centre; "
        "median of its five highest points.",
    )
    skip_below_grey: Annotated[int, Field(ge=0, le=255)] | None = Field(
        default=None,
        description="Points of which no channel reaches this have no "
        "colour, as points that no camera saw in many files: they paint no cell, and "
        "keep their depth. 1: those of pure "
        "black; 10: almost black ones, too; 0: none. Without it those of pure black, where "
        "these are specks: at most a tenth of all, and more than there are almost black ones.",
    )
    balance_scans: bool = Field(
        default=True,
        description="Balance the colours of scans that differ in brightness or white balance "
        "where they overlap on the walls.",
    )
    inpaint: Inpainting = Field(
        default="between",
        description="How gaps are filled: by interpolation between the "
        "painted cells around them; telea and navier-stokes of OpenCV, as skarlatos2012 "
        "has it; none.",
    )
    inpaint_radius_px: float = Field(
        default=3.0,
        gt=0,
        le=100,
        description="Radius from which a gap takes its colour; with between, "
        "a gap without a painted cell within it stays void.",
    )
