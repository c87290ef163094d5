"""Parameters of the methods of the kind `ortho`."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import Field

from orthoflow.sdk import MethodParams

Resampling = Literal["nearest", "bilinear", "cubic", "lanczos"]
# Points at most this far below the topmost point of a cell belong to the same surface.
LAYER_M: Final = 0.02

Inpainting = Literal["between", "telea", "navier-stokes", "none"]


class VisibilityParams(MethodParams):
    """Visibility of cells in a photo."""

    incidence_max_deg: float = Field(
        default=80.0,
        gt=0,
        lt=90,
        description="Largest angle of incidence at which a cell takes its colour from a photo.",
    )


class BackwardParams(VisibilityParams):
    """Sampling of colours, and visibility of cells in a photo."""

    resampling: Literal["nearest", "bilinear", "cubic", "lanczos"] = Field(
        default="bilinear",
        description="Interpolation of colours, averaged over the cell if the photo has a higher "
        "resolution than the wall; nearest takes the pixels of the photo unchanged.",
    )
    visibility: Literal["full", "none"] = Field(
        default="full",
        description="Objects that can hide cells. full: relief and cloud; none: nothing, for "
        "comparisons and for flat walls without objects in front of them.",
    )


class DirectParams(MethodParams):
    """Colouring of cells, and filling of gaps."""

    void_limits: tuple[
        Annotated[int, Field(ge=0, le=9)],
        Annotated[int, Field(ge=0, le=25)],
        Annotated[int, Field(ge=0, le=49)],
    ] = Field(
        default=(7, 23, 46),
        description="A void cell is filled if the 3x3, 5x5 and 7x7 windows around it contain at "
        "most these numbers of void cells. The cell itself and cells outside the image count as "
        "void.",
    )
    colouring: Literal["topmost", "centre", "gaussian", "median"] = Field(
        default="topmost",
        description="Source of a cell's colour. topmost: the point nearest to the viewer; "
        "centre: of the points on the surface nearest to the viewer, the one nearest to the "
        "cell centre; gaussian: mean over that surface, weighted by the distance from the "
        "cell centre; median: of the five points nearest to the viewer.",
    )
    skip_below_grey: Annotated[int, Field(ge=0, le=255)] | None = Field(
        default=None,
        description="Points darker than this in all channels are treated as points without a "
        "colour, since many files store these as black: their depths are used, but their colours "
        "are not. 1: pure black; 10: also almost black; 0: none. By default, the colours of pure "
        "black points are ignored if these are at most a tenth of all points and more numerous "
        "than almost black points.",
    )
    balance_scans: bool = Field(
        default=True,
        description="Balance the colours of scans that differ in brightness or white balance in "
        "their overlaps on the walls.",
    )
    inpaint: Inpainting = Field(
        default="between",
        description="How gaps are filled. between: by interpolation between the covered cells "
        "around them; telea, navier-stokes: by OpenCV's inpainting, as in skarlatos2012; none: "
        "gaps are not filled.",
    )
    inpaint_radius_px: float = Field(
        default=3.0,
        gt=0,
        le=100,
        description="Radius within which covered cells give a gap its colour; with between, gaps "
        "without a covered cell within this radius remain empty.",
    )
