"""The options of `orthoflow export` that belong to some formats only."""

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
    """The options that belong to some formats only; what nobody gave is None, False or empty.

    Attributes:
        cell: address of the cell that is meant.
        license_text: of a crate.
        author: of a crate.
        scale: of sheets, n of 1 : n.
        paper: of sheets.
        grid: distance of the crosses on sheets in their unit, 0 for none.
        units: of what is written on sheets.
        title_block: file with what an office writes on its sheets.
        beside: rasters that sheets show beside the orthoimage.
        embed: with every product and input.
        split: a record per dataset.
        inputs: input files, `NAME=PATH`.
        store: where products are that the record only names.
        colour: what the colours of points show.
        wall: number of the only wall that is meant.
        box: corners of the only part that is meant, as text.
        clean: without gross outliers.
        relief: with the depths of walls.
        heights_m: where plans are cut, above the floor.
        through: where sections are cut, `x,y,x,y`.
        dimensions: with lengths beside the lines of plans and sections.
        language: of labels.
        light: azimuth and altitude of a raking light, `315,25`.
        base_url: where an IIIF folder will be handed out.
        figure_format: of figures: `pdf`, `svg` or `png`.
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
