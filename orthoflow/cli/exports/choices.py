"""The options of `orthoflow export` that apply only to some formats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from orthoflow.files.clouds.attributes import Colouring
    from orthoflow.files.drawings.words import Language
    from orthoflow.report.charts import ChartFormat


@dataclass(frozen=True, kw_only=True)
class Choices:
    """Options that apply only to some formats; None, False or empty if an option is not given.

    Attributes:
        cell: address of the cell to export.
        license_text: license of an RO-Crate.
        author: author of an RO-Crate.
        scale: denominator N of the scale 1:N of sheets.
        paper: paper size of sheets.
        grid: spacing of the grid crosses in the unit of the sheets; 0 for none.
        units: unit of numbers on sheets.
        title_block: file with the title block of the user's office.
        beside: kinds of rasters to show next to the orthoimage on sheets.
        embed: whether to include all products and input files in the record.
        split: whether to write one run folder per dataset.
        inputs: input files, as `NAME=PATH`.
        store: store with products that the record references but does not contain.
        colour: source of the colours of points.
        wall: number of a single wall to export.
        box: two opposite corners of the part to export, as `x,y,z,x,y,z` in metres.
        clean: whether to remove isolated points.
        relief: whether to model the relief of walls from their depths.
        heights_m: heights of plans above the floor, in metres.
        through: lines of sections, each as `x,y,x,y` in metres.
        dimensions: whether to write lengths next to the lines of plans and sections.
        language: language of labels.
        light: azimuth and altitude in degrees of a raking light, e.g. `315,25`.
        base_url: address at which an IIIF folder will be published.
        figure_format: format of figures: `pdf`, `svg` or `png`.
    """

    cell: str | None = None
    license_text: str | None = None
    author: str | None = None
    scale: int | None = None
    paper: str | None = None
    grid: float | None = None
    units: Literal["m", "ft"] | None = None
    title_block: Path | None = None
    beside: tuple[str, ...] = ()
    embed: bool = False
    split: bool = False
    inputs: Sequence[str] = ()
    store: Path = Path()
    colour: Colouring | None = None
    wall: int | None = None
    box: str | None = None
    clean: bool = False
    relief: bool = False
    heights_m: tuple[float, ...] = ()
    through: tuple[str, ...] = ()
    dimensions: bool = False
    language: Language | None = None
    light: str | None = None
    base_url: str | None = None
    figure_format: ChartFormat | None = None
