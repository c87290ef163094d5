"""Parameters of `mosaic.seams`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from orthoflow.sdk import MethodParams


class SeamsParams(MethodParams):
    """How the layer of a cell is chosen, and how specks are avoided."""

    seams: Literal["best-view", "voronoi", "graph-cut", "priority"] = Field(
        "best-view", description="Which layer paints what several of them show."
    )
    priority: tuple[str, ...] = Field(
        (), description="Names of photos, highest priority first, for `seams: priority`."
    )
    gains: Literal["none", "global"] = Field(
        "global",
        description="none: colours stay as the photos have them, and nothing below changes "
        "them; global: where photos differ, the light of each is multiplied by one number per "
        "channel, so that overlaps agree.",
    )
    local_balance: bool = Field(
        default=True,
        description="Also balance vignetting and other differences that are "
        "smooth over a photo, as measured in overlaps.",
    )
    feather_cells: int = Field(
        64,
        ge=0,
        le=4096,
        description="Remaining differences at a seam are blended within this many cells "
        "on either side; only smooth differences, so that nothing is mixed. 0: a step may "
        "remain.",
    )
    island_cells_min: int = Field(
        default=100,
        ge=1,
        description="Smaller patches from one source are painted from the one around them, "
        "where it sees them too; 1 keeps the best view of every cell.",
    )

    robust: bool = Field(
        default=True,
        description="Where photos contradict each other over a region, as with people and "
        "vehicles that pass, one that most others and the scan confirm paints it.",
    )
    publish_layers: bool = Field(
        default=False,
        description="Also publish the layer of each photo as a GeoTIFF.",
    )
