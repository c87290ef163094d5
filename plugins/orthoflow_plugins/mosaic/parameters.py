"""Parameters of `mosaic.seams`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from orthoflow.sdk import MethodParams


class SeamsParams(MethodParams):
    """Rule for the layer of each cell, and balancing of colours."""

    seams: Literal["best-view", "voronoi", "graph-cut", "priority"] = Field(
        "best-view",
        description="Rule that selects one of several layers for a cell. best-view: by "
        "angle of incidence, resolution and distance from the border of the photo; voronoi: "
        "with seams in the middle of overlaps; graph-cut: with seams where photos look "
        "similar, away from depth edges; priority: in the order given.",
    )
    priority: tuple[str, ...] = Field(
        (), description="Names of photos, highest priority first, for `seams: priority`."
    )
    gains: Literal["none", "global"] = Field(
        "global",
        description="none: the colours of the photos are not changed; global: if photos differ, "
        "each is corrected for exposure (per channel), vignetting and other smooth differences "
        "measured in overlaps, and remaining differences are blended near seams.",
    )
    island_cells_min: int = Field(
        default=100,
        ge=1,
        description="Patches with fewer cells are assigned to the source around them if that "
        "source shows them, too; 1 keeps the best view of every cell.",
    )

    robust: bool = Field(
        default=True,
        description="If photos contradict each other over a region, as with passing people and "
        "vehicles, use the photo that most others and the scan confirm.",
    )
    publish_layers: bool = Field(
        default=False,
        description="Also publish the layer of each photo as a GeoTIFF.",
    )
